"""STAC documents: valid by the specification's own schemas, readable by pystac, true to the files."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pystac
import pytest
from pystac.extensions.classification import ClassificationExtension
from pystac.extensions.file import FileExtension
from pystac.extensions.projection import ProjectionExtension
from pystac.validation.local_validator import LocalValidator

from changedetect.crs import is_same_horizontal
from changedetect.grid import Grid
from changedetect.io.netcdf import (
    CHANGE_CLASSES,
    CHANGE_LAYERS,
    CLASS_LAYERS,
    SURFACE_LAYERS,
    ChangeMetadata,
    SurfaceMetadata,
)
from changedetect.io.products import CHANGE_RASTERS, write_change_products, write_epoch_products
from changedetect.io.stac import ItemMetadata, build_catalogue, build_collection, build_item, identifier, utc_time

RUN = {"programme": "North slope", "run_id": "r1", "config_sha256": "ab" * 32, "created": "2024-06-01T00:00:00Z"}
SITE_LOCAL = (
    'PROJCRS["site grid",BASEGEOGCRS["WGS 84",DATUM["World Geodetic System 1984",'
    'ELLIPSOID["WGS 84",6378137,298.257223563]]],CONVERSION["site",METHOD["Transverse Mercator"],'
    'PARAMETER["Latitude of natural origin",47],PARAMETER["Longitude of natural origin",9.1],'
    'PARAMETER["Scale factor at natural origin",1],PARAMETER["False easting",500000],'
    'PARAMETER["False northing",0]],CS[Cartesian,2],AXIS["easting",east],AXIS["northing",north],'
    'LENGTHUNIT["metre",1]]'
)


def grid_of(crs="EPSG:32632+5773"):
    return Grid(40, 60, west=500_000.0, north=5_300_000.0, resolution=0.5, crs=crs)


def metadata(epochs, **changes):
    known = {
        "programme": "North slope",
        "epochs": epochs,
        "datetimes": tuple(f"{epoch}T00:00:00" for epoch in epochs),
        "created": "2024-06-01T10:00:00Z",
        "run_id": "r1",
        "config_sha256": "ab" * 32,
        "software_version": "0.1.0",
        "lineage": "made for a test",
        "derived_from": epochs if len(epochs) == 2 else (),
    }
    return ItemMetadata(**(known | changes))


def write_pair(folder, grid, is_empty=False):
    dod = np.linspace(-1.0, 1.0, grid.n_cols) + np.zeros(grid.shape)
    dod[:10] = np.nan
    dod[:] = np.nan if is_empty else dod
    change = {name: np.where(np.isnan(dod), np.nan, 0.1) for name in CHANGE_LAYERS} | {"dod": dod}
    classes = np.select([np.isnan(dod), dod < -0.1, dod > 0.1], [255, 1, 2], 0).astype(np.uint8)
    change |= dict.fromkeys(CLASS_LAYERS, classes)
    pair = {"epoch_earlier": "2023-05-01", "epoch_later": "2024-05-01", "confidence": 0.95}
    pair |= {"datetime_earlier": "2023-05-01", "datetime_later": "2024-05-01"}
    write_change_products(folder, change, grid, ChangeMetadata(**RUN, **pair))
    return build_item(folder, grid, "dod", metadata(("2023-05-01", "2024-05-01")))


def write_epoch(folder, grid, epoch="2023-05-01"):
    surface = {name: np.full(grid.shape, 1.0) for name in SURFACE_LAYERS}
    write_epoch_products(folder, surface, grid, SurfaceMetadata(**RUN, epoch=epoch, datetime=epoch))
    return build_item(folder, grid, "elevation", metadata((epoch,)))


def complaints(document):
    """What the core schemas of STAC 1.1, which pystac brings along, do not accept."""
    kind = {"Feature": "item", "Collection": "collection", "Catalog": "catalog"}[document["type"]]
    uri = f"https://schemas.stacspec.org/v1.1.0/{kind}-spec/json-schema/{kind}.json"
    return [error.message for error in LocalValidator()._validate_from_local(uri, document)]


@pytest.mark.parametrize("crs", ["EPSG:32632+5773", "EPSG:32632+4979", "EPSG:32632", SITE_LOCAL])
def test_items_pass_the_schemas_whatever_the_crs(tmp_path, crs):
    grid = grid_of(crs)
    for item in (write_pair(tmp_path / "pair", grid), write_epoch(tmp_path / "epoch", grid)):
        assert complaints(item) == []
        json.dumps(item, allow_nan=False)


def test_the_schemas_see_what_is_wrong(tmp_path):
    item = write_epoch(tmp_path / "epoch", grid_of())
    assert complaints(item | {"stac_version": "1.0.0"})
    assert complaints(item | {"properties": item["properties"] | {"datetime": "yesterday"}})
    assert complaints({key: value for key, value in item.items() if key != "assets"})


def test_the_place_of_the_rasters_is_stated_in_the_horizontal_crs(tmp_path):
    item = pystac.Item.from_dict(write_pair(tmp_path / "pair", grid_of()))
    projection = ProjectionExtension.ext(item)
    assert projection.code == "EPSG:32632"
    assert projection.shape == [40, 60]
    assert projection.bbox == [500_000.0, 5_299_980.0, 500_030.0, 5_300_000.0]
    assert projection.transform == [0.5, 0.0, 500_000.0, 0.0, -0.5, 5_300_000.0]
    assert item.properties["changedetect:vertical_crs"] == "EPSG:5773"


def test_a_crs_without_a_code_stands_as_wkt(tmp_path):
    properties = write_epoch(tmp_path / "epoch", grid_of(SITE_LOCAL))["properties"]
    assert properties["proj:code"] is None
    assert is_same_horizontal(properties["proj:wkt2"], SITE_LOCAL)


def test_assets_are_the_files_with_their_checksums(tmp_path):
    found = pystac.Item.from_dict(write_pair(tmp_path / "pair", grid_of()))
    names = {asset.href.removeprefix("./") for asset in found.assets.values()}
    assert names == {path.name for path in (tmp_path / "pair").iterdir()} | {"manifest.json"}
    for key, asset in found.assets.items():
        if key == "manifest":
            continue
        content = (tmp_path / "pair" / asset.href).read_bytes()
        file = FileExtension.ext(asset)
        assert file.size == len(content)
        assert file.checksum == "1220" + hashlib.sha256(content).hexdigest()


def test_media_types_and_roles_say_what_an_asset_is(tmp_path):
    assets = write_pair(tmp_path / "pair", grid_of())["assets"]
    assert {assets[name]["type"] for name in CHANGE_RASTERS} == {str(pystac.MediaType.COG)}
    assert assets["change"]["type"] == "application/netcdf"
    assert assets["dod_style"]["roles"] == ["metadata", "style"]
    assert "data" in assets["dod"]["roles"]


def test_bands_have_the_form_of_version_1_1(tmp_path):
    item = write_pair(tmp_path / "pair", grid_of())
    (band,) = item["assets"]["dod"]["bands"]
    assert (band["name"], band["data_type"], band["nodata"], band["unit"]) == ("dod", "float32", "nan", "m")
    assert band["statistics"]["minimum"] == -1.0
    np.testing.assert_allclose(band["statistics"]["valid_percent"], 75.0, rtol=0, atol=1e-6)
    assert band["raster:spatial_resolution"] == 0.5
    text = json.dumps(item)
    assert "raster:bands" not in text
    assert "eo:bands" not in text
    (classes,) = item["assets"]["change_class"]["bands"]
    assert (classes["data_type"], classes["nodata"]) == ("uint8", 255)
    assert "unit" not in classes


def test_classes_are_described(tmp_path):
    item = pystac.Item.from_dict(write_pair(tmp_path / "pair", grid_of()))
    listed = ClassificationExtension.ext(item.assets["change_class"]).classes
    assert [(c.value, c.name, c.color_hint) for c in listed] == [
        (c.value, c.meaning, "{:02X}{:02X}{:02X}".format(*c.colour[:3])) for c in CHANGE_CLASSES
    ]


def test_a_change_lasts_from_the_earlier_to_the_later_epoch(tmp_path):
    properties = write_pair(tmp_path / "pair", grid_of())["properties"]
    assert properties["datetime"] is None
    bounds = (properties["start_datetime"], properties["end_datetime"])
    assert bounds == ("2023-05-01T00:00:00Z", "2024-05-01T00:00:00Z")
    assert properties["processing:software"] == {"changedetect": "0.1.0"}


def test_products_without_data_have_no_place(tmp_path):
    item = write_pair(tmp_path / "pair", grid_of(), is_empty=True)
    assert item["geometry"] is None
    assert "bbox" not in item
    assert complaints(item) == []


def test_an_item_outside_the_programme_has_no_collection(tmp_path):
    write_epoch(tmp_path / "epoch", grid_of())
    item = build_item(tmp_path / "epoch", grid_of(), "elevation", metadata(("2023-05-01",), is_listed=False))
    assert "collection" not in item
    assert item["links"] == []
    assert complaints(item) == []


def test_a_collection_holds_its_items(tmp_path):
    grid = grid_of()
    items = {
        "2023-05-01": write_epoch(tmp_path / "a", grid),
        "2024-05-01": write_epoch(tmp_path / "b", grid, "2024-05-01"),
        "2023-05-01_2024-05-01": write_pair(tmp_path / "c", grid),
    }
    collection = build_collection("North slope", grid.crs, items)
    assert complaints(collection) == complaints(build_catalogue("North slope")) == []
    assert {item["collection"] for item in items.values()} == {collection["id"]}
    assert collection["extent"]["temporal"]["interval"] == [["2023-05-01T00:00:00Z", "2024-05-01T00:00:00Z"]]
    (west, south, east, north) = collection["extent"]["spatial"]["bbox"][0]
    for item in items.values():
        box = item["bbox"]
        assert west <= box[0] < box[2] <= east
        assert south <= box[1] < box[3] <= north
    links = [link["href"] for link in collection["links"] if link["rel"] == "item"]
    assert links == [f"./{name}/item.json" for name in items]
    assert build_collection("North slope", grid.crs, items) == collection


def test_names_that_files_and_addresses_do_not_take_are_mended():
    assert identifier("Nordhang / Süd", ["2024-05-01"]) == "Nordhang-S-d-2024-05-01"
    assert identifier("///") == "programme"


def test_times_without_offset_are_utc():
    assert utc_time("2024-05-01T14:30:00") == "2024-05-01T14:30:00Z"
    assert utc_time("2024-05-01T14:30:00-05:00") == "2024-05-01T19:30:00Z"
