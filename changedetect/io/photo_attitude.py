"""Angles of photos as rotations; conventions that are mixed up are found by where the cameras look."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import InputDataError
from changedetect.io.photo_metadata import HORIZON, NADIR
from changedetect.navigation.alignment import attitude_covariance, attitude_from_angles

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.io.photo_metadata import PhotoMetadata
    from changedetect.navigation.camera import CameraMount
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["PhotoAttitudes", "camera_rotation", "photo_attitudes"]

logger = logging.getLogger(__name__)

#: Camera axes (right, down, forward) in body axes (forward, right, down): looking ahead, and looking down with the top
#: of the photo forward.
_AHEAD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_DOWN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
#: Photos that look further from straight down show the horizon and are left out; a survey looks nearer down than the
#: second, degrees.
_MAX_TILT, _SURVEY_TILT = 75.0, 60.0
#: Tilt of photos that state none: most cameras hang in a gimbal and look down, degrees.
_UNKNOWN_TILT_STD, _UNKNOWN_YAW_STD = 6.0, 180.0


@dataclass(frozen=True)
class PhotoAttitudes:
    """
    Rotations of photos.

    Attributes
    ----------
    rotation : array, shape (n, 3, 3)
        Camera axes to ENU.
    covariance : array, shape (n, 3, 3), rad^2, ENU
    has_heading : array, shape (n,), bool
    looks_down : array, shape (n,), bool
        Others show the horizon.
    source : str
        Where the angles come from, in words.
    """

    rotation: FloatArray
    covariance: FloatArray
    has_heading: BoolArray
    looks_down: BoolArray
    source: str


def camera_rotation(angles: tuple[float, float, float], counted_from: str, mount: FloatArray = _DOWN) -> FloatArray:
    """
    Camera axes to ENU.

    Parameters
    ----------
    angles : tuple of 3 float, degrees
        Yaw, pitch, roll.
    counted_from : str
        `HORIZON`: of the camera, which looks ahead at pitch 0; `NADIR`: of the aircraft, below which it hangs.
    mount : array, shape (3, 3)
        Camera axes to body axes, for `NADIR`.

    Examples
    --------
    >>> bool(np.allclose(camera_rotation((30, -90, 0), HORIZON), camera_rotation((30, 0, 0), NADIR)))
    True
    """
    yaw, pitch, roll = angles
    body = attitude_from_angles(roll, pitch, yaw)
    return np.asarray(body @ (_AHEAD if counted_from == HORIZON else mount))


def photo_attitudes(photos: Sequence[PhotoMetadata], mount: CameraMount | None = None) -> PhotoAttitudes:
    """
    Rotations of photos with covariance.

    Parameters
    ----------
    photos : sequence of PhotoMetadata
    mount : CameraMount, optional
        How the camera sits in the aircraft, for angles of the aircraft; by default looking down, top forward.

    Raises
    ------
    InputDataError
        The photos do not look down, by either convention of pitch.
    """
    n = len(photos)
    turned = _DOWN if mount is None else mount.rotation_body_camera
    has_heading = np.array([photo.angles is not None for photo in photos])
    counted_from = _convention(photos, turned)
    rotation, covariance = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for k, photo in enumerate(photos):
        yaw_std, pitch_std, roll_std = photo.angles_std
        angles = photo.angles
        if angles is None:
            angles, yaw_std, pitch_std, roll_std = (0.0, 0.0, 0.0), _UNKNOWN_YAW_STD, *[_UNKNOWN_TILT_STD] * 2
        rotation[k] = camera_rotation(angles, counted_from if photo.angles is not None else NADIR, turned)
        # what a maker calls roll tilts a hanging camera sideways and turns a gimbal's about the vertical; both tilts
        # are taken to be known alike
        yaw = angles[0]
        std = np.array([roll_std, pitch_std, yaw_std])
        covariance[k] = attitude_covariance(0.0, 0.0, yaw, std)
    looks_down = _tilt(rotation) <= _MAX_TILT
    if not looks_down.all():
        names = ", ".join(photos[int(k)].path.name for k in np.flatnonzero(~looks_down)[:5])
        logger.warning("%d of %d photos look at the horizon and are left out: %s", int((~looks_down).sum()), n, names)
    if looks_down.sum() < 3:
        msg = f"Only {int(looks_down.sum())} of {n} photos look down; at least 3 that overlap are needed."
        raise InputDataError(msg)
    sources = sorted({photo.angles_source for photo in photos if photo.angles is not None})
    source = ", ".join(sources) if sources else "none: taken as looking down, headings from the pictures"
    if not has_heading.any():
        logger.info("no photo states angles: taken as looking down, headings from the pictures")
    return PhotoAttitudes(rotation, covariance, has_heading, looks_down, source)


def _convention(photos: Sequence[PhotoMetadata], mount: FloatArray) -> str:
    """What the angles count from: as stated, or the other one where only it makes the photos look down."""
    known = [photo for photo in photos if photo.angles is not None]
    if not known:
        return NADIR
    stated = known[0].angles_from
    other = NADIR if stated == HORIZON else HORIZON
    share = {
        name: float(np.mean(_tilt(np.stack([camera_rotation(p.angles, name, mount) for p in known if p.angles]))
                            <= _SURVEY_TILT))
        for name in (stated, other)
    }  # fmt: skip
    if share[stated] >= 0.5:
        return stated
    pitch = float(np.median([photo.angles[1] for photo in known if photo.angles]))
    zero = {HORIZON: "the horizon (-90 looks down)", NADIR: "straight down"}
    if share[other] >= 0.8:
        logger.warning(
            "%s: a pitch of %.0f degrees would look away from the ground if 0 meant %s; taken as counted from %s",
            known[0].angles_source, pitch, zero[stated], zero[other],
        )  # fmt: skip
        return other
    msg = (
        f"The photos do not look down: {known[0].angles_source} gives {known[0].path.name} and {len(known) - 1} more a "
        f"pitch of {pitch:.0f} degrees in the median, counted from {zero[stated]}. Correct the angles in geo.txt or "
        "photos.csv, or leave out photos of the horizon."
    )
    raise InputDataError(msg)


def _tilt(rotation: FloatArray) -> FloatArray:
    """Angle between the optical axis and straight down, degrees."""
    return np.asarray(np.degrees(np.arccos(np.clip(-rotation[:, 2, 2], -1.0, 1.0))))
