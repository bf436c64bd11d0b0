"""
Positions and attitudes of photos as a table, photos.csv.

Comma-separated, names in the first line. Needed: `photo` (file name), `lat_deg`, `lon_deg`, and one of `alt_m` (above
the ellipsoid) and `alt_msl_m` (above sea level). Optional: `yaw_deg`, `pitch_deg`, `roll_deg` (pitch 0 looks down) or
`gimbal_yaw_deg`, `gimbal_pitch_deg`, `gimbal_roll_deg` (pitch -90 looks down), their `sigma_yaw_deg`,
`sigma_tilt_deg`, the position's `sigma_h_m`, `sigma_v_m`, and `time_s`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError
from changedetect.io.log_table import read_log_table
from changedetect.io.photo_metadata import ELLIPSOID, HORIZON, NADIR, SEA_LEVEL
from changedetect.io.photo_place import PhotoPlace

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.io.log_table import LogTable
    from changedetect.typing import FloatArray

__all__ = ["read_photo_table"]

_BODY = ("yaw_deg", "pitch_deg", "roll_deg")
_GIMBAL = ("gimbal_yaw_deg", "gimbal_pitch_deg", "gimbal_roll_deg")
_YAW_STD, _TILT_STD = 10.0, 3.0


def read_photo_table(path: Path) -> dict[str, PhotoPlace]:
    """
    Read photos.csv.

    Parameters
    ----------
    path : path

    Returns
    -------
    places : dict of PhotoPlace by file name

    Raises
    ------
    InputDataError
        A column is missing, a cell is not a number, or a photo is listed twice.
    """
    table = read_log_table(path, ["photo", "lat_deg", "lon_deg"])
    names = table.texts("photo")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        msg = f"{path}: {twice} is listed twice. Remove one of the lines."
        raise InputDataError(msg)
    latitude, longitude = table.numbers("lat_deg"), table.numbers("lon_deg")
    bad = [k for k in range(len(names)) if abs(latitude[k]) > 90 or abs(longitude[k]) > 360]
    if bad:
        k = bad[0]
        msg = (
            f"{path}, line {table.line[k]}: latitude {latitude[k]}, longitude {longitude[k]} are not degrees. Check "
            "the order and the unit."
        )
        raise InputDataError(msg)
    heights, above = _heights(table)
    angles, counted_from = _angles(table)
    level, up = _optional(table, "sigma_h_m"), _optional(table, "sigma_v_m")
    yaw_std, tilt_std = _optional(table, "sigma_yaw_deg"), _optional(table, "sigma_tilt_deg")
    time = _optional(table, "time_s")
    places = {}
    for k, name in enumerate(names):
        tilt = tilt_std[k] if tilt_std[k] > 0 else _TILT_STD
        places[name] = PhotoPlace(
            latitude=float(latitude[k]),
            longitude=float(longitude[k]),
            height=float(heights[k]) if math.isfinite(heights[k]) else None,
            height_above=above,
            std=_std(float(level[k]), float(up[k])),
            angles=None if angles is None or not math.isfinite(angles[k, 1]) else _triple(angles[k]),
            angles_from=counted_from,
            angles_std=(float(yaw_std[k]) if yaw_std[k] > 0 else _YAW_STD, float(tilt), float(tilt)),
            time=float(time[k]) if math.isfinite(time[k]) else None,
            source=path.name,
        )
    return places


def _heights(table: LogTable) -> tuple[FloatArray, str]:
    if table.has("alt_m") == table.has("alt_msl_m"):
        msg = f"{table.path} needs one of the columns alt_m (above the ellipsoid) and alt_msl_m (above sea level)."
        raise InputDataError(msg)
    if table.has("alt_m"):
        return table.numbers("alt_m", may_be_empty=True), ELLIPSOID
    return table.numbers("alt_msl_m", may_be_empty=True), SEA_LEVEL


def _angles(table: LogTable) -> tuple[FloatArray | None, str]:
    for names, counted_from in ((_BODY, NADIR), (_GIMBAL, HORIZON)):
        if any(table.has(name) for name in names):
            table.require(*names)
            return np.column_stack([table.numbers(name, may_be_empty=True) for name in names]), counted_from
    return None, NADIR


def _optional(table: LogTable, name: str) -> FloatArray:
    return table.numbers(name, may_be_empty=True) if table.has(name) else np.full(len(table), np.nan)


def _std(level: float, up: float) -> tuple[float, float, float] | None:
    if not (math.isfinite(level) and level > 0):
        return None
    return level, level, up if math.isfinite(up) and up > 0 else 1.5 * level


def _triple(row: FloatArray) -> tuple[float, float, float]:
    yaw, pitch, roll = (float(value) for value in row)
    return yaw, pitch, roll if math.isfinite(roll) else 0.0
