"""Robust fit of one kind of transform to a sample."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from changedetect.coregistration.instruments import Instruments
from changedetect.coregistration.robust import CHANGED, CHANGED_AT_FIRST, Consensus, majority_level, weigh
from changedetect.coregistration.uncertainty import Scores, parameter_covariance

if TYPE_CHECKING:
    from changedetect.coregistration.correlated import BlockErrors
    from changedetect.coregistration.sample import Sample
    from changedetect.coregistration.surfaces import ReferenceSurface
    from changedetect.coregistration.transform import Transform
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["FIRST_SMOOTHING", "Fit", "Misfit", "Solution", "assess", "best_smoothing", "length_scales", "measure", "solve"]

#: Largest motion of a position in the last iteration, m.
_TOLERANCE = 1e-5
_MAX_ITERATIONS = 40
#: Iterations in which changed squares are judged sharply, and until which they are judged at all; then they stay.
_N_SHARP = 4
_N_JUDGING = 8
#: A step is not longer than this many reaches of the reference.
_LONGEST_STEP = 4.0
#: Smoothers that are tried, standard deviations in squares.
_SMOOTHINGS = (1.0, 2.0, 4.0, 8.0)
#: The one to begin with: large areas that changed do not pull on slopes less their mean over smaller ones.
FIRST_SMOOTHING = 8.0
#: A smoother must bring the variance of the horizontal shift below this part of that without it.
_WORTHWHILE = 0.8
#: Parameters that are lengths; the others become lengths at the radius of the sample.
_LENGTHS = frozenset({"east", "north", "up"})


@dataclass(frozen=True)
class Misfit:
    """
    Observations against the reference under one transform.

    Attributes
    ----------
    residual : array, shape (n,), m
        Elevation above the reference; 0 where it is not defined.
    jacobian : array, shape (n, k)
        Its derivative with respect to the parameters, by the reference's own slope.
    surface_variance : array, shape (n,), m2
    defined : array, shape (n,), bool
    """

    residual: FloatArray
    jacobian: FloatArray
    surface_variance: FloatArray
    defined: BoolArray


@dataclass(frozen=True)
class Solution:
    """
    A transform that solves the estimating equations, if `is_converged`.

    Attributes
    ----------
    transform : Transform
    misfit : Misfit
    consensus : Consensus
    instruments : Instruments
    n_iterations : int
    is_converged : bool
    """

    transform: Transform
    misfit: Misfit
    consensus: Consensus
    instruments: Instruments
    n_iterations: int
    is_converged: bool

    @property
    def n_used(self) -> int:
        """Observations that have a weight."""
        return int(np.count_nonzero(self.consensus.weight))

    def scores(self, sample: Sample, smoothing: float | None) -> Scores:
        """Terms of the estimating equations for a choice of the smoother, parameters as lengths."""
        kept = (self.misfit.defined & self.consensus.stable_observations(sample.squares)).astype(np.float64)
        scales = length_scales(self.transform, sample.radius)
        instruments = replace(self.instruments, smoothing=smoothing).matrix(sample, self.transform)
        return Scores(
            instruments * scales * kept[:, None],
            self.consensus.weight * self.misfit.residual,
            self.consensus.derivative[:, None] * self.misfit.jacobian * scales,
            kept,
            sample.blocks,
        )


@dataclass(frozen=True)
class Fit:
    """
    A solution and how far it can be trusted.

    Attributes
    ----------
    solution : Solution
    covariance : array, shape (k, k)
        Of the parameters, in their units.
    freedom : array, shape (k,)
        Degrees of freedom of each variance.
    errors : BlockErrors
    """

    solution: Solution
    covariance: FloatArray
    freedom: FloatArray
    errors: BlockErrors

    @property
    def transform(self) -> Transform:
        """The transform fitted."""
        return self.solution.transform

    @property
    def n_effective(self) -> float:
        """Number of independent observations that would determine the vertical shift as well."""
        up = self.transform.names.index("up")
        n = self.solution.consensus.scale**2 / max(float(self.covariance[up, up]), 1e-300)
        return min(n, float(self.solution.n_used))


def measure(sample: Sample, reference: ReferenceSurface, transform: Transform) -> Misfit:
    """Evaluate residuals and their derivatives under a transform."""
    easting, northing, elevation = transform.apply(*sample.cloud.coordinates, sample.cloud.elevation)
    surface = reference.surface(easting, northing)
    defined = surface.defined
    jacobian = transform.jacobian(easting, northing, elevation, surface.slope_east, surface.slope_north)
    return Misfit(
        np.where(defined, elevation - surface.elevation, 0.0),
        np.where(defined[:, None], jacobian, 0.0),
        np.where(defined, surface.elevation_variance, 0.0),
        defined,
    )


def length_scales(transform: Transform, radius: float) -> FloatArray:
    """Factors that turn lengths at the radius of the sample into parameters, shape (k,)."""
    return np.array([1.0 if name in _LENGTHS else 1.0 / radius for name in transform.names])


def solve(
    sample: Sample,
    reference: ReferenceSurface,
    start: Transform,
    smoothing: float | None = None,
) -> Solution:
    """
    Fit a transform of one kind.

    Parameters
    ----------
    sample : Sample
    reference : ReferenceSurface
    start : Transform
        Of the kind wanted; its elevation is first brought to that of the majority of the ground.
    smoothing : float or None
        See `Instruments`; chosen by `best_smoothing`.
    Returns
    -------
    solution : Solution
        Of use only if it converged.

    Notes
    -----
    Solves Z' psi(r(theta)) = 0 by Gauss-Newton steps: in each the residuals r, the reference's slope in the Jacobian
    J and the robust weights W are evaluated anew, and theta changes by -(Z' W J)^-1 Z' W r. For Z see `Instruments`.
    """
    state = _State(start, None, Instruments.at(sample, reference, start, smoothing), start)
    iteration, is_converged = 0, False
    while not is_converged and iteration < _MAX_ITERATIONS:
        state, moved = _advance(state, sample, reference, iteration)
        iteration += 1
        is_converged = iteration > _N_SHARP + 1 and moved < _TOLERANCE
    misfit = measure(sample, reference, state.transform)
    consensus = weigh(misfit.residual, misfit.defined, sample.precision, sample.squares, state.consensus, None)
    return Solution(state.transform, misfit, consensus, state.instruments, iteration, is_converged)


def assess(solution: Solution, sample: Sample, guess: BlockErrors | None = None) -> Fit:
    """
    State the covariance of a solution.

    Parameters
    ----------
    solution : Solution
    sample : Sample
    guess : BlockErrors, optional
        Correlation of errors found in a similar fit.
    """
    scores = solution.scores(sample, solution.instruments.smoothing)
    covariance, freedom, errors = parameter_covariance(scores, guess)
    scales = length_scales(solution.transform, sample.radius)
    return Fit(solution, covariance * np.outer(scales, scales), freedom, errors)


def best_smoothing(solution: Solution, sample: Sample) -> float | None:
    """
    Smoother, in squares, that makes the horizontal shift most precise; None for none.

    Parameters
    ----------
    solution : Solution
        Of a kind that has a horizontal shift.
    sample : Sample
    """
    horizontal = [solution.transform.names.index(name) for name in ("east", "north")]

    def variance(smoothing: float | None) -> float:
        covariance = solution.scores(sample, smoothing).clustered_covariance()
        return float(np.sum(np.diag(covariance)[horizontal]))

    variances = {smoothing: variance(smoothing) for smoothing in _SMOOTHINGS}
    best = min(variances, key=lambda smoothing: variances[smoothing])
    return best if variances[best] < _WORTHWHILE * variance(None) else None


@dataclass(frozen=True)
class _State:
    """Where an iteration stands; `slopes_at` is the transform under which the instruments were taken."""

    transform: Transform
    consensus: Consensus | None
    instruments: Instruments
    slopes_at: Transform


def _advance(state: _State, sample: Sample, reference: ReferenceSurface, iteration: int) -> tuple[_State, float]:
    """One Gauss-Newton step, and how far it moved a position at the radius of the sample, m."""
    transform = state.transform
    misfit = measure(sample, reference, transform)
    if iteration < _N_SHARP:
        # the level of the majority, found anew while the horizontal shift settles: misfit on slopes hides changes
        level = majority_level(misfit.residual, misfit.defined, sample.precision, sample.squares)
        transform = transform.stepped([-level if name == "up" else 0.0 for name in transform.names])
        misfit = replace(misfit, residual=np.where(misfit.defined, misfit.residual - level, 0.0))
        consensus = weigh(misfit.residual, misfit.defined, sample.precision, sample.squares, None, CHANGED_AT_FIRST)
    else:
        changed = CHANGED if iteration < _N_JUDGING else None
        consensus = weigh(misfit.residual, misfit.defined, sample.precision, sample.squares, state.consensus, changed)
    taken, slopes_at = state.instruments, state.slopes_at
    drifted = float(np.hypot(*(transform.shift - slopes_at.shift)[:2])) > 0.5 * reference.reach
    if iteration < _N_JUDGING and drifted:
        taken, slopes_at = Instruments.at(sample, reference, transform, taken.smoothing), transform
    scales = length_scales(transform, sample.radius)
    instruments = taken.matrix(sample, transform) * scales
    normal = instruments.T @ (consensus.weight[:, None] * misfit.jacobian * scales)
    step = -np.linalg.pinv(normal) @ (instruments.T @ (consensus.weight * misfit.residual))
    moved = float(np.abs(step).max())
    is_level = np.array([name != "up" for name in transform.names])
    furthest = float(np.abs(step[is_level]).max(initial=0.0))
    step *= min(1.0, _LONGEST_STEP * reference.reach / max(furthest, 1e-300))
    return _State(transform.stepped(step * scales), consensus, taken, slopes_at), moved
