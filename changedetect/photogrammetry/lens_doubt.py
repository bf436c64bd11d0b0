"""
Lens parameters that are not adjusted, and how far they may be wrong.

A lens that is taken as given is not exact: a calibration leaves a tenth of a pixel at the rim, and what no model
describes (a shutter that rolls, a picture straightened in the camera) is of that size too. Near-vertical photos turn
such an error into a bending of the ground without showing it in the residuals. Each parameter that is not adjusted is
therefore considered [1]_: it stays as it is, but the covariance of poses and points contains its variance. That
variance is at least what was known of the parameter before. Where the photos contradict the value given, it grows to
the size of the contradiction, for then the model lacks something and the parameter takes its part.

References
----------
.. [1] Schmidt (1966), Application of state-space methods to navigation problems, Advances in Control Systems 3.
.. [2] Tipping, Faul (2003), Fast marginal likelihood maximisation for sparse Bayesian models, AISTATS 9.
.. [3] Birge (1932), The calculation of errors by the method of least squares, doi:10.1103/PhysRev.40.207.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh

from changedetect.kernels.projection import N_CALIBRATION, projection_jacobian
from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.lens import normalise
from changedetect.typing import BoolArray, FloatArray

__all__ = ["considered_covariance", "contradiction", "corner_units", "doubted_variance"]

logger = logging.getLogger(__name__)

_SWEEPS = 20
#: Standard errors that the photos' estimate of a parameter must differ by from the value given to speak against it.
_CONTRADICTS = 3.0
#: Modes of which photos know between this share and this multiple of what navigation knows, in variance.
_WEAKEST, _STRONGEST = 0.1, 10.0


def corner_units(block: ImageBlock) -> FloatArray:
    """
    Standard deviations of lens parameters that together move a corner of the photo by one pixel, shape (n_lenses, 9).

    Parameters
    ----------
    block : ImageBlock
    """
    jacobian: Any = projection_jacobian
    units = np.empty((len(block.intrinsics), N_CALIBRATION))
    for lens, (intrinsics, size) in enumerate(zip(block.intrinsics, block.size, strict=True)):
        width, height = size - 1.0
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        moves = np.zeros((4, N_CALIBRATION))
        for k, flat in enumerate(normalise(corners, intrinsics)):
            by_point, by_pose, by_lens = np.empty((2, 3)), np.empty((2, 6)), np.empty((2, N_CALIBRATION))
            jacobian(np.append(flat, 1.0), np.eye(3), np.zeros(3), intrinsics, by_point, by_pose, by_lens)
            moves[k] = np.linalg.norm(by_lens, axis=0)
        units[lens] = 1.0 / (moves.max(axis=0) * np.sqrt(N_CALIBRATION))
    return units


def doubted_variance(information: FloatArray, gradient: FloatArray, known: FloatArray) -> FloatArray:
    """
    Variance of parameters about the values given, by marginal likelihood, no less than what was known before.

    Parameters
    ----------
    information : array, shape (k, k)
        What the photos alone say of the parameters, all unknowns that are adjusted eliminated.
    gradient : array, shape (k,)
        Its right-hand side: the photos' estimate solves ``information @ x = gradient``.
    known : array, shape (k,)
        Variance known before.

    Returns
    -------
    variance : array, shape (k,)

    Notes
    -----
    Of one parameter, the others drawn from their priors, the photos know q = s x + noise of variance s; the likelihood
    of a prior variance a is largest at a = (q^2 - s) / s^2, eq. 20 of [2]_. One parameter after the other, until they
    stand; only what differs by three standard errors, q^2 > 9 s, is believed to be a contradiction.
    """
    std = np.sqrt(known)
    matrix, right = information * np.outer(std, std), gradient * std
    factor = np.ones(known.size)
    for _ in range(_SWEEPS):
        before = factor.copy()
        for k in range(known.size):
            others = np.arange(known.size) != k
            inner = matrix[np.ix_(others, others)] + np.diag(1.0 / factor[others])
            cross = np.linalg.solve(inner, matrix[others, k])
            s = float(matrix[k, k] - matrix[others, k] @ cross)
            q = float(right[k] - right[others] @ cross)
            factor[k] = max(1.0, (q * q - s) / (s * s)) if q * q > _CONTRADICTS**2 * s else 1.0
        if np.allclose(before, factor, rtol=1e-3):
            break
    return np.asarray(known * factor)


def contradiction(whole: FloatArray, prior: FloatArray, deviation: FloatArray) -> FloatArray:
    """
    Covariance to add in the modes in which photos and navigation contradict each other.

    Parameters
    ----------
    whole : array, shape (n, n)
        Normal matrix of the adjusted unknowns, photos and priors.
    prior : array, shape (n, n)
        The priors alone.
    deviation : array, shape (n,)
        Adjusted values less what the priors expect.

    Returns
    -------
    added : array, shape (n, n)

    Notes
    -----
    In the modes v of N_photos v = l P v, v' P v = 1, photos and priors are independent estimates of variance 1 / l and
    1, which differ by d. Where neither outweighs the other, in the bending of a block above all, the mean of
    d^2 / (1 + 1 / l) tells whether both are as exact as they claim; if it is larger than one, it multiplies the
    variance 1 / (1 + l) of these modes (the Birge ratio [3]_). Modes that one side alone knows hold no such test.
    """
    unit = 1.0 / np.sqrt(np.diag(prior))
    scale = np.outer(unit, unit)
    ratio, modes = eigh(whole * scale, prior * scale, subset_by_value=(1.0 + _WEAKEST, 1.0 + _STRONGEST))
    if ratio.size == 0:
        return np.zeros_like(whole)
    modes = unit[:, None] * modes
    moved = modes.T @ (prior @ deviation)
    squared = moved**2 * ratio / (ratio - 1.0)
    excess = max(float(np.mean(squared)) - 1.0, 0.0)
    if excess > 0:
        logger.info(
            "photos and navigation differ by %.1f standard deviations in %d modes",
            float(np.sqrt(1 + excess)),
            ratio.size,
        )
    return np.asarray((modes * (excess / ratio)) @ modes.T)


def considered_covariance(
    whole: FloatArray, gradient: FloatArray, prior: FloatArray, free: BoolArray, known: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Covariance of what is adjusted, with the error of parameters that are only considered.

    Parameters
    ----------
    whole, prior : array, shape (n, n)
        Normal matrix of all unknowns, and the part of it that is priors; these do not couple the considered ones.
    gradient : array, shape (n,)
    free : array, shape (n,), bool
        Unknowns that are adjusted.
    known : array, shape (n,)
        Variance known before of those considered; zero for all others.

    Returns
    -------
    covariance : array, shape (n, n)
        Zero for unknowns that are neither adjusted nor considered.
    slope : array, shape (n, n)
        How unknowns (rows) follow those considered (columns).
    variance : array, shape (n,)
        Of those considered, from `doubted_variance`.

    Notes
    -----
    Of adjusted x and considered c, N the normal matrix and P the variance of c: dx / dc = S = -N_xx^-1 N_xc,
    cov(x) = N_xx^-1 + S P S^T, cov(x, c) = S P (Schmidt's consider covariance [1]_).
    """
    x, c = np.flatnonzero(free), np.flatnonzero(known > 0)
    factor = cho_factor(whole[np.ix_(x, x)], check_finite=False)
    out, slopes, variance = np.zeros_like(whole), np.zeros_like(whole), np.zeros(len(whole))
    out[np.ix_(x, x)] = cho_solve(factor, np.eye(x.size))
    if c.size == 0:
        return out, slopes, variance
    cross = whole[np.ix_(x, c)]
    slope = -np.asarray(cho_solve(factor, cross))
    information = (whole - prior)[np.ix_(c, c)] + cross.T @ slope
    right = gradient[c] + slope.T @ gradient[x]
    variance[c] = doubted_variance(0.5 * (information + information.T), right, known[c])
    slopes[np.ix_(x, c)], slopes[c, c] = slope, 1.0
    return out + (slopes * variance) @ slopes.T, slopes, variance
