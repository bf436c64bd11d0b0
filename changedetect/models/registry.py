"""Which surface model a programme uses, and which one a stored state holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from changedetect.models.lwpr import LWPRSurface
from changedetect.models.lwpr_state import ADAPTIVE_FILE
from changedetect.models.reference import ReferenceLWPR

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.config import ProgrammeConfig

__all__ = ["create_model", "load_model"]


def create_model(config: ProgrammeConfig) -> LWPRSurface | ReferenceLWPR:
    """Return an empty model with the programme's settings."""
    if config.model == "reference":
        return ReferenceLWPR(config.lwpr, memory_days=config.memory_days)
    return LWPRSurface(config.adaptive, config.memory_days, config.resolution)


def load_model(directory: Path) -> LWPRSurface | ReferenceLWPR:
    """
    Read the model a folder holds.

    Raises
    ------
    ModelStateError
        The state is damaged.
    MissingInputError
        There is no state.
    """
    if (directory / ADAPTIVE_FILE).exists():
        return LWPRSurface.load(directory)
    return ReferenceLWPR.load(directory)
