"""Observations grouped by the squares of a lattice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, IntArray

__all__ = ["Squares"]

#: The bounding box is not cut into more squares than this, however few of them are occupied.
_MAX_SQUARES = 2**21


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
        Lay squares so that about `n_target` of them are occupied.

        Parameters
        ----------
        easting, northing : array, shape (n,), m
            At least one observation.
        n_target : int

        Returns
        -------
        squares : Squares
            At most about `n_target`; fewer where the observations do not fill so many.
        """
        width = max(float(np.ptp(easting)), 1e-3)
        height = max(float(np.ptp(northing)), 1e-3)
        side = max(math.sqrt(width * height / n_target), max(width, height) / n_target)
        while True:
            squares = cls._of_side(easting, northing, side)
            finer = side * math.sqrt(len(squares) / n_target)
            if len(squares) >= 0.6 * n_target or width * height > _MAX_SQUARES * finer**2:
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
            return np.bincount(self.member, weights=values, minlength=len(self))
        return np.stack([self.total(column) for column in values.T], axis=1)

    def mean(self, values: FloatArray, weight: FloatArray) -> FloatArray:
        """Weighted mean in each occupied square, NaN where the weights sum to zero; shape (n,) to (m,)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            mean: FloatArray = self.total(values * weight) / self.total(weight)
        return mean

    def raster(self, values: FloatArray) -> FloatArray:
        """Values of the occupied squares, shape (m,), on the lattice of the bounding box, 0 elsewhere."""
        laid_out = np.zeros((int(self.row.max()) + 1, int(self.column.max()) + 1))
        laid_out[self.row, self.column] = values
        return laid_out

    def on_points(self, raster: FloatArray) -> FloatArray:
        """Value of a raster at each observation's square, shape (n,)."""
        values: FloatArray = raster[self.row, self.column][self.member]
        return values
