"""Covariance of fitted parameters when errors are correlated in space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.coregistration.correlated import fit_block_errors
from changedetect.coregistration.robust import skipping_inflation

if TYPE_CHECKING:
    from changedetect.coregistration.correlated import BlockErrors
    from changedetect.coregistration.squares import Squares
    from changedetect.typing import FloatArray

__all__ = ["Scores", "parameter_covariance"]

#: Degrees of freedom are not stated beyond this: the normal distribution is reached.
_MOST_FREEDOM = 1e6


@dataclass(frozen=True)
class Scores:
    """
    Estimating equations at their solution.

    Attributes
    ----------
    instruments : array, shape (n, k)
        Z; 0 for observations that are left out.
    psi : array, shape (n,), m
        Robustly weighted residuals.
    design : array, shape (n, k)
        Derivative of psi with respect to the parameters.
    kept : array, shape (n,)
        1 for observations that take part, else 0.
    blocks : Squares
    """

    instruments: FloatArray
    psi: FloatArray
    design: FloatArray
    kept: FloatArray
    blocks: Squares

    @property
    def normal(self) -> FloatArray:
        """Derivative of the estimating equations, shape (k, k)."""
        product: FloatArray = self.instruments.T @ self.design
        return product

    def clustered_covariance(self) -> FloatArray:
        """Covariance of the parameters if blocks were independent of each other."""
        sums = self.blocks.total(self.instruments * self.psi[:, None])
        inverse = np.linalg.pinv(self.normal)
        covariance: FloatArray = inverse @ (sums.T @ sums) @ inverse.T
        return covariance


def parameter_covariance(scores: Scores, guess: BlockErrors | None) -> tuple[FloatArray, FloatArray, BlockErrors]:
    """
    Sandwich covariance of the parameters.

    Parameters
    ----------
    scores : Scores
    guess : BlockErrors or None
        Correlation found in a similar fit.

    Returns
    -------
    covariance : array, shape (k, k)
    freedom : array, shape (k,)
        Degrees of freedom of the variances, after Satterthwaite (1946, doi:10.2307/3002019).
    errors : BlockErrors

    Notes
    -----
    With H the derivative of the equations and s their terms, cov = H^-1 cov(sum s) H^-T. The sum is split in two.
    Deviations from the mean of a block: blocks count as independent and their sums give the covariance directly
    (cluster-robust sandwich), whatever the correlation inside a block is. Means of blocks: their errors are correlated
    over distances that may reach over a good part of the area, and summing squares over blocks would miss most of it
    (half of the variance for blocks of 2.5 correlation lengths); their covariance comes from restricted likelihood.
    """
    blocks, k = scores.blocks, scores.design.shape[1]
    counts = blocks.total(scores.kept)
    filled = counts > 0.0
    n = counts[filled]
    between = blocks.total(scores.instruments)[filled]
    means = blocks.total(scores.psi)[filled] / n
    within = blocks.total(scores.instruments * scores.psi[:, None])[filled] - between * means[:, None]
    correction = n.size / max(n.size - k, 1)

    northing, easting = blocks.row[filled] * blocks.side, blocks.column[filled] * blocks.side
    distance = np.hypot(easting[:, None] - easting, northing[:, None] - northing)
    dilution = np.median(n) / n
    design = blocks.total(scores.design)[filled] / n[:, None]
    errors = fit_block_errors(means, design, distance, dilution, blocks.side, guess)

    influence = np.linalg.pinv(scores.normal)
    within_terms = within @ influence.T
    between_terms = between @ influence.T
    covariance = correction * within_terms.T @ within_terms
    between_terms *= math.sqrt(skipping_inflation())
    covariance += between_terms.T @ errors.covariance(distance, dilution) @ between_terms

    # var(sum of a2) = 2 / 3 sum of a4 for normal terms a of known mean zero
    spread = correction**2 * (2.0 / 3.0) * np.sum(within_terms**4, axis=0)
    inverse = np.linalg.pinv(errors.information(design, distance, dilution))
    derivatives = errors.derivatives(distance, dilution)
    gradients = np.array([np.sum(between_terms * (d @ between_terms), axis=0) for d in derivatives])
    spread += np.sum(gradients * (inverse @ gradients), axis=0)
    variance = np.diag(covariance)
    freedom = np.clip(2.0 * variance**2 / np.maximum(spread, 1e-300), 1.0, _MOST_FREEDOM)
    return covariance, freedom, errors
