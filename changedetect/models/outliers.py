"""
Gross errors among the observations of one epoch: mistriangulated points, birds, multipath.

An observation of the ground has others near it at about its height, however steep or broken the ground is: along a
cliff, a crown, a wall. A gross error stands alone. So an observation is judged by its vertical distance to the third
nearest in height among those around it, against what that distance commonly is in the neighbourhood. Nothing is
compared with earlier epochs, where real change would look like gross errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.kernels.isolation import nearest_heights, square_medians
from changedetect.kernels.moments import count_sort
from changedetect.models.cells import Evidence
from changedetect.models.pyramid import Lattice, build_level

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, Coordinates, FloatArray, IntArray

__all__ = ["gross_errors"]

#: Observations in a square; with the eight around it some 27 are compared.
_PER_SQUARE = 3.0
#: An observation needs this many others at about its height.
_N_NEIGHBOURS = 3
#: Squares along one edge of the neighbourhood over which distances are compared: about a hundred observations.
_BLOCK = 6
#: The distance exceeded by a quarter of a neighbourhood stands for what is common there; 5 % of gross errors and the
#: few that are near them do not sway it.
_COMMON = 0.75
#: Observations without which a neighbourhood says nothing; the survey as a whole speaks instead.
_FEW = 8
#: Deviation from the median of its square, in median deviations, below which an observation is not looked at.
_FAR = 4.0
#: Common distance to the third nearest in height, in median deviations of normally distributed noise.
_DENSE_SHARE = 0.5
#: Kernel, in mean spacings, of the plain surface that takes the relief out before the second look.
_SURFACE_KERNEL = 2.3


@dataclass(frozen=True)
class _Squares:
    """Observations sorted into the squares of a lattice."""

    side: float
    row: IntArray
    column: IntArray
    shape: tuple[int, int]
    order: IntArray
    start: IntArray

    @classmethod
    def of(cls, row: IntArray, column: IntArray, side: float) -> _Squares:
        shape = int(row.max()) + 1, int(column.max()) + 1
        order, start = count_sort(row * shape[1] + column, shape[0] * shape[1])
        return cls(side, row, column, shape, order, start)

    def wider(self, factor: int) -> _Squares:
        return self.of(self.row // factor, self.column // factor, factor * self.side)

    def medians(self, values: FloatArray) -> FloatArray:
        """Median of every square, shape `shape`; NaN for an empty one."""
        found = np.empty(self.shape)
        square_medians(values, self.order, self.start, found.reshape(-1))
        return found


def _gentlest(ahead: FloatArray, behind: FloatArray) -> FloatArray:
    """Of two slopes of the same sign the gentler, else 0: at an edge that of the flatter side."""
    same = ahead * behind > 0.0
    smaller = np.where(np.abs(ahead) < np.abs(behind), ahead, behind)
    return np.where(same, smaller, 0.0)


def _slopes(squares: _Squares, wide: _Squares, medians: FloatArray) -> FloatArray:
    """Robust slope of every square, from the medians of squares twice as large; shape (2, n_rows, n_columns)."""
    padded = np.pad(medians, 1, constant_values=np.nan)
    inner = slice(1, -1)
    east = _gentlest(padded[inner, 2:] - medians, medians - padded[inner, :-2]) / wide.side
    north = _gentlest(padded[2:, inner] - medians, medians - padded[:-2, inner]) / wide.side
    row, column = np.arange(squares.shape[0]) // 2, np.arange(squares.shape[1]) // 2
    return np.ascontiguousarray(np.stack([east, north])[:, row][:, :, column])


def _common_distance(squares: _Squares, distance: FloatArray) -> FloatArray:
    """Quantile of the distances in the neighbourhood of every observation; shape (n,)."""
    n_columns = squares.shape[1] // _BLOCK + 1
    block = (squares.row // _BLOCK) * n_columns + squares.column // _BLOCK
    order = np.lexsort((distance, block))
    count = np.bincount(block)
    first = np.cumsum(count) - count
    at = first + np.minimum((_COMMON * count).astype(np.int64), np.maximum(count - 1, 0))
    common = distance[order][np.minimum(at, distance.size - 1)]
    common[(count < _FEW) | ~np.isfinite(common)] = np.nan
    overall = float(np.quantile(distance[np.isfinite(distance)], _COMMON))
    found: FloatArray = np.where(np.isfinite(common), common, overall)[block]
    return found


def _isolation(squares: _Squares, wide: _Squares, coordinates: Coordinates, elevation: FloatArray) -> FloatArray:
    """Vertical distance of every observation to its third nearest in height, shape (n,); infinite if there is none."""
    slopes = _slopes(squares, wide, wide.medians(elevation))
    distance = np.empty(elevation.size)
    asked = np.ones(elevation.size, np.bool_)
    nearest_heights(*coordinates, elevation, slopes, squares.order, squares.start, asked, _N_NEIGHBOURS, distance)
    return distance


def _stands_alone(squares: _Squares, distance: FloatArray, limit: float) -> BoolArray:
    # with too few others around, nothing can be said
    judged = np.isfinite(distance)
    if not judged.any():
        return judged
    alone: BoolArray = judged & (distance > limit * np.maximum(_common_distance(squares, distance), 1e-9))
    return alone


def _stands_far_off(squares: _Squares, coordinates: Coordinates, elevation: FloatArray, limit: float) -> BoolArray:
    """
    Do the same for dense observations, of which few have to be looked at.

    Where squares are small, relief inside them is small against noise: the common distance of a neighbourhood then
    follows from the median deviation from the squares' medians, and only what deviates far is looked at.
    """
    wide = squares.wider(2)
    medians = wide.medians(elevation)
    slopes = _slopes(squares, wide, medians)
    middle = [wide.medians(c) for c in coordinates]
    at = wide.row, wide.column
    offset = [c - m[at] for c, m in zip(coordinates, middle, strict=True)]
    slope = slopes[:, squares.row, squares.column]
    deviation = np.abs(elevation - medians[at] - slope[0] * offset[0] - slope[1] * offset[1])
    block = squares.wider(_BLOCK)
    common = block.medians(deviation)[block.row, block.column]
    asked = deviation > _FAR * common
    distance = np.zeros(elevation.size)
    nearest_heights(*coordinates, elevation, slopes, squares.order, squares.start, asked, _N_NEIGHBOURS, distance)
    alone: BoolArray = asked & np.isfinite(distance) & (distance > _DENSE_SHARE * limit * np.maximum(common, 1e-9))
    return alone


def _plain_surface(coordinates: Coordinates, elevation: FloatArray, kept: BoolArray, kernel: float) -> FloatArray:
    """Surface of one kernel size through the observations kept, at all of them; 0 where there are none nearby."""
    evidence = Evidence(2.0 ** math.floor(math.log2(0.5 * kernel)), is_weighted=False)
    evidence.add((coordinates[0][kept], coordinates[1][kept]), elevation[kept], None)
    cells, height = evidence.cells(0.0).centred()
    level, _ = build_level(cells, Lattice.covering(cells.region, kernel, 0.8 * kernel), 0.0, None)
    surface = np.zeros((elevation.size, 3))
    level.add_to(*coordinates, surface)
    return height + surface[:, 0]


def gross_errors(
    coordinates: Coordinates, elevation: FloatArray, density: float, limit: float, *, is_dense: bool
) -> BoolArray:
    """
    Observations that no others support.

    Parameters
    ----------
    coordinates : (easting, northing), each shape (n,), m
    elevation : array, shape (n,), m
    density : float, 1/m2
        Observations per m2 where there are observations.
    limit : float
        Distance to the third nearest in height, in common distances, beyond which an observation is one.
    is_dense : bool
        Whether ground that bends within a few spacings is of no concern; then one quick look will do.

    Returns
    -------
    alone : array, shape (n,), bool

    Notes
    -----
    Two looks: at heights less a robust slope, then also at what is left over a plain surface through the observations
    that passed, so that curved ground does not hide what stands a little off it. Support by either is support. Follows
    from the set of observations alone, not from their order.
    """
    alone = np.zeros(elevation.size, np.bool_)
    if elevation.size <= _FEW:
        return alone
    side = math.sqrt(_PER_SQUARE / density)
    easting, northing = coordinates
    row = np.floor(northing / side).astype(np.int64)
    column = np.floor(easting / side).astype(np.int64)
    row -= row.min()
    column -= column.min()
    if (row.max() + 1.0) * (column.max() + 1.0) > 64.0 * elevation.size + 1e6:
        # a few clusters far from each other: no lattice of squares can hold them at once
        return alone
    squares = _Squares.of(row, column, side)
    if is_dense:
        return _stands_far_off(squares, coordinates, elevation, limit)
    wide = squares.wider(2)
    heights = _isolation(squares, wide, coordinates, elevation)
    kept = ~_stands_alone(squares, heights, limit)
    if np.count_nonzero(kept) <= _FEW:
        return alone
    surface = _plain_surface(coordinates, elevation, kept, _SURFACE_KERNEL / math.sqrt(density))
    left_over = _isolation(squares, wide, coordinates, elevation - surface)
    # beside an edge the plain surface misses all observations, each by another amount: there the heights speak
    return _stands_alone(squares, np.minimum(heights, left_over), limit)
