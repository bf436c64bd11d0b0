"""Zones: read in any CRS, refused with a name and a fix where they cannot be used."""

import json

import numpy as np
import pytest
import shapely
from small_surveys import write_zones

from changedetect.errors import CRSMismatchError, InputDataError, MissingInputError
from changedetect.grid import Grid
from changedetect.io.zones import covered_cells, read_zones

CRS = "EPSG:32632+5773"
SQUARE = shapely.box(500_010.0, 5_300_010.0, 500_030.0, 5_300_020.0)


def test_polygons_come_with_their_names(tmp_path):
    hole = shapely.Polygon(SQUARE.exterior, [shapely.box(500_012, 5_300_012, 500_014, 5_300_014).exterior.coords])
    both = shapely.MultiPolygon([SQUARE, shapely.transform(SQUARE, lambda v: v + np.array([100.0, 0.0]))])
    zones = read_zones(write_zones(tmp_path / "z.gpkg", [hole, both], ["beach", "dune"]), CRS)
    assert [zone.name for zone in zones] == ["beach", "dune"]
    np.testing.assert_allclose(zones[0].polygon.area, 196.0, rtol=1e-9, atol=0.0)


def test_zones_in_another_crs_land_where_they_belong(tmp_path):
    from pyproj import Transformer

    back = Transformer.from_crs(32632, 25833, always_xy=True)
    moved = shapely.transform(SQUARE, lambda v: np.column_stack(back.transform(v[:, 0], v[:, 1])))
    zone = read_zones(write_zones(tmp_path / "z.gpkg", [moved], crs="EPSG:25833"), CRS)[0]
    np.testing.assert_allclose(zone.polygon.bounds, SQUARE.bounds, rtol=0.0, atol=1.0)


def test_geojson_is_longitude_and_latitude(tmp_path):
    from pyproj import Transformer

    back = Transformer.from_crs(32632, 4326, always_xy=True)
    degrees = shapely.transform(SQUARE, lambda v: np.column_stack(back.transform(v[:, 0], v[:, 1])))
    feature = {"type": "Feature", "properties": {"id": 7}, "geometry": json.loads(shapely.to_geojson(degrees))}
    (tmp_path / "z.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    zone = read_zones(tmp_path / "z.geojson", CRS)[0]
    assert zone.name == "7"
    np.testing.assert_allclose(zone.polygon.bounds, SQUARE.bounds, rtol=0.0, atol=0.01)


def test_names_that_are_missing_or_occur_twice_get_numbers(tmp_path):
    zones = read_zones(write_zones(tmp_path / "z.gpkg", [SQUARE] * 4, ["a", "b", "b", ""]), CRS)
    assert [zone.name for zone in zones] == ["a", "b 2", "b 3", "4"]
    again = read_zones(write_zones(tmp_path / "again.gpkg", [SQUARE] * 4, ["a", "a", "a 2", "1"]), CRS)
    assert [zone.name for zone in again] == ["a 1", "a 6", "a 2", "1"]


def test_a_column_of_names_can_be_chosen(tmp_path):
    path = write_zones(tmp_path / "z.gpkg", [SQUARE], ["cell 9"], column="compartment")
    assert read_zones(path, CRS)[0].name == "1"
    assert read_zones(path, CRS, name_column="compartment")[0].name == "cell 9"
    with pytest.raises(InputDataError, match="no column 'nam'; it has compartment"):
        read_zones(path, CRS, name_column="nam")


BOWTIE = shapely.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)])


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        (BOWTIE, r"feature 2 \('zone 1'\) is not a valid polygon: Self-intersection.*Fix geometries"),
        (shapely.Polygon(), r"feature 2 \('zone 1'\) has no geometry"),
        (None, r"feature 2 \('zone 1'\) has no geometry"),
        (shapely.LineString([(0, 0), (1, 1)]), r"feature 2 \('zone 1'\) is a LineString; zones are polygons"),
    ],
)
def test_a_feature_that_is_no_area_is_named(tmp_path, geometry, message):
    path = write_zones(tmp_path / "z.gpkg", [SQUARE, geometry])
    with pytest.raises(InputDataError, match=message):
        read_zones(path, CRS)


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
def test_files_that_cannot_be_used_say_why(tmp_path):
    with pytest.raises(MissingInputError, match="does not exist"):
        read_zones(tmp_path / "none.gpkg", CRS)
    (tmp_path / "text.gpkg").write_text("no database")
    with pytest.raises(InputDataError, match="cannot be read as a vector file"):
        read_zones(tmp_path / "text.gpkg", CRS)
    with pytest.raises(InputDataError, match="holds no features"):
        read_zones(write_zones(tmp_path / "empty.gpkg", []), CRS)
    with pytest.raises(CRSMismatchError, match="states no coordinate reference system"):
        read_zones(write_zones(tmp_path / "nowhere.gpkg", [SQUARE], crs=None), CRS)


