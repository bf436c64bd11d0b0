"""Dense heights on rendered ground."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered

from changedetect.errors import InputDataError
from changedetect.kernels.dense import cell_maps
from changedetect.photogrammetry.dense import DenseSettings, dense_points

SETTINGS = DenseSettings(tile=12.0)
GSD = rendered.HEIGHT / rendered.CAMERA.fx


@pytest.fixture(scope="module")
def dense(case):
    sparse = case.oriented.adjustment.points
    middle = sparse[(np.abs(sparse[:, 0]) < 7) & (np.abs(sparse[:, 1]) < 6)]
    return dense_points(case.flown, case.oriented.adjustment.block, middle, 0.1, GSD, SETTINGS), middle


def test_every_cell_gets_a_height_near_the_truth(dense):
    found, sparse = dense
    area = np.ptp(sparse[:, 0]) * np.ptp(sparse[:, 1])
    assert len(found.points) > 0.75 * area / found.cell**2  # the hull of the points is smaller than their rectangle
    error = found.points[:, 2] - rendered.hills(found.points[:, 0], found.points[:, 1])
    error -= np.median(error)
    assert 1.4826 * np.median(np.abs(error)) < 0.06
    assert np.percentile(np.abs(error), 99) < 0.3


def test_standard_deviations_are_of_the_size_of_the_errors(dense):
    found, _ = dense
    error = found.points[:, 2] - rendered.hills(found.points[:, 0], found.points[:, 1])
    ratio = 1.4826 * np.median(np.abs(error - np.median(error))) / np.median(found.sigma)
    assert 0.3 < ratio < 2.0
    assert found.n_views.min() >= SETTINGS.min_views


def test_cells_lie_on_one_lattice_whatever_the_tiles(case, dense):
    found, sparse = dense
    other = dense_points(
        case.flown, case.oriented.adjustment.block, sparse, 0.1, GSD, DenseSettings(tile=7.0), workers=1
    )
    for axis in (0, 1):
        off = other.points[:, axis] / other.cell - 0.5
        assert_allclose(off, np.rint(off), rtol=0, atol=1e-6)
    cells = [{tuple(c) for c in np.floor(d.points[:, :2] / d.cell).astype(int)} for d in (found, other)]
    assert len(cells[0] & cells[1]) > 0.97 * len(cells[0] | cells[1])


def test_a_wrong_start_within_a_few_decimetres_is_corrected(case, dense):
    found, sparse = dense
    bumped = sparse + np.column_stack([np.zeros((len(sparse), 2)), 0.25 * np.sin(sparse[:, 0])])
    other = dense_points(case.flown, case.oriented.adjustment.block, bumped, 0.1, GSD, SETTINGS)
    error = other.points[:, 2] - rendered.hills(other.points[:, 0], other.points[:, 1])
    assert 1.4826 * np.median(np.abs(error - np.median(error))) < 0.08
    assert len(found.points) > 0


def test_ground_without_pattern_is_refused(case):
    sparse = case.oriented.adjustment.points
    flat = np.full((240, 320), 100, np.uint8)
    few = DenseSettings(tile=40.0, spacing=4.0)
    with pytest.raises(InputDataError, match=r"No ground cell of .* could be matched"):
        dense_points(lambda _: flat, case.oriented.adjustment.block, sparse, 0.1, GSD, few)


def test_maps_give_the_place_and_its_derivative_by_height(case):
    block = case.oriented.adjustment.block
    east, north, height = np.array([0.0, 0.3]), np.array([-0.2, 0.1, 0.4]), np.zeros((3, 2))
    height[2, 1] = np.nan
    place, rise = cell_maps(east, north, height, block.rotation[1], block.position[1], block.lens_of(1), 320, 240, 0.01)
    expected = block.project(np.array([[0.3, 0.1, 0.0], [0.3, 0.1, 0.01]]), 1)[:, :2]
    assert_allclose(place[:, 1, 1], expected[0], rtol=0, atol=1e-3)
    assert_allclose(rise[:, 1, 1], (expected[1] - expected[0]) / 0.01, rtol=1e-3, atol=1e-3)
    assert place[0, 2, 1] < -1e5
