"""
PX4 flight logs (ULog): inertial samples, fixes and camera triggers.

Topics read: `sensor_combined` (means over each interval, forward-right-down, rad/s and m/s2), `vehicle_gps_position` or
`sensor_gps`, and `camera_capture` or `camera_trigger`. All carry the autopilot's clock in microseconds, so one time
base is given; what the receiver's message was late by is estimated later like any GPS delay. pyulog [1]_ reads the
container; it is an optional dependency.

References
----------
.. [1] PX4 Autopilot, ULog file format and pyulog, https://github.com/PX4/pyulog.
"""

from __future__ import annotations

import logging
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from changedetect.errors import ConfigError, InputDataError, MissingInputError
from changedetect.io.flight_gps import Fixes, GpsDefaults, check_fixes
from changedetect.io.flight_imu import ImuRange, make_imu_log
from changedetect.navigation.flight import ImuLog, ImuNoise, PhotoList

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.typing import FloatArray

__all__ = ["read_ulog", "read_ulog_photos"]

logger = logging.getLogger(__name__)

_GPS_TOPICS = ("vehicle_gps_position", "sensor_gps")
_CAMERA_TOPICS = ("camera_capture", "camera_trigger")
_PHOTO_SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff", ".png", ".dng")
_MICROSECOND = 1e-6


def read_ulog(path: Path, noise: ImuNoise, limits: ImuRange, defaults: GpsDefaults) -> tuple[ImuLog, Fixes]:
    """
    Read the inertial log and the fixes of a PX4 log.

    Parameters
    ----------
    path : path
    noise : ImuNoise
    limits : ImuRange
    defaults : GpsDefaults
        `geoid_separation` is needed for receivers that give heights above sea level alone.

    Returns
    -------
    imu : ImuLog
        Time in seconds since the autopilot started.
    fixes : Fixes
        3-D fixes only.

    Raises
    ------
    MissingInputError
        There is no such file.
    ConfigError
        pyulog is not installed.
    InputDataError
        The file is damaged, a topic is missing, or its content cannot be used.
    """
    topics = _topics(path, ("sensor_combined", *_GPS_TOPICS))
    sensor = _topic(path, topics, ("sensor_combined",))
    imu = make_imu_log(
        path,
        np.arange(1, sensor["timestamp"].size + 1),
        np.asarray(sensor["timestamp"], dtype=np.float64) * _MICROSECOND,
        _triple(path, sensor, "gyro_rad"),
        _triple(path, sensor, "accelerometer_m_s2"),
        noise,
        limits,
    )
    return imu, _fixes(path, _topic(path, topics, _GPS_TOPICS), defaults)


def read_ulog_photos(path: Path, directory: Path) -> PhotoList | None:
    """
    Pair the photos of a folder with the camera messages of a PX4 log, in order.

    Parameters
    ----------
    path : path
    directory : path
        Photos lie in its subfolder `images`, or in itself; their names sort in the order they were taken.

    Returns
    -------
    photos : PhotoList or None
        None where the log holds no camera messages.

    Raises
    ------
    InputDataError
        There are more or fewer photos than messages: which belongs to which cannot be told.
    """
    topics = _topics(path, _CAMERA_TOPICS)
    if not topics:
        return None
    folder = directory / "images" if (directory / "images").is_dir() else directory
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _PHOTO_SUFFIXES)
    message = _topic(path, topics, _CAMERA_TOPICS)
    time = np.unique(np.asarray(message["timestamp"], dtype=np.float64)) * _MICROSECOND
    if len(files) != time.size:
        msg = (
            f"{path} holds {time.size} camera messages and {folder} {len(files)} photos: which belongs to which cannot "
            "be told. Remove the surplus, or write images.csv (image,time_s) yourself."
        )
        raise InputDataError(msg)
    return PhotoList(tuple(file.name for file in files), time, tuple(files)) if files else None


