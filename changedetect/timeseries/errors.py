"""
Errors of each epoch apart, found in contrasts of neighbouring epochs.

An error that is correlated over metres to hundreds of metres is found in a difference on ground that did not change
(`changedetect.differencing.error_model`), where it is the sum of what all epochs of the difference contribute. The
contrasts of every epoch with the mean of its neighbours in time together tell what each contributes: the error of the
first epoch must not be counted as if every later epoch had it anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls

from changedetect.differencing.correlation import NestedCorrelation
from changedetect.differencing.error_model import ErrorModel
from changedetect.differencing.error_scale import ErrorScale
from changedetect.differencing.maps import Evidence
from changedetect.differencing.pair import cell_errors

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.timeseries.stack import Stack
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["combined_model", "epoch_errors"]

#: Epochs that an epoch is compared with: the nearest in time.
_N_NEIGHBOURS = 4
#: Standard deviation of an epoch's variance about that of a typical epoch, relative, before anything is looked at.
_PRIOR_SPREAD = 1.0
#: No epoch is taken to be freer than this of the errors that the others have, relative to a typical one.
_LEAST_SHARE = 0.1
#: Squared relative sampling error of a variance found in n independent values, times n; 2 for the contrast itself, more
#: for what is taken apart from it.
_SAMPLING = 3.0


@dataclass(frozen=True)
class _Contrast:
    """What the contrast of one epoch with its neighbours showed: factors of all epochs' variances in its own."""

    factors: FloatArray
    level: float
    model: ErrorModel


def epoch_errors(stack: Stack, stable: BoolArray | None) -> list[ErrorModel]:
    """
    Correlated errors of every epoch; their variances and tails go into `stack.correlated` and `stack.tails`.

    Parameters
    ----------
    stack : Stack
    stable : array, shape (n_rows, n_cols), bool, optional
        Ground known not to have changed. Otherwise it is found, contrast by contrast.

    Returns
    -------
    models : list of ErrorModel
        Correlation, tails, typical scale, and how many independent values they are known from.

    Raises
    ------
    TooLittleGroundError
        The given stable ground holds too few cells.

    Notes
    -----
    The contrast of epoch i with the mean of m neighbours has the variance c_i = s2_i + sum_j s2_j / m^2. The s2
    minimise sum_i (s2_i + sum_j s2_j / m^2 - c_i)^2 / var(c_i) + sum_i (s2_i - t)^2 / t^2, s2 >= 0, with t that of a
    typical epoch and var(c_i) = 2 c_i^2 / n_independent. They are then drawn together, in logarithms, as far as they
    scatter no more than so few independent values would make them: an epoch whose variance is too small by chance would
    get too much weight. How the variance goes from place to place is what the epoch's contrast says.
    """
    n = stack.n_epochs
    contrasts: list[_Contrast | None] = []
    for k in range(n):
        evidence, factors = _contrast_evidence(stack, k)
        known = evidence.known
        if not known.any():
            contrasts.append(None)
            continue
        errors = cell_errors(evidence, stack.resolution, stable)
        level = float(np.median(errors.correlated[known])) if errors.model.is_correlated else 0.0
        contrasts.append(_Contrast(factors, level, errors.model))
        if level > 0.0:
            stack.correlated[k] = errors.correlated / level
    variances = _separate(contrasts)
    models = []
    for k, contrast in enumerate(contrasts):
        if contrast is None or contrast.level <= 0.0:
            stack.correlated[k] = variances[k]
        else:
            stack.correlated[k] *= np.float32(variances[k])
        models.append(_epoch_model(contrasts, k, float(variances[k]), stack.correlation_length))
        stack.tails[k] = models[k].scale.freedom
    return models


def _neighbours(n: int, k: int) -> list[int]:
    return sorted((j for j in range(n) if j != k), key=lambda j: (abs(j - k), j))[:_N_NEIGHBOURS]


