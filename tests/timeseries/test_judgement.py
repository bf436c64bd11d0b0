"""False alarms, power, dates, confirmation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.timeseries import judgement as J
from changedetect.timeseries.judgement import ChangePrior, estimate_prior, judge_series, monitoring_level

PRIOR = ChangePrior(0.3, 0.97, 0.01, 0.01, 0.01)
STD = 0.05


def days(n, seed=0):
    return 17000.0 + np.cumsum(np.random.default_rng(seed).uniform(10.0, 50.0, n))


def noise(n_series, n, seed=1, std=STD):
    return np.random.default_rng(seed).normal(0.0, std, (n_series, n))


def judge(values, std=STD, **kwargs):
    variances = np.broadcast_to(np.asarray(std, float) ** 2, values.shape)
    return judge_series(values, variances, None, days(values.shape[1]), PRIOR, 0.95, **kwargs)


@pytest.mark.parametrize("n", [2, 3, 6, 20, 50])
@pytest.mark.parametrize("kind", ["equal", "unequal", "gaps"])
def test_series_without_change_raise_an_alarm_in_at_most_one_of_twenty(n, kind):
    rng = np.random.default_rng(n)
    std = np.full(n, STD) if kind == "equal" else STD * np.exp(rng.normal(0.0, 0.8, n))
    values = noise(20_000, n, n, std)
    if kind == "gaps":
        values[rng.uniform(size=values.shape) < 0.3] = np.nan
    found = judge(values, std)
    rate = np.mean(found.p_value[found.n_surveys >= 2] <= 0.05)
    # the bound is at most a third too careful with 50 surveys; 0.002 is the sampling error
    assert 0.029 < rate < 0.0545
    assert np.mean(found.series_class[found.n_surveys >= 2] > J.NO_CHANGE) <= rate + 1e-12


def test_a_step_is_dated_sized_and_confirmed():
    values = noise(500, 50)
    values[:, 25:] += 0.15
    found = judge(values)
    assert np.mean(found.series_class == J.BREAK_RAISED) > 0.95
    time = days(50)
    middle = 0.5 * (time[24] + time[25])
    assert np.mean(np.abs(found.break_time - middle) < 100.0) > 0.9
    covered = (found.break_time_earliest <= middle) & (found.break_time_latest >= middle)
    assert 0.93 < covered.mean() <= 1.0
    assert_allclose(found.break_size.mean(), 0.15, rtol=0.03, atol=0)
    z = ((found.break_size - 0.15) / found.break_size_std)[found.series_class == J.BREAK_RAISED]
    assert 0.85 < z.std() < 1.15
    assert found.confirming_surveys.mean() > 8
    assert found.break_probability.mean() > 0.9


def test_a_trend_is_a_trend_and_its_interval_covers():
    time = days(30)
    values = noise(1000, 30) + 0.08 * (time - time[0]) / 365.25
    found = judge(values)
    assert np.mean(found.series_class == J.TREND_RAISING) > 0.9
    z = (found.trend - 0.08) / found.trend_std
    assert 0.85 < z.std() < 1.1
    assert abs(z.mean()) < 0.1


def test_what_came_and_went_is_no_confirmed_break():
    values = noise(500, 40)
    values[:, 15:22] -= 0.2
    found = judge(values)
    assert not np.isin(found.series_class, (J.BREAK_LOWERED, J.BREAK_RAISED)).any()
    assert np.mean(found.series_class == J.RETURNED) > 0.95
    time = days(40)
    exact = (found.break_time == 0.5 * (time[14] + time[15])) & (found.return_time == time[22])
    assert exact[found.series_class == J.RETURNED].mean() > 0.8
    assert_allclose(found.break_size.mean(), -0.2, rtol=0.05, atol=0)


def test_a_break_of_the_newest_survey_is_not_confirmed_and_the_next_survey_confirms_it():
    values = noise(300, 20)
    values[:, 18:] += 0.5
    one = judge(values[:, :19])
    assert np.mean(one.series_class == J.UNCONFIRMED_BREAK) > 0.95
    assert np.mean(one.confirming_surveys == 1) > 0.95
    two = judge(values)
    assert np.mean(two.series_class == J.BREAK_RAISED) > 0.9
    assert np.mean(two.confirming_surveys == 2) > 0.9


def test_a_break_that_the_newest_survey_takes_back_is_not_confirmed():
    values = noise(300, 12)
    values[:, 6:11] += 0.5
    found = judge(values)
    assert not np.isin(found.series_class, (J.BREAK_LOWERED, J.BREAK_RAISED)).any()


def test_a_known_error_of_the_first_survey_is_no_break_in_all_others():
    std = np.full(12, 0.02)
    std[0] = 0.20
    values = noise(20_000, 12, 5, std)
    found = judge(values, std)
    assert np.mean(found.p_value <= 0.05) < 0.055
    since_first = values - values[:, :1]  # what the maps show; the reference's error is in all of them
    same = judge(since_first, std)
    assert_allclose(same.p_value, found.p_value, rtol=1e-6, atol=1e-9)


def test_series_that_no_model_fits_are_called_irregular_and_their_trend_is_widened():
    values = noise(300, 24) + 0.5 * np.sin(np.arange(24) * 2.0 * np.pi / 8.0)
    found = judge(values)
    assert np.mean(found.series_class == J.IRREGULAR) > 0.95
    plain = judge(noise(300, 24))
    assert found.trend_std.min() > 2.0 * plain.trend_std.max()


def test_two_surveys_and_fewer_are_said_to_be_few():
    values = np.array([[0.0, 1.0, np.nan], [0.0, np.nan, np.nan], [np.nan, np.nan, np.nan]])
    found = judge(values)
    assert found.series_class.tolist() == [J.UNCONFIRMED_BREAK, J.TOO_FEW_SURVEYS, J.OUTSIDE]
    assert np.isnan(found.trend).all()
    assert found.n_surveys.tolist() == [2, 1, 0]


def test_degrees_of_freedom_make_small_surveys_careful():
    rng = np.random.default_rng(2)
    n_points = 4
    points = rng.normal(0.0, STD, (40_000, 6, n_points))
    values, variances = points.mean(axis=2), points.var(axis=2, ddof=1) / n_points
    sure = judge_series(values, variances, None, days(6), PRIOR, 0.95)
    honest = judge_series(values, variances, np.full(values.shape, n_points - 1.0), days(6), PRIOR, 0.95)
    assert np.mean(honest.p_value <= 0.05) < 0.6 * np.mean(sure.p_value <= 0.05)


def test_the_prior_finds_how_much_of_the_ground_changed():
    values = noise(4000, 20)
    values[:800, 10:] += np.random.default_rng(3).normal(0.0, 0.5, (800, 1))
    variances = np.full(values.shape, STD**2)
    prior = estimate_prior(values, variances, None, days(20))
    assert 0.12 < prior.step < 0.24
    assert prior.nothing > 0.7
    quiet = estimate_prior(values[800:], variances[800:], None, days(20))
    assert quiet.nothing > 0.95
    assert estimate_prior(values[:20], variances[:20], None, days(20)).nothing == ChangePrior(1.0).nothing


def test_probabilities_of_breaks_are_calibrated():
    rng = np.random.default_rng(4)
    values = noise(20_000, 20, 7)
    changed = rng.uniform(size=20_000) < 0.15
    at = rng.integers(1, 20, 20_000)
    size = rng.normal(0.0, 0.15, 20_000) * changed
    values += size[:, None] * (np.arange(20) >= at[:, None])
    variances = np.full(values.shape, STD**2)
    found = judge_series(values, variances, None, days(20), estimate_prior(values, variances, None, days(20)), 0.95)
    for low, high in ((0.2, 0.5), (0.5, 0.8), (0.8, 1.01)):
        here = (found.break_probability >= low) & (found.break_probability < high)
        # a little is always given to trends and to what came and went, which did not occur here
        assert -0.04 < changed[here].mean() - found.break_probability[here].mean() < 0.12


def test_monitoring_holds_the_rate_over_all_looks():
    level = monitoring_level(12, 0.05)
    assert 0.003 < level < 0.02
    values = noise(4000, 12, 9)
    ever = np.zeros(4000, bool)
    for k in range(2, 13):
        ever |= judge(values[:, :k], level=level).series_class > J.NO_CHANGE
    assert 0.03 < ever.mean() < 0.065


def test_the_level_of_monitoring_falls_slowly_beyond_what_is_simulated(monkeypatch):
    monkeypatch.setattr(J, "_MOST_LOOKS", 12)
    monitoring_level.cache_clear()
    levels = [monitoring_level(n, 0.05) for n in (6, 12, 24, 48)]
    monitoring_level.cache_clear()
    assert levels == sorted(levels, reverse=True)
    assert levels[-1] > 0.2 * levels[1]
