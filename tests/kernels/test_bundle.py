"""Bundle kernels against finite differences and against plain dense least squares."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from changedetect.kernels.bundle import (
    coordinate_modes,
    invert_symmetric,
    point_covariances,
    point_steps,
    reduced_system,
)
from changedetect.kernels.matching import match_near
from changedetect.kernels.projection import N_CALIBRATION, project, project_many, projection_jacobian
from changedetect.kernels.triangulation import triangulate

LENS = np.array([500.0, 505.0, 160.0, 120.0, -0.1, 0.03, 0.001, -0.0008, 0.004])


def scene(seed=0, n_images=4, n_points=6, noise=0.0):
    """Arguments of the kernels for a small block in which every image sees every point."""
    rng = np.random.default_rng(seed)
    position = np.column_stack(
        [np.linspace(-12, 12, n_images), rng.uniform(-3, 3, n_images), 60 + rng.uniform(-1, 1, n_images)]
    )
    down = np.diag([1.0, -1.0, -1.0])
    rotation = Rotation.from_rotvec(rng.normal(0, 0.05, (n_images, 3))).as_matrix() @ down
    points = np.column_stack([rng.uniform(-6, 6, (n_points, 2)), rng.uniform(-2, 2, n_points)])
    lens = np.arange(n_images) % 2
    intrinsics = np.vstack([LENS, LENS * 1.02])
    start = np.arange(n_points + 1) * n_images
    image = np.tile(np.arange(n_images), n_points)
    point = np.repeat(np.arange(n_points), n_images)
    pixel = project_many(points, rotation, position, intrinsics, point, image, lens)[:, :2]
    pixel = pixel + noise * rng.standard_normal(pixel.shape)
    return points, rotation, position, intrinsics, lens, start, image, pixel


def corrected(intrinsics, lens):
    """Lens moved by unknowns of the adjustment: log focal length, cx, cy, k1, k2, k3, p1, p2, log fx / fy."""
    result = intrinsics.copy()
    result[:2] *= np.exp(lens[0] + np.array([0.5, -0.5]) * lens[8])
    result[2:6] += lens[1:5]
    result[6:8] += lens[6:8]
    result[8] += lens[5]
    return result


def moved(arguments, pose, lens):
    """Arguments with cameras moved by unknowns of the adjustment."""
    points, rotation, position, intrinsics, *rest = arguments
    intrinsics = np.array([corrected(*both) for both in zip(intrinsics, lens, strict=True)])
    turned = Rotation.from_rotvec(pose[:, 3:]).as_matrix() @ rotation
    return points, turned, position + pose[:, :3], intrinsics, *rest


def residual_jacobian(arguments):
    """Derivatives of all pixels by camera side and points, by central differences."""
    points, _, position, intrinsics, lens, start, image, _ = arguments
    n, g = len(position), len(intrinsics)
    point = np.repeat(np.arange(len(points)), np.diff(start))

    def pixels(x):
        pose, calibration = x[: 6 * n].reshape(n, 6), x[6 * n : 6 * n + N_CALIBRATION * g].reshape(g, N_CALIBRATION)
        places = points + x[6 * n + N_CALIBRATION * g :].reshape(-1, 3)
        _, r, p, k, *_ = moved(arguments, pose, calibration)
        return project_many(places, r, p, k, point, image, lens)[:, :2].ravel()

    size = 6 * n + N_CALIBRATION * g + 3 * len(points)
    columns = [(pixels(e) - pixels(-e)) / 2e-6 for e in np.eye(size) * 1e-6]
    return np.array(columns).T


def test_derivatives_of_the_projection_match_finite_differences():
    points, rotation, position, *_ = scene()
    by_point, by_pose, by_lens = np.empty((2, 3)), np.empty((2, 6)), np.empty((2, N_CALIBRATION))
    column, row, depth = projection_jacobian(points[0], rotation[0], position[0], LENS, by_point, by_pose, by_lens)
    assert_allclose((column, row, depth), project(points[0], rotation[0], position[0], LENS), rtol=1e-14, atol=0)

    def at(pose, lens, shift):
        turned = Rotation.from_rotvec(pose[3:]).as_matrix() @ rotation[0]
        return np.array(project(points[0] + shift, turned, position[0] + pose[:3], corrected(LENS, lens))[:2])

    step = 1e-6
    for analytic, which in ((by_pose, 0), (by_lens, 1), (by_point, 2)):
        for k in range(analytic.shape[1]):
            forth = [np.zeros(6), np.zeros(N_CALIBRATION), np.zeros(3)]
            forth[which][k] = step
            back = [-v for v in forth]
            assert_allclose(analytic[:, k], (at(*forth) - at(*back)) / (2 * step), rtol=1e-5, atol=1e-4)


def test_reduced_system_is_the_schur_complement_of_the_whole_one():
    arguments = scene(noise=0.5)
    weight = np.random.default_rng(3).uniform(0.5, 2.0, len(arguments[6]))
    matrix, gradient = reduced_system(*arguments, weight, 0.0)
    jacobian = residual_jacobian(arguments)
    points, rotation, position, intrinsics, lens, start, image, pixel = arguments
    point = np.repeat(np.arange(len(points)), np.diff(start))
    residual = (pixel - project_many(points, rotation, position, intrinsics, point, image, lens)[:, :2]).ravel()
    w = np.repeat(weight, 2)
    whole, right = jacobian.T @ (w[:, None] * jacobian), jacobian.T @ (w * residual)
    n = len(matrix)
    solve = np.linalg.solve(whole[n:, n:], np.column_stack([whole[n:, :n], right[n:]]))
    expected = whole[:n, :n] - whole[:n, n:] @ solve[:, :n]
    scale = np.sqrt(np.outer(np.diag(whole)[:n], np.diag(whole)[:n]))
    assert_allclose(matrix / scale, expected / scale, rtol=0, atol=1e-6)
    assert_allclose(gradient, right[:n] - whole[:n, n:] @ solve[:, n], rtol=1e-4, atol=1e-4 * np.abs(right).max())
    step = np.random.default_rng(4).normal(0, 1e-3, n)
    found = point_steps(*arguments, weight, 0.0, step)
    expected = np.linalg.solve(whole[n:, n:], right[n:] - whole[n:, :n] @ step).reshape(-1, 3)
    assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_point_covariances_are_blocks_of_the_inverse_of_the_whole_system():
    arguments = scene()
    weight = np.full(len(arguments[6]), 4.0)
    jacobian = residual_jacobian(arguments)
    n = 6 * 4 + N_CALIBRATION * 2
    prior = np.zeros(jacobian.shape[1])
    prior[:n] = np.concatenate(
        [np.tile([1.0] * 3 + [1e4] * 3, 4), np.tile([1e4, 1e-2, 1e-2, 1e4, 1e4, 1e4, 1e6, 1e6, 1e6], 2)]
    )
    covariance = np.linalg.inv(4.0 * jacobian.T @ jacobian + np.diag(prior))
    own, shared = point_covariances(*arguments, weight, covariance[:n, :n])
    for p in range(len(own)):
        at = slice(n + 3 * p, n + 3 * p + 3)
        assert_allclose(own[p] + shared[p], covariance[at, at], rtol=1e-4, atol=1e-8)


def test_modes_are_what_a_new_triangulation_gives():
    arguments = scene()
    weight = np.ones(len(arguments[6]))
    n = 6 * 4 + N_CALIBRATION * 2
    mode = np.random.default_rng(5).normal(0, 1e-5, n)
    heights = coordinate_modes(*arguments, weight, mode[:, None], 2)[:, 0]
    shifted = moved(arguments, mode[:24].reshape(4, 6), mode[24:].reshape(2, N_CALIBRATION))
    steps = point_steps(*shifted, weight, 0.0, np.zeros(n))
    assert_allclose(heights, steps[:, 2], rtol=1e-3, atol=1e-7)
    east = coordinate_modes(*arguments, weight, mode[:, None], 0)[:, 0]
    assert_allclose(east, steps[:, 0], rtol=1e-3, atol=1e-7)


def test_triangulation_recovers_points_and_leaves_out_what_is_not_fixed():
    points, rotation, position, intrinsics, lens, start, image, pixel = scene()
    rays = points[np.repeat(np.arange(6), 4)] - position[image]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    weight = np.ones(len(image))
    weight[start[2] + 1 : start[3]] = 0.0  # point 2 is left with one ray
    found, covariance = triangulate(rays, rotation, position, intrinsics, lens, start, image, pixel, weight, 3)
    assert np.isnan(found[2]).all()
    assert np.isnan(covariance[2]).all()
    assert_allclose(np.delete(found, 2, 0), np.delete(points, 2, 0), rtol=0, atol=1e-8)


def test_inverse_of_a_symmetric_matrix_and_of_a_singular_one():
    a = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.2], [0.5, -0.2, 2.0]])
    out = np.empty((3, 3))
    assert_allclose(invert_symmetric(a, out), np.linalg.det(a), rtol=1e-12, atol=0)
    assert_allclose(out, np.linalg.inv(a), rtol=1e-12, atol=1e-14)
    assert invert_symmetric(np.outer([1.0, 2, 3], [1.0, 2, 3]), out) == 0.0


def test_matching_takes_the_nearest_descriptor_near_the_prediction_only():
    rng = np.random.default_rng(0)
    second = rng.uniform(0, 1, (40, 16)).astype(np.float32)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    pixel = np.column_stack([rng.uniform(0, 100, 40), np.sort(rng.uniform(0, 100, 40))])
    first, predicted = second[::2].copy(), pixel[::2] + 1.0
    match = match_near(predicted, pixel, first, second, 5.0, 0.8, 0.5)
    assert_allclose(match, np.arange(0, 40, 2), rtol=0, atol=0)
    assert (match_near(predicted + 500.0, pixel, first, second, 5.0, 0.8, 0.5) == -1).all()
    assert (match_near(np.full_like(predicted, np.nan), pixel, first, second, 5.0, 0.8, 0.5) == -1).all()
    twins = np.repeat(second[:1], 40, axis=0)  # all alike: ambiguous wherever two are near
    assert (match_near(predicted, pixel, twins[:20], twins, 50.0, 0.8, 0.5) == -1).all()
