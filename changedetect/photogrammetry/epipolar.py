"""
Which matches of two photos agree with one camera motion.

With rotations known from navigation only the direction of the baseline is unknown, and two matches determine it: for
viewing rays r1, r2 in ground axes every true match has t . (r1 x r2) = 0. Without rotations the fundamental matrix
needs seven. A point that itself moves along the baseline passes either test; only a third view finds it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from changedetect.errors import InputDataError
from changedetect.typing import BoolArray, FloatArray

__all__ = ["fundamental_inliers", "sampson_angle", "two_point_inliers"]

#: Fewer matches than this between two photos say nothing about their geometry.
MIN_MATCHES = 8
_N_HYPOTHESES = 300


def sampson_angle(first: FloatArray, second: FloatArray, direction: FloatArray) -> FloatArray:
    """
    Angle by which rays miss the epipolar constraint, to first order.

    Parameters
    ----------
    first, second : array, shape (n, 3)
        Unit rays of the matches in ground axes.
    direction : array, shape (3,) or (k, 3)
        Baseline directions.

    Returns
    -------
    angle : array, shape (n,) or (k, n), rad, signed

    Notes
    -----
    Sampson's distance [1]_ of e = t . (r1 x r2): e over the norm of its gradient by both rays, |t x r1|^2 + |r2 x t|^2.

    References
    ----------
    .. [1] Hartley, Zisserman (2004), Multiple view geometry, section 11.4.3.
    """
    t = np.atleast_2d(direction)
    error = t @ np.cross(first, second).T
    length2 = np.sum(t * t, axis=1)[:, None]
    gradient = np.sqrt(np.maximum(2 * length2 - (t @ first.T) ** 2 - (t @ second.T) ** 2, 1e-30))
    angle = error / gradient
    return np.asarray(angle[0] if np.ndim(direction) == 1 else angle, dtype=np.float64)


def two_point_inliers(
    first: FloatArray, second: FloatArray, threshold: float, *, seed: int = 0
) -> tuple[BoolArray, FloatArray]:
    """
    Matches that agree with one baseline direction, rotations being known.

    Parameters
    ----------
    first, second : array, shape (n, 3)
        Unit rays of the matches in ground axes.
    threshold : float, rad
        Largest Sampson angle of an inlier: pixels over focal length.
    seed : int
        Of the random pairs.

    Returns
    -------
    inliers : array, shape (n,), bool
    direction : array, shape (3,)
        Unit baseline; its sign means nothing.

    Raises
    ------
    InputDataError
        There are fewer than 8 matches.

    Notes
    -----
    RANSAC [1]_ with a truncated quadratic score, then the smallest singular vector of the inliers' normals, weighted
    by their gradients, twice.

    References
    ----------
    .. [1] Fischler, Bolles (1981), Random sample consensus, doi:10.1145/358669.358692.
    """
    _require_matches(len(first))
    normals = np.cross(first, second)
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, len(first), (_N_HYPOTHESES, 2))
    t = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    length = np.linalg.norm(t, axis=1)
    t = t[length > 1e-12 * max(float(length.max()), 1e-300)]
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    cost = np.minimum((sampson_angle(first, second, t) / threshold) ** 2, 1.0).sum(axis=1)
    best: FloatArray = t[int(np.argmin(cost))]
    for _ in range(2):
        inliers = np.abs(sampson_angle(first, second, best)) < threshold
        if inliers.sum() < 3:
            break
        gradient = np.sqrt(2 - (first @ best) ** 2 - (second @ best) ** 2)
        rows = normals[inliers] / np.maximum(gradient[inliers, None], 1e-9)
        best = np.linalg.svd(rows, full_matrices=False)[2][2]
    return np.abs(sampson_angle(first, second, best)) < threshold, best


def fundamental_inliers(first: FloatArray, second: FloatArray, threshold: float) -> BoolArray:
    """
    Matches that agree with one fundamental matrix, no pose being known.

    Parameters
    ----------
    first, second : array, shape (n, 2), pixels
        Undistorted pixels of the matches.
    threshold : float, pixels

    Returns
    -------
    inliers : array, shape (n,), bool
        None at all where no fundamental matrix was found.

    Raises
    ------
    InputDataError
        There are fewer than 8 matches.

    Notes
    -----
    OpenCV's USAC with the MAGSAC++ score [1]_. On flat ground the matrix is not determined and more outliers pass than
    with known rotations.

    References
    ----------
    .. [1] Barath, Noskova, Ivashechkin, Matas (2020), MAGSAC++, doi:10.1109/CVPR42600.2020.00138.
    """
    _require_matches(len(first))
    cv2.setRNGSeed(0)
    estimate: Any = cv2.findFundamentalMat  # its stub denies that it may find none
    matrix, mask = estimate(
        np.asarray(first, np.float64), np.asarray(second, np.float64), cv2.USAC_MAGSAC, threshold, 0.999, 5000
    )
    if matrix is None or mask is None:
        return np.zeros(len(first), dtype=bool)
    return np.asarray(mask).ravel().astype(bool)


def _require_matches(n: int) -> None:
    if n < MIN_MATCHES:
        msg = f"{n} matches between two photos, at least {MIN_MATCHES} are needed to test their geometry."
        raise InputDataError(msg)
