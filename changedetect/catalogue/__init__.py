"""
What a monitoring programme consists of, what derives from what, and what is stale.

A programme is a folder::

    programme.toml          settings
    epochs/EPOCH_ID.toml    one survey epoch: date and sources
    state/EPOCH_ID/         the model learned up to that epoch, and manifest.json
    products/EPOCH_ID/      rasters of one epoch, and manifest.json
    products/EARLIER_LATER/ rasters of one difference, and manifest.json
    runs/RUN_ID.json        what each run did
    sources/EPOCH_ID/       sources moved here by `add --move`
"""

from __future__ import annotations

from changedetect.catalogue.epoch import Epoch, Source, parse_date, survey_time_days, validate_epoch_id
from changedetect.catalogue.programme import ChangeProduct, Programme
from changedetect.catalogue.records import (
    MANIFEST_FILE,
    AlignmentRecord,
    ProductRecord,
    SourceRecord,
    StateRecord,
    damaged_files,
    describe_files,
)
from changedetect.catalogue.staleness import (
    Item,
    epoch_product_reasons,
    own_state_reasons,
    pair_reasons,
    plan,
    state_reasons,
    wanted_pairs,
)

__all__ = [
    "MANIFEST_FILE",
    "AlignmentRecord",
    "ChangeProduct",
    "Epoch",
    "Item",
    "ProductRecord",
    "Programme",
    "Source",
    "SourceRecord",
    "StateRecord",
    "damaged_files",
    "describe_files",
    "epoch_product_reasons",
    "own_state_reasons",
    "pair_reasons",
    "parse_date",
    "plan",
    "state_reasons",
    "survey_time_days",
    "validate_epoch_id",
    "wanted_pairs",
]
