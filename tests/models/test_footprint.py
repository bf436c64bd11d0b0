"""How much ground an observation averages is found, and a dense surface averaged over as much."""

import numpy as np
import pytest
from coarse_and_dense import SOUTH, WEST, cloud, elevation_model, rough_ground

from changedetect.models.footprint import average_surface, find_footprint
from changedetect.models.lwpr import LWPRSurface

SIDE, CELL = 120.0, 4.0


def columns(surface):
    return lambda easting, northing: surface(easting, northing)[:, None]


@pytest.mark.parametrize(("average", "low", "high"), [(0.0, 0.0, 0.0), (1.0, 0.7, 1.5), (2.0, 1.4, 2.9)])
def test_the_footprint_of_an_elevation_model_is_found(average, low, high):
    ground = rough_ground(3, SIDE)
    model = elevation_model(ground, SIDE, CELL, average=average)
    cells = LWPRSurface().fit(model.coordinates, model.elevation).own_cells()
    side = find_footprint(cells, columns(ground), CELL, 1.0)
    assert low * CELL <= side <= high * CELL


def test_points_of_a_thin_cloud_are_points():
    ground = rough_ground(4, SIDE)
    thin = cloud(ground, SIDE, 0.3)
    cells = LWPRSurface().fit(thin.coordinates, thin.elevation).own_cells()
    assert find_footprint(cells, columns(ground), 1.0 / np.sqrt(0.3), 0.5) == 0.0


def test_change_of_part_of_the_ground_does_not_sway_it():
    ground = rough_ground(3, SIDE)
    model = elevation_model(
        ground, SIDE, CELL, change=lambda e, n: np.where(np.hypot(e - WEST - 60, n - SOUTH - 60) < 30, 2.0, 0.0)
    )
    cells = LWPRSurface().fit(model.coordinates, model.elevation).own_cells()
    assert 0.7 * CELL <= find_footprint(cells, columns(ground), CELL, 1.0) <= 1.5 * CELL


def test_too_few_observations_count_as_points():
    ground = rough_ground(3, SIDE)
    model = elevation_model(ground, 20.0, CELL)
    cells = LWPRSurface().fit(model.coordinates, model.elevation).own_cells()
    assert find_footprint(cells, columns(ground), CELL, 1.0) == 0.0


def test_the_mean_of_a_plane_is_its_value_and_that_of_a_bowl_lies_higher():
    places = (np.array([1.0, 5.0]), np.array([2.0, -3.0]))
    plane = average_surface(columns(lambda x, y: 2.0 * x - y), places, 4.0, 0.25)
    np.testing.assert_allclose(plane.surface[:, 0], 2.0 * places[0] - places[1], rtol=0, atol=1e-12)
    bowl = average_surface(columns(lambda x, y: x * x + y * y), places, 4.0, 0.25)
    # the mean of x^2 over a square of side s lies s^2 / 12 above that in the middle; 16 places a side see 255/256 of it
    expected = places[0] ** 2 + places[1] ** 2 + 2.0 * 16.0 / 12.0
    np.testing.assert_allclose(bowl.surface[:, 0], expected, rtol=0, atol=0.011)


def test_squares_that_are_partly_unknown_are_unknown():
    def surface(easting, northing):
        return np.where(easting > 0.0, easting, np.nan)[:, None]

    found = average_surface(surface, (np.array([-3.0, 0.0, 0.6, 1.1]), np.zeros(4)), 2.0, 0.1)
    assert found.known.tolist() == [False, False, False, True]
