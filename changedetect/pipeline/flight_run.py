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
from changedetect.io.photo_checks import check_copies
from changedetect.io.photo_folder import is_photo_folder
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.navigation.flight import Flight
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.photos import camera_poses
from changedetect.navigation.poses import CameraPoses
from changedetect.navigation.solution import NavigationSolution, navigate
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.block import ImageBlock, Observations
from changedetect.photogrammetry.calibration import observable_parameters
from changedetect.photogrammetry.control import ControlPoint, ControlResult, apply_control, marked_observations
from changedetect.photogrammetry.lens import intrinsics_array
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
from changedetect.photogrammetry.rough import RoughOrientation, RoughSettings, neighbouring_pairs, orient_roughly
from changedetect.photogrammetry.ties import Features, TieSettings, detect_features
from changedetect.pipeline.flight_store import FlightStore, key_of
from changedetect.storage import sha256_of_file
from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["METHODS", "FlightRun", "FlightSource", "read_flight_source"]

#: How points are made: everything adjusted; smoothed poses as they are; the filter's poses and two views, as the paper;
#: poses from another program as they are.
METHODS = ("adjusted", "smoothed", "paper", "given")
#: Causal poses carry no correlation between photos: their errors change at every fix, s.
_CAUSAL_CORRELATION_TIME = 4.0
#: Of a mark set by hand, pixels.
_MARK_STD = 0.5
#: Lens parameters are adjusted that the photos know at least five times better than EXIF.
_MAX_SHARE = 0.2
#: Of a lens known from EXIF, adjusted where the photos determine them.
_PHOTO_LENS = ("focal", "cx", "cy", "k1", "k2")
#: How well features are predicted after a rough orientation, pixels.
_ROUGH_PIXELS = 3.0


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
    lens_std : tuple of 9 float, optional
        How well the lens is known, as `AdjustmentSettings.lens_std`; it is then always estimated. None: it is exact.
    has_heading : array, shape (n,), bool, optional
        Given for poses too rough to predict features from: which of them state a heading.
    is_known : bool
        Poses come from an adjustment made elsewhere.
    reduction : int
        Pixels of the photo files, across and down, that make one of `camera`.
    camera_file : str
        Where the lens comes from, for messages.
    other_lenses : tuple of CameraIntrinsics
        Lenses of poses made elsewhere, beyond `camera`; all of one size.
    lens : array, shape (n,), int64, optional
        Lens of each photo; 0 is `camera`.
    """

    label: str
    poses: CameraPoses
    camera: CameraIntrinsics
    paths: tuple[Path, ...]
    correlation_time: float
    navigation: dict[str, Any]
    lens_std: tuple[float, ...] | None = None
    has_heading: BoolArray | None = None
    is_known: bool = False
    reduction: int = 1
    camera_file: str = "camera.yaml"
    other_lenses: tuple[CameraIntrinsics, ...] = ()
    lens: IntArray | None = None


def read_flight_source(
    directory: Path, *, is_causal: bool = False, camera_file: Path | None = None, camera_clock: float = 0.0
) -> FlightSource:
    """
    Read a flight folder and navigate it.

    Parameters
    ----------
    directory : path
        See `changedetect.io.flight`; a folder without logs is one of photos, see `changedetect.pipeline.photo_source`.
    is_causal : bool
        Take the filter's poses instead of the smoother's.
    camera_file : path, optional
    camera_clock : float, s
        Added to the times of the photos.

    Raises
    ------
    MissingInputError, InputDataError
        A file is missing or cannot be used.
    """
    if is_photo_folder(directory):
        from changedetect.pipeline.photo_source import read_photo_source

        return read_photo_source(directory, camera_file=camera_file)
    flight = read_flight(directory, camera_file=camera_file)
    photos, camera = flight.photos, flight.camera
    if photos is None or camera is None:
        what = "images.csv, the list of photos" if photos is None else "camera.yaml, the lens"
        msg = f"{directory} has no {what}; without it there is nothing to triangulate. Put it into the folder."
        raise InputDataError(msg)
    if len(photos) < 3:
        msg = f"{directory} has {len(photos)} photos; at least 3 that overlap are needed."
        raise InputDataError(msg)
    if camera_clock:
        photos = replace(photos, time=photos.time + camera_clock)
        flight = replace(flight, photos=photos)
    solution = navigate(flight)
    photos = solution.photos or photos  # with the camera's clock corrected
    return FlightSource(
        label=flight.label,
        poses=camera_poses(replace(flight, photos=photos), solution, causal=is_causal),
        camera=camera,
        paths=photos.paths,
        correlation_time=_CAUSAL_CORRELATION_TIME,
        navigation=_describe(flight, solution) | {"camera_clock_s": camera_clock + _clock(solution)},
    )


def _clock(solution: NavigationSolution) -> float:
    """What the photos' own positions added to their times, s."""
    return 0.0 if solution.camera_clock is None else solution.camera_clock.seconds


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

    def __post_init__(self) -> None:
        if self.source.has_heading is not None or self.source.is_known:
            object.__setattr__(self, "settings", _photo_settings(self.settings, self.source))

    @cached_property
    def photos(self) -> PhotoFiles:
        """Photos, checked against the camera file and each other."""
        check_copies(self.source.paths)
        source, factor = self.source, self.source.reduction
        size = source.camera.width * factor, source.camera.height * factor
        return PhotoFiles(source.paths, size, source.camera_file, factor)

    @cached_property
    def stated(self) -> ImageBlock:
        """Photos with the poses of navigation, or with those they state."""
        source = self.source
        block = ImageBlock.from_poses(source.poses, source.camera)
        if source.lens is not None:
            lenses = np.stack([intrinsics_array(lens) for lens in (source.camera, *source.other_lenses)])
            block = replace(block, intrinsics=lenses, size=np.repeat(block.size, len(lenses), axis=0), lens=source.lens)
        return block.moved_to(source.poses.origin, self.origin)

    @property
    def block(self) -> ImageBlock:
        """Poses that the priors refer to: those stated, with headings that the pictures contradict turned."""
        return self.stated if self.rough is None else self.rough.given

    @property
    def start(self) -> ImageBlock:
        """Poses that features are predicted with and adjustments begin with."""
        return self.stated if self.rough is None else self.rough.start

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
        return key_of(checksums, self.source.reduction, self.settings.ties.n_features, self.settings.ties.contrast)

    @cached_property
    def matching_key(self) -> str:
        """Key of everything the matching depends on."""
        block = self.start
        return key_of(
            self.photo_key, block.rotation, block.position, block.intrinsics, self.prediction_std,
            self.settings.tracks, self.settings.ties,
        )  # fmt: skip

    @cached_property
    def oriented_key(self) -> str:
        """Key of everything the adjustment depends on."""
        s = self.settings
        parts = (self.matching_key, self.information, s.extension, s.adjustment, s.min_views, self.control)
        return key_of(*parts) if self.rough is None else key_of(*parts, self.block.rotation)

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
    def rough(self) -> RoughOrientation | None:
        """Rough poses made good enough to predict features; None where they are so already."""
        has_heading = self.source.has_heading
        if has_heading is None:
            return None
        stated, adjustment = self.stated, self.settings.adjustment
        settings = RoughSettings()
        key = key_of(
            self.photo_key, stated.rotation, stated.position, stated.intrinsics, self.information, has_heading,
            adjustment, settings,
        )  # fmt: skip
        found = self.store.load_rough(key, stated)
        if found is None:
            count = _Counter(self.on_step, len(neighbouring_pairs(stated, settings.n_neighbours)), "photos compared")
            found = orient_roughly(
                self.features, stated, self.information, has_heading, adjustment, settings,
                workers=self.settings.workers, on_pair=count,
            )  # fmt: skip
            self.store.save_rough(key, found)
        return found

    @property
    def prediction_std(self) -> tuple[float, float]:
        """How well `start` is known, m and rad: as navigation says, or a few pixels once adjusted roughly."""
        if self.rough is None:
            return self.pose_std
        lens = self.start.intrinsics[0]
        above = float(np.median(self.start.position[:, 2])) - self.rough.ground_height
        return _ROUGH_PIXELS * above / float(lens[0]), 0.0

    @cached_property
    def matching(self) -> Matching:
        """Tracks and ties."""
        found = self.store.load_matching(self.matching_key)
        if found is None:
            found = match_flight(
                self.photos, self.features, self.start, self.prediction_std, self.settings, on_step=self.on_step
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
                start=None if self.rough is None else self.start,
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
        if self.source.lens_std is not None:
            return self  # all are free already, with what is known of the lens
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
        if method == "given":
            tracks = Observations.join([tracks, self.matching.ties])
        kept, _ = tracks.keep(np.ones(len(tracks), dtype=bool), min_views=self.settings.min_views)
        return triangulated(self.block, kept, self.information, heeds_poses=method == "smoothed")


def _photo_settings(settings: OrientationSettings, source: FlightSource) -> OrientationSettings:
    """Settings for photos without logs: a rough lens is adjusted, and features are sought in flat pictures too."""
    adjustment = settings.adjustment
    if source.lens_std is not None:
        adjustment = replace(adjustment, lens=_PHOTO_LENS, lens_std=source.lens_std, max_share=_MAX_SHARE)
    ties = TieSettings(n_features=6000, contrast=0.01) if settings.ties == TieSettings() else settings.ties
    return replace(settings, adjustment=adjustment, ties=ties)


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
