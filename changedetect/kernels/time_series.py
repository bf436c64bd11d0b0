"""
What single series of levels with known variances did: nothing, a trend, a step that stays, a change that came and went.

All statistics are contrasts of independent values, so prefix sums of the weights give each of them in constant time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, IntArray

__all__ = ["N_RESULT", "largest_interval_scores", "scan_series"]

N_RESULT = 26
#: Columns of the results of `scan_series`.
(
    N_OBSERVED,  # surveys that saw the place
    TREND,  # per unit of time
    TREND_STD,
    P_CHANGED,  # of the largest trend or step, over all dates
    INTERVAL_SCORE,  # largest normal score of a change that came and went
    EVIDENCE_TREND,  # logarithms of the Bayes factors of a trend, a step at any date, a change that came and went
    EVIDENCE_STEP,
    EVIDENCE_INTERVAL,
    FIRST_AFTER,  # index of the first epoch after the most probable step
    LAST_BEFORE,  # index of the last epoch before it that saw the place
    EARLIEST,  # index of the last epoch before the credible set of dates
    LATEST,  # index of the first epoch after it
    SIZE,  # level after less level before
    SIZE_STD,
    N_BEFORE,  # surveys before
    N_CONFIRMING,  # later surveys that agree with the new level and not with the old one
    N_CONTRADICTING,  # later surveys that agree with the old level and not with the new one
    NEWEST_CONTRADICTS,  # whether the newest survey is one of these
    INTERVAL_FIRST,  # index of the first epoch of the most probable interval
    INTERVAL_END,  # index of the first epoch after it
    INTERVAL_SIZE,
    INTERVAL_SIZE_STD,
    RESIDUAL_NONE,  # weighted residual sums of squares about the four models
    RESIDUAL_TREND,
    RESIDUAL_STEP,
    RESIDUAL_INTERVAL,
) = range(N_RESULT)
#: Rows of the prefix sums: weights, weights times values, squared weights over degrees of freedom, weights times times.
_W, _S, _Q, _T = range(4)
#: Share of the probability of a step at any date that the credible set of dates holds.
_CREDIBLE = 0.95


@njit(cache=True, error_model="numpy")
def _normal_score(t: float, freedom: float) -> float:
    """Normal score of Student's t (Wallace 1959)."""
    if freedom > 1e6:
        return t
    size = math.sqrt(freedom * math.log1p(t * t / freedom)) * (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0)
    return size if t >= 0.0 else -size


@njit(cache=True, error_model="numpy")
def _both_share(table: FloatArray, largest: float, score: float, correlation: float) -> float:
    """P(|a| > score, |b| > score) / P(|a| > score) of two normal scores, from a table over score and sqrt(1 - rho)."""
    n, m = table.shape
    u = min(score / largest, 1.0) * (n - 1)
    v = math.sqrt(max(0.0, 1.0 - abs(correlation))) * (m - 1)
    i, j = min(int(u), n - 2), min(int(v), m - 2)
    u -= i
    v -= j
    low = table[i, j] * (1.0 - v) + table[i, j + 1] * v
    high = table[i + 1, j] * (1.0 - v) + table[i + 1, j + 1] * v
    return low * (1.0 - u) + high * u


@njit(cache=True, error_model="numpy")
def _log_evidence(score: float, variance: float, prior: float) -> float:
    """Logarithm of the Bayes factor of a contrast of normal prior variance `prior` against one that is zero."""
    total = variance + prior
    return 0.5 * math.log(variance / total) + 0.5 * score * score * prior / total


