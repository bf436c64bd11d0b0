"""Commands that make data with known truth: simulate surveys, simulate flight."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperGroup

from changedetect.cli.options import DryRun, Overwrite
from changedetect.cli.session import Outcome, Session, command

if TYPE_CHECKING:
    from typer._click import Context

__all__ = ["register"]

OutputFolder = Annotated[Path, typer.Argument(metavar="OUTDIR", help="Folder to make.", show_default=False)]


class Imu(StrEnum):
    """Inertial sensors: a low-cost one, or a better one."""

    LOW = "low"
    MID = "mid"


class _Group(TyperGroup):
    """Take `simulate OUTDIR` for `simulate surveys OUTDIR`."""

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Put the name of the default command where none is given."""
        if args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = ["surveys", *args]
        return super().parse_args(ctx, args)


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    simulate = typer.Typer(
        cls=_Group,
        help="Make data with known truth: a programme of surveys (the default), or flights with photos and logs.",
        no_args_is_help=True,
    )
    command(simulate, "surveys", prefix="simulate ")(surveys)
    command(simulate, "flight", prefix="simulate ")(flight)
    app.add_typer(simulate, name="simulate")


def surveys(
    _session: Session,
    *,
    directory: OutputFolder,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Random seed; that of surveys/demo by default.", min=0)
    ] = None,
    density: Annotated[float, typer.Option("--density", help="Points per m2.", min=0.1, max=1000.0)] = 9.0,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Make a programme of three simulated epochs with known truth; also without the word surveys.

    For example:

    changedetect simulate surveys demo; changedetect update demo
    """
    from changedetect.pipeline.simulate import simulate as write_simulation
    from changedetect.synthetic import DEMO_SEED

    seed = DEMO_SEED if seed is None else seed
    written = write_simulation(directory, seed, density=density, overwrite=overwrite, dry_run=dry_run)
    document = {
        "directory": str(directory),
        "dry_run": dry_run,
        "random_seed": seed,
        "density": density,
        "epochs": list(written.epoch_ids),
        "n_points": written.n_points,
        "files": list(written.files),
    }
    text = (
        f"{'Would write' if dry_run else 'Wrote'} {len(written.epoch_ids)} epochs with {written.n_points:,} points, "
        f"and their truth, into {directory}. Next: changedetect update {directory}"
    )
    return Outcome(document, [text])


def flight(
    session: Session,
    *,
    directory: OutputFolder,
    seed: Annotated[int, typer.Option("--seed", help="Random seed of site, changes, gusts and noise.", min=0)] = 0,
    epochs: Annotated[int, typer.Option("--epochs", help="Flights over the site.", min=1, max=20)] = 2,
    strips: Annotated[int, typer.Option("--strips", help="Strips of a flight.", min=1, max=20)] = 2,
    photos: Annotated[int, typer.Option("--photos", help="Photos of a strip.", min=4, max=200)] = 8,
    size: Annotated[tuple[int, int], typer.Option("--size", metavar="WIDTH HEIGHT", help="Of a photo, pixels.")] = (
        640,
        480,
    ),
    imu: Annotated[Imu, typer.Option("--imu", help="Inertial sensor: low-cost, or better.")] = Imu.LOW,
    gps_offset: Annotated[
        float, typer.Option("--gps-offset", help="GPS offset of a flight, standard deviation on every axis, m.", min=0)
    ] = 1.0,
    gps_latency: Annotated[
        float, typer.Option("--gps-latency", help="How late fixes are stamped, s.", min=-0.5, max=0.5)
    ] = 0.0,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Make flights over one site with known truth: photos, inertial and GPS logs, changes from epoch to epoch.

    For example:

    changedetect simulate flight flights --seed 3

    changedetect init site --crs EPSG:32756+4979 --resolution 0.5

    changedetect add site 2024-05-01 flights/epoch1; changedetect add site 2024-10-30 flights/epoch2

    changedetect update site
    """
    from changedetect.errors import ConfigError
    from changedetect.navigation.flight import ImuNoise
    from changedetect.pipeline.simulate_flight import simulate_flights
    from changedetect.synthetic.flight_path import GpsErrors
    from changedetect.synthetic.flight_photos import FlightDesign

    try:
        design = FlightDesign(
            n_epochs=epochs,
            n_strips=strips,
            n_photos=photos,
            size=size,
            imu=ImuNoise() if imu is Imu.LOW else ImuNoise.mid(),
            gps=GpsErrors(offset_std=gps_offset, latency=gps_latency),
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error
    with session.progress() as on_step:
        written = simulate_flights(directory, design, seed=seed, overwrite=overwrite, dry_run=dry_run, on_step=on_step)
    document = {
        "directory": str(directory),
        "dry_run": dry_run,
        "random_seed": seed,
        "flights": list(written.flights),
        "dates": list(written.dates),
        "n_photos": written.n_photos,
        "files": list(written.files),
    }
    text = (
        f"{'Would write' if dry_run else 'Wrote'} {len(written.flights)} flights with {written.n_photos} photos, and "
        f"their truth, into {directory}. Next: changedetect init site --crs EPSG:32756+4979; "
        f"changedetect add site {written.dates[0][:10]} {directory / written.flights[0]}"
    )
    return Outcome(document, [text])
