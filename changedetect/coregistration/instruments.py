"""Slopes that are independent of the errors they are used against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from scipy.ndimage import gaussian_filter

if TYPE_CHECKING:
    from changedetect.coregistration.sample import Sample
    from changedetect.coregistration.squares import Squares
    from changedetect.coregistration.surfaces import ReferenceSurface
    from changedetect.coregistration.transform import Transform
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["Instruments"]

#: Parameters that act through the slope of the ground.
_SLOPE_BORNE = frozenset({"east", "north", "rotation_up", "scale"})
#: Reach of the Gaussian smoother in standard deviations.
_TRUNCATE = 3.0


@dataclass(frozen=True)
class Instruments:
    """
    What stands in for the Jacobian in the estimating equations.

    Attributes
    ----------
    slope_east, slope_north : array, shape (n,), m/m
        Of the reference, by differences over one reach to either side; 0 where it is not defined that far.
    defined : array, shape (n,), bool
    smoothing : float or None
        Standard deviation, in squares, of the smoother whose local mean is taken off; None takes none off.

    Notes
    -----
    In place of the Jacobian J stand instruments Z [1]_. J itself would not do, for two reasons:

    1. Its noise and that of the residual come from the same observations of the reference. That draws the shift
       to where interpolation smooths most, half a cell (0.026 cells too far at 0.7 cells with 5 cm noise on slopes
       of 0.25), and makes flat ground look as if its noise were relief. Differences over one reach to either side
       rest on other observations than the elevation in the middle.
    2. Errors that are correlated over tens of metres hide in slopes of that length. Slopes less their local mean do
       not follow them: what generalised least squares would do.

    Z that is independent of the errors gives a consistent estimate whatever it is; a poor one only costs precision,
    and the covariance of the estimate shows it.

    References
    ----------
    .. [1] R. J. Bowden, D. A. Turkington (1984), Instrumental Variables, Cambridge University Press.
    """

    slope_east: FloatArray
    slope_north: FloatArray
    defined: BoolArray
    smoothing: float | None

    @classmethod
    def at(cls, sample: Sample, reference: ReferenceSurface, transform: Transform, smoothing: float | None) -> Self:
        """Take slopes at the positions a transform gives the sample."""
        easting, northing, _ = transform.apply(*sample.cloud.coordinates, sample.cloud.elevation)
        h = reference.reach
        east, west = (reference.surface(easting + step, northing) for step in (h, -h))
        north, south = (reference.surface(easting, northing + step) for step in (h, -h))
        defined = east.defined & west.defined & north.defined & south.defined
        return cls(
            np.where(defined, (east.elevation - west.elevation) / (2.0 * h), 0.0),
            np.where(defined, (north.elevation - south.elevation) / (2.0 * h), 0.0),
            defined,
            smoothing,
        )

    def matrix(self, sample: Sample, transform: Transform) -> FloatArray:
        """Columns for the parameters of a transform near by; shape (n, k)."""
        moved = transform.apply(*sample.cloud.coordinates, sample.cloud.elevation)
        columns = transform.jacobian(*moved, self.slope_east, self.slope_north)
        for k, name in enumerate(transform.names):
            if name in _SLOPE_BORNE:
                columns[:, k] = self._local_detail(columns[:, k], sample.squares)
        return columns

    def _local_detail(self, values: FloatArray, squares: Squares) -> FloatArray:
        """Values less their mean around, 0 where there are none."""
        values = np.where(self.defined, values, 0.0)
        if self.smoothing is None:
            return values
        sums, counts = (
            gaussian_filter(squares.raster(squares.total(v)), self.smoothing, mode="constant", truncate=_TRUNCATE)
            for v in (values, self.defined.astype(np.float64))
        )
        mean = np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0.0)
        return np.where(self.defined, values - squares.on_points(mean), 0.0)
