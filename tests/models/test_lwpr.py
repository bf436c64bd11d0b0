"""The adaptive surface model: accuracy, honesty, adaptation, persistence."""

import numpy as np
import pytest

from changedetect.config import AdaptiveConfig
from changedetect.errors import ModelStateError
from changedetect.models import pyramid
from changedetect.models.lwpr import LWPRSurface, point_density

EAST, NORTH = 432_000.0, 5_331_000.0


def ground(easting, northing):
    x, y = easting - EAST, northing - NORTH
    return 300.0 + 0.05 * x + 1.0 * np.sin(x / 4.0) * np.cos(y / 5.0)


def survey(n=9000, seed=0, noise=0.05, side=30.0, lift=0.0):
    rng = np.random.default_rng(seed)
    easting, northing = EAST + rng.uniform(0.0, side, n), NORTH + rng.uniform(0.0, side, n)
    return (easting, northing), ground(easting, northing) + lift + rng.normal(0.0, noise, n)


def queries(low=2.0, high=28.0, n=40):
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(low, high, n), np.linspace(low, high, n)))
    return EAST + x, NORTH + y


def test_surface_is_far_more_accurate_than_one_observation_and_says_so():
    coordinates, elevation = survey()
    at = queries()
    answer = LWPRSurface().fit(coordinates, elevation).predict(at)
    error = answer.elevation - ground(*at)
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert 0.92 < np.mean(np.abs(error) < 1.96 * answer.elevation_std) <= 1.0
    np.testing.assert_allclose(np.median(answer.noise_std), 0.05, rtol=0.1, atol=0.0)
    assert np.median(answer.n_effective) > 3.0
    assert (answer.age_days == 0.0).all()


def test_new_observations_fall_into_the_stated_interval():
    coordinates, elevation = survey(seed=1)
    other, observed = survey(n=2000, seed=2)
    answer = LWPRSurface().fit(coordinates, elevation).predict(other)
    known = np.isfinite(answer.elevation)
    spread = np.hypot(answer.elevation_std, answer.noise_std)[known]
    assert 0.93 < np.mean(np.abs(observed[known] - answer.elevation[known]) < 1.96 * spread) < 0.97


def test_noise_is_local():
    coordinates, elevation = survey(noise=0.0)
    rng = np.random.default_rng(3)
    quiet = coordinates[0] < EAST + 15.0
    elevation = elevation + rng.normal(0.0, 1.0, elevation.size) * np.where(quiet, 0.03, 0.3)
    model = LWPRSurface().fit(coordinates, elevation)
    at = queries()
    noise = model.predict(at).noise_std
    np.testing.assert_allclose(np.median(noise[at[0] < EAST + 11.0]), 0.03, rtol=0.15, atol=0.0)
    np.testing.assert_allclose(np.median(noise[at[0] > EAST + 19.0]), 0.3, rtol=0.15, atol=0.0)


def test_stated_sigmas_weigh_the_observations():
    coordinates, elevation = survey(n=12_000, noise=0.0, seed=4)
    rng = np.random.default_rng(5)
    sigma = rng.choice([0.02, 0.5], elevation.size)
    elevation = elevation + rng.normal(0.0, 1.0, elevation.size) * sigma
    at = queries()
    weighted = LWPRSurface().fit(coordinates, elevation, sigma).predict(at)
    plain = LWPRSurface().fit(coordinates, elevation).predict(at)
    rmse = [np.sqrt(np.mean((p.elevation - ground(*at)) ** 2)) for p in (weighted, plain)]
    assert rmse[0] < 0.4 * rmse[1]


def test_nothing_is_invented_outside_the_data_or_in_large_gaps():
    (easting, northing), elevation = survey()
    hole = np.hypot(easting - EAST - 15.0, northing - NORTH - 15.0) < 5.0
    model = LWPRSurface().fit((easting[~hole], northing[~hole]), elevation[~hole])
    places = np.array([[15.0, 15.0], [32.0, 15.0], [-2.0, -2.0], [25.0, 25.0], [1000.0, 0.0]])
    answer = model.predict((EAST + places[:, 0], NORTH + places[:, 1]))
    np.testing.assert_array_equal(np.isnan(answer.elevation), [True, True, True, False, True])
    np.testing.assert_array_equal(answer.n_effective[[0, 1, 2, 4]], 0.0)


