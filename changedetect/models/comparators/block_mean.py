"""Mean of the observations in square blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.models.comparators.base import LocalAnswer, PointModel
from changedetect.models.comparators.observations import Observations, distance_to_kth

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, IntArray

__all__ = ["BlockMean"]

#: Strength of the pooled noise in a block's own estimate, in degrees of freedom.
_PRIOR_FREEDOM = 4.0


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Blocks in ascending order of `key`; corner and side in metres relative to the origin."""

    key: IntArray
    mean: FloatArray
    noise_variance: FloatArray
    count: FloatArray
    side: float


@dataclass(kw_only=True, eq=False)
class BlockMean(PointModel[_Blocks]):
    """
    The simplest raster: every square block answers with the weighted mean of its observations.

    Attributes
    ----------
    side : float or None, m
        Of a block; None takes the side that gives `points_per_block` at the median density.
    points_per_block : int
    max_points : int or None

    Notes
    -----
    The spread of the observations in a block estimates noise and relief together; with few observations it is drawn
    towards the pooled one, (4 pooled + sum of squares) / (4 + n - 1). Blocks without observation have no answer.
    Weights are 1 / sigma^2 where sigmas were given.
    """

    side: float | None = None
    points_per_block: int = 10
    max_points: int | None = None

    def _estimate(self, observations: Observations) -> dict[str, float]:
        if self.side is not None:
            if not self.side > 0.0:
                msg = f"The side of a block must be positive, in metres; got {self.side!r}."
                raise ValueError(msg)
            return {"side": float(self.side)}
        k = min(self.points_per_block, len(observations) - 1)
        disc = np.pi * distance_to_kth(observations.positions, k) ** 2
        return {"side": float(np.sqrt(disc * self.points_per_block / k))}

    def _prepare(self, observations: Observations, parameters: dict[str, float]) -> _Blocks:
        side = parameters["side"]
        key, label = np.unique(_block_key(observations.easting, observations.northing, side), return_inverse=True)
        weight = np.where(observations.variance > 0.0, 1.0 / np.maximum(observations.variance, 1e-12), 1.0)
        weight /= weight.mean()
        total, count = np.bincount(label, weight), np.bincount(label).astype(np.float64)
        mean = np.bincount(label, weight * observations.elevation) / total
        square = np.bincount(label, weight * (observations.elevation - mean[label]) ** 2)
        freedom = max(float(len(observations) - key.size), 1.0)
        pooled = float(square.sum()) / freedom
        noise_variance = (_PRIOR_FREEDOM * pooled + square) / (_PRIOR_FREEDOM + count - 1.0)
        n_effective = total**2 / np.bincount(label, weight**2)
        return _Blocks(key, mean, noise_variance, n_effective, side)

    def _answer(self, prepared: _Blocks, easting: FloatArray, northing: FloatArray) -> LocalAnswer:
        wanted = _block_key(easting, northing, prepared.side)
        place = np.minimum(np.searchsorted(prepared.key, wanted), prepared.key.size - 1)
        count = np.where(prepared.key[place] == wanted, prepared.count[place], 0.0)
        noise_variance = prepared.noise_variance[place]
        return LocalAnswer(
            elevation=prepared.mean[place],
            elevation_std=np.sqrt(noise_variance / np.maximum(count, 1.0)),
            noise_std=np.sqrt(noise_variance),
            n_effective=count,
        )


def _block_key(easting: FloatArray, northing: FloatArray, side: float) -> IntArray:
    """One number a block: its column in the upper and its row in the lower 32 bits."""
    column, row = np.floor(easting / side).astype(np.int64), np.floor(northing / side).astype(np.int64)
    return np.asarray(column * 2**32 + row)
