"""Strapdown mechanisation against closed forms, and the error dynamics against differences of it."""

from __future__ import annotations

import math

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from changedetect.kernels import navigation as kernel

NOISE = np.array([1e-6, 4e-5, 1e-10, 1e-6])
FLAT = np.array([0.0, 9.8])
STILL = np.zeros(3)


def make_state(position=(0, 0, 0), velocity=(0, 0, 0), rotation=None, gyro_bias=(0, 0, 0), accel_bias=(0, 0, 0)):
    rotation = np.eye(3) if rotation is None else rotation
    return np.concatenate([position, velocity, rotation.ravel(), gyro_bias, accel_bias]).astype(float)


def run(state, rate, force, dt, noise=NOISE, gravity=FLAT, earth=STILL):
    n = len(rate)
    return kernel.propagate(
        state, np.full(n, dt), np.asarray(rate, float), np.asarray(force, float), np.ones(n), noise, gravity, earth
    )


def test_a_body_at_rest_stays_at_rest() -> None:
    rotation = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix()
    force = rotation.T @ [0.0, 0.0, 9.8]
    state, _, _ = run(make_state((1, 2, 3), rotation=rotation), np.zeros((50, 3)), np.tile(force, (50, 1)), 0.01)
    assert_allclose(state, make_state((1, 2, 3), rotation=rotation), rtol=0, atol=1e-12)


def test_free_fall_is_a_parabola() -> None:
    state, _, _ = run(make_state(velocity=(3, 0, 1)), np.zeros((100, 3)), np.zeros((100, 3)), 0.01)
    assert_allclose(state[:6], [3.0, 0.0, 1.0 - 4.9, 3.0, 0.0, 1.0 - 9.8], rtol=0, atol=1e-12)


def test_biases_are_taken_from_the_samples() -> None:
    still = make_state(gyro_bias=(0.1, 0, -0.2), accel_bias=(0.5, 0.1, 0))
    state, _, _ = run(still, np.tile([0.1, 0, -0.2], (20, 1)), np.tile([0.5, 0.1, 9.8], (20, 1)), 0.01)
    assert_allclose(state, still, rtol=0, atol=1e-12)


def test_a_steady_turn_closes_its_circle() -> None:
    omega, speed, n = 0.25, 30.0, 400
    dt = 2 * math.pi / omega / n
    force = np.tile([0.0, omega * speed, 9.8], (n, 1))  # forward x, left y, up z
    state, _, _ = run(make_state(velocity=(speed, 0, 0)), np.tile([0, 0, omega], (n, 1)), force, dt)
    assert_allclose(state[3:15], make_state(velocity=(speed, 0, 0))[3:15], rtol=0, atol=1e-9)
    assert_allclose(state[:3], 0.0, rtol=0, atol=0.02)  # the chord of each interval is a parabola, not an arc


def test_the_earths_rotation_turns_a_gyro_that_is_fixed_in_space() -> None:
    earth = np.array([0.0, 5e-5, 4e-5])
    state, _, _ = run(make_state(), np.zeros((10, 3)), np.tile([0, 0, 9.8], (10, 1)), 100.0, earth=earth)
    expected = Rotation.from_rotvec(-earth * 1000.0).as_matrix()
    assert_allclose(state[6:15].reshape(3, 3), expected, rtol=0, atol=1e-12)


