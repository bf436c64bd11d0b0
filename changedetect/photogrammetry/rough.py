"""
Photos oriented from rough poses: positions good to metres, angles to degrees or not known, a lens read from EXIF.

Such poses predict nothing within the reach of a tracker. Features are therefore matched between whole photos, without
prediction; an essential matrix [1]_ found by MAGSAC++ [2]_ drops what does not fit one camera motion (a fundamental
matrix would not be determined over flat ground). Headings that the pictures contradict are turned (`headings`). Then
everything is adjusted, first with wide tolerances and a fixed lens, then with the lens free. What comes out predicts
features to a few pixels, as the poses of a smoother do, and serves as their place to start; the poses stated stay the
priors of what follows.

References
----------
.. [1] Nister (2004), An efficient solution to the five-point relative pose problem, doi:10.1109/TPAMI.2004.17.
.. [2] Barath, Noskova, Ivashechkin, Matas (2020), MAGSAC++, doi:10.1109/CVPR42600.2020.00138.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from changedetect.errors import InputDataError
from changedetect.photogrammetry.adjustment import AdjustmentSettings, adjust
from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.ground import match_descriptors
from changedetect.photogrammetry.headings import correct_headings, estimate_headings
from changedetect.photogrammetry.lens import normalise
from changedetect.photogrammetry.ties import Features, PairMatches, join_matches
from changedetect.typing import BoolArray, FloatArray

__all__ = ["RoughOrientation", "RoughSettings", "neighbouring_pairs", "orient_roughly"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RoughSettings:
    """
    How rough poses are improved.

    Attributes
    ----------
    n_neighbours : int
        Photos, nearest first, that each photo is matched with; the next in time comes with them.
    ratio : float
        Nearest over second nearest descriptor distance of an unambiguous match.
    max_error : float
        Largest distance from the epipolar line, as a share of the photo's longer side; leaves room for a distortion
        not known yet.
    min_matches : int
        Fewest matches that agree on one motion of the camera.
    sigma : tuple of float, pixels
        Standard deviation given to a feature in each adjustment; the lens is free from the second on.
    """

    n_neighbours: int = 9
    ratio: float = 0.75
    max_error: float = 0.0025
    min_matches: int = 20
    sigma: tuple[float, ...] = (10.0, 2.0, 1.0)


@dataclass(frozen=True)
class RoughOrientation:
    """
    Result of `orient_roughly`.

    Attributes
    ----------
    given : ImageBlock
        As stated, but for headings that the pictures contradict: the centre of the priors.
    start : ImageBlock
        Adjusted poses and lens.
    is_turned : array, shape (n,), bool
        Photos whose heading was changed.
    is_joined : array, shape (n,), bool
        Photos matched, directly or over others, with the largest group.
    ground_height : float, m
        Median height of the points.
    n_pairs, n_tried : int
        Pairs of photos that match, and those compared.
    """

    given: ImageBlock
    start: ImageBlock
    is_turned: BoolArray
    is_joined: BoolArray
    ground_height: float
    n_pairs: int
    n_tried: int


def orient_roughly(
    features: Sequence[Features],
    block: ImageBlock,
    information: FloatArray,
    has_heading: BoolArray,
    adjustment: AdjustmentSettings,
    settings: RoughSettings | None = None,
    *,
    workers: int = 2,
    on_pair: Callable[[], None] | None = None,
) -> RoughOrientation:
    """
    Bring rough poses near enough to the truth for features to be predicted.

    Parameters
    ----------
    features : sequence of Features
    block : ImageBlock
        Poses and lens as stated.
    information : array, shape (6 n, 6 n)
        Of these poses.
    has_heading : array, shape (n,), bool
        Which photos state a heading; the others get theirs from the pictures.
    adjustment : AdjustmentSettings
        Which lens parameters are free, and how well they are known before.
    settings : RoughSettings, optional
    workers : int
        Pairs matched at once.
    on_pair : callable, optional
        Called after each of `neighbouring_pairs`.

    Raises
    ------
    InputDataError
        Photos do not match, or contradict their positions.
    """
    settings = settings or RoughSettings()
    cv2.setNumThreads(1)  # pairs are matched side by side already
    candidates = neighbouring_pairs(block, settings.n_neighbours)
    pairs = _match(features, block, candidates, settings, workers, on_pair)
    is_joined = _joined(len(block), pairs)
    _require_joined(features, block, pairs, candidates, is_joined)
    given, is_turned = correct_headings(block, estimate_headings(features, pairs, block), has_heading)
    observations = join_matches(features, pairs, 1.0)
    start = given
    for k, sigma in enumerate(settings.sigma):
        weighted = replace(observations, sigma=np.full(len(observations), sigma))
        lens = adjustment.lens if k else ()
        stage = replace(adjustment, lens=lens, boresight_std=0.0, rounds=3, min_views=2)
        stage = replace(stage, heeds_contradiction=False)
        solved = adjust(given, weighted, information, stage, start=start)
        start = solved.block
    logger.info(
        "rough orientation: %d of %d pairs match, %d points, poses moved by %.1f m and %.1f degrees (rms)",
        len(pairs), len(candidates), len(solved.points),
        float(np.sqrt(np.mean(np.sum(solved.pose_correction[:, :3] ** 2, axis=1)))),
        float(np.degrees(np.sqrt(np.mean(np.sum(solved.pose_correction[:, 3:] ** 2, axis=1))))),
    )  # fmt: skip
    ground = float(np.median(solved.points[:, 2]))
    return RoughOrientation(given, start, is_turned, is_joined, ground, len(pairs), len(candidates))


def neighbouring_pairs(block: ImageBlock, n_neighbours: int) -> list[tuple[int, int]]:
    """Pairs of each photo with those taken nearest to it, and with the next in the order of time."""
    n = len(block)
    tree = cKDTree(block.position[:, :2])
    near = np.reshape(tree.query(block.position[:, :2], k=min(n_neighbours + 1, n))[1], (n, -1))
    pairs = {(min(i, int(j)), max(i, int(j))) for i in range(n) for j in near[i] if i != j}
    return sorted(pairs | {(i, i + 1) for i in range(n - 1)})


def _match(
    features: Sequence[Features],
    block: ImageBlock,
    candidates: Sequence[tuple[int, int]],
    settings: RoughSettings,
    workers: int,
    on_pair: Callable[[], None] | None,
) -> list[PairMatches]:
    def match(pair: tuple[int, int]) -> PairMatches | None:
        found = match_descriptors(features[pair[0]], features[pair[1]], settings.ratio)
        if len(found) >= settings.min_matches:
            inliers = _one_motion(features, block, pair, found, settings.max_error)
            found = found[inliers]
        if on_pair is not None:
            on_pair()
        return PairMatches(*pair, found) if len(found) >= settings.min_matches else None

    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        return [found for found in pool.map(match, candidates) if found is not None]


def _one_motion(
    features: Sequence[Features], block: ImageBlock, pair: tuple[int, int], match: Any, max_error: float
) -> BoolArray:
    """Matches that agree with one essential matrix."""
    i, j = pair
    focal = float(block.lens_of(i)[0])
    flat = [
        normalise(features[image].pixel[match[:, k]], block.lens_of(image)) * focal for k, image in enumerate((i, j))
    ]
    cv2.setRNGSeed(0)
    estimate: Any = cv2.findEssentialMat  # its stub denies that it may find none
    threshold = max_error * max(block.size_of(i))
    matrix, mask = estimate(*flat, np.diag([focal, focal, 1.0]), cv2.USAC_MAGSAC, 0.999, threshold, 2000)
    if matrix is None or mask is None:
        return np.zeros(len(match), dtype=bool)
    return np.asarray(mask).ravel().astype(bool)


def _joined(n: int, pairs: Sequence[PairMatches]) -> BoolArray:
    """Photos of the largest group that matches join."""
    first, second = [p.first for p in pairs], [p.second for p in pairs]
    graph = coo_array((np.ones(len(pairs)), (first, second)), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    return np.asarray(label == np.bincount(label).argmax())


def _require_joined(
    features: Sequence[Features],
    block: ImageBlock,
    pairs: Sequence[PairMatches],
    candidates: Sequence[tuple[int, int]],
    is_joined: BoolArray,
) -> None:
    """Refuse photos that show too little in common."""
    n = len(block)
    if is_joined.sum() >= max(3, n / 2):
        if not is_joined.all():
            names = ", ".join(block.names[i] for i in np.flatnonzero(~is_joined)[:5])
            logger.warning(
                "%d of %d photos are not joined with the others by matches, only by their positions: %s",
                int((~is_joined).sum()),
                n,
                names,
            )
        return
    poorest = int(np.argmin([len(f) for f in features]))
    lonely = block.names[int(np.flatnonzero(~is_joined)[0])]
    distance = np.median([np.linalg.norm(block.position[i] - block.position[j]) for i, j in candidates])
    msg = (
        f"The photos do not overlap or show too little: only {int(is_joined.sum())} of {n} are joined by matches "
        f"({len(pairs)} of {len(candidates)} pairs, {distance:.0f} m apart in the median); {lonely} matches none of "
        f"the group. {block.names[poorest]} has the fewest features, {len(features[poorest])}. Photos must overlap by "
        "two thirds and show ground with texture, not water; leave out photos of another flight."
    )
    raise InputDataError(msg)
