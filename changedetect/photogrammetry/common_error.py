"""
Error that all points of a flight have alike: offset, tilt, horizontal shift and bending, with their covariance.

What a flight's poses leave in common does not average out over a region. Against the Earth it is as large as the
offset of the GPS; between two flights adjusted together nearly all of it cancels. Bending is what a lens that is not
known well does to a block of near-vertical photos.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from changedetect.kernels.bundle import coordinate_modes
from changedetect.photogrammetry.covariance import height_design, point_arrays
from changedetect.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from changedetect.photogrammetry.adjustment import Adjustment

__all__ = ["COMMON_PARAMETERS", "CommonError", "PointModes", "common_error", "error_factor", "point_modes"]

#: Parameters of the error, in the order of its covariance.
COMMON_PARAMETERS = (
    "offset", "tilt_east", "tilt_north", "shift_east", "shift_north", "bend_east", "bend_cross", "bend_north",
)  # fmt: skip
#: Points that the parameters are fitted to.
_SAMPLE = 2_500
#: Eigenvalues of the standardised covariance below this share of the largest are rounding.
_NEGLIGIBLE = 1e-12


@dataclass(frozen=True)
class CommonError:
    """
    Height error of a flight, and its horizontal shift.

    With e = east - e0 and n = north - n0, z = offset + tilt_east e + tilt_north n + bend_east e^2 + bend_cross e n +
    bend_north n^2.

    Attributes
    ----------
    centre : tuple of 2 float, m
        e0, n0 in ENU.
    covariance : array, shape (8, 8)
        In the order of `COMMON_PARAMETERS`; m, m per m, m, m per m^2.
    residual_std : float, m
        Root mean square, over the points, of the standard deviation of heights that is left after these.
    """

    centre: tuple[float, float]
    covariance: FloatArray
    residual_std: float


@dataclass(frozen=True)
class PointModes:
    """
    Displacement of a sample of points in each mode of the cameras' errors.

    Attributes
    ----------
    place : array, shape (n, 3), ENU, m
    displacement : array, shape (3, n, n_modes), m
        East, north, up.
    """

    place: FloatArray
    displacement: FloatArray


def error_factor(covariance: FloatArray) -> FloatArray:
    """Matrix F with F F' the covariance; directions without variance are left out."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    kept = values > _NEGLIGIBLE * max(float(values[-1]), 1e-300)
    return np.ascontiguousarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def point_modes(adjustment: Adjustment, points: IntArray, factor: FloatArray) -> PointModes:
    """
    How errors of poses and lens displace the points of a flight.

    Parameters
    ----------
    adjustment : Adjustment
    points : array of int
        Their numbers.
    factor : array, shape (6 n_images + 9 n_lenses, n_modes)
        From `error_factor` of the covariance of poses and lenses; the rows of these points' photos and lenses count.
    """
    spread = np.unique(np.linspace(0, points.size - 1, min(points.size, _SAMPLE)).astype(np.int64))
    sample = points[spread]
    modes: Any = coordinate_modes
    arrays = point_arrays(adjustment, sample)
    displacement = np.stack([modes(*arrays, factor, axis) for axis in range(3)])
    return PointModes(adjustment.points[sample], displacement)


def common_error(later: PointModes, earlier: PointModes | None = None) -> CommonError:
    """
    Error that the heights of a flight, or the difference of two, have everywhere alike.

    Parameters
    ----------
    later : PointModes
    earlier : PointModes, optional
        Of the other flight, in the same modes; the error is that of the difference, later less earlier.
    """
    places = [later.place] if earlier is None else [later.place, earlier.place]
    middle = np.mean(np.concatenate(places)[:, :2], axis=0)
    fitted, left = _fitted(later, middle)
    variance = float(np.mean(left))
    if earlier is not None:
        other, left = _fitted(earlier, middle)
        fitted, variance = fitted - other, variance + float(np.mean(left))
    return CommonError((float(middle[0]), float(middle[1])), fitted @ fitted.T, float(np.sqrt(variance)))


def _fitted(modes: PointModes, middle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters in each mode, shape (8, n_modes), and the variance of each height that they leave, m^2."""
    design = height_design(*(modes.place[:, :2] - middle).T)
    fit = np.linalg.lstsq(design, modes.displacement[2], rcond=None)[0]
    left = modes.displacement[2] - design @ fit
    shift = modes.displacement[:2].mean(axis=1)
    return np.vstack([fit[:3], shift, fit[3:]]), np.asarray(np.sum(left**2, axis=1))
