"""Elevation rasters: cell centres, nodata, scale and offset, units, georeference, damage."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.testing import assert_allclose
from rasterio.shutil import copy

from changedetect.crs import horizontal_epsg, is_same_vertical
from changedetect.errors import InputDataError
from changedetect.io.points import SourceOptions, open_points, read_points
from changedetect.pointcloud import PointCloud

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).parents[3] / "shared" / "data"))
NORTH_UP = Affine(0.5, 0, 299_800.0, 0, -0.5, 5_773_700.0)
NAN = float("nan")


def ground(n_rows: int = 7, n_cols: int = 9) -> np.ndarray:
    rows, cols = np.mgrid[0:n_rows, 0:n_cols]
    return (100 + rows + 0.125 * cols).astype(np.float32)


def write(path: Path, values: np.ndarray, *, transform: Affine = NORTH_UP, crs: str | None = "EPSG:32755",
          **profile: Any) -> Path:  # fmt: skip
    bands = values if values.ndim == 3 else values[None]
    after = {key: profile.pop(key) for key in ("scales", "offsets", "units") if key in profile}
    with rasterio.open(
        path, "w", driver=profile.pop("driver", "GTiff"), width=bands.shape[2], height=bands.shape[1],
        count=bands.shape[0], dtype=bands.dtype, crs=crs, transform=transform, **profile,
    ) as dataset:  # fmt: skip
        dataset.write(bands)
        for key, value in after.items():
            setattr(dataset, key, value)
    return path


def read(path: Path, **options: Any) -> PointCloud:
    return read_points(path, SourceOptions(**options))


def test_every_cell_gives_a_point_at_its_centre(tmp_path: Path) -> None:
    source = open_points(write(tmp_path / "a.tif", ground()))
    cloud = source.read()
    assert len(cloud) == 63
    assert source.n_points is None
    assert horizontal_epsg(source.require_crs()) == 32755
    assert cloud.region == (299_800.25, 299_804.25, 5_773_696.75, 5_773_699.75)
    np.testing.assert_array_equal(cloud.elevation, ground().ravel())
    np.testing.assert_array_equal(cloud.easting[:3], [299_800.25, 299_800.75, 299_801.25])
    assert cloud.sigma is None


def test_cells_that_are_not_square_are_placed_right(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", ground(), transform=Affine(1.0007, 0, 10.0, 0, -1.0013, 20.0))
    cloud = read(path)
    assert_allclose(cloud.easting[8], 10 + 8.5 * 1.0007, rtol=0, atol=1e-12)
    assert_allclose(cloud.northing[-1], 20 - 6.5 * 1.0013, rtol=0, atol=1e-12)


def test_rotated_rasters_are_placed_by_their_affine_transform(tmp_path: Path) -> None:
    """The centre of cell (row, col) is the origin plus its steps along the turned axes."""
    angle, step = np.radians(30), 2.0
    c, s = step * np.cos(angle), step * np.sin(angle)
    cloud = read(write(tmp_path / "a.tif", ground(), transform=Affine(c, s, 1000.0, s, -c, 2000.0)))
    row, col = 3, 5
    i = row * 9 + col
    assert_allclose(cloud.easting[i], 1000 + c * (col + 0.5) + s * (row + 0.5), rtol=0, atol=1e-9)
    assert_allclose(cloud.northing[i], 2000 + s * (col + 0.5) - c * (row + 0.5), rtol=0, atol=1e-9)
    gaps = np.hypot(np.diff(cloud.easting[:9]), np.diff(cloud.northing[:9]))
    assert_allclose(gaps, step, rtol=0, atol=1e-9)


@pytest.mark.parametrize("tiles", [{}, {"tiled": True, "blockxsize": 16, "blockysize": 16}])
@pytest.mark.parametrize("chunk_size", [1, 100, 1000, 10**7])
def test_the_size_of_chunks_changes_no_point(tmp_path: Path, tiles: dict[str, Any], chunk_size: int) -> None:
    values = ground(50, 70)
    source = open_points(write(tmp_path / "a.tif", values, **tiles))
    cloud = PointCloud.concatenate(list(source.iter_chunks(chunk_size)))
    order = np.lexsort((cloud.easting, -cloud.northing))
    np.testing.assert_array_equal(cloud.elevation[order], values.ravel())


def test_a_stated_sigma_is_that_of_every_cell(tmp_path: Path) -> None:
    cloud = read(write(tmp_path / "a.tif", ground()), sigma=0.08)
    np.testing.assert_array_equal(cloud.sigma, np.full(63, 0.08))


# nodata


@pytest.mark.parametrize("nodata", [-9999.0, -32768.0, -3.4028234663852886e38, 0.0, NAN])
def test_declared_nodata_is_left_out(tmp_path: Path, nodata: float) -> None:
    values = ground()
    values[2, 3:6] = nodata
    assert len(read(write(tmp_path / "a.tif", values, nodata=nodata))) == 60


def test_nan_is_left_out_without_being_declared(tmp_path: Path) -> None:
    values = ground()
    values[0] = NAN
    assert len(read(write(tmp_path / "a.tif", values))) == 54


def test_masked_cells_are_left_out(tmp_path: Path) -> None:
    mask = np.full((7, 9), 255, np.uint8)
    mask[:, 0] = 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        path = write(tmp_path / "a.tif", ground())
        with rasterio.open(path, "r+") as dataset:
            dataset.write_mask(mask)
    assert len(read(path)) == 56


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32])
@pytest.mark.parametrize("fill", [-9999, -10000, -32768])
def test_a_fill_value_that_nobody_declared_is_refused_with_the_fix(tmp_path: Path, dtype: type, fill: int) -> None:
    values = ground().astype(dtype)
    values[1, :4] = fill
    path = write(tmp_path / "a.tif", values)
    with pytest.raises(InputDataError, match=rf"a\.tif: 4 cells .* {fill}\.0, .*--nodata {fill}\.0"):
        read(path)
    assert len(read(path, nodata=float(fill))) == 59


def test_a_second_fill_value_beside_the_declared_one_is_refused(tmp_path: Path) -> None:
    values = ground()
    values[0, 0], values[0, 1] = -9999, -3.4e38
    with pytest.raises(InputDataError, match=r"declares nodata -9999\.0"):
        read(write(tmp_path / "a.tif", values, nodata=-9999.0))


def test_zeros_far_from_all_other_elevations_are_refused(tmp_path: Path) -> None:
    values = ground()
    values[0] = 0
    path = write(tmp_path / "a.tif", values)
    with pytest.raises(InputDataError, match=r"9 of 63 cells are exactly 0 .* --nodata 0 if they are, --nodata nan"):
        read(path)
    assert len(read(path, nodata=0.0)) == 54
    assert len(read(path, nodata=NAN)) == 63
    assert len(read(write(tmp_path / "b.tif", values - np.float32(90) * (values > 0)))) == 63  # a water level


def test_a_stated_nodata_replaces_the_declared_one(tmp_path: Path) -> None:
    values = ground()
    values[0, :2] = -1.0
    path = write(tmp_path / "a.tif", values, nodata=float(values[6, 8]))
    assert len(read(path)) == 62
    cloud = read(path, nodata=-1.0)
    assert len(cloud) == 61
    assert cloud.elevation.max() == values[6, 8]


def test_a_nodata_value_the_cells_cannot_hold_matches_nothing(tmp_path: Path) -> None:
    assert len(read(write(tmp_path / "a.tif", ground().astype(np.int16)), nodata=-9999.5)) == 63


def test_a_raster_without_a_valid_cell_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="band 1 has no valid cell"):
        read(write(tmp_path / "a.tif", np.full((4, 4), -9999, np.float32), nodata=-9999))


# meaning of the numbers


def test_scale_and_offset_are_applied_and_nodata_is_as_stored(tmp_path: Path) -> None:
    stored = np.arange(12, dtype=np.int16).reshape(3, 4)
    stored[2, 3] = -5
    path = write(tmp_path / "a.tif", stored, nodata=-5, scales=(0.001,), offsets=(920.0,))
    assert_allclose(read(path).elevation, 920 + 0.001 * np.arange(11), rtol=0, atol=1e-12)
    assert len(read(path, nodata=3.0)) == 11


def test_a_band_is_chosen(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", np.stack([ground(), ground() + 7]))
    assert_allclose(read(path, band=2).elevation - read(path).elevation, 7.0, rtol=0, atol=0)
    with pytest.raises(InputDataError, match=r"has 2 band\(s\); band 3"):
        open_points(path, SourceOptions(band=3))


@pytest.mark.parametrize("unit", ["m", "metre", "Meters"])
def test_metres_are_accepted(tmp_path: Path, unit: str) -> None:
    assert len(read(write(tmp_path / "a.tif", ground(), units=(unit,)))) == 63


@pytest.mark.parametrize(
    ("unit", "crs"),
    [("ft", "EPSG:32755"), ("cm", "EPSG:32755"), ("US survey foot", "EPSG:32618+5703"), ("m", "EPSG:2263+6360")],
)
def test_units_that_contradict_the_crs_are_refused(tmp_path: Path, unit: str, crs: str) -> None:
    path = write(tmp_path / "a.tif", ground(), units=(unit,))
    with pytest.raises(InputDataError, match=rf"band 1 is in '{unit}', expected are .*--crs EPSG:2263\+6360"):
        open_points(path, SourceOptions(crs=crs))


def test_feet_agree_with_a_crs_in_feet(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", ground(), units=("US survey foot",), crs=None)
    assert len(read(path, crs="EPSG:2263+6360")) == 63


def test_a_vertical_crs_in_the_file_is_found(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", ground(), crs=rasterio.crs.CRS.from_user_input("EPSG:32632+5773"))
    assert is_same_vertical(open_points(path).require_crs(), "EPSG:32632+5773")


# refusals


def test_pictures_and_classified_maps_are_no_elevations(tmp_path: Path) -> None:
    picture = np.zeros((3, 5, 5), np.uint8)
    with pytest.raises(InputDataError, match=r"band 1 is a picture .* \(colour red\)"):
        open_points(write(tmp_path / "a.tif", picture, photometric="RGB"))
    with rasterio.open(
        tmp_path / "b.tif", "w", driver="GTiff", width=5, height=5, count=1, dtype="uint8", crs="EPSG:32755",
        transform=NORTH_UP,
    ) as dataset:  # fmt: skip
        dataset.write(np.ones((1, 5, 5), np.uint8))
        dataset.write_colormap(1, {1: (255, 0, 0, 255)})
    with pytest.raises(InputDataError, match="colour palette"):
        open_points(tmp_path / "b.tif")


def test_complex_numbers_are_no_elevations(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="complex"):
        open_points(write(tmp_path / "a.tif", np.ones((3, 3), np.complex64)))


@pytest.mark.filterwarnings("ignore:The given matrix is equal to Affine.identity")
def test_a_raster_without_georeference_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="has no georeference"):
        open_points(write(tmp_path / "a.tif", ground(), transform=Affine.identity(), crs=None))


def test_a_raster_without_crs_is_opened_and_says_so(tmp_path: Path) -> None:
    assert open_points(write(tmp_path / "a.tif", ground(), crs=None)).crs is None


def test_truncated_rasters_are_refused_by_name(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    content = write(
        tmp_path / "a.tif", rng.normal(100, 1, (200, 200)).astype(np.float32), compress="deflate"
    ).read_bytes()
    for part in (0.0001, 0.3, 0.9):
        path = tmp_path / "cut.tif"
        path.write_bytes(content[: max(20, int(part * len(content)))])
        with pytest.raises(InputDataError, match=r"cut\.tif (cannot be opened|is damaged)"):
            read(path)


@pytest.mark.parametrize(
    ("name", "driver"), [("a.asc", "AAIGrid"), ("a.img", "HFA"), ("a.bil", "EHdr"), ("a.flt", "EHdr")]
)
def test_other_formats_of_gdal_are_read(tmp_path: Path, name: str, driver: str) -> None:
    path = write(tmp_path / "a.tif", ground(), transform=Affine(0.5, 0, 300.0, 0, -0.5, 700.0))
    with rasterio.open(path) as dataset:
        copy(dataset, tmp_path / name, driver=driver)
    np.testing.assert_allclose(read(tmp_path / name).elevation, ground().ravel(), rtol=0, atol=1e-3)


# real surveys


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
@pytest.mark.parametrize(
    ("name", "n_points", "epsg"),
    [
        ("sandpyper_leo/leo_20180606_dsm_1m.tif", 145_755, 32755),
        ("sandpyper_leo/leo_20180713_dsm_1m.tif", 181_127, 32755),
        ("sandpyper_leo/leo_20180920_dsm_1m.tif", 126_256, 32755),
        ("sandpyper_leo/leo_20190211_dsm_1m.tif", 98_344, 32755),
        ("sandpyper_leo/leo_20190328_dsm_1m.tif", 101_012, 32755),
        ("sandpyper_leo/leo_20190731_dsm_1m.tif", 90_656, 32755),
        ("gc_sandbar/0003L_20170930_dem.tif", 29_788, 6404),
        ("gc_sandbar/0003L_20180926_dem.tif", 29_132, 6404),
        ("gc_sandbar/0003L_20191005_dem.tif", 19_349, 6404),
        ("flight_sim/truth/dem_epoch1.tif", 1_068_756, None),
    ],
)
def test_real_rasters_are_read(name: str, n_points: int, epsg: int | None) -> None:
    """Counts are those of cells that are neither NaN nor the declared nodata."""
    source = open_points(DATA / name)
    cloud = source.read()
    assert len(cloud) == n_points
    assert horizontal_epsg(source.require_crs()) == epsg
    with rasterio.open(DATA / name) as dataset:
        left, bottom, right, top = dataset.bounds
    west, east, south, north = cloud.region
    assert left < west < east < right
    assert bottom < south < north < top


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
def test_a_real_dem_lies_on_the_points_it_was_made_from() -> None:
    """Cells of the sandbar's 0.25 m DEM next to a surveyed point have its elevation, to the slope over half a cell."""
    dem = read(DATA / "gc_sandbar/0003L_20180926_dem.tif")
    points = read_points(DATA / "gc_sandbar/0003L_20180926_points.csv")
    near = {}
    for easting, northing, elevation in zip(dem.easting, dem.northing, dem.elevation, strict=True):
        near[round(easting), round(northing)] = elevation if (
            abs(easting - round(easting)) < 0.2 and abs(northing - round(northing)) < 0.2
        ) else near.get((round(easting), round(northing)), NAN)  # fmt: skip
    found = np.array([near.get((e, n), NAN) for e, n in zip(points.easting, points.northing, strict=True)])
    difference = (found - points.elevation)[np.isfinite(found)]
    assert difference.size > 1000
    assert_allclose(np.median(difference), 0.0, rtol=0, atol=0.02)
