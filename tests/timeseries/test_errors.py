"""Errors of each epoch apart."""

from __future__ import annotations

import math

import numpy as np
import pytest
from error_fields import smooth_field
from timeseries.small_stack import stack_of

from changedetect.config import DifferencingConfig
from changedetect.differencing.error_model import ErrorModel, TooLittleGroundError
from changedetect.timeseries.differences import epoch_maps, pair_maps
from changedetect.timeseries.errors import _drawn_together, combined_model, epoch_errors
from changedetect.timeseries.zones import area_budgets, area_series

SHAPE = (110, 110)
SETTINGS = DifferencingConfig()


def no_terms(_epoch):
    return []


def fields(scales, seed=0, length=6.0):
    rng = np.random.default_rng(seed)
    local = [smooth_field(rng, SHAPE, 0.01, 1.2) for _ in scales]
    return np.array([a + smooth_field(rng, SHAPE, s, length) for a, s in zip(local, scales, strict=True)])


@pytest.fixture(scope="module")
def unequal(tmp_path_factory):
    """Five epochs of which the first has an error four times as large as the others."""
    stack = stack_of(fields([0.08, 0.02, 0.02, 0.02, 0.02]), tmp_path_factory.mktemp("stack"))
    return stack, epoch_errors(stack, None)


def test_the_error_of_the_first_epoch_is_not_shared_out(unequal):
    stack, models = unequal
    found = np.sqrt(np.median(stack.correlated.reshape(5, -1), axis=1))
    assert 0.06 < found[0] < 0.10
    assert ((found[1:] > 0.012) & (found[1:] < 0.030)).all()
    assert all(isinstance(model, ErrorModel) and model.is_correlated for model in models)


def test_differences_of_a_stack_are_calibrated(unequal):
    stack, models = unequal
    for pair in ((0, 3), (1, 4)):
        maps = pair_maps(stack, models, no_terms, pair, SETTINGS)
        assert 0.8 < np.nanstd(maps.z_score) < 1.25


def test_series_hold_the_total_variance_and_mark_what_was_not_seen(tmp_path):
    values = fields([0.02, 0.02, 0.02], 3)[:, :40, :40]
    values[1, :10] = np.nan
    stack = stack_of(values, tmp_path)
    stack.correlated[:] = 4e-4
    stack.coherent[2] = 1e-4
    series, total, freedom = stack.series(slice(5, 15))
    assert series.shape == total.shape == freedom.shape == (400, 3)
    assert np.isnan(series[:200, 1]).all()
    assert np.isnan(total[:200, 1]).all()
    np.testing.assert_allclose(total[:, 0], 5e-4, rtol=1e-5, atol=0)
    np.testing.assert_allclose(total[:, 2], 6e-4, rtol=1e-5, atol=0)
    # a fifth of the variance is known from 100 degrees of freedom, the rest exactly
    np.testing.assert_allclose(freedom[:, 0], 2500.0, rtol=1e-3, atol=0)


def test_epochs_without_correlated_errors_have_none(tmp_path):
    stack = stack_of(fields([0.0, 0.0, 0.0], 5), tmp_path)
    models = epoch_errors(stack, None)
    assert np.sqrt(np.median(stack.correlated)) < 0.003
    assert len(models) == 3


def test_stable_ground_that_is_too_little_is_refused(tmp_path):
    stack = stack_of(fields([0.01, 0.01], 6), tmp_path)
    with pytest.raises(TooLittleGroundError, match="stable ground holds"):
        epoch_errors(stack, np.zeros(SHAPE, bool))


def test_variances_that_scatter_by_chance_are_drawn_together_and_others_are_not():
    chance = np.exp(np.random.default_rng(1).normal(0.0, 0.3, 30))
    drawn = _drawn_together(chance, np.full(30, 0.09), 1.0)
    assert np.std(np.log(drawn)) < 0.15
    np.testing.assert_allclose(drawn.mean(), chance.mean(), rtol=1e-12, atol=0)
    real = np.array([1.0, 16.0, 1.0, 16.0, 4.0])
    kept = _drawn_together(real, np.full(5, 0.03), 1.0)
    np.testing.assert_allclose(kept / kept.mean(), real / real.mean(), rtol=0.1, atol=0)


def test_models_are_combined_by_their_variances(unequal):
    _, models = unequal
    both = combined_model(models[:2], [9e-4, 1e-4])
    wanted = 0.9 * models[0].correlation(5.0) + 0.1 * models[1].correlation(5.0)
    np.testing.assert_allclose(both.correlation(5.0), wanted, rtol=1e-12, atol=0)
    assert not combined_model(models[:2], [0.0, 0.0]).is_correlated


def test_the_error_of_the_first_epoch_enters_an_area_once(unequal):
    stack, models = unequal
    window = (slice(5, 105), slice(5, 105))
    area = (window, np.ones((100, 100), bool))
    series = area_series(stack, models, no_terms, [area], SETTINGS)
    assert series.change[0, 0] == 0.0
    assert series.area_observed[0].tolist() == [10_000.0] * 5
    expected = np.array([np.mean(stack.value[k][window] - stack.value[0][window]) for k in range(5)])
    np.testing.assert_allclose(series.change[0], expected, rtol=0, atol=1e-7)
    assert series.variance[0, 0] > 4.0 * series.variance[0, 1:].max()
    (budget,) = area_budgets(stack, models, no_terms, (0, 2), [area], SETTINGS)
    std = math.sqrt(series.variance[0, 0] + series.variance[0, 2])
    assert budget.mean is not None
    np.testing.assert_allclose(budget.mean.std, std, rtol=0.05, atol=0)
    np.testing.assert_allclose(budget.mean.value, series.change[0, 2], rtol=1e-4, atol=1e-7)


def test_an_epoch_that_saw_little_of_an_area_is_not_tested_there(tmp_path):
    values = fields([0.0, 0.0, 0.0], 8)[:, :60, :60]
    values[1, :, :40] = np.nan
    stack = stack_of(values, tmp_path)
    models = epoch_errors(stack, None)
    everything = ((slice(0, 60), slice(0, 60)), np.ones((60, 60), bool))
    unseen = ((slice(0, 60), slice(0, 20)), np.ones((60, 20), bool))
    series = area_series(stack, models, no_terms, [everything, unseen], SETTINGS)
    assert series.is_tested[0].tolist() == [True, False, True]
    assert np.isnan(series.change[1, 1])
    assert series.area_observed[0, 1] == 60.0 * 20.0


def test_maps_of_one_epoch_have_its_own_errors_alone(unequal):
    stack, models = unequal
    first, third = (np.nanmedian(epoch_maps(stack, models, no_terms, k, SETTINGS).dod_std) for k in (0, 2))
    both = np.nanmedian(pair_maps(stack, models, no_terms, (0, 2), SETTINGS).dod_std)
    np.testing.assert_allclose(both, math.hypot(first, third), rtol=0.02, atol=0)
