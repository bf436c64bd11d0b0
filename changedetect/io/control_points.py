"""
Lists of control points, in the form of OpenDroneMap's gcp_list.txt [1]_.

The first line is the CRS: an authority code, a PROJ string, or `WGS84 UTM 32N`. Every other line is a mark: easting,
northing, elevation, column, row, photo, and optionally the name of the point; lines with the same coordinates are one
point. Pixels count from the centre of the top-left one.

References
----------
.. [1] https://docs.opendronemap.org/gcp/
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from changedetect.crs import make_transform
from changedetect.errors import InputDataError, MissingInputError
from changedetect.photogrammetry.control import ControlPoint

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.navigation.frame import LocalFrame
    from changedetect.typing import FloatArray

__all__ = ["read_control_points"]

#: Standard deviation of a survey that states none, m: east, north, up.
_SURVEY_STD = (0.02, 0.02, 0.03)
_UTM = re.compile(r"^WGS\s?84\s+UTM\s+(\d{1,2})\s*([NS])$", re.IGNORECASE)


def read_control_points(
    path: Path, frame: LocalFrame, *, is_check: bool = False, std: tuple[float, float, float] = _SURVEY_STD
) -> list[ControlPoint]:
    """
    Read a list of control points.

    Parameters
    ----------
    path : path
    frame : LocalFrame
        Frame to give positions in.
    is_check : bool
        Points to be compared only.
    std : tuple of 3 float, m
        Of the survey: east, north, up.

    Raises
    ------
    MissingInputError
        There is no such file.
    InputDataError
        A line cannot be read; the message names it.
    CRSMismatchError, VerticalDatumError
        The CRS is unknown, or its heights cannot be related to the ellipsoid.
    """
    if not path.is_file():
        msg = f"No such file: {path}. It lists control points, one mark a line."
        raise MissingInputError(msg)
    lines = [(k, line.split("#")[0].strip()) for k, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)]
    lines = [(k, line) for k, line in lines if line]
    if len(lines) < 2:
        msg = (
            f"{path} holds no marks: the first line is the CRS, the others easting northing elevation column row photo."
        )
        raise InputDataError(msg)
    marks: dict[tuple[float, float, float], list[tuple[str, float, float, str | None]]] = {}
    for number, line in lines[1:]:
        values, photo, name = _parse(path, number, line)
        marks.setdefault((values[0], values[1], values[2]), []).append((photo, values[3], values[4], name))
    places = _to_enu(np.array(list(marks)), _crs(lines[0][1]), frame)
    points = []
    for k, (place, seen) in enumerate(zip(places, marks.values(), strict=True), start=1):
        name = next((mark[3] for mark in seen if mark[3]), None) or f"{'check' if is_check else 'gcp'}{k}"
        pixel = np.array([(column, row) for _, column, row, _ in seen])
        photos = tuple(mark[0] for mark in seen)
        points.append(ControlPoint(name, place, np.array(std), photos, pixel, is_check))
    return points


def _parse(path: Path, number: int, line: str) -> tuple[list[float], str, str | None]:
    fields = line.split()
    if len(fields) < 6:
        msg = f"{path}, line {number}: {len(fields)} fields; easting northing elevation column row photo are needed."
        raise InputDataError(msg)
    try:
        values = [float(field) for field in fields[:5]]
    except ValueError as error:
        msg = f"{path}, line {number}: {' '.join(fields[:5])!r} are not five numbers ({error})."
        raise InputDataError(msg) from error
    if not np.isfinite(values).all():
        msg = (
            f"{path}, line {number}: {' '.join(fields[:5])!r} are not finite; every control point needs its elevation."
        )
        raise InputDataError(msg)
    return values, fields[5], fields[6] if len(fields) > 6 else None


def _crs(text: str) -> str:
    utm = _UTM.match(text.strip())
    if utm is None:
        return text.strip()
    base = 32600 if utm.group(2).upper() == "N" else 32700
    return f"EPSG:{base + int(utm.group(1))}+4979"


def _to_enu(places: FloatArray, crs: str, frame: LocalFrame) -> FloatArray:
    transform = make_transform(crs, "EPSG:4979")
    longitude, latitude, height = transform(places[:, 0].copy(), places[:, 1].copy(), places[:, 2].copy())
    return frame.to_enu(latitude, longitude, height)
