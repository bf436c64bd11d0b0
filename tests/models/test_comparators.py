from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal
from threadpoolctl import threadpool_limits

from changedetect.errors import MissingInputError, ModelStateError
from changedetect.models.comparators import (
    BlockMean,
    DelaunayLinear,
    ExactGPR,
    LocalGPR,
    NeighbourKriging,
    SparseGPR,
    comparators,
)
from changedetect.models.comparators.covariance import Covariance, estimate_covariance, negative_log_likelihood
from changedetect.models.comparators.observations import observations_from, stack_observations
from changedetect.models.comparators.sparse_gpr import inducing_points
from changedetect.storage import read_dataset, write_dataset
from changedetect.synthetic import SurveyDesign, survey_points, trees_scene

#: Small subsamples for the covariance, for tests of anything but its accuracy.
QUICK = {
    "gpr_rbf": {"n_subsample": 150},
    "gpr_matern32": {"n_subsample": 150},
    "kriging": {"n_blocks": 6, "block_size": 40},
    "local_gpr": {"n_blocks": 6, "block_size": 40},
    "sparse_gpr": {"n_blocks": 6, "block_size": 40},
}

CORNER = np.array([500_000.0, 5_300_000.0])
SCATTER = 0.05


@pytest.fixture(autouse=True)
def one_blas_thread():
    """Threads that wait for each other slow small matrices down."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


def quick(name):
    """The comparator of that name, with less time spent on its covariance."""
    method = comparators()[name]
    return method.model(**{**method.settings, **QUICK.get(name, {})})


def correlation(distance, length, kernel):
    """Textbook forms, written apart from the package."""
    if kernel == "rbf":
        return np.exp(-(distance**2) / (2.0 * length**2))
    return (1.0 + np.sqrt(3.0) * distance / length) * np.exp(-np.sqrt(3.0) * distance / length)


def distances(first, second):
    return np.sqrt(((first[:, None, :] - second[None, :, :]) ** 2).sum(axis=-1))


def gaussian_field(n, seed, *, side=30.0, signal=1.0, length=4.0, noise=0.2, kernel="matern32"):
    """Draw a stationary field at n + 300 places; observe n of them with noise, keep the rest as truth."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, side, (n + 300, 2))
    covariance = signal * correlation(distances(places, places), length, kernel)
    field = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(places))) @ rng.normal(size=len(places))
    observed = field[:n] + rng.normal(0.0, np.sqrt(noise), n)
    return places[:n] + CORNER, 20.0 + observed, places[n:] + CORNER, 20.0 + field[n:]


def posterior(positions, elevation, places, parameters, kernel, mean):
    """Exact Gaussian process posterior by dense solves."""
    signal, length, nugget = (parameters[name] for name in ("signal_variance", "length_scale", "nugget"))
    system = signal * correlation(distances(positions, positions), length, kernel) + nugget * np.eye(len(positions))
    cross = signal * correlation(distances(places, positions), length, kernel)
    weight = np.linalg.solve(system, cross.T).T
    return mean + weight @ (elevation - mean), signal - np.sum(weight * cross, axis=1)


# ---------------------------------------------------------------------------------------------- covariance functions


@pytest.mark.parametrize("kernel", ["rbf", "matern32"])
def test_likelihood_is_that_of_the_normal_distribution(kernel):
    rng = np.random.default_rng(1)
    positions, elevation = rng.uniform(0.0, 10.0, (25, 2)), rng.normal(size=25)
    variance = rng.uniform(0.0, 0.1, 25)
    system = 0.8 * correlation(distances(positions, positions), 3.0, kernel) + np.diag(0.05 + variance)
    ones = np.ones(25)
    mean = ones @ np.linalg.solve(system, elevation) / (ones @ np.linalg.solve(system, ones))
    value, _ = negative_log_likelihood(
        np.log([0.8, 3.0, 0.05]), kernel, distances(positions, positions)[None], elevation[None], variance[None]
    )
    assert_allclose(value, -multivariate_normal(np.full(25, mean), system).logpdf(elevation), rtol=1e-6, atol=0)


