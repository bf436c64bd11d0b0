"""A small rendered flight with known truth: textured hills, two strips and a crossing one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from changedetect.navigation.camera import CameraIntrinsics
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses

CAMERA = CameraIntrinsics(320, 240, 520.0, 520.0, 161.3, 117.8, -0.08, 0.02, 0.0002, -0.0003)
ORIGIN = LocalFrame(48.0, 9.0, 300.0)
HEIGHT = 60.0
_HALF, _STEP = 60.0, 0.06  # m: ground covered, texture cell


def hills(east, north):
    """Height of the ground, m."""
    return 1.5 * np.sin(east / 9.0) * np.cos(north / 7.0) + 0.02 * east


def mound(east, north, at=(4.0, 2.0), radius=4.0, height=0.8):
    """A smooth mound, m."""
    r2 = ((east - at[0]) ** 2 + (north - at[1]) ** 2) / radius**2
    return height * np.where(r2 < 1, (1 - r2) ** 2, 0.0)


def raised_hills(east, north):
    """The same ground with the mound on it, m."""
    return hills(east, north) + mound(east, north)


def texture(seed=0):
    """Ground texture with structure from decimetres to metres, uint8 range."""
    n = int(2 * _HALF / _STEP)
    rng = np.random.default_rng(seed)
    fine = gaussian_filter(rng.standard_normal((n, n)).astype(np.float32), 2.5)
    coarse = cv2.resize(gaussian_filter(rng.standard_normal((n // 8, n // 8)).astype(np.float32), 1.5), (n, n))
    return np.clip(128 + 40 * fine / fine.std() + 25 * coarse / coarse.std(), 0, 255).astype(np.float32)


def nadir(yaw):
    """Camera axes to ENU of a camera that looks down, the top of the photo towards `yaw` (degrees from north)."""
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return Rotation.from_euler("z", -yaw, degrees=True).as_matrix() @ down


@dataclass(frozen=True)
class Flown:
    """Photos and the poses they were taken from."""

    photos: tuple[np.ndarray, ...]
    truth: CameraPoses

    def __call__(self, image):
        return self.photos[image]


def layout(n_photos=5, baseline=6.0):
    """Two strips east and west, one across: positions (n, 3), yaws and times."""
    along = (np.arange(n_photos) - (n_photos - 1) / 2) * baseline
    strips = [
        (np.column_stack([along, np.full(n_photos, -6.0)]), 90.0),
        (np.column_stack([-along, np.full(n_photos, 6.0)]), 270.0),
        (np.column_stack([np.zeros(n_photos), along]), 0.0),
    ]
    position = np.concatenate([np.column_stack([xy, np.full(n_photos, HEIGHT)]) for xy, _ in strips])
    yaw = np.repeat([y for _, y in strips], n_photos)
    time = np.concatenate([k * 30.0 + np.arange(n_photos) * 0.5 for k in range(3)])
    return position, yaw, time


def poses_at(position, rotation, time, covariance, prefix="p"):
    names = tuple(f"{prefix}{k:03d}.png" for k in range(len(time)))
    return CameraPoses(names, time, position, rotation, covariance, ORIGIN)


def fly(seed=0, ground=hills, ground_texture=None, n_photos=5, prefix="p"):
    """Render a flight; attitudes wander by a degree."""
    rng = np.random.default_rng(seed)
    position, yaw, time = layout(n_photos)
    position = position + rng.normal(0, 0.4, position.shape)
    wander = Rotation.from_rotvec(rng.normal(0, np.radians(1.0), (len(yaw), 3))).as_matrix()
    rotation = wander @ np.stack([nadir(y) for y in yaw])
    painted = texture() if ground_texture is None else ground_texture
    photos = tuple(_render(p, r, ground, painted, rng) for p, r in zip(position, rotation, strict=True))
    covariance = np.tile(np.diag([1e-4] * 3 + [1e-8] * 3), (len(time), 1, 1))
    return Flown(photos, poses_at(position, rotation, time, covariance, prefix))


def perturbed(truth, seed, position_std=0.3, attitude_std_deg=0.15):
    """Poses with errors that are nearly equal along a strip, as a smoother leaves them, and their covariance."""
    rng = np.random.default_rng(seed)
    std = np.array([position_std] * 3 + [np.radians(attitude_std_deg)] * 3)
    error = np.empty((len(truth), 6))
    error[0] = std * rng.standard_normal(6)
    cross = []
    for k in range(1, len(truth)):
        alike = np.exp(-(truth.time[k] - truth.time[k - 1]) / 60.0)
        error[k] = alike * error[k - 1] + std * np.sqrt(1 - alike**2) * rng.standard_normal(6)
        cross.append(np.diag(alike * std**2))
    rotation = Rotation.from_rotvec(-error[:, 3:]).as_matrix() @ truth.rotation
    covariance = np.tile(np.diag(std**2), (len(truth), 1, 1))
    return CameraPoses(
        truth.names, truth.time, truth.position - error[:, :3], rotation, covariance, ORIGIN, np.array(cross)
    )


def _render(position, rotation, ground, painted, rng):
    direction = _directions() @ rotation.T
    height = np.zeros(len(direction))
    for _ in range(5):
        reach = (height - position[2]) / direction[:, 2]
        east, north = position[0] + reach * direction[:, 0], position[1] + reach * direction[:, 1]
        height = ground(east, north)
    at = np.array([(north + _HALF) / _STEP, (east + _HALF) / _STEP])
    grey = map_coordinates(painted, at, order=1, mode="reflect") + rng.normal(0, 3.0, len(direction))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(CAMERA.height, CAMERA.width)


@lru_cache
def _directions():
    """Viewing directions of all pixels in camera axes, by fixed-point iteration on the lens equations."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width, dtype=float), np.arange(CAMERA.height, dtype=float))
    u, v = (columns.ravel() - CAMERA.cx) / CAMERA.fx, (rows.ravel() - CAMERA.cy) / CAMERA.fy
    x, y = u.copy(), v.copy()
    for _ in range(20):
        r2 = x * x + y * y
        radial = 1 + CAMERA.k1 * r2 + CAMERA.k2 * r2 * r2
        x, y = (
            (u - 2 * CAMERA.p1 * x * y - CAMERA.p2 * (r2 + 2 * x * x)) / radial,
            (v - CAMERA.p1 * (r2 + 2 * y * y) - 2 * CAMERA.p2 * x * y) / radial,
        )
    return np.column_stack([x, y, np.ones(x.size)])
