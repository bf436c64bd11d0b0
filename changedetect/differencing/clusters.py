"""
Connected regions of conspicuous cells, judged against what correlated errors alone would give.

A region is worth its mass, the sum of what its scores exceed a threshold by. Random fields with the correlation of
the errors show how many regions of that mass ground without change has; the ratio to the number found is the false
discovery rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import label

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.differencing.correlation import NestedCorrelation
    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["Clusters", "NullClusters", "find_clusters", "normal_score", "q_values", "simulate_null"]

#: Random fields drawn: as many as this number of cells allows, within these limits.
_SIMULATED_CELLS = 2e6
_LEAST_FIELDS, _MOST_FIELDS = 2, 40
#: Share of the null masses, from the largest, that the tail is fitted to, and the least number of them.
_TAIL_SHARE = 0.1
_TAIL_COUNT = 20
#: Cells that share a side or a corner are connected.
_NEIGHBOURS = np.ones((3, 3), dtype=int)


@dataclass(frozen=True)
class Clusters:
    """
    Connected regions of one sign beyond a threshold.

    Attributes
    ----------
    labels : array, shape (n_rows, n_cols), int32
        Number of the region of each cell from 1; 0 outside all.
    sign : array, shape (n,), int8
        1 raised, -1 lowered.
    mass : array, shape (n,)
        Sum over the cells of |score| - threshold.
    """

    labels: NDArray[np.int32]
    sign: NDArray[np.int8]
    mass: FloatArray


@dataclass(frozen=True)
class NullClusters:
    """
    Regions that ground without change shows.

    Attributes
    ----------
    roots : array, shape (n,)
        Square roots of their masses, ascending.
    n_fields : int
        Random fields they were found in.
    """

    roots: FloatArray
    n_fields: int

    def expected(self, mass: FloatArray) -> FloatArray:
        """
        Expected number of regions of at least these masses on all the ground.

        Notes
        -----
        The excess of a peak of a random field over a high threshold is about exponential, and in two dimensions the
        extent grows with the excess, the mass with its square: the root of the mass is about exponential in its
        tail (Zhang, Nichols and Johnson 2009 [1]_). Beyond the largest tenth that law takes the place of the counts.

        References
        ----------
        .. [1] Zhang, Nichols, Johnson (2009), Cluster mass inference via random field theory, NeuroImage 44, 51-61.
        """
        n = self.roots.size
        if n == 0:
            return np.full(mass.shape, 1.0 / self.n_fields)
        root = np.sqrt(mass)
        n_tail = min(n, max(_TAIL_COUNT, round(_TAIL_SHARE * n)))
        tail = self.roots[n - n_tail :]
        scale = max(float(np.mean(tail - tail[0])), 1e-9)
        counted = n - np.searchsorted(self.roots, root, side="left").astype(np.float64)
        beyond = n_tail * np.exp(-(root - tail[0]) / scale)
        return np.where(root > tail[0], beyond, counted) / self.n_fields


def normal_score(score: FloatArray, freedom: FloatArray | float) -> FloatArray:
    """
    Normal scores of Student's t.

    Parameters
    ----------
    score : array
        Values of t; NaN stays.
    freedom : array or float
        Degrees of freedom.

    Returns
    -------
    scores : array
        Values of the standard normal distribution that are exceeded as rarely.

    Notes
    -----
    Wallace (1959) [1]_: g = (8 nu + 1) / (8 nu + 3) sqrt(nu log(1 + t^2 / nu)), within 0.04 for
    nu from 3 and |t| up to 6.

    References
    ----------
    .. [1] Wallace (1959), Bounds on normal approximations to Student's and the chi-square distributions, Annals of
       Mathematical Statistics 30, 1121-1130.
    """
    nu = np.minimum(freedom, 1e6)
    factor = (8.0 * nu + 1.0) / (8.0 * nu + 3.0)
    return np.asarray(np.copysign(factor * np.sqrt(nu * np.log1p(score**2 / nu)), score))


def find_clusters(score: FloatArray, threshold: float) -> Clusters:
    """
    Connected regions of a map of scores.

    Parameters
    ----------
    score : array, shape (n_rows, n_cols)
        NaN where nothing is known.
    threshold : float

    Returns
    -------
    clusters : Clusters
    """
    with np.errstate(invalid="ignore"):
        raised, n_raised = label(score > threshold, _NEIGHBOURS)
        lowered, n_lowered = label(score < -threshold, _NEIGHBOURS)
    labels = raised.astype(np.int32)
    below = lowered > 0
    labels[below] = lowered[below] + n_raised
    inside = labels > 0
    excess = np.abs(score[inside]) - threshold
    mass = np.bincount(labels[inside], excess, n_raised + n_lowered + 1)[1:].astype(np.float64)
    sign = np.repeat(np.array([1, -1], np.int8), [n_raised, n_lowered])
    return Clusters(labels, sign, mass)


def simulate_null(
    parts: tuple[FloatArray, FloatArray],
    correlations: tuple[NestedCorrelation, NestedCorrelation],
    known: BoolArray,
    resolution: float,
    threshold: float,
    rng: np.random.Generator,
    n_cells: float = _SIMULATED_CELLS,
) -> NullClusters:
    """
    Regions in random fields that have the correlation of the errors.

    Parameters
    ----------
    parts : pair of array, shape (n_rows, n_cols)
        Standard deviation of independent and of correlated errors over that of both together.
    correlations : pair of NestedCorrelation
        Of these two.
    known : array, bool
        Where the difference is known.
    resolution : float, m
    threshold : float
    rng : Generator
    n_cells : float
        Cells of all fields together, about; few fields of a large raster tell as much as many of a small one.
    """
    n_fields = int(np.clip(n_cells / known.size, _LEAST_FIELDS, _MOST_FIELDS))
    shape = (known.shape[0], known.shape[1])
    samplers = [c.sampler(shape, resolution) if c.ranges else None for c in correlations]
    roots: list[FloatArray] = []
    for _ in range(n_fields):
        field = np.zeros(known.shape)
        for part, draw in zip(parts, samplers, strict=True):
            if draw is not None:
                field += part * draw(rng)
        field[~known] = np.nan
        roots.append(np.sqrt(find_clusters(field, threshold).mass))
    return NullClusters(np.sort(np.concatenate(roots)), n_fields)


def q_values(mass: FloatArray, null: NullClusters) -> FloatArray:
    """
    Smallest false discovery rate at which each region counts as change.

    Parameters
    ----------
    mass : array, shape (n,)
    null : NullClusters

    Returns
    -------
    q : array, shape (n,)

    Notes
    -----
    Of the regions of at least this mass, the expected number without change over the number found (Storey 2002
    [1]_), made monotonic; all ground counts as unchanged in it, so the rate is an upper bound.

    References
    ----------
    .. [1] Storey (2002), A direct approach to false discovery rates, J. Royal Statistical Society B 64, 479-498.
    """
    order: IntArray = np.argsort(-mass, kind="stable")
    rate = null.expected(mass[order]) / np.arange(1.0, mass.size + 1.0)
    ordered = np.minimum(np.minimum.accumulate(rate[::-1])[::-1], 1.0)
    q = np.empty(mass.size)
    q[order] = ordered
    return q
