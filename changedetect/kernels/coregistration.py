"""
Kernels of co-registration: bicubic elevation and slope of a raster, and a spatially stratified choice of points.

References
----------
.. [1] R. Keys (1981), Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29, 1153-1160.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

__all__ = ["interpolate_raster", "keep_smallest"]


@njit(cache=True, error_model="numpy")
def _cubic_weights(t):
    """Weights of the four nodes -1, 0, 1, 2 at 0 <= t < 1, and their derivatives; Keys' kernel with a = -1/2."""
    t2 = t * t
    t3 = t2 * t
    value = (
        -0.5 * t3 + t2 - 0.5 * t,
        1.5 * t3 - 2.5 * t2 + 1.0,
        -1.5 * t3 + 2.0 * t2 + 0.5 * t,
        0.5 * t3 - 0.5 * t2,
    )
    slope = (-1.5 * t2 + 2.0 * t - 0.5, 4.5 * t2 - 5.0 * t, -4.5 * t2 + 4.0 * t + 0.5, 1.5 * t2 - t)
    return value, slope


@njit(cache=True, parallel=True, error_model="numpy")
def interpolate_raster(raster, row, column, interpolated):
    """
    Value and derivatives of a raster between its nodes.

    Parameters
    ----------
    raster : array, shape (n_rows, n_cols)
        Values at the nodes; NaN marks no data.
    row, column : array, shape (n,)
        Positions in units of nodes: node [i, j] is at (i, j).
    interpolated : array, shape (n, 4)
        Filled in place: value, derivative along rows, derivative along columns, defined (1 or 0). Bicubic [1]_ where
        all sixteen nodes have data, bilinear where only the inner four have, undefined elsewhere.
    """
    n_rows, n_cols = raster.shape
    for p in prange(row.size):
        o = interpolated[p]
        o[0] = o[1] = o[2] = o[3] = 0.0
        if not (0.0 <= row[p] <= n_rows - 1.0 and 0.0 <= column[p] <= n_cols - 1.0):
            continue
        i = min(int(math.floor(row[p])), n_rows - 2)
        j = min(int(math.floor(column[p])), n_cols - 2)
        if i < 0 or j < 0:
            continue
        s, t = row[p] - i, column[p] - j
        if i >= 1 and j >= 1 and i + 2 < n_rows and j + 2 < n_cols:
            row_weights, row_slopes = _cubic_weights(s)
            column_weights, column_slopes = _cubic_weights(t)
            value = along_rows = along_columns = 0.0
            for a in range(4):
                line = line_slope = 0.0
                for b in range(4):
                    z = raster[i - 1 + a, j - 1 + b]
                    line += column_weights[b] * z
                    line_slope += column_slopes[b] * z
                value += row_weights[a] * line
                along_rows += row_slopes[a] * line
                along_columns += row_weights[a] * line_slope
            if value == value:
                o[0], o[1], o[2], o[3] = value, along_rows, along_columns, 1.0
                continue
        z00, z01 = float(raster[i, j]), float(raster[i, j + 1])
        z10, z11 = float(raster[i + 1, j]), float(raster[i + 1, j + 1])
        value = (1.0 - s) * ((1.0 - t) * z00 + t * z01) + s * ((1.0 - t) * z10 + t * z11)
        if value == value:
            o[0] = value
            o[1] = (1.0 - t) * (z10 - z00) + t * (z11 - z01)
            o[2] = (1.0 - s) * (z01 - z00) + s * (z11 - z10)
            o[3] = 1.0


@njit(cache=True, error_model="numpy")
def keep_smallest(cell, key, easting, northing, elevation, sigma, best_key, best):
    """
    Keep in every cell the observation of the smallest key.

    Parameters
    ----------
    cell : array, shape (n,), int64
        Negative: the observation is left out.
    key : array, shape (n,), uint64
        Pseudo-random; observations of equal key are told apart by northing, easting, elevation, sigma.
    easting, northing, elevation, sigma : array, shape (n,), m
    best_key : array, shape (n_cells,), uint64
    best : array, shape (n_cells, 4)
        Both updated in place; columns easting, northing, elevation, sigma, NaN in an empty cell. The result does not
        depend on the order of the observations, nor on how they are spread over calls.
    """
    for p in range(cell.size):
        c = cell[p]
        if c < 0:
            continue
        o = best[c]
        if not np.isnan(o[0]):
            if key[p] > best_key[c]:
                continue
            if key[p] == best_key[c]:
                new = (northing[p], easting[p], elevation[p], sigma[p])
                if new >= (o[1], o[0], o[2], o[3]):
                    continue
        best_key[c] = key[p]
        o[0], o[1], o[2], o[3] = easting[p], northing[p], elevation[p], sigma[p]