@pytest.mark.parametrize("kernel", ["rbf", "matern32"])
def test_gradient_of_the_likelihood_is_its_slope(kernel):
    rng = np.random.default_rng(2)
    positions, elevation = rng.uniform(0.0, 10.0, (3, 20, 2)), rng.normal(size=(3, 20))
    distance = np.stack([distances(block, block) for block in positions])
    at = np.log([0.7, 2.5, 0.1])
    _, gradient = negative_log_likelihood(at, kernel, distance, elevation, np.zeros((3, 20)))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-5
        ends = [
            negative_log_likelihood(at + s, kernel, distance, elevation, np.zeros((3, 20)))[0] for s in (step, -step)
        ]
        assert_allclose(gradient[axis], (ends[0] - ends[1]) / 2e-5, rtol=1e-5, atol=1e-6)


# 500 points 2.7 m apart tell little about noise under a field of 4 m; neighbours tell more
@pytest.mark.parametrize(("n_blocks", "block_size", "tolerance"), [(1, 500, 0.6), (30, 64, 0.25)])
def test_maximum_likelihood_recovers_a_known_covariance(n_blocks, block_size, tolerance):
    positions, elevation, _, _ = gaussian_field(1500, 3, side=60.0, signal=1.0, length=4.0, noise=0.04)
    observations = observations_from(stack_observations(tuple(positions.T), elevation, None))
    found = estimate_covariance(observations, "matern32", random_seed=0, n_blocks=n_blocks, block_size=block_size)
    assert_allclose(found.nugget, 0.04, rtol=tolerance, atol=0)
    assert_allclose(found.length_scale, 4.0, rtol=0.3, atol=0)
    assert_allclose(found.signal_variance, 1.0, rtol=0.5, atol=0)


def test_known_sigmas_are_not_counted_again_as_nugget():
    positions, elevation, _, _ = gaussian_field(1200, 4, side=40.0, noise=0.04)
    sigma = np.full(elevation.size, 0.2)
    observations = observations_from(stack_observations(tuple(positions.T), elevation, sigma))
    found = estimate_covariance(observations, "matern32", random_seed=0, n_blocks=30, block_size=64)
    assert found.nugget < 0.015
    assert_allclose(found.noise_variance, 0.04, rtol=0.25, atol=0)


# ------------------------------------------------------------------------------------- against dense textbook solutions


@pytest.mark.parametrize("kernel", ["rbf", "matern32"])
def test_exact_gpr_is_the_textbook_posterior(kernel):
    positions, elevation, places, _ = gaussian_field(200, 5)
    model = ExactGPR(kernel=kernel).fit(tuple(positions.T), elevation)
    mean, variance = posterior(positions, elevation, places, model.parameters_, kernel, elevation.mean())
    answer = model.predict(tuple(places.T))
    assert_allclose(answer.elevation, mean, rtol=0, atol=1e-6)
    assert_allclose(answer.elevation_std, np.sqrt(variance), rtol=1e-5, atol=0)
    assert_allclose(answer.noise_std, np.sqrt(model.parameters_["nugget"]), rtol=1e-9, atol=0)


@pytest.mark.parametrize("approximation", ["fitc", "sgpr"])
def test_sparse_gpr_with_every_point_inducing_is_the_exact_posterior(approximation):
    positions, elevation, places, _ = gaussian_field(200, 6)
    model = SparseGPR(approximation=approximation, n_inducing=200).fit(tuple(positions.T), elevation)
    mean, variance = posterior(positions, elevation, places, model.parameters_, "matern32", elevation.mean())
    answer = model.predict(tuple(places.T))
    assert_allclose(answer.elevation, mean, rtol=0, atol=1e-4)
    assert_allclose(answer.elevation_std, np.sqrt(variance), rtol=1e-3, atol=0)


def test_one_local_model_is_the_exact_posterior():
    positions, elevation, places, _ = gaussian_field(200, 7)
    model = LocalGPR(points_per_model=10_000, n_blended=1).fit(tuple(positions.T), elevation)
    mean, variance = posterior(positions, elevation, places, model.parameters_, "matern32", elevation.mean())
    answer = model.predict(tuple(places.T))
    assert_allclose(answer.elevation, mean, rtol=0, atol=1e-8)
    assert_allclose(answer.elevation_std, np.sqrt(variance), rtol=1e-6, atol=0)


