"""Checking a flight before it becomes an epoch: everything that can be told without matching photos."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from changedetect.catalogue import STEPS_FOLDER, Programme, Source, parse_date
from changedetect.crs import make_transform
from changedetect.errors import ConfigError, InputDataError
from changedetect.pipeline.flight_epoch import open_flight
from changedetect.pipeline.flight_inputs import flight_date, flight_files, listing_sha256
from changedetect.pipeline.flight_store import FlightStore
from changedetect.pipeline.regions import describe_region, regions_overlap
from changedetect.storage import sha256_of_file
from changedetect.typing import Region

if TYPE_CHECKING:
    from changedetect.navigation.poses import CameraPoses

__all__ = ["CheckedFlight", "check_flight"]

logger = logging.getLogger(__name__)

_GEODETIC = "EPSG:4979"
#: Ground seen around the centre of a photo at least, m: a single strip covers some.
_AROUND = 10.0


@dataclass(frozen=True)
class CheckedFlight:
    """
    A flight that can be reconstructed as far as can be told.

    Attributes
    ----------
    source : Source
        With checksums.
    date : datetime
    region : tuple (west, east, south, north), m
        Ground below the photos.
    """

    source: Source
    date: datetime
    region: Region


def check_flight(programme: Programme, source: Source, epoch_id: str, date: datetime | None) -> CheckedFlight:
    """
    Read and navigate a flight, check its photos, and take the checksums of its files.

    Parameters
    ----------
    programme : Programme
    source : Source
        `uri` as the user gave it.
    epoch_id : str
    date : datetime, optional

    Raises
    ------
    MissingInputError, InputDataError, CRSMismatchError, VerticalDatumError, ConfigError
        The flight cannot be used; the message names the file and the fix.
    """
    directory = Path(source.uri).expanduser().resolve()
    run = open_flight(directory, FlightStore(programme.flight_directory(epoch_id) / STEPS_FOLDER))
    region = _region(run.source.poses, programme.config.crs)
    bounds = programme.config.bounds
    if bounds is not None and not regions_overlap(region, bounds):
        msg = (
            f"'{source.uri}' lies outside the programme: its photos span {describe_region(region)} in "
            f"{programme.config.crs}, the bounds are {describe_region(bounds)}. Check whether it is of this site, or "
            "the bounds in programme.toml."
        )
        raise InputDataError(msg)
    paths = flight_files(directory, run.source)
    files = {name: sha256_of_file(path) for name, path in paths.items()}
    home = programme.directory.resolve()
    uri = directory.relative_to(home).as_posix() if directory.is_relative_to(home) else directory.as_posix()
    checked = replace(
        Source(uri=uri, kind="flight"),
        sha256=listing_sha256(files),
        size=sum(path.stat().st_size for path in paths.values()),
        n_photos=len(run.source.poses),
        files=files,
    )
    return CheckedFlight(checked, _date(directory, flight_date(directory, run.source), epoch_id, date), region)


def _region(poses: CameraPoses, crs: str) -> Region:
    """Ground below the photos in the programme's CRS."""
    geodetic = poses.origin.to_geodetic(poses.position)
    easting, northing, _ = make_transform(_GEODETIC, crs)(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2])
    return (
        float(np.min(easting)) - _AROUND,
        float(np.max(easting)) + _AROUND,
        float(np.min(northing)) - _AROUND,
        float(np.max(northing)) + _AROUND,
    )


def _date(directory: Path, found: datetime | None, epoch_id: str, given: datetime | None) -> datetime:
    """The date the user gave, else the flight's own, else the epoch id; contradictions are told."""
    try:
        named: datetime | None = parse_date(epoch_id, "the epoch id")
    except ConfigError:
        named = None
    date = given or found or named
    if date is None:
        msg = (
            f"'{directory}' does not say when it was flown (no utc in init.json, no EXIF date in the photos), and "
            f"{epoch_id!r} is no date. Give it with --date, like --date 2024-05-01."
        )
        raise ConfigError(msg)
    for other, what in ((found, "the flight says"), (named, "the epoch id says")):
        if other is not None and abs(other - date) > timedelta(days=1.5):
            logger.warning("%s: dated %s, but %s %s", directory, date.date(), what, other.date())
    return date
