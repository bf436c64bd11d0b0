"""Commands that make a programme and its epochs: init, add, withdraw, config show."""

from __future__ import annotations

from typing import Annotated

import typer

from changedetect.cli.options import (
    Bounds,
    Directory,
    DryRun,
    EpochId,
    Model,
    Overwrite,
    Pairs,
    Resolution,
    parse_classes,
    parse_columns,
    parse_sigma,
)
from changedetect.cli.session import Outcome, Session, command

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    command(app, "init")(init)
    command(app, "add")(add)
    command(app, "withdraw")(withdraw)
    config = typer.Typer(help="Settings of a programme.", no_args_is_help=True)
    command(config, "show", prefix="config ")(config_show)
    app.add_typer(config, name="config")


def init(
    _session: Session,
    *,
    directory: Directory,
    crs: Annotated[
        str, typer.Option("--crs", help="CRS of all results: projected, metres, the vertical one after a plus.")
    ],
    resolution: Resolution = None,
    profile: Annotated[str | None, typer.Option("--profile", help="Kind of survey: drone, lidar or dem.")] = None,
    bounds: Bounds = None,
    name: Annotated[str | None, typer.Option("--name", help="Name of the programme; the folder's by default.")] = None,
    model: Annotated[Model | None, typer.Option("--model", help="Surface model.")] = None,
    pairs: Annotated[Pairs | None, typer.Option("--pairs", help="Which epochs update differences.")] = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Make a programme folder.

    For example:

    changedetect init site --crs EPSG:32632+5773

    changedetect init beach --crs EPSG:32755 --profile drone --bounds 299700 300302 5773163 5773733
    """
    from changedetect.catalogue import Programme

    settings = {
        "name": name,
        "crs": crs,
        "resolution": resolution,
        "bounds": bounds,
        "profile": profile,
        "model": model.value if model else None,
        "pairs": pairs.value if pairs else None,
    }
    programme = Programme.create(directory, settings, overwrite=overwrite, dry_run=dry_run)
    done = "Would make" if dry_run else "Made"
    document = {
        "directory": str(directory),
        "dry_run": dry_run,
        "config": {key: value for key, value, _ in programme.loaded.items()},
    }
    text = (
        f"{done} programme '{programme.config.name}' in {directory}. Next: changedetect add {directory} EPOCH_ID FILE"
    )
    return Outcome(document, [text])


def add(
    session: Session,
    *,
    directory: Directory,
    epoch_id: EpochId,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="Files: LAS, LAZ, COPC, PLY, CSV, XYZ, DEM; or the folder of one flight.",
            show_default=False,
        ),
    ],
    date: Annotated[
        str | None,
        typer.Option("--date", help="When it was surveyed (UTC); by default what a flight says, else the epoch id."),
    ] = None,
    label: Annotated[str, typer.Option("--label", help="A remark for people.")] = "",
    crs: Annotated[str | None, typer.Option("--crs", help="CRS of the files, where they do not say it.")] = None,
    sigma: Annotated[float | None, typer.Option("--sigma", help="Standard deviation of one elevation, m.")] = None,
    classes: Annotated[
        list[str] | None, typer.Option("--classes", help="Point classes to use, such as 2 or 2,9; all by default.")
    ] = None,
    columns: Annotated[
        str | None, typer.Option("--columns", help="Columns of a table: easting,northing,elevation, then sigma if any.")
    ] = None,
    nodata: Annotated[float | None, typer.Option("--nodata", help="Elevation that marks a missing value.")] = None,
    band: Annotated[int, typer.Option("--band", help="Band of a raster.", min=1)] = 1,
    move: Annotated[bool, typer.Option("--move", help="Move the files into the programme, last of all.")] = False,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Add a survey epoch: read and check its files or its flight, remember them.

    For example:

    changedetect add site 2024-05-01 survey.laz --classes 2

    changedetect add site 2024-09-03 dsm.tif --crs EPSG:32632+5773 --sigma 0.05

    changedetect add site 2025-05-01 flights/2025-05-01
    """
    from changedetect.catalogue import Source, parse_date, validate_epoch_id
    from changedetect.pipeline.ingest import add_epoch

    if not all(sources):
        msg = "a source is the name of a file or folder; got an empty text"
        raise typer.BadParameter(msg, param_hint="SOURCE...")
    validate_epoch_id(epoch_id)
    moment = parse_date(date, "--date") if date else None
    listed = [
        Source(
            uri=source,
            crs=crs,
            sigma=parse_sigma(sigma),
            classes=parse_classes(classes),
            columns=parse_columns(columns),
            nodata=nodata,
            band=band,
        )
        for source in sources
    ]
    added = add_epoch(
        session.open(directory),
        epoch_id,
        listed,
        moment,
        label=label,
        move=move,
        overwrite=overwrite,
        dry_run=dry_run,
    )
    document = {
        "directory": str(directory),
        "dry_run": dry_run,
        "epoch_id": epoch_id,
        "date": added.epoch.date_text,
        "n_points": added.n_points,
        "n_photos": added.n_photos,
        "region": list(added.region),
        "is_late": added.is_late,
        "sources": [
            {
                "uri": source.uri,
                "kind": source.kind,
                "sha256": source.sha256,
                "size": source.size,
                "n_points": source.n_points,
                "n_photos": source.n_photos,
                "n_files": None if source.files is None else len(source.files),
            }
            for source in added.epoch.sources
        ],
    }
    done = "Would add" if dry_run else "Added"
    content = f"a flight of {added.n_photos} photos" if added.n_photos else f"{added.n_points:,} points"
    text = f"{done} epoch {epoch_id} ({added.epoch.date_text}): {content}. Next: changedetect update {directory}"
    late = "It lies before other epochs; update learns those again after it."
    return Outcome(document, [text, late] if added.is_late else [text])


def withdraw(session: Session, *, directory: Directory, epoch_id: EpochId, dry_run: DryRun = False) -> Outcome:
    """
    Take a survey out; the next update makes everything as if it had never come.

    For example:

    changedetect withdraw site 2024-09-03
    """
    from changedetect.pipeline.withdraw import withdraw_epoch

    plan = withdraw_epoch(session.open(directory), epoch_id, dry_run=dry_run)
    kept_as = str(plan.kept_as.relative_to(directory))
    document = {
        "directory": str(directory),
        "dry_run": dry_run,
        "epoch_id": epoch_id,
        "kept_as": kept_as,
        "removed": [str(folder.relative_to(directory)) for folder in plan.removed],
        "n_to_learn": plan.n_to_learn,
    }
    done = "Would withdraw" if dry_run else "Withdrew"
    text = (
        f"{done} epoch {epoch_id}; its file is kept as {kept_as}, its sources stay where they are. "
        f"Next: changedetect update {directory}"
    )
    return Outcome(document, [text])


def config_show(session: Session, directory: Directory) -> Outcome:
    """
    Print every setting, its value and where it comes from.

    For example:

    changedetect config show site

    CHANGEDETECT_RESOLUTION=0.5 changedetect config show site --json
    """
    from rich.table import Table

    from changedetect.config import format_toml_value

    loaded = session.open(directory).loaded
    table = Table("setting", "value", "from", box=None, pad_edge=False)
    settings = {}
    for key, value, source in loaded.items():
        table.add_row(key, format_toml_value(value), source)
        settings[key] = {"value": value, "source": source}
    config = loaded.config
    document = {"settings": settings, "config_sha256": config.config_sha256, "learning_sha256": config.learning_sha256}
    return Outcome(document, [table, f"config_sha256 {config.config_sha256}"])
