"""Local Gaussian process regression after Nguyen-Tuong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from changedetect.models.comparators.base import LocalAnswer, PointModel
from changedetect.models.comparators.covariance import Covariance, Kernel, answer_from_moments, estimate_covariance
from changedetect.models.comparators.observations import Observations, distance_to_kth, nearest

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, IntArray

__all__ = ["LocalGPR"]


@dataclass(frozen=True, eq=False)
class _LocalModel:
    positions: FloatArray
    mean: float
    factor: FloatArray
    weights: FloatArray


@dataclass(frozen=True, eq=False)
class _LocalModels:
    centres: cKDTree
    models: tuple[_LocalModel, ...]
    width: float
    covariance: Covariance


@dataclass(kw_only=True, eq=False)
class LocalGPR(PointModel[_LocalModels]):
    """
    Many small Gaussian processes, each for the observations around its centre, blended by distance (LGPR [1]_).

    Attributes
    ----------
    points_per_model : int
        Aimed at, for the observations nearest to a centre; sets the distance of the centres from the density.
    overlap : float
        A model learns all observations within this many founding distances of its centre. 0 gives it only those
        nearest to it, as in the paper.
    generation_threshold : float, between 0 and 1
        An observation founds a new local model where all weights are at most this (w_gen).
    n_blended : int
        Nearest local models that answer together.
    kernel : "matern32" or "rbf"
    n_blocks, block_size : int
        Subsample for the maximum-likelihood fit of the covariance; see `likelihood_blocks`.
    random_seed : int
        Of the subsample and of the order in which observations found models.
    max_points : int or None

    Notes
    -----
    Weights are w_k = exp(-|x - c_k|^2 / (2 width^2)), eq. 3 of [1]_; the answer is sum w_k m_k / sum w_k over the
    nearest models, eq. 5. Its variance is that of the mixture, sum w_k (v_k + (m_k - m)^2) / sum w_k, its effective
    number of observations the weighted mean of theirs. The paper moves a centre to the mean of its points as they
    arrive and limits a model's size by removing points; here centres are found first, in random order, and each
    observation then belongs to the nearest one, and to all within reach of it where models overlap: a Gaussian process
    returns to its mean at the border of its points, which is where models are blended. A model without information
    about a place is not blended.

    References
    ----------
    .. [1] Nguyen-Tuong, D., Seeger, M. & Peters, J. (2009), Model learning with local Gaussian process regression,
       Advanced Robotics 23(15), doi:10.1163/016918609X12529286896877.
    """

    points_per_model: int = 30
    overlap: float = 1.6
    generation_threshold: float = 0.5
    n_blended: int = 3
    kernel: Kernel = "matern32"
    n_blocks: int = 30
    block_size: int = 64
    random_seed: int = 0
    max_points: int | None = 500_000

    _block_size: ClassVar[int] = 100_000

    def _estimate(self, observations: Observations) -> dict[str, float]:
        return estimate_covariance(
            observations,
            self.kernel,
            random_seed=self.random_seed,
            n_blocks=self.n_blocks,
            block_size=self.block_size,
        ).to_parameters()

    def _prepare(self, observations: Observations, parameters: dict[str, float]) -> _LocalModels:
        covariance = Covariance.from_parameters(self.kernel, parameters)
        positions = observations.positions
        radius = _founding_radius(positions, self.points_per_model)
        order = np.random.default_rng(self.random_seed).permutation(len(positions))
        founders = _founders(positions, order, radius)
        _, owner = cKDTree(positions[founders]).query(positions)
        count = np.bincount(owner)
        centres = np.column_stack([np.bincount(owner, axis) / count for axis in positions.T])
        if self.overlap > 0.0:
            within = cKDTree(positions).query_ball_point(centres, self.overlap * radius, return_sorted=True)
            members = [np.array(chosen, dtype=np.int64) for chosen in within]
        else:
            members = np.split(np.argsort(owner, kind="stable"), np.cumsum(count)[:-1])
        return _LocalModels(
            centres=cKDTree(centres),
            models=tuple(_local_model(observations, chosen, covariance) for chosen in members),
            width=radius / float(np.sqrt(-2.0 * np.log(self.generation_threshold))),
            covariance=covariance,
        )

    def _answer(self, prepared: _LocalModels, easting: FloatArray, northing: FloatArray) -> LocalAnswer:
        places = np.column_stack([easting, northing])
        n_blended = min(self.n_blended, len(prepared.models))
        distance, owner = nearest(prepared.centres, places, n_blended)
        # relative to the nearest centre: the ratio is the same, and nothing underflows far away
        weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / prepared.width**2)
        total, first, second, variance, n_effective = np.zeros((5, len(places)))
        by_model = np.argsort(owner, axis=None, kind="stable")
        ends = np.cumsum(np.bincount(owner.ravel(), minlength=len(prepared.models)))
        for model, asked in zip(prepared.models, np.split(by_model, ends[:-1]), strict=True):
            here, rank = np.divmod(asked, n_blended)
            local = _local_answer(model, places[here], prepared.covariance)
            share = np.where(local.n_effective > 0.0, weight[here, rank], 0.0)
            total[here] += share
            first[here] += share * local.elevation
            second[here] += share * local.elevation**2
            variance[here] += share * local.elevation_std**2
            n_effective[here] += share * local.n_effective
        norm = np.where(total > 0.0, total, 1.0)
        elevation = first / norm
        disagreement = np.maximum(second / norm - elevation**2, 0.0)
        return LocalAnswer(
            elevation=elevation,
            elevation_std=np.sqrt(variance / norm + disagreement),
            noise_std=np.full(elevation.shape, np.sqrt(prepared.covariance.noise_variance)),
            n_effective=n_effective / norm,
        )


def _founding_radius(positions: FloatArray, points_per_model: int) -> float:
    """
    Distance at which a new local model is founded, so that models hold about `points_per_model` points.

    Discs of diameter `radius` packed at random cover 0.547 of the ground at jamming, so centres no closer than
    `radius` own 0.547^-1 pi radius^2 / 4 each. Density is the median over the neighbourhoods of the points.
    """
    k = min(points_per_model, len(positions) - 1)
    density = k / (np.pi * distance_to_kth(positions, k) ** 2)
    return float(np.sqrt(4.0 * 0.547 * points_per_model / (np.pi * density)))


def _founders(positions: FloatArray, order: IntArray, radius: float) -> IntArray:
    """Go through the points in `order`; one founds a model where no founder lies within `radius`."""
    tree = cKDTree(positions)
    is_free = np.ones(len(positions), dtype=np.bool_)
    founders = []
    for candidate in order:
        if is_free[candidate]:
            founders.append(candidate)
            is_free[tree.query_ball_point(positions[candidate], radius)] = False
    return np.array(founders, dtype=np.int64)


def _local_model(observations: Observations, members: IntArray, covariance: Covariance) -> _LocalModel:
    positions, elevation = observations.positions[members], observations.elevation[members]
    system = covariance.between(positions, positions)
    system[np.diag_indices_from(system)] += covariance.nugget + observations.variance[members]
    factor = cholesky(system, lower=True)
    mean = float(elevation.mean())
    return _LocalModel(positions, mean, factor, cho_solve((factor, True), elevation - mean))


def _local_answer(model: _LocalModel, places: FloatArray, covariance: Covariance) -> LocalAnswer:
    distance = cdist(model.positions, places)
    cross = covariance.at_distance(distance)
    explained = np.sum(solve_triangular(model.factor, cross, lower=True) ** 2, axis=0)
    variance = covariance.signal_variance - explained
    return answer_from_moments(covariance, model.mean + model.weights @ cross, variance, distance.min(axis=0))
