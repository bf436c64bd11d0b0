"""A 5 m elevation model and a drone's cloud in one programme, from the command line to the map."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest
import rasterio
from coarse_and_dense import SOUTH, WEST, cloud, elevation_model, rough_ground
from rasterio.transform import from_origin
from small_surveys import run

from changedetect.io.cog import read_cog
from changedetect.io.las import write_points
from changedetect.storage import read_json

CRS = "EPSG:32632+5773"
SIDE, CELL, MARGIN = 180.0, 5.0, 20.0
OLD, NEW = "2010-06-01", "2024-06-01"
#: Middles, east and north of the corner, of a change as wide as the old model resolves and of one it cannot.
WIDE, NARROW = (115.0, 90.0), (50.0, 90.0)


def change(easting, northing):
    east, north = easting - WEST, northing - SOUTH
    wide = (np.abs(east - WIDE[0]) < 25.0) & (np.abs(north - WIDE[1]) < 25.0)
    narrow = (np.abs(east - NARROW[0]) < 1.5) & (np.abs(north - NARROW[1]) < 1.5)
    return np.where(wide, 1.0, 0.0) + np.where(narrow, 1.0, 0.0)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("resolution")
    ground = rough_ground(12, SIDE, relief=4.0)
    coarse, n = elevation_model(ground, SIDE, CELL), int(SIDE / CELL)
    profile = {"driver": "GTiff", "height": n, "width": n, "count": 1, "dtype": "float32", "crs": "EPSG:32632+5773"}
    with rasterio.open(
        folder / "old.tif", "w", transform=from_origin(WEST, SOUTH + SIDE, CELL, CELL), nodata=-9999.0, **profile
    ) as raster:
        raster.write(coarse.elevation.reshape(n, n)[::-1].astype(np.float32), 1)
    dense = cloud(ground, SIDE, 8.0, change=change, margin=MARGIN)
    write_points(folder / "new.laz", dense, CRS, created=date(2024, 6, 1))
    return folder


@pytest.fixture(scope="module")
def updated(site):
    """The programme after the commands a user gives, and what they printed last."""
    from _pytest.capture import MultiCapture, SysCapture

    directory, bounds = site / "programme", (WEST + MARGIN, WEST + SIDE - MARGIN, SOUTH + MARGIN, SOUTH + SIDE - MARGIN)

    class Capture:
        def readouterr(self):
            return capture.readouterr()

    capture = MultiCapture(in_=None, out=SysCapture(1), err=SysCapture(2))
    capture.start_capturing()
    try:
        run(Capture(), "init", directory, "--crs", CRS, "--resolution", 1, "--bounds", *bounds)
        run(Capture(), "add", directory, OLD, site / "old.tif")
        run(Capture(), "add", directory, NEW, site / "new.laz")
        run(Capture(), "update", directory)
    finally:
        capture.stop_capturing()
    return directory / "products" / f"{OLD}_{NEW}"


def at(values, grid, place):
    row = int((grid.north - SOUTH - place[1]) / grid.resolution)
    return values[row, int((WEST + place[0] - grid.west) / grid.resolution)]


def test_the_summary_says_what_the_old_model_cannot_show(updated):
    found = read_json(updated / "summary.json")["resolution"]
    assert found["width_earlier_m"] > 4.0 * found["width_later_m"]
    assert found["footprint_earlier_m"] == pytest.approx(CELL, rel=0.5)
    assert found["footprint_later_m"] == 0.0
    assert found["unresolved_std_m"] > 0.1
    assert found["statement"].startswith("The earlier epoch resolves ")
    assert "the earlier one limits the map" in found["statement"]


def test_the_map_of_the_resolution_says_so_cell_by_cell(updated):
    width, grid, tags = read_cog(updated / "resolution.tif")
    classes, _, class_tags = read_cog(updated / "resolution_class.tif")
    dod, _, _ = read_cog(updated / "dod.tif")
    assert (tags["unit"], tags["layer"]) == ("m", "resolution")
    np.testing.assert_array_equal(np.isfinite(width), np.isfinite(dod))
    np.testing.assert_array_equal(classes != 255, np.isfinite(dod))
    assert np.nanmin(width) > CELL
    assert np.mean(np.isin(classes[classes != 255], (1, 3))) > 0.99
    assert class_tags["flag_meanings"].split() == [
        "resolved_alike", "limited_by_earlier", "limited_by_later", "change_not_resolved",
    ]  # fmt: skip
    assert at(width, grid, WIDE) < 40.0


def test_the_wide_change_is_found_at_its_height(updated):
    dod, grid, _ = read_cog(updated / "dod.tif")
    classes, _, _ = read_cog(updated / "change_class.tif")
    np.testing.assert_allclose(at(dod, grid, WIDE), 1.0, rtol=0.12, atol=0.0)
    assert at(classes, grid, WIDE) == 2


def test_the_narrow_change_is_not_claimed(updated):
    dod, grid, _ = read_cog(updated / "dod.tif")
    assert at(dod, grid, NARROW) < 0.3


def test_quiet_ground_stays_quiet(updated):
    classes, grid, _ = read_cog(updated / "change_class.tif")
    easting, northing = (a.reshape(grid.shape) for a in grid.coordinates())
    east, north = easting - WEST, northing - SOUTH
    near = (np.abs(east - WIDE[0]) < 60.0) & (np.abs(north - WIDE[1]) < 60.0)
    far = ~near & (np.hypot(east - NARROW[0], north - NARROW[1]) > 25.0) & (classes <= 2)
    assert far.sum() > 500
    assert np.mean(classes[far] != 0) < 0.15


def test_the_cloud_is_aligned_by_its_own_surface(updated):
    manifest = read_json(updated.parents[1] / "state" / NEW / "manifest.json")
    transform = manifest["alignment"]["estimate"]["transform"]
    errors = transform["standard_errors"]
    assert transform["kind"] == "shift"
    assert max(errors["east"], errors["north"]) < 0.15
    for name, error in errors.items():
        assert abs(transform["parameters"][name]) < 4.0 * error
