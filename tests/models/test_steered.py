"""Fields along edges: they win at edges, keep still elsewhere."""

import numpy as np
import pytest

from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice, Level
from changedetect.models.rough_ground import refine_by_processes
from changedetect.models.steered import level_lines, steer

SIDE = 40.0


def crown(x, y):
    r = np.hypot(x - 20.0, y - 20.0)
    return np.where(r < 8.0, 5.0, 0.0)


def observations(ground, n, noise, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, SIDE, (2, n))
    return x, y, ground(x, y) + rng.normal(0.0, noise, n)


def unsteered(model):
    settings = model.settings
    return refine_by_processes(model.own_cells(), model.kernels_, settings.lattice_spacing, settings.shrinkage)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_rim_of_a_crown_comes_out_sharper(seed):
    x, y, z = observations(crown, 16_000, 0.3, seed)
    model = LWPRSurface().fit((x, y), z)
    u = np.linspace(2.0, SIDE - 2.0, 200)
    at = tuple(a.ravel() for a in np.meshgrid(u, u))
    rim = np.abs(np.hypot(at[0] - 20.0, at[1] - 20.0) - 8.0) < 0.5
    plain = unsteered(model)[0].blend(*at)[:, 0] - crown(*at)
    steered = model.predict(at).elevation - crown(*at)
    assert np.sqrt(np.mean(steered[rim] ** 2)) < 0.85 * np.sqrt(np.mean(plain[rim] ** 2))
    assert np.sqrt(np.mean(steered[~rim] ** 2)) < np.sqrt(np.mean(plain[~rim] ** 2))


def test_flat_ground_is_left_as_it_was():
    x, y, z = observations(lambda x, _: 0.2 * x, 6_000, 0.1, 3)
    model = LWPRSurface().fit((x, y), z)
    before, left_out = unsteered(model)
    after = steer(model.own_cells(), before, model.own_kernel_, left_out)
    moved = np.abs(after.planes[0] - before.planes[0])[before.planes[4] > 0.0]
    assert np.sqrt(np.mean(moved**2)) < 0.2 * np.sqrt(np.median(before.planes[3]))


def test_direction_and_curvature_of_level_lines_are_those_of_a_cone():
    kernel, spacing = 1.0, 0.4
    lattice = Lattice(kernel, spacing, -80, -80, 160, 160)
    x, y = lattice.centres()
    r = np.hypot(x, y)
    planes = np.zeros((9, *lattice.shape))
    planes[0] = np.tanh(8.0 - r).reshape(lattice.shape)
    planes[3], planes[4] = 1e-4, 1.0
    geometry = level_lines(Level(lattice, planes), kernel)
    on_ring = (np.abs(r - 8.0) < 0.4).reshape(lattice.shape)
    ex, ey = geometry[on_ring, 0], geometry[on_ring, 1]
    radial = np.abs(ex * (x / r).reshape(lattice.shape)[on_ring] + ey * (y / r).reshape(lattice.shape)[on_ring])
    assert radial.min() > 0.99
    # u = e'x + k v^2 / 2 is constant on the circle: with e outwards the centre lies at u = -8, so k = 1 / 8
    outwards = np.sign(ex * (x / r).reshape(lattice.shape)[on_ring] + ey * (y / r).reshape(lattice.shape)[on_ring])
    np.testing.assert_allclose(np.median(geometry[on_ring, 2] * outwards), 1.0 / 8.0, rtol=0.2, atol=0.0)
    assert geometry[on_ring, 3].all()
