"""How far in height an observation lies from the others around it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["nearest_heights", "square_medians"]


@njit(cache=True, parallel=True, error_model="numpy")
def square_medians(elevation: FloatArray, order: IntArray, start: IntArray, medians: FloatArray) -> None:
    """
    Median elevation of every square of a lattice.

    Parameters
    ----------
    elevation : array, shape (n,), m
    order : array, shape (n,), int64
        Observations square by square.
    start : array, shape (m + 1,), int64
        Where each square begins in `order`.
    medians : array, shape (m,), m
        Filled in place; NaN for an empty square.
    """
    for k in prange(medians.size):
        medians[k] = np.median(elevation[order[start[k] : start[k + 1]]]) if start[k + 1] > start[k] else np.nan


@njit(cache=True, parallel=True, error_model="numpy")
def nearest_heights(
    easting: FloatArray,
    northing: FloatArray,
    elevation: FloatArray,
    slope: FloatArray,
    order: IntArray,
    start: IntArray,
    asked: BoolArray,
    n_neighbours: int,
    distance: FloatArray,
) -> None:
    """
    Vertical distance to the k-th nearest in height among the observations of the square and those around it.

    Parameters
    ----------
    easting, northing, elevation : array, shape (n,), m
    slope : array, shape (2, n_rows, n_columns)
        Slope east and north of every square, taken off the height differences.
    order : array, shape (n,), int64
        Observations square by square, row by row.
    start : array, shape (n_rows * n_columns + 1,), int64
        Where each square begins in `order`.
    asked : array, shape (n,), bool
        Observations whose distance is wanted.
    n_neighbours : int
        k.
    distance : array, shape (n,), m
        Filled in place where asked for; infinite where there are fewer than k others.
    """
    n_rows, n_columns = slope.shape[1], slope.shape[2]
    for row in prange(n_rows):
        nearest = np.empty(n_neighbours)
        for column in range(n_columns):
            east, north = slope[0, row, column], slope[1, row, column]
            square = row * n_columns + column
            for p in range(start[square], start[square + 1]):
                i = order[p]
                if not asked[i]:
                    continue
                nearest[:] = np.inf
                for a in range(max(0, row - 1), min(n_rows, row + 2)):
                    first = start[a * n_columns + max(0, column - 1)]
                    last = start[a * n_columns + min(n_columns, column + 2)]
                    for q in range(first, last):
                        j = order[q]
                        if j == i:
                            continue
                        d = elevation[j] - elevation[i]
                        d = abs(d - east * (easting[j] - easting[i]) - north * (northing[j] - northing[i]))
                        k = n_neighbours
                        while k > 0 and d < nearest[k - 1]:
                            if k < n_neighbours:
                                nearest[k] = nearest[k - 1]
                            k -= 1
                        if k < n_neighbours:
                            nearest[k] = d
                distance[i] = nearest[n_neighbours - 1]
