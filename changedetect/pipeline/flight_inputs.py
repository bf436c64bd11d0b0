"""A flight's folder as a source: which files belong to it, their checksums, and when it was flown."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from changedetect.catalogue import Source, parse_date
from changedetect.errors import ConfigError, InputDataError, MissingInputError
from changedetect.io.photo_metadata import read_photo_metadata
from changedetect.storage import sha256_of_file

if TYPE_CHECKING:
    from changedetect.pipeline.flight_run import FlightSource

__all__ = ["check_files", "flight_date", "flight_files", "flights_below", "is_flight_folder", "listing_sha256"]

logger = logging.getLogger(__name__)

#: Files beside the photos that readers may use: logs, lists, calibrations.
_LOGS = {".csv", ".json", ".yaml", ".yml", ".txt", ".ulg", ".mrk", ".xml"}
_PHOTOS = {".jpg", ".jpeg", ".tif", ".tiff", ".png"}
#: Files that all flights of a site may share.
_SHARED = ("camera.yaml", "site.json")


def is_flight_folder(path: Path) -> bool:
    """Whether a folder holds logs or photos of a flight rather than files of points."""
    if not path.is_dir():
        return False
    if any((path / name).is_file() for name in ("imu.csv", "gps.csv", "images.csv")) or any(path.glob("*.ulg")):
        return True
    folders = [folder for folder in (path, path / "images") if folder.is_dir()]
    return any(
        file.suffix.lower() in _PHOTOS - {".tif", ".tiff"} and file.is_file()
        for folder in folders
        for file in folder.iterdir()
    )


def flights_below(directory: Path) -> list[str]:
    """Names of the folders in a folder that are flights; none where it is no folder, or a flight itself."""
    if not directory.is_dir() or is_flight_folder(directory):
        return []
    return [folder.name for folder in sorted(directory.iterdir()) if is_flight_folder(folder)]


def flight_files(directory: Path, source: FlightSource) -> dict[str, Path]:
    """
    Files that the points of a flight follow from, by their names relative to the folder, sorted.

    Parameters
    ----------
    directory : path
    source : FlightSource
        As read from it: its photos count, and every log and small text beside them.
    """
    found = {_name(directory, path): path for path in source.paths}
    for path in directory.iterdir():
        if path.is_file() and path.suffix.lower() in _LOGS:
            found[path.name] = path
    above = directory.resolve().parent
    for name in _SHARED:
        if name not in found and (above / name).is_file():
            found[f"../{name}"] = above / name
    return dict(sorted(found.items()))


def listing_sha256(files: Mapping[str, str]) -> str:
    """
    Checksum of a list of checksums, as `sha256sum` prints them, sorted by name.

    Examples
    --------
    >>> listing_sha256({"b": "0" * 64, "a": "1" * 64}) == listing_sha256({"a": "1" * 64, "b": "0" * 64})
    True
    """
    text = "".join(f"{sha256}  {name}\n" for name, sha256 in sorted(files.items()))
    return hashlib.sha256(text.encode()).hexdigest()


def check_files(directory: Path, source: Source) -> list[str]:
    """
    Compare the files of a flight with the checksums pinned when it was added.

    Parameters
    ----------
    directory : path
        Folder of the flight.
    source : Source
        Without pinned checksums nothing is compared.

    Returns
    -------
    complaints : list of str
        One for each file that is missing or another one.
    """
    complaints = []
    for name, expected in (source.files or {}).items():
        path = directory / name
        if not path.is_file():
            complaints.append(f"{name} is missing")
        elif sha256_of_file(path) != expected:
            complaints.append(f"{name} is another file")
    return complaints


def flight_date(directory: Path, source: FlightSource) -> datetime | None:
    """
    When a flight began, as its files say; None where none does.

    Parameters
    ----------
    directory : path
    source : FlightSource

    Returns
    -------
    date : datetime, without time zone, whole seconds
        `utc` of init.json, else the time in the EXIF of the first photo, which is in the clock of the camera.

    Raises
    ------
    InputDataError
        init.json states something else than a date.
    """
    path = directory / "init.json"
    if path.is_file():
        stated = json.loads(path.read_text(encoding="utf-8")).get("utc")
        if stated is not None:
            try:
                return parse_date(str(stated), f"{path}: utc").replace(microsecond=0)
            except ConfigError as error:
                raise InputDataError(str(error)) from error
    try:
        taken = read_photo_metadata(source.paths[0]).time
    except (InputDataError, MissingInputError) as error:
        logger.info("%s: no date in the first photo: %s", directory, error)
        return None
    return None if taken is None else datetime.fromtimestamp(int(taken), UTC).replace(tzinfo=None)


def _name(directory: Path, path: Path) -> str:
    resolved, home = path.resolve(), directory.resolve()
    return resolved.relative_to(home).as_posix() if resolved.is_relative_to(home) else resolved.as_posix()
