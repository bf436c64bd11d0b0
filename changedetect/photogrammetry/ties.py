"""
Ties between photos that no track joins: strips of one flight, and flights of different epochs.

Scale-invariant features [1]_ are matched near the place where poses and a plane near the ground predict them, both ways
and with a ratio test, and tested against the geometry of each pair. Matches are joined to points seen in many photos.

References
----------
.. [1] Lowe (2004), Distinctive image features from scale-invariant keypoints, doi:10.1023/B:VISI.0000029664.99615.94.
.. [2] Arandjelovic, Zisserman (2012), Three things everyone should know to improve object retrieval (root SIFT).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from changedetect.kernels.matching import match_near
from changedetect.photogrammetry.block import TIE, GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.epipolar import MIN_MATCHES, two_point_inliers
from changedetect.photogrammetry.tracks import Photos, overlap
from changedetect.typing import FloatArray, IntArray

__all__ = [
    "Features",
    "PairMatches",
    "TieSettings",
    "detect_features",
    "join_matches",
    "match_pairs",
    "overlapping_pairs",
]


@dataclass(frozen=True, kw_only=True)
class TieSettings:
    """
    How ties are found.

    Attributes
    ----------
    n_features : int
        Largest number of features in a photo.
    contrast : float
        Smallest response of a feature, in SIFT's measure; less finds more on fields and beaches.
    ratio : float
        Nearest over second nearest descriptor distance of an unambiguous match.
    unrelated : float
        Squared distance of root SIFT descriptors that have nothing to do with each other.
    max_epipolar : float, pixels
    min_overlap : float
        Smallest share of a photo that a partner sees.
    min_matches : int
        Fewest matches that agree on a baseline; below, a pair's matches are chance.
    sigma : float, pixels
        Standard deviation given to a feature's coordinate.
    """

    n_features: int = 2000
    contrast: float = 0.04
    ratio: float = 0.8
    unrelated: float = 0.5
    max_epipolar: float = 3.0
    min_overlap: float = 0.1
    min_matches: int = 15
    sigma: float = 0.4


@dataclass(frozen=True)
class Features:
    """
    Features of one photo.

    Attributes
    ----------
    pixel : array, shape (n, 2), float64
        Column and row, rows ascending.
    raw : array, shape (n, 128), uint8
        SIFT descriptors.
    """

    pixel: FloatArray
    raw: NDArray[np.uint8]

    @cached_property
    def descriptor(self) -> NDArray[np.float32]:
        """Root SIFT [2]_ of unit length, shape (n, 128)."""
        total = np.maximum(self.raw.sum(axis=1, keepdims=True, dtype=np.float32), 1.0)
        return np.asarray(np.sqrt(self.raw / total), dtype=np.float32)

    def __len__(self) -> int:
        return len(self.pixel)


@dataclass(frozen=True)
class PairMatches:
    """Matches of two photos: `match[k]` holds the feature's number in the first and in the second."""

    first: int
    second: int
    match: IntArray


def detect_features(
    photos: Photos,
    n_photos: int,
    settings: TieSettings,
    *,
    workers: int = 2,
    on_photo: Callable[[], None] | None = None,
) -> list[Features]:
    """
    Find and describe features in every photo.

    Parameters
    ----------
    photos : callable
    n_photos : int
    settings : TieSettings
    workers : int
    on_photo : callable, optional
        Called after each photo.
    """

    def detect(image: int) -> Features:
        opencv: Any = cv2  # the stubs lack SIFT
        detector = opencv.SIFT_create(
            nfeatures=settings.n_features, contrastThreshold=settings.contrast, enable_precise_upscale=True
        )
        keypoints, descriptors = detector.detectAndCompute(photos(image), None)
        if on_photo is not None:
            on_photo()
        if descriptors is None or not keypoints:
            return Features(np.empty((0, 2)), np.empty((0, 128), np.uint8))
        pixel = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
        rows_columns, first = np.unique(
            pixel[:, ::-1], axis=0, return_index=True
        )  # one orientation each, rows ascending
        raw = np.clip(np.rint(descriptors[first]), 0, 255).astype(np.uint8)
        return Features(np.ascontiguousarray(rows_columns[:, ::-1]), raw)

    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        return list(pool.map(detect, range(n_photos)))


def overlapping_pairs(block: ImageBlock, ground: GroundPlane, min_overlap: float) -> list[tuple[int, int]]:
    """Pairs of photos that see at least a share `min_overlap` of each other's ground."""
    corners = np.stack([block.footprint(i, ground) for i in range(len(block))])
    centre = np.nanmean(corners, axis=1)[:, :2]
    reach = np.nanmax(np.linalg.norm(corners[:, :, :2] - centre[:, None], axis=2), axis=1)
    pairs = []
    for i in range(len(block)):
        near = np.flatnonzero(np.linalg.norm(centre[i + 1 :] - centre[i], axis=1) < reach[i + 1 :] + reach[i]) + i + 1
        pairs += [(i, int(j)) for j in near if overlap(block, i, int(j), ground) >= min_overlap]
    return pairs


