"""Covariance of fitted parameters when errors are correlated in space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from changedetect.coregistration.estimation import instruments, length_scales
from changedetect.coregistration.stable_ground import CROSSING

if TYPE_CHECKING:
    from changedetect.coregistration.estimation import Fit
    from changedetect.coregistration.sample import Sample
    from changedetect.typing import FloatArray

__all__ = ["BlockErrors", "Uncertainty", "clustered_covariance", "fit_block_errors", "parameter_covariance"]

#: Degrees of freedom are not stated beyond this: the normal distribution is reached.
_MOST_FREEDOM = 1e6
#: Correlation lengths tried first, from half a block to this part of the extent; longer ones are beyond the data.
_LONGEST_RANGE = 0.4
_N_RANGES = 6
_SHARES = (0.2, 0.5, 0.8, 0.95)
#: To this the best of these is refined: relative, in length, odds of the share and log-likelihood.
_REFINEMENT = 0.03
#: Correlation is taken to be there where it raises the log-likelihood by more than its two parameters would by
#: chance (Akaike); without this threshold white noise had its standard errors overstated by a fifth.
_LIKELIHOOD_GAIN = 2.0
#: Exponents p of the correlation functions exp(-d / a) and exp(-d2 / (2 a2)).
_EXPONENTS = (1, 2)


@dataclass(frozen=True)
class BlockErrors:
    """
    Covariance of the errors of block means: variance ((1 - share) diag(dilution) + share R).

    Attributes
    ----------
    variance : float, m2
        Of a block of the typical number of observations.
    share : float, 0 to 1
        Part of it that is correlated from block to block.
    length : float, m
        Correlation length a.
    exponent : {1, 2}
        R is exp(-d / a) or exp(-d2 / (2 a2)).
    log_likelihood : float
        Restricted, less a constant.
    """

    variance: float
    share: float
    length: float
    exponent: int
    log_likelihood: float

    @property
    def decay_length(self) -> float:
        """Distance, m, over which the correlation falls to 1 / e; 0 where there is none."""
        return self.length * math.sqrt(self.exponent) if self.share > 0.0 else 0.0

    def covariance(self, distance: FloatArray, dilution: FloatArray) -> FloatArray:
        """Covariance matrix, shape (m, m), m2; for the arguments see `fit_block_errors`."""
        return self.variance * _pattern(distance, dilution, self.share, self.length, self.exponent)


@dataclass(frozen=True)
class Uncertainty:
    """
    How well the parameters of a fit are known.

    Attributes
    ----------
    covariance : array, shape (k, k)
        In the parameters' units.
    freedom : array, shape (k,)
        Degrees of freedom of each variance.
    errors : BlockErrors
    """

    covariance: FloatArray
    freedom: FloatArray
    errors: BlockErrors


@dataclass(frozen=True)
class _Scores:
    """Estimating equations at their solution, parameters as lengths; rows of observations left out are 0."""

    instruments: FloatArray
    psi: FloatArray
    design: FloatArray
    kept: FloatArray
    influence: FloatArray


def _scores(fit: Fit, sample: Sample, smoothing: float | None) -> _Scores:
    """
    Terms of the equations, and the inverse of their derivative.

    Notes
    -----
    The derivative is Z'X less the part that the means of squares have in it times `CROSSING`: when parameters move,
    some squares cross the threshold beyond which they count as changed (Huber's skipped mean). Without that term
    standard errors come out up to 9 % too small.
    """
    squares = sample.squares
    kept = (fit.residuals.defined & fit.consensus.on_stable_ground(squares)).astype(np.float64)
    scales = length_scales(fit.transform, sample.radius)
    stand_in = instruments(sample, fit, smoothing) * scales * kept[:, None]
    design = fit.consensus.derivative[:, None] * fit.jacobian() * scales
    counts = squares.total(kept)
    per_square = np.divide(1.0, counts, out=np.zeros_like(counts), where=counts > 0.0)
    means = squares.total(stand_in).T @ (per_square[:, None] * squares.total(design))
    influence = np.linalg.pinv((stand_in.T @ design - CROSSING * means).astype(np.float64))
    return _Scores(stand_in, fit.consensus.weight * fit.residuals.residual, design, kept, influence)


def clustered_covariance(fit: Fit, sample: Sample, smoothing: float | None) -> FloatArray:
    """Covariance of the parameters, as lengths, m2, for a choice of instruments if blocks were independent."""
    scores = _scores(fit, sample, smoothing)
    terms = sample.blocks.total(scores.instruments * scores.psi[:, None]) @ scores.influence.T
    covariance: FloatArray = terms.T @ terms
    return covariance


def parameter_covariance(fit: Fit, sample: Sample) -> Uncertainty:
    """
    Sandwich covariance of the parameters.

    Parameters
    ----------
    fit : Fit
    sample : Sample

    Returns
    -------
    uncertainty : Uncertainty
        Degrees of freedom after Satterthwaite (1946, doi:10.2307/3002019).

    Notes
    -----
    With H the derivative of the equations and s their terms, cov = H^-1 cov(sum s) H^-T. The sum is split in two.
    Deviations from the mean of a block: blocks count as independent and their sums give the covariance directly
    (cluster-robust sandwich), whatever the correlation inside a block is. Means of blocks: their errors are correlated
    over distances that may reach over a good part of the area, and summing squares over blocks would miss most of it
    (half of the variance for blocks of 2.5 correlation lengths); their covariance comes from restricted likelihood.
    Where the ground is one wave repeated over the whole area, and errors are correlated over half its length, standard
    errors of the horizontal shift came out up to 30 % too small.
    """
    scores, blocks = _scores(fit, sample, fit.smoothing), sample.blocks
    counts = blocks.total(scores.kept)
    filled = counts > 0.0
    n = counts[filled]
    means = blocks.total(scores.psi)[filled] / n
    between = blocks.total(scores.instruments)[filled]
    within = blocks.total(scores.instruments * scores.psi[:, None])[filled] - between * means[:, None]
    correction = n.size / max(n.size - scores.design.shape[1], 1)

    northing, easting = blocks.row[filled] * blocks.side, blocks.column[filled] * blocks.side
    distance = np.hypot(easting[:, None] - easting, northing[:, None] - northing)
    dilution = np.median(n) / n
    design = blocks.total(scores.design)[filled] / n[:, None]
    errors = fit_block_errors(means, design, distance, dilution, blocks.side)

    within_terms, between_terms = within @ scores.influence.T, between @ scores.influence.T
    covariance = correction * within_terms.T @ within_terms
    covariance += between_terms.T @ errors.covariance(distance, dilution) @ between_terms
    # var(sum of a2) = 2 / 3 sum of a4 for normal terms a of known mean zero
    spread = correction**2 * (2.0 / 3.0) * np.sum(within_terms**4, axis=0)
    spread += _variance_of_variances(errors, design, distance, dilution, between_terms)
    freedom = np.clip(2.0 * np.diag(covariance) ** 2 / np.maximum(spread, 1e-300), 1.0, _MOST_FREEDOM)
    scales = length_scales(fit.transform, sample.radius)
    return Uncertainty(covariance * np.outer(scales, scales), freedom, errors)


def fit_block_errors(
    means: FloatArray, design: FloatArray, distance: FloatArray, dilution: FloatArray, side: float
) -> BlockErrors:
    """
    Estimate how the errors of block means are correlated.

    Parameters
    ----------
    means : array, shape (m,), m
        Mean residual of each block.
    design : array, shape (m, k)
        What the fitted parameters may have taken out of the means; degrees of freedom lost to them are accounted for.
    distance : array, shape (m, m), m
        Between the blocks.
    dilution : array, shape (m,)
        Typical number of observations in a block over that of each block.
    side : float, m
        Of a block.

    Returns
    -------
    errors : BlockErrors

    Notes
    -----
    Restricted maximum likelihood [1]_: unlike a variogram it allows for the mean and tilt that were taken out, which
    matters when the area holds a few tens of correlation lengths only. Errors that correlate over less than a block
    end up in its own variance.

    References
    ----------
    .. [1] H. D. Patterson, R. Thompson (1971), Recovery of inter-block information when block sizes are unequal,
       Biometrika 58, 545-554.
    """

    def at(share: float, length: float, exponent: int) -> BlockErrors:
        likelihood, variance = _likelihood(means, design, _pattern(distance, dilution, share, length, exponent))
        return BlockErrors(variance, share, length, exponent, likelihood)

    shortest, longest = 0.5 * side, max(_LONGEST_RANGE * float(distance.max()), side)
    lengths = np.geomspace(shortest, longest, _N_RANGES)
    uncorrelated = at(0.0, shortest, 2)
    candidates = [at(share, float(a), p) for p in _EXPONENTS for a in lengths for share in _SHARES]
    best = max(candidates, key=lambda errors: errors.log_likelihood)

    def refined(parameters: FloatArray) -> BlockErrors:
        length = math.exp(float(np.clip(parameters[0], math.log(shortest), math.log(longest))))
        return at(1.0 / (1.0 + math.exp(-float(np.clip(parameters[1], -8.0, 8.0)))), length, best.exponent)

    def negative(parameters: FloatArray, /) -> float:
        return -refined(parameters).log_likelihood

    first = np.array([math.log(best.length), math.log(best.share / (1.0 - best.share))])
    found = minimize(negative, first, method="Nelder-Mead", tol=_REFINEMENT)
    best = max(best, refined(np.asarray(found.x)), key=lambda errors: errors.log_likelihood)
    return best if best.log_likelihood > uncorrelated.log_likelihood + _LIKELIHOOD_GAIN else uncorrelated


def _correlation(distance: FloatArray, length: float, exponent: int) -> FloatArray:
    scaled = distance / length
    correlation: FloatArray = np.exp(-scaled) if exponent == 1 else np.exp(-0.5 * scaled**2)
    return correlation


def _pattern(distance: FloatArray, dilution: FloatArray, share: float, length: float, exponent: int) -> FloatArray:
    """Covariance for a variance of one; a trace of white noise keeps a smooth correlation positive definite."""
    pattern = share * _correlation(distance, length, exponent) if share > 0.0 else np.zeros_like(distance)
    pattern[np.diag_indices_from(pattern)] += (1.0 - share) * dilution + 1e-6
    return pattern


def _likelihood(means: FloatArray, design: FloatArray, pattern: FloatArray) -> tuple[float, float]:
    """
    Restricted log-likelihood of means, less a constant, and the variance that maximises it.

    Notes
    -----
    With C = U'U the covariance for a variance of one, X the design and y the means, both multiplied by U'^-1:
    -1/2 ((m - k) log s2 + log det C + log det X'X), s2 the mean square of what X leaves of y. A direction that X
    does not determine takes away no degree of freedom.
    """
    factor = cholesky(pattern, check_finite=False)
    whitened = solve_triangular(factor, np.column_stack([design, means]), trans=1, check_finite=False)
    basis, singular, _ = np.linalg.svd(whitened[:, :-1], full_matrices=False)
    taken = singular > 1e-6 * singular.max(initial=0.0)
    left = whitened[:, -1] - basis[:, taken] @ (basis[:, taken].T @ whitened[:, -1])
    freedom = max(means.size - int(taken.sum()), 1)
    variance = max(float(left @ left) / freedom, 1e-300)
    log_det = 2.0 * float(np.log(np.diag(factor)).sum()) + 2.0 * float(np.log(singular[taken]).sum())
    return -0.5 * (freedom * math.log(variance) + log_det), variance


def _variance_of_variances(
    errors: BlockErrors, design: FloatArray, distance: FloatArray, dilution: FloatArray, terms: FloatArray
) -> FloatArray:
    """
    Variance of terms' C terms because C was estimated, shape (k,).

    Notes
    -----
    Fisher information of the parameters of C: half the trace of P C_i P C_j with C_i the derivatives of C and P the
    projection of restricted likelihood; then the delta method.
    """
    if errors.share > 0.0:
        shared = errors.variance * _correlation(distance, errors.length, errors.exponent)
        step = 1e-3
        lengths = (errors.length * math.exp(step), errors.length * math.exp(-step))
        longer, shorter = (errors.share * errors.variance * _correlation(distance, a, errors.exponent) for a in lengths)
        derivatives = [np.diag(errors.variance * dilution), shared, (longer - shorter) / (2.0 * step)]
    else:
        derivatives = [errors.covariance(distance, dilution)]
    inverse = np.linalg.inv(errors.covariance(distance, dilution))
    weighted = inverse @ design
    projection = inverse - weighted @ np.linalg.pinv(design.T @ weighted) @ weighted.T
    products = [projection @ derivative for derivative in derivatives]
    information = np.array([[0.5 * float(np.sum(a * b.T)) for b in products] for a in products])
    gradients = np.array([np.sum(terms * (d @ terms), axis=0) for d in derivatives])
    spread: FloatArray = np.sum(gradients * (np.linalg.pinv(information) @ gradients), axis=0)
    return spread
