"""Cloud Optimized GeoTIFFs: valid, georeferenced, honest about no data, the same bytes every time."""

from __future__ import annotations

import resource
import signal

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose, assert_array_equal
from rasterio.crs import CRS
from rio_cogeo.cogeo import cog_validate

from changedetect.crs import is_same_horizontal, vertical_part
from changedetect.errors import CRSMismatchError, InputDataError, MissingInputError, OutputError
from changedetect.grid import Grid
from changedetect.io.cog import Category, read_cog, write_cog

LEVELLED = "EPSG:32632+5773"
ELLIPSOIDAL = "EPSG:32632+4979"
CATEGORIES = (
    Category(0, "no_change", "no change", (235, 235, 235, 255)),
    Category(1, "raised", "raised", (33, 102, 172, 255)),
)


def grid_of(n_rows, n_cols, crs=LEVELLED):
    return Grid(n_rows, n_cols, west=500_000.25, north=4_650_000.5, resolution=0.25, crs=crs)


def terrain(grid, seed=0):
    rng = np.random.default_rng(seed)
    array = 300 + 0.01 * np.arange(grid.n_cols) + rng.normal(scale=0.05, size=grid.shape)
    array[: grid.n_rows // 3, : grid.n_cols // 4] = np.nan
    array[rng.random(grid.shape) < 0.01] = np.nan
    return array


def write(path, array, grid, **changes):
    arguments = {"nodata": np.nan, "description": "elevation of the surface", "unit": "m", "tags": {"run_id": "r1"}}
    write_cog(path, array, grid, **(arguments | changes))


def write_classes(path, array, grid):
    write(path, array, grid, nodata=255, unit="1", categories=CATEGORIES, overview="mode")


@pytest.mark.parametrize(
    ("shape", "n_overviews"), [((1, 1), 0), ((37, 411), 0), ((512, 512), 0), ((513, 300), 1), ((700, 1300), 2)]
)
def test_file_is_a_valid_cog_with_the_overviews_it_needs(tmp_path, shape, n_overviews):
    grid = grid_of(*shape)
    for name, array in (("a", terrain(grid)), ("classes", np.zeros(shape, np.uint8))):
        path = tmp_path / f"{name}.tif"
        (write_classes if name == "classes" else write)(path, array, grid)
        assert cog_validate(path, strict=True) == (True, [], [])
        with rasterio.open(path) as raster:
            assert len(raster.overviews(1)) == n_overviews
            assert raster.compression.name == "deflate"
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            if max(shape) > 512:
                assert raster.block_shapes == [(512, 512)]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tif", "classes.tif"]  # no sidecar, no temporary


def test_array_and_grid_come_back(tmp_path):
    grid = grid_of(120, 90)
    array = terrain(grid)
    write(tmp_path / "a.tif", array, grid)
    again, grid_again, tags = read_cog(tmp_path / "a.tif")
    assert again.dtype == np.float32
    assert_array_equal(again, array.astype(np.float32))
    assert grid_again == grid
    expected = {"run_id": "r1", "description": "elevation of the surface", "unit": "m", "AREA_OR_POINT": "Area"}
    assert expected.items() <= tags.items()
    assert tags["vertical_crs"] == "EPSG:5773"


def test_first_cell_centre_lies_half_a_cell_inside_the_corner(tmp_path):
    grid = grid_of(10, 20)
    write(tmp_path / "a.tif", terrain(grid), grid)
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.tags()["AREA_OR_POINT"] == "Area"
        assert raster.xy(0, 0) == (grid.easting[0], grid.northing[0]) == (500_000.375, 4_650_000.375)
        assert tuple(raster.bounds) == (500_000.25, 4_649_998.0, 500_005.25, 4_650_000.5)


def test_statistics_are_exact_and_ignore_no_data(tmp_path):
    grid = grid_of(700, 600)
    array = terrain(grid).astype(np.float32)
    write(tmp_path / "a.tif", array, grid)
    _, _, tags = read_cog(tmp_path / "a.tif")
    stored = [float(tags[f"STATISTICS_{key}"]) for key in ("MINIMUM", "MAXIMUM", "MEAN", "STDDEV")]
    exact = [
        np.nanmin(array),
        np.nanmax(array),
        np.nanmean(array, dtype=np.float64),
        np.nanstd(array, dtype=np.float64),
    ]
    # GDAL accumulates tile by tile: the standard deviation of values 200 times its size keeps 9 digits
    assert_allclose(stored, exact, rtol=1e-8, atol=0)
    # GDAL rounds the share downwards to two decimals
    assert_allclose(float(tags["STATISTICS_VALID_PERCENT"]), 100 * np.isfinite(array).mean(), rtol=0, atol=0.0101)


def test_overviews_are_means_of_the_data_alone(tmp_path):
    grid = grid_of(600, 1024)
    array = terrain(grid)
    array[300, 300:600] = np.nan
    write(tmp_path / "a.tif", array, grid)
    with rasterio.open(tmp_path / "a.tif", overview_level=0) as raster:
        overview = raster.read(1)
    cells = array.reshape(300, 2, 512, 2).swapaxes(1, 2).reshape(300, 512, 4)
    is_data = np.isfinite(cells).any(axis=2)
    expected = np.full(overview.shape, np.nan)
    expected[is_data] = np.nanmean(cells[is_data], axis=1)
    assert_array_equal(np.isnan(overview), ~is_data)
    assert_allclose(overview[is_data], expected[is_data], rtol=1e-6, atol=0)  # float32


def test_overviews_of_classes_are_classes(tmp_path):
    grid = grid_of(600, 600)
    classes = np.random.default_rng(2).choice(np.array([0, 1, 255], np.uint8), size=grid.shape)
    classes[:, :300] = 255
    classes[100:200, 400:500] = 1
    write_classes(tmp_path / "a.tif", classes, grid)
    with rasterio.open(tmp_path / "a.tif", overview_level=0) as raster:
        overview = raster.read(1)
    assert set(np.unique(overview)) <= {0, 1, 255}
    assert (overview[:, :150] == 255).all()
    assert (overview[50:100, 200:250] == 1).all()


def test_classes_carry_colours_and_meanings(tmp_path):
    grid = grid_of(8, 9)
    classes = np.tile(np.array([0, 1, 255], np.uint8), (8, 3))
    write_classes(tmp_path / "a.tif", classes, grid)
    again, _, tags = read_cog(tmp_path / "a.tif")
    assert again.dtype == np.uint8
    assert_array_equal(again, classes)
    assert (tags["flag_values"], tags["flag_meanings"]) == ("0 1", "no_change raised")
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.nodata == 255
        assert raster.colormap(1)[1] == (33, 102, 172, 255)
        assert raster.read_masks(1).tolist() == np.where(classes == 255, 0, 255).tolist()


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_array_of_one_value_is_written(tmp_path, value):
    grid = grid_of(600, 20)
    write(tmp_path / "a.tif", np.full(grid.shape, value), grid)
    assert cog_validate(tmp_path / "a.tif", strict=True)[0]
    assert_array_equal(read_cog(tmp_path / "a.tif")[0], np.full(grid.shape, value, np.float32))


def test_same_input_gives_the_same_bytes(tmp_path):
    grid = grid_of(700, 1300)
    write(tmp_path / "a.tif", terrain(grid), grid)
    first = (tmp_path / "a.tif").read_bytes()
    write(tmp_path / "a.tif", terrain(grid), grid)
    assert (tmp_path / "a.tif").read_bytes() == first


def test_compound_crs_is_stored_whole(tmp_path):
    write(tmp_path / "a.tif", terrain(grid_of(8, 8)), grid_of(8, 8))
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs == CRS.from_string(LEVELLED)
        assert raster.crs.to_wkt().startswith("COMPD_CS")


def test_ellipsoidal_heights_are_named_beside_the_horizontal_crs(tmp_path):
    grid = grid_of(8, 8, ELLIPSOIDAL)
    write(tmp_path / "a.tif", terrain(grid), grid)
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs.to_epsg() == 32632
        assert raster.tags()["vertical_crs"] == "ellipsoid:EPSG:4979"
    assert read_cog(tmp_path / "a.tif")[1] == grid


def test_undeclared_heights_stay_undeclared(tmp_path):
    grid = grid_of(8, 8, "EPSG:26917")
    write(tmp_path / "a.tif", terrain(grid), grid)
    _, again, tags = read_cog(tmp_path / "a.tif")
    assert again == grid
    assert "vertical_crs" not in tags


def test_datum_of_a_site_survives(tmp_path):
    horizontal = CRS.from_epsg(32632).to_wkt(version="WKT2_2019")
    vertical = 'VERTCRS["mine level",VDATUM["Shaft 7"],CS[vertical,1],AXIS["up",up],LENGTHUNIT["metre",1]]'
    crs = f'COMPOUNDCRS["mine",{horizontal},{vertical}]'
    write(tmp_path / "a.tif", terrain(grid_of(8, 8)), grid_of(8, 8, crs))
    again = read_cog(tmp_path / "a.tif")[1].crs
    assert is_same_horizontal(again, crs)
    assert vertical_part(again) == vertical_part(crs)
    assert "Shaft 7" in again


def test_crs_without_code_survives(tmp_path):
    crs = "+proj=lcc +lat_1=20 +lat_2=40 +lat_0=30 +lon_0=10 +datum=WGS84 +units=m"
    write(tmp_path / "a.tif", terrain(grid_of(8, 8)), grid_of(8, 8, crs))
    assert is_same_horizontal(read_cog(tmp_path / "a.tif")[1].crs, crs)


def test_crs_that_geotiff_cannot_express_is_refused(tmp_path):
    crs = "+proj=ob_tran +o_proj=moll +o_lat_p=45 +o_lon_p=-90 +R=6371000 +units=m"
    with pytest.raises(CRSMismatchError, match="GeoTIFF cannot store the CRS"):
        write(tmp_path / "a.tif", terrain(grid_of(8, 8)), grid_of(8, 8, crs))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("array", "categories", "message"),
    [
        (np.zeros((3, 4)), None, r"shape \(3, 4\), its grid \(4, 3\)"),
        (np.zeros((4, 3), np.int32), None, "floating point or uint8; got int32"),
        (np.zeros((4, 3)), CATEGORIES, "categories is uint8; got float64"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, array, categories, message):
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "a.tif", array, grid_of(4, 3), categories=categories)
    assert not list(tmp_path.iterdir())


def test_input_array_is_not_modified(tmp_path):
    array = terrain(grid_of(20, 20))
    before = array.copy()
    write(tmp_path / "a.tif", array, grid_of(20, 20))
    assert_array_equal(array, before)


def test_full_disk_leaves_the_old_file(tmp_path):
    grid = grid_of(600, 600)
    write(tmp_path / "a.tif", np.zeros(grid.shape), grid)
    before = (tmp_path / "a.tif").read_bytes()
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(OutputError, match=r"Cannot write .*a\.tif"):
            write(tmp_path / "a.tif", terrain(grid), grid)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert (tmp_path / "a.tif").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match=r"Cannot write into .*out"):
        write(tmp_path / "out" / "a.tif", terrain(grid_of(4, 4)), grid_of(4, 4))


def test_missing_raster_is_named(tmp_path):
    with pytest.raises(MissingInputError, match=r"No such file: .*a\.tif"):
        read_cog(tmp_path / "a.tif")


def test_file_that_is_no_raster_is_refused(tmp_path):
    (tmp_path / "a.tif").write_text("no raster")
    with pytest.raises(InputDataError, match=r"a\.tif cannot be read as a raster"):
        read_cog(tmp_path / "a.tif")


def test_truncated_raster_is_refused(tmp_path):
    grid = grid_of(600, 600)
    write(tmp_path / "a.tif", terrain(grid), grid)
    whole = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputDataError, match=r"a\.tif cannot be read as a raster"):
        read_cog(tmp_path / "a.tif")


def test_raster_that_is_not_north_up_is_refused(tmp_path):
    profile = {"driver": "GTiff", "height": 2, "width": 2, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    with rasterio.open(tmp_path / "a.tif", "w", **profile, transform=rasterio.Affine(1, 0.1, 0, 0, -1, 0)) as raster:
        raster.write(np.zeros((1, 2, 2), np.float32))
    with pytest.raises(InputDataError, match="square north-up cells are expected"):
        read_cog(tmp_path / "a.tif")
