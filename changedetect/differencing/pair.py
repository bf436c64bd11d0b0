"""The difference of two models on a grid."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing.coherent import likely_errors
from changedetect.differencing.covariates import error_covariates
from changedetect.differencing.error_model import estimate_errors
from changedetect.differencing.error_scale import half_width_scale
from changedetect.differencing.maps import CellErrors, ChangeMaps, Evidence, judge_change
from changedetect.differencing.prediction import predict_errors
from changedetect.differencing.resolution import Resolution
from changedetect.differencing.shared_surface import FIELD_AREA, LocalDifference, estimate_difference
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice
from changedetect.models.reference import ReferenceLWPR

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.config import DifferencingConfig
    from changedetect.differencing.coherent import CoherentTerm
    from changedetect.grid import Grid
    from changedetect.models.base import SurfaceModel
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["difference_models"]

#: A cell counts as observed by a reference-mode epoch with at least this effective number of observations.
_REFERENCE_MINIMUM = 2.0
#: Full width at half maximum of the reference mode's Gaussian kernel, in kernels.
_GAUSSIAN_WIDTH = math.sqrt(8.0 * math.log(2.0))
#: The majority of the cells lies this many times its own scatter away from zero: the epochs are not aligned, and their
#: offset is no measure of their errors.
_OFFSET_RATIO = 1.5
#: Coherent errors below this share of the squared difference add nothing to what its scatter shows.
_COHERENT_SHARE = 0.02
#: Range of the Gaussian correlation whose integral is that of estimates with a side of shared data of one:
#: 2 pi range^2 = side^2.
_RANGE_OF_SIDE = 1.0 / math.sqrt(2.0 * math.pi)


def difference_models(
    earlier: SurfaceModel,
    later: SurfaceModel,
    grid: Grid,
    settings: DifferencingConfig,
    *,
    stable: BoolArray | None = None,
    coherent: Sequence[CoherentTerm] = (),
) -> ChangeMaps:
    """
    Change from one epoch to a later one.

    Parameters
    ----------
    earlier, later : LWPRSurface or ReferenceLWPR
        Models of the two epochs, both of the same kind.
    grid : Grid
        Output cells, in the CRS of the models; its corner lies on multiples of the resolution.
    settings : DifferencingConfig
    stable : array, shape (n_rows, n_cols), bool, optional
        Ground known not to have changed, on which the errors are estimated. Otherwise it is found.
    coherent : sequence of CoherentTerm
        What the alignment of the epochs leaves uncertain.

    Returns
    -------
    maps : ChangeMaps

    Raises
    ------
    ValueError
        The models are of different kinds, or of one that cannot be differenced; stable ground or a coherent term has
        another shape than the grid.

    Notes
    -----
    In adaptive mode the evidence of the two epochs is differenced about one shared surface, see
    `estimate_difference`; what a model remembers of still earlier epochs takes no part. In reference mode the two
    predictions are subtracted and their variances added. Either way `estimate_errors` adds the correlated errors,
    and `predict_errors` takes off what the unchanged ground around tells of them, if the settings say so.
    """
    if isinstance(earlier, LWPRSurface) and isinstance(later, LWPRSurface):
        evidence = _adaptive_evidence(earlier, later, grid)
    elif isinstance(earlier, ReferenceLWPR) and isinstance(later, ReferenceLWPR):
        evidence = _reference_evidence(earlier, later, grid)
    else:
        msg = f"cannot difference a {type(earlier).__name__} and a {type(later).__name__}; learn both with one mode"
        raise ValueError(msg)
    if stable is not None and stable.shape != grid.shape:
        msg = f"stable ground has shape {stable.shape}, the grid {grid.shape}"
        raise ValueError(msg)
    # ground found not to have changed may have changed too little to be found: it predicts on demand only
    predict = settings.predict_errors == "always" or (settings.predict_errors == "stable" and stable is not None)
    errors = cell_errors(evidence, grid.resolution, stable, coherent, predict=predict)
    return judge_change(evidence, errors, settings)


def cell_errors(
    evidence: Evidence,
    resolution: float,
    stable: BoolArray | None = None,
    coherent: Sequence[CoherentTerm] = (),
    *,
    predict: bool = False,
) -> CellErrors:
    """
    Errors of every cell of a difference, by source.

    Parameters
    ----------
    evidence : Evidence
    resolution : float, m
    stable : array, shape (n_rows, n_cols), bool, optional
        Ground known not to have changed.
    coherent : sequence of CoherentTerm
    predict : bool
        Whether correlated errors are predicted from the unchanged ground around, where that is safe.

    Returns
    -------
    errors : CellErrors
    """
    known = evidence.known
    shape = (known.shape[0], known.shape[1])
    difference = np.where(known, evidence.difference, np.nan)
    variance = np.where(known, evidence.variance, 0.0)
    smoothing = evidence.correlation_length / (math.sqrt(FIELD_AREA) * resolution)
    covariates = error_covariates(variance, evidence.counts, evidence.terrain, known, smoothing)
    if known.any():
        centre, spread = half_width_scale(difference[known])
        if abs(centre) > _OFFSET_RATIO * spread:
            difference -= centre
    local_range = _RANGE_OF_SIDE * evidence.correlation_length
    model, ground = estimate_errors(difference, variance, covariates, resolution, local_range, stable)
    shared = np.zeros(shape)
    for term in coherent:
        shared += term.variance(shape)
    unchanged = ground & known
    if model.is_correlated and np.mean(shared[unchanged]) > _COHERENT_SHARE * np.mean(difference[unchanged] ** 2):
        # Else the coherent errors of this difference would count twice, once among those that its scatter shows
        likely = likely_errors(difference, _independent_errors(coherent, shape), unchanged, model.n_independent)
        less = difference - likely
        model, ground = estimate_errors(less, variance, covariates, resolution, local_range, stable)
    correlated = model.correlated_variance(covariates, shape)
    errors = CellErrors(model, correlated, shared, tuple(coherent), ground)
    if not predict or not model.is_correlated:
        return errors
    prediction = predict_errors(
        difference, (variance, correlated), model, ground, resolution,
        _independent_errors(coherent, shape),
        is_given=stable is not None,
        noise=math.exp(float(np.median(covariates["noise"][known]))),
    )  # fmt: skip
    return replace(errors, prediction=prediction)


def _independent_errors(coherent: Sequence[CoherentTerm], shape: tuple[int, int]) -> list[FloatArray]:
    return [error for term in coherent for error in term.independent_errors(shape)]


def _adaptive_evidence(earlier: LWPRSurface, later: LWPRSurface, grid: Grid) -> Evidence:
    west, _, south, _ = grid.region
    lattice = Lattice(
        0.0, grid.resolution, round(south / grid.resolution), round(west / grid.resolution), grid.n_rows, grid.n_cols
    )
    kernels = (earlier.own_kernel_, later.own_kernel_)
    return _north_up(estimate_difference(earlier.own_cells(), later.own_cells(), kernels, lattice))


def _north_up(local: LocalDifference) -> Evidence:
    return Evidence(
        local.difference[::-1],
        local.variance[::-1],
        local.freedom[::-1],
        (local.counts[0][::-1], local.counts[1][::-1]),
        (local.observed[0][::-1], local.observed[1][::-1]),
        (local.terrain[0][::-1], local.terrain[1][::-1]),
        math.sqrt(FIELD_AREA) * local.kernel,
        local.resolution.north_up(),
    )


def _reference_evidence(earlier: ReferenceLWPR, later: ReferenceLWPR, grid: Grid) -> Evidence:
    coordinates = grid.coordinates()

    def raster(values: FloatArray) -> FloatArray:
        return values.reshape(grid.shape)

    first, second = earlier.predict(coordinates), later.predict(coordinates)
    counts = raster(earlier.observed(coordinates)), raster(later.observed(coordinates))
    observed = tuple(
        (count >= _REFERENCE_MINIMUM) & np.isfinite(raster(p.elevation))
        for count, p in zip(counts, (first, second), strict=True)
    )
    elevation = np.nan_to_num(0.5 * raster(first.elevation + second.elevation))
    widths = [np.full(grid.shape, _GAUSSIAN_WIDTH * model.kernel_size) for model in (earlier, later)]
    north, east = np.gradient(elevation, grid.resolution) if min(grid.shape) > 1 else (elevation * 0.0,) * 2
    return Evidence(
        raster(second.elevation - first.elevation),
        raster(first.elevation_std**2 + second.elevation_std**2),
        np.maximum(np.minimum(counts[0], counts[1]) - 3.0, 1.0),
        counts,
        (observed[0], observed[1]),
        (elevation, np.hypot(north, east)),
        max(earlier.kernel_size, later.kernel_size) * math.sqrt(4.0 * math.pi),
        Resolution(widths[0], widths[1], np.full(grid.shape, np.nan)),
    )
