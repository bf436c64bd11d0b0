"""
Micro-cell moments: a survey epoch reduced to additive sums over small square cells.

A cell holds, for the observations inside it, the weighted sums of the powers of position and elevation up to the
second order. That is all a weighted local plane, its residual and its leave-one-out error need, so a receptive field
is computed from cells instead of points.

Sums are kept as int64 of quantised values, so that adding is exact: the same observations give the same bits in any
order, chunking or tiling, and an epoch can be taken out again. Lattices are anchored at the origin of the CRS and
cell sizes are powers of two of a metre, so the lattices of any two epochs nest.

Lanes of the integer sums (`N_SUMS` columns), with w the integer weight of an observation, x and y its offset from the
cell centre in units of cell_size * `OFFSET_UNIT`, z its elevation in units of `ELEVATION_UNIT`:
0 n, 1 w, 2 wx, 3 wy, 4 wxx, 5 wxy, 6 wyy, 7 wz, 8 wxz, 9 wyz, 10 wzz.
Lanes 8 to 10 may wrap around 2**64; `cell_moments` centres them on the cell's mean elevation, and a centred sum is
exact although its parts wrapped.

Lanes of the floating-point moments (`N_MOMENTS` columns), in metres about the cell centre and about elevation zero:
the same eleven with weights in units of one, then 11: sum of w times observation time in days, 12: sum of the noise
variances of the observations, m2 (one over the weight until the noise has been estimated).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, IntArray

__all__ = [
    "ELEVATION_UNIT",
    "N_MOMENTS",
    "N_SUMS",
    "OFFSET_UNIT",
    "WEIGHT_UNIT",
    "accumulate_tile",
    "cell_indices",
    "collect_tile",
    "count_sort",
    "deposit_moments",
    "gather_moments",
    "integer_weights",
    "moments_from_sums",
    "shift_moments",
]

N_SUMS = 11
N_MOMENTS = 13
#: Quantum of elevation, m.
ELEVATION_UNIT = 2.0**-13
#: Quantum of an offset inside a cell, in cell sizes.
OFFSET_UNIT = 2.0**-12
#: Weight 1 / sigma**2 (1/m2) that makes one integer weight unit: sigma = 4 m. Smaller sigmas weigh more, up to
#: sigma = 8 mm; larger ones count as 4 m.
WEIGHT_UNIT = 1.0 / 16.0
_WEIGHT_MAX = 2**18


@njit(cache=True, error_model="numpy")
def integer_weights(sigma: FloatArray) -> IntArray:
    """
    Integer weight of each observation from its standard deviation.

    Parameters
    ----------
    sigma : array, shape (n,), m, float64, positive

    Returns
    -------
    weight : array, shape (n,), int64
        round(1 / (sigma**2 * WEIGHT_UNIT)), between 1 and 2**18.
    """
    weight = np.empty(sigma.size, np.int64)
    for i in range(sigma.size):
        w = 1.0 / (sigma[i] * sigma[i] * WEIGHT_UNIT)
        weight[i] = max(1, int(min(float(_WEIGHT_MAX), w) + 0.5))
    return weight


@njit(cache=True, error_model="numpy")
def cell_indices(easting: FloatArray, northing: FloatArray, cell_size: float) -> tuple[IntArray, IntArray]:
    """
    Row (northwards) and column (eastwards) of the cell holding each observation.

    Parameters
    ----------
    easting, northing : array, shape (n,), m, float64
    cell_size : float, m

    Returns
    -------
    row, column : array, shape (n,), int64
        floor(coordinate / cell_size), counted from the origin of the CRS.
    """
    row = np.empty(easting.size, np.int64)
    column = np.empty(easting.size, np.int64)
    for i in range(easting.size):
        row[i] = int(math.floor(northing[i] / cell_size))
        column[i] = int(math.floor(easting[i] / cell_size))
    return row, column


@njit(cache=True)
def count_sort(key: IntArray, n_keys: int) -> tuple[IntArray, IntArray]:
    """
    Stable counting sort of small non-negative integers.

    Parameters
    ----------
    key : array, shape (n,), int64, 0 <= key < n_keys
    n_keys : int

    Returns
    -------
    order : array, shape (n,), int64
        Indices that sort `key`.
    start : array, shape (n_keys + 1,), int64
        Members of key k are order[start[k]:start[k + 1]].
    """
    start = np.zeros(n_keys + 1, np.int64)
    for i in range(key.size):
        start[key[i] + 1] += 1
    for k in range(n_keys):
        start[k + 1] += start[k]
    position = start[:-1].copy()
    order = np.empty(key.size, np.int64)
    for i in range(key.size):
        order[position[key[i]]] = i
        position[key[i]] += 1
    return order, start


@njit(cache=True, error_model="numpy")
def accumulate_tile(
    order: IntArray,
    row: IntArray,
    column: IntArray,
    easting: FloatArray,
    northing: FloatArray,
    elevation: FloatArray,
    weight: IntArray,
    cell_size: float,
    row0: int,
    column0: int,
    sums: IntArray,
) -> None:
    """
    Add observations to the dense integer sums of one tile.

    Parameters
    ----------
    order : array, shape (m,), int64
        The observations that lie in the tile.
    row, column : array, shape (n,), int64
    easting, northing, elevation : array, shape (n,), m
    weight : array, shape (n,) or (1,), int64
        One weight for all when the shape is (1,).
    cell_size : float, m
    row0, column0 : int
        First row and column of the tile.
    sums : array, shape (n_rows, n_columns, N_SUMS), int64
        Added to in place.
    """
    unit = cell_size * OFFSET_UNIT
    for k in range(order.size):
        i = order[k]
        s = sums[row[i] - row0, column[i] - column0]
        x = np.int64(math.floor((easting[i] - (column[i] + 0.5) * cell_size) / unit + 0.5))
        y = np.int64(math.floor((northing[i] - (row[i] + 0.5) * cell_size) / unit + 0.5))
        z = np.int64(math.floor(elevation[i] / ELEVATION_UNIT + 0.5))
        w = weight[0] if weight.size == 1 else weight[i]
        wx, wy, wz = w * x, w * y, w * z
        s[0] += 1
        s[1] += w
        s[2] += wx
        s[3] += wy
        s[4] += wx * x
        s[5] += wx * y
        s[6] += wy * y
        s[7] += wz
        s[8] += wx * z
        s[9] += wy * z
        s[10] += wz * z


@njit(cache=True)
def collect_tile(sums: IntArray) -> tuple[IntArray, IntArray]:
    """
    Occupied cells of a dense tile.

    Parameters
    ----------
    sums : array, shape (n_rows, n_columns, N_SUMS), int64

    Returns
    -------
    key : array, shape (m,), int64
        row * n_columns + column, ascending.
    occupied : array, shape (m, N_SUMS), int64
    """
    n = 0
    for a in range(sums.shape[0]):
        for b in range(sums.shape[1]):
            if sums[a, b, 0] > 0:
                n += 1
    key = np.empty(n, np.int64)
    occupied = np.empty((n, sums.shape[2]), np.int64)
    n = 0
    for a in range(sums.shape[0]):
        for b in range(sums.shape[1]):
            if sums[a, b, 0] > 0:
                key[n] = a * sums.shape[1] + b
                occupied[n] = sums[a, b]
                n += 1
    return key, occupied


@njit(cache=True, error_model="numpy")
def moments_from_sums(sums: IntArray, cell_size: float, weight_unit: float, time: float) -> FloatArray:
    """
    Floating-point moments from exact integer sums.

    Elevation sums are first centred, in integers, on each cell's rounded mean elevation, so that neither the size of
    the elevations nor a wrapped sum costs precision; then expressed about elevation zero again only to first order.

    Parameters
    ----------
    sums : array, shape (m, N_SUMS), int64
    cell_size : float, m
    weight_unit : float
        Weight that one integer unit stands for.
    time : float, days
        Time of the observations.

    Returns
    -------
    moments : array, shape (m, N_MOMENTS), float64
    """
    moments = np.empty((sums.shape[0], N_MOMENTS))
    ux = cell_size * OFFSET_UNIT
    uz = ELEVATION_UNIT
    for k in range(sums.shape[0]):
        s = sums[k]
        m = moments[k]
        r = np.int64(math.floor(s[7] / s[1] + 0.5))
        az = s[7] - r * s[1]
        axz = s[8] - r * s[2]
        ayz = s[9] - r * s[3]
        azz = s[10] - r * (s[7] + az)
        z0 = r * uz
        w = s[1] * weight_unit
        m[0] = s[0]
        m[1] = w
        m[2] = s[2] * ux * weight_unit
        m[3] = s[3] * ux * weight_unit
        m[4] = s[4] * (ux * ux) * weight_unit
        m[5] = s[5] * (ux * ux) * weight_unit
        m[6] = s[6] * (ux * ux) * weight_unit
        cz = az * uz * weight_unit
        m[7] = cz + z0 * w
        m[8] = axz * (ux * uz) * weight_unit + z0 * m[2]
        m[9] = ayz * (ux * uz) * weight_unit + z0 * m[3]
        m[10] = azz * (uz * uz) * weight_unit + 2.0 * z0 * cz + z0 * z0 * w
        m[11] = w * time
        m[12] = m[0] * m[0] / w
    return moments


@njit(cache=True, error_model="numpy")
def shift_moments(
    moments: FloatArray, value: FloatArray, slope_east: FloatArray, slope_north: FloatArray
) -> FloatArray:
    """
    Moments of z - (value + slope . offset): a plane taken off every cell, exactly.

    Parameters
    ----------
    moments : array, shape (m, N_MOMENTS)
    value : array, shape (m,), m
        Plane at the cell centre.
    slope_east, slope_north : array, shape (m,), dimensionless

    Returns
    -------
    residual : array, shape (m, N_MOMENTS)
    """
    residual = moments.copy()
    for k in range(moments.shape[0]):
        m, r = moments[k], residual[k]
        f, g, h = value[k], slope_east[k], slope_north[k]
        p = f * m[1] + g * m[2] + h * m[3]
        px = f * m[2] + g * m[4] + h * m[5]
        py = f * m[3] + g * m[5] + h * m[6]
        r[7] -= p
        r[8] -= px
        r[9] -= py
        r[10] += f * p + g * px + h * py - 2.0 * (f * m[7] + g * m[8] + h * m[9])
    return residual


@njit(cache=True, error_model="numpy", inline="always")
def _add_recentred(m: FloatArray, u: float, v: float, o: FloatArray) -> None:
    """Add moments `m` to `o`, whose centre lies (-u, -v) away."""
    o[0] += m[0]
    o[1] += m[1]
    o[2] += m[2] + u * m[1]
    o[3] += m[3] + v * m[1]
    o[4] += m[4] + 2.0 * u * m[2] + u * u * m[1]
    o[5] += m[5] + u * m[3] + v * m[2] + u * v * m[1]
    o[6] += m[6] + 2.0 * v * m[3] + v * v * m[1]
    o[7] += m[7]
    o[8] += m[8] + u * m[7]
    o[9] += m[9] + v * m[7]
    o[10] += m[10]
    o[11] += m[11]
    o[12] += m[12]


@njit(cache=True, error_model="numpy")
def deposit_moments(
    moments: FloatArray,
    row: IntArray,
    column: IntArray,
    source_size: float,
    cell_size: float,
    row0: int,
    column0: int,
    window: FloatArray,
) -> None:
    """
    Add cells of one lattice to a dense window of another, each whole, re-centred on the cell it falls into.

    A finer cell falls into the coarser one that contains it. A coarser cell cannot be divided: it goes to the finer
    cell that holds the mean position of its observations, and its moments stay exact about the new centre.

    Parameters
    ----------
    moments : array, shape (m, N_MOMENTS)
    row, column : array, shape (m,), int64
        Lattice indices of the source cells.
    source_size, cell_size : float, m
        Cell size of source and window.
    row0, column0 : int
        First row and column of the window.
    window : array, shape (n_rows, n_columns, N_MOMENTS)
        Added to in place; cells outside are left out.
    """
    n_rows, n_columns = window.shape[0], window.shape[1]
    for k in range(moments.shape[0]):
        m = moments[k]
        x0 = (column[k] + 0.5) * source_size
        y0 = (row[k] + 0.5) * source_size
        b = int(math.floor((x0 + m[2] / m[1]) / cell_size))
        a = int(math.floor((y0 + m[3] / m[1]) / cell_size))
        if a < row0 or b < column0 or a >= row0 + n_rows or b >= column0 + n_columns:
            continue
        u = x0 - (b + 0.5) * cell_size
        v = y0 - (a + 0.5) * cell_size
        _add_recentred(m, u, v, window[a - row0, b - column0])


@njit(cache=True, error_model="numpy")
def gather_moments(
    moments: FloatArray,
    offset_east: FloatArray,
    offset_north: FloatArray,
    target: IntArray,
    gathered: FloatArray,
) -> None:
    """
    Add each cell, whole, to a target cell, re-centred.

    Parameters
    ----------
    moments : array, shape (m, N_MOMENTS)
    offset_east, offset_north : array, shape (m,), m
        Centre of each cell less the centre of its target.
    target : array, shape (m,), int64
    gathered : array, shape (t, N_MOMENTS)
        Added to in place, in the order given.
    """
    for k in range(moments.shape[0]):
        _add_recentred(moments[k], offset_east[k], offset_north[k], gathered[target[k]])
