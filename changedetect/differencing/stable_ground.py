"""Ground that did not change, found on a coarse raster as what no significant region covers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_dilation

from changedetect.differencing.clusters import find_clusters, normal_score, q_values, simulate_null
from changedetect.differencing.coarse import block_means

if TYPE_CHECKING:
    from changedetect.differencing.correlation import NestedCorrelation
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["find_changed"]

#: A coarse raster has at most about this many cells along a side.
_COARSE_CELLS = 400
#: Scores beyond which cells join into regions.
_THRESHOLD = 2.0
#: Regions of at most this false discovery rate count as changed.
_RATE = 0.10
#: ... and if this share of their cells has scores beyond this. Where errors are larger here and smaller there than the
#: model knows, weak coherent patches are errors; taken for change they would make the estimate of the errors smaller,
#: and more patches significant.
_STRONG = 3.0
_STRONG_SHARE = 0.2
#: Cells of the random fields that regions are compared with.
_SIMULATED_CELLS = 8e5
#: A coarse cell is known where this share of its cells is.
_LEAST_SHARE = 0.5


def find_changed(
    difference: FloatArray,
    variances: tuple[FloatArray, FloatArray],
    correlations: tuple[NestedCorrelation, NestedCorrelation],
    freedom: float,
    resolution: float,
    margin: float,
) -> BoolArray:
    """
    Cells in or close to regions whose change is significant as a whole.

    Parameters
    ----------
    difference : array, shape (n_rows, n_cols), m
        NaN where it is not known.
    variances : pair of array, shape (n_rows, n_cols), m2
        Of the independent and of the correlated errors.
    correlations : pair of NestedCorrelation
        Of these two.
    freedom : float
        Degrees of freedom of the errors' tails.
    resolution, margin : float, m
        The margin is what the estimator's kernel draws edges out by.

    Returns
    -------
    changed : array, bool
    """
    factor = max(1, math.ceil(max(difference.shape) / _COARSE_CELLS))
    known = np.isfinite(difference)
    side = factor * resolution
    mean, share = block_means(difference, known, factor)
    parts = [
        block_means(v, known, factor)[0] * c.mean_over_square(side) if c.ranges else np.zeros(mean.shape)
        for v, c in zip(variances, correlations, strict=True)
    ]
    total = parts[0] + parts[1]
    is_known = (share >= _LEAST_SHARE) & (total > 0.0)
    total = np.where(is_known, total, 1.0)
    score = np.where(is_known, normal_score(mean / np.sqrt(total), freedom), np.nan)
    shares = (np.sqrt(np.where(is_known, parts[0] / total, 0.0)), np.sqrt(np.where(is_known, parts[1] / total, 0.0)))
    rng = np.random.default_rng(20)
    null = simulate_null(shares, correlations, is_known, side, _THRESHOLD, rng, _SIMULATED_CELLS)
    clusters = find_clusters(score, _THRESHOLD)
    strong = np.bincount(clusters.labels[np.abs(np.nan_to_num(score)) > _STRONG], minlength=clusters.mass.size + 1)
    n_cells = np.bincount(clusters.labels.ravel(), minlength=clusters.mass.size + 1)
    significant = np.concatenate([[False], q_values(clusters.mass, null) <= _RATE])
    significant &= strong >= _STRONG_SHARE * n_cells
    changed = significant[clusters.labels]
    if margin > 0.0 and changed.any():
        changed = binary_dilation(changed, np.ones((3, 3), bool), iterations=max(1, round(margin / side)))
    whole = np.repeat(np.repeat(changed, factor, axis=0), factor, axis=1)
    return np.asarray(whole[: difference.shape[0], : difference.shape[1]], bool)
