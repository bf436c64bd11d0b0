"""Ordinary kriging from the nearest observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.spatial import cKDTree

from changedetect.models.comparators.base import LocalAnswer, PointModel
from changedetect.models.comparators.covariance import Covariance, Kernel, answer_from_moments, estimate_covariance
from changedetect.models.comparators.observations import Observations, nearest

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["NeighbourKriging"]


@dataclass(frozen=True, eq=False)
class _Neighbourhood:
    tree: cKDTree
    observations: Observations
    covariance: Covariance


@dataclass(kw_only=True, eq=False)
class NeighbourKriging(PointModel[_Neighbourhood]):
    """
    Ordinary kriging of the surface from the `n_neighbours` nearest observations, noise filtered out.

    Attributes
    ----------
    n_neighbours : int
    kernel : "matern32" or "rbf"
    n_blocks, block_size : int
        Subsample for the maximum-likelihood fit of the covariance; see `likelihood_blocks`.
    random_seed : int
        Of the subsample.
    max_points : int or None

    Notes
    -----
    With C the covariance of the neighbours including their noise, k that between the place and the neighbours and 1 a
    vector of ones, the unknown constant mean is mu = 1'C^-1 z / 1'C^-1 1, the surface mu + k'C^-1 (z - mu 1) and its
    variance k0 - k'C^-1 k + (1 - 1'C^-1 k)^2 / (1'C^-1 1) [1]_.

    References
    ----------
    .. [1] Cressie, N. (1993), Statistics for Spatial Data, section 3.2, doi:10.1002/9781119115151.
    """

    n_neighbours: int = 30
    kernel: Kernel = "matern32"
    n_blocks: int = 30
    block_size: int = 64
    random_seed: int = 0
    max_points: int | None = 5_000_000

    _block_size: ClassVar[int] = 4_000

    def _estimate(self, observations: Observations) -> dict[str, float]:
        return estimate_covariance(
            observations,
            self.kernel,
            random_seed=self.random_seed,
            n_blocks=self.n_blocks,
            block_size=self.block_size,
        ).to_parameters()

    def _prepare(self, observations: Observations, parameters: dict[str, float]) -> _Neighbourhood:
        covariance = Covariance.from_parameters(self.kernel, parameters)
        return _Neighbourhood(cKDTree(observations.positions), observations, covariance)

    def _answer(self, prepared: _Neighbourhood, easting: FloatArray, northing: FloatArray) -> LocalAnswer:
        observations, covariance = prepared.observations, prepared.covariance
        places = np.column_stack([easting, northing])
        n_neighbours = min(self.n_neighbours, len(observations))
        distance, members = nearest(prepared.tree, places, n_neighbours)
        positions = observations.positions[members]
        between = np.linalg.norm(positions[:, :, None, :] - positions[:, None, :, :], axis=-1)
        system = covariance.at_distance(between)
        diagonal = np.arange(n_neighbours)
        system[:, diagonal, diagonal] += covariance.nugget + observations.variance[members]
        to_place = covariance.at_distance(distance)
        known = np.stack([observations.elevation[members], to_place, np.ones_like(to_place)], axis=-1)
        solved = np.linalg.solve(system, known)
        precision = solved[:, :, 2].sum(axis=1)
        mean = solved[:, :, 0].sum(axis=1) / precision
        weight = solved[:, :, 1]
        elevation = mean + np.sum(weight * (observations.elevation[members] - mean[:, None]), axis=1)
        from_mean = (1.0 - weight.sum(axis=1)) ** 2 / precision
        variance = covariance.signal_variance - np.sum(weight * to_place, axis=1) + from_mean
        return answer_from_moments(covariance, elevation, variance, distance[:, 0], is_mean_known=False)
