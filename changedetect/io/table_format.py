"""
How a text table of points is written: encoding, delimiter, decimal mark, header, and which columns hold what.

Everything is concluded from the first lines. Where they leave two readings the table is refused and the message says
how to state the right one.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from changedetect.crs import is_geographic
from changedetect.errors import CRSMismatchError, InputDataError

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.io.source import SourceOptions

__all__ = ["TableFormat", "is_number", "sniff_table", "split_line"]

_HEAD_BYTES = 65_536
_N_LINES = 50
_COMMENTS = ("#", "//")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$|[+-]?(nan|inf|infinity)$", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?$")
_UNIT = re.compile(
    r"[\s_]*(?:[\[(]\s*(m|metres?|meters?|deg|degrees?|°)\s*[\])]|[\s_](m|metres?|meters?|deg|degrees?))$"
)
_FOOT_UNIT = re.compile(r"[\s_\[(](ft|feet|foot|usft|us_ft|ftus)[\])]?$")

#: (easting, northing) names, each a kind of its own; which are longitude and latitude.
_HORIZONTAL: tuple[tuple[frozenset[str], frozenset[str], bool], ...] = (
    (frozenset({"easting", "eastings", "east"}), frozenset({"northing", "northings", "north"}), False),
    (frozenset({"x", "x_coord", "xcoord", "coord_x"}), frozenset({"y", "y_coord", "ycoord", "coord_y"}), False),
    (frozenset({"e"}), frozenset({"n"}), False),
    (frozenset({"lon", "long", "longitude", "lng"}), frozenset({"lat", "latitude"}), True),
)
_ELEVATION = frozenset({
    "elevation", "elev", "z", "h", "height", "alt", "altitude", "z_coord", "zcoord", "coord_z",
    "ellipsoidal height", "ellipsoidal_height", "orthometric height", "orthometric_height", "dem", "dsm", "dtm",
})  # fmt: skip
_SIGMA = frozenset({"sigma", "sigma_z", "sigmaz", "std", "std_z", "stdev", "stddev", "sd", "elevation_std", "z_std"})


@dataclass(frozen=True)
class TableFormat:
    """
    How to read a table.

    Attributes
    ----------
    encoding : str
    delimiter : str or None
        None stands for runs of blanks.
    decimal : "." or ","
    names : tuple of str, or None
        Header, where there is one.
    n_fields : int
        Fields of a line.
    first_line : int
        Number of the first line with data, from 1.
    columns : tuple of int
        Positions, from 0, of easting, northing, elevation and, where it is there, sigma.
    """

    encoding: str
    delimiter: str | None
    decimal: str
    names: tuple[str, ...] | None
    n_fields: int
    first_line: int
    columns: tuple[int, ...]


def sniff_table(path: Path, options: SourceOptions) -> TableFormat:
    """
    Conclude how a table is written.

    Parameters
    ----------
    path : path
    options : SourceOptions
        `columns` and `crs` decide between columns.

    Raises
    ------
    InputDataError
        No line holds three numbers, decimal commas cannot be told from delimiters, or the columns are ambiguous,
        missing or in feet.
    CRSMismatchError
        The columns are longitude and latitude and the CRS is projected, or the reverse.
    """
    encoding, lines = _first_lines(path)
    comments = [(i, line) for i, line in lines if line.lstrip().startswith(_COMMENTS)]
    content = [(i, _without_comment(line)) for i, line in lines if _without_comment(line)]
    content = content[1:] if len(content) > 1 and content[0][1].isdigit() else content  # PTS: number of points
    first = next((i for i, (_, line) in enumerate(content) if _has_three_numbers(line)), None)
    if first is None or first > 1:
        shown = content[0][1][:80] if content else ""
        msg = (
            f"{path}: no table of coordinates. A header of at most one line and then lines with easting, northing and "
            f"elevation are expected; the file starts with {shown!r}."
        )
        raise InputDataError(msg)
    first_line, data = content[first][0], [line for _, line in content[first : first + _N_LINES]]
    delimiter, decimal = _delimiter(path, data)
    fields = split_line(data[0], delimiter)
    names = tuple(split_line(content[0][1], delimiter)) if first else None
    if names is None:
        names = _commented_header(comments, first_line, delimiter, len(fields))
    if options.columns is None:
        _refuse_split_numbers(path, names, data, delimiter)
    n_fields = max(len(fields), len(names or ()))
    columns = _choose_columns(path, names, fields, n_fields, options)
    if options.sigma is not None:
        columns = columns[:3]
    return TableFormat(encoding, delimiter, decimal, names, n_fields, first_line, columns)


def split_line(line: str, delimiter: str | None) -> list[str]:
    """Fields of a line; quoted fields may hold the delimiter."""
    if delimiter is None:
        return line.split()
    fields = next(csv.reader(io.StringIO(line), delimiter=delimiter, skipinitialspace=True), [])
    return [field.strip() for field in fields]


def is_number(field: str, decimal: str) -> bool:
    """Whether a field is a number with this decimal mark."""
    return bool(_NUMBER.match(field) or (decimal == "," and _DECIMAL_COMMA.match(field)))


def _first_lines(path: Path) -> tuple[str, list[tuple[int, str]]]:
    """Encoding and the first lines with their numbers; the last one, perhaps cut off, is left out."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    encoding = "utf-8-sig" if head.startswith(b"\xef\xbb\xbf") else "utf-8"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    lines = head.decode(encoding, errors="replace").splitlines()
    if len(head) == _HEAD_BYTES and len(lines) > 1:
        lines.pop()
    return encoding, list(enumerate(lines, start=1))


