from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.grid import Grid
from changedetect.synthetic import (
    CanopyNoise,
    Constant,
    EastwardNoise,
    Plane,
    SlopeNoise,
    coast_scene,
    correlated_field,
    dem_scene,
    demo_scene,
    fractal_ground,
    random_trees,
    rasterize,
    trees_scene,
)

REGION = (500_000.0, 500_060.0, 5_300_000.0, 5_300_060.0)


def places(n=500, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(REGION[0], REGION[1], n), rng.uniform(REGION[2], REGION[3], n)


@pytest.mark.parametrize("make", [trees_scene, coast_scene, demo_scene, dem_scene])
def test_a_raster_equals_the_evaluation_at_its_cell_centres(make):
    scene = make(3)
    grid = Grid(n_rows=17, n_cols=23, west=REGION[0] + 3.2, north=REGION[2] + 55.0, resolution=1.7, crs=scene.crs)
    for surface in (scene.elevation_at(scene.n_stages - 1), scene.white_noise):
        assert_allclose(rasterize(surface, grid).ravel(), surface(*grid.coordinates()), rtol=0, atol=1e-9)


def test_row_0_of_a_raster_lies_in_the_north():
    grid = Grid(n_rows=3, n_cols=2, west=0.0, north=3.0, resolution=1.0, crs="EPSG:32632+5773")
    north_slope = Plane(centre=(0.0, 0.0), height=0.0, slope_north=1.0)
    assert_allclose(rasterize(north_slope, grid), [[2.5, 2.5], [1.5, 1.5], [0.5, 0.5]], rtol=0, atol=1e-12)


def test_blocks_of_points_do_not_change_the_values(monkeypatch):
    ground = fractal_ground(REGION, np.random.default_rng(1))
    whole = ground(*places())
    monkeypatch.setattr("changedetect.synthetic.surfaces._BLOCK_ELEMENTS", 1000)
    assert_allclose(ground(*places()), whole, rtol=0, atol=1e-12)


def test_surfaces_add_subtract_and_scale():
    one, two = Constant(2.0), Plane((REGION[0], REGION[2]), 1.0, 0.1, 0.2)
    easting, northing = places()
    expected = 2.0 - 0.5 * (1.0 + 0.1 * (easting - REGION[0]) + 0.2 * (northing - REGION[2]))
    assert_allclose((one - 0.5 * two)(easting, northing), expected, rtol=0, atol=1e-12)


def test_ground_does_not_depend_on_where_in_the_world_it_lies():
    near = fractal_ground((0.0, 60.0, 0.0, 60.0), np.random.default_rng(5))
    far = fractal_ground(REGION, np.random.default_rng(5))
    easting, northing = places()
    assert_allclose(far(easting, northing), near(easting - REGION[0], northing - REGION[2]), rtol=0, atol=1e-7)


def test_relief_of_fractal_ground_is_as_asked_over_many_realisations():
    easting, northing = places(400)
    many = [fractal_ground(REGION, np.random.default_rng(k), relief_std=2.5)(easting, northing) for k in range(200)]
    assert_allclose(np.mean(np.square(many)), 2.5**2, rtol=0.08, atol=0)


def test_variance_of_fractal_ground_grows_with_distance_as_its_roughness_says():
    # between the shortest and the longest wave the variogram of a self-affine surface grows as h ** (2 H)
    grounds = [
        fractal_ground(REGION, np.random.default_rng(k), roughness=0.5, shortest=0.2, longest=500.0) for k in range(100)
    ]
    easting, northing = places(200)
    variogram = [
        np.mean([np.mean((g(easting + h, northing) - g(easting, northing)) ** 2) for g in grounds]) for h in (2.0, 8.0)
    ]
    assert_allclose(np.log(variogram[1] / variogram[0]) / np.log(4.0), 2 * 0.5, rtol=0.1, atol=0)


def test_wavelengths_out_of_order_are_refused():
    with pytest.raises(ValueError, match="shortest < longest"):
        fractal_ground(REGION, np.random.default_rng(0), shortest=5.0, longest=2.0)


def test_correlated_field_has_the_covariance_it_states():
    easting, northing = places(60)
    fields = [correlated_field(REGION, np.random.default_rng(k), std=0.02, correlation_length=10.0) for k in range(600)]
    here = np.array([field(easting, northing) for field in fields])
    for lag in (0.0, 5.0, 10.0, 20.0):
        there = np.array([field(easting + 0.6 * lag, northing + 0.8 * lag) for field in fields])
        expected = 0.02**2 * np.exp(-0.5 * (lag / 10.0) ** 2)
        assert_allclose(np.mean(here * there), expected, rtol=0, atol=0.08 * 0.02**2)


def test_a_field_without_length_is_refused():
    with pytest.raises(ValueError, match="correlation_length > 0"):
        correlated_field(REGION, np.random.default_rng(0), std=0.1, correlation_length=0.0)


def test_noise_grows_to_the_east_and_under_crowns():
    trees = random_trees(REGION, np.random.default_rng(2))
    noise = EastwardNoise(REGION[0], 60.0, at_west=0.15, growth=0.6) + CanopyNoise(trees, 0.5)
    easting, northing = places(2000)
    expected = 0.15 + 0.6 * ((easting - REGION[0]) / 60.0) ** 2 + 0.5 * trees.covers(easting, northing)
    assert_allclose(noise(easting, northing), expected, rtol=0, atol=1e-12)


def test_noise_on_a_plane_follows_its_slope():
    plane = Plane((REGION[0], REGION[2]), 0.0, slope_east=np.tan(np.radians(30.0)))
    assert_allclose(SlopeNoise(plane, 0.05)(*places(3)), 0.05 * (1.0 + 30.0 / 15.0), rtol=1e-6, atol=0)
    cliff = Plane((REGION[0], REGION[2]), 0.0, slope_north=20.0)
    assert_allclose(SlopeNoise(cliff, 0.05)(*places(3)), 0.05 * (1.0 + 45.0 / 15.0), rtol=1e-6, atol=0)
