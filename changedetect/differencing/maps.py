"""What a difference of two epochs consists of, and how it is classified."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.config import DifferencingConfig
    from changedetect.typing import BoolArray, FloatArray

__all__ = [
    "BELOW_LEVEL_OF_DETECTION",
    "NOT_OBSERVED",
    "OUTSIDE",
    "SURFACE_LOWERED",
    "SURFACE_RAISED",
    "ChangeMaps",
    "judge_change",
]

BELOW_LEVEL_OF_DETECTION = 0
SURFACE_LOWERED = 1
SURFACE_RAISED = 2
#: Ground that only one of the epochs saw.
NOT_OBSERVED = 3
#: Ground that no epoch saw.
OUTSIDE = 255


@dataclass(frozen=True, kw_only=True)
class ChangeMaps:
    """
    Rasters of one pair of epochs; all of shape (n_rows, n_cols), north up.

    Attributes
    ----------
    dod : array, m, float64
        Elevation of the later epoch minus the earlier; NaN where not observed in both.
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


def judge_change(
    difference: FloatArray,
    variance: FloatArray,
    freedom: FloatArray,
    counts: tuple[FloatArray, FloatArray],
    observed: tuple[BoolArray, BoolArray],
    correlation_length: float,
    settings: DifferencingConfig,
) -> ChangeMaps:
    """
    Significance of a difference of known variance.

    Parameters
    ----------
    difference, variance, freedom : array, shape (n_rows, n_cols), m, m2, 1
        Estimate, its variance and the degrees of freedom of that variance.
    counts : pair of array, shape (n_rows, n_cols)
        Effective numbers of observations, earlier and later.
    observed : pair of array, bool
        Where each epoch observed the ground.
    correlation_length : float, m
    settings : DifferencingConfig

    Returns
    -------
    maps : ChangeMaps

    Notes
    -----
    With t the quantile of Student's distribution, level_of_detection = t std: the two-sided test at `confidence`. The
    probability of a change beyond the threshold is the mass of the t distribution about the estimate outside
    (-threshold, threshold).
    """
    both = observed[0] & observed[1] & np.isfinite(difference) & (variance > 0.0)
    d = np.where(both, difference, np.nan)
    std = np.sqrt(np.where(both, variance, np.nan))
    nu = np.where(both, np.maximum(freedom, 1.0), np.nan)
    lod = stats.t.ppf(0.5 + 0.5 * settings.confidence, nu) * std
    threshold = settings.change_threshold_m
    inside = np.asarray(stats.t.cdf((threshold - d) / std, nu) - stats.t.cdf((-threshold - d) / std, nu))
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
        n_effective_earlier=np.where(observed[0], counts[0], 0.0),
        n_effective_later=np.where(observed[1], counts[1], 0.0),
        correlation_length=correlation_length,
    )
