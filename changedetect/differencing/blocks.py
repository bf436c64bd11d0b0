"""Standardised differences as means over square blocks of cells, and correlations between such means."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing.coarse import block_means, block_sums

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.differencing.correlation import NestedCorrelation
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["Blocks", "block_covariance", "expand", "interpolate", "standardise"]

#: The finest blocks number at most about this many along a side of the map.
_FINEST_BLOCKS = 500
#: A block is data where this share of its cells is.
_LEAST_SHARE = 0.5
#: Means of blocks count up to this many standard deviations of a cell: change that was not found must not be passed
#: on to the ground around it.
_LARGEST_MEAN = 4.0


@dataclass(frozen=True)
class Blocks:
    """
    Block means of a difference over the scale of its correlated errors.

    Attributes
    ----------
    factor : int
        Cells along the side of a block.
    side : float, m
    mean : array, shape (n_rows, n_cols)
        Standardised difference; 0 where nothing is known.
    ratio : array, shape (n_rows, n_cols)
        Variance of the independent errors of a cell over that of the correlated ones, on the average.
    share : array, shape (n_rows, n_cols)
        Part of the block's cells that is data.
    coherent : array, shape (k, n_rows, n_cols)
        Standardised errors of one standard deviation of each of k uncorrelated parameters that the map shares.
    """

    factor: int
    side: float
    mean: FloatArray
    ratio: FloatArray
    share: FloatArray
    coherent: FloatArray

    @property
    def usable(self) -> BoolArray:
        """Blocks that are data, shape (n_rows, n_cols)."""
        return np.asarray(self.share >= _LEAST_SHARE)

    def without(self, excluded: BoolArray) -> Blocks:
        """Take ground out; `excluded` has the shape of the blocks."""
        return Blocks(self.factor, self.side, self.mean, self.ratio, np.where(excluded, 0.0, self.share), self.coherent)

    def window(self, rows: slice, cols: slice) -> Blocks:
        """Blocks of some rows and columns."""
        part = (rows, cols)
        return Blocks(
            self.factor, self.side, self.mean[part], self.ratio[part], self.share[part], self.coherent[:, rows, cols]
        )

    def coarser(self, factor: int) -> Blocks:
        """Blocks of `factor` times `factor` of these, each counting for its share."""
        if factor == 1:
            return self
        total = block_sums(self.share, factor)
        weight = np.maximum(total, 1e-12)
        mean, ratio = (block_sums(self.share * values, factor) / weight for values in (self.mean, self.ratio))
        limit = _LARGEST_MEAN * np.sqrt(1.0 + ratio)
        coherent = [block_sums(self.share * column, factor) / weight for column in self.coherent]
        return Blocks(
            self.factor * factor,
            self.side * factor,
            np.clip(mean, -limit, limit),
            ratio,
            total / factor**2,
            np.array(coherent).reshape(len(coherent), *mean.shape),
        )


def standardise(
    difference: FloatArray,
    variances: tuple[FloatArray, FloatArray],
    ground: BoolArray,
    resolution: float,
    coherent: Sequence[FloatArray] = (),
) -> Blocks:
    """
    Finest block means of a difference.

    Parameters
    ----------
    difference : array, shape (n_rows, n_cols), m
    variances : pair of array, shape (n_rows, n_cols), m2
        Of the independent and of the correlated errors; the latter above zero.
    ground : array, bool
        Cells that are data.
    resolution : float, m
    coherent : sequence of array, shape (n_rows, n_cols), m
        Errors of one standard deviation of each parameter that the map shares.

    Returns
    -------
    blocks : Blocks
        Single cells on maps of up to 500 x 500.
    """
    factor = max(1, math.ceil(max(difference.shape) / _FINEST_BLOCKS))
    scale = np.sqrt(variances[1])
    mean, share = block_means(difference / scale, ground, factor)
    ratio, _ = block_means(variances[0] / variances[1], ground, factor)
    mean, ratio = np.nan_to_num(mean), np.nan_to_num(ratio)
    limit = _LARGEST_MEAN * np.sqrt(1.0 + ratio)
    columns = [np.nan_to_num(block_means(column / scale, ground, factor)[0]) for column in coherent]
    return Blocks(
        factor,
        factor * resolution,
        np.clip(mean, -limit, limit),
        ratio,
        share,
        np.array(columns).reshape(len(columns), *mean.shape),
    )


def block_covariance(
    correlation: NestedCorrelation, side: float, distance: FloatArray, n_blocks: int = 2
) -> FloatArray:
    """
    Covariance between means over two blocks, or between a block and a place.

    Parameters
    ----------
    correlation : NestedCorrelation
    side : float, m
        Of the blocks.
    distance : array, m
        Between their centres.
    n_blocks : {2, 1}
        1: the other is a place.

    Returns
    -------
    covariance : array

    Notes
    -----
    The mean over a square of side b convolves a Gaussian of range R with a box of variance b^2 / 12 along each axis;
    the result is taken for the Gaussian of range sqrt(R^2 + n b^2 / 12). A block with itself has at least the mean over
    its square.
    """
    squared = np.asarray(distance, np.float64) ** 2
    total = np.zeros(squared.shape)
    for length, share in zip(correlation.ranges, correlation.shares, strict=True):
        wide = length**2 + n_blocks * side**2 / 12.0
        total += share * length**2 / wide * np.exp(-0.5 * squared / wide)
    # never less than the Gaussians, so that the matrix of all blocks stays positive definite
    if n_blocks == 1:
        return total
    return np.where(squared == 0.0, np.maximum(correlation.mean_over_square(side), total), total)


def interpolate(values: FloatArray, factor: int, shape: tuple[int, int]) -> FloatArray:
    """
    Bilinear interpolation from the centres of blocks to cells.

    Parameters
    ----------
    values : array, shape (ceil(n_rows / factor), ceil(n_cols / factor))
    factor : int
    shape : (n_rows, n_cols)

    Returns
    -------
    cells : array, shape (n_rows, n_cols)
    """
    result = values
    for axis, n in enumerate(shape):
        place = np.clip((np.arange(n) + 0.5) / factor - 0.5, 0.0, values.shape[axis] - 1.0)
        first = np.minimum(place.astype(np.int64), max(values.shape[axis] - 2, 0))
        second = np.minimum(first + 1, values.shape[axis] - 1)
        part = (place - first).reshape((-1, 1) if axis == 0 else (1, -1))
        result = (1.0 - part) * np.take(result, first, axis) + part * np.take(result, second, axis)
    return result


def expand(blocks: BoolArray, factor: int, shape: tuple[int, int]) -> BoolArray:
    """
    Give every cell what its block has.

    Parameters
    ----------
    blocks : array, bool
    factor : int
    shape : (n_rows, n_cols)

    Returns
    -------
    cells : array, shape (n_rows, n_cols), bool
    """
    if factor == 1:
        return blocks[: shape[0], : shape[1]]
    return np.asarray(np.repeat(np.repeat(blocks, factor, axis=0), factor, axis=1)[: shape[0], : shape[1]])
