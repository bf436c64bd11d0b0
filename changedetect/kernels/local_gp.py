"""
Gaussian processes over the few observations around each receptive field.

What a coarse surface leaves over is rough ground and noise. Around each field it is taken for a stationary process of
known variance, and its value and slope at the centre follow from the nearest cells [1]_.

References
----------
.. [1] C. E. Rasmussen, C. K. I. Williams (2006), Gaussian Processes for Machine Learning, eqs 2.25, 2.26 and 4.17.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from changedetect.kernels.compilation import FUSED

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["N_LOCAL", "N_NEAREST", "local_processes", "neighbour_products"]

#: Columns of `local_processes`: 0 value, 1 slope east, 2 slope north, 3 posterior variance, 4 sum of the weights.
N_LOCAL = 5
#: So many cells take part at most: 24 gain 1 %, 12 lose 2 %.
N_NEAREST = 16
#: Places of one piece of work of a thread.
_BLOCK = 256


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _matern(d: float) -> float:
    """Correlation of order 3/2 at a distance in correlation lengths."""
    return (1.0 + d) * math.exp(-d)


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _nearest_cells(
    window: FloatArray, cell_size: float, x0: float, y0: float, radius: float, without: bool, found: FloatArray
) -> int:
    """
    Collect the nearest occupied cells within a radius, ring by ring about the one that holds the place.

    `found`, shape (k, 6), gets squared distance, offset east and north, mean elevation, noise variance of that mean
    as observed and its weight over its count; in ascending order of distance. `without` leaves out the cell that
    holds the place. Returns how many there are.
    """
    row, column = int(math.floor(y0 / cell_size)), int(math.floor(x0 / cell_size))
    k = found.shape[0]
    rings = int(math.ceil(radius / cell_size))
    n = 0
    for ring in range(1 if without else 0, rings + 1):
        # cells of this ring are at least so far away
        nearest = max(ring - 1, 0) * cell_size
        if n == k and nearest * nearest > found[k - 1, 0]:
            break
        for a in range(max(0, row - ring), min(window.shape[0], row + ring + 1)):
            step = 1 if a in (row - ring, row + ring) else max(2 * ring, 1)
            for b in range(column - ring, column + ring + 1, step):
                if b < 0 or b >= window.shape[1]:
                    continue
                m = window[a, b]
                if m[1] <= 0.0:
                    continue
                dx = (b + 0.5) * cell_size + m[2] / m[1] - x0
                dy = (a + 0.5) * cell_size + m[3] / m[1] - y0
                d2 = dx * dx + dy * dy
                if n == k and d2 >= found[k - 1, 0]:
                    continue
                at = n if n < k else k - 1
                n = min(n + 1, k)
                while at > 0 and found[at - 1, 0] > d2:
                    found[at] = found[at - 1]
                    at -= 1
                o = found[at]
                o[0], o[1], o[2] = d2, dx, dy
                o[3] = m[7] / m[1]
                o[4] = m[12] / (m[0] * m[0])
                o[5] = m[1] / m[0]
    while n > 0 and found[n - 1, 0] > radius * radius:
        n -= 1
    return n


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _factorise(C: FloatArray, n: int) -> None:
    """Cholesky factor of the leading n rows, in place below the diagonal."""
    for i in range(n):
        for j in range(i + 1):
            s = C[i, j]
            for q in range(j):
                s -= C[i, q] * C[j, q]
            if i == j:
                C[i, i] = math.sqrt(max(s, 1e-12))
            else:
                C[i, j] = s / C[j, j]


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _solve(C: FloatArray, n: int, b: FloatArray, x: FloatArray) -> None:
    """Solve L L' x = b with the factor of `_factorise`."""
    for i in range(n):
        s = b[i]
        for q in range(i):
            s -= C[i, q] * x[q]
        x[i] = s / C[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for q in range(i + 1, n):
            s -= C[q, i] * x[q]
        x[i] = s / C[i, i]


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def local_processes(
    window: FloatArray,
    cell_size: float,
    row0: int,
    column0: int,
    correlation_length: float,
    radius: float,
    easting: FloatArray,
    northing: FloatArray,
    without: bool,
    variance: FloatArray,
    fits: FloatArray,
) -> None:
    """
    Posterior mean, slope and variance of local Gaussian processes at scattered places.

    Parameters
    ----------
    window : array, shape (n_rows, n_columns, N_MOMENTS)
        Moments of what is left over a coarse surface, covering the radius around the places.
    cell_size : float, m
    row0, column0 : int
        First row and column of the window.
    correlation_length : float, m
        l of the Matern covariance of order 3/2, t (1 + d / l) exp(-d / l).
    radius : float, m
        Cells further away take no part.
    easting, northing : array, shape (n,), m
    without : bool
        Leave out the cell that holds the place: the answers are then those of leave-one-out cross-validation.
    variance : array, shape (n,), m2
        Variance t of the process around each place.
    fits : array, shape (n, N_LOCAL)
        Filled in place; without any cell around, the prior: 0 with variance t.

    Notes
    -----
    A cell counts as one observation, the mean of its own, with the noise variance of that mean. Cells whose weight was
    faded have it raised in proportion to the least faded cell that takes part, so that memory yields to new
    observations and keeps its precision where there are none.
    """
    per_l = 1.0 / correlation_length
    n_blocks = (easting.size + _BLOCK - 1) // _BLOCK
    for block in prange(n_blocks):
        found = np.empty((N_NEAREST, 6))
        C = np.empty((N_NEAREST, N_NEAREST))
        k = np.empty(N_NEAREST)
        alpha = np.empty(N_NEAREST)
        weight = np.empty(N_NEAREST)
        z = np.empty(N_NEAREST)
        for i in range(block * _BLOCK, min(easting.size, (block + 1) * _BLOCK)):
            o = fits[i]
            t = variance[i]
            o[0] = o[1] = o[2] = o[4] = 0.0
            o[3] = t
            if not t > 0.0:
                continue
            x0, y0 = easting[i] - column0 * cell_size, northing[i] - row0 * cell_size
            n = _nearest_cells(window, cell_size, x0, y0, radius, without, found)
            if n == 0:
                continue
            freshest = 0.0
            for p in range(n):
                freshest = max(freshest, found[p, 5])
            for p in range(n):
                for q in range(p):
                    dx, dy = found[p, 1] - found[q, 1], found[p, 2] - found[q, 2]
                    C[p, q] = _matern(math.sqrt(dx * dx + dy * dy) * per_l)
                C[p, p] = 1.0 + found[p, 4] * freshest / (found[p, 5] * t)
                k[p] = _matern(math.sqrt(found[p, 0]) * per_l)
                z[p] = found[p, 3]
            _factorise(C, n)
            _solve(C, n, z, alpha)
            _solve(C, n, k, weight)
            explained = total = 0.0
            for p in range(n):
                slope = alpha[p] * math.exp(-math.sqrt(found[p, 0]) * per_l) * per_l * per_l
                o[0] += alpha[p] * k[p]
                o[1] += slope * found[p, 1]
                o[2] += slope * found[p, 2]
                explained += weight[p] * k[p]
                total += weight[p]
            o[3] = t * max(1.0 - explained, 0.0)
            o[4] = total


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def neighbour_products(
    window: FloatArray,
    cell_size: float,
    row0: int,
    column0: int,
    correlation_length: float,
    radius: float,
    easting: FloatArray,
    northing: FloatArray,
    n_neighbours: int,
    products: FloatArray,
) -> None:
    """
    What the neighbours of every cell say about the variance of the process there.

    Parameters
    ----------
    window, cell_size, row0, column0, correlation_length, radius
        As for `local_processes`.
    easting, northing : array, shape (n,), m
        The cells' places.
    n_neighbours : int
        So many of the nearest cells take part.
    products : array, shape (n, 2)
        Filled in place: sum of rho_j z_j and of rho_j**2 over the neighbours j, with rho the correlation with the
        place and z the left-over.

    Notes
    -----
    The product z_i z_j of two neighbours has expectation t rho_ij whatever the noise, since noise is independent from
    cell to cell; an observation that stands alone has no neighbour that agrees with it.
    """
    per_l = 1.0 / correlation_length
    n_blocks = (easting.size + _BLOCK - 1) // _BLOCK
    for block in prange(n_blocks):
        found = np.empty((n_neighbours, 6))
        for i in range(block * _BLOCK, min(easting.size, (block + 1) * _BLOCK)):
            x0, y0 = easting[i] - column0 * cell_size, northing[i] - row0 * cell_size
            n = _nearest_cells(window, cell_size, x0, y0, radius, True, found)
            total = squares = 0.0
            for p in range(n):
                rho = _matern(math.sqrt(found[p, 0]) * per_l)
                total += rho * found[p, 3]
                squares += rho * rho
            products[i, 0] = total
            products[i, 1] = squares
