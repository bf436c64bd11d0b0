"""The programme's catalogue of products: an item in every folder, one collection over them, always of what is there."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING

import changedetect
from changedetect.errors import MissingInputError, ModelStateError
from changedetect.io.stac import (
    CATALOGUE_FILE,
    COLLECTION_FILE,
    ITEM_FILE,
    ItemMetadata,
    build_catalogue,
    build_collection,
    build_item,
)
from changedetect.storage import read_json, write_json

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.catalogue import Programme
    from changedetect.grid import Grid
    from changedetect.typing import JSONObject

__all__ = ["catalogue_findings", "is_catalogue_current", "write_catalogue", "write_item"]

logger = logging.getLogger(__name__)


def write_item(
    folder: Path,
    programme: Programme,
    epoch_ids: tuple[str, ...],
    grid: Grid,
    run_id: str,
    created: str,
    *,
    is_listed: bool,
) -> None:
    """
    Describe a folder of products; its other files, but the manifest, are there.

    Parameters
    ----------
    folder : path
    programme : Programme
    epoch_ids : tuple of str
        One epoch, or the earlier and the later.
    grid : Grid
    run_id, created : str
    is_listed : bool
        Whether the folder is to be one of the programme's own.
    """
    config = programme.config
    epochs = [programme.epoch(epoch_id) for epoch_id in epoch_ids]
    meta = ItemMetadata(
        programme=config.name,
        epochs=epoch_ids,
        datetimes=tuple(epoch.date.isoformat() for epoch in epochs),
        created=created,
        run_id=run_id,
        config_sha256=config.config_sha256,
        software_version=changedetect.__version__,
        lineage=_lineage(programme, epoch_ids),
        derived_from=_ancestors(programme, epoch_ids),
        is_listed=is_listed,
    )
    layer = "elevation" if len(epoch_ids) == 1 else "dod"
    write_json(folder / ITEM_FILE, build_item(folder, grid, layer, meta))


def _ancestors(programme: Programme, epoch_ids: tuple[str, ...]) -> tuple[str, ...]:
    """Both epochs of a difference; the epoch whose model an epoch's adapts."""
    if len(epoch_ids) == 2:
        return epoch_ids
    found = programme.state_record(epoch_ids[0])
    return (found[0].parent,) if found is not None and found[0].parent is not None else ()


def _lineage(programme: Programme, epoch_ids: tuple[str, ...]) -> str:
    """How the product came about, in words; sources by name and checksum."""
    sentences = []
    for epoch_id in epoch_ids:
        found = programme.state_record(epoch_id)
        if found is None:
            continue
        record = found[0]
        named = "; ".join(f"{s.uri.rpartition('/')[2]} (SHA-256 {s.sha256})" for s in record.sources)
        text = f"{epoch_id}: surface learned by Locally Weighted Projection Regression from {record.n_points} points"
        sentences.append(f"{text} of {named}.")
        if record.alignment is not None:
            sentences.append(f"{record.alignment.wording.rstrip('.')}.")
    if len(epoch_ids) == 2:
        sentences.append(f"{epoch_ids[1]} minus {epoch_ids[0]}, differenced about one shared surface.")
    return " ".join(sentences)


def write_catalogue(programme: Programme) -> bool:
    """
    Bring collection and catalogue in line with the items that are there; the caller holds the programme's lock.

    Returns
    -------
    changed : bool
        Whether anything was written or removed. Without items there is no collection and no catalogue.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    wanted = _wanted(programme)
    changed = False
    for name in (COLLECTION_FILE, CATALOGUE_FILE):
        path = programme.directory / "products" / name
        if name not in wanted:
            changed |= path.exists()
            path.unlink(missing_ok=True)
        elif _found(path) != wanted[name]:
            write_json(path, wanted[name])
            changed = True
    if changed:
        logger.info("renewed %s", programme.directory / "products" / COLLECTION_FILE)
    return changed


def is_catalogue_current(programme: Programme) -> bool:
    """Whether collection and catalogue say what `write_catalogue` would write."""
    wanted, folder = _wanted(programme), programme.directory / "products"
    return all(_found(folder / name) == wanted.get(name) for name in (COLLECTION_FILE, CATALOGUE_FILE))


def catalogue_findings(programme: Programme) -> Iterator[tuple[str, str]]:
    """
    Compare collection and catalogue with the items that are there, and items with their folders.

    Yields
    ------
    subject, message : str
        File relative to the programme, and what is wrong with it.
    """
    wanted = _wanted(programme)
    for name in (COLLECTION_FILE, CATALOGUE_FILE):
        path, subject = programme.directory / "products" / name, f"products/{name}"
        if name not in wanted:
            if path.exists():
                yield subject, "describes products that are not there; `changedetect update` removes it"
        elif not path.exists():
            yield subject, "is missing; `changedetect update` writes it"
        elif _found(path) != wanted[name]:
            yield subject, "does not say what the products are; `changedetect update` writes it anew"
    for folder, item in _items(programme).items():
        yield from _item_findings(programme, folder, item)


def _item_findings(programme: Programme, folder: str, item: JSONObject) -> Iterator[tuple[str, str]]:
    """Assets and links of an item that lead nowhere, and checksums that differ from the manifest's."""
    subject, place = f"products/{folder}/{ITEM_FILE}", programme.product_directory(folder)
    try:
        found = programme.product_record(folder)
    except ModelStateError as error:
        logger.debug("%s", error)  # told with the folder
        return
    files = {} if found is None else found[0].files
    for key, asset in item.get("assets", {}).items():
        name = str(asset.get("href", "")).removeprefix("./")
        if not (place / name).is_file():
            yield subject, f"asset {key} names {name}, which is not there"
        elif "file:checksum" in asset and asset["file:checksum"] != f"1220{files.get(name, {}).get('sha256')}":
            yield subject, f"asset {key} has another checksum than the manifest states"
    for link in item.get("links", []):
        # collection and catalogue are judged by themselves
        if link["rel"] == "derived_from" and not (place / link["href"]).is_file():
            yield subject, f"link {link['rel']} leads to {link['href']}, which is not there"


def _wanted(programme: Programme) -> dict[str, JSONObject]:
    items = _items(programme)
    if not items:
        return {}
    config = programme.config
    collection = build_collection(config.name, config.crs, items)
    return {COLLECTION_FILE: collection, CATALOGUE_FILE: build_catalogue(config.name)}


def _items(programme: Programme) -> dict[str, JSONObject]:
    """Items of the programme's epochs and differences, in order of time, by the names of their folders."""
    names = [epoch.epoch_id for epoch in programme.epochs]
    names += [pair.product_id for pair in programme.existing_pairs()]
    items = {}
    for name in names:
        item = _found(programme.product_directory(name) / ITEM_FILE)
        if item is not None:
            items[name] = item
    return items


def _found(path: Path) -> JSONObject | None:
    """Read a document; None where it is missing or damaged, which its manifest tells."""
    try:
        document = read_json(path)
    except (MissingInputError, ModelStateError, json.JSONDecodeError) as error:
        logger.debug("%s", error)
        return None
    return document if isinstance(document, dict) else None