@njit(cache=True, error_model="numpy")
def _fit_trend(
    y: FloatArray,
    w: FloatArray,
    q: FloatArray,
    t: FloatArray,
    m: int,
    prior: float,
    common: float,
    sums: FloatArray,
    result: FloatArray,
) -> tuple[float, float, float]:
    """Normal score of a straight line, its log evidence, and the weighted spread of the times; fills the sums _T."""
    centre = 0.0
    for k in range(m):
        centre += w[k] * t[k]
    centre /= sums[_W, m]
    mean = sums[_S, m] / sums[_W, m]
    residual = spread = moment = moment_q = 0.0
    for k in range(m):
        offset = t[k] - centre
        residual += w[k] * (y[k] - mean) ** 2
        spread += w[k] * offset * offset
        moment += w[k] * offset * (y[k] - mean)
        moment_q += q[k] * offset**4
        sums[_T, k + 1] = sums[_T, k] + w[k] * offset
    result[RESIDUAL_NONE] = residual
    if m < 3:
        return 0.0, -np.inf, 0.0
    slope, variance = moment / spread, 1.0 / spread
    t_value = slope / math.sqrt(variance)
    score = _normal_score(t_value, spread**2 / max(moment_q, 1e-300))
    result[TREND], result[TREND_STD] = slope, math.sqrt(variance)
    result[RESIDUAL_TREND] = residual - moment * moment / spread
    span = t[m - 1] - t[0]
    return score, _log_evidence(_normal_score(t_value, common), variance, prior / (span * span)), spread


@njit(cache=True, error_model="numpy")
def _fit_steps(
    m: int, prior: float, spread: float, common: float, sums: FloatArray, evidence: FloatArray
) -> tuple[float, float]:
    """Largest absolute score of a step, largest correlation of one with the trend; log evidence of each date."""
    total_w, total_s, total_q = sums[_W, m], sums[_S, m], sums[_Q, m]
    largest = closest = 0.0
    for k in range(1, m):
        before, after = sums[_W, k], total_w - sums[_W, k]
        variance = 1.0 / before + 1.0 / after
        size = (total_s - sums[_S, k]) / after - sums[_S, k] / before
        freedom = variance**2 / max(sums[_Q, k] / before**4 + (total_q - sums[_Q, k]) / after**4, 1e-300)
        t_value = size / math.sqrt(variance)
        evidence[k] = _log_evidence(_normal_score(t_value, common), variance, prior)
        largest = max(largest, abs(_normal_score(t_value, freedom)))
        if spread > 0.0:
            closest = max(closest, abs(sums[_T, k]) / math.sqrt(before * after / total_w * spread))
    return largest, closest


@njit(cache=True, error_model="numpy")
def _p_value(score: float, closest: float, m: int, sums: FloatArray, table: FloatArray, largest: float) -> float:
    """Improved Bonferroni bound of P(any step or the trend exceeds a score)."""
    total = sums[_W, m]
    n_free = float(m - 1)
    for k in range(1, m - 1):
        before, next_before = sums[_W, k], sums[_W, k + 1]
        rho = math.sqrt(before * (total - next_before) / (next_before * (total - before)))
        n_free -= _both_share(table, largest, score, rho)
    if m >= 3:
        n_free += 1.0 - _both_share(table, largest, score, closest)
    return min(1.0, math.erfc(score / math.sqrt(2.0)) * n_free)


@njit(cache=True, error_model="numpy")
def _fit_intervals(index: IntArray, m: int, prior: float, common: float, sums: FloatArray, result: FloatArray) -> float:
    """Log evidence of a change that came and went, the mean over all intervals; fills in the most probable one."""
    total_w, total_s, total_q = sums[_W, m], sums[_S, m], sums[_Q, m]
    largest, top, total = 0.0, -np.inf, 0.0
    for i in range(1, m - 1):
        for j in range(i + 1, m):
            inside = sums[_W, j] - sums[_W, i]
            outside = total_w - inside
            part, part_q = sums[_S, j] - sums[_S, i], sums[_Q, j] - sums[_Q, i]
            variance = 1.0 / inside + 1.0 / outside
            size = part / inside - (total_s - part) / outside
            freedom = variance**2 / max(part_q / inside**4 + (total_q - part_q) / outside**4, 1e-300)
            t_value = size / math.sqrt(variance)
            largest = max(largest, abs(_normal_score(t_value, freedom)))
            evidence = _log_evidence(_normal_score(t_value, common), variance, prior)
            if evidence <= top:
                total += math.exp(evidence - top)
                continue
            total = total * math.exp(top - evidence) + 1.0
            top = evidence
            result[INTERVAL_FIRST], result[INTERVAL_END] = index[i], index[j]
            result[INTERVAL_SIZE], result[INTERVAL_SIZE_STD] = size, math.sqrt(variance)
            result[RESIDUAL_INTERVAL] = result[RESIDUAL_NONE] - size * size / variance
    result[INTERVAL_SCORE] = largest
    return top + math.log(total) - math.log(0.5 * (m - 1.0) * (m - 2.0)) if m >= 3 else -np.inf