def _without_comment(line: str) -> str:
    """Line up to a ``#``, or nothing where it starts with a comment mark; without surrounding blanks."""
    return "" if line.lstrip().startswith(_COMMENTS) else line.split("#", 1)[0].strip()


def _has_three_numbers(line: str) -> bool:
    return any(_n_numbers(line, delimiter) >= 3 for delimiter in ("\t", ";", ",", None))


def _n_numbers(line: str, delimiter: str | None) -> int:
    return sum(is_number(field, "," if delimiter != "," else ".") for field in split_line(line, delimiter))


def _delimiter(path: Path, data: list[str]) -> tuple[str | None, str]:
    """Delimiter and decimal mark under which all lines have three numbers or more, and the most fields agree."""
    for delimiter in ("\t", ";", ",", None):
        enough = sum(_n_numbers(line, delimiter) >= 3 for line in data)
        if 2 * enough < len(data):  # a bad line is named when it is read
            continue
        fields = [field for line in data for field in split_line(line, delimiter)]
        with_comma = delimiter != "," and any(_DECIMAL_COMMA.match(field) for field in fields)
        with_point = next((f for f in fields if "." in f and _NUMBER.match(f)), None)
        if with_comma and with_point is not None:
            msg = (
                f"{path}: numbers with a decimal comma and with a decimal point ({with_point!r}) in one table. "
                "Write all with a point, without marks for thousands."
            )
            raise InputDataError(msg)
        return delimiter, "," if with_comma else "."
    msg = f"{path}: the lines of the table follow no common pattern; the first is {data[0].strip()[:80]!r}."
    raise InputDataError(msg)


def _refuse_split_numbers(path: Path, names: tuple[str, ...] | None, data: list[str], delimiter: str | None) -> None:
    """Commas that part decimals and columns alike: twice as many whole numbers as there should be."""
    rows = [split_line(line, delimiter) for line in data]
    n_fields = len([field for field in rows[0] if field])
    too_many = names is not None and n_fields > len(names)
    digits = {tuple(len(field) for field in row[1:6:2]) for row in rows}
    looks_split = (
        names is None
        and delimiter == ","
        and n_fields >= 6
        and all(field.lstrip("+-").isdigit() for row in rows for field in row[:6])
        and len(digits) == 1
        and len(rows) > 1
    )
    if too_many or looks_split:
        expected = "3" if names is None else str(len(names))
        msg = (
            f"{path}: {n_fields} fields where {expected} columns are expected: {data[0][:80]!r}. If commas mark "
            "decimals and part columns too, write decimal points or part the columns by semicolons; if the fields are "
            "right, say which to take by position: --columns 1,2,3."
        )
        raise InputDataError(msg)


def _commented_header(
    comments: list[tuple[int, str]], first_line: int, delimiter: str | None, n_fields: int
) -> tuple[str, ...] | None:
    """Header in the last comment before the data, as in `# x y z` and `//X,Y,Z`; None where it is no header."""
    before = [line for number, line in comments if number < first_line]
    if not before:
        return None
    text = before[-1].strip().lstrip("#/").strip()
    for candidate in dict.fromkeys((delimiter, ",", None)):
        names = tuple(split_line(text, candidate)) if text else ()
        if len(names) == n_fields and any(_plain(name) in _ELEVATION for name in names) and _horizontal_pairs(names):
            return names
    return None


def _choose_columns(
    path: Path, names: tuple[str, ...] | None, fields: list[str], n_fields: int, options: SourceOptions
) -> tuple[int, ...]:
    if options.columns is not None:
        return _stated_columns(path, names, n_fields, options.columns, options.crs)
    if names is not None:
        return _recognised_columns(path, names, options.crs)
    if not all(is_number(field, ",") for field in fields[:3]):
        msg = (
            f"{path} has no header and its lines do not start with three numbers. Say which columns to take, by "
            "position from 1 (--columns 2,3,4) or all by name (--columns _,northing,easting,elevation,_)."
        )
        raise InputDataError(msg)
    if options.crs is not None and is_geographic(options.crs):
        msg = (
            f"{path} has no header, so it is open whether longitude or latitude comes first. Say so: "
            "--columns lon,lat,height or --columns lat,lon,height."
        )
        raise InputDataError(msg)
    return (0, 1, 2)


