"""Micro-cell moments: exact, additive, independent of order."""

import naive
import numpy as np
import pytest

from changedetect.kernels import moments as kernel
from changedetect.models.cells import Cells, Evidence, merge_cells

CELL = 0.5


def _points(n=400, seed=0, origin=(500_000.0, 5_300_000.0), height=1234.0):
    rng = np.random.default_rng(seed)
    easting = origin[0] + rng.uniform(0.0, 4.0, n)
    northing = origin[1] + rng.uniform(0.0, 3.0, n)
    elevation = height + 0.2 * (easting - origin[0]) + rng.normal(0.0, 0.1, n)
    return easting, northing, elevation


def _evidence(easting, northing, elevation, sigma=None):
    evidence = Evidence(CELL, is_weighted=sigma is not None)
    evidence.add((easting, northing), elevation, sigma)
    return evidence


def test_moments_equal_sums_over_points():
    easting, northing, elevation = _points()
    cells = _evidence(easting, northing, elevation).cells(0.0)
    for k in range(len(cells)):
        centre = ((cells.column[k] + 0.5) * CELL, (cells.row[k] + 0.5) * CELL)
        inside = (np.floor(easting / CELL) == cells.column[k]) & (np.floor(northing / CELL) == cells.row[k])
        expected = naive.moments(easting[inside], northing[inside], elevation[inside], np.ones(inside.sum()), centre)
        # positions are kept to cell_size / 4096 and elevations to 0.12 mm
        np.testing.assert_allclose(cells.moments[k, :4], expected[:4], rtol=1e-12, atol=inside.sum() * 1.3e-4)
        np.testing.assert_allclose(cells.moments[k, 4:7], expected[4:7], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(cells.moments[k, 7], expected[7], rtol=1e-7, atol=1e-3)
        np.testing.assert_allclose(cells.moments[k, 10], expected[10], rtol=1e-6, atol=1e-2)


def test_scatter_of_elevations_survives_large_elevations():
    easting, northing, elevation = _points(n=200, height=8000.0)
    cells = _evidence(easting, northing, elevation).cells(0.0)
    m = cells.moments
    variance = m[:, 10] / m[:, 1] - (m[:, 7] / m[:, 1]) ** 2
    low = _evidence(easting, northing, elevation - 8000.0).cells(0.0).moments
    expected = low[:, 10] / low[:, 1] - (low[:, 7] / low[:, 1]) ** 2
    np.testing.assert_allclose(variance, expected, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("weighted", [False, True])
def test_order_and_chunks_change_no_bit(weighted):
    easting, northing, elevation = _points(n=1000, seed=3)
    rng = np.random.default_rng(4)
    sigma = rng.uniform(0.02, 2.0, easting.size) if weighted else None
    reference = _evidence(easting, northing, elevation, sigma).cells(1.0)
    for _ in range(3):
        order = rng.permutation(easting.size)
        chunked = Evidence(CELL, is_weighted=weighted)
        for part in np.array_split(order, 7):
            chunked.add((easting[part], northing[part]), elevation[part], None if sigma is None else sigma[part])
        cells = chunked.cells(1.0)
        np.testing.assert_array_equal(cells.row, reference.row)
        np.testing.assert_array_equal(cells.moments, reference.moments)


def test_weights_are_one_over_variance():
    sigma = np.array([0.05, 0.1, 1.0, 4.0])
    weight = kernel.integer_weights(sigma) * kernel.WEIGHT_UNIT
    np.testing.assert_allclose(weight, 1.0 / sigma**2, rtol=0.01, atol=0.0)
    assert kernel.integer_weights(np.array([100.0]))[0] == 1


def test_coarser_cells_hold_the_same_sums():
    easting, northing, elevation = _points(seed=5)
    fine = _evidence(easting, northing, elevation).cells(2.0)
    coarse = fine.coarsened()
    expected = Evidence(2 * CELL, is_weighted=False)
    expected.add((easting, northing), elevation, None)
    expected = expected.cells(2.0)
    np.testing.assert_array_equal(coarse.row, expected.row)
    np.testing.assert_array_equal(coarse.moments[:, 0], expected.moments[:, 0])
    # the two quantise positions to different units
    np.testing.assert_allclose(coarse.moments[:, 7], expected.moments[:, 7], rtol=1e-12, atol=1e-6)
    np.testing.assert_allclose(coarse.moments[:, 2], expected.moments[:, 2], rtol=0.0, atol=5e-3)


def test_a_plane_is_taken_off_exactly():
    rng = np.random.default_rng(6)
    easting, northing = rng.uniform(0.0, 4.0, (2, 500))
    elevation = 3.0 + 0.25 * easting - 0.5 * northing
    cells = _evidence(easting, northing, elevation).cells(0.0)
    x, y = cells.places
    surface = np.column_stack([3.0 + 0.25 * x - 0.5 * y, np.full_like(x, 0.25), np.full_like(x, -0.5)])
    residual = cells.with_surface_removed(surface).moments
    # what is left is the quantisation of the positions and elevations
    assert np.abs(residual[:, 7] / residual[:, 1]).max() < 2e-4
    assert (residual[:, 10] / residual[:, 1]).max() < 1e-7


def test_merging_with_a_coarser_lattice_keeps_every_sum():
    easting, northing, elevation = _points(seed=8)
    fine = _evidence(easting, northing, elevation).cells(0.0)
    coarse = fine.coarsened()
    merged = merge_cells([fine, coarse])
    assert merged.cell_size == CELL
    np.testing.assert_allclose(merged.moments[:, 0].sum(), 2.0 * easting.size, rtol=0.0, atol=0.0)
    total = np.sum(merged.moments[:, 2] + merged.centres[0] * merged.moments[:, 1])
    expected = np.sum(fine.moments[:, 2] + fine.centres[0] * fine.moments[:, 1])
    np.testing.assert_allclose(total, 2.0 * expected, rtol=1e-12, atol=0.0)


def test_a_window_holds_the_cells_it_covers_and_no_others():
    easting, northing, elevation = _points(seed=9)
    cells = _evidence(easting, northing, elevation).cells(0.0)
    row0, column0 = int(cells.row.min()) + 1, int(cells.column.min()) + 2
    window = cells.window(CELL, (row0, row0 + 3), (column0, column0 + 2))
    inside = (cells.row >= row0) & (cells.row < row0 + 3) & (cells.column >= column0) & (cells.column < column0 + 2)
    assert window[..., 0].sum() == cells.moments[inside, 0].sum()
    np.testing.assert_array_equal(window[0, 0], cells.moments[(cells.row == row0) & (cells.column == column0)][0])


def test_counting_sort_is_stable():
    key = np.array([2, 0, 2, 1, 0, 2])
    order, start = kernel.count_sort(key, 3)
    np.testing.assert_array_equal(order, [1, 4, 3, 0, 2, 5])
    np.testing.assert_array_equal(start, [0, 2, 3, 6])


def test_cells_know_their_region():
    cells = Cells(2.0, np.array([3, 4]), np.array([-1, 5]), np.ones((2, kernel.N_MOMENTS)))
    assert cells.region == (-2.0, 12.0, 6.0, 10.0)
