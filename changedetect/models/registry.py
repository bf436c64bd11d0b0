"""Which surface model a programme uses, and which one a stored state holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from changedetect.errors import ModelStateError
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.reference import ReferenceLWPR
from changedetect.storage import read_json, write_json

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.config import ProgrammeConfig
    from changedetect.models.base import SurfaceModel

__all__ = ["create_model", "load_model", "save_model"]

_MODE_FILE = "mode.json"
_KINDS = {"adaptive": LWPRSurface, "reference": ReferenceLWPR}


def create_model(config: ProgrammeConfig) -> LWPRSurface | ReferenceLWPR:
    """Return an empty model with the programme's settings."""
    if config.model == "reference":
        return ReferenceLWPR(config.lwpr, memory_days=config.memory_days)
    return LWPRSurface(config.adaptive, config.memory_days, config.resolution)


def save_model(model: SurfaceModel, directory: Path) -> None:
    """Persist a model into a folder, with a note of its kind."""
    mode = next((name for name, kind in _KINDS.items() if isinstance(model, kind)), None)
    if mode is None:
        msg = f"a {type(model).__name__} cannot be persisted in a programme; use one of {sorted(_KINDS)}"
        raise ModelStateError(msg)
    model.save(directory)
    write_json(directory / _MODE_FILE, {"mode": mode})


def load_model(directory: Path) -> LWPRSurface | ReferenceLWPR:
    """
    Read the model a folder holds.

    Raises
    ------
    ModelStateError
        The state is damaged or of an unknown kind.
    MissingInputError
        There is no state.
    """
    mode = read_json(directory / _MODE_FILE).get("mode")
    if mode not in _KINDS:
        msg = f"{directory / _MODE_FILE} names the model {mode!r}; this software knows {sorted(_KINDS)}"
        raise ModelStateError(msg)
    return _KINDS[mode].load(directory)
