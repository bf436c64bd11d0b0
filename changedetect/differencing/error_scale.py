"""
Scale of the errors of a difference beyond the independent ones, found on ground that may hold change.

The difference d of a cell is a draw from a mixture: an error of variance V + s2 with Student's t tails, or, with a
probability that is estimated too, a change of any size. V is the known variance from independent errors; s2 grows
with what makes the ground hard to survey.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

if TYPE_CHECKING:
    from collections.abc import Mapping

    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["ErrorScale", "Sample", "fit_scale", "half_width_scale", "select_scale"]

#: Degrees of freedom of the tails that are tried; infinite is the normal distribution.
_FREEDOMS = (3.0, 4.0, 6.0, 10.0, math.inf)
#: Standard deviation of the exponents, for covariates in units of their own scatter, before any data are seen.
_EXPONENT_STD = 0.5
#: Lower end of s2, in the typical variance of independent errors: nothing.
_LEAST_RATIO = 1e-3
#: Exponents of the standardised covariates, and the covariates themselves, stay within these limits.
_LARGEST_EXPONENT = 3.0
_LARGEST_COVARIATE = 3.0
#: Log-likelihood, in independent observations, that heavier tails must gain on held-out blocks ...
_LEAST_GAIN = 1.0
#: ... and in standard errors of that gain.
_LEAST_GAIN_ERRORS = 2.5
#: Heavier tails stay with this gain, in its standard errors.
_KEPT_GAIN_ERRORS = 1.0
_N_FOLDS = 4


@dataclass(frozen=True)
class Sample:
    """
    Cells the scale is estimated from.

    Attributes
    ----------
    squared, variance : array, shape (n,), m2
        Squared difference, and the part of its variance due to independent errors.
    covariates : mapping of name to array, shape (n,)
    block : array, shape (n,), int
        Number of the block of ground each cell lies in, from 0; blocks are held out as a whole.
    n_independent : float
        How many independent values the cells are worth.
    background : float, 1/m
        Density of real change: uniform over what differences occur.
    start : float, m
        First guess of the scale of all errors.
    """

    squared: FloatArray
    variance: FloatArray
    covariates: Mapping[str, FloatArray]
    block: IntArray
    n_independent: float
    background: float
    start: float


@dataclass(frozen=True)
class ErrorScale:
    """
    Scale of the correlated errors, s2 = exp(level + sum_k exponents[k] c_k), c_k the standardised covariates.

    Attributes
    ----------
    level : float
        Logarithm of s2, m2, on ground where all covariates are at their median.
    names : tuple of str
        Covariates that matter.
    exponents, centres, widths : tuple of float
        Of each of these: exponent, median, standard deviation.
    freedom : float
        Degrees of freedom of Student's t whose scale this is; infinite for normal errors.
    changed_share : float
        Share of the sample taken for change.
    """

    level: float
    names: tuple[str, ...] = ()
    exponents: tuple[float, ...] = ()
    centres: tuple[float, ...] = ()
    widths: tuple[float, ...] = ()
    freedom: float = math.inf
    changed_share: float = 0.0

    def variance(self, covariates: Mapping[str, FloatArray]) -> FloatArray | float:
        """
        Evaluate s2, m2.

        Parameters
        ----------
        covariates : mapping of name to array
            All of `names`, of one shape. Values far outside the sample count as its ends.
        """
        if not self.names:
            return math.exp(self.level)
        total: FloatArray | float = self.level
        for name, exponent, centre, width in zip(self.names, self.exponents, self.centres, self.widths, strict=True):
            total = total + exponent * _standardised(covariates[name], centre, width)
        return np.exp(total)


def half_width_scale(values: FloatArray) -> tuple[float, float]:
    """
    Centre and scale of the majority of values: of the shortest interval that holds half of them.

    Parameters
    ----------
    values : array, shape (n,)

    Returns
    -------
    centre, scale : float
        The scale is consistent for normal values.

    Notes
    -----
    Breaks down only when half of the values are foreign (Rousseeuw and Leroy 1987).
    """
    ordered = np.sort(values)
    half = ordered.size // 2 + 1
    widths = ordered[half - 1 :] - ordered[: ordered.size - half + 1]
    k = int(np.argmin(widths))
    return 0.5 * float(ordered[k] + ordered[k + half - 1]), float(widths[k]) / 1.349


def fit_scale(sample: Sample, freedom: float) -> ErrorScale:
    """
    Scale with given tails, by maximum posterior density.

    Parameters
    ----------
    sample : Sample
    freedom : float

    Returns
    -------
    scale : ErrorScale

    Notes
    -----
    Correlated cells count for the independent values they are worth, against a normal prior of the exponents about
    zero: where few independent values are at hand a covariate would follow the errors of this one sample.
    """
    names = tuple(sample.covariates)
    centres, widths = _centres_and_widths(sample, names)
    design = _design(sample, names, centres, widths)
    every = np.ones(sample.squared.size, bool)
    theta = _maximise(sample, design, every, freedom, _first_guess(sample, design.shape[1]))
    return ErrorScale(
        level=float(theta[0]),
        names=names,
        exponents=tuple(theta[1:-1].tolist()),
        centres=centres,
        widths=widths,
        freedom=freedom,
        changed_share=1.0 / (1.0 + math.exp(-theta[-1])),
    )


def select_scale(sample: Sample, before: float = math.inf) -> ErrorScale:
    """
    Scale with the tails that predict held-out blocks of ground best; normal ones unless others are clearly better.

    Parameters
    ----------
    sample : Sample
    before : float
        Degrees of freedom of the tails when change was looked for that is no longer in the sample.

    Returns
    -------
    scale : ErrorScale

    Notes
    -----
    Tails that were heavy stay so unless normal ones are as good. Ground that is taken out for changed by normal tails
    leaves tails that look normal, and less and less ground from round to round.
    """
    likelihood = {freedom: _held_out(sample, freedom) for freedom in _FREEDOMS}
    best = max(likelihood, key=lambda key: float(likelihood[key].sum()))
    gain = likelihood[best] - likelihood[math.inf]
    total, error = float(gain.sum()), math.sqrt(gain.size) * float(gain.std())
    if math.isinf(before):
        is_clear = total * sample.n_independent > _LEAST_GAIN and total > _LEAST_GAIN_ERRORS * error
    else:
        is_clear = total > _KEPT_GAIN_ERRORS * error
    return fit_scale(sample, best if is_clear else math.inf)


def _held_out(sample: Sample, freedom: float) -> FloatArray:
    """Log-likelihood of each block by a fit to the folds it is not in, over the number of cells of all blocks."""
    names = tuple(sample.covariates)
    design = _design(sample, names, *_centres_and_widths(sample, names))
    every = np.ones(sample.squared.size, bool)
    start = _maximise(sample, design, every, freedom, _first_guess(sample, design.shape[1]))
    n_blocks = int(sample.block.max()) + 1
    # a fixed permutation, so that neighbouring blocks fall into different folds
    fold = (np.random.default_rng(5).permutation(n_blocks) % _N_FOLDS)[sample.block]
    likelihood = np.zeros(sample.squared.size)
    for k in range(_N_FOLDS):
        held = fold == k
        if held.any() and not held.all():
            theta = _maximise(sample, design, ~held, freedom, start)
            likelihood[held] = -_costs(theta, sample, design, held, freedom)[0]
    return np.bincount(sample.block, likelihood, n_blocks) / likelihood.size


def _standardised(values: FloatArray, centre: float, width: float) -> FloatArray:
    return np.clip((values - centre) / width, -_LARGEST_COVARIATE, _LARGEST_COVARIATE)


def _centres_and_widths(sample: Sample, names: tuple[str, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    columns = [sample.covariates[name] for name in names]
    return (
        tuple(float(np.median(c)) for c in columns),
        tuple(max(float(np.std(c)), 1e-6) for c in columns),
    )


def _design(
    sample: Sample, names: tuple[str, ...], centres: tuple[float, ...], widths: tuple[float, ...]
) -> FloatArray:
    columns = [
        _standardised(sample.covariates[name], centre, width)
        for name, centre, width in zip(names, centres, widths, strict=True)
    ]
    return np.column_stack([np.ones(sample.squared.size), *columns])


def _costs(
    theta: FloatArray, sample: Sample, design: FloatArray, part: BoolArray, freedom: float
) -> tuple[FloatArray, FloatArray]:
    """
    Negative log-likelihood of each cell of a part of the sample, and its mean gradient in theta.

    theta holds the logarithmic level, the exponents and the logit of the share of change.
    """
    x, squared = design[part], sample.squared[part]
    share = 1.0 / (1.0 + math.exp(-theta[-1]))
    s2 = np.exp(np.clip(x @ theta[:-1], -60.0, 40.0))
    total = sample.variance[part] + s2
    if math.isinf(freedom):
        log_density = -0.5 * (squared / total + np.log(2.0 * math.pi * total))
        slope = 0.5 * (squared / total - 1.0) / total
    else:
        q = squared / (freedom * total)
        constant = float(gammaln(0.5 * (freedom + 1.0)) - gammaln(0.5 * freedom)) - 0.5 * math.log(freedom * math.pi)
        log_density = constant - 0.5 * np.log(total) - 0.5 * (freedom + 1.0) * np.log1p(q)
        slope = (-0.5 + 0.5 * (freedom + 1.0) * q / (1.0 + q)) / total
    density = np.exp(log_density)
    mixed = (1.0 - share) * density + share * sample.background
    responsibility = (1.0 - share) * density / mixed
    by_scale = x.T @ (responsibility * slope * s2)
    by_share = np.sum((sample.background - density) / mixed) * share * (1.0 - share)
    return -np.log(mixed), -np.append(by_scale, by_share) / squared.size


def _maximise(sample: Sample, design: FloatArray, part: BoolArray, freedom: float, start: FloatArray) -> FloatArray:
    least = math.log(_LEAST_RATIO * float(np.median(sample.variance)))
    weight = 1.0 / (_EXPONENT_STD**2 * sample.n_independent)

    def objective(theta: FloatArray) -> tuple[float, FloatArray]:
        costs, gradient = _costs(theta, sample, design, part, freedom)
        exponents = theta[1:-1]
        gradient[1:-1] += weight * exponents
        return float(costs.mean()) + 0.5 * weight * float(exponents @ exponents), gradient

    limits = (-_LARGEST_EXPONENT, _LARGEST_EXPONENT)
    bounds = [(least, None), *[limits] * (design.shape[1] - 1), (-8.0, 0.5)]
    found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-8})
    return np.asarray(found.x, np.float64)


def _first_guess(sample: Sample, n_columns: int) -> FloatArray:
    typical = float(np.median(sample.variance))
    start = np.zeros(n_columns + 1)
    start[0] = math.log(max(sample.start**2 - typical, 0.05 * typical))
    start[-1] = -2.0
    return start
