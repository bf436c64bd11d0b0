"""
Points straight from the poses of navigation, without adjustment: the paper's chain, and the same with smoothed poses.

The paper tracks features, rejects those off the epipolar line, and triangulates two views of each from the poses of the
extended Kalman filter. It is here to be compared with: jumps of the filter between photos, a fifth of a metre at every
fix, are multiplied by height over baseline. Of a track's views the first and the last are taken, which suits it best.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from changedetect.errors import InputDataError
from changedetect.kernels.pose_weighted import pose_weighted_points
from changedetect.kernels.projection import N_CALIBRATION
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.block import ImageBlock, Observations
from changedetect.photogrammetry.covariance import pixel_correlation
from changedetect.photogrammetry.triangulation import residuals, triangulate
from changedetect.typing import FloatArray

__all__ = ["triangulated", "two_views"]


def two_views(tracks: Observations) -> Observations:
    """First and last observation of each track: the pair with the longest baseline."""
    is_end = np.zeros(len(tracks), dtype=bool)
    is_end[tracks.start[:-1]] = True
    is_end[tracks.start[1:] - 1] = True
    return tracks.keep(is_end)[0]


def triangulated(
    block: ImageBlock,
    observations: Observations,
    information: FloatArray,
    *,
    max_error: float = 4.0,
    heeds_poses: bool = False,
) -> Adjustment:
    """
    Points of poses as they are, in the shape of an adjustment that moved nothing.

    Parameters
    ----------
    block : ImageBlock
    observations : Observations
    information : array, shape (6 n, 6 n)
        Of the poses, for the points' covariance.
    max_error : float
        Points whose largest residual exceeds this many times the median are left out.
    heeds_poses : bool
        Weigh the views of a point by the covariance of the poses, which takes off what neighbouring photos have in
        common, instead of taking all as equally good.

    Raises
    ------
    InputDataError
        No point can be triangulated.
    """
    solved = triangulate(block, observations)
    error = np.linalg.norm(residuals(block, solved.points, observations), axis=1)
    fixed = np.isfinite(solved.points[:, 0])
    worst = np.maximum.reduceat(np.nan_to_num(error, nan=np.inf), observations.start[:-1])
    if not fixed.any():
        msg = (
            f"None of {observations.n_points} tracked points can be triangulated. Check poses, camera file and photos."
        )
        raise InputDataError(msg)
    fine = fixed & (worst <= max_error * max(float(np.median(worst[fixed])), 1.0))
    kept, origin = observations.keep(fine[observations.point])
    points = solved.points[origin]
    n = 6 * len(block)
    size = n + N_CALIBRATION * len(block.intrinsics)
    covariance = np.zeros((size, size))
    covariance[:n, :n] = np.linalg.inv(information)
    if heeds_poses:
        solve: Any = pose_weighted_points
        solved_again = solve(
            points, block.rotation, block.position, block.intrinsics, block.lens,
            kept.start, kept.image, kept.pixel, kept.sigma, np.ascontiguousarray(covariance[:n, :n]),
        )  # fmt: skip
        points = np.where(np.isfinite(solved_again[:, :1]), solved_again, points)
    n_flights = int(block.flight.max()) + 1
    lenses = np.zeros((len(block.intrinsics), N_CALIBRATION))
    width, height = block.size.mean(axis=0)
    return Adjustment(
        block=block,
        points=points,
        observations=kept,
        weight=kept.sigma**-2.0,
        origin=origin,
        camera_covariance=covariance,
        lens_slope=np.zeros((size, size - n)),
        lens_correction=lenses,
        lens_std=lenses,
        boresight=np.zeros((n_flights, 3)),
        boresight_std=np.zeros((n_flights, 3)),
        pose_correction=np.zeros((len(block), 6)),
        correlation=pixel_correlation(residuals(block, points, kept), kept, float(np.hypot(width, height))),
    )
