"""The surface models of a comparison: both modes of LWPR with a programme's settings, and the comparators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING

from changedetect.models.base import SurfaceModel
from changedetect.models.comparators import comparators
from changedetect.models.registry import create_model

if TYPE_CHECKING:
    from changedetect.config import ProgrammeConfig

__all__ = ["INSTALL_EXTRA", "Method", "known_methods"]

#: What to type where an optional package is missing.
INSTALL_EXTRA = "pip install 'changedetect[compare]'"

#: Names under which packages are imported, where they differ.
_IMPORT_NAMES = {"scikit-learn": "sklearn"}


@dataclass(frozen=True)
class Method:
    """
    One way to learn a surface.

    Attributes
    ----------
    name : str
    title : str
        For tables.
    build : callable
        Makes a fresh model; can be sent to another process.
    max_points : int or None
        Largest number of observations the method copes with.
    requires : str or None
        Optional package it needs.
    """

    name: str
    title: str
    build: Callable[[], SurfaceModel]
    max_points: int | None = None
    requires: str | None = None

    @property
    def missing_package(self) -> str | None:
        """The optional package that is needed and not installed."""
        if self.requires is None or find_spec(_IMPORT_NAMES.get(self.requires, self.requires)) is not None:
            return None
        return self.requires


def known_methods(config: ProgrammeConfig) -> dict[str, Method]:
    """
    Methods to compare, by name, the programme's own model first.

    Parameters
    ----------
    config : ProgrammeConfig
        Settings of both modes of LWPR; the comparators have their own.

    Returns
    -------
    methods : dict of str to Method

    Examples
    --------
    >>> from changedetect.config import ProgrammeConfig
    >>> list(known_methods(ProgrammeConfig(crs="EPSG:32632+5773", model="reference")))[:3]
    ['reference', 'adaptive', 'gpr_rbf']
    """
    own = (
        Method("adaptive", "LWPR, adaptive mode", partial(create_model, replace(config, model="adaptive"))),
        Method("reference", "LWPR as published", partial(create_model, replace(config, model="reference"))),
    )
    others = (Method(item.name, item.title, item, item.max_points, item.requires) for item in comparators().values())
    own_first = sorted(own, key=lambda method: method.name != config.model)
    return {method.name: method for method in (*own_first, *others)}
