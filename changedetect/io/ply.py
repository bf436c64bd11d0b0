"""
Point clouds and meshes in PLY files [1]_: the vertices, whatever else the file holds.

References
----------
.. [1] Turk, G. (1994), The PLY polygon file format, Stanford University.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, BinaryIO, Literal

import numpy as np

from changedetect.errors import InputDataError
from changedetect.io.source import (
    CHUNK_SIZE,
    PointSource,
    SourceOptions,
    constant_sigma,
    drop_missing,
    report_dropped,
    settle_crs,
    sigma_in_metres,
)
from changedetect.pointcloud import PointCloud

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from changedetect.typing import FloatArray

__all__ = ["PlySource"]

logger = logging.getLogger(__name__)

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ENCODINGS: dict[str, Literal["", "<", ">"]] = {
    "ascii": "",
    "binary_little_endian": "<",
    "binary_big_endian": ">",
}
_SIGMA_NAMES = ("sigma", "sigma_z")
_MAX_HEADER = 1_000_000
#: Coordinates stored more coarsely than this (m) leave visible steps in a surface.
_COARSE = 0.005


@dataclass(frozen=True)
class _Property:
    """One value of an element, or a list of values after their number."""

    name: str
    dtype: str
    count_dtype: str | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(p.count_dtype is not None for p in self.properties)

    def dtype(self, byte_order: str) -> np.dtype[np.void]:
        """Record of one element; only where no property is a list."""
        return np.dtype([(f"{i}", byte_order + p.dtype) for i, p in enumerate(self.properties)])


class PlySource(PointSource):
    """
    Vertices of a PLY file.

    Parameters
    ----------
    path : path
    options : SourceOptions
        `crs` (PLY has no place for one), `sigma` and `nodata` apply. A vertex property `sigma` or `sigma_z` is read
        as the standard deviation of the elevation, in its unit.

    Raises
    ------
    InputDataError
        The header cannot be understood, names no vertices, or the file is too short for what it announces.
    CRSMismatchError
        The CRS stated cannot be understood.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        with path.open("rb") as stream:
            self._byte_order, self._elements = _read_header(stream, path)
            self._start = stream.tell()
        self._vertex = next(i for i, element in enumerate(self._elements) if element.name == "vertex")
        vertex = self._elements[self._vertex]
        if vertex.count == 0:
            msg = f"{path} holds no points: its header announces 0 vertices. Export it again."
            raise InputDataError(msg)
        names = [p.name.lower() for p in vertex.properties]
        single = [p.name.lower() for p in vertex.properties if p.count_dtype is None]
        if not {"x", "y", "z"} <= set(single):
            msg = f"{path}: the vertices need the properties x, y and z; they have {', '.join(names) or 'none'}."
            raise InputDataError(msg)
        self._columns = [names.index(name) for name in ("x", "y", "z", *(n for n in _SIGMA_NAMES if n in single))][:4]
        super().__init__(path, options, settle_crs(path, None, options.crs), vertex.count)

    def iter_chunks(self, chunk_size: int = CHUNK_SIZE) -> Iterator[PointCloud]:
        """
        Read the vertices in the order of the file; see `PointSource.iter_chunks`.

        Raises
        ------
        InputDataError
            The file ends early or a line is not what the header announces; all elevations are `nodata`.
        """
        n_read = n_kept = 0
        with self.path.open("rb") as stream:
            stream.seek(self._start)
            for element in self._elements[: self._vertex]:
                for _ in self._records(stream, element, [], chunk_size):
                    pass
            vertex = self._elements[self._vertex]
            for values in self._records(stream, vertex, self._columns, chunk_size):
                if n_read == 0:
                    self._warn_if_coarse(values)
                n_read += len(values)
                cloud = drop_missing(self._cloud(values), self.options.nodata)
                n_kept += len(cloud)
                if len(cloud):
                    yield cloud
        report_dropped(self.path, n_read - n_kept, n_read, self.options.nodata)

    def _cloud(self, values: FloatArray) -> PointCloud:
        columns = [np.ascontiguousarray(column) for column in values.T]
        sigma = constant_sigma(self.options, len(values))
        if sigma is None and len(columns) > 3:
            sigma = sigma_in_metres(columns[3], self.crs)
        return PointCloud(columns[0], columns[1], columns[2], sigma)

    def _records(
        self, stream: BinaryIO, element: _Element, columns: list[int], chunk_size: int
    ) -> Iterator[FloatArray]:
        """Chunks of an element's values, shape (n, len(columns)); the stream ends up behind the element."""
        if self._byte_order == "":
            yield from self._ascii_records(stream, element, columns, chunk_size)
        elif element.has_lists:
            yield from self._list_records(stream, element, columns, chunk_size)
        else:
            dtype = element.dtype(self._byte_order)
            for first in range(0, element.count, chunk_size):
                n = min(chunk_size, element.count - first)
                data = stream.read(n * dtype.itemsize)
                if len(data) < n * dtype.itemsize:
                    raise self._ends_early(element, first + len(data) // dtype.itemsize)
                records = np.frombuffer(data, dtype)
                yield _stack([records[str(i)] for i in columns], n)

    def _list_records(
        self, stream: BinaryIO, element: _Element, columns: list[int], chunk_size: int
    ) -> Iterator[FloatArray]:
        """Records of varying length have to be walked one by one."""
        for first in range(0, element.count, chunk_size):
            n = min(chunk_size, element.count - first)
            values = np.empty((n, len(columns)))
            for row in range(n):
                record = self._one_record(stream, element, first + row)
                values[row] = [record[i] for i in columns]
            yield values

    def _one_record(self, stream: BinaryIO, element: _Element, number: int) -> list[float]:
        record = []
        for prop in element.properties:
            n_values = 1
            if prop.count_dtype is not None:
                n_values = int(self._numbers(stream, prop.count_dtype, 1, element, number)[0])
            values = self._numbers(stream, prop.dtype, n_values, element, number)
            record.append(float("nan") if prop.count_dtype is not None else float(values[0]))
        return record

    def _numbers(self, stream: BinaryIO, dtype: str, n: int, element: _Element, number: int) -> FloatArray:
        kind = np.dtype(self._byte_order + dtype)
        data = stream.read(max(0, n) * kind.itemsize)
        if n < 0 or len(data) < n * kind.itemsize:
            raise self._ends_early(element, number)
        return np.frombuffer(data, kind).astype(np.float64)

    def _ascii_records(
        self, stream: BinaryIO, element: _Element, columns: list[int], chunk_size: int
    ) -> Iterator[FloatArray]:
        for first in range(0, element.count, chunk_size):
            n = min(chunk_size, element.count - first)
            lines = list(islice(stream, n))
            if len(lines) < n:
                raise self._ends_early(element, first + len(lines))
            if columns:
                yield np.array([self._ascii_fields(line, element, columns, first + i) for i, line in enumerate(lines)])

    def _ascii_fields(self, line: bytes, element: _Element, columns: list[int], number: int) -> list[float]:
        fields = line.split()
        try:
            if element.has_lists:
                places, place = [], 0
                for prop in element.properties:
                    places.append(place)
                    place += 1 if prop.count_dtype is None else 1 + int(fields[place])
                return [float(fields[places[i]]) for i in columns]
            return [float(fields[i]) for i in columns]
        except (IndexError, ValueError) as error:
            shown = line[:80].decode("utf-8", errors="replace").strip()
            expected = " ".join(prop.name for prop in element.properties)
            msg = f"{self.path}: {element.name} {number + 1} is {shown!r} where {expected!r} is expected."
            raise InputDataError(msg) from error

    def _ends_early(self, element: _Element, n_found: int) -> InputDataError:
        msg = (
            f"{self.path} is truncated: it announces {element.count} elements {element.name!r} and ends after "
            f"{n_found}. Copy or download it again."
        )
        return InputDataError(msg)

    def _warn_if_coarse(self, values: FloatArray) -> None:
        vertex = self._elements[self._vertex]
        is_single = any(vertex.properties[i].dtype == "f4" for i in self._columns[:2])
        step = float(np.spacing(np.float32(np.nanmax(np.abs(values[:, :2]))))) if self._byte_order else 0.0
        if is_single and step > _COARSE:
            logger.warning(
                "%s stores coordinates as 32-bit numbers: at their size these are %.3g m apart. Export it with double "
                "precision, or the ground will show steps.",
                self.path,
                step,
            )


def _stack(columns: list[FloatArray], n: int) -> FloatArray:
    values = np.empty((n, len(columns)))
    for i, column in enumerate(columns):
        values[:, i] = column
    return values


def _read_header(stream: BinaryIO, path: Path) -> tuple[Literal["", "<", ">"], list[_Element]]:
    """Byte order ("" for text) and elements; the stream ends up at the first value."""
    byte_order: Literal["", "<", ">"] | None = None
    elements: list[_Element] = []
    for number, line in enumerate(_header_lines(stream, path), start=1):
        words = line.split()
        try:
            if words[0] == "format":
                byte_order = _ENCODINGS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], _count(words[2]), ()))
            elif words[0] == "property":
                last = elements.pop()
                elements.append(_Element(last.name, last.count, (*last.properties, _property(words))))
        except (IndexError, KeyError, ValueError) as error:
            msg = f"{path}, header line {number}: cannot understand {line!r}. Export it again as PLY 1.0."
            raise InputDataError(msg) from error
    if byte_order is None or not any(element.name == "vertex" for element in elements):
        names = ", ".join(element.name for element in elements) or "none"
        msg = f"{path}: the PLY header needs a format and an element 'vertex'; its elements: {names}."
        raise InputDataError(msg)
    return byte_order, elements


def _header_lines(stream: BinaryIO, path: Path) -> Iterator[str]:
    while stream.tell() < _MAX_HEADER:
        raw = stream.readline(1000)
        if not raw:
            break
        line = raw.decode("ascii", errors="replace").strip()
        if line == "end_header":
            return
        if line:
            yield line
    msg = f"{path} is truncated or no PLY file: 'end_header' is missing."
    raise InputDataError(msg)


def _property(words: list[str]) -> _Property:
    if words[1] == "list":
        return _Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
    return _Property(words[2], _TYPES[words[1]])


def _count(word: str) -> int:
    count = int(word)
    if count < 0:
        raise ValueError(word)
    return count