def _stated_columns(
    path: Path, names: tuple[str, ...] | None, n_fields: int, stated: tuple[str, ...], crs: str | None
) -> tuple[int, ...]:
    """Columns as the user states them: positions, names in the header, or names for a table without one."""
    if all(word.isdigit() for word in stated):
        places = tuple(int(word) - 1 for word in stated[:4])
        if any(not 0 <= place < n_fields for place in places):
            msg = f"{path} has {n_fields} columns, counted from 1; --columns {','.join(stated)} names others."
            raise InputDataError(msg)
        return places
    if names is None:
        return _recognised_columns(path, stated, crs)
    lower = [name.lower() for name in names]
    missing = [word for word in stated if word.lower() not in lower]
    if missing or len(stated) > 4:
        msg = (
            f"{path}: --columns {','.join(stated)} should name easting, northing, elevation and perhaps sigma, in that "
            f"order, out of: {', '.join(names)}."
        )
        raise InputDataError(msg)
    if any(_plain(stated[0]) in northings or _plain(stated[1]) in eastings for eastings, northings, _ in _HORIZONTAL):
        msg = (
            f"{path}: --columns {','.join(stated)} puts northing first. The order is easting (or longitude), northing "
            "(or latitude), elevation."
        )
        raise InputDataError(msg)
    return tuple(lower.index(word.lower()) for word in stated)


def _recognised_columns(path: Path, names: tuple[str, ...], crs: str | None) -> tuple[int, ...]:
    plain = [_plain(name) for name in names]
    elevation = [i for i, name in enumerate(plain) if name in _ELEVATION]
    sigma = [i for i, name in enumerate(plain) if name in _SIGMA]
    pairs = _horizontal_pairs(names)
    if crs is not None and len(pairs) > 1:
        wants_degrees = is_geographic(crs)
        pairs = [pair for pair in pairs if pair[2] == wants_degrees] or pairs
    if len(pairs) != 1 or len(elevation) != 1 or len(sigma) > 1:
        raise InputDataError(_columns_message(path, names, n_pairs=len(pairs), n_elevations=len(elevation)))
    easting, northing, degrees = pairs[0]
    _check_kind(path, names[easting], names[northing], degrees=degrees, crs=crs)
    return (easting, northing, elevation[0], *sigma)


def _horizontal_pairs(names: tuple[str, ...]) -> list[tuple[int, int, bool]]:
    """Positions of all easting and northing columns of one kind, and whether they are degrees."""
    plain = [_plain(name) for name in names]
    return [
        (i, j, degrees)
        for eastings, northings, degrees in _HORIZONTAL
        for i, easting in enumerate(plain)
        for j, northing in enumerate(plain)
        if easting in eastings and northing in northings
    ]


def _check_kind(path: Path, easting: str, northing: str, *, degrees: bool, crs: str | None) -> None:
    if crs is None:
        return
    geographic = is_geographic(crs)
    if degrees and not geographic:
        msg = (
            f"{path}: the columns {easting!r} and {northing!r} are degrees and the CRS stated, {crs}, is projected. "
            "State the CRS they are in: --crs EPSG:4326, or EPSG:4979 with ellipsoidal heights."
        )
        raise CRSMismatchError(msg)
    if geographic and _plain(easting) in _HORIZONTAL[0][0]:
        msg = (
            f"{path}: the columns {easting!r} and {northing!r} are no degrees and the CRS stated, {crs}, is "
            "geographic. State the projected CRS they are in, as in --crs EPSG:32632."
        )
        raise CRSMismatchError(msg)


def _columns_message(path: Path, names: tuple[str, ...], *, n_pairs: int, n_elevations: int) -> str:
    listed = ", ".join(names)
    in_feet = [name for name in names if _FOOT_UNIT.search(name.lower())]
    if in_feet:
        return (
            f"{path}: the columns {', '.join(in_feet)} are in feet. State them with --columns and a CRS in feet, "
            "heights included (--crs EPSG:2263+6360, say), or convert them to metres."
        )
    several = n_pairs > 1 or n_elevations > 1
    what = "can be read in more than one way" if several else "do not name easting, northing and elevation"
    return (
        f"{path}: the columns ({listed}) {what}. State which to take, in the order easting, northing, elevation: "
        "--columns easting,northing,height, or by position from 1: --columns 2,3,4."
    )


def _plain(name: str) -> str:
    """Column name in lower case without quotes and without a unit in metres or degrees."""
    return _UNIT.sub("", name.strip().strip("\"'").lower()).strip()
