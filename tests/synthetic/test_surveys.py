from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.grid import Grid
from changedetect.synthetic import (
    Constant,
    CorrelatedError,
    Ellipse,
    Plane,
    Rectangle,
    Scene,
    SurveyDesign,
    SurveyErrors,
    demo_scene,
    survey_dem,
    survey_points,
    trees_scene,
)

REGION = (500_000.0, 500_100.0, 5_300_000.0, 5_300_100.0)


def plane_scene(noise=0.05):
    ground = Plane((REGION[0], REGION[2]), 100.0, 0.1, -0.2)
    return Scene(region=REGION, ground=ground, white_noise=Constant(noise))


def residual(survey):
    cloud = survey.cloud
    return cloud.elevation - survey.surface(cloud.easting, cloud.northing)


def test_a_seed_repeats_a_survey_and_another_differs():
    design = SurveyDesign(density=2.0)
    first, again, other = (survey_points(demo_scene(1), design, seed).cloud for seed in (5, 5, 6))
    assert np.array_equal(first.elevation, again.elevation)
    assert not np.array_equal(first.elevation, other.elevation)


def test_density_counts_points_per_square_metre():
    assert len(survey_points(plane_scene(), SurveyDesign(density=1.5), 1).cloud) == 15_000


def test_positions_fill_the_region_evenly():
    cloud = survey_points(plane_scene(), SurveyDesign(density=4.0), 1).cloud
    count, _, _ = np.histogram2d(cloud.easting, cloud.northing, bins=10, range=[REGION[:2], REGION[2:]])
    # chi squared with 99 degrees of freedom: 99 +- 14
    assert np.sum((count - 400.0) ** 2 / 400.0) < 99 + 4 * 14


def test_density_grows_to_the_east_as_asked():
    cloud = survey_points(plane_scene(), SurveyDesign(density=8.0, density_ratio=4.0), 1).cloud
    share = (cloud.easting - REGION[0]) / 100.0
    west, east = np.mean(share < 0.1), np.mean(share > 0.9)
    # linear density 1 + 3 t: masses of the first and last tenth
    assert_allclose(east / west, (1 + 3 * 0.95) / (1 + 3 * 0.05), rtol=0.05, atol=0)
    assert len(cloud) == 80_000


def test_residuals_are_as_large_as_the_scene_says_place_by_place():
    survey = survey_points(trees_scene(4), SurveyDesign(density=10.0), 1)
    scaled = residual(survey) / survey.noise_std(survey.cloud.easting, survey.cloud.northing)
    assert_allclose(scaled.std(), 1.0, rtol=0.015, atol=0)
    assert abs(scaled.mean()) < 4.0 / np.sqrt(scaled.size)
    # normal: 95 % within 1.96
    assert_allclose(np.mean(np.abs(scaled) < 1.96), 0.95, rtol=0, atol=0.005)


def test_reported_sigma_is_the_white_noise_and_absent_otherwise():
    scene = trees_scene(4)
    survey = survey_points(scene, SurveyDesign(density=1.0, is_sigma_reported=True), 1)
    expected = scene.noise_std(survey.cloud.easting, survey.cloud.northing)
    assert_allclose(survey.cloud.sigma, expected, rtol=1e-12, atol=0)
    assert survey_points(scene, SurveyDesign(density=1.0), 1).cloud.sigma is None


def test_no_point_falls_into_a_gap_and_the_others_stay():
    gap = Ellipse((REGION[0] + 30.0, REGION[2] + 40.0), 12.0, 6.0, 25.0)
    whole = survey_points(plane_scene(), SurveyDesign(density=2.0), 1)
    holed = survey_points(plane_scene(), SurveyDesign(density=2.0, gaps=(gap,)), 1)
    assert not gap.contains(*holed.cloud.coordinates).any()
    assert np.isin(holed.cloud.easting, whole.cloud.easting).all()
    assert len(whole.cloud) - len(holed.cloud) == int(gap.contains(*whole.cloud.coordinates).sum())


def test_coverage_excludes_gaps_and_everything_outside_the_region():
    gap = Rectangle((REGION[0] + 30.0, REGION[2] + 40.0), 10.0, 10.0)
    survey = survey_points(plane_scene(), SurveyDesign(density=1.0, gaps=(gap,)), 1)
    easting = REGION[0] + np.array([30.0, 50.0, -1.0])
    assert survey.is_covered(easting, np.full(3, REGION[2] + 40.0)).tolist() == [False, True, False]


