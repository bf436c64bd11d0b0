"""Places of ground cells in a photo, and how they move as the cell rises."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from changedetect.kernels.projection import project
from changedetect.typing import FloatArray

__all__ = ["cell_maps"]


@njit(cache=True, nogil=True, error_model="numpy")
def cell_maps(
    east: FloatArray,
    north: FloatArray,
    height: FloatArray,
    rotation: FloatArray,
    position: FloatArray,
    intrinsics: FloatArray,
    width: int,
    rows_of_photo: int,
    step: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """
    Project a grid of ground cells into one photo.

    Parameters
    ----------
    east, north : array, shape (n_cols,) and (n_rows,), m
    height : array, shape (n_rows, n_cols), m
        NaN where unknown.
    rotation, position, intrinsics
        Of the photo, as in `projection.project`.
    width, rows_of_photo : int, pixels
        Size of the photo.
    step : float, m
        Height difference for the derivative.

    Returns
    -------
    place : array, shape (2, n_rows, n_cols), float32, pixels
        Column and row; -1e6 where the photo does not see the cell.
    rise : array, shape (2, n_rows, n_cols), float32, pixels / m
        Derivative of the place by the height of the cell.
    """
    n_rows, n_cols = height.shape
    place = np.full((2, n_rows, n_cols), np.float32(-1e6), np.float32)
    rise = np.zeros((2, n_rows, n_cols), np.float32)
    point = np.empty(3)
    for i in range(n_rows):
        for j in range(n_cols):
            if not np.isfinite(height[i, j]):
                continue
            point[0], point[1], point[2] = east[j], north[i], height[i, j]
            column, row, depth = project(point, rotation, position, intrinsics)
            if not (depth > 0 and 1 <= column <= width - 2 and 1 <= row <= rows_of_photo - 2):
                continue
            point[2] += step
            higher, lower, _ = project(point, rotation, position, intrinsics)
            place[0, i, j], place[1, i, j] = column, row
            rise[0, i, j], rise[1, i, j] = (higher - column) / step, (lower - row) / step
    return place, rise
