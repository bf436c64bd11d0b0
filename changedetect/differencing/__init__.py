"""Differences of two epochs: change, its errors and significance, volumes of areas, objects."""

from changedetect.differencing.areas import AreaBudget, Quantity, area_budget, elevation_bands, sum_std
from changedetect.differencing.coherent import CoherentTerm
from changedetect.differencing.error_model import TooLittleGroundError
from changedetect.differencing.maps import ChangeMaps
from changedetect.differencing.objects import ChangeObject, ChangeObjects, find_objects_of_change
from changedetect.differencing.pair import difference_models
from changedetect.differencing.resolution import (
    ObjectSize,
    Resolution,
    describe_resolution,
    object_sizes,
    resolution_classes,
)
from changedetect.differencing.summary import summarise, systematic_offset

__all__ = [
    "AreaBudget",
    "ChangeMaps",
    "ChangeObject",
    "ChangeObjects",
    "CoherentTerm",
    "ObjectSize",
    "Quantity",
    "Resolution",
    "TooLittleGroundError",
    "area_budget",
    "describe_resolution",
    "difference_models",
    "elevation_bands",
    "find_objects_of_change",
    "object_sizes",
    "resolution_classes",
    "sum_std",
    "summarise",
    "systematic_offset",
]
