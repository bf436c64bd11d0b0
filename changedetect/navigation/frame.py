"""
The local frame of a flight and the Earth below it.

Navigation runs in one Cartesian frame per site: east, north, up (ENU), metres, tangent to the WGS 84 ellipsoid at an
origin. It is not a map projection: its axes are straight lines in space, so distances and angles are true and up
departs from the local vertical by 0.009 degrees per kilometre from the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from changedetect.typing import FloatArray

__all__ = ["EarthModel", "LocalFrame"]

#: WGS 84 [1]_: semi-major axis (m), flattening, rotation rate (rad/s).
_A = 6378137.0
_F = 1.0 / 298.257223563
_E2 = _F * (2.0 - _F)
_ROTATION_RATE = 7.292115e-5
#: Normal gravity at the equator (m/s2) and Somigliana's constant [1]_, eq. 4-1.
_GRAVITY_EQUATOR = 9.7803253359
_SOMIGLIANA = 0.00193185265241


@dataclass(frozen=True)
class LocalFrame:
    """
    East, north, up in metres, tangent to the WGS 84 ellipsoid at an origin.

    Parameters
    ----------
    latitude, longitude : float, degrees
        Geodetic, WGS 84 (EPSG:4979).
    height : float, m
        Above the WGS 84 ellipsoid, not above sea level.

    Raises
    ------
    ValueError
        Latitude outside +-90 degrees, longitude outside +-360 degrees, or anything not finite.

    References
    ----------
    .. [1] National Imagery and Mapping Agency (2000), Department of Defense World Geodetic System 1984, TR8350.2.
    .. [2] Bowring (1976), Transformation from spatial to geographical coordinates, Survey Review 23.

    Examples
    --------
    >>> frame = LocalFrame(-33.89, 151.19, 40.0)
    >>> (frame.to_enu(-33.89, 151.19, 140.0).round(6) + 0.0).tolist()
    [0.0, 0.0, 100.0]
    """

    latitude: float
    longitude: float
    height: float

    def __post_init__(self) -> None:
        values = (self.latitude, self.longitude, self.height)
        if not all(math.isfinite(v) for v in values) or abs(self.latitude) > 90 or abs(self.longitude) > 360:
            msg = (
                f"The origin ({self.latitude}, {self.longitude}, {self.height}) is not a latitude (-90 to 90 degrees), "
                "a longitude (-360 to 360 degrees) and an ellipsoidal height (m)."
            )
            raise ValueError(msg)

    @property
    def rotation_from_ecef(self) -> FloatArray:
        """Rotation from Earth-centred, Earth-fixed (EPSG:4978) axes to ENU, shape (3, 3)."""
        sin_lat, cos_lat = math.sin(math.radians(self.latitude)), math.cos(math.radians(self.latitude))
        sin_lon, cos_lon = math.sin(math.radians(self.longitude)), math.cos(math.radians(self.longitude))
        return np.array(
            [
                [-sin_lon, cos_lon, 0.0],
                [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
                [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
            ]
        )

    def to_enu(
        self, latitude: float | FloatArray, longitude: float | FloatArray, height: float | FloatArray
    ) -> FloatArray:
        """
        Geodetic WGS 84 coordinates to this frame.

        Parameters
        ----------
        latitude, longitude : float or array, shape (...), degrees
        height : float or array, shape (...), m above the ellipsoid

        Returns
        -------
        position : array, shape (..., 3), ENU, m
        """
        offset = _ecef(latitude, longitude, height) - _ecef(self.latitude, self.longitude, self.height)
        return np.asarray(offset @ self.rotation_from_ecef.T, dtype=np.float64)

    def to_geodetic(self, position: FloatArray) -> FloatArray:
        """
        Positions of this frame to latitude, longitude (degrees) and ellipsoidal height (m).

        Parameters
        ----------
        position : array, shape (..., 3), ENU, m

        Returns
        -------
        geodetic : array, shape (..., 3)
        """
        origin = _ecef(self.latitude, self.longitude, self.height)
        return _geodetic(np.asarray(position, dtype=np.float64) @ self.rotation_from_ecef + origin)


@dataclass(frozen=True)
class EarthModel:
    """
    What the Earth does to an inertial sensor near the origin of a local frame.

    Parameters
    ----------
    gravity : float, m/s2
        Magnitude at the origin, positive.
    rotation : tuple of 3 floats, rad/s
        Earth rotation in ENU; zeros where the inertial data hold none (simulations).
    gradient : float, 1/s2
        Gravity over Earth radius: the plumb line leans by -gradient * (east, north) and gravity weakens by
        2 * gradient * up. Zero is a flat Earth.
    """

    gravity: float
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gradient: float = 0.0

    @classmethod
    def at(cls, frame: LocalFrame, gravity: float | None = None) -> EarthModel:
        """
        Give the rotating WGS 84 Earth at the origin of a frame.

        Parameters
        ----------
        frame : LocalFrame
        gravity : float, optional, m/s2
            Measured magnitude at the origin; by default Somigliana's normal gravity with its free-air gradient.
        """
        latitude = math.radians(frame.latitude)
        s2 = math.sin(latitude) ** 2
        if gravity is None:
            normal = _GRAVITY_EQUATOR * (1.0 + _SOMIGLIANA * s2) / math.sqrt(1.0 - _E2 * s2)
            gravity = normal * (1.0 - 2.0 * frame.height / _A)
        rotation = (0.0, _ROTATION_RATE * math.cos(latitude), _ROTATION_RATE * math.sin(latitude))
        return cls(gravity, rotation, gravity / (_A + frame.height))


def _ecef(latitude: float | FloatArray, longitude: float | FloatArray, height: float | FloatArray) -> FloatArray:
    """Geodetic (degrees, m) to Earth-centred, Earth-fixed, shape (..., 3), m."""
    lat, lon = np.radians(latitude), np.radians(longitude)
    normal = _A / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (normal + height) * np.cos(lat) * np.cos(lon),
            (normal + height) * np.cos(lat) * np.sin(lon),
            (normal * (1.0 - _E2) + height) * np.sin(lat),
        ],
        axis=-1,
    )


def _geodetic(ecef: FloatArray) -> FloatArray:
    """Earth-centred, Earth-fixed to geodetic by Bowring's formula, below 1e-9 degrees within 100 km of the ground."""
    x, y, z = ecef[..., 0], ecef[..., 1], ecef[..., 2]
    p = np.hypot(x, y)
    b = _A * (1.0 - _F)
    theta = np.arctan2(z * _A, p * b)
    lat = np.arctan2(z + _E2 / (1.0 - _E2) * b * np.sin(theta) ** 3, p - _E2 * _A * np.cos(theta) ** 3)
    normal = _A / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    # Projected on the normal: well conditioned at the poles too, where p / cos(lat) is not.
    height = p * np.cos(lat) + z * np.sin(lat) - normal * (1.0 - _E2 * np.sin(lat) ** 2)
    return np.stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), height], axis=-1)
