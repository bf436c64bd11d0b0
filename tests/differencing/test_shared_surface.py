"""The difference estimator: calibrated on unchanged ground, unbiased on change, silent where nothing was seen."""

import numpy as np
import pytest
from scipy import stats

from changedetect.differencing.shared_surface import estimate_difference
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice

SIDE, RESOLUTION = 50.0, 0.5


def ground(x, y):
    return 6.0 * np.sin(x / 14.0) * np.cos(y / 11.0) + 0.8 * np.sin((x + 0.6 * y) / 3.5) + 0.2 * np.sin(x) * np.sin(y)


def epoch(density, seed, change=None, noise=0.05, keep=None):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, SIDE, (2, int(density * SIDE**2)))
    z = ground(x, y) + rng.normal(0.0, noise, x.size)
    if change is not None:
        z = z + change(x, y)
    if keep is not None:
        inside = keep(x, y)
        x, y, z = x[inside], y[inside], z[inside]
    return LWPRSurface().fit((x, y), z)


def difference(earlier, later):
    n = int(SIDE / RESOLUTION)
    kernels = (earlier.own_kernel_, later.own_kernel_)
    return estimate_difference(earlier.own_cells(), later.own_cells(), kernels, Lattice(0.0, RESOLUTION, 0, 0, n, n))


def centres():
    u = (np.arange(int(SIDE / RESOLUTION)) + 0.5) * RESOLUTION
    return np.meshgrid(u, u)


def significant(result):
    z = result.difference / np.sqrt(result.variance)
    return np.abs(z) > stats.t.ppf(0.975, np.maximum(result.freedom, 1.0)), z


@pytest.mark.parametrize("density", [2.5, 9.0, 60.0])
def test_unchanged_ground_is_flagged_at_the_nominal_rate(density):
    flagged, z = [], []
    for seed in range(2):
        result = difference(epoch(density, 10 + seed), epoch(density, 20 + seed))
        both = result.observed[0] & result.observed[1]
        both[:4], both[-4:], both[:, :4], both[:, -4:] = False, False, False, False
        hits, score = significant(result)
        flagged.append(hits[both])
        z.append(score[both])
    assert 0.03 < np.concatenate(flagged).mean() < 0.07
    assert 0.90 < np.concatenate(z).std() < 1.12


def test_epochs_of_very_different_density_are_still_calibrated():
    flagged = []
    for seed in range(4):
        result = difference(epoch(1.5, 31 + seed), epoch(60.0, 41 + seed))
        both = result.observed[0] & result.observed[1]
        both[:6], both[-6:], both[:, :6], both[:, -6:] = False, False, False, False
        flagged.append(significant(result)[0][both])
    # a kernel of the thin epoch is 3 m wide: the four maps hold some 150 independent places
    assert 0.02 < np.concatenate(flagged).mean() < 0.08


@pytest.mark.parametrize("lift", [0.5, 0.1, -0.3])
def test_a_lifted_patch_comes_out_unbiased_and_found(lift):
    def patch(x, y):
        return np.where((np.abs(x - 25.0) < 10.0) & (np.abs(y - 25.0) < 10.0), lift, 0.0)

    result = difference(epoch(9.0, 41), epoch(9.0, 42, patch))
    x, y = centres()
    inside = (np.abs(x - 25.0) < 7.0) & (np.abs(y - 25.0) < 7.0)
    np.testing.assert_allclose(result.difference[inside].mean(), lift, rtol=0.0, atol=max(0.005, 0.01 * abs(lift)))
    assert significant(result)[0][inside].mean() > 0.99


def test_exchanging_the_epochs_changes_the_sign():
    a, b = epoch(5.0, 51), epoch(5.0, 52, lambda x, y: 0.2 * np.exp(-((x - 25.0) ** 2 + (y - 25.0) ** 2) / 20.0))
    forth, back = difference(a, b), difference(b, a)
    both = forth.observed[0] & forth.observed[1]
    # which epoch carries the change while the shared surface is learned makes a small difference, no more
    gap = (forth.difference + back.difference)[both] / np.sqrt(forth.variance[both])
    assert np.percentile(np.abs(gap), 95) < 0.5


def test_identical_epochs_differ_nowhere():
    a = epoch(5.0, 61)
    result = difference(a, a.copy())
    both = result.observed[0] & result.observed[1]
    np.testing.assert_allclose(result.difference[both], 0.0, rtol=0.0, atol=1e-9)


def test_ground_only_one_epoch_saw_is_not_observed():
    a, b = epoch(9.0, 71), epoch(9.0, 72, keep=lambda x, _: x < 25.0)
    result = difference(a, b)
    x, _ = centres()
    assert result.observed[0][:, 2:-2].mean() > 0.99
    assert not result.observed[1][x > 27.0].any()
    assert result.observed[1][(x > 1.0) & (x < 23.5)].mean() > 0.99


def test_an_edge_of_change_stays_sharp_and_unbiased_close_by():
    def block(x, y):
        return np.where((np.abs(x - 25.0) < 4.0) & (np.abs(y - 25.0) < 4.0), 0.5, 0.0)

    result = difference(epoch(9.0, 81), epoch(9.0, 82, block))
    x, y = centres()
    inside = (np.abs(x - 25.0) < 2.5) & (np.abs(y - 25.0) < 2.5)
    np.testing.assert_allclose(result.difference[inside].mean(), 0.5, rtol=0.02, atol=0.0)
    row = result.difference[np.abs(y[:, 0] - 25.0) < 2.0].mean(axis=0)
    west = x[0] < 25.0
    rise = np.interp([0.05, 0.45], row[west], x[0][west])
    assert rise[1] - rise[0] < 2.0
