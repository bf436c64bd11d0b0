"""
A flight folder, read and checked as a whole.

    imu.csv      inertial log           camera.yaml   lens and mounting     (here or in the folder above)
    gps.csv      GPS fixes              site.json     place, sensors, plan  (optional; here or in the folder above)
    images.csv   photos and times       init.json     initial state         (optional)
    images/      the photos

A PX4 log (one file *.ulg) may stand for imu.csv and gps.csv. The readers of the parts say which columns they take.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.camera_file import read_camera_file
from changedetect.io.flight_gps import Fixes, check_height, make_gps_log, read_fixes
from changedetect.io.flight_imu import check_rate_against_course, read_imu_log
from changedetect.io.flight_photos import check_photo_times, read_photo_list
from changedetect.io.flight_site import Site, read_initial_state, read_site
from changedetect.navigation.flight import Flight, ImuLog, PhotoList
from changedetect.navigation.frame import LocalFrame

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.navigation.camera import CameraIntrinsics, CameraMount

__all__ = ["read_flight"]

logger = logging.getLogger(__name__)


def read_flight(directory: Path, *, camera_file: Path | None = None) -> Flight:
    """
    Read a flight folder and check that its parts fit together.

    Parameters
    ----------
    directory : path
    camera_file : path, optional
        By default camera.yaml in the folder or the one above.

    Returns
    -------
    flight : Flight
        In ENU at the origin of site.json, or at the first fix where there is none.

    Raises
    ------
    MissingInputError
        The folder, a log or a photo is missing.
    InputDataError, VerticalDatumError
        A part cannot be used, or parts do not fit together; the message names the file and the fix.
    """
    if not directory.is_dir():
        msg = f"No such folder: {directory}. A flight is a folder with imu.csv, gps.csv and images.csv."
        raise MissingInputError(msg)
    site_file = _here_or_above(directory, "site.json")
    site = read_site(site_file) if site_file is not None else Site()
    imu_path, imu, fixes = _read_logs(directory, site)
    if site.is_sampled_instantly:
        imu = _interval_means(imu)
    origin = site.origin or _origin_at(fixes)
    gps = make_gps_log(fixes, origin, site.gps.offset_std)
    _check_overlap(directory, imu, fixes)
    check_rate_against_course(imu_path, imu, gps)
    photos = _read_photos(directory, imu_path, origin, imu)
    during = np.zeros(len(fixes), dtype=np.bool_)
    if photos is not None:
        during = (fixes.time >= photos.time[0]) & (fixes.time <= photos.time[-1])
    check_height(fixes, origin, during, site.nominal_height, site.gps.geoid_separation)
    camera, mount = _read_camera(directory, camera_file)
    init_file = directory / "init.json"
    flight = Flight(
        imu=imu,
        gps=gps,
        origin=origin,
        earth=site.earth(origin),
        imu_noise=site.imu_noise,
        photos=photos,
        camera=camera,
        initial=read_initial_state(init_file) if init_file.is_file() else None,
        label=str(directory),
        nominal_height=site.nominal_height,
    )
    return flight if mount is None else replace(flight, mount=mount)


def _here_or_above(directory: Path, name: str) -> Path | None:
    for folder in (directory, directory.resolve().parent):
        if (folder / name).is_file():
            return folder / name
    return None


def _read_logs(directory: Path, site: Site) -> tuple[Path, ImuLog, Fixes]:
    """Inertial log and fixes from comma-separated text or from a PX4 log."""
    ulogs = sorted(directory.glob("*.ulg"))
    if not (directory / "imu.csv").is_file() and ulogs:
        if len(ulogs) > 1:
            names = ", ".join(path.name for path in ulogs)
            msg = f"{directory} holds {len(ulogs)} PX4 logs ({names}); a flight has one. Leave the one that covers it."
            raise InputDataError(msg)
        from changedetect.io.ulog import read_ulog

        imu, fixes = read_ulog(ulogs[0], site.imu_noise, site.imu_range, site.gps)
        return ulogs[0], imu, fixes
    path = directory / "imu.csv"
    return path, read_imu_log(path, site.imu_noise, site.imu_range), read_fixes(directory / "gps.csv", site.gps)


def _read_photos(directory: Path, log: Path, origin: LocalFrame, imu: ImuLog) -> PhotoList | None:
    """Photos of images.csv, or of the camera messages of a PX4 log; None where neither says when they were taken."""
    path = directory / "images.csv"
    if not path.is_file() and log.suffix == ".ulg":
        from changedetect.io.ulog import read_ulog_photos

        photos = read_ulog_photos(log, directory)
        if photos is not None:
            check_photo_times(log, photos, float(imu.time[0]), float(imu.time[-1]))
        return photos
    if not path.is_file():
        logger.info("%s: no images.csv; the flight gives a trajectory but no camera poses", directory)
        return None
    photos = read_photo_list(path, origin)
    check_photo_times(path, photos, float(imu.time[0]), float(imu.time[-1]))
    return photos


def _read_camera(directory: Path, path: Path | None) -> tuple[CameraIntrinsics | None, CameraMount | None]:
    path = path or _here_or_above(directory, "camera.yaml")
    if path is None:
        logger.info("%s: no camera.yaml, here or above; lever arms are taken for zero", directory)
        return None, None
    return read_camera_file(path)


def _origin_at(fixes: Fixes) -> LocalFrame:
    """Origin at the first fix, rounded so that a repeated export gives the same frame."""
    return LocalFrame(
        round(float(fixes.latitude[0]), 4), round(float(fixes.longitude[0]), 4), round(float(fixes.height[0]))
    )


def _check_overlap(directory: Path, imu: ImuLog, fixes: Fixes) -> None:
    inside = int(np.count_nonzero((fixes.time >= imu.time[0]) & (fixes.time <= imu.time[-1])))
    if inside < 5:
        msg = (
            f"{fixes.path}: only {inside} of {len(fixes)} fixes fall into the inertial log of {directory} "
            f"({imu.time[0]:.3f} to {imu.time[-1]:.3f} s; the fixes cover {fixes.time[0]:.3f} to {fixes.time[-1]:.3f} "
            "s). Bring both to one time base, in seconds."
        )
        raise InputDataError(msg)


def _interval_means(imu: ImuLog) -> ImuLog:
    """Means over the intervals of values sampled at their ends (trapezoidal rule)."""

    def mean(values: np.ndarray) -> np.ndarray:
        return np.vstack([values[:1], 0.5 * (values[:-1] + values[1:])])

    return replace(imu, angular_rate=mean(imu.angular_rate), specific_force=mean(imu.specific_force))
