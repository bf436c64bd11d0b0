"""
What a monitoring programme consists of, what derives from what, and what is stale.

A programme is a folder::

    programme.toml          settings
    epochs/EPOCH_ID.toml    one survey epoch: date and sources
    flights/EPOCH_ID/points/ points made from an epoch's flight, and manifest.json
    flights/EPOCH_ID/steps/  what led to them, kept so that a stopped run goes on
    state/EPOCH_ID/         the model learned up to that epoch, and manifest.json
    products/EPOCH_ID/      rasters of one epoch, and manifest.json
    products/EARLIER_LATER/ rasters of one difference, and manifest.json
    runs/RUN_ID.json        what each run did
    sources/EPOCH_ID/       sources moved here by `add --move`
"""

from __future__ import annotations

from changedetect.catalogue.epoch import Epoch, Source, parse_date, survey_time_days, validate_epoch_id
from changedetect.catalogue.programme import POINTS_FOLDER, STEPS_FOLDER, ChangeProduct, Programme
from changedetect.catalogue.records import (
    MANIFEST_FILE,
    AlignmentRecord,
    AnchorRecord,
    CommonErrorRecord,
    ProductRecord,
    ReconstructionRecord,
    SourceRecord,
    StateRecord,
    damaged_files,
    describe_files,
)
from changedetect.catalogue.staleness import (
    Item,
    anchors_of,
    epoch_product_reasons,
    own_state_reasons,
    pair_reasons,
    plan,
    reconstruction_reasons,
    state_reasons,
    wanted_pairs,
)

__all__ = [
    "MANIFEST_FILE",
    "POINTS_FOLDER",
    "STEPS_FOLDER",
    "AlignmentRecord",
    "AnchorRecord",
    "ChangeProduct",
    "CommonErrorRecord",
    "Epoch",
    "Item",
    "ProductRecord",
    "Programme",
    "ReconstructionRecord",
    "Source",
    "SourceRecord",
    "StateRecord",
    "anchors_of",
    "damaged_files",
    "describe_files",
    "epoch_product_reasons",
    "own_state_reasons",
    "pair_reasons",
    "parse_date",
    "plan",
    "reconstruction_reasons",
    "state_reasons",
    "survey_time_days",
    "validate_epoch_id",
    "wanted_pairs",
]
