"""Regions of conspicuous cells and their false discovery rate."""

import numpy as np
from error_fields import smooth_field
from scipy import stats

from changedetect.differencing.clusters import (
    NullClusters,
    find_clusters,
    normal_score,
    q_values,
    simulate_null,
)
from changedetect.differencing.correlation import NestedCorrelation

SHAPE = (120, 120)
CORRELATION = NestedCorrelation((4.0,), (1.0,))


def test_normal_scores_are_exceeded_as_rarely_as_the_t_values():
    for freedom in (3.0, 6.0, 40.0):
        t = np.linspace(-6.0, 6.0, 41)
        exact = stats.norm.isf(stats.t.sf(np.abs(t), freedom)) * np.sign(t)
        np.testing.assert_allclose(normal_score(t, freedom), exact, rtol=0.0, atol=0.04)
    np.testing.assert_allclose(normal_score(np.array([2.0]), np.inf), [2.0], rtol=1e-4, atol=0.0)


def test_regions_have_one_sign_and_the_mass_above_the_threshold():
    score = np.zeros((10, 10))
    score[1:3, 1:3] = 3.0
    score[3, 3] = 2.5  # touches at a corner
    score[3, 4] = -4.0  # of the other sign
    score[8, 8] = np.nan
    clusters = find_clusters(score, 2.0)
    np.testing.assert_allclose(clusters.mass, [4.5, 2.0], rtol=1e-12, atol=0.0)
    np.testing.assert_array_equal(clusters.sign, [1, -1])
    assert clusters.labels[3, 3] == clusters.labels[1, 1] == 1
    assert clusters.labels[8, 8] == 0


def null(seed=1):
    parts = (np.zeros(SHAPE), np.ones(SHAPE))
    known = np.ones(SHAPE, bool)
    return simulate_null(parts, (CORRELATION, CORRELATION), known, 1.0, 1.96, np.random.default_rng(seed))


def test_expected_regions_agree_with_fields_made_otherwise():
    rng = np.random.default_rng(5)
    masses = np.concatenate([find_clusters(smooth_field(rng, SHAPE, 1.0, 4.0), 1.96).mass for _ in range(60)])
    simulated = null()
    for mass in (1.0, 10.0, 40.0):
        found = np.count_nonzero(masses >= mass) / 60.0
        np.testing.assert_allclose(simulated.expected(np.array([mass]))[0], found, rtol=0.2, atol=0.15)


def test_expected_number_never_grows_with_mass_and_has_a_tail():
    expected = null().expected(np.geomspace(0.01, 5000.0, 200))
    assert (np.diff(expected) <= 1e-12).all()
    assert 0.0 < expected[-1] < 1e-3


def test_without_any_null_region_a_bound_remains():
    np.testing.assert_allclose(NullClusters(np.empty(0), 4).expected(np.array([3.0])), [0.25], rtol=1e-12, atol=0.0)


def test_q_values_fall_with_mass_and_stay_within_one():
    q = q_values(np.array([1.0, 5000.0, 30.0, 2.0]), null())
    assert (np.argsort(q)[:2] == [1, 2]).all()
    assert (q <= 1.0).all()
    assert q[1] < 1e-3


def test_on_unchanged_ground_regions_are_rarely_discovered():
    simulated = null()
    rng = np.random.default_rng(6)
    discovered = [
        bool((q_values(find_clusters(smooth_field(rng, SHAPE, 1.0, 4.0), 1.96).mass, simulated) <= 0.05).any())
        for _ in range(100)
    ]
    assert np.mean(discovered) < 0.12
