"""Standard errors that hold although errors are correlated."""

import numpy as np
import pytest
import rolling_ground as rolling

from changedetect.coregistration import align
from changedetect.coregistration.uncertainty import fit_block_errors


def _blocks(side=10.0, n=14):
    row, column = (v.ravel() * side for v in np.mgrid[0:n, 0:n])
    return np.hypot(row[:, None] - row, column[:, None] - column), row, column


def _draw(rng, distance, length, variance, share):
    covariance = variance * (share * np.exp(-0.5 * (distance / length) ** 2) + (1.0 - share) * np.eye(len(distance)))
    return rng.multivariate_normal(np.zeros(len(distance)), covariance)


def test_the_correlation_of_block_means_is_found():
    distance, row, column = _blocks()
    design = np.column_stack([np.ones_like(row), row / 70.0 - 1.0, column / 70.0 - 1.0])
    rng = np.random.default_rng(0)
    found = []
    for _ in range(8):
        means = _draw(rng, distance, 20.0, 0.04, 0.7) + design @ (0.5, 0.1, -0.2)
        found.append(fit_block_errors(means, design, distance, np.ones_like(row), 10.0))
    assert all(errors.share > 0.0 for errors in found)
    assert np.median([errors.variance for errors in found]) == pytest.approx(0.04, rel=0.3)
    # 1 / e of a Gaussian correlation of length 20 m
    assert np.median([errors.decay_length for errors in found]) == pytest.approx(20.0 * np.sqrt(2.0), rel=0.25)


def test_white_block_means_are_seldom_taken_to_be_correlated():
    distance, row, _ = _blocks()
    rng = np.random.default_rng(1)
    design, dilution = np.ones((row.size, 1)), np.ones_like(row)
    draws = (rng.normal(0.0, 0.2, row.size) for _ in range(10))
    assert sum(fit_block_errors(means, design, distance, dilution, 10.0).share > 0.0 for means in draws) <= 2


def test_a_column_that_repeats_another_costs_no_second_degree_of_freedom():
    distance, row, _ = _blocks()
    means = np.random.default_rng(2).normal(0.0, 0.2, row.size)
    single, double = (
        fit_block_errors(means, np.ones((row.size, k)), distance, np.ones_like(row), 10.0) for k in (1, 2)
    )
    assert double.variance == pytest.approx(single.variance, rel=1e-6)


@pytest.mark.parametrize("length", [None, 12.0], ids=["independent", "correlated"])
def test_intervals_cover_the_truth(length):
    def error(rng, easting, northing):
        return rolling.correlated(rng, 0.03, length, easting, northing)

    shift, scores = (0.4, -0.3, 0.2), []
    for seed in range(12):
        how = {} if length is None else {"error": error}
        alignment = align(rolling.epoch(seed, 4000, shift=shift, **how), rolling.reference(seed, **how), "shift")
        scores.append((rolling.found_about(alignment) - shift) / alignment.standard_errors)
    spread = np.sqrt(np.mean(np.square(scores), axis=0))
    # 12 draws: the root mean square of z is known to 20 % for each parameter
    assert (spread > 0.5).all()
    assert (spread < 1.6).all()
    assert np.mean(np.abs(scores) < 2.1) > 0.87
