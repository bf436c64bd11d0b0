"""Height functions known everywhere: values that can be evaluated at points and on rasters, added and scaled."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from changedetect.grid import Grid
    from changedetect.typing import FloatArray

__all__ = ["Constant", "Plane", "PlaneWaves", "Scaled", "Surface", "SurfaceSum", "rasterize"]

#: Largest temporary array in an evaluation, in elements (32 MiB of float64).
_BLOCK_ELEMENTS = 4_194_304


class Surface(ABC):
    """
    A function of position, in metres; elevation, a change of elevation, or a standard deviation.

    A subclass is a frozen value and defines `__call__`. Surfaces add (`ground + trees`) and scale (`0.5 * mound`).
    """

    @abstractmethod
    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """
        Evaluate at points.

        Parameters
        ----------
        easting, northing : array, shape (n,), m

        Returns
        -------
        value : array, shape (n,), m, float64
        """

    def on_axes(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """
        Evaluate on the raster spanned by two axes.

        Parameters
        ----------
        easting : array, shape (n_cols,), m
        northing : array, shape (n_rows,), m

        Returns
        -------
        value : array, shape (n_rows, n_cols), m, float64
        """
        value = np.empty((northing.size, easting.size))
        n_block = max(1, _BLOCK_ELEMENTS // max(1, easting.size))
        for first in range(0, northing.size, n_block):
            rows = northing[first : first + n_block]
            flat = self(np.tile(easting, rows.size), np.repeat(rows, easting.size))
            value[first : first + n_block] = flat.reshape(rows.size, easting.size)
        return value

    def __add__(self, other: Surface) -> SurfaceSum:
        return SurfaceSum((*_parts(self), *_parts(other)))

    def __sub__(self, other: Surface) -> SurfaceSum:
        return self + (-1.0) * other

    def __rmul__(self, factor: float) -> Scaled:
        return Scaled(self, float(factor))


def _parts(surface: Surface) -> tuple[Surface, ...]:
    return surface.parts if isinstance(surface, SurfaceSum) else (surface,)


@dataclass(frozen=True)
class SurfaceSum(Surface):
    """Sum of surfaces; zero where `parts` is empty."""

    parts: tuple[Surface, ...]

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        return np.asarray(sum((part(easting, northing) for part in self.parts), np.zeros(easting.shape)))

    def on_axes(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate on a raster, each part in its own fast way."""
        zero = np.zeros((northing.size, easting.size))
        return np.asarray(sum((part.on_axes(easting, northing) for part in self.parts), zero))


@dataclass(frozen=True)
class Scaled(Surface):
    """A surface times a number."""

    surface: Surface
    factor: float

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        return self.factor * self.surface(easting, northing)

    def on_axes(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate on a raster."""
        return self.factor * self.surface.on_axes(easting, northing)


@dataclass(frozen=True)
class Constant(Surface):
    """The same value everywhere."""

    value: float

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:  # noqa: ARG002
        """Evaluate at points."""
        return np.full(easting.shape, self.value)


@dataclass(frozen=True)
class Plane(Surface):
    """
    An inclined plane: `height` at `centre`, rising by `slope_east` and `slope_north` (m per m).

    Examples
    --------
    >>> plane = Plane(centre=(500_000.0, 5_300_000.0), height=430.0, slope_east=0.1, slope_north=0.0)
    >>> plane(np.array([500_010.0]), np.array([5_300_000.0]))
    array([431.])
    """

    centre: tuple[float, float]
    height: float
    slope_east: float = 0.0
    slope_north: float = 0.0

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        rise_east = self.slope_east * (easting - self.centre[0])
        return np.asarray(self.height + rise_east + self.slope_north * (northing - self.centre[1]))


@dataclass(frozen=True, eq=False)
class PlaneWaves(Surface):
    """
    Sum of plane cosine waves, sum_k amplitude_k cos(a_k (e - e0) + b_k (n - n0) + phase_k).

    Attributes
    ----------
    origin : (easting, northing), m
        e0, n0; near the site, so that UTM-sized coordinates cost no precision.
    amplitude : array, shape (n_waves,), m
    wavenumber_east, wavenumber_north : array, shape (n_waves,), rad/m
        a and b.
    phase : array, shape (n_waves,), rad

    Notes
    -----
    On a raster cos(x + y) = cos x cos y - sin x sin y makes every wave a sum of two outer products, so that the whole
    raster is one matrix product and agrees with the evaluation at points to rounding.
    """

    origin: tuple[float, float]
    amplitude: FloatArray
    wavenumber_east: FloatArray
    wavenumber_north: FloatArray
    phase: FloatArray

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points, in blocks of bounded memory."""
        value = np.empty(easting.shape)
        n_block = max(1, _BLOCK_ELEMENTS // max(1, self.amplitude.size))
        for first in range(0, easting.size, n_block):
            block = slice(first, first + n_block)
            angle = np.multiply.outer(easting[block] - self.origin[0], self.wavenumber_east)
            angle += np.multiply.outer(northing[block] - self.origin[1], self.wavenumber_north)
            angle += self.phase
            value[block] = np.cos(angle, out=angle) @ self.amplitude
        return value

    def on_axes(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate on a raster as one matrix product."""
        x = np.multiply.outer(easting - self.origin[0], self.wavenumber_east) + self.phase
        y = np.multiply.outer(northing - self.origin[1], self.wavenumber_north)
        rows = np.hstack([np.cos(y), -np.sin(y)])
        cols = np.hstack([np.cos(x) * self.amplitude, np.sin(x) * self.amplitude])
        return np.asarray(rows @ cols.T)


def rasterize(surface: Surface, grid: Grid) -> FloatArray:
    """
    Evaluate a surface at the cell centres of a grid.

    Parameters
    ----------
    surface : Surface
    grid : Grid

    Returns
    -------
    value : array, shape (n_rows, n_cols), m, float64
        Row 0 in the north.
    """
    return surface.on_axes(grid.easting, grid.northing)
