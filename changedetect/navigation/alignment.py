"""
Where the filter starts: attitude, velocity and biases at the first moment.

Given (autopilot), or found: a standing aircraft gives the gyro bias, a moving one its attitude. Course and speed come
from the GPS; the specific force and the GPS acceleration then fix the tilt, also in a turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from changedetect.errors import InputDataError
from changedetect.navigation.flight import Flight, GpsLog, InitialState
from changedetect.typing import FloatArray

__all__ = ["ENU_FROM_NED", "align", "attitude_covariance", "attitude_from_angles", "attitude_to_angles", "motion_at"]

#: Turns north-east-down into east-north-up, and back.
ENU_FROM_NED: FloatArray = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

#: Half width of the window of fixes that gives velocity and acceleration, s.
_HALF_WINDOW = 2.0
#: Slower than this the course says nothing about the heading, m/s.
_MIN_SPEED = 4.0
#: Angle between course and heading that wind and sideslip explain, 1 sigma, rad.
_CRAB_STD = math.radians(12.0)
#: Standing still: spread of the inertial samples within a second, rad/s and m/s2, and way made over the ground, m/s.
_STILL_RATE, _STILL_FORCE, _STILL_SPEED = 0.02, 0.3, 0.5


def attitude_from_angles(roll_deg: float, pitch_deg: float, yaw_deg: float) -> FloatArray:
    """
    Rotation body (FRD) to ENU from roll, pitch and yaw against north-east-down.

    Parameters
    ----------
    roll_deg, pitch_deg, yaw_deg : float, degrees
        Turned in the order yaw, pitch, roll (aerospace ZYX); yaw from north to east.

    Returns
    -------
    rotation : array, shape (3, 3)

    Examples
    --------
    Level flight to the east: forward is east, right is south, down is down.

    >>> (attitude_from_angles(0.0, 0.0, 90.0).round(6) + 0.0).tolist()
    [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    """
    ned = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    return np.asarray(ENU_FROM_NED @ ned, dtype=np.float64)


def attitude_to_angles(rotation: FloatArray) -> FloatArray:
    """
    Roll, pitch and yaw of rotations body (FRD) to ENU, the inverse of `attitude_from_angles`.

    Parameters
    ----------
    rotation : array, shape (..., 3, 3)

    Returns
    -------
    angles : array, shape (..., 3), degrees
        Roll, pitch, yaw.
    """
    flat = np.asarray(rotation, dtype=np.float64).reshape(-1, 3, 3)
    angles = Rotation.from_matrix(ENU_FROM_NED @ flat).as_euler("ZYX", degrees=True)[:, ::-1]
    return np.asarray(angles.reshape(*np.shape(rotation)[:-2], 3), dtype=np.float64)


def attitude_covariance(roll_deg: float, pitch_deg: float, yaw_deg: float, std_deg: FloatArray) -> FloatArray:
    """
    Covariance of the small rotation in ENU that independent errors of roll, pitch and yaw make.

    Parameters
    ----------
    roll_deg, pitch_deg, yaw_deg : float, degrees
    std_deg : array, shape (3,), degrees
        Standard errors of roll, pitch, yaw.

    Returns
    -------
    covariance : array, shape (3, 3), ENU, rad2
    """
    axes = np.column_stack(
        [
            attitude_from_angles(roll_deg, pitch_deg, yaw_deg)[:, 0],  # roll turns about the nose
            attitude_from_angles(0.0, 0.0, yaw_deg)[:, 1],  # pitch about the level right wing
            ENU_FROM_NED[:, 2],  # yaw about down
        ]
    )
    return np.asarray(axes @ np.diag(np.radians(std_deg) ** 2) @ axes.T, dtype=np.float64)


@dataclass(frozen=True)
class Motion:
    """
    Motion of the antenna at one moment.

    Parameters
    ----------
    position, velocity, acceleration : array, shape (3,), ENU, m, m/s, m/s2
    position_std, velocity_std, acceleration_std : float, m, m/s, m/s2
        Standard error on every axis.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    position_std: float
    velocity_std: float
    acceleration_std: float


def align(flight: Flight) -> InitialState:
    """
    State at the first moment the filter can start from.

    Parameters
    ----------
    flight : Flight
        `flight.initial` is returned as it is where given.

    Returns
    -------
    initial : InitialState

    Raises
    ------
    InputDataError
        The aircraft never moves fast enough for a course, or the two logs do not overlap.

    Notes
    -----
    In motion, two directions fix the attitude (TRIAD [1]_): the specific force, which in ENU is the GPS acceleration
    less gravity, and the nose, which points along the course to within wind and sideslip. The first is taken as it
    is, so the second decides only the rotation about it.

    References
    ----------
    .. [1] Black (1964), A passive system for determining the attitude of a satellite, AIAA J. 2, 1350.
    """
    if flight.initial is not None:
        return flight.initial
    gps = _overlapping(flight)
    moment = _first_motion(flight, gps)
    motion = motion_at(gps, moment)
    imu = flight.imu
    window = (imu.time > moment - 0.5) & (imu.time <= moment + 0.5)
    force_body = imu.specific_force[window].mean(axis=0)
    force_enu = motion.acceleration + np.array([0.0, 0.0, flight.earth.gravity])
    rotation = _triad(force_body, force_enu, motion.velocity)
    course_std = math.hypot(_CRAB_STD, motion.velocity_std / float(np.hypot(*motion.velocity[:2])))
    tilt_std = math.hypot(motion.acceleration_std, flight.imu_noise.accel_bias_std, 0.5) / flight.earth.gravity
    axis = force_enu / np.linalg.norm(force_enu)
    about = np.outer(axis, axis)
    bias, bias_std = _standing_gyro_bias(flight, gps)
    return InitialState(
        time=moment,
        rotation=rotation,
        velocity=motion.velocity,
        rotation_covariance=tilt_std**2 * (np.eye(3) - about) + course_std**2 * about,
        velocity_std=1.0 + 2.0 * motion.velocity_std,
        gyro_bias=bias,
        gyro_bias_std=bias_std,
    )


def _overlapping(flight: Flight) -> GpsLog:
    """Fixes within the inertial log; refuses logs that do not share their time base."""
    gps, imu = flight.gps, flight.imu
    inside = (gps.time >= imu.time[0]) & (gps.time <= imu.time[-1])
    if np.count_nonzero(inside) < 5:
        msg = (
            f"The logs of {flight.label} do not overlap: inertial {imu.time[0]:.3f} to {imu.time[-1]:.3f} s, GPS "
            f"{gps.time[0]:.3f} to {gps.time[-1]:.3f} s. Bring both to one time base (seconds)."
        )
        raise InputDataError(msg)
    return GpsLog(
        gps.time[inside],
        gps.position[inside],
        gps.position_std[inside],
        None if gps.velocity is None else gps.velocity[inside],
        None if gps.velocity_std is None else gps.velocity_std[inside],
    )


def motion_at(gps: GpsLog, moment: float) -> Motion:
    """
    Motion of the antenna around a moment: a parabola through the fixes of four seconds, robust against outliers.

    Parameters
    ----------
    gps : GpsLog
    moment : float, s

    Returns
    -------
    motion : Motion

    Notes
    -----
    Least absolute deviations by iteratively reweighted least squares, bounded so that residuals within the stated noise
    keep full weight (Huber). Velocities enter where the receiver gives them.
    """
    n = max(int(np.count_nonzero(np.abs(gps.time - moment) <= _HALF_WINDOW)), 5)
    rows = np.argsort(np.abs(gps.time - moment), kind="stable")[:n]
    t = gps.time[rows] - moment
    design, target, std = np.column_stack([np.ones_like(t), t, 0.5 * t * t]), gps.position[rows], gps.position_std[rows]
    if gps.velocity is not None and gps.velocity_std is not None and np.all(np.isfinite(gps.velocity[rows])):
        design = np.vstack([design, np.column_stack([np.zeros_like(t), np.ones_like(t), t])])
        target = np.vstack([target, gps.velocity[rows]])
        std = np.vstack([std, gps.velocity_std[rows]])
    if np.ptp(t) == 0 or t.size < 3:
        design = design[:, :2] if t.size > 1 else design[:, :1]
    inverse = 1.0 / std.max(axis=1)
    weight = inverse
    size = np.zeros(weight.size)
    for _ in range(30):
        before = size
        coefficients = np.linalg.lstsq(design * weight[:, None], target * weight[:, None], rcond=None)[0]
        size = np.linalg.norm(target - design @ coefficients, axis=1) * inverse
        weight = inverse * np.sqrt(np.minimum(1.0, 2.0 / np.maximum(size, 1e-12)))
        if np.max(np.abs(size - before)) < 0.01:
            break
    covariance = np.linalg.pinv((design * weight[:, None]).T @ (design * weight[:, None]))
    padded, spread = np.zeros((3, 3)), np.full(3, np.inf)
    padded[: coefficients.shape[0]] = coefficients
    spread[: coefficients.shape[0]] = np.sqrt(np.diag(covariance))
    return Motion(padded[0], padded[1], padded[2], *(float(s) for s in spread))


def _first_motion(flight: Flight, gps: GpsLog) -> float:
    """Return the first moment at which the aircraft moves clearly, with fixes on both sides where there are any."""
    best = 0.0
    earliest = max(gps.time[0], flight.imu.time[0])
    for moment in gps.time[(gps.time >= earliest) & (gps.time <= flight.imu.time[-1])]:
        motion = motion_at(gps, float(moment))
        speed = float(np.hypot(*motion.velocity[:2]))
        best = max(best, speed)
        if speed > max(_MIN_SPEED, 5.0 * motion.velocity_std) and moment >= gps.time[0] + _HALF_WINDOW:
            return float(moment)
    msg = (
        f"{flight.label} cannot be aligned: the GPS never shows more than {best:.1f} m/s over ground, and the heading "
        f"comes from the course above {_MIN_SPEED:.0f} m/s. Give roll, pitch and yaw in init.json."
    )
    raise InputDataError(msg)


def _triad(force_body: FloatArray, force_enu: FloatArray, velocity: FloatArray) -> FloatArray:
    """Rotation body to ENU that takes the force onto itself and the nose as near to the velocity as that allows."""
    return _basis(force_enu, velocity) @ _basis(force_body, np.array([1.0, 0.0, 0.0])).T


def _basis(first: FloatArray, second: FloatArray) -> FloatArray:
    a = first / np.linalg.norm(first)
    b = np.cross(a, second)
    b = b / np.linalg.norm(b)
    return np.column_stack([a, b, np.cross(a, b)])


def _standing_gyro_bias(flight: Flight, gps: GpsLog) -> tuple[FloatArray, float | None]:
    """Mean rate over the seconds before take-off in which nothing moves; zeros and None where there are none."""
    imu = flight.imu
    second = np.floor(imu.time - imu.time[0]).astype(np.int64)
    rates = []
    for index in range(int(second[-1])):
        rows = second == index
        moment = imu.time[0] + index + 0.5
        if moment < gps.time[0]:
            continue
        motion = motion_at(gps, moment)
        is_still = (
            np.count_nonzero(rows) > 1
            and float(np.max(imu.angular_rate[rows].std(axis=0))) < _STILL_RATE
            and float(np.max(imu.specific_force[rows].std(axis=0))) < _STILL_FORCE
            and float(np.linalg.norm(motion.velocity)) < _STILL_SPEED + 3.0 * motion.velocity_std
        )
        if not is_still:
            break
        rates.append(imu.angular_rate[rows].mean(axis=0))
    if len(rates) < 3:
        return np.zeros(3), None
    noise = flight.imu_noise
    # The Earth's rotation is part of what a standing gyro shows; it is below every bias this model is meant for.
    std = math.hypot(noise.gyro_noise / math.sqrt(len(rates)), 2.0 * noise.gyro_instability, 7.3e-5)
    return np.mean(rates, axis=0), std
