"""The filter and smoother against a batch least-squares solution that shares no code with them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.kernels.navigation import corrected_state, propagate, state_difference
from changedetect.kernels.navigation_filter import accumulate_cross_covariance, filter_forward, smooth_backward

NOISE = np.array([1e-6, 4e-5, 1e-9, 1e-6])
GRAVITY, EARTH = np.array([0.0, 9.8]), np.zeros(3)
LEVER = np.array([-0.4, 0.1, -0.25])
GATE = 1e9


@pytest.fixture(scope="module")
def problem():
    """Six nodes half a second apart, ten intervals each; fixes at all but the first and third."""
    rng = np.random.default_rng(6)
    n, m = 50, 6
    rate = rng.normal(0, 0.2, (n, 3))
    force = rng.normal(0, 1.0, (n, 3)) + np.array([0, 0, 9.8])
    start = np.arange(m) * 10
    state = np.concatenate([[0, 0, 100, 20, 0, 0], np.eye(3).ravel(), np.zeros(6)]).astype(float)
    P = np.diag(np.repeat([1.0, 0.25, 1e-4, 1e-5, 1e-2], 3))
    fix = np.array([-1, 0, -1, 1, 2, 3])
    states = [state]
    for k in range(1, m):
        rows = slice(start[k - 1], start[k])
        moved, _, _ = propagate(
            states[-1], np.full(10, 0.05), rate[rows], force[rows], np.ones(10), NOISE, GRAVITY, EARTH
        )
        states.append(moved)
    antenna = [states[k][:3] + states[k][6:15].reshape(3, 3) @ LEVER for k in (1, 3, 4, 5)]
    position = np.array(antenna) + rng.normal(0, 0.01, (4, 3))
    swing = [states[k][6:15].reshape(3, 3) @ np.cross(rate[start[k] - 1], LEVER) for k in (1, 3, 4, 5)]
    velocity = np.array([states[k][3:6] for k in (1, 3, 4, 5)]) + swing + rng.normal(0, 0.004, (4, 3))
    velocity[1] = np.nan
    return (
        state, P, start, np.full(n, 0.05), rate, force, np.ones(n), fix, position, np.full((4, 3), 0.05**2), velocity,
        np.full((4, 3), 0.02**2), LEVER, GATE, NOISE, GRAVITY, EARTH, np.empty((0, 21)),
    )  # fmt: skip


def batch(arguments, reference):
    """Gauss-Newton step over all nodes at once about a reference trajectory: errors and full covariance."""
    state, P, start, dt, rate, force, factor, fix, z, R, zv, Rv, lever, _, noise, gravity, earth, _ = arguments
    m = len(start)
    rows, values = [], []

    def add(blocks, residual, covariance):
        whiten = np.linalg.cholesky(np.linalg.inv(covariance)).T
        row = np.zeros((len(residual), 15 * m))
        for k, block in blocks:
            row[:, 15 * k : 15 * k + 15] = block
        rows.append(whiten @ row)
        values.append(whiten @ residual)

    add([(0, np.eye(15))], state_difference(state, reference[0]), P)
    for k in range(1, m):
        part = slice(start[k - 1], start[k])
        moved, T, Q = propagate(
            reference[k - 1], dt[part], rate[part], force[part], factor[part], noise, gravity, earth
        )
        add([(k - 1, -T), (k, np.eye(15))], state_difference(moved, reference[k]), Q)
    for k in np.flatnonzero(fix >= 0):
        j, s = fix[k], reference[k]
        for observed, variance, predict in (
            (z[j], R[j], lambda x: x[:3] + x[6:15].reshape(3, 3) @ lever),
            (
                zv[j],
                Rv[j],
                lambda x, k=k: x[3:6] + x[6:15].reshape(3, 3) @ np.cross(rate[start[k] - 1] - x[15:18], lever),
            ),
        ):
            if np.isnan(observed[0]):
                continue
            H = np.zeros((3, 15))
            for c in range(15):
                e = np.zeros(15)
                e[c] = 1e-6
                H[:, c] = (predict(corrected_state(s, e)) - predict(corrected_state(s, -e))) / 2e-6
            add([(k, H)], observed - predict(s), np.diag(variance))
    A, b = np.vstack(rows), np.concatenate(values)
    covariance = np.linalg.inv(A.T @ A)
    return (covariance @ (A.T @ b)).reshape(m, 15), covariance.reshape(m, 15, m, 15).transpose(0, 2, 1, 3)


def test_smoother_is_the_batch_least_squares_solution(problem) -> None:
    predicted, filtered, P_predicted, P_filtered, T, _, _, _ = filter_forward(*problem)
    smoothed, P_smoothed, gain = smooth_backward(predicted, filtered, P_predicted, P_filtered, T, np.empty((0, 21)))
    step, covariance = batch(problem, smoothed)
    std = np.sqrt(np.diagonal(P_smoothed, axis1=1, axis2=2))
    assert np.abs(step / std).max() < 0.02  # nothing left to gain but second-order terms
    for k in range(len(smoothed)):
        assert_allclose(
            P_smoothed[k] / np.outer(std[k], std[k]), covariance[k, k] / np.outer(std[k], std[k]), rtol=0, atol=0.01
        )
    cross = accumulate_cross_covariance(P_smoothed, gain, np.array([0, 3, 4]))
    for row, (i, j) in enumerate([(0, 3), (3, 4)]):
        scale = np.outer(std[i], std[j])
        assert_allclose(cross[row] / scale, covariance[i, j] / scale, rtol=0, atol=0.01)


def test_iterating_about_the_smoothed_states_reaches_the_optimum(problem) -> None:
    """With a start that is 15 degrees off, one pass leaves a tenth of a standard deviation; two more leave nothing."""
    arguments = list(problem)
    P = problem[1].copy()
    P[6:9, 6:9] *= 700.0
    error = np.zeros(15)
    error[6:9] = [0.15, -0.2, 0.1]
    arguments[0], arguments[1] = corrected_state(problem[0], error), P
    left = []
    for _ in range(3):
        predicted, filtered, P_predicted, P_filtered, T, *_ = filter_forward(*arguments)
        smoothed, P_smoothed, _ = smooth_backward(predicted, filtered, P_predicted, P_filtered, T, arguments[17])
        step, _ = batch(arguments, smoothed)
        left.append(np.abs(step / np.sqrt(np.diagonal(P_smoothed, axis1=1, axis2=2))).max())
        arguments[17] = smoothed
    assert left[0] > 0.1
    assert left[2] < 0.1 * left[0]


def test_filter_at_the_last_node_is_the_smoother_there(problem) -> None:
    predicted, filtered, P_predicted, P_filtered, T, *_ = filter_forward(*problem)
    smoothed, P_smoothed, _ = smooth_backward(predicted, filtered, P_predicted, P_filtered, T, np.empty((0, 21)))
    assert np.array_equal(smoothed[-1], filtered[-1])
    assert np.array_equal(P_smoothed[-1], P_filtered[-1])


def test_smoothing_never_increases_a_variance(problem) -> None:
    predicted, filtered, P_predicted, P_filtered, T, *_ = filter_forward(*problem)
    _, P_smoothed, _ = smooth_backward(predicted, filtered, P_predicted, P_filtered, T, np.empty((0, 21)))
    scale = np.sqrt(np.diagonal(P_filtered, axis1=1, axis2=2))
    gain = (P_filtered - P_smoothed) / (scale[:, :, None] * scale[:, None, :])
    assert np.linalg.eigvalsh(gain).min() > -1e-9


def test_the_gate_refuses_a_jump_and_leaves_the_state_alone(problem) -> None:
    arguments = list(problem)
    position = problem[8].copy()
    position[2] += [0.0, 40.0, 0.0]
    arguments[8], arguments[13] = position, 21.1
    _, filtered, _, _, _, nis, is_used, _ = filter_forward(*arguments)
    assert not is_used[2, 0]
    assert nis[2, 0] > 1e4
    assert is_used[[0, 1, 3], 0].all()
    reference = filter_forward(*problem)[1]
    assert np.linalg.norm(filtered[-1, :3] - reference[-1, :3]) < 0.2


def test_a_delay_of_the_stamps_comes_out_of_one_pass(problem) -> None:
    """Fixes without noise, moved back by v d: the response of the innovations gives d; velocities add information."""
    plain = list(problem)
    plain[7] = np.full(6, -1)
    free = filter_forward(*plain)[0][[1, 3, 4, 5]]
    antenna = free[:, :3] + free[:, 6:15].reshape(-1, 3, 3) @ LEVER
    plain[7], plain[10] = problem[7], np.full((4, 3), np.nan)
    delay = 1e-3
    plain[8] = antenna - delay * free[:, 3:6]
    information, score = filter_forward(*plain)[7]
    assert_allclose(score / information, delay, rtol=1e-3, atol=0)
    plain[10] = problem[10]
    assert filter_forward(*plain)[7][0] > information
