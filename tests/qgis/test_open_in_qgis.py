"""Every product of a programme, opened in a real QGIS: valid, in place, in its style, drawn."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
from small_surveys import CRS, SIDE, SOUTH, WEST, make_programme

from changedetect.io.cog import read_cog
from changedetect.io.netcdf import CHANGE_CLASSES, CHANGE_LAYERS, RESOLUTION_CLASSES, SURFACE_LAYERS
from changedetect.io.products import CHANGE_RASTERS, SURFACE_RASTERS
from changedetect.pipeline.update import update

SYSTEM_PYTHON = "/usr/bin/python3"
SCRIPT = Path(__file__).with_name("open_in_qgis.py")
FIRST, SECOND, THIRD = "2024-01-01", "2024-07-01", "2025-01-01"
PIXELS = 400
PAPER = (255, 0, 255)


def environment(folder):
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    folder.chmod(0o700)
    return kept | {"QT_QPA_PLATFORM": "offscreen", "XDG_RUNTIME_DIR": str(folder)}


def reason_to_skip():
    if shutil.which(SYSTEM_PYTHON) is None:
        return f"there is no {SYSTEM_PYTHON}, the interpreter that a QGIS package would be for"
    probe = [SYSTEM_PYTHON, "-c", "import qgis.core"]
    result = subprocess.run(
        probe, capture_output=True, text=True, check=False, env=os.environ | {"QT_QPA_PLATFORM": "offscreen"}
    )
    if result.returncode:
        return f"QGIS is not installed for {SYSTEM_PYTHON} (apt install python3-qgis): {result.stderr.strip()[-120:]}"
    return ""


WHY_NOT = reason_to_skip()
pytestmark = [pytest.mark.qgis, pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Two dense epochs with a step between them, half of the second unseen, and a thin third one."""
    surveys = {
        FIRST: {"n_points": 4000},
        SECOND: {"n_points": 4000, "step": 0.5},
        THIRD: {"n_points": 300, "step": 0.5},
    }
    programme = make_programme(tmp_path_factory.mktemp("qgis") / "site", surveys, bounds=(
        WEST - 6.0, WEST + SIDE + 10.0, SOUTH - 4.0, SOUTH + SIDE + 2.0,
    ))  # fmt: skip
    result = update(programme)
    assert result.exit_code == 0, result.steps
    return programme


def pair_of(programme, earlier=FIRST, later=SECOND):
    return programme.product_directory(f"{earlier}_{later}")


@pytest.fixture(scope="module")
def opened(site, tmp_path_factory):
    """What QGIS says of every product, and pictures of the rasters."""
    folder = tmp_path_factory.mktemp("pictures")
    layers, pictures = [], {}
    for product in sorted(path for path in (site.directory / "products").iterdir() if path.is_dir()):
        for path in sorted(product.iterdir()):
            name = f"{product.name}/{path.name}"
            if path.suffix in {".tif", ".vrt"}:
                layers.append({"name": name, "uri": str(path), "kind": "raster"})
                pictures[str(folder / f"{product.name}_{path.name}.png")] = [name]
            elif path.suffix == ".nc":
                for layer in CHANGE_LAYERS if path.stem == "change" else SURFACE_LAYERS:
                    uri = f'NETCDF:"{path}":{layer}'
                    layers.append({"name": f"{name}:{layer}", "uri": uri, "kind": "raster"})
            elif path.suffix == ".gpkg":
                layers.append({"name": name, "uri": f"{path}|layername={path.stem}", "kind": "vector"})
    one = pair_of(site).name
    pictures[str(folder / "map.png")] = [f"{one}/objects.gpkg", f"{one}/dod_significant.vrt"]
    job = {"layers": layers, "pictures": pictures, "size": [PIXELS, PIXELS], "answer": str(folder / "answer.json")}
    (folder / "job.json").write_text(json.dumps(job))
    command = [SYSTEM_PYTHON, str(SCRIPT), str(folder / "job.json")]
    result = subprocess.run(
        command, env=environment(folder), capture_output=True, text=True, check=False, timeout=300, cwd=folder
    )
    assert result.returncode == 0, result.stderr
    return folder, json.loads((folder / "answer.json").read_text())


def colours_by_cell(opened, product, name, grid):
    """Colour of the picture at every cell centre, (n_rows, n_cols, 3)."""
    folder, answer = opened
    path = folder / f"{product.name}_{name}.png"
    with rasterio.open(path) as picture:
        pixels = np.moveaxis(picture.read()[:3], 0, -1)
    west, south, east, north = answer["pictures"][str(path)]["extent"]
    easting, northing = grid.easting, grid.northing
    column = ((easting - west) / (east - west) * PIXELS).astype(int)
    row = ((north - northing) / (north - south) * PIXELS).astype(int)
    return pixels[np.ix_(row, column)].astype(int)


def test_every_layer_of_every_product_is_valid(opened, site):
    layers = opened[1]["layers"]
    assert [name for name, found in layers.items() if not found["valid"]] == []
    # three pairs and three epochs
    assert sum(name.endswith(".tif") for name in layers) == 3 * len(CHANGE_RASTERS) + 3 * len(SURFACE_RASTERS)
    assert sum(name.endswith(".gpkg") for name in layers) == 3
    assert sum(".nc:" in name for name in layers) == 3 * len(CHANGE_LAYERS) + 3 * len(SURFACE_LAYERS)


