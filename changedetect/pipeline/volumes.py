"""Volumes between two epochs: of all ground, of zones and of bands of elevation."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from changedetect.differencing import AreaBudget, area_budget, elevation_bands
from changedetect.errors import UsageError
from changedetect.io.geopackage import write_zone_budgets
from changedetect.io.zones import covered_cells, read_zones
from changedetect.pipeline.learn import ModelShelf, learned_region
from changedetect.pipeline.pairs import difference_pair
from changedetect.pipeline.products import difference_warning, require_common_ground
from changedetect.pipeline.queries import require_absent, require_outside, require_suffix
from changedetect.pipeline.rasters import product_grid
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.catalogue import Programme
    from changedetect.differencing import ChangeMaps
    from changedetect.grid import Grid
    from changedetect.io.zones import Zone
    from changedetect.typing import FloatArray, JSONObject

__all__ = ["measure_volumes"]


def measure_volumes(
    programme: Programme,
    earlier: str,
    later: str,
    *,
    zones: Path | None = None,
    layer: str | None = None,
    name_column: str | None = None,
    band_height: float | None = None,
    output: Path | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
) -> JSONObject:
    """
    Volumes that moved between two epochs.

    Parameters
    ----------
    programme : Programme
    earlier, later : str
        Epoch ids, in the order of time.
    zones : Path, optional
        Vector file of polygons; each gets a budget of its own.
    layer, name_column : str, optional
        As for `read_zones`.
    band_height : float, m, optional
        Height of bands of elevation that get a budget each.
    output : Path, optional
        CSV file to write, one row a budget, or GeoPackage (``.gpkg``) of the zones with their budgets.
    overwrite : bool
    dry_run : bool
        Check everything and measure nothing.

    Returns
    -------
    details : dict
        `whole`, `zones` and `bands`: budgets as `AreaBudget.document` describes them, `name` with them, with the
        lower and upper border for bands; `warnings`; `error_model`.

    Raises
    ------
    UsageError
        The output ends neither in ``.csv`` nor in ``.gpkg``, or is to hold zones and none are named.
    MissingInputError, InputDataError, CRSMismatchError
        The zones cannot be used; or the epochs observed no ground in common.
    OutputExistsError
        The output exists.
    """
    if output is not None:
        require_suffix(output, (".csv", ".gpkg"), "CSV holds a table of all budgets, GeoPackage the zones with theirs.")
        if output.suffix.lower() == ".gpkg" and zones is None:
            msg = f"'{output}' is to hold zones with their budgets: name them with --zones, or write a .csv."
            raise UsageError(msg)
        require_outside(programme, output)
        require_absent(output, overwrite=overwrite, source=zones)
    config = programme.config
    pair = programme.pair(earlier, later)
    listed = () if zones is None else read_zones(zones, config.crs, layer=layer, name_column=name_column)
    if dry_run:
        grid = product_grid(config, learned_region(programme, (earlier, later)))
        away = [zone.name for zone in listed if covered_cells(zone.polygon, grid) is None]
        warnings = [f"zone '{name}' lies outside the ground of both epochs" for name in away]
        return {"n_zones": len(listed), "warnings": warnings}
    difference = difference_pair(programme, earlier, later, ModelShelf(programme))
    grid, maps, direction = difference.grid, difference.maps, difference.objects.direction
    confidence = config.differencing.confidence
    require_common_ground(programme, pair, difference.summary)
    warning = difference_warning(difference.summary)
    warnings = [warning] if warning else []
    budgets = [_zone_budget(zone, maps, grid, direction, confidence) for zone in listed]
    warnings += [
        f"zone '{zone.name}' holds no ground that both epochs observed"
        for zone, budget in zip(listed, budgets, strict=True)
        if budget.mean is None
    ]
    bands = [] if band_height is None else elevation_bands(maps, grid.resolution, confidence, band_height, direction)
    details: JSONObject = {
        "confidence": confidence,
        "crs": config.crs,
        "whole": area_budget(maps, grid.resolution, confidence, None, direction).document(),
        "zones": [{"name": z.name, **b.document()} for z, b in zip(listed, budgets, strict=True)],
        "bands": [{"lower_m": low, "upper_m": high, **b.document()} for low, high, b in bands],
        "error_model": maps.errors.model.document(),
        "warnings": warnings,
    }
    if output is not None:
        if output.suffix.lower() == ".gpkg":
            write_zone_budgets(output, listed, budgets, config.crs, epochs=(earlier, later))
        else:
            _write_table(output, details)
        details["output"] = str(output)
    return details


def _zone_budget(zone: Zone, maps: ChangeMaps, grid: Grid, direction: FloatArray, confidence: float) -> AreaBudget:
    covered = covered_cells(zone.polygon, grid)
    if covered is None:
        return area_budget(maps, grid.resolution, confidence, np.zeros(grid.shape))
    window, inside = covered
    return area_budget(maps, grid.resolution, confidence, inside, direction[window], window)


def _write_table(path: Path, details: JSONObject) -> None:
    rows = [{"kind": "whole", "name": "", **details["whole"]}]
    rows += [{"kind": "zone", **zone} for zone in details["zones"]]
    rows += [{"kind": "band", "name": f"{b['lower_m']:g} to {b['upper_m']:g} m", **b} for b in details["bands"]]
    flat = [_flat(row) for row in rows]
    columns = list(flat[0])
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(flat)


def _flat(row: JSONObject) -> dict[str, Any]:
    """Intervals as two columns each."""
    flat: dict[str, Any] = {}
    for key, value in row.items():
        if "_interval_" in key:
            bounds: Sequence[Any] = value if value is not None else (None, None)
            flat[key.replace("_interval_", "_lower_")], flat[key.replace("_interval_", "_upper_")] = bounds
        else:
            flat[key] = value
    return flat
