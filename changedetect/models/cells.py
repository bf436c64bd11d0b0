"""Sparse lattices of micro-cell moments, and the exact evidence of one survey epoch."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from changedetect.kernels import moments as kernel

if TYPE_CHECKING:
    from typing import Self

    from changedetect.typing import BoolArray, Coordinates, FloatArray, IntArray, Region

__all__ = ["TILE_CELLS", "Cells", "Evidence", "merge_cells"]

#: Cells along one edge of a tile, the unit in which evidence is accumulated and stored.
TILE_CELLS = 256
#: Cells of a dense window for each cell deposited in it, at most.
_DENSE_WINDOW = 2


@dataclass(frozen=True)
class Cells:
    """
    Occupied cells of a lattice, ordered by row, then column.

    Attributes
    ----------
    cell_size : float, m
        A power of two, so that lattices nest.
    row, column : array, shape (m,), int64
        Lattice indices, counted northwards and eastwards from the origin of the CRS.
    moments : array, shape (m, N_MOMENTS), float64
        See `changedetect.kernels.moments`.
    """

    cell_size: float
    row: IntArray
    column: IntArray
    moments: FloatArray

    def __len__(self) -> int:
        return int(self.row.size)

    @property
    def centres(self) -> Coordinates:
        """Easting and northing of the cell centres, m."""
        easting = np.asarray((self.column + 0.5) * self.cell_size, np.float64)
        northing = np.asarray((self.row + 0.5) * self.cell_size, np.float64)
        return easting, northing

    @property
    def region(self) -> Region:
        """(west, east, south, north) of the occupied cells, m."""
        c = self.cell_size
        return (
            float(self.column.min()) * c,
            float(self.column.max() + 1) * c,
            float(self.row.min()) * c,
            float(self.row.max() + 1) * c,
        )

    @property
    def places(self) -> Coordinates:
        """Easting and northing of the mean position of each cell's observations, m."""
        easting, northing = self.centres
        mean_east: FloatArray = self.moments[:, 2] / self.moments[:, 1]
        mean_north: FloatArray = self.moments[:, 3] / self.moments[:, 1]
        return easting + mean_east, northing + mean_north

    def with_surface_removed(self, surface: FloatArray) -> Self:
        """
        Moments of what is left over a surface.

        Parameters
        ----------
        surface : array, shape (m, >= 3)
            Value, slope east and slope north at `places`: within a cell the surface counts as its tangent there,
            which is exact for a single observation.

        Returns
        -------
        cells : Cells
        """
        east, north = np.ascontiguousarray(surface[:, 1]), np.ascontiguousarray(surface[:, 2])
        mean = self.moments[:, 2:4] / self.moments[:, 1:2]
        at_centre = surface[:, 0] - east * mean[:, 0] - north * mean[:, 1]
        return replace(self, moments=kernel.shift_moments(self.moments, at_centre, east, north))

    def centred(self) -> tuple[Self, float]:
        """
        Moments about a mean elevation, and that elevation.

        Squares of elevations far above zero would cost the residuals their last digits.
        """
        height = float(np.round(np.median(self.moments[:, 7] / self.moments[:, 1])))
        level = np.zeros((len(self), 3))
        level[:, 0] = height
        return self.with_surface_removed(level), height

    def with_weights_scaled(self, factor: FloatArray | float) -> Self:
        """Weights, and all they enter, times a factor per cell; counts and noise variances stay."""
        scaled = self.moments * np.reshape(factor, (-1, 1))
        scaled[:, (0, 12)] = self.moments[:, (0, 12)]
        return replace(self, moments=scaled)

    def with_noise(self, variance: FloatArray) -> Self:
        """State the noise variance of an observation, m2, cell by cell; shape (m,)."""
        moments = self.moments.copy()
        moments[:, 12] = moments[:, 0] * variance
        return replace(self, moments=moments)

    def select(self, kept: BoolArray) -> Self:
        """Only some of the cells; `kept` has shape (m,)."""
        return replace(self, row=self.row[kept], column=self.column[kept], moments=self.moments[kept])

    def coarsened(self) -> Cells:
        """Moments over cells of twice the size."""
        return _gather(self, 2.0 * self.cell_size)

    def window(self, cell_size: float, rows: tuple[int, int], columns: tuple[int, int]) -> FloatArray:
        """Dense moments of the cells of rows[0]..rows[1] - 1 and columns[0]..columns[1] - 1 of a lattice."""
        dense = np.zeros((rows[1] - rows[0], columns[1] - columns[0], kernel.N_MOMENTS))
        ratio = cell_size / self.cell_size
        # rows are ascending, so a window needs one slice; a coarse cell may deposit one cell away from its centre
        low = np.searchsorted(self.row, np.floor(rows[0] * ratio) - 1)
        high = np.searchsorted(self.row, np.ceil(rows[1] * ratio) + 1)
        part = slice(int(low), int(high))
        kernel.deposit_moments(
            self.moments[part], self.row[part], self.column[part], self.cell_size, cell_size, rows[0], columns[0], dense
        )
        return dense


