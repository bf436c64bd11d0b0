"""List of the photos of a flight: names, times, files, and where each says it was taken."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.log_table import LogTable, read_log_table
from changedetect.navigation.flight import PhotoList

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.navigation.frame import LocalFrame
    from changedetect.typing import FloatArray

__all__ = ["check_photo_times", "read_photo_list"]

logger = logging.getLogger(__name__)


def read_photo_list(path: Path, frame: LocalFrame) -> PhotoList:
    """
    Read images.csv.

    Parameters
    ----------
    path : path
        Columns `image` (file name), `time_s` (mid-exposure in the time base of the other logs), and optionally
        `strip` and `lat_deg`, `lon_deg`, `alt_m` (where the camera says it was). Photos lie beside the file or in its
        subfolder `images`. A file geo.txt beside it, as OpenDroneMap takes it, gives positions too.
    frame : LocalFrame

    Returns
    -------
    photos : PhotoList
        In the order of time, whatever the order of the lines.

    Raises
    ------
    MissingInputError
        The list or a photo it names is missing.
    InputDataError
        No rows, a photo named twice, or two photos with one time.
    """
    table = read_log_table(path, ["image", "time_s"])
    if len(table) == 0:
        msg = f"{path} lists no photos, only a header."
        raise InputDataError(msg)
    order = np.argsort(table.numbers("time_s"), kind="stable")
    if np.any(np.diff(order) < 0):
        logger.warning("%s: photos are not listed in the order of time; sorted", path)
    names, time = table.texts("image"), table.numbers("time_s")
    _check_names(table, names, time[order], order)
    files = [_find(path, name) for name in names]
    missing = [name for name, file in zip(names, files, strict=True) if file is None]
    if missing:
        msg = (
            f"{path} names {len(missing)} photo(s) that are neither beside it nor in {path.parent / 'images'}: "
            f"{', '.join(missing[:5])}{' ...' if len(missing) > 5 else ''}. Put them there, or remove their lines."
        )
        raise MissingInputError(msg)
    positions = _positions(table, names, frame)
    strips = table.texts("strip") if table.has("strip") else None
    return PhotoList(
        names=tuple(names[k] for k in order),
        time=time[order],
        paths=tuple(file for k in order if (file := files[k]) is not None),
        position=None if positions is None else positions[order],
        strip=None if strips is None else tuple(strips[k] for k in order),
    )


def check_photo_times(path: Path, photos: PhotoList, begin: float, end: float) -> None:
    """
    Refuse photos taken outside the logs.

    Parameters
    ----------
    path : path
        Of the list, for the message.
    photos : PhotoList
    begin, end : float, s
        What the inertial log covers.

    Raises
    ------
    InputDataError
        Photos of another flight, or a camera clock that is not that of the logs.
    """
    outside = (photos.time < begin) | (photos.time > end)
    if not np.any(outside):
        return
    first = int(np.flatnonzero(outside)[0])
    count = int(outside.sum())
    if count == len(photos):
        off = float(photos.time[0] - begin)
        cause = (
            f"The first photo and the start of the log are {off:+.3f} s apart: bring the camera's clock to the time "
            "base of the logs, or check that the photos are of this flight"
        )
    else:
        cause = "Remove their lines, or correct the clock of the camera if all photos belong to this flight"
    msg = (
        f"{path}: {count} of {len(photos)} photos were taken outside the inertial log ({begin:.3f} to {end:.3f} s), "
        f"the first {photos.names[first]} at {photos.time[first]:.3f} s. {cause}."
    )
    raise InputDataError(msg)


def _check_names(table: LogTable, names: tuple[str, ...], ordered_time: FloatArray, order: np.ndarray) -> None:
    seen: dict[str, int] = {}
    for row, name in enumerate(names):
        if name in seen:
            msg = (
                f"{table.path}, line {table.line[row]}: {name} is listed already on line {table.line[seen[name]]}. "
                "Remove one of the lines."
            )
            raise InputDataError(msg)
        seen[name] = row
    same = np.flatnonzero(np.diff(ordered_time) <= 0)
    if same.size:
        a, b = order[same[0]], order[same[0] + 1]
        msg = (
            f"{table.path}, lines {table.line[a]} and {table.line[b]}: {names[a]} and {names[b]} have the same time "
            f"{ordered_time[same[0]]:.6f} s. Times need fractions of a second; EXIF's whole seconds are not enough."
        )
        raise InputDataError(msg)


def _find(listing: Path, name: str) -> Path | None:
    for folder in (listing.parent / "images", listing.parent):
        if (folder / name).is_file():
            return folder / name
    return None


def _positions(table: LogTable, names: tuple[str, ...], frame: LocalFrame) -> FloatArray | None:
    """What the photos say of their place, ENU, shape (n, 3); None where nothing does."""
    if table.has("lat_deg", "lon_deg", "alt_m"):
        columns = [table.numbers(c, may_be_empty=True) for c in ("lat_deg", "lon_deg", "alt_m")]
        return frame.to_enu(*columns)
    geo = table.path.parent / "geo.txt"
    if not geo.is_file():
        return None
    lines = [line.split() for line in geo.read_text(encoding="utf-8").splitlines() if line.strip()]
    if not lines or " ".join(lines[0]).upper() not in ("EPSG:4326", "WGS84", "EPSG:4979"):
        logger.warning(
            "%s: positions in %s are not used to check the camera's clock",
            geo,
            " ".join(lines[0] if lines else ["no CRS"]),
        )
        return None
    positions = np.full((len(names), 3), np.nan)
    row_of = {name: row for row, name in enumerate(names)}
    for number, cells in enumerate(lines[1:], start=2):
        if cells[0] not in row_of or len(cells) < 4:
            continue
        try:
            longitude, latitude, height = (float(cell) for cell in cells[1:4])
        except ValueError as error:
            msg = f"{geo}, entry {number}: {' '.join(cells[1:4])!r} is not longitude, latitude and height."
            raise InputDataError(msg) from error
        positions[row_of[cells[0]]] = frame.to_enu(latitude, longitude, height)
    return positions if np.any(np.isfinite(positions)) else None
