"""Control points: they place the flight, name gross errors, and are read from lists."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered
from photogrammetry.test_adjustment import simulated

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.control_points import read_control_points
from changedetect.photogrammetry.adjustment import AdjustmentSettings, adjust
from changedetect.photogrammetry.block import Observations
from changedetect.photogrammetry.control import ControlPoint, apply_control, marked_observations
from changedetect.photogrammetry.covariance import point_uncertainty
from changedetect.photogrammetry.priors import pose_information

PLACES = np.array(
    [[-12.0, -8, 0], [12, -8, 0.5], [-11, 9, 0.2], [12, 8, -0.4], [1, 0, 0.3], [-5, 2, 0.1], [6, -3, 0.0]]
)


def surveyed(true_block, seed=0, n_checks=2):
    """Control points seen in the photos, the last ones as checks."""
    rng = np.random.default_rng(seed)
    control = []
    for k, place in enumerate(PLACES):
        photos, pixel = [], []
        for i in range(len(true_block)):
            seen = true_block.project(place[None], i)
            if true_block.is_inside(seen, i, 5.0)[0]:
                photos.append(true_block.names[i])
                pixel.append(seen[0, :2] + rng.normal(0, 0.3, 2))
        survey = place + rng.normal(0, 0.01, 3)
        is_check = k >= len(PLACES) - n_checks
        control.append(ControlPoint(f"c{k}", survey, np.full(3, 0.01), tuple(photos), np.array(pixel), is_check))
    return control


def adjusted(seed=0, common_std=2.0):
    """Flight with an offset of its own, adjusted with marks; numbers of the control points."""
    block, observations, _, true_block, _ = simulated(seed)
    offset = np.array([1.3, -0.8, 2.1])
    block = replace(block, position=block.position + offset)
    truth = rendered.poses_at(
        true_block.position, true_block.rotation, rendered.layout(5)[2], np.tile(np.eye(6), (15, 1, 1))
    )
    information = pose_information(rendered.perturbed(truth, seed + 1), common_std=common_std)
    control = surveyed(true_block)
    marks = marked_observations(control, block, 0.3)
    given = Observations.join([observations, marks])
    result = adjust(block, given, information, AdjustmentSettings(rounds=2))
    numbers = np.array(
        [int(np.flatnonzero(result.origin == observations.n_points + k)[0]) for k in range(len(control))]
    )
    return result, numbers, control, offset, observations.n_points


def test_control_points_place_the_flight_and_check_points_confirm_it():
    result, numbers, control, offset, _ = adjusted()
    moved, agreement = apply_control(result, numbers, control)
    assert_allclose(agreement.before["c5"], offset, rtol=0, atol=0.6)
    assert agreement.checks == ("c5", "c6")
    for name in agreement.checks:
        assert np.abs(agreement.after[name]).max() < 0.15
    assert agreement.refused == ()
    described = agreement.describe()
    assert max(described["check_rms_m"]) < 0.12
    assert np.sqrt(np.mean(moved.residuals**2)) < 1.05 * np.sqrt(np.mean(result.residuals**2))


def test_the_covariance_shrinks_to_what_the_survey_leaves():
    result, numbers, control, _, n_own = adjusted()
    moved, _ = apply_control(result, numbers, control)
    own = np.flatnonzero(result.origin < n_own)
    before, after = (point_uncertainty(a, own).systematic.covariance for a in (result, moved))
    assert np.sqrt(before[0, 0]) > 1.5
    assert np.sqrt(after[0, 0]) < 0.05
    assert np.linalg.eigvalsh(moved.camera_covariance)[0] > -1e-9


def test_a_gross_error_of_the_survey_is_named_and_left_out():
    result, numbers, control, _, _ = adjusted()
    wrong = [replace(p, position=p.position + np.array([0, 0, 1.0])) if p.name == "c2" else p for p in control]
    _, agreement = apply_control(result, numbers, wrong)
    assert agreement.refused == ("c2",)
    assert np.abs(agreement.after["c5"]).max() < 0.2


def test_a_survey_in_another_frame_is_refused():
    result, numbers, control, _, _ = adjusted()
    rng = np.random.default_rng(3)
    wrong = [replace(p, position=p.position + rng.normal(0, 40, 3)) for p in control]
    with pytest.raises(InputDataError, match="contradict the flight or each other"):
        apply_control(result, numbers, wrong)


def test_marks_in_foreign_or_single_photos_are_refused():
    block = simulated(0)[0]
    point = ControlPoint("a", np.zeros(3), np.ones(3), ("p000.png", "x.png"), np.zeros((2, 2)))
    with pytest.raises(InputDataError, match=r"a is marked in x\.png, which is not a photo"):
        marked_observations([point], block, 0.5)
    with pytest.raises(InputDataError, match=r"marked in 1 photo\(s\); two are needed"):
        marked_observations([replace(point, photos=("p000.png",), pixel=np.zeros((1, 2)))], block, 0.5)


def test_lists_as_opendronemap_takes_them_are_read(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text(
        "WGS84 UTM 32N\n"
        "500010.0 5316300.0 305.5 100.5 200.25 a.jpg gcp01\n"
        "500010.0 5316300.0 305.5 140 180 b.jpg gcp01  # again\n"
        "500000.0 5316310.0 304.0 10 20 a.jpg\n"
    )
    points = read_control_points(path, rendered.ORIGIN)
    assert [p.name for p in points] == ["gcp01", "gcp2"]
    assert points[0].photos == ("a.jpg", "b.jpg")
    assert_allclose(points[0].pixel, [[100.5, 200.25], [140, 180]], rtol=0, atol=0)
    assert_allclose(points[0].position - points[1].position, [10 / 0.9996, -10 / 0.9996, 1.5], rtol=0, atol=0.005)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("EPSG:32632+4979\n", "holds no marks"),
        ("EPSG:32632+4979\n1 2 3 4 5\n", "line 2: 5 fields"),
        ("EPSG:32632+4979\n1 2 x 4 5 a.jpg\n", "line 2: .* not five numbers"),
        ("EPSG:32632+4979\n1 2 nan 4 5 a.jpg\n", "line 2: .* needs its elevation"),
    ],
)
def test_lists_that_cannot_be_read_name_the_line(tmp_path, text, words):
    path = tmp_path / "gcp_list.txt"
    path.write_text(text)
    with pytest.raises(InputDataError, match=words):
        read_control_points(path, rendered.ORIGIN)


def test_a_missing_list_is_named(tmp_path):
    with pytest.raises(MissingInputError, match=r"gcp_list\.txt"):
        read_control_points(tmp_path / "gcp_list.txt", rendered.ORIGIN)