def _gather(cells: Cells, cell_size: float) -> Cells:
    """Deposit cells on another lattice, cell by cell in ascending order, and keep the occupied ones."""
    if len(cells) == 0:
        return replace(cells, cell_size=cell_size)
    m = cells.moments
    easting, northing = cells.centres
    if cell_size > cells.cell_size:
        dense = _gather_dense(cells, cell_size)
        if dense is not None:
            return dense
    row = np.floor((northing + m[:, 3] / m[:, 1]) / cell_size).astype(np.int64)
    column = np.floor((easting + m[:, 2] / m[:, 1]) / cell_size).astype(np.int64)
    row0, column0 = int(row.min()), int(column.min())
    width = int(column.max()) - column0 + 1
    key, inverse = np.unique((row - row0) * width + (column - column0), return_inverse=True)
    new_row, new_column = row0 + key // width, column0 + key % width
    gathered = np.zeros((key.size, kernel.N_MOMENTS))
    u = easting - (column + 0.5) * cell_size
    v = northing - (row + 0.5) * cell_size
    kernel.gather_moments(m, u, v, inverse.reshape(-1).astype(np.int64), gathered)
    return Cells(cell_size, new_row, new_column, gathered)


def _gather_dense(cells: Cells, cell_size: float) -> Cells | None:
    """Do the same over a dense window, which needs no sorting; None where most of the window would be empty."""
    west, east, south, north = cells.region
    rows = (math.floor(south / cell_size), math.ceil(north / cell_size) + 1)
    columns = (math.floor(west / cell_size), math.ceil(east / cell_size) + 1)
    if (rows[1] - rows[0]) * (columns[1] - columns[0]) > _DENSE_WINDOW * len(cells):
        return None
    window = cells.window(cell_size, rows, columns)
    row, column = np.nonzero(window[..., 1])
    return Cells(cell_size, row + rows[0], column + columns[0], window[row, column])


def merge_cells(parts: list[Cells]) -> Cells:
    """
    Sum of several sets of cells on the finest of their lattices.

    Parameters
    ----------
    parts : list of Cells
        At least one; weights must be in the same units.

    Returns
    -------
    cells : Cells
    """
    filled = [p for p in parts if len(p)] or parts[:1]
    if len(filled) == 1:
        return filled[0]
    size = min(p.cell_size for p in filled)
    fine = [p if p.cell_size == size else _gather(p, size) for p in filled]
    joined = Cells(
        size,
        np.concatenate([p.row for p in fine]),
        np.concatenate([p.column for p in fine]),
        np.concatenate([p.moments for p in fine]),
    )
    return _gather(joined, size)


