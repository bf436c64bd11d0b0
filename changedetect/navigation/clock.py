"""
Offset between the clock of the camera and that of the navigation logs.

Photos that say where they were taken (EXIF or geo.txt, from the camera's own receiver) can be laid on the trajectory:
the offset moves them along it, backwards on one heading and forwards on the other, while a difference of datum moves
all the same way. Without such positions, or on one heading alone, nothing can be told here.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from changedetect.errors import InputDataError
from changedetect.navigation.flight import PhotoList

if TYPE_CHECKING:
    from changedetect.navigation.camera import CameraMount
    from changedetect.navigation.solution import Trajectory
    from changedetect.typing import FloatArray

__all__ = ["ClockOffset", "estimate_clock_offset"]

logger = logging.getLogger(__name__)

#: Offsets searched, and the largest that is corrected, s.
_SEARCHED, _CORRECTED = 30.0, 2.0
#: Standard errors an offset must differ from zero to be believed; cameras that are triggered are usually in time.
_BELIEVED = 4.0
#: A priori standard deviation of the offset between both receivers, m.
_DATUM_STD = 5.0
#: Standard errors of residuals beyond which a photo's position weighs less (Huber).
_TUNING = 2.0


@dataclass(frozen=True)
class ClockOffset:
    """
    What must be added to the times of the photos.

    Parameters
    ----------
    seconds : float, s
    std : float, s
        Standard error.
    is_applied : bool
        Whether it differs from zero by more than 4 standard errors, and so was corrected.
    position_std : float, m
        Robust spread of the photos' positions about the trajectory after the fit.
    """

    seconds: float
    std: float
    is_applied: bool
    position_std: float


def estimate_clock_offset(
    photos: PhotoList, trajectory: Trajectory, mount: CameraMount, label: str = "flight"
) -> ClockOffset | None:
    """
    Fit the photos' own positions to a trajectory.

    Parameters
    ----------
    photos : PhotoList
        With positions, at least five.
    trajectory : Trajectory
        Smoothed.
    mount : CameraMount
    label : str
        Of the flight, for messages.

    Returns
    -------
    offset : ClockOffset or None
        None where the photos say too little: fewer than five positions, or a standard error above half a second.

    Raises
    ------
    InputDataError
        The clocks differ by more than 2 s.
    """
    if photos.position is None:
        return None
    has = np.all(np.isfinite(photos.position), axis=1)
    if np.count_nonzero(has) < 5:
        return None
    time, place = photos.time[has], photos.position[has]
    centre = trajectory.position + trajectory.rotation @ mount.camera_body
    path = CubicHermiteSpline(trajectory.time, centre, trajectory.velocity, extrapolate=False)
    seconds = _coarse_offset(path, time, place)
    std, spread = np.inf, np.inf
    for _ in range(20):
        change, std, spread = _refine(path, time + seconds, place)
        seconds += change
        if abs(change) < 0.01 * std:
            break
    # The trajectory's own error hardly changes along a strip, so many photos do not average it out.
    nearest = np.clip(np.searchsorted(trajectory.time, time), 0, len(trajectory) - 1)
    own = np.sqrt(np.trace(trajectory.covariance[nearest][:, :2, :2], axis1=1, axis2=2) / 2.0)
    speed = np.linalg.norm(trajectory.velocity[nearest], axis=1)
    std = float(np.hypot(std, np.median(own) / max(float(np.median(speed)), 1e-3)))
    if not std < 0.5:
        return None
    if abs(seconds) > _CORRECTED and abs(seconds) > _BELIEVED * std:
        msg = (
            f"The clock of the camera is off by {seconds:+.3f} s (+- {std:.3f} s) from the navigation logs of {label}: "
            "the positions the photos carry fit the trajectory only then. Add that to time_s in images.csv "
            f"(offsets up to {_CORRECTED:.0f} s are corrected without asking)."
        )
        raise InputDataError(msg)
    is_applied = abs(seconds) > _BELIEVED * std
    if is_applied:
        logger.warning("%s: camera clock off by %+.3f +- %.3f s; photo times corrected", label, seconds, std)
    return ClockOffset(seconds if is_applied else 0.0, std, is_applied, spread)


def _coarse_offset(path: CubicHermiteSpline, time: FloatArray, place: FloatArray) -> float:
    """Offset of the smallest median distance on a grid of 0.1 s, after taking out the median difference."""
    best, least = 0.0, np.inf
    for offset in np.arange(-_SEARCHED, _SEARCHED + 0.05, 0.1):
        difference = path(time + offset) - place
        inside = np.isfinite(difference[:, 0])
        if np.count_nonzero(inside) < max(5, 0.7 * time.size):
            continue
        residual = difference[inside] - np.clip(np.median(difference[inside], axis=0), -_DATUM_STD, _DATUM_STD)
        # Positions of cheap receivers jump: the median is not moved by a few of them.
        distance = float(np.median(np.linalg.norm(residual, axis=1)))
        if distance < least:
            best, least = float(offset), distance
    return best


def _refine(path: CubicHermiteSpline, moment: FloatArray, place: FloatArray) -> tuple[float, float, float]:
    """One Gauss-Newton step of offset and datum shift with Huber weights: change and standard error (s), spread (m)."""
    difference = path(moment) - place
    velocity = path(moment, 1)
    inside = np.all(np.isfinite(difference), axis=1)
    difference, velocity = difference[inside], velocity[inside]
    centred = difference - np.median(difference, axis=0)
    spread = max(1.4826 * float(np.median(np.abs(centred))), 1e-3)
    weight = np.minimum(1.0, _TUNING * spread / np.maximum(np.abs(centred), 1e-12)).ravel() / spread**2
    n = difference.shape[0]
    design = np.hstack([velocity.reshape(-1, 1), np.tile(np.eye(3), (n, 1))])
    normal = design.T @ (weight[:, None] * design)
    normal[1:, 1:] += np.eye(3) / _DATUM_STD**2
    solution = np.linalg.solve(normal, -design.T @ (weight * difference.ravel()))
    return float(solution[0]), float(np.sqrt(np.linalg.inv(normal)[0, 0])), spread
