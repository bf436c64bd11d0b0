"""Colour limits that all maps of a programme share."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

import numpy as np

from changedetect.catalogue import Programme
from changedetect.differencing import ChangeMaps
from changedetect.errors import ModelStateError
from changedetect.typing import FloatArray

__all__ = ["change_limits", "programme_limits", "surface_limits"]

logger = logging.getLogger(__name__)


def programme_limits(programme: Programme, epoch_ids: tuple[str, ...]) -> dict[str, tuple[float, float]] | None:
    """Colour limits of the programme's other maps of this kind: maps compare only if colours mean the same."""
    if len(epoch_ids) == 1:
        others = [epoch.epoch_id for epoch in programme.epochs if epoch.epoch_id != epoch_ids[0]]
    else:
        others = [pair.product_id for pair in programme.existing_pairs() if (pair.earlier, pair.later) != epoch_ids]
    for product_id in others:
        try:
            found = programme.product_record(product_id)
        except ModelStateError as error:
            logger.debug("%s", error)  # it is stale and will be made again
            continue
        if found is not None:
            return {name: (float(low), float(high)) for name, (low, high) in found[0].colour_limits.items()}
    return None


def surface_limits(layers: Mapping[str, FloatArray]) -> dict[str, tuple[float, float]]:
    """Colour limits for the first epoch of a programme, from its layers (see `Prediction`)."""
    elevation = layers["elevation"][np.isfinite(layers["elevation"])]
    limits = {name: (0.0, _round_up(_percentile(layers[name], 98.0))) for name in ("elevation_std", "noise_std")}
    if elevation.size:
        low, high = (float(value) for value in np.percentile(elevation, (2.0, 98.0)))
        limits["elevation"] = (low, high if high > low else low + 1.0)
    return limits


def change_limits(maps: ChangeMaps) -> dict[str, tuple[float, float]]:
    """Colour limits for the first difference of a programme: symmetric about zero, beyond the level of detection."""
    largest = _round_up(max(_percentile(np.abs(maps.dod), 98.0), 2.0 * _percentile(maps.level_of_detection, 50.0)))
    limits = {
        name: (0.0, _round_up(_percentile(getattr(maps, name), 98.0))) for name in ("dod_std", "level_of_detection")
    }
    return {"dod": (-largest, largest), **limits}


def _percentile(values: FloatArray, q: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, q)) if finite.size else 0.0


def _round_up(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten; 1 for nothing."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1.0 + 1e-9))
