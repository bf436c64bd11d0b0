"""Correlation of the errors of block means, estimated by restricted maximum likelihood."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize

from changedetect.kernels.coregistration import restricted_likelihood

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["BlockErrors", "fit_block_errors"]

#: Correlation lengths tried first, from half a block to this part of the extent; longer ones are beyond the data.
_LONGEST_RANGE = 0.4
_N_RANGES = 6
_SHARES = (0.2, 0.5, 0.8, 0.95)
#: Evaluations of the likelihood that refine the best of these.
_N_REFINEMENTS = 40
#: Correlation is taken to be there where it raises the log-likelihood by more than its two parameters would by
#: chance (Akaike); without this threshold white noise had its standard errors overstated by a fifth.
_LIKELIHOOD_GAIN = 2.0
#: Exponents of the distance in the correlation functions exp(-d / a) and exp(-d2 / (2 a2)).
_EXPONENTS = (1, 2)


@dataclass(frozen=True)
class BlockErrors:
    """
    Covariance of the errors of block means.

    Attributes
    ----------
    variance : float, m2
        Of a block of the typical number of observations.
    share : float, 0 to 1
        Part of it that is correlated from block to block.
    length : float, m
        Correlation length a.
    exponent : {1, 2}
        Correlation exp(-d / a) or exp(-d2 / (2 a2)).
    log_likelihood : float
        Restricted, less a constant.
    """

    variance: float
    share: float
    length: float
    exponent: int
    log_likelihood: float

    @property
    def is_correlated(self) -> bool:
        """Whether neighbouring blocks share any error."""
        return self.share > 0.0

    def covariance(self, distance: FloatArray, dilution: FloatArray) -> FloatArray:
        """Covariance matrix, shape (m, m), m2; for the arguments see `fit_block_errors`."""
        return self.variance * _pattern(distance, dilution, self.share, self.length, self.exponent)

    def derivatives(self, distance: FloatArray, dilution: FloatArray) -> list[FloatArray]:
        """Derivatives of the covariance with respect to the parameters that were estimated."""
        if not self.is_correlated:
            return [self.covariance(distance, dilution)]
        shared = self.variance * _correlation(distance, self.length, self.exponent)
        step = 1e-3
        lengths = (self.length * math.exp(step), self.length * math.exp(-step))
        longer, shorter = (self.share * self.variance * _correlation(distance, a, self.exponent) for a in lengths)
        return [np.diag(self.variance * dilution), shared, (longer - shorter) / (2.0 * step)]

    def information(self, design: FloatArray, distance: FloatArray, dilution: FloatArray) -> FloatArray:
        """
        Fisher information of the parameters of `derivatives`.

        Notes
        -----
        Half the trace of P C_i P C_j, with P the projection of restricted likelihood.
        """
        inverse = np.linalg.inv(self.covariance(distance, dilution))
        weighted = inverse @ design
        projection = inverse - weighted @ np.linalg.solve(design.T @ weighted, weighted.T)
        products = [projection @ derivative for derivative in self.derivatives(distance, dilution)]
        return np.array([[0.5 * float(np.sum(a * b.T)) for b in products] for a in products])


def fit_block_errors(
    means: FloatArray,
    design: FloatArray,
    distance: FloatArray,
    dilution: FloatArray,
    side: float,
    start: BlockErrors | None = None,
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
    start : BlockErrors, optional
        A good guess; the shape of the correlation is then taken from it.

    Returns
    -------
    errors : BlockErrors

    Notes
    -----
    cov = variance ((1 - share) diag(dilution) + share R), R exponential or Gaussian, by restricted maximum likelihood
    [1]_: unlike a variogram it allows for the mean and tilt that were taken out, which matters when the area holds a
    few tens of correlation lengths only. Errors that correlate over less than a block end up in its own variance.

    References
    ----------
    .. [1] H. D. Patterson, R. Thompson (1971), Recovery of inter-block information when block sizes are unequal,
       Biometrika 58, 545-554.
    """
    problem = _Likelihood(np.column_stack([design, means]), distance, dilution)
    shortest, longest = 0.5 * side, max(_LONGEST_RANGE * float(distance.max()), side)
    best = problem.evaluate(0.0, shortest, 2)
    guesses: list[tuple[float, float, int]] = []
    if start is None:
        lengths = np.geomspace(shortest, longest, _N_RANGES)
        guesses = [(share, float(a), p) for p in _EXPONENTS for a in lengths for share in _SHARES]
    elif start.is_correlated:
        guesses = [(start.share, float(np.clip(start.length, shortest, longest)), start.exponent)]
    guess = max((problem.evaluate(*g) for g in guesses), key=_log_likelihood, default=best)
    if not guesses:
        return best
    found = max(guess, problem.refined(guess, shortest, longest), key=_log_likelihood)
    return found if found.log_likelihood > best.log_likelihood + _LIKELIHOOD_GAIN else best


def _log_likelihood(errors: BlockErrors) -> float:
    return errors.log_likelihood


@dataclass(frozen=True)
class _Likelihood:
    """The restricted likelihood of block means; columns are the design and the means."""

    columns: FloatArray
    distance: FloatArray
    dilution: FloatArray

    def evaluate(self, share: float, length: float, exponent: int) -> BlockErrors:
        likelihood, variance = restricted_likelihood(
            self.columns, self.distance, self.dilution, share, length, exponent
        )
        return BlockErrors(variance, share, length, exponent, likelihood)

    def refined(self, guess: BlockErrors, shortest: float, longest: float) -> BlockErrors:
        def at(parameters: FloatArray) -> BlockErrors:
            length = math.exp(float(np.clip(parameters[0], math.log(shortest), math.log(longest))))
            share = 1.0 / (1.0 + math.exp(-float(np.clip(parameters[1], -8.0, 8.0))))
            return self.evaluate(share, length, guess.exponent)

        first = np.array([math.log(guess.length), math.log(guess.share / (1.0 - guess.share))])
        options = {"maxfev": _N_REFINEMENTS, "xatol": 0.03, "fatol": 0.02}
        found = minimize(lambda p: -at(p).log_likelihood, first, method="Nelder-Mead", options=options)
        return at(found.x)


def _correlation(distance: FloatArray, length: float, exponent: int) -> FloatArray:
    scaled = distance / length
    correlation: FloatArray = np.exp(-scaled) if exponent == 1 else np.exp(-0.5 * scaled**2)
    return correlation


def _pattern(distance: FloatArray, dilution: FloatArray, share: float, length: float, exponent: int) -> FloatArray:
    """Covariance for a variance of one; a trace of white noise keeps a smooth correlation positive definite."""
    pattern = share * _correlation(distance, length, exponent) if share > 0.0 else np.zeros_like(distance)
    pattern[np.diag_indices_from(pattern)] += (1.0 - share) * dilution + 1e-6
    return pattern
