"""A plane near the ground, from the photos themselves: where features should appear is predicted with it."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from changedetect.errors import InputDataError
from changedetect.photogrammetry.block import TIE, GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.epipolar import MIN_MATCHES, two_point_inliers
from changedetect.photogrammetry.ties import Features
from changedetect.photogrammetry.triangulation import triangulate
from changedetect.typing import FloatArray, IntArray

__all__ = ["estimate_ground", "fit_plane", "match_descriptors"]

logger = logging.getLogger(__name__)

#: Pairs of consecutive photos tried; a dozen places suffice for a plane.
_MAX_PAIRS = 16
_RATIO = 0.75
#: Rays that meet at less than this angle (rad) do not fix a height.
_MIN_ANGLE = 0.01
_MIN_POINTS = 20


def estimate_ground(features: Sequence[Features], block: ImageBlock) -> GroundPlane:
    """
    Find the plane near the ground from features of consecutive photos.

    Parameters
    ----------
    features : sequence of Features
        Of every photo of the block.
    block : ImageBlock
        Photos in the order of time.

    Raises
    ------
    InputDataError
        Consecutive photos share too few features: no overlap, no texture (water), or photos of another flight.
    """
    first = np.flatnonzero(block.flight[1:] == block.flight[:-1])
    chosen = first[np.unique(np.linspace(0, len(first) - 1, min(_MAX_PAIRS, len(first))).astype(int))]
    points, counts = [], []
    for i in chosen:
        found = _pair_points(features, block, int(i), int(i) + 1)
        counts.append(len(found))
        points.append(found)
    together = np.concatenate(points) if points else np.empty((0, 3))
    if len(together) < _MIN_POINTS:
        fewest = min((len(f) for f in features), default=0)
        msg = (
            f"Consecutive photos do not match: {len(together)} common ground points in {len(chosen)} pairs of the "
            f"{len(block)} photos ({block.names[0] if block.names else 'none'} and later; at least {fewest} features "
            "in each). Photos must overlap by half or more and show ground with texture, not water; and logs and "
            "photos must be of one flight."
        )
        raise InputDataError(msg)
    plane = fit_plane(together)
    logger.info("ground near %.1f m, spread %.1f m, from %d points", plane.height, plane.spread, len(together))
    return plane


def fit_plane(points: FloatArray) -> GroundPlane:
    """
    Fit a plane to points robustly.

    Parameters
    ----------
    points : array, shape (n, 3), m

    Returns
    -------
    plane : GroundPlane
        Slopes beyond 1:2 are not believed; the plane is then level.
    """
    middle = np.median(points, axis=0)
    design = np.column_stack([np.ones(len(points)), points[:, :2] - middle[:2]])
    height = points[:, 2]
    coefficients = np.array([middle[2], 0.0, 0.0])
    for _ in range(20):
        off = np.abs(height - design @ coefficients)
        scale = max(1.4826 * float(np.median(off)), 0.01)
        weight = 1.0 / (1.0 + (off / (2.0 * scale)) ** 2)
        coefficients = np.linalg.lstsq(design * weight[:, None], height * weight, rcond=None)[0]
    if np.hypot(coefficients[1], coefficients[2]) > 0.5:
        coefficients = np.array([middle[2], 0.0, 0.0])
    spread = 1.4826 * float(np.median(np.abs(height - design @ coefficients)))
    origin = coefficients[0] - coefficients[1] * middle[0] - coefficients[2] * middle[1]
    return GroundPlane(float(origin), float(coefficients[1]), float(coefficients[2]), max(spread, 0.5))


def _pair_points(features: Sequence[Features], block: ImageBlock, i: int, j: int) -> FloatArray:
    """Ground points of two photos, matched without a prediction."""
    match = match_descriptors(features[i], features[j], _RATIO)
    if len(match) < MIN_MATCHES:
        return np.empty((0, 3))
    first, second = features[i].pixel[match[:, 0]], features[j].pixel[match[:, 1]]
    rays = block.rays(i, first), block.rays(j, second)
    inliers, _ = two_point_inliers(*rays, 5.0 / float(block.lens_of(j)[0]))
    wide = np.sum(rays[0] * rays[1], axis=1) < np.cos(_MIN_ANGLE)
    keep = np.flatnonzero(inliers & wide)
    if keep.size < MIN_MATCHES:
        return np.empty((0, 3))
    n = keep.size
    observations = Observations.gather(
        np.tile(np.arange(n), 2),
        np.repeat([i, j], n),
        np.concatenate([first[keep], second[keep]]),
        np.ones(2 * n),
        np.full(2 * n, TIE),
    )
    points = triangulate(block, observations).points
    below = points[:, 2] < min(block.position[i, 2], block.position[j, 2])  # also drops NaN
    return np.asarray(points[below])


def match_descriptors(a: Features, b: Features, ratio: float) -> IntArray:
    """
    Mutual nearest neighbours of two photos' features, wherever they lie.

    Parameters
    ----------
    a, b : Features
    ratio : float
        Largest distance to the nearest descriptor, as a share of that to the second nearest.

    Returns
    -------
    match : array, shape (n, 2), int64
        Numbers of the features in both photos.
    """
    if min(len(a), len(b)) < 2:
        return np.empty((0, 2), np.int64)
    product = a.descriptor @ b.descriptor.T
    best = np.argmax(product, axis=1)
    rows = np.arange(len(a))
    nearest = 2 - 2 * product[rows, best]
    back = np.argmax(product, axis=0)
    product[rows, best] = -1
    second = 2 - 2 * product.max(axis=1)
    good = (back[best] == rows) & (nearest < ratio**2 * second)
    return np.column_stack([rows[good], best[good]])
