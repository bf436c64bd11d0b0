"""GPS logs: fixes, their heights and their noise."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError, VerticalDatumError
from changedetect.io.log_table import LogTable, read_log_table
from changedetect.navigation.flight import GpsLog

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.navigation.frame import LocalFrame
    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["Fixes", "GpsDefaults", "check_fixes", "check_height", "make_gps_log", "read_fixes"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class GpsDefaults:
    """
    What the log itself may leave open.

    Parameters
    ----------
    horizontal_std, vertical_std : float, m, optional
        Noise of a fix, where the log has no columns for it.
    velocity_std : float, m/s
    offset_std : float, m
        Of the offset that lasts a whole flight.
    geoid_separation : float, m, optional
        Height of the geoid above the ellipsoid at the site.
    """

    horizontal_std: float | None = None
    vertical_std: float | None = None
    velocity_std: float = 0.3
    offset_std: float = 0.0
    geoid_separation: float | None = None


@dataclass(frozen=True)
class Fixes:
    """
    GPS fixes in geographic coordinates.

    Parameters
    ----------
    path : path
    line : array of int, shape (n,)
    time : array, shape (n,), s
    latitude, longitude : array, shape (n,), degrees, WGS 84
    height : array, shape (n,), m above the ellipsoid
    std : array, shape (n, 3), m
        East, north, up.
    velocity_ned : array, shape (n, 3), m/s, optional
        North, east, down.
    velocity_std : array, shape (n, 3), m/s, optional
    """

    path: Path
    line: IntArray
    time: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray
    std: FloatArray
    velocity_ned: FloatArray | None = None
    velocity_std: FloatArray | None = None

    def __len__(self) -> int:
        return int(self.time.size)

    def keep(self, rows: BoolArray) -> Fixes:
        """Fixes of the rows that are True."""
        return Fixes(
            self.path,
            self.line[rows],
            self.time[rows],
            self.latitude[rows],
            self.longitude[rows],
            self.height[rows],
            self.std[rows],
            None if self.velocity_ned is None else self.velocity_ned[rows],
            None if self.velocity_std is None else self.velocity_std[rows],
        )


def read_fixes(path: Path, defaults: GpsDefaults) -> Fixes:
    """
    Read a GPS log of comma-separated text.

    Parameters
    ----------
    path : path
        Columns `time_s`, `lat_deg`, `lon_deg`, and `alt_m` (above the WGS 84 ellipsoid) or `alt_msl_m` (above sea
        level, with the geoid's height in a column `geoid_separation_m` or in site.json); noise in `sigma_h_m`,
        `sigma_v_m`; velocity, where the receiver gives it, in `vn_m_s`, `ve_m_s`, `vd_m_s` and `sigma_vel_m_s`.
    defaults : GpsDefaults

    Returns
    -------
    fixes : Fixes

    Raises
    ------
    MissingInputError, InputDataError
        As `read_log_table`; or no fix at all, time that does not increase, coordinates or noise out of range.
    VerticalDatumError
        Heights above sea level without the geoid's height.
    """
    table = read_log_table(path, ["time_s", "lat_deg", "lon_deg"])
    if len(table) == 0:
        msg = f"{path} holds no fixes, only a header. Supply the GPS log of the flight."
        raise InputDataError(msg)
    n = len(table)
    horizontal = _noise(table, "sigma_h_m", defaults.horizontal_std)
    vertical = _noise(table, "sigma_v_m", defaults.vertical_std)
    velocity = velocity_std = None
    if table.has("vn_m_s", "ve_m_s", "vd_m_s"):
        velocity = np.column_stack([table.numbers(c, may_be_empty=True) for c in ("vn_m_s", "ve_m_s", "vd_m_s")])
        std = table.numbers("sigma_vel_m_s") if table.has("sigma_vel_m_s") else np.full(n, defaults.velocity_std)
        velocity_std = np.column_stack([std, std, std])
    fixes = Fixes(
        path=path,
        line=table.line,
        time=table.numbers("time_s"),
        latitude=table.numbers("lat_deg"),
        longitude=table.numbers("lon_deg"),
        height=_ellipsoidal_height(table, defaults),
        std=np.column_stack([horizontal, horizontal, vertical]),
        velocity_ned=velocity,
        velocity_std=velocity_std,
    )
    return check_fixes(fixes)


def make_gps_log(fixes: Fixes, frame: LocalFrame, offset_std: float) -> GpsLog:
    """
    Fixes in the local frame.

    Parameters
    ----------
    fixes : Fixes
    frame : LocalFrame
    offset_std : float, m

    Returns
    -------
    gps : GpsLog

    Raises
    ------
    InputDataError
        The fixes lie more than 100 km from the origin, where a tangent plane has no meaning for a survey.
    """
    position = frame.to_enu(fixes.latitude, fixes.longitude, fixes.height)
    distance = np.hypot(position[:, 0], position[:, 1])
    if float(np.median(distance)) > 1e5:
        msg = (
            f"{fixes.path}: the fixes lie {np.median(distance) / 1e3:.0f} km from the origin of site.json "
            f"({frame.latitude}, {frame.longitude}). Correct the origin, or check that latitude and longitude are not "
            "swapped."
        )
        raise InputDataError(msg)
    velocity = None
    if fixes.velocity_ned is not None:
        north, east, down = fixes.velocity_ned.T
        velocity = np.column_stack([east, north, -down])
    return GpsLog(fixes.time, position, fixes.std, velocity, fixes.velocity_std, offset_std)


def check_height(
    fixes: Fixes, frame: LocalFrame, during: BoolArray, nominal_height: float | None, separation: float | None
) -> None:
    """
    Refuse heights above sea level that are stated to be ellipsoidal.

    Parameters
    ----------
    fixes : Fixes
    frame : LocalFrame
        Origin with its ellipsoidal height, taken for the level of the ground.
    during : array of bool, shape (n,)
        Fixes while photos were taken.
    nominal_height : float, m, optional
        Planned height above ground. None: nothing can be told.
    separation : float, m, optional
        Height of the geoid above the ellipsoid.

    Raises
    ------
    VerticalDatumError
        The flight is off its planned height by the geoid's height, or by more than 15 m and a quarter of that height.
    """
    if nominal_height is None or not np.any(during):
        return
    off = float(np.median(fixes.height[during]) - frame.height - nominal_height)
    bound = max(15.0, 0.25 * nominal_height)
    is_geoid = separation is not None and abs(separation) > 8.0 and abs(off + separation) < 0.3 * abs(separation)
    if abs(off) > bound or is_geoid:
        cause = (
            f"by the height of the geoid above the ellipsoid ({separation:.1f} m): column alt_m holds heights above "
            "sea level. Rename it alt_msl_m"
            if is_geoid
            else "as heights above sea level are: if column alt_m holds those, rename it alt_msl_m and give "
            "geoid_separation_m in site.json; else correct alt_ellipsoidal_m or nominal_height_m there, or leave it out"
        )
        msg = (
            f"{fixes.path}: while photos were taken the GPS was {abs(off):.1f} m {'above' if off > 0 else 'below'} the "
            f"planned height ({nominal_height:g} m over a ground at {frame.height:g} m above the ellipsoid), {cause}."
        )
        raise VerticalDatumError(msg)


def _noise(table: LogTable, name: str, default: float | None) -> FloatArray:
    """Column of standard deviations, or what the site states for all fixes."""
    if table.has(name):
        values = table.numbers(name)
        if np.any(values <= 0):
            row = int(np.flatnonzero(values <= 0)[0])
            msg = f"{table.path}, line {table.line[row]}: {name} is {values[row]:g}; a fix needs a positive one."
            raise InputDataError(msg)
        return values
    if default is None:
        msg = (
            f"{table.path} has no column {name}, and site.json states no noise of the GPS. Add the column, or "
            '"gps": {"sigma_h_m": ..., "sigma_v_m": ...} to site.json.'
        )
        raise InputDataError(msg)
    return np.full(len(table), default)


def _ellipsoidal_height(table: LogTable, defaults: GpsDefaults) -> FloatArray:
    if table.has("alt_m"):
        return table.numbers("alt_m")
    if not table.has("alt_msl_m"):
        msg = (
            f"{table.path} has neither alt_m (above the ellipsoid) nor alt_msl_m (above sea level); its header says "
            f"{', '.join(table.columns)}."
        )
        raise InputDataError(msg)
    if table.has("geoid_separation_m"):
        return table.numbers("alt_msl_m") + table.numbers("geoid_separation_m")
    if defaults.geoid_separation is None:
        msg = (
            f"{table.path} gives heights above sea level (alt_msl_m) without the height of the geoid above the "
            "ellipsoid. Add a column geoid_separation_m, or geoid_separation_m to site.json."
        )
        raise VerticalDatumError(msg)
    return table.numbers("alt_msl_m") + defaults.geoid_separation


def check_fixes(fixes: Fixes) -> Fixes:
    """
    Leave out empty and repeated fixes.

    Parameters
    ----------
    fixes : Fixes

    Returns
    -------
    fixes : Fixes

    Raises
    ------
    InputDataError
        No fix is left, coordinates are not degrees, or time runs backwards.
    """
    bad = (np.abs(fixes.latitude) > 90) | (np.abs(fixes.longitude) > 360)
    if np.any(bad):
        row = int(np.flatnonzero(bad)[0])
        msg = (
            f"{fixes.path}, line {fixes.line[row]}: latitude {fixes.latitude[row]:g}, longitude "
            f"{fixes.longitude[row]:g} are not degrees. Receivers' 1e-7 degrees must be divided; check the order too."
        )
        raise InputDataError(msg)
    empty = (fixes.latitude == 0.0) & (fixes.longitude == 0.0)
    if np.any(empty):
        if np.all(empty):
            msg = f"{fixes.path}: every fix is at latitude 0, longitude 0: the receiver never had a fix."
            raise InputDataError(msg)
        logger.warning(
            "%s: %d rows at latitude 0, longitude 0 (no fix) left out, the first at line %d",
            fixes.path,
            empty.sum(),
            fixes.line[empty][0],
        )
        fixes = fixes.keep(~empty)
    step = np.diff(fixes.time)
    if np.any(step < 0):
        row = int(np.flatnonzero(step < 0)[0]) + 1
        msg = (
            f"{fixes.path}, line {fixes.line[row]}: time goes back from {fixes.time[row - 1]:.3f} to "
            f"{fixes.time[row]:.3f} s. Sort the log, or split it where the clock was set."
        )
        raise InputDataError(msg)
    repeated = np.concatenate([[False], step == 0])
    if np.any(repeated):
        logger.warning(
            "%s: %d fixes with the stamp of the one before left out, the first at line %d",
            fixes.path,
            repeated.sum(),
            fixes.line[repeated][0],
        )
        fixes = fixes.keep(~repeated)
    return fixes
