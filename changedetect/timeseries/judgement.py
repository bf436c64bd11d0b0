"""Trend, break and class of series of levels: of cells, and of zones."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from changedetect.kernels import time_series as kernel
from changedetect.timeseries.null import LARGEST_SCORE, both_exceed_table, interval_p_values

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = [
    "BREAK_LOWERED",
    "BREAK_RAISED",
    "IRREGULAR",
    "NO_CHANGE",
    "OUTSIDE",
    "RETURNED",
    "TOO_FEW_SURVEYS",
    "TREND_LOWERING",
    "TREND_RAISING",
    "UNCONFIRMED_BREAK",
    "ChangePrior",
    "Judgement",
    "estimate_prior",
    "judge_series",
    "monitoring_level",
]

NO_CHANGE = 0
TREND_LOWERING = 1
TREND_RAISING = 2
BREAK_LOWERED = 3
BREAK_RAISED = 4
UNCONFIRMED_BREAK = 5
RETURNED = 6
IRREGULAR = 7
TOO_FEW_SURVEYS = 8
OUTSIDE = 255

#: A break is confirmed by this many surveys.
CONFIRMATIONS = 2
#: Share of the false-alarm rate that goes to changes that came and went; trends and steps have the rest.
_INTERVAL_SHARE = 0.2
#: Probability of residuals this large, under the model that fits best, below which none is taken to fit.
_MISFIT_LEVEL = 1e-3
#: Parameters of the models nothing, trend, step, interval; a date counts as one.
_PARAMETERS = (1.0, 2.0, 3.0, 4.0)
#: Standard deviations of changes that are tried, in the typical standard deviation of a level.
_SIZES = tuple(2.0 ** (0.5 * k) for k in range(1, 13))
#: The one that counts where series are too few to tell.
_USUAL_SIZE = 8.0
_N_SAMPLE = 4000
_N_ITERATIONS = 60
#: Series that are simulated to hold a rate over all looks, and the most surveys they have.
_N_MONITORED = 4000
_MOST_LOOKS = 60
#: Series of each model that are assumed to have been seen before, as a share of the sample.
_PSEUDO_SHARE = 0.002
DAYS_PER_YEAR = 365.25
_EVIDENCE = (kernel.EVIDENCE_TREND, kernel.EVIDENCE_STEP, kernel.EVIDENCE_INTERVAL)
_RESIDUALS = (kernel.RESIDUAL_NONE, kernel.RESIDUAL_TREND, kernel.RESIDUAL_STEP, kernel.RESIDUAL_INTERVAL)


@dataclass(frozen=True)
class ChangePrior:
    """
    How common changes are, and how large.

    Attributes
    ----------
    size : float, m
        Standard deviation of the size of a change.
    nothing, trend, step, interval : float
        Prior probabilities, one in total.
    """

    size: float
    nothing: float = 0.7
    trend: float = 0.1
    step: float = 0.1
    interval: float = 0.1

    @property
    def shares(self) -> FloatArray:
        """Probabilities in the order nothing, trend, step, interval."""
        return np.array([self.nothing, self.trend, self.step, self.interval])


@dataclass(frozen=True)
class Judgement:
    """
    What series did; all arrays of shape (n_series,), NaN where the surveys are too few.

    Attributes
    ----------
    n_surveys : array, int
    trend, trend_std : array, m per year
        By generalised least squares; the standard deviation is widened where a line does not fit.
    p_value : array
        Probability that a series without change shows as much as this one, over all dates and kinds of change.
    break_probability : array
        Probability that the level changed once, at one date, and stayed.
    break_time, break_time_earliest, break_time_latest : array, days
        Middle between the surveys before and after the most probable break; ends of the time that holds the break
        with 95 % probability, if there is one.
    break_size, break_size_std : array, m
        Level after less level before.
    surveys_before : array
        Surveys before the break.
    confirming_surveys : array
        Surveys since the break that agree with the new level and not with the old one.
    contradicting_surveys : array
        Those that agree with the old level and not with the new one.
    return_time : array, days
        When a change that came and went had gone; NaN for others. Time and size of the break are then its.
    misfit : array
        Mean square of the residuals about the model of the class, in what the errors explain.
    series_class : array, uint8
    """

    n_surveys: NDArray[np.int16]
    trend: FloatArray
    trend_std: FloatArray
    p_value: FloatArray
    break_probability: FloatArray
    break_time: FloatArray
    break_time_earliest: FloatArray
    break_time_latest: FloatArray
    break_size: FloatArray
    break_size_std: FloatArray
    surveys_before: FloatArray
    confirming_surveys: FloatArray
    contradicting_surveys: FloatArray
    return_time: FloatArray
    misfit: FloatArray
    series_class: NDArray[np.uint8]

    @classmethod
    def names(cls) -> list[str]:
        """Names of all arrays."""
        return [field.name for field in fields(cls)]


def judge_series(
    values: FloatArray,
    variances: FloatArray,
    freedom: FloatArray | None,
    time: FloatArray,
    prior: ChangePrior,
    confidence: float,
    level: float | None = None,
) -> Judgement:
    """
    Judge series of levels with independent errors.

    Parameters
    ----------
    values, variances : array, shape (n_series, n_epochs), m, m2
        NaN where not observed. Levels may be counted from anywhere.
    freedom : array, shape (n_series, n_epochs), optional
        Degrees of freedom of the variances; known exactly by default.
    time : array, shape (n_epochs,), days
        Ascending.
    prior : ChangePrior
    confidence : float
        At which a survey agrees with a level, and one less the share of series without change that are given a class
        of change.
    level : float, optional
        That share, if it is another, such as `monitoring_level`.

    Returns
    -------
    judgement : Judgement

    Notes
    -----
    The series is tested against no change at all: the largest score of a trend and of a step at any date by an improved
    Bonferroni bound, that of a change that came and went against simulated ones; the smaller of p / 0.8 and p / 0.2
    counts. Which change it was is decided by the probability of each model. A break is confirmed by two surveys since
    that agree with the new level and not with the old one, if they outnumber those that say the opposite and the newest
    survey is none of these. Where the residuals about the best model are larger than errors make them in one of a
    thousand series, none of the models is taken to fit.
    """
    results = _scan(values, variances, freedom, time, prior.size, confidence)
    column = results.T
    n = column[kernel.N_OBSERVED]
    p_changed, p_interval = column[kernel.P_CHANGED], interval_p_values(column[kernel.INTERVAL_SCORE], n)
    with_interval = np.fmin(p_changed / (1.0 - _INTERVAL_SHARE), p_interval / _INTERVAL_SHARE)
    p_value = np.minimum(1.0, np.where(n >= 3, with_interval, p_changed))
    probabilities = _probabilities(results, prior.shares)[0]
    kind = 1 + np.argmax(probabilities[:, 1:], axis=1)
    kind[~(p_value <= (1.0 - confidence if level is None else level))] = 0
    misfit, fits = _misfit(results, kind)
    came_and_went = kind == 3
    after, before = _at(time, column[kernel.FIRST_AFTER]), _at(time, column[kernel.LAST_BEFORE])
    start = np.where(
        came_and_went, _interval_start(values, time, column[kernel.INTERVAL_FIRST]), 0.5 * (after + before)
    )
    widened = np.sqrt(np.maximum(1.0, column[kernel.RESIDUAL_TREND] / np.maximum(n - 2.0, 1.0)))
    scale = np.sqrt(np.fmax(1.0, misfit))
    return Judgement(
        n_surveys=n.astype(np.int16),
        trend=column[kernel.TREND] * DAYS_PER_YEAR,
        trend_std=column[kernel.TREND_STD] * DAYS_PER_YEAR * widened,
        p_value=p_value,
        break_probability=np.where(n >= 2, probabilities[:, 2], np.nan),
        break_time=start,
        break_time_earliest=np.where(came_and_went, np.nan, _at(time, column[kernel.EARLIEST])),
        break_time_latest=np.where(came_and_went, np.nan, _at(time, column[kernel.LATEST])),
        break_size=np.where(came_and_went, column[kernel.INTERVAL_SIZE], column[kernel.SIZE]),
        break_size_std=np.where(came_and_went, column[kernel.INTERVAL_SIZE_STD], column[kernel.SIZE_STD]) * scale,
        surveys_before=column[kernel.N_BEFORE],
        confirming_surveys=column[kernel.N_CONFIRMING],
        contradicting_surveys=column[kernel.N_CONTRADICTING],
        return_time=np.where(came_and_went, _at(time, column[kernel.INTERVAL_END]), np.nan),
        misfit=misfit,
        series_class=_classes(column, kind, fits),
    )


def _scan(
    values: FloatArray,
    variances: FloatArray,
    freedom: FloatArray | None,
    time: FloatArray,
    size: float,
    confidence: float,
) -> FloatArray:
    shares = np.zeros(values.shape) if freedom is None else 1.0 / np.maximum(freedom, 1.0)
    results = np.empty((len(values), kernel.N_RESULT))
    limit = float(stats.norm.ppf(0.5 + 0.5 * confidence))
    kernel.scan_series(
        np.ascontiguousarray(values), np.ascontiguousarray(variances), np.ascontiguousarray(shares),
        np.asarray(time, np.float64), limit, size, both_exceed_table(), LARGEST_SCORE, results,
    )  # fmt: skip
    return results


def _classes(column: FloatArray, kind: IntArray, fits: BoolArray) -> NDArray[np.uint8]:
    n = column[kernel.N_OBSERVED]
    confirmed = (
        (column[kernel.N_CONFIRMING] >= CONFIRMATIONS)
        & (column[kernel.N_CONFIRMING] > column[kernel.N_CONTRADICTING])
        & (column[kernel.NEWEST_CONTRADICTS] == 0.0)
    )
    classes = np.full(n.shape, NO_CHANGE, np.uint8)
    classes[kind == 1] = np.where(column[kernel.TREND] > 0.0, TREND_RAISING, TREND_LOWERING)[kind == 1]
    classes[kind == 2] = np.where(column[kernel.SIZE] > 0.0, BREAK_RAISED, BREAK_LOWERED)[kind == 2]
    classes[(kind == 2) & ~confirmed] = UNCONFIRMED_BREAK
    classes[kind == 3] = RETURNED
    classes[(kind > 0) & ~fits & (classes != UNCONFIRMED_BREAK)] = IRREGULAR
    classes[n < 2] = TOO_FEW_SURVEYS
    classes[n < 1] = OUTSIDE
    return classes


def _misfit(results: FloatArray, kind: IntArray) -> tuple[FloatArray, BoolArray]:
    """Mean square of the residuals about the chosen model, and whether it fits."""
    residual = np.choose(kind, [results[:, k] for k in _RESIDUALS])
    freedom = results[:, kernel.N_OBSERVED] - np.asarray(_PARAMETERS)[kind]
    judged = (freedom >= 1.0) & np.isfinite(residual)
    nu = np.where(judged, freedom, 1.0)
    fits = ~judged | (stats.chi2.sf(np.where(judged, residual, 0.0), nu) > _MISFIT_LEVEL)
    return np.where(judged, residual / nu, np.nan), fits


def _at(time: FloatArray, index: FloatArray) -> FloatArray:
    known = np.isfinite(index)
    return np.where(known, time[np.where(known, index, 0.0).astype(int)], np.nan)


def _interval_start(values: FloatArray, time: FloatArray, first: FloatArray) -> FloatArray:
    """Middle between the first survey of an interval and the one before it that saw the place."""
    start = np.full(first.shape, np.nan)
    n = values.shape[1]
    for k in range(1, n):
        here = first == k
        if here.any():
            seen = np.isfinite(values[here, :k])
            before = k - 1 - np.argmax(seen[:, ::-1], axis=1)
            start[here] = 0.5 * (time[k] + time[before])
    return start


def estimate_prior(
    values: FloatArray, variances: FloatArray, freedom: FloatArray | None, time: FloatArray
) -> ChangePrior:
    """
    How common and how large changes are, by maximum likelihood over many series.

    Parameters
    ----------
    values, variances, freedom : array, shape (n_series, n_epochs)
        As for `judge_series`; at most 4000 of the series, evenly spread, are looked at.
    time : array, shape (n_epochs,), days

    Returns
    -------
    prior : ChangePrior

    Notes
    -----
    Empirical Bayes with the mixture nothing, trend, step, interval; its shares by expectation-maximisation for each of
    some sizes. That half of many series changed makes a change of one of them probable.
    """
    usable = np.flatnonzero(np.isfinite(values).sum(axis=1) >= 2)
    typical = math.sqrt(float(np.nanmedian(variances))) if usable.size else 1.0
    best = ChangePrior(_USUAL_SIZE * typical)
    if usable.size < 100:
        return best
    chosen = usable[np.unique(np.linspace(0, usable.size - 1, _N_SAMPLE).astype(int))]
    part = (values[chosen], variances[chosen], None if freedom is None else freedom[chosen])
    highest = -math.inf
    for size in _SIZES:
        results = _scan(*part, time, size * typical, 0.95)
        shares, likelihood = _mixture(results)
        if likelihood > highest:
            highest, best = likelihood, ChangePrior(size * typical, *shares.tolist())
    return best


def _probabilities(results: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Probability of nothing, trend, step, interval, shape (n, 4), and the log-likelihood of each series."""
    evidence = np.zeros((len(results), len(shares)))
    evidence[:, 1:] = np.where(np.isnan(results[:, _EVIDENCE]), -np.inf, results[:, _EVIDENCE])
    logs = evidence + np.log(shares)
    top = logs.max(axis=1, keepdims=True)
    weights = np.exp(logs - top)
    total = weights.sum(axis=1, keepdims=True)
    return weights / total, (top + np.log(total))[:, 0]


