from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.synthetic import Channel, DuneCrests, Scarp, Trees, analytic_ground, random_trees
from changedetect.synthetic.terrain import across_and_along, smoothstep

REGION = (0.0, 60.0, 0.0, 60.0)


def one_tree(height=8.0, radius=3.0, rim_share=0.25):
    return Trees(*(np.array([value]) for value in (30.0, 30.0, height, radius)), rim_share=rim_share)


def test_a_crown_is_as_high_as_stated_above_its_centre_and_has_a_steep_rim():
    tree = one_tree()
    easting = np.array([30.0, 30.0 + 3.0 - 1e-9, 30.0 + 3.0 + 1e-9])
    assert_allclose(tree(easting, np.full(3, 30.0)), [8.0, 2.0, 0.0], rtol=0, atol=1e-3)


def test_a_low_crown_is_a_spherical_cap():
    # cap 2 m high over a radius of 3 m: sphere of radius (9 + 4) / 4
    tree = one_tree(height=2.0, rim_share=0.0)
    away = np.linspace(0.0, 2.9, 30)
    expected = np.sqrt(3.25**2 - away**2) - (3.25 - 2.0)
    assert_allclose(tree(30.0 + away, np.full(30, 30.0)), expected, rtol=0, atol=1e-12)


def test_overlapping_crowns_take_the_higher_one():
    trees = Trees(np.array([30.0, 31.0]), np.array([30.0, 30.0]), np.array([8.0, 5.0]), np.array([3.0, 3.0]), 0.5)
    assert_allclose(trees(np.array([30.0]), np.array([30.0])), [8.0], rtol=0, atol=1e-12)


def test_random_trees_stand_inside_the_region():
    trees = random_trees(REGION, np.random.default_rng(1), n_trees=200)
    assert np.all(trees.easting - trees.radius >= 0.0)
    assert np.all(trees.northing + trees.radius <= 60.0)
    assert np.all((trees.height >= 4.0) & (trees.height <= 12.0))


def test_across_is_positive_to_the_right_of_the_direction():
    across, along = across_and_along(np.array([12.0, 10.0]), np.array([10.0, 13.0]), (10.0, 10.0), azimuth_deg=0.0)
    assert_allclose(across, [2.0, 0.0], rtol=0, atol=1e-12)
    assert_allclose(along, [0.0, 3.0], rtol=0, atol=1e-12)
    across, along = across_and_along(np.array([12.0]), np.array([10.0]), (10.0, 10.0), azimuth_deg=90.0)
    assert_allclose([across[0], along[0]], [0.0, 2.0], rtol=0, atol=1e-12)


def test_smoothstep_is_flat_at_both_ends():
    step = smoothstep(np.array([-1.0, 0.0, 1e-4, 1.0 - 1e-4, 1.0, 2.0]))
    assert_allclose(step, [0.0, 0.0, 0.0, 1.0, 1.0, 1.0], rtol=0, atol=1e-7)


@pytest.mark.parametrize("azimuth_deg", [0.0, 37.0, 200.0])
def test_a_scarp_rises_to_its_height_across_its_face(azimuth_deg):
    scarp = Scarp((30.0, 30.0), azimuth_deg, height=4.0, width=2.0)
    right = np.array([np.cos(np.radians(azimuth_deg)), -np.sin(np.radians(azimuth_deg))])
    across = np.array([-1.0, 0.0, 1.0, 2.0, 9.0])
    assert_allclose(scarp(30.0 + across * right[0], 30.0 + across * right[1]), [0, 0, 2, 4, 4], rtol=0, atol=1e-9)


def test_a_cliff_is_a_vertical_step():
    cliff = Scarp((30.0, 30.0), 0.0, height=4.0)
    assert_allclose(cliff(np.array([30.0, 30.0 + 1e-9]), np.array([5.0, 5.0])), [0.0, 4.0], rtol=0, atol=0)


def test_a_retreated_scarp_is_the_old_one_displaced():
    scarp = Scarp((30.0, 30.0), 25.0, height=4.0, width=2.0)
    rng = np.random.default_rng(3)
    easting, northing = rng.uniform(0.0, 60.0, (2, 200))
    right = np.array([np.cos(np.radians(25.0)), -np.sin(np.radians(25.0))])
    assert_allclose(
        scarp.retreated(3.0)(easting, northing),
        scarp(easting - 3.0 * right[0], northing - 3.0 * right[1]),
        rtol=0,
        atol=1e-12,
    )


def test_a_channel_is_deep_on_its_meandering_centre_line_and_absent_away_from_it():
    channel = Channel((30.0, 0.0), 0.0, 0.8, 1.0, 2.0, meander_amplitude=3.0, meander_wavelength=40.0)
    northing = np.linspace(0.0, 60.0, 50)
    centre = 30.0 + 3.0 * np.sin(2.0 * np.pi * northing / 40.0)
    assert_allclose(channel(centre, northing), -0.8, rtol=0, atol=1e-12)
    assert_allclose(channel(centre + 3.01, northing), 0.0, rtol=0, atol=1e-12)


def test_dunes_are_steeper_in_the_lee_and_repeat_across_their_crests_only():
    dunes = DuneCrests((0.0, 0.0), 0.0, wavelength=12.0, height=1.5, lee_share=0.25)
    across = np.array([0.0, 9.0, 12.0, 21.0])
    assert_allclose(dunes(across, np.zeros(4)), [0.0, 1.5, 0.0, 1.5], rtol=0, atol=1e-9)
    along = np.linspace(0.0, 50.0, 9)
    assert_allclose(dunes(np.full(9, 5.0), along), dunes(np.array([5.0]), np.zeros(1))[0], rtol=0, atol=1e-12)
    windward = np.diff(dunes(np.array([8.0, 8.5]), np.zeros(2)))[0]
    lee = -np.diff(dunes(np.array([9.5, 10.0]), np.zeros(2)))[0]
    assert lee > 2.0 * windward


def test_analytic_ground_differs_between_seeds_and_repeats_for_one():
    easting, northing = np.random.default_rng(0).uniform(0.0, 60.0, (2, 50))
    first, again, other = (
        analytic_ground(REGION, np.random.default_rng(seed))(easting, northing) for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.5
