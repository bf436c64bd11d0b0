"""Weights that let unchanged ground decide, however the rest changed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.special import ndtr, ndtri

if TYPE_CHECKING:
    from changedetect.coregistration.sample import Sample, Squares
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["CROSSING", "Consensus", "agreeing", "majority_level", "nmad"]

#: Tukey's biweight in scales: 95 % efficient for normal errors.
_TUKEY = 4.685
#: A square whose mean residual is further away than this many scales of such means has changed, and so has one whose
#: neighbourhood is. While searching it is fewer, because where 40 % of the ground changed to one side the scale that
#: is seen is twice that of the unchanged ground. Changes of 4.5 such scales are then found on up to 40 % of the
#: ground (with 2.5 all along: of 6 scales).
_CHANGED = 2.5
_CHANGED_SEARCHING = 2.0
#: Density of normal means at the thresholds, 2 c phi(c), over those inside, 2 Phi(c) - 1.
CROSSING = (
    2.0 * _CHANGED * math.exp(-0.5 * _CHANGED**2) / math.sqrt(2.0 * math.pi) / math.erf(_CHANGED / math.sqrt(2.0))
)
#: Squares along one side of a neighbourhood.
_NEIGHBOURS = 5
#: Smallest scale, m: far below any survey's noise, it keeps noise-free data from dividing by zero.
_SMALLEST_SCALE = 1e-6
#: Values that tell the level of the majority well enough.
_ENOUGH = 10_000
#: Standard deviation of a normal variable over its median absolute deviation.
_NMAD = 1.4826


def nmad(values: FloatArray) -> float:
    """
    Normalised median absolute deviation about the median.

    Parameters
    ----------
    values : array, shape (n,)

    Returns
    -------
    nmad : float
        The standard deviation where values are normal; NaN where there are none.
    """
    if values.size == 0:
        return float("nan")
    return _NMAD * float(np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class Consensus:
    """
    Which observations agree with the reference, and how well.

    Attributes
    ----------
    weight : array, shape (n,)
        psi(r) / r of the biweight, 0 for outliers and on changed ground.
    derivative : array, shape (n,)
        psi'(r).
    is_stable : array, shape (n_squares,), bool
        Squares whose ground did not change.
    scale : float, m
        Robust standard deviation of an observation's residual.
    """

    weight: FloatArray
    derivative: FloatArray
    is_stable: BoolArray
    scale: float

    def on_stable_ground(self, squares: Squares) -> BoolArray:
        """Whether each observation lies on ground that did not change."""
        stable: BoolArray = self.is_stable[squares.member]
        return stable


def agreeing(
    residual: FloatArray, defined: BoolArray, sample: Sample, before: Consensus | None, *, is_settled: bool = False
) -> Consensus:
    """
    One step towards the observations that agree with the reference.

    Parameters
    ----------
    residual : array, shape (n,), m
    defined : array, shape (n,), bool
        Where the reference has an elevation.
    sample : Sample
        Its squares are small enough to tell changed from unchanged ground, large enough to average noise.
    before : Consensus or None
        Of the step before; None while searching: scales are then those of the closest quarter.
    is_settled : bool
        Keep the scale and the changed squares of the step before.

    Returns
    -------
    consensus : Consensus

    Notes
    -----
    Observations far from the surface (vegetation, gross errors) get less weight by Tukey's biweight. Squares are left
    out whole whose mean is far off, or that of their neighbourhood, or most of whose neighbours are: a change that is
    small against the noise of one observation shows in the mean of many. Scales are those of what was not left out in
    the step before, so they shrink to those of the unchanged ground although changes inflate the first.
    """
    precision, squares = sample.precision, sample.squares
    standardised = np.abs(residual * np.sqrt(precision))
    if before is None:
        scale = _quarter_scale(standardised[defined])
    elif is_settled:
        scale = before.scale
    else:
        scale = max(_NMAD * _median(standardised[defined & (before.weight > 0.0)]), _SMALLEST_SCALE)
    u2 = np.where(defined, (standardised / (_TUKEY * scale)) ** 2, 1.0)
    inside = np.maximum(1.0 - u2, 0.0)
    weight = inside**2 * precision
    stable = before.is_stable if before and is_settled else _unchanged(residual, weight, squares, before)
    kept = stable[squares.member]
    derivative = inside * (1.0 - 5.0 * u2) * precision
    return Consensus(np.where(kept, weight, 0.0), np.where(kept, derivative, 0.0), stable, scale)


def majority_level(residual: FloatArray, defined: BoolArray, sample: Sample) -> float:
    """
    Level of the ground that did not change, found among ground that stands at several.

    Parameters
    ----------
    residual, defined, sample
        As for `agreeing`.

    Returns
    -------
    level : float, m
        Where the closest half of the neighbourhoods' means lies; observations far from the majority take no part.
    """
    precision, squares = sample.precision, sample.squares
    level = _shortest_half(residual[defined])
    standardised = np.abs((residual - level) * np.sqrt(precision))
    u2 = np.where(defined, (standardised / (_TUKEY * _quarter_scale(standardised[defined]))) ** 2, 1.0)
    weight = np.maximum(1.0 - u2, 0.0) ** 2 * precision
    means = _neighbourhood_mean(squares.total(residual * weight), squares.total(weight), squares)
    return _shortest_half(means[np.isfinite(means)])


def _unchanged(residual: FloatArray, weight: FloatArray, squares: Squares, before: Consensus | None) -> BoolArray:
    """Squares that did not change."""
    cut = _CHANGED_SEARCHING if before is None else _CHANGED
    sums, weights = squares.total(residual * weight), squares.total(weight)
    # squares without a single observation of any weight have no mean: they have changed
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.abs(np.nan_to_num(sums / weights, nan=np.inf))
    scale = _quarter_scale(means) if before is None else _truncated_scale(means[before.is_stable], cut)
    stable = means <= cut * scale
    around = np.abs(np.nan_to_num(_neighbourhood_mean(sums * stable, weights * stable, squares), nan=np.inf))
    wider = _quarter_scale(around) if before is None else _truncated_scale(around[before.is_stable & stable], cut)
    stable &= around <= cut * wider
    # inside a changed area some agree by chance
    agreeing_share, occupied = (
        uniform_filter(squares.raster(v.astype(np.float64)), _NEIGHBOURS, mode="constant")
        for v in (stable, np.ones_like(stable))
    )
    unchanged: BoolArray = stable & (agreeing_share >= 0.5 * occupied)[squares.row, squares.column]
    return unchanged


def _neighbourhood_mean(sums: FloatArray, weights: FloatArray, squares: Squares) -> FloatArray:
    """Mean around each occupied square, NaN where there is no weight."""
    total, weight = (uniform_filter(squares.raster(v), _NEIGHBOURS, mode="constant") for v in (sums, weights))
    has_weight = weight > 1e-9 * float(weight.max(initial=0.0))
    mean = np.divide(total, weight, out=np.full_like(total, np.nan), where=has_weight)
    return mean[squares.row, squares.column]


def _shortest_half(values: FloatArray) -> float:
    """
    Median of the half of the values that lies closest together; 0 where there are none.

    Stays with the majority where up to almost half of the values lie elsewhere, all on one side even, which
    displaces the median.

    References
    ----------
    .. [1] P. J. Rousseeuw (1984), Least median of squares regression, J. Am. Stat. Assoc. 79, 871-880.
    """
    if values.size == 0:
        return 0.0
    # samples are ordered by place: every so many of them are spread as evenly
    ordered = np.sort(values[:: values.size // _ENOUGH + 1])
    half = ordered.size // 2 + 1
    first = int(np.argmin(ordered[half - 1 :] - ordered[: ordered.size - half + 1]))
    return float(np.median(ordered[first : first + half]))


def _quarter_scale(distances: FloatArray) -> float:
    """Standard deviation, if normal, from the quarter of absolute values closest to zero: outliers inflate it least."""
    finite = distances[np.isfinite(distances)]
    quartile = float(np.quantile(finite, 0.25)) if finite.size else 0.0
    return max(quartile / float(ndtri(0.625)), _SMALLEST_SCALE)


def _truncated_scale(distances: FloatArray, cut: float) -> float:
    """Standard deviation of normal values from absolute values of which those beyond `cut` times it were left out."""
    return max(_median(distances) / float(ndtri(0.25 + 0.5 * ndtr(cut))), _SMALLEST_SCALE)


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if values.size else 0.0
