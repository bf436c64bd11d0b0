"""Sparse Gaussian process regression with inducing points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial import cKDTree

from changedetect.models.comparators.base import LocalAnswer, PointModel
from changedetect.models.comparators.covariance import Covariance, Kernel, answer_from_moments, estimate_covariance
from changedetect.models.comparators.observations import Observations, nearest

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, IntArray

__all__ = ["SparseGPR", "inducing_points"]

#: Observations projected at once: bounds memory at this times the number of inducing points.
_PROJECTION_BLOCK = 8_192
#: Cells do not get smaller than this where positions repeat, m.
_FINEST_CELL = 1e-4


@dataclass(frozen=True, eq=False)
class _InducingPosterior:
    positions: FloatArray
    prior_factor: FloatArray
    posterior_factor: FloatArray
    weights: FloatArray
    tree: cKDTree
    covariance: Covariance


@dataclass(kw_only=True, eq=False)
class SparseGPR(PointModel[_InducingPosterior]):
    """
    Gaussian process seen through `n_inducing` places; cost grows linearly with the observations.

    Attributes
    ----------
    n_inducing : int
        Aimed at; spread evenly over the ground that was observed.
    approximation : "fitc" or "sgpr"
        FITC [1]_ counts the part of each observation that the inducing points cannot explain as its own noise; SGPR
        [2]_ (with the predictive equations of DTC) does not.
    kernel : "matern32" or "rbf"
    n_blocks, block_size : int
        Subsample for the maximum-likelihood fit of the covariance; see `likelihood_blocks`.
    random_seed : int
        Of the subsample.
    max_points : int or None

    Notes
    -----
    With Kuu = L L', V = L^-1 Kuf, Lambda the diagonal noise and B = I + V Lambda^-1 V', the posterior at x is
    v' B^-1 V Lambda^-1 z with v = L^-1 k(u, x), and its variance k0 - v'v + v' B^-1 v. Unified view: [3]_.

    References
    ----------
    .. [1] Snelson, E. & Ghahramani, Z. (2006), Sparse Gaussian processes using pseudo-inputs, NIPS 18.
    .. [2] Titsias, M. (2009), Variational learning of inducing variables in sparse Gaussian processes, AISTATS, PMLR 5.
    .. [3] Quinonero-Candela, J. & Rasmussen, C. E. (2005), A unifying view of sparse approximate Gaussian process
       regression, JMLR 6.
    """

    n_inducing: int = 600
    approximation: Literal["fitc", "sgpr"] = "fitc"
    kernel: Kernel = "matern32"
    n_blocks: int = 1
    block_size: int = 500
    random_seed: int = 0
    max_points: int | None = 1_000_000

    _block_size: ClassVar[int] = 8_192

    def _estimate(self, observations: Observations) -> dict[str, float]:
        return estimate_covariance(
            observations,
            self.kernel,
            random_seed=self.random_seed,
            n_blocks=self.n_blocks,
            block_size=self.block_size,
        ).to_parameters()

    def _prepare(self, observations: Observations, parameters: dict[str, float]) -> _InducingPosterior:
        covariance = Covariance.from_parameters(self.kernel, parameters)
        inducing = inducing_points(observations.positions, self.n_inducing)
        prior = covariance.between(inducing, inducing)
        prior[np.diag_indices_from(prior)] += 1e-8 * covariance.signal_variance
        prior_factor = cholesky(prior, lower=True)
        precision = np.eye(len(inducing))
        projected = np.zeros(len(inducing))
        for first in range(0, len(observations), _PROJECTION_BLOCK):
            block = slice(first, first + _PROJECTION_BLOCK)
            cross = covariance.between(inducing, observations.positions[block])
            basis = solve_triangular(prior_factor, cross, lower=True)
            noise = covariance.nugget + observations.variance[block]
            if self.approximation == "fitc":
                noise = noise + np.maximum(covariance.signal_variance - np.sum(basis**2, axis=0), 0.0)
            precision += (basis / noise) @ basis.T
            projected += basis @ (observations.elevation[block] / noise)
        posterior_factor = cholesky(precision, lower=True)
        weights = solve_triangular(posterior_factor, projected, lower=True)
        tree = cKDTree(observations.positions)
        return _InducingPosterior(inducing, prior_factor, posterior_factor, weights, tree, covariance)

    def _answer(self, prepared: _InducingPosterior, easting: FloatArray, northing: FloatArray) -> LocalAnswer:
        covariance = prepared.covariance
        places = np.column_stack([easting, northing])
        cross = covariance.between(prepared.positions, places)
        basis = solve_triangular(prepared.prior_factor, cross, lower=True)
        reduced = solve_triangular(prepared.posterior_factor, basis, lower=True)
        variance = covariance.signal_variance - np.sum(basis**2, axis=0) + np.sum(reduced**2, axis=0)
        distance, _ = nearest(prepared.tree, places, 1)
        return answer_from_moments(covariance, prepared.weights @ reduced, variance, distance[:, 0])


def inducing_points(positions: FloatArray, n_inducing: int) -> FloatArray:
    """
    Choose about `n_inducing` of the observed positions, spread evenly over the ground they cover.

    Parameters
    ----------
    positions : array, shape (n, 2), m
    n_inducing : int
        All positions are taken where there are no more.

    Returns
    -------
    inducing : array, shape (about n_inducing, 2), m

    Notes
    -----
    Square cells, made smaller until enough of them hold observations; of each the one nearest the cell's mean.
    """
    if len(positions) <= n_inducing:
        return np.asarray(np.unique(positions, axis=0))
    corner = positions.min(axis=0)
    side = float(np.ptp(positions, axis=0).max()) / np.sqrt(n_inducing)
    label = _cell_labels(positions - corner, side)
    while label.max() + 1 < 0.95 * n_inducing and side > _FINEST_CELL:
        side *= 0.95
        label = _cell_labels(positions - corner, side)
    count = np.bincount(label)
    middle = np.column_stack([np.bincount(label, axis) / count for axis in positions.T])
    from_middle = np.sum((positions - middle[label]) ** 2, axis=1)
    order = np.lexsort((from_middle, label))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    return np.asarray(positions[order[first]])


def _cell_labels(positions: FloatArray, side: float) -> IntArray:
    """Number the occupied square cells and say which one each position lies in."""
    cell = np.floor(positions / side).astype(np.int64)
    _, label = np.unique(cell[:, 0] * 2**32 + cell[:, 1], return_inverse=True)
    return np.asarray(label, dtype=np.int64)