def test_kriging_solves_the_ordinary_kriging_system_of_the_nearest_points():
    # the system with a Lagrange multiplier, Cressie (1993), eqs 3.2.12-3.2.16, one place at a time
    positions, elevation, places, _ = gaussian_field(400, 8)
    model = NeighbourKriging(n_neighbours=12).fit(tuple(positions.T), elevation)
    signal, length, nugget = (model.parameters_[name] for name in ("signal_variance", "length_scale", "nugget"))
    answer = model.predict(tuple(places.T))
    for k, place in enumerate(places[:40]):
        near = np.argsort(np.linalg.norm(positions - place, axis=1))[:12]
        cross = signal * correlation(np.linalg.norm(positions[near] - place, axis=1), length, "matern32")
        system = np.ones((13, 13))
        system[:12, :12] = signal * correlation(distances(positions[near], positions[near]), length, "matern32")
        system[:12, :12] += nugget * np.eye(12)
        system[12, 12] = 0.0
        solution = np.linalg.solve(system, np.append(cross, 1.0))
        assert_allclose(answer.elevation[k], solution[:12] @ elevation[near], rtol=0, atol=1e-7)
        variance = signal - solution[:12] @ cross - solution[12]
        assert_allclose(answer.elevation_std[k], np.sqrt(variance), rtol=1e-6, atol=0)


def test_delaunay_follows_a_plane_and_weighs_corner_noise_by_barycentric_weights():
    rng = np.random.default_rng(9)
    positions = np.vstack([[[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]], rng.uniform(4.0, 9.0, (40, 2))])
    sigma = np.concatenate([[0.1, 0.2, 0.3], np.full(40, 0.05)])
    elevation = 10.0 + 0.3 * positions[:, 0] - 0.2 * positions[:, 1]
    model = DelaunayLinear().fit(tuple(positions.T), elevation, sigma)
    answer = model.predict((np.array([0.5, 2.0]), np.array([0.5, 0.2])))
    assert_allclose(answer.elevation, [10.05, 10.56], rtol=0, atol=1e-9)
    weight = np.array([1.0 - 0.5 / 3 - 0.5 / 3, 0.5 / 3, 0.5 / 3])
    assert_allclose(answer.elevation_std[0] ** 2, np.sum((weight * sigma[:3]) ** 2), rtol=1e-9, atol=0)


def test_delaunay_says_nothing_outside_the_convex_hull():
    easting, northing = np.random.default_rng(10).uniform(0.0, 10.0, (2, 200))
    model = DelaunayLinear().fit((easting, northing), np.ones(200))
    assert np.isnan(model.predict((np.array([10.1]), np.array([5.0]))).elevation).all()


def test_delaunay_averages_points_at_one_position():
    easting, northing = np.random.default_rng(11).uniform(0.0, 10.0, (2, 50))
    easting, northing = np.tile(easting, 2), np.tile(northing, 2)
    elevation = np.repeat([4.0, 6.0], 50)
    answer = DelaunayLinear().fit((easting, northing), elevation).predict((np.array([5.0]), np.array([5.0])))
    assert_allclose(answer.elevation, 5.0, rtol=0, atol=1e-9)


def test_delaunay_finds_the_noise_despite_edges_and_outliers():
    rng = np.random.default_rng(12)
    easting, northing = rng.uniform(0.0, 50.0, (2, 20_000))
    elevation = np.where(easting > 25.0, 8.0, 0.0) + rng.normal(0.0, SCATTER, easting.size)
    elevation[::100] += rng.normal(0.0, 5.0, elevation[::100].size)
    model = DelaunayLinear().fit((easting, northing), elevation)
    assert_allclose(model.parameters_["noise_std"], SCATTER, rtol=0.15, atol=0)


def test_block_mean_is_the_mean_of_its_block_and_nothing_beside():
    easting = np.array([0.2, 0.4, 0.6, 0.8, 5.2, 5.4, 5.6, 5.8, 5.5, 5.3])
    elevation = np.array([1.0, 2.0, 3.0, 4.0, 7.0, 7.0, 7.0, 7.0, 7.0, 7.0])
    model = BlockMean(side=1.0).fit((easting, np.full(10, 0.5)), elevation)
    answer = model.predict((np.array([0.9, 5.1, 3.0]), np.array([0.1, 0.9, 0.5])))
    assert_allclose(answer.elevation, [2.5, 7.0, np.nan], rtol=0, atol=1e-12)
    assert answer.n_effective.tolist() == [4.0, 6.0, 0.0]
    # pooled variance 5 / 8; (4 pooled + 5) / (4 + 3) in the first block
    expected = (4.0 * 5.0 / 8.0 + 5.0) / 7.0
    assert_allclose(answer.noise_std[0] ** 2, expected, rtol=1e-9, atol=0)
    assert_allclose(answer.elevation_std[0] ** 2, expected / 4.0, rtol=1e-9, atol=0)


