"""Outlines on the ground and the changes of elevation inside them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from changedetect.synthetic.surfaces import Surface
from changedetect.synthetic.terrain import across_and_along, smoothstep

if TYPE_CHECKING:
    from changedetect.synthetic.terrain import Scarp
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["Change", "ChangePatch", "Ellipse", "Footprint", "Profile", "Rectangle", "ScarpRetreat"]

Profile: TypeAlias = Literal["box", "plateau", "mound", "pit"]


class Footprint(ABC):
    """A closed outline, in metres of the scene's coordinates."""

    @abstractmethod
    def distance(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Signed distance to the outline, shape (n,), m; negative inside."""

    @property
    @abstractmethod
    def inradius(self) -> float:
        """Greatest depth below the outline, m: -distance at the centre."""

    def contains(self, easting: FloatArray, northing: FloatArray) -> BoolArray:
        """Whether points lie inside, shape (n,)."""
        return np.asarray(self.distance(easting, northing) < 0.0)


@dataclass(frozen=True)
class Rectangle(Footprint):
    """
    A rectangle; its distance is exact.

    Attributes
    ----------
    centre : (easting, northing), m
    length : float, m
        Along `azimuth_deg`.
    width : float, m
        Across it.
    azimuth_deg : float, degrees
        Clockwise from north.
    """

    centre: tuple[float, float]
    length: float
    width: float
    azimuth_deg: float = 0.0

    def distance(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Signed distance to the outline, m."""
        across, along = across_and_along(easting, northing, self.centre, self.azimuth_deg)
        beyond_side = np.abs(across) - 0.5 * self.width
        beyond_end = np.abs(along) - 0.5 * self.length
        outside = np.hypot(np.maximum(beyond_side, 0.0), np.maximum(beyond_end, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(beyond_side, beyond_end), 0.0))

    @property
    def inradius(self) -> float:
        """Half the shorter side, m."""
        return 0.5 * min(self.length, self.width)


@dataclass(frozen=True)
class Ellipse(Footprint):
    """
    An ellipse; a circle where both semi-axes are equal.

    Attributes
    ----------
    centre : (easting, northing), m
    semi_along : float, m
        Semi-axis along `azimuth_deg`.
    semi_across : float, m
    azimuth_deg : float, degrees
        Clockwise from north.

    Notes
    -----
    `distance` is (rho - 1) times the shorter semi-axis, rho the radius relative to the outline: exact for circles and
    along the shorter axis, elsewhere smaller in size than the true distance.
    """

    centre: tuple[float, float]
    semi_along: float
    semi_across: float
    azimuth_deg: float = 0.0

    def distance(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Signed distance to the outline, m; see the notes of the class."""
        across, along = across_and_along(easting, northing, self.centre, self.azimuth_deg)
        relative_radius = np.hypot(across / self.semi_across, along / self.semi_along)
        return np.asarray((relative_radius - 1.0) * self.inradius)

    @property
    def inradius(self) -> float:
        """The shorter semi-axis, m."""
        return min(self.semi_along, self.semi_across)


class Change(Surface):
    """A change of elevation that is 0 outside an area."""

    @abstractmethod
    def distance(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Signed distance to the border of the changed area, shape (n,), m; negative inside."""


@dataclass(frozen=True)
class ChangePatch(Change):
    """
    A change of elevation inside an outline, 0 outside.

    Attributes
    ----------
    footprint : Footprint
    height : float, m
        Greatest change; positive = raised.
    profile : "box", "plateau", "mound" or "pit"
        `box`: the whole height up to the outline, a vertical edge. `plateau`: the whole height deeper than `edge`
        inside the outline, a smooth rise before. `mound`: a bell over the whole outline. `pit`: a bowl, steepest at
        the outline and flat in the middle.
    edge : float, m
        Width of the rise of a plateau.

    Raises
    ------
    ValueError
        The profile is unknown, or a plateau's edge is not between 0 and the outline's inradius.

    Examples
    --------
    >>> fill = ChangePatch(Rectangle((20.0, 20.0), 18.0, 18.0), height=0.5, profile="plateau", edge=1.0)
    >>> fill(np.array([20.0, 28.5, 40.0]), np.array([20.0, 20.0, 20.0]))
    array([0.5 , 0.25, 0.  ])
    """

    footprint: Footprint
    height: float
    profile: Profile = "box"
    edge: float = 0.0

    def __post_init__(self) -> None:
        if self.profile not in ("box", "plateau", "mound", "pit"):
            msg = f"Unknown profile {self.profile!r} of a change; use 'box', 'plateau', 'mound' or 'pit'."
            raise ValueError(msg)
        if self.profile == "plateau" and not 0.0 < self.edge <= self.footprint.inradius:
            msg = (
                f"The edge of a plateau must be above 0 and at most the outline's inradius "
                f"{self.footprint.inradius:g} m; got {self.edge!r}. Use profile 'box' for a vertical edge."
            )
            raise ValueError(msg)

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        depth = np.maximum(-self.footprint.distance(easting, northing), 0.0)
        relative_depth = np.minimum(depth / self.footprint.inradius, 1.0)
        if self.profile == "box":
            share = np.asarray(depth > 0.0, dtype=np.float64)
        elif self.profile == "plateau":
            share = smoothstep(depth / self.edge)
        elif self.profile == "mound":
            share = np.sin(0.5 * np.pi * relative_depth) ** 2
        else:
            share = 1.0 - (1.0 - relative_depth) ** 2
        return np.asarray(self.height * share)

    def distance(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Signed distance to the outline, m."""
        return self.footprint.distance(easting, northing)


@dataclass(frozen=True)
class ScarpRetreat(Change):
    """
    Erosion of a scarp whose face moved back by `retreat` m; negative for a scarp of positive height.

    Attributes
    ----------
    scarp : Scarp
        As it stood before; part of the scene's ground.
    retreat : float, m
        Above 0.
    """

    scarp: Scarp
    retreat: float

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        return self.scarp.retreated(self.retreat)(easting, northing) - self.scarp(easting, northing)

    def distance(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Signed distance to the band between the old foot and the new top of the face, m."""
        across, _ = across_and_along(easting, northing, self.scarp.point, self.scarp.azimuth_deg)
        return np.asarray(np.maximum(-across, across - (self.scarp.width + self.retreat)))
