"""PLY: encodings, properties, other elements, damage."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError
from changedetect.io.points import SourceOptions, open_points, read_points
from changedetect.pointcloud import PointCloud

N = 25
COORDINATES = np.column_stack([634_000.5 + np.arange(N), 4_831_000.25 - np.arange(N), 75.125 + np.arange(N) / 8])
SIGMA = np.linspace(0.0625, 0.25, N).astype(np.float32)
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
FACES = [(0, 1, 2), (1, 2, 3, 4)]


def header(encoding: str, *body: str) -> bytes:
    return "\n".join(["ply", f"format {encoding} 1.0", "comment made by a test", *body, "end_header"]).encode() + b"\n"


def mesh(encoding: str, coordinate: str = "double") -> bytes:
    """Vertices with colour, confidence and sigma among their properties; faces behind them."""
    body = [f"element vertex {N}", "property uchar red", *(f"property {coordinate} {axis}" for axis in "xyz"),
            "property float confidence", "property float sigma", "element face 2",
            "property list uchar int vertex_indices"]  # fmt: skip
    out = header(encoding, *body)
    order = BYTE_ORDERS.get(encoding)
    if order is None:
        for (x, y, z), sigma in zip(COORDINATES, SIGMA, strict=True):
            out += f"255 {x!r} {y!r} {z!r} 0.5 {sigma!s}\n".replace("np.float64(", "").replace(")", "").encode()
        for face in FACES:
            out += (" ".join(map(str, (len(face), *face))) + "\n").encode()
        return out
    code = {"double": "d", "float": "f"}[coordinate]
    for (x, y, z), sigma in zip(COORDINATES, SIGMA, strict=True):
        out += struct.pack(f"{order}B3{code}ff", 255, x, y, z, 0.5, sigma)
    for face in FACES:
        out += struct.pack(f"{order}B{len(face)}i", len(face), *face)
    return out


def with_lists(encoding: str) -> bytes:
    """An element with lists before the vertices, and a list of varying length inside each vertex, before its x."""
    body = ["element camera 2", "property list uchar float lens", "property int id", f"element vertex {N}",
            "property list uint8 uint16 views", *(f"property float64 {axis}" for axis in "xyz")]  # fmt: skip
    out = header(encoding, *body)
    order = BYTE_ORDERS.get(encoding)
    for camera in range(2):
        lens = [1.5] * (camera + 2)
        if order is None:
            out += (" ".join(map(str, (len(lens), *lens, camera))) + "\n").encode()
        else:
            out += struct.pack(f"{order}B{len(lens)}fi", len(lens), *lens, camera)
    for i, (x, y, z) in enumerate(COORDINATES.tolist()):
        views = list(range(i % 4))
        if order is None:
            out += (" ".join(map(str, (len(views), *views, x, y, z))) + "\n").encode()
        else:
            out += struct.pack(f"{order}B{len(views)}H3d", len(views), *views, x, y, z)
    return out


def write(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    return path


def assert_same(cloud: PointCloud) -> None:
    np.testing.assert_array_equal(np.column_stack([cloud.easting, cloud.northing, cloud.elevation]), COORDINATES)


@pytest.mark.parametrize("encoding", ["ascii", *BYTE_ORDERS])
def test_vertices_are_read_whatever_the_encoding(tmp_path: Path, encoding: str) -> None:
    source = open_points(write(tmp_path, mesh(encoding)))
    assert source.n_points == N
    assert source.crs is None
    cloud = source.read()
    assert_same(cloud)
    assert_allclose(cloud.sigma, SIGMA, rtol=1e-7, atol=0)
    assert cloud.easting.dtype.isnative


@pytest.mark.parametrize("encoding", ["ascii", *BYTE_ORDERS])
def test_lists_before_and_inside_the_vertices_are_walked_over(tmp_path: Path, encoding: str) -> None:
    assert_same(read_points(write(tmp_path, with_lists(encoding))))


@pytest.mark.parametrize("make", [mesh, with_lists])
@pytest.mark.parametrize("encoding", ["ascii", *BYTE_ORDERS])
def test_the_size_of_chunks_changes_no_value(tmp_path: Path, encoding: str, make: object) -> None:
    source = open_points(write(tmp_path, make(encoding)))  # type: ignore[operator]
    chunks = list(source.iter_chunks(10))
    assert [len(chunk) for chunk in chunks] == [10, 10, 5]
    assert_same(PointCloud.concatenate(chunks))


def test_windows_line_ends_in_the_header_are_read(tmp_path: Path) -> None:
    content = mesh("ascii").replace(b"\n", b"\r\n")
    assert_same(read_points(write(tmp_path, content)))


def test_a_stated_sigma_replaces_the_property(tmp_path: Path) -> None:
    cloud = read_points(write(tmp_path, mesh("ascii")), SourceOptions(sigma=0.04, crs="EPSG:26917"))
    np.testing.assert_array_equal(cloud.sigma, np.full(N, 0.04))


def test_missing_elevations_are_left_out_when_declared(tmp_path: Path) -> None:
    content = mesh("ascii").replace(b" 75.25 ", b" nan ")
    path = write(tmp_path, content)
    assert len(read_points(path, SourceOptions(nodata=float("nan")))) == N - 1
    assert np.isnan(read_points(path).elevation).sum() == 1


def test_coordinates_too_large_for_32_bits_give_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        cloud = read_points(write(tmp_path, mesh("binary_little_endian", "float")))
    assert "32-bit numbers: at their size these are 0.5 m apart" in caplog.text
    assert_allclose(cloud.northing, COORDINATES[:, 1], rtol=0, atol=0.25)
    caplog.clear()
    read_points(write(tmp_path, mesh("binary_little_endian")))
    assert not caplog.records


@pytest.mark.parametrize("make", [mesh, with_lists])
@pytest.mark.parametrize("encoding", ["ascii", *BYTE_ORDERS])
@pytest.mark.parametrize("kept", [0.3, 0.6])
def test_a_truncated_file_is_refused(tmp_path: Path, encoding: str, make: object, kept: float) -> None:
    content = make(encoding)  # type: ignore[operator]
    start = content.index(b"end_header") + 11
    cut = content[: start + int(kept * (len(content) - start))]
    with pytest.raises(InputDataError, match=r"a\.ply(:? is truncated|: vertex)"):
        read_points(write(tmp_path, cut))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ply\nformat ascii 1.0\nelement vertex 2\n", "'end_header' is missing"),
        (header("ascii", "element vertex 0", "property float x", "property float y", "property float z"), "no points"),
        (header("ascii", "element vertex 3", "property float x", "property float y"), "need the properties x, y and z"),
        (header("ascii", "element face 3", "property float x"), "an element 'vertex'"),
        (header("binary_middle_endian", "element vertex 3"), "header line 2: cannot understand"),
        (header("ascii", "element vertex many"), "header line 4: cannot understand 'element vertex many'"),
        (header("ascii", "element vertex -5"), "header line 4"),
        (header("ascii", "property float x"), "header line 4"),
        (header("ascii", "element vertex 1", "property quaternion x"), "header line 5"),
        (
            header("ascii", "element vertex 1", *(f"property float {axis}" for axis in "xyz")) + b"1 2 three\n",
            "vertex 1 is '1 2 three' where 'x y z' is expected",
        ),
    ],
)
def test_damaged_files_are_refused_with_the_place(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(InputDataError, match=rf"a\.ply.*{message}"):
        read_points(write(tmp_path, content))
