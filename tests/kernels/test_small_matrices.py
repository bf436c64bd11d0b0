"""Rotations and small linear algebra against scipy and numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from changedetect.kernels import small_matrices as sm


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 9.9e-4, 1.1e-3, 0.3, 2.0, 3.1, np.pi - 1e-6, np.pi])
def test_rotation_matrix_and_vector_agree_with_scipy_at_every_angle(angle: float) -> None:
    axis = np.array([0.6, -0.64, 0.48])
    matrix = sm.rotation_matrix(angle * axis)
    assert_allclose(matrix, Rotation.from_rotvec(angle * axis).as_matrix(), rtol=0, atol=1e-14)
    assert_allclose(sm.rotation_matrix(sm.rotation_vector(matrix)), matrix, rtol=0, atol=1e-12)
    if angle < np.pi:
        assert_allclose(sm.rotation_vector(matrix), angle * axis, rtol=0, atol=1e-9)


def test_half_turns_about_each_axis_and_towards_either_side() -> None:
    for axis in np.vstack([np.eye(3), [[0.8, 0.6, 0.0], [-0.8, 0.6, 0.0], [0.36, -0.48, 0.8]]]):
        for angle in (np.pi, np.pi - 0.01, -(np.pi - 0.01)):
            matrix = Rotation.from_rotvec(angle * axis).as_matrix()
            assert_allclose(sm.rotation_matrix(sm.rotation_vector(matrix)), matrix, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [1e-4, 0.009, 0.011, 0.7])
def test_mean_rotation_along_the_way_is_the_integral(angle: float) -> None:
    axis = np.array([0.0, 0.6, 0.8])
    s, weight = np.polynomial.legendre.leggauss(12)
    parts = [Rotation.from_rotvec(0.5 * (x + 1) * angle * axis).as_matrix() for x in s]
    integral = 0.5 * np.tensordot(weight, parts, axes=1)
    assert_allclose(sm.rotation_series(angle * axis, 1), integral, rtol=0, atol=1e-14)


def test_products_agree_with_numpy() -> None:
    rng = np.random.default_rng(1)
    A, B, v, w = rng.normal(size=(4, 5)), rng.normal(size=(5, 3)), rng.normal(size=3), rng.normal(size=3)
    assert_allclose(sm.product(A, B), A @ B, rtol=1e-13, atol=1e-14)
    assert_allclose(sm.times_vector(B, v), B @ v, rtol=1e-13, atol=1e-14)
    assert_allclose(sm.cross(v, w), np.cross(v, w), rtol=1e-13, atol=1e-15)
    P = B @ B.T
    out = sm.congruence(A, P)
    assert_allclose(out, A @ P @ A.T, rtol=1e-12, atol=1e-13)
    assert np.array_equal(out, out.T)


def test_cholesky_solve_survives_variances_of_twelve_orders_of_magnitude() -> None:
    rng = np.random.default_rng(2)
    scale = 10.0 ** np.linspace(-6, 6, 8)
    M = rng.normal(size=(8, 20))
    A = scale[:, None] * (M @ M.T / 20) * scale
    X = rng.normal(size=(8, 3)) / scale[:, None]
    assert_allclose(sm.cholesky_solve(A, A @ X) * scale[:, None], X * scale[:, None], rtol=1e-9, atol=1e-11)


def test_cholesky_solve_of_an_indefinite_matrix_is_nan() -> None:
    if getattr(sm.cholesky_solve, "py_func", None) is None:
        pytest.skip("uncompiled square roots of negative numbers raise instead")
    assert np.isnan(sm.cholesky_solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.ones((2, 1)))).any()
