"""
Persisted state of reference mode: one NetCDF4 file, readable without this software.

It holds every number of every receptive field, so that a model that is read back answers, and goes on learning, bit for
bit like the one that was stored.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import xarray as xr

from changedetect.errors import ModelStateError
from changedetect.kernels.lwpr_search import LWPRState
from changedetect.kernels.lwpr_state import FIELD_DTYPE, METRIC_DTYPE, Parameters
from changedetect.storage import read_dataset, write_dataset

if TYPE_CHECKING:
    from changedetect.models.reference import ReferenceLWPR, ReferenceSettings

Model = TypeVar("Model", bound="ReferenceLWPR")

__all__ = ["STATE_FILE", "STATE_VERSION", "read_state", "write_state"]

#: Version of this layout; a reader refuses any other.
STATE_VERSION = 1
STATE_FILE = "reference_lwpr.nc"


def write_state(directory: Path, model: ReferenceLWPR) -> None:
    """
    Write a model's state.

    Parameters
    ----------
    directory : path
        Made if need be.
    model : ReferenceLWPR
        Fitted.

    Raises
    ------
    ModelStateError
        The model has learned nothing yet.
    OutputError
        The folder cannot be written.
    """
    n = model.state_.n_fields
    if n == 0:
        msg = "the model has learned nothing yet; call fit before save"
        raise ModelStateError(msg)
    arrays = {
        name: ("receptive_field", records[name][:n].copy())
        for records in (model.state_.fields, model.state_.metrics)
        for name in records.dtype.names or ()
    }
    attributes = {
        "title": "surface model of survey epochs, reference mode: locally weighted projection regression",
        "comment": "Positions are (easting - origin, northing - origin) / input_scale, elevations are divided by "
        "output_scale; both scales are in settings. Names are the symbols of doi:10.1162/089976605774320557.",
        "state_version": STATE_VERSION,
        "settings": json.dumps(asdict(model.settings), sort_keys=True),
        "parameters": json.dumps(model.parameters_._asdict(), sort_keys=True),
        "memory_days": model.memory_days,
        "prior_observations": model.prior_observations,
        "survey_time": model.survey_time_,
        "origin": np.array(model.origin_),
        "region": np.array(model.region_),
        "elevations": np.array(model.elevations_),
        "n_pruned": model.state_.n_pruned,
    }
    write_dataset(Path(directory) / STATE_FILE, xr.Dataset(arrays, attrs=attributes))


def read_state(directory: Path, kind: type[Model], settings_kind: type[ReferenceSettings]) -> Model:
    """
    Read a model's state.

    Parameters
    ----------
    directory : path
    kind, settings_kind : type
        Classes to make.

    Raises
    ------
    MissingInputError
        There is no state in the folder.
    ModelStateError
        The state is damaged, incomplete, or of another format version.
    """
    path = Path(directory) / STATE_FILE
    dataset = read_dataset(path)
    version = dataset.attrs.get("state_version")
    if version != STATE_VERSION:
        msg = f"{path} has state version {version}; this software reads {STATE_VERSION}. Learn the epoch again."
        raise ModelStateError(msg)
    try:
        return _restored(dataset, kind, settings_kind)
    except (KeyError, TypeError, ValueError) as error:
        msg = f"{path} is incomplete or damaged: {error}. Restore it from a backup, or learn the epoch again."
        raise ModelStateError(msg) from error


def _restored(dataset: xr.Dataset, kind: type[Model], settings_kind: type[ReferenceSettings]) -> Model:
    attributes = dataset.attrs
    settings = settings_kind(**json.loads(attributes["settings"]))
    model = kind(settings, float(attributes["memory_days"]), float(attributes["prior_observations"]))
    model.parameters_ = Parameters(**json.loads(attributes["parameters"]))
    model.survey_time_ = float(attributes["survey_time"])
    easting, northing = (float(value) for value in attributes["origin"])
    west, east, south, north = (float(value) for value in attributes["region"])
    count, mean, squares = (float(value) for value in attributes["elevations"])
    model.origin_, model.region_, model.elevations_ = (
        (easting, northing),
        (west, east, south, north),
        (count, mean, squares),
    )
    n = dataset.sizes["receptive_field"]
    state = LWPRState(n_pruned=int(attributes["n_pruned"]))
    state.reserve(n)
    for dtype, records in ((FIELD_DTYPE, state.fields), (METRIC_DTYPE, state.metrics)):
        for name in dtype.names or ():
            records[name][:n] = dataset[name].values
    state.n_fields = n
    model.state_ = state
    return model