def test_coning_motion_is_followed_to_a_thousandth_of_the_uncorrected_drift() -> None:
    """A body axis that describes a cone turns although the mean rates about it do not show it [Savage 1998]."""
    angle, frequency, dt, n = 0.02, 2 * math.pi * 5.0, 0.01, 1000
    t = np.arange(n + 1) * dt
    fine = np.linspace(0.0, n * dt, n * 50 + 1)
    truth = Rotation.from_rotvec(
        angle * np.column_stack([np.cos(frequency * fine), np.sin(frequency * fine), 0 * fine])
    )
    turn = (truth[:-1].inv() * truth[1:]).as_rotvec().reshape(n, 50, 3).sum(axis=1) / dt
    force = np.zeros((n, 3))
    rate, _ = kernel.compensate_motion(np.full(n, dt), turn, force)
    start = make_state(rotation=truth[0].as_matrix())
    errors = []
    for samples in (turn, rate):
        state, _, _ = run(start, samples, force, dt)
        difference = truth[-1].inv() * Rotation.from_matrix(state[6:15].reshape(3, 3))
        errors.append(np.linalg.norm(difference.as_rotvec()))
    assert errors[0] > 1e-3
    assert errors[1] < 0.05 * errors[0]
    assert t.size == n + 1


def test_state_difference_undoes_a_correction() -> None:
    rng = np.random.default_rng(3)
    state = make_state((5, 6, 7), (1, 2, 3), Rotation.random(rng=rng).as_matrix(), (0.1, 0, 0), (0, 0.2, 0))
    error = rng.normal(size=15) * 0.3
    assert_allclose(kernel.state_difference(kernel.corrected_state(state, error), state), error, rtol=0, atol=1e-12)


def test_transition_is_the_derivative_of_the_mechanisation() -> None:
    """Perturb each of the 15 errors and integrate: oracle for the linear error dynamics, Earth and biases included."""
    rng = np.random.default_rng(4)
    rate, force = rng.normal(0, 0.3, (30, 3)), rng.normal(0, 2, (30, 3)) + np.array([0, 0, -9.8])
    earth, gravity = np.array([0.0, 6e-5, -4e-5]), np.array([1.5e-6, 9.8])
    start = make_state((500, 300, 100), (20, -15, 1), Rotation.random(rng=rng).as_matrix(), (0.01, 0, 0), (0.1, 0, 0))
    end, transition, _ = run(start, rate, force, 0.01, gravity=gravity, earth=earth)
    steps = np.repeat([1e-3, 1e-3, 1e-6, 1e-6, 1e-4], 3)
    for column, step in enumerate(steps):
        error = np.zeros(15)
        error[column] = step
        moved, _, _ = run(kernel.corrected_state(start, error), rate, force, 0.01, gravity=gravity, earth=earth)
        derivative = kernel.state_difference(moved, end) / step
        assert_allclose(transition[:, column], derivative, rtol=2e-3, atol=2e-6)


def test_process_noise_of_white_sensors_has_the_textbook_growth() -> None:
    """Integrated white noise at rest: velocity variance q t, position q t^3 / 3, attitude g t."""
    force = np.tile([0.0, 0.0, 9.8], (100, 1))
    _, _, Q = run(make_state(), np.zeros((100, 3)), force, 0.01, noise=np.array([1e-12, 4e-4, 1e-20, 1e-20]))
    assert_allclose(np.diag(Q)[:3], 4e-4 / 3, rtol=1e-3, atol=0)
    assert_allclose(np.diag(Q)[3:6], 4e-4, rtol=1e-3, atol=0)
    assert_allclose(np.diag(Q)[6:9], 1e-12, rtol=1e-7, atol=0)
    assert np.linalg.eigvalsh(Q).min() > -1e-18


def test_splitting_an_interval_changes_nothing_but_rounding() -> None:
    rng = np.random.default_rng(5)
    start = make_state((0, 0, 100), (30, 0, 0), Rotation.random(rng=rng).as_matrix())
    rate, force = np.array([[0.1, -0.2, 0.3]]), np.array([[0.5, 0.1, -9.7]])
    whole, T, Q = run(start, rate, force, 0.01)
    half, T2, Q2 = run(start, np.repeat(rate, 2, axis=0), np.repeat(force, 2, axis=0), 0.005)
    assert_allclose(whole, half, rtol=0, atol=2e-7)
    assert_allclose(T, T2, rtol=0, atol=2e-6)
    assert_allclose(Q, Q2, rtol=0.01, atol=1e-9)
