"""
Normal equations of a bundle adjustment, with the ground points eliminated [1]_.

Unknowns on the camera side, in this order: six for each image (position in m, small rotation vector in ground axes in
rad), then nine for each lens (see `changedetect.kernels.projection.N_CALIBRATION`). Each point adds a 3 x 3 block V and
a coupling W; the Schur complement U - W V^-1 W^T leaves a dense system of the camera side alone, whose inverse is the
marginal covariance of poses and lenses. Observations are sorted by point, then by image; those of point p are
`start[p]` to `start[p + 1]`.

References
----------
.. [1] Triggs, McLauchlan, Hartley, Fitzgibbon (2000), Bundle adjustment - a modern synthesis, section 6.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from changedetect.kernels.projection import N_CALIBRATION, projection_jacobian
from changedetect.typing import FloatArray, IntArray

__all__ = [
    "coordinate_modes",
    "invert_symmetric",
    "linearise_point",
    "most_views",
    "point_covariances",
    "point_steps",
    "reduced_system",
]

#: Points nearer to a camera than this are behind it for all purposes, m.
MIN_DEPTH = 1e-3


@njit(cache=True, error_model="numpy")
def invert_symmetric(a: FloatArray, out: FloatArray) -> float:
    """
    Write the inverse of a symmetric 3 x 3 matrix; return its determinant, 0 where it has no inverse.

    Parameters
    ----------
    a, out : array, shape (3, 3)
    """
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    determinant = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    if not abs(determinant) > 1e-14 * abs(a[0, 0] * a[1, 1] * a[2, 2]):
        out[:] = 0.0
        return 0.0
    out[0, 0] = c00 / determinant
    out[0, 1] = out[1, 0] = c01 / determinant
    out[0, 2] = out[2, 0] = c02 / determinant
    out[1, 1] = (a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]) / determinant
    out[1, 2] = out[2, 1] = (a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]) / determinant
    out[2, 2] = (a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]) / determinant
    return determinant


@njit(cache=True, error_model="numpy")
def linearise_point(
    x: FloatArray,
    first: int,
    last: int,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    lens: IntArray,
    image: IntArray,
    pixel: FloatArray,
    weight: FloatArray,
    by_point: FloatArray,
    by_pose: FloatArray,
    by_lens: FloatArray,
    residual: FloatArray,
    v: FloatArray,
    gradient: FloatArray,
) -> None:
    """Derivatives and residuals of one point's observations; its own block V and gradient."""
    v[:] = 0.0
    gradient[:] = 0.0
    for o in range(first, last):
        i, k = image[o], o - first
        column, row, depth = projection_jacobian(
            x, rotation[i], position[i], intrinsics[lens[i]], by_point[k], by_pose[k], by_lens[k]
        )
        w = weight[o]
        if w <= 0.0 or not depth > MIN_DEPTH:
            by_point[k], by_pose[k], by_lens[k] = 0.0, 0.0, 0.0
            residual[k] = 0.0
            continue
        residual[k, 0], residual[k, 1] = pixel[o, 0] - column, pixel[o, 1] - row
        for a in range(3):
            gradient[a] += w * (by_point[k, 0, a] * residual[k, 0] + by_point[k, 1, a] * residual[k, 1])
            for b in range(3):
                v[a, b] += w * (by_point[k, 0, a] * by_point[k, 0, b] + by_point[k, 1, a] * by_point[k, 1, b])


@njit(cache=True, error_model="numpy")
def most_views(start: IntArray) -> int:
    """Largest number of observations of a point."""
    most = 0
    for p in range(start.size - 1):
        most = max(most, start[p + 1] - start[p])
    return most


