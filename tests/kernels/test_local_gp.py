"""Local Gaussian processes: against the textbook formulas."""

import numpy as np
from numpy.testing import assert_allclose

from changedetect.kernels.local_gp import N_LOCAL, N_NEAREST, local_processes, neighbour_products
from changedetect.kernels.moments import N_MOMENTS

LENGTH, RADIUS, CELL = 1.5, 20.0, 1.0


def matern(d):
    return (1.0 + d / LENGTH) * np.exp(-d / LENGTH)


def scattered(n, seed=0, fade=1.0):
    """A window of 8 x 8 cells with n occupied ones, and their places, heights and noise variances."""
    rng = np.random.default_rng(seed)
    window = np.zeros((8, 8, N_MOMENTS))
    chosen = rng.choice(64, n, replace=False)
    row, column = chosen // 8, chosen % 8
    count = rng.integers(1, 4, n).astype(float)
    offset = rng.uniform(-0.5, 0.5, (2, n))
    height, noise = rng.normal(0.0, 1.0, n), rng.uniform(0.05, 0.2, n)
    weight = fade * count
    cells = np.zeros((n, N_MOMENTS))
    cells[:, 0], cells[:, 1] = count, weight
    cells[:, 2], cells[:, 3] = weight * offset[0], weight * offset[1]
    cells[:, 7], cells[:, 12] = weight * height, count * noise
    window[row, column] = cells
    # the window's first cell is number 100 northwards and 200 eastwards
    x, y = (200 + column + 0.5) * CELL + offset[0], (100 + row + 0.5) * CELL + offset[1]
    return window, x, y, height, noise / count


def evaluate(window, x, y, variance, *, without=False):
    fits = np.empty((len(x), N_LOCAL))
    at = np.full(len(x), variance)
    local_processes(
        window, CELL, 100, 200, LENGTH, RADIUS, np.asarray(x, float), np.asarray(y, float), without, at, fits
    )
    return fits


def textbook(x, y, height, noise, variance, at):
    d = np.hypot(x[:, None] - x, y[:, None] - y)
    k = variance * matern(np.hypot(x - at[0], y - at[1]))
    C = variance * matern(d) + np.diag(noise)
    weight = np.linalg.solve(C, k)
    return weight @ height, variance - weight @ k, weight.sum()


def test_value_variance_and_weights_are_those_of_a_gaussian_process():
    window, x, y, height, noise = scattered(12)
    at = np.array([[203.3, 104.2], [200.1, 107.9], [206.0, 101.5]])
    fits = evaluate(window, *at.T, 0.7)
    wanted = np.array([textbook(x, y, height, noise, 0.7, p) for p in at])
    assert_allclose(fits[:, (0, 3, 4)], wanted, rtol=1e-9, atol=1e-12)


def test_slopes_are_the_derivative_of_the_value():
    window, *_ = scattered(12)
    step = 1e-5
    at = np.array([203.3, 104.2])
    fits = evaluate(
        window, at[0] + np.array([0.0, step, -step, 0.0, 0.0]), at[1] + np.array([0, 0, 0, step, -step]), 0.7
    )
    assert_allclose(fits[0, 1], (fits[1, 0] - fits[2, 0]) / (2 * step), rtol=1e-6, atol=1e-9)
    assert_allclose(fits[0, 2], (fits[3, 0] - fits[4, 0]) / (2 * step), rtol=1e-6, atol=1e-9)


def test_without_leaves_out_the_cell_of_the_place_alone():
    window, x, y, height, noise = scattered(12)
    fits = evaluate(window, x, y, 0.7, without=True)
    for i in range(12):
        others = np.arange(12) != i
        wanted = textbook(x[others], y[others], height[others], noise[others], 0.7, (x[i], y[i]))
        assert_allclose(fits[i, (0, 3, 4)], wanted, rtol=1e-9, atol=1e-12)


def test_only_the_nearest_cells_take_part():
    window, x, y, height, noise = scattered(40)
    at = np.array([203.3, 104.2])
    nearest = np.argsort(np.hypot(x - at[0], y - at[1]))[:N_NEAREST]
    wanted = textbook(x[nearest], y[nearest], height[nearest], noise[nearest], 0.7, at)
    assert_allclose(evaluate(window, at[:1], at[1:], 0.7)[0, (0, 3, 4)], wanted, rtol=1e-9, atol=1e-12)


def test_without_observations_the_prior_is_the_answer():
    fits = evaluate(np.zeros((8, 8, N_MOMENTS)), [203.0], [104.0], 0.7)
    assert_allclose(fits[0], [0.0, 0.0, 0.0, 0.7, 0.0], rtol=0.0, atol=0.0)


def test_a_fade_shared_by_all_changes_nothing():
    plain, x, y, *_ = scattered(12)
    faded, *_ = scattered(12, fade=0.01)
    assert_allclose(evaluate(faded, x, y, 0.7), evaluate(plain, x, y, 0.7), rtol=1e-12, atol=1e-14)


def test_faded_cells_yield_to_fresh_ones():
    window, x, y, height, _ = scattered(12)
    old = window.copy()
    old[:4, :, 1:12] *= 1e-6
    at = np.array([x[y < 104.0][0]]), np.array([y[y < 104.0][0]])
    is_fresh = y >= 104.0
    fresh = window.copy()
    fresh[:4] = 0.0
    assert is_fresh.any()
    assert_allclose(evaluate(old, *at, 0.7)[0, 0], evaluate(fresh, *at, 0.7)[0, 0], rtol=0.0, atol=1e-3)
    assert abs(evaluate(window, *at, 0.7)[0, 0] - height[y < 104.0][0]) < 0.5


def test_products_of_neighbours_tell_the_variance_of_the_process_whatever_the_noise():
    rng = np.random.default_rng(5)
    n = 60
    row, column = np.divmod(np.arange(n * n), n)
    window = np.zeros((n, n, N_MOMENTS))
    x, y = (column + 0.5) * CELL, (row + 0.5) * CELL
    z = np.zeros(n * n)
    for _ in range(200):
        # a sum of random waves has the Matern spectrum (1 + (k l)**2)**(-5 / 2) in two dimensions
        wave = rng.standard_normal(2) / LENGTH * np.sqrt(3.0 / rng.chisquare(3.0))
        z += np.sqrt(2.0 / 200.0) * np.cos(wave[0] * x + wave[1] * y + rng.uniform(0.0, 2.0 * np.pi))
    z = z * 0.3 + rng.normal(0.0, 0.5, z.size)
    window[row, column, 0] = window[row, column, 1] = 1.0
    window[row, column, 7] = z
    products = np.empty((z.size, 2))
    neighbour_products(window, CELL, 0, 0, LENGTH, RADIUS, x, y, 4, products)
    assert_allclose((z * products[:, 0]).sum() / products[:, 1].sum(), 0.09, rtol=0.2, atol=0.0)
