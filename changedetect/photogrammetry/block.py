"""Photos with poses and lenses, and the observations of ground points in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from changedetect.kernels.projection import project_many
from changedetect.photogrammetry.lens import intrinsics_array, rays

if TYPE_CHECKING:
    from changedetect.navigation.camera import CameraIntrinsics
    from changedetect.navigation.frame import LocalFrame
    from changedetect.navigation.poses import CameraPoses
    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["EPOCH_TIE", "MARK", "TIE", "TRACK", "GroundPlane", "ImageBlock", "Observations"]

#: Kinds of observations: tracked along a strip, matched between photos, matched between epochs, marked by hand.
TRACK, TIE, EPOCH_TIE, MARK = 0, 1, 2, 3


@dataclass(frozen=True)
class GroundPlane:
    """
    Plane that the ground lies near, for predictions: z = height + slope_east * east + slope_north * north.

    Attributes
    ----------
    height : float, m
    slope_east, slope_north : float
    spread : float, m
        Robust standard deviation of the ground about the plane.
    """

    height: float
    slope_east: float = 0.0
    slope_north: float = 0.0
    spread: float = 2.0

    def at(self, east: FloatArray, north: FloatArray) -> FloatArray:
        """Height of the plane, m."""
        return np.asarray(self.height + self.slope_east * east + self.slope_north * north, dtype=np.float64)

    def intersect(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """
        Points where rays meet the plane, shape (n, 3), m; NaN for rays that do not point down to it.

        Parameters
        ----------
        origin : array, shape (3,) or (n, 3), m
        direction : array, shape (n, 3)
        """
        normal = np.array([-self.slope_east, -self.slope_north, 1.0])
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.height - origin @ normal) / (direction @ normal)
        distance = np.where(distance > 0, distance, np.nan)
        return np.asarray(origin + distance[:, None] * direction, dtype=np.float64)


@dataclass(frozen=True)
class ImageBlock:
    """
    Photos that are oriented together; all coordinates in one local east-north-up frame.

    Attributes
    ----------
    names : tuple of str, length n
    rotation : array, shape (n, 3, 3)
        Camera axes (x right, y down, z forward) to ENU.
    position : array, shape (n, 3), m
    intrinsics : array, shape (n_lenses, 9), pixels
        fx, fy, cx, cy, k1, k2, p1, p2, k3.
    size : array, shape (n_lenses, 2), pixels
        Width and height.
    lens, flight : array, shape (n,), int64
        Lens and flight of each photo.
    """

    names: tuple[str, ...]
    rotation: FloatArray
    position: FloatArray
    intrinsics: FloatArray
    size: IntArray
    lens: IntArray
    flight: IntArray

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def from_poses(cls, poses: CameraPoses, camera: CameraIntrinsics) -> Self:
        """Block of one flight with one lens."""
        n = len(poses.names)
        return cls(
            names=poses.names,
            rotation=np.ascontiguousarray(poses.rotation, dtype=np.float64),
            position=np.ascontiguousarray(poses.position, dtype=np.float64),
            intrinsics=intrinsics_array(camera)[None],
            size=np.array([[camera.width, camera.height]], dtype=np.int64),
            lens=np.zeros(n, np.int64),
            flight=np.zeros(n, np.int64),
        )

    @classmethod
    def join(cls, blocks: Sequence[ImageBlock]) -> Self:
        """Block of several flights, each with its own lenses; all must be in one frame (see `moved_to`)."""
        lenses = np.cumsum([0] + [len(block.intrinsics) for block in blocks])
        flights = np.cumsum([0] + [int(block.flight.max()) + 1 for block in blocks])
        return cls(
            names=tuple(name for block in blocks for name in block.names),
            rotation=np.concatenate([block.rotation for block in blocks]),
            position=np.concatenate([block.position for block in blocks]),
            intrinsics=np.concatenate([block.intrinsics for block in blocks]),
            size=np.concatenate([block.size for block in blocks]),
            lens=np.concatenate([block.lens + k for block, k in zip(blocks, lenses, strict=False)]),
            flight=np.concatenate([block.flight + k for block, k in zip(blocks, flights, strict=False)]),
        )

    def moved_to(self, origin: LocalFrame, target: LocalFrame) -> Self:
        """
        Photos in another local frame.

        Parameters
        ----------
        origin : LocalFrame
            Frame the block is in.
        target : LocalFrame
        """
        if origin == target:
            return self
        turn = target.rotation_from_ecef @ origin.rotation_from_ecef.T
        geodetic = origin.to_geodetic(self.position)
        position = target.to_enu(geodetic[:, 0], geodetic[:, 1], geodetic[:, 2])
        return replace(self, position=position, rotation=np.einsum("ij,njk->nik", turn, self.rotation))

    def select(self, image: IntArray) -> Self:
        """Photos at these positions."""
        return replace(
            self,
            names=tuple(self.names[i] for i in image),
            rotation=self.rotation[image],
            position=self.position[image],
            lens=self.lens[image],
            flight=self.flight[image],
        )

    def lens_of(self, image: int) -> FloatArray:
        """Intrinsics of a photo, shape (9,)."""
        return np.asarray(self.intrinsics[self.lens[image]])

    def size_of(self, image: int) -> tuple[int, int]:
        """Width and height of a photo, pixels."""
        width, height = self.size[self.lens[image]]
        return int(width), int(height)

    def rays(self, image: int, pixel: FloatArray) -> FloatArray:
        """Unit directions of pixels of one photo in ENU, shape (n, 3)."""
        return rays(pixel, self.rotation[image], self.lens_of(image))

    def project(self, points: FloatArray, image: int) -> FloatArray:
        """Column, row (pixels) and depth (m) of points in one photo, shape (n, 3)."""
        n = len(points)
        return np.asarray(
            project_many(
                np.ascontiguousarray(points),
                self.rotation,
                self.position,
                self.intrinsics,
                np.arange(n),
                np.full(n, image, np.int64),
                self.lens,
            )
        )

    def is_inside(self, projected: FloatArray, image: int, margin: float = 0.0) -> BoolArray:
        """Which of `project`'s results lie in the photo and in front of it, at least `margin` pixels from its rim."""
        width, height = self.size_of(image)
        column, row, depth = projected.T
        return np.asarray(
            (depth > 0)
            & (column >= margin)
            & (row >= margin)
            & (column <= width - 1 - margin)
            & (row <= height - 1 - margin)
        )

    def footprint(self, image: int, ground: GroundPlane) -> FloatArray:
        """Corners of a photo on the ground, shape (4, 3), m; NaN where a corner looks above the horizon."""
        width, height = self.size_of(image)
        corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
        return ground.intersect(self.position[image], self.rays(image, corners))

    def ground_sample_distance(self, ground: GroundPlane) -> float:
        """Median size of a pixel on the ground, m."""
        height = self.position[:, 2] - ground.at(self.position[:, 0], self.position[:, 1])
        return float(np.median(height / self.intrinsics[self.lens, 0]))


