"""Whether photos of a folder belong together: one camera, one flight, each with a position, in the order of time."""

from __future__ import annotations

import logging
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from changedetect.errors import InputDataError
from changedetect.navigation.frame import LocalFrame
from changedetect.storage import sha256_of_file

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from changedetect.io.photo_metadata import PhotoMetadata

__all__ = ["check_copies", "check_one_camera", "check_one_flight", "in_order", "with_positions"]

logger = logging.getLogger(__name__)

#: Largest share of photos without a position that are left out with a warning; beyond it is an error.
_MAX_LOST = 0.34
#: Groups of photos further apart than this many times the usual distance, and than this, m, are of several flights.
_MAX_GAP, _LEAST_GAP = 10.0, 200.0
#: Photos taken further apart in time than this (s) are of several flights.
_MAX_PAUSE = 6 * 3600.0
_FEWEST = 3


def check_one_camera(photos: Sequence[PhotoMetadata]) -> None:
    """
    Refuse photos of several cameras or sizes.

    Raises
    ------
    InputDataError
    """
    for what, values in (
        ("size", [f"{photo.width} x {photo.height} pixels" for photo in photos]),
        ("camera", [photo.camera or "an unnamed camera" for photo in photos]),
    ):
        counts = Counter(values)
        if len(counts) > 1:
            most, rare = counts.most_common()[0][0], counts.most_common()[-1][0]
            odd = photos[values.index(rare)].path
            msg = (
                f"{odd} is of {rare}, {counts[most]} of {len(photos)} photos are of {most}. Photos of one flight have "
                f"one {what}: move the others to a folder of their own, and export all unrotated and in full size."
            )
            raise InputDataError(msg)


def with_positions(directory: Path, photos: Sequence[PhotoMetadata]) -> list[PhotoMetadata]:
    """
    Photos that say where they were taken.

    Raises
    ------
    InputDataError
        Too many do not, or too few are left.
    """
    found = [photo for photo in photos if photo.latitude is not None and photo.longitude is not None]
    lost = [photo.path.name for photo in photos if photo.latitude is None or photo.longitude is None]
    fix = (
        "Give their places in geo.txt (as OpenDroneMap takes it) or photos.csv beside them, or the logs of the flight "
        "(imu.csv, gps.csv), or copy the photos without software that strips EXIF"
    )
    if len(lost) > _MAX_LOST * len(photos):
        msg = (
            f"{len(lost)} of {len(photos)} photos in {directory} have no GPS position in EXIF ({lost[0]}, ...). {fix}."
        )
        raise InputDataError(msg)
    if len(found) < _FEWEST:
        msg = f"{directory} has {len(found)} photos; at least {_FEWEST} that overlap are needed."
        raise InputDataError(msg)
    if lost:
        logger.warning(
            "%s: %d of %d photos have no GPS position and are left out: %s. %s",
            directory, len(lost), len(photos), ", ".join(lost[:5]), fix,
        )  # fmt: skip
    return found


def in_order(photos: Sequence[PhotoMetadata]) -> list[PhotoMetadata]:
    """Photos in the order of time, where all state one, else of their names."""
    if any(photo.time is None for photo in photos):
        return sorted(photos, key=lambda photo: photo.path.name)
    ordered = sorted(photos, key=lambda photo: (photo.time or 0.0, photo.path.name))
    names = [photo.path.name for photo in ordered]
    if names != sorted(names):
        logger.info("photos were not named in the order of time; sorted by time, %s first", names[0])
    return ordered


def check_one_flight(directory: Path, photos: Sequence[PhotoMetadata]) -> None:
    """
    Refuse photos of several places or days, and copies.

    Raises
    ------
    InputDataError
    """
    latitude = np.array([photo.latitude for photo in photos], dtype=np.float64)
    longitude = np.array([photo.longitude for photo in photos], dtype=np.float64)
    frame = LocalFrame(float(np.median(latitude)), float(np.median(longitude)), 0.0)
    place = frame.to_enu(latitude, longitude, np.zeros(len(photos)))[:, :2]
    tree = cKDTree(place)
    usual = float(np.median(np.atleast_2d(tree.query(place, k=2)[0])[:, 1]))
    reach = max(_MAX_GAP * usual, _LEAST_GAP)
    _, label = connected_components(tree.sparse_distance_matrix(tree, reach).tocsr(), directed=False)
    counts = np.bincount(label)
    if counts.size > 1:
        away = np.flatnonzero(label != counts.argmax())
        main = place[label == counts.argmax()]
        distance = float(np.min(np.linalg.norm(main - place[away[0]], axis=1)))
        msg = (
            f"{photos[away[0]].path} and {away.size - 1} more of {len(photos)} photos in {directory} were taken "
            f"{distance:,.0f} m from the others, which are {usual:.0f} m apart. They are of another flight, or their "
            "GPS was wrong: move them to a folder of their own."
        )
        raise InputDataError(msg)
    times = np.array([np.nan if photo.time is None else photo.time for photo in photos])
    pause = np.diff(np.sort(times[np.isfinite(times)]))
    if pause.size and pause.max() > _MAX_PAUSE:
        order = np.argsort(times)
        later = photos[int(order[int(np.argmax(pause)) + 1])]
        msg = (
            f"{later.path} was taken {pause.max() / 3600:,.0f} hours after the photo before it: photos of several "
            f"flights are in {directory}. Ground changes between flights: give each a folder of its own."
        )
        raise InputDataError(msg)
    check_copies([photo.path for photo in photos])


def check_copies(paths: Sequence[Path]) -> None:
    """
    Refuse a photo that is there twice, whatever its names: it would count twice.

    Raises
    ------
    InputDataError
    """
    of_size: dict[int, list[Path]] = {}
    for path in paths:
        of_size.setdefault(path.stat().st_size, []).append(path)
    for group in of_size.values():
        if len(group) < 2:
            continue
        first: dict[str, Path] = {}
        for path in group:
            other = first.setdefault(sha256_of_file(path), path)
            if other is not path:
                msg = f"{path} is a copy of {other.name}. Put the right picture there, or remove one of them."
                raise InputDataError(msg)