@njit(cache=True, error_model="numpy")
def _couple(
    n_views: int,
    lenses: int,
    image_of: IntArray,
    lens_of: IntArray,
    weights: FloatArray,
    by_point: FloatArray,
    by_pose: FloatArray,
    by_lens: FloatArray,
    coupling: FloatArray,
    index: IntArray,
    base: int,
) -> int:
    """
    Write the rows W of one point and the unknown each belongs to; return how many.

    Poses give six rows a view; lenses nine rows each, summed over the point's views.
    """
    n = 0
    for k in range(n_views):
        if weights[k] <= 0.0:
            continue
        for a in range(6):
            index[n] = 6 * image_of[k] + a
            for b in range(3):
                coupling[n, b] = weights[k] * (
                    by_pose[k, 0, a] * by_point[k, 0, b] + by_pose[k, 1, a] * by_point[k, 1, b]
                )
            n += 1
    for g in range(lenses):
        is_seen = False
        for k in range(n_views):
            if lens_of[k] != g or weights[k] <= 0.0:
                continue
            if not is_seen:
                for a in range(N_CALIBRATION):
                    index[n + a] = base + N_CALIBRATION * g + a
                    coupling[n + a] = 0.0
                is_seen = True
            for a in range(N_CALIBRATION):
                for b in range(3):
                    coupling[n + a, b] += weights[k] * (
                        by_lens[k, 0, a] * by_point[k, 0, b] + by_lens[k, 1, a] * by_point[k, 1, b]
                    )
        if is_seen:
            n += N_CALIBRATION
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def reduced_system(
    points: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    lens: IntArray,
    start: IntArray,
    image: IntArray,
    pixel: FloatArray,
    weight: FloatArray,
    damping: float,
) -> tuple[FloatArray, FloatArray]:
    """
    Normal equations of the camera side, points eliminated.

    Parameters
    ----------
    points : array, shape (n_points, 3), m
    rotation, position : array, shape (n_images, 3, 3) and (n_images, 3)
    intrinsics : array, shape (n_lenses, 9)
    lens : array, shape (n_images,)
    start : array, shape (n_points + 1,)
    image : array, shape (n_observations,)
    pixel : array, shape (n_observations, 2)
    weight : array, shape (n_observations,), 1 / pixels^2
        0 leaves an observation out.
    damping : float
        Share of its diagonal added to every V.

    Returns
    -------
    matrix : array, shape (n, n), with n = 6 n_images + 9 n_lenses
    gradient : array, shape (n,)
        Solve matrix @ step = gradient.
    """
    base = 6 * position.shape[0]
    n_lenses = intrinsics.shape[0]
    size = base + N_CALIBRATION * n_lenses
    matrix = np.zeros((size, size))
    total = np.zeros(size)
    most = most_views(start)
    by_point, by_pose = np.empty((most, 2, 3)), np.empty((most, 2, 6))
    by_lens, residual = np.empty((most, 2, N_CALIBRATION)), np.empty((most, 2))
    coupling = np.empty((6 * most + N_CALIBRATION * n_lenses, 3))
    index = np.empty(6 * most + N_CALIBRATION * n_lenses, np.int64)
    v, v_inverse, gradient, shifted = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    lens_of = np.empty(most, np.int64)
    for p in range(points.shape[0]):
        first, last = start[p], start[p + 1]
        m = last - first
        linearise_point(
            points[p], first, last, rotation, position, intrinsics, lens, image, pixel, weight,
            by_point, by_pose, by_lens, residual, v, gradient,
        )  # fmt: skip
        for a in range(3):
            v[a, a] *= 1.0 + damping
        if invert_symmetric(v, v_inverse) <= 0.0:
            continue
        for k in range(m):
            i, w = image[first + k], weight[first + k]
            lens_of[k] = lens[i]
            at, to = 6 * i, base + N_CALIBRATION * lens[i]
            for a in range(6):
                g0, g1 = w * by_pose[k, 0, a], w * by_pose[k, 1, a]
                total[at + a] += g0 * residual[k, 0] + g1 * residual[k, 1]
                for b in range(a, 6):
                    matrix[at + a, at + b] += g0 * by_pose[k, 0, b] + g1 * by_pose[k, 1, b]
                for b in range(N_CALIBRATION):
                    matrix[at + a, to + b] += g0 * by_lens[k, 0, b] + g1 * by_lens[k, 1, b]
            for a in range(N_CALIBRATION):
                g0, g1 = w * by_lens[k, 0, a], w * by_lens[k, 1, a]
                total[to + a] += g0 * residual[k, 0] + g1 * residual[k, 1]
                for b in range(a, N_CALIBRATION):
                    matrix[to + a, to + b] += g0 * by_lens[k, 0, b] + g1 * by_lens[k, 1, b]
        n = _couple(
            m, n_lenses, image[first:last], lens_of, weight[first:last], by_point, by_pose, by_lens,
            coupling, index, base,
        )  # fmt: skip
        for a in range(n):
            for c in range(3):
                shifted[c] = (
                    coupling[a, 0] * v_inverse[0, c]
                    + coupling[a, 1] * v_inverse[1, c]
                    + coupling[a, 2] * v_inverse[2, c]
                )
            at = index[a]
            total[at] -= shifted[0] * gradient[0] + shifted[1] * gradient[1] + shifted[2] * gradient[2]
            for b in range(a, n):
                matrix[at, index[b]] -= (
                    shifted[0] * coupling[b, 0] + shifted[1] * coupling[b, 1] + shifted[2] * coupling[b, 2]
                )
    for a in range(size):
        for b in range(a + 1, size):
            matrix[b, a] = matrix[a, b]
    return matrix, total


