"""Gross errors are left out; cliffs, crowns and real change are not."""

import numpy as np
import pytest

from changedetect.config import AdaptiveConfig
from changedetect.models.lwpr import LWPRSurface

SIDE = 60.0


def ground(x, y):
    return 3.0 * np.sin(x / 9.0) * np.cos(y / 11.0) + np.where(x > 30.0, 4.0, 0.0)


def survey(n, seed, noise=0.05):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, SIDE, (2, n))
    return x, y, ground(x, y) + rng.normal(0.0, noise, n)


def surface_error(x, y, z, resolution=None, limit=8.0):
    model = LWPRSurface(AdaptiveConfig(outlier_limit=limit), resolution=resolution)
    kept = model.without_gross_errors((x, y), z)
    u = np.linspace(2.0, SIDE - 2.0, 90)
    at = tuple(a.ravel() for a in np.meshgrid(u, u))
    error = model.fit((x[kept], y[kept]), z[kept]).predict(at).elevation - ground(*at)
    return np.sqrt(np.nanmean(error**2)), kept


@pytest.mark.parametrize(("n", "resolution"), [(3_000, None), (40_000, None), (150_000, 0.5)])
def test_five_percent_of_gross_errors_cost_at_most_a_tenth(n, resolution):
    x, y, z = survey(n, 1)
    rng = np.random.default_rng(2)
    bad = rng.random(n) < 0.05
    spoiled = np.where(bad, z + rng.choice([-1.0, 1.0], n) * rng.uniform(1.0, 20.0, n), z)
    clean, _ = surface_error(x[~bad], y[~bad], z[~bad], resolution)
    screened, kept = surface_error(x, y, spoiled, resolution)
    assert screened < 1.10 * clean
    assert np.mean(~kept[bad]) > 0.9


@pytest.mark.parametrize(("n", "resolution"), [(3_000, None), (40_000, None), (150_000, 0.5)])
def test_hardly_anything_is_left_out_of_a_clean_survey_with_a_cliff(n, resolution):
    x, y, z = survey(n, 3)
    screened, kept = surface_error(x, y, z, resolution)
    everything, _ = surface_error(x, y, z, resolution, limit=0.0)
    assert np.mean(~kept) < 0.005
    assert screened < 1.08 * everything


def test_a_step_since_the_last_epoch_is_no_gross_error():
    x, y, z = survey(20_000, 4)
    model = LWPRSurface().fit((x, y), z, survey_time=0.0)
    x, y, z = survey(20_000, 5)
    lifted = z + np.where((np.abs(x - 15.0) < 5.0) & (np.abs(y - 30.0) < 5.0), 3.0, 0.0)
    kept = model.without_gross_errors((x, y), lifted)
    assert np.mean(~kept) < 0.002


def test_what_is_left_out_does_not_depend_on_the_order():
    x, y, z = survey(5_000, 6)
    z[::97] += 5.0
    kept = LWPRSurface().without_gross_errors((x, y), z)
    order = np.random.default_rng(0).permutation(z.size)
    np.testing.assert_array_equal(LWPRSurface().without_gross_errors((x[order], y[order]), z[order]), kept[order])


def test_screening_can_be_switched_off_and_needs_a_few_observations():
    x, y, z = survey(500, 7)
    z[0] += 100.0
    assert LWPRSurface(AdaptiveConfig(outlier_limit=0.0)).without_gross_errors((x, y), z).all()
    assert LWPRSurface().without_gross_errors((x[:5], y[:5]), z[:5]).all()


def test_clusters_far_apart_are_not_judged_instead_of_exhausting_memory():
    x, y, z = survey(2_000, 8)
    x[:1000] += 5e7
    y[:1000] += 5e7
    assert LWPRSurface().without_gross_errors((x, y), z).all()
