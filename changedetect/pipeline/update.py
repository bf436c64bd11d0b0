"""The main job: learn what is new or stale, make the products that follow from it, and nothing else."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numba

from changedetect.catalogue import (
    ChangeProduct,
    Epoch,
    Item,
    Programme,
    anchors_of,
    epoch_product_reasons,
    pair_reasons,
    plan,
    reconstruction_reasons,
    state_reasons,
    wanted_pairs,
)
from changedetect.pipeline.learn import ModelShelf, learn_epoch
from changedetect.pipeline.lock import programme_lock
from changedetect.pipeline.manifest import RunManifest
from changedetect.pipeline.products import make_epoch_products, make_pair_products
from changedetect.pipeline.stac import is_catalogue_current, write_catalogue

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
        if not is_catalogue_current(programme):
            with programme_lock(programme.directory):
                write_catalogue(programme)
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
        self._flights: dict[str, str] = {}

    def execute(self) -> None:
        """Make what is due: points, model and maps of each epoch in order of time, then the differences."""
        parent: Epoch | None = None
        for epoch in self.programme.epochs:
            if not self._has_points(epoch):
                continue
            # the maps follow at once, while the model's receptive fields are in memory; the next epoch needs them too
            if self._is_learned(epoch, parent):
                parent = epoch
                self._make_epoch_products(epoch.epoch_id)
        for pair in wanted_pairs(self.programme, list(self._states)):
            self._make_pair_products(pair)
        write_catalogue(self.programme)
        if self._on_progress is not None:
            self._on_progress(self._total, self._total, "done")

    def _has_points(self, epoch: Epoch) -> bool:
        """Make points from an epoch's flight if that is due; one that fails is passed over."""
        if epoch.flight is None:
            return True
        reasons = reconstruction_reasons(self.programme, epoch, self._flights)
        if reasons:
            from changedetect.pipeline.flight_epoch import reconstruct_epoch  # photogrammetry, which few updates need

            item = Item("flight", epoch.epoch_id, reasons)
            with self._step(item) as details:
                anchors = anchors_of(self.programme, list(self._flights))
                on_step = self._substeps(item)
                details.update(reconstruct_epoch(self.programme, epoch, anchors, on_step=on_step))
                for warning in details["warnings"]:
                    self.run.warn(f"{epoch.epoch_id}: {warning}")
            if self.run.steps[-1]["status"] == "failed":
                return False
        record = self.programme.reconstruction_record(epoch.epoch_id)
        if record is None:
            return False
        self._flights[epoch.epoch_id] = record[1]
        return True

    def _substeps(self, item: Item) -> Progress | None:
        """Progress of a long step, told in the label."""
        if self._on_progress is None:
            return None
        on_progress, done = self._on_progress, len(self.run.steps)

        def on_step(count: int, total: int, label: str) -> None:
            on_progress(done, max(self._total, done + 1), f"{item.title}: {label} {count}/{total}")

        return on_step

    def _is_learned(self, epoch: Epoch, parent: Epoch | None) -> bool:
        """Learn an epoch if it is due; one that fails is passed over, and the next follows its predecessor."""
        reasons = state_reasons(self.programme, epoch, parent, self._states, self._flights.get(epoch.epoch_id))
        if reasons:
            with self._step(Item("model", epoch.epoch_id, reasons)) as details:
                reference_id = next(iter(self._states), None)
                details.update(learn_epoch(self.programme, epoch, parent, reference_id, self.models))
                for warning in details["warnings"]:
                    self.run.warn(f"{epoch.epoch_id}: {warning}")
            if self.run.steps[-1]["status"] == "failed":
                return False
        record = self.programme.state_record(epoch.epoch_id)
        if record is None:
            return False
        self._states[epoch.epoch_id] = record[1]
        return True

    def _make_epoch_products(self, epoch_id: str) -> None:
        reasons = epoch_product_reasons(self.programme, epoch_id, self._states)
        if reasons:
            with self._step(Item("epoch", epoch_id, reasons)) as details:
                details.update(make_epoch_products(self.programme, epoch_id, self.models, self.run.run_id))

    def _make_pair_products(self, pair: ChangeProduct) -> None:
        reasons = pair_reasons(self.programme, pair, self._states)
        if reasons:
            with self._step(Item("pair", pair.product_id, reasons)) as details:
                details.update(make_pair_products(self.programme, pair, self.models, self.run.run_id))
                for warning in details["warnings"]:
                    self.run.warn(f"{pair.earlier} to {pair.later}: {warning}")

    def _step(self, item: Item) -> AbstractContextManager[dict[str, Any]]:
        logger.info("%s: %s", item.title, "; ".join(item.reasons))
        if self._on_progress is not None:
            done = len(self.run.steps)
            self._on_progress(done, max(self._total, done + 1), item.title)
        return self.run.step(item)


def _use_workers(workers: int) -> None:
    """Set the number of threads of the compiled code, at most those the machine offers; 0 takes all."""
    available = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    numba.set_num_threads(min(workers, available) if workers else available)
