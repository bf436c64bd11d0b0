"""Fitting a transform of one kind: robust instrumental-variable regression of residuals on the reference's slope."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter

from changedetect.coregistration.reference import Slopes, slopes_at
from changedetect.coregistration.stable_ground import agreeing, majority_level

if TYPE_CHECKING:
    from changedetect.coregistration.reference import ReferenceSurface
    from changedetect.coregistration.sample import Sample, Squares
    from changedetect.coregistration.stable_ground import Consensus
    from changedetect.coregistration.transform import Transform
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["SMOOTHINGS", "Fit", "Residuals", "length_scales", "measure", "solve"]

#: Largest motion of a position in the last step, m.
_TOLERANCE = 1e-5
_MAX_EVALUATIONS = 24
#: A last step of this part of the reach is accepted where the iteration goes round in a small circle.
_ACCEPTED = 3e-4
#: Evaluations in which changed ground is searched for anew: misfit on slopes hides changes until the shift is found.
_N_SEARCHES = 2
#: What changed is settled once a step is shorter than this part of the reach, or after so many evaluations.
_SETTLED = 1e-2
_N_UNSETTLED = 9
#: Reweighted steps on the linearised residuals of one evaluation.
_N_STEPS = 4
#: A step is not longer than this many reaches of the reference.
_LONGEST_STEP = 4.0
#: Slopes are taken anew once positions have moved by this part of the reach.
_DRIFT = 0.2
#: Smoothers whose local mean is taken off the slopes, standard deviations in fine squares; the last is the one to begin
#: with: large areas that changed do not pull on slopes less their mean.
SMOOTHINGS = (0.7, 1.0, 1.4, 2.0, 4.0, 8.0, 16.0)
#: Parameters that are lengths; the others become lengths at the radius of the sample.
_LENGTHS = frozenset({"east", "north", "up"})
#: Parameters that act through the slope of the ground.
_SLOPE_BORNE = frozenset({"east", "north", "rotation_up", "scale"})


@dataclass(frozen=True)
class Residuals:
    """
    Observations against the reference under one transform.

    Attributes
    ----------
    easting, northing, elevation : array, shape (n,), m
        Moved positions.
    residual : array, shape (n,), m
        Elevation above the reference; 0 where it is not defined.
    surface_variance : array, shape (n,), m2
        Of the reference; 0 where it is not defined.
    defined : array, shape (n,), bool
    """

    easting: FloatArray
    northing: FloatArray
    elevation: FloatArray
    residual: FloatArray
    surface_variance: FloatArray
    defined: BoolArray


@dataclass(frozen=True)
class Fit:
    """
    A transform that solves the estimating equations, if `is_converged`.

    Attributes
    ----------
    transform : Transform
    residuals : Residuals
    slopes : Slopes
        Of the reference at the moved positions.
    consensus : Consensus
    smoothing : float or None
        See `instruments`.
    n_evaluations : int
        Of the reference, at all positions of the sample.
    is_converged : bool
    """

    transform: Transform
    residuals: Residuals
    slopes: Slopes
    consensus: Consensus
    smoothing: float | None
    n_evaluations: int
    is_converged: bool

    @property
    def n_used(self) -> int:
        """Observations that have a weight."""
        return int(np.count_nonzero(self.consensus.weight))

    def jacobian(self) -> FloatArray:
        """Derivative of the residuals, shape (n, k); 0 where the reference is not defined."""
        r = self.residuals
        columns = self.transform.jacobian(r.easting, r.northing, r.elevation, self.slopes.east, self.slopes.north)
        return np.where(r.defined[:, None], columns, 0.0)


def measure(sample: Sample, reference: ReferenceSurface, transform: Transform) -> Residuals:
    """Evaluate residuals under a transform."""
    easting, northing, elevation = transform.apply(*sample.cloud.coordinates, sample.cloud.elevation)
    surface, variance = reference.surface(easting, northing)
    defined = np.isfinite(surface)
    residual = np.where(defined, elevation - surface, 0.0)
    return Residuals(easting, northing, elevation, residual, np.where(defined, variance, 0.0), defined)


def length_scales(transform: Transform, radius: float) -> FloatArray:
    """Factors that turn lengths at the radius of the sample into parameters, shape (k,)."""
    return np.array([1.0 if name in _LENGTHS else 1.0 / radius for name in transform.names])


def instruments(sample: Sample, fit: Fit, smoothing: float | None) -> FloatArray:
    """
    What stands in for the Jacobian in the estimating equations.

    Parameters
    ----------
    sample : Sample
    fit : Fit
    smoothing : float or None
        Standard deviation, in fine squares, of the smoother whose local mean is taken off the slopes; None: none is.

    Returns
    -------
    instruments : array, shape (n, k)

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
    r, slopes = fit.residuals, fit.slopes
    # a surface that smooths cuts peaks and fills hollows: what it leaves over looks like a scale of the relief alone
    level = np.full_like(r.elevation, fit.transform.centre[2] + fit.transform["up"])
    columns = fit.transform.jacobian(r.easting, r.northing, level, slopes.wide_east, slopes.wide_north)
    if smoothing is None:
        return columns
    has_slope = (slopes.wide_east != 0.0) | (slopes.wide_north != 0.0)
    for k, name in enumerate(fit.transform.names):
        if name in _SLOPE_BORNE:
            columns[:, k] = _local_detail(columns[:, k], has_slope, smoothing, sample.fine)
    return columns


