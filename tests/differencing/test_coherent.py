"""Errors that whole maps share."""

import numpy as np
import pytest
from error_fields import change_maps, quiet

from changedetect.differencing import CoherentTerm, sum_std

SHAPE = (60, 80)


def tilt():
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]]
    design = np.column_stack([np.ones(row.size), (col.ravel() - 40.0) / 40.0])
    return CoherentTerm(design, np.array([[4e-4, 1e-4], [1e-4, 9e-4]]))


def test_variances_of_cells_and_sums_are_those_of_drawn_parameters():
    term = tilt()
    rng = np.random.default_rng(3)
    maps = (rng.multivariate_normal(np.zeros(2), term.covariance, 20_000) @ term.design.T).reshape(-1, *SHAPE)
    np.testing.assert_allclose(term.variance(SHAPE)[::20, ::20], maps.var(axis=0)[::20, ::20], rtol=0.06, atol=0.0)
    weights = rng.uniform(0.0, 1.0, SHAPE)
    sums = np.tensordot(maps, weights, 2)
    np.testing.assert_allclose(term.variance_of_sum(weights), sums.var(), rtol=0.06, atol=0.0)


def test_an_offset_common_to_all_cells_widens_their_intervals_and_that_of_the_sum():
    d = quiet(1, SHAPE)
    offset = CoherentTerm(np.ones((d.size, 1)), np.array([[0.05**2]]))
    without, with_offset = change_maps(d), change_maps(d, coherent=[offset])
    expected = np.hypot(without.dod_std, 0.05)
    np.testing.assert_allclose(with_offset.dod_std, expected, rtol=1e-9, atol=0.0)
    whole = np.ones(SHAPE)
    expected_sum = np.hypot(sum_std(without, whole, 1.0), 0.05 * d.size)
    np.testing.assert_allclose(sum_std(with_offset, whole, 1.0), expected_sum, rtol=1e-9, atol=0.0)


def test_shapes_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match="design of shape"):
        CoherentTerm(np.ones((5, 2)), np.eye(3))
    with pytest.raises(ValueError, match="below zero"):
        CoherentTerm(np.ones((5, 1)), np.array([[-1.0]]))
    with pytest.raises(ValueError, match="describes 5 cells; the map has 2 x 3"):
        CoherentTerm(np.ones((5, 1)), np.eye(1)).variance((2, 3))
