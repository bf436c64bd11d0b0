"""
Terrain change detection with surfaces learned by Locally Weighted Projection Regression.

The names below load on first use, so that importing the package stays cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Grid": "changedetect.grid",
    "PointCloud": "changedetect.pointcloud",
    "Prediction": "changedetect.models.base",
    "SurfaceModel": "changedetect.models.base",
    "LWPRSurface": "changedetect.models.lwpr",
    "Programme": "changedetect.catalogue",
}

__all__ = ["Grid", "LWPRSurface", "PointCloud", "Prediction", "Programme", "SurfaceModel", "__version__"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    msg = f"module 'changedetect' has no attribute {name!r}"
    raise AttributeError(msg)


def __dir__() -> list[str]:
    return __all__
