"""Opening any file of points: its format, its options, its way into the programme's CRS."""

from __future__ import annotations

import logging
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose

from changedetect.errors import (
    ConfigError,
    CRSMismatchError,
    InputDataError,
    MissingInputError,
    VerticalDatumError,
)
from changedetect.io.las import write_points
from changedetect.io.points import (
    PointSource,
    SourceOptions,
    detect_format,
    iter_programme_chunks,
    open_points,
    read_points,
)
from changedetect.io.table import write_table
from changedetect.pointcloud import PointCloud

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).parents[3] / "shared" / "data"))


def survey(n: int = 40) -> PointCloud:
    i = np.arange(n, dtype=float)
    return PointCloud(500_000 + i, 5_300_000 + 2 * i, 400 + i / 10)


def write_all(folder: Path) -> dict[str, Path]:
    """The same survey in every format, whole millimetres."""
    cloud = survey()
    paths = {name: folder / f"a.{name}" for name in ("laz", "las", "csv", "ply", "tif")}
    for name in ("laz", "las"):
        write_points(paths[name], cloud, "EPSG:32632")
    write_table(paths["csv"], {"x": cloud.easting, "y": cloud.northing, "z": cloud.elevation})
    rows = "".join(f"{e} {n} {z}\n" for e, n, z in zip(cloud.easting, cloud.northing, cloud.elevation, strict=True))
    header = "ply\nformat ascii 1.0\nelement vertex 40\nproperty double x\nproperty double y\nproperty double z\n"
    paths["ply"].write_text(f"{header}end_header\n{rows}")
    with rasterio.open(
        paths["tif"], "w", driver="GTiff", width=8, height=5, count=1, dtype="float32", crs="EPSG:32632",
        transform=rasterio.Affine(1, 0, 5e5, 0, -1, 5.3e6),
    ) as dataset:  # fmt: skip
        dataset.write(cloud.elevation.reshape(1, 5, 8).astype(np.float32))
    return paths


FORMATS = {"laz": "las", "las": "las", "csv": "table", "ply": "ply", "tif": "raster"}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("suffix", ["", ".data", ".csv"])
def test_the_content_decides_on_the_format(tmp_path: Path, name: str, suffix: str) -> None:
    renamed = tmp_path / f"survey{suffix}"
    shutil.copy(write_all(tmp_path)[name], renamed)
    assert detect_format(renamed) == FORMATS[name]
    assert len(read_points(renamed)) == 40


def test_all_formats_give_the_same_elevations(tmp_path: Path) -> None:
    for path in write_all(tmp_path).values():
        assert_allclose(np.sort(read_points(str(path)).elevation), survey().elevation, rtol=0, atol=1e-4)


def test_every_source_keeps_the_contract(tmp_path: Path) -> None:
    for name, path in write_all(tmp_path).items():
        source = open_points(path, SourceOptions(crs="EPSG:32633+5773", sigma=0.07))
        assert isinstance(source, PointSource)
        assert source.path == path
        assert source.crs == "EPSG:32633+5773"
        assert source.n_points in (40, None)
        chunks = list(source.iter_chunks())
        assert sum(map(len, chunks)) == 40, name
        np.testing.assert_array_equal(PointCloud.concatenate(chunks).sigma, np.full(40, 0.07))
        np.testing.assert_array_equal(source.read().easting, source.read().easting)


# what cannot be opened


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"No such file: .*nowhere\.laz") as caught:
        open_points(tmp_path / "nowhere.laz")
    assert caught.value.exit_code == 66


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match=r"is a folder\. Name the files in it"):
        open_points(tmp_path)


@pytest.mark.parametrize("name", ["a.laz", "a.csv", "a.tif", "a.ply", "a"])
def test_an_empty_file_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(InputDataError, match=rf"{name} is empty \(0 bytes\)"):
        open_points(tmp_path / name)


@contextmanager
def as_another_user() -> Iterator[None]:
    """Root may read everything; step down to nobody for a moment."""
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)


