"""Alignment of survey epochs to a reference surface."""

from __future__ import annotations

from changedetect.coregistration.align import align
from changedetect.coregistration.alignment import Alignment, Candidate
from changedetect.coregistration.settings import AlignmentSettings
from changedetect.coregistration.surfaces import (
    GridReference,
    LWPRReference,
    PredictedReference,
    ReferenceSurface,
    SurfaceValues,
)
from changedetect.coregistration.thinning import SpatialSample, thin
from changedetect.coregistration.transform import KINDS, Kind, Transform

__all__ = [
    "KINDS",
    "Alignment",
    "AlignmentSettings",
    "Candidate",
    "GridReference",
    "Kind",
    "LWPRReference",
    "PredictedReference",
    "ReferenceSurface",
    "SpatialSample",
    "SurfaceValues",
    "Transform",
    "align",
    "thin",
]
