"""The observations an alignment rests on: spread evenly, independent of their order, grouped by place."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.pointcloud import PointCloud
    from changedetect.typing import FloatArray, IntArray

__all__ = ["Sample", "Squares", "thin"]

#: The bounding box is not cut into more squares than this, however few of them are occupied.
_MAX_BOX = 2**21
#: Observations in a small square, on average: enough to see a change that is smaller than the noise of one.
_IN_SQUARE = 12
_MAX_SQUARES = 2**14
#: And in the smallest, over which slopes are smoothed.
_IN_FINE = 2
#: Blocks for the correlation of errors: enough to estimate it from, few enough for matrices of their covariance.
_N_BLOCKS = 180
_IN_BLOCK = 4
#: So many observations of a cell, on average, are picked at random before an even choice is made among them.
_OVERSAMPLING = 8.0
#: Coordinates enter the pseudo-random key to this precision, m.
_KEY_QUANTUM = 1e-4


@dataclass(frozen=True)
class Squares:
    """
    Occupied squares of a lattice and which observation lies in which.

    Attributes
    ----------
    side : float, m
    member : array, shape (n,), int64
        Position of each observation's square among the occupied ones.
    row, column : array, shape (m,), int64
        Place of each occupied square, counted from the south-west corner of the bounding box.
    """

    side: float
    member: IntArray
    row: IntArray
    column: IntArray

    @classmethod
    def holding(cls, easting: FloatArray, northing: FloatArray, n_target: int) -> Self:
        """
        Lay squares so that about `n_target` of them, or fewer, are occupied.

        Parameters
        ----------
        easting, northing : array, shape (n,), m
            At least one observation.
        n_target : int
        """
        width = max(float(np.ptp(easting)), 1e-3)
        height = max(float(np.ptp(northing)), 1e-3)
        side = max(math.sqrt(width * height / n_target), max(width, height) / n_target)
        while True:
            squares = cls._of_side(easting, northing, side)
            finer = side * math.sqrt(len(squares) / n_target)
            if len(squares) >= 0.6 * n_target or width * height > _MAX_BOX * finer**2:
                return squares
            side = finer

    @classmethod
    def _of_side(cls, easting: FloatArray, northing: FloatArray, side: float) -> Self:
        row = np.floor((northing - northing.min()) / side).astype(np.int64)
        column = np.floor((easting - easting.min()) / side).astype(np.int64)
        width = int(column.max()) + 1
        occupied, member = np.unique(row * width + column, return_inverse=True)
        return cls(side, member.reshape(-1), occupied // width, occupied % width)

    def __len__(self) -> int:
        return int(self.row.size)

    def total(self, values: FloatArray) -> FloatArray:
        """Sum of the observations' values in each occupied square; shape (n,) to (m,), or (n, k) to (m, k)."""
        if values.ndim == 1:
            total: FloatArray = np.bincount(self.member, weights=values, minlength=len(self)).astype(np.float64)
            return total
        return np.stack([self.total(column) for column in values.T], axis=1)

    def raster(self, values: FloatArray) -> FloatArray:
        """Values of the occupied squares, shape (m,), on the lattice of the bounding box, 0 elsewhere."""
        laid_out = np.zeros((int(self.row.max()) + 1, int(self.column.max()) + 1))
        laid_out[self.row, self.column] = values
        return laid_out

    def on_points(self, raster: FloatArray) -> FloatArray:
        """Value of a raster at each observation's square, shape (n,)."""
        values: FloatArray = raster[self.row, self.column][self.member]
        return values


