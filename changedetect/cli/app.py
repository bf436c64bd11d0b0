"""The commands, put together."""

from __future__ import annotations

from typing import Annotated

import typer

from changedetect import __version__
from changedetect.cli import comparison, flights, programmes, results, runs, series, simulations

__all__ = ["app"]

app = typer.Typer(
    name="changedetect",
    help="Terrain change detection: surfaces learned from surveys, differenced with honest uncertainty.",
    epilog=(
        "Begin with: changedetect init site --crs EPSG:32632+5773; "
        "changedetect add site 2024-05-01 survey.laz; changedetect update site"
    ),
    no_args_is_help=True,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"changedetect {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Terrain change detection: surfaces learned from surveys, differenced with honest uncertainty."""


programmes.register(app)
runs.register(app)
results.register(app)
series.register(app)
comparison.register(app)
flights.register(app)
simulations.register(app)
