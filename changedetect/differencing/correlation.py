"""Spatial correlation of the errors of a difference: nested, isotropic, fast to integrate over areas."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import convolve1d
from scipy.optimize import nnls

if TYPE_CHECKING:
    from collections.abc import Callable

    from changedetect.differencing.lags import PairProducts
    from changedetect.typing import FloatArray

__all__ = ["NestedCorrelation", "fit_correlation"]

#: Ratio of neighbouring ranges of the bank that a correlation is composed of.
_RANGE_RATIO = math.sqrt(2.0)
#: Cells are summed into coarser ones as long as those stay below this part of a range.
_COARSE = 1.0 / 3.0
#: A Gaussian is cut off at this many ranges.
_CUT = 4.5
#: Shares of the variance below this are left out of a model.
_NEGLIGIBLE = 1e-3
#: Weight of the variance itself among the lags of the fit.
_WEIGHT_AT_ZERO = 3.0
#: Increments count by their relative error, which is taken as even below this value ...
_LEAST_INCREMENT = 0.01
#: ... and to grow with the lag beyond this part of the largest one.
_EVEN_LAGS = 0.2


@dataclass(frozen=True)
class NestedCorrelation:
    """
    A sum of Gaussian covariances, sum_k shares[k] exp(-r^2 / (2 ranges[k]^2)).

    Attributes
    ----------
    ranges : tuple of float, m
        Ascending.
    shares : tuple of float
        Variance of each part. One in total for a correlation; more where the tails of the errors are heavier than
        those of the scale they are measured in.

    Notes
    -----
    Every isotropic correlation that is valid in all dimensions is a mixture of Gaussians (Schoenberg 1938 [1]_), so
    with ranges in narrow steps nothing is lost by this form; and a Gaussian is separable, which makes sums over areas
    cheap.

    References
    ----------
    .. [1] Schoenberg (1938), Metric spaces and completely monotone functions, Annals of Mathematics 39, 811-841.

    Examples
    --------
    >>> correlation = NestedCorrelation((2.0, 30.0), (0.25, 0.75))
    >>> float(correlation(0.0))
    1.0
    """

    ranges: tuple[float, ...]
    shares: tuple[float, ...]

    def __call__(self, distance: FloatArray | float) -> FloatArray:
        """Covariance at a distance, m."""
        squared = np.asarray(distance, np.float64) ** 2
        total = np.zeros(squared.shape)
        for length, share in zip(self.ranges, self.shares, strict=True):
            total += share * np.exp(-0.5 * squared / length**2)
        return total

    @property
    def variance(self) -> float:
        """Sum of the shares."""
        return float(sum(self.shares))

    def normalised(self) -> NestedCorrelation:
        """Shares scaled to a sum of one; no parts at all stay none."""
        total = self.variance
        return NestedCorrelation(self.ranges, tuple(share / total for share in self.shares)) if total > 0.0 else self

    def squared_area(self) -> float:
        """
        Integral of the squared correlation over the plane, m2.

        Over an area A the variance of such errors is known as from A / squared_area independent values.
        """
        w, r2 = np.asarray(self.normalised().shares), np.asarray(self.ranges) ** 2
        return float(np.sum(np.outer(w, w) * 2.0 * math.pi * np.outer(r2, r2) / np.add.outer(r2, r2)))

    def mean_over_square(self, side: float) -> float:
        """Mean covariance of two random places in a square of this side, m; the variance of a block mean."""
        return float(sum(w * _line_mean(side / r) ** 2 for w, r in zip(self.shares, self.ranges, strict=True)))

    def variance_of_sum(self, weights: FloatArray, resolution: float) -> float:
        """
        Variance of a weighted sum over the cells of a raster.

        Parameters
        ----------
        weights : array, shape (n_rows, n_cols)
            Weight times standard deviation of each cell; 0 outside the area.
        resolution : float, m

        Returns
        -------
        variance : float
            sum_ij weights_i weights_j covariance(r_ij), for the price of a few short convolutions.
        """
        total = 0.0
        side, current = resolution, weights
        for length, share in sorted(zip(self.ranges, self.shares, strict=True)):
            while 2.0 * side <= _COARSE * length:
                current, side = _halved(current), 2.0 * side
            if share > 0.0:
                total += share * _quadratic_form(current, side, length)
        return max(total, 0.0)

    def sampler(self, shape: tuple[int, int], resolution: float) -> Callable[[np.random.Generator], FloatArray]:
        """
        Return what draws random fields of unit variance with this correlation.

        Parameters
        ----------
        shape : (n_rows, n_cols)
        resolution : float, m

        Returns
        -------
        draw : callable
            Takes a generator, gives an array of this shape. Fields are periodic over an extent that is larger by
            three ranges, as far as the shape allows.
        """
        margin = int(min(math.ceil(3.0 * max(self.ranges) / resolution), max(shape)))
        rows, cols = (next_fast_len(n + margin, real=True) for n in shape)
        k2 = np.add.outer(np.fft.fftfreq(rows) ** 2, np.fft.rfftfreq(cols) ** 2) / resolution**2
        spectrum = np.zeros(k2.shape)
        for length, share in zip(self.ranges, self.shares, strict=True):
            # below half a cell a Gaussian is white on this raster
            squared = max(length, 0.4 * resolution) ** 2
            spectrum += share * squared * np.exp(-2.0 * math.pi**2 * squared * k2)
        gain = np.sqrt(spectrum / _full_mean(spectrum, cols))

        def draw(rng: np.random.Generator) -> FloatArray:
            white = rfft2(rng.standard_normal((rows, cols)))
            return np.asarray(irfft2(white * gain, s=(rows, cols))[: shape[0], : shape[1]])

        return draw


def _full_mean(spectrum: FloatArray, n_columns: int) -> float:
    """Mean of a two-sided spectrum of which the half of the real transform is given."""
    weight = np.full(spectrum.shape[1], 2.0)
    weight[0] = 1.0
    if n_columns % 2 == 0:
        weight[-1] = 1.0
    return float(np.sum(spectrum @ weight) / (spectrum.shape[0] * n_columns))


def _line_mean(ratio: float) -> float:
    """Mean of exp(-(u - v)^2 / 2) over u and v in (0, ratio)."""
    if ratio < 1e-3:
        return 1.0
    erf = math.sqrt(0.5 * math.pi) * math.erf(ratio / math.sqrt(2.0))
    return 2.0 / ratio**2 * (ratio * erf + math.exp(-0.5 * ratio**2) - 1.0)


def _halved(weights: FloatArray) -> FloatArray:
    """Sums over two by two cells."""
    rows, cols = weights.shape
    padded = np.pad(weights, ((0, rows % 2), (0, cols % 2)))
    return np.asarray(padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2).sum(axis=(1, 3)))


def _quadratic_form(weights: FloatArray, side: float, length: float) -> float:
    """Sum over pairs of cells of w_i w_j exp(-r_ij^2 / (2 length^2))."""
    smoothed = weights
    for axis in (0, 1):
        reach = min(math.ceil(_CUT * length / side), weights.shape[axis] - 1)
        steps = np.arange(-reach, reach + 1) * (side / length)
        smoothed = convolve1d(smoothed, np.exp(-0.5 * steps**2), axis=axis, mode="constant")
    return float(np.sum(weights * smoothed))


def fit_correlation(
    pairs: PairProducts, local: NestedCorrelation, excess: float, shortest: float, longest: float
) -> NestedCorrelation:
    """
    Nested correlation of the correlated errors.

    Parameters
    ----------
    pairs : PairProducts
    local : NestedCorrelation
        Correlation of the independent errors, as the estimator's kernel makes it.
    excess : float
        Mean square of the standardised difference at lag zero, less the part of independent errors.
    shortest, longest : float, m
        Ranges to choose from.

    Returns
    -------
    correlation : NestedCorrelation
        Covariance in units of the squared scale of the correlated errors; no parts where there is nothing to explain.

    Notes
    -----
    E[y_i y_j] = a_i a_j local(r) + b_i b_j sum_k w_k exp(-r^2 / (2 r_k^2)) is linear in the shares w_k, which are
    found by non-negative least squares over a bank of ranges r_k. So is the mean increment, which at short lags is
    known far better than the products are: what the whole map shares cancels in it. How well errors can be predicted
    from the ground around is decided there.
    """
    n = max(1, math.floor(math.log(max(longest / shortest, 1.0)) / math.log(_RANGE_RATIO) + 1e-9) + 1)
    ranges = shortest * _RANGE_RATIO ** np.arange(n)
    gaussians = np.exp(-0.5 * (pairs.distance[:, None] / ranges) ** 2)
    at_lag = local(pairs.distance)
    products = gaussians * pairs.correlated[:, None]
    increments = pairs.correlated_square[:, None] - products
    increment_left = pairs.increment - (pairs.local_square - pairs.local * at_lag)
    weight = 1.0 / np.maximum(pairs.increment, _LEAST_INCREMENT)
    if pairs.distance.size:
        weight /= 1.0 + pairs.distance / (_EVEN_LAGS * pairs.distance[-1])
    design = np.vstack([products, increments * weight[:, None], np.full((1, n), _WEIGHT_AT_ZERO * pairs.strength)])
    wanted = np.concatenate([pairs.product - pairs.local * at_lag, increment_left * weight, [_WEIGHT_AT_ZERO * excess]])
    shares, _ = nnls(design, wanted)
    kept = shares > _NEGLIGIBLE * max(float(shares.sum()), 1e-12)
    return NestedCorrelation(tuple(ranges[kept].tolist()), tuple(shares[kept].tolist()))
