"""Models to change maps, and change maps to numbers."""

import numpy as np
import pytest

from changedetect.config import DifferencingConfig
from changedetect.differencing import CoherentTerm, difference_models, summarise, systematic_offset
from changedetect.grid import Grid
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.reference import ReferenceLWPR

EAST, NORTH, SIDE = 300_000.0, 4_200_000.0, 30.0
GRID = Grid.from_region((EAST, EAST + SIDE, NORTH, NORTH + SIDE), 0.5, "EPSG:32632")
SETTINGS = DifferencingConfig()


def epoch(seed, lift=0.0, model=LWPRSurface, keep_below=SIDE, everywhere=0.0, n=8000):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, SIDE, (2, n))
    z = 50.0 + np.sin(x / 5.0) + everywhere + rng.normal(0.0, 0.04, n)
    z += np.where((x > 10.0) & (x < 20.0) & (y > 18.0) & (y < 28.0), lift, 0.0)
    keep = x < keep_below
    return model().fit((EAST + x[keep], NORTH + y[keep]), z[keep], survey_time=float(seed))


def offsets():
    easting, northing = GRID.coordinates()
    return (easting - EAST).reshape(GRID.shape), (northing - NORTH).reshape(GRID.shape)


@pytest.mark.parametrize("model", [LWPRSurface, ReferenceLWPR])
def test_a_raised_patch_lies_where_it_should_on_a_north_up_map(model):
    maps = difference_models(epoch(1, model=model), epoch(2, 0.5, model=model), GRID, SETTINGS)
    x, y = offsets()
    inside = (x > 12.5) & (x < 17.5) & (y > 20.5) & (y < 25.5)
    # 25 m2 hold about 15 fields of the reference mode, each good to 2 cm
    np.testing.assert_allclose(np.nanmean(maps.dod[inside]), 0.5, rtol=0.05, atol=0.0)
    assert (maps.change_class[inside] == 2).mean() > 0.97
    south = (y < 14.0) & (y > 2.0) & (x > 2.0) & (x < 28.0)
    assert np.mean(maps.change_class[south] == 0) > 0.85


def test_classes_follow_from_difference_and_level_of_detection():
    maps = difference_models(epoch(3), epoch(4, -0.4, keep_below=22.0), GRID, SETTINGS)
    both = np.isfinite(maps.dod)
    np.testing.assert_array_equal(maps.change_class[both] == 1, maps.dod[both] < -maps.level_of_detection[both])
    x, _ = offsets()
    assert (maps.change_class[x > 24.0] == 3).mean() > 0.95
    assert np.isnan(maps.dod[x > 24.0]).all()
    assert (maps.n_effective_later[x > 24.0] == 0.0).all()
    np.testing.assert_allclose(maps.z_score[both], (maps.dod / maps.dod_std)[both], rtol=1e-12, atol=0.0)


def test_probability_of_change_is_high_on_change_and_low_elsewhere():
    maps = difference_models(epoch(5), epoch(6, 0.3), GRID, SETTINGS)
    x, y = offsets()
    inside = (x > 12.5) & (x < 17.5) & (y > 20.5) & (y < 25.5)
    assert maps.change_probability[inside].min() > 0.99
    assert np.nanmedian(maps.change_probability[y < 14.0]) < 0.01


def test_volumes_are_those_of_the_patch():
    summary = summarise(difference_models(epoch(7), epoch(8, 0.5), GRID, SETTINGS), GRID)
    np.testing.assert_allclose(summary["volume_net_m3"], 50.0, rtol=0.03, atol=0.0)
    np.testing.assert_allclose(summary["volume_raised_m3"], 50.0, rtol=0.05, atol=0.0)
    assert summary["volume_lowered_m3"] < 1.0
    balance = summary["volume_raised_m3"] - summary["volume_lowered_m3"]
    np.testing.assert_allclose(balance, summary["volume_net_m3"], rtol=0.0, atol=0.5)
    assert 0.1 < summary["volume_net_std_m3"] < 2.0
    low, high = summary["volume_net_interval_m3"]
    assert low < summary["volume_net_m3"] < high
    assert summary["objects"]["n_raised"] >= 1
    assert summary["systematic_offset_m"] is None


@pytest.mark.slow
def test_standard_deviation_of_the_net_volume_is_that_of_repeated_surveys():
    volumes, stated = [], []
    for seed in range(12):
        maps = difference_models(epoch(100 + seed, n=3000), epoch(200 + seed, n=3000), GRID, SETTINGS)
        summary = summarise(maps, GRID)
        volumes.append(summary["volume_net_m3"])
        stated.append(summary["volume_net_std_m3"])
    # 12 draws: the ratio of standard deviations is known to about 20 %
    assert 0.6 < np.std(volumes) / np.mean(stated) < 1.5


def test_a_datum_step_is_recognised_and_local_change_is_not():
    step = difference_models(epoch(9), epoch(10, everywhere=-0.4), GRID, SETTINGS)
    np.testing.assert_allclose(systematic_offset(step), -0.4, rtol=0.0, atol=0.01)
    assert systematic_offset(difference_models(epoch(11), epoch(12, 0.5), GRID, SETTINGS)) is None


def test_models_of_different_kinds_are_refused():
    with pytest.raises(ValueError, match="learn both with one mode"):
        difference_models(epoch(1), epoch(2, model=ReferenceLWPR), GRID, SETTINGS)


def test_what_alignment_leaves_uncertain_widens_every_cell():
    models = epoch(13), epoch(14)
    offset = CoherentTerm(np.ones((GRID.n_rows * GRID.n_cols, 1)), np.array([[0.03**2]]))
    without = difference_models(*models, GRID, SETTINGS)
    widened = difference_models(*models, GRID, SETTINGS, coherent=[offset])
    both = np.isfinite(without.dod)
    np.testing.assert_allclose(widened.dod_std[both], np.hypot(without.dod_std, 0.03)[both], rtol=1e-9, atol=0.0)


def test_stable_ground_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"stable ground has shape \(3, 3\), the grid \(60, 60\)"):
        difference_models(epoch(1), epoch(2), GRID, SETTINGS, stable=np.ones((3, 3), bool))


def test_coherent_errors_are_not_counted_among_those_that_scatter_too():
    from error_fields import evidence, quiet

    from changedetect.differencing.pair import cell_errors

    shape = (100, 100)
    east = np.tile(np.linspace(-1.0, 1.0, shape[1]), shape[0])
    tilt = CoherentTerm(east[:, None], np.array([[0.05**2]]))
    known, likely = [], []
    for seed in range(4):
        d = quiet(seed, shape, local=0.005, correlated=0.03, length=3.0)
        tilted = evidence(d + 0.08 * east.reshape(shape), 0.005)
        known.append(np.sqrt(cell_errors(evidence(d, 0.005), 1.0).correlated.mean()))
        likely.append(np.sqrt(cell_errors(tilted, 1.0, coherent=(tilt,)).correlated.mean()))
    np.testing.assert_allclose(np.mean(likely), np.mean(known), rtol=0.1, atol=0)
