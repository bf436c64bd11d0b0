"""The observations an alignment rests on, in groups."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from changedetect.coregistration.squares import Squares

if TYPE_CHECKING:
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import FloatArray

__all__ = ["Sample"]

#: Observations in a square, on average: enough to see a change that is smaller than the noise of one.
_IN_SQUARE = 12
_MAX_SQUARES = 2**14
#: Blocks for the correlation of errors: enough to estimate it from, few enough for matrices of their covariance.
_N_BLOCKS = 180
_IN_BLOCK = 4


@dataclass(frozen=True)
class Sample:
    """
    Observations of an epoch, grouped by place.

    Attributes
    ----------
    cloud : PointCloud
        In the frame of the epoch.
    precision : array, shape (n,)
        1 / variance of an observation about the reference, relative to the typical one.
    centre : (easting, northing, elevation), m
        Centroid.
    radius : float, m
        Root mean square horizontal distance from it.
    squares : Squares
        Small: changed ground is told from unchanged by them, and slopes are smoothed over them.
    blocks : Squares
        Large: the correlation of errors is judged by them.
    """

    cloud: PointCloud
    precision: FloatArray
    centre: tuple[float, float, float]
    radius: float
    squares: Squares
    blocks: Squares

    @classmethod
    def of(cls, cloud: PointCloud) -> Self:
        """Group observations; at least one."""
        easting, northing = cloud.coordinates
        centre = (float(easting.mean()), float(northing.mean()), float(cloud.elevation.mean()))
        radius = float(np.sqrt(np.mean((easting - centre[0]) ** 2 + (northing - centre[1]) ** 2)))
        n = len(cloud)
        return cls(
            cloud,
            np.ones(n),
            centre,
            max(radius, 1e-3),
            Squares.holding(easting, northing, min(max(n // _IN_SQUARE, 1), _MAX_SQUARES)),
            Squares.holding(easting, northing, min(max(n // _IN_BLOCK, 1), _N_BLOCKS)),
        )

    def __len__(self) -> int:
        return len(self.cloud)

    def weighted_by(self, variance: FloatArray) -> Self:
        """Give each observation a precision from its variance, m2, shape (n,); extremes are moderated."""
        return replace(self, precision=np.clip(float(np.median(variance)) / variance, 1.0 / 64.0, 64.0))
