"""Where the wide kernel has smeared an edge of change."""

from __future__ import annotations

import numpy as np
from scipy import stats

from changedetect.timeseries.deviations import LocalDeviation
from changedetect.typing import BoolArray, FloatArray

__all__ = ["EdgeFinder"]

#: Two-sided probability of three standard deviations, at which a wide and a narrow kernel of two epochs contradict.
_LEVEL = 0.0027
#: ... and their mean square is this many times what noise makes it.
_LEAST_RATIO = 2.0


class EdgeFinder:
    """
    Compares deviations with a wide and a narrow kernel, epoch by epoch, without keeping them.

    Parameters
    ----------
    shape : (n_rows, n_columns)

    Notes
    -----
    The wide kernel's data hold the narrow one's, so the variance of the difference g_e of the two is the difference of
    their variances (Lepski's rule). What all epochs have in common is no edge of change, so the weighted sum of squares
    of g_e about their mean counts, chi-square with one degree of freedom less than epochs. All epochs of a cell use the
    same kernel: the smoothing of the ground's change stays the same over time.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._squares = np.zeros(shape)
        self._sums = np.zeros(shape)
        self._weights = np.zeros(shape)
        self._number = np.zeros(shape)
        self._is_usable = np.ones(shape, bool)

    def add(self, wide: LocalDeviation, narrow: LocalDeviation) -> None:
        """Take in an epoch."""
        known = wide.observed & np.isfinite(wide.value)
        both = known & np.isfinite(narrow.value)
        self._is_usable &= both | ~known
        spread = np.maximum(narrow.variance - wide.variance, 0.05 * narrow.variance)
        weight = np.where(both, 1.0 / np.where(spread > 0.0, spread, np.inf), 0.0)
        difference: FloatArray = np.where(both, narrow.value - wide.value, 0.0)
        self._squares += weight * difference**2
        self._sums += weight * difference
        self._weights += weight
        self._number += both

    def edges(self) -> BoolArray:
        """Cells where the narrow kernel is to be taken, in all epochs."""
        freedom = np.maximum(self._number - 1.0, 1.0)
        square = self._squares - self._sums**2 / np.maximum(self._weights, 1e-300)
        limit = np.maximum(stats.chi2.isf(_LEVEL, freedom), _LEAST_RATIO * freedom)
        found: BoolArray = self._is_usable & (self._number >= 2) & (square > limit)
        return found