def test_of_several_layers_one_must_be_named(tmp_path):
    path = write_zones(tmp_path / "z.gpkg", [SQUARE], layer="one")
    write_zones(path, [SQUARE, SQUARE], layer="two", append=True)
    with pytest.raises(InputDataError, match=r"2 layers \(one, two\)"):
        read_zones(path, CRS)
    assert len(read_zones(path, CRS, layer="two")) == 2
    with pytest.raises(InputDataError, match="no layer 'three'; it has one, two"):
        read_zones(path, CRS, layer="three")


def test_cells_count_where_their_centres_lie_in_the_polygon():
    grid = Grid.from_region((500_000.0, 500_050.0, 5_300_000.0, 5_300_040.0), 2.0, CRS)
    window, inside = covered_cells(shapely.box(500_009.5, 5_300_010.5, 500_031.5, 5_300_017.5), grid)
    whole = np.zeros(grid.shape, bool)
    whole[window] = inside
    easting, northing = grid.coordinates()
    expected = (easting > 500_009.5) & (easting < 500_031.5) & (northing > 5_300_010.5) & (northing < 5_300_017.5)
    np.testing.assert_array_equal(whole.ravel(), expected)


def test_a_polygon_beside_the_grid_covers_nothing():
    grid = Grid.from_region((500_000.0, 500_050.0, 5_300_000.0, 5_300_040.0), 2.0, CRS)
    assert covered_cells(shapely.box(600_000.0, 0.0, 600_001.0, 1.0), grid) is None


def test_what_cannot_be_reached_from_the_zones_crs_is_said_of_the_file_without_options_of_other_commands(tmp_path):
    path = write_zones(tmp_path / "z.gpkg", [SQUARE], crs="IAU_2015:30100", layer="moon")
    with pytest.raises(CRSMismatchError, match=r"z\.gpkg', layer 'moon': .*Save Features As") as caught:
        read_zones(path, CRS)
    assert "--crs" not in str(caught.value)


def test_metres_in_a_geojson_are_told_with_the_feature(tmp_path):
    feature = {"type": "Feature", "properties": {"name": "slip"}, "geometry": json.loads(shapely.to_geojson(SQUARE))}
    (tmp_path / "z.geojson").write_text(json.dumps(feature))
    with pytest.raises(CRSMismatchError, match=r"feature 1 \('slip'\).*GeoJSON is in longitude and latitude") as caught:
        read_zones(tmp_path / "z.geojson", CRS)
    assert "--crs" not in str(caught.value)


@pytest.mark.filterwarnings("ignore:Non closed ring")
def test_a_ring_that_does_not_close_is_named(tmp_path):
    ring = [[9.0, 48.0], [9.1, 48.0], [9.1, 48.1]]
    geometry = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "properties": {"name": "slip"}, "geometry": geometry}
    (tmp_path / "z.geojson").write_text(json.dumps(feature))
    with pytest.raises(InputDataError, match=r"feature 1 \('slip'\).*Fix geometries"):
        read_zones(tmp_path / "z.geojson", CRS)