@njit(cache=True, error_model="numpy")
def _date_step(index: IntArray, m: int, evidence: FloatArray, result: FloatArray) -> tuple[int, float]:
    """Most probable date of a step and the log of the summed evidence; fills in the dates that are credible."""
    best = 1
    for k in range(2, m):
        if evidence[k] > evidence[best]:
            best = k
    total = 0.0
    for k in range(1, m):
        total += math.exp(evidence[k] - evidence[best])
    log_total = evidence[best] + math.log(total)
    low = high = best
    mass = math.exp(evidence[best] - log_total)
    while mass < _CREDIBLE and (low > 1 or high < m - 1):
        down = evidence[low - 1] if low > 1 else -np.inf
        up = evidence[high + 1] if high < m - 1 else -np.inf
        if down >= up:
            low -= 1
        else:
            high += 1
        mass += math.exp(max(down, up) - log_total)
    result[FIRST_AFTER], result[LAST_BEFORE] = index[best], index[best - 1]
    result[EARLIEST], result[LATEST] = index[low - 1], index[high]
    return best, log_total


@njit(cache=True, error_model="numpy")
def _describe_step(
    best: int, y: FloatArray, w: FloatArray, m: int, limit: float, sums: FloatArray, result: FloatArray
) -> None:
    """Fill in size and standard deviation of a step, and the surveys since that say yes or no."""
    before, after = sums[_W, best], sums[_W, m] - sums[_W, best]
    old, new = sums[_S, best] / before, (sums[_S, m] - sums[_S, best]) / after
    variance = 1.0 / before + 1.0 / after
    result[SIZE], result[SIZE_STD] = new - old, math.sqrt(variance)
    result[RESIDUAL_STEP] = result[RESIDUAL_NONE] - (new - old) ** 2 / variance
    result[N_BEFORE] = best
    confirming = contradicting = 0
    for k in range(best, m):
        own = 1.0 / w[k]
        agrees_new = abs(y[k] - new) <= limit * math.sqrt(own)
        agrees_old = abs(y[k] - old) <= limit * math.sqrt(own + 1.0 / before)
        confirming += agrees_new and not agrees_old
        contradicting += agrees_old and not agrees_new
        result[NEWEST_CONTRADICTS] = agrees_old and not agrees_new
    result[N_CONFIRMING], result[N_CONTRADICTING] = confirming, contradicting


@njit(cache=True, error_model="numpy")
def _scan_one(
    index: IntArray,
    y: FloatArray,
    w: FloatArray,
    q: FloatArray,
    t: FloatArray,
    m: int,
    limit: float,
    prior: float,
    table: FloatArray,
    largest: float,
    result: FloatArray,
) -> None:
    """Scan one series of m values: y values, w weights, q squared weights over degrees of freedom, t times."""
    sums = np.zeros((4, m + 1))
    evidence = np.empty(m)
    for k in range(m):
        sums[_W, k + 1] = sums[_W, k] + w[k]
        sums[_S, k + 1] = sums[_S, k] + w[k] * y[k]
        sums[_Q, k + 1] = sums[_Q, k] + q[k]
    # models are compared with the same degrees of freedom: large values of t would else be ranked by these
    common = sums[_W, m] ** 2 / max(sums[_Q, m], 1e-300)
    score_trend, trend, spread = _fit_trend(y, w, q, t, m, prior, common, sums, result)
    score_step, closest = _fit_steps(m, prior, spread, common, sums, evidence)
    result[P_CHANGED] = _p_value(max(score_step, abs(score_trend)), closest, m, sums, table, largest)
    interval = _fit_intervals(index, m, prior, common, sums, result)
    best, step = _date_step(index, m, evidence, result)
    _describe_step(best, y, w, m, limit, sums, result)
    result[EVIDENCE_TREND] = trend
    result[EVIDENCE_STEP] = step - math.log(m - 1.0)
    result[EVIDENCE_INTERVAL] = interval


