"""
Camera poses of one flight: the contract between navigation and photogrammetry.

Frames: positions and rotations are in the flight's local east-north-up frame (`LocalFrame`, metres). Camera axes are
OpenCV's: x right, y down, z forward along the optical axis, so that X_enu = rotation @ x_cam + position.

Errors of a pose are six numbers, [position error in ENU (m), small rotation vector in ENU (rad)]: the true position is
position + dp and the true rotation is exp([phi]x) @ rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from changedetect.errors import ModelStateError
from changedetect.navigation.frame import LocalFrame
from changedetect.storage import read_dataset, write_dataset

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import xarray as xr

    from changedetect.typing import FloatArray

__all__ = ["CameraPoses"]

_FORMAT = "changedetect camera poses 1"


@dataclass(frozen=True)
class CameraPoses:
    """
    Position and orientation of the camera at each photo, with covariance.

    Parameters
    ----------
    names : tuple of str, length n
        File names of the photos, in order of time.
    time : array, shape (n,), s
        Mid-exposure, in the time base of the flight's logs.
    position : array, shape (n, 3), ENU, m
        Camera centre.
    rotation : array, shape (n, 3, 3)
        From camera axes (x right, y down, z forward) to ENU.
    covariance : array, shape (n, 6, 6), m2, m rad, rad2
        Of each pose's error. An error shared by the whole flight is not in it: see `common_covariance`.
    origin : LocalFrame
        Origin of ENU: latitude and longitude (degrees), ellipsoidal height (m), WGS 84.
    cross_covariance : array, shape (n - 1, 6, 6), optional
        E[e_i e_(i+1)^T] of the errors of consecutive photos.
    common_covariance : array, shape (6, 6), optional
        Of the error all photos of the flight share (the slowly changing offset of the GPS). None: not known to exist.
    velocity : array, shape (n, 3), ENU, m/s, optional
        Of the camera centre: the derivative of position with respect to the time of exposure.
    angular_rate : array, shape (n, 3), ENU, rad/s, optional
        The derivative of the rotation vector with respect to the time of exposure.

    Raises
    ------
    ValueError
        Shapes do not agree.
    """

    names: tuple[str, ...]
    time: FloatArray
    position: FloatArray
    rotation: FloatArray
    covariance: FloatArray
    origin: LocalFrame
    cross_covariance: FloatArray | None = None
    common_covariance: FloatArray | None = None
    velocity: FloatArray | None = None
    angular_rate: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        expected = {
            "time": (n,),
            "position": (n, 3),
            "rotation": (n, 3, 3),
            "covariance": (n, 6, 6),
            "cross_covariance": (max(n - 1, 0), 6, 6),
            "common_covariance": (6, 6),
            "velocity": (n, 3),
            "angular_rate": (n, 3),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                msg = f"{name} of {n} camera poses has shape {np.shape(value)}; expected {shape}."
                raise ValueError(msg)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def total_covariance(self) -> FloatArray:
        """Covariance of each pose with the error shared by the flight included, shape (n, 6, 6)."""
        if self.common_covariance is None:
            return self.covariance
        return np.asarray(self.covariance + self.common_covariance, dtype=np.float64)

    @property
    def relative_covariance(self) -> FloatArray | None:
        """
        Covariance of e_(i+1) - e_i, the change of error between consecutive photos, shape (n - 1, 6, 6).

        It is far smaller than the covariance of either pose, and what relative orientation and tracks depend on. None
        where the cross-covariance is not known. A common error cancels.
        """
        if self.cross_covariance is None:
            return None
        cross = self.cross_covariance
        return np.asarray(self.covariance[:-1] + self.covariance[1:] - cross - cross.transpose(0, 2, 1))

    def select(self, names: Sequence[str]) -> CameraPoses:
        """
        Poses of the photos named, in the order of time.

        The cross-covariance is kept only where the selection drops no photo between two that stay.

        Raises
        ------
        ValueError
            A name is not among the poses.
        """
        unknown = sorted(set(names) - set(self.names))
        if unknown:
            msg = f"No pose for {', '.join(unknown[:5])}{' ...' if len(unknown) > 5 else ''}."
            raise ValueError(msg)
        wanted = set(names)
        index = np.array([i for i, name in enumerate(self.names) if name in wanted], dtype=np.int64)
        is_run = index.size > 0 and bool(np.all(np.diff(index) == 1))
        keep_cross = self.cross_covariance is not None and is_run
        return replace(
            self,
            names=tuple(self.names[i] for i in index),
            time=self.time[index],
            position=self.position[index],
            rotation=self.rotation[index],
            covariance=self.covariance[index],
            cross_covariance=self.cross_covariance[index[:-1]]
            if keep_cross and self.cross_covariance is not None
            else None,
            velocity=None if self.velocity is None else self.velocity[index],
            angular_rate=None if self.angular_rate is None else self.angular_rate[index],
        )

    def save(self, path: Path) -> None:
        """
        Write as NetCDF4, atomically.

        Raises
        ------
        OutputError
            The file cannot be written.
        """
        write_dataset(path, self._to_dataset())

    @classmethod
    def load(cls, path: Path) -> CameraPoses:
        """
        Read what `save` wrote; every number comes back with the same bits.

        Raises
        ------
        MissingInputError
            There is no such file.
        ModelStateError
            The file is damaged or holds something else.
        """
        dataset = read_dataset(path)
        if dataset.attrs.get("format") != _FORMAT:
            msg = (
                f"{path} does not hold camera poses of this version: its attribute 'format' is "
                f"{dataset.attrs.get('format')!r}, expected {_FORMAT!r}. Run the navigation step again."
            )
            raise ModelStateError(msg)

        def optional(name: str) -> FloatArray | None:
            return np.asarray(dataset[name].values, dtype=np.float64) if name in dataset else None

        try:
            return cls(
                names=tuple(str(name) for name in dataset["name"].values),
                time=np.asarray(dataset["time"].values, dtype=np.float64),
                position=np.asarray(dataset["position"].values, dtype=np.float64),
                rotation=np.asarray(dataset["rotation"].values, dtype=np.float64),
                covariance=np.asarray(dataset["covariance"].values, dtype=np.float64),
                origin=LocalFrame(*(float(v) for v in dataset.attrs["origin_latitude_longitude_height"])),
                cross_covariance=optional("cross_covariance"),
                common_covariance=optional("common_covariance"),
                velocity=optional("velocity"),
                angular_rate=optional("angular_rate"),
            )
        except (KeyError, ValueError, TypeError) as error:
            msg = f"{path} holds incomplete camera poses: {error}. Run the navigation step again."
            raise ModelStateError(msg) from error

    def _to_dataset(self) -> xr.Dataset:
        import xarray as xr

        variables = {
            "name": (("photo",), np.array(self.names, dtype=object), {"long_name": "file name of the photo"}),
            "time": (("photo",), self.time, {"units": "s", "long_name": "mid-exposure, time base of the flight"}),
            "position": (("photo", "axis"), self.position, {"units": "m", "long_name": "camera centre, ENU"}),
            "rotation": (("photo", "axis", "axis_camera"), self.rotation, {"long_name": "camera axes to ENU"}),
            "covariance": (("photo", "error", "error_of"), self.covariance, {"units": "m2, m rad, rad2"}),
            "cross_covariance": (("pair", "error", "error_of"), self.cross_covariance, {"units": "m2, m rad, rad2"}),
            "common_covariance": (("error", "error_of"), self.common_covariance, {"units": "m2, m rad, rad2"}),
            "velocity": (("photo", "axis"), self.velocity, {"units": "m s-1", "long_name": "of the camera, ENU"}),
            "angular_rate": (("photo", "axis"), self.angular_rate, {"units": "rad s-1", "long_name": "ENU"}),
        }
        attributes = {
            "format": _FORMAT,
            "origin_latitude_longitude_height": [self.origin.latitude, self.origin.longitude, self.origin.height],
            "frame": "east, north, up (m), tangent to WGS 84 at the origin (degrees, degrees, m above the ellipsoid)",
            "camera_axes": "x right, y down, z forward (OpenCV)",
            "error": "[position ENU m, rotation vector ENU rad]: true rotation = exp([phi]x) rotation",
        }
        present = {name: content for name, content in variables.items() if content[1] is not None}
        return xr.Dataset(present, attrs=attributes)
