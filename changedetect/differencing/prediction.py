"""
The correlated error of every cell as the unchanged ground around it tells it, and what is left of it.

A change must not be taken for error. So a cell is predicted from ground that lies beyond a hole about it, and from no
ground that may have changed; what a statement is about never takes part in its prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_dilation

from changedetect.differencing.blocks import Blocks, interpolate, standardise
from changedetect.differencing.coarse import block_sums
from changedetect.differencing.correlation import NestedCorrelation, fit_correlation
from changedetect.differencing.error_scale import Sample, fit_scale, half_width_scale
from changedetect.differencing.lags import CellScores, collect_pairs, standardised_scores
from changedetect.differencing.stencil import HOLE, Stencil, choose_stencil, predict_blocks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.differencing.error_model import ErrorModel
    from changedetect.typing import BoolArray, FloatArray, IntArray, JSONObject

__all__ = ["ErrorPrediction", "predict_errors"]

#: Correlated errors larger than this many times the scatter of neighbouring observations may be change as well, on
#: ground that was not given as stable.
_LARGEST_RATIO = 2.0
#: Part of the variance of the correlated errors that prediction leaves of them on unchanged ground, at most.
_WANTED = 0.5
#: Cells that the variance left is checked with, and limits of its correction.
_N_CHECKED = 15_000
_LEAST_INFLATION, _LARGEST_INFLATION = 0.2, 4.0
#: The correlation of what is left is found on so many rows and columns in the middle of the map.
_MIDDLE = 1000


@dataclass(frozen=True)
class ErrorPrediction:
    """
    Prediction of the correlated errors of a difference.

    Attributes
    ----------
    error : array, shape (n_rows, n_cols), m
        Predicted; 0 where nothing is.
    variance : array, shape (n_rows, n_cols), m2
        Of what is left of the correlated errors and of those that co-registration leaves.
    candidates : array, shape (n_rows, n_cols), bool
        Ground that took no part because it may have changed, or was not given as stable.
    data : Blocks
        The finest blocks that took part.
    correlation : NestedCorrelation
        Of what is left, as a correlation.
    inflation : float
        Variance found over variance expected on unchanged ground.
    share_left : float
        Part of the variance of correlated errors that is left on unchanged ground.
    hole : float, m
        Radius of the ground about a cell that takes no part in its prediction.
    """

    error: FloatArray
    variance: FloatArray
    candidates: BoolArray
    data: Blocks
    correlation: NestedCorrelation
    inflation: float
    share_left: float
    hole: float

    def inflated(self, share: FloatArray | float) -> FloatArray:
        """
        Part of the variance that is left, as unchanged ground shows it to be.

        Parameters
        ----------
        share : array or float
            As the covariances tell it, 0 to 1.

        Notes
        -----
        What is left on unchanged ground fixes the factor at its own share; where nothing is predicted it is one, and
        between it is a power of the share.
        """
        return _inflated(share, self.inflation, self.share_left)

    def document(self) -> JSONObject:
        """Return what the prediction amounts to, for people and files."""
        return {
            "hole_radius_m": self.hole,
            "share_of_variance_left": float(_inflated(self.share_left, self.inflation, self.share_left)),
            "candidate_share": float(np.mean(self.candidates)),
        }


def _inflated(share: FloatArray | float, inflation: float, at: float) -> FloatArray:
    power = math.log(inflation) / math.log(min(at, 0.95))
    part = np.clip(share, 1e-6, 1.0)
    return np.asarray(np.minimum(part * np.where(part < at, inflation, part**power), 1.0))


def predict_errors(
    difference: FloatArray,
    variances: tuple[FloatArray, FloatArray],
    model: ErrorModel,
    unchanged: BoolArray,
    resolution: float,
    coherent: Sequence[FloatArray] = (),
    *,
    is_given: bool = False,
    noise: float = math.inf,
) -> ErrorPrediction | None:
    """
    Predict the correlated errors of a difference from unchanged ground.

    Parameters
    ----------
    difference : array, shape (n_rows, n_cols), m
        NaN where it is not known.
    variances : pair of array, shape (n_rows, n_cols), m2
        Of the independent and of the correlated errors.
    model : ErrorModel
    unchanged : array, bool
        Ground the model was estimated on.
    resolution : float, m
    coherent : sequence of array, shape (n_rows, n_cols), m
        Errors of one standard deviation of each independent parameter that the map shares.
    is_given : bool
        Whether `unchanged` is ground given as stable, where errors may be as large as they like.
    noise : float, m
        Scatter of neighbouring observations.

    Returns
    -------
    prediction : ErrorPrediction or None
        None where there is nothing to predict, or to little use, or where correlated errors are so large against
        the noise that they may be change.

    Notes
    -----
    Simple kriging from block means of unchanged ground: of that ground itself from beyond a hole about the cell
    (`choose_stencil`), of all other ground from all of it around. The variance left is checked on unchanged ground and
    corrected by a factor.
    """
    known = np.isfinite(difference)
    shape = (difference.shape[0], difference.shape[1])
    if not model.is_correlated or not (known & unchanged).any():
        return None
    scale = np.sqrt(variances[1])
    if not is_given and float(np.median(scale[known & unchanged])) > _LARGEST_RATIO * noise:
        return None
    correlation = model.correlation.normalised()
    d = np.where(known, difference, 0.0)
    finest = standardise(d, variances, known & unchanged, resolution, coherent)
    wide = choose_stencil(correlation, model.local, finest, _WANTED)
    fine = choose_stencil(correlation, model.local, finest)
    if wide is None or fine is None:
        return None
    stencil, share_left = wide
    candidates = known & ~unchanged
    error, share, lost = _at_cells(finest, (stencil, fine[0]), candidates, shape)
    quiet = known & ~candidates
    share_left = float(np.median(share[quiet])) if quiet.any() else share_left
    inflation = _inflation((d - scale * error)[quiet], variances[0][quiet], (variances[1] * share)[quiet], model)
    left = variances[1] * _inflated(share, inflation, share_left)
    for column, predicted in zip(coherent, lost, strict=True):
        left += (column - scale * predicted) ** 2
    error *= scale
    middle = tuple(slice(max(0, (n - _MIDDLE) // 2), (n + _MIDDLE) // 2) for n in shape)
    return ErrorPrediction(
        error=error,
        variance=left,
        candidates=candidates,
        data=finest,
        correlation=_correlation_left(
            (d - error)[middle], (variances[0][middle], left[middle]), quiet[middle], model, resolution
        ),
        inflation=inflation,
        share_left=share_left,
        hole=HOLE * stencil.step * finest.side,
    )


def _at_cells(
    finest: Blocks, stencils: tuple[Stencil, Stencil], candidates: BoolArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    """
    Prediction, share of the variance left and predicted coherent errors of all cells, standardised.

    Of unchanged ground from beyond the hole of the first stencil, of candidates from all ground about them in the
    blocks of the second.
    """
    wide, fine = stencils
    around = predict_blocks(finest.coarser(wide.step), wide)
    parts = [around.mean, around.variance / wide.prior, *around.coherent]
    cells = [interpolate(values, wide.step * finest.factor, shape) for values in parts]
    if candidates.any():
        blocks, factor = finest.coarser(fine.step), fine.step * finest.factor
        near = block_sums(candidates.astype(np.float64), factor) > 0.0
        outside = predict_blocks(blocks, fine, binary_dilation(near, np.ones((3, 3), bool)), keep_hole=False)
        parts = [outside.mean, outside.variance / fine.prior, *outside.coherent]
        for values, result in zip(parts, cells, strict=True):
            result[candidates] = interpolate(values, factor, shape)[candidates]
    return cells[0], cells[1], cells[2:]


def _inflation(left: FloatArray, variance: FloatArray, expected: FloatArray, model: ErrorModel) -> float:
    """Variance of what is left on unchanged ground over the expected one, robustly."""
    if left.size < 2:
        return 1.0
    part = np.random.default_rng(13).permutation(left.size)[:_N_CHECKED]
    root = np.sqrt(expected[part])
    standardised = left[part] / root
    centre, spread = half_width_scale(standardised)
    start = math.hypot(centre, spread)
    ratio = variance[part] / expected[part]
    widest = max(float(np.percentile(np.abs(standardised), 99.5)), 10.0 * start, math.sqrt(float(np.median(ratio))))
    found = fit_scale(
        Sample(
            squared=standardised**2,
            variance=ratio,
            covariates={},
            block=np.zeros(part.size, np.int64),
            n_independent=model.n_independent,
            background=0.5 / widest,
            start=start,
        ),
        model.scale.freedom,
    )
    return float(np.clip(math.exp(found.level), _LEAST_INFLATION, _LARGEST_INFLATION))


def _correlation_left(
    left: FloatArray,
    variances: tuple[FloatArray, FloatArray],
    ground: BoolArray,
    model: ErrorModel,
    resolution: float,
) -> NestedCorrelation:
    """Correlation of what is left of the correlated errors."""
    shortest = model.local.ranges[0]
    if np.count_nonzero(ground) < 2:
        return NestedCorrelation((shortest,), (1.0,))
    cells = [values.ravel() for values in (left, *variances)]

    def at(places: IntArray) -> CellScores:
        return standardised_scores(cells[0][places], cells[1][places], cells[2][places], model.scale.freedom)

    pairs = collect_pairs(at, ground, resolution, np.random.default_rng(14))
    found = fit_correlation(pairs, model.local, pairs.strength, shortest, model.correlation.ranges[-1])
    return found.normalised() if found.ranges else NestedCorrelation((shortest,), (1.0,))
