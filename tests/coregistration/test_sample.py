"""The sample: even, independent of order, grouped by place."""

import numpy as np

from changedetect.coregistration.sample import Sample, Squares, thin
from changedetect.pointcloud import PointCloud


def _cloud(n=40000, seed=0):
    rng = np.random.default_rng(seed)
    easting, northing = 500000.0 + rng.uniform(0.0, 100.0, n), 5300000.0 + rng.uniform(0.0, 50.0, n)
    return PointCloud(easting, northing, rng.normal(0.0, 1.0, n))


def test_the_choice_does_not_depend_on_the_order():
    cloud = _cloud()
    order = np.random.default_rng(1).permutation(len(cloud))
    shuffled = cloud.select(order)
    for n_target in (100_000, 3000):
        first, second = cloud.select(thin(cloud, n_target)), shuffled.select(thin(shuffled, n_target))
        np.testing.assert_array_equal(first.elevation, second.elevation)


def test_the_choice_is_even_where_density_differs_a_hundredfold():
    cloud = _cloud()
    is_dense = cloud.easting < 500050.0
    cloud = cloud.select(is_dense | (np.arange(len(cloud)) % 100 == 0))
    chosen = cloud.select(thin(cloud, 300))
    dense, sparse = np.sum(chosen.easting < 500050.0), np.sum(chosen.easting >= 500050.0)
    assert 180 <= len(chosen) <= 300
    assert sparse > 0.5 * dense


def test_fewer_observations_than_asked_for_are_all_taken():
    cloud = _cloud(500)
    np.testing.assert_array_equal(np.sort(thin(cloud, 500)), np.arange(500))


def test_squares_add_up_and_lie_where_their_observations_do():
    cloud = _cloud(5000)
    squares = Squares.holding(*cloud.coordinates, 200)
    assert 120 <= len(squares) <= 260
    np.testing.assert_allclose(squares.total(cloud.elevation).sum(), cloud.elevation.sum(), rtol=0, atol=1e-9)
    column = np.floor((cloud.easting - cloud.easting.min()) / squares.side)
    np.testing.assert_array_equal(squares.column[squares.member], column)
    laid_out = squares.raster(np.arange(len(squares)) + 1.0)
    np.testing.assert_array_equal(squares.on_points(laid_out), squares.member + 1.0)


def test_squares_follow_ground_that_fills_little_of_its_bounding_box():
    rng = np.random.default_rng(3)
    along = rng.uniform(0.0, 5000.0, 20000)
    squares = Squares.holding(along, along + rng.uniform(0.0, 20.0, along.size), 500)
    assert 300 <= len(squares) <= 500


def test_precision_follows_variance_within_limits():
    sample = Sample.of(_cloud(1000), np.zeros(1000, dtype=np.int64))
    variance = np.full(1000, 0.04)
    variance[:10], variance[10:20] = 0.01, 1e6
    precision = sample.weighted_by(variance).precision
    np.testing.assert_allclose(precision[[0, 10, 20]], (4.0, 1.0 / 64.0, 1.0), rtol=1e-12, atol=0)
