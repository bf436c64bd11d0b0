"""NetCDF products pass the CF checker and open with place, time and datum in other software."""

from __future__ import annotations

from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
import rasterio
import xarray as xr
from compliance_checker.suite import CheckSuite
from numpy.testing import assert_allclose, assert_array_equal

from changedetect.crs import is_same_horizontal, is_same_vertical
from changedetect.errors import OutputError
from changedetect.grid import Grid
from changedetect.io.netcdf import (
    CHANGE_LAYERS,
    CLASS_LAYERS,
    SURFACE_LAYERS,
    ChangeMetadata,
    SurfaceMetadata,
    change_dataset,
    surface_dataset,
    write_change,
    write_surface,
)

LEVELLED = "EPSG:32632+5773"
CRSS = [LEVELLED, "EPSG:25832+7837", "EPSG:32632+4979", "EPSG:26917"]
RUN = {
    "programme": "demo",
    "run_id": "20240601T000000Z-1",
    "config_sha256": "ab" * 32,
    "created": "2024-06-01T00:00:00Z",
    "institution": "Survey Department",
    "references": "https://example.org/demo",
}
CHANGE = ChangeMetadata(
    **RUN,
    epoch_earlier="2023-05-01",
    epoch_later="2024-05-01",
    datetime_earlier="2023-05-01",
    datetime_later="2024-05-01T12:00:00+02:00",
    confidence=0.95,
    change_threshold=0.05,
)
SURFACE = SurfaceMetadata(
    **RUN,
    epoch="2024-05-01",
    datetime="2024-05-01T11:00:00Z",
    datetime_first="2024-05-01T10:30:00Z",
    datetime_last="2024-05-01T11:15:00Z",
)


def grid_of(crs=LEVELLED):
    return Grid(13, 17, west=500_000.5, north=4_650_000.0, resolution=0.5, crs=crs)


def change_layers(grid, seed=0):
    rng = np.random.default_rng(seed)
    layers = {name: rng.gamma(2.0, size=grid.shape) for name in CHANGE_LAYERS}
    layers["dod"] -= 2.0
    for name in CLASS_LAYERS:
        layers[name] = rng.choice(np.array([0, 1, 2, 3, 255], np.uint8), size=grid.shape)
    for array in layers.values():
        array[:3, :5] = 255 if array.dtype == np.uint8 else np.nan
    return layers


def surface_layers(grid, seed=0):
    rng = np.random.default_rng(seed)
    layers = {name: rng.gamma(2.0, size=grid.shape) for name in SURFACE_LAYERS}
    for array in layers.values():
        array[:3, :5] = np.nan
    return layers


def cf_complaints(path):
    """Everything the CF 1.11 checker does not accept; it uses the standard name table that it ships."""
    CheckSuite.load_all_available_checkers()
    suite = CheckSuite()
    dataset = suite.load_dataset(str(path))
    results, errors = suite.run_all(dataset, ["cf:1.11"])["cf:1.11"]
    assert not errors
    assert len(results) > 20
    incomplete = [r for r in results if (r.value[0] < r.value[1] if isinstance(r.value, tuple) else not r.value)]
    return [message for result in incomplete for message in result.msgs or [str(result.name)]]


@pytest.mark.parametrize("crs", CRSS)
def test_change_passes_the_cf_checker_without_error_or_warning(tmp_path, crs):
    write_change(tmp_path / "a.nc", change_layers(grid_of(crs)), grid_of(crs), CHANGE)
    assert cf_complaints(tmp_path / "a.nc") == []


@pytest.mark.parametrize("crs", CRSS)
def test_surface_passes_the_cf_checker_without_error_or_warning(tmp_path, crs):
    write_surface(tmp_path / "a.nc", surface_layers(grid_of(crs)), grid_of(crs), SURFACE)
    assert cf_complaints(tmp_path / "a.nc") == []


def test_cf_checker_sees_what_is_wrong(tmp_path):
    write_change(tmp_path / "a.nc", change_layers(grid_of()), grid_of(), CHANGE)
    with netCDF4.Dataset(tmp_path / "a.nc", "a") as file:
        file["x"].units = "no_unit_at_all"
        file["change_class"].flag_meanings = "too few"
        file["dod"].standard_name = "no_such_name"
    complaints = "\n".join(cf_complaints(tmp_path / "a.nc"))
    assert "no_unit_at_all" in complaints
    assert "flag_meanings" in complaints
    assert "no_such_name" in complaints


