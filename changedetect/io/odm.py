"""
Positions and attitudes of photos in the form of OpenDroneMap's geo.txt [1]_.

The first line is the CRS, an authority code or a PROJ string; every other line is a photo: name, easting or longitude,
northing or latitude, and optionally height, yaw, pitch, roll (degrees; pitch 0 looks down, yaw 0 puts north on top) and
horizontal and vertical accuracy (m). `nan` and missing fields at the end say nothing. Heights of a CRS without a
vertical one are taken above the ellipsoid.

References
----------
.. [1] https://docs.opendronemap.org/geo/
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from changedetect.crs import make_transform
from changedetect.crs.definition import parse_crs, vertical_crs
from changedetect.errors import InputDataError
from changedetect.io.photo_metadata import ELLIPSOID, NADIR
from changedetect.io.photo_place import PhotoPlace

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read_geo"]

_MAX_FIELDS = 9
#: Degrees; what OpenDroneMap's users copy from autopilots.
_ANGLES_STD = (10.0, 3.0, 3.0)


def read_geo(path: Path) -> dict[str, PhotoPlace]:
    """
    Read a geo.txt.

    Parameters
    ----------
    path : path

    Returns
    -------
    places : dict of PhotoPlace by file name

    Raises
    ------
    InputDataError
        A line cannot be read; the message names it.
    CRSMismatchError, VerticalDatumError
        The CRS is unknown, or its heights cannot be related to the ellipsoid.
    """
    lines = [(k, line.split("#")[0].strip()) for k, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)]
    lines = [(k, line) for k, line in lines if line]
    if len(lines) < 2:
        msg = (
            f"{path} holds no photos: the first line is the CRS, the others are: photo x y [z yaw pitch roll accuracy]."
        )
        raise InputDataError(msg)
    rows: dict[str, list[float]] = {}
    for number, line in lines[1:]:
        name, values = _parse(path, number, line)
        if name in rows:
            msg = f"{path}, line {number}: {name} is listed twice. Remove one of the lines."
            raise InputDataError(msg)
        rows[name] = values
    table = np.array([values + [math.nan] * (_MAX_FIELDS - 1 - len(values)) for values in rows.values()])
    table[:, :3] = _to_geodetic(table[:, :3], lines[0][1])
    return {name: _place(row, path.name) for name, row in zip(rows, table, strict=True)}


def _parse(path: Path, number: int, line: str) -> tuple[str, list[float]]:
    fields = line.split()
    if not 3 <= len(fields) <= _MAX_FIELDS:
        msg = (
            f"{path}, line {number}: {len(fields)} fields; expected: photo x y [z yaw pitch roll horizontal-accuracy "
            "vertical-accuracy]. Names with blanks are not possible."
        )
        raise InputDataError(msg)
    try:
        values = [float(field) for field in fields[1:]]
    except ValueError as error:
        msg = f"{path}, line {number}: {error}. Everything behind the name of the photo is a number or nan."
        raise InputDataError(msg) from error
    if not (math.isfinite(values[0]) and math.isfinite(values[1])):
        msg = f"{path}, line {number}: the position {fields[1]} {fields[2]} is not finite. Remove the line."
        raise InputDataError(msg)
    return fields[0], values


def _to_geodetic(places: np.ndarray, crs: str) -> np.ndarray:
    """Longitude, latitude and height above the ellipsoid where there is one."""
    parsed = parse_crs(crs)
    has_datum = vertical_crs(parsed) is not None
    height = places[:, 2].copy()
    if has_datum:
        transform = make_transform(crs, "EPSG:4979")
        known = np.isfinite(height)
        longitude, latitude, out = transform(places[:, 0].copy(), places[:, 1].copy(), np.where(known, height, 0.0))
        return np.column_stack([longitude, latitude, np.where(known, out, math.nan)])
    transform = make_transform(crs, "EPSG:4326", has_heights=False)
    longitude, latitude, _ = transform(places[:, 0].copy(), places[:, 1].copy(), np.zeros(len(places)))
    return np.column_stack([longitude, latitude, height])


def _place(row: np.ndarray, source: str) -> PhotoPlace:
    longitude, latitude, height, yaw, pitch, roll, level, up = (float(value) for value in row)
    has_angles = math.isfinite(yaw) and math.isfinite(pitch)
    has_std = math.isfinite(level) and level > 0
    return PhotoPlace(
        latitude=latitude,
        longitude=longitude,
        height=height if math.isfinite(height) else None,
        height_above=ELLIPSOID,
        std=(level, level, up if math.isfinite(up) and up > 0 else 1.5 * level) if has_std else None,
        angles=(yaw, pitch, roll if math.isfinite(roll) else 0.0) if has_angles else None,
        angles_from=NADIR,
        angles_std=_ANGLES_STD,
        source=source,
    )
