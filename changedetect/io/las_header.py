"""
Headers of LAS files: whether they fit their file, and which CRS they state.

A damaged header must not reach the decompressor, which trusts its counts.
"""

from __future__ import annotations

import io
import struct
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import laspy
import lazrs  # type: ignore[import-untyped]

from changedetect.errors import InputDataError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["check_chunks", "check_header", "crs_of_header", "readable"]

_WKT_RECORD, _GEOKEY_RECORDS = 2112, (34735, 34736, 34737)


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn what laspy and its decompressor raise on damaged files into one error that names the file."""
    try:
        yield
    except (laspy.LaspyException, lazrs.LazrsError, struct.error, EOFError, OSError, ValueError) as error:
        if isinstance(error, InputDataError):
            raise
        raise InputDataError(_truncated_message(path, str(error) or type(error).__name__)) from error


def check_header(path: Path) -> None:
    """
    Refuse a header whose places and counts cannot be those of this file.

    Notes
    -----
    Byte positions are those of table 3 of the LAS specification. Done before laspy sees the file: with a damaged
    count it would read records that are not there for hours.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(375)
    if len(head) < 227:
        raise InputDataError(_truncated_message(path, f"the header needs 227 bytes, the file has {size}"))
    (header_size, start, n_records, point_format, record_size, n_points) = struct.unpack_from("<HIIBHI", head, 94)
    first_extended = n_extended = 0
    if head[25] >= 4 and len(head) == 375:
        first_extended, n_extended, n_points = struct.unpack_from("<QIQ", head, 235)
    if not 227 <= header_size <= start <= size or n_records * 54 > start - header_size:
        raise InputDataError(
            _truncated_message(
                path,
                f"its header announces points from byte {start} on, after {n_records} records; the file ends at {size}",
            )
        )
    if n_extended:
        _check_extended_records(path, first_extended, n_extended, size)
    is_compressed = point_format & 0xC0
    if not is_compressed and start + n_points * record_size > size:
        n_held = max(0, size - start) // max(1, record_size)
        raise InputDataError(
            _truncated_message(path, f"its header announces {n_points} points, the file of {size} bytes holds {n_held}")
        )


def _check_extended_records(path: Path, first: int, n_records: int, size: int) -> None:
    """Walk along the records behind the points (60 bytes of header and the length each states)."""
    place = first
    with path.open("rb") as stream:
        for _ in range(n_records):
            stream.seek(min(place + 20, size))
            length = stream.read(8)
            place += 60 + int.from_bytes(length, "little")
            if len(length) < 8 or place > size:
                raise InputDataError(_truncated_message(path, f"{n_records} records from byte {first} on pass its end"))


def check_chunks(path: Path, header: Any) -> None:
    """Refuse a LAZ file whose table of chunks is cut off, or does not hold the points the header announces."""
    size, start = path.stat().st_size, int(header.offset_to_point_data)
    with path.open("rb") as stream:
        stream.seek(start)
        table = int.from_bytes(stream.read(8), "little", signed=True)
        if table == -1:  # written by a program that could not seek: the place stands at the very end
            stream.seek(-8, io.SEEK_END)
            table = int.from_bytes(stream.read(8), "little", signed=True)
        if not start + 8 <= table <= size - 8:
            raise InputDataError(
                _truncated_message(path, f"its table of chunks should start at byte {table} of {size}")
            )
        stream.seek(table + 4)
        n_chunks = int.from_bytes(stream.read(4), "little")
        records = header.vlrs.get("LasZipVlr")
        if not records:
            raise InputDataError(_truncated_message(path, "the record that describes its compression is missing"))
        record = lazrs.LazVlr(records[0].record_data)
        if n_chunks > size or record.item_size() != header.point_format.size:
            raise InputDataError(_truncated_message(path, f"its table announces {n_chunks} chunks"))
        stream.seek(start)
        chunks = lazrs.read_chunk_table(stream, record)
    capacity = sum(n_points for n_points, _ in chunks)
    slack = 0 if record.uses_variable_size_chunks() else record.chunk_size()
    if not capacity - slack <= header.point_count <= capacity:
        raise InputDataError(
            _truncated_message(
                path, f"its header announces {header.point_count} points, its {n_chunks} chunks hold up to {capacity}"
            )
        )


