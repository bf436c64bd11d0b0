"""
Best linear prediction of correlated errors from the blocks of ground around (simple kriging on a lattice).

With y_j the standardised means of the blocks that are data, c_j their covariances with the error at a place and K those
among them, the error is predicted by w'y, w = K^-1 c; what is left has the variance prior - 2 w'c + w'K w, whatever
the weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_erosion, correlate

from changedetect.differencing.blocks import block_covariance
from changedetect.kernels.kriging import solve_stencils

if TYPE_CHECKING:
    from changedetect.differencing.blocks import Blocks
    from changedetect.differencing.correlation import NestedCorrelation
    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["Prediction", "Stencil", "choose_stencil", "disc_scores", "make_stencil", "predict_blocks"]

#: Blocks within this many sides of a place take no part in the prediction of its error ...
HOLE = 2.5
#: ... those within this many do.
_REACH = 5.6
#: Blocks within this many sides of a place make the disc whose mean is tested for change.
_DISC = 2.1
#: The hole is the largest one that leaves at most this part of the errors' variance ...
_WANTED = 0.25
#: ... and prediction is not worth while where the smallest leaves more than this.
_WORTHLESS = 0.6
#: Sides of a block, in ranges of the independent errors: those of ground beyond the hole are others.
_LEAST_SIDE = 2.2
#: Blocks along the shorter side of a map, at least.
_LEAST_BLOCKS = 10
#: Part of the variance added to the diagonal, against rounding.
_RIDGE = 1e-6
#: Places solved together.
_BATCH = 4096
#: Fewer blocks than this predict nothing.
_LEAST_DATA = 3


@dataclass(frozen=True)
class Stencil:
    """
    Blocks around a place and their covariances, in units of the squared scale of the correlated errors.

    Attributes
    ----------
    step : int
        Finest blocks along the side of one of the stencil's.
    row, column : array, shape (n,), int
        Offsets from the block of the place, in blocks.
    hole, disc : array, shape (n,), bool
        Blocks that take no part in predicting the place; those whose mean is tested for change.
    correlated, local : array, shape (n, n)
        Covariances of means of correlated errors, and of independent ones over the variance of a cell.
    target : array, shape (n,)
        Covariance of correlated errors with that of the place.
    prior : float
        Variance of the correlated error of a place.
    """

    step: int
    row: IntArray
    column: IntArray
    hole: BoolArray
    disc: BoolArray
    correlated: FloatArray
    local: FloatArray
    target: FloatArray
    prior: float


@dataclass(frozen=True)
class Prediction:
    """
    Prediction at the centres of blocks, standardised; arrays of shape (n_rows, n_cols).

    Attributes
    ----------
    mean : array
        0 where nothing is predicted.
    variance : array
        Of what is left of the correlated error.
    coherent : array, shape (k, n_rows, n_cols)
        Prediction of each parameter's error, as the mean would give it.
    """

    mean: FloatArray
    variance: FloatArray
    coherent: FloatArray


def make_stencil(correlation: NestedCorrelation, local: NestedCorrelation, side: float, step: int) -> Stencil:
    """
    Stencil of blocks of one size.

    Parameters
    ----------
    correlation, local : NestedCorrelation
        Of the correlated and of the independent errors.
    side : float, m
    step : int

    Returns
    -------
    stencil : Stencil
    """
    n = int(_REACH)
    row, column = (a.ravel() for a in np.mgrid[-n : n + 1, -n : n + 1])
    inside = np.hypot(row, column) <= _REACH
    row, column = row[inside], column[inside]
    radius = np.hypot(row, column)
    distance = side * np.hypot(row[:, None] - row, column[:, None] - column)
    return Stencil(
        step,
        row,
        column,
        radius <= HOLE,
        radius <= _DISC,
        block_covariance(correlation, side, distance),
        block_covariance(local, side, distance),
        block_covariance(correlation, side, side * radius, 1),
        correlation.variance,
    )


def choose_stencil(
    correlation: NestedCorrelation, local: NestedCorrelation, finest: Blocks, wanted: float = _WANTED
) -> tuple[Stencil, float] | None:
    """
    Stencil with the largest hole whose surroundings still say most of the error in its middle.

    Parameters
    ----------
    correlation, local : NestedCorrelation
    finest : Blocks

    Returns
    -------
    stencil, left : Stencil, float
        And the part of the variance that its prediction leaves; None where errors cannot be predicted to any use, or
        the map is too small.

    Notes
    -----
    Change within the hole takes no part in the prediction of its middle, so a large hole is safe; a small one
    predicts better.
    """
    if not finest.usable.any():
        return None
    ratio = float(np.median(finest.ratio[finest.usable]))
    chosen: tuple[Stencil, float] | None = None
    step = 1
    while min(finest.mean.shape) >= _LEAST_BLOCKS * step:
        side = step * finest.side
        if side >= _LEAST_SIDE * local.ranges[0]:
            stencil = make_stencil(correlation, local, side, step)
            weights = _weights(stencil, ~stencil.hole, ratio)
            left = 1.0 - float(weights @ stencil.target[~stencil.hole]) / stencil.prior
            if chosen is None and left > _WORTHLESS:
                return None
            if chosen is None or left <= wanted:
                chosen = stencil, left
            else:
                break
        step = max(step + 1, math.floor(1.25 * step))
    return chosen


def predict_blocks(
    blocks: Blocks, stencil: Stencil, wanted: BoolArray | None = None, *, keep_hole: bool = True
) -> Prediction:
    """
    Predict the correlated errors at the centres of blocks.

    Parameters
    ----------
    blocks : Blocks
        Of the stencil's size.
    stencil : Stencil
    wanted : array, shape (n_rows, n_cols), bool, optional
        Where; everywhere by default.
    keep_hole : bool
        Leave the ground close by out; False predicts from all usable blocks.

    Returns
    -------
    prediction : Prediction
        With prior variance where it was not wanted.
    """
    shape = (blocks.mean.shape[0], blocks.mean.shape[1])
    places = np.arange(blocks.mean.size) if wanted is None else np.flatnonzero(wanted)
    mean = np.zeros(shape)
    variance = np.full(shape, stencil.prior)
    coherent: FloatArray = np.zeros((len(blocks.coherent), *shape))
    allowed: BoolArray = ~stencil.hole if keep_hole else stencil.hole | ~stencil.hole
    usable = _gathered_flags(blocks.usable, stencil, places) & allowed
    is_full = np.asarray((usable | ~allowed).all(axis=1))
    typical = float(np.median(blocks.ratio[blocks.usable])) if blocks.usable.any() else 1.0
    shared = np.zeros(stencil.hole.size)
    shared[allowed] = _weights(stencil, allowed, typical)
    flat_coherent = coherent.reshape(len(coherent), mean.size)
    for start in range(0, places.size, _BATCH):
        part = slice(start, start + _BATCH)
        batch, full = places[part], is_full[part]
        ratio = _gathered(blocks.ratio, stencil, batch)
        weights = np.tile(shared, (batch.size, 1))
        if not full.all():
            weights[~full] = _batch_weights(stencil, usable[part][~full], ratio[~full])
        mean.ravel()[batch] = np.einsum("ij,ij->i", weights, _gathered(blocks.mean, stencil, batch))
        variance.ravel()[batch] = _variance_left(stencil, weights, ratio)
        for column, result in zip(blocks.coherent, flat_coherent, strict=True):
            result[batch] = np.einsum("ij,ij->i", weights, _gathered(column, stencil, batch))
    return Prediction(mean, variance, coherent)


def disc_scores(blocks: Blocks, stencil: Stencil) -> FloatArray:
    """
    Mean of the disc about every block less its prediction from outside the hole, in standard deviations.

    Parameters
    ----------
    blocks : Blocks
    stencil : Stencil

    Returns
    -------
    score : array, shape (n_rows, n_cols)
        0 where too few blocks are usable.

    Notes
    -----
    The weights are those of ground without gaps; where blocks are missing they are not the best ones, but the
    variance is that of the weights used.
    """
    typical = float(np.median(blocks.ratio[blocks.usable])) if blocks.usable.any() else 1.0
    ring = ~stencil.hole
    covariance = stencil.correlated + typical * stencil.local
    inner = covariance[np.ix_(ring, stencil.disc)].mean(axis=1)
    weights = np.zeros(stencil.hole.size)
    weights[ring] = -np.linalg.solve(covariance[np.ix_(ring, ring)] + _RIDGE * np.eye(int(ring.sum())), inner)
    even = weights + np.where(stencil.disc, 1.0 / stencil.disc.sum(), 0.0)
    kernel = np.zeros((2 * int(_REACH) + 1,) * 2)
    kernel[stencil.row + int(_REACH), stencil.column + int(_REACH)] = even
    variance = float(even @ stencil.correlated @ even) + blocks.ratio * float(even @ stencil.local @ even)
    for column in blocks.coherent:
        variance = variance + correlate(column, kernel, mode="constant") ** 2
    score = correlate(blocks.mean, kernel, mode="constant") / np.sqrt(np.maximum(variance, 1e-300))
    neighbours = np.zeros(kernel.shape, bool)
    neighbours[stencil.row + int(_REACH), stencil.column + int(_REACH)] = True
    gaps = np.flatnonzero(~binary_erosion(blocks.usable, neighbours))
    for start in range(0, gaps.size, _BATCH):
        batch = gaps[start : start + _BATCH]
        score.ravel()[batch] = _scores_with_gaps(blocks, stencil, batch, weights)
    return np.asarray(score)


def _scores_with_gaps(blocks: Blocks, stencil: Stencil, places: IntArray, weights: FloatArray) -> FloatArray:
    """Scores of discs that lack blocks in themselves or around; weights are those of the blocks around."""
    usable = _gathered_flags(blocks.usable, stencil, places)
    in_disc = (usable & stencil.disc).sum(axis=1)
    each = np.where(usable, weights, 0.0)
    each += np.where(usable & stencil.disc, 1.0 / np.maximum(in_disc, 1)[:, None], 0.0)
    scaled = each * np.sqrt(_gathered(blocks.ratio, stencil, places))
    variance = np.einsum("ij,ij->i", each @ stencil.correlated, each)
    variance += np.einsum("ij,ij->i", scaled @ stencil.local, scaled)
    for column in blocks.coherent:
        variance += np.einsum("ij,ij->i", each, _gathered(column, stencil, places)) ** 2
    total = np.einsum("ij,ij->i", each, _gathered(blocks.mean, stencil, places))
    ring = ~stencil.hole
    enough = (3 * in_disc >= stencil.disc.sum()) & (3 * (usable & ring).sum(axis=1) >= ring.sum())
    return np.where(enough, total / np.sqrt(np.maximum(variance, 1e-300)), 0.0)


def _gathered_flags(flags: BoolArray, stencil: Stencil, places: IntArray) -> BoolArray:
    return np.asarray(_gathered(flags.astype(np.float64), stencil, places) > 0.0)


def _gathered(values: FloatArray, stencil: Stencil, places: IntArray) -> FloatArray:
    """Values at the stencil's blocks around places, shape (n_places, n); 0 beyond the map."""
    reach = int(_REACH)
    padded = np.pad(values, reach)
    row, column = places // values.shape[1] + reach, places % values.shape[1] + reach
    flat = (row * padded.shape[1] + column)[:, None] + stencil.row * padded.shape[1] + stencil.column
    return np.asarray(padded.ravel()[flat])


def _weights(stencil: Stencil, used: BoolArray, ratio: float) -> FloatArray:
    inside = np.ix_(used, used)
    covariance = stencil.correlated[inside] + ratio * stencil.local[inside]
    return np.asarray(np.linalg.solve(covariance + _RIDGE * np.eye(len(covariance)), stencil.target[used]), np.float64)


def _batch_weights(stencil: Stencil, used: BoolArray, ratio: FloatArray) -> FloatArray:
    """Weights of places that each have other blocks."""
    used &= (used.sum(axis=1) >= _LEAST_DATA)[:, None]
    weights = np.empty(used.shape)
    solve_stencils(stencil.correlated, stencil.local, stencil.target, used, ratio, _RIDGE, weights)
    return weights


def _variance_left(stencil: Stencil, weights: FloatArray, ratio: FloatArray) -> FloatArray:
    scaled = weights * np.sqrt(ratio)
    left = stencil.prior - 2.0 * weights @ stencil.target
    left += np.einsum("ij,ij->i", weights @ stencil.correlated, weights)
    left += np.einsum("ij,ij->i", scaled @ stencil.local, scaled)
    return np.clip(left, 1e-4 * stencil.prior, stencil.prior)
