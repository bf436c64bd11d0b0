"""Hold-outs: the right share, the same for everybody, and blocks that are gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from changedetect.errors import ConfigError, InputDataError
from changedetect.validation.splits import default_block_side, hold_out_blocks, hold_out_random, thin

WEST, SOUTH = 500000.0, 5300000.0


def positions(n=20_000, side=100.0, seed=0):
    rng = np.random.default_rng(seed)
    return WEST + rng.uniform(0.0, side, n), SOUTH + rng.uniform(0.0, side, n)


@pytest.mark.parametrize("share", [0.05, 0.1, 0.5])
def test_a_random_hold_out_takes_its_share(share):
    taken = hold_out_random(positions(), share).mean()
    # binomial: five standard deviations
    np.testing.assert_allclose(taken, share, rtol=0, atol=5.0 * np.sqrt(share * (1.0 - share) / 20_000))


def test_a_random_hold_out_is_spread_evenly_over_the_ground():
    easting, northing = positions(40_000)
    chosen = hold_out_random((easting, northing), 0.1)
    column, row = ((easting - WEST) // 20).astype(int), ((northing - SOUTH) // 20).astype(int)
    count = np.bincount(5 * row + column, minlength=25)
    held = np.bincount((5 * row + column)[chosen], minlength=25)
    excess = (held - 0.1 * count) / np.sqrt(0.09 * count)
    assert np.abs(excess).max() < 4.0
    assert 0.5 < excess.std() < 1.5


@given(st.integers(0, 2**31), st.permutations(range(200)))
@settings(max_examples=20, deadline=None)
def test_what_is_held_out_does_not_depend_on_the_order_of_the_points(seed, order):
    easting, northing = positions(200, side=20.0)
    turned = easting[order], northing[order]
    np.testing.assert_array_equal(
        hold_out_random((easting, northing), 0.2, seed)[order], hold_out_random(turned, 0.2, seed)
    )
    np.testing.assert_array_equal(
        hold_out_blocks((easting, northing), 0.2, seed)[0][order], hold_out_blocks(turned, 0.2, seed)[0]
    )


def test_points_at_one_place_go_together():
    easting, northing = positions(500)
    doubled = np.repeat(easting, 2), np.repeat(northing, 2)
    chosen = hold_out_random(doubled, 0.3)
    np.testing.assert_array_equal(chosen[::2], chosen[1::2])
    assert 0 < chosen.sum() < chosen.size


def test_seeds_make_independent_choices():
    one, other = (hold_out_random(positions(), 0.2, seed) for seed in (1, 2))
    np.testing.assert_allclose(np.mean(one & other), 0.04, rtol=0, atol=0.008)
    assert not np.array_equal(hold_out_blocks(positions(), seed=1)[0], hold_out_blocks(positions(), seed=2)[0])


def test_a_held_out_block_is_a_gap_without_any_point_left():
    easting, northing = positions()
    chosen, side = hold_out_blocks((easting, northing), 0.1, seed=3, side=5.0)
    assert side == 5.0
    np.testing.assert_allclose(chosen.mean(), 0.1, rtol=0, atol=0.006)
    nearest = [
        np.hypot(easting[~chosen] - x, northing[~chosen] - y).min()
        for x, y in zip(easting[chosen][:400], northing[chosen][:400], strict=True)
    ]
    # in the middle of a block the nearest point that is left lies about half a side away
    assert np.max(nearest) > 2.0
    assert np.mean(nearest) > 3.0 * 0.5 / np.sqrt(20_000 / 1e4)


def test_blocks_are_five_point_distances_wide_where_nothing_is_said():
    side = default_block_side(positions())
    np.testing.assert_allclose(side, 5.0 / np.sqrt(2.0), rtol=0.15, atol=0)
    assert hold_out_blocks(positions())[1] == side


def test_thinning_takes_as_many_as_asked_and_not_what_the_hold_out_takes():
    coordinates = positions()
    chosen = thin(coordinates, 5000, seed=4)
    assert chosen.size == 5000
    assert np.all(np.diff(chosen) > 0)
    held_out = hold_out_random(coordinates, 0.1, seed=4)
    np.testing.assert_allclose(held_out[chosen].mean(), held_out.mean(), rtol=0, atol=0.02)
    assert thin(coordinates, 10**6).size == 20_000


def test_impossible_hold_outs_are_refused():
    with pytest.raises(ConfigError, match=r"must lie between 0 and 1; got 1\.5"):
        hold_out_random(positions(), 1.5)
    with pytest.raises(ConfigError, match="side of a held-out block must be positive"):
        hold_out_blocks(positions(), side=-1.0)
    with pytest.raises(InputDataError, match=r"Blocks of 90 m are too large.*10 are needed"):
        hold_out_blocks(positions(), side=90.0)
