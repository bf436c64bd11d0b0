from __future__ import annotations

from datetime import date

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.synthetic import (
    EpochPlan,
    SurveyDesign,
    benchmark_dems,
    benchmark_points,
    coast_scene,
    dem_scene,
    demo_programme,
    demo_scene,
    patch_scene,
    simulate_programme,
)


@pytest.fixture(scope="module")
def demo():
    return demo_programme()


def test_the_demonstration_is_what_its_tutorial_describes(demo):
    assert [epoch.epoch_id for epoch in demo.epochs] == ["2024-03-15", "2024-09-10", "2025-03-20"]
    assert demo.scene.crs == "EPSG:32632+5773"
    for epoch in demo.epochs:
        west, east, south, north = epoch.survey.cloud.region
        assert 500_000.0 <= west < east <= 500_060.0
        assert 5_300_000.0 <= south < north <= 5_300_060.0
        assert 8.0 * 3_600 < len(epoch.survey.cloud) < 10.0 * 3_600


def test_the_filled_plateau_stands_half_a_metre_over_at_least_14_by_14_metres_and_stays(demo):
    grid = demo.grid(0.25)
    for later in (1, 2):
        assert np.sum(demo.true_change(grid, 0, later) == 0.5) * 0.25**2 >= 14.0 * 14.0


def test_the_hollow_is_eroded_between_the_second_and_third_epoch_only(demo):
    grid = demo.grid(0.25)
    assert demo.true_change(grid, 0, 1).min() == 0.0
    change = demo.true_change(grid, 1, 2)
    assert change.min() == -0.30
    assert np.sum(change == -0.30) * 0.25**2 > 50.0


def test_the_mound_goes_on_growing(demo):
    grid = demo.grid(0.25)
    south_east_quarter = np.s_[: grid.n_rows // 2, grid.n_cols // 2 :]
    assert_allclose(demo.true_change(grid, 0, 1)[south_east_quarter].max(), 0.20, rtol=0.01, atol=0)
    assert_allclose(demo.true_change(grid, 0, 2)[south_east_quarter].max(), 0.35, rtol=0.01, atol=0)


def test_the_second_epoch_has_a_gap_over_ground_that_does_not_change(demo):
    grid = demo.grid(0.5)
    gap = ~demo.is_covered(grid, 1)
    assert_allclose(gap.sum() * 0.25, 9.0 * 12.0, rtol=0.05, atol=0)
    assert np.all(demo.true_change(grid, 0, 2)[gap] == 0.0)
    assert demo.is_covered(grid, 0).all()
    cloud = demo.epochs[1].survey.cloud
    rows = ((grid.north - cloud.northing) / 0.5).astype(int)
    cols = ((cloud.easting - grid.west) / 0.5).astype(int)
    deep = ~demo.is_covered(grid, 1)
    deep &= np.roll(deep, 1, 0) & np.roll(deep, -1, 0) & np.roll(deep, 1, 1) & np.roll(deep, -1, 1)
    assert not deep[rows, cols].any()


def test_most_of_the_demonstration_is_stable(demo):
    assert np.mean(demo.true_change(demo.grid(0.5), 0, 2) == 0.0) > 0.75


def test_white_noise_of_the_demonstration_is_four_centimetres(demo):
    for epoch in demo.epochs:
        cloud = epoch.survey.cloud
        error = cloud.elevation - epoch.survey.surface(*cloud.coordinates)
        assert_allclose(error.std(), 0.04, rtol=0.02, atol=0)
        assert abs(error.mean()) < 4 * 0.04 / np.sqrt(len(cloud))


def test_true_volumes_add_up_over_epochs(demo):
    first, second, both = demo.true_volume(0, 1), demo.true_volume(1, 2), demo.true_volume(0, 2)
    assert_allclose(first.net + second.net, both.net, rtol=1e-9, atol=0)
    assert_allclose(both.net, both.fill + both.cut, rtol=1e-12, atol=0)
    # plateau and mound in the first interval: 0.5 x 17^2 and 0.2 x pi 48 (1/2 - 2/pi^2), both within 1 %
    assert_allclose(first.fill, 0.5 * 17.0**2 + 0.2 * np.pi * 48.0 * (0.5 - 2.0 / np.pi**2), rtol=0.01, atol=0)


def test_true_elevations_differ_by_the_true_change(demo):
    grid = demo.grid(1.0)
    difference = demo.true_elevation(grid, 2) - demo.true_elevation(grid, 0)
    assert_allclose(difference, demo.true_change(grid, 0, 2), rtol=0, atol=1e-9)


def test_another_seed_gives_another_ground_with_the_same_changes():
    one, two = demo_programme(1, density=1.0), demo_programme(2, density=1.0)
    grid = one.grid(2.0)
    assert np.abs(one.true_elevation(grid, 0) - two.true_elevation(grid, 0)).max() > 0.1
    assert np.array_equal(one.true_change(grid, 0, 2), two.true_change(grid, 0, 2))


def test_epochs_of_a_programme_do_not_share_their_noise():
    programme = demo_programme(1, density=1.0)
    first, last = programme.epochs[0].survey.cloud, programme.epochs[2].survey.cloud
    assert not np.isin(first.easting, last.easting).any()


def test_a_programme_needs_one_plan_a_stage():
    plans = [EpochPlan(date(2024, 1, 1), SurveyDesign(density=1.0))]
    with pytest.raises(ValueError, match="3 stages needs as many epochs; got 1 plans"):
        simulate_programme(demo_scene(1), plans)


def test_dates_of_a_programme_must_ascend():
    plans = [EpochPlan(date(2024, month, 1), SurveyDesign(density=1.0)) for month in (1, 5, 3)]
    with pytest.raises(ValueError, match="must ascend; got 2024-01-01, 2024-05-01, 2024-03-01"):
        simulate_programme(coast_scene(1), plans)


def test_stages_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match=r"0 <= earlier <= later < 3; got 0 and 3"):
        demo_scene(1).change(np.zeros(1), np.zeros(1), earlier=0, later=3)


