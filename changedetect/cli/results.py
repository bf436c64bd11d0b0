"""Commands that ask learned models: predict, surface, diff, volume."""

from __future__ import annotations

import logging
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from changedetect.cli.options import (
    Bounds,
    Directory,
    DryRun,
    EpochId,
    Overwrite,
    Resolution,
    ZoneLayer,
    ZoneNames,
    require_zones,
)
from changedetect.cli.session import Outcome, Session, command

if TYPE_CHECKING:
    from rich.table import Table

    from changedetect.catalogue import Programme
    from changedetect.typing import JSONObject

__all__ = ["register"]

logger = logging.getLogger(__name__)


class Layer(StrEnum):
    """What a model says about a place."""

    ELEVATION = "elevation"
    ELEVATION_STD = "elevation_std"
    NOISE_STD = "noise_std"
    N_EFFECTIVE = "n_effective"
    AGE_DAYS = "age_days"


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    command(app, "predict")(predict)
    command(app, "surface")(surface)
    command(app, "diff")(diff)
    command(app, "volume")(volume)


def predict(
    session: Session,
    *,
    directory: Directory,
    epoch_id: EpochId,
    points: Annotated[
        Path, typer.Argument(metavar="POINTS.csv", help="Table with columns easting and northing.", show_default=False)
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT.csv", help="Table to write.", show_default=False)
    ],
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Predict elevation and its uncertainty at the places of a table, in the programme's CRS.

    For example:

    changedetect predict site 2024-05-01 places.csv -o elevations.csv
    """
    from changedetect.pipeline.queries import predict_table

    programme = _asked(session.open(directory), epoch_id)
    details = predict_table(programme, epoch_id, points, output, overwrite=overwrite, dry_run=dry_run)
    document = {"directory": str(directory), "epoch_id": epoch_id, "dry_run": dry_run, **details}
    text = (
        f"{'Would write' if dry_run else 'Wrote'} {details['n_points']:,} places to {output}; "
        f"{details['n_without_answer']:,} without an answer"
    )
    return Outcome(document, [text])


def surface(
    session: Session,
    *,
    directory: Directory,
    epoch_id: EpochId,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT.tif|OUT.nc", help="File to write.", show_default=False)
    ],
    layer: Annotated[Layer, typer.Option("--layer", help="What a GeoTIFF holds; NetCDF holds all.")] = Layer.ELEVATION,
    resolution: Resolution = None,
    bounds: Bounds = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Write the surface of an epoch as a raster.

    For example:

    changedetect surface site 2024-05-01 -o surface.nc

    changedetect surface site 2024-05-01 -o std.tif --layer elevation_std --resolution 0.5
    """
    from changedetect.pipeline.queries import write_epoch_surface

    programme = _asked(session.open(directory), epoch_id)
    details = write_epoch_surface(
        programme,
        epoch_id,
        output,
        layer=layer.value,
        resolution=resolution,
        bounds=bounds,
        overwrite=overwrite,
        dry_run=dry_run,
    )
    rows, cols = details["shape"]
    document = {"directory": str(directory), "epoch_id": epoch_id, "dry_run": dry_run, **details}
    return Outcome(document, [f"{'Would write' if dry_run else 'Wrote'} {rows} x {cols} cells to {output}"])


def diff(
    session: Session,
    *,
    directory: Directory,
    earlier: Annotated[str, typer.Argument(metavar="EARLIER", help="Epoch to compare with.", show_default=False)],
    later: Annotated[str, typer.Argument(metavar="LATER", help="Epoch to compare.", show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUTDIR", help="Folder to write.", show_default=False)
    ],
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Write the change maps of one pair of epochs into a folder.

    For example:

    changedetect diff site 2024-05-01 2024-09-03 -o maps
    """
    from changedetect.pipeline.queries import difference_epochs

    programme = _asked(_asked(session.open(directory), earlier), later)
    details = difference_epochs(programme, earlier, later, output, overwrite=overwrite, dry_run=dry_run)
    document = {"directory": str(directory), "earlier": earlier, "later": later, "dry_run": dry_run, "output": details}
    text = [f"{'Would write' if dry_run else 'Wrote'} the change from {earlier} to {later} to {output}"]
    for warning in details.get("warnings", []):
        logger.warning("%s", warning)
        text.append(f"Warning: {warning}")
    return Outcome(document, [*text])


def volume(
    session: Session,
    *,
    directory: Directory,
    earlier: Annotated[str, typer.Argument(metavar="EARLIER", help="Epoch to compare with.", show_default=False)],
    later: Annotated[str, typer.Argument(metavar="LATER", help="Epoch to compare.", show_default=False)],
    zones: Annotated[
        Path | None, typer.Option("--zones", metavar="FILE", help="Polygons that get a budget each, in any CRS.")
    ] = None,
    layer: ZoneLayer = None,
    name_column: ZoneNames = None,
    bands: Annotated[
        float | None, typer.Option("--bands", metavar="HEIGHT", help="Budget per band of elevation of this height, m.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT.csv|OUT.gpkg",
            help="Table, or map of the zones, to write.",
            show_default=False,
        ),
    ] = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Measure raised, lowered and net volume between two epochs, each with its interval.

    For example:

    changedetect volume site 2024-05-01 2024-09-03

    changedetect volume site 2024-05-01 2024-09-03 --zones cells.gpkg --bands 1.0 -o volumes.csv

    changedetect volume site 2024-05-01 2024-09-03 --zones cells.gpkg -o volumes.gpkg
    """
    from changedetect.pipeline.volumes import measure_volumes

    if bands is not None and not bands > 0.0:
        msg = f"the height of a band must be above zero, not {bands:g}"
        raise typer.BadParameter(msg, param_hint="--bands")
    require_zones(zones, layer, name_column)
    programme = _asked(_asked(session.open(directory), earlier), later)
    details = measure_volumes(
        programme,
        earlier,
        later,
        zones=zones,
        layer=layer,
        name_column=name_column,
        band_height=bands,
        output=output,
        overwrite=overwrite,
        dry_run=dry_run,
    )
    document = {"directory": str(directory), "earlier": earlier, "later": later, "dry_run": dry_run, **details}
    for warning in details["warnings"]:
        logger.warning("%s", warning)
    if dry_run:
        return Outcome(document, [f"Would measure the volumes from {earlier} to {later}, {details['n_zones']} zones"])
    return Outcome(document, [_volume_table(details), *(f"Warning: {text}" for text in details["warnings"])])


def _volume_table(details: JSONObject) -> Table:
    from rich.table import Table

    level = f"{100.0 * details['confidence']:g} %"
    table = Table("area", "m2", f"raised m3, {level}", f"lowered m3, {level}", f"net m3, {level}", box=None)
    rows = [("all ground", details["whole"])]
    rows += [(zone["name"], zone) for zone in details["zones"]]
    rows += [(f"{band['lower_m']:g} to {band['upper_m']:g} m", band) for band in details["bands"]]
    for name, budget in rows:
        cells = []
        for kind in ("raised", "lowered", "net"):
            low, high = budget[f"volume_{kind}_interval_m3"]
            cells.append(f"{budget[f'volume_{kind}_m3']:,.1f} ({low:,.1f} to {high:,.1f})")
        table.add_row(name, f"{budget['area_observed_m2']:,.0f}", *cells)
    return table


def _asked(programme: Programme, epoch_id: str) -> Programme:
    """Check that an epoch's model can be asked, and say if it is not current."""
    from changedetect.pipeline.queries import require_model

    warning = require_model(programme, epoch_id)
    if warning:
        logger.warning("%s", warning)
    return programme