@pytest.mark.skipif(os.name != "posix", reason="permissions as POSIX has them")
def test_a_file_that_may_not_be_read_is_named() -> None:
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(stat.S_IRWXU | stat.S_IXOTH)
        path = Path(folder) / "a.laz"
        path.write_bytes(b"LASF")
        path.chmod(0)
        with as_another_user(), pytest.raises(MissingInputError, match=r"a\.laz may not be read: permission denied"):
            open_points(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.laz", b"easting,northing,elevation\n1,2,3\n", r"not a LAS or LAZ file: it starts with b'easting,'"),
        ("a.las", b"PK\x03\x04 a zip file", "not a LAS or LAZ file"),
        ("a.ply", b"solid stl\n", "not a PLY file"),
        ("a.csv", b"\x00\x01\x02\x03" * 100, "not a table of text: it holds zero bytes"),
        ("a.tif", b"this is no picture", "cannot be opened as a raster"),
        (
            "a.docx",
            b"PK\x03\x04\x00\x00 a zip file",
            r"not supported \(suffix '\.docx'\)\. Supported are LAS",
        ),
        ("README", b"Some words\nand no numbers\n", r"suffix 'none'"),
        ("a.gz", b"\x1f\x8b\x08\x00 compressed", "not supported"),
    ],
)
def test_what_is_no_file_of_points_is_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputDataError, match=rf"{name}.*{message}"):
        read_points(tmp_path / name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma": 0.0}, "sigma is a standard deviation in metres"),
        ({"sigma": float("nan")}, "sigma is"),
        ({"classes": ()}, "classes are ASPRS codes"),
        ({"classes": (2, 256)}, "classes are ASPRS codes"),
        ({"columns": ("x", "y")}, "columns need at least easting"),
        ({"band": 0}, "counted from 1"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SourceOptions(**options)  # type: ignore[arg-type]


def test_a_stated_crs_that_cannot_be_understood_is_refused_on_opening(tmp_path: Path) -> None:
    for path in write_all(tmp_path).values():
        with pytest.raises(CRSMismatchError, match=r"Cannot understand .*'EPSG:nowhere'"):
            open_points(path, SourceOptions(crs="EPSG:nowhere"))


# into the programme's CRS


def test_points_arrive_in_the_crs_of_the_programme(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    i = np.arange(20)
    write_table(path, {"lon": 9 + i * 1e-5, "lat": 48 + i * 1e-5, "height": 300.0 + i}, decimals=9)
    source = open_points(path, SourceOptions(crs="EPSG:4979"))
    cloud = PointCloud.concatenate(list(iter_programme_chunks(source, "EPSG:32632+4979", 7)))
    assert_allclose([cloud.easting[0], cloud.northing[0]], [500_000.0, 5_316_300.2245], rtol=0, atol=1e-3)
    np.testing.assert_array_equal(cloud.elevation, 300.0 + i)


def test_us_feet_arrive_as_metres(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    feet = PointCloud(984_250.0 + np.arange(20), np.arange(20.0), 15_000.0 + np.arange(20), np.full(20, 0.1))
    write_points(path, feet, "EPSG:2263+6360")
    cloud = PointCloud.concatenate(list(iter_programme_chunks(open_points(path), "EPSG:32118+5703")))
    assert_allclose(cloud.elevation, feet.elevation * 1200 / 3937, rtol=1e-12, atol=0)
    assert_allclose(cloud.easting, feet.easting * 1200 / 3937, rtol=0, atol=1e-5)
    assert_allclose(cloud.sigma, np.full(20, 0.1 * 1200 / 3937), rtol=1e-6, atol=0)


def test_the_same_crs_gives_the_same_numbers(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_all(tmp_path)["laz"]
    with caplog.at_level(logging.WARNING):
        cloud = PointCloud.concatenate(list(iter_programme_chunks(open_points(path), "EPSG:32632")))
    np.testing.assert_array_equal(cloud.easting, read_points(path).easting)
    np.testing.assert_array_equal(cloud.northing, read_points(path).northing)


def first_chunk(path: Path, programme: str, **options: object) -> PointCloud:
    return next(iter_programme_chunks(open_points(path, SourceOptions(**options)), programme))  # type: ignore[arg-type]


def test_a_source_without_crs_is_refused_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(CRSMismatchError, match=r"a\.csv does not say .* --crs"):
        first_chunk(write_all(tmp_path)["csv"], "EPSG:32632")


def test_differing_vertical_datums_are_refused_with_the_name_of_the_source(tmp_path: Path) -> None:
    path = write_all(tmp_path)["laz"]
    with pytest.raises(VerticalDatumError, match=r"a\.laz: The source's CRS .* --crs EPSG:32632\+5773"):
        first_chunk(path, "EPSG:32632+5773")
    with pytest.raises(VerticalDatumError, match=r"a\.laz: Vertical datums differ"):
        first_chunk(path, "EPSG:32632+5773", crs="EPSG:32632+3855")
    assert len(first_chunk(path, "EPSG:32632+5773", crs="EPSG:32632+5773")) == 40


def test_points_outside_the_source_crs_are_refused_with_the_name_of_the_source(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match=r"a\.csv: 40 of 40 points cannot be transformed"):
        first_chunk(write_all(tmp_path)["csv"], "EPSG:32632", crs="EPSG:4326")


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("500000,5300000,20000", "absurd elevation, first at point 12: 20000"),
        ("500000,5e30,1", "absurd northing"),
    ],
)
def test_absurd_points_are_refused(tmp_path: Path, row: str, message: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n" + "".join(f"{5e5 + i},{5.3e6 + i},4\n" for i in range(12)) + row + "\n")
    with pytest.raises(InputDataError, match=rf"a\.csv: .*{message}"):
        first_chunk(path, "EPSG:32632", crs="EPSG:32632")


def test_absurd_points_of_later_chunks_are_placed(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n" + "".join(f"{5e5 + i},{5.3e6 + i},4\n" for i in range(30)) + "500000,5300000,20000\n")
    source = open_points(path, SourceOptions(crs="EPSG:32632"))
    with pytest.raises(InputDataError, match=r"points from 20 on: .* first at point 10"):
        list(iter_programme_chunks(source, "EPSG:32632", 20))


def test_nan_in_a_source_is_refused(tmp_path: Path) -> None:
    path = write_all(tmp_path)["ply"]
    path.write_text(path.read_text().replace("500003.0 ", "nan "))
    with pytest.raises(InputDataError, match=r"a\.ply: 1 of 40 points have no finite easting .* first at point 3"):
        first_chunk(path, "EPSG:32632", crs="EPSG:32632")


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_coordinates_that_are_not_finite_do_not_pass_through_a_transformation(tmp_path: Path, word: str) -> None:
    path = write_all(tmp_path)["ply"]
    path.write_text(path.read_text().replace("500003.0 ", f"{word} "))
    with pytest.raises(InputDataError, match=r"1 of 40 points have no finite easting .* first at point 3"):
        first_chunk(path, "EPSG:32632", crs="EPSG:32633")


def test_degrees_stated_to_be_metres_are_recognised(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n" + "".join(f"{9 + i * 1e-5},{48 + i * 1e-5},400\n" for i in range(20)))
    for stated in ("EPSG:32632", "EPSG:32633"):
        with pytest.raises(InputDataError, match=r"a\.csv: coordinates look like degrees"):
            first_chunk(path, "EPSG:32632", crs=stated)


def test_fewer_than_ten_points_are_refused_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n" + "".join(f"{5e5 + i},{5.3e6 + i},4\n" for i in range(9)))
    source = open_points(path, SourceOptions(crs="EPSG:32632"))
    with pytest.raises(InputDataError, match=r"a\.csv: 9 usable point\(s\), at least 10"):
        list(iter_programme_chunks(source, "EPSG:32632"))


def test_opening_a_table_does_not_import_gdal(tmp_path: Path) -> None:
    path = write_all(tmp_path)["csv"]
    program = (
        "import sys; from changedetect.io.points import read_points; "
        f"assert len(read_points({str(path)!r})) == 40; print('rasterio' in sys.modules, 'laspy' in sys.modules)"
    )
    root = str(Path(__file__).parents[2])
    run = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": root},
    )
    assert run.stdout.split() == ["False", "False"]


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
def test_real_lidar_reaches_the_sister_datum_within_a_metre(caplog: pytest.LogCaptureFixture) -> None:
    source = open_points(DATA / "ttp_lidar/ttp_2015_thinned.laz")
    with caplog.at_level(logging.WARNING):
        cloud = PointCloud.concatenate(list(iter_programme_chunks(source, "EPSG:32617")))
    original = source.read()
    np.testing.assert_array_equal(cloud.elevation, original.elevation)
    assert 0 < np.abs(cloud.northing - original.northing).max() < 1.0
