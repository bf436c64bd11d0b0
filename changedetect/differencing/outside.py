"""The correlated error of sums over an area as the ground outside the area tells it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import distance_transform_edt

from changedetect.differencing.blocks import block_covariance
from changedetect.differencing.coarse import block_sums

if TYPE_CHECKING:
    from changedetect.differencing.blocks import Blocks
    from changedetect.differencing.correlation import NestedCorrelation
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["OutsideGround", "SumPrediction"]

#: Blocks outside within this many sides of the area take part ...
_REACH = 4.5
#: ... at most so many; where there are more, blocks are made larger.
_MOST_BLOCKS = 250
#: Blocks of the area itself, at most.
_MOST_PARTS = 1500
#: Sides of a block, in ranges of the independent errors: those of neighbouring blocks are nearly others.
_LEAST_SIDE = 1.5
#: Part of the variance added to the diagonal, against rounding.
_RIDGE = 1e-6


@dataclass(frozen=True)
class SumPrediction:
    """
    Prediction of a weighted sum of standardised correlated errors.

    Attributes
    ----------
    mean : float
    share_left : float
        Part of the sum's variance that is left, 0 to 1.
    coherent : array, shape (k,)
        Prediction of the sum of each coherent error.
    """

    mean: float
    share_left: float
    coherent: FloatArray


class OutsideGround:
    """
    Blocks around an area, ready to predict sums over it.

    Parameters
    ----------
    data : Blocks
        Finest blocks of unchanged ground.
    area : array, bool, shape of the finest blocks
        Takes no part.
    correlations : pair of NestedCorrelation
        Of the independent errors and, as a correlation, of the correlated ones.

    Notes
    -----
    Simple kriging of block means: with K their covariance, c theirs with the sum and q the sum's variance, the
    prediction is c'K^-1 y and leaves 1 - c'K^-1 c / q of the variance. Any choice of blocks is valid; those near by
    matter.
    """

    def __init__(
        self, data: Blocks, area: BoolArray, correlations: tuple[NestedCorrelation, NestedCorrelation]
    ) -> None:
        local, self._correlation = correlations
        self._window = _window(area, data, local.ranges[0])
        self.step, blocks, parts = self._chosen(data, area, local.ranges[0])
        self._side = blocks.side
        self._parts = np.argwhere(parts).astype(np.float64)
        distance = distance_transform_edt(~parts) if parts.any() else np.full(parts.shape, math.inf)
        chosen = blocks.usable & ~parts & (distance <= _REACH)
        self._places = np.argwhere(chosen).astype(np.float64)
        self._mean, self._coherent = blocks.mean[chosen], blocks.coherent[:, chosen]
        self._factor = None
        if len(self._places):
            lag = self._side * _distances(self._places, self._places)
            root = np.sqrt(blocks.ratio[chosen])
            covariance = block_covariance(self._correlation, self._side, lag)
            covariance += root[:, None] * root * block_covariance(local, self._side, lag)
            self._factor = cho_factor(covariance + _RIDGE * np.eye(len(root)))

    def _chosen(self, data: Blocks, area: BoolArray, local_range: float) -> tuple[int, Blocks, BoolArray]:
        """Size of the blocks, the blocks about the area, and those that hold parts of it."""
        rows, cols = self._window
        part = data.without(area).window(rows, cols)
        inside = area[rows, cols]
        step = max(1, math.ceil(_LEAST_SIDE * local_range / data.side))
        while True:
            blocks, parts = part.coarser(step), block_sums(inside.astype(np.float64), step) > 0.0
            near = blocks.usable & ~parts & (distance_transform_edt(~parts) <= _REACH)
            if step >= max(inside.shape) or (
                np.count_nonzero(near) <= _MOST_BLOCKS and np.count_nonzero(parts) <= _MOST_PARTS
            ):
                return step, blocks, parts
            step = max(step + 1, math.floor(1.3 * step))

    def predict(self, weights: FloatArray) -> SumPrediction:
        """
        Predict a sum over the area.

        Parameters
        ----------
        weights : array, shape of the finest blocks
            Of the standardised error of each block; zero outside the area.

        Returns
        -------
        prediction : SumPrediction
        """
        if self._factor is None:
            return SumPrediction(0.0, 1.0, np.zeros(len(self._coherent)))
        rows, cols = self._window
        index = self._parts.astype(np.int64)
        w = block_sums(weights[rows, cols], self.step)[index[:, 0], index[:, 1]]
        inner = block_covariance(self._correlation, self._side, self._side * _distances(self._parts, self._parts))
        outer = block_covariance(self._correlation, self._side, self._side * _distances(self._places, self._parts))
        prior, target = float(w @ inner @ w), outer @ w
        if not prior > 0.0:
            return SumPrediction(0.0, 1.0, np.zeros(len(self._coherent)))
        gain = cho_solve(self._factor, target)
        left = 1.0 - float(gain @ target) / prior
        return SumPrediction(float(gain @ self._mean), float(np.clip(left, 1e-3, 1.0)), self._coherent @ gain)


def _window(area: BoolArray, data: Blocks, local_range: float) -> tuple[slice, slice]:
    """Rows and columns about the area: as wide again as the area itself to every side, and some blocks more."""
    slices = []
    for axis in (0, 1):
        used = np.flatnonzero(area.any(axis=1 - axis))
        if used.size == 0:
            return slice(0, 1), slice(0, 1)
        margin = int(used[-1] - used[0]) + math.ceil(2.0 * _REACH * _LEAST_SIDE * local_range / data.side) + 20
        slices.append(slice(max(0, int(used[0]) - margin), int(used[-1]) + margin + 1))
    return slices[0], slices[1]


def _distances(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.hypot(first[:, None, 0] - second[:, 0], first[:, None, 1] - second[:, 1])
