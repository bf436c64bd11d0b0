"""
Lens models of other programs, undistortion, and viewing rays.

Three conventions meet here. OpenCV puts the centre of the top-left pixel at (0, 0); COLMAP at (0.5, 0.5), so its
principal point is larger by half a pixel; Metashape counts the principal point from the centre of the image, which is
((width - 1) / 2, (height - 1) / 2) in OpenCV's count, and swaps the decentring coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from changedetect.errors import InputDataError
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.typing import FloatArray

__all__ = [
    "MetashapeCalibration",
    "corrected_intrinsics",
    "from_colmap",
    "from_metashape",
    "intrinsics_array",
    "intrinsics_correction",
    "normalise",
    "rays",
    "reduced_camera",
    "to_colmap",
    "to_metashape",
    "with_calibration",
]

#: Newton steps of the undistortion; five reach 1e-10 for any lens whose image does not fold.
_UNDISTORT_STEPS = 10
#: Columns of the intrinsics that corrections 1 to 7 are added to: cx, cy, k1, k2, k3, p1, p2.
_ADDED = (2, 3, 4, 5, 8, 6, 7)
_COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}


@dataclass(frozen=True)
class MetashapeCalibration:
    """
    Frame camera as Agisoft Metashape writes it.

    Attributes
    ----------
    width, height : int, pixels
    f : float, pixels
    cx, cy : float, pixels
        From the centre of the image.
    b1, b2 : float, pixels
        Affinity and skew.
    k1, k2, k3, p1, p2 : float
        p1 and p2 are OpenCV's p2 and p1.
    """

    width: int
    height: int
    f: float
    cx: float = 0.0
    cy: float = 0.0
    b1: float = 0.0
    b2: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


def intrinsics_array(camera: CameraIntrinsics) -> FloatArray:
    """Parameters in the order of the kernels: fx, fy, cx, cy, k1, k2, p1, p2, k3; shape (9,)."""
    c = camera
    return np.array([c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3], dtype=np.float64)


def corrected_intrinsics(intrinsics: FloatArray, correction: FloatArray) -> FloatArray:
    """
    Intrinsics moved by corrections of an adjustment.

    Parameters
    ----------
    intrinsics : array, shape (n_lenses, 9)
    correction : array, shape (n_lenses, 9)
        Of log focal length, cx, cy (pixels), k1, k2, k3, p1, p2, log fx / fy.
    """
    moved: FloatArray = intrinsics.copy()
    moved[:, :2] *= np.exp(correction[:, :1] + correction[:, 8:] * np.array([0.5, -0.5]))
    moved[:, _ADDED] += correction[:, 1:8]
    return moved


def intrinsics_correction(before: FloatArray, after: FloatArray) -> FloatArray:
    """Corrections that take intrinsics to others, shape (n_lenses, 9); the inverse of `corrected_intrinsics`."""
    scale = np.log(after[:, :2] / before[:, :2])
    added = after[:, _ADDED] - before[:, _ADDED]
    return np.column_stack([scale.mean(axis=1), added, scale[:, 0] - scale[:, 1]])


def with_calibration(camera: CameraIntrinsics, correction: FloatArray) -> CameraIntrinsics:
    """
    Camera moved by corrections of an adjustment.

    Parameters
    ----------
    camera : CameraIntrinsics
    correction : array, shape (9,)
        As of `corrected_intrinsics`.
    """
    moved = corrected_intrinsics(intrinsics_array(camera)[None], np.asarray(correction)[None])[0]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(value) for value in moved)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)


def reduced_camera(camera: CameraIntrinsics, factor: int) -> CameraIntrinsics:
    """
    Camera of photos of which each square of `factor` x `factor` pixels became one.

    Parameters
    ----------
    camera : CameraIntrinsics
    factor : int

    Examples
    --------
    >>> half = reduced_camera(CameraIntrinsics(100, 80, 90.0, 90.0, 49.5, 39.5), 2)
    >>> half.width, half.fx, half.cx
    (50, 45.0, 24.5)
    """
    return replace(
        camera,
        width=camera.width // factor,
        height=camera.height // factor,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=(camera.cx + 0.5) / factor - 0.5,
        cy=(camera.cy + 0.5) / factor - 0.5,
    )


def from_colmap(model: str, width: int, height: int, parameters: FloatArray) -> CameraIntrinsics:
    """
    Camera of a COLMAP model.

    Parameters
    ----------
    model : str
        SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, or FULL_OPENCV without k4, k5, k6.
    width, height : int, pixels
    parameters : array
        As a line of cameras.txt gives them.

    Raises
    ------
    InputDataError
        The model is another one, or the number of parameters is wrong.

    Examples
    --------
    >>> from_colmap("PINHOLE", 100, 80, np.array([90.0, 90.0, 50.0, 40.0])).cx
    49.5
    """
    names = _COLMAP_PARAMETERS.get(model)
    if names is None:
        msg = f"COLMAP camera model {model!r} is not supported. Use one of {', '.join(_COLMAP_PARAMETERS)}."
        raise InputDataError(msg)
    if len(parameters) != len(names):
        msg = f"COLMAP camera model {model} has {len(names)} parameters ({', '.join(names)}); {len(parameters)} given."
        raise InputDataError(msg)
    values = {name: float(value) for name, value in zip(names, parameters, strict=True)}
    focal = values.pop("f", None)
    if focal is not None:
        values |= {"fx": focal, "fy": focal}
    rational = [name for name in ("k4", "k5", "k6") if values.pop(name, 0.0) != 0.0]
    if rational:
        msg = f"The FULL_OPENCV camera has {', '.join(rational)}, which is not supported. Calibrate it as OPENCV."
        raise InputDataError(msg)
    values["cx"] -= 0.5
    values["cy"] -= 0.5
    return CameraIntrinsics(width, height, **values)


def to_colmap(camera: CameraIntrinsics) -> tuple[str, FloatArray]:
    """
    Model name and parameters for a line of COLMAP's cameras.txt.

    Raises
    ------
    InputDataError
        k3 is not 0, which COLMAP's OPENCV model has no place for.
    """
    c = camera
    if c.k3 != 0.0:
        msg = f"COLMAP's OPENCV camera has no k3, this one has k3 = {c.k3}. Calibrate without k3, or undistort first."
        raise InputDataError(msg)
    return "OPENCV", np.array([c.fx, c.fy, c.cx + 0.5, c.cy + 0.5, c.k1, c.k2, c.p1, c.p2])


def from_metashape(calibration: MetashapeCalibration) -> CameraIntrinsics:
    """
    Camera of a Metashape calibration.

    Raises
    ------
    InputDataError
        Skew b2 is not 0.
    """
    c = calibration
    if c.b2 != 0.0:
        msg = f"The Metashape calibration has skew b2 = {c.b2} pixels, which is not supported. Optimise without b2."
        raise InputDataError(msg)
    return CameraIntrinsics(
        width=c.width,
        height=c.height,
        fx=c.f + c.b1,
        fy=c.f,
        cx=(c.width - 1) / 2 + c.cx,
        cy=(c.height - 1) / 2 + c.cy,
        k1=c.k1,
        k2=c.k2,
        p1=c.p2,
        p2=c.p1,
        k3=c.k3,
    )


def to_metashape(camera: CameraIntrinsics) -> MetashapeCalibration:
    """Calibration as Metashape writes it."""
    c = camera
    return MetashapeCalibration(
        width=c.width,
        height=c.height,
        f=c.fy,
        cx=c.cx - (c.width - 1) / 2,
        cy=c.cy - (c.height - 1) / 2,
        b1=c.fx - c.fy,
        k1=c.k1,
        k2=c.k2,
        k3=c.k3,
        p1=c.p2,
        p2=c.p1,
    )


def normalise(pixel: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """
    Undistorted, normalised coordinates of pixels.

    Parameters
    ----------
    pixel : array, shape (n, 2)
        Column and row.
    intrinsics : array, shape (9,)

    Returns
    -------
    normalised : array, shape (n, 2)
        Tangents of the viewing angles right and down of the optical axis.

    Notes
    -----
    Newton's method on the distortion polynomial; OpenCV's fixed-point iteration converges too slowly at wide angles.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    target = np.column_stack([(pixel[:, 0] - cx) / fx, (pixel[:, 1] - cy) / fy])
    x, y = target[:, 0].copy(), target[:, 1].copy()
    for _ in range(_UNDISTORT_STEPS):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - target[:, 0]
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - target[:, 1]
        a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        d = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        determinant = a * d - b * b
        x -= (d * u - b * v) / determinant
        y -= (a * v - b * u) / determinant
        if max(float(np.max(np.abs(u), initial=0.0)), float(np.max(np.abs(v), initial=0.0))) < 1e-13:
            break
    return np.column_stack([x, y])


def rays(pixel: FloatArray, rotation: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """
    Unit viewing directions of pixels in ground axes.

    Parameters
    ----------
    pixel : array, shape (n, 2)
    rotation : array, shape (3, 3) or (n, 3, 3)
        Camera axes to ground axes.
    intrinsics : array, shape (9,)

    Returns
    -------
    rays : array, shape (n, 3)
    """
    flat = normalise(pixel, intrinsics)
    direction = np.column_stack([flat, np.ones(len(flat))])
    turned = np.einsum("...ij,...j->...i", rotation, direction)
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True), dtype=np.float64)