@dataclass(frozen=True)
class Sample:
    """
    Observations of an epoch, grouped by place.

    Attributes
    ----------
    cloud : PointCloud
        In the frame of the epoch.
    area : array, shape (n,), int64
        Number of the stable area each lies in; 0 throughout where none were given.
    precision : array, shape (n,)
        1 / variance of an observation about the reference, relative to the typical one.
    centre : (easting, northing, elevation), m
        Centroid.
    radius : float, m
        Root mean square horizontal distance from it.
    fine, squares : Squares
        Slopes are smoothed over the former; changed ground is told from unchanged by the latter, which are larger.
    blocks : Squares
        Large: the correlation of errors is judged by them.
    """

    cloud: PointCloud
    area: IntArray
    precision: FloatArray
    centre: tuple[float, float, float]
    radius: float
    fine: Squares
    squares: Squares
    blocks: Squares

    @classmethod
    def of(cls, cloud: PointCloud, area: IntArray) -> Self:
        """Group observations; at least one."""
        easting, northing = cloud.coordinates
        centre = (float(easting.mean()), float(northing.mean()), float(cloud.elevation.mean()))
        radius = float(np.sqrt(np.mean((easting - centre[0]) ** 2 + (northing - centre[1]) ** 2)))
        n = len(cloud)
        return cls(
            cloud,
            area,
            np.ones(n),
            centre,
            max(radius, 1e-3),
            Squares.holding(easting, northing, max(n // _IN_FINE, 1)),
            Squares.holding(easting, northing, min(max(n // _IN_SQUARE, 1), _MAX_SQUARES)),
            Squares.holding(easting, northing, min(max(n // _IN_BLOCK, 1), _N_BLOCKS)),
        )

    def __len__(self) -> int:
        return len(self.cloud)

    def weighted_by(self, variance: FloatArray) -> Self:
        """Give each observation a precision from its variance, m2, shape (n,); extremes are moderated."""
        return replace(self, precision=np.clip(float(np.median(variance)) / variance, 1.0 / 64.0, 64.0))


def thin(cloud: PointCloud, n_target: int) -> IntArray:
    """
    Choose at most about `n_target` observations, spread evenly over the ground they cover.

    Parameters
    ----------
    cloud : PointCloud
        At least one observation.
    n_target : int

    Returns
    -------
    chosen : array, int64
        Positions, ordered by place: neither the choice nor sums over it depend on the order of the observations.
    """
    if len(cloud) <= n_target:
        return np.lexsort((cloud.elevation, cloud.easting, cloud.northing)).astype(np.int64)
    key = _pseudo_random_key(cloud.easting, cloud.northing, cloud.elevation)
    # about so many from each cell of a lattice first, because sorting all would take the longest
    cell = _cells(cloud.easting, cloud.northing, n_target)
    share = _OVERSAMPLING / np.bincount(cell)[cell]
    picked = np.flatnonzero(key <= np.minimum(share, 1.0) * float(2**64 - 2**11))
    squares = Squares.holding(cloud.easting[picked], cloud.northing[picked], n_target)
    order = np.lexsort((key[picked], squares.member))
    first = np.searchsorted(squares.member[order], np.arange(len(squares)))
    chosen: IntArray = picked[order[first]]
    return chosen


def _cells(easting: FloatArray, northing: FloatArray, n_cells: int) -> IntArray:
    """Number, row by row, of the cell of each observation; about `n_cells` cells over the bounding box."""
    west, south = float(easting.min()), float(northing.min())
    width, height = max(float(easting.max()) - west, 1e-3), max(float(northing.max()) - south, 1e-3)
    side = max(math.sqrt(width * height / n_cells), max(width, height) / n_cells)
    n_columns = math.floor(width / side) + 1
    row, column = ((northing - south) / side).astype(np.int64), ((easting - west) / side).astype(np.int64)
    cells: IntArray = row * n_columns + column
    return cells


def _pseudo_random_key(*columns: FloatArray) -> NDArray[np.uint64]:
    """
    Hash coordinates by the mixing of splitmix64.

    References
    ----------
    .. [1] Steele, Lea & Flood (2014), Fast splittable pseudorandom number generators, doi:10.1145/2714064.2660195
    """
    mixed = np.zeros(columns[0].shape, dtype=np.uint64)
    for column in columns:
        mixed ^= np.rint(column / _KEY_QUANTUM).astype(np.int64).view(np.uint64)
        mixed ^= mixed >> np.uint64(30)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(27)
        mixed *= np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return mixed
