"""
Flight 75 of the UMN UAV laboratory's Thor as a `Flight`, for tests and benchmarks.

Inertial samples at 50 Hz are values at their stamp; fixes and Doppler velocities come at 1 Hz. The onboard solution is
a 15-state filter of the same logs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from changedetect.navigation.alignment import ENU_FROM_NED, attitude_from_angles
from changedetect.navigation.flight import Flight, GpsLog, ImuLog, ImuNoise
from changedetect.navigation.frame import EarthModel, LocalFrame

#: Fixed wing with the motor running: vibration dominates the accelerometer's noise.
NOISE = ImuNoise(
    gyro_noise=math.radians(0.1),
    accel_noise=0.05,
    gyro_bias_std=math.radians(1.0),
    accel_bias_std=0.3,
    gyro_instability=math.radians(0.05),
    accel_instability=0.1,
    correlation_time=200.0,
)


@dataclass(frozen=True)
class Onboard:
    """Onboard solution: time (s), velocity (ENU, m/s), rotation (body to ENU)."""

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray


def read_thor75(folder: Path) -> tuple[Flight, Onboard]:
    """Read the three tables of the folder."""
    imu = np.loadtxt(folder / "imu_50hz.csv", delimiter=",", skiprows=1)
    imu = imu[np.any(imu[:, 1:7] != 0, axis=1)]  # the first row, before the sensor answered, is all zeros
    gps = np.loadtxt(folder / "gps_1hz.csv", delimiter=",", skiprows=1)
    gps = gps[np.concatenate([[True], np.diff(gps[:, 0]) > 0])]
    frame = LocalFrame(float(gps[0, 2]), float(gps[0, 3]), float(gps[0, 4]))
    rate, force = imu[:, 1:4], imu[:, 4:7]
    log = ImuLog(
        imu[:, 0],
        np.vstack([rate[:1], 0.5 * (rate[:-1] + rate[1:])]),
        np.vstack([force[:1], 0.5 * (force[:-1] + force[1:])]),
    )
    n = len(gps)
    fixes = GpsLog(
        time=gps[:, 0],
        position=frame.to_enu(gps[:, 2], gps[:, 3], gps[:, 4]),
        position_std=np.tile([2.0, 2.0, 4.0], (n, 1)),
        velocity=gps[:, 5:8] @ ENU_FROM_NED.T,
        velocity_std=np.tile([0.2, 0.2, 0.4], (n, 1)),
    )
    flight = Flight(log, fixes, frame, EarthModel.at(frame), NOISE, label="thor 75")
    nav = np.loadtxt(folder / "onboard_nav_50hz.csv", delimiter=",", skiprows=1)
    onboard = Onboard(
        time=nav[:, 0],
        position=frame.to_enu(np.degrees(nav[:, 1]), np.degrees(nav[:, 2]), nav[:, 3]),
        velocity=nav[:, 4:7] @ ENU_FROM_NED.T,
        rotation=np.stack([attitude_from_angles(*row) for row in np.degrees(nav[:, 7:10])]),
    )
    return flight, onboard