def _mixture(results: FloatArray) -> tuple[FloatArray, float]:
    """Shares of the models by expectation-maximisation, and the mean log-likelihood."""
    shares = np.full(4, 0.25)
    likelihood = -math.inf
    for _ in range(_N_ITERATIONS):
        probabilities, logs = _probabilities(results, shares)
        likelihood = float(logs.mean())
        shares = probabilities.mean(axis=0) + _PSEUDO_SHARE
        shares /= shares.sum()
    return shares, likelihood


@cache
def monitoring_level(n_epochs: int, rate: float) -> float:
    """
    Level of each look at a growing series that is held over all looks together.

    Parameters
    ----------
    n_epochs : int
        Surveys so far: the series was looked at after each from the second on.
    rate : float
        Share of series without change that may ever be given a class of change.

    Returns
    -------
    level : float
        For `judge_series`. Series of more than 60 surveys are extrapolated: the level falls with the logarithm of
        their number.

    Notes
    -----
    The smallest p-value of all looks at simulated series of equal variances and intervals.
    """
    if n_epochs > _MOST_LOOKS:
        half, whole = (monitoring_level(n, rate) for n in (_MOST_LOOKS // 2, _MOST_LOOKS))
        slope = (1.0 / whole - 1.0 / half) / math.log(2.0)
        return 1.0 / (1.0 / whole + slope * math.log(n_epochs / _MOST_LOOKS))
    values = np.random.default_rng(n_epochs).standard_normal((_N_MONITORED, n_epochs))
    time = np.arange(n_epochs, dtype=np.float64)
    smallest = np.ones(_N_MONITORED)
    for k in range(2, n_epochs + 1):
        part = values[:, :k]
        judged = judge_series(part, np.ones(part.shape), None, time[:k], ChangePrior(1.0), 1.0 - rate)
        smallest = np.minimum(smallest, judged.p_value)
    return float(np.quantile(smallest, rate))
