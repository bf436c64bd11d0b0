"""Reference mode as a surface model: accuracy, honesty, epochs, persistence."""

from dataclasses import asdict

import numpy as np
import pytest
import xarray as xr

from changedetect.config import LWPRConfig
from changedetect.errors import MissingInputError, ModelStateError
from changedetect.models.base import SurfaceModel
from changedetect.models.reference import ReferenceLWPR, ReferenceSettings

EAST, NORTH = 432_000.0, 5_331_000.0
NOISE = 0.05


def ground(easting, northing):
    x, y = easting - EAST, northing - NORTH
    return 300.0 + 0.05 * x + 0.5 * np.sin(x / 6.0) * np.cos(y / 7.0)


def survey(n=2500, seed=0, noise=NOISE, side=20.0, lift=0.0):
    rng = np.random.default_rng(seed)
    easting, northing = EAST + rng.uniform(0.0, side, n), NORTH + rng.uniform(0.0, side, n)
    return (easting, northing), ground(easting, northing) + lift + rng.normal(0.0, noise, n)


def queries(low=2.0, high=18.0, n=15):
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(low, high, n), np.linspace(low, high, n)))
    return EAST + x, NORTH + y


def assert_same_answers(one, other, at=None):
    at = queries() if at is None else at
    a, b = one.predict(at), other.predict(at)
    for name in ("elevation", "elevation_std", "noise_std", "n_effective", "age_days"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.fixture(scope="module")
def model():
    return ReferenceLWPR().fit(*survey(), survey_time=1000.0)


def test_it_follows_the_protocol(model):
    assert isinstance(model, SurfaceModel)


def test_surface_is_more_accurate_than_one_observation_and_says_so(model):
    at = queries()
    answer = model.predict(at)
    error = answer.elevation - ground(*at)
    assert np.sqrt(np.mean(error**2)) < 0.6 * NOISE
    assert 0.93 < np.mean(np.abs(error) < 1.96 * answer.elevation_std) <= 1.0
    assert np.median(answer.elevation_std) < NOISE
    np.testing.assert_allclose(np.median(answer.noise_std), NOISE, rtol=0.3, atol=0.0)
    # the kernel was chosen for twenty, of which forgetting leaves some
    assert 10.0 < np.median(answer.n_effective) < 22.0
    np.testing.assert_allclose(np.median(model.observed(at)), 20.0, rtol=0.3, atol=0.0)
    assert (answer.age_days == 0.0).all()


def test_new_observations_fall_into_the_stated_interval():
    fitted = ReferenceLWPR(ReferenceSettings(initial_kernel_m=1.0)).fit(*survey(n=9000, seed=1))
    other, observed = survey(n=800, seed=2)
    answer = fitted.predict(other)
    known = np.isfinite(answer.elevation)
    spread = np.hypot(answer.elevation_std, answer.noise_std)[known]
    assert known.mean() > 0.99
    assert 0.93 < np.mean(np.abs(observed[known] - answer.elevation[known]) < 1.96 * spread) < 0.985


def test_noise_is_local():
    coordinates, elevation = survey(n=6000, noise=0.0)
    is_quiet = coordinates[0] < EAST + 10.0
    elevation = elevation + np.random.default_rng(3).standard_normal(6000) * np.where(is_quiet, 0.03, 0.3)
    fitted = ReferenceLWPR(ReferenceSettings(initial_kernel_m=0.8)).fit(coordinates, elevation)
    at = queries()
    noise = fitted.predict(at).noise_std
    np.testing.assert_allclose(np.median(noise[at[0] < EAST + 7.0]), 0.03, rtol=0.5, atol=0.0)
    np.testing.assert_allclose(np.median(noise[at[0] > EAST + 13.0]), 0.3, rtol=0.2, atol=0.0)


def test_where_nothing_was_observed_there_is_no_answer(model):
    answer = model.predict((np.array([EAST + 200.0]), np.array([NORTH])))
    for name in ("elevation", "elevation_std", "noise_std", "age_days"):
        assert np.isnan(getattr(answer, name)[0])
    assert answer.n_effective[0] == 0.0
    assert model.observed((np.array([EAST + 200.0]), np.array([NORTH])))[0] == 0.0


def test_an_empty_model_answers_nothing():
    answer = ReferenceLWPR().predict(queries())
    assert np.isnan(answer.elevation).all()
    assert (answer.n_effective == 0.0).all()
    assert (ReferenceLWPR().observed(queries()) == 0.0).all()


def test_a_handful_of_points_has_finite_uncertainty():
    # residuals count only from the eleventh update on; before, the spread of the elevations bounds the noise
    coordinates, elevation = survey(n=12, side=1.0)
    answer = ReferenceLWPR(ReferenceSettings(initial_kernel_m=2.0)).fit(coordinates, elevation).predict(coordinates)
    assert np.isfinite(answer.elevation).all()
    assert (answer.noise_std > 0.0).all()
    assert (answer.elevation_std > 0.0).all()


def test_the_order_of_points_does_not_matter_unless_it_is_given():
    coordinates, elevation = survey(n=800)
    elevation[:5] += 0.3
    coordinates = tuple(np.r_[axis, axis[:5]] for axis in coordinates)  # five places twice, at other elevations
    elevation = np.r_[elevation, elevation[:5] - 0.6]
    shuffled = np.random.default_rng(1).permutation(805)
    moved = tuple(axis[shuffled] for axis in coordinates), elevation[shuffled]
    assert_same_answers(ReferenceLWPR().fit(coordinates, elevation), ReferenceLWPR().fit(*moved))
    given, other = (ReferenceLWPR().fit(*data, order="given") for data in ((coordinates, elevation), moved))
    assert (given.predict(queries()).elevation != other.predict(queries()).elevation).any()


def test_inputs_are_left_as_they_are():
    coordinates, elevation = survey(n=300)
    kept = coordinates[0].copy(), coordinates[1].copy(), elevation.copy()
    fitted = ReferenceLWPR().fit(coordinates, elevation)
    fitted.predict(coordinates)
    for a, b in zip(kept, (*coordinates, elevation), strict=True):
        np.testing.assert_array_equal(a, b)


def test_fit_forgets_everything():
    fitted = (
        ReferenceLWPR().fit(*survey(n=500, seed=8, lift=5.0), survey_time=10.0).fit(*survey(n=500), survey_time=3.0)
    )
    assert_same_answers(fitted, ReferenceLWPR().fit(*survey(n=500), survey_time=3.0))


def test_a_step_over_observed_ground_is_not_attenuated(model):
    at = queries(6.0, 14.0)
    before = model.predict(at)
    for n, tolerance in ((2500, 0.005), (20_000, 0.005)):
        # little noise: the question is what the memory keeps back
        coordinates, elevation = survey(n=n, seed=4, noise=0.002, lift=0.5)
        after = model.copy().partial_fit(coordinates, elevation, survey_time=1100.0).predict(at)
        exact = ReferenceLWPR(ReferenceSettings(initial_kernel_m=0.5)).fit(coordinates, elevation - 0.5).predict(at)
        np.testing.assert_allclose(np.mean(after.elevation - exact.elevation), 0.5, rtol=0.0, atol=tolerance)
        assert np.median(after.noise_std) < 1.5 * np.median(before.noise_std)  # the way up is not noise


def test_in_one_epoch_after_another_the_memory_stays_bounded(model):
    updated = model
    for epoch in range(1, 6):
        updated = updated.copy().partial_fit(*survey(n=2500, seed=epoch, lift=0.2 * epoch), survey_time=1000.0 + epoch)
    at = queries()
    error = updated.predict(at).elevation - ground(*at) - 1.0
    assert np.sqrt(np.mean(error**2)) < NOISE
    assert abs(error.mean()) < 0.01


def test_ground_that_is_not_seen_again_stays_and_ages(model):
    (easting, northing), elevation = survey(n=2500, seed=5, lift=-1.0)
    west = easting < EAST + 8.0
    later = model.copy().partial_fit((easting[west], northing[west]), elevation[west], survey_time=1365.0)
    at = queries()
    before, after = model.predict(at), later.predict(at)
    unseen, seen = at[0] > EAST + 12.0, at[0] < EAST + 5.0
    np.testing.assert_allclose(after.elevation[unseen], before.elevation[unseen], rtol=0.0, atol=1e-9)
    assert (after.age_days[unseen] == 365.0).all()
    assert (after.elevation_std[unseen] > before.elevation_std[unseen]).all()
    assert (after.n_effective[unseen] < 1.0 + 1e-9).all()
    assert (later.observed(at)[unseen] == 0.0).all()
    np.testing.assert_allclose(after.elevation[seen] - before.elevation[seen], -1.0, rtol=0.0, atol=0.25)
    assert (after.age_days[seen] == 0.0).all()
    assert (later.observed(at)[seen] > 2.0).all()
    # a third epoch remembers when each place was seen last
    third = later.copy().partial_fit((easting[west], northing[west]), elevation[west], survey_time=1400.0)
    assert (third.predict(at).age_days[unseen] == 400.0).all()
    assert (third.predict(at).age_days[seen] == 0.0).all()


def test_memory_fades_with_time(model):
    (easting, northing), elevation = survey(n=400, seed=6)
    west = easting < EAST + 4.0
    at = queries(13.0, 18.0)
    counts = []
    for days in (1.0, 2000.0, 2e6):
        later = model.copy().partial_fit((easting[west], northing[west]), elevation[west], survey_time=1000.0 + days)
        answer = later.predict(at)
        assert np.isfinite(answer.elevation_std).all()
        counts.append(np.median(answer.n_effective))
    # one observation at most; one after e-foldings; never nothing
    before = np.median(model.predict(at).n_effective)
    np.testing.assert_allclose(counts[:2], [1.0, before * np.exp(-2000.0 / 730.0)], rtol=0.1, atol=0.0)
    np.testing.assert_allclose(counts[2], 1e-3, rtol=1e-6, atol=0.0)


def test_the_present_epoch_goes_on_without_a_time(model):
    continued = model.copy().partial_fit(*survey(seed=7))
    assert continued.survey_time_ == 1000.0
    at = queries()
    assert np.median(continued.observed(at)) > 1.5 * np.median(model.observed(at))


def test_a_copy_shares_nothing(model):
    before = model.predict(queries()).elevation
    model.copy().partial_fit(*survey(seed=9, lift=3.0), survey_time=1001.0)
    np.testing.assert_array_equal(model.predict(queries()).elevation, before)


def test_a_reloaded_model_answers_and_learns_bit_for_bit_alike(model, tmp_path):
    model.save(tmp_path / "new" / "folder")
    assert [path.name for path in (tmp_path / "new" / "folder").iterdir()] == ["reference_lwpr.nc"]
    loaded = ReferenceLWPR.load(tmp_path / "new" / "folder")
    assert_same_answers(model, loaded)
    np.testing.assert_array_equal(model.observed(queries()), loaded.observed(queries()))
    assert (loaded.settings, loaded.region, loaded.memory_days) == (model.settings, model.region, model.memory_days)
    more = survey(seed=10, lift=0.1)
    assert_same_answers(
        model.copy().partial_fit(*more, survey_time=1200.0), loaded.partial_fit(*more, survey_time=1200.0)
    )


def test_all_settings_survive_storage(tmp_path):
    settings = ReferenceSettings(
        kernel="bisquare", initial_distance_metric=((4.0, 1.0), (1.0, 2.0)), learn_metric=True, penalty=1e-7, cutoff=0.0
    )
    fitted = ReferenceLWPR(settings, memory_days=100.0, prior_observations=2.0).fit(*survey(n=400))
    fitted.save(tmp_path)
    loaded = ReferenceLWPR.load(tmp_path)
    assert (loaded.settings, loaded.memory_days, loaded.prior_observations) == (settings, 100.0, 2.0)
    assert loaded.parameters_ == fitted.parameters_
    assert_same_answers(fitted, loaded)


def test_state_is_readable_without_this_software(model, tmp_path):
    model.save(tmp_path)
    with xr.open_dataset(tmp_path / "reference_lwpr.nc") as dataset:
        assert dataset.sizes["receptive_field"] == model.state_.n_fields
        origin, scale = dataset.attrs["origin"], 1.0
        easting = origin[0] + scale * dataset["centre_x"].values
        assert (easting.min() >= EAST) & (easting.max() <= EAST + 20.0)


def test_a_model_that_learned_nothing_is_not_stored(tmp_path):
    with pytest.raises(ModelStateError, match="learned nothing"):
        ReferenceLWPR().save(tmp_path)


def test_a_state_that_cannot_be_used_is_refused(model, tmp_path):
    with pytest.raises(MissingInputError):
        ReferenceLWPR.load(tmp_path)
    path = tmp_path / "reference_lwpr.nc"
    model.save(tmp_path)
    whole = xr.load_dataset(path, decode_times=False)
    whole.drop_vars("beta0").to_netcdf(path)
    with pytest.raises(ModelStateError, match="beta0"):
        ReferenceLWPR.load(tmp_path)
    whole.assign_attrs(state_version=99).to_netcdf(path)
    with pytest.raises(ModelStateError, match="version 99"):
        ReferenceLWPR.load(tmp_path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ModelStateError):
        ReferenceLWPR.load(tmp_path)


@pytest.mark.parametrize("kernel", ["gaussian", "bisquare"])
@pytest.mark.parametrize("is_meta", [True, False])
def test_learned_metrics_adapt_and_answer(kernel, is_meta):
    settings = ReferenceSettings(
        kernel=kernel,
        learn_metric=True,
        meta_learning=is_meta,
        diagonal_metric=False,
        prune_threshold=0.9,
        activation_threshold=0.2,
        initial_kernel_m=1.5,
    )
    fitted = ReferenceLWPR(settings).fit(*survey(n=4000))
    fields = fitted.state_.fields[: fitted.state_.n_fields]
    assert np.ptp(fields["D_xx"]) > 1e-3 * np.median(fields["D_xx"])
    at = queries()
    answer = fitted.predict(at)
    assert np.isfinite(answer.elevation).mean() > 0.98
    error = (answer.elevation - ground(*at))[np.isfinite(answer.elevation)]
    assert np.sqrt(np.mean(error**2)) < 0.08


def test_scales_of_inputs_and_outputs_do_not_matter_to_a_fixed_metric():
    data = survey(n=600)
    plain = ReferenceLWPR(ReferenceSettings(initial_kernel_m=1.0)).fit(*data)
    scaled = ReferenceLWPR(
        ReferenceSettings(initial_kernel_m=1.0, input_scale=50.0, output_scale=10.0, initial_s2=1e-14)
    ).fit(*data)
    a, b = plain.predict(queries()), scaled.predict(queries())
    for name in ("elevation", "elevation_std", "noise_std", "n_effective"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-5, atol=1e-6)


def test_an_initial_metric_can_be_given():
    metric = ((4.0, 1.0), (1.0, 2.0))
    fitted = ReferenceLWPR(ReferenceSettings(initial_distance_metric=metric)).fit(*survey(n=300))
    fields = fitted.state_.fields[: fitted.state_.n_fields]
    np.testing.assert_allclose(fields["D_xx"], 4.0, rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(fields["D_xy"], 1.0, rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(fields["D_yy"], 2.0, rtol=1e-12, atol=0.0)


def test_the_section_of_a_programme_gives_the_settings():
    section = LWPRConfig(activation_threshold=0.3, initial_kernel_m=2.0)
    assert ReferenceLWPR(section).settings == ReferenceSettings(**asdict(section))
    assert ReferenceLWPR(section).settings.activation_threshold == 0.3


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"activation_threshold": 0.0}, "activation_threshold"),
        ({"no_such_key": 1}, "no_such_key"),
        ({"kernel": "cosine"}, "kernel"),
        ({"initial_kernel_m": 1.0, "initial_distance_metric": ((1.0, 0.0), (0.0, 1.0))}, "give one of them"),
        ({"initial_distance_metric": ((1.0, 2.0), (2.0, 1.0))}, "positive definite"),
        ({"initial_distance_metric": ((1.0, 0.5), (0.4, 1.0))}, "symmetric"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(keys, message):
    with pytest.raises(ValueError, match=message):
        ReferenceSettings(**keys)


def test_a_memory_that_is_none_is_refused():
    with pytest.raises(ValueError, match="memory_days must be positive"):
        ReferenceLWPR(memory_days=0.0)
    with pytest.raises(ValueError, match="prior_observations must be positive"):
        ReferenceLWPR(prior_observations=-1.0)


def test_observations_that_cannot_be_learned_are_refused(model):
    coordinates, elevation = survey(n=20)
    with pytest.raises(ValueError, match="finite"):
        model.copy().partial_fit(coordinates, np.where(np.arange(20) == 3, np.nan, elevation))
    with pytest.raises(ValueError, match="shape"):
        model.copy().partial_fit(coordinates, elevation[:5])
    with pytest.raises(ValueError, match="no observations"):
        model.copy().partial_fit((elevation[:0], elevation[:0]), elevation[:0])
    with pytest.raises(ValueError, match="before the present epoch"):
        model.copy().partial_fit(coordinates, elevation, survey_time=999.0)
    with pytest.raises(ValueError, match="survey_time must be finite"):
        model.copy().partial_fit(coordinates, elevation, survey_time=np.inf)
    with pytest.raises(ValueError, match="order must be"):
        model.copy().partial_fit(coordinates, elevation, order="random")
    with pytest.raises(ValueError, match="sigma must be positive"):
        model.copy().partial_fit(coordinates, elevation, np.zeros(20))