@pytest.mark.parametrize("crs", CRSS)
def test_gdal_reads_place_and_datum(tmp_path, crs):
    grid = grid_of(crs)
    layers = change_layers(grid)
    write_change(tmp_path / "a.nc", layers, grid, CHANGE)
    with rasterio.open(f"netcdf:{tmp_path}/a.nc:dod") as raster:
        assert tuple(raster.transform)[:6] == grid.transform
        assert raster.xy(0, 0) == (grid.easting[0], grid.northing[0]) == (500_000.75, 4_649_999.75)
        stored = raster.crs.to_wkt(version="WKT2_2019")
        assert is_same_horizontal(stored, crs)
        assert is_same_vertical(stored, crs)
        assert np.isnan(raster.nodata)
        assert_array_equal(raster.read(1), layers["dod"].astype(np.float32))


def test_layers_come_back_with_their_types_and_no_data(tmp_path):
    grid = grid_of()
    layers = change_layers(grid)
    write_change(tmp_path / "a.nc", layers, grid, CHANGE)
    with netCDF4.Dataset(tmp_path / "a.nc") as file:
        file.set_auto_mask(False)
        for name in set(CHANGE_LAYERS) - set(CLASS_LAYERS):
            assert file[name].dtype == np.float32
            assert np.isnan(file[name]._FillValue)
            assert_array_equal(file[name][0], layers[name].astype(np.float32))
        classes = file["change_class"]
        assert classes.dtype == np.int8
        assert classes._FillValue == -1
        assert classes.standard_name == "status_flag"
        assert_array_equal(classes.flag_values, np.array([0, 1, 2, 3], np.int8))
        assert classes.flag_values.dtype == np.int8
        assert classes.flag_meanings == "below_level_of_detection surface_lowered surface_raised not_observed"
        assert_array_equal(classes[0], np.where(layers["change_class"] == 255, -1, layers["change_class"].astype(int)))
        assert not {"_FillValue"} & {key for name in ("x", "y", "x_bnds", "time") for key in file[name].ncattrs()}
        filters = file["dod"].filters()
        assert (filters["zlib"], filters["complevel"], filters["shuffle"]) == (True, 4, True)


def test_large_layers_are_chunked(tmp_path):
    grid = Grid(600, 1100, 0.0, 600.0, 1.0, LEVELLED)
    write_surface(tmp_path / "a.nc", {name: np.zeros(grid.shape) for name in SURFACE_LAYERS}, grid, SURFACE)
    with netCDF4.Dataset(tmp_path / "a.nc") as file:
        assert file["elevation"].chunking() == [1, 512, 512]


def test_bounds_enclose_cells_in_the_order_of_the_coordinate():
    grid = grid_of()
    dataset = change_dataset(change_layers(grid), grid, CHANGE)
    for name, half in (("x", 0.25), ("y", -0.25)):
        centres = dataset[name].values
        assert dataset[name].attrs["bounds"] == f"{name}_bnds"
        assert_allclose(dataset[f"{name}_bnds"], np.column_stack([centres - half, centres + half]), rtol=0, atol=1e-9)
    assert_array_equal(dataset["x_bnds"][1:, 0], dataset["x_bnds"][:-1, 1])
    assert (np.diff(dataset["y"]) < 0).all()


def test_time_of_a_change_is_the_later_epoch_bounded_by_both(tmp_path):
    write_change(tmp_path / "a.nc", change_layers(grid_of()), grid_of(), CHANGE)
    earlier = datetime(2023, 5, 1, tzinfo=UTC).timestamp()
    later = datetime(2024, 5, 1, 10, tzinfo=UTC).timestamp()
    with netCDF4.Dataset(tmp_path / "a.nc") as file:
        assert file["time"][:] == later
        assert file["time_bnds"][:].tolist() == [[earlier, later]]
        assert file.time_coverage_start == "2023-05-01T00:00:00Z"
        assert file.time_coverage_end == "2024-05-01T10:00:00Z"
    with xr.open_dataset(tmp_path / "a.nc") as dataset:
        assert dataset.time.values == [np.datetime64("2024-05-01T10:00")]


def test_time_of_a_surface_is_bounded_by_its_first_and_last_observation():
    dataset = surface_dataset(surface_layers(grid_of()), grid_of(), SURFACE)
    assert_array_equal(dataset["time_bnds"] - dataset["time"], [[-1800.0, 900.0]])
    instant = SurfaceMetadata(**RUN, epoch="a", datetime="2024-05-01")
    dataset = surface_dataset(surface_layers(grid_of()), grid_of(), instant)
    assert_array_equal(dataset["time_bnds"] - dataset["time"], [[0.0, 0.0]])