def _truncated_message(path: Path, why: str) -> str:
    return f"{path} is damaged or truncated: {why}. Copy or download it again and compare its size."


def crs_of_header(header: Any) -> str | None:
    """CRS in the header: the WKT record or the GeoTIFF keys, whichever the header says counts, else the other."""
    records = [*header.vlrs, *(header.evlrs or [])]
    projection = {vlr.record_id: vlr.record_data_bytes() for vlr in records if vlr.user_id == "LASF_Projection"}
    wkt = projection.get(_WKT_RECORD, b"").split(b"\0")[0].decode("utf-8", errors="replace").strip() or None
    geokeys = tuple(projection.get(record, b"") for record in _GEOKEY_RECORDS)
    if header.global_encoding.wkt or not geokeys[0]:
        return wkt or (_crs_of_geokeys(*geokeys) if geokeys[0] else None)
    return _crs_of_geokeys(*geokeys) or wkt


def _crs_of_geokeys(directory: bytes, doubles: bytes, text: bytes) -> str | None:
    """
    WKT of the CRS that GeoTIFF keys describe, user-defined ones and vertical ones included.

    Notes
    -----
    LAS stores the very content of the three GeoTIFF tags [1]_, so the smallest TIFF around them lets GDAL decode it.

    References
    ----------
    .. [1] OGC 19-008r4 (2019), GeoTIFF standard 1.1, annex on configuration keys.
    """
    import rasterio
    from rasterio.io import MemoryFile

    tiff = _smallest_tiff(directory, doubles, text)
    with rasterio.Env(GTIFF_REPORT_COMPD_CS=True), MemoryFile(tiff) as memory, memory.open() as dataset:
        return None if dataset.crs is None else str(dataset.crs.to_wkt(version="WKT2_2019"))


def _smallest_tiff(directory: bytes, doubles: bytes, text: bytes) -> bytes:
    """TIFF of one black pixel that carries the three GeoTIFF tags."""
    short, long, ascii_, double = 3, 4, 2, 12
    tags: list[tuple[int, int, int, bytes]] = [
        (256, short, 1, struct.pack("<H", 1)),  # width
        (257, short, 1, struct.pack("<H", 1)),  # height
        (258, short, 1, struct.pack("<H", 8)),  # bits per sample
        (259, short, 1, struct.pack("<H", 1)),  # no compression
        (262, short, 1, struct.pack("<H", 1)),  # black is zero
        (273, long, 1, struct.pack("<I", 8)),  # the pixel's place
        (277, short, 1, struct.pack("<H", 1)),  # one band
        (278, short, 1, struct.pack("<H", 1)),  # rows per strip
        (279, long, 1, struct.pack("<I", 1)),  # bytes per strip
        (33550, double, 3, struct.pack("<3d", 1, 1, 0)),  # pixel size
        (33922, double, 6, struct.pack("<6d", 0, 0, 0, 0, 0, 0)),  # tie point
        (34735, short, len(directory) // 2, directory),
    ]
    if doubles:
        tags.append((34736, double, len(doubles) // 8, doubles))
    if text:
        tags.append((34737, ascii_, len(text), text))
    first_value = 10 + 2 + 12 * len(tags) + 4
    entries, values = b"", b""
    for tag, kind, count, data in tags:
        inline = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", first_value + len(values))
        entries += struct.pack("<HHI", tag, kind, count) + inline
        values += data + b"\0" * (len(data) % 2) if len(data) > 4 else b""
    return b"II*\0" + struct.pack("<I", 10) + b"\0\0" + struct.pack("<H", len(tags)) + entries + b"\0" * 4 + values
