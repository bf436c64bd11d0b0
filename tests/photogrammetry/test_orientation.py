"""Tracks, ties and the adjusted flight, on photos rendered over known ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered

from changedetect.errors import InputDataError
from changedetect.photogrammetry.block import TIE, TRACK, GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.extension import rectified
from changedetect.photogrammetry.ground import estimate_ground, fit_plane
from changedetect.photogrammetry.orientation import OrientationSettings, match_flight, orient_together
from changedetect.photogrammetry.paper import triangulated, two_views
from changedetect.photogrammetry.priors import pose_information
from changedetect.photogrammetry.ties import Features, PairMatches, detect_features, join_matches
from changedetect.photogrammetry.tracks import TrackSettings, strips, track_features
from changedetect.photogrammetry.triangulation import residuals, triangulate, two_view_error


def height_errors(points, ground=rendered.hills):
    return points[:, 2] - ground(points[:, 0], points[:, 1])


def spread(values):
    return 1.4826 * np.median(np.abs(values - np.median(values)))


def test_strips_end_where_the_aircraft_turns(case):
    runs = strips(case.block, case.matching.ground)
    assert runs == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]


def test_ground_plane_is_found_from_photos_alone(case):
    plane = estimate_ground(case.features, case.true_block)
    assert_allclose(plane.height, 0.0, rtol=0, atol=0.3)
    assert 0.5 <= plane.spread < 1.5


def test_plane_fit_ignores_a_tenth_of_gross_errors():
    rng = np.random.default_rng(0)
    points = rng.uniform(-50, 50, (500, 3))
    points[:, 2] = 3 + 0.1 * points[:, 0] - 0.05 * points[:, 1] + rng.normal(0, 0.2, 500)
    points[:50, 2] += 40
    plane = fit_plane(points)
    assert_allclose([plane.height, plane.slope_east, plane.slope_north], [3, 0.1, -0.05], rtol=0, atol=0.05)


@pytest.mark.parametrize("kind", ["tracks", "ties"])
def test_matches_hit_the_same_ground_within_a_third_of_a_pixel(case, kind):
    observations = getattr(case.matching, kind)
    assert observations.n_points > 200
    solved = triangulate(case.true_block, observations)
    error = residuals(case.true_block, solved.points, observations)
    assert np.nanmedian(np.abs(error)) < 0.1
    assert np.nanpercentile(np.abs(error), 95) < 0.33
    assert spread(height_errors(solved.points[np.isfinite(solved.points[:, 0])])) < 0.12


def test_tracks_do_not_depend_on_the_number_of_workers(case):
    one = track_features(case.flown, case.block, case.matching.ground, case.settings.tracks, workers=1)
    assert_allclose(one.pixel, case.matching.tracks.pixel, rtol=0, atol=0)
    assert_allclose(one.image, case.matching.tracks.image, rtol=0, atol=0)


def test_fundamental_gate_keeps_about_the_same_tracks(case):
    settings = TrackSettings(n_features=400, gate="fundamental")
    other = track_features(case.flown, case.block, case.matching.ground, settings)
    assert 0.9 < len(other) / len(case.matching.tracks) < 1.1


def test_rectified_photo_of_another_strip_looks_like_the_first(case):
    ground = GroundPlane(0.0)
    turned = rectified(case.flown(5), case.true_block, ground, (1, 5)).astype(float)
    first = case.flown(1).astype(float)
    common = slice(130, 200), slice(100, 220)
    assert np.corrcoef(turned[common].ravel(), first[common].ravel())[0, 1] > 0.6
    assert np.corrcoef(case.flown(5)[common].ravel(), first[common].ravel())[0, 1] < 0.3


def test_adjustment_removes_most_of_the_error_that_poses_leave(case):
    given = triangulate(case.block, case.matching.ties)
    before = spread(height_errors(given.points[np.isfinite(given.points[:, 0])]))
    adjusted = case.oriented.adjustment
    error = height_errors(adjusted.points)
    assert spread(error) < 0.07
    assert spread(error) < before / 3
    assert adjusted.observations.n_views.min() >= 3


def test_tracks_are_carried_on_to_other_strips(case):
    n_tracks = case.matching.tracks.n_points
    observations = case.oriented.observations
    assert np.count_nonzero(observations.kind == TIE) > np.count_nonzero(case.matching.ties.kind == TIE)
    assert observations.n_views.mean() > case.matching.tracks.n_views.mean()
    assert n_tracks > 0


def test_adjusted_positions_agree_with_the_truth_within_their_covariance(case):
    adjusted = case.oriented.adjustment
    error = adjusted.block.position - case.flown.truth.position
    variance = np.diag(adjusted.camera_covariance)[: 6 * len(error)].reshape(-1, 6)[:, :3]
    assert np.all(np.abs(error) < 3.5 * np.sqrt(variance))


def test_two_views_are_the_ends_of_each_track_and_worse(case):
    pair = two_views(case.matching.tracks)
    assert_allclose(pair.n_views, 2, rtol=0, atol=0)
    result = triangulated(case.block, pair, case.information)
    assert spread(height_errors(result.points)) > 2 * spread(height_errors(case.oriented.adjustment.points))
    assert_allclose(result.pose_correction, 0, rtol=0, atol=0)


def test_flights_adjusted_together_agree_without_coregistration(case, later_case):
    flights = [(c.block, c.information, c.features, c.matching, c.oriented) for c in (case, later_case)]
    together = orient_together(flights, ("first", "second"), 1.0, case.settings)
    assert together.n_shared > 60
    first, second = (together.adjustment.points[points] for points in together.points)
    change = np.median(height_errors(second, rendered.raised_hills)) - np.median(height_errors(first))
    assert abs(change) < 0.03
    on_mound = rendered.mound(second[:, 0], second[:, 1]) > 0.25
    assert on_mound.sum() >= 5
    error = height_errors(second, rendered.raised_hills)
    assert_allclose(np.median(error[on_mound]), np.median(error), rtol=0, atol=0.08)


def test_photos_of_other_ground_are_refused_with_advice(case):
    other = rendered.texture(seed=9)
    photos = [case.flown(i) if i % 2 else other[i * 50 : i * 50 + 240, :320].astype(np.uint8) for i in range(12)]
    features = detect_features(lambda i: photos[i], 12, case.settings.ties)
    with pytest.raises(InputDataError, match=r"Consecutive photos do not match.*p000\.png"):
        estimate_ground(features, case.block)


def test_photos_without_overlap_are_strips_of_their_own(case):
    apart = replace(case.block, position=case.block.position * [[9.0, 9.0, 1.0]])
    assert strips(apart, GroundPlane(0.0)) == [[k] for k in range(12)]


def test_water_is_refused():
    calm = np.full((240, 320), 90, np.uint8)
    flown = rendered.fly(0, n_photos=4, ground_texture=np.full((2000, 2000), 90, np.float32))
    block = ImageBlock.from_poses(flown.truth, rendered.CAMERA)
    features = detect_features(lambda _: calm, len(block), OrientationSettings().ties)
    with pytest.raises(InputDataError, match="not water"):
        match_flight(lambda _: calm, features, block, (0.3, 0.003), OrientationSettings())


def test_joining_drops_points_that_claim_two_features_of_one_photo():
    features = [Features(np.arange(8.0).reshape(4, 2), np.ones((4, 128), np.uint8)) for _ in range(3)]
    pairs = [
        PairMatches(0, 1, np.array([[0, 0], [1, 1]])),
        PairMatches(1, 2, np.array([[0, 2], [1, 3]])),
        PairMatches(0, 2, np.array([[0, 2], [2, 3]])),  # feature 1 of photo 0 and feature 2 meet in photo 2
    ]
    joined = join_matches(features, pairs, 0.4)
    assert joined.n_points == 1
    assert_allclose(joined.image, [0, 1, 2], rtol=0, atol=0)
    assert_allclose(joined.pixel, [[0, 1], [0, 1], [4, 5]], rtol=0, atol=0)


def test_observations_are_sorted_joined_and_thinned():
    made = Observations.gather(
        np.array([7, 3, 7, 3, 9]),
        np.array([1, 0, 0, 2, 1]),
        np.arange(10.0).reshape(5, 2),
        np.ones(5),
        np.full(5, TRACK),
    )
    assert_allclose(made.start, [0, 2, 4, 5], rtol=0, atol=0)
    assert_allclose(made.image, [0, 2, 0, 1, 1], rtol=0, atol=0)
    kept, old = made.keep(np.ones(5, dtype=bool))
    assert_allclose(old, [0, 1], rtol=0, atol=0)
    both = Observations.join([made, kept], [0, 10])
    assert both.n_points == 5
    assert_allclose(both.image[5:], kept.image + 10, rtol=0, atol=0)


def test_blocks_move_to_another_frame_without_changing_what_they_see(case):
    target = replace(rendered.ORIGIN, latitude=48.001, longitude=9.002)
    moved = case.block.moved_to(rendered.ORIGIN, target)
    point = np.array([[3.0, -2.0, 0.5]])
    geodetic = rendered.ORIGIN.to_geodetic(point)
    there = target.to_enu(geodetic[:, 0], geodetic[:, 1], geodetic[:, 2])
    assert_allclose(moved.project(there, 4), case.block.project(point, 4), rtol=0, atol=1e-5)


def test_two_view_error_formula_agrees_with_the_covariance():
    down = np.tile(np.diag([1.0, -1.0, -1.0]), (2, 1, 1))
    position = np.array([[-4.0, 0, 100], [4, 0, 100]])
    block = ImageBlock(
        ("a", "b"), down, position, np.array([[2050.0, 2050, 512, 384, 0, 0, 0, 0, 0]]),
        np.array([[1024, 768]]), np.zeros(2, np.int64), np.zeros(2, np.int64),
    )  # fmt: skip
    pixel = np.concatenate([block.project(np.zeros((1, 3)), i)[:, :2] for i in (0, 1)])
    seen = Observations.gather(np.zeros(2), np.arange(2), pixel, np.full(2, 0.3), np.full(2, TRACK))
    std = np.sqrt(triangulate(block, seen).covariance[0, 2, 2])
    assert_allclose(std, two_view_error(100.0, 8.0, 2050.0, 0.3), rtol=0.01, atol=0)


def test_information_of_a_flight_fits_its_block(case):
    assert case.information.shape == (72, 72)
    assert_allclose(pose_information(case.poses, common_std=0.5), case.information, rtol=0, atol=0)
