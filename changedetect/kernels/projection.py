"""
Projection of ground points into photos with the Brown-Conrady lens model, and its derivatives.

Ground coordinates are local metres, camera axes are x right, y down, z forward; `rotation` turns camera axes into
ground axes. `intrinsics` holds fx, fy, cx, cy, k1, k2, p1, p2, k3 in pixels and OpenCV's convention: the centre of the
top-left pixel is (0, 0).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from changedetect.typing import FloatArray, IntArray

__all__ = ["N_CALIBRATION", "N_INTRINSICS", "distort", "project", "project_many", "projection_jacobian"]

#: fx, fy, cx, cy, k1, k2, p1, p2, k3
N_INTRINSICS = 9
#: Parameters of a lens that an adjustment may estimate or doubt: log focal length, cx, cy, k1, k2, k3, p1, p2 and the
#: logarithm of fx / fy.
N_CALIBRATION = 9


@njit(cache=True, error_model="numpy")
def distort(x: float, y: float, intrinsics: FloatArray) -> tuple[float, float]:
    """
    Pixel of a normalised image point.

    Parameters
    ----------
    x, y : float
        Tangents of the viewing angles right and down of the optical axis.
    intrinsics : array, shape (9,)

    Returns
    -------
    column, row : float, pixels

    Notes
    -----
    Brown (1966): radial k1, k2, k3 and decentring p1, p2.
    """
    r2 = x * x + y * y
    radial = 1.0 + r2 * (intrinsics[4] + r2 * (intrinsics[5] + r2 * intrinsics[8]))
    p1, p2 = intrinsics[6], intrinsics[7]
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return intrinsics[0] * xd + intrinsics[2], intrinsics[1] * yd + intrinsics[3]


@njit(cache=True, error_model="numpy")
def project(
    point: FloatArray, rotation: FloatArray, position: FloatArray, intrinsics: FloatArray
) -> tuple[float, float, float]:
    """
    Pixel of a ground point, and its depth along the optical axis.

    Parameters
    ----------
    point, position : array, shape (3,), m
    rotation : array, shape (3, 3)
    intrinsics : array, shape (9,)

    Returns
    -------
    column, row : float, pixels
    depth : float, m
        Not positive for a point behind the camera, whose pixel means nothing.
    """
    d0, d1, d2 = point[0] - position[0], point[1] - position[1], point[2] - position[2]
    xc = rotation[0, 0] * d0 + rotation[1, 0] * d1 + rotation[2, 0] * d2
    yc = rotation[0, 1] * d0 + rotation[1, 1] * d1 + rotation[2, 1] * d2
    zc = rotation[0, 2] * d0 + rotation[1, 2] * d1 + rotation[2, 2] * d2
    column, row = distort(xc / zc, yc / zc, intrinsics)
    return column, row, zc


@njit(cache=True, error_model="numpy")
def projection_jacobian(
    point: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    by_point: FloatArray,
    by_pose: FloatArray,
    by_lens: FloatArray,
) -> tuple[float, float, float]:
    """
    Project a point and write the derivatives of its pixel.

    Parameters
    ----------
    point, position : array, shape (3,), m
    rotation : array, shape (3, 3)
    intrinsics : array, shape (9,)
    by_point : array, shape (2, 3), pixels / m
        Overwritten: by the point's coordinates.
    by_pose : array, shape (2, 6)
        Overwritten: by the camera's position (m) and by a small rotation vector phi in ground axes (rad), where
        R_true = exp([phi]x) R.
    by_lens : array, shape (2, 9)
        Overwritten: by log focal length, cx, cy, k1, k2, k3, p1, p2, log fx / fy.

    Returns
    -------
    column, row : float, pixels
    depth : float, m

    Notes
    -----
    With d = X - C and the camera frame vector q = R^T d: dq/dX = R^T, dq/dC = -R^T and, because
    (exp([phi]x) R)^T d = R^T (d - phi x d) to first order, dq/dphi = R^T [d]x.
    """
    d0, d1, d2 = point[0] - position[0], point[1] - position[1], point[2] - position[2]
    xc = rotation[0, 0] * d0 + rotation[1, 0] * d1 + rotation[2, 0] * d2
    yc = rotation[0, 1] * d0 + rotation[1, 1] * d1 + rotation[2, 1] * d2
    zc = rotation[0, 2] * d0 + rotation[1, 2] * d1 + rotation[2, 2] * d2
    x, y = xc / zc, yc / zc
    fx, fy = intrinsics[0], intrinsics[1]
    k1, k2, k3 = intrinsics[4], intrinsics[5], intrinsics[8]
    p1, p2 = intrinsics[6], intrinsics[7]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)  # d radial / d r2
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    # derivatives of the distorted by the normalised coordinates
    dxx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    dyx = dxy
    dyy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    # by the camera frame vector q
    a0, a1 = fx * dxx / zc, fx * dxy / zc
    a2 = -(a0 * x + a1 * y)
    b0, b1 = fy * dyx / zc, fy * dyy / zc
    b2 = -(b0 * x + b1 * y)
    for k in range(3):
        u = a0 * rotation[k, 0] + a1 * rotation[k, 1] + a2 * rotation[k, 2]
        v = b0 * rotation[k, 0] + b1 * rotation[k, 1] + b2 * rotation[k, 2]
        by_point[0, k], by_point[1, k] = u, v
        by_pose[0, k], by_pose[1, k] = -u, -v
    for k in range(2):
        g0, g1, g2 = by_point[k, 0], by_point[k, 1], by_point[k, 2]
        # g^T [d]x
        by_pose[k, 3] = g1 * d2 - g2 * d1
        by_pose[k, 4] = g2 * d0 - g0 * d2
        by_pose[k, 5] = g0 * d1 - g1 * d0
    by_lens[0, 0], by_lens[1, 0] = fx * xd, fy * yd
    by_lens[0, 1], by_lens[1, 1] = 1.0, 0.0
    by_lens[0, 2], by_lens[1, 2] = 0.0, 1.0
    by_lens[0, 3], by_lens[1, 3] = fx * x * r2, fy * y * r2
    by_lens[0, 4], by_lens[1, 4] = fx * x * r2 * r2, fy * y * r2 * r2
    by_lens[0, 5], by_lens[1, 5] = fx * x * r2 * r2 * r2, fy * y * r2 * r2 * r2
    by_lens[0, 6], by_lens[1, 6] = fx * 2.0 * x * y, fy * (r2 + 2.0 * y * y)
    by_lens[0, 7], by_lens[1, 7] = fx * (r2 + 2.0 * x * x), fy * 2.0 * x * y
    by_lens[0, 8], by_lens[1, 8] = 0.5 * fx * xd, -0.5 * fy * yd
    return fx * xd + intrinsics[2], fy * yd + intrinsics[3], zc


@njit(cache=True, nogil=True, error_model="numpy")
def project_many(
    points: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    point: IntArray,
    image: IntArray,
    lens: IntArray,
) -> FloatArray:
    """
    Pixels and depths of many pairs of a point and an image.

    Parameters
    ----------
    points : array, shape (n_points, 3), m
    rotation : array, shape (n_images, 3, 3)
    position : array, shape (n_images, 3), m
    intrinsics : array, shape (n_lenses, 9)
    point, image : array, shape (n,)
    lens : array, shape (n_images,)
        Lens of each image.

    Returns
    -------
    projected : array, shape (n, 3)
        Column, row (pixels) and depth (m).
    """
    out = np.empty((point.size, 3))
    for i in range(point.size):
        j = image[i]
        out[i] = project(points[point[i]], rotation[j], position[j], intrinsics[lens[j]])
    return out
