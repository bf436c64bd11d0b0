"""Nearest descriptors among the features near a predicted place."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from changedetect.typing import FloatArray, IntArray

__all__ = ["match_near"]


# Summing in another order lets the processor add several products at once: eight times as fast, and NaN stay NaN.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _product(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    total = np.float32(0.0)
    for k in range(a.size):
        total += a[k] * b[k]
    return float(total)


@njit(cache=True, nogil=True, error_model="numpy")
def match_near(
    predicted: FloatArray,
    pixel: FloatArray,
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    radius: float,
    ratio: float,
    unrelated: float,
) -> IntArray:
    """
    Best match of each feature among those near its predicted place.

    Parameters
    ----------
    predicted : array, shape (n, 2), pixels
        Where features of the first photo should appear in the second; NaN where nowhere.
    pixel : array, shape (m, 2), pixels
        Features of the second photo, rows (second column) ascending.
    first, second : array, shape (n, d) and (m, d), float32
        Descriptors of unit length.
    radius : float, pixels
    ratio : float
        A match must be nearer than this times the second nearest within the radius.
    unrelated : float
        Squared distance of descriptors that have nothing to do with each other; stands for the second nearest where
        the radius holds only one.

    Returns
    -------
    match : array, shape (n,), int64
        Feature of the second photo; -1 where none is near or the nearest is ambiguous.
    """
    n, m = predicted.shape[0], pixel.shape[0]
    match = np.full(n, -1, np.int64)
    rows = pixel[:, 1].copy()
    for a in range(n):
        column, row = predicted[a, 0], predicted[a, 1]
        if not (np.isfinite(column) and np.isfinite(row)):
            continue
        best, runner_up, at = unrelated, unrelated, -1
        for b in range(np.searchsorted(rows, row - radius), m):
            if rows[b] > row + radius:
                break
            if (pixel[b, 0] - column) ** 2 + (rows[b] - row) ** 2 > radius * radius:
                continue
            distance = 2.0 - 2.0 * _product(first[a], second[b])
            if distance < best:
                runner_up, best, at = best, distance, b
            elif distance < runner_up:
                runner_up = distance
        if at >= 0 and best < ratio * ratio * runner_up:
            match[a] = at
    return match