@pytest.mark.parametrize(
    ("crs", "standard_name"),
    [
        ("EPSG:32632+5773", "surface_altitude"),
        ("EPSG:25832+7837", "surface_height_above_geopotential_datum"),
        ("EPSG:32632+4979", "height_above_reference_ellipsoid"),
        ("EPSG:26917", None),
    ],
)
def test_standard_name_of_elevation_follows_the_vertical_datum(crs, standard_name):
    dataset = surface_dataset(surface_layers(grid_of(crs)), grid_of(crs), SURFACE)
    assert dataset["elevation"].attrs.get("standard_name") == standard_name
    expected = None if standard_name is None else f"{standard_name} standard_error"
    assert dataset["elevation_std"].attrs.get("standard_name") == expected


def test_change_is_described_for_a_reader_who_has_only_the_file():
    dataset = change_dataset(change_layers(grid_of()), grid_of(), CHANGE)
    assert dataset.attrs["Conventions"] == "CF-1.11 ACDD-1.3"
    for key in ("title", "institution", "source", "history", "references", "run_id", "config_sha256"):
        assert dataset.attrs[key]
    assert dataset.attrs["history"].startswith("2024-06-01T00:00:00Z changedetect ")
    assert dataset.attrs["geospatial_bounds_crs"] == "EPSG:32632"
    assert dataset.attrs["vertical_crs"] == "EPSG:5773"
    assert "standard_name" not in dataset["dod"].attrs
    assert set(dataset["dod"].attrs["ancillary_variables"].split()) == set(CHANGE_LAYERS) - {"dod"}
    assert "confidence of 0.95" in dataset["level_of_detection"].attrs["comment"]
    assert "quantile of the standardised change at 0.975" in dataset["level_of_detection"].attrs["comment"]
    assert "exceeds 0.05 m" in dataset["change_probability"].attrs["comment"]
    assert dataset["spatial_ref"].attrs["geopotential_datum_name"] == "EGM96 geoid"
    assert dataset["spatial_ref"].attrs["grid_mapping_name"] == "transverse_mercator"
    for name in CHANGE_LAYERS:
        assert dataset[name].attrs["grid_mapping"] == "spatial_ref"
        assert dataset[name].attrs["cell_methods"] == "area: point"


def test_ages_stay_numbers_when_xarray_decodes_the_file(tmp_path):
    layers = surface_layers(grid_of())
    write_surface(tmp_path / "a.nc", layers, grid_of(), SURFACE)
    with xr.open_dataset(tmp_path / "a.nc") as dataset:
        assert dataset.age_days.dtype == np.float32
        assert_array_equal(dataset.age_days[0], layers["age_days"].astype(np.float32))


def test_same_input_gives_the_same_bytes(tmp_path):
    write_change(tmp_path / "a.nc", change_layers(grid_of()), grid_of(), CHANGE)
    first = (tmp_path / "a.nc").read_bytes()
    write_change(tmp_path / "a.nc", change_layers(grid_of()), grid_of(), CHANGE)
    assert (tmp_path / "a.nc").read_bytes() == first


def test_missing_and_unknown_layers_are_named():
    layers = change_layers(grid_of())
    layers["dodd"] = layers.pop("dod")
    with pytest.raises(ValueError, match=r"missing: \['dod'\], unknown: \['dodd'\]"):
        change_dataset(layers, grid_of(), CHANGE)


def test_layer_of_another_shape_is_refused():
    layers = surface_layers(grid_of()) | {"elevation": np.zeros((17, 13))}
    with pytest.raises(ValueError, match=r"'elevation' has shape \(17, 13\), its grid \(13, 17\)"):
        surface_dataset(layers, grid_of(), SURFACE)


def test_unknown_class_is_refused():
    layers = change_layers(grid_of())
    layers["change_class"][0, 0] = 7
    with pytest.raises(ValueError, match=r"Unknown values in change_class: \[7\]"):
        change_dataset(layers, grid_of(), CHANGE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"datetime_later": "2022-05-01"}, "within its bounds, in order"),
        ({"datetime_earlier": "last spring"}, "Not a time in ISO 8601: 'last spring'"),
    ],
)
def test_impossible_times_are_refused(changes, message):
    meta = ChangeMetadata(
        **RUN,
        **{
            "epoch_earlier": "a",
            "epoch_later": "b",
            "datetime_earlier": "2023-05-01",
            "datetime_later": "2024-05-01",
            "confidence": 0.95,
            **changes,
        },
    )
    with pytest.raises(ValueError, match=message):
        change_dataset(change_layers(grid_of()), grid_of(), meta)


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match=r"Cannot write into .*out"):
        write_surface(tmp_path / "out" / "a.nc", surface_layers(grid_of()), grid_of(), SURFACE)
