"""Correlated errors predicted from the ground around: calibrated, less than before, and no change taken for error."""

import math
from dataclasses import replace

import numpy as np
import pytest
from error_fields import evidence, quiet, smooth_field

from changedetect.config import DifferencingConfig
from changedetect.differencing import CoherentTerm, area_budget, find_objects_of_change, summarise
from changedetect.differencing.maps import judge_change
from changedetect.differencing.pair import cell_errors
from changedetect.grid import Grid

SHAPE, LENGTH = (128, 128), 9.0
#: Squares of 18 cells, two correlation lengths wide.
PATCHES = {0.5: np.s_[20:38, 20:38], -0.3: np.s_[20:38, 88:106], 0.15: np.s_[88:106, 20:38]}


def changed(height=None):
    change = np.zeros(SHAPE)
    for value, window in PATCHES.items():
        change[window] = value if height is None else height
    return change


def maps_of(d, resolution=1.0, **kwargs):
    """Maps of a difference whose observations scatter more than its correlated errors."""
    found = evidence(d, 0.01, resolution=resolution)
    errors = cell_errors(found, resolution, predict=True, **kwargs)
    return judge_change(found, errors, DifferencingConfig())


def away_from_change(change):
    from scipy.ndimage import binary_erosion

    return binary_erosion(change == 0.0, iterations=4, border_value=1)


@pytest.fixture(scope="module")
def drawn():
    """Three draws with change: maps, measured difference, the errors in it."""
    rows = []
    for seed in range(3):
        error = quiet(300 + seed, SHAPE, correlated=0.03, length=LENGTH)
        rows.append((maps_of(error + changed()), error))
    return rows


def test_unchanged_ground_is_calibrated_and_its_error_smaller(drawn):
    still = away_from_change(changed())
    flagged = np.mean([np.isin(maps.change_class[still], (1, 2)).mean() for maps, _ in drawn])
    spread = np.mean([maps.z_score[still].std() for maps, _ in drawn])
    left = np.mean([maps.dod[still].std() / error[still].std() for maps, error in drawn])
    assert 0.03 < flagged < 0.08
    assert 0.85 < spread < 1.15
    assert left < 0.85


def test_change_is_not_taken_for_error(drawn):
    lost = []
    for maps, _ in drawn:
        for height, window in PATCHES.items():
            inner = tuple(slice(s.start + 3, s.stop - 3) for s in window)
            sign = math.copysign(1.0, height)
            lost.append(sign * (maps.dod[inner].mean() - height))
    np.testing.assert_allclose(np.mean(lost), 0.0, rtol=0.0, atol=0.015)
    assert np.std(lost) < 0.03


def test_the_error_of_changed_ground_is_as_stated(drawn):
    scores = []
    for maps, _ in drawn:
        for height, window in PATCHES.items():
            inner = tuple(slice(s.start + 3, s.stop - 3) for s in window)
            scores.append((maps.dod[inner] - height).ravel() / maps.dod_std[inner].ravel())
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.4


@pytest.mark.slow
def test_change_of_two_correlated_errors_is_found_where_its_surroundings_tell(drawn):
    window = np.s_[88:106, 88:106]
    power, plain = [], []
    for _, error in drawn:
        d = error + changed()
        d[window] += 0.06
        found = evidence(d, 0.01)
        for predict, hits in ((True, power), (False, plain)):
            maps = judge_change(found, cell_errors(found, 1.0, predict=predict), DifferencingConfig())
            hits.append(np.mean(maps.change_class[91:103, 91:103] == 2))
    assert np.mean(power) > 0.6
    assert np.mean(power) > np.mean(plain) + 0.1


def test_the_measured_difference_is_the_corrected_one_and_the_error(drawn):
    for maps, error in drawn:
        np.testing.assert_allclose(maps.dod + maps.correlated_error, error + changed(), rtol=0.0, atol=1e-12)


