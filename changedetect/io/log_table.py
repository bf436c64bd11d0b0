"""Logs as comma-separated text with a header: columns by name, every complaint with file, line and column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from changedetect.errors import InputDataError, MissingInputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["LogTable", "read_log_table"]


@dataclass(frozen=True)
class LogTable:
    """
    Rows of a log.

    Parameters
    ----------
    path : path
    columns : tuple of str
        Names in the header, in order.
    line : array of int, shape (n,)
        Line in the file of each row, the first line being 1.
    cells : pandas.DataFrame
        Text of every cell.
    """

    path: Path
    columns: tuple[str, ...]
    line: IntArray
    cells: pd.DataFrame

    def __len__(self) -> int:
        return int(self.line.size)

    def numbers(self, name: str, *, may_be_empty: bool = False) -> FloatArray:
        """
        Column as float64.

        Parameters
        ----------
        name : str
        may_be_empty : bool
            Empty cells and NaN become NaN instead of an error.

        Raises
        ------
        InputDataError
            The column is missing, or a cell is not a finite number; the message names line and column.
        """
        self.require(name)
        text = self.cells[name]
        values = np.array(pd.to_numeric(text, errors="coerce"), dtype=np.float64)
        bad = ~np.isfinite(values)
        if may_be_empty:
            bad &= ~text.str.strip().str.lower().isin(["", "nan"]).to_numpy()
        if np.any(bad):
            row = int(np.flatnonzero(bad)[0])
            msg = (
                f"{self.path}, line {self.line[row]}, column {name}: {text.iloc[row]!r} is not a finite number "
                f"({int(bad.sum())} such cell(s)). Correct or remove the row(s)."
            )
            raise InputDataError(msg)
        return values

    def texts(self, name: str) -> tuple[str, ...]:
        """
        Column as text without surrounding blanks.

        Raises
        ------
        InputDataError
            The column is missing.
        """
        self.require(name)
        return tuple(str(cell).strip() for cell in self.cells[name])

    def has(self, *names: str) -> bool:
        """Whether all these columns are there."""
        return set(names) <= set(self.columns)

    def require(self, *names: str) -> None:
        """
        Refuse the table unless all these columns are there.

        Raises
        ------
        InputDataError
        """
        missing = [name for name in names if name not in self.columns]
        if missing:
            msg = (
                f"{self.path} has no column {', '.join(missing)}; its header says {', '.join(self.columns)}. "
                "Rename the columns: names carry their units."
            )
            raise InputDataError(msg)

    def keep(self, rows: BoolArray) -> LogTable:
        """Table of the rows that are True."""
        return LogTable(self.path, self.columns, self.line[rows], self.cells[rows])


def read_log_table(path: Path, required: Sequence[str] = ()) -> LogTable:
    """
    Read a log.

    Parameters
    ----------
    path : path
        Comma-separated, UTF-8, names in the first line that is not a comment (#).
    required : sequence of str
        Columns that must be there.

    Returns
    -------
    table : LogTable

    Raises
    ------
    MissingInputError
        There is no such file.
    InputDataError
        The file is empty, is not text, lines differ in their number of cells, or a required column is missing.
    """
    if not path.is_file():
        msg = f"No such file: {path}. A flight folder holds imu.csv, gps.csv and images.csv (or one PX4 .ulg log)."
        raise MissingInputError(msg)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        msg = f"{path} is not text: byte {error.start} is not UTF-8. Export the log as comma-separated text."
        raise InputDataError(msg) from error
    numbered = [
        (k, line) for k, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        msg = f"{path} is empty: it has no header and no rows. Export the log again."
        raise InputDataError(msg)
    columns = tuple(cell.strip() for cell in numbered[0][1].split(","))
    rows = [line.split(",") for _, line in numbered[1:]]
    for (line, _), row in zip(numbered[1:], rows, strict=True):
        if len(row) != len(columns):
            msg = (
                f"{path}, line {line}: {len(row)} cells where the header has {len(columns)} columns. The log is cut "
                "off or damaged there; remove the line or export it again."
            )
            raise InputDataError(msg)
    table = LogTable(
        path=path,
        columns=columns,
        line=np.array([line for line, _ in numbered[1:]], dtype=np.int64),
        cells=pd.DataFrame(rows, columns=list(columns), dtype=str),
    )
    table.require(*required)
    return table