def _topics(path: Path, wanted: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Columns of the first instance of each wanted topic that the log holds."""
    if not path.is_file():
        msg = f"No such file: {path}."
        raise MissingInputError(msg)
    try:
        from pyulog import ULog  # type: ignore[import-untyped]
        from pyulog.exceptions import ULogException  # type: ignore[import-untyped]
    except ImportError as error:
        msg = f"Reading {path} needs pyulog, which is not installed: pip install pyulog."
        raise ConfigError(msg) from error
    try:
        log = ULog(str(path), list(wanted))
    except (ULogException, TypeError, ValueError, KeyError, IndexError, struct.error, UnicodeDecodeError) as error:
        msg = f"{path} cannot be read as a PX4 log: {error}. Download it from the autopilot again."
        raise InputDataError(msg) from error
    if log.file_corruption:
        logger.warning("%s: parts of the log are damaged and were left out", path)
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts) / 1e3
        logger.warning("%s: the logger lost %d stretches, %.2f s in all", path, len(log.dropouts), lost)
    return {data.name: data.data for data in reversed(log.data_list)}


def _topic(path: Path, topics: dict[str, dict[str, Any]], names: tuple[str, ...]) -> dict[str, Any]:
    for name in names:
        if name in topics:
            return topics[name]
    msg = f"{path} holds no topic {' or '.join(names)}. Log it (PX4: SDLOG_PROFILE) and fly again, or supply text logs."
    raise InputDataError(msg)


def _triple(path: Path, topic: dict[str, Any], name: str) -> FloatArray:
    try:
        return np.column_stack([np.asarray(topic[f"{name}[{axis}]"], dtype=np.float64) for axis in range(3)])
    except KeyError as error:
        msg = f"{path}: the topic has no field {name}[0..2]; its fields are {', '.join(sorted(topic))}."
        raise InputDataError(msg) from error


def _fixes(path: Path, gps: dict[str, Any], defaults: GpsDefaults) -> Fixes:
    """Fixes in degrees and metres from either generation of the message."""
    column = {name: np.asarray(values, dtype=np.float64) for name, values in gps.items()}
    is_3d = column.get("fix_type", np.full(column["timestamp"].size, 3.0)) >= 3
    if not np.any(is_3d):
        msg = f"{path}: the receiver never had a 3-D fix (fix_type below 3 in all {is_3d.size} messages)."
        raise InputDataError(msg)
    if "latitude_deg" in column:
        latitude, longitude = column["latitude_deg"], column["longitude_deg"]
        ellipsoidal, level = column.get("altitude_ellipsoid_m"), column.get("altitude_msl_m")
    else:  # before PX4 1.14: integers, 1e-7 degrees and millimetres
        latitude, longitude = column["lat"] * 1e-7, column["lon"] * 1e-7
        ellipsoidal, level = (1e-3 * column[k] if k in column else None for k in ("alt_ellipsoid", "alt"))
    height = _height(path, ellipsoidal, level, defaults)
    horizontal, vertical = _std(column, "eph", defaults.horizontal_std), _std(column, "epv", defaults.vertical_std)
    velocity = velocity_std = None
    if "vel_n_m_s" in column:
        velocity = np.column_stack([column[k] for k in ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s")])
        speed_std = _std(column, "s_variance_m_s", defaults.velocity_std)
        velocity_std = np.column_stack([speed_std] * 3)
    fixes = Fixes(
        path=path,
        line=np.arange(1, is_3d.size + 1),
        time=column["timestamp"] * _MICROSECOND,
        latitude=latitude,
        longitude=longitude,
        height=height,
        std=np.column_stack([horizontal, horizontal, vertical]),
        velocity_ned=velocity,
        velocity_std=velocity_std,
    )
    return check_fixes(fixes.keep(is_3d))


def _height(path: Path, ellipsoidal: FloatArray | None, level: FloatArray | None, defaults: GpsDefaults) -> FloatArray:
    """Ellipsoidal height; from sea level where the receiver gives no other (zeros)."""
    if ellipsoidal is not None and np.any(ellipsoidal != 0):
        return ellipsoidal
    if level is not None and defaults.geoid_separation is not None:
        return level + defaults.geoid_separation
    msg = (
        f"{path}: the receiver gives heights above sea level alone. Add geoid_separation_m (height of the geoid above "
        "the ellipsoid) to site.json."
    )
    raise InputDataError(msg)


def _std(column: dict[str, FloatArray], name: str, default: float | None) -> FloatArray:
    """Standard deviations of the message where they are positive, else what the site states or 2 m."""
    fallback = 2.0 if default is None else default
    values = column.get(name, np.full(column["timestamp"].size, fallback))
    return np.where(np.isfinite(values) & (values > 0), values, fallback)