def match_pairs(
    features: Sequence[Features],
    block: ImageBlock,
    ground: GroundPlane,
    pairs: Sequence[tuple[int, int]],
    settings: TieSettings,
    *,
    position_std: float,
    workers: int = 2,
    on_pair: Callable[[], None] | None = None,
) -> list[PairMatches]:
    """
    Match the features of pairs of photos.

    Parameters
    ----------
    features : sequence of Features
        Of every photo of the block.
    block : ImageBlock
    ground : GroundPlane
    pairs : sequence of (int, int)
    settings : TieSettings
    position_std : float, m
        How well poses place a photo on the ground; features are sought within three times this, and what the ground's
        relief adds.
    workers : int
    on_pair : callable, optional
        Called after each pair.

    Returns
    -------
    matches : list of PairMatches
        Pairs whose matches agree on a baseline.
    """

    def match(pair: tuple[int, int]) -> PairMatches | None:
        found = _match_pair(features, block, ground, pair, settings, position_std)
        if on_pair is not None:
            on_pair()
        return found

    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        return [found for found in pool.map(match, pairs) if found is not None]


def _match_pair(
    features: Sequence[Features],
    block: ImageBlock,
    ground: GroundPlane,
    pair: tuple[int, int],
    settings: TieSettings,
    position_std: float,
) -> PairMatches | None:
    i, j = pair
    a, b = features[i], features[j]
    if min(len(a), len(b)) < settings.min_matches:
        return None
    forth = _nearest(a, b, block, ground, (i, j), settings, position_std)
    back = _nearest(b, a, block, ground, (j, i), settings, position_std)
    mutual = np.flatnonzero((forth >= 0) & (back[forth] == np.arange(len(a))))
    if mutual.size < max(settings.min_matches, MIN_MATCHES):
        return None
    match = np.column_stack([mutual, forth[mutual]])
    focal = float(block.lens_of(j)[0])
    first, second = block.rays(i, a.pixel[match[:, 0]]), block.rays(j, b.pixel[match[:, 1]])
    inliers, _ = two_point_inliers(first, second, settings.max_epipolar / focal)
    if inliers.sum() < settings.min_matches:
        return None
    return PairMatches(i, j, match[inliers])


def _nearest(
    a: Features,
    b: Features,
    block: ImageBlock,
    ground: GroundPlane,
    pair: tuple[int, int],
    settings: TieSettings,
    position_std: float,
) -> IntArray:
    """Match features of one photo into another near where they should appear."""
    i, j = pair
    points = ground.intersect(block.position[i], block.rays(i, a.pixel))
    seen = np.isfinite(points[:, 0])
    predicted = np.full((len(a), 2), np.nan)
    predicted[seen] = block.project(points[seen], j)[:, :2]
    height = float(block.position[j, 2] - ground.at(block.position[j, 0], block.position[j, 1]))
    baseline = float(np.linalg.norm(block.position[i] - block.position[j]))
    error = 3 * np.hypot(np.sqrt(2) * position_std, ground.spread * baseline / height)
    radius = float(block.lens_of(j)[0] / height * error) + 5.0
    return np.asarray(
        match_near(predicted, b.pixel, a.descriptor, b.descriptor, radius, settings.ratio, settings.unrelated)
    )


def join_matches(features: Sequence[Features], matches: Sequence[PairMatches], sigma: float) -> Observations:
    """
    Points from pairwise matches: features joined by any chain of matches are one point.

    Parameters
    ----------
    features : sequence of Features
    matches : sequence of PairMatches
    sigma : float, pixels

    Returns
    -------
    observations : Observations
        A point that claims two features of one photo contradicts itself and is left out.
    """
    offset = np.concatenate([[0], np.cumsum([len(f) for f in features])])
    total = int(offset[-1])
    links = [np.column_stack([m.match[:, 0] + offset[m.first], m.match[:, 1] + offset[m.second]]) for m in matches]
    edges = np.concatenate(links) if links else np.empty((0, 2), np.int64)
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(total, total))
    label = connected_components(graph, directed=False)[1].astype(np.int64)
    image = np.repeat(np.arange(len(features)), np.diff(offset))
    used = np.unique(edges)
    label, image = label[used], image[used]
    key = label * len(features) + image
    keys, counts = np.unique(key, return_counts=True)
    contradictory = np.unique(keys[counts > 1] // len(features))
    fine = ~np.isin(label, contradictory)
    pixel = np.concatenate([f.pixel for f in features])[used] if total else np.empty((0, 2))
    n = int(fine.sum())
    return Observations.gather(label[fine], image[fine], pixel[fine], np.full(n, sigma), np.full(n, TIE))
