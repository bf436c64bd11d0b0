"""Nested correlations: sums over areas, random fields, fits."""

import math

import numpy as np
import pytest
from error_fields import smooth_field

from changedetect.differencing.correlation import NestedCorrelation, fit_correlation
from changedetect.differencing.lags import PairProducts, collect_pairs, standardised_scores

NESTED = NestedCorrelation((1.5, 9.0, 60.0), (0.3, 0.5, 0.2))


def all_pairs(weights, resolution, correlation):
    """Double sum over all pairs of cells, one by one."""
    row, col = np.nonzero(np.ones(weights.shape))
    w = weights.ravel()
    total = 0.0
    for k in range(w.size):
        distance = resolution * np.hypot(row - row[k], col - col[k])
        covariance = sum(
            s * np.exp(-0.5 * (distance / r) ** 2) for r, s in zip(correlation.ranges, correlation.shares, strict=True)
        )
        total += w[k] * float(np.sum(w * covariance))
    return total


@pytest.mark.parametrize("resolution", [0.5, 1.0, 4.0])
def test_the_variance_of_a_sum_is_the_double_sum_over_all_pairs(resolution):
    rng = np.random.default_rng(3)
    weights = rng.uniform(0.0, 1.0, (37, 52)) * (rng.uniform(size=(37, 52)) > 0.2)
    # cells are summed into coarser ones up to a third of a range, which costs at most a per cent or two
    np.testing.assert_allclose(
        NESTED.variance_of_sum(weights, resolution), all_pairs(weights, resolution, NESTED), rtol=0.02, atol=0.0
    )


def test_weights_of_both_signs_may_cancel_but_never_give_a_negative_variance():
    weights = np.ones((40, 40))
    weights[:, ::2] = -1.0
    variance = NestedCorrelation((30.0,), (1.0,)).variance_of_sum(weights, 1.0)
    assert 0.0 <= variance < 0.01 * NestedCorrelation((30.0,), (1.0,)).variance_of_sum(np.abs(weights), 1.0)


def test_the_mean_over_a_square_is_that_of_many_cells():
    n = 40
    exact = all_pairs(np.full((n, n), 1.0 / n**2), 0.5, NESTED)
    np.testing.assert_allclose(NESTED.mean_over_square(0.5 * n), exact, rtol=0.01, atol=0.0)
    np.testing.assert_allclose(NESTED.mean_over_square(0.0), 1.0, rtol=1e-12, atol=0.0)


def test_the_squared_area_is_the_integral_of_the_squared_correlation():
    r = np.linspace(0.0, 400.0, 40_001)
    integral = np.sum(2.0 * math.pi * r * NESTED(r) ** 2) * (r[1] - r[0])
    np.testing.assert_allclose(NESTED.squared_area(), integral, rtol=1e-3, atol=0.0)


def test_drawn_fields_have_the_stated_covariance():
    correlation = NestedCorrelation((2.0, 10.0), (0.4, 0.6))
    rng = np.random.default_rng(8)
    draw = correlation.sampler((150, 151), 1.0)
    fields = np.array([draw(rng) for _ in range(30)])
    np.testing.assert_allclose(np.mean(fields**2), 1.0, rtol=0.05, atol=0.0)
    for lag in (1, 3, 8, 20):
        found = 0.5 * (np.mean(fields[:, lag:] * fields[:, :-lag]) + np.mean(fields[:, :, lag:] * fields[:, :, :-lag]))
        np.testing.assert_allclose(found, correlation(float(lag)), rtol=0.0, atol=0.05)


def test_a_correlation_is_found_again_under_independent_errors():
    rng = np.random.default_rng(5)
    shape = (400, 400)
    local, longer = smooth_field(rng, shape, 0.6, 1.5), smooth_field(rng, shape, 0.8, 12.0)
    parts = (np.full(shape, 0.6), np.full(shape, 0.8))
    cells = [values.ravel() for values in (local + longer, *parts)]

    def at(places):
        return standardised_scores(cells[0][places], cells[1][places] ** 2, cells[2][places] ** 2, np.inf)

    pairs = collect_pairs(at, np.ones(shape, bool), 1.0, np.random.default_rng(1))
    found = fit_correlation(pairs, NestedCorrelation((1.5,), (1.0,)), 0.64, 1.5, 100.0)
    np.testing.assert_allclose(found.variance, 1.0, rtol=0.0, atol=0.08)
    at = np.array([3.0, 8.0, 12.0, 20.0, 40.0])
    np.testing.assert_allclose(found(at), np.exp(-0.5 * (at / 12.0) ** 2), rtol=0.0, atol=0.12)


def test_lags_without_enough_pairs_are_left_out():
    usable = np.zeros((60, 60), bool)
    usable[:25, :25] = True

    def at(places):
        return standardised_scores(np.zeros(places.size), np.ones(places.size), 0.0, np.inf)

    pairs = collect_pairs(at, usable, 1.0, np.random.default_rng(1))
    assert isinstance(pairs, PairProducts)
    assert pairs.distance.size > 3
    assert pairs.distance.max() < 35.0


def test_scores_beyond_what_errors_reach_do_not_count():
    cells = standardised_scores(np.array([0.01, 0.5, np.nan]), np.full(3, 1e-4), 0.0, np.inf)
    assert cells.counts.tolist() == [True, False, False]
    np.testing.assert_allclose(cells.counting().score, [1.0], rtol=1e-12, atol=0.0)
