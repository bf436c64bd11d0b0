"""
A height for every cell of a fine grid, from all photos that see it.

The ground is described by the height of each cell; every photo is projected onto it. Where heights are right, all
photos show the same picture, so heights are moved until they do: least squares over all views and a window of cells
around each, from coarse cells and blurred photos to fine ones [1]_. The height starts from the sparse points, within
the reach of the coarsest level. Only the height is sought, so every view counts, and the curvature of the sum of
squares says how well the pattern fixes it.

References
----------
.. [1] Wrobel (1987), Facets stereo vision (FAST Vision), Proc. ISPRS Intercommission Conference on Fast Processing of
   Photogrammetric Data, 231-258.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from changedetect.errors import InputDataError
from changedetect.kernels.dense import cell_maps
from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.tracks import Photos
from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["DensePoints", "DenseSettings", "dense_points"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class DenseSettings:
    """
    How heights are found.

    Attributes
    ----------
    spacing : float, pixels
        Side of a cell, in sizes of a pixel on the ground.
    levels : int
        Coarser levels before the finest; each doubles cells and blur.
    window : int, cells
        Side of the window compared.
    iterations : int
        Steps on each level.
    tile : float, m
        Side of the squares worked on at once.
    min_views : int
        Cells seen by fewer photos get no height.
    max_views : int
        The photos nearest to the vertical are taken where more see a tile.
    min_correlation : float
        Views whose pattern agrees less with the mean of all are left out, and cells whose views do.
    max_gap : float, m
        Largest distance of a cell to the nearest sparse points.
    """

    spacing: float = 1.35
    levels: int = 2
    window: int = 9
    iterations: int = 4
    tile: float = 30.0
    min_views: int = 3
    max_views: int = 16
    min_correlation: float = 0.5
    max_gap: float = 3.0


@dataclass(frozen=True)
class DensePoints:
    """
    Heights of cells.

    Attributes
    ----------
    points : array, shape (n, 3), ENU, m
    sigma : array, shape (n,), m
        Of the pixels and of the pattern, without what poses and lens share.
    n_views : array, shape (n,), int64
    nearest : array, shape (n,), int64
        Sparse point nearest to each.
    cell : float, m
    """

    points: FloatArray
    sigma: FloatArray
    n_views: IntArray
    nearest: IntArray
    cell: float


def dense_points(
    photos: Photos,
    block: ImageBlock,
    sparse: FloatArray,
    pixel_std: float,
    gsd: float,
    settings: DenseSettings | None = None,
    *,
    workers: int = 2,
    on_tile: Callable[[int, int], None] | None = None,
) -> DensePoints:
    """
    Find the height of every cell of a grid.

    Parameters
    ----------
    photos : callable
    block : ImageBlock
        Adjusted poses of one flight.
    sparse : array, shape (n, 3), ENU, m
        Points of the adjustment, from which heights start.
    pixel_std : float, pixels
        Error of a photo's geometry at a place, common to the pixels of a window: that of tracked points.
    gsd : float, m
        Size of a pixel on the ground.
    settings : DenseSettings, optional
    workers : int
    on_tile : callable, optional
        Called with tiles done and all tiles.

    Raises
    ------
    InputDataError
        No cell could be matched.
    """
    settings = settings or DenseSettings()
    cell = settings.spacing * gsd
    tree = cKDTree(sparse[:, :2])
    start = LinearNDInterpolator(sparse[:, :2], _without_spikes(sparse, tree))
    tiles = list(_tiles(sparse, cell, settings))

    def work(tile: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray, IntArray]:
        return _match_tile(photos, block, tile, start, tree, pixel_std, cell, settings)

    parts = []
    with ThreadPoolExecutor(max_workers=max(workers, 1)) as pool:
        for done, part in enumerate(pool.map(work, tiles), start=1):
            parts.append(part)
            if on_tile is not None:
                on_tile(done, len(tiles))
    points = np.concatenate([part[0] for part in parts])
    if len(points) == 0:
        msg = (
            f"No ground cell of {cell:.2f} m could be matched in three photos or more. Photos need more overlap or "
            "texture; use the points of the adjustment instead (without --dense)."
        )
        raise InputDataError(msg)
    sigma = np.concatenate([part[1] for part in parts])
    n_views = np.concatenate([part[2] for part in parts])
    nearest = tree.query(points[:, :2])[1]
    logger.info("%d cells of %.3f m in %d tiles", len(points), cell, len(tiles))
    return DensePoints(points, sigma, n_views, np.asarray(nearest, dtype=np.int64), cell)


def _without_spikes(sparse: FloatArray, tree: cKDTree) -> FloatArray:
    """Heights of sparse points, those far from the median of their neighbours replaced by it."""
    near = tree.query(sparse[:, :2], k=min(9, len(sparse)))[1]
    median = np.median(sparse[near, 2], axis=1)
    off = np.abs(sparse[:, 2] - median)
    limit = max(4 * 1.4826 * float(np.median(off)), 0.1)
    return np.where(off > limit, median, sparse[:, 2])


def _tiles(sparse: FloatArray, cell: float, settings: DenseSettings) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Cell centres east and north of every tile, on one lattice."""
    count = max(int(settings.tile / cell), 8)
    low, high = np.floor(sparse[:, :2].min(axis=0) / cell), np.ceil(sparse[:, :2].max(axis=0) / cell)
    for column in range(int(low[0]), int(high[0]), count):
        for row in range(int(low[1]), int(high[1]), count):
            east = np.arange(column, min(column + count, int(high[0])), dtype=np.float64)
            north = np.arange(row, min(row + count, int(high[1])), dtype=np.float64)
            yield (east + 0.5) * cell, (north + 0.5) * cell


