"""Rasters of an epoch and of the difference of two, each in a folder that is whole or absent."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import changedetect
from changedetect.catalogue import ChangeProduct, ProductRecord, Programme, describe_files
from changedetect.errors import InputDataError, ModelStateError
from changedetect.grid import Grid
from changedetect.io.geopackage import write_objects
from changedetect.io.netcdf import CHANGE_LAYERS
from changedetect.io.products import (
    ChangeMetadata,
    SurfaceMetadata,
    write_change_products,
    write_epoch_products,
)
from changedetect.pipeline.colours import change_limits, programme_limits, surface_limits
from changedetect.pipeline.learn import ModelShelf
from changedetect.pipeline.manifest import utc_now
from changedetect.pipeline.pairs import difference_pair
from changedetect.pipeline.rasters import predict_layers, product_grid
from changedetect.pipeline.regions import describe_region
from changedetect.pipeline.stac import write_item
from changedetect.storage import read_json, write_json
from changedetect.typing import JSONObject

__all__ = [
    "OBJECTS_FILE",
    "SUMMARY_FILE",
    "difference_warning",
    "make_epoch_products",
    "make_pair_products",
    "predict_layers",
    "product_grid",
]

logger = logging.getLogger(__name__)

SUMMARY_FILE = "summary.json"
OBJECTS_FILE = "objects.gpkg"
#: Version of the layout of `summary.json`.
SUMMARY_FORMAT_VERSION = 1
#: Names the rasters have in `ChangeMaps` where they differ.
_MAP_NAMES = {"n_observations_earlier": "n_effective_earlier", "n_observations_later": "n_effective_later"}


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
    limits = programme_limits(programme, (epoch_id,), surface_limits(layers))
    meta = SurfaceMetadata(
        programme=config.name,
        run_id=run_id,
        config_sha256=config.config_sha256,
        created=utc_now(),
        colour_limits=limits,
        epoch=epoch_id,
        datetime=epoch.date.isoformat(),
    )
    add_manifest = _manifest_writer(
        programme, (epoch_id,), grid, run_id, limits=limits, warnings=(), is_listed=directory is None
    )
    folder = programme.product_directory(epoch_id) if directory is None else directory
    files = write_epoch_products(folder, layers, grid, meta, add_files=add_manifest)
    observed = float(np.mean(np.isfinite(layers["elevation"])))
    return {"directory": str(folder), "n_files": len(files), "shape": list(grid.shape), "covered_share": observed}


def make_pair_products(
    programme: Programme, pair: ChangeProduct, models: ModelShelf, run_id: str, directory: Path | None = None
) -> JSONObject:
    """
    Write the rasters, the objects and the summary of the difference of two epochs.

    Parameters are those of `make_epoch_products`.

    Returns
    -------
    details : dict
        For the run's manifest; `warnings` is a list of what people should know, `summary` what the folder's
        `summary.json` says.

    Raises
    ------
    InputDataError
        The epochs have no ground in common, and a folder was asked for; the programme's own product says so.
    """
    config = programme.config
    difference = difference_pair(programme, pair.earlier, pair.later, models)
    grid, maps, objects, statistics = difference.grid, difference.maps, difference.objects, difference.summary
    if directory is not None:
        require_common_ground(programme, pair, statistics)
    warning = difference_warning(statistics)
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
    layers: dict[str, NDArray[Any]] = {
        "resolution": maps.resolution.width,
        "unresolved_std": maps.resolution.unresolved_std,
        "resolution_class": difference.resolution_class,
    }
    layers |= {name: getattr(maps, _MAP_NAMES.get(name, name)) for name in CHANGE_LAYERS if name not in layers}
    limits = programme_limits(programme, (pair.earlier, pair.later), change_limits(maps))
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
        programme,
        (pair.earlier, pair.later),
        grid,
        run_id,
        limits=limits,
        warnings=warnings,
        is_listed=directory is None,
    )

    def add_files(folder: Path) -> None:
        epoch_ids = (pair.earlier, pair.later)
        write_objects(folder / OBJECTS_FILE, objects, grid, epochs=epoch_ids, sizes=difference.sizes)
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


def require_common_ground(programme: Programme, pair: ChangeProduct, summary: JSONObject) -> None:
    """
    Refuse a difference that holds nothing.

    Parameters
    ----------
    programme : Programme
    pair : ChangeProduct
    summary : dict
        As `changedetect.differencing.summarise` returns it.

    Raises
    ------
    InputDataError
        No ground was observed by both epochs.
    """
    if summary["area_observed_m2"] > 0.0:
        return
    epochs = [programme.epoch(epoch_id) for epoch_id in (pair.earlier, pair.later)]
    spans = [f"{epoch.epoch_id} spans {describe_region(epoch.region)}" for epoch in epochs if epoch.region is not None]
    msg = (
        f"Epochs {pair.earlier} and {pair.later} of '{programme.directory}' observed no ground in common"
        f"{': ' if spans else ''}{', '.join(spans)}. Choose epochs that overlap, or wider bounds."
    )
    raise InputDataError(msg)


def difference_warning(summary: JSONObject) -> str | None:
    """
    Say in words that two epochs share no ground, or differ by a constant, if `summarise` found that they do.

    Parameters
    ----------
    summary : dict
        As `changedetect.differencing.summarise` returns it.
    """
    if not summary["area_observed_m2"] > 0.0:
        return "no ground was observed by both epochs: the maps hold no difference"
    offset = summary["systematic_offset_m"]
    if offset is None:
        return None
    moved = summary["area_raised_m2" if offset > 0 else "area_lowered_m2"] / summary["area_observed_m2"]
    return (
        f"epochs differ by a median of {offset:+.2f} m over {100.0 * moved:.0f} % of the area, as a vertical datum or "
        "registration step would, and co-registration did not take it out"
    )


def _manifest_writer(
    programme: Programme,
    epoch_ids: tuple[str, ...],
    grid: Grid,
    run_id: str,
    *,
    limits: Mapping[str, tuple[float, float]],
    warnings: tuple[str, ...],
    is_listed: bool,
) -> Callable[[Path], None]:
    """Return what adds item and manifest to a folder of products, last of its files."""
    config = programme.config
    states = {epoch_id: _state_sha256(programme, epoch_id) for epoch_id in epoch_ids}

    def write(folder: Path) -> None:
        created = utc_now()
        write_item(folder, programme, epoch_ids, grid, run_id, created, is_listed=is_listed)
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
            created=created,
        ).write(folder)

    return write


def _state_sha256(programme: Programme, epoch_id: str) -> str:
    found = programme.state_record(epoch_id)
    if found is None:
        msg = f"Epoch '{epoch_id}' has not been learned. Run: changedetect update {programme.directory}"
        raise ModelStateError(msg)
    return found[1]
