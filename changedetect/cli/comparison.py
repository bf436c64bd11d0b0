"""The command that holds surface models against each other: compare."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from changedetect.cli.options import Directory, DryRun, EpochId, Overwrite
from changedetect.cli.session import Outcome, Session, command

if TYPE_CHECKING:
    from rich.console import RenderableType

    from changedetect.catalogue import Programme

__all__ = ["register"]


class HoldOutChoice(StrEnum):
    """What is held out."""

    RANDOM = "random"
    BLOCKS = "blocks"
    BOTH = "both"


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    command(app, "compare")(compare)


def compare(
    session: Session,
    *,
    directory: Directory,
    epoch_id: EpochId,
    models: Annotated[
        list[str] | None,
        typer.Option("--models", metavar="NAMES", help="Methods, separated by commas; all by default."),
    ] = None,
    holdout: Annotated[
        HoldOutChoice, typer.Option("--holdout", help="Hold out single points, blocks (gaps), or try both.")
    ] = HoldOutChoice.BOTH,
    share: Annotated[float, typer.Option("--share", help="Part of the points held out.", min=0.001, max=0.9)] = 0.1,
    block_side: Annotated[
        float | None, typer.Option("--block-side", help="Side of held-out blocks, m; five point distances by default.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Of what is held out.", min=0, max=2**31 - 1)] = 0,
    max_points: Annotated[
        int | None, typer.Option("--max-points", help="Thin the survey to so many points first.", min=200)
    ] = None,
    subsample: Annotated[
        bool,
        typer.Option("--subsample", help="Methods that cannot cope with the size learn a part of it, not nothing."),
    ] = False,
    plot: Annotated[Path | None, typer.Option("--plot", metavar="FILE.png", help="Picture to draw.")] = None,
    overwrite: Overwrite = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Compare the programme's surface model with others on points of an epoch that none of them has seen.

    For example:

    changedetect compare site 2024-05-01

    changedetect compare site 2024-05-01 --models adaptive,kriging,gpr_matern32 --max-points 5000 --plot compare.png
    """
    from changedetect.pipeline.compare import compare_epoch
    from changedetect.validation.results import ComparisonOptions
    from changedetect.validation.splits import HOLD_OUT_KINDS

    programme = session.open(directory)
    chosen = tuple(kind for kind in HOLD_OUT_KINDS if holdout.value in (kind, "both"))
    options = ComparisonOptions(
        hold_outs=chosen,
        share=share,
        seed=seed,
        block_side=block_side,
        max_points=max_points,
        is_subsampled=subsample,
    )
    names = _parse_models(models, programme)
    with session.progress() as on_progress:
        details = compare_epoch(
            programme,
            epoch_id,
            names,
            options,
            plot=plot,
            overwrite=overwrite,
            dry_run=dry_run,
            on_progress=on_progress,
        )
    document = {"directory": str(directory), "epoch_id": epoch_id, "dry_run": dry_run, **details}
    document["plot"] = str(plot) if plot else None
    text: list[RenderableType] = []
    for hold_out in details["hold_outs"]:
        text += _planned(hold_out) if dry_run else _scored(hold_out)
    if plot:
        text.append(f"{'Would draw' if dry_run else 'Drew'} {plot}")
    return Outcome(document, text)


def _parse_models(texts: list[str] | None, programme: Programme) -> list[str] | None:
    """Read names of methods, repeated or separated by commas."""
    if not texts:
        return None
    from changedetect.pipeline.compare import method_names

    known = method_names(programme)
    names = [part.strip() for text in texts for part in text.split(",") if part.strip()]
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        msg = f"unknown: {', '.join(unknown) or 'no name given'}; known are {', '.join(known)}"
        raise typer.BadParameter(msg, param_hint="--models")
    return names


def _heading(hold_out: dict[str, Any]) -> str:
    total = hold_out["n_learned"] + hold_out["n_held_out"]
    place = "at random" if hold_out["kind"] == "random" else f"in blocks of {hold_out['block_side']:g} m"
    return f"{hold_out['n_held_out']:,} of {total:,} points held out {place}"


def _planned(hold_out: dict[str, Any]) -> list[RenderableType]:
    lines: list[RenderableType] = [f"Would compare with {_heading(hold_out)}:"]
    for item in hold_out["evaluations"]:
        part = f"{'a subsample of ' if item['is_subsampled'] else ''}{item['n_learned']:,} points"
        skipped = item["skipped"]
        lines.append(
            f"  {item['name']} ({item['title']}) " + (f"is skipped: {skipped}" if skipped else f"learns {part}")
        )
    return lines


def _scored(hold_out: dict[str, Any]) -> list[RenderableType]:
    from rich.table import Table

    headings = ("method", "answered", "RMSE m", "CRPS m", "NLPD", "in 50 %", "90 %", "95 %")
    table = Table(*headings, "quiet", "noisy", "CPU s", "memory MB", box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    notes: list[RenderableType] = []
    for item in hold_out["evaluations"]:
        if item["skipped"]:
            notes.append(f"Skipped: {item['title']}: {item['skipped']}")
            continue
        mark = ""
        if item["is_subsampled"]:
            mark = " *"
            notes.append(f"* {item['title']} learned a subsample of {item['n_learned']:,} points")
        memory = item["peak_memory_bytes"]
        table.add_row(
            item["name"] + mark,
            f"{100.0 * item['n_answered'] / hold_out['n_held_out']:.1f} %",
            *(_number(item["common"], name, ".4f") for name in ("rmse", "crps")),
            _number(item["common"], "nlpd", ".3f"),
            *(_number(item["common"], f"coverage_{level}", ".3f") for level in (50, 90, 95)),
            *(_number(item[quarter], "coverage_95", ".3f") for quarter in ("quiet", "noisy")),
            f"{item['cpu_seconds']:.1f}",
            "" if memory is None else f"{memory / 1e6:,.0f}",
        )
    about = f"{_heading(hold_out)}; scores over the {hold_out['n_common']:,} that all answer"
    if hold_out["quartered_by"]:
        notes.append(
            "quiet, noisy: share in the 95 % interval where the noise predicted by "
            f"{hold_out['quartered_by']} is in its lowest and highest quarter"
        )
    return [about, table, *notes]


def _number(scores: dict[str, Any] | None, name: str, form: str) -> str:
    return "" if scores is None else format(scores[name], form)
