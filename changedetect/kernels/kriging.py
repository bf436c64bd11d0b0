"""Weights of best linear predictions of many places that each have other data."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["solve_stencils"]


@njit(cache=True, error_model="numpy", nogil=True)
def solve_stencils(
    correlated: FloatArray,
    local: FloatArray,
    target: FloatArray,
    used: BoolArray,
    ratio: FloatArray,
    ridge: float,
    weights: FloatArray,
) -> None:
    """
    Solve (correlated + sqrt(r_i r_j) local + ridge) w = target over the data used, for every place.

    Parameters
    ----------
    correlated, local : array, shape (n, n)
        Covariances among the data around a place.
    target : array, shape (n,)
        Covariances of the data with the place.
    used : array, shape (n_places, n), bool
    ratio : array, shape (n_places, n)
        Factor of the local covariance of each datum, r.
    ridge : float
    weights : array, shape (n_places, n)
        Out: w; 0 where data are not used.

    Notes
    -----
    Cholesky factorisation of the rows and columns that are used, one place after the other.
    """
    n = target.size
    index = np.empty(n, np.int64)
    lower = np.empty((n, n))
    solution = np.empty(n)
    root = np.empty(n)
    for place in range(used.shape[0]):
        m = 0
        for j in range(n):
            weights[place, j] = 0.0
            if used[place, j]:
                index[m] = j
                root[m] = math.sqrt(ratio[place, j])
                m += 1
        for i in range(m):
            row = index[i]
            for j in range(i + 1):
                value = correlated[row, index[j]] + root[i] * root[j] * local[row, index[j]]
                if i == j:
                    value += ridge
                lower[i, j] = value
        for i in range(m):
            for j in range(i + 1):
                value = lower[i, j]
                for k in range(j):
                    value -= lower[i, k] * lower[j, k]
                lower[i, j] = math.sqrt(max(value, ridge)) if i == j else value / lower[j, j]
            value = target[index[i]]
            for k in range(i):
                value -= lower[i, k] * solution[k]
            solution[i] = value / lower[i, i]
        for i in range(m - 1, -1, -1):
            value = solution[i] / lower[i, i]
            solution[i] = value
            for k in range(i):
                solution[k] -= lower[i, k] * value
            weights[place, index[i]] = value
