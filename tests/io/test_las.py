"""LAS, LAZ and COPC: reading real files, filters, CRS records, damage; and writing."""

from __future__ import annotations

import logging
import os
import struct
from datetime import date
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import CRS

from changedetect.crs import crs_name, horizontal_epsg, is_same_horizontal, is_same_vertical, vertical_part
from changedetect.errors import ChangeDetectError, CRSMismatchError, InputDataError, OutputError
from changedetect.io.las import write_points
from changedetect.io.points import SourceOptions, open_points, read_points
from changedetect.pointcloud import PointCloud

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).parents[3] / "shared" / "data"))


def survey(n: int = 1000, seed: int = 1) -> PointCloud:
    rng = np.random.default_rng(seed)
    return PointCloud(
        rng.uniform(634_000, 634_100, n),
        rng.uniform(4_831_000, 4_831_100, n),
        rng.uniform(74, 80, n),
        rng.uniform(0.02, 0.2, n),
        rng.integers(1, 7, n),
    )


def write_las(path: Path, cloud: PointCloud, *, point_format: int = 6, version: str = "1.4", scale: float = 0.01,
              **dimensions: np.ndarray) -> None:  # fmt: skip
    """Write with laspy alone, as another program would."""
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [scale] * 3, [634_000.0, 4_831_000.0, -50.0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.easting, cloud.northing, cloud.elevation
    if cloud.classification is not None:
        las.classification = cloud.classification
    for name, values in dimensions.items():
        setattr(las, name, values)
    las.write(path)


def add_records(source: Path, target: Path, records: list[laspy.VLR], *, wkt_flag: bool = False) -> None:
    las = laspy.read(source)
    las.header.vlrs.extend(records)
    las.header.global_encoding.wkt = wkt_flag
    las.write(target)


def geokeys(*entries: tuple[int, int, int, int], doubles: tuple[float, ...] = (), text: str = "") -> list[laspy.VLR]:
    directory = struct.pack("<4H", 1, 1, 0, len(entries)) + b"".join(struct.pack("<4H", *entry) for entry in entries)
    records = [laspy.VLR("LASF_Projection", 34735, "", directory)]
    if doubles:
        records.append(laspy.VLR("LASF_Projection", 34736, "", struct.pack(f"<{len(doubles)}d", *doubles)))
    if text:
        records.append(laspy.VLR("LASF_Projection", 34737, "", text.encode() + b"\0"))
    return records


def wkt_record(text: str) -> laspy.VLR:
    return laspy.VLR("LASF_Projection", 2112, "", text.encode() + b"\0")


# reading


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("point_format", "version"), [(0, "1.2"), (3, "1.2"), (1, "1.3"), (6, "1.4"), (8, "1.4")])
def test_points_come_back_to_half_the_scale(tmp_path: Path, suffix: str, point_format: int, version: str) -> None:
    cloud, path = survey(), tmp_path / f"a{suffix}"
    write_las(path, cloud, point_format=point_format, version=version)
    source = open_points(path)
    read = source.read()
    assert source.n_points == len(read) == 1000
    assert source.crs is None
    for name in ("easting", "northing", "elevation"):
        assert_allclose(getattr(read, name), getattr(cloud, name), rtol=0, atol=0.005 + 1e-9)
    assert read.sigma is None
    np.testing.assert_array_equal(read.classification, cloud.classification)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_the_size_of_chunks_changes_no_value(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_las(path, survey(1003))
    source = open_points(path)
    whole = source.read()
    chunks = list(source.iter_chunks(100))
    assert [len(chunk) for chunk in chunks] == [100] * 10 + [3]
    joined = PointCloud.concatenate(chunks)
    np.testing.assert_array_equal(joined.easting, whole.easting)
    np.testing.assert_array_equal(joined.elevation, whole.elevation)


def test_only_the_classes_asked_for_are_kept(tmp_path: Path) -> None:
    cloud, path = survey(), tmp_path / "a.laz"
    write_las(path, cloud)
    read = read_points(path, SourceOptions(classes=(2, 6)))
    wanted = np.isin(cloud.classification, (2, 6))
    assert_allclose(read.easting, cloud.easting[wanted], rtol=0, atol=0.006)
    assert set(np.unique(read.classification)) == {2, 6}


def test_classes_that_are_not_there_are_refused_with_those_that_are(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_las(path, PointCloud(*(np.full(12, v) for v in (634_000.0, 4_831_000.0, 1.0)), None, [1] * 5 + [5] * 7))
    source = open_points(path, SourceOptions(classes=(2, 9)))
    with pytest.raises(InputDataError, match=r"a\.laz: no usable .* class 2 or 9.* 1 \(5 points\), 5 \(7 points\)"):
        source.read()


def test_withheld_and_synthetic_points_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cloud, path = survey(50), tmp_path / "a.laz"
    withheld, synthetic = np.arange(50) < 5, np.arange(50) >= 47
    write_las(path, cloud, withheld=withheld, synthetic=synthetic)
    with caplog.at_level(logging.INFO):
        read = read_points(path)
    assert_allclose(read.easting, cloud.easting[5:47], rtol=0, atol=0.006)
    assert "42 of 50 points used" in caplog.text
    write_las(path, cloud, withheld=np.ones(50, bool))
    with pytest.raises(InputDataError, match="50 of 50 points are flagged"):
        read_points(path)


def test_noise_classes_are_used_only_when_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_las(path, PointCloud(*(np.full(14, v) for v in (634_000.0, 4_831_000.0, 1.0)), None, [2] * 11 + [7, 18, 18]))
    assert len(read_points(path)) == 11
    assert len(read_points(path, SourceOptions(classes=(2, 18)))) == 13


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_extra_dimension_sigma_z_is_the_sigma(tmp_path: Path, dtype: type) -> None:
    cloud, path = survey(30), tmp_path / "a.laz"
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.add_extra_dim(laspy.ExtraBytesParams("sigma_z", dtype))
    header.offsets = [634_000, 4_831_000, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z, las.sigma_z = cloud.easting, cloud.northing, cloud.elevation, cloud.sigma
    las.write(path)
    read = read_points(path)
    assert_allclose(read.sigma, cloud.sigma, rtol=1e-6, atol=0)
    stated = read_points(path, SourceOptions(sigma=0.05))
    np.testing.assert_array_equal(stated.sigma, np.full(30, 0.05))


def test_sigma_in_a_file_with_heights_in_feet_becomes_metres(tmp_path: Path) -> None:
    cloud, path = survey(30), tmp_path / "a.laz"
    write_points(path, cloud, "EPSG:2263+6360")
    assert_allclose(read_points(path).sigma, cloud.sigma * (1200 / 3937), rtol=1e-6, atol=0)
    assert_allclose(read_points(path, SourceOptions(sigma=0.05)).sigma, np.full(30, 0.05), rtol=0, atol=0)


# the CRS


@pytest.mark.parametrize("crs", ["EPSG:26917", "EPSG:26917+5713", "EPSG:32632+4979", "EPSG:2193", "EPSG:2263+6360"])
def test_a_crs_written_is_the_crs_read(tmp_path: Path, crs: str) -> None:
    path = tmp_path / "a.laz"
    write_points(path, survey(), crs)
    found = open_points(path).require_crs()
    assert is_same_horizontal(found, crs)
    assert is_same_vertical(found, crs)


def test_wkt1_is_written_where_it_suffices(tmp_path: Path) -> None:
    """Readers of LAS expect OGC WKT 1."""
    path = tmp_path / "a.laz"
    write_points(path, survey(), "EPSG:26917+5713")
    with laspy.open(path) as reader:
        assert reader.header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith("COMPD_CS")
        assert reader.header.global_encoding.wkt
        assert reader.header.parse_crs().sub_crs_list[1].to_epsg() == 5713


@pytest.mark.parametrize(
    ("records", "horizontal", "vertical"),
    [
        (geokeys((1024, 0, 1, 1), (1025, 0, 1, 1), (3072, 0, 1, 32615)), 32615, None),
        (geokeys((1024, 0, 1, 1), (3072, 0, 1, 26917), (3076, 0, 1, 9001), (4096, 0, 1, 5713)), 26917, "EPSG:5713"),
        (geokeys((1024, 0, 1, 1), (3072, 0, 1, 2263), (3076, 0, 1, 9003), (4096, 0, 1, 6360), (4099, 0, 1, 9003)),
         2263, "EPSG:6360"),
        (geokeys((1024, 0, 1, 2), (2048, 0, 1, 4326)), 4326, None),
    ],
)  # fmt: skip
def test_geotiff_keys_are_understood(
    tmp_path: Path, records: list[laspy.VLR], horizontal: int, vertical: str | None
) -> None:
    write_las(tmp_path / "a.las", survey(), point_format=3, version="1.2")
    add_records(tmp_path / "a.las", tmp_path / "b.laz", records)
    crs = open_points(tmp_path / "b.laz").require_crs()
    assert horizontal_epsg(crs) == horizontal
    assert vertical_part(crs) == vertical


def test_geotiff_keys_of_a_projection_without_code_are_understood(tmp_path: Path) -> None:
    """A transverse Mercator about 9.5 degrees east, given by its parameters alone."""
    records = geokeys(
        (1024, 0, 1, 1), (1025, 0, 1, 1), (1026, 34737, 9, 0), (2048, 0, 1, 4326), (3072, 0, 1, 32767),
        (3074, 0, 1, 32767), (3075, 0, 1, 1), (3076, 0, 1, 9001), (3080, 34736, 1, 0), (3081, 34736, 1, 1),
        (3082, 34736, 1, 2), (3083, 34736, 1, 3), (3092, 34736, 1, 4),
        doubles=(9.5, 0.0, 500_000.0, 0.0, 0.9999), text="Site TM|",
    )  # fmt: skip
    write_las(tmp_path / "a.las", survey(), point_format=3, version="1.2")
    add_records(tmp_path / "a.las", tmp_path / "b.las", records)
    expected = "+proj=tmerc +lat_0=0 +lon_0=9.5 +k=0.9999 +x_0=500000 +y_0=0 +datum=WGS84 +units=m"
    assert is_same_horizontal(open_points(tmp_path / "b.las").require_crs(), expected)


def test_the_header_says_which_of_two_crs_records_counts(tmp_path: Path) -> None:
    records = [wkt_record(CRS("EPSG:26917").to_wkt("WKT1_GDAL")), *geokeys((1024, 0, 1, 1), (3072, 0, 1, 32617))]
    write_las(tmp_path / "a.las", survey(), point_format=3)
    for flag, code in ((True, 26917), (False, 32617)):
        add_records(tmp_path / "a.las", tmp_path / "b.las", records, wkt_flag=flag)
        assert horizontal_epsg(open_points(tmp_path / "b.las").require_crs()) == code


def test_the_crs_the_user_states_replaces_that_of_the_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.laz"
    write_points(path, survey(), "EPSG:32617")
    assert open_points(path, SourceOptions(crs="EPSG:26917+5713")).crs == "EPSG:26917+5713"
    assert "EPSG:26917+5713, replaces the one in the file" in caplog.text
    caplog.clear()
    open_points(path, SourceOptions(crs="EPSG:32617"))
    assert not caplog.records


def test_a_crs_that_cannot_be_understood_is_refused_unless_stated(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", survey())
    add_records(tmp_path / "a.las", tmp_path / "b.las", [wkt_record('PROJCS["broken')], wkt_flag=True)
    with pytest.raises(CRSMismatchError, match=r"b\.las: the CRS in the file cannot be understood.*--crs"):
        open_points(tmp_path / "b.las")
    assert open_points(tmp_path / "b.las", SourceOptions(crs="EPSG:26917")).crs == "EPSG:26917"


def test_an_empty_crs_record_is_no_crs(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", survey())
    add_records(tmp_path / "a.las", tmp_path / "b.las", [wkt_record("")], wkt_flag=True)
    source = open_points(tmp_path / "b.las")
    assert source.crs is None
    with pytest.raises(CRSMismatchError, match=r"b\.las does not say .* --crs EPSG:32632\+5773"):
        source.require_crs()


# damage


def test_a_file_without_points_is_refused(tmp_path: Path) -> None:
    for name in ("a.las", "a.laz"):
        empty = np.empty(0)
        write_las(tmp_path / name, PointCloud(empty, empty, empty))
        with pytest.raises(InputDataError, match=rf"{name} holds no points"):
            open_points(tmp_path / name)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("part", [0.01, 0.03, 0.2, 0.5, 0.97, 0.9999])
def test_a_truncated_file_is_refused_by_name(tmp_path: Path, suffix: str, part: float) -> None:
    whole, cut = tmp_path / f"a{suffix}", tmp_path / f"cut{suffix}"
    write_points(whole, survey(), "EPSG:26917")
    content = whole.read_bytes()
    cut.write_bytes(content[: int(part * len(content))])
    with pytest.raises(InputDataError, match=rf"cut{suffix}.*truncated") as caught:
        read_points(cut)
    assert caught.value.exit_code == 65


def test_a_header_that_announces_too_many_points_is_refused(tmp_path: Path) -> None:
    for name in ("a.las", "a.laz"):
        path = tmp_path / name
        write_points(path, survey(), "EPSG:26917")
        content = bytearray(path.read_bytes())
        content[247:255] = struct.pack("<Q", 70_000)
        path.write_bytes(content)
        with pytest.raises(InputDataError, match=rf"{name} is damaged or truncated: its header announces 70000 points"):
            open_points(path)


@pytest.mark.parametrize(
    ("position", "value"),
    [(100, struct.pack("<I", 2**31)), (96, struct.pack("<I", 2**31)), (235, struct.pack("<QI", 10, 2**31)),
     (94, struct.pack("<H", 9)), (131, struct.pack("<d", 0.0)), (155, struct.pack("<d", float("nan")))],
)  # fmt: skip
def test_absurd_headers_are_refused_at_once(tmp_path: Path, position: int, value: bytes) -> None:
    path = tmp_path / "a.las"
    write_points(path, survey(), "EPSG:26917")
    content = bytearray(path.read_bytes())
    content[position : position + len(value)] = value
    path.write_bytes(content)
    with pytest.raises(InputDataError, match=r"a\.las is damaged"):
        open_points(path)


def test_random_damage_never_escapes_as_another_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    whole, path = tmp_path / "whole.laz", tmp_path / "a.laz"
    write_points(whole, survey(200), "EPSG:26917")
    content = whole.read_bytes()
    messages = []
    for trial in range(150):
        damaged = bytearray(content)
        for _ in range(4):
            damaged[rng.integers(4, 400 if trial % 2 else len(content))] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_points(path)
        except ChangeDetectError as error:
            messages.append(str(error))
    assert len(messages) > 50
    assert all("a.laz" in message for message in messages)


# writing


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    cloud, path = survey(), tmp_path / "a.laz"
    write_points(path, cloud, "EPSG:26917", scale=0.0001)
    read = read_points(path)
    for name in ("easting", "northing", "elevation"):
        assert_allclose(getattr(read, name), getattr(cloud, name), rtol=0, atol=0.00005 + 1e-9)
    assert_allclose(read.sigma, cloud.sigma, rtol=1e-7, atol=0)  # float32
    np.testing.assert_array_equal(read.classification, cloud.classification)
    assert [p.name for p in tmp_path.iterdir()] == ["a.laz"]


def test_without_sigma_none_is_written(tmp_path: Path) -> None:
    cloud = survey()
    write_points(tmp_path / "a.laz", PointCloud(cloud.easting, cloud.northing, cloud.elevation), "EPSG:26917")
    assert read_points(tmp_path / "a.laz").sigma is None


def test_the_suffix_decides_on_compression(tmp_path: Path) -> None:
    for name, compressed in (("a.las", False), ("a.laz", True)):
        write_points(tmp_path / name, survey(), "EPSG:26917")
        with laspy.open(tmp_path / name) as reader:
            assert reader.header.are_points_compressed == compressed
            assert (str(reader.header.version), reader.header.point_format.id) == ("1.4", 6)
    assert (tmp_path / "a.laz").stat().st_size < 0.8 * (tmp_path / "a.las").stat().st_size


def test_the_same_points_and_date_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.laz", "b.laz"):
        write_points(tmp_path / name, survey(), "EPSG:26917", created=date(2024, 5, 1))
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()
    with laspy.open(tmp_path / "a.laz") as reader:
        assert reader.header.creation_date == date(2024, 5, 1)


def test_points_that_spread_too_far_for_the_scale_are_refused(tmp_path: Path) -> None:
    cloud = PointCloud(np.array([0.0, 3e6]), np.zeros(2), np.zeros(2))
    with pytest.raises(InputDataError, match="spread over more than 2147484 m"):
        write_points(tmp_path / "a.laz", cloud, "EPSG:26917")
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_for_no_points_or_no_crs(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="holds no points"):
        write_points(tmp_path / "a.laz", survey(0), "EPSG:26917")
    with pytest.raises(CRSMismatchError, match="Cannot understand"):
        write_points(tmp_path / "a.laz", survey(), "nowhere")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match=r"Cannot write into .*file"):
        write_points(tmp_path / "file" / "a.laz", survey(), "EPSG:26917")


# COPC


def write_copc(path: Path, cloud: PointCloud, wkt: str) -> None:
    """Write the smallest COPC file: a root node and one child, in LAZ chunks of different size (COPC 1.0)."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    scales, offsets = [0.001] * 3, [634_000.0, 4_831_000.0, 0.0]
    header.scales, header.offsets = scales, offsets
    record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    record.x, record.y, record.z = cloud.easting, cloud.northing, cloud.elevation
    record.return_number[:] = record.number_of_returns[:] = 1
    raw = record.array.view(np.uint8)
    laszip = lazrs.LazVlr.new_for_compression(6, 0, True)

    def vlr(user: bytes, number: int, data: bytes) -> bytes:
        return struct.pack("<H16sHH32s", 0, user, number, len(data), b"") + data

    low = [float(v.min()) for v in (cloud.easting, cloud.northing, cloud.elevation)]
    high = [float(v.max()) for v in (cloud.easting, cloud.northing, cloud.elevation)]
    tail = [vlr(b"laszip encoded", 22204, bytes(laszip.record_data())),
            vlr(b"LASF_Projection", 2112, wkt.encode() + b"\0")]  # fmt: skip
    start = 375 + 54 + 160 + sum(map(len, tail))
    n_root = len(cloud) // 3
    with path.open("wb+") as stream:
        stream.write(b"\0" * start)
        compressor = lazrs.LasZipCompressor(stream, laszip)
        compressor.reserve_offset_to_chunk_table()
        compressor.compress_many(raw[: n_root * 30])
        compressor.finish_current_chunk()
        middle = stream.tell()
        compressor.compress_many(raw[n_root * 30 :])
        compressor.finish_current_chunk()
        after = stream.tell()
        compressor.done()
        stream.seek(0, 2)
        hierarchy = stream.tell()
        entries = struct.pack("<4iQii", 0, 0, 0, 0, start + 8, middle - start - 8, n_root)
        entries += struct.pack("<4iQii", 1, 0, 0, 0, middle, after - middle, len(cloud) - n_root)
        stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(entries), b"") + entries)
        stream.seek(0)
        counts = struct.pack("<I5I", 0, 0, 0, 0, 0, 0)
        stream.write(struct.pack("<4sHH16sBB32s32sHHHIIBH", b"LASF", 0, 16, b"", 1, 4, b"", b"", 1, 2024, 375, start, 3,
                                 6 | 0x80, 30) + counts)  # fmt: skip
        stream.write(struct.pack("<6d", *scales, *offsets))
        stream.write(struct.pack("<6d", high[0], low[0], high[1], low[1], high[2], low[2]))
        stream.write(struct.pack("<QQIQ15Q", 0, hierarchy, 1, len(cloud), len(cloud), *[0] * 14))
        half = max(h - v for h, v in zip(high, low, strict=True)) / 2
        centre = [(h + v) / 2 for h, v in zip(high, low, strict=True)]
        info = struct.pack("<5d2Q2d", *centre, half, half / 64, hierarchy + 60, len(entries), 0.0, 0.0)
        stream.write(vlr(b"copc", 1, info.ljust(160, b"\0")) + b"".join(tail))


def test_a_copc_file_is_read_whole(tmp_path: Path) -> None:
    cloud, path = survey(3000), tmp_path / "a.copc.laz"
    write_copc(path, cloud, CRS("EPSG:26917+5713").to_wkt("WKT1_GDAL"))
    with laspy.CopcReader.open(path) as reader:  # it is a COPC file, says an independent reader
        assert len(reader.query(level=0)) == 1000
    source = open_points(path)
    assert is_same_vertical(source.require_crs(), "EPSG:26917+5713")
    read = source.read()
    assert len(read) == source.n_points == 3000
    assert_allclose(read.easting, cloud.easting, rtol=0, atol=0.0005 + 1e-9)
    assert_allclose(read.elevation, cloud.elevation, rtol=0, atol=0.0005 + 1e-9)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputDataError, match="truncated"):
        open_points(path)


# real surveys


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
@pytest.mark.parametrize(
    ("name", "n_points", "epsg", "lowest", "highest"),
    [
        ("ttp_lidar/ttp_2015.laz", 137_040, 26917, 74.36, 101.62),
        ("ttp_lidar/ttp_2015_thinned.laz", 89_815, 26917, 74.30, 101.13),
        ("ttp_lidar/ttp_2023_thinned.laz", 81_473, 26917, None, None),  # less 37 low and 5 high noise points
        ("gc_sandbar/0003L_20170930_points.laz", 1_984, 6404, 920.142, 929.226),
        ("gc_sandbar/0003L_20180926_points.laz", 1_929, 6404, 920.420, 927.280),
        ("gc_sandbar/0003L_20191005_points.laz", 1_297, 6404, 920.516, 927.624),
        ("uav_brighton_beach/model.laz", 940_393, 32615, 156.06, 168.92),
    ],
)
def test_real_surveys_are_read(
    name: str, n_points: int, epsg: int, lowest: float | None, highest: float | None
) -> None:
    source = open_points(DATA / name)
    cloud = source.read()
    assert len(cloud) == n_points
    assert horizontal_epsg(source.require_crs()) == epsg, crs_name(source.require_crs())
    if lowest is not None:
        assert_allclose([cloud.elevation.min(), cloud.elevation.max()], [lowest, highest], rtol=0, atol=1e-9)


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
def test_the_ground_of_a_real_survey_can_be_chosen() -> None:
    cloud = read_points(DATA / "ttp_lidar/ttp_2015.laz", SourceOptions(classes=(2,)))
    assert len(cloud) == 57_143
    with pytest.raises(InputDataError, match=r"class 9.*2 \(57143 points\), 3 \(38299 points\)"):
        read_points(DATA / "ttp_lidar/ttp_2015.laz", SourceOptions(classes=(9,)))
