"""Adding a survey epoch: everything is read and checked before anything is written."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from changedetect.catalogue import Epoch, Programme, Source, parse_date, validate_epoch_id
from changedetect.errors import ConfigError, InputDataError, MissingInputError, OutputExistsError
from changedetect.pipeline.flight_inputs import flights_below, is_flight_folder
from changedetect.pipeline.lock import programme_lock
from changedetect.pipeline.reading import read_epoch_points
from changedetect.pipeline.regions import describe_region, regions_overlap, unit_hint
from changedetect.storage import atomic_path, sha256_of_file
from changedetect.typing import Region

__all__ = ["AddedEpoch", "add_epoch"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class AddedEpoch:
    """
    An epoch as it was added.

    Attributes
    ----------
    epoch : Epoch
    n_points : int
        Observations inside the programme's bounds; 0 for a flight, whose points `update` makes.
    n_photos : int
        Of a flight; 0 for files of points.
    region : tuple (west, east, south, north), m
        Ground they cover; of a flight, that below the photos' centres.
    is_late : bool
        Whether later epochs exist, which are learned again after this one.
    """

    epoch: Epoch
    n_points: int
    region: Region
    is_late: bool
    n_photos: int = 0


def add_epoch(
    programme: Programme,
    epoch_id: str,
    sources: Sequence[Source],
    date: datetime | None,
    *,
    label: str = "",
    move: bool = False,
    overwrite: bool = False,
    dry_run: bool = False,
) -> AddedEpoch:
    """
    Read and check the sources of a new epoch, and write `epochs/EPOCH_ID.toml`.

    A folder that holds a flight is one source, and the only one of its epoch: its logs are navigated and its photos
    checked here, its points are made by `update`.

    Parameters
    ----------
    programme : Programme
    epoch_id : str
    sources : sequence of Source
        `uri` as the user gave it, relative to the working directory.
    date : datetime, optional
        When it was surveyed. By default what the flight itself says, else the epoch id.
    label : str
    move : bool
        Move the files into the programme's folder `sources/EPOCH_ID/`, last of all.
    overwrite : bool
        Replace an epoch of the same id.
    dry_run : bool
        Check everything and write nothing.

    Returns
    -------
    AddedEpoch

    Raises
    ------
    OutputExistsError
        There is such an epoch already.
    InputDataError
        A source cannot be used, is in the programme already, or overlaps neither its bounds nor its other epochs.
    MissingInputError, CRSMismatchError, VerticalDatumError, ConfigError, TemporaryError
        As their names say.
    """
    validate_epoch_id(epoch_id)
    if _is_flight(sources, move=move):
        return _add_flight(programme, epoch_id, sources[0], date, label=label, overwrite=overwrite, dry_run=dry_run)
    if date is None:
        date = parse_date(epoch_id, "no --date is given, and the epoch id")
    if programme.epoch_path(epoch_id).exists() and not overwrite:
        raise OutputExistsError(_exists(epoch_id))
    if dry_run:
        return _check(programme, epoch_id, sources, date, label)
    with programme_lock(programme.directory):
        added = _check(programme, epoch_id, sources, date, label)
        epoch = _copied(programme, added.epoch) if move else added.epoch
        programme.write_epoch(epoch)
        if move:
            _remove_originals(programme, added.epoch, epoch)
    return replace(added, epoch=epoch)


def _check(programme: Programme, epoch_id: str, sources: Sequence[Source], date: datetime, label: str) -> AddedEpoch:
    found = tuple(_described(programme, source) for source in sources)
    _require_new_files(programme, epoch_id, found)
    epoch = Epoch(epoch_id=epoch_id, date=date, sources=found, label=label)
    ordered = programme.with_epoch(epoch)
    points = read_epoch_points(programme, epoch)
    _require_overlap(programme, epoch_id, points.cloud.region)
    read = zip(epoch.sources, points.records, strict=True)
    counted = tuple(replace(source, n_points=record.n_read) for source, record in read)
    return AddedEpoch(
        epoch=replace(epoch, sources=counted, region=points.cloud.region),
        n_points=len(points.cloud),
        region=points.cloud.region,
        is_late=ordered[-1].epoch_id != epoch_id,
    )


def _described(programme: Programme, source: Source) -> Source:
    """Return the source with its checksum, its path as the programme is to remember it."""
    path = Path(source.uri).expanduser().resolve()
    if path.is_dir():
        flights = flights_below(path)
        if flights:
            msg = (
                f"'{source.uri}' holds {'flights' if len(flights) > 1 else 'a flight'} in folders: "
                f"{', '.join(flights)}. A flight is an epoch of its own; add each by itself: changedetect add "
                f"{programme.directory} EPOCH_ID {Path(source.uri) / flights[0]}"
            )
            raise InputDataError(msg)
        msg = (
            f"'{source.uri}' is a folder. Name the files in it, for example {source.uri}/*.laz. (The folder of a "
            "flight holds photos, and imu.csv and gps.csv or a PX4 log.)"
        )
        raise InputDataError(msg)
    sha256 = sha256_of_file(path)
    home = programme.directory.resolve()
    uri = path.relative_to(home).as_posix() if path.is_relative_to(home) else path.as_posix()
    return replace(source, uri=uri, sha256=sha256, size=path.stat().st_size)


def _require_new_files(programme: Programme, epoch_id: str, sources: Sequence[Source]) -> None:
    """Refuse a file whose content the programme has in this or another epoch, under whatever name."""
    known: dict[str, str] = {}
    for epoch in programme.epochs:
        if epoch.epoch_id == epoch_id:
            continue
        known |= dict.fromkeys(_known_checksums(programme, epoch), f"epoch '{epoch.epoch_id}'")
    for source in sources:
        checksum = source.sha256 or ""
        if checksum in known:
            msg = (
                f"'{source.uri}' is in the programme already, in {known[checksum]} (same content, SHA-256 "
                f"{checksum[:12]}...). A survey counts once; leave the file out."
            )
            raise InputDataError(msg)
        known[checksum] = f"this epoch, as '{source.name}'"


def _is_flight(sources: Sequence[Source], *, move: bool) -> bool:
    """Whether the sources are one flight; refuses flights beside others, and options that mean nothing for them."""
    flights = [source for source in sources if is_flight_folder(Path(source.uri).expanduser())]
    if not flights:
        return False
    if len(sources) > 1:
        msg = (
            f"'{flights[0].uri}' is a flight; a flight is an epoch of its own. Add it by itself, and the other sources "
            "as other epochs."
        )
        raise InputDataError(msg)
    if move:
        msg = f"'{flights[0].uri}' is a flight: flights are referenced where they lie. Leave --move out."
        raise ConfigError(msg)
    plain = Source(uri=flights[0].uri)
    if flights[0].reading_options() != plain.reading_options():
        msg = (
            f"'{flights[0].uri}' is a flight: --crs, --sigma, --classes, --columns, --nodata and --band are about "
            "files of points. Leave them out; what a flight needs stands in its site.json and camera.yaml."
        )
        raise ConfigError(msg)
    return True


def _add_flight(
    programme: Programme,
    epoch_id: str,
    source: Source,
    date: datetime | None,
    *,
    label: str,
    overwrite: bool,
    dry_run: bool,
) -> AddedEpoch:
    """Navigate a flight, check its photos, and remember its files by their checksums."""
    from changedetect.pipeline.flight_checks import check_flight  # photogrammetry, which files of points do not need

    if programme.epoch_path(epoch_id).exists() and not overwrite:
        raise OutputExistsError(_exists(epoch_id))
    checked = check_flight(programme, source, epoch_id, date)
    _require_new_files(programme, epoch_id, (checked.source,))
    _require_overlap(programme, epoch_id, checked.region)
    epoch = Epoch(epoch_id=epoch_id, date=checked.date, sources=(checked.source,), label=label, region=checked.region)
    ordered = programme.with_epoch(epoch)
    if not dry_run:
        with programme_lock(programme.directory):
            programme.write_epoch(epoch)
    return AddedEpoch(
        epoch=epoch,
        n_points=0,
        n_photos=checked.source.n_photos or 0,
        region=checked.region,
        is_late=ordered[-1].epoch_id != epoch_id,
    )


def _exists(epoch_id: str) -> str:
    return f"Epoch '{epoch_id}' exists. Choose another id, or pass --overwrite to replace it."


def _known_checksums(programme: Programme, epoch: Epoch) -> list[str]:
    """Checksums pinned in the epoch's file, or else those found when it was learned, or else those on disk."""
    if all(source.sha256 for source in epoch.sources):
        return [source.sha256 for source in epoch.sources if source.sha256]
    record = programme.intact_state_record(epoch.epoch_id)
    if record is not None:
        return [source.sha256 for source in record.sources]
    checksums = []
    for source in epoch.sources:
        if source.is_flight:
            continue
        try:
            checksums.append(sha256_of_file(source.path(programme.directory)))
        except MissingInputError as error:
            logger.warning("Epoch %s: %s", epoch.epoch_id, error)
    return checksums


