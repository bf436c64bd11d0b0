"""
What navigation knows of all poses of a flight together, as one information matrix.

Errors of consecutive smoothed poses are nearly equal: a decimetre or two for the flight, a centimetre or two from photo
to photo. Priors that treat photos as independent would let the images bend a strip by what the marginal covariance
allows, and would call the mean of fifty poses seven times better than it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError
from changedetect.typing import FloatArray

if TYPE_CHECKING:
    from changedetect.navigation.poses import CameraPoses

__all__ = ["boresight_pattern", "pose_information"]

#: Smallest standard deviation given to a change of pose between photos: m, rad. Below it a prior could not be inverted.
_FLOOR = np.array([1e-3] * 3 + [1e-5] * 3)


def pose_information(poses: CameraPoses, *, correlation_time: float = 10.0, common_std: float = 0.0) -> FloatArray:
    """
    Information matrix of the errors of all poses of one flight.

    Parameters
    ----------
    poses : CameraPoses
    correlation_time : float, s
        Used where the poses carry no cross-covariance: errors of photos t apart correlate by exp(-t / time). 0 makes
        photos independent, as positions from single GPS fixes are.
    common_std : float, m
        Standard deviation of an offset that all positions of the flight share (the slowly changing error of GPS), where
        the poses carry no common covariance.

    Returns
    -------
    information : array, shape (6 n, 6 n)
        Inverse of the covariance of [dp, phi] of photo after photo.

    Raises
    ------
    InputDataError
        A covariance is not positive definite.

    Notes
    -----
    A first-order Gauss-Markov chain e' = A e + q, with A = E[e' e^T] C^-1 and cov(q) = C' - A C A^T: block tridiagonal.
    The common part K is added to every block of the covariance by Woodbury's identity,
    L - L E K (I + E^T L E K)^-1 E^T L, with E the stack of identity matrices.
    """
    covariance = np.asarray(poses.covariance, dtype=np.float64)
    n = len(covariance)
    _require_positive(poses, covariance)
    information = np.zeros((6 * n, 6 * n))
    information[:6, :6] = np.linalg.inv(covariance[0])
    for i in range(n - 1):
        transition = _transition(poses, i, correlation_time)
        noise = covariance[i + 1] - transition @ covariance[i] @ transition.T
        rows = np.hstack([-transition, np.eye(6)])
        at = slice(6 * i, 6 * i + 12)
        information[at, at] += rows.T @ _inverse_floored(noise) @ rows
    common = poses.common_covariance
    if common is None:
        common = np.diag([common_std**2] * 3 + [0.0] * 3)
    if not np.any(common):
        return information
    stacked = np.tile(np.eye(6), (n, 1))
    left = information @ stacked
    core = common @ np.linalg.inv(np.eye(6) + stacked.T @ left @ common)
    information -= left @ core @ left.T
    return np.asarray((information + information.T) / 2)


def boresight_pattern(rotation: FloatArray) -> FloatArray:
    """
    Pose errors that an error of the camera's mounting angles makes.

    Parameters
    ----------
    rotation : array, shape (n, 3, 3)
        Camera axes to ENU.

    Returns
    -------
    pattern : array, shape (6 n, 3)
        Columns: rotation by one radian about the camera's x, y and z axis.
    """
    pattern = np.zeros((len(rotation), 6, 3))
    pattern[:, 3:] = rotation
    return pattern.reshape(-1, 3)


def _transition(poses: CameraPoses, i: int, correlation_time: float) -> FloatArray:
    if poses.cross_covariance is not None:
        return np.asarray(np.linalg.solve(poses.covariance[i], poses.cross_covariance[i]).T)
    gap = float(poses.time[i + 1] - poses.time[i])
    alike = np.exp(-abs(gap) / correlation_time) if correlation_time > 0 else 0.0
    now, then = np.linalg.cholesky(poses.covariance[i]), np.linalg.cholesky(poses.covariance[i + 1])
    return np.asarray(alike * then @ np.linalg.inv(now))


def _inverse_floored(covariance: FloatArray) -> FloatArray:
    """Inverse with standard deviations kept above the floor, in every direction."""
    scaled = covariance / np.outer(_FLOOR, _FLOOR)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    whitened = (vectors / np.maximum(values, 1.0)) @ vectors.T
    return np.asarray(whitened / np.outer(_FLOOR, _FLOOR))


def _require_positive(poses: CameraPoses, covariance: FloatArray) -> None:
    for name, block in zip(poses.names, covariance, strict=True):
        if not np.isfinite(block).all() or np.linalg.eigvalsh((block + block.T) / 2)[0] <= 0:
            msg = (
                f"The pose covariance of photo {name} is not positive definite; variances "
                f"{np.diag(block).tolist()} (m2, rad2). Run the navigation step again, or give positive accuracies."
            )
            raise InputDataError(msg)
