"""
Persisted state of the adaptive model: plain NetCDF4 files in one folder.

`model.nc` holds the settings and what the model chose; `evidence_R_C.nc` the exact sums of the present epoch and
`memory_R_C.nc` the remembered moments, one pair a storage tile. Receptive fields are not stored: they are rebuilt
from these, bit for bit.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import xarray as xr

from changedetect.config import AdaptiveConfig
from changedetect.errors import ModelStateError
from changedetect.kernels.moments import ELEVATION_UNIT, N_MOMENTS, N_SUMS, OFFSET_UNIT, WEIGHT_UNIT
from changedetect.models.cells import TILE_CELLS, Cells, Evidence
from changedetect.storage import read_dataset, write_dataset

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.models.lwpr import LWPRSurface
    from changedetect.typing import IntArray

    Model = TypeVar("Model", bound=LWPRSurface)

__all__ = ["ADAPTIVE_FILE", "STATE_VERSION", "read_state", "write_state"]

#: The file that tells a folder holds an adaptive model.
ADAPTIVE_FILE = "model.nc"
#: Version of this layout; a reader refuses any other.
STATE_VERSION = 1
#: Cells along one edge of a storage tile.
_STORAGE_CELLS = 4 * TILE_CELLS
_LANES = ("n", "w", "wx", "wy", "wxx", "wxy", "wyy", "wz", "wxz", "wyz", "wzz")


def write_state(directory: Path, model: LWPRSurface) -> None:
    """
    Write a model's state.

    Parameters
    ----------
    directory : path
        Made if need be.
    model : LWPRSurface
        Fitted.

    Raises
    ------
    ModelStateError
        The model has learned nothing yet.
    OutputError
        The folder cannot be written.
    """
    if "evidence_" not in model.__dict__:
        msg = "the model has learned nothing yet; call fit before save"
        raise ModelStateError(msg)
    directory.mkdir(parents=True, exist_ok=True)
    evidence, memory = _evidence_files(model.evidence_), _memory_files(model.memory_)
    for name, dataset in (evidence | memory).items():
        encoding = {str(v): {"zlib": True, "complevel": 4, "shuffle": True} for v in dataset.data_vars}
        write_dataset(directory / name, dataset, encoding)
    head = xr.Dataset({"kernels": ("level", np.array(model.kernels_), {"units": "m", "long_name": "kernel sizes"})})
    head.attrs = {
        "title": "surface model of one survey epoch, adaptive mode",
        "state_version": STATE_VERSION,
        "settings": json.dumps(asdict(model.settings), sort_keys=True),
        "memory_days": model.memory_days,
        "resolution": np.nan if model.resolution is None else model.resolution,
        "survey_time": model.survey_time_,
        "own_kernel": model.own_kernel_,
        "memory_kernel": model.memory_kernel_,
        "cell_size": model.evidence_.cell_size,
        "is_weighted": int(model.evidence_.is_weighted),
        "files": json.dumps(sorted(evidence | memory)),
    }
    write_dataset(directory / ADAPTIVE_FILE, head)


def read_state(directory: Path, kind: type[Model]) -> Model:
    """
    Read a model's state; see `LWPRSurface.load`.

    Raises
    ------
    ModelStateError
        A file is missing, damaged, or of another format version.
    """
    head = read_dataset(directory / ADAPTIVE_FILE)
    version = head.attrs.get("state_version")
    if version != STATE_VERSION:
        msg = (
            f"{directory / 'model.nc'} has state version {version}, this software reads {STATE_VERSION}. "
            "Run `changedetect update` to learn the epoch again."
        )
        raise ModelStateError(msg)
    a = head.attrs
    resolution = float(a["resolution"])
    model = kind(
        AdaptiveConfig(**json.loads(a["settings"])),
        float(a["memory_days"]),
        None if np.isnan(resolution) else resolution,
    )
    files = {name: read_dataset(directory / name) for name in json.loads(a["files"])}
    model.survey_time_ = float(a["survey_time"])
    model.own_kernel_ = float(a["own_kernel"])
    model.memory_kernel_ = float(a["memory_kernel"])
    model.kernels_ = tuple(float(k) for k in head["kernels"].values)
    model.evidence_ = Evidence(float(a["cell_size"]), is_weighted=bool(a["is_weighted"]))
    for name, dataset in sorted(files.items()):
        if name.startswith("evidence_"):
            _load_evidence(model.evidence_, dataset)
    model.memory_ = _load_memory([d for n, d in sorted(files.items()) if n.startswith("memory_")])
    return model


def _tile_names(row: IntArray, column: IntArray) -> dict[tuple[int, int], IntArray]:
    """Members of every storage tile, in the order given."""
    tiles: dict[tuple[int, int], IntArray] = {}
    pairs = np.stack([row // _STORAGE_CELLS, column // _STORAGE_CELLS])
    unique, inverse = np.unique(pairs, axis=1, return_inverse=True)
    for k, (r, c) in enumerate(unique.T):
        tiles[int(r), int(c)] = np.flatnonzero(inverse.reshape(-1) == k)
    return tiles


def _evidence_files(evidence: Evidence) -> dict[str, xr.Dataset]:
    ordered = sorted(evidence.tiles)
    row = np.concatenate([t[0] * TILE_CELLS + evidence.tiles[t][0] // TILE_CELLS for t in ordered])
    column = np.concatenate([t[1] * TILE_CELLS + evidence.tiles[t][0] % TILE_CELLS for t in ordered])
    sums = np.concatenate([evidence.tiles[t][1] for t in ordered])
    files = {}
    for (r, c), members in _tile_names(row, column).items():
        s = sums[members].copy()
        # centred on the rounded mean elevation, in integers: exact to undo, and small numbers compress
        mean = np.floor(s[:, 7] / s[:, 1] + 0.5).astype(np.int64)
        s[:, 7] -= mean * s[:, 1]
        s[:, 10] -= mean * (2 * s[:, 7] + mean * s[:, 1])
        s[:, 8] -= mean * s[:, 2]
        s[:, 9] -= mean * s[:, 3]
        lanes = {
            name: ("cell", _narrow(s[:, k])) for k, name in enumerate(_LANES) if name != "w" or evidence.is_weighted
        }
        lanes["row"] = ("cell", _narrow(row[members] - r * _STORAGE_CELLS))
        lanes["column"] = ("cell", _narrow(column[members] - c * _STORAGE_CELLS))
        lanes["mean_elevation"] = ("cell", _narrow(mean))
        files[f"evidence_{r}_{c}.nc"] = xr.Dataset(
            lanes,
            attrs={
                "title": "exact sums over micro-cells, elevations about mean_elevation",
                "cell_size": evidence.cell_size,
                "tile_row": r,
                "tile_column": c,
                "tile_cells": _STORAGE_CELLS,
                "cell_size_units": "m",
                "comment": "cell row r (northwards) and column c (eastwards) of the tile has its south-west corner at "
                "easting (tile_column * tile_cells + c) * cell_size, northing likewise, in the CRS of the programme; "
                "offsets x, y from the cell centre are in units of cell_size * offset_unit_cells, elevations z in "
                "units of elevation_unit_m about mean_elevation; w is 1 where it is not stored, else "
                "1 / (sigma^2 * weight_unit_per_m2)",
                "weight_unit_per_m2": WEIGHT_UNIT,
                "offset_unit_cells": OFFSET_UNIT,
                "elevation_unit_m": ELEVATION_UNIT,
            },
        )
    return files


def _load_evidence(evidence: Evidence, dataset: xr.Dataset) -> None:
    n = dataset.sizes["cell"]
    s = np.empty((n, N_SUMS), np.int64)
    for k, name in enumerate(_LANES):
        s[:, k] = dataset[name if name in dataset else "n"].values
    mean = dataset["mean_elevation"].values.astype(np.int64)
    s[:, 8] += mean * s[:, 2]
    s[:, 9] += mean * s[:, 3]
    s[:, 10] += mean * (2 * s[:, 7] + mean * s[:, 1])
    s[:, 7] += mean * s[:, 1]
    row = dataset["row"].values.astype(np.int64) + int(dataset.attrs["tile_row"]) * _STORAGE_CELLS
    column = dataset["column"].values.astype(np.int64) + int(dataset.attrs["tile_column"]) * _STORAGE_CELLS
    tile = (row // TILE_CELLS) * (1 << 31) + column // TILE_CELLS
    order = np.lexsort((column, row, tile))
    starts = np.flatnonzero(np.r_[True, np.diff(tile[order]) != 0, True])
    for a, b in itertools.pairwise(starts):
        members = order[a:b]
        r, c = row[members], column[members]
        key = (r % TILE_CELLS) * TILE_CELLS + c % TILE_CELLS
        evidence.tiles[int(r[0] // TILE_CELLS), int(c[0] // TILE_CELLS)] = (key, s[members])


def _memory_files(memory: Cells | None) -> dict[str, xr.Dataset]:
    if memory is None or len(memory) == 0:
        return {}
    files = {}
    for (r, c), members in _tile_names(memory.row, memory.column).items():
        files[f"memory_{r}_{c}.nc"] = xr.Dataset(
            {
                "row": ("cell", memory.row[members].astype(np.int32)),
                "column": ("cell", memory.column[members].astype(np.int32)),
                "moments": (("cell", "lane"), memory.moments[members]),
            },
            attrs={
                "title": "remembered moments of earlier epochs about the cell centres",
                "cell_size": memory.cell_size,
                "cell_size_units": "m",
                "lanes": "n w wx wy wxx wxy wyy wz wxz wyz wzz wt ns2",
                "comment": "sums over observations: n count, w weight (1/m2), x y offset from the cell centre (m, east "
                "and north), z elevation (m), t time (days since 1970-01-01), s2 noise variance (m2); rows and columns "
                "count cells from the origin of the programme's CRS",
            },
        )
    return files


def _load_memory(datasets: list[xr.Dataset]) -> Cells | None:
    if not datasets:
        return None
    row = np.concatenate([d["row"].values for d in datasets]).astype(np.int64)
    column = np.concatenate([d["column"].values for d in datasets]).astype(np.int64)
    moments = np.concatenate([d["moments"].values for d in datasets])
    if moments.shape[1] != N_MOMENTS:
        msg = f"remembered moments have {moments.shape[1]} lanes, expected {N_MOMENTS}"
        raise ModelStateError(msg)
    order = np.lexsort((column, row))
    return Cells(float(datasets[0].attrs["cell_size"]), row[order], column[order], np.ascontiguousarray(moments[order]))


def _narrow(values: IntArray) -> np.typing.NDArray[Any]:
    """The same integers in the smallest signed type that holds them."""
    low, high = int(values.min()), int(values.max())
    for kind in (np.int8, np.int16, np.int32):
        if np.iinfo(kind).min < low and high <= np.iinfo(kind).max:
            return values.astype(kind)
    return values
