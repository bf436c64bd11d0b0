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


def programme_limits(
    programme: Programme, epoch_ids: tuple[str, ...], own: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """
    Colour limits of a map: those that the programme's other maps of its kind have, else its own.

    Parameters
    ----------
    programme : Programme
    epoch_ids : tuple of str
        One epoch, or two.
    own : mapping of layer to (low, high)
        What suits this map by itself.

    Returns
    -------
    limits : dict of layer to (low, high)

    Notes
    -----
    Maps compare only if colours mean the same. So the first map of a programme sets the limits of each layer, and later
    ones take them over, whatever they show; `differencing.colour_limit_m` sets that of the change by hand.
    """
    if len(epoch_ids) == 1:
        others = [epoch.epoch_id for epoch in programme.epochs if epoch.epoch_id != epoch_ids[0]]
    else:
        others = [pair.product_id for pair in programme.existing_pairs() if (pair.earlier, pair.later) != epoch_ids]
    limits: dict[str, tuple[float, float]] = {}
    for product_id in others:
        try:
            found = programme.product_record(product_id)
        except ModelStateError as error:
            logger.debug("%s", error)  # it is stale and will be made again
            continue
        if found is not None:
            kept = {name: (float(low), float(high)) for name, (low, high) in found[0].colour_limits.items()}
            limits = kept | limits
    limits = dict(own) | limits
    chosen = programme.config.differencing.colour_limit_m
    if chosen is not None and "dod" in limits:
        limits["dod"] = (-chosen, chosen)
    return limits


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
    layers = {
        "dod_std": maps.dod_std,
        "level_of_detection": maps.level_of_detection,
        "resolution": maps.resolution.width,
    }
    limits = {name: (0.0, _round_up(_percentile(layer, 98.0))) for name, layer in layers.items()}
    return {"dod": (-largest, largest), **limits}


def _percentile(values: FloatArray, q: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, q)) if finite.size else 0.0


def _round_up(value: float) -> float:
    """Round up to 1, 1.5, 2, 3, 5 or 7 times a power of ten; 1 for nothing."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0) if value <= step * power * (1.0 + 1e-9))
