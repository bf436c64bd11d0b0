"""The error model as a whole: calibrated on quiet ground, blind to change, honest about what it cannot know."""

import math

import numpy as np
import pytest
from error_fields import change_maps, evidence, quiet, smooth_field

from changedetect.differencing import area_budget, find_objects_of_change
from changedetect.differencing.pair import cell_errors


def patches(shape, share):
    """Squares of 0.3 to 0.6 m that together cover a share of the ground."""
    change = np.zeros(shape)
    side = int(math.sqrt(share * shape[0] * shape[1] / 4.0))
    for k, height in enumerate((0.6, -0.4, 0.3, -0.5)):
        r, c = 8 + (k // 2) * shape[0] // 2, 8 + (k % 2) * shape[1] // 2
        change[r : r + side, c : c + side] = height
    return change


def test_independent_errors_alone_add_nothing():
    flagged, added = [], []
    for seed in range(2):
        maps = change_maps(quiet(seed))
        added.append(np.sqrt(np.median(maps.errors.correlated)))
        flagged.append(np.mean((maps.change_class == 1) | (maps.change_class == 2)))
    assert 0.03 < np.mean(flagged) < 0.07
    assert max(added) < 0.005


@pytest.mark.parametrize("share", [0.0, 0.35])
def test_correlated_errors_are_found_beside_change(share):
    false, spread, ratio = [], [], []
    for seed in range(2):
        shape = (240, 240)
        change = patches(shape, share)
        maps = change_maps(quiet(20 + seed, shape, correlated=0.05, length=5.0) + change)
        still = change == 0.0
        false.append(np.mean(((maps.change_class == 1) | (maps.change_class == 2))[still]))
        spread.append(maps.z_score[still].std())
        ratio.append(math.exp(0.5 * maps.errors.model.scale.level) / 0.05)
    assert 0.03 < np.mean(false) < 0.07
    assert 0.85 < np.mean(spread) < 1.15
    np.testing.assert_allclose(np.mean(ratio), 1.0, rtol=0.0, atol=0.12)


def test_ranges_from_metres_to_tens_of_metres_are_told_apart():
    rng = np.random.default_rng(31)
    shape = (300, 300)
    d = quiet(30, shape) + smooth_field(rng, shape, 0.03, 5.0) + smooth_field(rng, shape, 0.03, 20.0)
    found = cell_errors(evidence(d, 0.01), 1.0).model.correlation.normalised()
    at = np.array([2.0, 10.0, 20.0, 40.0])
    expected = 0.5 * np.exp(-0.5 * (at / 5.0) ** 2) + 0.5 * np.exp(-0.5 * (at / 20.0) ** 2)
    np.testing.assert_allclose(found(at), expected, rtol=0.0, atol=0.15)


def test_errors_that_grow_with_slope_are_calibrated_on_level_and_steep_ground_alike():
    rng = np.random.default_rng(41)
    shape = (240, 240)
    slope = np.tile(np.linspace(0.02, 0.8, 240), (240, 1))
    d = quiet(40, shape) + smooth_field(rng, shape, 1.0, 5.0) * (0.02 + 0.08 * slope)
    found = evidence(d, 0.01, slope=slope)
    errors = cell_errors(found, 1.0)
    z = d / np.sqrt(found.variance + errors.correlated)
    for part in (slope < 0.2, slope > 0.6):
        assert 0.8 < z[part].std() < 1.2


def test_given_stable_ground_is_all_that_is_used():
    shape = (160, 160)
    d = quiet(50, shape, correlated=0.04, length=4.0)
    d[:, 80:] *= 4.0
    stable = np.zeros(shape, bool)
    stable[:, :80] = True
    errors = cell_errors(evidence(d, 0.01), 1.0, stable)
    np.testing.assert_array_equal(errors.stable, stable)
    np.testing.assert_allclose(math.exp(0.5 * errors.model.scale.level), 0.04, rtol=0.2, atol=0.0)


def test_stable_ground_that_nobody_observed_is_refused():
    d = quiet(51)
    stable = np.zeros(d.shape, bool)
    stable[:5, :5] = True
    with pytest.raises(ValueError, match=r"stable ground holds 25 cells .* at least 200"):
        cell_errors(evidence(d, 0.01), 1.0, stable)


def test_a_step_between_epochs_that_are_not_aligned_is_no_error():
    maps = change_maps(quiet(52, (120, 120), correlated=0.03, length=4.0) - 0.4)
    assert np.mean(maps.change_class == 1) > 0.99
    assert np.median(maps.dod_std) < 0.05


def test_ground_that_was_not_observed_stays_unknown_and_does_no_harm():
    d = quiet(53, (160, 160), correlated=0.03, length=5.0)
    d[40:90, 60:150] = np.nan
    maps = change_maps(d)
    assert np.isnan(maps.dod_std[40:90, 60:150]).all()
    assert np.isfinite(maps.dod_std[np.isfinite(d)]).all()
    assert 0.85 < np.nanstd(maps.z_score) < 1.15


def test_a_map_of_a_few_cells_gets_its_independent_errors_alone():
    maps = change_maps(quiet(54, (8, 8)))
    np.testing.assert_allclose(maps.dod_std, maps.local_std, rtol=1e-12, atol=0.0)
    assert not maps.errors.model.is_correlated


def test_the_same_difference_gives_the_same_model():
    d = quiet(55, (120, 120), correlated=0.03, length=4.0)
    first, second = (cell_errors(evidence(d, 0.01), 1.0) for _ in range(2))
    assert first.model == second.model


def test_epochs_that_share_no_ground_give_a_map_of_nothing():
    maps = change_maps(np.full((30, 40), np.nan))
    assert np.isnan(maps.dod_std).all()
    objects = find_objects_of_change(maps, 1.0, 0.95, 0.05)
    assert objects.items == ()
    assert area_budget(maps, 1.0, 0.95, None, objects.direction).mean is None


def test_identical_epochs_are_flagged_nowhere():
    maps = change_maps(np.zeros((60, 60)))
    assert (maps.change_class == 0).all()
    assert not maps.errors.model.is_correlated
    assert maps.errors.model.document()["correlated_std_m"] == 0.0