def test_block_mean_weighs_observations_by_their_sigma():
    easting = np.linspace(0.1, 0.9, 10)
    elevation, sigma = np.repeat([0.0, 1.0], 5), np.repeat([0.1, 0.2], 5)
    answer = BlockMean(side=1.0).fit((easting, easting), elevation, sigma).predict((np.array([0.5]), np.array([0.5])))
    assert_allclose(answer.elevation, 0.2, rtol=0, atol=1e-12)


# ---------------------------------------------------------------------------------------------------- statistical laws

STATIONARY = {
    "gpr_matern32": partial(ExactGPR, n_subsample=250),
    "kriging": NeighbourKriging,
    "local_gpr": LocalGPR,
    "sparse_gpr": partial(SparseGPR, n_inducing=300, block_size=250),
}


@pytest.fixture(scope="module")
def stationary_fields():
    with threadpool_limits(limits=1, user_api="blas"):
        return [gaussian_field(700, 20 + seed, side=33.0, length=5.0, noise=0.04) for seed in range(4)]


@pytest.mark.parametrize("name", STATIONARY)
def test_intervals_cover_the_truth_and_observations_on_a_stationary_field(name, stationary_fields):
    inside_truth, inside_observation = [], []
    for seed, (positions, elevation, places, truth) in enumerate(stationary_fields):
        answer = STATIONARY[name]().fit(tuple(positions.T), elevation).predict(tuple(places.T))
        error = answer.elevation - truth
        observation = error + np.random.default_rng(seed).normal(0.0, 0.2, error.size)
        inside_truth.append(np.abs(error) < 1.96 * answer.elevation_std)
        inside_observation.append(np.abs(observation) < 1.96 * np.hypot(answer.elevation_std, answer.noise_std))
    assert 0.92 < np.mean(inside_truth) < 0.98
    assert 0.93 < np.mean(inside_observation) < 0.97


@pytest.mark.parametrize("name", STATIONARY)
def test_effective_number_counts_observations_that_stand_together(name):
    # 25 observations within millimetres of one place, far from the others
    rng = np.random.default_rng(30)
    crowd = rng.normal(70.0, 1e-3, (25, 2))
    positions, elevation, _, _ = gaussian_field(400, 31, noise=0.2)
    positions = np.vstack([positions - CORNER, crowd]) + CORNER
    elevation = np.append(elevation, 20.3 + rng.normal(0.0, np.sqrt(0.2), 25))
    model = quick(name).fit(tuple(positions.T), elevation)
    answer = model.predict(tuple((CORNER + 70.0)[:, None]))
    # ordinary kriging spends part of the 25 on the unknown mean
    assert 18.0 < answer.n_effective[0] < 26.0


@pytest.mark.parametrize("name", STATIONARY)
def test_precise_observations_count_more_than_vague_ones(name):
    rng = np.random.default_rng(32)
    easting, northing = rng.uniform(0.0, 20.0, (2, 600))
    is_vague = rng.uniform(size=600) < 0.5
    sigma = np.where(is_vague, 1.0, 0.02)
    elevation = 0.1 * easting + rng.normal(0.0, sigma)
    places = tuple(rng.uniform(3.0, 17.0, (2, 200)))
    rmse = []
    for given in (sigma, None):
        answer = quick(name).fit((easting, northing), elevation, given).predict(places)
        rmse.append(np.sqrt(np.mean((answer.elevation - 0.1 * places[0]) ** 2)))
    assert rmse[0] < 0.02
    assert rmse[0] < 0.25 * rmse[1]


