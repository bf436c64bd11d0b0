"""Means and volumes over areas, with errors that know what cells share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from changedetect.differencing.coarse import block_sums
from changedetect.differencing.maps import NOT_OBSERVED
from changedetect.differencing.outside import OutsideGround

if TYPE_CHECKING:
    from changedetect.differencing.maps import ChangeMaps
    from changedetect.typing import BoolArray, FloatArray, JSONObject

__all__ = ["AreaBudget", "Quantity", "area_budget", "elevation_bands", "sum_std"]

_EVERYTHING = (slice(None), slice(None))


@dataclass(frozen=True)
class Quantity:
    """
    An estimate with its standard deviation and interval.

    Attributes
    ----------
    value, std, lower, upper : float
        The interval has the confidence it was asked for.
    """

    value: float
    std: float
    lower: float
    upper: float

    def document(self, name: str, unit: str) -> JSONObject:
        """Return the entries name_unit, name_std_unit and name_interval_unit."""
        return {
            f"{name}_{unit}": self.value,
            f"{name}_std_{unit}": self.std,
            f"{name}_interval_{unit}": [self.lower, self.upper],
        }


@dataclass(frozen=True)
class AreaBudget:
    """
    What moved in an area.

    Attributes
    ----------
    area_observed, area_not_observed : float, m2
        Ground that both epochs saw, that only one saw.
    net, raised, lowered : Quantity, m3
        net = raised - lowered.
    mean : Quantity or None, m
        Mean change of the observed ground; None where there is none.
    """

    area_observed: float
    area_not_observed: float
    net: Quantity
    raised: Quantity
    lowered: Quantity
    mean: Quantity | None

    def document(self) -> JSONObject:
        """Return the budget for files."""
        mean = self.mean or Quantity(0.0, 0.0, 0.0, 0.0)
        described = mean.document("change_mean", "m")
        return {
            "area_observed_m2": self.area_observed,
            "area_not_observed_m2": self.area_not_observed,
            **self.raised.document("volume_raised", "m3"),
            **self.lowered.document("volume_lowered", "m3"),
            **self.net.document("volume_net", "m3"),
            **(described if self.mean is not None else dict.fromkeys(described)),
        }


def sum_std(
    maps: ChangeMaps, weights: FloatArray, resolution: float, window: tuple[slice, slice] = _EVERYTHING
) -> float:
    """
    Standard deviation of a weighted sum of the difference over cells.

    Parameters
    ----------
    maps : ChangeMaps
    weights : array, shape of the window
        Cells whose difference is not known do not count.
    resolution : float, m
    window : pair of slice
        Rows and columns of the map that the weights are for; all of it by default.

    Returns
    -------
    std : float
        In m times the unit of the weights.

    Notes
    -----
    The variance of sum_i w_i d_i is sum_ij w_i w_j (u_i u_j local(r_ij) + s_i s_j correlation(r_ij)) and what
    co-registration shares, with u and s the standard deviations of independent and correlated errors. Both
    correlations are sums of Gaussians, so each double sum is a few short convolutions on cells as coarse as the
    range allows. Where correlated errors are predicted from unchanged ground, that of the sum is predicted from the
    ground outside the area, and the variance is that of what is left.
    """
    return _Area(maps, weights != 0.0, resolution, window).sum(weights)[1]


class _Area:
    """
    Sums of change over an area and their standard deviations.

    Where correlated errors are predicted the area's own ground takes no part: what is left of the sum's error after
    its best prediction from the unchanged ground outside counts.
    """

    def __init__(
        self, maps: ChangeMaps, inside: BoolArray, resolution: float, window: tuple[slice, slice] = _EVERYTHING
    ) -> None:
        self._maps, self._resolution = maps, resolution
        used = inside & np.isfinite(maps.dod[window])
        rows, cols = (np.flatnonzero(used.any(axis=axis)) for axis in (1, 0))
        self._inner = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] if rows.size else None
        if self._inner is None:
            return
        first = [s.indices(n)[0] for s, n in zip(window, maps.dod.shape, strict=True)]
        self._window = tuple(
            slice(start + s.start, start + s.stop) for start, s in zip(first, self._inner, strict=True)
        )
        self._used = used[self._inner]
        self._outside: OutsideGround | None = None
        prediction = maps.errors.prediction
        if prediction is not None:
            area = self._on_blocks(self._used.astype(np.float64)) > 0.0
            model = maps.errors.model
            self._outside = OutsideGround(prediction.data, area, (model.local, model.correlation.normalised()))

    def sum(self, weights: FloatArray) -> tuple[float, float]:
        """Weighted sum of the change and its standard deviation; weights of the shape of the window."""
        if self._inner is None:
            return 0.0, 0.0
        maps, model, here = self._maps, self._maps.errors.model, self._window
        w = np.where(self._used, weights[self._inner], 0.0)
        measured = maps.dod[here] + maps.correlated_error[here]
        total = float(np.sum(np.where(self._used, w * measured, 0.0)))
        local = np.where(self._used, maps.local_std[here], 0.0)
        variance = model.local.variance_of_sum(w * local, self._resolution)
        scaled = w * np.sqrt(np.where(self._used, maps.errors.correlated[here], 0.0))
        share, known = 1.0, None
        if self._outside is not None and maps.errors.prediction is not None:
            known = self._outside.predict(self._on_blocks(scaled))
            total -= known.mean
            share = float(maps.errors.prediction.inflated(known.share_left))
        if model.is_correlated:
            variance += share * model.correlation.variance_of_sum(scaled, self._resolution)
        if maps.errors.terms:
            whole = np.zeros(maps.dod.shape)
            whole[here] = w
            sums = np.concatenate([term.independent_sums(whole) for term in maps.errors.terms])
            variance += float(np.sum((sums - (0.0 if known is None else known.coherent)) ** 2))
        return total, math.sqrt(variance)

    def _on_blocks(self, values: FloatArray) -> FloatArray:
        """Sums over the finest blocks of the prediction of values on the area's window."""
        prediction = self._maps.errors.prediction
        if prediction is None:
            return values
        factor, shape = prediction.data.factor, prediction.data.mean.shape
        starts = [s.start for s in self._window]
        padded = np.pad(values, [(start % factor, 0) for start in starts])
        sums = block_sums(padded, factor)
        whole = np.zeros(shape)
        place = tuple(slice(start // factor, start // factor + n) for start, n in zip(starts, sums.shape, strict=True))
        whole[place] = sums
        return whole


def area_budget(
    maps: ChangeMaps,
    resolution: float,
    confidence: float,
    inside: BoolArray | FloatArray | None = None,
    direction: FloatArray | None = None,
    window: tuple[slice, slice] = _EVERYTHING,
) -> AreaBudget:
    """
    Volumes and mean change of an area.

    Parameters
    ----------
    maps : ChangeMaps
    resolution : float, m
    confidence : float
        Of the intervals.
    inside : array, shape of the window, optional
        Cells of the area, or the share of each cell that lies in it; all ground by default.
    direction : array, shape of the window, optional
        1 where change was found to raise the ground, 0 where to lower it, 0.5 where none was found.
    window : pair of slice
        Rows and columns of the map to look at; all by default.

    Returns
    -------
    budget : AreaBudget

    Notes
    -----
    All cells count with their estimate. raised = a sum p d and lowered = -a sum (1 - p) d with p the direction: both
    are linear in the differences, so errors of quiet ground do not add up to volume as they would in a sum of
    positive parts, and have a standard deviation. Where errors make one of them negative both are lifted until it is
    zero. Change too weak to be found counts half to either side in these
    two, and fully in the net volume.
    """
    dod = maps.dod[window]
    part = np.ones(dod.shape) if inside is None else np.asarray(inside, np.float64)
    known = np.isfinite(dod)
    area = resolution**2
    weights = np.where(known, part * area, 0.0)
    p = np.full(dod.shape, 0.5) if direction is None else direction
    observed = float(weights.sum())

    ground = _Area(maps, weights > 0.0, resolution, window)

    def quantity(w: FloatArray) -> Quantity:
        return _quantity(*ground.sum(w), maps, confidence)

    net = quantity(weights)
    mean = None
    if observed > 0.0:
        mean = Quantity(*(v / observed for v in (net.value, net.std, net.lower, net.upper)))
    not_observed = (maps.change_class[window] == NOT_OBSERVED) & (part > 0.0)
    raised, lowered = _not_below_zero(quantity(weights * p), quantity(-weights * (1.0 - p)))
    return AreaBudget(observed, float(np.sum(part[not_observed])) * area, net, raised, lowered, mean)


def _not_below_zero(raised: Quantity, lowered: Quantity) -> tuple[Quantity, Quantity]:
    """Both moved alike, so that neither is negative and their difference stays; the truth lies above zero too."""
    lift = max(0.0, -raised.value, -lowered.value)
    lifted = [Quantity(q.value + lift, q.std, max(q.lower, 0.0), q.upper + lift) for q in (raised, lowered)]
    return lifted[0], lifted[1]


def elevation_bands(
    maps: ChangeMaps,
    resolution: float,
    confidence: float,
    height: float,
    direction: FloatArray | None = None,
) -> list[tuple[float, float, AreaBudget]]:
    """
    Budget of every band of elevation.

    Parameters
    ----------
    maps : ChangeMaps
    resolution : float, m
    confidence : float
    height : float, m
        Of a band; borders are multiples of it.
    direction : array, optional
        As for `area_budget`.

    Returns
    -------
    bands : list of (lower, upper, budget), m, m, AreaBudget
        Bands that hold ground both epochs saw, lowest first.

    Raises
    ------
    ValueError
        The height is not above zero.
    """
    if not height > 0.0:
        msg = f"the height of an elevation band is {height} m; it must be above zero"
        raise ValueError(msg)
    number = np.floor(maps.elevation / height)
    found = np.unique(number[np.isfinite(number)])
    return [
        (
            float(k * height),
            float((k + 1.0) * height),
            area_budget(maps, resolution, confidence, number == k, direction),
        )
        for k in found
    ]


def _quantity(value: float, std: float, maps: ChangeMaps, confidence: float) -> Quantity:
    """
    Interval of a sum: Student's t with the number of values the errors' scale is known from.

    The tails of single cells do not matter in a sum of many, but where few independent values showed the scale it may
    be too small by chance.
    """
    model = maps.errors.model
    freedom = max(model.n_independent, 3.0) if model.is_correlated else math.inf
    reach = float(stats.t.ppf(0.5 + 0.5 * confidence, freedom)) * std
    return Quantity(value, std, value - reach, value + reach)
