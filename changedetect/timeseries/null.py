"""What series of surveys without change show: the distribution of the largest of many scores."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy import special

from changedetect.kernels.time_series import largest_interval_scores
from changedetect.typing import FloatArray

__all__ = ["LARGEST_SCORE", "both_exceed_table", "interval_p_values"]

#: End of the tables of scores; beyond it nothing matters.
LARGEST_SCORE = 9.0
_N_SCORES, _N_CORRELATIONS = 91, 129
_N_NODES = 80
#: Simulated series for each number of surveys, and its upper shares that the tail is taken from.
_N_DRAWS = 40_000
_TAIL_SHARES = (0.10, 0.01)
#: Numbers of surveys that are simulated: each up to this, then in steps of this ratio.
_EACH_UP_TO = 10
_COUNT_RATIO = 1.25
_BLOCK = 2_000_000


@cache
def both_exceed_table() -> FloatArray:
    """
    Share of the exceedances of one normal score that another, correlated one shares.

    Returns
    -------
    table : array, shape (n_scores, n_correlations)
        P(|a| > c, |b| > c) / P(|a| > c), rows c evenly from 0 to `LARGEST_SCORE`, columns sqrt(1 - rho) evenly from 0
        to 1, rho the correlation.

    Notes
    -----
    Given a = x > c, b is normal about rho x with variance 1 - rho^2; x is integrated by Gauss-Legendre quadrature over
    equal shares of its tail.
    """
    c = np.linspace(0.0, LARGEST_SCORE, _N_SCORES)[:, None, None]
    rho = 1.0 - np.linspace(0.0, 1.0, _N_CORRELATIONS)[None, :, None] ** 2
    nodes, weights = np.polynomial.legendre.leggauss(_N_NODES)
    # the substitution u^4 puts nodes where x is large
    u = 0.5 * (nodes + 1.0)
    x = special.ndtri_exp(special.log_ndtr(-c) + 4.0 * np.log(u)[None, None, :])
    x = -x
    density = 0.5 * weights * 4.0 * u**3
    spread = np.sqrt(np.maximum(1.0 - rho**2, 1e-300))
    same = special.ndtr((rho * x - c) / spread)
    opposite = special.ndtr((-rho * x - c) / spread)
    table = np.sum((same + opposite) * density, axis=-1)
    table[:, 0] = 1.0
    table.setflags(write=False)
    return np.asarray(table)


def interval_p_values(scores: FloatArray, n_observed: FloatArray) -> FloatArray:
    """
    How rarely series without change show a change that came and went with at least this score.

    Parameters
    ----------
    scores : array, shape (n,)
        Largest normal score over all intervals of surveys with surveys before and after; NaN stays.
    n_observed : array, shape (n,)
        Number of surveys.

    Returns
    -------
    p_values : array, shape (n,)

    Notes
    -----
    The probability is a number of independent contrasts, found by simulation, times that of a single one. The number
    grows with the square of the score, at most to that of all intervals. Series of equal variances are simulated:
    unequal ones make intervals more alike and their maximum smaller.
    """
    p_values = np.full(scores.shape, np.nan)
    for m in np.unique(n_observed[np.isfinite(scores)]).astype(int):
        here = (n_observed == m) & np.isfinite(scores)
        if m < 3:
            continue
        squares, counts = _effective_counts(int(m))
        slope = (counts[1] - counts[0]) / (squares[1] - squares[0])
        c2 = scores[here] ** 2
        n_intervals = 0.5 * (m - 1.0) * (m - 2.0)
        effective = np.clip(counts[0] + slope * (c2 - squares[0]), 1.0, n_intervals)
        p_values[here] = np.minimum(1.0, effective * special.erfc(scores[here] / math.sqrt(2.0)))
    return p_values


def _effective_counts(m: int) -> tuple[FloatArray, FloatArray]:
    """Squared score and effective number of contrasts at two levels of the tail, interpolated in the surveys."""
    if m <= _EACH_UP_TO:
        return _simulated_counts(m)
    step = math.log(m / _EACH_UP_TO) / math.log(_COUNT_RATIO)
    ends = [round(_EACH_UP_TO * _COUNT_RATIO**k) for k in (math.floor(step), math.ceil(step))]
    low, high = (_simulated_counts(k) for k in ends)
    share = 0.0 if ends[0] == ends[1] else math.log(m / ends[0]) / math.log(ends[1] / ends[0])
    return low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1])


@cache
def _simulated_counts(m: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(m)
    found = []
    left = _N_DRAWS
    while left > 0:
        n = min(left, max(1, _BLOCK // m))
        scores = np.empty(n)
        largest_interval_scores(rng.standard_normal((n, m)), scores)
        found.append(scores)
        left -= n
    quantiles = np.quantile(np.concatenate(found), [1.0 - share for share in _TAIL_SHARES])
    singles = special.erfc(quantiles / math.sqrt(2.0))
    return quantiles**2, np.array(_TAIL_SHARES) / singles
