"""Epipolar tests on exact geometry with outliers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError
from changedetect.photogrammetry.epipolar import fundamental_inliers, sampson_angle, two_point_inliers

FOCAL = 1000.0
BASELINE = np.array([8.0, 1.0, 0.3])


def matches(n=200, n_wrong=60, noise_px=0.2, seed=0):
    """Rays of two photos 60 m above rough ground; the first `n_wrong` matches are chance."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-20, 20, (n, 2)), rng.uniform(-64, -52, n)])
    second = points - BASELINE
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    second[:n_wrong, :2] = rng.uniform(-20, 20, (n_wrong, 2))
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    noisy = [r + rng.normal(0, noise_px / FOCAL, r.shape) for r in (points, second)]
    return [r / np.linalg.norm(r, axis=1, keepdims=True) for r in noisy]


def test_two_points_find_the_baseline_and_reject_chance_matches():
    first, second = matches()
    inliers, direction = two_point_inliers(first, second, 1.0 / FOCAL)
    unit = BASELINE / np.linalg.norm(BASELINE)
    assert abs(direction @ unit) > np.cos(np.radians(0.2))
    assert inliers[60:].mean() > 0.98
    assert inliers[:60].mean() < 0.15


def test_sampson_angle_of_a_true_match_is_the_noise():
    first, second = matches(n=4000, n_wrong=0, noise_px=0.3)
    angle = sampson_angle(first, second, BASELINE)
    # one of the two coordinates of either ray counts; the rays' noise is isotropic
    assert_allclose(np.std(angle) * FOCAL, 0.3, rtol=0.08, atol=0)
    several = sampson_angle(first[:5], second[:5], np.stack([BASELINE, -BASELINE]))
    assert_allclose(several[0], -several[1], rtol=1e-12, atol=1e-15)


def test_points_moving_along_the_baseline_pass_because_two_views_cannot_see_them():
    first, second = matches(n_wrong=0, noise_px=0.0)
    moving = second[:20] * 55.0 + 1.5 * BASELINE / np.linalg.norm(BASELINE)
    second[:20] = moving / np.linalg.norm(moving, axis=1, keepdims=True)
    inliers, _ = two_point_inliers(first, second, 1.0 / FOCAL)
    assert inliers[:20].all()


def test_fundamental_matrix_rejects_chance_matches_without_poses():
    first, second = (FOCAL * r[:, :2] / r[:, 2:] for r in matches())
    inliers = fundamental_inliers(first, second, 1.0)
    assert inliers[60:].mean() > 0.9
    assert inliers[:60].mean() < 0.2


def test_too_few_matches_are_refused():
    with pytest.raises(InputDataError, match=r"7 matches.*at least 8"):
        two_point_inliers(np.ones((7, 3)), np.ones((7, 3)), 1e-3)
    with pytest.raises(InputDataError, match=r"7 matches.*at least 8"):
        fundamental_inliers(np.ones((7, 2)), np.ones((7, 2)), 1.0)
