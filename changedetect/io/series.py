"""
Time series of a programme: CF NetCDF of cells and zones, and CSV tables of zones.

Layers over time are written slab by slab, so that memory does not grow with the number of epochs.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import netCDF4
import numpy as np
import xarray as xr

from changedetect.io.cog import Category
from changedetect.io.netcdf import Layer, ProductMetadata, axis_attributes, global_attributes, grid_mapping
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from changedetect.grid import Grid

__all__ = [
    "CELL_LAYERS",
    "SERIES_CLASSES",
    "TIME_LAYERS",
    "SeriesMetadata",
    "ZoneSeries",
    "write_series",
    "write_table",
]

SERIES_CLASSES = (
    Category(0, "no_change_found", "no change found", (235, 235, 235, 255)),
    Category(1, "trend_lowering", "lowering steadily", (244, 165, 130, 255)),
    Category(2, "trend_raising", "rising steadily", (146, 197, 222, 255)),
    Category(3, "break_lowered", "lowered once, confirmed", (178, 24, 43, 255)),
    Category(4, "break_raised", "raised once, confirmed", (33, 102, 172, 255)),
    Category(5, "unconfirmed_break", "changed, not confirmed by a second survey", (254, 224, 139, 255)),
    Category(6, "came_and_went", "changed and returned", (153, 112, 171, 255)),
    Category(7, "irregular", "changed, in no simple way", (90, 90, 90, 255)),
    Category(8, "too_few_surveys", "fewer than two surveys", (189, 174, 108, 255)),
)
#: Cells that no epoch observed, in a uint8 array; -1 in the file.
CLASS_OUTSIDE = 255

#: Layers over (time, y, x).
TIME_LAYERS = {
    "dod": Layer(
        "change of elevation since the first epoch",
        "m",
        "Positive where the surface was raised. Missing where the first epoch or this one did not observe the ground: "
        "that is not unchanged ground. All changes share the error of the first epoch.",
    ),
    "dod_std": Layer(
        "standard deviation of the change of elevation since the first epoch",
        "m",
        "Root of the sum of the squares of epoch_std of this epoch and of the first.",
    ),
    "epoch_std": Layer(
        "standard deviation of the error of this epoch's own surface",
        "m",
        "Errors of different epochs are independent: the change between any two epochs has the sum of their squares as "
        "variance. What all epochs share is not in it; what some share is, so that no variance comes out too small.",
    ),
    "observed": Layer("whether the epoch observed the ground", "1", standard_name="status_flag"),
    "n_observations": Layer("effective number of observations", "1", standard_name="number_of_observations"),
}
#: Layers over (y, x).
CELL_LAYERS = {
    "elevation": Layer("elevation of the first epoch that observed the ground", "m"),
    "trend": Layer("trend of the elevation", "m year-1", "Generalised least squares over all surveys of the cell."),
    "trend_std": Layer(
        "standard deviation of the trend", "m year-1", "Widened where the elevation does not follow a line."
    ),
    "p_value": Layer(
        "probability that ground without change shows as much",
        "1",
        "Of the largest trend, step at any date, or change that came and went: holds over all dates.",
    ),
    "break_probability": Layer("probability that the elevation changed once and stayed", "1"),
    "break_time": Layer(
        "time of the most probable break",
        "",
        "Middle between the surveys before and after; for a change that came and went, of its beginning.",
    ),
    "break_time_earliest": Layer("earliest time of the break, if there is one, at 95 % probability", ""),
    "break_time_latest": Layer("latest time of the break, if there is one, at 95 % probability", ""),
    "break_size": Layer("size of the break, elevation after less elevation before", "m"),
    "break_size_std": Layer("standard deviation of the size of the break", "m"),
    "surveys_before": Layer("surveys before the break", "1"),
    "confirming_surveys": Layer("surveys since the break that agree with the new level and not with the old", "1"),
    "contradicting_surveys": Layer("surveys since the break that agree with the old level and not with the new", "1"),
    "return_time": Layer("time at which a change that came had gone", ""),
    "misfit": Layer("mean square of the residuals, in what the errors explain", "1"),
    "n_surveys": Layer("surveys that observed the ground", "1"),
    "series_class": Layer("what the ground did", "1", standard_name="status_flag"),
}
_TIMES = ("break_time", "break_time_earliest", "break_time_latest", "return_time")
_COUNTS = ("surveys_before", "confirming_surveys", "contradicting_surveys", "n_surveys")
_TIME_UNITS = {"units": "seconds since 1970-01-01T00:00:00Z", "calendar": "standard"}
_DAY = 86400.0
_CHUNK = 512


@dataclass(frozen=True, kw_only=True)
class SeriesMetadata(ProductMetadata):
    """
    Metadata of a series.

    Attributes
    ----------
    epochs : tuple of str
        Epoch ids in the order of time.
    times : tuple of float, days
        Since 1970-01-01, one an epoch.
    confidence : float
        Of the intervals of zones, and at which a survey agrees with a level.
    false_alarm_level : float
        Largest `p_value` of cells and zones that get a class of change.
    """

    epochs: tuple[str, ...]
    times: tuple[float, ...]
    confidence: float
    false_alarm_level: float


@dataclass(frozen=True)
class ZoneSeries:
    """
    Series of zones for the file.

    Attributes
    ----------
    names : tuple of str
    over_time : mapping of name to array, shape (n_zones, n_epochs)
        With their unit and what they are, as `Layer`.
    judged : mapping of name to array, shape (n_zones,)
        As `CELL_LAYERS`, without elevation.
    """

    names: tuple[str, ...]
    over_time: Mapping[str, tuple[NDArray[Any], Layer]]
    judged: Mapping[str, NDArray[Any]]


def write_series(
    path: Path,
    cells: Mapping[str, NDArray[Any]],
    slab: Callable[[int], Mapping[str, NDArray[Any]]],
    grid: Grid,
    meta: SeriesMetadata,
    zones: ZoneSeries | None = None,
) -> None:
    """
    Write a series as CF NetCDF, atomically.

    Parameters
    ----------
    path : Path
    cells : mapping of name to array, shape (n_rows, n_cols)
        All of `CELL_LAYERS`; times in days since 1970-01-01, `series_class` uint8 with 255 outside.
    slab : callable
        Gives all of `TIME_LAYERS` of an epoch, by its number; arrays of shape (n_rows, n_cols).
    grid : Grid
    meta : SeriesMetadata
    zones : ZoneSeries, optional

    Raises
    ------
    OutputError
        The file cannot be written.
    ValueError
        A layer is missing or has another shape.
    """
    missing = sorted(set(CELL_LAYERS) ^ set(cells))
    if missing or any(array.shape != grid.shape for array in cells.values()):
        msg = f"A series has the layers {', '.join(CELL_LAYERS)}, each of shape {grid.shape}; not so: {missing}."
        raise ValueError(msg)
    dataset = _frame(cells, grid, meta, zones)
    encoding = {str(name): _encoding(str(name), variable) for name, variable in dataset.variables.items()}
    with atomic_path(path) as temporary:
        dataset.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding, unlimited_dims=())
        with netCDF4.Dataset(temporary, "a") as file:
            _append_slabs(file, slab, grid, len(meta.epochs))


def _encoding(name: str, variable: xr.Variable) -> dict[str, Any]:
    if variable.dims == ("y", "x"):
        return _packing(("y", "x"), variable.shape, variable.dtype)
    if name.startswith("zone_"):
        return {"_FillValue": _fill(variable.dtype)}
    # xarray would declare NaN, which CF forbids on coordinates
    return {} if variable.dtype.kind == "U" else {"_FillValue": None}


def _append_slabs(file: Any, slab: Callable[[int], Mapping[str, NDArray[Any]]], grid: Grid, n_epochs: int) -> None:
    """Write the layers over time, one epoch at a time."""
    variables = {}
    for name, layer in TIME_LAYERS.items():
        kind = np.dtype(np.int8 if name == "observed" else np.float32)
        packing = _packing(("time", "y", "x"), (1, *grid.shape), kind)
        variable = file.createVariable(
            name, kind, ("time", "y", "x"), zlib=True, complevel=packing["complevel"], shuffle=True,
            chunksizes=packing["chunksizes"], fill_value=packing["_FillValue"],
        )  # fmt: skip
        variable.setncatts(_attributes(layer))
        variables[name] = variable
    variables["dod"].setncattr("ancillary_variables", "dod_std epoch_std observed n_observations")
    variables["observed"].setncatts(
        {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "not_observed observed"}
    )
    for k in range(n_epochs):
        layers = slab(k)
        for name, variable in variables.items():
            variable[k] = np.asarray(layers[name], variable.dtype)


def _packing(dims: tuple[str, ...], shape: Sequence[int], kind: np.dtype[Any]) -> dict[str, Any]:
    chunks = tuple(1 if dim == "time" else min(_CHUNK, n) for dim, n in zip(dims, shape, strict=True))
    return {"zlib": True, "complevel": 4, "shuffle": True, "chunksizes": chunks, "_FillValue": _fill(kind)}


def _fill(kind: np.dtype[Any]) -> Any:
    return kind.type(-1) if kind.kind == "i" else kind.type(np.nan)


def _frame(cells: Mapping[str, NDArray[Any]], grid: Grid, meta: SeriesMetadata, zones: ZoneSeries | None) -> xr.Dataset:
    """Everything but the layers over time."""
    west, _, _, north = grid.region
    edges_x = west + np.arange(grid.n_cols + 1) * grid.resolution
    edges_y = north - np.arange(grid.n_rows + 1) * grid.resolution
    seconds = np.asarray(meta.times) * _DAY
    first = np.full(seconds.shape, seconds[0])
    time = {"standard_name": "time", "long_name": "time of the survey", "axis": "T", "bounds": "time_bnds"}
    time |= {**_TIME_UNITS, "units_metadata": "leap_seconds: unknown"}
    coordinates = {
        "time": ("time", seconds, time),
        "y": ("y", grid.northing, axis_attributes("y")),
        "x": ("x", grid.easting, axis_attributes("x")),
        "epoch_id": ("time", np.array(meta.epochs, dtype=str), {"long_name": "epoch"}),
    }
    variables: dict[str, Any] = {
        "time_bnds": (("time", "nv"), np.column_stack([first, seconds])),
        "y_bnds": (("y", "nv"), np.column_stack([edges_y[:-1], edges_y[1:]])),
        "x_bnds": (("x", "nv"), np.column_stack([edges_x[:-1], edges_x[1:]])),
        "spatial_ref": ((), np.int32(0), grid_mapping(grid)),
    }
    for name, layer in CELL_LAYERS.items():
        variables[name] = (("y", "x"), *_encoded(name, cells[name], layer))
    if zones is not None:
        coordinates["zone"] = ("zone", np.array(zones.names, dtype=str), {"long_name": "name of the zone"})
        for name, (array, layer) in zones.over_time.items():
            variables[f"zone_{name}"] = (("zone", "time"), np.asarray(array, np.float64), _plain(layer))
        for name, array in zones.judged.items():
            values, attributes = _encoded(name, array, CELL_LAYERS[name])
            del attributes["grid_mapping"], attributes["cell_methods"]
            attributes["long_name"] += " of the zone"
            variables[f"zone_{name}"] = (("zone",), values, attributes)
    return xr.Dataset(variables, coordinates, _global(grid, meta))


def _global(grid: Grid, meta: SeriesMetadata) -> dict[str, Any]:
    dates = [str(np.datetime64(round(days * _DAY), "s")) for days in (meta.times[0], meta.times[-1])]
    title = f"{meta.programme}: change of elevation over {len(meta.epochs)} surveys"
    return global_attributes(grid, meta, title, dates[0], dates[1]) | {
        "id": f"{meta.programme}-series",
        "epoch_first": meta.epochs[0],
        "epoch_last": meta.epochs[-1],
        "confidence": meta.confidence,
        "false_alarm_level": meta.false_alarm_level,
    }


def _encoded(name: str, array: NDArray[Any], layer: Layer) -> tuple[NDArray[Any], dict[str, Any]]:
    attributes = _attributes(layer)
    if name == "series_class":
        values = [c.value for c in SERIES_CLASSES]
        attributes |= {
            "flag_values": np.array(values, np.int8),
            "flag_meanings": " ".join(c.meaning for c in SERIES_CLASSES),
            "valid_range": np.array([min(values), max(values)], np.int8),
        }
        return np.where(array == CLASS_OUTSIDE, np.int8(-1), array.astype(np.int8)), attributes
    if name in _TIMES:
        return np.asarray(array, np.float64) * _DAY, attributes | _TIME_UNITS
    if name in _COUNTS:
        return np.where(np.isfinite(array), array, -1).astype(np.int16), attributes
    return np.asarray(array, np.float32), attributes


def _attributes(layer: Layer) -> dict[str, Any]:
    return _plain(layer) | {"grid_mapping": "spatial_ref", "cell_methods": "area: point"}


def _plain(layer: Layer) -> dict[str, Any]:
    described = {
        "long_name": layer.long_name,
        "standard_name": layer.standard_name,
        "units": layer.unit,
        "comment": layer.comment,
    }
    return {key: value for key, value in described.items() if value}


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """
    Write rows of equal columns as CSV, atomically; None and NaN become empty fields.

    Parameters
    ----------
    path : Path
    rows : sequence of mapping
        At least one.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: _field(value) for key, value in row.items()})


def _field(value: Any) -> Any:
    is_missing = value is None or (isinstance(value, float) and np.isnan(value))
    return "" if is_missing else value
