"""Covariance functions of Gaussian-process surfaces and their maximum-likelihood fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from changedetect.models.comparators.base import LocalAnswer
from changedetect.models.comparators.observations import Observations, distance_to_kth, nearest

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = [
    "Covariance",
    "Kernel",
    "answer_from_moments",
    "estimate_covariance",
    "likelihood_blocks",
    "negative_log_likelihood",
    "parameter_ranges",
]

Kernel: TypeAlias = Literal["rbf", "matern32"]

_SQRT3 = float(np.sqrt(3.0))
#: Added to the diagonal, relative to the signal: smooth covariances of close points are singular to rounding.
_JITTER = 1e-9
#: Scaled distance at which the correlation has fallen to 0.05.
_EFFECTIVE_RANGE: dict[Kernel, float] = {"rbf": float(np.sqrt(2.0 * np.log(20.0))), "matern32": 2.7389}


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

    @property
    def effective_range(self) -> float:
        """Distance at which the correlation has fallen to 0.05, m: an observation says nothing beyond it."""
        return _EFFECTIVE_RANGE[self.kernel] * self.length_scale

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


def parameter_ranges(observations: Observations) -> list[tuple[float, float]]:
    """
    Bounds within which signal variance (m2), length scale (m) and nugget (m2) are sought.

    Raises
    ------
    ValueError
        All points lie at one place.

    Notes
    -----
    Lengths below half the distance to the fourth neighbour cannot be told from noise; lengths of more than twice the
    site, or signals much larger than the relief, turn flat ground into far extrapolation.
    """
    extent = float(max(np.ptp(observations.easting), np.ptp(observations.northing)))
    if extent == 0.0:
        msg = "All points lie at one place; a covariance cannot be fitted."
        raise ValueError(msg)
    shortest = min(0.5 * distance_to_kth(observations.positions, 4), extent)
    relief = max(float(observations.elevation.var()), 1e-8)
    return [(1e-4 * relief, 100.0 * relief), (shortest, 2.0 * extent), (1e-7 * relief, 10.0 * relief)]


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
    ranges = parameter_ranges(observations)
    rng = np.random.default_rng(random_seed)
    blocks = likelihood_blocks(observations, rng, n_blocks=n_blocks, block_size=block_size)
    bounds = Bounds(*np.log(ranges).T)
    relief, (shortest, longest) = 0.01 * ranges[0][1], ranges[1]
    scales = (4.0 * shortest, np.sqrt(shortest * longest), 0.1 * longest)
    starts = [(relief, scale, 0.05 * relief) for scale in scales]
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


def answer_from_moments(
    covariance: Covariance,
    elevation: FloatArray,
    variance: FloatArray,
    distance: FloatArray,
    *,
    is_mean_known: bool = True,
) -> LocalAnswer:
    """
    Turn a posterior mean and variance of the surface into an answer.

    Parameters
    ----------
    covariance : Covariance
    elevation : array, shape (n,), m
    variance : array, shape (n,), m2
        Posterior variance of the surface, without noise.
    distance : array, shape (n,), m
        From each place to the nearest observation.
    is_mean_known : bool
        Whether the prior has a variance at all; with an unknown mean, as in ordinary kriging, it is infinite.

    Returns
    -------
    answer : LocalAnswer

    Notes
    -----
    The effective number of observations is that of independent ones at the place itself which would reduce the prior
    variance p to the posterior v: noise / v - noise / p. Beyond the effective range of the covariance from all
    observations a Gaussian process answers with its mean, which is no knowledge about the ground; the number is 0.
    """
    posterior = np.maximum(variance, 1e-9 * covariance.signal_variance)
    prior_precision = 1.0 / covariance.signal_variance if is_mean_known else 0.0
    # the floor keeps rounding from turning a weak answer into none
    n_effective = np.maximum(covariance.noise_variance * (1.0 / posterior - prior_precision), 1e-6)
    return LocalAnswer(
        elevation=elevation,
        elevation_std=np.sqrt(posterior),
        noise_std=np.full(elevation.shape, np.sqrt(covariance.noise_variance)),
        n_effective=np.where(distance <= covariance.effective_range, n_effective, 0.0),
    )
