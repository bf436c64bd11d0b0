"""Covariance functions of Gaussian-process surfaces and their maximum-likelihood fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from changedetect.models.comparators.base import LocalAnswer
from changedetect.models.comparators.observations import Observations, nearest

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = [
    "Covariance",
    "Kernel",
    "answer_from_moments",
    "estimate_covariance",
    "likelihood_blocks",
    "negative_log_likelihood",
]

Kernel: TypeAlias = Literal["rbf", "matern32"]

_SQRT3 = float(np.sqrt(3.0))
#: Added to the diagonal, relative to the signal: smooth covariances of close points are singular to rounding.
_JITTER = 1e-9
#: Where the observations leave more than this part of the prior variance they are taken to say nothing.
_UNSUPPORTED_SHARE = 0.999


@dataclass(frozen=True)
class Covariance:
    """
    Isotropic covariance of a surface, and the noise of an observation of it.

    Attributes
    ----------
    kernel : "rbf" or "matern32"
    signal_variance : float, m2
    length_scale : float, m
    nugget : float, m2
        Noise variance beyond the sigmas given.
    mean_variance : float, m2
        Mean of the squared sigmas given; 0 where there were none.
    """

    kernel: Kernel
    signal_variance: float
    length_scale: float
    nugget: float
    mean_variance: float = 0.0

    @classmethod
    def from_parameters(cls, kernel: Kernel, parameters: dict[str, float]) -> Covariance:
        """Build from what `to_parameters` returned."""
        return cls(kernel, **parameters)

    def to_parameters(self) -> dict[str, float]:
        """Return the numbers by name."""
        return {
            "signal_variance": self.signal_variance,
            "length_scale": self.length_scale,
            "nugget": self.nugget,
            "mean_variance": self.mean_variance,
        }

    @property
    def noise_variance(self) -> float:
        """Variance of one typical observation about the surface, m2."""
        return self.nugget + self.mean_variance

    def between(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariance of the surface at two sets of positions, shapes (n, 2) and (m, 2), as (n, m), m2."""
        return self.at_distance(cdist(first, second))

    def at_distance(self, distance: FloatArray) -> FloatArray:
        """Covariance of the surface at places `distance` m apart, m2."""
        return self.signal_variance * _correlation(self.kernel, distance / self.length_scale)


def _correlation(kernel: Kernel, scaled_distance: FloatArray) -> FloatArray:
    """Rasmussen & Williams (2006), eqs 4.9 (rbf) and 4.17 (Matern, nu = 3/2)."""
    if kernel == "rbf":
        return np.asarray(np.exp(-0.5 * scaled_distance**2))
    a = _SQRT3 * scaled_distance
    return np.asarray((1.0 + a) * np.exp(-a))


def _correlation_slope(kernel: Kernel, scaled_distance: FloatArray) -> FloatArray:
    """Derivative of the correlation with the logarithm of the length scale."""
    if kernel == "rbf":
        return np.asarray(scaled_distance**2 * np.exp(-0.5 * scaled_distance**2))
    a = _SQRT3 * scaled_distance
    return np.asarray(a**2 * np.exp(-a))


