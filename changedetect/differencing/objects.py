"""Change objects: regions whose change is significant as a whole, at a controlled rate of false discoveries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats
from scipy.ndimage import binary_closing, binary_fill_holes, find_objects

from changedetect.differencing.areas import Quantity, area_budget
from changedetect.differencing.clusters import find_clusters, normal_score, q_values, simulate_null

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.differencing.maps import ChangeMaps
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["ChangeObject", "ChangeObjects", "find_objects_of_change"]


@dataclass(frozen=True)
class ChangeObject:
    """
    One region of change.

    Attributes
    ----------
    number : int
        Its label in the raster of objects, from 1; the largest mass first.
    is_raised : bool
    n_cells : int
    area : float, m2
    volume : Quantity, m3
        Positive where raised.
    mean : Quantity, m
    extreme : float, m
        Change of the largest absolute value.
    q_value : float
        Smallest false discovery rate at which this region counts as change.
    """

    number: int
    is_raised: bool
    n_cells: int
    area: float
    volume: Quantity
    mean: Quantity
    extreme: float
    q_value: float


@dataclass(frozen=True)
class ChangeObjects:
    """
    All objects of a difference.

    Attributes
    ----------
    items : tuple of ChangeObject
    labels : array, shape (n_rows, n_cols), int32
        Number of the object of each cell, 0 outside all.
    direction : array, shape (n_rows, n_cols), float64
        1 in raised objects, 0 in lowered ones, 0.5 elsewhere.
    """

    items: tuple[ChangeObject, ...]
    labels: NDArray[np.int32]
    direction: FloatArray


def find_objects_of_change(
    maps: ChangeMaps, resolution: float, confidence: float, false_discovery_rate: float
) -> ChangeObjects:
    """
    Find the regions of change.

    Parameters
    ----------
    maps : ChangeMaps
    resolution : float, m
    confidence : float
        Cells beyond the two-sided quantile join into regions; also that of the intervals.
    false_discovery_rate : float
        Regions with a q-value of at most this are objects.

    Returns
    -------
    objects : ChangeObjects

    Notes
    -----
    Regions are scored by mass against random fields with the errors' own correlation, see `clusters`. Gaps and holes
    narrower than the estimator's kernel are closed. A region ends where its change is no longer conspicuous; the mean
    of a weak object is that of its conspicuous part.
    """
    threshold = float(stats.norm.ppf(0.5 + 0.5 * confidence))
    known = np.isfinite(maps.dod)
    score = normal_score(maps.z_score, maps.degrees_of_freedom)
    clusters = find_clusters(score, threshold)
    direction = np.full(known.shape, 0.5)
    labels = np.zeros(known.shape, np.int32)
    if clusters.mass.size == 0:
        return ChangeObjects((), labels, direction)
    model = maps.errors.model
    total = np.where(known, maps.dod_std, 1.0)
    local = np.where(known, maps.local_std, 0.0) / total
    # what co-registration leaves moves whole maps and makes no regions; its share of the variance goes to the others
    correlated = np.sqrt(np.maximum(1.0 - local**2, 0.0)) if model.is_correlated else np.zeros(known.shape)
    prediction = maps.errors.prediction
    correlation = model.correlation.normalised() if prediction is None else prediction.correlation
    null = simulate_null(
        (local, correlated), (model.local, correlation), known, resolution, threshold, np.random.default_rng(40)
    )
    q = q_values(clusters.mass, null)
    reach = max(1, round(model.local.ranges[0] / resolution))
    items: list[ChangeObject] = []
    windows = find_objects(clusters.labels)
    for k in np.argsort(-clusters.mass, kind="stable"):
        if q[k] > false_discovery_rate:
            continue
        rows, cols = (slice(max(s.start - reach, 0), s.stop + reach) for s in windows[k])
        window = (rows, cols)
        free = known[window] & (labels[window] == 0)
        region = _closed(clusters.labels[window] == k + 1, reach) & free
        if not region.any():
            continue
        number = len(items) + 1
        labels[window][region] = number
        is_raised = bool(clusters.sign[k] > 0)
        direction[window][region] = float(is_raised)
        items.append(_describe(maps, region, window, number, is_raised, float(q[k]), resolution, confidence))
    return ChangeObjects(tuple(items), labels, direction)


def _closed(region: BoolArray, reach: int) -> BoolArray:
    """Region without gaps and holes of up to twice the reach."""
    padded = np.pad(region, reach)
    closed = binary_closing(padded, np.ones((3, 3), bool), iterations=reach)
    filled = binary_fill_holes(closed)
    inner = (slice(reach, -reach), slice(reach, -reach))
    return np.asarray(filled if filled is not None else closed, bool)[inner] | region


def _describe(
    maps: ChangeMaps,
    region: BoolArray,
    window: tuple[slice, slice],
    number: int,
    is_raised: bool,
    q_value: float,
    resolution: float,
    confidence: float,
) -> ChangeObject:
    budget = area_budget(maps, resolution, confidence, region, window=window)
    d = maps.dod[window][region]
    volume, area = budget.net, budget.area_observed
    return ChangeObject(
        number=number,
        is_raised=is_raised,
        n_cells=int(d.size),
        area=area,
        volume=volume,
        mean=Quantity(*(v / area for v in (volume.value, volume.std, volume.lower, volume.upper))),
        extreme=float(d[np.argmax(np.abs(d))]),
        q_value=q_value,
    )
