"""Rasters of an epoch and of the difference of two, each in a folder that is whole or absent."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

import changedetect
from changedetect.catalogue import ChangeProduct, ProductRecord, Programme, describe_files
from changedetect.config import ProgrammeConfig
from changedetect.differencing import difference_models, summarise
from changedetect.errors import ConfigError, ModelStateError
from changedetect.grid import Grid
from changedetect.io.netcdf import CHANGE_LAYERS, SURFACE_LAYERS
from changedetect.io.products import (
    ChangeMetadata,
    SurfaceMetadata,
    write_change_products,
    write_epoch_products,
)
from changedetect.models.base import SurfaceModel
from changedetect.pipeline.colours import change_limits, programme_limits, surface_limits
from changedetect.pipeline.learn import ModelShelf
from changedetect.pipeline.manifest import utc_now
from changedetect.pipeline.regions import join_regions
from changedetect.storage import read_json, write_json
from changedetect.typing import FloatArray, JSONObject, Region

__all__ = [
    "SUMMARY_FILE",
    "make_epoch_products",
    "make_pair_products",
    "offset_warning",
    "predict_layers",
    "product_grid",
]

logger = logging.getLogger(__name__)

SUMMARY_FILE = "summary.json"
#: Version of the layout of `summary.json`.
SUMMARY_FORMAT_VERSION = 1
#: Cells predicted at a time, along each side.
#: A raster of more cells is refused: 20 000 x 20 000.
_MAX_CELLS = 4e8
_BLOCK = 512
#: Names the rasters have in `ChangeMaps` where they differ.
_MAP_NAMES = {"n_observations_earlier": "n_effective_earlier", "n_observations_later": "n_effective_later"}


def product_grid(
    config: ProgrammeConfig, region: Region, *, resolution: float | None = None, bounds: Region | None = None
) -> Grid:
    """
    Return the grid of a product: the bounds given, the programme's, or else `region`, snapped outwards.

    All grids of a resolution have their cell borders on its multiples, so that rasters of different epochs overlay
    cell by cell even where their extents differ.

    Raises
    ------
    ConfigError
        Resolution or bounds enclose nothing, or the raster would be too large to be meant.
    """
    cell = config.resolution if resolution is None else resolution
    west, east, south, north = bounds or config.bounds or region
    if not cell > 0.0:
        msg = f"The resolution must be above zero, not {cell:g} m."
        raise ConfigError(msg)
    if not (west < east and south < north):
        msg = f"Bounds are west east south north with west < east and south < north, not {west} {east} {south} {north}."
        raise ConfigError(msg)
    n_cells = (east - west) * (north - south) / cell**2
    if n_cells > _MAX_CELLS:
        size = f"{east - west:,.0f} m x {north - south:,.0f} m at {cell:g} m"
        msg = (
            f"A raster of {size} has {n_cells:,.0f} cells; at most {_MAX_CELLS:,.0f} are made. Set bounds in "
            "programme.toml (are there stray points far from the site?) or a coarser resolution."
        )
        raise ConfigError(msg)
    return Grid.from_region((west, east, south, north), cell, config.crs)


def predict_layers(model: SurfaceModel, grid: Grid) -> dict[str, FloatArray]:
    """
    Evaluate a surface at the cell centres of a grid.

    Returns
    -------
    layers : dict of name to array, shape (n_rows, n_cols), float64
        The fields of `Prediction`.
    """
    layers = {name: np.full(grid.shape, np.nan) for name in SURFACE_LAYERS}
    for rows, cols, block in grid.blocks(_BLOCK):
        prediction = model.predict(block.coordinates())
        for name, layer in layers.items():
            layer[rows, cols] = getattr(prediction, name).reshape(block.shape)
    return layers


def make_epoch_products(
    programme: Programme, epoch_id: str, models: ModelShelf, run_id: str, directory: Path | None = None
) -> JSONObject:
    """
    Write the rasters of one epoch.

    Parameters
    ----------
    programme : Programme
    epoch_id : str
    models : ModelShelf
    run_id : str
    directory : Path, optional
        The programme's own folder by default.

    Returns
    -------
    details : dict
        For the run's manifest.
    """
    epoch, config = programme.epoch(epoch_id), programme.config
    model = models.get(epoch_id)
    grid = product_grid(config, model.region)
    layers = predict_layers(model, grid)
    limits = programme_limits(programme, (epoch_id,)) or surface_limits(layers)
    meta = SurfaceMetadata(
        programme=config.name,
        run_id=run_id,
        config_sha256=config.config_sha256,
        created=utc_now(),
        colour_limits=limits,
        epoch=epoch_id,
        datetime=epoch.date.isoformat(),
    )
    add_manifest = _manifest_writer(programme, (epoch_id,), grid, run_id, limits=limits, warnings=())
    folder = programme.product_directory(epoch_id) if directory is None else directory
    files = write_epoch_products(folder, layers, grid, meta, add_files=add_manifest)
    observed = float(np.mean(np.isfinite(layers["elevation"])))
    return {"directory": str(folder), "n_files": len(files), "shape": list(grid.shape), "covered_share": observed}


def make_pair_products(
    programme: Programme, pair: ChangeProduct, models: ModelShelf, run_id: str, directory: Path | None = None
) -> JSONObject:
    """
    Write the rasters and the summary of the difference of two epochs; parameters as `make_epoch_products`.

    Returns
    -------
    details : dict
        For the run's manifest; `warnings` is a list of what people should know, `summary` what the folder's
        `summary.json` says.
    """
    config = programme.config
    earlier, later = models.get(pair.earlier), models.get(pair.later)
    grid = product_grid(config, join_regions(earlier.region, later.region))
    maps = difference_models(earlier, later, grid, config.differencing)
    statistics = summarise(maps, grid)
    warning = offset_warning(statistics)
    warnings = (warning,) if warning else ()
    epochs = [programme.epoch(pair.earlier), programme.epoch(pair.later)]
    summary: JSONObject = {
        "format_version": SUMMARY_FORMAT_VERSION,
        "programme": config.name,
        "epoch_earlier": pair.earlier,
        "epoch_later": pair.later,
        "date_earlier": epochs[0].date_text,
        "date_later": epochs[1].date_text,
        "crs": config.crs,
        "confidence": config.differencing.confidence,
        "warnings": list(warnings),
        **statistics,
    }
    layers = {name: getattr(maps, _MAP_NAMES.get(name, name)) for name in CHANGE_LAYERS}
    limits = programme_limits(programme, (pair.earlier, pair.later)) or change_limits(maps)
    meta = ChangeMetadata(
        programme=config.name,
        run_id=run_id,
        config_sha256=config.config_sha256,
        created=utc_now(),
        colour_limits=limits,
        epoch_earlier=pair.earlier,
        epoch_later=pair.later,
        datetime_earlier=epochs[0].date.isoformat(),
        datetime_later=epochs[1].date.isoformat(),
        confidence=config.differencing.confidence,
        change_threshold=config.differencing.change_threshold_m,
    )
    add_manifest = _manifest_writer(
        programme, (pair.earlier, pair.later), grid, run_id, limits=limits, warnings=warnings
    )

    def add_files(folder: Path) -> None:
        write_json(folder / SUMMARY_FILE, summary)
        add_manifest(folder)

    folder = programme.product_directory(pair.product_id) if directory is None else directory
    files = write_change_products(folder, layers, grid, meta, add_files=add_files)
    return {
        "directory": str(folder),
        "n_files": len(files),
        "shape": list(grid.shape),
        "warnings": list(warnings),
        "summary": read_json(folder / SUMMARY_FILE),
    }


def offset_warning(summary: JSONObject) -> str | None:
    """
    Say in words that two epochs differ by a constant, if `summarise` found that they do.

    Parameters
    ----------
    summary : dict
        As `changedetect.differencing.summarise` returns it.
    """
    offset = summary["systematic_offset_m"]
    if offset is None:
        return None
    moved = summary["area_raised_m2" if offset > 0 else "area_lowered_m2"] / summary["area_observed_m2"]
    return (
        f"epochs differ by a median of {offset:+.2f} m over {100.0 * moved:.0f} % of the area, as a vertical datum or "
        "registration step would; no co-registration is applied"
    )


def _manifest_writer(
    programme: Programme,
    epoch_ids: tuple[str, ...],
    grid: Grid,
    run_id: str,
    *,
    limits: Mapping[str, tuple[float, float]],
    warnings: tuple[str, ...],
) -> Callable[[Path], None]:
    """Return what adds the manifest to a folder of products, last of its files."""
    config = programme.config
    states = {epoch_id: _state_sha256(programme, epoch_id) for epoch_id in epoch_ids}

    def write(folder: Path) -> None:
        ProductRecord(
            epochs=epoch_ids,
            states=states,
            settings=config.product_settings(differencing=len(epoch_ids) == 2),
            config_sha256=config.config_sha256,
            region=grid.region,
            colour_limits=limits,
            warnings=warnings,
            files=describe_files(folder),
            software_version=changedetect.__version__,
            run_id=run_id,
            created=utc_now(),
        ).write(folder)

    return write


def _state_sha256(programme: Programme, epoch_id: str) -> str:
    found = programme.state_record(epoch_id)
    if found is None:
        msg = f"Epoch '{epoch_id}' has not been learned. Run: changedetect update {programme.directory}"
        raise ModelStateError(msg)
    return found[1]
