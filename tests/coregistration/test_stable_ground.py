"""Unchanged ground found among changed ground."""

import numpy as np
import pytest

from changedetect.coregistration.sample import Sample
from changedetect.coregistration.stable_ground import agreeing, majority_level, nmad
from changedetect.pointcloud import PointCloud


def _sample(n=20000, seed=0):
    rng = np.random.default_rng(seed)
    easting, northing = rng.uniform(0.0, 100.0, (2, n))
    return Sample.of(PointCloud(easting, northing, np.zeros(n)), np.zeros(n, dtype=np.int64)), rng


def _settled(residual, sample):
    defined = np.ones(residual.size, dtype=np.bool_)
    level, consensus = majority_level(residual, defined, sample), None
    for _ in range(6):
        consensus = agreeing(residual - level, defined, sample, consensus)
    return level, consensus


def test_nmad_is_the_standard_deviation_of_normal_values():
    values = np.random.default_rng(0).normal(3.0, 0.5, 200_000)
    assert nmad(values) == pytest.approx(0.5, rel=0.01)
    assert np.isnan(nmad(np.empty(0)))


def test_the_level_stays_with_the_majority_when_forty_percent_rose():
    sample, rng = _sample()
    residual = 0.2 + rng.normal(0.0, 0.05, len(sample)) + 0.3 * (sample.cloud.easting < 40.0)
    level, consensus = _settled(residual, sample)
    assert level == pytest.approx(0.2, abs=0.02)
    kept = consensus.on_stable_ground(sample.squares)
    is_changed = sample.cloud.easting < 38.0
    assert kept[is_changed].mean() < 0.01
    assert kept[sample.cloud.easting > 42.0].mean() > 0.9
    assert consensus.scale == pytest.approx(0.05, rel=0.1)


def test_a_change_smaller_than_the_noise_is_found_in_the_mean_of_many():
    sample, rng = _sample(60000)
    inside = (np.abs(sample.cloud.easting - 50.0) < 15.0) & (np.abs(sample.cloud.northing - 50.0) < 15.0)
    residual = rng.normal(0.0, 0.05, len(sample)) + 0.04 * inside
    _, consensus = _settled(residual, sample)
    kept = consensus.on_stable_ground(sample.squares)
    assert kept[inside].mean() < 0.1
    assert kept[~inside].mean() > 0.85


def test_single_gross_errors_lose_their_weight_and_not_their_square():
    sample, rng = _sample()
    residual = rng.normal(0.0, 0.05, len(sample))
    is_gross = rng.uniform(size=len(sample)) < 0.05
    residual[is_gross] += 5.0
    _, consensus = _settled(residual, sample)
    assert (consensus.weight[is_gross] == 0.0).all()
    assert consensus.on_stable_ground(sample.squares).mean() > 0.9


def test_ground_without_a_reference_has_no_weight():
    sample, rng = _sample(3000)
    defined = sample.cloud.easting > 30.0
    residual = np.where(defined, rng.normal(0.0, 0.05, 3000), 0.0)
    consensus = agreeing(residual, defined, sample, agreeing(residual, defined, sample, None))
    assert (consensus.weight[~defined] == 0.0).all()