def test_order_of_observations_changes_no_bit():
    coordinates, elevation = survey(n=4000, seed=6)
    at = queries()
    expected = LWPRSurface().fit(coordinates, elevation).predict(at)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(elevation.size)
        answer = LWPRSurface().fit((coordinates[0][order], coordinates[1][order]), elevation[order]).predict(at)
        np.testing.assert_array_equal(answer.elevation, expected.elevation)
        np.testing.assert_array_equal(answer.elevation_std, expected.elevation_std)


def test_size_of_the_blocks_of_work_changes_no_bit(monkeypatch):
    coordinates, elevation = survey(n=4000, seed=7)
    at = queries()
    expected = LWPRSurface().fit(coordinates, elevation).predict(at)
    monkeypatch.setattr(pyramid, "_BLOCK_FIELDS", 13)
    answer = LWPRSurface().fit(coordinates, elevation).predict(at)
    np.testing.assert_array_equal(answer.elevation, expected.elevation)
    np.testing.assert_array_equal(answer.noise_std, expected.noise_std)


def test_a_step_between_epochs_is_not_attenuated():
    first, elevation = survey(seed=8)
    second, later = survey(seed=9)
    raised = (np.abs(second[0] - EAST - 15.0) < 8.0) & (np.abs(second[1] - NORTH - 15.0) < 8.0)
    later = later + np.where(raised, 0.5, 0.0)
    model = LWPRSurface().fit(first, elevation, survey_time=19_000.0)
    adapted = model.copy().partial_fit(second, later, survey_time=19_200.0)
    inside = queries(9.0, 21.0)
    step = np.mean(adapted.predict(inside).elevation - model.predict(inside).elevation)
    np.testing.assert_allclose(step, 0.5, rtol=0.01, atol=0.0)


def test_ground_not_seen_again_stays_and_ages():
    first, elevation = survey(seed=10)
    (easting, northing), later = survey(seed=11, lift=0.3)
    west = easting < EAST + 15.0
    model = LWPRSurface().fit(first, elevation, survey_time=19_000.0)
    adapted = model.copy().partial_fit((easting[west], northing[west]), later[west], survey_time=19_100.0)
    at = queries(18.0, 28.0)
    before, after = model.predict(at), adapted.predict(at)
    np.testing.assert_allclose(after.elevation, before.elevation, rtol=0.0, atol=0.03)
    np.testing.assert_allclose(after.age_days, 100.0, rtol=0.0, atol=1e-6)
    assert not adapted.observed(at).any()
    seen = queries(2.0, 12.0)
    assert adapted.observed(seen).all()
    assert (adapted.predict(seen).age_days == 0.0).all()


def test_the_past_sharpens_a_thin_survey_of_unchanged_ground():
    first, elevation = survey(n=9000, seed=12)
    second, later = survey(n=400, seed=13)
    at = queries()
    alone = LWPRSurface().fit(second, later).predict(at)
    model = LWPRSurface().fit(first, elevation, survey_time=0.0)
    adapted = model.copy().partial_fit(second, later, survey_time=30.0).predict(at)
    known = np.isfinite(alone.elevation)
    rmse = [np.sqrt(np.mean((p.elevation - ground(*at))[known] ** 2)) for p in (alone, adapted)]
    assert rmse[1] < 0.7 * rmse[0]


def test_learning_epochs_again_from_their_evidence_gives_the_same_model():
    surveys = [survey(n=3000, seed=s, lift=0.1 * s) for s in range(3)]
    chain = []
    for k, (coordinates, elevation) in enumerate(surveys):
        model = chain[-1].copy() if chain else LWPRSurface()
        chain.append(model.partial_fit(coordinates, elevation, survey_time=100.0 * k))
    at = queries()
    again = chain[0].rebuilt_on(None)
    for model in chain[1:]:
        again = model.rebuilt_on(again)
    np.testing.assert_array_equal(again.predict(at).elevation, chain[-1].predict(at).elevation)
    # the epoch in the middle withdrawn, as if it had never been
    without = chain[2].rebuilt_on(chain[0])
    scratch = LWPRSurface().fit(*surveys[0], survey_time=0.0).partial_fit(*surveys[2], survey_time=200.0)
    np.testing.assert_allclose(without.predict(at).elevation, scratch.predict(at).elevation, rtol=0.0, atol=1e-9)


