from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.grid import Grid
from changedetect.synthetic import ChangePatch, Ellipse, Rectangle, Scarp, ScarpRetreat, rasterize

CRS = "EPSG:32632+5773"


def volume(change, resolution=0.05):
    grid = Grid.from_region((0.0, 60.0, 0.0, 60.0), resolution, CRS)
    return rasterize(change, grid).sum() * resolution**2


def outline_points(n=400):
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    return np.cos(angle), np.sin(angle)


def test_distance_to_a_rectangle_is_exact():
    rectangle = Rectangle((10.0, 10.0), length=4.0, width=2.0)
    easting = np.array([10.0, 12.0, 10.0, 11.0, 14.0, 10.9])
    northing = np.array([10.0, 10.0, 15.0, 10.0, 16.0, 11.5])
    assert_allclose(rectangle.distance(easting, northing), [-1.0, 1.0, 3.0, 0.0, 5.0, -0.1], rtol=0, atol=1e-12)


def test_a_turned_rectangle_contains_what_lies_along_its_azimuth():
    rectangle = Rectangle((0.0, 0.0), length=10.0, width=2.0, azimuth_deg=90.0)
    assert rectangle.contains(np.array([4.9, 0.0]), np.array([0.0, 4.9])).tolist() == [True, False]


def test_distance_to_a_circle_is_exact():
    circle = Ellipse((5.0, 5.0), 3.0, 3.0)
    assert_allclose(circle.distance(np.array([5.0, 9.0]), np.array([5.0, 8.0])), [-3.0, 2.0], rtol=0, atol=1e-12)


def test_distance_to_an_ellipse_has_the_right_sign_and_never_exceeds_the_true_one():
    ellipse = Ellipse((5.0, 5.0), 6.0, 2.0)
    cos, sin = outline_points()
    outline = np.column_stack([5.0 + 2.0 * cos, 5.0 + 6.0 * sin])
    places = np.random.default_rng(1).uniform(-5.0, 15.0, (500, 2))
    true = np.min(np.linalg.norm(places[:, None] - outline[None], axis=-1), axis=1)
    stated = ellipse.distance(*places.T)
    inside = ((places[:, 0] - 5.0) / 2.0) ** 2 + ((places[:, 1] - 5.0) / 6.0) ** 2 < 1.0
    assert np.array_equal(stated < 0.0, inside)
    assert np.all(np.abs(stated) <= true + 0.01)


def test_a_box_moves_its_area_times_its_height():
    assert_allclose(volume(ChangePatch(Rectangle((30.0, 30.0), 20.0, 10.0), 0.5)), 100.0, rtol=1e-3, atol=0)


def test_a_plateau_has_its_whole_height_over_its_core():
    plateau = ChangePatch(Rectangle((30.0, 30.0), 18.0, 18.0), 0.5, "plateau", edge=1.0)
    core = np.random.default_rng(1).uniform(22.0, 38.0, (2, 300))
    assert np.array_equal(plateau(*core), np.full(300, 0.5))
    # along an edge the smooth rise moves half its width x height; four corners correct by less than 1 %
    assert_allclose(volume(plateau), 0.5 * 17.0**2, rtol=0.01, atol=0)


def test_a_mound_moves_the_volume_of_its_bell():
    # integral of sin^2(pi (1 - rho) / 2) over an ellipse: pi a b (1 / 2 - 2 / pi^2)
    mound = ChangePatch(Ellipse((30.0, 30.0), 8.0, 6.0, 20.0), 0.2, "mound")
    assert_allclose(volume(mound), 0.2 * np.pi * 48.0 * (0.5 - 2.0 / np.pi**2), rtol=1e-4, atol=0)


def test_a_pit_moves_the_volume_of_its_bowl():
    # integral of 1 - rho^2 over a circle: half its area
    pit = ChangePatch(Ellipse((30.0, 30.0), 7.0, 7.0), -0.3, "pit")
    assert_allclose(volume(pit), -0.3 * np.pi * 49.0 / 2.0, rtol=1e-4, atol=0)


def test_a_retreating_scarp_loses_height_times_retreat_per_metre():
    change = ScarpRetreat(Scarp((25.0, 0.0), 0.0, height=4.0, width=1.5), retreat=3.0)
    assert_allclose(volume(change), -4.0 * 3.0 * 60.0, rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    "change",
    [
        ChangePatch(Rectangle((30.0, 30.0), 20.0, 10.0, 30.0), 0.5),
        ChangePatch(Ellipse((30.0, 30.0), 9.0, 5.0, 70.0), -0.5, "pit"),
        ScarpRetreat(Scarp((25.0, 0.0), 12.0, height=4.0, width=1.5), retreat=3.0),
    ],
)
def test_a_change_is_zero_exactly_where_its_distance_is_positive(change):
    easting, northing = np.random.default_rng(2).uniform(0.0, 60.0, (2, 4000))
    outside = change.distance(easting, northing) > 0.0
    assert outside.any()
    assert np.array_equal(change(easting, northing) == 0.0, outside)


def test_a_plateau_needs_an_edge_that_fits():
    square = Rectangle((0.0, 0.0), 4.0, 4.0)
    for edge in (0.0, 2.1):
        with pytest.raises(ValueError, match="inradius 2 m"):
            ChangePatch(square, 0.5, "plateau", edge=edge)


def test_an_unknown_profile_is_refused():
    with pytest.raises(ValueError, match="Unknown profile 'cone'"):
        ChangePatch(Rectangle((0.0, 0.0), 4.0, 4.0), 0.5, "cone")