def test_every_layer_lies_in_the_crs_of_the_programme(opened):
    assert CRS == "EPSG:32632+5773"
    for name, found in opened[1]["layers"].items():
        assert found["crs"]["valid"], name
        assert found["crs"]["authid"] == "EPSG:32632", name


def test_every_raster_lies_where_it_should(opened, site):
    for name, found in opened[1]["layers"].items():
        if name.endswith(".tif"):
            _, grid, _ = read_cog(site.directory / "products" / name)
            west, east, south, north = grid.region
            np.testing.assert_allclose(found["extent"], (west, south, east, north), rtol=0, atol=1e-6, err_msg=name)
            assert found["size"] == list(grid.shape)
            assert found["nodata"], name


def test_every_raster_opens_in_its_style(opened):
    for name, found in opened[1]["layers"].items():
        if name.endswith(("change_class.tif", "resolution_class.tif")):
            classes = CHANGE_CLASSES if name.endswith("change_class.tif") else RESOLUTION_CLASSES
            expected = [[c.value, "#{:02x}{:02x}{:02x}".format(*c.colour[:3]), c.label] for c in classes]
            assert found["renderer"] == "paletted", name
            assert found["classes"] == expected
        elif name.endswith((".tif", ".vrt")):
            assert found["renderer"] == "singlebandpseudocolor", name
            assert len(found["stops"]) >= 5


def test_colours_of_the_change_are_symmetric_and_the_same_on_all_maps(opened):
    stops = {n: f["stops"] for n, f in opened[1]["layers"].items() if n.endswith(("/dod.tif", "/dod_significant.vrt"))}
    limits = {tuple(f["limits"]) for n, f in opened[1]["layers"].items() if n in stops}
    assert len(limits) == 1
    low, high = limits.pop()
    assert low == -high
    assert len(stops) == 6
    for found in stops.values():
        values = [value for value, _, _ in found]
        np.testing.assert_allclose(values, np.negative(values)[::-1], rtol=0, atol=1e-9)
        coloured = {round(value, 9): colour for value, colour, label in found if "level of detection" not in label}
        others = {round(v, 9): c for s in stops.values() for v, c, label in s if "level of detection" not in label}
        assert all(others[value] == colour for value, colour in coloured.items() if value in others)
        assert any("level of detection" in label for _, _, label in found)


def test_cells_below_their_level_of_detection_are_neutral_and_no_data_is_transparent(opened, site):
    for pair in ((FIRST, SECOND), (SECOND, THIRD)):
        product = pair_of(site, *pair)
        dod, grid, _ = read_cog(product / "dod.tif")
        classes, _, _ = read_cog(product / "change_class.tif")
        colour = colours_by_cell(opened, product, "dod_significant.vrt", grid)
        is_grey = np.ptp(colour, axis=-1) <= 2
        is_paper = (colour == PAPER).all(axis=-1)
        assert np.isnan(dod).sum() > 500
        np.testing.assert_array_equal(is_paper, np.isnan(dod))
        np.testing.assert_array_equal(is_grey, classes == 0)
        red, blue = colour[classes == 1], colour[classes == 2]
        assert (red[:, 0] > red[:, 2]).all()
        assert (blue[:, 2] > blue[:, 0]).all()
        assert len(blue) > 50 or pair != (FIRST, SECOND)
        # the change itself knows no level of detection of the cell; its style covers that of nearly all
        plain = np.ptp(colours_by_cell(opened, product, "dod.tif", grid), axis=-1) <= 2
        assert np.mean(plain[classes == 0]) > 0.94


def test_every_raster_leaves_ground_without_data_transparent(opened, site):
    for product in (site.product_directory(FIRST), pair_of(site)):
        for path in sorted(product.glob("*.tif")):
            values, grid, _ = read_cog(path)
            missing = values == 255 if values.dtype == np.uint8 else np.isnan(values)
            colour = colours_by_cell(opened, product, path.name, grid)
            np.testing.assert_array_equal((colour == PAPER).all(axis=-1), missing, err_msg=path.name)


def test_objects_open_in_the_style_that_the_geopackage_holds(opened, site):
    found = opened[1]["layers"][f"{pair_of(site).name}/objects.gpkg"]
    assert found["renderer"] == "RuleRenderer"
    assert found["expressions_valid"]
    assert found["labels"]
    assert "volume_m3" in found["label"]
    signed = {label: n for label, n in found["counts"].items() if label.startswith(("raised", "lowered"))}
    assert len(signed) == 6
    assert sum(signed.values()) == found["features"] >= 1
    assert signed["raised, q <= 0.001"] >= 1


def test_the_objects_are_drawn_over_the_change(opened, site):
    folder, answer = opened
    assert all(picture["errors"] == [] for picture in answer["pictures"].values())
    with rasterio.open(folder / "map.png") as picture:
        drawn = np.moveaxis(picture.read()[:3], 0, -1).astype(int)
    with rasterio.open(folder / f"{pair_of(site).name}_dod_significant.vrt.png") as picture:
        bare = np.moveaxis(picture.read()[:3], 0, -1).astype(int)
    touched = np.any(drawn != bare, axis=-1)
    # the block is 8 m wide on a map of 36 m: its object covers about a twentieth
    assert 0.02 < touched.mean() < 0.2
