"""What a difference of two epochs consists of, and how it is classified."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import special, stats

from changedetect.differencing.clusters import normal_score
from changedetect.differencing.resolution import FIELD_AREA, KERNEL_WIDTH, Resolution

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.config import DifferencingConfig
    from changedetect.differencing.coherent import CoherentTerm
    from changedetect.differencing.error_model import ErrorModel
    from changedetect.differencing.prediction import ErrorPrediction
    from changedetect.typing import BoolArray, FloatArray

__all__ = [
    "BELOW_LEVEL_OF_DETECTION",
    "NOT_OBSERVED",
    "OUTSIDE",
    "SURFACE_LOWERED",
    "SURFACE_RAISED",
    "CellErrors",
    "ChangeMaps",
    "Evidence",
    "judge_change",
]

BELOW_LEVEL_OF_DETECTION = 0
SURFACE_LOWERED = 1
SURFACE_RAISED = 2
#: Ground that only one of the epochs saw.
NOT_OBSERVED = 3
#: Ground that no epoch saw.
OUTSIDE = 255
#: Degrees of freedom from which on a normal score stands for Student's t.
_MANY = 20.0


@dataclass(frozen=True)
class Evidence:
    """
    What the estimator of a difference says of every cell; arrays of shape (n_rows, n_cols), north up.

    Attributes
    ----------
    difference, variance : array, m, m2
        Later minus earlier, and its variance from independent errors of the observations.
    freedom : array
        Degrees of freedom of that variance.
    counts : pair of array
        Effective numbers of observations, earlier and later.
    observed : pair of array, bool
        Where each epoch observed the ground.
    terrain : pair of array, m, 1
        Elevation that both epochs share, and its slope.
    correlation_length : float, m
        Side of the square over which estimates of neighbouring cells share their data.
    resolution : Resolution, optional
        What width of change the estimates resolve; where left out the same everywhere, from `correlation_length`.
    """

    difference: FloatArray
    variance: FloatArray
    freedom: FloatArray
    counts: tuple[FloatArray, FloatArray]
    observed: tuple[BoolArray, BoolArray]
    terrain: tuple[FloatArray, FloatArray]
    correlation_length: float
    resolution: Resolution | None = None

    @property
    def known(self) -> BoolArray:
        """Cells whose difference and variance are known and that both epochs observed."""
        both: BoolArray = self.observed[0] & self.observed[1] & np.isfinite(self.difference) & (self.variance > 0.0)
        return both


@dataclass(frozen=True)
class CellErrors:
    """
    Variance of every cell by source, and the model behind it.

    Attributes
    ----------
    model : ErrorModel
    correlated : array, shape (n_rows, n_cols), m2
        Squared scale of the errors that are correlated over metres to hundreds of metres.
    coherent : array, shape (n_rows, n_cols), m2
        Variance of what co-registration leaves.
    terms : tuple of CoherentTerm
        Where the latter comes from.
    stable : array, shape (n_rows, n_cols), bool
        Ground the model was estimated on.
    prediction : ErrorPrediction, optional
        Of the correlated errors from the ground around, and what is left of them.
    """

    model: ErrorModel
    correlated: FloatArray
    coherent: FloatArray
    terms: tuple[CoherentTerm, ...]
    stable: BoolArray
    prediction: ErrorPrediction | None = None

    @property
    def predicted(self) -> FloatArray:
        """Predicted error of every cell, m, which is taken off the difference; 0 where nothing is predicted."""
        return np.zeros(self.correlated.shape) if self.prediction is None else self.prediction.error

    @property
    def shared(self) -> FloatArray:
        """Variance, m2, of what cells share and no prediction takes off."""
        return self.correlated + self.coherent if self.prediction is None else self.prediction.variance


@dataclass(frozen=True, kw_only=True)
class ChangeMaps:
    """
    Rasters of one pair of epochs; all of shape (n_rows, n_cols), north up.

    Attributes
    ----------
    dod : array, m, float64
        Elevation of the later epoch minus the earlier, less `correlated_error`; NaN where not observed in both.
    dod_std : array, m
        Standard deviation of `dod`.
    level_of_detection : array, m
        Smallest absolute change that differs from zero at the stated confidence.
    change_probability : array
        Probability that the absolute change exceeds the stated threshold.
    change_class : array, uint8
        0 below the level of detection, 1 lowered, 2 raised, 3 not observed in one of the epochs, 255 outside.
    z_score : array
        dod / dod_std.
    degrees_of_freedom : array
        Of the variance estimate behind `dod_std`.
    n_effective_earlier, n_effective_later : array
        Effective number of observations of each epoch behind `dod`; 0 where there are none.
    correlation_length : float, m
        Side of the square over which estimates of neighbouring cells share their data.
    local_std : array, m
        Part of `dod_std` that is due to independent errors of the observations.
    elevation : array, m
        Elevation that both epochs share; NaN where `dod` is.
    correlated_error : array, m
        Error that `dod` would have without correction, as predicted from the unchanged ground around; their sum is the
        difference as measured. 0 where nothing is predicted; NaN where `dod` is.
    errors : CellErrors
        The other parts, and the model of the errors.
    """

    dod: FloatArray
    dod_std: FloatArray
    level_of_detection: FloatArray
    change_probability: FloatArray
    change_class: NDArray[np.uint8]
    z_score: FloatArray
    degrees_of_freedom: FloatArray
    n_effective_earlier: FloatArray
    n_effective_later: FloatArray
    correlation_length: float
    local_std: FloatArray
    elevation: FloatArray
    correlated_error: FloatArray
    errors: CellErrors
    resolution: Resolution


def judge_change(evidence: Evidence, errors: CellErrors, settings: DifferencingConfig) -> ChangeMaps:
    """
    Significance of a difference of known errors.

    Parameters
    ----------
    evidence : Evidence
    errors : CellErrors
    settings : DifferencingConfig

    Returns
    -------
    maps : ChangeMaps

    Notes
    -----
    With t the quantile of Student's distribution, level_of_detection = t std: the two-sided test at `confidence`. The
    probability of a change beyond the threshold is the mass of the t distribution about the estimate outside
    (-threshold, threshold). Degrees of freedom of the sum of variances follow Satterthwaite (1946). Where the tails
    of the correlated errors are heavier than normal, std is the scale of a t distribution.
    """
    both = evidence.known
    d = np.where(both, evidence.difference - errors.predicted, np.nan)
    local = np.where(both, evidence.variance, np.nan)
    variance = local + errors.shared
    std = np.sqrt(variance)
    nu = _combined_freedom(local, errors, variance, np.maximum(evidence.freedom, 1.0))
    lod = _t_quantile(0.5 + 0.5 * settings.confidence, nu) * std
    threshold = settings.change_threshold_m
    inside = _t_probability((threshold - d) / std, nu) - _t_probability((-threshold - d) / std, nu)
    observed = evidence.observed
    classes = np.full(d.shape, OUTSIDE, np.uint8)
    classes[observed[0] | observed[1]] = NOT_OBSERVED
    classes[both] = BELOW_LEVEL_OF_DETECTION
    classes[both & (d > lod)] = SURFACE_RAISED
    classes[both & (d < -lod)] = SURFACE_LOWERED
    return ChangeMaps(
        dod=d,
        dod_std=std,
        level_of_detection=lod,
        change_probability=np.subtract(1.0, inside),
        change_class=classes,
        z_score=d / std,
        degrees_of_freedom=nu,
        n_effective_earlier=np.where(observed[0], evidence.counts[0], 0.0),
        n_effective_later=np.where(observed[1], evidence.counts[1], 0.0),
        correlation_length=evidence.correlation_length,
        local_std=np.sqrt(local),
        elevation=np.where(both, evidence.terrain[0], np.nan),
        correlated_error=np.where(both, errors.predicted, np.nan),
        errors=errors,
        resolution=_resolution(evidence).within(both),
    )


def _resolution(evidence: Evidence) -> Resolution:
    if evidence.resolution is not None:
        return evidence.resolution
    # a kernel averages over the area of a square of that side
    kernel = evidence.correlation_length / math.sqrt(FIELD_AREA)
    width = np.full(evidence.difference.shape, KERNEL_WIDTH * kernel)
    return Resolution(width, width, np.full(width.shape, np.nan))


def _combined_freedom(local: FloatArray, errors: CellErrors, variance: FloatArray, freedom: FloatArray) -> FloatArray:
    tails = errors.model.scale.freedom
    shared = errors.correlated if errors.prediction is None else errors.prediction.variance
    spread = local**2 / freedom + (0.0 if math.isinf(tails) else shared**2 / tails)
    return np.asarray(variance**2 / spread)


def _t_probability(t: FloatArray, freedom: FloatArray) -> FloatArray:
    """Distribution function of Student's t, within 3e-5; exact below `_MANY` degrees of freedom."""
    few = freedom < _MANY
    probability = np.asarray(special.ndtr(normal_score(t, freedom)))
    probability[few] = special.stdtr(freedom[few], t[few])
    return probability


def _t_quantile(probability: float, freedom: FloatArray) -> FloatArray:
    """Quantile of Student's t, interpolated in 1 / freedom; within 1e-4 of the exact one."""
    inverse = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 400)])
    table = np.concatenate([[stats.norm.ppf(probability)], stats.t.ppf(probability, 1.0 / inverse[1:])])
    return np.asarray(np.interp(1.0 / freedom, inverse, table))
