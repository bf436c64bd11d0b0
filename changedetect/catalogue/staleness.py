"""
What has to be made, and why.

Points of a flight are stale when its files, the settings or the flights it is adjusted to are not those they were made
with; a model when its sources, date, settings or parent are not those it was learned from; a product when its models or
settings are not those it was made from. Reasons are sentences for people; no reason means up to date.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from changedetect.catalogue.epoch import Epoch, Source
from changedetect.catalogue.programme import POINTS_FOLDER, ChangeProduct, Programme
from changedetect.catalogue.records import AlignmentRecord, AnchorRecord, SourceRecord, damaged_files
from changedetect.errors import MissingInputError, ModelStateError
from changedetect.storage import sha256_of_file

__all__ = [
    "Item",
    "anchors_of",
    "epoch_product_reasons",
    "own_state_reasons",
    "pair_reasons",
    "plan",
    "reconstruction_reasons",
    "state_reasons",
    "wanted_pairs",
]

Kind = Literal["flight", "model", "epoch", "pair"]

#: A checksum that no manifest has: the model it stands for is still to be learned.
_TO_BE_LEARNED = "to be learned"


@dataclass(frozen=True)
class Item:
    """
    One thing a programme has or should have.

    Attributes
    ----------
    kind : {"flight", "model", "epoch", "pair"}
        The points made from an epoch's flight, the model of an epoch, the products of an epoch, or those of two.
    item_id : str
        Epoch id, or ``EARLIER_LATER``.
    reasons : tuple of str
        Why it has to be made; empty where it is up to date.
    """

    kind: Kind
    item_id: str
    reasons: tuple[str, ...]

    @property
    def title(self) -> str:
        """What it is, for people."""
        titles = {"flight": "points of ", "model": "model of ", "epoch": "maps of ", "pair": "difference "}
        return titles[self.kind] + self.item_id

    @property
    def is_due(self) -> bool:
        """Whether it has to be made."""
        return bool(self.reasons)


def plan(programme: Programme) -> tuple[Item, ...]:
    """
    List what a programme has or should have, each thing with why it is due.

    Returns
    -------
    items : tuple of Item
        In the order they are made: of each epoch the points of its flight, its model, its maps; then the differences.
    """
    items = []
    flights: dict[str, str] = {}
    states: dict[str, str] = {}
    parent: Epoch | None = None
    for epoch in programme.epochs:
        if epoch.flight is not None:
            reasons = reconstruction_reasons(programme, epoch, flights)
            made = None if reasons else programme.reconstruction_record(epoch.epoch_id)
            flights[epoch.epoch_id] = made[1] if made else _TO_BE_LEARNED
            items.append(Item("flight", epoch.epoch_id, reasons))
        reasons = state_reasons(programme, epoch, parent, states, flights.get(epoch.epoch_id))
        record = None if reasons else programme.state_record(epoch.epoch_id)
        states[epoch.epoch_id] = record[1] if record else _TO_BE_LEARNED
        items.append(Item("model", epoch.epoch_id, reasons))
        items.append(Item("epoch", epoch.epoch_id, epoch_product_reasons(programme, epoch.epoch_id, states)))
        parent = epoch
    pairs = wanted_pairs(programme, list(states))
    return (*items, *(Item("pair", pair.product_id, pair_reasons(programme, pair, states)) for pair in pairs))


def wanted_pairs(programme: Programme, epoch_ids: Sequence[str]) -> tuple[ChangeProduct, ...]:
    """
    Return the differences among the given epochs, in order of time, that a programme is to have.

    Those its rule asks for, and those that exist: what was once published is kept current.
    """
    asked = programme.pairs(epoch_ids=epoch_ids)
    kept = [pair for pair in programme.existing_pairs() if {pair.earlier, pair.later} <= {*epoch_ids}]
    return (*asked, *(pair for pair in kept if pair not in asked))


def anchors_of(programme: Programme, flights: Sequence[str]) -> tuple[str, ...]:
    """
    Return the earlier flights that a flight is to be adjusted to: the first, and the one before.

    Parameters
    ----------
    programme : Programme
    flights : sequence of str
        Epoch ids of the flights before it, in order of time.
    """
    if programme.config.flights.joint == "never" or not flights:
        return ()
    return tuple(dict.fromkeys((flights[0], flights[-1])))


def reconstruction_reasons(programme: Programme, epoch: Epoch, flights: Mapping[str, str]) -> tuple[str, ...]:
    """
    Say why points have to be made from the flight of an epoch.

    Parameters
    ----------
    programme : Programme
    epoch : Epoch
        Whose source is a flight.
    flights : mapping of epoch id to the SHA-256 of its points' manifest
        Of the flights before it, in order of time.
    """
    try:
        found = programme.reconstruction_record(epoch.epoch_id)
    except ModelStateError as error:
        return (str(error),)
    if found is None:
        return ("not reconstructed yet",)
    record, source = found[0], epoch.flight
    reasons = damaged_files(programme.flight_directory(epoch.epoch_id) / POINTS_FOLDER, record.files, deep=False)
    reasons += _changed_settings(record.settings, programme.config.flight_settings)
    if source is not None and source.sha256 is not None and source.sha256 != record.source_sha256:
        reasons.append(f"flight {source.name} has another checksum")
    elif source is not None and source.sha256 is None and source.uri != record.source_uri:
        reasons.append(f"flight {source.uri} takes the place of {record.source_uri}")
    wanted, known = anchors_of(programme, list(flights)), tuple(anchor.epoch_id for anchor in record.anchors)
    if wanted != known:
        reasons.append(f"it is to be adjusted to {_names(wanted)} now, and was adjusted to {_names(known)}")
        return tuple(reasons)
    if programme.config.flights.joint == "always" and wanted and not record.bound:
        reasons.append(f"it is to be adjusted to {_names(wanted)}, and shares too little ground")
    for anchor in record.anchors:
        if anchor.sha256 != flights[anchor.epoch_id]:
            reasons.append(f"flight {anchor.epoch_id}, which it is adjusted to, {_reconstructed(flights, anchor)}")
    return tuple(reasons)


def _names(epoch_ids: Sequence[str]) -> str:
    return " and ".join(epoch_ids) if epoch_ids else "no flight"


def _reconstructed(flights: Mapping[str, str], anchor: AnchorRecord) -> str:
    is_due = flights[anchor.epoch_id] == _TO_BE_LEARNED
    return "is to be reconstructed" if is_due else "was reconstructed again"


def state_reasons(
    programme: Programme, epoch: Epoch, parent: Epoch | None, states: Mapping[str, str], points: str | None = None
) -> tuple[str, ...]:
    """
    Say why the model of an epoch has to be learned.

    Parameters
    ----------
    programme : Programme
    epoch : Epoch
    parent : Epoch or None
        The epoch whose model it adapts.
    states : mapping of epoch id to the SHA-256 of its state's manifest
        Of the earlier epochs, in order; later ones are aligned to the first.
    points : str or None
        SHA-256 of the manifest of the points made from its flight; None where it has none.
    """
    own = own_state_reasons(programme, epoch, _reference(states), points)
    found = programme.state_record(epoch.epoch_id) if own == () else None
    if found is None:
        return own
    record, parent_id = found[0], parent.epoch_id if parent else None
    if record.parent != parent_id:
        return (f"it follows {_name(parent_id)} now, and followed {_name(record.parent)}",)
    if parent_id is not None and record.parent_sha256 != states[parent_id]:
        return (f"its parent {parent_id} {_learned(states[parent_id])}",)
    return ()


def own_state_reasons(
    programme: Programme, epoch: Epoch, reference_id: str | None, points: str | None = None
) -> tuple[str, ...]:
    """
    Say why the model of an epoch has to be learned from its sources, whatever its parent.

    Parameters
    ----------
    programme : Programme
    epoch : Epoch
    reference_id : str or None
        Epoch it is aligned to; None where it is the first.
    points : str or None
        As for `state_reasons`.
    """
    try:
        found = programme.state_record(epoch.epoch_id)
    except ModelStateError as error:
        return (str(error),)
    if found is None:
        return ("not learned yet",)
    record = found[0]
    reasons = damaged_files(programme.state_directory(epoch.epoch_id), record.files, deep=False)
    reasons += _changed_settings(record.settings, programme.config.learning_settings)
    reasons += _changed_sources(programme, epoch.sources, record.sources)
    if record.sources and record.sources[0].derived_sha256 != points:
        is_due = points == _TO_BE_LEARNED
        reasons.append(f"the points of its flight {'are to be made' if is_due else 'were made again'}")
    if record.survey_time != epoch.survey_time:
        reasons.append("its date has changed")
    reasons += _changed_alignment(programme, reference_id, record.alignment)
    return tuple(reasons)


def epoch_product_reasons(programme: Programme, epoch_id: str, states: Mapping[str, str]) -> tuple[str, ...]:
    """Say why the rasters of one epoch have to be made; `states` as for `state_reasons`, the epoch included."""
    settings = programme.config.product_settings(differencing=False)
    return _product_reasons(programme, epoch_id, (epoch_id,), settings, states)


def pair_reasons(programme: Programme, pair: ChangeProduct, states: Mapping[str, str]) -> tuple[str, ...]:
    """Say why the difference of two epochs has to be made; `states` as for `state_reasons`, both included."""
    settings = programme.config.product_settings(differencing=True)
    return _product_reasons(programme, pair.product_id, (pair.earlier, pair.later), settings, states)


def _product_reasons(
    programme: Programme,
    product_id: str,
    epoch_ids: tuple[str, ...],
    settings: Mapping[str, Any],
    states: Mapping[str, str],
) -> tuple[str, ...]:
    try:
        found = programme.product_record(product_id)
    except ModelStateError as error:
        return (str(error),)
    if found is None:
        return ("not made yet",)
    record = found[0]
    reasons = damaged_files(programme.product_directory(product_id), record.files, deep=False)
    reasons += _changed_settings(record.settings, settings)
    for epoch_id in epoch_ids:
        if record.states.get(epoch_id) != states[epoch_id]:
            reasons.append(f"the model of {epoch_id} {_learned(states[epoch_id])}")
    return tuple(reasons)


def _reference(states: Mapping[str, str]) -> str | None:
    """Epoch that later ones are aligned to: the first in order of time."""
    return next(iter(states), None)


def _changed_alignment(programme: Programme, reference_id: str | None, record: AlignmentRecord | None) -> list[str]:
    """Compare what an epoch was aligned to with what it is to be aligned to now."""
    wanted = reference_id if programme.config.coregistration.enabled else None
    if record is None or wanted is None:
        return [] if record is None and wanted is None else [f"it is to be aligned to {_name(wanted)} now"]
    if record.reference != wanted:
        return [f"it is to be aligned to {_name(wanted)} now, and was aligned to {_name(record.reference)}"]
    reference = programme.intact_state_record(wanted)
    if reference is not None and reference.evidence_sha256 != record.reference_sha256:
        return [f"epoch {wanted}, which it is aligned to, was learned from other data"]
    areas = programme.stable_areas_path
    if areas is not None and areas.is_file() and sha256_of_file(areas) != record.stable_areas_sha256:
        return [f"the stable areas in {areas.name} have changed"]
    return []


def _name(epoch_id: str | None) -> str:
    return f"epoch {epoch_id}" if epoch_id else "no epoch"


def _learned(state: str) -> str:
    return "is to be learned" if state == _TO_BE_LEARNED else "was learned again"


def _changed_settings(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    keys = [*new, *(key for key in old if key not in new)]
    return [
        f"setting {key} is {new.get(key, 'gone')!r}, was {old.get(key, 'not known')!r}"
        for key in keys
        if key not in old or key not in new or old[key] != new[key]
    ]


def _changed_sources(programme: Programme, sources: Sequence[Source], records: Sequence[SourceRecord]) -> list[str]:
    """Compare by content where the epoch's file pins checksums, else by name and, if the file is there, content."""
    if len(sources) != len(records):
        return [f"it has {len(sources)} sources, was learned from {len(records)}"]
    reasons = []
    for source, record in zip(sources, records, strict=True):
        if source.reading_options() != record.options:
            reasons.append(f"source {source.name} is to be read differently")
        if source.sha256 is not None:
            if source.sha256 != record.sha256:
                reasons.append(f"source {source.name} has another checksum")
        elif source.uri != record.uri:
            reasons.append(f"source {source.uri} takes the place of {record.uri}")
        elif not source.is_flight and _file_differs(programme, source, record):
            reasons.append(f"source {source.name} has changed on disk")
    return reasons


def _file_differs(programme: Programme, source: Source, record: SourceRecord) -> bool:
    """Whether the file is there and is another one; models need no sources once they are learned."""
    try:
        path = source.path(programme.directory)
        status = path.stat()
    except (MissingInputError, OSError):
        return False
    if (status.st_size, status.st_mtime_ns) == (record.size, record.modified_ns):
        return False
    return status.st_size != record.size or sha256_of_file(path) != record.sha256