def solve(sample: Sample, reference: ReferenceSurface, start: Transform, smoothing: float | None = None) -> Fit:
    """
    Fit a transform of one kind.

    Parameters
    ----------
    sample : Sample
    reference : ReferenceSurface
    start : Transform
        Of the kind wanted.
    smoothing : float or None
        See `instruments`.

    Returns
    -------
    fit : Fit
        Of use only if it converged.

    Notes
    -----
    Gauss-Newton steps: residuals are evaluated anew in each, and on them, linearised, the equations Z' psi(r) = 0 are
    solved by reweighting, until a step moves no position by more than 10 um.
    """
    residuals = measure(sample, reference, start)
    slopes = _slopes(reference, residuals, start)
    consensus = agreeing(residuals.residual, residuals.defined, sample, None)
    fit = Fit(start, residuals, slopes, consensus, smoothing, n_evaluations=1, is_converged=False)
    is_settled, taken_at, length = False, start, math.inf
    while fit.n_evaluations <= _MAX_EVALUATIONS:
        is_searching = fit.n_evaluations <= _N_SEARCHES
        fit, length = _stepped(fit, sample, reference.reach, is_searching=is_searching, is_settled=is_settled)
        if length <= _TOLERANCE and is_settled:
            return replace(fit, is_converged=True)
        # a vertical motion changes residuals by just itself
        if start.kind != "vertical":
            fit = replace(fit, residuals=measure(sample, reference, fit.transform))
        drift = float(np.hypot(*(fit.transform.shift - taken_at.shift)[:2]))
        was_settled = is_settled
        close = length < _SETTLED * reference.reach and not is_searching
        is_settled = is_settled or close or fit.n_evaluations >= _N_UNSETTLED
        if not was_settled and (is_settled or drift > _DRIFT * reference.reach):
            fit, taken_at = replace(fit, slopes=_slopes(reference, fit.residuals, start)), fit.transform
        fit = replace(fit, n_evaluations=fit.n_evaluations + 1)
    return replace(fit, is_converged=length <= _ACCEPTED * reference.reach)


def _slopes(reference: ReferenceSurface, residuals: Residuals, transform: Transform) -> Slopes:
    if transform.kind == "vertical":
        return Slopes(*np.zeros((4, residuals.residual.size)))
    return slopes_at(reference, residuals.easting, residuals.northing)


def _stepped(fit: Fit, sample: Sample, reach: float, *, is_searching: bool, is_settled: bool) -> tuple[Fit, float]:
    """Solve the linearised equations; also how far, m, a position would move by the whole step."""
    scales = length_scales(fit.transform, sample.radius)
    jacobian = fit.jacobian() * scales
    stand_in = np.ascontiguousarray((instruments(sample, fit, fit.smoothing) * scales).T)
    defined, consensus = fit.residuals.defined, fit.consensus
    up = fit.transform.names.index("up")
    step = np.zeros(scales.size)
    for _ in range(_N_STEPS):
        left = fit.residuals.residual + jacobian @ step
        if is_searching:
            level = majority_level(left, defined, sample)
            step[up] -= level
            left = left - level
        consensus = agreeing(left, defined, sample, None if is_searching else consensus, is_settled=is_settled)
        weighted = stand_in * consensus.weight
        step -= np.linalg.pinv(weighted @ jacobian) @ (weighted @ left)
    length = float(np.abs(step).max())
    furthest = float(np.abs(np.delete(step, up)).max(initial=0.0))
    step *= min(1.0, _LONGEST_STEP * reach / max(furthest, 1e-300))
    residual = np.where(defined, fit.residuals.residual + jacobian @ step, 0.0)
    moved = replace(fit.residuals, residual=residual)
    transform = fit.transform.stepped(step * scales)
    return replace(fit, transform=transform, residuals=moved, consensus=consensus), length


def _local_detail(values: FloatArray, defined: BoolArray, smoothing: float, squares: Squares) -> FloatArray:
    """Values less their mean around; 0 where not defined."""
    sums, counts = (
        gaussian_filter(squares.raster(squares.total(v)), smoothing, mode="constant", truncate=3.0)
        for v in (np.where(defined, values, 0.0), defined.astype(np.float64))
    )
    mean = np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0.0)
    return np.where(defined, values - squares.on_points(mean), 0.0)
