"""Points in text tables (CSV, XYZ, TXT, PTS): reading them in chunks, and writing predictions."""

from __future__ import annotations

import logging
import math
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

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
from changedetect.io.table_format import TableFormat, is_number, sniff_table, split_line
from changedetect.pointcloud import PointCloud
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from changedetect.typing import FloatArray

__all__ = ["TableSource", "write_table"]

logger = logging.getLogger(__name__)

_NO_ELEVATION = "no elevation"
_ROLES = ("easting", "northing", "elevation", "sigma")


class TableSource(PointSource):
    """
    Points of a text table.

    Parameters
    ----------
    path : path
    options : SourceOptions
        `crs` (a table has none of its own), `sigma`, `columns` and `nodata` apply.

    Raises
    ------
    InputDataError
        The table cannot be understood, or its columns can be understood in two ways.
    CRSMismatchError
        The columns are degrees and the CRS stated is not, or the reverse.

    Notes
    -----
    Delimiters are comma, semicolon, tab or blanks; decimal marks point or comma. Lines that start with ``#`` or
    ``//`` before the data, and anything after ``#``, are comments. An empty cell, a NaN, a word where a number
    belongs or a line with too few or too many fields is refused with its line number: dropping it silently would hide
    a broken export. Empty and NaN elevations are left out when the user states ``--nodata nan``.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        crs = settle_crs(path, None, options.crs)
        self.format = sniff_table(path, options)
        super().__init__(path, options, crs, None)

    def iter_chunks(self, chunk_size: int = CHUNK_SIZE) -> Iterator[PointCloud]:
        """
        Read the points in the order of the lines; see `PointSource.iter_chunks`.

        Raises
        ------
        InputDataError
            A line is not what the first ones promise: named by its number and text. Or all elevations are `nodata`.
        """
        n_read = n_kept = 0
        with self._open(chunk_size) as reader:
            while (values := self._next(reader)) is not None:
                n_read += len(values)
                cloud = drop_missing(self._cloud(values), self.options.nodata)
                n_kept += len(cloud)
                if len(cloud):
                    yield cloud
        report_dropped(self.path, n_read - n_kept, n_read, self.options.nodata)

    def _open(self, chunk_size: int) -> Any:
        fmt = self.format
        return pd.read_csv(
            self.path,
            sep=r"\s+" if fmt.delimiter is None else fmt.delimiter,
            header=None,
            names=range(fmt.n_fields),  # no usecols: with it pandas drops surplus fields without a word
            index_col=False,
            skiprows=fmt.first_line - 1,
            dtype=dict.fromkeys(fmt.columns, np.float64),
            decimal=fmt.decimal,
            comment="#",
            skipinitialspace=True,
            chunksize=chunk_size,
            encoding=fmt.encoding,
            encoding_errors="replace",
            compression=None,
        )

    def _next(self, reader: Any) -> FloatArray | None:
        """Next chunk, shape (n, 3 or 4); None at the end."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", pd.errors.DtypeWarning)  # of columns that are not used
                frame = next(reader)
        except StopIteration:
            return None
        except (ValueError, pd.errors.ParserError) as error:
            raise self._bad_line(str(error)) from error
        values = np.column_stack([frame[column].to_numpy() for column in self.format.columns])
        usable = np.isfinite(values)
        if self.options.nodata is not None and math.isnan(self.options.nodata):
            usable[:, 2] |= np.isnan(values[:, 2])
        if not usable.all():
            reason = "a value is missing or not finite"
            raise self._bad_line(reason)
        return values

    def _cloud(self, values: FloatArray) -> PointCloud:
        columns = [np.ascontiguousarray(column) for column in values.T]
        sigma = constant_sigma(self.options, len(values))
        if sigma is None and len(columns) > 3:
            sigma = sigma_in_metres(columns[3], self.crs)
        return PointCloud(columns[0], columns[1], columns[2], sigma)

    def _bad_line(self, reason: str) -> InputDataError:
        """Find the first line that cannot be used; a slow second reading, on the way out only."""
        n_bad, first = 0, ""
        with self.path.open(encoding=self.format.encoding, errors="replace") as stream:
            for number, line in enumerate(stream, start=1):
                why = None if number < self.format.first_line else _fault(line, self.format, self.options.nodata)
                if why is None:
                    continue
                n_bad += 1
                first = first or f"line {number} ({line.strip()[:80]!r}): {why}"
        if not first:
            return InputDataError(f"{self.path} cannot be read as a table: {reason}.")
        more = f" ({n_bad} such lines)" if n_bad > 1 else ""
        hint = " To leave out lines without elevation, state --nodata nan." if first.endswith(_NO_ELEVATION) else ""
        return InputDataError(f"{self.path}, {first}{more}. Correct or remove it.{hint}")


def write_table(path: Path, columns: Mapping[str, FloatArray], *, decimals: int | Mapping[str, int] = 4) -> None:
    """
    Write columns of numbers as CSV, atomically.

    Parameters
    ----------
    path : path
        An existing file is replaced.
    columns : mapping of name to array, shape (n,)
        Names go into the header as given: end them in their unit (`easting_m`, `elevation_std_m`), so that the reader
        here and other programs know them. NaN becomes an empty cell.
    decimals : int or mapping of name to int
        Digits after the point; 4 (0.1 mm) where a mapping does not say.

    Raises
    ------
    ValueError
        Columns differ in length, or there are none.
    OutputError
        The file cannot be written.
    """
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in columns.items()}
    if not arrays or len({values.shape for values in arrays.values()}) != 1:
        shapes = ", ".join(f"{name} {values.shape}" for name, values in arrays.items()) or "none"
        msg = f"A table needs columns of one length; got {shapes}."
        raise ValueError(msg)
    digits = {name: decimals if isinstance(decimals, int) else decimals.get(name, 4) for name in arrays}
    text = {name: _formatted(values, digits[name]) for name, values in arrays.items()}
    with atomic_path(path) as temporary:
        pd.DataFrame(text).to_csv(temporary, index=False, lineterminator="\n")


def _formatted(values: FloatArray, decimals: int) -> list[str]:
    pattern = f"%.{decimals}f"
    rounded = np.round(values, decimals) + 0.0  # no minus sign before a zero
    return ["" if math.isnan(value) else pattern % value for value in rounded.tolist()]


def _fault(line: str, fmt: TableFormat, nodata: float | None) -> str | None:
    """Why a line of data cannot be used; None where it can, or holds none."""
    content = line.split("#", 1)[0]
    if not content.strip():
        return None
    fields = split_line(content, fmt.delimiter)
    if len(fields) > fmt.n_fields:
        return f"{len(fields)} fields where the first lines have {fmt.n_fields}"
    for role, column in zip(_ROLES, fmt.columns, strict=False):
        field = fields[column] if column < len(fields) else ""
        value = field.replace(",", ".") if fmt.decimal == "," else field
        if field == "" or value.lower() in _MISSING_WORDS:
            if role != "elevation" or nodata is None or not math.isnan(nodata):
                return f"no {role}"
        elif not is_number(field, fmt.decimal):
            return f"{role} is {field!r}, not a number"
        elif not math.isfinite(float(value)):
            return f"{role} is {field!r}, not finite"
    return None


#: What pandas takes for a missing number besides an empty cell.
_MISSING_WORDS = frozenset(
    {"nan", "-nan", "na", "n/a", "#n/a", "#na", "null", "none", "<na>", "1.#ind", "1.#qnan", "-1.#ind", "-1.#qnan"}
)