def _match_tile(
    photos: Photos,
    block: ImageBlock,
    tile: tuple[FloatArray, FloatArray],
    start: LinearNDInterpolator,
    tree: cKDTree,
    pixel_std: float,
    cell: float,
    settings: DenseSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Points of one tile with standard deviations and numbers of views; a rim of windows around it is matched too."""
    rim = settings.window * 2**settings.levels // 2 + 2
    nothing = np.empty((0, 3)), np.empty(0), np.empty(0, np.int64)
    inner = slice(rim, rim + tile[1].size), slice(rim, rim + tile[0].size)
    before, after = cell * np.arange(-rim, 0), cell * np.arange(1, rim + 1)
    wide = [np.concatenate([axis[0] + before, axis, axis[-1] + after]) for axis in tile]
    grid_east, grid_north = np.meshgrid(*wide)
    height = np.asarray(start(grid_east, grid_north), dtype=np.float64)
    if not np.isfinite(height[inner]).any():
        return nothing
    views = _views(block, tile, float(np.nanmedian(height)), settings.max_views)
    if len(views) < settings.min_views:
        return nothing
    greys = {view: photos(view) for view in views}
    for level in range(settings.levels, -1, -1):
        height = _refine(greys, block, wide, height, level, settings)
    return _finish(greys, block, wide, height, inner, tree, pixel_std, settings)


def _views(block: ImageBlock, tile: tuple[FloatArray, FloatArray], height: float, most: int) -> list[int]:
    """Photos that see any of nine places of a tile, those nearest above it first."""
    east, north = np.meshgrid(np.linspace(tile[0][0], tile[0][-1], 3), np.linspace(tile[1][0], tile[1][-1], 3))
    places = np.column_stack([east.ravel(), north.ravel(), np.full(9, height)])
    seen = [i for i in range(len(block)) if block.is_inside(block.project(places, i), i).any()]
    away = [float(np.linalg.norm(block.position[i, :2] - places[4, :2])) for i in seen]
    return [seen[k] for k in np.argsort(away)[:most]]


def _refine(
    greys: dict[int, NDArray[np.uint8]],
    block: ImageBlock,
    axes: list[FloatArray],
    height: FloatArray,
    level: int,
    settings: DenseSettings,
) -> FloatArray:
    """Heights improved with cells and photos coarsened by 2 ** level."""
    factor = 2**level
    coarse_axes = [axis[: axis.size // factor * factor].reshape(-1, factor).mean(axis=1) for axis in axes]
    shape = coarse_axes[1].size, coarse_axes[0].size
    whole = height[: shape[0] * factor, : shape[1] * factor]
    coarse = whole.reshape(shape[0], factor, shape[1], factor).mean(axis=(1, 3))
    begin = coarse.copy()
    pictures = {view: _picture(grey, level) for view, grey in greys.items()}
    for _ in range(settings.iterations):
        patterns, slopes, seen, rise = _project(pictures, block, coarse_axes, coarse, settings.window)
        slope, curvature = _normal(patterns, slopes, seen, settings.window)
        with np.errstate(invalid="ignore", divide="ignore"):
            step = -slope / curvature
            limit = 1.0 * factor / rise  # one coarse pixel of parallax
        step = np.where(np.isfinite(step) & (seen.sum(axis=0) >= 2), np.clip(step, -limit, limit), 0.0)
        coarse = coarse + step
        known = np.isfinite(coarse)
        smooth = cv2.medianBlur(np.where(known, coarse, 0.0).astype(np.float32), 3)
        coarse = np.where(known & (cv2.blur(known.astype(np.float32), (3, 3)) > 0.99), smooth, coarse)
    if factor == 1:
        return np.asarray(coarse, dtype=np.float64)
    change = np.nan_to_num(coarse - begin).astype(np.float32)
    out = height.copy()
    grown = cv2.resize(change, (shape[1] * factor, shape[0] * factor), interpolation=cv2.INTER_LINEAR)
    out[: grown.shape[0], : grown.shape[1]] += grown
    return out


def _picture(grey: NDArray[np.uint8], level: int) -> NDArray[np.float32]:
    """Photo with its gradients by column and row, blurred to the cell of the level; shape (height, width, 3)."""
    soft = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.7 * 2**level)
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    by_column = cv2.filter2D(soft, cv2.CV_32F, kernel)
    by_row = cv2.filter2D(soft, cv2.CV_32F, kernel.T)
    return np.ascontiguousarray(np.dstack([soft, by_column, by_row]))


def _project(
    pictures: dict[int, NDArray[np.float32]],
    block: ImageBlock,
    axes: list[FloatArray],
    height: FloatArray,
    window: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], BoolArray, FloatArray]:
    """
    Patterns of all views on the ground.

    Returns
    -------
    patterns, slopes : array, shape (n_views, n_rows, n_cols)
        Normalised to mean 0 and variance 1 in the window, and their derivative by height.
    seen : array of bool, same shape
    rise : array, shape (n_rows, n_cols), pixels / m
        Root mean square, over the views, of how far a cell's parallax departs from the mean.
    """
    patterns, slopes, seen, rises = [], [], [], []
    for view, picture in pictures.items():
        width, rows = block.size_of(view)
        place, rise = cell_maps(
            axes[0], axes[1], height, block.rotation[view], block.position[view], block.lens_of(view), width, rows, 0.5
        )
        sampled = cv2.remap(picture, place[0], place[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        grey = sampled[..., 0]
        here = cv2.erode((place[0] > -1e5).astype(np.uint8), np.ones((window, window), np.uint8)) > 0
        mean = cv2.blur(grey, (window, window))
        spread = np.sqrt(np.maximum(cv2.blur(grey * grey, (window, window)) - mean * mean, 1.0))
        slope = sampled[..., 1] * rise[0] + sampled[..., 2] * rise[1]
        patterns.append(np.where(here, (grey - mean) / spread, 0.0))
        slopes.append(np.where(here, (slope - cv2.blur(slope, (window, window))) / spread, 0.0))
        seen.append(here)
        rises.append(_ground_rise(rise, block, view))
    is_seen = np.array(seen)
    moves = np.where(is_seen[:, None], np.array(rises), 0.0)
    count = np.maximum(is_seen.sum(axis=0), 1)
    centred = np.where(is_seen[:, None], moves - moves.sum(axis=0) / count, 0.0)
    parallax = np.sqrt(np.maximum((centred**2).sum(axis=(0, 1)) / count, 1e-12))
    return np.array(patterns, np.float32), np.array(slopes, np.float32), is_seen, parallax


def _ground_rise(rise: NDArray[np.float32], block: ImageBlock, view: int) -> NDArray[np.float32]:
    """Parallax turned from the photo's columns and rows to east and north, so that views can be compared."""
    turn = block.rotation[view][:2, :2].astype(np.float32)
    return np.asarray(np.tensordot(turn, rise, axes=1), dtype=np.float32)


def _normal(
    patterns: NDArray[np.float32], slopes: NDArray[np.float32], seen: BoolArray, window: int
) -> tuple[FloatArray, FloatArray]:
    """
    Gradient and curvature, by height, of the squares of all views about their mean, summed over the window.

    Notes
    -----
    With patterns P_k and slopes D_k of K views: sum_k (P_k + D_k dh - mean)^2 has the gradient
    sum D P - sum D sum P / K and the curvature sum D^2 - (sum D)^2 / K.
    """
    count = np.maximum(seen.sum(axis=0), 1).astype(np.float32)
    total_p, total_d = patterns.sum(axis=0), slopes.sum(axis=0)
    gradient = (patterns * slopes).sum(axis=0) - total_p * total_d / count
    curvature = (slopes * slopes).sum(axis=0) - total_d * total_d / count
    area = float(window * window)
    box = (window, window)
    return (
        np.asarray(cv2.blur(gradient, box) * area, dtype=np.float64),
        np.asarray(cv2.blur(curvature, box) * area + 1e-6, dtype=np.float64),
    )


def _finish(
    greys: dict[int, NDArray[np.uint8]],
    block: ImageBlock,
    axes: list[FloatArray],
    height: FloatArray,
    inner: tuple[slice, slice],
    tree: cKDTree,
    pixel_std: float,
    settings: DenseSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Last step with the views that agree, and what is known of each cell."""
    window = settings.window
    pictures = {view: _picture(grey, 0) for view, grey in greys.items()}
    patterns, slopes, seen, _ = _project(pictures, block, axes, height, window)
    agree = seen & (_agreement(patterns, seen, window) >= settings.min_correlation)
    patterns, slopes = np.where(agree, patterns, 0.0), np.where(agree, slopes, 0.0)
    gradient, curvature = _normal(patterns, slopes, agree, window)
    count = agree.sum(axis=0)
    rise = _parallax(block, list(pictures), axes, height, agree)
    with np.errstate(invalid="ignore", divide="ignore"):
        step = -gradient / curvature
        mean = patterns.sum(axis=0) / np.maximum(count, 1)
        square = np.where(agree, (patterns - mean) ** 2, 0.0).sum(axis=0).astype(np.float32)
        noise = cv2.blur(square, (window, window)) / np.maximum(count - 1, 1)
        sigma = np.sqrt(pixel_std**2 / (count * rise**2) + noise / curvature)
        fine = (count >= settings.min_views) & np.isfinite(step) & (np.abs(step) * rise < 0.5) & np.isfinite(sigma)
    grid_east, grid_north = np.meshgrid(*axes)
    chosen = np.zeros(height.shape, dtype=bool)
    chosen[inner] = fine[inner]
    points = np.column_stack([grid_east[chosen], grid_north[chosen], (height + step)[chosen]])
    if len(points):
        near = tree.query(points[:, :2])[0] <= settings.max_gap
        return points[near], sigma[chosen][near], count[chosen][near].astype(np.int64)
    return points, sigma[chosen], count[chosen].astype(np.int64)


def _agreement(patterns: NDArray[np.float32], seen: BoolArray, window: int) -> NDArray[np.float32]:
    """Correlation of every view with the mean of the others in the window."""
    total, count = patterns.sum(axis=0), seen.sum(axis=0)
    out = np.zeros_like(patterns)
    for k in range(len(patterns)):
        others = (total - patterns[k]) / np.maximum(count - 1, 1)
        size = np.sqrt(np.maximum(cv2.blur(others * others, (window, window)), 1e-6))
        own = np.sqrt(np.maximum(cv2.blur(patterns[k] ** 2, (window, window)), 1e-6))
        out[k] = cv2.blur((patterns[k] * others).astype(np.float32), (window, window)) / (size * own)
    return out


def _parallax(
    block: ImageBlock, views: list[int], axes: list[FloatArray], height: FloatArray, agree: BoolArray
) -> FloatArray:
    """Root mean square parallax per metre of height of the views that agree, about their mean, pixels / m."""
    count = np.maximum(agree.sum(axis=0), 1)
    first, second = np.zeros((2, *height.shape)), np.zeros(height.shape)
    for k, view in enumerate(views):
        width, rows = block.size_of(view)
        _, rise = cell_maps(
            axes[0], axes[1], height, block.rotation[view], block.position[view], block.lens_of(view), width, rows, 0.5
        )
        turned = np.where(agree[k], _ground_rise(rise, block, view), 0.0)
        first += turned
        second += (turned**2).sum(axis=0)
    variance = second / count - ((first / count) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(variance, 1e-12)))
