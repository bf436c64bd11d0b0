"""Points from observations in posed images."""

from __future__ import annotations

import numpy as np
from numba import njit

from changedetect.kernels.bundle import invert_symmetric, linearise_point, most_views
from changedetect.kernels.projection import N_CALIBRATION
from changedetect.typing import FloatArray, IntArray

__all__ = ["triangulate"]


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate(
    rays: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    lens: IntArray,
    start: IntArray,
    image: IntArray,
    pixel: FloatArray,
    weight: FloatArray,
    n_iterations: int,
) -> tuple[FloatArray, FloatArray]:
    """
    Points from their observations in posed images, by least squares of the reprojection error.

    Parameters
    ----------
    rays : array, shape (n_observations, 3)
        Unit directions of the observations in ground axes, for the start.
    rotation, position, intrinsics, lens, start, image, pixel, weight
        As `reduced_system`.
    n_iterations : int
        Steps of Gauss-Newton after the start, the point nearest to all rays.

    Returns
    -------
    points : array, shape (n_points, 3), m
        NaN where rays are parallel or fewer than two, or the point comes to lie behind a camera.
    covariance : array, shape (n_points, 3, 3), m^2
        Of the pixels alone.
    """
    n_points = start.size - 1
    points = np.full((n_points, 3), np.nan)
    covariance = np.full((n_points, 3, 3), np.nan)
    most = most_views(start)
    by_point, by_pose = np.empty((most, 2, 3)), np.empty((most, 2, 6))
    by_lens, residual = np.empty((most, 2, N_CALIBRATION)), np.empty((most, 2))
    v, v_inverse, gradient, x = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for p in range(n_points):
        first, last = start[p], start[p + 1]
        v[:], gradient[:] = 0.0, 0.0
        n_used = 0
        for o in range(first, last):
            if weight[o] <= 0.0:
                continue
            n_used += 1
            for a in range(3):
                for b in range(3):
                    c = (1.0 if a == b else 0.0) - rays[o, a] * rays[o, b]
                    v[a, b] += c
                    gradient[a] += c * position[image[o], b]
        if n_used < 2 or invert_symmetric(v, v_inverse) <= 0.0:
            continue
        for a in range(3):
            x[a] = v_inverse[a, 0] * gradient[0] + v_inverse[a, 1] * gradient[1] + v_inverse[a, 2] * gradient[2]
        is_fixed = True
        for _ in range(n_iterations + 1):  # the last one for the covariance alone
            linearise_point(
                x, first, last, rotation, position, intrinsics, lens, image, pixel, weight,
                by_point, by_pose, by_lens, residual, v, gradient,
            )  # fmt: skip
            if invert_symmetric(v, v_inverse) <= 0.0:
                is_fixed = False
                break
            if _ == n_iterations:
                break
            for a in range(3):
                x[a] += v_inverse[a, 0] * gradient[0] + v_inverse[a, 1] * gradient[1] + v_inverse[a, 2] * gradient[2]
        if is_fixed:
            points[p] = x
            covariance[p] = v_inverse
    return points, covariance
