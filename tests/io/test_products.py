"""Product folders: complete, consistent, replaced as a whole or not at all."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import textwrap
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal
from rio_cogeo.cogeo import cog_validate

from changedetect.errors import OutputError
from changedetect.grid import Grid
from changedetect.io.cog import read_cog
from changedetect.io.netcdf import CHANGE_LAYERS, CLASS_LAYERS, SURFACE_LAYERS
from changedetect.io.products import (
    CHANGE_RASTERS,
    SURFACE_RASTERS,
    ChangeMetadata,
    SurfaceMetadata,
    write_change_products,
    write_epoch_products,
)
from changedetect.storage import clear_leftovers

GRID = Grid(60, 80, west=500_000.0, north=4_650_000.0, resolution=0.5, crs="EPSG:32632+5773")
RUN = {"programme": "demo", "run_id": "r1", "config_sha256": "ab" * 32, "created": "2024-06-01T00:00:00Z"}
PAIR = {
    "epoch_earlier": "2023-05-01",
    "epoch_later": "2024-05-01",
    "datetime_earlier": "2023-05-01",
    "datetime_later": "2024-05-01",
    "confidence": 0.95,
}


def change_of(grid=GRID, shift=0.0, level_of_detection=0.1):
    """Made by one formula, so that layers agree with each other: a ramp of change between two steps."""
    dod = np.broadcast_to(np.linspace(-1.0, 1.0, grid.n_cols), grid.shape) + shift
    dod[: grid.n_rows // 4] = np.nan
    std = np.where(np.isnan(dod), np.nan, level_of_detection / 1.96)
    classes = np.select([np.isnan(dod), dod < -level_of_detection, dod > level_of_detection], [255, 1, 2], 0)
    return {
        "dod": dod,
        "dod_std": std,
        "level_of_detection": 1.96 * std,
        "change_probability": np.clip(np.abs(dod), 0, 1),
        "change_class": classes.astype(np.uint8),
        "z_score": dod / std,
        "correlated_error": np.zeros(grid.shape),
        "n_observations_earlier": np.full(grid.shape, 5.0),
        "n_observations_later": np.full(grid.shape, 7.5),
        "resolution": np.where(np.isnan(dod), np.nan, 3.0),
        "unresolved_std": np.where(np.isnan(dod), np.nan, 0.2),
        "resolution_class": np.where(np.isnan(dod), 255, 1).astype(np.uint8),
    }


def surface_of(grid=GRID):
    surface = {name: np.full(grid.shape, 0.1) for name in SURFACE_LAYERS}
    surface["elevation"] = 100 + np.add.outer(np.arange(grid.n_rows), np.arange(grid.n_cols)) * 0.01
    surface["age_days"] = np.zeros(grid.shape)
    for array in surface.values():
        array[-5:] = np.nan
    return surface


def write_pair(directory, change=None, add_files=None, **meta):
    change = change_of() if change is None else change
    return write_change_products(directory, change, GRID, ChangeMetadata(**(RUN | PAIR | meta)), add_files=add_files)


def write_epoch(directory, add_files=None):
    meta = SurfaceMetadata(**RUN, epoch="2024-05-01", datetime="2024-05-01")
    return write_epoch_products(directory, surface_of(), GRID, meta, add_files=add_files)


def dod_stops(directory):
    items = ET.parse(directory / "dod.qml").getroot().iter("item")
    return [float(item.get("value")) for item in items]


def colours_beyond(directory, value):
    """Colours of the stops of the change that lie further from zero than a value."""
    items = ET.parse(directory / "dod.qml").getroot().iter("item")
    return [item.get("color") for item in items if abs(float(item.get("value"))) > value]


def test_pair_has_every_product_with_its_checksum(tmp_path):
    files = write_pair(tmp_path / "pair")
    expected = {"change.nc", "dod_significant.vrt", "dod_significant.qml"}
    expected |= {f"{name}.{suffix}" for name in CHANGE_RASTERS for suffix in ("tif", "qml")}
    assert {file.name for file in files} == {p.name for p in (tmp_path / "pair").iterdir()} == expected
    for file in files:
        content = (tmp_path / "pair" / file.name).read_bytes()
        assert (file.n_bytes, file.sha256) == (len(content), hashlib.sha256(content).hexdigest())


def test_epoch_has_every_product(tmp_path):
    files = write_epoch(tmp_path / "epoch")
    expected = {"surface.nc"} | {f"{name}.{suffix}" for name in SURFACE_RASTERS for suffix in ("tif", "qml")}
    assert {file.name for file in files} == {p.name for p in (tmp_path / "epoch").iterdir()} == expected
    array, grid, tags = read_cog(tmp_path / "epoch" / "elevation.tif")
    assert grid == GRID
    assert_array_equal(array, surface_of()["elevation"].astype(np.float32))
    assert (tags["epoch"], tags["programme"], tags["unit"]) == ("2024-05-01", "demo", "m")
    assert read_cog(tmp_path / "epoch" / "age_days.tif")[2]["unit"] == "day"


@pytest.mark.parametrize("crs", ["EPSG:32632+5773", "EPSG:32632+4979"])
def test_rasters_and_netcdf_of_a_pair_agree(tmp_path, crs):
    grid = Grid(520, 40, west=500_000.0, north=4_650_000.0, resolution=0.5, crs=crs)
    change = change_of(grid)
    write_change_products(tmp_path / "pair", change, grid, ChangeMetadata(**RUN, **PAIR))
    with xr.open_dataset(tmp_path / "pair" / "change.nc", mask_and_scale=False) as dataset:
        assert set(CHANGE_LAYERS) < set(dataset.data_vars)
        for name in CHANGE_RASTERS:
            path = tmp_path / "pair" / f"{name}.tif"
            assert cog_validate(path, strict=True) == (True, [], [])
            array, grid_again, tags = read_cog(path)
            assert grid_again == grid
            signed = np.where(array == 255, -1, array.astype(int)) if name in CLASS_LAYERS else array
            assert_array_equal(dataset[name][0], signed)
            assert_array_equal(array, change[name].astype(array.dtype))
            provenance = RUN | PAIR | {"layer": name, "confidence": "0.95"}
            del provenance["created"]
            assert provenance.items() <= tags.items()
            with rasterio.open(path) as raster:
                centre = raster.xy(0, 0)
            assert_allclose(centre, (dataset.x[0], dataset.y[0]), rtol=0, atol=0)


def test_products_do_not_depend_on_when_they_are_written(tmp_path):
    assert write_pair(tmp_path / "first") == write_pair(tmp_path / "second")


def test_existing_pair_is_replaced_as_a_whole(tmp_path):
    write_pair(tmp_path / "pair", add_files=lambda folder: (folder / "summary.json").write_text("{}"))
    write_pair(tmp_path / "pair", change_of(shift=0.5))
    assert not (tmp_path / "pair" / "summary.json").exists()
    assert_allclose(np.nanmean(read_cog(tmp_path / "pair" / "dod.tif")[0]), 0.5, rtol=0, atol=1e-6)
    assert [p.name for p in tmp_path.iterdir()] == ["pair"]


def test_added_files_are_published_and_listed(tmp_path):
    def add_summary(folder):
        assert (folder / "dod.tif").exists()
        assert not (tmp_path / "pair").exists()
        (folder / "summary.json").write_text("{}")

    files = write_pair(tmp_path / "pair", add_files=add_summary)
    assert "summary.json" in {file.name for file in files}
    assert (tmp_path / "pair" / "summary.json").read_text() == "{}"


@pytest.mark.parametrize("write", [write_pair, write_epoch])
def test_error_at_the_last_moment_leaves_the_old_product(tmp_path, write):
    before = write_pair(tmp_path / "product")

    def fail(folder):
        message = "interrupted"
        raise KeyboardInterrupt(message)

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "product", add_files=fail)
    assert [p.name for p in tmp_path.iterdir()] == ["product"]
    for file in before:
        assert hashlib.sha256((tmp_path / "product" / file.name).read_bytes()).hexdigest() == file.sha256


def test_killed_run_leaves_the_old_product(tmp_path):
    before = write_pair(tmp_path / "pair")
    code = textwrap.dedent(
        """
        import os, signal, sys
        import numpy as np
        from changedetect.grid import Grid
        from changedetect.io.netcdf import CHANGE_LAYERS, CLASS_LAYERS
        from changedetect.io.products import ChangeMetadata, write_change_products

        grid = Grid(60, 80, 500000.0, 4650000.0, 0.5, "EPSG:32632+5773")
        change = {name: np.ones(grid.shape) for name in CHANGE_LAYERS}
        change |= {name: np.ones(grid.shape, np.uint8) for name in CLASS_LAYERS}
        meta = ChangeMetadata(
            programme="demo", run_id="r2", config_sha256="", created="2024-06-01", epoch_earlier="a", epoch_later="b",
            datetime_earlier="2023-05-01", datetime_later="2024-05-01", confidence=0.95,
        )
        kill = lambda folder: os.kill(os.getpid(), signal.SIGKILL)
        write_change_products(sys.argv[1], change, grid, meta, add_files=kill)
        """
    )
    environment = os.environ | {"PYTHONPATH": "."}
    result = subprocess.run([sys.executable, "-c", code, tmp_path / "pair"], env=environment, check=False)
    assert result.returncode == -9
    assert len(list(tmp_path.iterdir())) == 2  # the old product and what the killed run was writing
    assert len(clear_leftovers(tmp_path)) == 1
    for file in before:
        assert hashlib.sha256((tmp_path / "pair" / file.name).read_bytes()).hexdigest() == file.sha256


def test_layers_that_do_not_fit_leave_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"missing: \['z_score'\]"):
        write_pair(tmp_path / "pair", {k: v for k, v in change_of().items() if k != "z_score"})
    assert not list(tmp_path.iterdir())


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "products").write_text("a file")
    with pytest.raises(OutputError, match=r"Cannot write into .*products"):
        write_pair(tmp_path / "products" / "pair")


def test_colours_follow_the_programme_and_the_level_of_detection(tmp_path):
    limits = {"dod": (-3.0, 3.0), "dod_std": (0.0, 0.5)}
    for name, shift in (("a", 0.0), ("b", 0.7)):
        write_pair(tmp_path / name, change_of(shift=shift), colour_limits=limits)
        values = dod_stops(tmp_path / name)
        assert (values[0], values[-1]) == (-3.0, 3.0)
        assert_allclose(sorted(values, key=abs)[:2], [-0.1, 0.1], rtol=0, atol=1e-9)
        assert colours_beyond(tmp_path / name, 0.1) == colours_beyond(tmp_path / "a", 0.1)
        std = [float(i.get("value")) for i in ET.parse(tmp_path / name / "dod_std.qml").getroot().iter("item")]
        assert (std[0], std[-1]) == (0.0, 0.5)


def test_colours_keep_their_meaning_where_the_level_of_detection_exceeds_their_limit(tmp_path):
    limits = {"dod": (-0.3, 0.3)}
    write_pair(tmp_path / "pair", change_of(level_of_detection=0.5), colour_limits=limits)
    write_pair(tmp_path / "quiet", change_of(level_of_detection=0.05), colour_limits=limits)
    loud, quiet = (colours_beyond(tmp_path / name, 0.5) for name in ("pair", "quiet"))
    assert loud == ["#67001f", "#053061"]
    ends = [item.get("color") for item in ET.parse(tmp_path / "quiet" / "dod.qml").getroot().iter("item")]
    assert (ends[0], ends[-1]) == ("#67001f", "#053061")
    assert quiet == []


def test_the_neutral_band_covers_the_level_of_detection_of_nearly_all_cells(tmp_path):
    change = change_of()
    level = np.where(np.isnan(change["dod"]), np.nan, np.linspace(0.1, 0.15, GRID.n_cols))
    write_pair(tmp_path / "pair", change | {"level_of_detection": level})
    neutral = sorted(dod_stops(tmp_path / "pair"), key=abs)[1]
    assert np.mean(level[np.isfinite(level)] <= neutral) >= 0.95
    level[-1, 0] = level[-1, -1] = 40.0
    write_pair(tmp_path / "pair", change | {"level_of_detection": np.where(level > 0.14, 40.0, level)})
    assert sorted(dod_stops(tmp_path / "pair"), key=abs)[1] < 0.26


def test_the_significant_change_is_neutral_exactly_below_the_level_of_detection(tmp_path):
    write_pair(tmp_path / "pair")
    with rasterio.open(tmp_path / "pair" / "dod_significant.vrt") as raster:
        values, crs, unit = raster.read(1), raster.crs, raster.units[0]
        assert tuple(raster.transform)[:6] == GRID.transform
        assert np.isnan(raster.nodata)
    with rasterio.open(tmp_path / "pair" / "dod.tif") as raster:
        dod = raster.read(1)
        assert (crs, unit) == (raster.crs, "m")
    classes = read_cog(tmp_path / "pair" / "change_class.tif")[0]
    assert_array_equal(values, np.where(np.isin(classes, (1, 2)), dod, np.where(np.isnan(dod), np.nan, 0.0)))
    items = list(ET.parse(tmp_path / "pair" / "dod_significant.qml").getroot().iter("item"))
    grey = [float(item.get("value")) for item in items if "below the level" in item.get("label")]
    significant = np.abs(values[values != 0.0])
    assert 0.0 < grey[1] < significant[np.isfinite(significant)].min()


def test_pair_without_any_data_is_written(tmp_path):
    change = {name: np.full(GRID.shape, np.nan) for name in CHANGE_LAYERS}
    change |= {name: np.full(GRID.shape, 255, np.uint8) for name in CLASS_LAYERS}
    files = write_pair(tmp_path / "pair", change)
    assert len(files) == 17
    assert np.isnan(read_cog(tmp_path / "pair" / "dod.tif")[0]).all()
