"""
Flights with photos and known truth: a site flown over again and again, each time with logs of its own.

Logs come from `flight_path`. Photos are rendered by casting a ray through every pixel of a distorted lens onto the
height field, so that houses hide what lies behind them; a slow wave of a fraction of a pixel bends each photo as air
and rolling shutters do, and pixels are noisy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from changedetect.kernels.rendering import cast_rays, look
from changedetect.navigation.alignment import ENU_FROM_NED, attitude_covariance, attitude_from_angles
from changedetect.navigation.camera import CameraIntrinsics, CameraMount
from changedetect.navigation.flight import ImuNoise, InitialState
from changedetect.navigation.frame import LocalFrame
from changedetect.synthetic.flight_path import FlightPlan, GpsErrors, SimulatedFlight, simulate_flight
from changedetect.synthetic.flight_scene import CELL, FlightScene, draw_scene, scene_nodes
from changedetect.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["FlightDesign", "FlownEpoch", "fly_programme"]

#: Horizontal field of view: that of 1024 pixels and a focal length of 2050.
_FIELD = 1024.0 / 2050.0
#: Beyond what the outermost photo sees on level ground, m: attitudes and relief.
_BORDER = 16.0
#: Longest side of a photo, pixels: the ground is drawn at the resolution of the photos, in memory.
_MAX_SIDE = 8000
_MOUNT = CameraMount(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([0.15, 0.02, 0.1]),
    np.array([-0.4, 0.0, -0.25]),
)
#: How well the first attitude is stated: roll, pitch, yaw in degrees; and the first velocity, m/s.
_ATTITUDE_STD_DEG = np.array([1.0, 1.0, 3.0])
_VELOCITY_STD = 0.5


@dataclass(frozen=True, kw_only=True)
class FlightDesign:
    """
    What is flown, and with what.

    Attributes
    ----------
    n_epochs, n_strips, n_photos : int
        Photos of each strip.
    size : (int, int), pixels
        Width (across the strip) and height of a photo.
    height, baseline, speed : float, m, m, m/s
        Above ground; distance of photos.
    side_overlap : float
        Share of a strip's width that the next one sees too.
    imu : ImuNoise
    gps : GpsErrors
    bend : float, pixels
        Standard deviation of the wave that bends each photo.
    pixel_noise : float
        Standard deviation, of 255.
    texture_change : float
        Share of the ground's detail that is new in each epoch.
    origin : LocalFrame

    Raises
    ------
    ValueError
        Too few photos or epochs, or photos too small or too large.
    """

    n_epochs: int = 2
    n_strips: int = 2
    n_photos: int = 6
    size: tuple[int, int] = (512, 384)
    height: float = 100.0
    baseline: float = 8.0
    speed: float = 30.0
    side_overlap: float = 0.5
    imu: ImuNoise = field(default_factory=ImuNoise)
    gps: GpsErrors = field(default_factory=lambda: GpsErrors(offset_std=1.0))
    bend: float = 0.15
    pixel_noise: float = 2.0
    texture_change: float = 0.15
    origin: LocalFrame = field(default_factory=lambda: LocalFrame(-33.89, 151.19, 40.0))

    def __post_init__(self) -> None:
        """Refuse what cannot be reconstructed."""
        if self.n_epochs < 1 or self.n_strips < 1 or self.n_photos < 4 or min(self.size) < 200:
            msg = (
                f"{self.n_epochs} epochs of {self.n_strips} strips of {self.n_photos} photos of {self.size[0]} x "
                f"{self.size[1]} pixels; at least 1, 1, 4 and 200 x 200 are needed."
            )
            raise ValueError(msg)
        if max(self.size) > _MAX_SIDE:
            msg = (
                f"Photos of {self.size[0]} x {self.size[1]} pixels; at most {_MAX_SIDE} x {_MAX_SIDE} are rendered. "
                "Choose a smaller size."
            )
            raise ValueError(msg)
        if not 0.0 <= self.side_overlap < 0.9:
            msg = f"side_overlap = {self.side_overlap}; expected a share from 0 to 0.9."
            raise ValueError(msg)

    @property
    def camera(self) -> CameraIntrinsics:
        """Lens with the distortion of a small survey camera."""
        width, height = self.size
        focal = width / _FIELD
        return CameraIntrinsics(
            width, height, focal, focal, (width - 1) / 2 + 3.1, (height - 1) / 2 - 2.3, -0.12, 0.05, 2e-4, -1e-4
        )

    @property
    def ground_pixel(self) -> float:
        """Size of a pixel on level ground, m."""
        return self.height / self.camera.fx

    @property
    def spacing(self) -> float:
        """Distance of strips, m."""
        return (1 - self.side_overlap) * self.size[0] * self.ground_pixel

    def plan(self, rng: np.random.Generator) -> FlightPlan:
        """Plan of one epoch: the course differs by some degrees from epoch to epoch."""
        interval = self.baseline / self.speed
        return FlightPlan(
            n_strips=self.n_strips,
            strip_length=(self.n_photos - 0.5) * self.baseline,
            strip_spacing=self.spacing,
            height=self.height,
            speed=self.speed,
            heading_deg=90.0 + float(rng.normal(0.0, 4.0)),
            wind=(float(rng.normal(0.0, 2.5)), float(rng.normal(0.0, 2.5))),
            photo_interval=interval,
        )

    def halves(self) -> tuple[float, float]:
        """Half the ground photographed on level ground, east and north, m."""
        width, height = (pixels * self.ground_pixel for pixels in self.size)
        along = (self.n_photos + 1) * self.baseline
        across = (self.n_strips - 1) * self.spacing
        return (along + height) / 2, (across + width) / 2


@dataclass(frozen=True)
class FlownEpoch:
    """
    One flight over the site.

    Attributes
    ----------
    number : int
        From 0.
    scene : FlightScene
    design : FlightDesign
    simulated : SimulatedFlight
        Logs and path.
    initial : InitialState
        What the operator states of the first moment, with its error.
    """

    number: int
    scene: FlightScene
    design: FlightDesign
    simulated: SimulatedFlight
    initial: InitialState

    @property
    def names(self) -> tuple[str, ...]:
        """Of the photos."""
        return tuple(f"e{self.number + 1}_{k:04d}.jpg" for k in range(len(self.time)))

    @property
    def time(self) -> FloatArray:
        """Of the photos, s."""
        photos = self.simulated.flight.photos
        return photos.time if photos is not None else np.empty(0)

    def true_poses(self) -> tuple[FloatArray, FloatArray]:
        """Camera centres, shape (n, 3), m, and rotations from camera axes to ENU, shape (n, 3, 3)."""
        return _true_poses(self.simulated)

    def stated_positions(self) -> FloatArray:
        """Where the camera's own receiver, as noisy as the other, says each photo was taken, ENU, m, shape (n, 3)."""
        rng = np.random.default_rng([self.scene.seed, 13, self.number])
        gps = self.design.gps
        noise = rng.normal(0.0, 1.0, (len(self.time), 3)) * [gps.horizontal_std, gps.horizontal_std, gps.vertical_std]
        return self.true_poses()[0] + self.simulated.gps_offset + noise

    def photos(self) -> Iterator[NDArray[np.uint8]]:
        """Render one photo after the other, shape (height, width)."""
        position, rotation = self.true_poses()
        surface = np.ascontiguousarray(self.scene.surface(self.number))
        seen = self.scene.brightness(self.number, texture_change=self.design.texture_change)
        blur = 0.45 * self.design.ground_pixel / self.scene.texture_cell  # of a pixel that gathers light over its area
        seen = np.ascontiguousarray(gaussian_filter(seen, blur))
        rng = np.random.default_rng([self.scene.seed, 11, self.number])
        for k in range(len(self.time)):
            yield self._render(position[k], rotation[k], surface, seen, rng)

    def _render(
        self,
        position: FloatArray,
        rotation: FloatArray,
        surface: FloatArray,
        seen: FloatArray,
        rng: np.random.Generator,
    ) -> NDArray[np.uint8]:
        camera, scene = self.design.camera, self.scene
        pixels = _pixels(camera) + self.design.bend * _waves(camera, rng)
        direction = undistorted(camera, pixels) @ rotation.T
        west, south = -scene.half_east, -scene.half_north
        place = cast_rays(
            np.ascontiguousarray(direction), position, surface, west, south, CELL, float(surface.max()) + 0.1
        )
        grey = look(place, seen, west, south, scene.texture_cell)
        grey += rng.normal(0.0, self.design.pixel_noise, grey.size)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(camera.height, camera.width)


