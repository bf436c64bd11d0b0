"""Arguments and options that several commands share, and the reading of their texts."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

__all__ = [
    "Bounds",
    "Directory",
    "DryRun",
    "EpochId",
    "Model",
    "Overwrite",
    "Pairs",
    "Resolution",
    "ZoneLayer",
    "ZoneNames",
    "parse_classes",
    "parse_columns",
    "parse_sigma",
    "require_zones",
]


class Pairs(StrEnum):
    """Which epochs are differenced."""

    CONSECUTIVE = "consecutive"
    FIRST = "first"
    ALL = "all"


class Model(StrEnum):
    """Surface models a programme can be learned with."""

    ADAPTIVE = "adaptive"
    REFERENCE = "reference"


Directory = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the programme.", show_default=False)]
EpochId = Annotated[str, typer.Argument(metavar="EPOCH_ID", help="Epoch, such as 2024-05-01.", show_default=False)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what exists; refused otherwise (exit code 73).")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", "-n", help="Check everything, say what would be done, write nothing.")
]
Bounds = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option("--bounds", metavar="WEST EAST SOUTH NORTH", help="Region in the programme's CRS, m."),
]
ZoneLayer = Annotated[str | None, typer.Option("--layer", help="Layer of the zones, where the file has several.")]
ZoneNames = Annotated[str | None, typer.Option("--name-column", help="Column with the names of the zones.")]
Resolution = Annotated[float | None, typer.Option("--resolution", help="Cell size of the rasters, m.")]


def parse_classes(texts: list[str] | None) -> tuple[int, ...] | None:
    """
    Read point classes, repeated or separated by commas.

    Raises
    ------
    typer.BadParameter
        A text is no whole number from 0 to 255.
    """
    if not texts:
        return None
    parts = [part.strip() for text in texts for part in text.split(",") if part.strip()]
    if not all(part.isdecimal() and int(part) <= 255 for part in parts):
        msg = f"classes are whole numbers from 0 to 255, such as 2 or 2,9; got {', '.join(texts)}"
        raise typer.BadParameter(msg, param_hint="--classes")
    return tuple(int(part) for part in parts)


def parse_columns(text: str | None) -> tuple[str, ...] | None:
    """Read names of columns, separated by commas."""
    return None if text is None else tuple(part.strip() for part in text.split(","))


def parse_sigma(sigma: float | None) -> float | None:
    """
    Check a standard deviation.

    Raises
    ------
    typer.BadParameter
        It is not above zero, or not finite.
    """
    if sigma is not None and not 0.0 < sigma < math.inf:
        msg = f"a standard deviation is above zero, in metres, such as 0.05; got {sigma:g}"
        raise typer.BadParameter(msg, param_hint="--sigma")
    return sigma


def require_zones(zones: Path | None, layer: str | None, name_column: str | None) -> None:
    """
    Refuse options about zones where none are given.

    Raises
    ------
    typer.BadParameter
    """
    given = [name for name, value in (("--layer", layer), ("--name-column", name_column)) if value is not None]
    if zones is None and given:
        msg = "is about the zones of a file; name it with --zones"
        raise typer.BadParameter(msg, param_hint=given[0])
