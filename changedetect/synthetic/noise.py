"""Standard deviations of white observation noise that vary over a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.synthetic.surfaces import Surface

if TYPE_CHECKING:
    from changedetect.synthetic.terrain import Trees
    from changedetect.typing import FloatArray

__all__ = ["CanopyNoise", "EastwardNoise", "SlopeNoise"]


@dataclass(frozen=True)
class EastwardNoise(Surface):
    """Noise that grows from `at_west` by `growth` ((e - west) / length)^2, m; it stays `at_west` further west."""

    west: float
    length: float
    at_west: float
    growth: float

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:  # noqa: ARG002
        """Evaluate at points."""
        return np.asarray(self.at_west + self.growth * np.maximum((easting - self.west) / self.length, 0.0) ** 2)


@dataclass(frozen=True)
class CanopyNoise(Surface):
    """Additional noise `std`, m, under the crowns of trees and none elsewhere."""

    trees: Trees
    std: float

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        return np.where(self.trees.covers(easting, northing), self.std, 0.0)


@dataclass(frozen=True)
class SlopeNoise(Surface):
    """
    Noise that grows with the slope of a surface: std (1 + slope / doubling_slope), the slope counted up to a limit.

    Attributes
    ----------
    surface : Surface
    std : float, m
        On level ground.
    doubling_slope_deg : float, degrees
        Slope at which the noise is twice `std`.
    largest_slope_deg : float, degrees
    step : float, m
        Half the base of the central differences that give the slope.
    """

    surface: Surface
    std: float
    doubling_slope_deg: float = 15.0
    largest_slope_deg: float = 45.0
    step: float = 0.5

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        base = 2.0 * self.step
        rise_east = self.surface(easting + self.step, northing) - self.surface(easting - self.step, northing)
        rise_north = self.surface(easting, northing + self.step) - self.surface(easting, northing - self.step)
        return self._from_gradient(rise_east / base, rise_north / base)

    def on_axes(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate on a raster."""
        base = 2.0 * self.step
        on_axes = self.surface.on_axes
        rise_east = on_axes(easting + self.step, northing) - on_axes(easting - self.step, northing)
        rise_north = on_axes(easting, northing + self.step) - on_axes(easting, northing - self.step)
        return self._from_gradient(rise_east / base, rise_north / base)

    def _from_gradient(self, slope_east: FloatArray, slope_north: FloatArray) -> FloatArray:
        slope_deg = np.degrees(np.arctan(np.hypot(slope_east, slope_north)))
        return np.asarray(self.std * (1.0 + np.minimum(slope_deg, self.largest_slope_deg) / self.doubling_slope_deg))
