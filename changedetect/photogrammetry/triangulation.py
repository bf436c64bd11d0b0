"""Ground points from observations in posed photos, with the covariance that their pixels give them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from changedetect.kernels.projection import project_many
from changedetect.kernels.triangulation import triangulate as triangulate_kernel
from changedetect.photogrammetry.block import ImageBlock, Observations
from changedetect.typing import BoolArray, FloatArray

__all__ = ["Triangulation", "are_determined", "observation_rays", "residuals", "triangulate", "two_view_error"]


#: Rays of a point must meet at this angle, rad: a baseline of a two-hundredth of the height.
_MIN_ANGLE = 0.005


@dataclass(frozen=True)
class Triangulation:
    """
    Points and their pixel covariance.

    Attributes
    ----------
    points : array, shape (n_points, 3), ENU, m
        NaN where observations do not determine a point in front of its cameras.
    covariance : array, shape (n_points, 3, 3), m^2
        Of the pixels alone; errors of poses are not in it.
    """

    points: FloatArray
    covariance: FloatArray


def observation_rays(block: ImageBlock, observations: Observations) -> FloatArray:
    """Unit directions of all observations in ENU, shape (n, 3)."""
    out = np.empty((len(observations), 3))
    order = np.argsort(observations.image, kind="stable")
    bounds = np.searchsorted(observations.image[order], np.arange(len(block) + 1))
    for i in range(len(block)):
        mine = order[bounds[i] : bounds[i + 1]]
        if mine.size:
            out[mine] = block.rays(i, observations.pixel[mine])
    return out


def triangulate(
    block: ImageBlock, observations: Observations, *, weight: FloatArray | None = None, n_iterations: int = 4
) -> Triangulation:
    """
    Points nearest to all their rays, then Gauss-Newton on the reprojection error.

    Parameters
    ----------
    block : ImageBlock
    observations : Observations
    weight : array, shape (n,), optional, 1 / pixels^2
        1 / sigma^2 by default; 0 leaves an observation out.
    n_iterations : int

    Notes
    -----
    With N photos at equal distances B, height H and focal length f, the height's standard deviation is
    H^2 / f * sigma / (B sqrt(N (N^2 - 1) / 12)).
    """
    if weight is None:
        weight = observations.sigma**-2.0
    points, covariance = triangulate_kernel(
        observation_rays(block, observations),
        block.rotation,
        block.position,
        block.intrinsics,
        block.lens,
        observations.start,
        observations.image,
        observations.pixel,
        weight,
        n_iterations,
    )
    projected = project_many(
        points, block.rotation, block.position, block.intrinsics, observations.point, observations.image, block.lens
    )
    behind = np.unique(observations.point[~(projected[:, 2] > 0)])
    points[behind] = np.nan
    covariance[behind] = np.nan
    return Triangulation(points, covariance)


def residuals(block: ImageBlock, points: FloatArray, observations: Observations) -> FloatArray:
    """
    Measured minus projected pixels.

    Parameters
    ----------
    block : ImageBlock
    points : array, shape (n_points, 3), ENU, m
    observations : Observations

    Returns
    -------
    residuals : array, shape (n, 2), pixels
        NaN for a point behind the camera.
    """
    projected = project_many(
        points, block.rotation, block.position, block.intrinsics, observations.point, observations.image, block.lens
    )
    out = observations.pixel - projected[:, :2]
    out[~(projected[:, 2] > 0)] = np.nan
    return np.asarray(out)


def are_determined(block: ImageBlock, points: FloatArray, observations: Observations) -> BoolArray:
    """
    Which points are seen under an angle; the others run off along their rays and leave normal equations singular.

    Parameters
    ----------
    block : ImageBlock
    points : array, shape (n_points, 3), ENU, m
    observations : Observations

    Notes
    -----
    The mean of two unit vectors an angle a apart has the length cos(a / 2).
    """
    if observations.n_points == 0:
        return np.zeros(0, dtype=bool)
    rays = points[observations.point] - block.position[observations.image]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    mean = np.add.reduceat(rays, observations.start[:-1]) / observations.n_views[:, None]
    length = np.minimum(np.linalg.norm(mean, axis=1), 1.0)
    return np.asarray(length < np.cos(_MIN_ANGLE / 2))


def two_view_error(height: float, baseline: float, focal: float, sigma: float) -> float:
    """
    Standard deviation of a height from two photos, m.

    Parameters
    ----------
    height, baseline : float, m
    focal, sigma : float, pixels

    Examples
    --------
    >>> round(two_view_error(100.0, 8.0, 2050.0, 0.3), 3)
    0.259
    """
    return height**2 / (focal * baseline) * float(np.sqrt(2.0)) * sigma