def _require_overlap(programme: Programme, epoch_id: str, region: Region) -> None:
    """Refuse an epoch that shares no ground with any other: its CRS is wrong, or it is another site."""
    others = {
        epoch.epoch_id: _known_region(programme, epoch) for epoch in programme.epochs if epoch.epoch_id != epoch_id
    }
    known = {name: other for name, other in others.items() if other is not None}
    if not known or any(regions_overlap(region, other) for other in known.values()):
        return
    name, other = list(known.items())[-1]
    hint = next(filter(None, (unit_hint(region, each) for each in known.values())), "")
    msg = (
        f"The sources do not overlap the programme: they span {describe_region(region)} in {programme.config.crs}, "
        f"epoch '{name}' spans {describe_region(other)}. {hint}Check the CRS of the files (--crs) and "
        "whether they are of this site."
    )
    raise InputDataError(msg)


def _known_region(programme: Programme, epoch: Epoch) -> Region | None:
    if epoch.region is not None:
        return epoch.region
    record = programme.intact_state_record(epoch.epoch_id)
    return None if record is None else record.region


def _copied(programme: Programme, epoch: Epoch) -> Epoch:
    """Put the files of an epoch, under their own names, into the programme's folder; the originals stay for now."""
    folder = programme.sources_directory(epoch.epoch_id)
    names = [source.name for source in epoch.sources]
    if len({*names}) < len(names):
        msg = f"Sources that are moved need different file names, not {', '.join(names)}. Rename one of them."
        raise InputDataError(msg)
    moved = []
    for source in epoch.sources:
        original, target = source.path(programme.directory), folder / source.name
        if original != target:
            with atomic_path(target) as temporary:
                _link_or_copy(original, temporary)
        moved.append(replace(source, uri=target.relative_to(programme.directory).as_posix()))
    return replace(epoch, sources=tuple(moved))


def _link_or_copy(original: Path, target: Path) -> None:
    try:
        os.link(original, target)
    except OSError:  # another file system, or one without links
        shutil.copy2(original, target)


def _remove_originals(programme: Programme, before: Epoch, after: Epoch) -> None:
    for old, new in zip(before.sources, after.sources, strict=True):
        original, kept = (source.path(programme.directory).resolve() for source in (old, new))
        if original == kept:
            continue
        try:
            original.unlink()
        except OSError as error:  # the epoch is complete; a copy too many does no harm
            logger.warning("'%s' was copied to '%s' but cannot be removed: %s", original, kept, error.strerror)
