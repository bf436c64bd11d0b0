"""
Offset between the clock of the camera and that of the logs, from the pictures themselves.

Gusts turn an aircraft by degrees within a second. Photos adjusted to each other tell how the camera turned from one to
the next; laid on the attitudes of the inertial log they fit at one offset only. Needs no positions in the photos.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

if TYPE_CHECKING:
    from changedetect.navigation.camera import CameraMount
    from changedetect.navigation.solution import Trajectory
    from changedetect.typing import FloatArray

__all__ = ["PictureClock", "clock_from_attitudes"]

#: Offsets searched and their spacing, s.
_SEARCHED, _SPACING = 3.0, 0.01
#: Photos further apart than this belong to different strips, s.
_GAP = 3.0
#: Consecutive photos turn alike: independent ones per photo.
_INDEPENDENT = 0.5


@dataclass(frozen=True)
class PictureClock:
    """
    What has to be added to the times of the photos.

    Attributes
    ----------
    seconds, std : float, s
    rms_before, rms_after : float, rad
        Of attitudes against the inertial log, without their mean.
    """

    seconds: float
    std: float
    rms_before: float
    rms_after: float

    def explains(self, share: float) -> bool:
        """Whether the offset takes off at least this share of how pictures and logs disagree."""
        return self.rms_after < (1.0 - share) * self.rms_before and abs(self.seconds) > 2.0 * self.std


def clock_from_attitudes(
    time: FloatArray, rotation: FloatArray, trajectory: Trajectory, mount: CameraMount
) -> PictureClock | None:
    """
    Find the offset at which attitudes of adjusted photos follow the inertial log.

    Parameters
    ----------
    time : array, shape (n,), s
        Of the photos, as listed.
    rotation : array, shape (n, 3, 3)
        Adjusted, camera axes to ENU.
    trajectory : Trajectory
        Smoothed.
    mount : CameraMount

    Returns
    -------
    clock : PictureClock or None
        None where fewer than five photos can be compared.

    Notes
    -----
    The median of the differences of each strip, in camera axes, is taken off: errors of mounting and of heading, which
    wander from strip to strip, say nothing about time.
    """
    course = Slerp(trajectory.time, Rotation.from_matrix(trajectory.rotation))
    adjusted = Rotation.from_matrix(rotation)
    camera = Rotation.from_matrix(mount.rotation_body_camera)
    inside = (time - _SEARCHED >= trajectory.time[0]) & (time + _SEARCHED <= trajectory.time[-1])
    if np.count_nonzero(inside) < 5:
        inside = (time >= trajectory.time[0]) & (time <= trajectory.time[-1])
    if np.count_nonzero(inside) < 5:
        return None
    moments, turned = time[inside], adjusted[inside]
    strips = np.split(np.arange(moments.size), np.flatnonzero(np.diff(moments) > _GAP) + 1)

    def rms(offset: float) -> float:
        at = np.clip(moments + offset, trajectory.time[0], trajectory.time[-1])
        difference = ((course(at) * camera).inv() * turned).as_rotvec()
        left = [difference[part] - np.median(difference[part], axis=0) for part in strips]
        return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))

    offsets = np.arange(-_SEARCHED, _SEARCHED + _SPACING / 2, _SPACING)
    values = np.array([rms(offset) for offset in offsets])
    best = int(np.argmin(values))
    low, high = max(best - 5, 0), min(best + 6, offsets.size)
    curve = np.polyfit(offsets[low:high] - offsets[best], values[low:high] ** 2, 2)
    n = _INDEPENDENT * 3 * moments.size
    std = np.inf if curve[0] <= 0 else float(np.sqrt(values[best] ** 2 / (n * curve[0])))
    return PictureClock(float(offsets[best]), max(std, _SPACING / 2), rms(0.0), float(values[best]))
