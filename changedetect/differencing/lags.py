"""Standardised differences of cells, and their products at lags: what correlations are estimated from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing.clusters import normal_score

if TYPE_CHECKING:
    from collections.abc import Callable

    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["CellScores", "PairProducts", "collect_pairs", "standardised_scores"]

#: Lags of the sampled products, evenly spaced in their logarithm, and pairs drawn for each.
_N_LAGS = 28
_N_PAIRS = 25_000
#: Fewer pairs than this say nothing about a lag.
_MINIMUM_PAIRS = 500
#: Scores count up to this limit, where the errors' tails are heavier than normal.
_SCORE_LIMIT = 4.0


@dataclass(frozen=True)
class CellScores:
    """
    Standardised differences of some cells; arrays of shape (n,).

    Attributes
    ----------
    score : array
        Difference over the standard deviation of all its errors.
    local, correlated : array
        Standard deviation of the independent and of the correlated errors over that of both together.
    counts : array, bool
        Whether the score is of a size that errors have.
    """

    score: FloatArray
    local: FloatArray
    correlated: FloatArray
    counts: BoolArray

    def counting(self) -> CellScores:
        """Return those that count."""
        c = self.counts
        return CellScores(self.score[c], self.local[c], self.correlated[c], c[c])


def standardised_scores(
    difference: FloatArray, variance: FloatArray, correlated: FloatArray | float, freedom: float
) -> CellScores:
    """
    Scores of some cells.

    Parameters
    ----------
    difference : array, shape (n,), m
    variance, correlated : array, shape (n,), m2
        Of the independent and of the correlated errors.
    freedom : float
        Degrees of freedom of the errors' tails.
    """
    total = variance + correlated
    score = difference / np.sqrt(total)
    counts = np.abs(normal_score(score, freedom)) < _SCORE_LIMIT
    return CellScores(score, np.sqrt(variance / total), np.sqrt(correlated / total), counts)


@dataclass(frozen=True)
class PairProducts:
    """
    Products and increments of standardised differences of cells a lag apart, and what they consist of.

    With y the standardised difference, a and b the parts of its standard deviation that are due to independent and to
    correlated errors.

    Attributes
    ----------
    distance : array, shape (n_lags,), m
    product : array, shape (n_lags,)
        Mean of y_i y_j.
    increment : array, shape (n_lags,)
        Mean of (y_i - y_j)^2 / 2.
    local, correlated : array, shape (n_lags,)
        Means of a_i a_j and of b_i b_j.
    local_square, correlated_square : array, shape (n_lags,)
        Means of (a_i^2 + a_j^2) / 2 and of (b_i^2 + b_j^2) / 2.
    """

    distance: FloatArray
    product: FloatArray
    increment: FloatArray
    local: FloatArray
    correlated: FloatArray
    local_square: FloatArray
    correlated_square: FloatArray

    @property
    def strength(self) -> float:
        """Mean of `correlated`; 1 where there is no pair, as on small rasters with scattered ground."""
        return float(np.mean(self.correlated)) if self.correlated.size else 1.0


def collect_pairs(
    at: Callable[[IntArray], CellScores], ground: BoolArray, resolution: float, rng: np.random.Generator
) -> PairProducts:
    """
    Sample pairs of cells at lags from one cell to half the extent, in random directions.

    Parameters
    ----------
    at : callable
        Gives the scores of cells, by their numbers row by row.
    ground : array, shape (n_rows, n_cols), bool
        Unchanged ground.
    resolution : float, m
    rng : Generator

    Returns
    -------
    pairs : PairProducts
        Lags with too few pairs are left out.
    """
    n_rows, n_cols = ground.shape
    places, flags = np.flatnonzero(ground), ground.ravel()
    rows: list[tuple[float, ...]] = []
    for lag in np.unique(np.rint(np.geomspace(1.0, max(0.5 * min(n_rows, n_cols), 2.0), _N_LAGS))):
        if places.size < _MINIMUM_PAIRS:
            break
        first = rng.choice(places, _N_PAIRS)
        angle = rng.uniform(0.0, 2.0 * math.pi, first.size)
        down = np.rint(lag * np.sin(angle)).astype(np.int64)
        right = np.rint(lag * np.cos(angle)).astype(np.int64)
        row, col = first // n_cols + down, first % n_cols + right
        inside = (row >= 0) & (row < n_rows) & (col >= 0) & (col < n_cols)
        second = np.where(inside, row * n_cols + col, 0)
        inside &= flags[second]
        here, there = at(first[inside]), at(second[inside])
        usable = here.counts & there.counts
        if np.count_nonzero(usable) < _MINIMUM_PAIRS:
            continue
        distance = float(np.mean(np.hypot(down[inside][usable], right[inside][usable])))
        (y, a, u), (z, b, v) = ((c.score[usable], c.local[usable], c.correlated[usable]) for c in (here, there))
        means = y * z, 0.5 * (y - z) ** 2, a * b, u * v, 0.5 * (a**2 + b**2), 0.5 * (u**2 + v**2)
        rows.append((distance * resolution, *(float(np.mean(values)) for values in means)))
    return PairProducts(*np.array(rows).reshape(-1, 7).T)
