"""
Tracks carried from strip to strip once poses are good.

A tracker compares patches of one orientation and scale, so a track ends where its strip ends. With adjusted poses every
other photo that sees a point can be turned into the geometry of the photo the track began in: each of its pixels is
sent through a plane near the ground. There the point lies within a few pixels of its prediction, the patches look
alike, and the tracker measures it to a fraction of a pixel. Points seen in two or three strips have twice the views
and are tied together far better than descriptors alone tie them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from changedetect.photogrammetry.block import TIE, GroundPlane, ImageBlock, Observations
from changedetect.photogrammetry.tracks import Photos, TrackSettings, there_and_back
from changedetect.typing import FloatArray, IntArray

__all__ = ["ExtensionSettings", "extend_tracks", "rectified"]

#: Pixels between the nodes of the grid on which the mapping between two photos is computed.
_NODE = 16


@dataclass(frozen=True, kw_only=True)
class ExtensionSettings:
    """
    How tracks are carried on.

    Attributes
    ----------
    max_miss : float, pixels
        Largest distance between the place predicted and the place found.
    margin : float, pixels
        Between a prediction and the rim of the photo.
    min_points : int
        Photos that see fewer points of another photo are not compared with it.
    max_turn : float, degrees
        Largest angle between the viewing directions of the two photos.
    """

    max_miss: float = 4.0
    margin: float = 12.0
    min_points: int = 10
    max_turn: float = 45.0


def extend_tracks(
    photos: Photos,
    block: ImageBlock,
    points: FloatArray,
    observations: Observations,
    ground: GroundPlane,
    settings: ExtensionSettings,
    track_settings: TrackSettings,
    strip: IntArray,
    *,
    workers: int = 2,
    on_photo: Callable[[], None] | None = None,
) -> Observations:
    """
    Look for every tracked point in the other photos of its flight that see it.

    Parameters
    ----------
    photos : callable
    block : ImageBlock
        Adjusted poses.
    points : array, shape (n_points, 3), ENU, m
    observations : Observations
        Of these points; the first view of each is the pattern looked for.
    ground : GroundPlane
    settings : ExtensionSettings
    track_settings : TrackSettings
    strip : array, shape (n_images,)
        Label of the strip each photo belongs to; what follows in the same strip is left to the tracker.
    workers : int
    on_photo : callable, optional
        Called after each photo.

    Returns
    -------
    observations : Observations
        The same points in the same order, with the views found added.
    """
    anchor = observations.image[observations.start[:-1]]

    def search(image: int) -> list[tuple[IntArray, IntArray, FloatArray]]:
        mine = np.flatnonzero(anchor == image)
        found = []
        if mine.size:
            seen = _seen_by(block, points[mine], image, settings, strip)
            for other, inside in seen.items():
                known = _known(observations, mine, other)
                wanted = mine[inside & ~known]
                if wanted.size >= settings.min_points:
                    pixel, good = _find(
                        photos, block, points, observations, ground, (image, other), wanted, settings, track_settings
                    )
                    found.append((wanted[good], np.full(int(good.sum()), other, np.int64), pixel[good]))
        if on_photo is not None:
            on_photo()
        return found

    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        parts = [part for found in pool.map(search, range(len(block))) for part in found]
    point = np.concatenate([observations.point, *(part[0] for part in parts)])
    image = np.concatenate([observations.image, *(part[1] for part in parts)])
    pixel = np.concatenate([observations.pixel, *(part[2] for part in parts)])
    n_new = len(point) - len(observations)
    sigma = np.concatenate([observations.sigma, np.full(n_new, track_settings.sigma)])
    kind = np.concatenate([observations.kind, np.full(n_new, TIE)])
    return Observations.gather(point, image, pixel, sigma, kind)


def rectified(
    grey: NDArray[np.uint8], block: ImageBlock, ground: GroundPlane, pair: tuple[int, int]
) -> NDArray[np.uint8]:
    """
    Second photo of a pair as it would look from the first, were the ground the plane.

    Parameters
    ----------
    grey : array, shape (height, width), uint8
        The second photo.
    block : ImageBlock
    ground : GroundPlane
    pair : (int, int)

    Returns
    -------
    rectified : array, shape (height, width) of the first photo, uint8
    """
    first, second = pair
    width, height = block.size_of(first)
    columns = np.arange(0, width + _NODE, _NODE, dtype=np.float64)
    rows = np.arange(0, height + _NODE, _NODE, dtype=np.float64)
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    there = transfer(block, ground, first, second, nodes).reshape(rows.size, columns.size, 2).astype(np.float32)
    there = np.nan_to_num(there, nan=-1e6)
    # bilinear between the nodes: their centres fall on whole multiples of the spacing
    at_column, at_row = np.meshgrid(
        np.arange(width, dtype=np.float32) / _NODE, np.arange(height, dtype=np.float32) / _NODE
    )
    fine = cv2.remap(there, at_column, at_row, cv2.INTER_LINEAR)
    return np.asarray(cv2.remap(grey, fine[..., 0], fine[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)


def transfer(block: ImageBlock, ground: GroundPlane, first: int, second: int, pixel: FloatArray) -> FloatArray:
    """Pixels of one photo sent through the ground plane into another, shape (n, 2); NaN above the horizon."""
    points = ground.intersect(block.position[first], block.rays(first, pixel))
    seen = np.isfinite(points[:, 0])
    out = np.full((len(pixel), 2), np.nan)
    projected = block.project(points[seen], second)
    projected[~(projected[:, 2] > 0)] = np.nan
    out[seen] = projected[:, :2]
    return out


def _seen_by(
    block: ImageBlock, points: FloatArray, image: int, settings: ExtensionSettings, strip: IntArray
) -> dict[int, NDArray[np.bool_]]:
    """For every photo of another strip, or earlier in this one, with a similar view: which points it sees."""
    axis = block.rotation[:, :, 2]
    alike = (axis @ axis[image] > np.cos(np.radians(settings.max_turn))) & (block.flight == block.flight[image])
    alike &= (strip != strip[image]) | (np.arange(len(block)) < image)  # a track goes forwards from its first photo
    seen = {}
    for other in np.flatnonzero(alike):
        inside = block.is_inside(block.project(points, int(other)), int(other), settings.margin)
        if inside.sum() >= settings.min_points:
            seen[int(other)] = inside
    return seen


def _known(observations: Observations, points: IntArray, image: int) -> NDArray[np.bool_]:
    """Which points already have a view in a photo."""
    is_here = np.zeros(observations.n_points, dtype=bool)
    is_here[observations.point[observations.image == image]] = True
    return np.asarray(is_here[points])


def _find(
    photos: Photos,
    block: ImageBlock,
    points: FloatArray,
    observations: Observations,
    ground: GroundPlane,
    pair: tuple[int, int],
    wanted: IntArray,
    settings: ExtensionSettings,
    track_settings: TrackSettings,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Pixels of points in the second photo, and which were found."""
    first, second = pair
    pattern = observations.pixel[observations.start[wanted]]
    predicted = block.project(points[wanted], second)[:, :2]
    # The prediction keeps the error the point has in its first photo, which the pattern shows
    guess = transfer(block, ground, second, first, predicted)
    inside = np.isfinite(guess[:, 0])
    turned = rectified(photos(second), block, ground, pair)
    found, good = there_and_back(
        photos(first), turned, pattern.astype(np.float32), np.nan_to_num(guess).astype(np.float32), track_settings, 1
    )
    pixel = transfer(block, ground, first, second, found.astype(np.float64))
    miss = np.linalg.norm(pixel - predicted, axis=1)
    return pixel, good & inside & (miss < settings.max_miss)
