"""Means and volumes of areas: unbiased, with intervals that cover the truth."""

import numpy as np
import pytest
from error_fields import change_maps, quiet

from changedetect.differencing import area_budget, elevation_bands, find_objects_of_change, sum_std

SHAPE = (160, 160)


def drawn(seed, change=0.0):
    return change_maps(quiet(seed, SHAPE, correlated=0.03, length=5.0) + change)


def test_means_of_blocks_scatter_as_their_standard_deviations_say():
    scores = {20: [], 40: []}
    for seed in range(3):
        maps = drawn(100 + seed)
        for side, found in scores.items():
            for r in range(0, SHAPE[0], side):
                for c in range(0, SHAPE[1], side):
                    window = np.s_[r : r + side, c : c + side]
                    found.append(maps.dod[window].sum() / sum_std(maps, np.ones((side, side)), 1.0, window))
    # 48 blocks of 40 cells: their standard deviation is known to ten per cent
    np.testing.assert_allclose(np.std(scores[20]), 1.0, rtol=0.0, atol=0.15)
    np.testing.assert_allclose(np.std(scores[40]), 1.0, rtol=0.0, atol=0.25)


def test_a_window_and_the_whole_map_give_the_same_answer():
    maps = drawn(110)
    window = np.s_[30:80, 40:110]
    whole = np.zeros(SHAPE)
    whole[window] = 1.0
    np.testing.assert_allclose(
        sum_std(maps, np.ones((50, 70)), 1.0, window), sum_std(maps, whole, 1.0), rtol=1e-12, atol=0.0
    )


@pytest.mark.slow
def test_volumes_of_a_patch_are_covered_by_their_intervals_and_unbiased():
    change = np.zeros(SHAPE)
    change[50:110, 50:110] = 0.1
    covered, volumes = [], []
    inside = change > 0.0
    for seed in range(6):
        maps = drawn(200 + seed, change)
        net = area_budget(maps, 1.0, 0.95, inside).net
        covered.append(net.lower <= 360.0 <= net.upper)
        volumes.append(net.value)
    np.testing.assert_allclose(np.mean(volumes), 360.0, rtol=0.05, atol=0.0)
    assert np.sum(covered) >= 4  # fewer happen once in five hundred times


def test_raised_less_lowered_is_net_and_the_mean_is_net_per_area():
    change = np.zeros(SHAPE)
    change[20:70, 20:70], change[90:140, 20:90] = 0.4, -0.3
    maps = drawn(300, change)
    objects = find_objects_of_change(maps, 1.0, 0.95, 0.05)
    budget = area_budget(maps, 1.0, 0.95, None, objects.direction)
    np.testing.assert_allclose(budget.raised.value - budget.lowered.value, budget.net.value, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(budget.mean.value * budget.area_observed, budget.net.value, rtol=1e-12, atol=0.0)
    assert budget.raised.lower <= 1000.0 <= budget.raised.upper
    assert budget.lowered.lower <= 1050.0 <= budget.lowered.upper


def test_errors_of_quiet_ground_do_not_add_up_to_volume():
    raised = [area_budget(drawn(400 + seed), 1.0, 0.95).raised for seed in range(2)]
    # a sum of positive parts would be 0.4 standard deviations of every cell: more than 400 m3
    assert all(abs(r.value) < 3.0 * r.std < 400.0 for r in raised)


def test_ground_that_nobody_observed_twice_has_no_mean():
    budget = area_budget(drawn(500), 1.0, 0.95, np.zeros(SHAPE, bool))
    assert budget.mean is None
    assert budget.document()["change_mean_m"] is None
    assert budget.net.value == budget.net.std == 0.0


def test_bands_of_elevation_add_up_to_the_whole():
    maps = drawn(600)
    object.__setattr__(maps, "elevation", np.tile(np.linspace(10.2, 13.7, SHAPE[1]), (SHAPE[0], 1)))
    bands = elevation_bands(maps, 1.0, 0.95, 1.0)
    assert [(low, high) for low, high, _ in bands] == [(10.0, 11.0), (11.0, 12.0), (12.0, 13.0), (13.0, 14.0)]
    total = sum(budget.net.value for _, _, budget in bands)
    np.testing.assert_allclose(total, area_budget(maps, 1.0, 0.95).net.value, rtol=0.0, atol=1e-6)


def test_a_band_without_height_is_refused():
    with pytest.raises(ValueError, match="must be above zero"):
        elevation_bands(drawn(600), 1.0, 0.95, 0.0)


def test_raised_and_lowered_are_never_negative():
    for seed in range(2):
        budget = area_budget(drawn(700 + seed), 1.0, 0.95)
        for quantity in (budget.raised, budget.lowered):
            assert 0.0 <= quantity.lower <= quantity.value <= quantity.upper
        np.testing.assert_allclose(budget.raised.value - budget.lowered.value, budget.net.value, rtol=0.0, atol=1e-6)
