"""Series of areas: mean change since the first epoch, and budgets, with errors that know what cells share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from changedetect.differencing.areas import AreaBudget, area_budget, sum_std
from changedetect.differencing.objects import find_objects_of_change
from changedetect.timeseries.differences import TermsOfEpochs, epoch_maps, pair_maps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.config import DifferencingConfig
    from changedetect.differencing.error_model import ErrorModel
    from changedetect.timeseries.stack import Stack
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["Area", "AreaSeries", "area_budgets", "area_series"]

#: Rows and columns of the map, and which of those cells lie in an area.
Area: TypeAlias = "tuple[tuple[slice, slice], BoolArray]"

#: An epoch that saw less of the ground that the first one saw takes no part in the tests of an area.
_LEAST_COVERAGE = 0.5


@dataclass(frozen=True)
class AreaSeries:
    """
    Mean change of areas since the first epoch; arrays of shape (n_areas, n_epochs).

    Attributes
    ----------
    area_observed : array, m2
        Ground of the area that both the first epoch and this one observed.
    change : array, m
        0 in the first epoch; NaN where there is no such ground.
    variance : array, m2
        Of each epoch's own error of the mean. That of the change is the sum with the first epoch's, which all share.
    is_tested : array, bool
        Whether the epoch saw enough of the area for its mean to be compared with those of others.
    """

    area_observed: FloatArray
    change: FloatArray
    variance: FloatArray
    is_tested: BoolArray


def area_series(
    stack: Stack,
    models: Sequence[ErrorModel],
    terms: TermsOfEpochs,
    areas: Sequence[Area],
    settings: DifferencingConfig,
) -> AreaSeries:
    """
    Mean change of areas since the first epoch.

    Parameters
    ----------
    stack : Stack
    models : sequence of ErrorModel
        Of each epoch.
    terms : callable
        Gives errors that whole epochs share.
    areas : sequence of Area
    settings : DifferencingConfig

    Returns
    -------
    series : AreaSeries

    Notes
    -----
    Means are taken over the cells that the first epoch and the one at hand both observed. Their variance is that of
    `sum_std`: independent, correlated and coherent errors of one epoch at a time, so that what all epochs share with
    the first enters once.
    """
    n = stack.n_epochs
    shape = (len(areas), n)
    observed, change, variance = np.zeros(shape), np.full(shape, np.nan), np.full(shape, np.nan)
    for k in range(n):
        maps = epoch_maps(stack, models, terms, k, settings)
        for row, (window, inside) in enumerate(areas):
            first = np.asarray(stack.value[0][window], np.float64)
            both = inside & np.isfinite(first) & np.isfinite(maps.dod[window])
            count = int(np.count_nonzero(both))
            if count == 0:
                continue
            weights = both / count
            observed[row, k] = count * stack.resolution**2
            change[row, k] = float(np.mean(maps.dod[window][both] - first[both]))
            variance[row, k] = sum_std(maps, weights, stack.resolution, window) ** 2
    is_tested = np.isfinite(change) & (observed >= _LEAST_COVERAGE * observed[:, :1])
    return AreaSeries(observed, change, variance, is_tested)


def area_budgets(
    stack: Stack,
    models: Sequence[ErrorModel],
    terms: TermsOfEpochs,
    pair: tuple[int, int],
    areas: Sequence[Area],
    settings: DifferencingConfig,
) -> list[AreaBudget]:
    """
    Volumes of areas between two epochs of the stack.

    Parameters
    ----------
    stack, models, terms, areas, settings
        As for `area_series`.
    pair : (earlier, later)
        Numbers of the epochs.

    Returns
    -------
    budgets : list of AreaBudget
        At the confidence of the settings; which ground was raised and which lowered is told by the objects of change
        of this pair.
    """
    maps = pair_maps(stack, models, terms, pair, settings)
    rate = 1.0 - settings.confidence
    direction = find_objects_of_change(maps, stack.resolution, settings.confidence, rate).direction
    return [
        area_budget(maps, stack.resolution, settings.confidence, inside, direction[window], window)
        for window, inside in areas
    ]