def fly_programme(design: FlightDesign | None = None, *, seed: int = 0) -> tuple[FlownEpoch, ...]:
    """
    Draw a site and fly over it.

    Parameters
    ----------
    design : FlightDesign, optional
    seed : int
        Of site, changes, gusts, biases and noise.

    Returns
    -------
    epochs : tuple of FlownEpoch
        Photos are rendered when asked for.

    Raises
    ------
    ValueError
        The design leaves no room for the changes.
    """
    design = design or FlightDesign()
    rngs = [np.random.default_rng([seed, 3, number]) for number in range(design.n_epochs)]
    flown = [_fly(design, f"epoch{number + 1}", rng) for number, rng in enumerate(rngs)]
    half_east, half_north = (half + _BORDER for half in design.halves())
    nodes = scene_nodes(half_east, half_north, CELL)
    views = np.min([_views(design.camera, _true_poses(simulated), nodes) for simulated in flown], axis=0)
    scene = draw_scene(half_east, half_north, views, 0.5 * design.ground_pixel, seed=seed)
    return tuple(
        FlownEpoch(number, scene, design, simulated, _stated_start(simulated, rng))
        for number, (simulated, rng) in enumerate(zip(flown, rngs, strict=True))
    )


def _views(
    camera: CameraIntrinsics, poses: tuple[FloatArray, FloatArray], nodes: tuple[FloatArray, FloatArray]
) -> IntArray:
    """Photos of a flight that see each node of level ground."""
    count = np.zeros(nodes[0].shape, dtype=np.int64)
    for position, rotation in zip(*poses, strict=True):
        offset = np.stack([nodes[0] - position[0], nodes[1] - position[1], np.full_like(nodes[0], -position[2])])
        x, y, depth = np.tensordot(rotation.T, offset, axes=1)
        column, row = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        count += (column > 0) & (row > 0) & (column < camera.width - 1) & (row < camera.height - 1)
    return count


