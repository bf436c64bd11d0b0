"""
A flight oriented step by step: match, adjust, carry tracks on, adjust again.

Each step is a function of what the one before returned, so that a run can stop and go on between them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np
from scipy.linalg import block_diag

from changedetect.errors import InputDataError
from changedetect.photogrammetry.adjustment import Adjustment, AdjustmentSettings, adjust
from changedetect.photogrammetry.block import GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.extension import ExtensionSettings, extend_tracks
from changedetect.photogrammetry.ground import estimate_ground
from changedetect.photogrammetry.joint import JointSettings, drop_changed, require_shared, shared_between_flights
from changedetect.photogrammetry.ties import (
    Features,
    PairMatches,
    TieSettings,
    join_matches,
    match_pairs,
    overlapping_pairs,
)
from changedetect.photogrammetry.tracks import Photos, TrackSettings, strips, track_features
from changedetect.typing import FloatArray, IntArray

__all__ = [
    "Matching",
    "OrientationSettings",
    "Oriented",
    "OrientedTogether",
    "Step",
    "match_flight",
    "orient_flight",
    "orient_together",
]

logger = logging.getLogger(__name__)

#: Called with what has been done and how much there is, in one step.
Step = Callable[[int, int, str], None]
#: Mounting angles are seldom known better than this, rad; freeing them costs nothing where flight lines cross.
_BORESIGHT_STD = float(np.radians(0.3))
#: Fewest points with three views that a flight needs.
_MIN_POINTS = 50
#: Share of the usual number of observations below which a photo hardly takes part; false matches leave 2 %.
_LONELY = 0.05


@dataclass(frozen=True, kw_only=True)
class OrientationSettings:
    """
    Settings of all steps.

    Attributes
    ----------
    tracks, ties, extension, adjustment, joint
        Of each step.
    min_views : int
        Points with fewer views are not given out; two views alone leave three times the error of three.
    workers : int
        Photos or strips worked on at once.
    """

    tracks: TrackSettings = field(default_factory=TrackSettings)
    ties: TieSettings = field(default_factory=TieSettings)
    extension: ExtensionSettings = field(default_factory=ExtensionSettings)
    adjustment: AdjustmentSettings = field(default_factory=lambda: AdjustmentSettings(boresight_std=_BORESIGHT_STD))
    joint: JointSettings = field(default_factory=JointSettings)
    min_views: int = 3
    workers: int = 2


@dataclass(frozen=True)
class Matching:
    """
    What matching the photos of one flight found.

    Attributes
    ----------
    ground : GroundPlane
    strip : array, shape (n_images,), int64
        Run of overlapping photos each belongs to.
    tracks : Observations
    pairs : list of PairMatches
        Of features, for chains to other flights.
    ties : Observations
        The same joined to points.
    n_pairs : int
        Pairs of photos that overlap by the poses.
    """

    ground: GroundPlane
    strip: IntArray
    tracks: Observations
    pairs: list[PairMatches]
    ties: Observations
    n_pairs: int


@dataclass(frozen=True)
class Oriented:
    """
    An adjusted flight.

    Attributes
    ----------
    adjustment : Adjustment
    observations : Observations
        Those given to it: tracks carried on, then ties.
    """

    adjustment: Adjustment
    observations: Observations


@dataclass(frozen=True)
class OrientedTogether:
    """
    Flights adjusted together.

    Attributes
    ----------
    adjustment : Adjustment
    points : tuple of arrays of int
        Numbers of each flight's own points.
    n_shared : int
        Points that bind flights.
    moved : array, shape (n, 3), ENU, m
        Places of shared points left out because their ground changed.
    """

    adjustment: Adjustment
    points: tuple[IntArray, ...]
    n_shared: int
    moved: FloatArray


def match_flight(
    photos: Photos,
    features: Sequence[Features],
    block: ImageBlock,
    pose_std: tuple[float, float],
    settings: OrientationSettings,
    *,
    on_step: Step | None = None,
) -> Matching:
    """
    Find tracks along strips and ties between all photos of a flight.

    Parameters
    ----------
    photos : callable
    features : sequence of Features
        Of every photo.
    block : ImageBlock
        In the order of time.
    pose_std : (float, float), m and rad
        Standard deviation of positions and attitudes, without what the whole flight shares.
    settings : OrientationSettings
    on_step : callable, optional

    Raises
    ------
    InputDataError
        Photos do not overlap or share too few features.
    """
    cv2.setNumThreads(1)  # photos are worked on side by side already
    ground = estimate_ground(features, block)
    runs = strips(block, ground)
    strip = np.empty(len(block), np.int64)
    for label, run in enumerate(runs):
        strip[run] = label
    candidates = overlapping_pairs(block, ground, settings.ties.min_overlap)
    if not candidates:
        msg = (
            f"No photo overlaps another by a tenth ({len(block)} photos, {block.names[0]} and later). The camera must "
            "trigger more often, or photos and logs are not of one flight."
        )
        raise InputDataError(msg)
    tracks = track_features(
        photos,
        block,
        ground,
        settings.tracks,
        workers=settings.workers,
        on_photo=_counter(on_step, len(block), "tracks"),
    )
    above = block.position[:, 2] - ground.at(block.position[:, 0], block.position[:, 1])
    pairs = match_pairs(
        features,
        block,
        ground,
        candidates,
        settings.ties,
        position_std=float(np.hypot(pose_std[0], pose_std[1] * np.median(above))),
        workers=settings.workers,
        on_pair=_counter(on_step, len(candidates), "ties"),
    )
    ties = join_matches(features, pairs, settings.ties.sigma)
    _require_matches(block, tracks, ties)
    logger.info(
        "%d strips, %d tracked points, %d ties in %d pairs", len(runs), tracks.n_points, ties.n_points, len(pairs)
    )
    return Matching(ground, strip, tracks, pairs, ties, len(candidates))


def orient_flight(
    photos: Photos,
    block: ImageBlock,
    information: FloatArray,
    matching: Matching,
    settings: OrientationSettings,
    *,
    start: ImageBlock | None = None,
    marks: Observations | None = None,
    on_step: Step | None = None,
) -> Oriented:
    """
    Adjust a flight, carry its tracks to other strips, and adjust it again.

    Parameters
    ----------
    photos : callable
    block : ImageBlock
        Poses of navigation.
    information : array, shape (6 n, 6 n)
        Of these poses.
    matching : Matching
    settings : OrientationSettings
    start : ImageBlock, optional
        Poses and lens to begin with, where those given are too rough; the lens is then adjusted from the beginning.
    marks : Observations, optional
        Of control points; they become the last points given to the adjustment.
    on_step : callable, optional

    Raises
    ------
    InputDataError
        Observations and poses contradict each other.
    """
    rough = AdjustmentSettings(rounds=2, heeds_contradiction=False)
    if start is not None:
        rough = replace(settings.adjustment, rounds=2, boresight_std=0.0, min_views=2, heeds_contradiction=False)
    first = adjust(block, Observations.join([matching.tracks, matching.ties]), information, rough, start=start)
    is_track = first.origin < matching.tracks.n_points
    kept, _ = first.observations.keep(is_track[first.observations.point])
    carried = extend_tracks(
        photos,
        first.block,
        first.points[is_track],
        kept,
        matching.ground,
        settings.extension,
        settings.tracks,
        matching.strip,
        workers=settings.workers,
        on_photo=_counter(on_step, len(block), "tracks carried on"),
    )
    observations, _ = _seen_often(Observations.join([carried, matching.ties]), settings.min_views)
    if marks is not None:
        observations = Observations.join([observations, marks])
    report = _counter(on_step, settings.adjustment.rounds, "adjustment")
    final = replace(settings.adjustment, min_views=settings.min_views if marks is None else 2)
    return Oriented(adjust(block, observations, information, final, start=first.block, on_round=report), observations)


def orient_together(
    flights: Sequence[tuple[ImageBlock, FloatArray, Sequence[Features], Matching, Oriented]],
    names: tuple[str, ...],
    position_std: float,
    settings: OrientationSettings,
    *,
    on_step: Step | None = None,
) -> OrientedTogether:
    """
    Adjust several flights over one site together.

    Parameters
    ----------
    flights : sequence of (block, information, features, matching, oriented)
        Blocks with the poses of navigation, all in one ENU frame.
    names : tuple of str
        Of the flights, for messages.
    position_std : float, m
        How far the adjusted flights may lie apart.
    settings : OrientationSettings
    on_step : callable, optional

    Raises
    ------
    InputDataError
        Flights share too few points.
    """
    blocks, informations, features, matchings, oriented = zip(*flights, strict=True)
    given = ImageBlock.join(blocks)
    start = ImageBlock.join([result.adjustment.block for result in oriented])
    offsets = np.concatenate([[0], np.cumsum([len(block) for block in blocks])])
    everything = [feature for one in features for feature in one]
    ground = matchings[0].ground
    candidates = [
        (i, j)
        for i, j in overlapping_pairs(start, ground, settings.ties.min_overlap)
        if start.flight[i] != start.flight[j]
    ]
    between = match_pairs(
        everything,
        start,
        ground,
        candidates,
        settings.ties,
        position_std=position_std,
        workers=settings.workers,
        on_pair=_counter(on_step, len(candidates), "ties between flights"),
    )
    within = [
        PairMatches(pair.first + int(shift), pair.second + int(shift), pair.match)
        for matching, shift in zip(matchings, offsets, strict=False)
        for pair in matching.pairs
    ]
    shared = shared_between_flights(given, join_matches(everything, within + between, settings.ties.sigma))
    require_shared(given, shared, settings.joint, names)
    own = Observations.join([result.observations for result in oriented], [int(k) for k in offsets[:-1]])
    information = block_diag(*informations)
    rough = replace(settings.adjustment, rounds=2, min_views=2, heeds_contradiction=False)
    report = _counter(on_step, 2 + settings.adjustment.rounds, "adjustment together")
    first = adjust(given, Observations.join([own, shared]), information, rough, start=start, on_round=report)
    is_shared = first.origin >= own.n_points
    kept, _ = first.observations.keep(is_shared[first.observations.point])
    unmoved, moved = drop_changed(first.block, kept, settings.joint, names)
    both = Observations.join([own, unmoved])
    last = replace(settings.adjustment, min_views=settings.min_views)
    final = adjust(given, both, information, last, start=first.block, on_round=report)
    counts = np.cumsum([0] + [result.observations.n_points for result in oriented])
    points = tuple(np.flatnonzero((final.origin >= low) & (final.origin < high)) for low, high in pairwise(counts))
    return OrientedTogether(final, points, unmoved.n_points, moved)


def _seen_often(observations: Observations, min_views: int) -> tuple[Observations, IntArray]:
    return observations.keep(np.ones(len(observations), dtype=bool), min_views=min_views)


def _require_matches(block: ImageBlock, tracks: Observations, ties: Observations) -> None:
    """Refuse a flight whose photos show too little to orient them."""
    n_points = int((tracks.n_views >= 3).sum() + (ties.n_views >= 3).sum())
    per_photo = np.bincount(np.concatenate([tracks.image, ties.image]), minlength=len(block))
    if n_points < _MIN_POINTS:
        poorest = block.names[int(np.argmin(per_photo))]
        msg = (
            f"Only {n_points} points are seen by three photos or more, at least {_MIN_POINTS} are needed; the poorest "
            f"photo is {poorest} with {int(per_photo.min())} observations. Photos must overlap by two thirds and show "
            "ground with texture, not water; logs and photos must be of one flight, and the clock of the camera be in "
            "time."
        )
        raise InputDataError(msg)
    lonely = np.flatnonzero(per_photo < max(4.0, _LONELY * float(np.median(per_photo))))
    if lonely.size:
        names = ", ".join(block.names[i] for i in lonely[:5])
        logger.warning(
            "%d photos share hardly any points with the others and keep the poses they were given (out of order, of "
            "other ground, blurred, or over water?): %s",
            lonely.size,
            names,
        )


def _counter(on_step: Step | None, total: int, label: str) -> Callable[[], None] | None:
    """Callback that counts up to a total."""
    if on_step is None:
        return None
    done = iter(range(1, total + 1))

    def count() -> None:
        on_step(next(done, total), total, label)

    return count
