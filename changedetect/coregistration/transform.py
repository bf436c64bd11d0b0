"""Transforms between the frame of an epoch and that of its reference, about a stored centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self, TypeAlias, get_args

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, JSONObject

__all__ = ["KINDS", "PARAMETER_NAMES", "Kind", "Transform"]

Kind: TypeAlias = Literal["vertical", "shift", "shift_tilt", "rigid", "rigid_scale"]
#: From few to many parameters; each kind contains the one before, tilt and rotation being the same to first order.
KINDS: tuple[Kind, ...] = get_args(Kind)
_ROTATION = ("rotation_east", "rotation_north", "rotation_up")
PARAMETER_NAMES: dict[Kind, tuple[str, ...]] = {
    "vertical": ("up",),
    "shift": ("east", "north", "up"),
    "shift_tilt": ("east", "north", "up", "tilt_east", "tilt_north"),
    "rigid": ("east", "north", "up", *_ROTATION),
    "rigid_scale": ("east", "north", "up", *_ROTATION, "scale"),
}


@dataclass(frozen=True)
class Transform:
    """
    From the coordinates of an epoch to those of its reference.

    Attributes
    ----------
    kind : {"vertical", "shift", "shift_tilt", "rigid", "rigid_scale"}
        A vertical shift; a shift in space; the same and a tilt that leaves horizontal positions alone; a rotation and
        a shift; the same and a scale.
    centre : (easting, northing, elevation), m
        In the frame of the epoch; rotation, tilt and scale act about it.
    parameters : tuple of float
        In the order of `PARAMETER_NAMES[kind]`. Shifts in m; tilts in m/m; rotations in radians, a right-handed
        rotation vector in the order east, north, up; scale as the excess over one.

    Raises
    ------
    ValueError
        The kind is unknown, or has another number of parameters.

    Notes
    -----
    With c the centre, t the shift and p a position, "rigid" and "rigid_scale" give p' = c + t + (1 + s) R (p - c).

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

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return PARAMETER_NAMES[self.kind]

    def __getitem__(self, name: str) -> float:
        """Value of a parameter; 0 for one that the kind does not have."""
        return self.parameters[self.names.index(name)] if name in self.names else 0.0

    @property
    def shift(self) -> FloatArray:
        """(east, north, up), m: how the centre moves."""
        return np.array([self["east"], self["north"], self["up"]])

    @property
    def rotates(self) -> bool:
        """Whether the kind has a rotation."""
        return self.kind in ("rigid", "rigid_scale")

    def apply(
        self, easting: FloatArray, northing: FloatArray, elevation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Move positions of the epoch, arrays of shape (n,), m, into the frame of the reference."""
        east, north, up = self.shift
        c = self.centre
        u, v = easting - c[0], northing - c[1]
        if not self.rotates:
            lift = up + self["tilt_east"] * u + self["tilt_north"] * v
            return easting + east, northing + north, elevation + lift
        rotation = Rotation.from_rotvec([self[name] for name in _ROTATION]).as_matrix()
        moved = (1.0 + self["scale"]) * (rotation @ np.stack([u, v, elevation - c[2]]))
        return moved[0] + (c[0] + east), moved[1] + (c[1] + north), moved[2] + (c[2] + up)

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
        one = np.ones_like(slope_east)
        if self.kind == "vertical":
            return one[:, None]
        u, v, w = (a - c - t for a, c, t in zip((easting, northing, elevation), self.centre, self.shift, strict=True))
        columns = [-slope_east, -slope_north, one]
        if self.kind == "shift_tilt":
            columns += [u, v]
        elif self.rotates:
            # (a x q) . n = a . (q x n) for a rotation by the small vector a of a place q from the centre
            columns += [v + w * slope_north, -u - w * slope_east, v * slope_east - u * slope_north]
        if self.kind == "rigid_scale":
            columns.append(w - u * slope_east - v * slope_north)
        return np.stack(columns, axis=1)

    def stepped(self, step: FloatArray) -> Self:
        """Return the transform after a step of its parameters, rotations composed and not added."""
        parameters = np.array(self.parameters) + step
        if self.rotates:
            before = Rotation.from_rotvec(self.parameters[3:6])
            parameters[3:6] = (Rotation.from_rotvec(step[3:6]) * before).as_rotvec()
        if self.kind == "rigid_scale":
            parameters[6] = (1.0 + self["scale"]) * (1.0 + float(step[6])) - 1.0
        return type(self)(self.kind, self.centre, tuple(float(p) for p in parameters))

    def inverted(self) -> Self:
        """
        Return the transform that undoes this one, about the moved centre.

        Examples
        --------
        >>> there = Transform("rigid", (10.0, 20.0, 3.0), (0.5, -0.2, 1.0, 1e-3, 2e-3, -3e-3))
        >>> back = there.inverted().apply(*there.apply(*(np.array([v]) for v in (40.0, 70.0, 5.0))))
        >>> [round(float(v[0]), 9) for v in back]
        [40.0, 70.0, 5.0]
        """
        centre = tuple(float(c + t) for c, t in zip(self.centre, self.shift, strict=True))
        parameters = [-value for value in self.parameters]
        if self.kind == "rigid_scale":
            parameters[-1] = 1.0 / (1.0 + self["scale"]) - 1.0
        return type(self)(self.kind, (centre[0], centre[1], centre[2]), tuple(parameters))

    def as_kind(self, kind: Kind) -> Self:
        """Return a transform of another kind with the parameters that both have; the others are 0."""
        return type(self)(kind, self.centre, tuple(self[name] for name in PARAMETER_NAMES[kind]))

    def to_dict(self) -> JSONObject:
        """Return everything as JSON knows it; `from_dict` reads it back bit for bit."""
        parameters = dict(zip(self.names, self.parameters, strict=True))
        return {"kind": self.kind, "centre_m": list(self.centre), "parameters": parameters}

    @classmethod
    def from_dict(cls, document: JSONObject) -> Self:
        """Read back what `to_dict` gave; KeyError or ValueError where it is not such a document."""
        easting, northing, elevation = (float(v) for v in document["centre_m"])
        names = PARAMETER_NAMES[document["kind"]]
        parameters = tuple(float(document["parameters"][name]) for name in names)
        return cls(document["kind"], (easting, northing, elevation), parameters)
