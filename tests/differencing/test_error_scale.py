"""The scale of errors: robust against change, found with its covariates and tails."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import check_grad

from changedetect.differencing import error_scale
from changedetect.differencing.error_scale import Sample, fit_scale, half_width_scale, select_scale


def sample(d, local=0.01, covariates=None, n_independent=None, n_blocks=60):
    centre, spread = half_width_scale(d)
    start = math.hypot(centre, spread)
    widest = max(np.percentile(np.abs(d), 99.5), 10.0 * start)
    return Sample(
        squared=d**2,
        variance=np.full(d.size, local**2),
        covariates=covariates or {},
        block=np.arange(d.size) * n_blocks // d.size,
        n_independent=float(d.size if n_independent is None else n_independent),
        background=0.5 / widest,
        start=start,
    )


def test_the_majority_is_found_beside_forty_per_cent_of_change():
    rng = np.random.default_rng(2)
    values = np.concatenate([rng.normal(0.02, 0.05, 6000), rng.normal(0.6, 0.1, 4000)])
    centre, scale = half_width_scale(values)
    np.testing.assert_allclose(centre, 0.02, rtol=0.0, atol=0.02)
    # half of the values are five sixths of the majority, whose interval is 2.05 times as wide as its middle half
    assert 0.05 < scale < 0.115


@pytest.mark.parametrize("freedom", [3.0, math.inf])
def test_the_gradient_is_that_of_the_likelihood(freedom):
    rng = np.random.default_rng(4)
    one = sample(rng.normal(0.0, 0.03, 500), covariates={"slope": rng.normal(0.0, 1.0, 500)})
    design = np.column_stack([np.ones(500), one.covariates["slope"]])
    every = np.ones(500, bool)
    error = check_grad(
        lambda t: error_scale._costs(t, one, design, every, freedom)[0].mean(),
        lambda t: error_scale._costs(t, one, design, every, freedom)[1],
        np.array([-7.0, 0.4, -1.5]),
    )
    assert error < 1e-5


@pytest.mark.parametrize("share", [0.0, 0.15, 0.35])
def test_change_neither_inflates_the_scale_nor_hides_in_it(share):
    rng = np.random.default_rng(6)
    d = rng.normal(0.0, math.hypot(0.01, 0.04), 10_000)
    n = int(share * d.size)
    d[:n] += rng.choice([-0.5, 0.3, 0.6], n)
    found = fit_scale(sample(d), math.inf)
    # what lies between is shared out: a tenth too small at a third of change, before regions are taken out
    np.testing.assert_allclose(math.sqrt(found.variance({})), 0.04, rtol=0.12, atol=0.0)
    np.testing.assert_allclose(found.changed_share, share, rtol=0.0, atol=0.08)


def test_where_errors_are_independent_nothing_is_added():
    found = select_scale(sample(np.random.default_rng(7).normal(0.0, 0.01, 10_000)))
    assert math.sqrt(found.variance({})) < 0.003
    assert math.isinf(found.freedom)


def test_errors_that_grow_with_slope_are_found_to_do_so():
    rng = np.random.default_rng(9)
    slope = rng.normal(-2.0, 0.7, 10_000)
    std = 0.03 * np.exp(0.5 * (slope + 2.0))
    found = select_scale(sample(rng.normal(0.0, 1.0, 10_000) * np.hypot(std, 0.01), covariates={"slope": slope}))
    at = np.array([-3.0, -2.0, -1.0])
    expected = 0.03 * np.exp(0.5 * (at + 2.0))
    np.testing.assert_allclose(np.sqrt(found.variance({"slope": at})), expected, rtol=0.08, atol=0.0)


def test_with_few_independent_values_a_covariate_hardly_matters():
    rng = np.random.default_rng(9)
    slope = rng.normal(0.0, 1.0, 10_000)
    d = rng.normal(0.0, 1.0, 10_000) * np.hypot(0.03 * np.exp(0.5 * slope), 0.01)
    one = sample(d, covariates={"slope": slope})
    many, few = (fit_scale(replace(one, n_independent=n), math.inf).exponents[0] for n in (1e4, 2.0))
    np.testing.assert_allclose(many, 1.0, rtol=0.1, atol=0.0)
    assert few < 0.4 * many


def test_heavy_tails_are_recognised_and_normal_ones_left_alone():
    rng = np.random.default_rng(11)
    heavy = select_scale(sample(0.04 * rng.standard_t(3.0, 10_000)))
    assert heavy.freedom <= 4.0
    np.testing.assert_allclose(math.sqrt(heavy.variance({})), 0.04, rtol=0.15, atol=0.0)
    assert math.isinf(select_scale(sample(rng.normal(0.0, 0.04, 10_000))).freedom)


def test_tails_that_were_heavy_stay_so_when_little_speaks_for_normal_ones():
    rng = np.random.default_rng(12)
    slightly = sample(0.04 * rng.standard_t(8.0, 10_000), n_independent=20.0)
    assert math.isinf(select_scale(slightly).freedom)
    assert select_scale(slightly, before=4.0).freedom <= 10.0
    assert math.isinf(select_scale(sample(rng.normal(0.0, 0.04, 10_000)), before=4.0).freedom)
