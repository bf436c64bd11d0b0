"""Which kind of transform an epoch needs: the simplest that suffices, by tests that know errors are correlated."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from changedetect.coregistration.alignment import Candidate
from changedetect.coregistration.estimation import FIRST_SMOOTHING, Fit, assess, best_smoothing, solve
from changedetect.coregistration.refusals import undetermined
from changedetect.coregistration.transform import KINDS
from changedetect.errors import InputDataError

if TYPE_CHECKING:
    from changedetect.coregistration.estimation import Solution
    from changedetect.coregistration.sample import Sample
    from changedetect.coregistration.settings import AlignmentSettings
    from changedetect.coregistration.surfaces import ReferenceSurface
    from changedetect.coregistration.transform import Kind

__all__ = ["Choice", "choose", "leaves_out"]

logger = logging.getLogger(__name__)

#: Parameters of the larger kinds that each kind contains.
_CONTAINED: dict[Kind, frozenset[str]] = {
    "vertical": frozenset({"up"}),
    "shift": frozenset({"east", "north", "up"}),
    # a tilt is a rotation about a horizontal axis, to first order
    "shift_tilt": frozenset({"east", "north", "up", "tilt_east", "tilt_north", "rotation_east", "rotation_north"}),
    "rigid": frozenset({"east", "north", "up", "rotation_east", "rotation_north", "rotation_up"}),
    "similarity": frozenset({"east", "north", "up", "rotation_east", "rotation_north", "rotation_up", "scale"}),
}


@dataclass(frozen=True)
class Choice:
    """The fit that was taken, the kinds considered, and why not more if the ground was the reason."""

    fit: Fit
    candidates: tuple[Candidate, ...]
    fallback: str | None


def leaves_out(kind: Kind, largest: Fit) -> tuple[float, float]:
    """
    Test whether what a kind leaves out of a larger fit is zero.

    Parameters
    ----------
    kind : str
    largest : Fit
        Of a larger kind.

    Returns
    -------
    statistic, p_value : float

    Notes
    -----
    Wald statistic theta' V^-1 theta / k of the k parameters left out, against the F distribution with k and the
    smallest of their degrees of freedom. A likelihood ratio or BIC that counts observations would find a tilt in
    every survey, since correlated errors are tilted over any area; V has that in it.
    """
    names = largest.transform.names
    out = [k for k, name in enumerate(names) if name not in _CONTAINED[kind]]
    theta = np.array(largest.transform.parameters)[out]
    scale = np.sqrt(np.diag(largest.covariance)[out])
    correlation = largest.covariance[np.ix_(out, out)] / np.outer(scale, scale)
    statistic = float((theta / scale) @ np.linalg.pinv(correlation) @ (theta / scale)) / len(out)
    return statistic, float(stats.f.sf(statistic, len(out), largest.freedom[out].min()))


def choose(sample: Sample, reference: ReferenceSurface, vertical: Solution, settings: AlignmentSettings) -> Choice:
    """
    Fit the kind asked for, or the simplest that suffices.

    Parameters
    ----------
    sample : Sample
    reference : ReferenceSurface
    vertical : Solution
        Of kind "vertical".
    settings : AlignmentSettings

    Returns
    -------
    choice : Choice

    Raises
    ------
    InputDataError
        A kind was asked for that the ground does not determine.
    """
    wanted = settings.largest_kind if settings.kind == "auto" else settings.kind
    allowed = KINDS[: KINDS.index(wanted) + 1]
    if settings.kind != "auto":
        fit, reason = _fitted(wanted, sample, reference, vertical, settings)
        if reason is not None:
            msg = (
                f"A transform of kind '{wanted}' cannot be estimated: {reason}. Ask for a simpler kind, or 'auto', "
                "or give stable ground with more relief."
            )
            raise InputDataError(msg)
        return Choice(fit, (Candidate(kind=wanted, statistic=None, p_value=None, verdict="asked for"),), None)
    fits: dict[Kind, Fit] = {}
    reasons: dict[Kind, str] = {}
    if len(allowed) > 1:
        _collect("shift", sample, reference, vertical, settings, fits, reasons)
    largest: Kind = "shift" if "shift" in fits else "vertical"
    if "shift" in fits:
        for kind in reversed(allowed[2:]):
            _collect(kind, sample, reference, fits["shift"].solution, settings, fits, reasons)
            if kind in fits:
                largest = kind
                break
    if largest == "vertical":
        fits["vertical"] = assess(vertical, sample)
    return _simplest(sample, reference, vertical, settings, fits, reasons, largest)


def _collect(
    kind: Kind,
    sample: Sample,
    reference: ReferenceSurface,
    before: Solution,
    settings: AlignmentSettings,
    fits: dict[Kind, Fit],
    reasons: dict[Kind, str],
) -> None:
    fit, reason = _fitted(kind, sample, reference, before, settings)
    if reason is None:
        fits[kind] = fit
    else:
        reasons[kind] = reason


def _fitted(
    kind: Kind, sample: Sample, reference: ReferenceSurface, before: Solution, settings: AlignmentSettings
) -> tuple[Fit, str | None]:
    """Fit a kind from a solution of a simpler one; with why it is not determined, or None where it is."""
    n_before = int(np.count_nonzero(before.misfit.defined))
    limit = settings.max_parameter_std_m if settings.max_parameter_std_m is not None else 0.5 * reference.reach
    if kind == "vertical":
        return assess(before, sample), None
    if before.transform.kind == "vertical":
        raw = solve(sample, reference, before.transform.promoted("shift"), FIRST_SMOOTHING)
        smoothing = best_smoothing(raw, sample)
        before = solve(sample, reference, raw.transform, smoothing) if smoothing != FIRST_SMOOTHING else raw
    solution = before
    if kind != "shift":
        smoothing = before.instruments.smoothing
        solution = solve(sample, reference, before.transform.promoted(kind), smoothing)
    fit = assess(solution, sample)
    reason = undetermined(fit, sample, n_before, limit)
    logger.debug("%s: %s, standard errors %s", kind, fit.transform.parameters, np.sqrt(np.diag(fit.covariance)))
    return fit, reason


def _simplest(
    sample: Sample,
    reference: ReferenceSurface,
    vertical: Solution,
    settings: AlignmentSettings,
    fits: dict[Kind, Fit],
    reasons: dict[Kind, str],
    largest: Kind,
) -> Choice:
    """Take the first kind whose rest is not significant."""
    candidates = []
    taken: Kind | None = None
    for kind in KINDS[: KINDS.index(largest)]:
        statistic, p_value = leaves_out(kind, fits[largest])
        suffices = p_value > settings.significance
        if taken is not None:
            verdict = f"more than needed: '{taken}' suffices"
        elif suffices:
            taken = kind
            verdict = f"taken: what it leaves out is not significant (p = {p_value:.2g})"
        else:
            verdict = f"leaves out what is significant (p = {p_value:.2g})"
        candidates.append(Candidate(kind=kind, statistic=statistic, p_value=p_value, verdict=verdict))
    is_last = taken is None
    taken = taken or largest
    verdict = "taken: the largest that the ground determines" if is_last else f"more than needed: '{taken}' suffices"
    candidates.append(Candidate(kind=largest, statistic=None, p_value=None, verdict=verdict))
    candidates += [
        Candidate(kind=kind, statistic=None, p_value=None, verdict=f"not determined: {reason}")
        for kind, reason in sorted(reasons.items(), key=lambda item: KINDS.index(item[0]))
    ]
    if taken not in fits:
        before = vertical if taken == "vertical" else fits["shift"].solution
        fits[taken], reason = _fitted(taken, sample, reference, before, settings)
        if reason is not None:
            taken = largest
    fallback = reasons.get("shift") if taken == "vertical" else None
    return Choice(fits[taken], tuple(candidates), fallback)


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