@pytest.mark.parametrize("name", ["kriging", "local_gpr", "sparse_gpr", "delaunay", "block_mean"])
def test_error_on_terrain_with_trees_is_of_the_expected_size(name):
    # measured over three seeds at 40 000 points: .22-.25, .21-.25, .46-.56, .35-.37, .44-.53 m
    scene = trees_scene(3, side=30.0, n_trees=4)
    survey = survey_points(scene, SurveyDesign(density=11.1), 1)
    rng = np.random.default_rng(1)
    west, east, south, north = scene.region
    places = rng.uniform(west, east, 3000), rng.uniform(south, north, 3000)
    answer = comparators()[name]().fit(survey.cloud.coordinates, survey.cloud.elevation).predict(places)
    known = np.isfinite(answer.elevation)
    assert known.mean() > 0.98
    rmse = np.sqrt(np.mean((answer.elevation - survey.surface(*places))[known] ** 2))
    assert rmse < {"kriging": 0.3, "local_gpr": 0.3, "sparse_gpr": 0.6, "delaunay": 0.45, "block_mean": 0.7}[name]


# --------------------------------------------------------------------------------------------------- learning and state


def field_observations(seed=40, n=300):
    positions, elevation, places, _ = gaussian_field(n, seed)
    return tuple(positions.T), elevation, tuple(places.T)


@pytest.mark.parametrize("name", comparators())
def test_learning_in_pieces_is_learning_at_once(name):
    (easting, northing), elevation, places = field_observations()
    whole = quick(name).fit((easting, northing), elevation)
    pieces = quick(name)
    for part in (slice(200, 300), slice(0, 80), slice(80, 200)):
        pieces.partial_fit((easting[part], northing[part]), elevation[part])
    assert np.array_equal(whole.predict(places).elevation, pieces.predict(places).elevation, equal_nan=True)


def test_a_later_epoch_replaces_the_earlier_one():
    coordinates, elevation, places = field_observations()
    model = NeighbourKriging().fit(coordinates, elevation, survey_time=100.0)
    model.partial_fit(coordinates, elevation + 0.5, survey_time=200.0)
    only_later = NeighbourKriging().fit(coordinates, elevation + 0.5)
    assert np.array_equal(model.predict(places).elevation, only_later.predict(places).elevation)


def test_too_many_points_are_refused_and_the_model_stays():
    coordinates, elevation, places = field_observations()
    model = ExactGPR(max_points=400).fit(coordinates, elevation)
    before = model.predict(places).elevation
    with pytest.raises(ValueError, match=r"ExactGPR takes at most 400 points; got 600\. Thin the points"):
        model.partial_fit(coordinates, elevation)
    assert np.array_equal(model.predict(places).elevation, before)


def test_fewer_than_ten_points_are_refused():
    with pytest.raises(ValueError, match="at least 10 points; got 9"):
        BlockMean().fit((np.arange(9.0), np.arange(9.0)), np.zeros(9))


@pytest.mark.parametrize("name", ["gpr_rbf", "kriging", "local_gpr", "sparse_gpr", "delaunay"])
def test_points_at_one_place_are_refused(name):
    place = np.full(20, 5.0)
    with pytest.raises(ValueError, match="at one place"):
        comparators()[name]().fit((place, place), np.arange(20.0))


@pytest.mark.parametrize("name", sorted(set(comparators()) - {"delaunay"}))
def test_points_on_a_line_teach_the_line(name):
    along = np.linspace(0.0, 50.0, 400)
    elevation = 0.05 * along + np.random.default_rng(1).normal(0.0, 0.01, 400)
    answer = (
        comparators()[name]().fit((along, 2.0 * along), elevation).predict((along[50:350:7], 2.0 * along[50:350:7]))
    )
    assert_allclose(answer.elevation, 0.05 * along[50:350:7], rtol=0, atol=0.05)


def test_repeated_observations_do_not_break_the_factorisation():
    coordinates, elevation, places = field_observations()
    twice = tuple(np.tile(axis, 2) for axis in coordinates)
    both = np.append(elevation, elevation + np.random.default_rng(4).normal(0.0, 0.3, elevation.size))
    for name in ("gpr_rbf", "kriging", "local_gpr", "sparse_gpr"):
        answer = quick(name).fit(twice, both).predict(places)
        assert np.isfinite(answer.elevation).all()


