"""What a lens that is not adjusted may err by, and contradictions between photos and navigation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from photogrammetry import rendered
from photogrammetry.test_adjustment import simulated

from changedetect.kernels.projection import N_CALIBRATION
from changedetect.photogrammetry.adjustment import AdjustmentSettings, adjust
from changedetect.photogrammetry.covariance import point_uncertainty
from changedetect.photogrammetry.lens import corrected_intrinsics, normalise
from changedetect.photogrammetry.lens_doubt import contradiction, corner_units, doubted_variance


def without_tilt(error, places):
    """Errors of heights less an offset and a tilt."""
    design = np.column_stack([np.ones(len(error)), places[:, :2]])
    return error - design @ np.linalg.lstsq(design, error, rcond=None)[0]


def flown_with(error, settings, seeds=range(4)):
    """Standardised errors of heights of flights whose stated lens is wrong, and their standard deviations."""
    z, sigma = [], []
    for seed in seeds:
        lens = replace(rendered.CAMERA, k1=rendered.CAMERA.k1 + error)
        block, observations, places, _, information = simulated(seed + 20, camera=lens)
        result = adjust(block, observations, information, settings)
        u = point_uncertainty(result, np.arange(len(result.points)))
        z.append(without_tilt(result.points[:, 2] - places[result.origin, 2], result.points) / u.sigma)
        sigma.append(u.sigma)
    return np.concatenate(z), np.concatenate(sigma)


def test_units_of_all_parameters_together_move_a_corner_by_a_pixel():
    block = simulated(1)[0]
    units = corner_units(block)[0]
    width, height = block.size_of(0)
    corners = np.array([[0.0, 0.0], [width - 1, 0.0], [0.0, height - 1], [width - 1, height - 1]])
    flat = normalise(corners, block.lens_of(0))
    point = np.column_stack([flat, np.ones(4)])
    level = replace(block, rotation=np.eye(3)[None].repeat(len(block), 0), position=np.zeros((len(block), 3)))
    small, moves = 1e-3, np.zeros(N_CALIBRATION)
    for k in range(N_CALIBRATION):
        step = np.zeros((1, N_CALIBRATION))
        step[0, k] = small * units[k]
        moved = replace(level, intrinsics=corrected_intrinsics(level.intrinsics, step)).project(point, 0)
        moves[k] = np.linalg.norm(moved[:, :2] - corners, axis=1).max() / small
    assert_allclose(moves, 1.0 / np.sqrt(N_CALIBRATION), rtol=1e-3, atol=0)


def test_what_was_known_stays_where_photos_agree_and_grows_where_they_do_not():
    information, known = np.diag([100.0, 100.0, 1e-6]), np.array([0.01, 0.01, 0.01])
    estimate = np.array([0.15, 2.0, 5.0])  # 1.5 and 20 standard errors off, and not determined at all
    variance = doubted_variance(information, information @ estimate, known)
    assert_allclose(variance[[0, 2]], known[[0, 2]], rtol=0, atol=0)
    assert_allclose(variance[1], 2.0**2 - 0.01, rtol=1e-6, atol=0)


def test_variance_grows_by_the_birge_ratio_in_modes_that_both_sides_know():
    prior, photos = np.diag([1.0, 1.0, 1.0]), np.diag([1.0, 1e4, 1e-4])
    whole = prior + photos
    away = np.array([6.0, 0.0, 0.0])  # what the photos say; the priors say zero
    posterior = np.linalg.solve(whole, photos @ away)
    added = contradiction(whole, prior, posterior)
    ratio = 6.0**2 / 2.0  # squared difference over the sum of both variances
    assert_allclose(added[0, 0], (ratio - 1) / 2.0, rtol=1e-9, atol=0)
    assert_allclose(np.delete(np.delete(added, 0, 0), 0, 1), 0.0, rtol=0, atol=1e-12)
    assert_allclose(contradiction(whole, prior, posterior / 10), 0.0, rtol=0, atol=0)


def test_heights_by_a_lens_stated_wrong_are_as_good_as_claimed():
    z, sigma = flown_with(0.04, AdjustmentSettings())
    blind, _ = flown_with(0.04, AdjustmentSettings(lens_doubt=0.0, heeds_contradiction=False))
    _, right = flown_with(0.0, AdjustmentSettings())
    assert np.mean(np.abs(z) < 1.96) > 0.92
    assert np.mean(np.abs(blind) < 1.96) < np.mean(np.abs(z) < 1.96) - 0.05
    assert np.median(sigma) > 1.1 * np.median(right)


def test_a_doubted_lens_stays_as_given_and_enters_the_covariance():
    block, observations, _, _, information = simulated(3)
    result = adjust(block, observations, information, AdjustmentSettings())
    exact = adjust(block, observations, information, AdjustmentSettings(lens_doubt=0.0))
    assert_allclose(result.block.intrinsics, block.intrinsics, rtol=0, atol=0)
    assert_allclose(result.block.position, exact.block.position, rtol=0, atol=0)
    assert_allclose(result.lens_std[0], 0.1 * corner_units(block)[0], rtol=1e-9, atol=0)
    assert not exact.lens_std.any()
    n = 6 * len(block)
    variance = np.diag(result.camera_covariance)[n:]
    doubt = (result.lens_slope * variance) @ result.lens_slope.T
    assert_allclose(result.camera_covariance, exact.camera_covariance + doubt, rtol=1e-6, atol=1e-12)
