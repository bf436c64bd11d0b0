"""Triangulation that heeds the covariance of poses."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from changedetect.kernels.pose_weighted import pose_weighted_points
from changedetect.kernels.projection import project_many

INTRINSICS = np.array([[1000.0, 1000.0, 250.0, 200.0, -0.05, 0.01, 0.0, 0.0, 0.0]])
DOWN = np.diag([1.0, -1.0, -1.0])
N = 6


def scene(rng, n_points=300):
    """Six photos along a line, points seen by all."""
    position = np.column_stack([np.linspace(-20, 20, N), np.zeros(N), np.full(N, 100.0)])
    points = np.column_stack([rng.uniform(-4, 4, n_points), rng.uniform(-8, 8, n_points), rng.normal(0, 2, n_points)])
    start = np.arange(0, N * n_points + 1, N)
    image = np.tile(np.arange(N), n_points)
    rotation = np.tile(DOWN, (N, 1, 1))
    lens = np.zeros(N, np.int64)
    pixel = project_many(points, rotation, position, INTRINSICS, np.repeat(np.arange(n_points), N), image, lens)
    return points, rotation, position, lens, start, image, np.ascontiguousarray(pixel[:, :2])


def chained_covariance(worse=1.0):
    """Errors of neighbouring photos nearly equal; those of the last two `worse` times as large."""
    decay = 0.97 ** np.abs(np.subtract.outer(np.arange(N), np.arange(N)))
    size = np.array([1.0] * (N - 2) + [worse] * 2)
    return np.kron(decay * np.outer(size, size), np.diag([0.3**2] * 3 + [2e-3**2] * 3))


def test_true_poses_and_pixels_give_the_points_back():
    points, rotation, position, lens, start, image, pixel = scene(np.random.default_rng(0), 50)
    solved = pose_weighted_points(
        points + 0.5, rotation, position, INTRINSICS, lens, start, image, pixel, np.full(len(image), 0.3),
        chained_covariance(),
    )  # fmt: skip
    assert_allclose(solved, points, rtol=0, atol=1e-4)


def test_errors_are_smaller_than_with_equal_weights():
    rng = np.random.default_rng(1)
    covariance = chained_covariance(worse=4.0)
    factor = np.linalg.cholesky(covariance)
    errors = {"weighted": [], "equal": []}
    for _ in range(40):
        points, rotation, position, lens, start, image, pixel = scene(rng, 30)
        pixel = pixel + rng.normal(0, 0.3, pixel.shape)
        error = (factor @ rng.standard_normal(6 * N)).reshape(N, 6)
        turned = Rotation.from_rotvec(-error[:, 3:]).as_matrix() @ rotation
        given = (points, turned, position - error[:, :3], INTRINSICS, lens, start, image, pixel)
        sigma = np.full(len(image), 0.3)
        for name, c in (("weighted", covariance), ("equal", np.zeros_like(covariance))):
            errors[name].append(pose_weighted_points(*given, sigma, c)[:, 2] - points[:, 2])
    size = {name: np.sqrt(np.mean(np.concatenate(values) ** 2)) for name, values in errors.items()}
    assert size["weighted"] < 0.7 * size["equal"]


def test_a_point_behind_the_cameras_is_nan():
    points, rotation, position, lens, start, image, pixel = scene(np.random.default_rng(2), 2)
    points = points + np.array([[0.0, 0.0, 300.0], [0.0, 0.0, 0.0]])
    solved = pose_weighted_points(
        points, rotation, position, INTRINSICS, lens, start, image, pixel, np.full(len(image), 0.3),
        chained_covariance(),
    )  # fmt: skip
    assert np.isnan(solved[0]).all()
    assert np.isfinite(solved[1]).all()
