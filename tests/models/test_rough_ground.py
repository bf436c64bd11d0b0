"""Coarse fields and local processes: detail where the ground is rough, calm where it is not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice, refine
from changedetect.models.rough_ground import process_variance, refine_by_processes

SIDE = 60.0


def waves():
    rng = np.random.default_rng(0)
    number = rng.standard_normal((150, 2)) / 1.2 * np.sqrt(3.0 / rng.chisquare(3.0, (150, 1)))
    return number, rng.uniform(0.0, 2.0 * np.pi, 150)


NUMBER, PHASE = waves()


def rough(x, y):
    """Ground of 0.3 m with a Matern correlation of order 3/2 and length 1.2 m, as a sum of waves."""
    at = np.stack([x, y], axis=-1)
    return 0.3 * np.sqrt(2.0 / PHASE.size) * np.cos(at @ NUMBER.T + PHASE).sum(axis=-1)


def survey(ground, n, noise, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, SIDE, (2, n))
    return x, y, ground(x, y) + rng.normal(0.0, noise, n)


def inner(n=90):
    u = np.linspace(3.0, SIDE - 3.0, n)
    return tuple(a.ravel() for a in np.meshgrid(u, u))


def surfaces(model):
    how = model.kernels_, model.settings.lattice_spacing, model.settings.shrinkage
    cells = model.own_cells()
    return refine(cells, *how)[0], refine_by_processes(cells, *how)


@pytest.mark.parametrize("seed", [0, 1])
def test_rough_ground_measured_well_keeps_its_detail(seed):
    x, y, z = survey(rough, 6000, 0.02, seed)
    model = LWPRSurface().fit((x, y), z)
    fields, (processes, _) = surfaces(model)
    at = inner()
    error = [level.blend(*at)[:, 0] - rough(*at) for level in (fields, processes)]
    assert np.sqrt(np.mean(error[1] ** 2)) < 0.9 * np.sqrt(np.mean(error[0] ** 2))


def test_the_stated_variance_is_that_of_the_error_on_rough_ground():
    x, y, z = survey(rough, 6000, 0.02, 2)
    level = surfaces(LWPRSurface().fit((x, y), z))[1][0]
    blended = level.blend(*inner())
    score = (blended[:, 0] - rough(*inner())) / np.sqrt(blended[:, 3])
    assert 0.7 < np.sqrt(np.mean(score**2)) < 1.3


def test_the_error_left_out_is_that_of_points_never_seen():
    x, y, z = survey(rough, 6000, 0.05, 3)
    left_out = surfaces(LWPRSurface().fit((x, y), z))[1][1]
    held = np.random.default_rng(4).random(x.size) < 0.1
    level = surfaces(LWPRSurface().fit((x[~held], y[~held]), z[~held]))[1][0]
    error = z[held] - level.blend(x[held], y[held])[:, 0]
    assert_allclose(np.sqrt(left_out.mean()), np.sqrt(np.mean(error**2)), rtol=0.25, atol=0.0)


def test_where_there_is_noise_only_the_process_has_no_variance():
    x, y, z = survey(lambda x, _: 0.0 * x, 6000, 0.1, 5)
    cells = LWPRSurface().fit((x, y), z).own_cells()
    lattice = Lattice.covering(cells.region, 1.0, 0.8)
    variance, _ = process_variance(cells, lattice, 1.0, 4.0)
    assert np.median(variance) < 0.1 * 0.1**2


def test_the_variance_is_known_from_the_cells_around():
    x, y, z = survey(rough, 6000, 0.05, 7)
    cells = LWPRSurface().fit((x, y), z).own_cells()
    lattice = Lattice.covering(cells.region, 1.0, 0.8)
    _, freedom = process_variance(cells, lattice, 1.0, 4.0)
    extent = float(np.ptp(x) * np.ptp(y))
    expected = len(cells) / extent * 4.0 * np.pi * (2.6 * lattice.spacing) ** 2
    middle = freedom[lattice.n_rows // 2, lattice.n_columns // 2]
    assert_allclose(middle, expected, rtol=0.25, atol=0.0)
    assert freedom[0, 0] < 0.5 * middle


def test_a_gross_error_that_was_not_left_out_is_not_believed():
    x, y, z = survey(lambda x, _: 0.05 * x, 8000, 0.05, 6)
    spoiled = z.copy()
    spoiled[:3] += 4.0
    at = np.array([x[:3], y[:3]])
    model = LWPRSurface().fit((x, y), spoiled)
    assert_allclose(model.predict(tuple(at)).elevation, 0.05 * x[:3], rtol=0.0, atol=0.15)
