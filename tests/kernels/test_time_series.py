"""Scans of single series against slow sums over the definition."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from changedetect.kernels import time_series as kernel
from changedetect.timeseries.null import LARGEST_SCORE, both_exceed_table


def scan(values, variances, time=None, freedom=None, size=1.0, limit=1.96):
    values = np.atleast_2d(np.asarray(values, float))
    variances = np.broadcast_to(np.asarray(variances, float), values.shape)
    shares = np.zeros(values.shape) if freedom is None else np.broadcast_to(1.0 / freedom, values.shape)
    time = np.arange(values.shape[1], dtype=float) if time is None else np.asarray(time, float)
    results = np.empty((len(values), kernel.N_RESULT))
    kernel.scan_series(
        values, np.ascontiguousarray(variances), np.ascontiguousarray(shares), time, limit, size,
        both_exceed_table(), LARGEST_SCORE, results,
    )  # fmt: skip
    return results


def line_fit(columns, y, variance):
    """Generalised least squares: estimates, covariance, weighted residual sum."""
    x = np.column_stack(columns)
    weight = np.diag(1.0 / variance)
    covariance = np.linalg.inv(x.T @ weight @ x)
    beta = covariance @ x.T @ weight @ y
    left = y - x @ beta
    return beta, covariance, float(left @ weight @ left)


@pytest.fixture
def case():
    rng = np.random.default_rng(3)
    n = 9
    variance = rng.uniform(0.5, 3.0, n)
    time = np.cumsum(rng.uniform(0.5, 2.0, n))
    y = rng.normal(0.0, np.sqrt(variance)) + 2.0 * (np.arange(n) >= 5)
    return y, variance, time


def test_trend_and_steps_are_those_of_generalised_least_squares(case):
    y, variance, time = case
    (row,) = scan(y, variance, time)
    ones = np.ones(y.size)
    beta, covariance, residual = line_fit([ones, time], y, variance)
    assert_allclose(row[kernel.TREND], beta[1], rtol=1e-12, atol=0)
    assert_allclose(row[kernel.TREND_STD], math.sqrt(covariance[1, 1]), rtol=1e-12, atol=0)
    assert_allclose(row[kernel.RESIDUAL_TREND], residual, rtol=1e-10, atol=0)
    scores, fits = [abs(beta[1]) / math.sqrt(covariance[1, 1])], []
    for k in range(1, y.size):
        step, spread, left = line_fit([ones, np.arange(y.size) >= k], y, variance)
        fits.append((step[1], math.sqrt(spread[1, 1]), left))
        scores.append(abs(step[1]) / math.sqrt(spread[1, 1]))
    k = int(row[kernel.FIRST_AFTER])
    assert row[kernel.LAST_BEFORE] == k - 1
    found = [row[c] for c in (kernel.SIZE, kernel.SIZE_STD, kernel.RESIDUAL_STEP)]
    assert_allclose(found, fits[k - 1], rtol=1e-10, atol=0)
    bonferroni = len(scores) * 2.0 * stats.norm.sf(max(scores))
    single = 2.0 * stats.norm.sf(max(scores))
    assert single <= row[kernel.P_CHANGED] <= bonferroni


def test_evidence_is_that_of_all_dates_together(case):
    y, variance, time = case
    size = 1.5
    (row,) = scan(y, variance, time, size=size)

    def evidence(design, prior):
        beta, covariance, _ = line_fit([np.ones(y.size), design], y, variance)
        v = covariance[1, 1]
        return stats.norm.pdf(beta[1], 0.0, math.sqrt(v + prior)) / stats.norm.pdf(beta[1], 0.0, math.sqrt(v))

    number = np.arange(y.size)
    steps = [evidence(number >= k, size**2) for k in range(1, y.size)]
    intervals = [
        evidence((number >= i) & (number < j), size**2) for i in range(1, y.size - 1) for j in range(i + 1, y.size)
    ]
    trend = evidence(time, (size / (time[-1] - time[0])) ** 2)
    columns = [kernel.EVIDENCE_TREND, kernel.EVIDENCE_STEP, kernel.EVIDENCE_INTERVAL]
    assert_allclose(row[columns], np.log([trend, np.mean(steps), np.mean(intervals)]), rtol=1e-9, atol=1e-9)
    assert row[kernel.FIRST_AFTER] == 1 + int(np.argmax(steps))


def test_missing_epochs_do_not_matter(case):
    y, variance, time = case
    (whole,) = scan(y, variance, time)
    wide = np.full(y.size + 3, np.nan)
    places = np.array([0, 1, 2, 4, 5, 7, 8, 9, 11])
    wide[places] = y
    wide_variance, wide_time = np.full(wide.size, np.nan), np.zeros(wide.size)
    wide_variance[places], wide_time[places] = variance, time
    (row,) = scan(wide, wide_variance, wide_time)
    indices = [kernel.FIRST_AFTER, kernel.LAST_BEFORE, kernel.EARLIEST, kernel.LATEST, kernel.INTERVAL_FIRST]
    indices.append(kernel.INTERVAL_END)
    others = [k for k in range(kernel.N_RESULT) if k not in indices]
    assert_allclose(row[others], whole[others], rtol=1e-12, atol=1e-12)
    assert_allclose(row[indices], places[whole[indices].astype(int)], rtol=0, atol=0)


def test_an_unsure_survey_moves_the_test_less_than_a_sure_one():
    y = [0.0, 0.0, 0.0, 3.0]
    sure = scan(y, [1.0, 1.0, 1.0, 1.0])[0, kernel.P_CHANGED]
    unsure = scan(y, [1.0, 1.0, 1.0, 9.0])[0, kernel.P_CHANGED]
    few = scan(y, 1.0, freedom=4.0)[0, kernel.P_CHANGED]
    assert sure < unsure
    assert sure < few


def test_surveys_since_a_break_confirm_or_contradict_it():
    (row,) = scan([0.0, 0.1, 0.0, 5.0, 5.1, 0.0, 5.0, 0.1], 0.04, limit=1.96)
    assert row[kernel.FIRST_AFTER] == 3
    assert row[kernel.N_CONTRADICTING] == 2
    assert row[kernel.NEWEST_CONTRADICTS] == 1
    (steady,) = scan([0.0, 0.1, 0.0, 5.0, 5.1, 5.0], 0.04)
    assert (steady[kernel.N_CONFIRMING], steady[kernel.NEWEST_CONTRADICTS], steady[kernel.N_BEFORE]) == (3, 0, 3)


def test_fewer_than_two_values_say_nothing():
    results = scan([[np.nan, 1.0, np.nan], [np.nan, np.nan, np.nan]], 1.0)
    assert results[:, kernel.N_OBSERVED].tolist() == [1.0, 0.0]
    assert np.isnan(results[:, 1:]).all()


def test_two_values_are_judged_as_a_step_alone():
    (row,) = scan([0.0, 3.0], 1.0)
    assert_allclose(row[kernel.P_CHANGED], 2.0 * stats.norm.sf(3.0 / math.sqrt(2.0)), rtol=1e-9, atol=0)
    assert np.isnan(row[kernel.TREND])
    assert row[kernel.EVIDENCE_INTERVAL] == -np.inf


def test_the_largest_interval_score_is_the_largest_over_all_intervals():
    draws = np.random.default_rng(1).normal(size=(3, 6))
    found = np.empty(3)
    kernel.largest_interval_scores(draws, found)
    for y, score in zip(draws, found, strict=True):
        best = 0.0
        for i in range(1, 5):
            for j in range(i + 1, 6):
                inside = (np.arange(6) >= i) & (np.arange(6) < j)
                beta, covariance, _ = line_fit([np.ones(6), inside], y, np.ones(6))
                best = max(best, abs(beta[1]) / math.sqrt(covariance[1, 1]))
        assert_allclose(score, best, rtol=1e-10, atol=0)


def test_large_changes_of_unequal_surveys_are_not_ranked_by_their_degrees_of_freedom():
    freedom = np.array([30.0, 400.0, 400.0, 30.0])
    (row,) = scan([0.0, 100.0, 100.1, 100.0], 1.0, freedom=freedom, size=50.0)
    assert row[kernel.FIRST_AFTER] == 1
    assert row[kernel.EVIDENCE_STEP] > row[kernel.EVIDENCE_TREND]
    assert row[kernel.EVIDENCE_STEP] > row[kernel.EVIDENCE_INTERVAL]
