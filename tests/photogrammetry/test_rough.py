"""Photos oriented from rough poses: headings from the pictures, poses and lens near enough to predict features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered
from scipy.spatial.transform import Rotation

from changedetect.errors import InputDataError
from changedetect.photogrammetry.adjustment import AdjustmentSettings, adjust
from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.covariance import point_uncertainty
from changedetect.photogrammetry.headings import Headings, correct_headings, estimate_headings
from changedetect.photogrammetry.orientation import orient_flight
from changedetect.photogrammetry.priors import pose_information
from changedetect.photogrammetry.rough import RoughSettings, neighbouring_pairs, orient_roughly
from changedetect.photogrammetry.similarity import fit_similarity
from changedetect.photogrammetry.ties import Features, PairMatches, TieSettings, detect_features
from changedetect.photogrammetry.triangulation import are_determined, residuals, triangulate

STD = np.array([1.5, 1.5, 0.5, *np.radians([2.0, 2.0, 8.0])])
LENS_STD = (0.05, 5.0, 5.0, 0.1, 0.1, 0.1, 0.002, 0.002, 0.002)
LENS = AdjustmentSettings(lens=("focal", "cx", "cy", "k1", "k2"), lens_std=LENS_STD, max_share=0.2)


def heading(rotation):
    """Azimuth of the top of photos, degrees."""
    top = rotation @ np.array([0.0, -1.0, 0.0])
    return np.degrees(np.arctan2(top[..., 0], top[..., 1]))


def apart(a, b):
    return np.abs((a - b + 180) % 360 - 180)


def rough(truth, seed, std=STD):
    """Poses as a photo states them, and their information."""
    rng = np.random.default_rng(seed)
    error = std * rng.standard_normal((len(truth), 6))
    rotation = Rotation.from_rotvec(error[:, 3:]).as_matrix() @ truth.rotation
    covariance = np.tile(np.diag(std**2), (len(truth), 1, 1))
    poses = replace(
        truth, position=truth.position + error[:, :3], rotation=rotation, covariance=covariance, cross_covariance=None
    )
    return poses, pose_information(poses, correlation_time=0.0)


@pytest.fixture(scope="module")
def flown():
    return rendered.fly(0, n_photos=4)


@pytest.fixture(scope="module")
def features(flown):
    return detect_features(flown, len(flown.truth), TieSettings(n_features=700, contrast=0.01))


@pytest.fixture(scope="module")
def solved(flown, features):
    """Rough poses and a lens of EXIF, one picture turned upside down in what it states, one without a heading."""
    poses, information = rough(flown.truth, 5)
    rotation = poses.rotation.copy()
    rotation[2] = rotation[2] @ np.diag([-1.0, -1.0, 1.0])
    rotation[7] = Rotation.from_rotvec([0, 0, 2.0]).as_matrix() @ rotation[7]
    camera = replace(rendered.CAMERA, fx=540.0, fy=540.0, cx=159.5, cy=119.5, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    block = ImageBlock.from_poses(replace(poses, rotation=rotation), camera)
    stated = np.arange(len(block)) != 7
    return block, information, orient_roughly(features, block, information, stated, LENS)


def test_headings_that_pictures_contradict_are_turned(flown, solved):
    block, _, result = solved
    assert apart(heading(block.rotation[2]), heading(flown.truth.rotation[2])) > 150
    off = apart(heading(result.given.rotation), heading(flown.truth.rotation))
    assert np.flatnonzero(result.is_turned).tolist() == [2, 7]
    assert off.max() < 30
    # a picture turned upside down keeps its tilt
    assert_allclose(result.given.rotation[2, :, 2], block.rotation[2, :, 2], rtol=0, atol=1e-12)


def test_rough_poses_come_to_predict_features_to_a_few_pixels(flown, solved, features):
    block, _, result = solved
    assert result.is_joined.all()
    east, north = np.meshgrid(np.linspace(-6, 6, 5), np.linspace(-5, 5, 5))
    ground = np.column_stack([east.ravel(), north.ravel(), rendered.hills(east.ravel(), north.ravel())])
    true = ImageBlock.from_poses(flown.truth, rendered.CAMERA)

    def miss(start):
        """How far points seen in all photos project from where their features are, once placed by the poses."""
        from changedetect.photogrammetry.block import Observations

        n, m = len(start), len(ground)
        pixel = np.concatenate([true.project(ground, i)[:, :2] for i in range(n)])
        seen = Observations.gather(
            np.tile(np.arange(m), n), np.repeat(np.arange(n), m), pixel, np.ones(n * m), np.zeros(n * m, np.int64)
        )
        return np.nanmedian(np.linalg.norm(residuals(start, triangulate(start, seen).points, seen), axis=1))

    assert miss(block) > 20.0
    assert miss(result.start) < 1.0


def test_flights_of_rough_poses_end_as_good_as_smoothed_ones(flown, features, solved):
    from changedetect.photogrammetry.orientation import OrientationSettings, match_flight
    from changedetect.photogrammetry.tracks import TrackSettings

    _, information, result = solved
    settings = OrientationSettings(
        tracks=TrackSettings(n_features=400), ties=TieSettings(n_features=700, contrast=0.01), adjustment=LENS
    )
    matching = match_flight(flown, features, result.start, (0.35, 0.0), settings)
    final = orient_flight(flown, result.given, information, matching, settings, start=result.start).adjustment
    fitted = fit_similarity(final.points, _nearest_truth(flown, final))
    moved = fitted.apply(final.points)
    error = moved[:, 2] - rendered.hills(moved[:, 0], moved[:, 1])
    assert len(error) > 200
    assert 1.4826 * np.median(np.abs(error - np.median(error))) < 0.15


def _nearest_truth(flown, adjustment):
    """Where the true cameras place the observations of an adjustment."""
    true = ImageBlock.from_poses(flown.truth, rendered.CAMERA)
    return triangulate(true, adjustment.observations).points


def test_water_and_photos_of_other_places_are_refused(flown, features, solved):
    block, information, _ = solved
    stated = np.ones(len(block), dtype=bool)
    rng = np.random.default_rng(1)
    water = [Features(f.pixel, rng.integers(0, 80, f.raw.shape).astype(np.uint8)) for f in features]
    with pytest.raises(InputDataError, match=r"only 1 of 12 are joined .* texture, not water"):
        orient_roughly(water, block, information, stated, LENS)


def test_a_group_without_matches_to_the_others_is_named(flown, features, solved, caplog):
    block, information, _ = solved
    rng = np.random.default_rng(1)
    some = list(features)
    some[4] = Features(some[4].pixel, rng.integers(0, 80, some[4].raw.shape).astype(np.uint8))
    stated = np.ones(len(block), dtype=bool)
    result = orient_roughly(some, block, information, stated, LENS, RoughSettings(sigma=(10.0, 2.0)))
    assert not result.is_joined[4]
    assert "1 of 12 photos are not joined with the others by matches, only by their positions: p004.png" in caplog.text


def test_neighbours_are_the_nearest_and_the_next_in_time(solved):
    block, _, _ = solved
    pairs = neighbouring_pairs(block, 1)
    assert {(i, i + 1) for i in range(11)} <= set(pairs)
    distance = np.linalg.norm(block.position[:, None, :2] - block.position[None, :, :2], axis=2)
    np.fill_diagonal(distance, np.inf)
    assert all((min(i, j), max(i, j)) in pairs for i, j in enumerate(distance.argmin(axis=1)))


def nadir_block(yaws, places):
    rotation = np.stack([rendered.nadir(yaw) for yaw in yaws])
    truth = rendered.poses_at(
        np.asarray(places), rotation, np.arange(len(yaws), dtype=float), np.tile(np.eye(6), (len(yaws), 1, 1))
    )
    return ImageBlock.from_poses(truth, rendered.CAMERA)


@pytest.mark.parametrize("wrong", [0.0, 35.0, 90.0, 180.0, -120.0])
def test_the_heading_seen_is_that_of_the_photo(wrong):
    places = [(0, 0, 60.0), (8, 1, 61.0), (3, 7, 60.0), (9, 9, 59.0)]
    true = nadir_block([10.0, 25.0, -60.0, 130.0], places)
    stated = nadir_block([10.0, 25.0, -60.0 - wrong, 130.0], places)
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(0, 8, 60), rng.uniform(0, 8, 60), np.zeros(60)])
    features = [Features(true.project(ground, i)[:, :2], np.zeros((60, 128), np.uint8)) for i in range(4)]
    match = np.column_stack([np.arange(60)] * 2)
    pairs = [PairMatches(i, j, match) for i in range(4) for j in range(i + 1, 4)]
    seen = estimate_headings(features, pairs, stated)
    assert_allclose(apart(np.degrees(seen.off[2]), wrong), 0.0, rtol=0, atol=2.0)
    assert_allclose(np.degrees(seen.off[[0, 1, 3]]), 0.0, rtol=0, atol=2.0)
    corrected, is_corrected = correct_headings(stated, seen, np.ones(4, dtype=bool))
    assert is_corrected.tolist() == [False, False, abs(wrong) > 45, False]
    if is_corrected[2]:
        assert apart(heading(corrected.rotation[2]), -60.0) < 2.0


def test_headings_that_are_hardly_seen_are_left_alone():
    block = nadir_block([0.0, 0.0], [(0, 0, 60.0), (8, 0, 60.0)])
    unsure = Headings(np.array([np.pi, np.nan]), np.array([np.radians(60.0), np.nan]))
    corrected, is_corrected = correct_headings(block, unsure, np.ones(2, dtype=bool))
    assert not is_corrected.any()
    assert_allclose(corrected.rotation, block.rotation, rtol=0, atol=0)


def test_lens_parameters_that_photos_hardly_determine_stay_and_enter_the_covariance(case):
    observations, std = case.oriented.observations, 0.004
    loose = AdjustmentSettings(lens=("focal",), lens_std=(std, *LENS_STD[1:]), min_views=3)
    free = adjust(case.block, observations, case.information, loose)
    kept = adjust(case.block, observations, case.information, replace(loose, max_share=0.2))
    exact = adjust(case.block, observations, case.information, AdjustmentSettings(min_views=3))
    assert 0.2 * std < free.lens_std[0, 0] < std
    assert free.lens_correction[0, 0] != 0.0
    assert kept.lens_correction[0, 0] == 0.0
    assert_allclose(kept.lens_std[0, 0], std, rtol=1e-9, atol=0)
    assert_allclose(kept.block.intrinsics, case.block.intrinsics, rtol=0, atol=0)
    # Schmidt: the covariance for an exact lens, and what the focal length's error does to the poses
    n = 6 * len(case.block)
    poses, shared = kept.camera_covariance[:n, :n], kept.camera_covariance[:n, n]
    spread = exact.camera_covariance[:n, :n] + np.outer(shared, shared) / std**2
    assert_allclose(np.sqrt(np.diag(poses)), np.sqrt(np.diag(spread)), rtol=0.05, atol=0)
    # heights are off by the focal length's share, but for what base lines take up of it
    of_lens = replace(
        kept, camera_covariance=np.outer(kept.camera_covariance[:, n], kept.camera_covariance[n]) / std**2
    )
    up = np.sqrt(point_uncertainty(of_lens, np.arange(len(kept.points))).covariance[:, 2, 2])
    assert 0.4 < np.median(up) / (std * rendered.HEIGHT) < 1.0


def test_a_start_lends_its_lens_to_the_parameters_that_are_free(case):
    given = replace(case.block, intrinsics=case.block.intrinsics * np.array([1.15, 1.15] + [1.0] * 7))
    settings = AdjustmentSettings(lens=("focal",), lens_std=(0.2, *LENS_STD[1:]))
    start = case.oriented.adjustment.block
    result = adjust(given, case.oriented.observations, case.information, settings, start=start)
    assert_allclose(result.block.intrinsics[0, 0], case.block.intrinsics[0, 0], rtol=0.01, atol=0)
    assert_allclose(result.lens_correction[0, 0], -np.log(1.15), rtol=0.1, atol=0)
    fixed = adjust(given, case.oriented.observations, case.information, AdjustmentSettings(), start=start)
    assert_allclose(fixed.block.intrinsics, given.intrinsics, rtol=0, atol=0)


def test_points_on_parallel_rays_are_not_determined(case):
    adjustment = case.oriented.adjustment
    points = adjustment.points.copy()
    points[3] += (points[3] - adjustment.block.position[0]) * 1e5
    good = are_determined(adjustment.block, points, adjustment.observations)
    assert not good[3]
    assert np.delete(good, 3).all()


def test_a_similarity_is_found_in_spite_of_a_gross_error():
    rng = np.random.default_rng(0)
    source = rng.normal(0, 3, (20, 3))
    rotation = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    target = 7.5 * source @ rotation.T + [100.0, -50.0, 20.0]
    target[4] += 40.0
    found = fit_similarity(source, target)
    assert_allclose(found.scale, 7.5, rtol=1e-3, atol=0)
    assert_allclose(found.rotation, rotation, rtol=0, atol=1e-3)
    assert_allclose(np.delete(found.apply(source) - target, 4, axis=0), 0.0, rtol=0, atol=0.05)


def test_cameras_on_a_line_do_not_place_a_model():
    line = np.outer(np.arange(6.0), [1.0, 2.0, 0.1])
    with pytest.raises(InputDataError, match="6 camera positions lie on one line"):
        fit_similarity(line, 3 * line)
    with pytest.raises(InputDataError, match="2 camera positions are too few"):
        fit_similarity(line[:2], line[:2])
