"""Receptive fields from moments against weighted least squares through the points."""

import naive
import numpy as np
import pytest

from changedetect.kernels import receptive_fields as kernel
from changedetect.models.cells import Evidence
from changedetect.models.pyramid import Lattice, Level, fit_lattice, support

FINE = 2.0**-6  # cells so small that taking the activation at a cell's mean position is exact enough


def _cells(easting, northing, elevation, sigma=None, cell_size=FINE):
    evidence = Evidence(cell_size, is_weighted=sigma is not None)
    evidence.add((easting, northing), elevation, sigma)
    return evidence.cells(0.0)


def _scene(n=60, seed=0):
    rng = np.random.default_rng(seed)
    easting, northing = 1000.0 + rng.uniform(0.0, 1.5, (2, n))
    elevation = 50.0 + 0.3 * easting - 0.1 * northing + rng.normal(0.0, 0.2, n)
    return easting, northing, elevation


@pytest.mark.parametrize("weighted", [False, True])
def test_plane_covariance_and_residual_equal_the_oracle(weighted):
    easting, northing, elevation = _scene()
    rng = np.random.default_rng(1)
    sigma = rng.choice([0.25, 0.5, 1.0], easting.size) if weighted else None
    weight = np.ones_like(easting) if sigma is None else 1.0 / sigma**2
    lattice = Lattice(0.5, 0.4, 2501, 2501, 2, 2)
    fits = fit_lattice(_cells(easting, northing, elevation, sigma), lattice)
    for k, centre in enumerate(zip(*lattice.centres(), strict=True)):
        beta, covariance, n_effective, residual, freedom = naive.local_plane(
            easting, northing, elevation, weight, centre, 0.5
        )
        o = fits[k // 2, k % 2]
        # the ridge on the slopes is a thousandth of an observation
        np.testing.assert_allclose(o[:3], beta, rtol=0.0, atol=3e-3)
        np.testing.assert_allclose(o[3:9], covariance[np.triu_indices(3)], rtol=0.01, atol=1e-3 * covariance[0, 0])
        np.testing.assert_allclose(o[10], n_effective, rtol=1e-3, atol=0.0)
        np.testing.assert_allclose(o[11], residual, rtol=5e-3, atol=0.0)
        np.testing.assert_allclose(o[12], freedom, rtol=5e-3, atol=0.0)


def test_a_field_without_observations_is_marked_empty():
    easting, northing, elevation = _scene()
    fits = fit_lattice(_cells(easting, northing, elevation), Lattice(0.5, 0.4, 2600, 2600, 2, 2))
    assert (fits[..., 9] == 0.0).all()


def test_support_demands_observations_on_all_sides():
    easting, northing = (a.ravel() for a in np.meshgrid(np.arange(0.1, 10.0, 0.2), np.arange(0.1, 10.0, 0.2)))
    cells = _cells(easting, northing, np.zeros_like(easting), cell_size=0.25)
    lattice = Lattice(1.0, 0.5, 0, 0, 20, 40)
    judged = support(cells, lattice, 1.0)[0]
    x = (np.arange(40) + 0.5) * 0.5
    assert (judged[10, x < 9.5] == 1.0).all()
    assert (judged[10, x > 10.8] == 0.0).all()


def test_blended_planes_reproduce_a_plane_and_its_slope():
    lattice = Lattice(1.0, 0.8, 10, 20, 8, 8)
    x, y = lattice.centres()
    planes = np.zeros((kernel.N_PLANE, 8, 8))
    planes[0] = (2.0 + 0.5 * x - 0.25 * y).reshape(8, 8)
    planes[1], planes[2], planes[3] = 0.5, -0.25, 0.04
    planes[4] = np.random.default_rng(0).uniform(0.5, 2.0, (8, 8))
    easting, northing = np.random.default_rng(1).uniform((17.5, 9.5), (21.0, 13.0), (50, 2)).T
    blended = Level(lattice, planes).blend(easting, northing)
    np.testing.assert_allclose(blended[:, 0], 2.0 + 0.5 * easting - 0.25 * northing, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(blended[:, 1:3], np.tile([0.5, -0.25], (50, 1)), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(blended[:, 3], 0.04, rtol=0.0, atol=1e-12)


def test_blend_answers_only_within_reach_of_a_field():
    planes = np.zeros((kernel.N_PLANE, 4, 4))
    planes[0], planes[4] = 7.0, 1.0
    level = Level(Lattice(1.0, 0.8, 0, 0, 4, 4), planes)
    blended = level.blend(np.array([1.6, 4.9]), np.array([1.6, 1.6]))
    np.testing.assert_array_equal(blended[:, 7], [1.0, 0.0])
    np.testing.assert_allclose(blended[:, 0], [7.0, 0.0], rtol=1e-12, atol=0.0)


def test_better_fields_weigh_more_in_the_blend():
    planes = np.zeros((kernel.N_PLANE, 1, 2))
    planes[0] = [[0.0, 1.0]]
    planes[4] = [[1.0, 3.0]]
    middle = Level(Lattice(1.0, 1.0, 0, 0, 1, 2), planes).blend(np.array([1.0]), np.array([0.5]))
    np.testing.assert_allclose(middle[0, 0], 0.75, rtol=1e-12, atol=0.0)


def test_disagreement_of_neighbours_adds_to_the_variance():
    planes = np.zeros((kernel.N_PLANE, 1, 2))
    planes[0], planes[3], planes[4] = [[0.0, 1.0]], 0.04, 1.0
    lattice, middle = Lattice(1.0, 1.0, 0, 0, 1, 2), (np.array([1.0]), np.array([0.5]))
    np.testing.assert_allclose(Level(lattice, planes).blend(*middle)[0, 3], 0.04 + 0.25, rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(Level(lattice, planes, 1.5, 0.0).blend(*middle)[0, 3], 0.04, rtol=1e-12, atol=0.0)


def test_pooled_noise_ignores_a_minority_of_rough_fields():
    rng = np.random.default_rng(3)
    fits = np.zeros((9, 9, kernel.N_FIT))
    fits[..., 9] = fits[..., 10] = 20.0
    fits[..., 12] = 17.0
    fits[..., 15] = 1.0
    fits[..., 11] = 0.01 * rng.chisquare(17.0, (9, 9))
    fits[:, 6:, 11] = 50.0
    pooled = np.empty((5, 5))
    kernel.pool_noise(fits, 0, 0, 3, 5.0, 1.0, pooled)
    np.testing.assert_allclose(pooled[:, :3], 0.01, rtol=0.35, atol=0.0)


def _fits_of_one_plane(value, covariance):
    fits = np.zeros((1, 1, kernel.N_FIT))
    fits[0, 0, :3], fits[0, 0, 3:9] = value, covariance[np.triu_indices(3)]
    fits[..., 9] = fits[..., 10] = fits[..., 12] = 20.0
    fits[..., 11], fits[..., 15] = 20.0, 100.0
    return fits


def _shrunk(fits, prior, coarse_variance=0.001, detail=0.0):
    base = np.stack([np.full((1, 1), coarse_variance), np.ones((1, 1))])
    planes = np.zeros((kernel.N_PLANE, 1, 1))
    kernel.shrink_planes(fits, base, np.reshape(prior, (2, 1, 1)), np.full((1, 1), detail), 1.0, 4.0, planes)
    return planes[:, 0, 0]


def test_a_shrunk_plane_is_the_posterior_mean():
    covariance = np.array([[0.02, 0.003, -0.001], [0.003, 0.01, 0.002], [-0.001, 0.002, 0.05]])
    beta = np.array([0.4, -0.2, 0.3])
    prior = np.diag([0.05, 0.02, 0.02])
    planes = _shrunk(_fits_of_one_plane(beta, covariance), (0.05, 0.02))
    weight = prior @ np.linalg.inv(prior + covariance)
    np.testing.assert_allclose(planes[:3], weight @ beta, rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(planes[8], weight[0, 0], rtol=1e-12, atol=0.0)
    expected = (1.0 - weight[0, 0]) * 0.001 + weight[0, 0] * 0.02
    np.testing.assert_allclose(planes[3], expected, rtol=1e-12, atol=0.0)


def test_without_detail_around_nothing_is_added():
    planes = _shrunk(_fits_of_one_plane(np.array([0.4, 0.1, 0.1]), 0.01 * np.eye(3)), (0.0, 0.0))
    np.testing.assert_array_equal(planes[:3], 0.0)
    assert planes[3] == 0.001


def test_a_plane_is_taken_as_fitted_where_the_prior_is_infinite():
    planes = _shrunk(_fits_of_one_plane(np.array([0.4, 0.1, -0.1]), 0.01 * np.eye(3)), (np.inf, np.inf))
    np.testing.assert_allclose(planes[:3], [0.4, 0.1, -0.1], rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(planes[3], 0.01, rtol=1e-12, atol=0.0)


def test_unseen_detail_adds_to_the_variance():
    planes = _shrunk(np.zeros((1, 1, kernel.N_FIT)), (0.1, 0.1), detail=0.04)
    np.testing.assert_allclose(planes[3], 0.041, rtol=1e-12, atol=0.0)
    np.testing.assert_array_equal(planes[:3], 0.0)