def likelihood_blocks(
    observations: Observations, rng: np.random.Generator, *, n_blocks: int, block_size: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Draw a subsample in blocks: random points, each with its nearest neighbours.

    Parameters
    ----------
    observations : Observations
    rng : numpy.random.Generator
    n_blocks, block_size : int
        One block of the whole size is a plain random subsample.

    Returns
    -------
    distance : array, shape (n_blocks, block_size, block_size), m
        Between the observations of a block.
    elevation : array, shape (n_blocks, block_size), m
    variance : array, shape (n_blocks, block_size), m2

    Notes
    -----
    A few hundred points scattered over a site of many thousands lie too far apart to tell noise from detail. Blocks
    of neighbours see both; their likelihoods are summed as if independent, a composite likelihood [1]_.

    References
    ----------
    .. [1] Varin, C., Reid, N. & Firth, D. (2011), An overview of composite likelihood methods, Statistica Sinica 21.
    """
    n_points = len(observations)
    block_size = min(block_size, n_points)
    if n_blocks == 1:
        members = np.sort(rng.choice(n_points, block_size, replace=False))[None]
    else:
        seeds = rng.choice(n_points, min(n_blocks, n_points), replace=False)
        _, members = nearest(cKDTree(observations.positions), observations.positions[seeds], block_size)
    distance = np.stack([cdist(block, block) for block in observations.positions[members]])
    return distance, observations.elevation[members], observations.variance[members]


def negative_log_likelihood(
    log_parameters: FloatArray, kernel: Kernel, distance: FloatArray, elevation: FloatArray, variance: FloatArray
) -> tuple[float, FloatArray]:
    """
    Negative log likelihood of blocks of observations and its gradient, each block with its own constant mean.

    Parameters
    ----------
    log_parameters : array, shape (3,)
        Natural logarithms of signal variance (m2), length scale (m) and nugget (m2).
    kernel : "rbf" or "matern32"
    distance : array, shape (n_blocks, n, n), m
    elevation : array, shape (n_blocks, n), m
    variance : array, shape (n_blocks, n), m2
        Known part of the noise.

    Returns
    -------
    value : float
    gradient : array, shape (3,)

    Notes
    -----
    Rasmussen & Williams (2006), eqs 2.30 and 5.9. The mean maximises the likelihood (generalised least squares), so
    the gradient needs no term for it.
    """
    signal, length, nugget = np.exp(log_parameters)
    scaled = distance / length
    correlation = signal * _correlation(kernel, scaled)
    diagonal = np.arange(distance.shape[1])
    correlation[:, diagonal, diagonal] *= 1.0 + _JITTER
    covariance = correlation.copy()
    covariance[:, diagonal, diagonal] += nugget + variance
    factor = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(covariance)
    mean = np.einsum("bij,bj->b", inverse, elevation) / inverse.sum(axis=(1, 2))
    residual = elevation - mean[:, None]
    alpha = np.einsum("bij,bj->bi", inverse, residual)
    log_determinant = 2.0 * np.log(factor[:, diagonal, diagonal]).sum()
    value = 0.5 * (np.sum(residual * alpha) + log_determinant + residual.size * np.log(2.0 * np.pi))
    inner = inverse - alpha[:, :, None] * alpha[:, None, :]
    gradient = 0.5 * np.array(
        [
            np.sum(inner * correlation),
            np.sum(inner * signal * _correlation_slope(kernel, scaled)),
            nugget * np.sum(inner[:, diagonal, diagonal]),
        ]
    )
    return float(value), gradient


def estimate_covariance(
    observations: Observations, kernel: Kernel, *, random_seed: int, n_blocks: int, block_size: int
) -> Covariance:
    """
    Fit signal variance, length scale and nugget by maximum likelihood on a subsample.

    Parameters
    ----------
    observations : Observations
    kernel : "rbf" or "matern32"
    random_seed : int
    n_blocks, block_size : int
        See `likelihood_blocks`.

    Returns
    -------
    covariance : Covariance

    Raises
    ------
    ValueError
        All points lie at one place.
    """
    rng = np.random.default_rng(random_seed)
    blocks = likelihood_blocks(observations, rng, n_blocks=n_blocks, block_size=block_size)
    extent = float(max(np.ptp(observations.easting), np.ptp(observations.northing)))
    if extent == 0.0:
        msg = "All points lie at one place; a covariance cannot be fitted."
        raise ValueError(msg)
    spacing = extent / np.sqrt(len(observations))
    relief = max(float(observations.elevation.var()), 1e-8)
    # wider bounds let flat ground run away to lengths at which everything is extrapolation
    ranges = [(1e-4 * relief, 100.0 * relief), (0.2 * spacing, 2.0 * extent), (1e-8 * relief, 10.0 * relief)]
    bounds = Bounds(*np.log(ranges).T)
    starts = [(relief, scale, 0.05 * relief) for scale in (4.0 * spacing, np.sqrt(spacing * extent), 0.3 * extent)]
    fits = [
        minimize(
            negative_log_likelihood,
            np.clip(np.log(start), bounds.lb, bounds.ub),
            args=(kernel, *blocks),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 60},
        )
        for start in starts
    ]
    signal, length, nugget = np.exp(min(fits, key=lambda fit: float(fit.fun)).x)
    return Covariance(kernel, float(signal), float(length), float(nugget), float(observations.variance.mean()))


def answer_from_moments(covariance: Covariance, elevation: FloatArray, variance: FloatArray) -> LocalAnswer:
    """
    Turn a posterior mean and variance of the surface into an answer.

    Parameters
    ----------
    covariance : Covariance
    elevation : array, shape (n,), m
    variance : array, shape (n,), m2
        Posterior variance of the surface, without noise.

    Returns
    -------
    answer : LocalAnswer

    Notes
    -----
    The effective number of observations is that of independent ones at the place itself which would reduce the prior
    variance p to the posterior v: noise / v - noise / p. Where v exceeds 99.9 % of p the observations say nothing; a
    Gaussian process answers with its mean there, which is no knowledge about the ground, and the number is set to 0.
    """
    prior = covariance.signal_variance
    floor = 1e-9 * prior
    posterior = np.maximum(variance, floor)
    n_effective = covariance.noise_variance * np.maximum(1.0 / posterior - 1.0 / prior, 0.0)
    return LocalAnswer(
        elevation=elevation,
        elevation_std=np.sqrt(posterior),
        noise_std=np.full(elevation.shape, np.sqrt(covariance.noise_variance)),
        n_effective=np.where(posterior < _UNSUPPORTED_SHARE * prior, n_effective, 0.0),
    )
