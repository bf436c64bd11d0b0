"""What an epoch is aligned to: elevation, slope and variance of a reference surface, whatever it was made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from changedetect.kernels.coregistration import interpolate_raster

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.grid import Grid
    from changedetect.models.base import SurfaceModel
    from changedetect.models.lwpr import LWPRSurface
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["GridReference", "LWPRReference", "PredictedReference", "ReferenceSurface", "SurfaceValues"]

#: The errors of two places this many of the finest kernels apart are correlated by less than a fifth: coarser levels
#: decide where the finest see nothing but noise.
_REACH_KERNELS = 4.0
#: Nodes from a place beyond which bicubic interpolation at the two shares at most one, of small weight.
_REACH_NODES = 3.0


class SurfaceValues(NamedTuple):
    """
    A surface at n places.

    Attributes
    ----------
    elevation : array, shape (n,), m
    slope_east, slope_north : array, shape (n,), m/m
    elevation_variance : array, shape (n,), m2
        Of the surface itself; 0 where it is not known.
    defined : array, shape (n,), bool
        Where false the other values mean nothing.
    """

    elevation: FloatArray
    slope_east: FloatArray
    slope_north: FloatArray
    elevation_variance: FloatArray
    defined: BoolArray


class ReferenceSurface(Protocol):
    """A surface that can be evaluated with its slope."""

    @property
    def reach(self) -> float:
        """Distance, m, beyond which the surface at two places rests on different observations."""
        ...

    def surface(self, easting: FloatArray, northing: FloatArray) -> SurfaceValues:
        """Evaluate at places of shape (n,), m, in the CRS of the reference."""
        ...


@dataclass(frozen=True)
class LWPRReference:
    """
    A learned surface in adaptive mode, with the exact derivative of its blend of receptive fields.

    Attributes
    ----------
    model : LWPRSurface
    """

    model: LWPRSurface

    @property
    def reach(self) -> float:
        """Four of the kernels that the density of the observations supports, m."""
        return _REACH_KERNELS * self.model.own_kernel_

    def surface(self, easting: FloatArray, northing: FloatArray) -> SurfaceValues:
        """Evaluate at places of shape (n,), m."""
        blended = self.model._receptive_fields().level.blend(easting, northing)
        defined = (blended[:, 7] > 0.0) & (blended[:, 5] >= 0.5)
        return SurfaceValues(blended[:, 0], blended[:, 1], blended[:, 2], blended[:, 3], defined)


@dataclass(frozen=True)
class PredictedReference:
    """
    Any surface model, its slope by central differences.

    Attributes
    ----------
    model : SurfaceModel
    kernel : float, m
        Kernel size of the model; differences are taken over half of it either side.
    """

    model: SurfaceModel
    kernel: float

    @property
    def reach(self) -> float:
        """Four kernels, m."""
        return _REACH_KERNELS * self.kernel

    def surface(self, easting: FloatArray, northing: FloatArray) -> SurfaceValues:
        """Evaluate at places of shape (n,), m."""
        here = self.model.predict((easting, northing))
        h = 0.5 * self.kernel
        east, west = (self.model.predict((easting + step, northing)).elevation for step in (h, -h))
        north, south = (self.model.predict((easting, northing + step)).elevation for step in (h, -h))
        slope_east, slope_north = (east - west) / (2.0 * h), (north - south) / (2.0 * h)
        defined = np.isfinite(here.elevation) & np.isfinite(slope_east) & np.isfinite(slope_north)
        columns = (here.elevation, slope_east, slope_north, here.elevation_std**2)
        return SurfaceValues(*(np.where(defined, column, 0.0) for column in columns), defined)


@dataclass(frozen=True, eq=False)
class GridReference:
    """
    An elevation raster, bicubic between its cell centres.

    Attributes
    ----------
    elevation : array, shape (n_rows, n_cols), m, float32 or float64
        Row 0 in the north; NaN marks no data, next to which interpolation is bilinear.
    grid : Grid

    Raises
    ------
    ValueError
        The array does not have the shape of the grid.
    """

    elevation: NDArray[np.floating]
    grid: Grid

    def __post_init__(self) -> None:
        if self.elevation.shape != self.grid.shape:
            msg = f"The elevation has shape {self.elevation.shape}, but its grid {self.grid.shape}."
            raise ValueError(msg)
        object.__setattr__(self, "elevation", np.ascontiguousarray(self.elevation))

    @property
    def reach(self) -> float:
        """Three cells, m."""
        return _REACH_NODES * self.grid.resolution

    def surface(self, easting: FloatArray, northing: FloatArray) -> SurfaceValues:
        """Evaluate at places of shape (n,), m; the variance of a raster is not known and given as 0."""
        c = self.grid.resolution
        row = (self.grid.north - np.asarray(northing)) / c - 0.5
        column = (np.asarray(easting) - self.grid.west) / c - 0.5
        values = np.empty((row.size, 4))
        interpolate_raster(self.elevation, row, column, values)
        defined = values[:, 3] > 0.0
        return SurfaceValues(values[:, 0], values[:, 2] / c, -values[:, 1] / c, np.zeros(row.size), defined)
