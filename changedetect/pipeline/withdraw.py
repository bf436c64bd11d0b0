"""Taking a survey out of a programme; the next update makes everything as if it had never come."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

from changedetect.catalogue import Programme, validate_epoch_id
from changedetect.errors import OutputError
from changedetect.pipeline.lock import programme_lock
from changedetect.pipeline.stac import write_catalogue

__all__ = ["WithdrawnEpoch", "withdraw_epoch"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class WithdrawnEpoch:
    """
    What was taken out.

    Attributes
    ----------
    epoch_id : str
    kept_as : Path
        The epoch's file, kept so that it can be put back into `epochs/`.
    removed : tuple of Path
        Folders of its model, its maps and the differences it took part in.
    n_to_learn : int
        Later epochs, which the next update puts on their new parent.
    """

    epoch_id: str
    kept_as: Path
    removed: tuple[Path, ...]
    n_to_learn: int


def withdraw_epoch(programme: Programme, epoch_id: str, *, dry_run: bool = False) -> WithdrawnEpoch:
    """
    Take an epoch out of a programme.

    Parameters
    ----------
    programme : Programme
    epoch_id : str
    dry_run : bool
        Say what would be done and do nothing.

    Returns
    -------
    WithdrawnEpoch

    Raises
    ------
    MissingInputError
        The programme has no such epoch, nor one that was withdrawn halfway.
    OutputError
        A file cannot be moved or removed.
    TemporaryError
        Another process writes to the programme.

    Notes
    -----
    Sources are not touched. The epoch's file goes first, in one step: a process killed after that leaves folders that
    belong to no epoch, which `verify` names and a second call removes.
    """
    validate_epoch_id(epoch_id)
    if dry_run:
        return _described(programme, epoch_id)
    with programme_lock(programme.directory):
        plan = _described(programme, epoch_id)
        path = programme.epoch_path(epoch_id)
        try:
            if path.exists():
                plan.kept_as.parent.mkdir(exist_ok=True)
                path.replace(plan.kept_as)
            for folder in plan.removed:
                shutil.rmtree(folder)
                logger.info("removed %s", folder)
        except OSError as error:
            msg = f"Epoch '{epoch_id}' cannot be taken out wholly: {error}. Mend that and withdraw it again."
            raise OutputError(msg) from error
        write_catalogue(Programme(programme.directory, programme.loaded))  # which does not know the epoch any more
    return plan


def _described(programme: Programme, epoch_id: str) -> WithdrawnEpoch:
    kept_as = programme.directory / "withdrawn" / f"{epoch_id}.toml"
    others = [epoch.epoch_id for epoch in programme.epochs if epoch.epoch_id != epoch_id]
    names = [epoch_id, *(f"{epoch_id}_{other}" for other in others), *(f"{other}_{epoch_id}" for other in others)]
    folders = [programme.flight_directory(epoch_id), programme.state_directory(epoch_id)]
    folders += [*(programme.product_directory(name) for name in names)]
    removed = tuple(folder for folder in folders if folder.is_dir())
    n_later = 0
    if programme.epoch_path(epoch_id).exists() or not (kept_as.exists() and removed):
        epoch = programme.epoch(epoch_id)
        n_later = sum(other.date > epoch.date for other in programme.epochs)
    return WithdrawnEpoch(epoch_id=epoch_id, kept_as=kept_as, removed=removed, n_to_learn=n_later)