@dataclass(frozen=True)
class Observations:
    """
    Pixels of ground points, sorted by point.

    Attributes
    ----------
    start : array, shape (n_points + 1,), int64
        Observations of point p are ``start[p]`` to ``start[p + 1]``.
    image : array, shape (n,), int64
    pixel : array, shape (n, 2), pixels
        Column and row, distorted as measured.
    sigma : array, shape (n,), pixels
        Standard deviation of each coordinate.
    kind : array, shape (n,), int64
        How it was measured: `TRACK`, `TIE`, `EPOCH_TIE` or `MARK`.
    """

    start: IntArray
    image: IntArray
    pixel: FloatArray
    sigma: FloatArray
    kind: IntArray

    def __len__(self) -> int:
        return self.image.size

    @property
    def n_points(self) -> int:
        """Number of points."""
        return self.start.size - 1

    @property
    def point(self) -> IntArray:
        """Point of each observation, shape (n,)."""
        return np.repeat(np.arange(self.n_points), np.diff(self.start))

    @property
    def n_views(self) -> IntArray:
        """Number of observations of each point, shape (n_points,)."""
        return np.diff(self.start)

    @classmethod
    def gather(cls, point: IntArray, image: IntArray, pixel: FloatArray, sigma: FloatArray, kind: IntArray) -> Self:
        """
        Sort observations by point; points are numbered anew in the order of their labels.

        Parameters
        ----------
        point : array, shape (n,)
            Any labels.
        image, pixel, sigma, kind
            As the attributes.
        """
        order = np.lexsort((image, point))
        _, counts = np.unique(point, return_counts=True)
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        return cls(
            start,
            np.asarray(image, np.int64)[order],
            np.asarray(pixel, np.float64)[order],
            np.asarray(sigma, np.float64)[order],
            np.asarray(kind, np.int64)[order],
        )

    @classmethod
    def join(cls, parts: Sequence[Observations], image_offsets: Sequence[int] | None = None) -> Self:
        """Points of several sets, one set after the other; images are renumbered by the offsets."""
        offsets = image_offsets if image_offsets is not None else [0] * len(parts)
        shifts = np.cumsum([0] + [len(part) for part in parts])
        starts = [part.start[:-1] + shift for part, shift in zip(parts, shifts, strict=False)]
        return cls(
            np.concatenate([*starts, [shifts[-1]]]).astype(np.int64),
            np.concatenate([part.image + offset for part, offset in zip(parts, offsets, strict=True)]),
            np.concatenate([part.pixel for part in parts]),
            np.concatenate([part.sigma for part in parts]),
            np.concatenate([part.kind for part in parts]),
        )

    def keep(self, mask: BoolArray, *, min_views: int = 2) -> tuple[Self, IntArray]:
        """
        Observations that `mask` picks, without points left with fewer than `min_views`.

        Returns
        -------
        observations : Observations
        points : array of int
            Old number of each point that stays.
        """
        point = self.point
        counts = np.bincount(point[mask], minlength=self.n_points)
        stays = counts >= min_views
        mask = mask & stays[point]
        start = np.concatenate([[0], np.cumsum(counts[stays])]).astype(np.int64)
        kept = type(self)(start, self.image[mask], self.pixel[mask], self.sigma[mask], self.kind[mask])
        return kept, np.flatnonzero(stays)