def test_volumes_rest_on_ground_outside_and_their_intervals_hold(drawn):
    errors, stated, plain = [], [], []
    for maps, _ in drawn:
        assert maps.errors.prediction is not None
        for height, window in PATCHES.items():
            inside = np.zeros(SHAPE, bool)
            inside[tuple(slice(s.start - 4, s.stop + 4) for s in window)] = True
            net = area_budget(maps, 1.0, 0.95, inside).net
            errors.append(net.value - height * 18**2)
            stated.append(net.std)
            bare = replace(maps, errors=replace(maps.errors, prediction=None))
            plain.append(area_budget(bare, 1.0, 0.95, inside).net.std)
    assert 0.5 < math.sqrt(np.mean(np.square(errors)) / np.mean(np.square(stated))) < 1.5
    assert np.mean(stated) < 0.8 * np.mean(plain)


def test_net_volume_is_raised_less_lowered(drawn):
    maps, _ = drawn[0]
    objects = find_objects_of_change(maps, 1.0, 0.95, 0.05)
    inside = np.zeros(SHAPE, bool)
    inside[12:46, 12:116] = True
    budget = area_budget(maps, 1.0, 0.95, inside, objects.direction)
    np.testing.assert_allclose(budget.raised.value - budget.lowered.value, budget.net.value, rtol=0.0, atol=1e-9)


def test_the_volume_of_the_whole_map_is_the_measured_one(drawn):
    maps, error = drawn[1]
    net = area_budget(maps, 1.0, 0.95).net
    np.testing.assert_allclose(net.value, (error + changed()).sum(), rtol=1e-9, atol=0.0)


def test_given_stable_ground_alone_is_data():
    d = quiet(310, SHAPE, correlated=0.03, length=LENGTH)
    d[:, 64:] += 0.05
    stable = np.zeros(SHAPE, bool)
    stable[:, :60] = True
    maps = maps_of(d, stable=stable)
    # far from it nothing is known
    np.testing.assert_allclose(maps.correlated_error[:, 108:], 0.0, rtol=0.0, atol=0.003)
    np.testing.assert_allclose(maps.dod[:, 108:].mean(), 0.05, rtol=0.0, atol=0.02)


def test_errors_far_above_the_noise_may_be_change_and_stay():
    d = quiet(320, SHAPE, correlated=0.4, length=LENGTH)
    maps = maps_of(d)
    assert maps.errors.model.is_correlated
    assert maps.errors.prediction is None
    np.testing.assert_array_equal(maps.correlated_error, 0.0)


def test_a_shift_that_whole_maps_share_is_known_from_the_ground_around():
    d = quiet(330, SHAPE, correlated=0.03, length=LENGTH) + 0.02
    term = CoherentTerm(np.ones((d.size, 1)), np.array([[0.03**2]]))
    maps = maps_of(d, coherent=(term,))
    prediction = maps.errors.prediction
    assert prediction is not None
    assert np.median(prediction.variance) < 0.8 * (np.median(maps.errors.correlated) + 0.03**2)
    assert abs(np.median(maps.dod)) < 0.01


def test_identical_epochs_and_independent_errors_are_left_alone():
    for d in (np.zeros(SHAPE), quiet(340, SHAPE)):
        maps = maps_of(d)
        np.testing.assert_array_equal(maps.dod, d)


def test_the_summary_says_what_was_taken_off(drawn):
    maps, _ = drawn[0]
    grid = Grid.from_region((0.0, 128.0, 0.0, 128.0), 1.0, "EPSG:32632")
    found = summarise(maps, grid)["error_prediction"]
    assert 5.0 < found["hole_radius_m"] < 40.0
    assert 0.0 < found["share_of_variance_left"] < 0.8
    assert 0.03 < found["candidate_share"] < 0.4


def test_unknown_ground_neither_is_data_nor_gets_a_prediction():
    d = quiet(350, SHAPE, correlated=0.03, length=LENGTH)
    d[40:80, 40:80] = np.nan
    maps = maps_of(d)
    assert np.isnan(maps.correlated_error[40:80, 40:80]).all()
    assert np.isfinite(maps.correlated_error[np.isfinite(d)]).all()


def test_one_smooth_field_is_predicted_well_from_beyond_a_hole():
    rng = np.random.default_rng(6)
    d = quiet(360, (140, 140)) + smooth_field(rng, (140, 140), 0.04, 12.0)
    maps = maps_of(d)
    assert maps.dod.std() < 0.75 * d.std()