def _true_poses(simulated: SimulatedFlight) -> tuple[FloatArray, FloatArray]:
    photos, mount, path = simulated.flight.photos, simulated.flight.mount, simulated.path
    time = photos.time if photos is not None else np.empty(0)
    body = path.rotation(time)
    return path.position(time) + body @ mount.camera_body, body @ mount.rotation_body_camera


def _fly(design: FlightDesign, label: str, rng: np.random.Generator) -> SimulatedFlight:
    simulated = simulate_flight(
        design.plan(rng),
        design.imu,
        design.gps,
        seed=int(rng.integers(2**31)),
        origin=design.origin,
        mount=_MOUNT,
    )
    return replace(simulated, flight=replace(simulated.flight, camera=design.camera, label=label))


def _stated_start(simulated: SimulatedFlight, rng: np.random.Generator) -> InitialState:
    """Attitude and velocity at the first inertial sample as an operator would state them."""
    moment = simulated.flight.imu.time[:1]
    ned = ENU_FROM_NED.T @ simulated.path.rotation(moment)[0]
    yaw, pitch, roll = Rotation.from_matrix(ned).as_euler("ZYX", degrees=True)
    stated = np.array([roll, pitch, yaw]) + rng.normal(0.0, 1.0, 3) * _ATTITUDE_STD_DEG
    roll, pitch, yaw = (float(angle) for angle in stated)
    return InitialState(
        time=float(moment[0]),
        rotation=attitude_from_angles(roll, pitch, yaw),
        velocity=simulated.path.velocity(moment)[0] + rng.normal(0.0, _VELOCITY_STD, 3),
        rotation_covariance=attitude_covariance(roll, pitch, yaw, _ATTITUDE_STD_DEG),
        velocity_std=_VELOCITY_STD,
    )


def _pixels(camera: CameraIntrinsics) -> FloatArray:
    """Centres of all pixels, row by row, shape (n, 2)."""
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    return np.column_stack([columns.ravel(), rows.ravel()])


def _waves(camera: CameraIntrinsics, rng: np.random.Generator) -> FloatArray:
    """Smooth displacement of every pixel, of unit variance, six waves of a tenth to half of the photo, shape (n, 2)."""
    at = _pixels(camera)
    total = np.zeros_like(at)
    for _ in range(6):
        length = camera.width * rng.uniform(0.1, 0.5)
        direction, phase = rng.uniform(0, 2 * np.pi, 2)
        angle = 2 * np.pi / length * (at[:, 0] * np.cos(direction) + at[:, 1] * np.sin(direction)) + phase
        total += np.sin(angle)[:, None] * rng.normal(0.0, 1.0, 2)
    return total / math.sqrt(3.0)


def undistorted(camera: CameraIntrinsics, pixel: FloatArray) -> FloatArray:
    """
    Viewing directions of pixels in camera axes, z = 1, shape (n, 3).

    Parameters
    ----------
    camera : CameraIntrinsics
    pixel : array, shape (n, 2)

    Notes
    -----
    Fixed-point iteration on Brown's equations; converges for the mild lenses of survey cameras.
    """
    u, v = (pixel[:, 0] - camera.cx) / camera.fx, (pixel[:, 1] - camera.cy) / camera.fy
    x, y = u.copy(), v.copy()
    for _ in range(8):
        r2 = x * x + y * y
        radial = 1 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
        x, y = (
            (u - 2 * camera.p1 * x * y - camera.p2 * (r2 + 2 * x * x)) / radial,
            (v - camera.p1 * (r2 + 2 * y * y) - 2 * camera.p2 * x * y) / radial,
        )
    return np.column_stack([x, y, np.ones(x.size)])