@njit(cache=True, parallel=True, error_model="numpy")
def scan_series(
    values: FloatArray,
    variances: FloatArray,
    shares: FloatArray,
    time: FloatArray,
    limit: float,
    prior_std: float,
    table: FloatArray,
    largest: float,
    results: FloatArray,
) -> None:
    """
    Scan series for trends, steps and changes that came and went.

    Parameters
    ----------
    values, variances : array, shape (n_series, n_epochs), m, m2
        Levels with independent errors; NaN where there is none.
    shares : array, shape (n_series, n_epochs)
        1 / degrees of freedom of each variance; 0 for a known one.
    time : array, shape (n_epochs,)
        Ascending.
    limit : float
        Standard deviations within which a survey agrees with a level.
    prior_std : float, m
        Standard deviation of the sizes of changes.
    table : array
        P(|a| > c, |b| > c) / P(|a| > c) over c from 0 to `largest` and sqrt(1 - rho) from 0 to 1.
    largest : float
    results : array, shape (n_series, N_RESULT)
        Filled in place, columns as named above. NaN where a series has fewer than two values; trend and interval need
        three.

    Notes
    -----
    With weights w = 1 / variance all estimates are weighted means and slopes (generalised least squares with a
    diagonal covariance), and every score is a contrast of them. P_CHANGED is Worsley's improved Bonferroni bound: the
    sum over the contrasts of P(|z| > c), less P of both for each pair of neighbouring dates, and for the trend and the
    step closest to it: a tree of pairs (Hunter 1976 [1]_, Worsley 1982 [2]_).

    References
    ----------
    .. [1] Hunter (1976), An upper bound for the probability of a union, Journal of Applied Probability 13, 597-603.
    .. [2] Worsley (1982), An improved Bonferroni inequality and applications, Biometrika 69, 297-302.
    """
    n_series, n = values.shape
    for c in prange(n_series):
        index = np.empty(n, np.int64)
        y, w, q, t = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
        m = 0
        for k in range(n):
            v = variances[c, k]
            if math.isnan(values[c, k]) or math.isnan(v) or v <= 0.0:
                continue
            index[m], y[m], w[m], t[m] = k, values[c, k], 1.0 / v, time[k]
            q[m] = w[m] * w[m] * shares[c, k]
            m += 1
        for k in range(N_RESULT):
            results[c, k] = np.nan
        if m >= 2:
            _scan_one(index, y, w, q, t, m, limit, prior_std**2, table, largest, results[c])
        results[c, N_OBSERVED] = m


@njit(cache=True, parallel=True, error_model="numpy")
def largest_interval_scores(draws: FloatArray, scores: FloatArray) -> None:
    """
    Largest absolute score of a change that came and went, in series of equal variances.

    Parameters
    ----------
    draws : array, shape (n_series, n_epochs)
        Standard normal.
    scores : array, shape (n_series,)
        Filled in place.
    """
    n_series, m = draws.shape
    for c in prange(n_series):
        sums = np.zeros(m + 1)
        for k in range(m):
            sums[k + 1] = sums[k] + draws[c, k]
        most = 0.0
        for i in range(1, m - 1):
            for j in range(i + 1, m):
                n_in = float(j - i)
                n_out = m - n_in
                part = sums[j] - sums[i]
                most = max(most, abs(part / n_in - (sums[m] - part) / n_out) / math.sqrt(1.0 / n_in + 1.0 / n_out))
        scores[c] = most
