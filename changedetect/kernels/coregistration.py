"""
Kernel of co-registration: a raster between its nodes.

References
----------
.. [1] R. Keys (1981), Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29, 1153-1160,
   doi:10.1109/TASSP.1981.1163711.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["interpolate_raster"]


@njit(cache=True, error_model="numpy")
def _cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Weights of the four nodes -1, 0, 1, 2 at 0 <= t <= 1; Keys' kernel with a = -1/2 [1]_."""
    t2 = t * t
    t3 = t2 * t
    return (
        -0.5 * t3 + t2 - 0.5 * t,
        1.5 * t3 - 2.5 * t2 + 1.0,
        -1.5 * t3 + 2.0 * t2 + 0.5 * t,
        0.5 * t3 - 0.5 * t2,
    )


@njit(cache=True, parallel=True, error_model="numpy")
def interpolate_raster(raster: FloatArray, row: FloatArray, column: FloatArray, interpolated: FloatArray) -> None:
    """
    Value of a raster between its nodes.

    Parameters
    ----------
    raster : array, shape (n_rows, n_cols)
        Values at the nodes; NaN marks no data.
    row, column : array, shape (n,)
        Positions in units of nodes: node [i, j] is at (i, j).
    interpolated : array, shape (n,)
        Filled in place: bicubic [1]_ where all sixteen nodes around have data, bilinear where only the inner four
        have, NaN elsewhere.
    """
    n_rows, n_cols = raster.shape
    for p in prange(row.size):
        interpolated[p] = np.nan
        if not (0.0 <= row[p] <= n_rows - 1.0 and 0.0 <= column[p] <= n_cols - 1.0):
            continue
        i = min(int(math.floor(row[p])), n_rows - 2)
        j = min(int(math.floor(column[p])), n_cols - 2)
        if i < 0 or j < 0:
            continue
        s, t = row[p] - i, column[p] - j
        if i >= 1 and j >= 1 and i + 2 < n_rows and j + 2 < n_cols:
            row_weights, column_weights = _cubic_weights(s), _cubic_weights(t)
            value = 0.0
            for a in range(4):
                line = 0.0
                for b in range(4):
                    line += column_weights[b] * raster[i - 1 + a, j - 1 + b]
                value += row_weights[a] * line
            if not np.isnan(value):
                interpolated[p] = value
                continue
        z00, z01 = float(raster[i, j]), float(raster[i, j + 1])
        z10, z11 = float(raster[i + 1, j]), float(raster[i + 1, j + 1])
        interpolated[p] = (1.0 - s) * ((1.0 - t) * z00 + t * z01) + s * ((1.0 - t) * z10 + t * z11)
