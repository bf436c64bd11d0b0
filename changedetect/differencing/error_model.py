"""
Errors of a difference: independent ones, correlated ones, and what co-registration leaves.

Observations carry independent errors, whose variance the estimator of the difference knows. Real surveys also carry
errors that are correlated over metres to hundreds of metres: strips, poses, cover. They are estimated on ground that
did not change, found robustly or given: how large they are as a function of what makes ground hard to survey, and
over what distances they are shared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing.blocks import expand, standardise
from changedetect.differencing.candidates import find_candidates
from changedetect.differencing.coarse import block_means
from changedetect.differencing.correlation import NestedCorrelation, fit_correlation
from changedetect.differencing.error_scale import ErrorScale, Sample, fit_scale, half_width_scale, select_scale
from changedetect.differencing.lags import CellScores, collect_pairs, standardised_scores
from changedetect.differencing.stable_ground import find_changed
from changedetect.differencing.stencil import choose_stencil

if TYPE_CHECKING:
    from collections.abc import Mapping

    from changedetect.typing import BoolArray, FloatArray, IntArray, JSONObject

__all__ = ["ErrorModel", "TooLittleGroundError", "estimate_errors"]

#: Cells the scale is estimated from, and those that looking for change starts with.
_N_SAMPLE = 15_000
#: Cells that means over all ground are taken from, at most.
_N_MEANS = 500_000
#: Rounds of: scale, correlation, changed ground.
_ROUNDS = 4
#: Rounds more, in which changed ground is told by what the ground around says.
_LATER_ROUNDS = 2
#: Rounds end when less than this part of the ground comes or goes.
_SETTLED = 2e-3
#: Part of the known ground that must be left.
_LEAST_SHARE = 0.3
#: Tails assumed while change has not been looked for.
_FIRST_FREEDOM = 4.0
#: Blocks of ground that are held out in turn: this many where errors are correlated over short distances.
_N_BLOCKS = 100
#: Side of a block in correlation lengths, at least.
_BLOCK_LENGTHS = 1.0
#: Below this share of the variance correlated errors are nothing.
_NEGLIGIBLE_SHARE = 0.01
#: Ground is given or found; less than this number of cells cannot tell.
_LEAST_CELLS = 200
#: Ranges longer than this part of the extent cannot be told from a constant.
_LONGEST_RANGE = 0.25


class TooLittleGroundError(ValueError):
    """The ground that is given as stable was hardly observed by both epochs."""


@dataclass(frozen=True)
class ErrorModel:
    """
    Variance and correlation of the errors of one difference.

    Attributes
    ----------
    local : NestedCorrelation
        Correlation of the estimates' independent errors: neighbouring cells share observations.
    scale : ErrorScale
        Scale of the correlated errors.
    correlation : NestedCorrelation
        Their covariance in units of that scale squared; more than one in total where tails are heavy. No parts where
        no correlated errors were found.
    n_independent : float
        How many independent values the scale was estimated from.
    stable_share : float
        Share of the ground that took part.
    """

    local: NestedCorrelation
    scale: ErrorScale
    correlation: NestedCorrelation
    n_independent: float
    stable_share: float

    @property
    def is_correlated(self) -> bool:
        """Whether correlated errors were found at all."""
        return bool(self.correlation.ranges)

    def correlated_variance(self, covariates: Mapping[str, FloatArray], shape: tuple[int, int]) -> FloatArray:
        """
        Squared scale of the correlated errors, m2.

        Parameters
        ----------
        covariates : mapping of name to array, shape (n_rows, n_cols)
        shape : (n_rows, n_cols)

        Returns
        -------
        variance : array, shape (n_rows, n_cols)
        """
        if not self.is_correlated:
            return np.zeros(shape)
        return np.asarray(np.broadcast_to(self.scale.variance(covariates), shape))

    def document(self) -> JSONObject:
        """Return what the model says, for people and files; `grows_with` holds exponents of the standard deviation."""
        exponents = dict(zip(self.scale.names, (0.5 * e for e in self.scale.exponents), strict=True))
        return {
            "correlated_std_m": math.exp(0.5 * self.scale.level) if self.is_correlated else 0.0,
            "grows_with": exponents if self.is_correlated else {},
            "degrees_of_freedom": None if math.isinf(self.scale.freedom) else self.scale.freedom,
            "ranges_m": list(self.correlation.ranges),
            "range_shares": list(self.correlation.normalised().shares),
            "n_independent": self.n_independent,
            "stable_share": self.stable_share,
        }


def estimate_errors(
    difference: FloatArray,
    variance: FloatArray,
    covariates: Mapping[str, FloatArray],
    resolution: float,
    local_range: float,
    stable: BoolArray | None = None,
) -> tuple[ErrorModel, BoolArray]:
    """
    Estimate the error model of a difference.

    Parameters
    ----------
    difference : array, shape (n_rows, n_cols), m
        Of aligned epochs; NaN where it is not known.
    variance : array, shape (n_rows, n_cols), m2
        Its variance from independent errors alone.
    covariates : mapping of name to array, shape (n_rows, n_cols)
        What errors may grow with, in logarithms; finite where the difference is.
    resolution : float, m
    local_range : float, m
        Range of the Gaussian that the correlation of neighbouring estimates resembles.
    stable : array, shape (n_rows, n_cols), bool, optional
        Ground known not to have changed. Otherwise it is found.

    Returns
    -------
    model : ErrorModel
    stable : array, bool
        The ground that took part.

    Raises
    ------
    TooLittleGroundError
        The given stable ground holds too few known cells.

    Notes
    -----
    Starting from all ground with heavy tails: the scale by maximum likelihood of errors mixed with change, the
    correlation from products of standardised differences, then the regions that are significant against both are
    taken out, and again. All ground takes part otherwise; nothing is trimmed by size, which would make the estimate
    smaller from round to round.
    """
    known = np.isfinite(difference) & (variance > 0.0)
    if stable is not None and np.count_nonzero(known & stable) < _LEAST_CELLS:
        n = np.count_nonzero(known & stable)
        msg = f"stable ground holds {n} cells that both epochs observed; at least {_LEAST_CELLS} are needed"
        raise TooLittleGroundError(msg)
    ground = known if stable is None else known & stable
    model = ErrorModel(
        NestedCorrelation((local_range,), (1.0,)), ErrorScale(-math.inf), NestedCorrelation((), ()), 1.0, 0.0
    )
    if np.count_nonzero(ground) < _LEAST_CELLS:
        return model, ground
    for k in range(_ROUNDS):
        model = _estimate_round(difference, variance, covariates, ground, resolution, model, n_before=k)
        if stable is None and k < _ROUNDS - 1:
            correlated = model.correlated_variance(covariates, difference.shape)
            correlations = (model.local, model.correlation.normalised())
            changed = find_changed(
                np.where(known, difference, np.nan), (variance, correlated), correlations, model.scale.freedom,
                resolution, local_range,
            )  # fmt: skip
            left = known & ~changed
            settled = k > 0 and _is_settled(left, ground)
            if settled or np.count_nonzero(left) < _LEAST_CELLS:
                break
            ground = left
    if stable is None and model.is_correlated:
        model, ground = _estimate_again(difference, variance, covariates, known, ground, resolution, model)
    return replace(model, stable_share=float(np.count_nonzero(ground) / np.count_nonzero(known))), ground


def _estimate_again(
    difference: FloatArray,
    variance: FloatArray,
    covariates: Mapping[str, FloatArray],
    known: BoolArray,
    ground: BoolArray,
    resolution: float,
    model: ErrorModel,
) -> tuple[ErrorModel, BoolArray]:
    """
    Model and ground once more, without what the ground around shows to have changed.

    A change of one or two standard deviations of the correlated errors is not conspicuous by itself. It is against its
    prediction from the ground around.
    """
    changed = known & ~ground
    for k in range(_LATER_ROUNDS + 1):
        # what is predicted has the whole variance, of which the scale of heavy tails is a part
        correlated = max(model.correlation.variance, 1.0) * model.correlated_variance(covariates, known.shape)
        variances = (variance, np.where(known, correlated, 1.0))
        correlations = (model.local, model.correlation.normalised())
        finest = standardise(np.where(known, difference, 0.0), variances, known, resolution)
        chosen = choose_stencil(correlations[1], correlations[0], finest)
        if chosen is None:
            break
        given = np.nan_to_num(block_means(changed.astype(np.float64), known, finest.factor)[0]) > 0.5
        found = find_candidates(finest, chosen[0], correlations, given)
        left = known & ~expand(found, finest.factor, known.shape)
        settled = _is_settled(left, ground)
        if settled or np.count_nonzero(left) < max(_LEAST_CELLS, _LEAST_SHARE * np.count_nonzero(known)):
            break
        ground = left
        if k == _LATER_ROUNDS:
            break
        later = _estimate_round(difference, variance, covariates, ground, resolution, model, n_before=_ROUNDS)
        if not later.is_correlated:
            break
        model = later
    return model, ground


def _is_settled(left: BoolArray, before: BoolArray) -> bool:
    """Whether ground is so nearly what it was that errors estimated on it will be too."""
    return bool(np.count_nonzero(left != before) <= _SETTLED * np.count_nonzero(before))


def _estimate_round(
    difference: FloatArray,
    variance: FloatArray,
    covariates: Mapping[str, FloatArray],
    ground: BoolArray,
    resolution: float,
    before: ErrorModel,
    *,
    n_before: int,
) -> ErrorModel:
    rng = np.random.default_rng(11)
    area = float(np.count_nonzero(ground)) * resolution**2
    n_independent = max(area / max(_squared_area(before), resolution**2), 1.0)
    sample = _draw_sample(difference, variance, covariates, ground, resolution, n_independent, before, rng)
    if n_before == 0:
        scale = fit_scale(sample, _FIRST_FREEDOM)
    else:
        # those of the first round were assumed
        scale = select_scale(sample, before.scale.freedom if n_before > 1 else math.inf)
    cells = [np.asarray(values).ravel() for values in (difference, variance)]
    columns = {name: np.asarray(values).ravel() for name, values in covariates.items()}

    def at(places: IntArray) -> CellScores:
        correlated = scale.variance({name: values[places] for name, values in columns.items()})
        return standardised_scores(cells[0][places], cells[1][places], correlated, scale.freedom)

    places = np.flatnonzero(ground)
    every = at(places if places.size <= _N_MEANS else rng.choice(places, _N_MEANS, replace=False)).counting()
    correlated_share = float(np.mean(every.correlated**2)) if every.score.size else 0.0
    if correlated_share < _NEGLIGIBLE_SHARE:
        return replace(before, scale=scale, correlation=NestedCorrelation((), ()), n_independent=n_independent)
    pairs = collect_pairs(at, ground, resolution, rng)
    excess = float(np.mean(every.score**2) - np.mean(every.local**2)) / correlated_share
    extent = resolution * min(difference.shape)
    correlation = fit_correlation(
        pairs, before.local, max(excess, 0.0) * pairs.strength, before.local.ranges[0], _LONGEST_RANGE * extent
    )
    return replace(before, scale=scale, correlation=correlation, n_independent=n_independent)


def _squared_area(model: ErrorModel) -> float:
    dominant = model.correlation if model.is_correlated else model.local
    return dominant.squared_area()


def _draw_sample(
    difference: FloatArray,
    variance: FloatArray,
    covariates: Mapping[str, FloatArray],
    ground: BoolArray,
    resolution: float,
    n_independent: float,
    before: ErrorModel,
    rng: np.random.Generator,
) -> Sample:
    places = np.flatnonzero(ground)
    if places.size > _N_SAMPLE:
        places = np.sort(rng.choice(places, _N_SAMPLE, replace=False))
    d = difference.ravel()[places]
    centre, spread = half_width_scale(d)
    start = math.hypot(centre, spread)
    typical = math.sqrt(float(np.median(variance.ravel()[places])))
    # identical epochs differ by nothing anywhere
    widest = max(float(np.percentile(np.abs(d), 99.5)), 10.0 * start, typical)
    area = float(np.count_nonzero(ground)) * resolution**2
    length = math.sqrt(_squared_area(before))
    side = max(math.sqrt(area / _N_BLOCKS), _BLOCK_LENGTHS * length)
    return Sample(
        squared=d**2,
        variance=variance.ravel()[places],
        covariates={name: np.asarray(values).ravel()[places] for name, values in covariates.items()},
        block=_blocks(places, difference.shape, side / resolution),
        n_independent=n_independent,
        background=0.5 / widest,
        start=start,
    )


def _blocks(places: IntArray, shape: tuple[int, int], side: float) -> IntArray:
    """Number of the square block of ground each cell lies in, counted from 0 over those that occur."""
    row, column = places // shape[1], places % shape[1]
    key = (row / side).astype(np.int64) * (int(shape[1] / side) + 1) + (column / side).astype(np.int64)
    return np.unique(key, return_inverse=True)[1].reshape(-1).astype(np.int64)