@pytest.mark.parametrize("seed", range(6))
def test_benchmark_patches_lie_apart_and_inside_the_region(seed):
    scene = patch_scene(seed)
    west, east, south, north = scene.region
    patches = scene.changes_between(0, 1)
    assert sorted(patch.height for patch in patches) == [-0.5, -0.2, 0.02, 0.05, 0.1, 0.5]
    centres = np.array([patch.footprint.centre for patch in patches])
    gaps = np.abs(centres[:, None] - centres[None]).max(axis=-1) + 1e9 * np.eye(6)
    assert gaps.min() > 20.0
    assert np.all((centres - [west, south] >= 10.0) & ([east, north] - centres >= 10.0))


def test_patches_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="do not fit apart"):
        patch_scene(1, patch_side=40.0)


def test_labels_mark_the_inside_of_each_patch_and_leave_its_border_out():
    scene = patch_scene(3)
    rng = np.random.default_rng(1)
    easting = rng.uniform(scene.region[0], scene.region[1], 20_000)
    northing = rng.uniform(scene.region[2], scene.region[3], 20_000)
    label = scene.change_labels(easting, northing, margin=2.0)
    change = scene.change(easting, northing)
    assert np.all(change[label == 0] == 0.0)
    for k, patch in enumerate(scene.changes_between(0, 1), start=1):
        assert np.all(change[label == k] == patch.height)
        assert_allclose(np.mean(label == k), 16.0**2 / 100.0**2, rtol=0.15, atol=0)
    near = np.zeros(easting.size, dtype=bool)
    for patch in scene.changes_between(0, 1):
        near |= np.abs(patch.distance(easting, northing)) < 2.0
    assert np.array_equal(label == -1, near)


def test_overlapping_changes_carry_no_label():
    scene = demo_scene(1)
    mound = scene.changes_between(0, 1)[1].footprint.centre
    label = scene.change_labels(np.array([mound[0]]), np.array([mound[1]]), margin=1.0, earlier=0, later=2)
    assert label.tolist() == [-1]


def test_point_benchmark_differs_by_the_patches_and_the_noise():
    earlier, later = benchmark_points(1, density=4.0)
    easting, northing = later.cloud.coordinates
    error = later.cloud.elevation - later.scene.surface(easting, northing, 0)
    label = later.scene.change_labels(easting, northing, margin=0.5)
    for k, patch in enumerate(later.scene.changes_between(0, 1), start=1):
        assert_allclose(error[label == k].mean(), patch.height, rtol=0, atol=4 * 0.05 / np.sqrt(np.sum(label == k)))
    assert_allclose(error[label == 0].std(), 0.05, rtol=0.02, atol=0)
    assert len(earlier.cloud) == 40_000


def test_correlated_point_benchmark_is_misregistered_by_the_stated_length():
    earlier, later = benchmark_points(2, density=1.0, case="correlated")
    assert earlier.design.errors.shift == (0.0, 0.0, 0.0)
    assert_allclose(np.hypot(*later.design.errors.shift[:2]), 0.036, rtol=1e-12, atol=0)
    assert later.correlated_error.parts


@pytest.mark.parametrize("case", ["independent", "correlated", "heteroscedastic"])
def test_raster_benchmark_has_the_errors_of_its_case(case):
    earlier, later = benchmark_dems(4, size=300, case=case)
    scene, grid = earlier.scene, earlier.grid
    assert earlier.elevation.shape == later.elevation.shape == (300, 300)
    truth = scene.elevation_at(0).on_axes(grid.easting, grid.northing)
    error = earlier.elevation - truth
    white = np.diff(error, axis=1)[:, ::2].std() / np.sqrt(2.0)
    if case == "heteroscedastic":
        assert white > 0.06
        slope = np.hypot(*np.gradient(truth))
        assert error[slope > np.quantile(slope, 0.8)].std() > 1.2 * error[slope < np.quantile(slope, 0.2)].std()
    else:
        assert_allclose(white, 0.05, rtol=0.03, atol=0)
    blocks = error.reshape(30, 10, 30, 10).mean(axis=(1, 3)).std()
    assert (blocks > 0.02) == (case != "independent")
    assert (later.errors.shift[2] == 0.3) == (case != "independent")


def test_raster_scene_changes_a_tenth_of_its_side():
    scene = dem_scene(1, side=500.0)
    assert {patch.footprint.length for patch in scene.changes_between(0, 1)} == {50.0}


def test_unknown_benchmark_cases_are_refused():
    with pytest.raises(ValueError, match="Unknown case 'rainy'"):
        benchmark_points(1, density=1.0, case="rainy")
    with pytest.raises(ValueError, match="Unknown case 'rainy'"):
        benchmark_dems(1, size=20, case="rainy")
