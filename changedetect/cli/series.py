"""The command that looks at all epochs together: series."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from changedetect.cli.options import (
    Bounds,
    Directory,
    DryRun,
    Overwrite,
    Resolution,
    ZoneLayer,
    ZoneNames,
    require_zones,
)
from changedetect.cli.session import Outcome, Session, command

if TYPE_CHECKING:
    from rich.table import Table

    from changedetect.typing import JSONObject

__all__ = ["register"]

logger = logging.getLogger(__name__)

#: Classes that a break is shown for.
_BREAKS = ("break_lowered", "break_raised", "unconfirmed_break", "came_and_went")


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    command(app, "series")(series)


def series(
    session: Session,
    *,
    directory: Directory,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT.nc", help="File to write.", show_default=False)
    ],
    zones: Annotated[
        Path | None,
        typer.Option("--zones", metavar="FILE", help="Polygons that get a series and budgets each, in any CRS."),
    ] = None,
    layer: ZoneLayer = None,
    name_column: ZoneNames = None,
    monitoring: Annotated[
        bool,
        typer.Option(
            "--monitoring",
            help="Hold the rate of false alarms over all looks at the growing series, one after each survey.",
        ),
    ] = False,
    resolution: Resolution = None,
    bounds: Bounds = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Write what all ground did over all epochs: change since the first, trend, break and its date, each with its error.

    With zones, OUT_zones.csv holds trend and break of each, OUT_budgets.csv its volumes from epoch to epoch.

    For example:

    changedetect series site -o series.nc

    changedetect series site -o series.nc --zones cells.gpkg
    """
    from changedetect.pipeline.series import make_series

    require_zones(zones, layer, name_column)
    details = make_series(
        session.open(directory),
        output,
        zones=zones,
        layer=layer,
        name_column=name_column,
        resolution=resolution,
        bounds=bounds,
        monitoring=monitoring,
        overwrite=overwrite,
        dry_run=dry_run,
    )
    for warning in details["warnings"]:
        logger.warning("%s", warning)
    document = {"directory": str(directory), "dry_run": dry_run, **details}
    n_epochs = len(details["epochs"])
    if dry_run:
        return Outcome(document, [f"Would write the series of {n_epochs} epochs to {output}"])
    text = [f"Wrote the series of {n_epochs} epochs to {', '.join(details['files'].values())}"]
    told = [f"Warning: {warning}" for warning in details["warnings"]]
    return Outcome(document, [_class_table(details), _zone_table(details), *text, *told])


def _class_table(details: JSONObject) -> Table:
    from rich.table import Table

    table = Table("what the ground did", "m2", box=None)
    for meaning, area in details["area_m2"].items():
        table.add_row(meaning.replace("_", " "), f"{area:,.0f}")
    return table


def _zone_table(details: JSONObject) -> Table:
    from rich.table import Table

    head = ("area", "what it did", "trend m/year", "break", "m", "surveys confirm", "since the first m")
    table = Table(*head, box=None)
    for area in (details["whole"], *details["zones"]):
        last = area["series"][-1]
        is_break = area["class"] in _BREAKS
        table.add_row(
            area["name"],
            area["class"].replace("_", " "),
            _plus_minus(area["trend_m_per_year"], area["trend_std_m_per_year"]),
            area["break_time"][:10] if is_break else "",
            _plus_minus(area["break_size_m"], area["break_size_std_m"]) if is_break else "",
            str(area["confirming_surveys"]) if is_break else "",
            _plus_minus(last["change_mean_m"], last["change_mean_std_m"]),
        )
    return table


def _plus_minus(value: float | None, std: float | None) -> str:
    return "" if value is None else f"{value:+.3f}" + ("" if std is None else f" ± {std:.3f}")
