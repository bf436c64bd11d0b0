"""Interpolation of rasters against polynomials and a written-out oracle."""

import numpy as np

from changedetect.kernels.coregistration import interpolate_raster


def _interpolated(raster, row, column):
    result = np.empty(row.size)
    interpolate_raster(raster, row, column, result)
    return result


def _keys(distance):
    """Keys' cubic convolution kernel with a = -1/2, by distance in nodes."""
    d = abs(distance)
    if d <= 1.0:
        return 1.5 * d**3 - 2.5 * d**2 + 1.0
    return -0.5 * d**3 + 2.5 * d**2 - 4.0 * d + 2.0 if d < 2.0 else 0.0


def test_quadratic_surfaces_are_reproduced():
    row, column = np.mgrid[0:9, 0:12].astype(float)

    def surface(i, j):
        return 3.0 + 0.5 * i - 0.2 * j + 0.1 * i * i - 0.07 * j * j + 0.3 * i * j

    rng = np.random.default_rng(0)
    i, j = rng.uniform(1.0, 7.0, 200), rng.uniform(1.0, 10.0, 200)
    np.testing.assert_allclose(_interpolated(surface(row, column), i, j), surface(i, j), rtol=0, atol=1e-12)


def test_interpolation_equals_the_sum_over_keys_kernel():
    rng = np.random.default_rng(1)
    raster = rng.normal(size=(10, 11))
    i, j = rng.uniform(1.0, 8.0, 50), rng.uniform(1.0, 9.0, 50)
    expected = [
        sum(_keys(a - k) * _keys(b - m) * raster[a, b] for a in range(10) for b in range(11))
        for k, m in zip(i, j, strict=True)
    ]
    np.testing.assert_allclose(_interpolated(raster, i, j), expected, rtol=0, atol=1e-12)


def test_nodes_keep_their_values_up_to_the_rim():
    raster = np.random.default_rng(2).normal(size=(6, 7))
    row, column = (v.ravel().astype(float) for v in np.mgrid[0:6, 0:7])
    np.testing.assert_allclose(_interpolated(raster, row, column), raster.ravel(), rtol=0, atol=1e-14)


def test_next_to_missing_data_interpolation_is_bilinear():
    raster = np.arange(36.0).reshape(6, 6) ** 1.5
    raster[0, 0] = np.nan
    row, column = np.array([1.25]), np.array([1.75])
    corners = raster[1:3, 1:3]
    expected = np.array([0.75, 0.25]) @ corners @ np.array([0.25, 0.75])
    np.testing.assert_allclose(_interpolated(raster, row, column), expected, rtol=0, atol=1e-12)


def test_places_outside_or_beside_missing_nodes_are_undefined():
    raster = np.ones((5, 5))
    raster[2, 2] = np.nan
    row = np.array([-0.01, 4.01, 2.5, 0.5, np.nan])
    column = np.array([2.0, 2.0, 2.5, -1.0, 1.0])
    assert np.isnan(_interpolated(raster, row, column)).all()
    assert np.isnan(_interpolated(np.ones((1, 5)), np.array([0.0]), np.array([1.0]))).all()
