"""
What is known of a camera and of how it sits in the aircraft.

Pixels follow OpenCV: u to the right, v down, and the centre of the top-left pixel is (0, 0). COLMAP puts it at
(0.5, 0.5), so its principal point is larger by half a pixel; Metashape counts from the middle of the image.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from changedetect.typing import FloatArray

__all__ = ["CameraIntrinsics", "CameraMount"]


@dataclass(frozen=True)
class CameraIntrinsics:
    """
    Pinhole camera with the five-parameter lens of Brown and Conrady, as OpenCV's `plumb_bob`.

    Parameters
    ----------
    width, height : int, pixels
    fx, fy : float, pixels
        Focal lengths.
    cx, cy : float, pixels
        Principal point; the centre of the top-left pixel is (0, 0).
    k1, k2, p1, p2, k3 : float
        Radial (k) and tangential (p) distortion of normalised coordinates, in OpenCV's order.

    Raises
    ------
    ValueError
        Sizes or focal lengths are not positive, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        numbers = [self.fx, self.fy, self.cx, self.cy, *self.distortion]
        if self.width <= 0 or self.height <= 0 or self.fx <= 0 or self.fy <= 0 or not np.all(np.isfinite(numbers)):
            msg = (
                f"A camera of {self.width} x {self.height} pixels with focal lengths {self.fx}, {self.fy}, principal "
                f"point {self.cx}, {self.cy} and distortion {self.distortion.tolist()} is not possible: sizes and "
                "focal lengths are positive and every number is finite."
            )
            raise ValueError(msg)

    @property
    def matrix(self) -> FloatArray:
        """Camera matrix K, shape (3, 3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> FloatArray:
        """OpenCV's coefficients k1, k2, p1, p2, k3, shape (5,)."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3], dtype=np.float64)


def _identity() -> FloatArray:
    return np.eye(3)


def _zeros() -> FloatArray:
    return np.zeros(3)


@dataclass(frozen=True)
class CameraMount:
    """
    Where camera and GPS antenna sit in the aircraft.

    Body axes are forward, right, down (FRD) at the inertial sensor.

    Parameters
    ----------
    rotation_body_camera : array, shape (3, 3)
        From camera axes (x right, y down, z forward) to body axes: x_body = rotation @ x_camera + camera_body.
    camera_body : array, shape (3,), m
        Camera centre in body axes.
    antenna_body : array, shape (3,), m
        Phase centre of the GPS antenna in body axes (lever arm).

    Raises
    ------
    ValueError
        The matrix is not a rotation, or a number is not finite.
    """

    rotation_body_camera: FloatArray = field(default_factory=_identity)
    camera_body: FloatArray = field(default_factory=_zeros)
    antenna_body: FloatArray = field(default_factory=_zeros)

    def __post_init__(self) -> None:
        matrix = np.asarray(self.rotation_body_camera, dtype=np.float64)
        is_rotation = (
            matrix.shape == (3, 3)
            and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4)
            and np.linalg.det(matrix) > 0
        )
        if not is_rotation:
            msg = (
                f"R_body_cam = {matrix.tolist()} is not a rotation matrix (orthonormal rows, determinant +1). It turns "
                "camera axes (right, down, forward) into body axes (forward, right, down)."
            )
            raise ValueError(msg)
        for name in ("camera_body", "antenna_body"):
            vector = np.asarray(getattr(self, name), dtype=np.float64)
            if vector.shape != (3,) or not np.all(np.isfinite(vector)):
                msg = f"{name} = {vector.tolist()} is not three finite numbers (forward, right, down; m)."
                raise ValueError(msg)
