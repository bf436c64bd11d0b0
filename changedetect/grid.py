"""A north-up raster's place in the world, as one value."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from changedetect.typing import Coordinates, FloatArray, Region

__all__ = ["Grid"]

#: Coordinates within this part of a cell from a multiple of the resolution are taken to be on it.
_SNAP_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Grid:
    """
    Square cells, north up, row 0 in the north.

    Attributes
    ----------
    n_rows, n_cols : int
        At least 1 each.
    west, north : float, m
        Outer corner of the first cell, in `crs`.
    resolution : float, m
        Side of a cell.
    crs : str
        As the user gave it, like "EPSG:32632+5773", or WKT.

    Raises
    ------
    ValueError
        A count is below 1, or a length is not finite, or the resolution is not positive.

    Notes
    -----
    Cell centres are computed from whole cell numbers, so that a cell has bit for bit the same centre in the grid and
    in any block, window or padded version of it.

    Examples
    --------
    >>> grid = Grid.from_region((500000.2, 500002.9, 4649998.5, 4650000.0), 0.5, "EPSG:32632+5773")
    >>> grid.shape, grid.region
    ((3, 6), (500000.0, 500003.0, 4649998.5, 4650000.0))
    >>> grid.northing
    array([4649999.75, 4649999.25, 4649998.75])
    """

    n_rows: int
    n_cols: int
    west: float
    north: float
    resolution: float
    crs: str

    def __post_init__(self) -> None:
        if self.n_rows < 1 or self.n_cols < 1:
            msg = f"A grid needs at least one row and one column; got {self.n_rows} x {self.n_cols}."
            raise ValueError(msg)
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            msg = f"The resolution of a grid must be positive and finite, in metres; got {self.resolution!r}."
            raise ValueError(msg)
        if not (math.isfinite(self.west) and math.isfinite(self.north)):
            msg = f"The corner of a grid must be finite; got west {self.west!r}, north {self.north!r}."
            raise ValueError(msg)

    @classmethod
    def from_region(cls, region: Region, resolution: float, crs: str) -> Self:
        """
        Smallest grid that covers `region` and whose cell borders are multiples of the resolution.

        Parameters
        ----------
        region : (west, east, south, north), m
            May be a single point or line: the grid then has one column or row.
        resolution : float, m
        crs : str

        Raises
        ------
        ValueError
            The region is reversed or not finite, or the resolution is not positive.
        """
        west, east, south, north = region
        if not (all(map(math.isfinite, region)) and west <= east and south <= north):
            msg = f"A region is (west, east, south, north) with west <= east and south <= north; got {region!r}."
            raise ValueError(msg)
        if not (math.isfinite(resolution) and resolution > 0):
            msg = f"The resolution of a grid must be positive and finite, in metres; got {resolution!r}."
            raise ValueError(msg)
        first_col = math.floor(west / resolution + _SNAP_TOLERANCE)
        end_col = max(math.ceil(east / resolution - _SNAP_TOLERANCE), first_col + 1)
        first_row = math.floor(south / resolution + _SNAP_TOLERANCE)
        end_row = max(math.ceil(north / resolution - _SNAP_TOLERANCE), first_row + 1)
        return cls(
            n_rows=end_row - first_row,
            n_cols=end_col - first_col,
            west=first_col * resolution,
            north=end_row * resolution,
            resolution=float(resolution),
            crs=crs,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(n_rows, n_cols)."""
        return self.n_rows, self.n_cols

    @property
    def east(self) -> float:
        """Eastern border, m."""
        return _lattice(self.west, self.n_cols, self.resolution)

    @property
    def south(self) -> float:
        """Southern border, m."""
        return _lattice(self.north, -self.n_rows, self.resolution)

    @property
    def region(self) -> Region:
        """(west, east, south, north) of the outer borders, m."""
        return self.west, self.east, self.south, self.north

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Affine coefficients (a, b, c, d, e, f): easting = a col + b row + c, northing = d col + e row + f."""
        return self.resolution, 0.0, self.west, 0.0, -self.resolution, self.north

    @property
    def easting(self) -> FloatArray:
        """Cell centres west to east, shape (n_cols,), m."""
        return _centres(self.west, np.arange(0.5, self.n_cols), self.resolution)

    @property
    def northing(self) -> FloatArray:
        """Cell centres north to south, shape (n_rows,), m, descending."""
        return _centres(self.north, -np.arange(0.5, self.n_rows), self.resolution)

    def coordinates(self) -> Coordinates:
        """Easting and northing of every cell centre, row by row, each of shape (n_rows * n_cols,), m."""
        return np.tile(self.easting, self.n_rows), np.repeat(self.northing, self.n_cols)

    def window(self, rows: slice, cols: slice) -> Self:
        """
        Grid of the cells [rows, cols]; slices of step 1 that select at least one cell.

        Raises
        ------
        ValueError
            The slices select no cell.
        """
        first_row, end_row, _ = rows.indices(self.n_rows)
        first_col, end_col, _ = cols.indices(self.n_cols)
        return type(self)(
            n_rows=end_row - first_row,
            n_cols=end_col - first_col,
            west=_lattice(self.west, first_col, self.resolution),
            north=_lattice(self.north, -first_row, self.resolution),
            resolution=self.resolution,
            crs=self.crs,
        )

    def blocks(self, size: int) -> Iterator[tuple[slice, slice, Self]]:
        """
        Cut into blocks of at most `size` x `size` cells, row by row, without overlap.

        Yields
        ------
        rows, cols : slice
            Where the block lies: `array[rows, cols]`.
        block : Grid
        """
        if size < 1:
            msg = f"A block needs at least one cell; got size {size}."
            raise ValueError(msg)
        for first_row in range(0, self.n_rows, size):
            rows = slice(first_row, min(first_row + size, self.n_rows))
            for first_col in range(0, self.n_cols, size):
                cols = slice(first_col, min(first_col + size, self.n_cols))
                yield rows, cols, self.window(rows, cols)

    def pad(self, n: int) -> Self:
        """Grow by `n` cells on every side (shrink where negative)."""
        return type(self)(
            n_rows=self.n_rows + 2 * n,
            n_cols=self.n_cols + 2 * n,
            west=_lattice(self.west, -n, self.resolution),
            north=_lattice(self.north, n, self.resolution),
            resolution=self.resolution,
            crs=self.crs,
        )

    def intersection(self, region: Region) -> Self | None:
        """
        Grid of this grid's cells that share area with `region` (west, east, south, north); None where none does.

        Raises
        ------
        ValueError
            The region is reversed or not finite.
        """
        west, east, south, north = region
        if not (all(map(math.isfinite, region)) and west <= east and south <= north):
            msg = f"A region is (west, east, south, north) with west <= east and south <= north; got {region!r}."
            raise ValueError(msg)
        first_col = max(0, math.floor((west - self.west) / self.resolution + _SNAP_TOLERANCE))
        end_col = min(self.n_cols, math.ceil((east - self.west) / self.resolution - _SNAP_TOLERANCE))
        first_row = max(0, math.floor((self.north - north) / self.resolution + _SNAP_TOLERANCE))
        end_row = min(self.n_rows, math.ceil((self.north - south) / self.resolution - _SNAP_TOLERANCE))
        if first_col >= end_col or first_row >= end_row:
            return None
        return self.window(slice(first_row, end_row), slice(first_col, end_col))


def _centres(corner: float, cells: FloatArray, resolution: float) -> FloatArray:
    """
    Coordinates `cells` (fractional cell numbers) away from `corner`, independent of which corner was chosen.

    The corner is a whole number of cells from zero plus an offset below one cell. The offset is rounded to 0.1 um,
    far above the rounding of coordinates (1 nm at UTM northings), so that it is the same for all windows of a grid.
    """
    whole = math.floor(corner / resolution + _SNAP_TOLERANCE)
    offset = round(corner - whole * resolution, 7)
    return np.asarray((whole + cells) * resolution + offset, dtype=np.float64)


def _lattice(corner: float, n: int, resolution: float) -> float:
    """Border `n` cells away from `corner`, by the rule of `_centres`; `corner` itself for n = 0."""
    if n == 0:
        return corner
    return float(_centres(corner, np.array([float(n)]), resolution)[0])
