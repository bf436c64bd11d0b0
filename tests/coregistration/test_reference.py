"""Surfaces to align to."""

import numpy as np
import pytest
import rolling_ground as rolling

from changedetect.coregistration import GridReference, ModelReference
from changedetect.coregistration.reference import slopes_at
from changedetect.models.lwpr import LWPRSurface


def _places(n=200, margin=15.0):
    rng = np.random.default_rng(3)
    low, high = margin, rolling.SIDE - margin
    return rolling.WEST + rng.uniform(low, high, n), rolling.SOUTH + rng.uniform(low, high, n)


def _gradient(easting, northing, h=1e-4):
    ground = rolling.ground
    east = (ground(easting + h, northing) - ground(easting - h, northing)) / (2 * h)
    north = (ground(easting, northing + h) - ground(easting, northing - h)) / (2 * h)
    return east, north


def test_a_raster_gives_its_ground_and_the_gradient():
    reference, places = rolling.reference(noise=0.0), _places()
    elevation, variance = reference.surface(*places)
    np.testing.assert_allclose(elevation, rolling.ground(*places), rtol=0, atol=2e-3)
    assert (variance == 0.0).all()
    slopes = slopes_at(reference, *places)
    east, north = _gradient(*places)
    np.testing.assert_allclose(slopes.east, east, rtol=0, atol=0.01)
    np.testing.assert_allclose(slopes.north, north, rtol=0, atol=0.01)


def test_a_raster_is_undefined_outside_and_its_slopes_are_zero_there():
    reference = rolling.reference()
    easting, northing = np.array([rolling.WEST - 10.0]), np.array([rolling.SOUTH + 10.0])
    elevation, variance = reference.surface(easting, northing)
    assert np.isnan(elevation).all()
    assert np.isnan(variance).all()
    assert slopes_at(reference, easting, northing).wide_east[0] == 0.0


def test_a_learned_surface_gives_elevation_variance_and_gradient():
    cloud = rolling.epoch(n=60000, noise=0.02)
    model = LWPRSurface().fit(cloud.coordinates, cloud.elevation)
    reference, places = ModelReference(model, model.own_kernel_), _places()
    elevation, variance = reference.surface(*places)
    predicted = model.predict(places)
    np.testing.assert_array_equal(elevation, predicted.elevation)
    np.testing.assert_array_equal(variance, predicted.elevation_std**2)
    slopes = slopes_at(reference, *places)
    for own, true in zip((slopes.east, slopes.north), _gradient(*places), strict=True):
        assert np.corrcoef(own, true)[0, 1] > 0.97
        assert np.polyfit(true, own, 1)[0] == pytest.approx(1.0, abs=0.05)


def test_an_array_of_another_shape_than_its_grid_is_refused():
    grid = rolling.reference().grid
    with pytest.raises(ValueError, match="shape"):
        GridReference(np.zeros((3, 3)), grid)
