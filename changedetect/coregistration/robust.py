"""Weights that let unchanged ground decide, however the rest changed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.special import ndtr, ndtri

if TYPE_CHECKING:
    from changedetect.coregistration.squares import Squares
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["CHANGED", "CHANGED_AT_FIRST", "Consensus", "majority_level", "nmad", "skipping_inflation", "weigh"]

#: Tukey's biweight in scales: 95 % efficient for normal errors.
_TUKEY = 4.685
#: A square whose mean residual is further away than this many scales of such means has changed. At first it is fewer,
#: because where 40 % of the ground changed to one side the scale that is seen is twice that of the unchanged ground.
#: Changes of 4.5 such scales are then found on up to 40 % of the ground (with 3.0 and 3.0: of 6 scales).
CHANGED = 2.5
CHANGED_AT_FIRST = 2.0
#: Squares along one side of a neighbourhood.
_NEIGHBOURS = 5
#: Smallest scale, m: far below any survey's noise, it keeps noise-free data from dividing by zero.
_SMALLEST_SCALE = 1e-6
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
    Which observations agree, and how well.

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
    square_scale : float, m
        The same of a square's mean residual.
    """

    weight: FloatArray
    derivative: FloatArray
    is_stable: BoolArray
    scale: float
    square_scale: float

    def stable_observations(self, squares: Squares) -> BoolArray:
        """Whether each observation lies on ground that did not change."""
        stable: BoolArray = self.is_stable[squares.member]
        return stable


def weigh(
    residual: FloatArray,
    defined: BoolArray,
    precision: FloatArray,
    squares: Squares,
    before: Consensus | None,
    changed: float | None,
) -> Consensus:
    """
    One step towards the observations that agree with the reference.

    Parameters
    ----------
    residual : array, shape (n,), m
    defined : array, shape (n,), bool
        Where the reference has an elevation.
    precision : array, shape (n,)
        1 / variance of an observation, relative to the typical one.
    squares : Squares
        Small enough to tell changed from unchanged ground, large enough to average noise.
    before : Consensus or None
        Of the step before; None in the first.
    changed : float or None
        Scales beyond which a square has changed. None keeps the scales and the changed squares of the step before.

    Returns
    -------
    consensus : Consensus

    Notes
    -----
    Two stages. Observations far from the surface (vegetation, gross errors) get less weight by Tukey's biweight; its
    scale is the NMAD about zero of those not rejected in the step before, which shrinks to that of the unchanged
    ground although changed ground inflates the first one. Then squares whose mean is far off are left out whole:
    a change that is small against the noise of one observation shows in the mean of several.
    """
    is_judging = before is None or changed is not None
    cut = CHANGED if changed is None else changed
    if before is None:
        scale = _quarter_scale(np.abs(residual * np.sqrt(precision))[defined])
    elif is_judging:
        kept = defined & (before.weight > 0.0)
        scale = max(_NMAD * _median(np.abs(residual * np.sqrt(precision))[kept]), _SMALLEST_SCALE)
    else:
        scale = before.scale
    u2 = np.where(defined, precision * (residual / (_TUKEY * scale)) ** 2, 1.0)
    inside = np.maximum(1.0 - u2, 0.0)
    weight = inside**2 * precision
    derivative = inside * (1.0 - 5.0 * u2) * precision
    # squares without a single observation of any weight have no mean: they have changed
    means = np.abs(np.nan_to_num(squares.mean(residual, weight), nan=np.inf))
    if before is None:
        square_scale = _quarter_scale(means)
    elif is_judging:
        square_scale = max(_median(means[before.is_stable]) / _truncated_median(cut), _SMALLEST_SCALE)
    else:
        square_scale = before.square_scale
    stable = _majority(means <= cut * square_scale, squares) if is_judging or before is None else before.is_stable
    kept = stable[squares.member]
    return Consensus(np.where(kept, weight, 0.0), np.where(kept, derivative, 0.0), stable, scale, square_scale)


def majority_level(residual: FloatArray, defined: BoolArray, precision: FloatArray, squares: Squares) -> float:
    """
    Level of the ground that did not change, found among squares that stand at several.

    Parameters
    ----------
    residual, defined, precision, squares
        As for `weigh`.

    Returns
    -------
    level : float, m
        Where the closest half of the squares' means lies; observations far from the majority take no part in these.
    """
    level = _shortest_half(residual[defined])
    scale = _quarter_scale(np.abs((residual - level) * np.sqrt(precision))[defined])
    u2 = np.where(defined, precision * ((residual - level) / (_TUKEY * scale)) ** 2, 1.0)
    means = squares.mean(residual, np.maximum(1.0 - u2, 0.0) ** 2 * precision)
    return _shortest_half(means[np.isfinite(means)])


def skipping_inflation() -> float:
    """
    Variance of the mean of what is left where normal values beyond `CHANGED` are left out, over its naive estimate.

    Notes
    -----
    Huber's skipped mean: psi(x) = x for |x| < c has E psi' = 2 Phi(c) - 1 - 2 c phi(c), the last term for the values
    that cross the threshold when the mean moves; counting those inside alone gives 2 Phi(c) - 1.
    """
    inside = 2.0 * float(ndtr(CHANGED)) - 1.0
    crossing = 2.0 * CHANGED * math.exp(-0.5 * CHANGED**2) / math.sqrt(2.0 * math.pi)
    return (inside / (inside - crossing)) ** 2


def _shortest_half(values: FloatArray) -> float:
    """
    Median of the half of the values that lies closest together.

    Stays with the majority where up to almost half of the values lie elsewhere, all on one side even, which
    displaces the median.

    References
    ----------
    .. [1] P. J. Rousseeuw (1984), Least median of squares regression, J. Am. Stat. Assoc. 79, 871-880.
    """
    ordered = np.sort(values)
    half = ordered.size // 2 + 1
    first = int(np.argmin(ordered[half - 1 :] - ordered[: ordered.size - half + 1]))
    return float(np.median(ordered[first : first + half]))


def _majority(stable: BoolArray, squares: Squares) -> BoolArray:
    """Take out squares most of whose neighbours have changed: inside a changed area some agree by chance."""
    agreeing, occupied = (
        uniform_filter(squares.raster(v.astype(np.float64)), _NEIGHBOURS, mode="constant")
        for v in (stable, np.ones_like(stable))
    )
    return stable & (agreeing >= 0.5 * occupied)[squares.row, squares.column]


def _quarter_scale(distances: FloatArray) -> float:
    """Standard deviation, if normal, from the quarter of absolute values closest to zero, which outliers inflate least."""
    finite = distances[np.isfinite(distances)]
    quartile = float(np.quantile(finite, 0.25)) if finite.size else 0.0
    return max(quartile / float(ndtri(0.625)), _SMALLEST_SCALE)


def _truncated_median(cut: float) -> float:
    """Median of |x| for x normal with standard deviation one and |x| < cut."""
    return float(ndtri(0.25 + 0.5 * ndtr(cut)))


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if values.size else 0.0
