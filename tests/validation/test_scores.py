"""Scores: closed forms against their definitions, and what they say of honest and dishonest predictions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from changedetect.models.base import Prediction
from changedetect.validation.scores import crps, negative_log_density, observation_std, score


def prediction(elevation, surface_std, noise_std):
    elevation = np.asarray(elevation, dtype=float)
    full = np.ones_like(elevation)
    return Prediction(
        elevation=elevation,
        elevation_std=surface_std * full,
        noise_std=noise_std * full,
        n_effective=full,
        age_days=0.0 * full,
    )


@pytest.mark.parametrize("freedom", [None, 1.5, 4.0, 50.0])
@pytest.mark.parametrize("z", [-3.0, 0.0, 0.7])
def test_crps_is_the_integral_of_its_definition(z, freedom):
    std = 0.3
    family = stats.norm(scale=std) if freedom is None else stats.t(freedom, scale=std)
    low = integrate.quad(lambda x: family.cdf(x) ** 2, -np.inf, z * std)[0]
    high = integrate.quad(lambda x: family.sf(x) ** 2, z * std, np.inf)[0]
    shape = None if freedom is None else np.array([freedom])
    np.testing.assert_allclose(crps(np.array([z]), np.array([std]), shape), low + high, rtol=1e-6, atol=0)
    density = negative_log_density(np.array([z]), np.array([std]), shape)
    np.testing.assert_allclose(density, -family.logpdf(z * std), rtol=1e-12, atol=0)


def test_a_students_t_of_many_degrees_of_freedom_scores_as_a_gaussian():
    rng = np.random.default_rng(0)
    observed = rng.normal(size=1000)
    answer = prediction(np.zeros(1000), 0.6, 0.8)
    gaussian, student = score(observed, answer), score(observed, answer, freedom=1e5)
    for name, value in gaussian.to_dict().items():
        np.testing.assert_allclose(student.to_dict()[name], value, rtol=1e-3, atol=1e-3)


def test_an_honest_prediction_gets_the_scores_theory_gives_it():
    rng = np.random.default_rng(1)
    observed = 100.0 + rng.normal(0.0, 0.5, 200_000)
    scores = score(observed, prediction(np.full(200_000, 100.0), 0.3, 0.4))
    assert scores.n == 200_000
    np.testing.assert_allclose(scores.rmse, 0.5, rtol=0.01, atol=0)
    np.testing.assert_allclose(scores.mae, 0.5 * np.sqrt(2.0 / np.pi), rtol=0.01, atol=0)
    np.testing.assert_allclose(scores.bias, 0.0, rtol=0, atol=0.005)
    np.testing.assert_allclose(scores.nlpd, 0.5 * np.log(2.0 * np.pi * np.e * 0.25), rtol=0, atol=0.01)
    np.testing.assert_allclose(scores.crps, 0.5 / np.sqrt(np.pi), rtol=0.01, atol=0)
    coverage = [scores.coverage_50, scores.coverage_90, scores.coverage_95]
    np.testing.assert_allclose(coverage, (0.50, 0.90, 0.95), rtol=0, atol=0.005)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_standard_deviation_costs_in_every_proper_score(factor):
    observed = np.random.default_rng(2).normal(0.0, 0.5, 20_000)
    honest = score(observed, prediction(np.zeros(20_000), 0.0, 0.5))
    other = score(observed, prediction(np.zeros(20_000), 0.0, 0.5 * factor))
    assert other.nlpd > honest.nlpd + 0.1
    assert other.crps > 1.02 * honest.crps
    assert (other.coverage_95 > 0.95) == (factor > 1.0)
    assert other.rmse == honest.rmse


def test_only_answers_are_scored():
    answer = prediction([1.0, np.nan, 3.0], 0.1, 0.1)
    scores = score(np.array([1.0, 2.0, 3.5]), answer)
    assert scores.n == 2
    np.testing.assert_allclose(scores.mae, 0.25, rtol=1e-12, atol=0)
    assert score(np.array([1.0]), prediction([np.nan], np.nan, np.nan)) is None


def test_the_spread_of_an_observation_holds_surface_and_noise():
    np.testing.assert_allclose(observation_std(prediction([0.0], 0.3, 0.4)), 0.5, rtol=1e-12, atol=0)


def test_scores_that_mean_nothing_are_refused():
    with pytest.raises(ValueError, match="2 observations and 1 predictions"):
        score(np.zeros(2), prediction([0.0], 0.1, 0.1))
    with pytest.raises(ValueError, match="1 of 1 answers have no positive standard deviation"):
        score(np.zeros(1), prediction([0.0], 0.0, 0.0))
