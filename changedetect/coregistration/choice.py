"""Which kind of transform an epoch needs: the simplest that suffices, by a test that knows errors are correlated."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy import stats

from changedetect.coregistration.estimation import SMOOTHINGS, solve
from changedetect.coregistration.refusals import AlignmentError, check_determined, check_solved
from changedetect.coregistration.transform import KINDS, PARAMETER_NAMES
from changedetect.coregistration.uncertainty import clustered_covariance, parameter_covariance

if TYPE_CHECKING:
    from changedetect.coregistration.estimation import Fit
    from changedetect.coregistration.reference import ReferenceSurface
    from changedetect.coregistration.sample import Sample
    from changedetect.coregistration.transform import Kind
    from changedetect.coregistration.uncertainty import Uncertainty

__all__ = ["Candidate", "Choice", "choose", "leaves_out"]

logger = logging.getLogger(__name__)

#: A simpler kind is taken unless what it leaves out differs from zero at this level.
_SIGNIFICANCE = 0.001
#: A smoother must bring the variance of the horizontal shift below this part of that without it.
_WORTHWHILE = 0.8
#: Parameters of the larger kinds that each kind contains; a tilt is a rotation about a horizontal axis, to first order.
_CONTAINED: dict[Kind, frozenset[str]] = {
    "vertical": frozenset({"up"}),
    "shift": frozenset(PARAMETER_NAMES["shift"]),
    "shift_tilt": frozenset({*PARAMETER_NAMES["shift_tilt"], "rotation_east", "rotation_north"}),
    "rigid": frozenset(PARAMETER_NAMES["rigid"]),
    "rigid_scale": frozenset(PARAMETER_NAMES["rigid_scale"]),
}


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """
    One kind of transform that was considered.

    Attributes
    ----------
    kind : str
    statistic : float or None
        Wald statistic, over the number of parameters, of what this kind leaves out of the largest determined one.
    p_value : float or None
        Probability of a larger one if that were zero; None for the largest kind and where it was not tested.
    verdict : str
        In words.
    """

    kind: Kind
    statistic: float | None
    p_value: float | None
    verdict: str


@dataclass(frozen=True)
class Choice:
    """The fit that was taken, how well it is known, the kinds considered, and why it is vertical only if it is."""

    fit: Fit
    uncertainty: Uncertainty
    candidates: tuple[Candidate, ...]
    fallback: str | None


class _Fitted(NamedTuple):
    fit: Fit
    uncertainty: Uncertainty


def leaves_out(kind: Kind, largest: Fit, uncertainty: Uncertainty) -> tuple[float, float]:
    """
    Test whether what a kind leaves out of a larger fit is zero.

    Parameters
    ----------
    kind : str
    largest : Fit
        Of a larger kind.
    uncertainty : Uncertainty
        Of that fit.

    Returns
    -------
    statistic, p_value : float

    Notes
    -----
    Wald statistic theta' V^-1 theta / k of the k parameters left out, against the F distribution with k and the
    smallest of their degrees of freedom. A likelihood ratio or BIC that counts observations would find a tilt in
    every survey, since correlated errors are tilted over any area; V has that in it.
    """
    transform, covariance = largest.transform, uncertainty.covariance
    out = [k for k, name in enumerate(transform.names) if name not in _CONTAINED[kind]]
    scale = np.sqrt(np.diag(covariance)[out])
    theta = np.array(transform.parameters)[out] / scale
    correlation = covariance[np.ix_(out, out)] / np.outer(scale, scale)
    statistic = float(theta @ np.linalg.pinv(correlation) @ theta) / len(out)
    return statistic, float(stats.f.sf(statistic, len(out), uncertainty.freedom[out].min()))


def choose(sample: Sample, reference: ReferenceSurface, vertical: Fit, kind: Kind | Literal["auto"]) -> Choice:
    """
    Fit the kind asked for, or the simplest that suffices.

    Parameters
    ----------
    sample : Sample
    reference : ReferenceSurface
    vertical : Fit
        Of kind "vertical".
    kind : str

    Returns
    -------
    choice : Choice

    Raises
    ------
    AlignmentError
        A kind was asked for that the ground does not determine.

    Notes
    -----
    The horizontal shift is part of the transform wherever the ground determines it, significant or not: its
    uncertainty is an error of every difference on a slope, and is in the covariance only if it was estimated. Tilt,
    rotation and scale are taken if they are significant, each kind tested against the largest determined one.
    """
    if kind != "auto":
        try:
            fitted = _fitted(kind, sample, reference, vertical)
        except AlignmentError as error:
            msg = (
                f"A transform of kind '{kind}' cannot be estimated: {error}. Ask for a simpler kind or 'auto', or give "
                "stable ground with more relief."
            )
            raise AlignmentError(msg, error.cause) from error
        asked = Candidate(kind=kind, statistic=None, p_value=None, verdict="asked for")
        return Choice(fitted.fit, fitted.uncertainty, (asked,), None)
    try:
        shift = _fitted("shift", sample, reference, vertical)
    except AlignmentError as error:
        taken = Candidate(kind="vertical", statistic=None, p_value=None, verdict="taken: the largest determined")
        fitted = _fitted("vertical", sample, reference, vertical)
        return Choice(fitted.fit, fitted.uncertainty, (taken, _refused("shift", error)), str(error))
    return _simplest(sample, reference, shift)


def _refused(kind: Kind, error: AlignmentError) -> Candidate:
    return Candidate(kind=kind, statistic=None, p_value=None, verdict=f"not determined: {error}")


def _fitted(kind: Kind, sample: Sample, reference: ReferenceSurface, before: Fit) -> _Fitted:
    """Fit a kind from a fit of a simpler one; AlignmentError where the ground does not determine it."""
    fit = before
    if kind != "vertical":
        if before.transform.kind == "vertical":
            fit = solve(sample, reference, before.transform.as_kind("shift"), SMOOTHINGS[-1])
            check_solved(fit, sample, reference)
            smoothing = _best_smoothing(fit, sample)
            if smoothing != fit.smoothing:
                fit = solve(sample, reference, fit.transform, smoothing)
        if kind != "shift":
            fit = solve(sample, reference, fit.transform.as_kind(kind), fit.smoothing)
    check_solved(fit, sample, reference)
    uncertainty = parameter_covariance(fit, sample)
    logger.debug("%s: %s, covariance %s", kind, fit.transform.parameters, uncertainty.covariance)
    check_determined(fit, uncertainty, sample, reference)
    return _Fitted(fit, uncertainty)


def _best_smoothing(shift: Fit, sample: Sample) -> float | None:
    """Smoother, in fine squares, that makes the horizontal shift most precise; None for none."""

    def variance(smoothing: float | None) -> float:
        return float(np.diag(clustered_covariance(shift, sample, smoothing))[:2].sum())

    variances = {smoothing: variance(smoothing) for smoothing in SMOOTHINGS}
    best = min(variances, key=lambda smoothing: variances[smoothing])
    return best if variances[best] < _WORTHWHILE * variance(None) else None


def _simplest(sample: Sample, reference: ReferenceSurface, shift: _Fitted) -> Choice:
    """Take the first kind, from the shift on, whose rest in the largest determined one is not significant."""
    largest = shift
    refused: list[Candidate] = []
    for kind in reversed(KINDS[2:]):
        try:
            largest = _fitted(kind, sample, reference, shift.fit)
            break
        except AlignmentError as error:
            refused.insert(0, _refused(kind, error))
    candidates: list[Candidate] = []
    chosen: _Fitted | None = None
    for kind in KINDS[1 : KINDS.index(largest.fit.transform.kind)]:
        statistic, p_value = leaves_out(kind, *largest)
        if chosen is not None:
            verdict = f"more than needed: '{chosen.fit.transform.kind}' suffices"
        elif p_value <= _SIGNIFICANCE:
            verdict = f"leaves out what is significant (p = {p_value:.2g})"
        else:
            chosen = shift if kind == "shift" else _fitted(kind, sample, reference, shift.fit)
            verdict = f"taken: what it leaves out is not significant (p = {p_value:.2g})"
        candidates.append(Candidate(kind=kind, statistic=statistic, p_value=p_value, verdict=verdict))
    verdict = "taken: the largest that the ground determines"
    if chosen is not None:
        verdict = f"more than needed: '{chosen.fit.transform.kind}' suffices"
    candidates.append(Candidate(kind=largest.fit.transform.kind, statistic=None, p_value=None, verdict=verdict))
    chosen = chosen or largest
    return Choice(chosen.fit, chosen.uncertainty, (*candidates, *refused), None)
