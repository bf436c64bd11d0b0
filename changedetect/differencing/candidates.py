"""Ground that may have changed, judged by what the ground around it says: it must not take part in predictions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    binary_fill_holes,
    distance_transform_edt,
    find_objects,
    gaussian_filter,
    label,
    maximum_filter,
)

from changedetect.differencing.blocks import expand, interpolate
from changedetect.differencing.coarse import block_sums
from changedetect.differencing.outside import OutsideGround
from changedetect.differencing.stencil import disc_scores, make_stencil, predict_blocks

if TYPE_CHECKING:
    from changedetect.differencing.blocks import Blocks
    from changedetect.differencing.correlation import NestedCorrelation
    from changedetect.differencing.stencil import Stencil
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["find_candidates"]

#: Conspicuous discs of ground without change that a map may show, on the average ...
_FALSE_DISCS = 0.15
#: ... and the least number of standard deviations that makes one.
_LEAST_LIMIT = 3.0
#: Discs are taken where their score is at least this part of the largest one around, and again after these are out.
_PEAK = 0.6
#: Rounds of looking for discs and growing regions from them, at most; they end when less than a part of the map is new.
_ROUNDS = 4
_SETTLED = 5e-4
#: A map holds this many blocks along its shorter side, at least, when discs are looked for.
_LEAST_BLOCKS = 8
#: A region goes as far as its smoothed score is beyond this.
_LOW = 1.5
#: Scores count up to this limit before they are smoothed, so that a region ends where its ground does.
_HIGH = 3.0
#: ... and ends within this many blocks of its discs.
_GROWTH = 1.5
#: A region as a whole must exceed its prediction from outside by this many standard deviations more than a disc.
_EXTRA = 0.75
#: Part of the variance of the correlated errors by which predictions may be worse than the model knows.
_DOUBT = 0.05
#: Regions are grown by this many ranges of the independent errors: what kernels draw edges out by.
_MARGIN = 1.0
#: A candidate reaches this many blocks about the middle of its disc.
_DISC = np.hypot(*np.mgrid[-2:3, -2:3]) <= 2.1
_NEIGHBOURS = np.ones((3, 3), bool)


def find_candidates(
    finest: Blocks,
    stencil: Stencil,
    correlations: tuple[NestedCorrelation, NestedCorrelation],
    given: BoolArray,
) -> BoolArray:
    """
    Ground that may have changed.

    Parameters
    ----------
    finest : Blocks
        Of all known ground.
    stencil : Stencil
        Discs of half its size, its size and larger by powers of two are tested.
    correlations : pair of NestedCorrelation
        Of the independent and of the correlated errors.
    given : array, bool, shape of the finest blocks
        Candidates already.

    Returns
    -------
    candidates : array, bool, shape of the finest blocks

    Notes
    -----
    The mean of a disc less its best prediction from outside is the test for a change of unknown height of that disc
    against errors of known correlation. Conspicuous discs are taken out; with them out, all ground is predicted anew,
    and the regions that hold such a disc go as far as their ground disagrees with its prediction. What is out shows
    more of what should be, so this is repeated until nothing is added.
    """
    regions = [given & (finest.mean > 0.0), given & (finest.mean <= 0.0)]
    out = given.copy()
    limit = _limit(finest, stencil)
    reach = correlations[0].ranges[0] / finest.side
    for _ in range(_ROUNDS):
        seeds = _conspicuous_discs(finest, out, stencil, correlations, limit)
        if not seeds.any() and not out.any():
            return out
        score = _scores(finest.without(out | seeds), finest, out | seeds, stencil, correlations[0])
        regions = [
            _grown(sign * score, region | seeds, region, _GROWTH * stencil.step, reach)
            for sign, region in zip((1.0, -1.0), regions, strict=True)
        ]
        before = out
        out = out | seeds | regions[0] | regions[1]
        if np.count_nonzero(before != out) <= _SETTLED * out.size:
            break
    data = finest.without(regions[0] | regions[1])
    margin = max(1, math.ceil(_MARGIN * reach))
    found = np.zeros_like(given)
    for region in regions:
        kept = _significant(finest, data, region, correlations, limit + _EXTRA)
        found |= np.asarray(binary_dilation(kept, _NEIGHBOURS, iterations=margin), bool)
    return _solid(found)


def _conspicuous_discs(
    finest: Blocks,
    out: BoolArray,
    stencil: Stencil,
    correlations: tuple[NestedCorrelation, NestedCorrelation],
    limit: float,
) -> BoolArray:
    discs = np.zeros_like(out)
    step = max(1, stencil.step // 2)
    while min(out.shape) >= _LEAST_BLOCKS * step:
        current = make_stencil(correlations[1], correlations[0], step * finest.side, step)
        scores = np.abs(disc_scores(finest.without(out | discs).coarser(step), current))
        peaks = (scores > limit) & (scores >= _PEAK * maximum_filter(scores, 5))
        discs |= expand(binary_dilation(peaks, _DISC), step, (out.shape[0], out.shape[1]))
        step *= 2
    return discs & ~out


def _limit(finest: Blocks, stencil: Stencil) -> float:
    """Standard deviations that discs without change rarely exceed anywhere on the map."""
    n_discs = max(np.count_nonzero(finest.usable) / (stencil.step**2 * np.count_nonzero(stencil.disc)), 1.0)
    return max(_LEAST_LIMIT, float(stats.norm.isf(0.5 * _FALSE_DISCS / n_discs)))


def _significant(
    finest: Blocks,
    data: Blocks,
    regions: BoolArray,
    correlations: tuple[NestedCorrelation, NestedCorrelation],
    limit: float,
) -> BoolArray:
    """Regions whose mean exceeds its prediction from the ground outside all of them."""
    labels, n = label(regions, _NEIGHBOURS)
    kept = np.zeros(n + 1, bool)
    for k, window in enumerate(find_objects(labels), start=1):
        area = labels == k
        weights = np.where(area, finest.share, 0.0)
        predicted = OutsideGround(data, area, correlations).predict(weights)
        left = float(np.sum(weights * finest.mean)) - predicted.mean
        inner = weights[window]
        variance = (predicted.share_left + _DOUBT) * correlations[1].variance_of_sum(inner, finest.side)
        variance += correlations[0].variance_of_sum(inner * np.sqrt(finest.ratio[window]), finest.side)
        kept[k] = left**2 > limit**2 * variance
    return kept[labels]


def _scores(data: Blocks, finest: Blocks, wanted: BoolArray, stencil: Stencil, local: NestedCorrelation) -> FloatArray:
    """Standardised disagreement of places near those wanted with the data beyond the hole about them, smoothed."""
    shape = (finest.mean.shape[0], finest.mean.shape[1])
    near = binary_dilation(block_sums(wanted.astype(np.float64), stencil.step) > 0.0, _DISC)
    around = predict_blocks(data.coarser(stencil.step), stencil, near)
    mean, left = (interpolate(values, stencil.step, shape) for values in (around.mean, around.variance))
    spread = np.sqrt(left + finest.ratio * local.mean_over_square(finest.side))
    known = finest.usable
    reach = 0.7 * local.ranges[0] / finest.side
    weight = np.maximum(gaussian_filter(known.astype(np.float64), reach), 1e-6)
    smooth = (
        gaussian_filter(np.where(known, np.clip((finest.mean - mean) / spread, -_HIGH, _HIGH), 0.0), reach) / weight
    )
    return np.asarray(smooth)


def _grown(score: FloatArray, seeds: BoolArray, before: BoolArray, steps: float, reach: float) -> BoolArray:
    """Regions of high scores that hold seeds and end not far from them, and those before, without holes."""
    part = (score > _LOW) & (distance_transform_edt(~seeds) <= steps) if seeds.any() else np.zeros_like(seeds)
    labels, n = label(part)
    chosen = np.zeros(n + 1, bool)
    chosen[np.unique(labels[seeds])] = True
    chosen[0] = False
    return _solid(chosen[labels] | before, max(1, round(reach)))


def _solid(region: BoolArray, gap: int = 1) -> BoolArray:
    """Region with gaps closed and holes filled."""
    padded = np.pad(region, gap)
    closed = binary_closing(padded, _NEIGHBOURS, iterations=gap)[gap:-gap, gap:-gap]
    return np.asarray(binary_fill_holes(closed), bool) | region
