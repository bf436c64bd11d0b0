"""Tables of points: every way they are written, what is ambiguous, which line is bad; and writing."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import CRSMismatchError, InputDataError, OutputError
from changedetect.io.points import SourceOptions, open_points, read_points
from changedetect.io.table import write_table
from changedetect.pointcloud import PointCloud

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).parents[3] / "shared" / "data"))
ROWS = [(240_100.5 + i, 647_862.25 - 2 * i, 925.125 + i / 8) for i in range(12)]
NAN = float("nan")


def lines(delimiter: str = ",", decimal: str = ".", extra: str = "") -> str:
    return "".join(delimiter.join(f"{v:.3f}".replace(".", decimal) for v in row) + extra + "\n" for row in ROWS)


def read(tmp_path: Path, text: str | bytes, name: str = "a.csv", **options: object) -> PointCloud:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_points(path, SourceOptions(**options))  # type: ignore[arg-type]


def assert_rows(cloud: PointCloud, rows: list[tuple[float, float, float]] = ROWS) -> None:
    np.testing.assert_array_equal(np.column_stack([cloud.easting, cloud.northing, cloud.elevation]), rows)


# forms


@pytest.mark.parametrize("header", ["", "x{0}y{0}z\n", "Easting{0}Northing{0}Elevation\n"])
@pytest.mark.parametrize(
    ("delimiter", "decimal"),
    [(",", "."), (", ", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", "."), ("   ", "."), (" ", ",")],
)
def test_delimiter_decimal_mark_and_header_are_found(tmp_path: Path, header: str, delimiter: str, decimal: str) -> None:
    assert_rows(read(tmp_path, header.format(delimiter) + lines(delimiter, decimal)))


@pytest.mark.parametrize(
    "header",
    ["easting_m,northing_m,elevation_m", "E,N,H", "X (m),Y [m],Z (m)", '"x","y","z"', "East,North,Height", "X,Y,DSM",
     "xcoord,ycoord,alt", "easting metres,northing metres,elev"],
)  # fmt: skip
def test_usual_column_names_are_recognised(tmp_path: Path, header: str) -> None:
    assert_rows(read(tmp_path, f"{header}\n{lines()}"))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_encodings_and_line_ends_of_other_systems_are_read(tmp_path: Path, encoding: str, newline: str) -> None:
    text = "x,y,z,where\n" + lines(extra=",Grünfläche")
    assert_rows(read(tmp_path, text.replace("\n", newline).encode(encoding)))


@pytest.mark.parametrize("comment", ["# made by hand\n# second line\n", "# x y z\n", "//X Y Z\n", "\n\n", "12\n"])
def test_comments_blank_lines_and_a_count_of_points_are_passed_over(tmp_path: Path, comment: str) -> None:
    assert_rows(read(tmp_path, f"{comment}{lines(' ')}\n# the end\n", "a.pts"))


def test_a_header_in_a_comment_gives_the_order(tmp_path: Path) -> None:
    text = "# a note, with commas, first\n# northing, easting, elevation\n" + "".join(
        f"{n},{e},{z}\n" for e, n, z in ROWS
    )
    assert_rows(read(tmp_path, text))


def test_columns_are_found_among_others_in_any_order(tmp_path: Path) -> None:
    text = "name,Northing,Easting,code,Elevation,sigma\n"
    text += "".join(f'P{i},{n},{e},"tree, big",{z},0.0{i % 9 + 1}\n' for i, (e, n, z) in enumerate(ROWS))
    cloud = read(tmp_path, text)
    assert_rows(cloud)
    assert cloud.sigma is not None
    assert_allclose(cloud.sigma[:3], [0.01, 0.02, 0.03], rtol=1e-15, atol=0)


def test_columns_beyond_the_third_of_a_table_without_header_are_ignored(tmp_path: Path) -> None:
    cloud = read(tmp_path, lines(" ", extra=" 120 130 140"), "a.xyz")
    assert_rows(cloud)
    assert cloud.sigma is None


def test_the_size_of_chunks_changes_no_value(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z\n" + lines())
    chunks = list(open_points(tmp_path / "a.csv").iter_chunks(5))
    assert [len(chunk) for chunk in chunks] == [5, 5, 2]
    assert_rows(PointCloud.concatenate(chunks))


def test_numbers_are_read_to_the_last_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    values = rng.uniform(0, 1e7, (200, 3))
    text = "x,y,z\n" + "".join(",".join(repr(float(v)) for v in row) + "\n" for row in values)
    cloud = read(tmp_path, text)
    np.testing.assert_array_equal(np.column_stack([cloud.easting, cloud.northing, cloud.elevation]), values)


# what the user states


def test_columns_by_name_pick_one_of_several(tmp_path: Path) -> None:
    header = "Name,Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height\n"
    text = header + "".join(f"P{i},{e},{n},{z},9,48,{z + 47}\n" for i, (e, n, z) in enumerate(ROWS))
    with pytest.raises(InputDataError, match=r"more than one way.*--columns easting,northing"):
        read(tmp_path, text)
    assert_rows(read(tmp_path, text, columns=("easting", "Northing", "ELEVATION")))
    cloud = read(tmp_path, text, columns=("longitude", "latitude", "ellipsoidal height"), crs="EPSG:4979")
    assert cloud.easting[0] == 9.0


def test_the_crs_chooses_between_degrees_and_metres(tmp_path: Path) -> None:
    text = "x,y,z,lon,lat\n" + lines(extra=",9.0,48.0")
    assert_rows(read(tmp_path, text, crs="EPSG:32632"))
    assert read(tmp_path, text, crs="EPSG:4326").northing[0] == 48.0


@pytest.mark.parametrize("columns", [("3", "2", "4"), ("_", "northing", "easting", "elevation", "_")])
def test_columns_of_a_table_without_header_by_position_or_name(tmp_path: Path, columns: tuple[str, ...]) -> None:
    text = "".join(f"{i},{n},{e},{z},stone\n" for i, (e, n, z) in enumerate(ROWS))
    assert_rows(read(tmp_path, text, columns=columns))


def test_stated_columns_that_are_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match=r"--columns x,y,q should name .* out of: x, y, z"):
        read(tmp_path, "x,y,z\n" + lines(), columns=("x", "y", "q"))
    with pytest.raises(InputDataError, match=r"has 3 columns, counted from 1; --columns 1,2,4"):
        read(tmp_path, lines(), columns=("1", "2", "4"))


def test_stated_columns_with_northing_first_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="puts northing first"):
        read(tmp_path, "northing,easting,z\n" + lines(), columns=("northing", "easting", "z"))


def test_a_stated_sigma_replaces_the_column(tmp_path: Path) -> None:
    cloud = read(tmp_path, "x,y,z,sigma\n" + lines(extra=","), sigma=0.03)
    np.testing.assert_array_equal(cloud.sigma, np.full(12, 0.03))


def test_a_sigma_in_a_table_with_heights_in_feet_becomes_metres(tmp_path: Path) -> None:
    cloud = read(tmp_path, "x,y,z,std\n" + lines(extra=",0.1"), crs="EPSG:2263+6360")
    assert_allclose(cloud.sigma, np.full(12, 0.1 * 1200 / 3937), rtol=1e-12, atol=0)


@pytest.mark.parametrize("empty", ["", "nan", "NA", " "])
def test_missing_elevations_are_left_out_only_when_declared(tmp_path: Path, empty: str) -> None:
    text = "x,y,z\n" + lines().replace("925.500", empty)
    with pytest.raises(InputDataError, match=r"a\.csv, line 5 .*: no elevation.*--nodata nan"):
        read(tmp_path, text)
    assert_rows(read(tmp_path, text, nodata=NAN), [row for row in ROWS if row[2] != 925.5])


def test_a_number_for_missing_elevations_is_left_out_when_declared(tmp_path: Path) -> None:
    text = "x,y,z\n" + lines().replace("925.500", "-9999")
    assert_rows(read(tmp_path, text, nodata=-9999.0), [row for row in ROWS if row[2] != 925.5])
    with pytest.raises(InputDataError, match=r"all 12 points have the elevation -1\.0"):
        read(tmp_path, "x,y,z\n" + "".join(f"{e},{n},-1\n" for e, n, _ in ROWS), nodata=-1.0)


# refusals


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("240102.500", "24O102.5", "easting is '24O102.5', not a number"),
        ("240102.500", "", "no easting"),
        ("647858.250", "nan", "no northing"),
        ("925.375", "inf", "elevation is 'inf', not finite"),
        ("925.375", "925.375,1,2", "5 fields where the first lines have 3"),
        ("925.375", "1,925.375", "4 fields where the first lines have 3"),
        (",925.375", "", "no elevation"),
    ],
)
def test_a_bad_line_is_named_with_its_number_and_text(tmp_path: Path, old: str, new: str, fault: str) -> None:
    text = "# a comment\nx,y,z\n" + lines().replace(old, new)
    bad = text.splitlines()[4]
    with pytest.raises(InputDataError) as caught:
        read(tmp_path, text)
    assert f"a.csv, line 5 ({bad!r}): {fault}" in str(caught.value)


def test_a_bad_line_far_behind_the_first_chunk_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n" + lines() * 1000 + "1,2,three\n" + lines() + "1,2,four\n")
    with pytest.raises(InputDataError, match=r"line 12002 .*'three', not a number \(2 such lines\)"):
        list(open_points(path).iter_chunks(1000))


def test_commas_as_decimal_marks_and_delimiters_are_refused(tmp_path: Path) -> None:
    for header in ("", "x,y,z\n"):
        with pytest.raises(InputDataError, match=r"6 fields where 3 columns are expected.*semicolons"):
            read(tmp_path, header + lines(",", ","))


def test_decimal_commas_and_points_in_one_table_are_refused(tmp_path: Path) -> None:
    text = "x;y;z\n" + "".join(f"240.100,5;647.862,25;925.{i}\n" for i in range(12))
    with pytest.raises(InputDataError, match="decimal comma and with a decimal point"):
        read(tmp_path, text.replace("240.100,5", "240100,5").replace("647.862,25", "647862,25"))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("a,b,c", "do not name easting, northing and elevation"),
        ("x,y,value", "do not name"),
        ("x,y,z,height", "more than one way"),
        ("x,y,z,xcoord", "more than one way"),
        ("easting,northing,elevation_ft", "elevation_ft are in feet"),
        ("x_ft,y_ft,z_ft", "x_ft, y_ft, z_ft are in feet"),
    ],
)
def test_columns_that_cannot_be_told_are_listed(tmp_path: Path, header: str, message: str) -> None:
    extra = ",1" * (header.count(",") - 2)
    with pytest.raises(InputDataError, match=message):
        read(tmp_path, f"{header}\n{lines(extra=extra)}")


def test_names_before_the_numbers_without_header_are_refused_with_the_fix(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="--columns 2,3,4"):
        read(tmp_path, "".join(f"P{i},{e},{n},{z}\n" for i, (e, n, z) in enumerate(ROWS)))


def test_degrees_and_metres_are_not_confused(tmp_path: Path) -> None:
    with pytest.raises(CRSMismatchError, match=r"'lon' and 'lat' are degrees .* EPSG:32632, is projected"):
        read(tmp_path, "lon,lat,height\n" + lines(), crs="EPSG:32632")
    with pytest.raises(CRSMismatchError, match=r"no degrees .* EPSG:4326, is geographic"):
        read(tmp_path, "easting,northing,height\n" + lines(), crs="EPSG:4326")


def test_degrees_without_header_need_their_order(tmp_path: Path) -> None:
    text = "".join(f"48.{i:03d} 9.{i:03d} 300.0\n" for i in range(12))
    with pytest.raises(InputDataError, match=r"--columns lon,lat,height or --columns lat,lon,height"):
        read(tmp_path, text, crs="EPSG:4326")
    cloud = read(tmp_path, text, crs="EPSG:4326", columns=("lat", "lon", "height"))
    assert (cloud.easting[1], cloud.northing[1]) == (9.001, 48.001)


@pytest.mark.parametrize("text", ["hello\nworld\n", "x,y,z\n", "1,2\n3,4\n", "# only comments\n", "\n\n\n"])
def test_a_text_without_coordinates_is_no_table(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputDataError, match=r"a\.csv: no table of coordinates"):
        read(tmp_path, text)


# writing


def test_a_table_written_is_read_back(tmp_path: Path) -> None:
    easting, northing, elevation = np.array(ROWS).T
    sigma = np.linspace(0.01, 0.12, 12)
    write_table(
        tmp_path / "out.csv",
        {"easting_m": easting, "northing_m": northing, "elevation_m": elevation, "sigma_m": sigma},
        decimals={"easting_m": 6},
    )
    cloud = read_points(tmp_path / "out.csv")
    assert_rows(cloud)
    assert_allclose(cloud.sigma, sigma, rtol=0, atol=0.5e-4)
    assert (tmp_path / "out.csv").read_text().splitlines()[1] == "240100.500000,647862.2500,925.1250,0.0100"
    assert [p.name for p in tmp_path.iterdir()] == ["out.csv"]


def test_no_data_becomes_an_empty_cell(tmp_path: Path) -> None:
    write_table(tmp_path / "out.csv", {"x": np.array([1.0, 2.0]), "elevation_m": np.array([np.nan, -0.00004])})
    assert (tmp_path / "out.csv").read_text() == "x,elevation_m\n1.0000,\n2.0000,0.0000\n"


def test_columns_of_different_length_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"one length; got a \(2,\), b \(3,\)"):
        write_table(tmp_path / "out.csv", {"a": np.zeros(2), "b": np.zeros(3)})
    with pytest.raises(ValueError, match="none"):
        write_table(tmp_path / "out.csv", {})
    assert not list(tmp_path.iterdir())


def test_a_table_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="Cannot write into"):
        write_table(tmp_path / "file" / "out.csv", {"a": np.zeros(2)})


# real surveys


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
@pytest.mark.parametrize("day", ["20170930", "20180926", "20191005"])
def test_a_real_survey_as_table_and_as_laz_is_the_same(day: str) -> None:
    table = read_points(DATA / f"gc_sandbar/0003L_{day}_points.csv")
    las = read_points(DATA / f"gc_sandbar/0003L_{day}_points.laz")
    for name in ("easting", "northing", "elevation"):
        assert_allclose(getattr(table, name), getattr(las, name), rtol=0, atol=0.0005)
