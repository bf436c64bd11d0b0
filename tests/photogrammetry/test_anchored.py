"""A flight adjusted to an earlier one that stays as it was published."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered

from changedetect.errors import InputDataError
from changedetect.navigation.frame import LocalFrame
from changedetect.photogrammetry.anchored import Anchor, FinishedFlight, orient_to_anchors
from changedetect.photogrammetry.common_error import common_error, error_factor, point_modes
from changedetect.photogrammetry.joint import JointSettings, SharedPoints, unchanged
from changedetect.pipeline.flight_store import load_finished, save_finished


def anchor_of(case, name="first"):
    return Anchor(name, FinishedFlight(case.oriented.adjustment, rendered.ORIGIN), case.features, case.matching.pairs)


def flight_of(case):
    return case.block, case.information, case.features, case.matching, case.oriented


@pytest.fixture(scope="module")
def anchored(case, later_case):
    return orient_to_anchors(flight_of(later_case), [anchor_of(case)], "second", rendered.ORIGIN, 1.0, case.settings)


def pose_error(adjustment, case):
    """Mean error of the camera positions, ENU, m."""
    return (adjustment.block.position - case.true_block.position).mean(axis=0)


def test_the_new_flight_takes_over_the_error_of_the_published_one(case, later_case, anchored):
    published = pose_error(case.oriented.adjustment, case)
    alone = pose_error(later_case.oriented.adjustment, later_case)
    bound = pose_error(anchored.finished.adjustment, later_case)
    assert np.linalg.norm(alone - published) > 5 * np.linalg.norm(bound - published)
    std = np.sqrt(np.diag(anchored.differences["first"].covariance))
    assert abs(bound[2] - published[2]) < 4 * std[0] + 0.03
    assert anchored.n_shared["first"] > 60


def test_heights_agree_but_for_the_mound(case, anchored):
    def error(adjustment, ground):
        at = adjustment.points
        return at[:, 2] - ground(at[:, 0], at[:, 1])

    first = error(case.oriented.adjustment, rendered.hills)
    second = error(anchored.finished.adjustment, rendered.raised_hills)
    assert_allclose(np.median(second), np.median(first), rtol=0, atol=0.06)
    at = anchored.finished.adjustment.points
    on_mound = rendered.mound(at[:, 0], at[:, 1]) > 0.25
    assert on_mound.sum() >= 5
    assert_allclose(np.median(second[on_mound]), np.median(second), rtol=0, atol=0.08)


def test_what_both_flights_share_is_known_better_than_either(case, anchored):
    def offset_std(adjustment):
        factor = error_factor(adjustment.camera_covariance)
        whole = common_error(point_modes(adjustment, np.arange(len(adjustment.points)), factor))
        return np.sqrt(np.diag(whole.covariance))

    published, bound = (offset_std(a) for a in (case.oriented.adjustment, anchored.finished.adjustment))
    between = np.sqrt(np.diag(anchored.differences["first"].covariance))
    assert between[0] < 0.3 * bound[0]
    assert np.all(between[3:5] < 0.3 * bound[3:5])
    assert_allclose(bound[0], published[0], rtol=0.2, atol=0)  # it cannot know its place better than what holds it


def test_covariances_with_the_held_flight_are_consistent(case, anchored):
    finished = anchored.finished
    held = case.oriented.adjustment.camera_covariance
    cross = finished.cross["first"]
    assert cross.shape == (len(finished.adjustment.camera_covariance), len(held))
    joint = np.block([[finished.adjustment.camera_covariance, cross], [cross.T, held]])
    std = np.sqrt(np.maximum(np.diag(joint), 1e-300))
    assert np.linalg.eigvalsh(joint / np.outer(std, std))[0] > -1e-6


def test_a_finished_flight_in_another_frame_and_back_is_the_same(anchored):
    other = LocalFrame(48.01, 9.02, 310.0)
    back = anchored.finished.in_frame(other).in_frame(rendered.ORIGIN)
    a, b = anchored.finished.adjustment, back.adjustment
    assert_allclose(b.points, a.points, rtol=0, atol=1e-6)
    assert_allclose(b.block.position, a.block.position, rtol=0, atol=1e-6)
    assert_allclose(b.camera_covariance, a.camera_covariance, rtol=0, atol=1e-9)
    assert_allclose(back.cross["first"], anchored.finished.cross["first"], rtol=0, atol=1e-9)


def test_flights_without_common_ground_are_refused(case, later_case):
    far = anchor_of(case)
    block = case.oriented.adjustment.block
    moved = replace(
        case.oriented.adjustment, block=replace(block, position=block.position + np.array([500.0, 0.0, 0.0]))
    )
    far = replace(far, finished=FinishedFlight(moved, rendered.ORIGIN))
    with pytest.raises(InputDataError, match=r"Flight second shares too few ground points .*first: 0.* at least 30"):
        orient_to_anchors(flight_of(later_case), [far], "second", rendered.ORIGIN, 1.0, case.settings)


@pytest.mark.parametrize(("change", "radius"), [(0.6, 5.0), (-0.3, 6.0)])
def test_ground_that_moved_is_kept_out_of_the_points_that_bind(change, radius):
    """Changes of a few standard errors of one point are found by neighbours, though these share distortions."""
    rng = np.random.default_rng(0)
    n, std = 4000, 0.06
    place = np.column_stack([rng.uniform(-40, 40, (n, 2)), np.zeros(n)])
    common = 0.02 * np.sin(place[:, 0] / 3.0)  # what neighbours share
    difference = rng.normal(0.0, [0.02, 0.02, std], (n, 3))
    difference[:, 2] += common
    has_moved = np.hypot(place[:, 0] - 10, place[:, 1] + 5) < radius
    difference[has_moved, 2] += change
    covariance = np.tile(np.diag([0.02**2, 0.02**2, std**2]), (n, 1, 1))
    keep = unchanged(SharedPoints(np.arange(n), place, difference, covariance), JointSettings())
    assert keep[has_moved].mean() < 0.05
    away = np.hypot(place[:, 0] - 10, place[:, 1] + 5) > radius + 7
    assert keep[away].mean() > 0.97


def test_a_flight_written_with_five_lens_parameters_is_read_with_the_others_exact(anchored, tmp_path):
    flight = anchored.finished
    save_finished(tmp_path / "now.npz", flight)
    with np.load(tmp_path / "now.npz") as stored:
        arrays = {name: stored[name] for name in stored.files}
    n = 6 * len(flight.adjustment.block)
    arrays["camera_covariance"] = arrays["camera_covariance"][: n + 5, : n + 5]
    for name in ("lens_correction", "lens_std"):
        arrays[name] = arrays[name][:, :5]
    for k, other in enumerate(flight.cross):
        arrays[f"cross_{k}"] = flight.cross[other][: n + 5, : flight.cross[other].shape[1] - 4]
    del arrays["lens_slope"]
    np.savez(tmp_path / "before.npz", **arrays)
    read = load_finished(tmp_path / "before.npz")
    expected = flight.adjustment.camera_covariance.copy()
    expected[n + 5 :], expected[:, n + 5 :] = 0.0, 0.0
    assert_allclose(read.adjustment.camera_covariance, expected, rtol=0, atol=0)
    assert read.adjustment.lens_std.shape == (1, 9)
    assert not read.adjustment.lens_slope.any()
    assert [c.shape for c in read.cross.values()] == [c.shape for c in flight.cross.values()]
    again = read.in_frame(LocalFrame(flight.origin.latitude, flight.origin.longitude, flight.origin.height + 1.0))
    assert_allclose(np.trace(again.adjustment.camera_covariance), np.trace(expected), rtol=1e-9, atol=0)
