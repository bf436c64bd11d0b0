"""
CF NetCDF products: all layers of a surface or of a change in one self-describing file.

Follows the CF conventions 1.11 [1]_ and the attribute convention ACDD 1.3 [2]_. Positions are cell centres with
bounds; a change has time bounds [earlier, later].

References
----------
.. [1] Eaton et al. (2023), NetCDF Climate and Forecast (CF) Metadata Conventions 1.11.
.. [2] ESIP (2015), Attribute Convention for Data Discovery 1.3.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from changedetect import __version__
from changedetect.crs import horizontal_epsg, surface_standard_name, to_cf, to_wkt, vertical_part
from changedetect.io.cog import Category
from changedetect.storage import write_dataset

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from changedetect.grid import Grid

__all__ = [
    "CHANGE_CLASSES",
    "CHANGE_LAYERS",
    "CLASS_LAYERS",
    "CLASS_NODATA",
    "RESOLUTION_CLASSES",
    "SURFACE_LAYERS",
    "ChangeMetadata",
    "Layer",
    "ProductMetadata",
    "SurfaceMetadata",
    "change_dataset",
    "surface_dataset",
    "write_change",
    "write_surface",
]

#: Cells outside all data in a uint8 class layer; -1 in NetCDF, whose class layer is signed.
CLASS_NODATA = 255

CHANGE_CLASSES = (
    Category(0, "below_level_of_detection", "below level of detection", (235, 235, 235, 255)),
    Category(1, "surface_lowered", "lowered", (178, 24, 43, 255)),
    Category(2, "surface_raised", "raised", (33, 102, 172, 255)),
    Category(3, "not_observed", "not observed in both epochs", (189, 174, 108, 255)),
)

#: Which epoch limits what a difference resolves; see `changedetect.differencing.resolution_classes`.
RESOLUTION_CLASSES = (
    Category(0, "resolved_alike", "both epochs resolve alike", (235, 235, 235, 255)),
    Category(1, "limited_by_earlier", "limited by the earlier epoch", (221, 204, 119, 255)),
    Category(2, "limited_by_later", "limited by the later epoch", (136, 204, 238, 255)),
    Category(3, "change_not_resolved", "change found, too small to resolve its height and outline", (136, 34, 85, 255)),
)


@dataclass(frozen=True)
class Layer:
    """What a layer is called and means; `unit` in UDUNITS spelling, "1" for pure numbers."""

    long_name: str
    unit: str
    comment: str = ""
    standard_name: str | None = None


CHANGE_LAYERS = {
    "dod": Layer("change of elevation, later minus earlier", "m", "Positive where the surface was raised."),
    "dod_std": Layer("standard deviation of the change of elevation", "m"),
    "level_of_detection": Layer("level of detection of a change of elevation", "m"),
    "change_probability": Layer("probability that the elevation changed", "1"),
    "change_class": Layer("class of change", "1", standard_name="status_flag"),
    "z_score": Layer("change of elevation divided by its standard deviation", "1"),
    "correlated_error": Layer(
        "correlated error of the difference, as the unchanged ground around tells it",
        "m",
        "Taken off dod: dod plus this is the difference as measured. 0 where nothing is predicted.",
    ),
    "n_observations_earlier": Layer(
        "effective number of observations, earlier epoch", "1", standard_name="number_of_observations"
    ),
    "n_observations_later": Layer(
        "effective number of observations, later epoch", "1", standard_name="number_of_observations"
    ),
    "resolution": Layer(
        "ground resolution of the change of elevation",
        "m",
        "Full width at half maximum of the mean that an answer is. Narrower change comes out lower and wider.",
    ),
    "unresolved_std": Layer(
        "standard deviation of ground detail within the resolution",
        "m",
        "Detail of the finer epoch; whether it changed cannot be told. Not part of dod_std.",
    ),
    "resolution_class": Layer("what limits the ground resolution", "1", standard_name="status_flag"),
}

#: Layers of classes, with their classes.
CLASS_LAYERS = {"change_class": CHANGE_CLASSES, "resolution_class": RESOLUTION_CLASSES}

SURFACE_LAYERS = {
    "elevation": Layer("elevation of the surface", "m"),
    "elevation_std": Layer("standard deviation of the surface", "m"),
    "noise_std": Layer("standard deviation of one observation about the surface", "m"),
    "n_effective": Layer("effective number of observations", "1", standard_name="number_of_observations"),
    # "day", not "days", which xarray would decode as a duration
    "age_days": Layer("time from the last observation of the surface to this epoch", "day"),
}

_TIME_ATTRIBUTES = {
    "standard_name": "time",
    "long_name": "time of the survey",
    "units": "seconds since 1970-01-01T00:00:00Z",
    "calendar": "standard",
    "units_metadata": "leap_seconds: unknown",
    "axis": "T",
    "bounds": "time_bnds",
}


@dataclass(frozen=True, kw_only=True)
class ProductMetadata:
    """
    Where a product comes from.

    Attributes
    ----------
    programme : str
        Name of the monitoring programme.
    run_id, config_sha256 : str
        The run that wrote it and the settings it ran with.
    created : str
        Time of the run, ISO 8601.
    history : str
        One line per run: time, version, command. Made from the others where empty.
    institution, source, references : str
        CF global attributes; left out where empty.
    colour_limits : mapping of layer name to (minimum, maximum)
        For the styles beside the rasters; fixed for a programme, so that maps of different epochs compare. Layers
        without an entry get limits from their own values.
    """

    programme: str
    run_id: str
    config_sha256: str
    created: str
    history: str = ""
    institution: str = ""
    source: str = "Survey points, modelled by Locally Weighted Projection Regression"
    references: str = ""
    changedetect_version: str = __version__
    colour_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class SurfaceMetadata(ProductMetadata):
    """
    Metadata of the surface of one epoch.

    Attributes
    ----------
    epoch : str
        Epoch id.
    datetime : str
        Time of the survey, ISO 8601; UTC where no offset is given.
    datetime_first, datetime_last : str
        First and last observation; `datetime` where empty.
    """

    epoch: str
    datetime: str
    datetime_first: str = ""
    datetime_last: str = ""


@dataclass(frozen=True, kw_only=True)
class ChangeMetadata(ProductMetadata):
    """
    Metadata of the change between two epochs.

    Attributes
    ----------
    epoch_earlier, epoch_later : str
        Epoch ids.
    datetime_earlier, datetime_later : str
        Times of the surveys, ISO 8601; UTC where no offset is given.
    confidence : float
        Of the level of detection, two-sided, in (0, 1).
    change_threshold : float, m
        `change_probability` is that of a change larger than this, either way.
    """

    epoch_earlier: str
    epoch_later: str
    datetime_earlier: str
    datetime_later: str
    confidence: float
    change_threshold: float = 0.0


def change_dataset(layers: Mapping[str, NDArray[Any]], grid: Grid, meta: ChangeMetadata) -> xr.Dataset:
    """
    Assemble a change as CF dataset.

    Parameters
    ----------
    layers : mapping of name to array, shape (n_rows, n_cols)
        All of `CHANGE_LAYERS`: floating point with NaN for no data; those of `CLASS_LAYERS` uint8 with 255.
    grid : Grid
    meta : ChangeMetadata

    Returns
    -------
    dataset : xarray.Dataset
        Dimensions (time, y, x), one time: the later epoch, with bounds [earlier, later]. Layers are float32,
        classes int8 with -1 for no data.

    Raises
    ------
    ValueError
        A layer is missing or has another shape, a class value is unknown, or the epochs are in reverse order.
    """
    _check_layers(layers, CHANGE_LAYERS, grid)
    earlier, later = _seconds(meta.datetime_earlier), _seconds(meta.datetime_later)
    variables = {name: _variable(layers[name], layer) for name, layer in CHANGE_LAYERS.items()}
    variables |= {name: _class_variable(name, layers[name], classes) for name, classes in CLASS_LAYERS.items()}
    variables["dod"].attrs["ancillary_variables"] = " ".join(name for name in CHANGE_LAYERS if name != "dod")
    variables["level_of_detection"].attrs["comment"] = (
        f"A change larger than this, either way, is significant at a confidence of {meta.confidence:g} (two-sided): "
        f"the quantile of the standardised change at {(1 + meta.confidence) / 2:g} times dod_std."
    )
    variables["change_probability"].attrs["comment"] = (
        f"Probability that the absolute change exceeds {meta.change_threshold:g} m."
    )
    title = f"{meta.programme}: change of elevation from {meta.epoch_earlier} to {meta.epoch_later}"
    attributes = global_attributes(grid, meta, title, meta.datetime_earlier, meta.datetime_later) | {
        "id": f"{meta.programme}-{meta.epoch_earlier}-{meta.epoch_later}-dod",
        "epoch_earlier": meta.epoch_earlier,
        "epoch_later": meta.epoch_later,
        "confidence": meta.confidence,
    }
    return _dataset(variables, grid, (later, earlier, later), attributes)


def surface_dataset(layers: Mapping[str, NDArray[Any]], grid: Grid, meta: SurfaceMetadata) -> xr.Dataset:
    """
    Assemble the surface of an epoch as CF dataset.

    Parameters
    ----------
    layers : mapping of name to array, shape (n_rows, n_cols)
        All of `SURFACE_LAYERS`, floating point, NaN for no data.
    grid : Grid
    meta : SurfaceMetadata

    Returns
    -------
    dataset : xarray.Dataset
        Dimensions (time, y, x), one time with the bounds of the survey; float32.

    Raises
    ------
    ValueError
        A layer is missing or has another shape, or the survey ends before it begins.
    """
    _check_layers(layers, SURFACE_LAYERS, grid)
    first, last = meta.datetime_first or meta.datetime, meta.datetime_last or meta.datetime
    variables = {name: _variable(layers[name], layer) for name, layer in SURFACE_LAYERS.items()}
    others = [name for name in SURFACE_LAYERS if name != "elevation"]
    variables["elevation"].attrs["ancillary_variables"] = " ".join(others)
    standard_name = surface_standard_name(grid.crs)
    if standard_name is not None:
        variables["elevation"].attrs["standard_name"] = standard_name
        variables["elevation_std"].attrs["standard_name"] = f"{standard_name} standard_error"
    attributes = global_attributes(grid, meta, f"{meta.programme}: surface of {meta.epoch}", first, last) | {
        "id": f"{meta.programme}-{meta.epoch}",
        "epoch": meta.epoch,
    }
    return _dataset(variables, grid, (_seconds(meta.datetime), _seconds(first), _seconds(last)), attributes)


def write_change(path: Path, layers: Mapping[str, NDArray[Any]], grid: Grid, meta: ChangeMetadata) -> None:
    """
    Write a change as CF NetCDF, atomically; parameters as `change_dataset`.

    Raises
    ------
    OutputError
        The file cannot be written.
    ValueError
        As `change_dataset`.
    """
    _write(Path(path), change_dataset(layers, grid, meta))


def write_surface(path: Path, layers: Mapping[str, NDArray[Any]], grid: Grid, meta: SurfaceMetadata) -> None:
    """
    Write the surface of an epoch as CF NetCDF, atomically; parameters as `surface_dataset`.

    Raises
    ------
    OutputError
        The file cannot be written.
    ValueError
        As `surface_dataset`.
    """
    _write(Path(path), surface_dataset(layers, grid, meta))


def _write(path: Path, dataset: xr.Dataset) -> None:
    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        if variable.dims != ("time", "y", "x"):
            encoding[str(name)] = {"_FillValue": None}  # xarray would declare NaN, which CF forbids on coordinates
            continue
        chunks = tuple(min(512, n) for n in variable.shape)
        fill = np.int8(-1) if variable.dtype == np.int8 else np.float32(np.nan)
        encoding[str(name)] = {"zlib": True, "complevel": 4, "shuffle": True, "chunksizes": chunks, "_FillValue": fill}
    write_dataset(path, dataset, encoding)


def _check_layers(layers: Mapping[str, NDArray[Any]], expected: Mapping[str, Layer], grid: Grid) -> None:
    if set(layers) != set(expected):
        missing, unknown = sorted(set(expected) - set(layers)), sorted(set(layers) - set(expected))
        msg = f"A product has the layers {', '.join(expected)}; missing: {missing}, unknown: {unknown}."
        raise ValueError(msg)
    for name, array in layers.items():
        if array.shape != grid.shape:
            msg = f"Layer {name!r} has shape {array.shape}, its grid {grid.shape}; both are (n_rows, n_cols)."
            raise ValueError(msg)


def _variable(array: NDArray[Any], layer: Layer) -> xr.Variable:
    attributes = {
        "long_name": layer.long_name,
        "standard_name": layer.standard_name,
        "units": layer.unit,
        "comment": layer.comment,
        "grid_mapping": "spatial_ref",
        "cell_methods": "area: point",  # the model is evaluated at cell centres
    }
    attributes = {key: value for key, value in attributes.items() if value}
    return xr.Variable(("time", "y", "x"), np.asarray(array, dtype=np.float32)[np.newaxis], attributes)


def _class_variable(name: str, classes: NDArray[Any], categories: Sequence[Category]) -> xr.Variable:
    values = [c.value for c in categories]
    unknown = np.setdiff1d(np.unique(classes), [*values, CLASS_NODATA])
    if unknown.size:
        msg = f"Unknown values in {name}: {unknown.tolist()}; allowed are {values}, {CLASS_NODATA} for no data."
        raise ValueError(msg)
    layer = CHANGE_LAYERS[name]
    attributes = {
        "long_name": layer.long_name,
        "standard_name": layer.standard_name,
        "flag_values": np.array(values, dtype=np.int8),
        "flag_meanings": " ".join(c.meaning for c in categories),
        "valid_range": np.array([min(values), max(values)], dtype=np.int8),
        "grid_mapping": "spatial_ref",
        "cell_methods": "area: point",
    }
    signed = np.where(classes == CLASS_NODATA, np.int8(-1), classes.astype(np.int8))
    return xr.Variable(("time", "y", "x"), signed[np.newaxis], attributes)


def _dataset(
    variables: Mapping[str, xr.Variable], grid: Grid, times: tuple[float, float, float], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """Layers with their coordinates; `times` = (time, first bound, second bound), s since 1970."""
    time, first, last = times
    if not first <= time <= last:
        begin, end = (datetime.fromtimestamp(t, UTC).isoformat() for t in (first, last))
        own = datetime.fromtimestamp(time, UTC).isoformat()
        msg = f"The time of a product must lie within its bounds, in order; got {own} within {begin} to {end}."
        raise ValueError(msg)
    west, _, _, north = grid.region
    steps_x, steps_y = np.arange(grid.n_cols + 1), np.arange(grid.n_rows + 1)
    edges_x, edges_y = west + steps_x * grid.resolution, north - steps_y * grid.resolution
    coordinates = {
        "time": ("time", np.array([time]), _TIME_ATTRIBUTES),
        "y": ("y", grid.northing, axis_attributes("y")),
        "x": ("x", grid.easting, axis_attributes("x")),
    }
    auxiliary = {
        "time_bnds": (("time", "nv"), np.array([[first, last]])),
        "y_bnds": (("y", "nv"), np.column_stack([edges_y[:-1], edges_y[1:]])),
        "x_bnds": (("x", "nv"), np.column_stack([edges_x[:-1], edges_x[1:]])),
        "spatial_ref": ((), np.int32(0), grid_mapping(grid)),
    }
    return xr.Dataset({**variables, **auxiliary}, coordinates, dict(attributes))


def axis_attributes(name: str) -> dict[str, str]:
    direction = {"x": "easting", "y": "northing"}[name]
    return {
        "standard_name": f"projection_{name}_coordinate",
        "long_name": f"{direction} of the cell centre",
        "units": "m",
        "axis": name.upper(),
        "bounds": f"{name}_bnds",
    }


def grid_mapping(grid: Grid) -> dict[str, Any]:
    """CF attributes, and the two that GDAL reads: `spatial_ref` and `GeoTransform` (west, a, b, north, d, e)."""
    a, b, c, d, e, f = grid.transform
    geotransform = " ".join(repr(v) for v in (c, a, b, f, d, e))
    return {**to_cf(grid.crs), "spatial_ref": to_wkt(grid.crs), "GeoTransform": geotransform}


def global_attributes(grid: Grid, meta: ProductMetadata, title: str, first: str, last: str) -> dict[str, Any]:
    west, east, south, north = grid.region
    epsg, vertical = horizontal_epsg(grid.crs), vertical_part(grid.crs)
    ring = ((west, south), (east, south), (east, north), (west, north), (west, south))
    polygon = f"POLYGON (({', '.join(f'{x!r} {y!r}' for x, y in ring)}))"
    history = meta.history or f"{meta.created} changedetect {meta.changedetect_version}, run {meta.run_id}"
    attributes = {
        "Conventions": "CF-1.11 ACDD-1.3",
        "title": title,
        "institution": meta.institution,
        "source": meta.source,
        "history": history,
        "references": meta.references,
        "programme": meta.programme,
        "date_created": meta.created,
        "time_coverage_start": _iso_utc(first),
        "time_coverage_end": _iso_utc(last),
        "geospatial_bounds": polygon if epsg is not None else "",
        "geospatial_bounds_crs": f"EPSG:{epsg}" if epsg is not None else "",
        "vertical_crs": vertical or "",
        "changedetect_version": meta.changedetect_version,
        "run_id": meta.run_id,
        "config_sha256": meta.config_sha256,
    }
    return {key: value for key, value in attributes.items() if value}


def _seconds(iso: str) -> float:
    return _parse_time(iso).timestamp()


def _iso_utc(iso: str) -> str:
    return _parse_time(iso).astimezone(UTC).isoformat().replace("+00:00", "Z")


def _parse_time(iso: str) -> datetime:
    try:
        time = datetime.fromisoformat(iso)
    except ValueError as error:
        msg = f"Not a time in ISO 8601: {iso!r}. Write 2024-05-01 or 2024-05-01T10:30:00Z."
        raise ValueError(msg) from error
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
