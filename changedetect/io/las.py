"""
Point clouds in LAS, LAZ and COPC files [1]_.

Points that their producer withdrew are never used: those flagged withheld or synthetic, and those classed as noise
(7 and 18) unless these classes are asked for. COPC is read as the LAZ file it is [2]_.

References
----------
.. [1] ASPRS (2019), LAS specification 1.4 - R15.
.. [2] COPC specification 1.0, https://copc.io.
"""

from __future__ import annotations

import io
import logging
import struct
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import laspy
import lazrs  # type: ignore[import-untyped]
import numpy as np

from changedetect.crs import to_wkt
from changedetect.errors import CRSMismatchError, InputDataError, OutputError
from changedetect.io.source import (
    CHUNK_SIZE,
    PointSource,
    SourceOptions,
    constant_sigma,
    settle_crs,
    sigma_in_metres,
)
from changedetect.pointcloud import PointCloud
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterator
    from datetime import date
    from pathlib import Path

    from numpy.typing import NDArray

    from changedetect.typing import BoolArray

__all__ = ["SIGMA_DIMENSION", "LasSource", "write_points"]

logger = logging.getLogger(__name__)

#: Extra dimension with the standard deviation of each elevation, in the unit of the heights.
SIGMA_DIMENSION = "sigma_z"
#: ASPRS classes low point (noise) and high noise.
_NOISE_CLASSES = (7, 18)
_SELECTION = (
    laspy.DecompressionSelection.XY_RETURNS_CHANNEL
    | laspy.DecompressionSelection.Z
    | laspy.DecompressionSelection.CLASSIFICATION
    | laspy.DecompressionSelection.FLAGS
    | laspy.DecompressionSelection.ALL_EXTRA_BYTES
)
_WKT_RECORD, _GEOKEY_RECORDS = 2112, (34735, 34736, 34737)
_MAX_INT32 = 2**31 - 1


