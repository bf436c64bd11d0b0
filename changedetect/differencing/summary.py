"""What a difference amounts to: areas, volumes and their errors, in one small document."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing.maps import (
    BELOW_LEVEL_OF_DETECTION,
    NOT_OBSERVED,
    SURFACE_LOWERED,
    SURFACE_RAISED,
    ChangeMaps,
)

if TYPE_CHECKING:
    from changedetect.grid import Grid
    from changedetect.typing import JSONObject

__all__ = ["summarise", "systematic_offset"]

#: A shift of the whole map: the median is this many times its robust scatter away from zero ...
_OFFSET_RATIO = 1.5
#: ... and this share of the ground moved to the same side beyond the level of detection.
_OFFSET_SHARE = 0.5


def summarise(maps: ChangeMaps, grid: Grid) -> JSONObject:
    """
    Areas, volumes and robust statistics of a difference.

    Parameters
    ----------
    maps : ChangeMaps
    grid : Grid

    Returns
    -------
    summary : dict
        Areas in m2, volumes in m3 with their standard deviations, changes in m. `volume_net` is the integral of the
        difference over all ground both epochs observed; `volume_raised` - `volume_lowered` equals it. None
        stands for what cannot be stated because no ground was observed twice.

    Notes
    -----
    Volumes use the estimate of every cell, since keeping only significant cells biases them. Summing positive and
    negative parts apart would count noise as both cut and fill: where no change was detected the smaller of the two
    sums is taken for noise and off both. Standard deviations hold the local noise alone: cells closer than
    `maps.correlation_length` share their data, cells further apart count as independent.
    """
    area = grid.resolution**2
    both = np.isfinite(maps.dod)
    classes = maps.change_class
    d, std = maps.dod[both], maps.dod_std[both]
    quiet = classes[both] == BELOW_LEVEL_OF_DETECTION
    rectified = area * float(min(np.sum(d[quiet & (d > 0.0)]), -np.sum(d[quiet & (d < 0.0)])))
    median = float(np.median(d)) if d.size else None
    return {
        "resolution_m": grid.resolution,
        "area_observed_m2": area * int(both.sum()),
        "area_raised_m2": area * int(np.count_nonzero(classes == SURFACE_RAISED)),
        "area_lowered_m2": area * int(np.count_nonzero(classes == SURFACE_LOWERED)),
        "area_below_level_of_detection_m2": area * int(quiet.sum()),
        "area_not_observed_m2": area * int(np.count_nonzero(classes == NOT_OBSERVED)),
        "volume_raised_m3": max(area * float(np.sum(d[d > 0.0])) - rectified, 0.0),
        "volume_raised_std_m3": _volume_std(std[d > 0.0], area, maps.correlation_length),
        "volume_lowered_m3": max(-area * float(np.sum(d[d < 0.0])) - rectified, 0.0),
        "volume_lowered_std_m3": _volume_std(std[d < 0.0], area, maps.correlation_length),
        "volume_net_m3": area * float(np.sum(d)),
        "volume_net_std_m3": _volume_std(std, area, maps.correlation_length),
        "change_median_m": median,
        "change_nmad_m": None if median is None else 1.4826 * float(np.median(np.abs(d - median))),
        "change_minimum_m": float(d.min()) if d.size else None,
        "change_maximum_m": float(d.max()) if d.size else None,
        "level_of_detection_median_m": float(np.median(maps.level_of_detection[both])) if d.size else None,
        "systematic_offset_m": systematic_offset(maps),
    }


def _volume_std(std: np.typing.NDArray[np.float64], area: float, correlation_length: float) -> float:
    shared = max(1.0, correlation_length**2 / area)
    return area * math.sqrt(shared * float(np.sum(std**2)))


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
