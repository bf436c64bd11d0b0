"""Does everything in a programme's folder still match what it was made from?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from changedetect.catalogue import (
    MANIFEST_FILE,
    POINTS_FOLDER,
    STEPS_FOLDER,
    Epoch,
    ProductRecord,
    Programme,
    ReconstructionRecord,
    Source,
    StateRecord,
    damaged_files,
    plan,
)
from changedetect.errors import MissingInputError, ModelStateError
from changedetect.pipeline.flight_inputs import check_files
from changedetect.pipeline.stac import catalogue_findings
from changedetect.storage import sha256_of_file

__all__ = ["Finding", "verify"]


@dataclass(frozen=True)
class Finding:
    """
    Something that does not match.

    Attributes
    ----------
    severity : {"error", "warning"}
        An error is a result that cannot be trusted or is not current; a warning is worth knowing.
    subject : str
        Folder or file, relative to the programme.
    message : str
    """

    severity: Literal["error", "warning"]
    subject: str
    message: str


def verify(programme: Programme) -> tuple[Finding, ...]:
    """
    Check checksums of sources, models and products, lineage, that products match their inputs and the catalogue them.

    Parameters
    ----------
    programme : Programme

    Returns
    -------
    findings : tuple of Finding
        Empty where all is well.
    """
    found = (*_sources(programme), *_folders(programme), *_currency(programme), *_catalogue(programme))
    return tuple(dict.fromkeys(found))  # a damaged folder is found both by itself and as stale


def _sources(programme: Programme) -> Iterator[Finding]:
    for epoch in programme.epochs:
        recorded = _recorded_checksums(programme, epoch)
        for source, expected in zip(epoch.sources, recorded, strict=True):
            subject = f"epochs/{epoch.epoch_id}.toml"
            if source.is_flight:
                yield from _flight(programme, source, subject)
                continue
            try:
                path = source.path(programme.directory)
                actual = sha256_of_file(path)
            except MissingInputError as error:
                yield Finding("warning", subject, f"source {source.name} is not there: {error}")
                continue
            if expected is not None and actual != expected:
                yield Finding("error", subject, f"source '{path}' differs from its checksum")


def _flight(programme: Programme, source: Source, subject: str) -> Iterator[Finding]:
    """Every file of a flight against its checksum."""
    try:
        path = source.path(programme.directory)
    except MissingInputError as error:
        yield Finding("warning", subject, f"flight {source.name} is not there: {error}")
        return
    if not path.is_dir():
        yield Finding("warning", subject, f"flight {source.name} is not there: no folder {path}")
        return
    for complaint in check_files(path, source):
        yield Finding("error", subject, f"flight '{path}': {complaint}")


def _recorded_checksums(programme: Programme, epoch: Epoch) -> list[str | None]:
    """Checksums pinned in the epoch's file, else those found when it was learned."""
    pinned = [source.sha256 for source in epoch.sources]
    try:
        found = programme.state_record(epoch.epoch_id)
    except ModelStateError:  # told by `_folders`
        return pinned
    if found is None or len(found[0].sources) != len(pinned):
        return pinned
    return [one or record.sha256 for one, record in zip(pinned, found[0].sources, strict=True)]


def _folders(programme: Programme) -> Iterator[Finding]:
    """Every folder of models and products against its manifest."""
    epoch_ids = [epoch.epoch_id for epoch in programme.epochs]
    pair_ids = [pair.product_id for pair in programme.pairs("all")]
    for name, owner, known in (
        ("state", StateRecord, {*epoch_ids}),
        ("products", ProductRecord, {*epoch_ids, *pair_ids}),
    ):
        for folder in sorted(path for path in (programme.directory / name).glob("*") if path.is_dir()):
            subject = f"{name}/{folder.name}"
            if folder.name not in known:
                yield Finding("warning", subject, "belongs to no epoch of the programme; remove it")
            yield from _folder(folder, owner, subject)
    flights = [epoch.epoch_id for epoch in programme.epochs if epoch.flight is not None]
    for folder in sorted(path for path in (programme.directory / "flights").glob("*") if path.is_dir()):
        subject = f"flights/{folder.name}"
        if folder.name not in flights:
            yield Finding("warning", subject, "belongs to no flight of the programme; remove it")
        if (folder / POINTS_FOLDER).is_dir():
            yield from _folder(folder / POINTS_FOLDER, ReconstructionRecord, f"{subject}/{POINTS_FOLDER}")
        for path in sorted(folder.iterdir()):
            if path.name not in (POINTS_FOLDER, STEPS_FOLDER):
                yield Finding("warning", subject, f"{path.name} was not written by changedetect")


def _folder(
    folder: Path, owner: type[StateRecord | ProductRecord | ReconstructionRecord], subject: str
) -> Iterator[Finding]:
    try:
        found = owner.read(folder)
    except ModelStateError as error:
        yield Finding("error", subject, str(error))
        return
    if found is None:
        yield Finding("error", subject, f"has no {MANIFEST_FILE}; `changedetect update` makes it anew")
        return
    files = found[0].files
    remedy = "remove the folder, then `changedetect update` makes it anew"
    if owner is not ProductRecord:
        remedy += " from the sources"
    seen_by_update = damaged_files(folder, files, deep=False)
    for complaint in damaged_files(folder, files, deep=True):
        told = complaint if complaint in seen_by_update else f"{complaint}; {remedy}"
        yield Finding("error", subject, told)
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    for name in sorted(present - {*files, MANIFEST_FILE}):
        yield Finding("warning", subject, f"{name} was not written by changedetect")


def _currency(programme: Programme) -> Iterator[Finding]:
    """Lineage: models against sources, settings and parents; products against models and settings."""
    folders = {"flight": "flights", "model": "state", "epoch": "products", "pair": "products"}
    for item in plan(programme):
        folder = Path(folders[item.kind]) / item.item_id
        for reason in item.reasons:
            exists = (programme.directory / folder).is_dir()
            yield Finding("error" if exists else "warning", folder.as_posix(), reason)


def _catalogue(programme: Programme) -> Iterator[Finding]:
    """STAC collection, catalogue and items against what is there."""
    for subject, message in catalogue_findings(programme):
        yield Finding("error", subject, message)
