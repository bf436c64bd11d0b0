"""The main job: learn what is new or stale, make the products that follow from it, and nothing else."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numba

from changedetect.catalogue import (
    Epoch,
    Item,
    Programme,
    epoch_product_reasons,
    pair_reasons,
    plan,
    state_reasons,
    wanted_pairs,
)
from changedetect.pipeline.learn import ModelShelf, learn_epoch
from changedetect.pipeline.lock import programme_lock
from changedetect.pipeline.manifest import RunManifest
from changedetect.pipeline.products import make_epoch_products, make_pair_products

__all__ = ["Progress", "UpdateResult", "update"]

logger = logging.getLogger(__name__)

#: Called as on_progress(done, total, label) before each step and once at the end.
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, kw_only=True)
class UpdateResult:
    """
    What an update did.

    Attributes
    ----------
    items : tuple of Item
        Everything the programme has or should have, as found before.
    run_id : str or None
        None where nothing was due: then nothing was touched.
    exit_code : int
        0, or that of the first step that failed.
    steps : tuple of mapping
        As in the run's manifest.
    warnings : tuple of str
    """

    items: tuple[Item, ...]
    run_id: str | None = None
    exit_code: int = 0
    steps: tuple[Mapping[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def n_due(self) -> int:
        """How many things were due."""
        return sum(item.is_due for item in self.items)


def update(
    programme: Programme,
    *,
    command: str = "update",
    on_progress: Progress | None = None,
) -> UpdateResult:
    """
    Bring models and products of a programme up to date.

    Parameters
    ----------
    programme : Programme
    command : str
        For the run's manifest.
    on_progress : callable, optional

    Returns
    -------
    UpdateResult
        A step that failed is told there and in the run's manifest, with the exit code of the first; the other steps
        are done all the same.

    Raises
    ------
    TemporaryError
        Another run holds the programme's lock.
    OutputError
        The programme's folder cannot be written.
    """
    items = plan(programme)
    if not any(item.is_due for item in items):
        return UpdateResult(items=items)
    _use_workers(programme.config.machine.workers)
    with programme_lock(programme.directory):
        items = plan(programme)  # another run may have finished in between
        if not any(item.is_due for item in items):
            return UpdateResult(items=items)
        run = RunManifest(programme, command)
        with run.recording():
            _Update(programme, run, on_progress, sum(item.is_due for item in items)).execute()
    return UpdateResult(
        items=items,
        run_id=run.run_id,
        exit_code=run.exit_code,
        steps=tuple(run.steps),
        warnings=tuple(run.warnings),
    )


class _Update:
    """The steps of one update; every decision is taken anew from what the steps before really achieved."""

    def __init__(self, programme: Programme, run: RunManifest, on_progress: Progress | None, total: int) -> None:
        self.programme = programme
        self.run = run
        self.models = ModelShelf(programme)
        self._on_progress = on_progress
        self._total = total
        self._states: dict[str, str] = {}

    def execute(self) -> None:
        """Learn, then make products of epochs, then of pairs."""
        self._learn_epochs()
        programme, run_id = self.programme, self.run.run_id
        for epoch_id in self._states:
            if reasons := epoch_product_reasons(programme, epoch_id, self._states):
                with self._step(Item("epoch", epoch_id, reasons)) as details:
                    details.update(make_epoch_products(programme, epoch_id, self.models, run_id))
        for pair in wanted_pairs(programme, list(self._states)):
            if reasons := pair_reasons(programme, pair, self._states):
                with self._step(Item("pair", pair.product_id, reasons)) as details:
                    details.update(make_pair_products(programme, pair, self.models, run_id))
                    for warning in details["warnings"]:
                        self.run.warn(f"{pair.earlier} to {pair.later}: {warning}")
        if self._on_progress is not None:
            self._on_progress(self._total, self._total, "done")

    def _learn_epochs(self) -> None:
        """Learn what is due; an epoch that fails is passed over, and the next one follows its predecessor."""
        parent: Epoch | None = None
        for epoch in self.programme.epochs:
            reasons = state_reasons(self.programme, epoch, parent, self._states)
            if reasons:
                with self._step(Item("model", epoch.epoch_id, reasons)) as details:
                    details.update(learn_epoch(self.programme, epoch, parent, self.models))
                if self.run.steps[-1]["status"] == "failed":
                    continue
            record = self.programme.state_record(epoch.epoch_id)
            if record is not None:
                self._states[epoch.epoch_id] = record[1]
                parent = epoch

    def _step(self, item: Item) -> Any:
        logger.info("%s %s: %s", item.kind, item.item_id, "; ".join(item.reasons))
        if self._on_progress is not None:
            self._on_progress(
                len(self.run.steps), max(self._total, len(self.run.steps) + 1), f"{item.kind} {item.item_id}"
            )
        return self.run.step(item)


def _use_workers(workers: int) -> None:
    """Set the number of threads of the compiled code, at most those the machine offers; 0 takes all."""
    available = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    numba.set_num_threads(min(workers, available) if workers else available)
