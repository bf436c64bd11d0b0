"""A grid says where its cells are, and every part of it says the same."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from changedetect.grid import Grid

CRS = "EPSG:32632+5773"

resolutions = st.sampled_from([0.05, 0.1, 0.25, 1 / 3, 0.5, 0.7, 1.0, 2.5, 30.0])
offsets = st.floats(0, 1, exclude_max=True)
counts = st.integers(1, 25)


@st.composite
def grids(draw):
    resolution = draw(resolutions)
    west = (draw(st.integers(100_000, 900_000)) + draw(offsets) * draw(st.booleans())) * resolution
    north = (draw(st.integers(-1_000_000, 9_000_000)) + draw(offsets) * draw(st.booleans())) * resolution
    return Grid(draw(counts), draw(counts), west, north, resolution, CRS)


def test_centres_and_borders_of_a_small_grid():
    grid = Grid(2, 3, west=100.0, north=50.0, resolution=10.0, crs=CRS)
    assert grid.shape == (2, 3)
    assert grid.region == (100.0, 130.0, 30.0, 50.0)
    assert grid.transform == (10.0, 0.0, 100.0, 0.0, -10.0, 50.0)
    assert_array_equal(grid.easting, [105.0, 115.0, 125.0])
    assert_array_equal(grid.northing, [45.0, 35.0])
    easting, northing = grid.coordinates()
    assert_array_equal(easting, [105.0, 115.0, 125.0, 105.0, 115.0, 125.0])
    assert_array_equal(northing, [45.0, 45.0, 45.0, 35.0, 35.0, 35.0])
    assert easting.dtype == northing.dtype == np.float64


@settings(deadline=None)
@given(
    st.floats(-1e6, 1e6),
    st.floats(-1e7, 1e7),
    st.floats(0, 100),
    st.floats(0, 100),
    resolutions,
)
def test_grid_from_region_covers_it_and_no_cell_more(west, south, width, height, resolution):
    region = (west, west + width, south, south + height)
    grid = Grid.from_region(region, resolution, CRS)
    slack = 2e-6 * resolution + 1e-8
    assert grid.west <= region[0] + slack
    assert grid.east >= region[1] - slack
    assert grid.south <= region[2] + slack
    assert grid.north >= region[3] - slack
    assert grid.west > region[0] - resolution - slack
    assert grid.north < region[3] + resolution + slack or height < slack
    for border in (grid.west, grid.north):
        assert_allclose(border / resolution, round(border / resolution), rtol=0, atol=1e-6)


def test_grid_from_a_region_of_whole_cells_is_that_region():
    # 0.3 / 0.1 is 2.9999999999999996 in floating point
    grid = Grid.from_region((500000.3, 500001.2, 4649999.7, 4650000.6), 0.1, CRS)
    assert grid.shape == (9, 9)
    assert_allclose(grid.region, (500000.3, 500001.2, 4649999.7, 4650000.6), rtol=0, atol=1e-9)
    assert Grid.from_region(grid.region, 0.1, CRS) == grid


def test_grid_from_a_point_is_one_cell():
    grid = Grid.from_region((10.0, 10.0, 5.2, 5.2), 0.5, CRS)
    assert grid.shape == (1, 1)
    assert grid.region == (10.0, 10.5, 5.0, 5.5)


@settings(deadline=None)
@given(grids(), st.integers(1, 40))
def test_blocks_tile_the_grid_with_bit_identical_centres(grid, size):
    covered = np.zeros(grid.shape, dtype=int)
    for rows, cols, block in grid.blocks(size):
        covered[rows, cols] += 1
        assert block.shape == covered[rows, cols].shape
        assert max(block.shape) <= size
        assert_array_equal(block.easting, grid.easting[cols])
        assert_array_equal(block.northing, grid.northing[rows])
        assert block.crs == grid.crs
    assert_array_equal(covered, 1)


@settings(deadline=None)
@given(grids(), st.integers(0, 30))
def test_padded_grid_holds_the_same_cells(grid, n):
    padded = grid.pad(n)
    assert padded.shape == (grid.n_rows + 2 * n, grid.n_cols + 2 * n)
    assert_array_equal(padded.easting[n : n + grid.n_cols], grid.easting)
    assert_array_equal(padded.northing[n : n + grid.n_rows], grid.northing)


@settings(deadline=None)
@given(grids())
def test_centres_lie_half_a_cell_inside_the_borders(grid):
    west, east, south, north = grid.region
    half = 0.5 * grid.resolution
    # northings of 2.7e8 m have a spacing of 6e-8 m; offsets are kept to 1e-7 m
    outer = (grid.easting[0] - half, grid.easting[-1] + half, grid.northing[-1] - half, grid.northing[0] + half)
    assert_allclose(outer, (west, east, south, north), rtol=0, atol=2e-7)
    assert_allclose(np.diff(grid.easting), grid.resolution, rtol=0, atol=1e-7)
    assert_allclose(np.diff(grid.northing), -grid.resolution, rtol=0, atol=2e-7)


def test_intersection_is_the_cells_that_share_area():
    grid = Grid(10, 10, west=0.0, north=10.0, resolution=1.0, crs=CRS)
    part = grid.intersection((2.5, 5.0, 3.2, 20.0))
    assert part is not None
    assert part.region == (2.0, 5.0, 3.0, 10.0)
    assert grid.intersection((-5.0, 50.0, -5.0, 50.0)) == grid


@pytest.mark.parametrize("region", [(20.0, 30.0, 0.0, 10.0), (10.0, 12.0, 0.0, 10.0), (0.0, 10.0, -3.0, 0.0)])
def test_regions_beside_the_grid_do_not_intersect(region):
    assert Grid(10, 10, west=0.0, north=10.0, resolution=1.0, crs=CRS).intersection(region) is None


def test_grids_are_values():
    assert Grid(1, 2, 0.0, 1.0, 0.5, CRS) == Grid(1, 2, 0.0, 1.0, 0.5, CRS)
    assert len({Grid(1, 2, 0.0, 1.0, 0.5, CRS), Grid(1, 2, 0.0, 1.0, 0.5, CRS)}) == 1
    with pytest.raises(AttributeError):
        Grid(1, 2, 0.0, 1.0, 0.5, CRS).west = 3.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1, 0.0, 0.0, 1.0), "at least one row and one column; got 0 x 1"),
        ((1, 1, 0.0, 0.0, 0.0), "resolution .* positive and finite.*got 0.0"),
        ((1, 1, 0.0, 0.0, math.nan), "resolution .*got nan"),
        ((1, 1, math.inf, 0.0, 1.0), "corner .*west inf"),
    ],
)
def test_impossible_grids_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Grid(*arguments, CRS)


@pytest.mark.parametrize("region", [(1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, math.nan), (0.0, math.inf, 0.0, 1.0)])
def test_impossible_regions_are_refused(region):
    with pytest.raises(ValueError, match="west <= east"):
        Grid.from_region(region, 1.0, CRS)
    with pytest.raises(ValueError, match="west <= east"):
        Grid(1, 1, 0.0, 0.0, 1.0, CRS).intersection(region)


def test_windows_and_blocks_of_no_cell_are_refused():
    grid = Grid(3, 3, 0.0, 0.0, 1.0, CRS)
    with pytest.raises(ValueError, match="at least one row"):
        grid.window(slice(3, 5), slice(0, 1))
    with pytest.raises(ValueError, match="at least one cell; got size 0"):
        next(grid.blocks(0))