@njit(cache=True, error_model="numpy")
def _take_off_moved(
    first: int,
    last: int,
    lens: IntArray,
    image: IntArray,
    weight: FloatArray,
    by_point: FloatArray,
    by_pose: FloatArray,
    by_lens: FloatArray,
    step: FloatArray,
    base: int,
    gradient: FloatArray,
) -> None:
    """Subtract W' step from a point's gradient: what its pixels move by as the camera side takes the step."""
    for k in range(last - first):
        i, w = image[first + k], weight[first + k]
        at, to = 6 * i, base + N_CALIBRATION * lens[i]
        for r in range(2):
            moved = 0.0
            for a in range(6):
                moved += by_pose[k, r, a] * step[at + a]
            for a in range(N_CALIBRATION):
                moved += by_lens[k, r, a] * step[to + a]
            for b in range(3):
                gradient[b] -= w * by_point[k, r, b] * moved


@njit(cache=True, nogil=True, error_model="numpy")
def point_steps(
    points: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    lens: IntArray,
    start: IntArray,
    image: IntArray,
    pixel: FloatArray,
    weight: FloatArray,
    damping: float,
    step: FloatArray,
) -> FloatArray:
    """
    Steps of the points that follow from a step of the camera side.

    Parameters
    ----------
    points, rotation, position, intrinsics, lens, start, image, pixel, weight, damping
        As `reduced_system`.
    step : array, shape (6 n_images + 9 n_lenses,)

    Returns
    -------
    steps : array, shape (n_points, 3), m
        V^-1 (g - W^T step); 0 for a point whose observations do not fix it.
    """
    base = 6 * position.shape[0]
    most = most_views(start)
    by_point, by_pose = np.empty((most, 2, 3)), np.empty((most, 2, 6))
    by_lens, residual = np.empty((most, 2, N_CALIBRATION)), np.empty((most, 2))
    v, v_inverse, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    steps = np.zeros((points.shape[0], 3))
    for p in range(points.shape[0]):
        first, last = start[p], start[p + 1]
        linearise_point(
            points[p], first, last, rotation, position, intrinsics, lens, image, pixel, weight,
            by_point, by_pose, by_lens, residual, v, gradient,
        )  # fmt: skip
        for a in range(3):
            v[a, a] *= 1.0 + damping
        if invert_symmetric(v, v_inverse) <= 0.0:
            continue
        _take_off_moved(first, last, lens, image, weight, by_point, by_pose, by_lens, step, base, gradient)
        for a in range(3):
            steps[p, a] = v_inverse[a, 0] * gradient[0] + v_inverse[a, 1] * gradient[1] + v_inverse[a, 2] * gradient[2]
    return steps


