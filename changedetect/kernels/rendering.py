"""
Where rays of a camera meet a height field, and what they see there.

The height field is bilinear between its nodes: what is rendered is exactly what the arrays say. Grids are arrays
[north, east] whose row 0 lies in the south, which spares a sign in the inner loop.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from changedetect.typing import FloatArray

__all__ = ["bilinear", "cast_rays", "look"]

#: Halvings of the last step of a ray, which leave a thousandth of it.
_HALVINGS = 10


@njit(cache=True, error_model="numpy", inline="always")
def bilinear(grid: FloatArray, row: float, column: float) -> float:
    """
    Value between four nodes; beyond the rim that of the rim.

    Parameters
    ----------
    grid : array, shape (n_rows, n_cols), at least 2 x 2
    row, column : float, nodes
    """
    row = min(max(row, 0.0), grid.shape[0] - 1.0)
    column = min(max(column, 0.0), grid.shape[1] - 1.0)
    i, j = min(int(row), grid.shape[0] - 2), min(int(column), grid.shape[1] - 2)
    u, v = row - i, column - j
    south = (1.0 - v) * grid[i, j] + v * grid[i, j + 1]
    north = (1.0 - v) * grid[i + 1, j] + v * grid[i + 1, j + 1]
    return (1.0 - u) * south + u * north


@njit(cache=True, error_model="numpy", parallel=True)
def cast_rays(
    direction: FloatArray, position: FloatArray, height: FloatArray, west: float, south: float, cell: float, top: float
) -> FloatArray:
    """
    First point of a height field on each ray.

    Parameters
    ----------
    direction : array, shape (n, 3), ENU
        Of any length, pointing down.
    position : array, shape (3,), ENU, m
        Where all rays begin, above `top`.
    height : array, shape (n_rows, n_cols), m
        Nodes from the south-west; beyond the rim the ground goes on level.
    west, south : float, m
        Of node (0, 0).
    cell : float, m
    top : float, m
        Not below any node.

    Returns
    -------
    place : array, shape (n, 3), ENU, m

    Notes
    -----
    A ray goes down from `top` in steps of half a cell, across or down, whichever it reaches first, until it is below
    the ground; the step in which that happened is halved. Edges thinner than half a cell are missed.
    """
    n = direction.shape[0]
    place = np.empty((n, 3))
    for k in prange(n):
        e, u, d = direction[k, 0], direction[k, 1], -direction[k, 2]
        t = (position[2] - top) / d
        step = 0.5 * cell / max(math.hypot(e, u), d)
        above = t
        while True:
            z = position[2] - t * d
            row = (position[1] + t * u - south) / cell
            column = (position[0] + t * e - west) / cell
            if z <= bilinear(height, row, column):
                break
            above = t
            t += step
        below = t
        for _ in range(_HALVINGS):
            t = 0.5 * (above + below)
            row = (position[1] + t * u - south) / cell
            column = (position[0] + t * e - west) / cell
            if position[2] - t * d <= bilinear(height, row, column):
                below = t
            else:
                above = t
        t = 0.5 * (above + below)
        place[k, 0] = position[0] + t * e
        place[k, 1] = position[1] + t * u
        place[k, 2] = position[2] - t * d
    return place


@njit(cache=True, error_model="numpy", parallel=True)
def look(place: FloatArray, grid: FloatArray, west: float, south: float, cell: float) -> FloatArray:
    """
    Values of a grid at places.

    Parameters
    ----------
    place : array, shape (n, 3) or (n, 2), ENU, m
    grid : array, shape (n_rows, n_cols)
        Nodes from the south-west.
    west, south, cell : float, m

    Returns
    -------
    value : array, shape (n,)
    """
    value = np.empty(place.shape[0])
    for k in prange(place.shape[0]):
        value[k] = bilinear(grid, (place[k, 1] - south) / cell, (place[k, 0] - west) / cell)
    return value
