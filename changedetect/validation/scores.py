"""
How well a prediction foretells observations: its error, and whether it knew its error.

A model predicts a whole distribution for an observation: centred on the surface, with the variance of the surface and
that of one observation's noise. Proper scores (NLPD, CRPS) reward the sharpest distribution that is honest.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import special, stats

if TYPE_CHECKING:
    from changedetect.models.base import Prediction
    from changedetect.typing import FloatArray, JSONObject

__all__ = ["COVERAGE_LEVELS", "Scores", "crps", "negative_log_density", "observation_std", "score"]

#: Nominal levels of the intervals whose coverage is counted.
COVERAGE_LEVELS = (0.50, 0.90, 0.95)


@dataclass(frozen=True, kw_only=True)
class Scores:
    """
    Scores of a prediction against observations that it has not seen.

    Attributes
    ----------
    n : int
        Observations scored.
    rmse, mae : float, m
        Root mean square and mean absolute error.
    bias : float, m
        Mean of prediction minus observation.
    nlpd : float
        Negative log predictive density, the mean, in nats; densities per metre. Smaller is better. It has no bound: a
        few observations far outside their intervals can make all of it.
    nlpd_median : float
        The median, which they do not move.
    crps : float, m
        Continuous ranked probability score, the mean. Smaller is better; for a point forecast it is the MAE.
    coverage_50, coverage_90, coverage_95 : float
        Share of the observations inside the central interval of that probability.
    """

    n: int
    rmse: float
    mae: float
    bias: float
    nlpd: float
    nlpd_median: float
    crps: float
    coverage_50: float
    coverage_90: float
    coverage_95: float

    def to_dict(self) -> JSONObject:
        """Return the scores by name."""
        return asdict(self)


def score(observed: FloatArray, prediction: Prediction, freedom: FloatArray | float | None = None) -> Scores | None:
    """
    Score a prediction where it answers.

    Parameters
    ----------
    observed : array, shape (n,), m
        Elevations that were held out.
    prediction : Prediction
        At their places.
    freedom : array or float, optional
        Degrees of freedom of Student's t; None takes the predictive distribution to be Gaussian.

    Returns
    -------
    scores : Scores or None
        None where nothing was answered.

    Raises
    ------
    ValueError
        Shapes differ, or an answer has no positive standard deviation.
    """
    if observed.shape != prediction.elevation.shape:
        msg = f"There are {observed.size} observations and {prediction.elevation.size} predictions; they must agree."
        raise ValueError(msg)
    is_known = np.isfinite(prediction.elevation)
    n = int(is_known.sum())
    if n == 0:
        return None
    std = observation_std(prediction)[is_known]
    if not np.all(std > 0.0):
        msg = f"{int(np.sum(~(std > 0.0)))} of {n} answers have no positive standard deviation."
        raise ValueError(msg)
    shape = None if freedom is None else np.broadcast_to(np.asarray(freedom, np.float64), observed.shape)[is_known]
    error = prediction.elevation[is_known] - observed[is_known]
    z = error / std
    density = negative_log_density(z, std, shape)
    inside = [float(np.mean(np.abs(z) <= _half_width(level, shape))) for level in COVERAGE_LEVELS]
    return Scores(
        n=n,
        rmse=float(np.sqrt(np.mean(error**2))),
        mae=float(np.mean(np.abs(error))),
        bias=float(np.mean(error)),
        nlpd=float(np.mean(density)),
        nlpd_median=float(np.median(density)),
        crps=float(np.mean(crps(z, std, shape))),
        coverage_50=inside[0],
        coverage_90=inside[1],
        coverage_95=inside[2],
    )


def observation_std(prediction: Prediction) -> FloatArray:
    """Standard deviation of a new observation, surface and noise together, shape (n,), m; NaN without answer."""
    return np.hypot(prediction.elevation_std, prediction.noise_std)


def negative_log_density(z: FloatArray, std: FloatArray, freedom: FloatArray | None = None) -> FloatArray:
    """
    Negative log density of a Gaussian, or of Student's t with `freedom`.

    Parameters
    ----------
    z : array, shape (n,)
        Error over `std`.
    std : array, shape (n,), m
        Standard deviation; of Student's t the scale.
    freedom : array, shape (n,), optional

    Returns
    -------
    density : array, shape (n,), nats
    """
    family = stats.norm.logpdf(z) if freedom is None else stats.t.logpdf(z, freedom)
    return np.asarray(np.log(std) - family)


def crps(z: FloatArray, std: FloatArray, freedom: FloatArray | None = None) -> FloatArray:
    """
    Continuous ranked probability score of a Gaussian, or of Student's t with `freedom` above 1.

    Parameters
    ----------
    z : array, shape (n,)
        Error over `std`.
    std : array, shape (n,), m
        Standard deviation; of Student's t the scale.
    freedom : array, shape (n,), optional

    Returns
    -------
    crps : array, shape (n,), m

    Notes
    -----
    Closed forms: Gaussian, eq. 21 of [1]_; Student's t, appendix A of [2]_.

    References
    ----------
    .. [1] Gneiting, T. & Raftery, A. E. (2007), Strictly proper scoring rules, prediction, and estimation, JASA 102,
       doi:10.1198/016214506000001437.
    .. [2] Jordan, A., Krueger, F. & Lerch, S. (2019), Evaluating probabilistic forecasts with scoringRules, Journal of
       Statistical Software 90(12), doi:10.18637/jss.v090.i12.
    """
    if freedom is None:
        standard = z * (2.0 * stats.norm.cdf(z) - 1.0) + 2.0 * stats.norm.pdf(z) - 1.0 / np.sqrt(np.pi)
        return np.asarray(std * standard)
    spread = np.sqrt(freedom) / (freedom - 1.0)
    ratio = special.beta(0.5, freedom - 0.5) / special.beta(0.5, 0.5 * freedom) ** 2
    standard = z * (2.0 * stats.t.cdf(z, freedom) - 1.0) - 2.0 * spread * ratio
    standard += 2.0 * stats.t.pdf(z, freedom) * (freedom + z**2) / (freedom - 1.0)
    return np.asarray(std * standard)


def _half_width(level: float, freedom: FloatArray | None) -> FloatArray:
    """Half the central interval of probability `level`, in standard deviations (scales)."""
    at = 0.5 * (1.0 + level)
    return np.asarray(stats.norm.ppf(at) if freedom is None else stats.t.ppf(at, freedom))