def test_misregistration_displaces_the_cloud_and_nothing_else():
    still = survey_points(plane_scene(), SurveyDesign(density=1.0), 1).cloud
    shifted_by = SurveyErrors(shift=(0.3, -0.2, 0.1))
    moved = survey_points(plane_scene(), SurveyDesign(density=1.0, errors=shifted_by), 1).cloud
    assert_allclose(moved.easting - still.easting, 0.3, rtol=0, atol=1e-8)
    assert_allclose(moved.northing - still.northing, -0.2, rtol=0, atol=1e-8)
    assert_allclose(moved.elevation - still.elevation, 0.1, rtol=0, atol=1e-12)


def test_a_share_of_the_points_are_gross_errors_and_known_as_such():
    errors = SurveyErrors(outlier_share=0.03, outlier_std=5.0)
    survey = survey_points(plane_scene(), SurveyDesign(density=4.0, errors=errors), 1)
    assert_allclose(survey.is_outlier.mean(), 0.03, rtol=0, atol=0.003)
    assert_allclose(residual(survey)[survey.is_outlier].std(), 5.0, rtol=0.1, atol=0)
    assert_allclose(residual(survey)[~survey.is_outlier].std(), 0.05, rtol=0.02, atol=0)


def test_correlated_errors_are_shared_by_neighbours_and_recorded():
    errors = SurveyErrors(white_scale=0.0, correlated=(CorrelatedError(0.03, 10.0), CorrelatedError(0.04, 40.0)))
    survey = survey_points(plane_scene(), SurveyDesign(density=1.0, errors=errors), 1)
    assert_allclose(residual(survey), survey.correlated_error(*survey.cloud.coordinates), rtol=0, atol=1e-9)
    assert 0.02 < residual(survey).std() < 0.08


def test_two_surveys_draw_different_error_fields():
    errors = SurveyErrors(white_scale=0.0, correlated=(CorrelatedError(0.03, 10.0),))
    fields = [
        survey_points(plane_scene(), SurveyDesign(density=1.0, errors=errors), k).correlated_error for k in (1, 2)
    ]
    place = np.array([REGION[0] + 50.0]), np.array([REGION[2] + 50.0])
    assert fields[0](*place)[0] != fields[1](*place)[0]


def test_a_raster_survey_shows_the_displaced_ground_with_noise_and_gaps():
    scene = plane_scene(noise=0.05)
    grid = Grid.from_region(REGION, 1.0, scene.crs)
    gap = Rectangle((REGION[0] + 30.0, REGION[2] + 40.0), 10.0, 10.0)
    survey = survey_dem(scene, grid, SurveyErrors(shift=(0.7, -0.4, 0.3)), 1, gaps=(gap,))
    easting, northing = grid.coordinates()
    # the plane rises by 0.1 to the east and falls by 0.2 to the north
    expected = scene.surface(easting, northing) - 0.7 * 0.1 - 0.4 * 0.2 + 0.3
    error = survey.elevation.ravel() - expected
    assert np.array_equal(np.isnan(error), gap.contains(easting, northing))
    assert abs(np.nanmean(error)) < 4 * 0.05 / 100
    assert_allclose(np.nanstd(error), 0.05, rtol=0.03, atol=0)


def test_the_surveyed_stage_is_the_one_asked_for():
    scene = demo_scene(2)
    quiet = SurveyDesign(density=2.0, errors=SurveyErrors(white_scale=0.0))
    before, after = (survey_points(scene, quiet, 1, stage=k).cloud for k in (0, 1))
    assert_allclose(
        after.elevation - before.elevation, scene.change(before.easting, before.northing), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("density", [0.0, -1.0, float("nan")])
def test_a_density_that_is_not_positive_is_refused(density):
    with pytest.raises(ValueError, match="must be positive"):
        SurveyDesign(density=density)


def test_an_impossible_share_of_outliers_is_refused():
    with pytest.raises(ValueError, match="between 0 and 1"):
        SurveyErrors(outlier_share=1.5)
