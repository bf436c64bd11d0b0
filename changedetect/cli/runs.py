"""Commands about the whole programme: update, status, verify."""

from __future__ import annotations

import logging
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from changedetect.cli.options import Directory, DryRun, Pairs
from changedetect.cli.session import Outcome, Session, command

if TYPE_CHECKING:
    from rich.console import RenderableType

    from changedetect.catalogue import Item, Programme
    from changedetect.pipeline.update import UpdateResult

__all__ = ["register"]

logger = logging.getLogger(__name__)

#: Exit code of `update --exit-code` where a difference made by this run shows significant change.
SIGNIFICANT_CHANGE = 10
#: Exit code of `verify` where something does not match.
DAMAGED = 65

PairsOption = Annotated[
    Pairs | None, typer.Option("--pairs", help="Which epochs to difference; the programme's own rule by default.")
]


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    command(app, "update")(update)
    command(app, "status")(status)
    command(app, "verify")(verify)


def update(
    session: Session,
    *,
    directory: Directory,
    pairs: PairsOption = None,
    workers: Annotated[int | None, typer.Option("--workers", help="Threads; 0 takes all cores.", min=0)] = None,
    exit_code: Annotated[
        bool, typer.Option("--exit-code", help="Return 10 if this run found significant change.")
    ] = False,
    dry_run: DryRun = False,
) -> Outcome:
    """
    Learn what is new or stale and make the maps that follow from it: the main job.

    For example:

    changedetect update site

    changedetect update site --pairs all --exit-code --json
    """
    programme = session.open(directory, pairs=pairs.value if pairs else None, machine__workers=workers)
    if dry_run:
        return _planned(programme, directory)
    from changedetect.pipeline.update import update as run_update

    with session.progress() as on_progress:
        result = run_update(programme, command=" ".join(["changedetect", *sys.argv[1:]]), on_progress=on_progress)
    failed = [step for step in result.steps if step["status"] == "failed"]
    is_changed = _is_changed(result)
    document = {
        "directory": str(directory),
        "dry_run": False,
        "run_id": result.run_id,
        "n_due": result.n_due,
        "steps": list(result.steps),
        "warnings": list(result.warnings),
        "significant_change": is_changed,
        **_overview(programme),
    }
    text: list[RenderableType] = []
    if result.run_id is None:
        text.append("Nothing to do: all models and products are up to date.")
    text += [*_tables(programme), *_alignment_lines(programme)]
    text += [f"Warning: {warning}" for warning in _product_warnings(programme)]
    text += [f"Failed: {step['title']}: {step['error']['message']}" for step in failed]
    text.append(f"Maps lie in {directory / 'products'}")
    code = result.exit_code or (SIGNIFICANT_CHANGE if exit_code and is_changed else 0)
    return Outcome(document, text, code)


def status(session: Session, directory: Directory, pairs: PairsOption = None) -> Outcome:
    """
    Say what a programme has, and what is new or stale and why.

    For example:

    changedetect status site
    """
    from changedetect.catalogue import plan

    programme = session.open(directory, pairs=pairs.value if pairs else None)
    items = plan(programme)
    due = [item for item in items if item.is_due]
    text = [*_tables(programme), *_alignment_lines(programme), *_due_lines(due)]
    if not due:
        text.append("All models and products are up to date.")
    document = {
        "directory": str(directory),
        "name": programme.config.name,
        "crs": programme.config.crs,
        **_overview(programme),
        "items": [_item(item) for item in items],
        "n_due": len(due),
    }
    return Outcome(document, text)


def verify(session: Session, directory: Directory) -> Outcome:
    """
    Check checksums, lineage, and that models and products match their inputs.

    For example:

    changedetect verify site --json
    """
    from changedetect.pipeline.verify import verify as run_verify

    findings = run_verify(session.open(directory))
    errors = [finding for finding in findings if finding.severity == "error"]
    listed = [
        {"severity": finding.severity, "subject": finding.subject, "message": finding.message} for finding in findings
    ]
    text: list[RenderableType] = [f"{item['severity']}: {item['subject']}: {item['message']}" for item in listed]
    if not findings:
        text.append("All checksums, lineages and products are as they should be.")
    elif not errors:
        text.append("No errors.")
    document = {"directory": str(directory), "n_errors": len(errors), "findings": listed}
    return Outcome(document, text, DAMAGED if errors else 0)


