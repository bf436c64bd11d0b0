"""Does everything in a programme's folder still match what it was made from?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from changedetect.catalogue import (
    MANIFEST_FILE,
    Epoch,
    ProductRecord,
    Programme,
    StateRecord,
    damaged_files,
    plan,
)
from changedetect.errors import MissingInputError, ModelStateError
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
    Check checksums of sources, models and products, lineage, and that products match their inputs.

    Parameters
    ----------
    programme : Programme

    Returns
    -------
    findings : tuple of Finding
        Empty where all is well.
    """
    found = (*_sources(programme), *_folders(programme), *_currency(programme))
    return tuple(dict.fromkeys(found))  # a damaged folder is found both by itself and as stale


def _sources(programme: Programme) -> Iterator[Finding]:
    for epoch in programme.epochs:
        recorded = _recorded_checksums(programme, epoch)
        for source, expected in zip(epoch.sources, recorded, strict=True):
            subject = f"epochs/{epoch.epoch_id}.toml"
            try:
                path = source.path(programme.directory)
                actual = sha256_of_file(path)
            except MissingInputError as error:
                yield Finding("warning", subject, f"source {source.name} is not there: {error}")
                continue
            if expected is not None and actual != expected:
                yield Finding("error", subject, f"source '{path}' differs from its checksum")


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


def _folder(folder: Path, owner: type[StateRecord | ProductRecord], subject: str) -> Iterator[Finding]:
    try:
        found = owner.read(folder)
    except ModelStateError as error:
        yield Finding("error", subject, str(error))
        return
    if found is None:
        yield Finding("error", subject, f"has no {MANIFEST_FILE}; `changedetect update` makes it anew")
        return
    files = found[0].files
    yield from (Finding("error", subject, complaint) for complaint in damaged_files(folder, files, deep=True))
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    for name in sorted(present - {*files, MANIFEST_FILE}):
        yield Finding("warning", subject, f"{name} was not written by changedetect")


def _currency(programme: Programme) -> Iterator[Finding]:
    """Lineage: models against sources, settings and parents; products against models and settings."""
    folders = {"model": "state", "epoch": "products", "pair": "products"}
    for item in plan(programme):
        folder = Path(folders[item.kind]) / item.item_id
        for reason in item.reasons:
            exists = (programme.directory / folder).is_dir()
            yield Finding("error" if exists else "warning", folder.as_posix(), reason)
