"""
The logs of one flight, in SI units and one time base.

`changedetect.io.flight` makes these from files; simulators make them from truth. Constructors check shapes and order
only: whether the numbers are plausible is checked where a file can be named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from changedetect.navigation.camera import CameraIntrinsics, CameraMount
from changedetect.navigation.frame import EarthModel, LocalFrame
from changedetect.typing import FloatArray

__all__ = ["Flight", "GpsLog", "ImuLog", "ImuNoise", "InitialState", "PhotoList"]

_MICRO_G = 9.80665e-6


@dataclass(frozen=True)
class ImuNoise:
    """
    Error model of an inertial sensor, the same on every axis.

    Parameters
    ----------
    gyro_noise : float, rad/s/sqrt(Hz)
        Angular random walk.
    accel_noise : float, m/s2/sqrt(Hz)
        Velocity random walk.
    gyro_bias_std, accel_bias_std : float, rad/s and m/s2
        Of the bias at switch-on.
    gyro_instability, accel_instability : float, rad/s and m/s2
        Standard deviation of the wandering part of the bias.
    correlation_time : float, s
        Of the wandering part: it enters as a random walk of density 2 instability**2 / correlation_time, the short-term
        behaviour of a first-order Gauss-Markov process.

    Raises
    ------
    ValueError
        A number is not positive.
    """

    gyro_noise: float = math.radians(0.05)
    accel_noise: float = 600.0 * _MICRO_G
    gyro_bias_std: float = math.radians(0.3)
    accel_bias_std: float = 1e4 * _MICRO_G
    gyro_instability: float = math.radians(100.0) / 3600.0
    accel_instability: float = 1500.0 * _MICRO_G
    correlation_time: float = 300.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                msg = f"{name} of the inertial sensor is {value}; it must be a positive number."
                raise ValueError(msg)

    @classmethod
    def mid(cls) -> ImuNoise:
        """Give a tactical-grade MEMS sensor: 0.01 deg/s/sqrt(Hz), 200 ug/sqrt(Hz), 4 mg."""
        return cls(
            gyro_noise=math.radians(0.01),
            accel_noise=200.0 * _MICRO_G,
            gyro_bias_std=math.radians(0.1),
            accel_bias_std=4e3 * _MICRO_G,
            gyro_instability=math.radians(20.0) / 3600.0,
            accel_instability=300.0 * _MICRO_G,
        )

    @property
    def densities(self) -> FloatArray:
        """Spectral densities of gyro, accelerometer, gyro bias and accelerometer bias, shape (4,), SI."""
        wander = 2.0 / self.correlation_time
        return np.array(
            [
                self.gyro_noise**2,
                self.accel_noise**2,
                wander * self.gyro_instability**2,
                wander * self.accel_instability**2,
            ]
        )


@dataclass(frozen=True)
class ImuLog:
    """
    Inertial measurements.

    Parameters
    ----------
    time : array, shape (n,), s
        End of each interval, strictly increasing.
    angular_rate : array, shape (n, 3), FRD, rad/s
        Mean over the interval that ends at `time`.
    specific_force : array, shape (n, 3), FRD, m/s2
        Mean over the same interval; about (0, 0, -9.8) at rest and level.
    noise_factor : array, shape (n,), optional
        Factor on the sensor's noise for intervals that were bridged or saturated.

    Raises
    ------
    ValueError
        Shapes do not agree, fewer than two samples, or time does not increase.
    """

    time: FloatArray
    angular_rate: FloatArray
    specific_force: FloatArray
    noise_factor: FloatArray | None = None

    def __post_init__(self) -> None:
        _check_log("inertial log", self.time, 2, angular_rate=self.angular_rate, specific_force=self.specific_force)

    def __len__(self) -> int:
        return int(self.time.size)

    @property
    def interval(self) -> float:
        """Median sampling interval, s."""
        return float(np.median(np.diff(self.time)))


@dataclass(frozen=True)
class GpsLog:
    """
    Fixes of the GPS antenna in the local frame.

    Parameters
    ----------
    time : array, shape (n,), s
        Of each fix, in the time base of the inertial log, strictly increasing.
    position : array, shape (n, 3), ENU, m
    position_std : array, shape (n, 3), m
        Of the error that changes from fix to fix.
    velocity, velocity_std : array, shape (n, 3), ENU, m/s, optional
        Doppler velocity; rows of NaN are not used.
    offset_std : float, m
        Of an offset that stays the same for the whole flight. No filter can see it; it goes into the covariance all
        photos share.

    Raises
    ------
    ValueError
        Shapes do not agree, no fix at all, time does not increase or a standard deviation is not positive.
    """

    time: FloatArray
    position: FloatArray
    position_std: FloatArray
    velocity: FloatArray | None = None
    velocity_std: FloatArray | None = None
    offset_std: float = 0.0

    def __post_init__(self) -> None:
        _check_log("GPS log", self.time, 1, position=self.position, position_std=self.position_std)
        if not np.all(self.position_std > 0):
            msg = "A standard deviation of the GPS log is not positive; every fix needs one."
            raise ValueError(msg)
        if (self.velocity is None) != (self.velocity_std is None):
            msg = "GPS velocity and its standard deviation go together: give both or neither."
            raise ValueError(msg)
        if self.velocity is not None and self.velocity_std is not None:
            _check_log("GPS log", self.time, 1, velocity=self.velocity, velocity_std=self.velocity_std)

    def __len__(self) -> int:
        return int(self.time.size)


@dataclass(frozen=True)
class PhotoList:
    """
    Photos of a flight in the order of time.

    Parameters
    ----------
    names : tuple of str, length n
    time : array, shape (n,), s
        Mid-exposure in the time base of the inertial log, strictly increasing.
    paths : tuple of path, length n
    position : array, shape (n, 3), ENU, m, optional
        What the camera or an accompanying file says of its place; NaN where it says nothing.
    strip : tuple of str, length n, optional
        Label of the flight line of each photo.

    Raises
    ------
    ValueError
        Lengths differ, a name occurs twice, or time does not increase.
    """

    names: tuple[str, ...]
    time: FloatArray
    paths: tuple[Path, ...]
    position: FloatArray | None = None
    strip: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        _check_log("photo list", self.time, 1)
        lengths = {n, len(self.paths), self.time.size, n if self.strip is None else len(self.strip)}
        if len(lengths) > 1 or (self.position is not None and self.position.shape != (n, 3)):
            msg = f"The photo list has {n} names, {len(self.paths)} paths and {self.time.size} times; they must agree."
            raise ValueError(msg)
        if len(set(self.names)) < n:
            twice = next(name for name in self.names if self.names.count(name) > 1)
            msg = f"The photo {twice} is listed twice."
            raise ValueError(msg)

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class InitialState:
    """
    Attitude and velocity at one moment, from alignment or from the autopilot.

    Parameters
    ----------
    time : float, s
    rotation : array, shape (3, 3)
        Body (FRD) to ENU.
    velocity : array, shape (3,), ENU, m/s
    rotation_covariance : array, shape (3, 3), ENU, rad2
    velocity_std : float, m/s
        On every axis.
    position : array, shape (3,), ENU, m, optional
        Of the inertial sensor; by default from the GPS.
    position_std : float, m, optional
    gyro_bias : array, shape (3,), FRD, rad/s
    gyro_bias_std : float, rad/s, optional
        By default that of the sensor at switch-on.
    """

    time: float
    rotation: FloatArray
    velocity: FloatArray
    rotation_covariance: FloatArray
    velocity_std: float
    position: FloatArray | None = None
    position_std: float | None = None
    gyro_bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    gyro_bias_std: float | None = None


@dataclass(frozen=True)
class Flight:
    """
    Everything navigation needs of one flight.

    Parameters
    ----------
    imu : ImuLog
    gps : GpsLog
    photos : PhotoList, optional
    origin : LocalFrame
        Origin of ENU.
    earth : EarthModel
    imu_noise : ImuNoise
    mount : CameraMount
    camera : CameraIntrinsics, optional
    initial : InitialState, optional
        None: found from the logs.
    label : str
        Name of the flight in messages, usually its folder.
    nominal_height : float, m, optional
        Planned height above ground.
    """

    imu: ImuLog
    gps: GpsLog
    origin: LocalFrame
    earth: EarthModel
    imu_noise: ImuNoise = field(default_factory=ImuNoise)
    mount: CameraMount = field(default_factory=CameraMount)
    photos: PhotoList | None = None
    camera: CameraIntrinsics | None = None
    initial: InitialState | None = None
    label: str = "flight"
    nominal_height: float | None = None


def _check_log(what: str, time: FloatArray, n_least: int, **columns: FloatArray) -> None:
    """Raise ValueError unless time increases strictly and every column has three numbers a row."""
    if time.ndim != 1 or time.size < n_least:
        msg = f"The {what} has time of shape {time.shape}; at least {n_least} row(s) are needed."
        raise ValueError(msg)
    for name, values in columns.items():
        if values.shape != (time.size, 3):
            msg = f"{name} of the {what} has shape {values.shape}; expected {(time.size, 3)}."
            raise ValueError(msg)
    if not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
        msg = f"Time of the {what} does not increase from row to row."
        raise ValueError(msg)