class LasSource(PointSource):
    """
    Points of a LAS, LAZ or COPC file.

    Parameters
    ----------
    path : path
    options : SourceOptions
        `crs`, `sigma` and `classes` apply.

    Raises
    ------
    InputDataError
        The file is damaged, truncated, of an unknown version, or holds no points.
    CRSMismatchError
        Its CRS cannot be understood.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        _check_header(path)
        with _readable(path), laspy.open(path, laz_backend=_BACKENDS, decompression_selection=_SELECTION) as reader:
            header = reader.header
            if header.are_points_compressed and header.point_count:
                _check_chunks(path, header)
            found = _crs_in(header)
        if header.point_count == 0:
            msg = f"{path} holds no points: its header announces 0. Export it again."
            raise InputDataError(msg)
        super().__init__(path, options, settle_crs(path, found, options.crs), int(header.point_count))

    def iter_chunks(self, chunk_size: int = CHUNK_SIZE) -> Iterator[PointCloud]:
        """
        Read the points in the order of the file; see `PointSource.iter_chunks`.

        Raises
        ------
        InputDataError
            The file is damaged or truncated, or no point passes the filters: the message counts the classes there.
        """
        counts = np.zeros(256, np.int64)
        n_read = n_kept = n_flagged = 0
        with (
            _readable(self.path),
            laspy.open(self.path, laz_backend=_BACKENDS, decompression_selection=_SELECTION) as reader,
        ):
            for points in reader.chunk_iterator(chunk_size):
                classes = np.asarray(points.classification, dtype=np.uint8)
                flagged = _flagged(points)
                keep = self._wanted(classes) & ~flagged
                counts += np.bincount(classes, minlength=256)
                n_read += classes.size
                n_flagged += int(flagged.sum())
                cloud = self._cloud(points, classes)
                cloud = cloud if keep.all() else cloud.select(keep)
                n_kept += len(cloud)
                if len(cloud):
                    yield cloud
        if n_read != self.n_points:
            msg = f"{self.path} is truncated: its header announces {self.n_points} points, {n_read} could be read."
            raise InputDataError(msg)
        self._report(n_read, n_kept, n_flagged, counts)

    def _wanted(self, classes: NDArray[np.uint8]) -> BoolArray:
        if self.options.classes is None:
            return ~np.isin(classes, _NOISE_CLASSES)
        return np.isin(classes, self.options.classes)

    def _cloud(self, points: Any, classes: NDArray[np.uint8]) -> PointCloud:
        sigma = constant_sigma(self.options, classes.size)
        if sigma is None and SIGMA_DIMENSION in points.point_format.extra_dimension_names:
            sigma = sigma_in_metres(np.asarray(points[SIGMA_DIMENSION], dtype=np.float64), self.crs)
        return PointCloud(np.asarray(points.x), np.asarray(points.y), np.asarray(points.z), sigma, classes)

    def _report(self, n_read: int, n_kept: int, n_flagged: int, counts: NDArray[np.int64]) -> None:
        present = ", ".join(f"{code} ({counts[code]} points)" for code in np.flatnonzero(counts))
        if n_kept == 0:
            classes = self.options.classes
            wanted = "other than noise" if classes is None else f"of class {' or '.join(map(str, classes))}"
            msg = (
                f"{self.path}: no usable point {wanted}. Classes in the file: {present}; {n_flagged} of {n_read} "
                "points are flagged withheld or synthetic. Choose classes with --classes, or leave the option out."
            )
            raise InputDataError(msg)
        if n_kept < n_read:
            logger.info("%s: %d of %d points used; classes in the file: %s", self.path, n_kept, n_read, present)


def write_points(path: Path, cloud: PointCloud, crs: str, *, scale: float = 0.001, created: date | None = None) -> None:
    """
    Write a point cloud as LAZ (or LAS, by the suffix), atomically.

    Parameters
    ----------
    path : path
        An existing file is replaced.
    cloud : PointCloud
        Metres in `crs`. Sigma goes into the extra dimension `sigma_z` (float32).
    crs : str
        Written as WKT 1, which most readers of LAS expect; as WKT 2 where only that can express it: a projected CRS
        with ellipsoidal heights.
    scale : float, m
        Coordinates are rounded to this.
    created : date, optional
        Creation date in the header; today by default. With a fixed date the same points give the same bytes.

    Raises
    ------
    InputDataError
        There are no points, or they spread too far for whole numbers of `scale`.
    CRSMismatchError
        `crs` cannot be understood.
    OutputError
        The file cannot be written.

    Notes
    -----
    Version 1.4, point format 6. Coordinates are stored relative to whole metres at the south-west lower corner.
    """
    if len(cloud) == 0:
        msg = f"Nothing to write to {path}: the point cloud holds no points."
        raise InputDataError(msg)
    columns = (cloud.easting, cloud.northing, cloud.elevation)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.creation_date = created
    header.generating_software = "changedetect"
    header.scales = np.full(3, scale)
    header.offsets = np.array([np.floor(values.min()) for values in columns])
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(_wkt_for_las(crs)))
    if cloud.sigma is not None:
        header.add_extra_dim(laspy.ExtraBytesParams(SIGMA_DIMENSION, np.float32, "standard deviation of z"))
    integers = [np.rint((v - offset) / scale) for v, offset in zip(columns, header.offsets, strict=True)]
    if max(float(values.max()) for values in integers) > _MAX_INT32:
        msg = (
            f"The points for {path} spread over more than {_MAX_INT32 * scale:.0f} m, too far for a scale of {scale} m."
        )
        raise InputDataError(msg)
    record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    record.X, record.Y, record.Z = (values.astype(np.int32) for values in integers)
    record.return_number[:] = 1
    record.number_of_returns[:] = 1
    if cloud.classification is not None:
        record.classification[:] = cloud.classification
    if cloud.sigma is not None:
        record[SIGMA_DIMENSION] = cloud.sigma.astype(np.float32)
    with atomic_path(path) as temporary:
        _write(temporary, path, header, record)


def _write(temporary: Path, path: Path, header: laspy.LasHeader, record: Any) -> None:
    compress = path.suffix.lower() != ".las"
    try:
        with laspy.open(temporary, mode="w", header=header, do_compress=compress) as writer:
            writer.write_points(record)
    except (laspy.LaspyException, lazrs.LazrsError) as error:
        msg = f"Cannot write {path}: {error}. Free space, or choose another place to write to."
        raise OutputError(msg) from error


def _wkt_for_las(crs: str) -> str:
    try:
        return to_wkt(crs, "WKT1")
    except CRSMismatchError:
        return to_wkt(crs, "WKT2")


#: One thread per core where chunks allow it, else one.
_BACKENDS = (laspy.LazBackend.LazrsParallel, laspy.LazBackend.Lazrs)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn what laspy and its decompressor raise on damaged files into one error that names the file."""
    try:
        yield
    except (laspy.LaspyException, lazrs.LazrsError, struct.error, EOFError, OSError, ValueError) as error:
        if isinstance(error, InputDataError):
            raise
        raise InputDataError(_truncated_message(path, str(error) or type(error).__name__)) from error


def _check_header(path: Path) -> None:
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
    if n_extended and first_extended + 60 * n_extended > size:
        raise InputDataError(
            _truncated_message(path, f"{n_extended} records are announced at byte {first_extended}, after its end")
        )
    is_compressed = point_format & 0xC0
    if not is_compressed and start + n_points * record_size > size:
        n_held = max(0, size - start) // max(1, record_size)
        raise InputDataError(
            _truncated_message(path, f"its header announces {n_points} points, the file of {size} bytes holds {n_held}")
        )


def _check_chunks(path: Path, header: Any) -> None:
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
        record = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
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


def _flagged(points: Any) -> BoolArray:
    """Points withheld or synthetic."""
    flagged: BoolArray = np.asarray(points.withheld, dtype=bool) | np.asarray(points.synthetic, dtype=bool)
    return flagged


def _crs_in(header: Any) -> str | None:
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