@njit(cache=True, nogil=True, error_model="numpy")
def point_covariances(
    points: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    lens: IntArray,
    start: IntArray,
    image: IntArray,
    pixel: FloatArray,
    weight: FloatArray,
    camera_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """
    Covariance of each point: the part of its own pixels, and the part of poses and lenses.

    Parameters
    ----------
    points, rotation, position, intrinsics, lens, start, image, pixel, weight
        As `reduced_system`.
    camera_covariance : array, shape (6 n_images + 9 n_lenses, 6 n_images + 9 n_lenses)
        Marginal covariance of the camera side.

    Returns
    -------
    own : array, shape (n_points, 3, 3), m^2
        V^-1: independent from point to point. NaN for a point that its observations do not fix.
    shared : array, shape (n_points, 3, 3), m^2
        V^-1 W^T C W V^-1: common to all points that see the same cameras.
    """
    base = 6 * position.shape[0]
    n_lenses = intrinsics.shape[0]
    most = most_views(start)
    by_point, by_pose = np.empty((most, 2, 3)), np.empty((most, 2, 6))
    by_lens, residual = np.empty((most, 2, N_CALIBRATION)), np.empty((most, 2))
    coupling = np.empty((6 * most + N_CALIBRATION * n_lenses, 3))
    index = np.empty(6 * most + N_CALIBRATION * n_lenses, np.int64)
    v, v_inverse, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    lens_of = np.empty(most, np.int64)
    spread, row = np.empty((3, 3)), np.empty(3)
    own = np.full((points.shape[0], 3, 3), np.nan)
    shared = np.full((points.shape[0], 3, 3), np.nan)
    for p in range(points.shape[0]):
        first, last = start[p], start[p + 1]
        linearise_point(
            points[p], first, last, rotation, position, intrinsics, lens, image, pixel, weight,
            by_point, by_pose, by_lens, residual, v, gradient,
        )  # fmt: skip
        if invert_symmetric(v, v_inverse) <= 0.0:
            continue
        for k in range(last - first):
            lens_of[k] = lens[image[first + k]]
        n = _couple(
            last - first, n_lenses, image[first:last], lens_of, weight[first:last], by_point, by_pose, by_lens,
            coupling, index, base,
        )  # fmt: skip
        spread[:] = 0.0
        for a in range(n):
            row[:] = 0.0
            for b in range(n):
                c = camera_covariance[index[a], index[b]]
                for j in range(3):
                    row[j] += c * coupling[b, j]
            for i in range(3):
                for j in range(3):
                    spread[i, j] += coupling[a, i] * row[j]
        for a in range(3):
            for b in range(3):
                own[p, a, b] = v_inverse[a, b]
                total = 0.0
                for i in range(3):
                    for j in range(3):
                        total += v_inverse[a, i] * spread[i, j] * v_inverse[j, b]
                shared[p, a, b] = total
    return own, shared


@njit(cache=True, nogil=True, error_model="numpy")
def coordinate_modes(
    points: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    lens: IntArray,
    start: IntArray,
    image: IntArray,
    pixel: FloatArray,
    weight: FloatArray,
    modes: FloatArray,
    axis: int,
) -> FloatArray:
    """
    One coordinate of each point per unit of a pattern of camera-side errors.

    Parameters
    ----------
    points, rotation, position, intrinsics, lens, start, image, pixel, weight
        As `reduced_system`.
    modes : array, shape (6 n_images + 9 n_lenses, n_modes)
        Columns: errors of the camera side.
    axis : int
        0 east, 1 north, 2 height.

    Returns
    -------
    moves : array, shape (n_points, n_modes), m
        Change of the coordinate as the point's observations stay and the cameras move by each column.
    """
    moves = np.empty((points.shape[0], modes.shape[1]))
    base = 6 * position.shape[0]
    most = most_views(start)
    by_point, by_pose = np.empty((most, 2, 3)), np.empty((most, 2, 6))
    by_lens, residual = np.empty((most, 2, N_CALIBRATION)), np.empty((most, 2))
    v, v_inverse, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for p in range(points.shape[0]):
        first, last = start[p], start[p + 1]
        linearise_point(
            points[p], first, last, rotation, position, intrinsics, lens, image, pixel, weight,
            by_point, by_pose, by_lens, residual, v, gradient,
        )  # fmt: skip
        invert_symmetric(v, v_inverse)
        for c in range(modes.shape[1]):
            gradient[:] = 0.0
            _take_off_moved(first, last, lens, image, weight, by_point, by_pose, by_lens, modes[:, c], base, gradient)
            moves[p, c] = (
                v_inverse[axis, 0] * gradient[0] + v_inverse[axis, 1] * gradient[1] + v_inverse[axis, 2] * gradient[2]
            )
    return moves
