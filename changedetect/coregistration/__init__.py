"""Alignment of survey epochs to a reference surface."""

from __future__ import annotations

from changedetect.coregistration.alignment import Alignment
from changedetect.coregistration.choice import Candidate
from changedetect.coregistration.point_to_surface import align
from changedetect.coregistration.reference import GridReference, ModelReference, ReferenceSurface
from changedetect.coregistration.refusals import AlignmentError
from changedetect.coregistration.resolutions import align_across_resolutions, differ_in_resolution
from changedetect.coregistration.transform import KINDS, Kind, Transform

__all__ = [
    "KINDS",
    "Alignment",
    "AlignmentError",
    "Candidate",
    "GridReference",
    "Kind",
    "ModelReference",
    "ReferenceSurface",
    "Transform",
    "align",
    "align_across_resolutions",
    "differ_in_resolution",
]
