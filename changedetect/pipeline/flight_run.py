"""One flight folder on its way to points: read, navigated, matched, oriented, each step kept in a work folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from changedetect.errors import InputDataError
from changedetect.io.flight import read_flight
from changedetect.io.images import PhotoFiles
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.navigation.flight import Flight
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.photos import camera_poses
from changedetect.navigation.poses import CameraPoses
from changedetect.navigation.solution import NavigationSolution, navigate
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.calibration import observable_parameters
from changedetect.photogrammetry.control import ControlPoint, ControlResult, apply_control, marked_observations
from changedetect.photogrammetry.orientation import (
    Matching,
    OrientationSettings,
    Oriented,
    Step,
    match_flight,
    orient_flight,
)
from changedetect.photogrammetry.paper import triangulated, two_views
from changedetect.photogrammetry.priors import pose_information
from changedetect.photogrammetry.ties import Features, detect_features
from changedetect.pipeline.flight_store import FlightStore, key_of
from changedetect.storage import sha256_of_file
from changedetect.typing import FloatArray

__all__ = ["METHODS", "FlightRun", "FlightSource", "read_flight_source"]

#: How points are made: everything adjusted; smoothed poses as they are; the filter's poses and two views, as the paper.
METHODS = ("adjusted", "smoothed", "paper")
#: Causal poses carry no correlation between photos: their errors change at every fix, s.
_CAUSAL_CORRELATION_TIME = 4.0
#: Of a mark set by hand, pixels.
_MARK_STD = 0.5


@dataclass(frozen=True)
class FlightSource:
    """
    What a reconstruction needs of a flight.

    Attributes
    ----------
    label : str
    poses : CameraPoses
        With the covariance to be used as a prior.
    camera : CameraIntrinsics
    paths : tuple of path
        Photos, in the order of the poses.
    correlation_time : float, s
        Of poses without cross-covariance.
    navigation : dict
        For the report.
    """

    label: str
    poses: CameraPoses
    camera: CameraIntrinsics
    paths: tuple[Path, ...]
    correlation_time: float
    navigation: dict[str, Any]


def read_flight_source(directory: Path, *, is_causal: bool = False, camera_file: Path | None = None) -> FlightSource:
    """
    Read a flight folder and navigate it.

    Parameters
    ----------
    directory : path
        See `changedetect.io.flight`.
    is_causal : bool
        Take the filter's poses instead of the smoother's.
    camera_file : path, optional

    Raises
    ------
    MissingInputError, InputDataError
        A file is missing or cannot be used.
    """
    flight = read_flight(directory, camera_file=camera_file)
    photos, camera = flight.photos, flight.camera
    if photos is None or camera is None:
        what = "images.csv, the list of photos" if photos is None else "camera.yaml, the lens"
        msg = f"{directory} has no {what}; without it there is nothing to triangulate. Put it into the folder."
        raise InputDataError(msg)
    if len(photos) < 3:
        msg = f"{directory} has {len(photos)} photos; at least 3 that overlap are needed."
        raise InputDataError(msg)
    solution = navigate(flight)
    photos = solution.photos or photos  # with the camera's clock corrected
    return FlightSource(
        label=flight.label,
        poses=camera_poses(replace(flight, photos=photos), solution, causal=is_causal),
        camera=camera,
        paths=photos.paths,
        correlation_time=_CAUSAL_CORRELATION_TIME,
        navigation=_describe(flight, solution),
    )


def _describe(flight: Flight, solution: NavigationSolution) -> dict[str, Any]:
    return {
        "n_fixes": len(flight.gps),
        "n_fixes_refused": solution.n_refused,
        "innovation_squared_per_dof": solution.nis_per_dof,
        "gps_latency_s": solution.latency.seconds,
        "gps_offset_std_m": flight.gps.offset_std,
        "gyro_bias_rad_s": solution.smoothed.gyro_bias[-1].tolist(),
        "accel_bias_m_s2": solution.smoothed.accel_bias[-1].tolist(),
    }


@dataclass(frozen=True)
class FlightRun:
    """
    Steps of one flight.

    Attributes
    ----------
    source : FlightSource
    store : FlightStore
    settings : OrientationSettings
    origin : LocalFrame
        Frame in which all is computed; that of the first flight where there are several.
    on_step : callable, optional
    control : tuple of ControlPoint
        Surveyed points marked in the photos.
    """

    source: FlightSource
    store: FlightStore
    settings: OrientationSettings
    origin: LocalFrame
    on_step: Callable[[int, int, str], None] | None = None
    control: tuple[ControlPoint, ...] = ()

    @cached_property
    def photos(self) -> PhotoFiles:
        """Photos, checked against the camera file."""
        camera = self.source.camera
        return PhotoFiles(self.source.paths, (camera.width, camera.height), "camera.yaml")

    @cached_property
    def block(self) -> ImageBlock:
        """Photos with the poses of navigation."""
        return ImageBlock.from_poses(self.source.poses, self.source.camera).moved_to(
            self.source.poses.origin, self.origin
        )

    @cached_property
    def information(self) -> FloatArray:
        """Information matrix of the poses."""
        poses = self.source.poses
        information = pose_information(poses, correlation_time=self.source.correlation_time)
        if poses.origin == self.origin:
            return information
        turn = self.origin.rotation_from_ecef @ poses.origin.rotation_from_ecef.T
        whole = np.kron(np.eye(2 * len(poses)), turn)
        return np.asarray(whole @ information @ whole.T)

    @property
    def pose_std(self) -> tuple[float, float]:
        """Median standard deviation of positions (m) and attitudes (rad), without what the flight shares."""
        variance = np.diagonal(self.source.poses.covariance, axis1=1, axis2=2)
        return float(np.sqrt(np.median(variance[:, :3]))), float(np.sqrt(np.median(variance[:, 3:])))

    @property
    def offset_std(self) -> float:
        """Standard deviation of the flight's place as a whole, m."""
        total = np.diagonal(self.source.poses.total_covariance, axis1=1, axis2=2)
        return float(np.sqrt(np.median(total[:, :2])))

    @cached_property
    def photo_key(self) -> str:
        """Key of the photos' content and of how features are found."""
        checksums = [sha256_of_file(path) for path in self.source.paths]
        return key_of(checksums, self.settings.ties.n_features)

    @cached_property
    def matching_key(self) -> str:
        """Key of everything the matching depends on."""
        block = self.block
        return key_of(
            self.photo_key, block.rotation, block.position, block.intrinsics, self.pose_std,
            self.settings.tracks, self.settings.ties,
        )  # fmt: skip

    @cached_property
    def oriented_key(self) -> str:
        """Key of everything the adjustment depends on."""
        s = self.settings
        return key_of(self.matching_key, self.information, s.extension, s.adjustment, s.min_views, self.control)

    @cached_property
    def features(self) -> list[Features]:
        """Features of every photo."""
        found = self.store.load_features(self.photo_key)
        if found is None:
            count = _Counter(self.on_step, len(self.photos), "features")
            found = detect_features(
                self.photos, len(self.photos), self.settings.ties, workers=self.settings.workers, on_photo=count
            )
            self.store.save_features(self.photo_key, found)
        return found

    @cached_property
    def matching(self) -> Matching:
        """Tracks and ties."""
        found = self.store.load_matching(self.matching_key)
        if found is None:
            found = match_flight(
                self.photos, self.features, self.block, self.pose_std, self.settings, on_step=self.on_step
            )
            self.store.save_matching(self.matching_key, found)
        return found

    @cached_property
    def oriented(self) -> Oriented:
        """Adjusted flight."""
        found = self.store.load_oriented(self.oriented_key, self.block)
        if found is None:
            marks = marked_observations(self.control, self.block, _MARK_STD) if self.control else None
            found = orient_flight(
                self.photos,
                self.block,
                self.information,
                self.matching,
                self.settings,
                marks=marks,
                on_step=self.on_step,
            )
            self.store.save_oriented(self.oriented_key, found)
        return found

    @cached_property
    def controlled(self) -> tuple[Adjustment, ControlResult | None]:
        """Adjustment corrected by the control points, and how they agree."""
        oriented = self.oriented
        if not self.control:
            return oriented.adjustment, None
        first = oriented.observations.n_points - len(self.control)
        numbers = np.full(len(self.control), -1, np.int64)
        at = np.flatnonzero(oriented.adjustment.origin >= first)
        numbers[oriented.adjustment.origin[at] - first] = at
        return apply_control(oriented.adjustment, numbers, self.control)

    def calibrated(self) -> FlightRun:
        """Same flight with the lens parameters and mounting angles freed that its photos determine."""
        observations = self.oriented.observations
        found = observable_parameters(self.block, observations, self.information, start=self.oriented.adjustment.block)
        adjustment = replace(
            self.settings.adjustment, lens=found.lens, boresight_std=found.prior_boresight if found.boresight else 0.0
        )
        return replace(self, settings=replace(self.settings, adjustment=adjustment))

    def unadjusted(self, method: str) -> Adjustment:
        """Points of the poses as they are: all views of a track, or two as in the paper."""
        tracks = self.matching.tracks
        if method == "paper":
            return triangulated(self.block, two_views(tracks), self.information)
        kept, _ = tracks.keep(np.ones(len(tracks), dtype=bool), min_views=self.settings.min_views)
        return triangulated(self.block, kept, self.information)


class _Counter:
    """Callback that counts; photos finish in several threads."""

    def __init__(self, on_step: Step | None, total: int, label: str) -> None:
        self.on_step, self.total, self.label, self.done = on_step, total, label, 0

    def __call__(self) -> None:
        self.done += 1
        if self.on_step is not None:
            self.on_step(min(self.done, self.total), self.total, self.label)


def default_workers(asked: int) -> int:
    """Threads: those asked for, or one for each core."""
    return asked if asked > 0 else max(os.cpu_count() or 1, 1)
