"""Transforms of coordinates between the frame of an epoch and that of its reference, about a stored centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self, TypeAlias, get_args

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.typing import FloatArray, JSONObject

__all__ = ["KINDS", "PARAMETER_NAMES", "PARAMETER_UNITS", "Kind", "Transform"]

Kind: TypeAlias = Literal["vertical", "shift", "shift_tilt", "rigid", "similarity"]
#: From few to many parameters; each kind contains the one before, tilt and rotation being the same to first order.
KINDS: tuple[Kind, ...] = get_args(Kind)
PARAMETER_NAMES: dict[Kind, tuple[str, ...]] = {
    "vertical": ("up",),
    "shift": ("east", "north", "up"),
    "shift_tilt": ("east", "north", "up", "tilt_east", "tilt_north"),
    "rigid": ("east", "north", "up", "rotation_east", "rotation_north", "rotation_up"),
    "similarity": ("east", "north", "up", "rotation_east", "rotation_north", "rotation_up", "scale"),
}
PARAMETER_UNITS: dict[str, str] = {
    "east": "m",
    "north": "m",
    "up": "m",
    "tilt_east": "m/m",
    "tilt_north": "m/m",
    "rotation_east": "rad",
    "rotation_north": "rad",
    "rotation_up": "rad",
    "scale": "1",
}


@dataclass(frozen=True)
class Transform:
    """
    From the coordinates of an epoch to those of its reference.

    Attributes
    ----------
    kind : {"vertical", "shift", "shift_tilt", "rigid", "similarity"}
        A vertical shift; a shift in space; the same and a tilt that leaves horizontal positions alone; a rotation and
        a shift; the same and a scale.
    centre : (easting, northing, elevation), m
        In the frame of the epoch; rotation, tilt and scale act about it.
    parameters : tuple of float
        In the order of `PARAMETER_NAMES[kind]`. Shifts in m; tilts in m/m; rotations in radians, a rotation vector
        in the order east, north, up, right-handed; scale as the excess over one.

    Raises
    ------
    ValueError
        The kind is unknown, or has another number of parameters.

    Notes
    -----
    With c the centre, t the shift and p a position, "rigid" and "similarity" give p' = c + t + (1 + s) R (p - c).

    Examples
    --------
    >>> moved = Transform("shift", (500000.0, 5300000.0, 400.0), (0.03, -0.02, 0.41))
    >>> easting, northing, elevation = (np.array([v]) for v in (500010.0, 5300020.0, 401.0))
    >>> [round(float(v[0]), 3) for v in moved.apply(easting, northing, elevation)]
    [500010.03, 5300019.98, 401.41]
    """

    kind: Kind
    centre: tuple[float, float, float]
    parameters: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            msg = f"The kind of a transform is one of {', '.join(KINDS)}; got {self.kind!r}."
            raise ValueError(msg)
        if len(self.parameters) != len(self.names):
            msg = f"A transform of kind {self.kind!r} has {len(self.names)} parameters; got {len(self.parameters)}."
            raise ValueError(msg)

    @classmethod
    def identity(cls, kind: Kind, centre: tuple[float, float, float]) -> Self:
        """Return the transform of a kind that moves nothing."""
        return cls(kind, centre, (0.0,) * len(PARAMETER_NAMES[kind]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return PARAMETER_NAMES[self.kind]

    @property
    def shift(self) -> FloatArray:
        """(east, north, up), m: how the centre moves."""
        if self.kind == "vertical":
            return np.array([0.0, 0.0, self.parameters[0]])
        return np.array(self.parameters[:3])

    @property
    def scale(self) -> float:
        """Factor on distances."""
        return 1.0 + self.parameters[6] if self.kind == "similarity" else 1.0

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrix, shape (3, 3); the unit matrix where the kind has no rotation."""
        vector = self.parameters[3:6] if self.kind in ("rigid", "similarity") else (0.0, 0.0, 0.0)
        matrix: FloatArray = Rotation.from_rotvec(vector).as_matrix()
        return matrix

    @property
    def tilt(self) -> tuple[float, float]:
        """Rise towards east and north, m/m, of the kind that tilts without rotating."""
        return (self.parameters[3], self.parameters[4]) if self.kind == "shift_tilt" else (0.0, 0.0)

    def apply(
        self, easting: FloatArray, northing: FloatArray, elevation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Move positions of the epoch into the frame of the reference.

        Parameters
        ----------
        easting, northing, elevation : array, shape (n,), m

        Returns
        -------
        easting, northing, elevation : array, shape (n,), m
        """
        east, north, up = self.shift
        if self.kind in ("rigid", "similarity"):
            c = np.array(self.centre)
            offset = np.stack([easting - c[0], northing - c[1], elevation - c[2]])
            moved = self.scale * (self.rotation @ offset)
            return moved[0] + (c[0] + east), moved[1] + (c[1] + north), moved[2] + (c[2] + up)
        lifted = elevation + up
        if self.kind == "shift_tilt":
            lifted = lifted + self._tilt_at(easting, northing)
        return easting + east, northing + north, lifted

    def apply_inverse(
        self, easting: FloatArray, northing: FloatArray, elevation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Move positions of the reference back into the frame of the epoch; undoes `apply` to rounding."""
        east, north, up = self.shift
        if self.kind in ("rigid", "similarity"):
            c = np.array(self.centre)
            offset = np.stack([easting - (c[0] + east), northing - (c[1] + north), elevation - (c[2] + up)])
            moved = (self.rotation.T @ offset) / self.scale
            return moved[0] + c[0], moved[1] + c[1], moved[2] + c[2]
        easting, northing = easting - east, northing - north
        lowered = elevation - up
        if self.kind == "shift_tilt":
            lowered = lowered - self._tilt_at(easting, northing)
        return easting, northing, lowered

    def jacobian(
        self,
        easting: FloatArray,
        northing: FloatArray,
        elevation: FloatArray,
        slope_east: FloatArray,
        slope_north: FloatArray,
    ) -> FloatArray:
        """
        Derivative of elevation above the reference with respect to the parameters.

        Parameters
        ----------
        easting, northing, elevation : array, shape (n,), m
            Aligned positions, in the frame of the reference.
        slope_east, slope_north : array, shape (n,), m/m
            Of the reference there.

        Returns
        -------
        jacobian : array, shape (n, n_parameters)
            Of r = z' - f(x', y'): with n = (-slope east, -slope north, 1) a motion dp of the aligned position changes
            r by n . dp. Rotations are taken about the moved centre, on top of the present one.
        """
        one = np.ones_like(elevation)
        if self.kind == "vertical":
            return one[:, None]
        columns = [-slope_east, -slope_north, one]
        centre = np.array(self.centre) + self.shift
        u, v, w = easting - centre[0], northing - centre[1], elevation - centre[2]
        if self.kind == "shift_tilt":
            columns += [u, v]
        elif self.kind in ("rigid", "similarity"):
            # (w x q) . n = w . (q x n) for a rotation by the small vector w
            columns += [v + w * slope_north, -u - w * slope_east, v * slope_east - u * slope_north]
        if self.kind == "similarity":
            columns.append(w - u * slope_east - v * slope_north)
        return np.stack(columns, axis=1)

    def stepped(self, step: Sequence[float] | FloatArray) -> Self:
        """Return the transform after a step of its parameters, rotations composed and not added."""
        parameters = np.array(self.parameters) + np.asarray(step)
        if self.kind in ("rigid", "similarity"):
            turned = Rotation.from_rotvec(np.asarray(step)[3:6]) * Rotation.from_rotvec(self.parameters[3:6])
            parameters[3:6] = turned.as_rotvec()
        if self.kind == "similarity":
            parameters[6] = self.scale * (1.0 + float(step[6])) - 1.0
        return type(self)(self.kind, self.centre, tuple(float(p) for p in parameters))

    def promoted(self, kind: Kind) -> Self:
        """Return the transform as a kind of more parameters, a tilt becoming the rotation of the same tilt."""
        parameters = np.zeros(len(PARAMETER_NAMES[kind]))
        if kind == "vertical":
            parameters[0] = self.shift[2]
            return type(self)(kind, self.centre, tuple(parameters))
        parameters[:3] = self.shift
        if kind == "shift_tilt":
            parameters[3:5] = self.tilt
        elif kind in ("rigid", "similarity"):
            # rising towards north is a positive rotation about east, rising towards east a negative one about north
            a, b = self.tilt
            parameters[3:6] = self.parameters[3:6] if self.kind in ("rigid", "similarity") else (b, -a, 0.0)
        if kind == "similarity":
            parameters[6] = self.scale - 1.0
        return type(self)(kind, self.centre, tuple(float(p) for p in parameters))

    def to_dict(self) -> JSONObject:
        """Return everything as JSON knows it; `from_dict` reads it back bit for bit."""
        return {
            "kind": self.kind,
            "centre_m": list(self.centre),
            "parameters": dict(zip(self.names, self.parameters, strict=True)),
        }

    @classmethod
    def from_dict(cls, document: JSONObject) -> Self:
        """
        Read back what `to_dict` gave.

        Raises
        ------
        ValueError, KeyError
            The document lacks something, or its kind or parameters are not those of a transform.
        """
        easting, northing, elevation = (float(v) for v in document["centre_m"])
        kind = document["kind"]
        if kind not in KINDS:
            msg = f"The kind of a transform is one of {', '.join(KINDS)}; got {kind!r}."
            raise ValueError(msg)
        parameters = tuple(float(document["parameters"][name]) for name in PARAMETER_NAMES[kind])
        return cls(kind, (easting, northing, elevation), parameters)

    def _tilt_at(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Lift, m, that the tilt gives positions of the epoch's frame."""
        a, b = self.tilt
        lift: FloatArray = a * (easting - self.centre[0]) + b * (northing - self.centre[1])
        return lift