def test_a_reloaded_model_predicts_the_same_bits(tmp_path):
    first, elevation = survey(n=3000, seed=14)
    second, later = survey(n=2000, seed=15)
    rng = np.random.default_rng(0)
    model = LWPRSurface(AdaptiveConfig(shrinkage=0.9), 365.0, 0.5).fit(first, elevation, survey_time=1.0)
    model.partial_fit(second, later, rng.uniform(0.05, 0.1, later.size), survey_time=40.0)
    model.save(tmp_path / "state")
    reloaded = LWPRSurface.load(tmp_path / "state")
    at = queries()
    for name in ("elevation", "elevation_std", "noise_std", "n_effective", "age_days"):
        np.testing.assert_array_equal(getattr(reloaded.predict(at), name), getattr(model.predict(at), name))
    third, last = survey(n=1000, seed=16)
    expected = model.partial_fit(third, last, survey_time=50.0).predict(at).elevation
    np.testing.assert_array_equal(reloaded.partial_fit(third, last, survey_time=50.0).predict(at).elevation, expected)


def test_a_damaged_or_foreign_state_is_refused(tmp_path):
    coordinates, elevation = survey(n=500)
    LWPRSurface().fit(coordinates, elevation).save(tmp_path)
    part = next(tmp_path.glob("evidence_*.nc"))
    part.write_bytes(part.read_bytes()[:200])
    with pytest.raises(ModelStateError, match=part.name):
        LWPRSurface.load(tmp_path)


def test_a_model_that_learned_nothing_cannot_be_saved(tmp_path):
    with pytest.raises(ModelStateError, match="learned nothing"):
        LWPRSurface().save(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"elevation": np.array([1.0, np.nan])}, "not finite"),
        ({"elevation": np.array([1.0])}, "same length"),
        ({"sigma": np.array([0.1, 0.0])}, "positive"),
    ],
)
def test_observations_that_cannot_be_used_are_refused(change, message):
    arguments = {"elevation": np.array([1.0, 2.0]), "sigma": None} | change
    with pytest.raises(ValueError, match=message):
        LWPRSurface().fit((np.array([0.0, 1.0]), np.array([0.0, 1.0])), **arguments)


def test_epochs_must_come_in_order_of_time():
    coordinates, elevation = survey(n=500)
    model = LWPRSurface().fit(coordinates, elevation, survey_time=10.0)
    with pytest.raises(ValueError, match="before the present epoch"):
        model.partial_fit(coordinates, elevation, survey_time=9.0)


@pytest.mark.parametrize("density", [0.5, 7.0, 120.0])
def test_density_is_found_also_when_only_part_of_the_extent_is_covered(density):
    rng = np.random.default_rng(0)
    n = int(density * 400.0)
    easting = np.r_[rng.uniform(0.0, 20.0, n), 2000.0]
    northing = np.r_[rng.uniform(0.0, 20.0, n), 2000.0]
    np.testing.assert_allclose(point_density(easting, northing), density, rtol=0.6, atol=0.0)


@pytest.mark.parametrize("stated", [0.025, 0.05, 0.2])
def test_the_noise_found_is_compared_with_the_sigma_stated(stated):
    rng = np.random.default_rng(31)
    x, y = rng.uniform(0.0, 40.0, (2, 12_000))
    z = 0.1 * x + np.sin(y / 9.0) + rng.normal(0.0, 0.05, x.size)
    model = LWPRSurface().fit((x, y), z, np.full(x.size, stated))
    np.testing.assert_allclose(model.stated_sigma_ratio(), 0.05 / stated, rtol=0.05, atol=0.0)
    assert LWPRSurface().fit((x, y), z).stated_sigma_ratio() is None


def test_chosen_settings_follow_the_density_and_what_is_set_stays():
    coordinates, elevation = survey()
    chosen = LWPRSurface().fit(coordinates, elevation).chosen_settings()
    thinned = tuple(c[::16] for c in coordinates)
    sparse = LWPRSurface().fit(thinned, elevation[::16]).chosen_settings()
    assert sparse["epoch_kernel_m"] > 3.0 * chosen["epoch_kernel_m"]
    by_hand = LWPRSurface(AdaptiveConfig(kernel_min_m=2.0, kernel_max_m=30.0)).fit(coordinates, elevation)
    assert by_hand.chosen_settings()["epoch_kernel_m"] == 2.0
    assert by_hand.chosen_settings()["kernel_max_m"] >= 30.0
