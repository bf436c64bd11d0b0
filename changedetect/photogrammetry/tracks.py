"""
Features followed from photo to photo along a strip.

Good Features to Track [1]_ are followed with the pyramidal Lucas-Kanade tracker [2]_. Between photos of a survey the
image moves by a fifth of its size, too far for the tracker alone: it starts where the poses and a plane near the ground
say a feature should be. A feature counts in the next photo if tracking it back returns to its start, and each later
photo is matched against the photo the feature was found in, so that errors do not add up along the track.

References
----------
.. [1] Shi, Tomasi (1994), Good features to track, doi:10.1109/CVPR.1994.323794.
.. [2] Bouguet (2001), Pyramidal implementation of the affine Lucas Kanade feature tracker.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from changedetect.photogrammetry.block import TRACK, GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.epipolar import MIN_MATCHES, fundamental_inliers, two_point_inliers
from changedetect.photogrammetry.lens import normalise
from changedetect.typing import BoolArray, FloatArray

__all__ = ["Photos", "TrackSettings", "overlap", "strips", "there_and_back", "track_features"]

#: Gives the grey photo of a position in the block, shape (height, width), uint8.
Photos: TypeAlias = Callable[[int], NDArray[np.uint8]]


@dataclass(frozen=True, kw_only=True)
class TrackSettings:
    """
    How features are found and followed.

    Attributes
    ----------
    n_features : int
        Wanted in each photo.
    min_distance : float, pixels
        Between features.
    quality : float
        Smallest corner response, as a share of the photo's best.
    window : int, pixels
        Side of the patch compared.
    levels : int
        Pyramid levels above the photo itself.
    max_return : float, pixels
        Largest distance between a feature and its image tracked there and back.
    max_epipolar : float, pixels
        Largest Sampson distance; 2 passes all true matches of poses good to half a degree.
    gate : str
        `two_point` (rotations from navigation) or `fundamental` (none).
    sigma : float, pixels
        Standard deviation given to a tracked coordinate.
    """

    n_features: int = 2000
    min_distance: float = 8.0
    quality: float = 0.005
    window: int = 21
    levels: int = 3
    max_return: float = 0.5
    max_epipolar: float = 2.0
    gate: str = "two_point"
    sigma: float = 0.3


def strips(
    block: ImageBlock, ground: GroundPlane, *, min_overlap: float = 0.2, max_turn_deg: float = 30.0
) -> list[list[int]]:
    """
    Runs of photos in which each overlaps the next and is turned like it.

    Parameters
    ----------
    block : ImageBlock
        Photos in the order of time.
    ground : GroundPlane
    min_overlap : float
        Smallest share of a photo seen by the next one; a run ends where it is less, as in a turn or between flights.
    max_turn_deg : float
        Largest rotation from photo to photo; a tracker does not follow further turned patterns.

    Returns
    -------
    runs : list of list of int
        Positions of the photos; every photo is in one run.
    """
    runs: list[list[int]] = [[0]] if len(block) else []
    for i in range(1, len(block)):
        turn = np.trace(block.rotation[i - 1].T @ block.rotation[i])  # 1 + 2 cos(angle)
        is_alike = turn >= 1 + 2 * np.cos(np.radians(max_turn_deg)) and block.flight[i] == block.flight[i - 1]
        if is_alike and overlap(block, i - 1, i, ground) >= min_overlap:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs


def overlap(block: ImageBlock, first: int, second: int, ground: GroundPlane) -> float:
    """Share of a coarse raster of the first photo whose ground the second one sees."""
    width, height = block.size_of(first)
    columns, rows = np.meshgrid((np.arange(8) + 0.5) * width / 8, (np.arange(6) + 0.5) * height / 6)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    points = ground.intersect(block.position[first], block.rays(first, pixels))
    seen = np.isfinite(points[:, 0])
    if not seen.any():
        return 0.0
    return float(block.is_inside(block.project(points[seen], second), second).sum() / len(pixels))


def track_features(
    photos: Photos,
    block: ImageBlock,
    ground: GroundPlane,
    settings: TrackSettings,
    *,
    workers: int = 2,
    on_photo: Callable[[], None] | None = None,
) -> Observations:
    """
    Follow features through all strips of a block.

    Parameters
    ----------
    photos : callable
    block : ImageBlock
        Photos in the order of time.
    ground : GroundPlane
    settings : TrackSettings
    workers : int
        Strips followed at once.
    on_photo : callable, optional
        Called after each photo.

    Returns
    -------
    observations : Observations
        At least two views each; points are numbered strip by strip, so the result does not depend on `workers`.
    """
    runs = strips(block, ground)
    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        parts = list(pool.map(lambda run: _track_strip(photos, block, ground, settings, run, on_photo), runs))
    return Observations.join(parts)


@dataclass
class _Active:
    """Features alive in the current photo."""

    label: NDArray[np.int64]
    pixel: NDArray[np.float32]
    anchor: NDArray[np.int64]
    anchor_pixel: NDArray[np.float32]

    @classmethod
    def empty(cls) -> _Active:
        none = np.empty(0, np.int64)
        return cls(none, np.empty((0, 2), np.float32), none, np.empty((0, 2), np.float32))

    def select(self, mask: BoolArray) -> _Active:
        return _Active(self.label[mask], self.pixel[mask], self.anchor[mask], self.anchor_pixel[mask])

    def extended(self, other: _Active) -> _Active:
        return _Active(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in vars(self)))


@dataclass
class _Record:
    """Observations of a strip as they come."""

    label: list[NDArray[np.int64]] = field(default_factory=list)
    image: list[NDArray[np.int64]] = field(default_factory=list)
    pixel: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, active: _Active, image: int) -> None:
        self.label.append(active.label)
        self.image.append(np.full(active.label.size, image, np.int64))
        self.pixel.append(active.pixel)

    def observations(self, sigma: float) -> Observations:
        label, image = np.concatenate(self.label), np.concatenate(self.image)
        pixel = np.concatenate(self.pixel).astype(np.float64)
        found = Observations.gather(label, image, pixel, np.full(label.size, sigma), np.full(label.size, TRACK))
        return found.keep(np.ones(len(found), dtype=bool))[0]


def _track_strip(
    photos: Photos,
    block: ImageBlock,
    ground: GroundPlane,
    settings: TrackSettings,
    run: Sequence[int],
    on_photo: Callable[[], None] | None,
) -> Observations:
    record, active, n_labels = _Record(), _Active.empty(), 0
    greys: dict[int, NDArray[np.uint8]] = {}
    for k, image in enumerate(run):
        grey = photos(image)
        greys[image] = grey
        if k:
            active = _follow(greys, block, ground, settings, active, run[k - 1], image)
        fresh = _detect(grey, active.pixel, settings)
        labels = np.arange(n_labels, n_labels + len(fresh))
        n_labels += len(fresh)
        active = active.extended(_Active(labels, fresh, np.full(len(fresh), image, np.int64), fresh))
        record.add(active, image)
        for old in set(greys) - set(active.anchor.tolist()) - {image}:
            del greys[old]
        if on_photo is not None:
            on_photo()
    return record.observations(settings.sigma)


def _detect(grey: NDArray[np.uint8], existing: NDArray[np.float32], settings: TrackSettings) -> NDArray[np.float32]:
    """New features away from those followed and from the rim."""
    wanted = settings.n_features - len(existing)
    if wanted <= 0:
        return np.empty((0, 2), np.float32)
    height, width = grey.shape
    rim = settings.window // 2 + 1
    mask = np.zeros(grey.shape, np.uint8)
    mask[rim : height - rim, rim : width - rim] = 255
    for column, row in np.rint(existing).astype(int):
        cv2.circle(mask, (int(column), int(row)), int(settings.min_distance), 0, -1)
    found = cv2.goodFeaturesToTrack(grey, wanted, settings.quality, settings.min_distance, mask=mask)
    return np.empty((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)


def _follow(
    greys: dict[int, NDArray[np.uint8]],
    block: ImageBlock,
    ground: GroundPlane,
    settings: TrackSettings,
    active: _Active,
    previous: int,
    image: int,
) -> _Active:
    """Features of the previous photo found in this one, their pixels moved."""
    if active.label.size == 0:
        return active
    points = ground.intersect(block.position[previous], block.rays(previous, active.pixel.astype(np.float64)))
    predicted = block.project(points, image)
    inside = np.isfinite(points[:, 0]) & block.is_inside(predicted, image)
    active, predicted = active.select(inside), predicted[inside]
    if active.label.size == 0:
        return active
    pixel, found = there_and_back(
        greys[previous], greys[image], active.pixel, predicted[:, :2].astype(np.float32), settings, settings.levels
    )
    active, pixel = active.select(found), pixel[found]
    pixel, found = _from_anchor(greys, active, pixel, previous, image, settings)
    before = active.pixel[found]
    active = active.select(found)
    active.pixel = pixel[found]
    return active.select(_agree(block, before, active.pixel, previous, image, settings))


def there_and_back(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    start: NDArray[np.float32],
    guess: NDArray[np.float32],
    settings: TrackSettings,
    levels: int,
) -> tuple[NDArray[np.float32], BoolArray]:
    """Track from the first to the second photo and back."""
    follow: Any = cv2.calcOpticalFlowPyrLK
    window = (settings.window, settings.window)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, ok, _ = follow(first, second, start, guess.copy(), None, None, window, levels, criteria, flags)
    back, ok_back, _ = follow(second, first, there, start.copy(), None, None, window, levels, criteria, flags)
    rows, columns = second.shape
    column, row = there[:, 0], there[:, 1]
    inside = (column >= 0) & (row >= 0) & (column <= columns - 1) & (row <= rows - 1)
    returned = np.linalg.norm(back - start, axis=1) <= settings.max_return
    return np.asarray(there, np.float32), np.asarray((ok.ravel() == 1) & (ok_back.ravel() == 1) & inside & returned)


def _from_anchor(
    greys: dict[int, NDArray[np.uint8]],
    active: _Active,
    pixel: NDArray[np.float32],
    previous: int,
    image: int,
    settings: TrackSettings,
) -> tuple[NDArray[np.float32], BoolArray]:
    """Match against the photo a feature was found in; one that then jumps had drifted and is given up."""
    pixel, found = pixel.copy(), np.ones(len(pixel), dtype=bool)
    for anchor in np.unique(active.anchor):
        if anchor == previous:
            continue
        mine = np.flatnonzero(active.anchor == anchor)
        refined, ok = there_and_back(
            greys[int(anchor)], greys[image], active.anchor_pixel[mine], pixel[mine], settings, 0
        )
        found[mine] = ok & (np.linalg.norm(refined - pixel[mine], axis=1) < 1.5)
        pixel[mine] = refined
    return pixel, found


def _agree(
    block: ImageBlock,
    before: NDArray[np.float32],
    after: NDArray[np.float32],
    previous: int,
    image: int,
    settings: TrackSettings,
) -> BoolArray:
    """Matches that agree with one camera motion; all of them where too few to say."""
    if len(before) < MIN_MATCHES:
        return np.ones(len(before), dtype=bool)
    first, second = before.astype(np.float64), after.astype(np.float64)
    if settings.gate == "fundamental":
        return fundamental_inliers(_flat(block, previous, first), _flat(block, image, second), settings.max_epipolar)
    focal = float(block.lens_of(image)[0])
    return two_point_inliers(block.rays(previous, first), block.rays(image, second), settings.max_epipolar / focal)[0]


def _flat(block: ImageBlock, image: int, pixel: FloatArray) -> FloatArray:
    """Undistorted pixels."""
    lens = block.lens_of(image)
    return np.asarray(normalise(pixel, lens) * lens[:2] + lens[2:4])
