"""
Placing a model that floats: turn, scale and shift that take its cameras to where they were.

References
----------
.. [1] Umeyama (1991), Least-squares estimation of transformation parameters between two point patterns,
   doi:10.1109/34.88573.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from changedetect.errors import InputDataError
from changedetect.typing import FloatArray

__all__ = ["Similarity", "fit_similarity"]

#: Cameras nearer to one line than this share of its length leave the turn about it open.
_MIN_WIDTH = 0.02
_STEPS = 20


@dataclass(frozen=True)
class Similarity:
    """
    target = scale * rotation @ source + shift.

    Attributes
    ----------
    scale : float
    rotation : array, shape (3, 3)
    shift : array, shape (3,)
    residual_std : array, shape (3,)
        Robust standard deviation of what remains, in the target's unit.
    """

    scale: float
    rotation: FloatArray
    shift: FloatArray
    residual_std: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """Points of the source in the target's frame, shape (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)


def fit_similarity(source: FloatArray, target: FloatArray) -> Similarity:
    """
    Fit a similarity robustly.

    Parameters
    ----------
    source, target : array, shape (n, 3)

    Raises
    ------
    InputDataError
        Fewer than three points, or all on one line.

    Notes
    -----
    Umeyama's closed form [1]_ with Cauchy weights, repeated.
    """
    n = len(source)
    spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False) if n >= 3 else np.zeros(3)
    if n < 3 or spread[1] < _MIN_WIDTH * spread[0]:
        msg = (
            f"{n} camera positions {'lie on one line' if n >= 3 else 'are too few'}: they do not say how the model is "
            "turned. Use photos of two flight lines at least, or a model that is aligned (COLMAP: model_aligner "
            "--alignment_type ecef)."
        )
        raise InputDataError(msg)
    weight = np.ones(n)
    for _ in range(_STEPS):
        scale, rotation, shift = _closed_form(source, target, weight)
        error = np.linalg.norm(target - (scale * source @ rotation.T + shift), axis=1)
        weight = 1.0 / (1.0 + (error / max(2.0 * float(np.median(error)), 1e-12)) ** 2)
    left = target - (scale * source @ rotation.T + shift)
    std = 1.4826 * np.median(np.abs(left - np.median(left, axis=0)), axis=0)
    return Similarity(scale, rotation, shift, np.asarray(std))


def _closed_form(source: FloatArray, target: FloatArray, weight: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    w = weight / weight.sum()
    a, b = w @ source, w @ target
    covariance = (target - b).T @ (w[:, None] * (source - a))
    u, singular, vt = np.linalg.svd(covariance)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / (w @ np.sum((source - a) ** 2, axis=1)))
    return scale, rotation, b - scale * rotation @ a
