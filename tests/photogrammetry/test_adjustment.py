"""Bundle adjustment on simulated observations: unbiased, calibrated, robust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from changedetect.errors import InputDataError
from changedetect.photogrammetry.adjustment import LENS_PARAMETERS, AdjustmentSettings, adjust
from changedetect.photogrammetry.block import TRACK, ImageBlock, Observations
from changedetect.photogrammetry.calibration import observable_parameters
from changedetect.photogrammetry.covariance import flight_difference, pixel_correlation, point_uncertainty
from changedetect.photogrammetry.joint import JointSettings, compare_flights, drop_changed, require_shared, unchanged
from changedetect.photogrammetry.priors import pose_information

PIXEL_STD = 0.3


def simulated(seed=0, n_points=250, noise=PIXEL_STD, camera=rendered.CAMERA, boresight=None):
    """Block with perturbed poses, observations, true points, true poses and information."""
    rng = np.random.default_rng(seed)
    position, yaw, time = rendered.layout(5)
    rotation = np.stack([rendered.nadir(y) for y in yaw])
    covariance = np.tile(np.eye(6), (len(time), 1, 1))
    truth = rendered.poses_at(position + rng.normal(0, 0.5, position.shape), rotation, time, covariance)
    poses = rendered.perturbed(truth, seed + 1)
    if boresight is not None:
        poses = replace(poses, rotation=poses.rotation @ Rotation.from_rotvec(-np.asarray(boresight)).as_matrix())
    true_block = ImageBlock.from_poses(truth, rendered.CAMERA)
    points = np.column_stack([rng.uniform(-22, 22, (n_points, 2)), np.zeros(n_points)])
    points[:, 2] = 2 * rendered.hills(points[:, 0], points[:, 1])
    label, image, pixel = [], [], []
    for i in range(len(truth)):
        seen = true_block.project(points, i)
        inside = np.flatnonzero(true_block.is_inside(seen, i, 3.0))
        label.append(inside)
        image.append(np.full(inside.size, i))
        pixel.append(seen[inside, :2] + rng.normal(0, noise, (inside.size, 2)))
    label, image, pixel = np.concatenate(label), np.concatenate(image), np.concatenate(pixel)
    made = Observations.gather(label, image, pixel, np.full(label.size, 0.5), np.full(label.size, TRACK))
    kept, old = made.keep(np.ones(len(made), dtype=bool), min_views=3)
    places = points[np.unique(label)[old]]
    return ImageBlock.from_poses(poses, camera), kept, places, true_block, pose_information(poses)


def test_noise_is_estimated_and_errors_are_as_large_as_claimed():
    lengths = []
    for seed in range(4):
        block, observations, places, _, information = simulated(seed)
        result = adjust(block, observations, information)
        assert_allclose(result.observations.sigma[0], PIXEL_STD, rtol=0.06, atol=0)
        u = point_uncertainty(result, np.arange(len(result.points)))
        error = result.points - places[result.origin]
        lengths.append(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(u.covariance), error)) / 3)
    assert 0.6 < np.mean(lengths) < 1.6  # whole errors, dominated by the pose errors each flight has once


def test_heights_against_each_other_are_as_good_as_claimed():
    z = []
    for seed in range(4):
        block, observations, places, _, information = simulated(seed + 20)
        result = adjust(block, observations, information)
        u = point_uncertainty(result, np.arange(len(result.points)))
        error = result.points[:, 2] - places[result.origin, 2]
        design = np.column_stack([np.ones(len(error)), result.points[:, :2]])
        z.append((error - design @ np.linalg.lstsq(design, error, rcond=None)[0]) / u.sigma)
    z = np.concatenate(z)
    assert 0.85 < z.std() < 1.15
    assert 0.93 < np.mean(np.abs(z) < 1.96) < 0.97


def test_poses_that_contradict_the_photos_show_in_the_priors():
    block, observations, _, _, information = simulated(1)
    agreeing = adjust(block, observations, information)
    assert 0.1 < agreeing.prior_chi2 < 2.0
    rng = np.random.default_rng(0)
    shifted = replace(block, position=block.position + rng.normal(0, 1.5, block.position.shape))
    assert adjust(shifted, observations, information).prior_chi2 > 4.0


def test_perfect_observations_give_back_the_geometry():
    block, observations, places, _, information = simulated(noise=0.0)
    result = adjust(block, observations, 1e-8 * information, AdjustmentSettings(rounds=2))
    # free of priors the solution is the truth up to a similarity: compare distances
    error = result.points - result.points.mean(0), places[result.origin] - places[result.origin].mean(0)
    scale = np.sqrt(np.sum(error[0] ** 2) / np.sum(error[1] ** 2))
    turn = Rotation.align_vectors(error[0] / scale, error[1])[0]
    assert_allclose(error[0] / scale, turn.apply(error[1]), rtol=0, atol=1e-4)


def test_gross_errors_are_removed_and_cost_little():
    block, observations, places, _, information = simulated(3)
    rng = np.random.default_rng(0)
    wrong = rng.choice(len(observations), len(observations) // 25, replace=False)
    pixel = observations.pixel.copy()
    pixel[wrong] += rng.uniform(5, 30, (wrong.size, 2)) * rng.choice([-1, 1], (wrong.size, 2))
    clean = adjust(block, observations, information)
    dirty = adjust(block, replace(observations, pixel=pixel), information)
    assert len(dirty.observations) <= len(observations) - 0.95 * wrong.size
    rms = [np.sqrt(np.mean((r.points - places[r.origin])[:, 2] ** 2)) for r in (clean, dirty)]
    assert rms[1] < 1.25 * rms[0] + 0.02


def test_wrong_radial_distortion_is_found_and_corrected():
    camera = replace(rendered.CAMERA, k1=rendered.CAMERA.k1 + 0.04)
    block, observations, _, _, information = simulated(5, n_points=500, camera=camera)
    found = observable_parameters(block, observations, information)
    assert "k1" in found.lens
    assert "focal" not in found.lens  # one height over nearly level ground does not tell it
    result = adjust(block, observations, information, AdjustmentSettings(lens=found.lens))
    assert_allclose(result.lens_correction[0, 3], -0.04, rtol=0, atol=4 * result.lens_std[0, 3])
    assert result.lens_std[0, 3] < 0.01
    assert result.lens_correction[0, 0] == 0.0
    assert set(found.describe()["std_over_prior"]) == set(LENS_PARAMETERS)


def test_wrong_mounting_angles_are_found():
    boresight = np.radians([0.6, -0.5, 0.8])
    block, observations, _, _, information = simulated(6, boresight=boresight)
    result = adjust(block, observations, information, AdjustmentSettings(boresight_std=np.radians(1.0)))
    assert_allclose(result.boresight[0], boresight, rtol=0, atol=float(3.5 * result.boresight_std.max()))
    assert result.boresight_std.max() < np.radians(0.3)


def test_unknown_lens_parameters_and_shapes_are_refused():
    block, observations, _, _, information = simulated(0, n_points=50)
    with pytest.raises(ValueError, match=r"\['k9'\].*focal"):
        adjust(block, observations, information, AdjustmentSettings(lens=("k9",)))
    with pytest.raises(ValueError, match=r"shape \(6, 6\); expected \(90, 90\)"):
        adjust(block, observations, information[:6, :6])


def test_observations_that_fix_nothing_are_refused():
    block, observations, _, _, information = simulated(0, n_points=50)
    mirrored = replace(block, position=2 * block.position.mean(axis=0) - block.position)  # rays part below the cameras
    with pytest.raises(InputDataError, match=r"None of .* points is fixed"):
        adjust(mirrored, observations, information)


def test_correlated_pixel_errors_are_seen_and_white_ones_are_not():
    block, observations, _, true_block, _ = simulated(8, n_points=1500, noise=0.0)
    rng = np.random.default_rng(1)
    white = rng.normal(0, 0.2, (len(observations), 2))
    smooth = np.empty_like(white)
    for i in range(len(block)):
        field = gaussian_filter(rng.standard_normal((2, 60, 80)), (0, 4, 4))
        mine = observations.image == i
        at = np.clip((observations.pixel[mine] / 4).astype(int), 0, [79, 59])
        smooth[mine] = (0.2 / field.std() * field)[:, at[:, 1], at[:, 0]].T
    assert_allclose(pixel_correlation(white, observations, 400.0).design_effect, 1.0, rtol=0, atol=0.3)
    found = pixel_correlation(smooth, observations, 400.0)
    assert found.design_effect > 5
    # of a field smoothed with s the correlation is exp(-d^2 / 4 s^2): 1 / e at 2 s = 32 pixels
    assert_allclose(found.length, 32.0, rtol=0.35, atol=0)
    assert len(true_block) == len(block)


def two_flights(change=0.6, seed=0):
    """Two flights over one set of points, some of which rose between them."""
    first = simulated(seed, n_points=400)
    second = simulated(seed, n_points=400)  # the same places, poses and views
    rng = np.random.default_rng(seed + 50)
    block = ImageBlock.join([first[3], second[3]])
    places = first[2]
    rose = np.hypot(places[:, 0] - 5, places[:, 1] + 3) < 5
    later = places + np.outer(rose, [0, 0, change])
    observations = first[1]
    pixel = []
    for flight, at in ((0, places), (1, later)):
        shift = flight * len(first[3])
        seen = np.stack([block.project(at, i + shift)[:, :2] for i in range(len(first[3]))])
        exact = seen[observations.image, observations.point]
        pixel.append(exact + rng.normal(0, PIXEL_STD, exact.shape))
    shared = Observations.gather(
        np.tile(observations.point, 2),
        np.concatenate([observations.image, observations.image + len(first[3])]),
        np.concatenate(pixel),
        np.full(2 * len(observations), PIXEL_STD),
        np.full(2 * len(observations), 2),
    )
    return block, shared, rose


def test_changed_ground_is_kept_out_of_the_shared_points():
    block, shared, rose = two_flights()
    (pair,) = compare_flights(block, shared)
    keep = unchanged(pair, JointSettings())
    assert keep[~rose].mean() > 0.9
    assert keep[rose].mean() < 0.1
    kept, moved = drop_changed(block, shared, JointSettings(), ("a", "b"))
    assert kept.n_points == keep.sum()
    assert len(moved) == np.count_nonzero(~keep)


def test_ground_that_did_not_change_stays_shared():
    block, shared, _ = two_flights(change=0.0)
    (pair,) = compare_flights(block, shared)
    assert unchanged(pair, JointSettings()).mean() > 0.97


def test_flights_without_common_points_are_refused_by_name():
    block, shared, _ = two_flights()
    few, _ = shared.keep(shared.point < 5)
    with pytest.raises(InputDataError, match="Flight later shares 5 ground points"):
        require_shared(block, few, JointSettings(), ("earlier", "later"))


def test_what_flights_share_cancels_in_their_difference():
    block, shared, _ = two_flights(change=0.0)
    n = len(block) // 2
    common = np.kron(np.ones((2 * n, 2 * n)), np.diag([1.0, 1, 1, 0, 0, 0])) + 1e-4 * np.eye(12 * n)
    result = adjust(block, shared, np.linalg.inv(common), AdjustmentSettings(rounds=1))
    numbers = np.arange(len(result.points))
    alone = point_uncertainty(result, numbers).systematic
    difference = flight_difference(result, numbers[::2], numbers[1::2])
    assert_allclose(np.sqrt(alone.covariance[0, 0]), 1.0, rtol=0.05, atol=0)
    assert np.sqrt(difference.covariance[0, 0]) < 0.05
