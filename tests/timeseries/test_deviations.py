"""One surface shared by all epochs: calibrated, unbiased, common to all."""

from __future__ import annotations

import numpy as np
import pytest
from timeseries.small_stack import CELL, LATTICE, REGION, SIDE, epoch

from changedetect.timeseries.deviations import estimate_deviation, learn_shared_surface
from changedetect.timeseries.edges import EdgeFinder

INNER = np.zeros(LATTICE.shape, bool)
INNER[5:-5, 5:-5] = True


def deviations(epochs):
    shared = learn_shared_surface(epochs, REGION)
    return shared, [estimate_deviation(shared, e, LATTICE) for e in epochs]


@pytest.fixture(scope="module")
def stepped():
    """Eight surveys, the east half raised by 0.30 m from the fifth on."""
    return deviations([epoch(k, change=lambda e, _n, k=k: 0.3 * (k >= 4) * (e > SIDE / 2)) for k in range(8)])


def test_deviations_of_unchanged_ground_scatter_as_their_variances_say():
    _, found = deviations([epoch(10 + k) for k in range(10)])
    values = np.array([wide.value for wide, _ in found])
    variances = np.array([wide.variance for wide, _ in found])
    mean = (values / variances).sum(axis=0) / (1.0 / variances).sum(axis=0)
    square = ((values - mean) ** 2 / variances).sum(axis=0) / 9.0
    assert 0.85 < square[INNER].mean() < 1.15


def test_a_step_comes_out_unbiased(stepped):
    _, found = stepped
    values = np.array([wide.value for wide, _ in found])
    after, before = values[4:].mean(axis=0), values[:4].mean(axis=0)
    columns = np.arange(40) * CELL
    np.testing.assert_allclose((after - before)[5:-5, columns > 13.5].mean(), 0.30, rtol=0, atol=0.004)
    np.testing.assert_allclose((after - before)[5:-5, columns < 6.0].mean(), 0.0, rtol=0, atol=0.004)


def test_edges_of_change_are_found_where_they_are(stepped):
    _, found = stepped
    finder = EdgeFinder(LATTICE.shape)
    for wide, narrow in found:
        finder.add(wide, narrow)
    edges = finder.edges()
    assert edges[5:-5, 17:23].mean() > 0.7
    assert edges[5:-5, :12].mean() < 0.03


def test_no_edge_is_found_in_unchanged_ground():
    _, found = deviations([epoch(30 + k) for k in range(6)])
    finder = EdgeFinder(LATTICE.shape)
    for wide, narrow in found:
        finder.add(wide, narrow)
    assert finder.edges()[INNER].mean() < 0.02


def test_ground_that_an_epoch_did_not_see_is_not_observed():
    epochs = [epoch(k) for k in range(3)] + [epoch(9, kept=lambda e, _n: e < 10.0)]
    _, found = deviations(epochs)
    assert not found[3][0].observed[:, 24:].any()
    assert found[3][0].observed[5:-5, 5:15].all()
    assert all(wide.observed[INNER].all() for wide, _ in found[:3])


def test_a_much_sparser_epoch_neither_blurs_the_others_nor_raises_false_change():
    dense = [epoch(40 + k, density=16.0) for k in range(5)]
    shared, found = deviations([*dense, epoch(50, density=1.0)])
    alone, _ = deviations(dense)
    assert shared.kernel == alone.kernel
    assert len(shared.levels) == 2
    wide = found[-1][0]
    others = np.mean([w.value for w, _ in found[:5]], axis=0)
    z = (wide.value - others) / np.sqrt(wide.variance)
    assert np.nanstd(z[INNER]) < 1.6
    assert abs(np.nanmean((wide.value - others)[INNER])) < 0.03


def test_terrain_is_the_ground(stepped):
    shared, _ = stepped
    elevation, slope = shared.terrain(LATTICE)
    assert 298.0 < elevation[INNER].min() < elevation[INNER].max() < 302.0
    assert 0.0 <= slope[INNER].min() < slope[INNER].max() < 1.0