def _contrast_evidence(stack: Stack, k: int) -> tuple[Evidence, FloatArray]:
    """Epoch k less the mean of its neighbours, and the mean factors of all epochs' variances in that."""
    own = stack.layers(k)
    shape = own.value.shape
    number, total, variance, spread, count = (np.zeros(shape) for _ in range(5))
    seen: dict[int, FloatArray] = {}
    for j in _neighbours(stack.n_epochs, k):
        other = stack.layers(j)
        known = np.isfinite(other.value)
        seen[j] = known.astype(np.float64)
        number += known
        total += np.where(known, other.value, 0.0)
        variance += np.where(known, other.variance, 0.0)
        spread += np.where(known, other.variance**2 / other.freedom, 0.0)
        count += np.where(known, other.count, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_variance = own.variance + variance / number**2
        freedom = mean_variance**2 / (own.variance**2 / own.freedom + spread / number**4)
        evidence = Evidence(
            difference=own.value - total / number,
            variance=mean_variance,
            freedom=freedom,
            counts=(own.count, count),
            observed=(own.observed, number > 0.0),
            terrain=stack.terrain,
            correlation_length=stack.correlation_length,
        )
        factors = np.zeros(stack.n_epochs)
        factors[k] = 1.0
        both = evidence.known
        if both.any():
            for j, known in seen.items():
                factors[j] = float(np.mean((known / number**2)[both]))
    return evidence, factors


def _separate(contrasts: Sequence[_Contrast | None]) -> FloatArray:
    """Variance of each epoch from those of the contrasts."""
    n = len(contrasts)
    levels = np.array([0.0 if c is None else c.level for c in contrasts])
    sums = np.array([1.0 if c is None else float(c.factors.sum()) for c in contrasts])
    used = np.array([c is not None for c in contrasts])
    if not (levels > 0.0).any():
        return np.zeros(n)
    typical = float(np.mean((levels / sums)[used]))
    design, wanted = [], []
    for contrast in contrasts:
        if contrast is not None:
            error = math.sqrt(2.0 / max(contrast.model.n_independent, 1.0)) * max(contrast.level, typical)
            design.append(contrast.factors / error)
            wanted.append(contrast.level / error)
    design.append(np.eye(n) / (_PRIOR_SPREAD * typical))
    wanted.extend([1.0 / _PRIOR_SPREAD] * n)
    apart = np.maximum(nnls(np.vstack(design), np.array(wanted))[0], _LEAST_SHARE * typical)
    sampling = _SAMPLING / np.array([1.0 if c is None else max(c.model.n_independent, 1.0) for c in contrasts])
    return _drawn_together(apart, sampling, typical)


def _drawn_together(variances: FloatArray, sampling: FloatArray, typical: float) -> FloatArray:
    """Empirical Bayes: logarithms shrunk to their mean by their scatter beyond that of sampling; the mean is kept."""
    logs = np.log(variances / typical)
    centre = float(logs.mean())
    scatter = float(np.mean((logs - centre) ** 2)) * logs.size / max(logs.size - 1, 1)
    spread = max(0.0, scatter - float(sampling.mean()))
    drawn = np.exp(centre + spread / (spread + sampling) * (logs - centre))
    return np.asarray(drawn * variances.mean() / drawn.mean())


def _epoch_model(contrasts: Sequence[_Contrast | None], k: int, variance: float, side: float) -> ErrorModel:
    """Model of one epoch: that of its contrast, or a mean of all where that shows no correlated errors."""
    own = contrasts[k]
    if own is not None and own.model.is_correlated:
        return replace(own.model, scale=ErrorScale(math.log(variance), freedom=own.model.scale.freedom))
    others = [c.model for c in contrasts if c is not None and c.model.is_correlated]
    if not others or variance <= 0.0:
        local = NestedCorrelation((side / math.sqrt(2.0 * math.pi),), (1.0,))
        return ErrorModel(local, ErrorScale(-math.inf), NestedCorrelation((), ()), 1.0, 0.0)
    mean = combined_model(others, [1.0] * len(others))
    return replace(mean, scale=ErrorScale(math.log(variance), freedom=mean.scale.freedom))


def combined_model(models: Sequence[ErrorModel], variances: Sequence[float]) -> ErrorModel:
    """
    Model of a sum of independent errors.

    Parameters
    ----------
    models : sequence of ErrorModel
        At least one.
    variances : sequence of float, m2
        Typical squared scale of each; where all are zero no errors are correlated.

    Returns
    -------
    model : ErrorModel
        Correlations weighted by the variances; tails by Satterthwaite's rule.
    """
    total = float(sum(v for m, v in zip(models, variances, strict=True) if m.is_correlated))
    if total <= 0.0:
        return replace(models[0], scale=ErrorScale(-math.inf), correlation=NestedCorrelation((), ()))
    shares: dict[float, float] = {}
    inverse = independent = stable = 0.0
    for model, variance in zip(models, variances, strict=True):
        if not model.is_correlated:
            continue
        part = variance / total
        inverse += part**2 / model.scale.freedom
        independent += part * model.n_independent
        stable += part * model.stable_share
        for length, share in zip(model.correlation.ranges, model.correlation.shares, strict=True):
            shares[length] = shares.get(length, 0.0) + share * part
    ranges = tuple(sorted(shares))
    freedom = 1.0 / inverse if inverse > 0.0 else math.inf
    return ErrorModel(
        models[0].local,
        ErrorScale(math.log(total), freedom=freedom),
        NestedCorrelation(ranges, tuple(shares[length] for length in ranges)),
        independent,
        stable,
    )