class Evidence:
    """
    What one epoch observed: exact integer sums over micro-cells.

    Parameters
    ----------
    cell_size : float, m
        A power of two.
    is_weighted : bool
        Whether observations carry standard deviations; then weights are 1 / sigma**2, else 1.

    Notes
    -----
    Observations may come in any order and in any number of calls: the sums are the same to the last bit.
    """

    def __init__(self, cell_size: float, *, is_weighted: bool) -> None:
        self.cell_size = cell_size
        self.is_weighted = is_weighted
        self.tiles: dict[tuple[int, int], tuple[IntArray, IntArray]] = {}

    def __len__(self) -> int:
        """Return the number of observations."""
        return int(sum(sums[:, 0].sum() for _, sums in self.tiles.values()))

    @property
    def n_cells(self) -> int:
        """Number of occupied cells."""
        return sum(key.size for key, _ in self.tiles.values())

    def copy(self) -> Evidence:
        """Return evidence that shares no state with this one."""
        other = Evidence(self.cell_size, is_weighted=self.is_weighted)
        other.tiles = {tile: (key.copy(), sums.copy()) for tile, (key, sums) in self.tiles.items()}
        return other

    def add(self, coordinates: Coordinates, elevation: FloatArray, sigma: FloatArray | None) -> None:
        """
        Take in observations.

        Parameters
        ----------
        coordinates : (easting, northing), each shape (n,), m
        elevation : array, shape (n,), m
        sigma : array, shape (n,), m, or None
            Standard deviation of each observation; required if and only if the evidence is weighted.
        """
        easting, northing = coordinates
        row, column = kernel.cell_indices(easting, northing, self.cell_size)
        weight = np.ones(1, np.int64) if sigma is None else kernel.integer_weights(sigma)
        tile_row, tile_column = row // TILE_CELLS, column // TILE_CELLS
        first, width = tile_row.min(), int(np.ptp(tile_column)) + 1
        first_column = tile_column.min()
        key = (tile_row - first) * width + (tile_column - first_column)
        order, start = kernel.count_sort(key, (int(np.ptp(tile_row)) + 1) * width)
        for k in np.flatnonzero(np.diff(start)):
            tile = (int(first) + int(k) // width, int(first_column) + int(k) % width)
            dense = self._dense(tile)
            kernel.accumulate_tile(
                order[start[k] : start[k + 1]], row, column, easting, northing, elevation, weight,
                self.cell_size, tile[0] * TILE_CELLS, tile[1] * TILE_CELLS, dense,
            )  # fmt: skip
            self.tiles[tile] = kernel.collect_tile(dense)

    def _dense(self, tile: tuple[int, int]) -> IntArray:
        dense = np.zeros((TILE_CELLS, TILE_CELLS, kernel.N_SUMS), np.int64)
        if tile in self.tiles:
            key, sums = self.tiles[tile]
            dense.reshape(-1, kernel.N_SUMS)[key] = sums
        return dense

    def cells(self, survey_time: float) -> Cells:
        """
        Floating-point moments of the occupied cells.

        Parameters
        ----------
        survey_time : float, days
            Time of the observations, carried along as a weighted mean.

        Returns
        -------
        cells : Cells
            Weights are 1 per observation, or 1 / sigma**2 in 1/m2.
        """
        if not self.tiles:
            empty = np.empty(0, np.int64)
            return Cells(self.cell_size, empty, empty, np.empty((0, kernel.N_MOMENTS)))
        unit = kernel.WEIGHT_UNIT if self.is_weighted else 1.0
        ordered = sorted(self.tiles)
        row = np.concatenate([t[0] * TILE_CELLS + self.tiles[t][0] // TILE_CELLS for t in ordered])
        column = np.concatenate([t[1] * TILE_CELLS + self.tiles[t][0] % TILE_CELLS for t in ordered])
        sums = np.concatenate([self.tiles[t][1] for t in ordered])
        order = np.lexsort((column, row))
        moments = kernel.moments_from_sums(sums[order], self.cell_size, unit, survey_time)
        return Cells(self.cell_size, row[order], column[order], moments)
