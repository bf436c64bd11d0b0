"""What a difference amounts to: areas, volumes and their errors, in one small document."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing.areas import area_budget
from changedetect.differencing.maps import (
    BELOW_LEVEL_OF_DETECTION,
    NOT_OBSERVED,
    SURFACE_LOWERED,
    SURFACE_RAISED,
    ChangeMaps,
)
from changedetect.differencing.objects import find_objects_of_change

if TYPE_CHECKING:
    from changedetect.differencing.objects import ChangeObjects
    from changedetect.grid import Grid
    from changedetect.typing import JSONObject

__all__ = ["summarise", "systematic_offset"]

#: A shift of the whole map: the median is this many times its robust scatter away from zero ...
_OFFSET_RATIO = 1.5
#: ... and this share of the ground moved to the same side beyond the level of detection.
_OFFSET_SHARE = 0.5


def summarise(
    maps: ChangeMaps, grid: Grid, objects: ChangeObjects | None = None, confidence: float = 0.95
) -> JSONObject:
    """
    Areas, volumes and robust statistics of a difference.

    Parameters
    ----------
    maps : ChangeMaps
    grid : Grid
    objects : ChangeObjects, optional
        Where change was found, which tells raised from lowered ground; by default they are found here, at a false
        discovery rate of one less the confidence.
    confidence : float
        Of the intervals of the volumes.

    Returns
    -------
    summary : dict
        Areas in m2, volumes in m3 with standard deviations and intervals, changes in m; `error_model` says what
        errors were found, `error_prediction` how far they were predicted from the ground around and taken off (None:
        not at all), `objects` how many regions of change. None stands for what cannot be stated because no
        ground was observed twice.

    Notes
    -----
    Volumes use the estimate of every cell, since keeping only significant cells biases them, see `area_budget`.
    """
    if objects is None:
        objects = find_objects_of_change(maps, grid.resolution, confidence, 1.0 - confidence)
    area = grid.resolution**2
    both = np.isfinite(maps.dod)
    classes = maps.change_class
    d = maps.dod[both]
    median = float(np.median(d)) if d.size else None
    budget = area_budget(maps, grid.resolution, confidence, None, objects.direction)
    volumes = {key: value for key, value in budget.document().items() if key.startswith("volume")}
    return {
        "resolution_m": grid.resolution,
        "area_observed_m2": area * int(both.sum()),
        "area_raised_m2": area * int(np.count_nonzero(classes == SURFACE_RAISED)),
        "area_lowered_m2": area * int(np.count_nonzero(classes == SURFACE_LOWERED)),
        "area_below_level_of_detection_m2": area * int(np.count_nonzero(classes == BELOW_LEVEL_OF_DETECTION)),
        "area_not_observed_m2": area * int(np.count_nonzero(classes == NOT_OBSERVED)),
        **volumes,
        "change_median_m": median,
        "change_nmad_m": None if median is None else 1.4826 * float(np.median(np.abs(d - median))),
        "change_minimum_m": float(d.min()) if d.size else None,
        "change_maximum_m": float(d.max()) if d.size else None,
        "level_of_detection_median_m": float(np.median(maps.level_of_detection[both])) if d.size else None,
        "systematic_offset_m": systematic_offset(maps),
        "error_model": maps.errors.model.document(),
        "error_prediction": None if maps.errors.prediction is None else maps.errors.prediction.document(),
        "objects": _count(objects),
    }


def _count(objects: ChangeObjects) -> JSONObject:
    raised = [item for item in objects.items if item.is_raised]
    lowered = [item for item in objects.items if not item.is_raised]
    return {
        "n_raised": len(raised),
        "n_lowered": len(lowered),
        "area_raised_m2": float(sum(item.area for item in raised)),
        "area_lowered_m2": float(sum(item.area for item in lowered)),
    }


def systematic_offset(maps: ChangeMaps) -> float | None:
    """
    Median change, m, if the map as a whole is shifted as by a vertical datum or registration step; else None.

    Returns
    -------
    offset : float or None
        The median, when it exceeds its robust scatter 1.5-fold and more than half of the ground observed by both
        epochs moved significantly to its side.
    """
    d = maps.dod[np.isfinite(maps.dod)]
    if d.size == 0:
        return None
    median = float(np.median(d))
    scatter = 1.4826 * float(np.median(np.abs(d - median)))
    side = SURFACE_RAISED if median > 0.0 else SURFACE_LOWERED
    share = np.count_nonzero(maps.change_class == side) / d.size
    return median if abs(median) > _OFFSET_RATIO * scatter and share > _OFFSET_SHARE else None
