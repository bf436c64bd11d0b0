"""Places in a table, without elevations: where a model is to be asked."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from changedetect.errors import InputDataError, MissingInputError
from changedetect.typing import Coordinates, FloatArray

__all__ = ["iter_coordinates"]

_EASTING_NAMES = ("easting", "easting_m", "east", "e", "x")
_NORTHING_NAMES = ("northing", "northing_m", "north", "n", "y")
_ROWS_AT_A_TIME = 200_000


@contextmanager
def iter_coordinates(path: Path) -> Iterator[Iterator[Coordinates]]:
    """
    Open a CSV file of places.

    Parameters
    ----------
    path : Path
        Columns easting and northing (or x and y); without a header the first two.

    Yields
    ------
    blocks : iterator of (easting, northing), m
        Some rows at a time.

    Raises
    ------
    MissingInputError
        There is no such file.
    InputDataError
        It is no table of finite coordinates; the message names the line.
    """
    if not path.is_file():
        msg = f"No such file: {path}. Check the name and the folder."
        raise MissingInputError(msg)
    with path.open(encoding="utf-8-sig", newline="") as stream:
        yield _blocks(stream, path)


def _blocks(stream: TextIO, path: Path) -> Iterator[Coordinates]:
    """Yield easting and northing of some rows at a time."""
    rows = enumerate(csv.reader(stream), start=1)
    try:
        first = next(((line, row) for line, row in rows if row), None)
        if first is None:
            return
        columns = _columns(first[1], path)
        head = [first] if columns is None else []
        easting, northing = (0, 1) if columns is None else columns
        while True:
            block = [*head, *((line, row) for line, row in islice(rows, _ROWS_AT_A_TIME) if row)]
            head = []
            if not block:
                return
            yield _numbers(block, easting, path), _numbers(block, northing, path)
    except UnicodeDecodeError as error:
        msg = f"'{path}' is not a table of text: byte {error.start} is not UTF-8."
        raise InputDataError(msg) from error


def _columns(header: Sequence[str], path: Path) -> tuple[int, int] | None:
    """Return where easting and northing stand; None for a first row of numbers."""
    names = [name.strip().lower() for name in header]
    if names[:2] and all(_is_number(name) for name in names[:2]):
        if len(names) < 2:
            msg = f"'{path}', line 1: easting and northing are needed, separated by a comma; got {header!r}."
            raise InputDataError(msg)
        return None
    found = []
    for wanted in (_EASTING_NAMES, _NORTHING_NAMES):
        index = next((names.index(name) for name in wanted if name in names), None)
        if index is None:
            msg = (
                f"'{path}' has no column '{wanted[0]}' (or {', '.join(wanted[1:])}); its header says "
                f"{', '.join(header)}. Columns are separated by commas."
            )
            raise InputDataError(msg)
        found.append(index)
    return found[0], found[1]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(block: Sequence[tuple[int, Sequence[str]]], column: int, path: Path) -> FloatArray:
    values = np.empty(len(block))
    for index, (line, row) in enumerate(block):
        text = row[column] if column < len(row) else ""
        if not _is_number(text) or not math.isfinite(float(text)):
            msg = f"'{path}', line {line}: {text!r} is no finite coordinate in metres."
            raise InputDataError(msg)
        values[index] = float(text)
    return values
