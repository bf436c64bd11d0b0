"""Commands about flights: reconstruct."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from changedetect.cli.options import DryRun, Overwrite
from changedetect.cli.session import Outcome, Session, command

__all__ = ["register"]


class Method(StrEnum):
    """How points are made from photos."""

    ADJUSTED = "adjusted"
    SMOOTHED = "smoothed"
    PAPER = "paper"
    GIVEN = "given"


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    command(app, "reconstruct")(reconstruct)


def reconstruct(
    session: Session,
    *,
    flights: Annotated[
        list[Path],
        typer.Argument(
            metavar="FLIGHT...",
            help="Folders of logs and photos, of photos alone, or of a COLMAP or OpenSfM model; several are adjusted "
            "together.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="File for the points, .laz or .las; a folder where several flights are given.",
            show_default=False,
        ),
    ],
    crs: Annotated[
        str | None,
        typer.Option("--crs", help="CRS of the points; by default that of site.json, else UTM, ellipsoidal heights."),
    ] = None,
    method: Annotated[
        Method | None,
        typer.Option(
            "--method",
            help="adjusted: bundle adjustment; smoothed: poses of the logs; paper: filter and two views; given: poses "
            "of a model as they are. By default given for models, else adjusted.",
            show_default=False,
        ),
    ] = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Estimate the lens parameters that the photos determine.")
    ] = False,
    dense: Annotated[
        bool, typer.Option("--dense", help="A point for every cell of a fine grid; takes minutes more.")
    ] = False,
    camera: Annotated[
        Path | None, typer.Option("--camera", help="Camera file; by default camera.yaml of the flight.")
    ] = None,
    gcp: Annotated[
        Path | None, typer.Option("--gcp", help="List of control points, as OpenDroneMap's gcp_list.txt.")
    ] = None,
    check: Annotated[
        Path | None, typer.Option("--check", help="List of check points, of the same form: compared, not used.")
    ] = None,
    work: Annotated[
        Path | None, typer.Option("--work", help="Folder that keeps the steps; OUT.work by default, safe to delete.")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", help="Threads; 0 takes all cores.", min=0)] = 0,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Make point clouds from flights: logs and photos to points with standard deviations.

    For example:

    changedetect reconstruct flight1 -o points.laz --crs EPSG:32756+4979

    changedetect reconstruct flight1 flight2 -o clouds --dense

    changedetect reconstruct folder_of_photos -o points.laz --json
    """
    from changedetect.pipeline.reconstruct import ReconstructOptions, summary_lines
    from changedetect.pipeline.reconstruct import reconstruct as run

    options = ReconstructOptions(
        crs=crs,
        method=None if method is None else method.value,
        calibrate=calibrate,
        dense=dense,
        work=work,
        camera_file=camera,
        control=gcp,
        checks=check,
        workers=workers,
        overwrite=overwrite,
        dry_run=dry_run,
    )
    with session.progress() as on_step:
        report = run(flights, output, options, on_step=on_step)
    return Outcome({"dry_run": dry_run, "output": str(output), **report}, [*summary_lines(report)])
