"""
Positions of photos in DJI's Timestamp.MRK.

One line a photo, with labels behind the values: number, GPS time of week, [week], offsets from the antenna to the
camera (mm; north, east, down), latitude, longitude, ellipsoidal height, standard deviations (m; north, east, down) and
kind of solution (0 none, 16 single, 34 float, 50 fixed). Fields are told by their labels, not by their place: DJI's
manuals disagree with its files on the order of latitude and longitude. Positions are those of the camera; the offsets
are in them already [1]_.

References
----------
.. [1] DJI (2021), Zenmuse P1 user manual, image log file: "longitude after compensation".
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from changedetect.errors import InputDataError
from changedetect.io.photo_metadata import ELLIPSOID
from changedetect.io.photo_place import PhotoPlace

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = ["MrkEntry", "places_of_photos", "read_mrk"]

logger = logging.getLogger(__name__)

_LABELS = {"N": "north", "E": "east", "V": "down", "Lat": "latitude", "Lon": "longitude", "Ellh": "height", "Q": "fix"}
_FIELD = re.compile(r"(-?\d+(?:\.\d+)?)\s*,\s*(Lat|Lon|Ellh|N|E|V|Q)\b")
_STD = re.compile(r"(\d+(?:\.\d+)?)\s*,\s*(\d+(?:\.\d+)?)\s*,\s*(\d+(?:\.\d+)?)\s")
#: Seconds in a GPS week, and from 1970 to the beginning of GPS time (leap seconds of it not counted).
_WEEK, _GPS_EPOCH = 604800.0, 315964800.0
#: Solutions with corrections: float and fixed.
_FLOAT = 32


@dataclass(frozen=True)
class MrkEntry:
    """
    One line of Timestamp.MRK.

    Attributes
    ----------
    number : int
        Of the photo, from 1.
    time : float, s
        GPS time since 1970, or of the week where no week is given.
    latitude, longitude : float, degrees
    height : float, m
        Above the ellipsoid, of the camera.
    std : tuple of 3 float, m
        East, north, up.
    lever_arm : tuple of 3 float, m
        Camera minus antenna: east, north, up; contained in the position.
    fix : int
        0 none, 16 single, 34 float, 50 fixed.
    """

    number: int
    time: float
    latitude: float
    longitude: float
    height: float
    std: tuple[float, float, float]
    lever_arm: tuple[float, float, float]
    fix: int


def read_mrk(path: Path) -> list[MrkEntry]:
    """
    Read a Timestamp.MRK.

    Parameters
    ----------
    path : path

    Returns
    -------
    entries : list of MrkEntry

    Raises
    ------
    InputDataError
        A line cannot be read, or a number occurs twice; the message names it.
    """
    entries: list[MrkEntry] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        if line.strip(" \0\t"):
            entries.append(_parse(path, number, line))
    if not entries:
        msg = f"{path} is empty. Copy it again from the aircraft, or remove it to use what the photos say themselves."
        raise InputDataError(msg)
    numbers = [entry.number for entry in entries]
    if len(set(numbers)) < len(numbers):
        twice = next(n for n in numbers if numbers.count(n) > 1)
        msg = (
            f"{path}: photo number {twice} occurs twice; files of several flights were joined. Give one flight's file."
        )
        raise InputDataError(msg)
    return entries


def places_of_photos(path: Path, entries: Sequence[MrkEntry], names: Sequence[str]) -> dict[str, PhotoPlace]:
    """
    Entries by photo.

    Parameters
    ----------
    path : path
        Of the file, for messages.
    entries : sequence of MrkEntry
    names : sequence of str
        Of the photos; the last group of four digits in a name is its number (100_0001_0012.JPG,
        DJI_20240501101112_0012_V.JPG).

    Raises
    ------
    InputDataError
        Photos and file are not of one flight.
    """
    by_number = {entry.number: entry for entry in entries}
    found: dict[str, MrkEntry] = {}
    for name in names:
        digits = re.findall(r"(?<!\d)\d{4}(?!\d)", name.rsplit(".", 1)[0])
        if digits and int(digits[-1]) in by_number:
            found[name] = by_number[int(digits[-1])]
    if len(found) < len(names) and len(names) == len(entries):
        found = dict(zip(sorted(names), sorted(entries, key=lambda entry: entry.number), strict=True))
    if len(found) < len(names):
        lacking = next(name for name in names if name not in found)
        msg = (
            f"{path} has {len(entries)} entries (photos {entries[0].number} to {entries[-1].number}) and none for "
            f"{lacking}; {len(names)} photos. Give the file of this flight, or leave out photos of other flights."
        )
        raise InputDataError(msg)
    weak = sorted(name for name, entry in found.items() if entry.fix < _FLOAT)
    if weak:
        logger.warning(
            "%s: %d of %d positions are without corrections (%s); metres instead of centimetres",
            path, len(weak), len(found), ", ".join(weak[:3]),
        )  # fmt: skip
    return {name: _place(entry, path.name) for name, entry in found.items()}


def _place(entry: MrkEntry, source: str) -> PhotoPlace:
    return PhotoPlace(
        latitude=entry.latitude,
        longitude=entry.longitude,
        height=entry.height,
        height_above=ELLIPSOID,
        std=entry.std,
        time=entry.time,
        source=source,
    )


def _parse(path: Path, number: int, line: str) -> MrkEntry:
    fields = line.replace("\t", " ").split()
    labelled = {_LABELS[label]: float(value) for value, label in _FIELD.findall(line)}
    missing = [name for name in _LABELS.values() if name not in labelled]
    behind = line[line.index("Ellh") + 4 :] if "Ellh" in line else ""
    std = _STD.search(behind + " ")
    if missing or std is None or len(fields) < 3:
        what = f"no {', '.join(missing)}" if missing else "no standard deviations"
        msg = (
            f"{path}, line {number}: {what} in {line.strip()[:80]!r}. A line is: number, time, [week], offset,N "
            "offset,E offset,V latitude,Lat longitude,Lon height,Ellh three standard deviations and quality,Q."
        )
        raise InputDataError(msg)
    week = re.search(r"\[\s*(\d+)\s*\]", line)
    try:
        photo, time_of_week = int(fields[0]), float(fields[1])
    except ValueError as error:
        msg = f"{path}, line {number}: {fields[0]!r} {fields[1]!r} are not the photo's number and GPS time ({error})."
        raise InputDataError(msg) from error
    if abs(labelled["latitude"]) > 90 or abs(labelled["longitude"]) > 180:
        msg = f"{path}, line {number}: {labelled['latitude']}, {labelled['longitude']} is not latitude and longitude."
        raise InputDataError(msg)
    north, east, down = (max(float(value), 1e-3) for value in std.groups())
    return MrkEntry(
        number=photo,
        time=time_of_week + (int(week.group(1)) * _WEEK + _GPS_EPOCH if week else 0.0),
        latitude=labelled["latitude"],
        longitude=labelled["longitude"],
        height=labelled["height"],
        std=(east, north, down),
        lever_arm=(labelled["east"] / 1e3, labelled["north"] / 1e3, -labelled["down"] / 1e3),
        fix=int(labelled["fix"]),
    )
