"""
Triangulation that knows how far the poses may be wrong, and that neighbouring ones are wrong alike.

Least squares takes all views of a point as equally good. Poses that are not adjusted err by far more than pixels do,
and the errors of photos taken a moment apart are nearly equal; weighting the views by the inverse of that covariance
takes off what they have in common.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from changedetect.kernels.projection import N_CALIBRATION, projection_jacobian
from changedetect.typing import FloatArray, IntArray

__all__ = ["pose_weighted_points"]

_ITERATIONS = 4
#: Steps below this have converged, m.
_SMALL = 1e-4


@njit(cache=True, error_model="numpy")
def pose_weighted_points(
    points: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    lens: IntArray,
    start: IntArray,
    image: IntArray,
    pixel: FloatArray,
    sigma: FloatArray,
    pose_covariance: FloatArray,
) -> FloatArray:
    """
    Points from views whose poses err together, by generalised least squares.

    Parameters
    ----------
    points : array, shape (n_points, 3), m
        To begin with.
    rotation, position, intrinsics, lens, start, image, pixel
        As `changedetect.kernels.bundle.reduced_system`.
    sigma : array, shape (n,), pixels
    pose_covariance : array, shape (6 n_images, 6 n_images)
        Of position (m) and rotation vector (rad) of photo after photo.

    Returns
    -------
    solved : array, shape (n_points, 3), m
        NaN where the views do not fix the point.

    Notes
    -----
    With A the derivative of the pixels by the point and B that by the poses, minimise r' S^-1 r,
    S = sigma^2 I + B C B' [1]_.

    References
    ----------
    .. [1] Aitken (1936), On least squares and linear combinations of observations, doi:10.1017/S0370164600014346.
    """
    solved = np.empty_like(points)
    for p in range(points.shape[0]):
        first, last = start[p], start[p + 1]
        k = last - first
        by_point, by_pose = np.empty((2 * k, 3)), np.zeros((2 * k, 6 * k))
        one_point, one_pose, one_lens = np.empty((2, 3)), np.empty((2, 6)), np.empty((2, N_CALIBRATION))
        covariance, residual = np.empty((6 * k, 6 * k)), np.empty(2 * k)
        for i in range(k):
            for j in range(k):
                a, b = 6 * image[first + i], 6 * image[first + j]
                covariance[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = pose_covariance[a : a + 6, b : b + 6]
        x = points[p].copy()
        is_fixed = True
        for _ in range(_ITERATIONS):
            for i in range(k):
                o = first + i
                m = image[o]
                column, row, depth = projection_jacobian(
                    x, rotation[m], position[m], intrinsics[lens[m]], one_point, one_pose, one_lens
                )
                if not depth > 0.0:
                    is_fixed = False
                by_point[2 * i : 2 * i + 2] = one_point
                by_pose[2 * i : 2 * i + 2, 6 * i : 6 * i + 6] = one_pose
                residual[2 * i], residual[2 * i + 1] = pixel[o, 0] - column, pixel[o, 1] - row
            if not is_fixed:
                break
            total = by_pose @ covariance @ by_pose.T
            for i in range(2 * k):
                total[i, i] += sigma[first + i // 2] ** 2
            weighted = np.linalg.solve(total, by_point)
            normal = by_point.T @ weighted
            size = normal[0, 0] * normal[1, 1] * normal[2, 2]
            if not np.linalg.det(normal) > 1e-12 * size:
                is_fixed = False
                break
            step = np.linalg.solve(normal, weighted.T @ residual)
            x += step
            if np.abs(step).max() < _SMALL:
                break
        if is_fixed:
            solved[p] = x
        else:
            solved[p] = np.nan
    return solved
