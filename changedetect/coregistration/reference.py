"""What an epoch is aligned to: elevation and variance of a surface anywhere, whatever it is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from changedetect.kernels.coregistration import interpolate_raster

if TYPE_CHECKING:
    from changedetect.grid import Grid
    from changedetect.models.base import SurfaceModel
    from changedetect.typing import FloatArray

__all__ = ["GridReference", "ModelReference", "ReferenceSurface", "Slopes", "slopes_at"]

#: The errors of two places this many of the finest kernels apart are correlated by less than a fifth: coarser levels
#: decide where the finest see nothing but noise.
_REACH_KERNELS = 4.0
#: Nodes from a place beyond which bicubic interpolation at the two shares at most one, of small weight.
_REACH_NODES = 3.0
#: Part of the reach over which the surface's own gradient is taken: an eighth of a kernel or less.
_GRADIENT_STEP = 1.0 / 32.0


class ReferenceSurface(Protocol):
    """A surface that can be evaluated anywhere."""

    @property
    def reach(self) -> float:
        """Distance, m, beyond which the surface at two places rests on different observations."""
        ...

    def surface(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Elevation, m, and its variance, m2 (0: not known), at places of shape (n,); NaN where there is none."""
        ...


@dataclass(frozen=True)
class ModelReference:
    """
    A learned surface.

    Attributes
    ----------
    model : SurfaceModel
    kernel : float, m
        Its finest kernel.
    """

    model: SurfaceModel
    kernel: float

    @property
    def reach(self) -> float:
        """Four kernels, m."""
        return _REACH_KERNELS * self.kernel

    def surface(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Elevation, m, and its variance, m2, at places of shape (n,)."""
        predicted = self.model.predict((easting, northing))
        return predicted.elevation, predicted.elevation_std**2


@dataclass(frozen=True, eq=False)
class GridReference:
    """
    An elevation raster, bicubic between its cell centres.

    Attributes
    ----------
    elevation : array, shape (n_rows, n_cols), m, float64
        Row 0 in the north; NaN marks no data, next to which interpolation is bilinear.
    grid : Grid

    Raises
    ------
    ValueError
        The array does not have the shape of the grid.
    """

    elevation: FloatArray
    grid: Grid

    def __post_init__(self) -> None:
        if self.elevation.shape != self.grid.shape:
            msg = f"The elevation has shape {self.elevation.shape}, but its grid {self.grid.shape}."
            raise ValueError(msg)
        object.__setattr__(self, "elevation", np.ascontiguousarray(self.elevation, dtype=np.float64))

    @property
    def reach(self) -> float:
        """Three cells, m."""
        return _REACH_NODES * self.grid.resolution

    def surface(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Elevation, m, at places of shape (n,); its variance is not known and given as 0."""
        cell = self.grid.resolution
        elevation = np.empty(easting.size)
        row, column = (self.grid.north - northing) / cell - 0.5, (easting - self.grid.west) / cell - 0.5
        interpolate_raster(self.elevation, row, column, elevation)
        return elevation, np.where(np.isnan(elevation), np.nan, 0.0)


class Slopes(NamedTuple):
    """
    Slopes of a reference at n places, m/m, shape (n,) each; 0 where not defined.

    `east` and `north` are the surface's own gradient. `wide_east` and `wide_north` are differences over one reach to
    either side, which rest on other observations than the elevation in the middle.
    """

    east: FloatArray
    north: FloatArray
    wide_east: FloatArray
    wide_north: FloatArray


def slopes_at(reference: ReferenceSurface, easting: FloatArray, northing: FloatArray) -> Slopes:
    """Gradient of a reference, own and wide, at places of shape (n,), m."""

    def difference(step_east: float, step_north: float) -> FloatArray:
        ahead, _ = reference.surface(easting + step_east, northing + step_north)
        behind, _ = reference.surface(easting - step_east, northing - step_north)
        slope = (ahead - behind) / (2.0 * (step_east + step_north))
        return np.where(np.isfinite(slope), slope, 0.0)

    own, wide = _GRADIENT_STEP * reference.reach, reference.reach
    return Slopes(difference(own, 0.0), difference(0.0, own), difference(wide, 0.0), difference(0.0, wide))
