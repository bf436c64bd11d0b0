"""Exact Gaussian process regression, by scikit-learn."""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.spatial import cKDTree

from changedetect.models.comparators.base import LocalAnswer, PointModel
from changedetect.models.comparators.covariance import Covariance, Kernel, answer_from_moments, parameter_ranges
from changedetect.models.comparators.observations import Observations, nearest

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["ExactGPR"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _Posterior:
    regressor: Any
    tree: cKDTree
    covariance: Covariance


@dataclass(kw_only=True, eq=False)
class ExactGPR(PointModel[_Posterior]):
    """
    Gaussian process regression with an isotropic kernel and white noise; cost grows with the cube of the points.

    Attributes
    ----------
    kernel : "matern32" or "rbf"
    n_subsample : int
        Points, chosen at random, to which the hyper-parameters are fitted by maximum likelihood.
    random_seed : int
        Of the subsample.
    max_points : int or None
        5000 points take 0.9 GB and, on one core, 7 s to learn and 0.8 s for 1000 places.

    Notes
    -----
    The posterior is Rasmussen & Williams (2006), algorithm 2.1 [1]_, as scikit-learn implements it. Sigmas given with
    the observations enter as known noise variances; white noise beyond them is estimated. The prior mean is the mean
    of the observations.

    References
    ----------
    .. [1] Rasmussen, C. E. & Williams, C. K. I. (2006), Gaussian Processes for Machine Learning, MIT Press.
    """

    kernel: Kernel = "matern32"
    n_subsample: int = 800
    random_seed: int = 0
    max_points: int | None = 5_000

    #: Triangular solves hold max_points x block in memory.
    _block_size: ClassVar[int] = 2_000

    def _estimate(self, observations: Observations) -> dict[str, float]:
        rng = np.random.default_rng(self.random_seed)
        n_subsample = min(self.n_subsample, len(observations))
        sample = np.sort(rng.choice(len(observations), n_subsample, replace=False))
        ranges = parameter_ranges(observations)
        relief, longest = 0.01 * ranges[0][1], ranges[1][1]
        start = Covariance(self.kernel, relief, 0.1 * longest, 0.05 * relief)
        regressor = _regressor(start, observations.variance[sample], ranges)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            regressor.fit(observations.positions[sample], observations.elevation[sample])
        for warning in caught:
            logger.info("exact GPR: %s", warning.message)
        signal, length, nugget = np.exp(regressor.kernel_.theta)
        fitted = Covariance(self.kernel, float(signal), float(length), float(nugget))
        return {**fitted.to_parameters(), "mean_variance": float(observations.variance.mean())}

    def _prepare(self, observations: Observations, parameters: dict[str, float]) -> _Posterior:
        covariance = Covariance.from_parameters(self.kernel, parameters)
        regressor = _regressor(covariance, observations.variance, None)
        regressor.fit(observations.positions, observations.elevation)
        return _Posterior(regressor, cKDTree(observations.positions), covariance)

    def _answer(self, prepared: _Posterior, easting: FloatArray, northing: FloatArray) -> LocalAnswer:
        places = np.column_stack([easting, northing])
        with warnings.catch_warnings():
            # rounding may leave variances a hair below zero on noise-free data; answer_from_moments has a floor
            warnings.filterwarnings("ignore", message="Predicted variances smaller than 0")
            elevation, std = prepared.regressor.predict(places, return_std=True)
        variance = std**2 - prepared.covariance.nugget
        distance, _ = nearest(prepared.tree, places, 1)
        return answer_from_moments(prepared.covariance, elevation, variance, distance[:, 0])


def _regressor(covariance: Covariance, variance: FloatArray, bounds: list[tuple[float, float]] | None) -> Any:
    """Scikit-learn's regressor for a covariance; its hyper-parameters are fitted where `bounds` are given."""
    process, kernels = _scikit_learn("gaussian_process"), _scikit_learn("gaussian_process.kernels")
    ranges = ["fixed", "fixed", "fixed"] if bounds is None else bounds
    signal = kernels.ConstantKernel(covariance.signal_variance, ranges[0])
    if covariance.kernel == "rbf":
        shape = kernels.RBF(covariance.length_scale, ranges[1])
    else:
        shape = kernels.Matern(covariance.length_scale, ranges[1], nu=1.5)
    noise = kernels.WhiteKernel(covariance.nugget, ranges[2])
    return process.GaussianProcessRegressor(
        signal * shape + noise,
        alpha=np.maximum(variance, 1e-9 * covariance.signal_variance),
        optimizer=None if bounds is None else "fmin_l_bfgs_b",
    )


def _scikit_learn(module: str) -> Any:
    try:
        return import_module(f"sklearn.{module}")
    except ImportError as error:
        msg = (
            "Exact Gaussian process regression needs scikit-learn, which the extra 'compare' brings: "
            "pip install 'changedetect[compare]'."
        )
        raise ImportError(msg) from error
