"""
Kernels of co-registration: bicubic elevation and slope of a raster, a spatially stratified choice of points, and the
likelihood of correlated errors.

References
----------
.. [1] R. Keys (1981), Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29, 1153-1160.
.. [2] H. D. Patterson, R. Thompson (1971), Recovery of inter-block information when block sizes are unequal,
   Biometrika 58, 545-554.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

__all__ = ["interpolate_raster", "keep_smallest", "restricted_likelihood"]


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


@njit(cache=True, error_model="numpy")
def restricted_likelihood(columns, distance, dilution, share, length, exponent):
    """
    Restricted likelihood of correlated means, their variance profiled out.

    Parameters
    ----------
    columns : array, shape (m, k + 1)
        Design of the fitted parameters, then the means.
    distance : array, shape (m, m), m
    dilution : array, shape (m,)
        Variance of the independent part of each mean, relative to the typical one.
    share : float, 0 to 1
        Correlated part of the variance.
    length : float, m
    exponent : {1, 2}
        Correlation exp(-d / length) or exp(-d2 / (2 length2)).

    Returns
    -------
    log_likelihood, variance : float
        Less a constant; -inf and 0 where the covariance matrix is not positive definite.

    Notes
    -----
    With C = U'U the covariance for a variance of one, X the design and y the means, both multiplied by U'^-1 [2]_:
    -1/2 ((m - k) log s2 + log det C + log det X'X), s2 the mean square of what X leaves of y. Written out instead of
    calling LAPACK, whose threads cost more than they save on matrices of this size.
    """
    m, k = columns.shape[0], columns.shape[1] - 1
    u = np.empty((m, m))
    for i in range(m):
        for j in range(i, m):
            d = distance[i, j] / length
            u[i, j] = share * (math.exp(-d) if exponent == 1 else math.exp(-0.5 * d * d))
        # a trace of white noise keeps a smooth correlation positive definite
        u[i, i] = share + (1.0 - share) * dilution[i] + 1e-6
    w = columns.copy()
    log_det = 0.0
    for j in range(m):
        if not u[j, j] > 0.0:
            return -math.inf, 0.0
        pivot = math.sqrt(u[j, j])
        log_det += 2.0 * math.log(pivot)
        for c in range(j, m):
            u[j, c] /= pivot
        for c in range(k + 1):
            w[j, c] /= pivot
        for i in range(j + 1, m):
            f = u[j, i]
            for c in range(i, m):
                u[i, c] -= f * u[j, c]
            for c in range(k + 1):
                w[i, c] -= f * w[j, c]
    freedom = m
    for a in range(k + 1):
        before = after = 0.0
        for i in range(m):
            before += w[i, a] * w[i, a]
        for b in range(a):
            dot = 0.0
            for i in range(m):
                dot += w[i, a] * w[i, b]
            for i in range(m):
                w[i, a] -= dot * w[i, b]
        for i in range(m):
            after += w[i, a] * w[i, a]
        if a == k:
            variance = max(after / max(freedom, 1), 1e-300)
            return -0.5 * (freedom * math.log(variance) + log_det), variance
        # a column that the others hold already takes away no degree of freedom
        is_new = after > 1e-12 * before
        if is_new:
            log_det += math.log(after)
            freedom -= 1
        norm = math.sqrt(after) if is_new else math.inf
        for i in range(m):
            w[i, a] /= norm
    return -math.inf, 0.0
