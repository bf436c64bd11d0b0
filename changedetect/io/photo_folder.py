"""
A folder of photos without logs, read and checked as a whole.

    *.jpg, images/*.jpg   photos with EXIF and XMP
    geo.txt               places and angles, as OpenDroneMap takes them           (optional)
    photos.csv            the same as a table with named columns                  (optional)
    *Timestamp.MRK        places, of DJI aircraft with RTK                        (optional)
    camera.yaml           lens; else the focal length is taken from EXIF          (optional; here or above)
    site.json             origin, geoid_separation_m, crs                         (optional; here or above)

The first of geo.txt, photos.csv and *Timestamp.MRK that is there replaces what the photos say of their places. What is
stated becomes poses with standard deviations: positions of a GPS without corrections share an error of metres, and
their heights often count from a level that nobody knows.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.camera_file import read_camera_file
from changedetect.io.flight_site import Site, read_site
from changedetect.io.mrk import places_of_photos, read_mrk
from changedetect.io.odm import read_geo
from changedetect.io.photo_attitude import photo_attitudes
from changedetect.io.photo_checks import check_one_camera, check_one_flight, in_order, with_positions
from changedetect.io.photo_heights import photo_heights
from changedetect.io.photo_metadata import PhotoMetadata, read_photo_metadata
from changedetect.io.photo_place import PhotoPlace, with_place
from changedetect.io.photo_table import read_photo_table
from changedetect.navigation.camera import CameraIntrinsics, CameraMount
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from changedetect.typing import BoolArray, FloatArray

__all__ = ["PhotoFolder", "PlacedPhotos", "find_photos", "is_photo_folder", "placed_photos", "read_photo_folder"]

logger = logging.getLogger(__name__)

#: Files that make a folder a flight with logs.
_LOGS = ("imu.csv", "gps.csv")
_SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
#: Of a GPS without corrections: what changes from photo to photo, and what the whole flight shares, m.
_LEVEL_STD, _SHARED_LEVEL_STD = 1.5, 3.0
#: Of a lens known from EXIF: relative focal length, principal point as a share of the width; k1, k2, k3, p1, p2 and the
#: relative difference of fx and fy.
_FOCAL_STD, _CENTRE_STD = 0.05, 0.015
_DISTORTION_STD = (0.1, 0.1, 0.1, 0.002, 0.002, 0.002)


@dataclass(frozen=True)
class PhotoFolder:
    """
    Photos as poses with priors.

    Attributes
    ----------
    poses : CameraPoses
        In the order of time.
    camera : CameraIntrinsics
        Of the photos as they are.
    paths : tuple of path
    lens_std : tuple of 9 float, optional
        Of log focal length, cx, cy (pixels), k1, k2, k3, p1, p2, log fx / fy; None where a camera file states the lens.
    has_heading : array, shape (n,), bool
    camera_file : str
        Where the lens comes from.
    description : dict
        For the report.
    """

    poses: CameraPoses
    camera: CameraIntrinsics
    paths: tuple[Path, ...]
    lens_std: tuple[float, ...] | None
    has_heading: BoolArray
    camera_file: str
    description: dict[str, Any]


@dataclass(frozen=True)
class PlacedPhotos:
    """
    Positions of photos.

    Attributes
    ----------
    position : array, shape (n, 3), ENU, m
    origin : LocalFrame
    shared_std : array, shape (3,), m
        Of the error all positions share: east, north, up.
    source : str
        Where they come from.
    """

    position: FloatArray
    origin: LocalFrame
    shared_std: FloatArray
    source: str


def is_photo_folder(directory: Path) -> bool:
    """Whether a folder exists and holds no logs of a flight."""
    if not directory.is_dir() or any((directory / name).is_file() for name in _LOGS):
        return False
    return next(directory.glob("*.ulg"), None) is None


def find_photos(directory: Path) -> list[Path]:
    """
    Photos of a folder: those in its subfolder `images` if there is one, else its own; in the order of their names.

    Raises
    ------
    MissingInputError
        There are none.
    """
    for folder in (directory / "images", directory):
        found = sorted(path for path in folder.glob("*") if path.suffix.lower() in _SUFFIXES and path.is_file())
        if found:
            return found
    msg = (
        f"{directory} holds neither the logs of a flight (imu.csv, gps.csv, or a PX4 .ulg) nor photos "
        f"({', '.join(_SUFFIXES)}), here or in {directory.name}/images."
    )
    raise MissingInputError(msg)


def read_photo_folder(directory: Path, *, camera_file: Path | None = None) -> PhotoFolder:
    """
    Read a folder of photos.

    Parameters
    ----------
    directory : path
    camera_file : path, optional
        By default camera.yaml in the folder or the one above, else EXIF.

    Raises
    ------
    MissingInputError
        There are no photos, or a list names some that are not there.
    InputDataError, VerticalDatumError
        Photos cannot be used, or do not belong together; the message names the file and the fix.
    """
    photos = [read_photo_metadata(path) for path in find_photos(directory)]
    photos, listed = _with_lists(directory, photos)
    check_one_camera(photos)
    photos = in_order(with_positions(directory, photos))
    check_one_flight(directory, photos)
    site = _site_of(directory)
    heights = photo_heights(directory, photos, site.gps.geoid_separation)
    camera, mount, lens_std, camera_name = _camera(directory, photos, camera_file)
    attitudes = photo_attitudes(photos, mount)
    keep = attitudes.looks_down
    photos = [photo for photo, is_kept in zip(photos, keep, strict=True) if is_kept]
    latitude, longitude = _coordinates(photos)
    height = heights.height[keep]
    origin = site.origin or _origin_at(latitude, longitude, height)
    covariance = np.zeros((len(photos), 6, 6))
    level, shared = _level_std(photos)
    covariance[:, :3, :3] = [np.diag(std**2) for std in np.column_stack([level, heights.std[keep]])]
    covariance[:, 3:, 3:] = attitudes.covariance[keep]
    common = np.diag([shared**2, shared**2, heights.shared_std**2, 0.0, 0.0, 0.0])
    poses = CameraPoses(
        names=tuple(photo.path.name for photo in photos),
        time=np.array([np.nan if photo.time is None else photo.time for photo in photos]),
        position=origin.to_enu(latitude, longitude, height),
        rotation=attitudes.rotation[keep],
        covariance=covariance,
        origin=origin,
        common_covariance=common if np.any(common) else None,
    )
    description = {
        "source": "photos",
        "camera": photos[0].camera,
        "positions": listed or "EXIF and XMP",
        "position_std_m": [float(np.median(level[:, 0])), float(np.median(heights.std))],
        "shared_position_std_m": [shared, heights.shared_std],
        "heights": heights.above,
        "angles": attitudes.source,
        "focal_px": camera.fx,
        "focal_from": camera_name if lens_std is None else photos[0].focal_source,
        "n_left_out": int((~keep).sum()),
    }
    paths = tuple(photo.path for photo in photos)
    return PhotoFolder(poses, camera, paths, lens_std, attitudes.has_heading[keep], camera_name, description)


def placed_photos(directory: Path, paths: Sequence[Path]) -> PlacedPhotos:
    """
    Positions of given photos of a folder, for a model that floats.

    Raises
    ------
    InputDataError
        A photo does not say where it was taken.
    """
    photos, listed = _with_lists(directory, [read_photo_metadata(path) for path in paths])
    lost = [photo.path.name for photo in photos if photo.latitude is None or photo.longitude is None]
    if lost:
        msg = (
            f"{len(lost)} of {len(photos)} photos in {directory} have no position ({lost[0]}, ...), and the model has "
            "no place on Earth. Give places in geo.txt or photos.csv beside the photos, or align the model (COLMAP: "
            "model_aligner --alignment_type ecef)."
        )
        raise InputDataError(msg)
    site = _site_of(directory)
    heights = photo_heights(directory, photos, site.gps.geoid_separation)
    latitude, longitude = _coordinates(photos)
    origin = site.origin or _origin_at(latitude, longitude, heights.height)
    _, shared = _level_std(photos)
    position = origin.to_enu(latitude, longitude, heights.height)
    return PlacedPhotos(position, origin, np.array([shared, shared, heights.shared_std]), listed or "EXIF and XMP")


def _coordinates(photos: Sequence[PhotoMetadata]) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude of photos that have them, degrees."""
    latitude = np.array([photo.latitude for photo in photos], dtype=np.float64)
    return latitude, np.array([photo.longitude for photo in photos], dtype=np.float64)


