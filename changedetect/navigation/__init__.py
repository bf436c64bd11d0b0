"""
From inertial and GPS logs to camera poses with covariance.

Frames: body axes forward-right-down (FRD) at the inertial sensor; navigation in local east-north-up (ENU) metres
tangent to WGS 84; attitudes from outside (roll, pitch, yaw) are FRD against north-east-down. Times are seconds in one
time base for all logs of a flight. Angles are radians inside, degrees in files.

`solution.navigate` filters and smooths a `flight.Flight`, `photos.camera_poses` gives the poses of its photos; what
other parts of the project exchange is named below and needs no compiler.
"""

from __future__ import annotations

from changedetect.navigation.camera import CameraIntrinsics, CameraMount
from changedetect.navigation.frame import EarthModel, LocalFrame
from changedetect.navigation.poses import CameraPoses

__all__ = ["CameraIntrinsics", "CameraMount", "CameraPoses", "EarthModel", "LocalFrame"]