def test_level_ground_without_noise_comes_out_level():
    rng = np.random.default_rng(2)
    easting, northing = rng.uniform(0.0, 20.0, (2, 300))
    for name in comparators():
        answer = quick(name).fit((easting, northing), np.full(300, 7.0)).predict((np.array([10.0]), np.array([10.0])))
        assert_allclose(answer.elevation, 7.0, rtol=0, atol=1e-6)
        assert answer.n_effective[0] > 0.0


def test_inducing_points_are_observed_places_spread_over_the_ground():
    rng = np.random.default_rng(3)
    positions = np.vstack([rng.uniform(0.0, 10.0, (20_000, 2)), rng.uniform(30.0, 40.0, (500, 2))])
    chosen = inducing_points(positions, 300)
    assert 280 <= len(chosen) <= 420
    assert all(np.any(np.all(positions == place, axis=1)) for place in chosen[:20])
    # both patches are 10 m squares: as many places in the sparse one
    assert_allclose(np.mean(chosen[:, 0] > 20.0), 0.5, rtol=0, atol=0.1)


# ------------------------------------------------------------------------------------------------------ state on disk


@pytest.fixture
def saved(tmp_path):
    coordinates, elevation, _ = field_observations()
    NeighbourKriging(n_neighbours=20).fit(coordinates, elevation, survey_time=12.5).save(tmp_path / "state")
    return tmp_path / "state"


def test_settings_come_back_with_the_state(saved):
    model = NeighbourKriging.load(saved)
    assert model.settings() == NeighbourKriging(n_neighbours=20).settings()
    with pytest.raises(ValueError, match=r"survey_time 12\.0 lies before the present epoch's 12\.5"):
        model.partial_fit((np.arange(20.0), np.arange(20.0)), np.arange(20.0), survey_time=12.0)


def test_a_state_of_another_model_is_refused(saved):
    with pytest.raises(ModelStateError, match="holds a 'NeighbourKriging', not a 'DelaunayLinear'"):
        DelaunayLinear.load(saved)


def test_a_missing_state_is_named(tmp_path):
    with pytest.raises(MissingInputError, match=r"comparator\.nc"):
        NeighbourKriging.load(tmp_path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d.assign_attrs(format_version=99), "format version 99"),
        (lambda d: d.drop_vars("variance"), "not a whole NeighbourKriging"),
        (lambda d: d.assign_attrs(settings='{"colour": 1}'), "not a whole NeighbourKriging"),
        (lambda d: d.assign_attrs(parameters="{"), "not a whole NeighbourKriging"),
        (lambda d: d.assign_attrs(parameters='{"nugget": "0x1p-3"}'), "not a whole NeighbourKriging"),
    ],
)
def test_a_damaged_state_is_refused(saved, damage, message):
    path = saved / "comparator.nc"
    write_dataset(path, damage(read_dataset(path)))
    with pytest.raises(ModelStateError, match=message):
        NeighbourKriging.load(saved)


def test_saving_before_learning_is_refused(tmp_path):
    with pytest.raises(ValueError, match="nothing to save"):
        BlockMean().save(tmp_path)


# ---------------------------------------------------------------------------------------------------------- registry


def test_every_comparator_states_what_it_takes_and_makes_fresh_models():
    methods = comparators()
    assert {name: method.max_points for name, method in methods.items()} == {
        "gpr_rbf": 5_000,
        "gpr_matern32": 5_000,
        "local_gpr": 500_000,
        "sparse_gpr": 1_000_000,
        "kriging": 5_000_000,
        "delaunay": 2_000_000,
        "block_mean": None,
    }
    for name, method in methods.items():
        assert method.name == name
        assert method() is not method()


def test_missing_scikit_learn_names_the_extra(monkeypatch):
    for module in ("sklearn", "sklearn.gaussian_process", "sklearn.gaussian_process.kernels"):
        monkeypatch.setitem(sys.modules, module, None)
    coordinates, elevation, _ = field_observations()
    with pytest.raises(ImportError, match=r"pip install 'changedetect\[compare\]'"):
        ExactGPR().fit(coordinates, elevation)


def test_listing_the_comparators_does_not_import_scikit_learn():
    code = (
        "import sys; from changedetect.models import comparators as c; c.comparators(); print('sklearn' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_covariance_parameters_make_the_round_trip():
    covariance = Covariance("rbf", 1.5, 2.5, 0.1, 0.01)
    assert Covariance.from_parameters("rbf", covariance.to_parameters()) == covariance
