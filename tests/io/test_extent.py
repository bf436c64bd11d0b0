"""Footprints in longitude and latitude: hold the data, keep GeoJSON's rules, everywhere on Earth."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from changedetect.crs import to_longitude_latitude
from changedetect.grid import Grid
from changedetect.io.extent import data_extent, join_boxes

PLACES = {
    "levelled heights": ("EPSG:32632+5773", 500_000.0, 5_300_000.0),
    "ellipsoidal heights": ("EPSG:32632+4979", 500_000.0, 5_300_000.0),
    "another datum": ("EPSG:31467", 3_500_000.0, 5_400_000.0),
    "southern": ("EPSG:32755", 600_000.0, 6_100_000.0),
    "axes north first": ("EPSG:2193", 1_600_000.0, 5_400_000.0),
    "polar": ("EPSG:3031", -1_000_000.0, 1_000_000.0),
    "antimeridian": ("EPSG:32601", 166_000.0, 100_000.0),
}


def grid_at(place, shape=(80, 120), resolution=5.0):
    crs, easting, northing = PLACES[place]
    north = northing + 0.5 * shape[0] * resolution
    return Grid(*shape, west=easting - 0.5 * shape[1] * resolution, north=north, resolution=resolution, crs=crs)


def l_shape(grid):
    valid = np.ones(grid.shape, bool)
    valid[: grid.n_rows // 2, : grid.n_cols // 2] = False
    return valid


def polygons(geometry):
    found = shapely.geometry.shape(geometry)
    return list(shapely.get_parts(found))


@pytest.mark.parametrize("place", PLACES)
def test_every_valid_cell_lies_in_the_footprint_and_hardly_more(place):
    grid = grid_at(place)
    valid = l_shape(grid)
    extent = data_extent(valid, grid)
    longitude, latitude = to_longitude_latitude(grid.crs, *grid.coordinates())
    inside = np.zeros(longitude.size, bool)
    for part in polygons(extent.geometry):
        assert part.is_valid
        inside |= shapely.contains_xy(part, longitude, latitude)
    inside = inside.reshape(grid.shape)
    assert inside[valid].all()
    assert inside[~valid].mean() < 0.05
    west, south, east, north = extent.bbox
    assert south <= latitude[valid.ravel()].min()
    assert latitude[valid.ravel()].max() <= north
    assert (west > east) == (place == "antimeridian")


def test_rings_turn_as_geojson_wants_and_longitudes_stay_in_range():
    grid = grid_at("antimeridian")
    extent = data_extent(np.ones(grid.shape, bool), grid)
    assert extent.geometry["type"] == "MultiPolygon"
    for part in polygons(extent.geometry):
        assert part.exterior.is_ccw
        assert -180.0 <= part.bounds[0] < part.bounds[2] <= 180.0
        assert part.bounds[2] - part.bounds[0] < 1.0
    west, _, east, _ = extent.bbox
    assert 179.0 < west < 180.0
    assert -180.0 < east < -179.0


def test_a_site_over_the_pole_reaches_all_longitudes():
    grid = Grid(60, 60, west=-3000.0, north=3000.0, resolution=100.0, crs="EPSG:3031")
    extent = data_extent(np.ones(grid.shape, bool), grid)
    assert extent.bbox[:3] == (-180.0, -90.0, 180.0)
    assert -90.0 < extent.bbox[3] < -89.9


def test_specks_and_ragged_edges_keep_the_footprint_small():
    rng = np.random.default_rng(3)
    grid = grid_at("levelled heights", (700, 900), 1.0)
    row, column = np.indices(grid.shape)
    valid = (row - 350) ** 2 / 300**2 + (column - 450) ** 2 / 400**2 < 1.0 + 0.1 * rng.normal(size=grid.shape)
    extent = data_extent(valid, grid)
    assert shapely.get_num_coordinates(shapely.geometry.shape(extent.geometry)) < 700
    longitude, latitude = to_longitude_latitude(grid.crs, *grid.coordinates())
    part = shapely.geometry.shape(extent.geometry)
    assert shapely.contains_xy(part, longitude, latitude)[valid.ravel()].all()


def test_nothing_valid_is_nowhere():
    grid = grid_at("levelled heights")
    extent = data_extent(np.zeros(grid.shape, bool), grid)
    assert (extent.geometry, extent.bbox) == (None, None)


def test_one_cell_is_a_polygon():
    grid = grid_at("levelled heights", resolution=0.25)
    valid = np.zeros(grid.shape, bool)
    valid[40, 60] = True
    (part,) = polygons(data_extent(valid, grid).geometry)
    assert part.is_valid
    assert part.area > 0.0


def test_boxes_join_on_the_shorter_side_of_the_earth():
    assert join_boxes([]) is None
    assert join_boxes([(170.0, -5.0, 175.0, 0.0), (-175.0, -4.0, -170.0, 3.0)]) == (170.0, -5.0, -170.0, 3.0)
    assert join_boxes([(179.0, 0.0, -179.0, 1.0), (178.0, 0.0, 178.5, 2.0)]) == (178.0, 0.0, -179.0, 2.0)
    assert join_boxes([(-180.0, -90.0, 180.0, -80.0), (10.0, -85.0, 11.0, -79.0)]) == (-180.0, -90.0, 180.0, -79.0)
