"""
Ground control: surveyed points marked in photos.

Control points are adjusted like any other point; what was surveyed then corrects poses and lens by their covariance, as
a Kalman filter's measurement does. The correction is the same as that of an adjustment with the survey in it, to first
order, and says before it is applied whether survey and flight agree: a control point that contradicts the others or
the flight by more than chance allows is named. Check points are compared and left out.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from changedetect.errors import InputDataError
from changedetect.kernels.bundle import coordinate_modes, point_covariances, point_steps
from changedetect.kernels.projection import N_CALIBRATION
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.block import MARK, ImageBlock, Observations
from changedetect.photogrammetry.covariance import point_arrays
from changedetect.photogrammetry.lens import corrected_intrinsics
from changedetect.typing import FloatArray, IntArray

__all__ = ["ControlPoint", "ControlResult", "apply_control", "marked_observations"]

logger = logging.getLogger(__name__)

#: Control points beyond this quantile of chi-square with three degrees of freedom are gross errors.
_CONFIDENCE = 0.9999


@dataclass(frozen=True)
class ControlPoint:
    """
    A surveyed point and its marks in photos.

    Attributes
    ----------
    name : str
    position : array, shape (3,), ENU, m
    std : array, shape (3,), m
        Of the survey.
    photos : tuple of str
        Names of the photos it is marked in.
    pixel : array, shape (n, 2), pixels
        Of the marks.
    is_check : bool
        Compared only.
    """

    name: str
    position: FloatArray
    std: FloatArray
    photos: tuple[str, ...]
    pixel: FloatArray
    is_check: bool = False


@dataclass(frozen=True)
class ControlResult:
    """
    How survey and flight agree.

    Attributes
    ----------
    before, after : dict of str to array, shape (3,), m
        Adjusted minus surveyed, east, north, up, by name, before and after the control points were applied.
    refused : tuple of str
        Control points left out as gross errors.
    checks : tuple of str
        Points that took no part.
    """

    before: dict[str, FloatArray]
    after: dict[str, FloatArray]
    refused: tuple[str, ...]
    checks: tuple[str, ...]

    def describe(self) -> dict[str, Any]:
        """Content for a report."""
        left = np.array([self.after[name] for name in self.checks]).reshape(-1, 3)
        return {
            "points": {
                name: {"before_m": self.before[name].tolist(), "after_m": self.after[name].tolist()}
                for name in self.before
            },
            "refused": list(self.refused),
            "checks": list(self.checks),
            "check_rms_m": np.sqrt(np.mean(left**2, axis=0)).tolist() if len(left) else None,
        }


def marked_observations(control: Sequence[ControlPoint], block: ImageBlock, pixel_std: float) -> Observations:
    """
    Marks as observations, one point for each control point in their order.

    Raises
    ------
    InputDataError
        A mark is in a photo that is not part of the flight, or a point is marked in fewer than two photos.
    """
    number = {name: k for k, name in enumerate(block.names)}
    for point in control:
        unknown = [photo for photo in point.photos if photo not in number]
        if unknown:
            msg = (
                f"Control point {point.name} is marked in {unknown[0]}, which is not a photo of this flight. Correct "
                "the name or remove the mark."
            )
            raise InputDataError(msg)
        if len(set(point.photos)) < 2:
            msg = f"Control point {point.name} is marked in {len(set(point.photos))} photo(s); two are needed."
            raise InputDataError(msg)
    label = np.repeat(np.arange(len(control)), [len(point.photos) for point in control])
    image = np.array([number[photo] for point in control for photo in point.photos], dtype=np.int64)
    pixel = np.concatenate([point.pixel for point in control])
    n = label.size
    return Observations.gather(label, image, pixel, np.full(n, pixel_std), np.full(n, MARK))


def apply_control(
    adjustment: Adjustment, numbers: IntArray, control: Sequence[ControlPoint]
) -> tuple[Adjustment, ControlResult]:
    """
    Correct an adjustment by what was surveyed.

    Parameters
    ----------
    adjustment : Adjustment
        In which the control points were adjusted as points.
    numbers : array of int
        Number of each control point there; -1 for one that did not survive.
    control : sequence of ControlPoint

    Returns
    -------
    adjustment : Adjustment
        With corrected poses, lenses, points and covariance.
    result : ControlResult

    Raises
    ------
    InputDataError
        No control point is left, or more than a third contradicts the flight.

    Notes
    -----
    With the sensitivity H of the control points to the camera side, covariance C of the camera side, own covariance O
    of the points and R of the survey: S = H C H^T + O + R, gain C H^T S^-1. The point with the largest Mahalanobis
    length given the others is left out until all lie within chance.
    """
    used = [k for k, point in enumerate(control) if numbers[k] >= 0 and not point.is_check]
    before = _differences(adjustment, numbers, control)
    refused: list[str] = []
    limit = float(chi2.ppf(_CONFIDENCE, 3))
    while True:
        if not used or len(refused) > len(control) / 3:
            names = ", ".join(refused) or "all"
            msg = (
                f"Control points contradict the flight or each other ({names}). Check their CRS, heights (above "
                "the ellipsoid or levelled?), names and marks."
            )
            raise InputDataError(msg)
        sensitivity, own = _sensitivity(adjustment, numbers[used])
        innovation = np.concatenate([-before[control[k].name] for k in used])
        survey = np.diag(np.concatenate([control[k].std ** 2 for k in used]))
        spread = sensitivity @ adjustment.camera_covariance @ sensitivity.T + own + survey
        gain = np.linalg.solve(spread, sensitivity @ adjustment.camera_covariance).T
        lengths = _lengths(innovation, spread)
        worst = int(np.argmax(lengths))
        if lengths[worst] <= limit:
            break
        refused.append(control[used.pop(worst)].name)
        logger.warning("Control point %s contradicts the flight and the other points; left out", refused[-1])
    step = gain @ innovation
    covariance = adjustment.camera_covariance - gain @ sensitivity @ adjustment.camera_covariance
    moved = _moved(adjustment, step, (covariance + covariance.T) / 2)
    checks = tuple(p.name for k, p in enumerate(control) if p.is_check and numbers[k] >= 0)
    return moved, ControlResult(before, _differences(moved, numbers, control), tuple(refused), checks)


def _lengths(innovation: FloatArray, spread: FloatArray) -> FloatArray:
    """Squared Mahalanobis length of each point's difference, given all the others' (leave-one-out)."""
    inverse = np.linalg.inv(spread)
    weighted = inverse @ innovation
    out = np.empty(len(innovation) // 3)
    for k in range(out.size):
        at = slice(3 * k, 3 * k + 3)
        out[k] = weighted[at] @ np.linalg.solve(inverse[at, at], weighted[at])
    return out


def _differences(adjustment: Adjustment, numbers: IntArray, control: Sequence[ControlPoint]) -> dict[str, FloatArray]:
    """Adjusted minus surveyed by name."""
    return {
        point.name: np.asarray(adjustment.points[number] - point.position)
        for number, point in zip(numbers, control, strict=True)
        if number >= 0
    }


def _sensitivity(adjustment: Adjustment, numbers: IntArray) -> tuple[FloatArray, FloatArray]:
    """Derivative of points by the camera side, shape (3 k, n), and their own covariance, shape (3 k, 3 k)."""
    order = np.argsort(numbers)  # the kernels take points in their own order
    back = np.argsort(order)
    arrays = point_arrays(adjustment, numbers[order])
    modes: Any = coordinate_modes
    unit = np.eye(len(adjustment.camera_covariance))
    by_axis = np.stack([modes(*arrays, unit, axis)[back] for axis in range(3)], axis=1)
    covariances: Any = point_covariances
    own = covariances(*arrays, np.zeros_like(unit))[0][back]
    k = len(numbers)
    block = np.zeros((k, 3, k, 3))
    block[np.arange(k), :, np.arange(k)] = own
    return by_axis.reshape(3 * k, -1), block.reshape(3 * k, 3 * k)


def _moved(adjustment: Adjustment, step: FloatArray, covariance: FloatArray) -> Adjustment:
    """Adjustment after a step of the camera side; points follow."""
    old = adjustment.block
    n = len(old)
    o = adjustment.observations
    steps: Any = point_steps
    shift = steps(
        adjustment.points, old.rotation, old.position, old.intrinsics, old.lens, o.start, o.image, o.pixel,
        adjustment.weight, 0.0, step,
    )  # fmt: skip
    pose = step[: 6 * n].reshape(n, 6)
    lens = step[6 * n :].reshape(-1, N_CALIBRATION)
    block = replace(
        old,
        rotation=Rotation.from_rotvec(pose[:, 3:]).as_matrix() @ old.rotation,
        position=old.position + pose[:, :3],
        intrinsics=corrected_intrinsics(old.intrinsics, lens),
    )
    return replace(
        adjustment,
        block=block,
        points=adjustment.points + shift,
        camera_covariance=covariance,
        lens_correction=adjustment.lens_correction + lens,
        pose_correction=adjustment.pose_correction + pose,
    )