def _planned(programme: Programme, directory: Any) -> Outcome:
    from changedetect.catalogue import plan

    items = plan(programme)
    due = [item for item in items if item.is_due]
    text = ["Nothing to do: all models and products are up to date."] if not due else [*_due_lines(due)]
    document = {
        "directory": str(directory),
        "dry_run": True,
        "items": [_item(item) for item in items],
        "n_due": len(due),
    }
    return Outcome(document, [*text])


def _item(item: Item) -> dict[str, Any]:
    return {"kind": item.kind, "id": item.item_id, "due": item.is_due, "reasons": list(item.reasons)}


def _due_lines(due: list[Item]) -> list[RenderableType]:
    return [f"To do: {item.title}: {'; '.join(item.reasons)}" for item in due]


def _is_changed(result: UpdateResult) -> bool:
    summaries = [step["summary"] for step in result.steps if "summary" in step]
    return any(summary["area_raised_m2"] + summary["area_lowered_m2"] > 0 for summary in summaries)


def _overview(programme: Programme) -> dict[str, Any]:
    """Epochs with their models, and the differences that exist with their summaries."""
    epochs = []
    for epoch in programme.epochs:
        record = programme.intact_state_record(epoch.epoch_id)
        epochs.append(
            {
                "epoch_id": epoch.epoch_id,
                "date": epoch.date_text,
                "label": epoch.label,
                "sources": [source.uri for source in epoch.sources],
                "model": record and record.mode,
                "parent": record and record.parent,
                "n_points": record and record.n_points,
                "region": record and list(record.region),
                "alignment": record and record.alignment and asdict(record.alignment),
                "state": str(programme.state_directory(epoch.epoch_id)) if record else None,
            }
        )
    return {"epochs": epochs, "pairs": [*_summaries(programme).values()]}


def _summaries(programme: Programme) -> dict[str, dict[str, Any]]:
    """Summary of each difference that exists, by the name of its folder."""
    from changedetect.errors import MissingInputError, ModelStateError
    from changedetect.storage import read_json

    found = {}
    for pair in programme.existing_pairs():
        folder = programme.product_directory(pair.product_id)
        try:
            found[pair.product_id] = {**read_json(folder / "summary.json"), "directory": str(folder)}
        except (MissingInputError, ModelStateError) as error:  # stale; `update` makes it anew
            logger.warning("%s", error)
    return found


def _product_warnings(programme: Programme) -> list[str]:
    return [
        f"{summary['epoch_earlier']} to {summary['epoch_later']}: {warning}"
        for summary in _summaries(programme).values()
        for warning in summary["warnings"]
    ]


def _tables(programme: Programme) -> list[RenderableType]:
    from rich.table import Table

    epochs = Table("epoch", "date", "points", "model", "follows", "aligned by", box=None, pad_edge=False)
    for epoch in programme.epochs:
        record = programme.intact_state_record(epoch.epoch_id)
        if record is None:
            epochs.add_row(epoch.epoch_id, epoch.date_text, "", "not learned", "", "")
        else:
            aligned = "" if record.alignment is None else record.alignment.kind
            points = f"{record.n_points:,}"
            epochs.add_row(epoch.epoch_id, epoch.date_text, points, record.mode, record.parent or "", aligned)
    headings = ("change", "raised m3", "lowered m3", "net m3", "changed m2", "observed m2", "folder")
    changes = Table(*headings, box=None, pad_edge=False)
    for summary in _summaries(programme).values():
        changes.add_row(
            f"{summary['epoch_earlier']} to {summary['epoch_later']}",
            _with_std(summary, "volume_raised"),
            _with_std(summary, "volume_lowered"),
            _with_std(summary, "volume_net"),
            f"{summary['area_raised_m2'] + summary['area_lowered_m2']:,.0f}",
            f"{summary['area_observed_m2']:,.0f}",
            summary["directory"],
        )
    return [table for table in (epochs, changes) if table.row_count]


def _alignment_lines(programme: Programme) -> list[RenderableType]:
    """How each epoch was aligned, and what to know about it."""
    lines: list[RenderableType] = []
    for epoch in programme.epochs:
        record = programme.intact_state_record(epoch.epoch_id)
        if record is None or record.alignment is None:
            continue
        alignment = record.alignment
        if alignment.wording not in alignment.warnings:
            lines.append(f"Aligned {epoch.epoch_id} to {alignment.reference}: {alignment.wording}")
        lines += [f"Warning: {epoch.epoch_id}: {warning}" for warning in alignment.warnings]
    return lines


def _with_std(summary: dict[str, Any], name: str) -> str:
    return f"{summary[f'{name}_m3']:,.1f} ± {summary[f'{name}_std_m3']:,.1f}"