def _origin_at(latitude: FloatArray, longitude: FloatArray, height: FloatArray) -> LocalFrame:
    """Origin at the first photo, rounded so that other photos of the site give nearly the same."""
    return LocalFrame(round(float(latitude[0]), 4), round(float(longitude[0]), 4), round(float(height.min())))


def _site_of(directory: Path) -> Site:
    """What site.json of the folder, or the one above, says; nothing where there is none."""
    for folder in (directory, directory.resolve().parent):
        if (folder / "site.json").is_file():
            return read_site(folder / "site.json")
    return Site()


def _with_lists(directory: Path, photos: list[PhotoMetadata]) -> tuple[list[PhotoMetadata], str]:
    """Photos with the places of the first list that is there, and its name."""
    names = [photo.path.name for photo in photos]
    places: dict[str, PhotoPlace] = {}
    marks = sorted(path for path in directory.iterdir() if path.name.lower().endswith("timestamp.mrk"))
    if (directory / "geo.txt").is_file():
        path = directory / "geo.txt"
        places = read_geo(path)
    elif (directory / "photos.csv").is_file():
        path = directory / "photos.csv"
        places = read_photo_table(path)
    elif marks:
        if len(marks) > 1:
            msg = f"{directory} holds {len(marks)} Timestamp.MRK files ({marks[0].name}, ...); a flight has one."
            raise InputDataError(msg)
        path = marks[0]
        places = places_of_photos(path, read_mrk(path), names)
    else:
        return photos, ""
    missing = sorted(set(places) - set(names))
    if missing:
        msg = (
            f"{path} names {len(missing)} photo(s) that are not in the folder: {', '.join(missing[:5])}"
            f"{' ...' if len(missing) > 5 else ''}. Put them there, or remove their lines."
        )
        raise MissingInputError(msg)
    unlisted = [name for name in names if name not in places]
    if unlisted:
        logger.warning(
            "%s: %d of %d photos are not listed (%s); they keep the places of their EXIF",
            path, len(unlisted), len(names), ", ".join(unlisted[:5]),
        )  # fmt: skip
    listed = [with_place(p, places[p.path.name]) if p.path.name in places else p for p in photos]
    return listed, path.name


