"""Rays meet the ground where the height field says."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from changedetect.kernels.rendering import bilinear, cast_rays, look

CELL, HALF = 0.5, 20.0
EAST, NORTH = np.meshgrid(np.arange(81) * CELL - HALF, np.arange(81) * CELL - HALF)


def downward(rng, n, steepness=0.3):
    return np.column_stack([rng.uniform(-steepness, steepness, (n, 2)), -np.ones(n)])


def test_nodes_keep_their_value_and_a_plane_is_met_everywhere():
    plane = 2.0 + 0.1 * EAST - 0.2 * NORTH
    assert bilinear(plane, 7.0, 3.0) == plane[7, 3]
    rng = np.random.default_rng(0)
    place = rng.uniform(-19, 19, (200, 2))
    assert_allclose(
        look(place, plane, -HALF, -HALF, CELL), 2.0 + 0.1 * place[:, 0] - 0.2 * place[:, 1], rtol=0, atol=1e-12
    )


def test_beyond_the_rim_the_ground_goes_on_level():
    grid = np.arange(9.0).reshape(3, 3)
    assert bilinear(grid, -5.0, 1.0) == 1.0
    assert bilinear(grid, 9.0, 9.0) == 8.0


def test_rays_meet_an_inclined_plane_at_its_intersection():
    plane = 1.0 + 0.15 * EAST + 0.05 * NORTH
    position = np.array([1.0, -2.0, 40.0])
    direction = downward(np.random.default_rng(1), 500)
    place = cast_rays(direction, position, plane, -HALF, -HALF, CELL, float(plane.max()) + 0.1)
    normal = np.array([-0.15, -0.05, 1.0])
    reach = (1.0 - position @ normal) / (direction @ normal)
    assert_allclose(place, position + reach[:, None] * direction, rtol=0, atol=1e-3)


def test_places_lie_on_rays_and_on_the_ground_and_nothing_hides_them():
    rng = np.random.default_rng(2)
    ground = 1.5 * np.sin(EAST / 3) * np.cos(NORTH / 4)
    ground[30:50, 40:44] += 6.0  # a wall
    position = np.array([0.0, 0.0, 50.0])
    direction = downward(rng, 400)
    place = cast_rays(direction, position, ground, -HALF, -HALF, CELL, float(ground.max()) + 0.1)
    assert_allclose(np.cross(place - position, direction), 0.0, rtol=0, atol=1e-9)
    height = look(place, ground, -HALF, -HALF, CELL)
    flat = np.abs(place[:, 2] - height) < 0.01
    assert flat.mean() > 0.95  # the others meet the side of the wall, metres high within a cell
    assert np.all(place[:, 2] < height + 0.02)
    for share in np.linspace(0.05, 0.98, 60):
        along = position + share * (place - position)
        assert np.all(along[:, 2] > look(along, ground, -HALF, -HALF, CELL) - 1e-9)
