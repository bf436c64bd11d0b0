"""
Inertial logs: units, time and plausibility.

A strapdown solution believes its sensor: degrees for radians or g for m/s2 give a wrong answer, not an error. What can
be told from the numbers is checked here, before anything is computed from them.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError
from changedetect.io.log_table import LogTable, read_log_table
from changedetect.navigation.flight import GpsLog, ImuLog, ImuNoise

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["ImuRange", "check_rate_against_course", "make_imu_log", "read_imu_log"]

logger = logging.getLogger(__name__)

_GRAVITY = 9.80665
#: Factor to SI by the suffix of a column.
_RATE_UNITS = {"rad_s": 1.0, "deg_s": math.pi / 180.0}
_FORCE_UNITS = {"m_s2": 1.0, "g": _GRAVITY, "mg": 1e-3 * _GRAVITY}
#: Intervals this much longer than the median are gaps; gaps up to this long (s) are bridged.
_GAP_RATIO = 1.5
_LONGEST_GAP = 0.5
#: Factor on the noise of a sample at the sensor's limit: the true value may be anything beyond.
_SATURATED_FACTOR = 30.0
_MAX_SATURATED = 0.02
#: Steps of resolution between the median and a limit: coarse logs of a sensor at rest repeat their values.
_CLEAR_OF_REST = 50.0


@dataclass(frozen=True)
class ImuRange:
    """
    Where the sensor saturates, on every axis; None where it is not stated.

    Parameters
    ----------
    rate : float, rad/s, optional
    force : float, m/s2, optional
    """

    rate: float | None = None
    force: float | None = None


def read_imu_log(path: Path, noise: ImuNoise, limits: ImuRange) -> ImuLog:
    """
    Read an inertial log of comma-separated text.

    Parameters
    ----------
    path : path
        Columns `time_s` (end of the interval), `gyro_x_rad_s` (or `_deg_s`), `acc_x_m_s2` (or `_g`, `_mg`), likewise y
        and z; body axes forward-right-down, specific force, means over the interval.
    noise : ImuNoise
    limits : ImuRange

    Returns
    -------
    imu : ImuLog

    Raises
    ------
    MissingInputError, InputDataError
        As `read_log_table` and `make_imu_log`.
    """
    table = read_log_table(path, ["time_s"])
    rate = _vector(table, "gyro", _RATE_UNITS)
    force = _vector(table, "acc", _FORCE_UNITS)
    return make_imu_log(path, table.line, table.numbers("time_s"), rate, force, noise, limits)


def make_imu_log(
    path: Path,
    line: IntArray,
    time: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    noise: ImuNoise,
    limits: ImuRange,
) -> ImuLog:
    """
    Check inertial samples and mark what cannot be believed as stated.

    Parameters
    ----------
    path : path
        For messages.
    line : array of int, shape (n,)
        Where each sample stands in the file.
    time : array, shape (n,), s
    rate, force : array, shape (n, 3), FRD, rad/s and m/s2
    noise : ImuNoise
    limits : ImuRange

    Returns
    -------
    imu : ImuLog
        Without repeated rows; bridged gaps and saturated samples carry a noise factor above 1.

    Raises
    ------
    InputDataError
        Too few samples, time that runs backwards, two different samples with one stamp, a gap above 0.5 s, units or
        axes that cannot be right, or more than 2 % of the samples saturated.
    """
    rows = _without_repeats(path, line, time, rate, force) if time.size else np.zeros(0, bool)
    line, time, rate, force = line[rows], time[rows], rate[rows].copy(), force[rows].copy()
    if time.size < 10:
        msg = f"{path} has {time.size} inertial samples; at least 10 are needed. Export the whole log."
        raise InputDataError(msg)
    _check_units(path, rate, force)
    factor = np.ones(time.size)
    saturated = _saturated(path, line, time, rate, limits.rate, "angular rate")
    saturated |= _saturated(path, line, time, force, limits.force, "specific force")
    factor[saturated] = _SATURATED_FACTOR
    _bridge_gaps(path, line, time, rate, force, noise, factor)
    return ImuLog(time, rate, force, factor)


def check_rate_against_course(path: Path, imu: ImuLog, gps: GpsLog) -> None:
    """
    Compare the gyro's rate with the turns the GPS saw.

    In a coordinated turn the rate of turn of the course is the magnitude of the angular rate. A log in deg/s that is
    taken for rad/s exceeds it 57 times.

    Parameters
    ----------
    path : path
        Of the inertial log, for the message.
    imu : ImuLog
    gps : GpsLog

    Raises
    ------
    InputDataError
        The rates differ by more than a factor of eight over the turns of the flight. Flights without turns pass.
    """
    window = 4.0
    ratios = []
    for begin in np.arange(max(gps.time[0], imu.time[0]), min(gps.time[-1], imu.time[-1]) - window, window / 2):
        half = begin + window / 2
        first, second = (_mean_velocity(gps, a, a + window / 2) for a in (begin, half))
        if first is None or second is None or min(np.hypot(*first), np.hypot(*second)) < 6.0:
            continue
        turn = math.atan2(first[0] * second[1] - first[1] * second[0], first @ second) / (window / 2)
        inside = (imu.time > begin + window / 4) & (imu.time <= begin + 3 * window / 4)
        if abs(turn) > 0.1 and np.any(inside):
            ratios.append(float(np.linalg.norm(imu.angular_rate[inside].mean(axis=0))) / abs(turn))
    if len(ratios) < 3:
        return
    ratio = float(np.median(ratios))
    if not 1 / 8 < ratio < 8:
        units = "degrees for radians (rename the columns gyro_x_deg_s, gyro_y_deg_s, gyro_z_deg_s)"
        msg = (
            f"{path}: in the turns of the flight the angular rate is {ratio:.2g} times what the GPS course shows. "
            f"The columns probably hold {units if ratio > 1 else 'radians for degrees, or clocks that do not agree'}."
        )
        raise InputDataError(msg)


def _vector(table: LogTable, prefix: str, units: dict[str, float]) -> FloatArray:
    """Three columns of one unit, in SI."""
    for suffix, factor in units.items():
        names = [f"{prefix}_{axis}_{suffix}" for axis in "xyz"]
        if table.has(*names):
            return np.column_stack([table.numbers(name) for name in names]) * factor
    choices = " or ".join(f"{prefix}_x_{suffix}" for suffix in units)
    msg = (
        f"{table.path} has no columns {choices} (and y, z); its header says {', '.join(table.columns)}. Rename the "
        "columns: the unit is part of the name."
    )
    raise InputDataError(msg)


def _without_repeats(path: Path, line: IntArray, time: FloatArray, rate: FloatArray, force: FloatArray) -> BoolArray:
    """Rows that are not exact copies of the one before; refuses time that stands still or runs backwards."""
    step = np.diff(time)
    if np.any(step < 0):
        row = int(np.flatnonzero(step < 0)[0]) + 1
        msg = (
            f"{path}, line {line[row]}: time goes back from {time[row - 1]:.6f} to {time[row]:.6f} s. Sort the log, or "
            "split it where the clock was set."
        )
        raise InputDataError(msg)
    same = np.concatenate([[False], step == 0])
    copy = same & np.concatenate([[False], np.all(np.diff(np.hstack([rate, force]), axis=0) == 0, axis=1)])
    if np.any(same & ~copy):
        row = int(np.flatnonzero(same & ~copy)[0])
        msg = (
            f"{path}, line {line[row]}: the stamp {time[row]:.6f} s is that of the line before, with other values "
            f"({int(np.sum(same & ~copy))} such line(s)). Give every sample its own time, with enough digits."
        )
        raise InputDataError(msg)
    if np.any(copy):
        logger.warning("%s: %d repeated rows left out, the first at line %d", path, copy.sum(), line[copy][0])
    return np.asarray(~copy)


def _check_units(path: Path, rate: FloatArray, force: FloatArray) -> None:
    """Gravity tells the unit of force and the direction of down; no aircraft turns at more than 12 rad/s for long."""
    size = float(np.median(np.linalg.norm(force, axis=1)))
    if not 0.7 * _GRAVITY < size < 1.6 * _GRAVITY:
        hint = " Check unit and scale, and that it is specific force (gravity is in it)."
        for name, one in (("g", 1.0), ("mg", 1e3)):
            if 0.7 < size / one < 1.6:
                hint = f" That is about one {name}: rename the columns acc_x_{name}, acc_y_{name}, acc_z_{name}."
        msg = f"{path}: the specific force has a median magnitude of {size:.3g} m/s2; in flight it is about 9.8.{hint}"
        raise InputDataError(msg)
    down = float(np.median(force[:, 2]))
    if down > -0.5 * _GRAVITY:
        msg = (
            f"{path}: the z axis shows {down:.2f} m/s2 where body axes forward-right-down show about -9.8 (specific "
            "force of level flight). Turn the axes (from forward-left-up: change the sign of y and z of both sensors)."
        )
        raise InputDataError(msg)
    fast = float(np.percentile(np.linalg.norm(rate, axis=1), 90))
    if fast > 12.0:
        msg = (
            f"{path}: a tenth of the angular rates exceed {fast:.1f} rad/s ({math.degrees(fast):.0f} deg/s), which no "
            "survey aircraft does. If the columns hold degrees, rename them gyro_x_deg_s, gyro_y_deg_s, gyro_z_deg_s."
        )
        raise InputDataError(msg)


def _saturated(
    path: Path, line: IntArray, time: FloatArray, values: FloatArray, limit: float | None, what: str
) -> BoolArray:
    """
    Rows at the limit of the sensor.

    Without a stated limit: runs of at least three samples at exactly the largest or smallest value of the axis.
    """
    if limit is not None:
        hit = np.any(np.abs(values) >= 0.999 * limit, axis=1)
    else:
        hit = np.zeros(time.size, dtype=np.bool_)
        for axis in values.T:
            hit |= _clipped(axis)
    n = int(hit.sum())
    if n == 0:
        return np.asarray(hit)
    first = int(np.flatnonzero(hit)[0])
    where = f"{n} of {time.size} samples, the first at line {line[first]} ({time[first]:.3f} s)"
    if n > _MAX_SATURATED * time.size:
        msg = (
            f"{path}: the {what} is saturated in {where}. Attitude cannot be followed through that; use a sensor with "
            "a wider range, or cut the log to the part without it."
        )
        raise InputDataError(msg)
    logger.warning("%s: %s saturated in %s; their noise is raised %.0f times", path, what, where, _SATURATED_FACTOR)
    return np.asarray(hit)


def _clipped(axis: FloatArray) -> BoolArray:
    """Samples in runs of three or more at one and the same extreme value, on either side."""
    out = np.zeros(axis.size, dtype=np.bool_)
    middle = float(np.median(axis))
    distinct = np.unique(axis)
    if distinct.size < 2:
        return out
    step = float(np.diff(distinct).min())  # resolution of the log
    for extreme in (distinct[-1], distinct[0]):
        if abs(extreme - middle) < _CLEAR_OF_REST * step:
            continue
        at = axis == extreme
        run = at[:-2] & at[1:-1] & at[2:]
        for shift in range(3):
            out[shift : axis.size - 2 + shift] |= run
    return np.asarray(out)


def _bridge_gaps(
    path: Path,
    line: IntArray,
    time: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    noise: ImuNoise,
    factor: FloatArray,
) -> None:
    """
    Fill gaps with the mean of both sides, in place, and raise their noise.

    The error of that mean is taken from the log itself: half of what the sensor changes over a time as long as the
    gap, for its whole length.
    """
    step = np.diff(time)
    nominal = float(np.median(step))
    gaps = np.flatnonzero(step > _GAP_RATIO * nominal)
    for k in gaps:
        if step[k] > _LONGEST_GAP:
            msg = (
                f"{path}: no inertial samples for {step[k]:.2f} s between lines {line[k]} and {line[k + 1]} "
                f"({time[k]:.3f} to {time[k + 1]:.3f} s); up to {_LONGEST_GAP} s can be bridged. Supply the complete "
                "log, or hand in the parts before and after as flights of their own."
            )
            raise InputDataError(msg)
        lag = max(round(step[k] / nominal), 1)
        for values, density in ((rate, noise.gyro_noise), (force, noise.accel_noise)):
            change = float(np.sqrt(np.mean((values[lag:] - values[:-lag]) ** 2)))
            factor[k + 1] = max(factor[k + 1], 1.0, 0.5 * change * math.sqrt(step[k]) / density)
        rate[k + 1] = 0.5 * (rate[k] + rate[k + 1])
        force[k + 1] = 0.5 * (force[k] + force[k + 1])
    if gaps.size:
        logger.warning(
            "%s: %d gaps of up to %.3f s bridged, the first after line %d",
            path,
            gaps.size,
            step[gaps].max(),
            line[gaps[0]],
        )


def _mean_velocity(gps: GpsLog, begin: float, end: float) -> FloatArray | None:
    """Horizontal velocity by a straight line through the fixes of a window, m/s; None where there are too few."""
    rows = (gps.time >= begin) & (gps.time <= end)
    if np.count_nonzero(rows) < 3:
        return None
    return np.asarray(np.polyfit(gps.time[rows] - begin, gps.position[rows, :2], 1)[0], dtype=np.float64)