def _level_std(photos: Sequence[PhotoMetadata]) -> tuple[FloatArray, float]:
    """Standard deviations east and north of every photo, shape (n, 2), and of what they share."""
    stated = [photo.position_std for photo in photos]
    level = [(_LEVEL_STD, _LEVEL_STD) if std is None else std[:2] for std in stated]
    return np.array(level, dtype=np.float64), _SHARED_LEVEL_STD if None in stated else 0.0


def _camera(
    directory: Path, photos: Sequence[PhotoMetadata], camera_file: Path | None
) -> tuple[CameraIntrinsics, CameraMount | None, tuple[float, ...] | None, str]:
    """Lens, mounting, how well the lens is known (None: exactly), and where it comes from."""
    path = camera_file
    if path is None:
        folders = (directory, directory.resolve().parent)
        path = next((folder / "camera.yaml" for folder in folders if (folder / "camera.yaml").is_file()), None)
    focals = [photo.focal for photo in photos if photo.focal is not None]
    first = photos[0]
    if path is not None:
        camera, mount = read_camera_file(path)
        if focals and not 0.8 < camera.fx / float(np.median(focals)) < 1.25 and camera.width == first.width:
            logger.warning(
                "%s states a focal length of %.0f pixels, %s of %s one of %.0f. Check that the camera file is of these "
                "photos", path, camera.fx, first.focal_source, first.path.name, float(np.median(focals)),
            )  # fmt: skip
        return camera, mount, None, path.name
    if not focals:
        msg = (
            f"{first.path} and {len(photos) - 1} more state no focal length in EXIF (FocalLengthIn35mmFilm, or "
            "FocalLength with FocalPlaneXResolution). Give a camera file (--camera, or camera.yaml in the folder)."
        )
        raise InputDataError(msg)
    focal = float(np.median(focals))
    other = [photo for photo in photos if photo.focal is not None and abs(photo.focal / focal - 1) > 0.02]
    if other:
        msg = (
            f"{other[0].path} has a focal length of {other[0].focal:.0f} pixels, the others one of {focal:.0f}: the "
            "lens was zoomed. Put photos of each focal length into a folder of their own."
        )
        raise InputDataError(msg)
    width, height = first.width, first.height
    camera = CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    centre = _CENTRE_STD * max(width, height)
    return camera, None, (_FOCAL_STD, centre, centre, *_DISTORTION_STD), "EXIF"
