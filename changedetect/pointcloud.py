"""Scattered elevations as one value, and the checks that every source passes once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from changedetect.errors import InputDataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from changedetect.typing import BoolArray, Coordinates, FloatArray, IntArray, Region

__all__ = [
    "MINIMUM_POINTS",
    "PointCloud",
    "check_count",
    "check_finite",
    "check_not_degrees",
    "check_points",
    "check_values",
]

#: Fewer points than this define no surface.
MINIMUM_POINTS = 10
#: The deepest trench lies at -10 994 m, the highest summit at 8 849 m.
_MAX_ELEVATION = 12_000.0
#: Ten times the greatest false easting in use (zone-prefixed grids reach 3.6e7 m).
_MAX_COORDINATE = 1e8
#: A survey whose coordinates are degrees spans less than this (0.2 degrees = 22 km); one in metres spans more.
_DEGREE_SPAN = 0.2


@dataclass(frozen=True, eq=False)
class PointCloud:
    """
    Observed points of a surface.

    Attributes
    ----------
    easting, northing, elevation : array, shape (n,), m, float64
        In whichever CRS the owner says; readers give the source's CRS, in which the first two may be degrees.
    sigma : array, shape (n,), m, float64, or None
        Standard deviation of each elevation; None where it is to be estimated.
    classification : array, shape (n,), uint8, or None
        ASPRS class codes.

    Raises
    ------
    ValueError
        Arrays are not one-dimensional or differ in length.

    Examples
    --------
    >>> cloud = PointCloud(np.array([1.0, 2.0, 4.0]), np.array([5.0, 5.0, 6.0]), np.array([0.1, 0.2, 0.3]))
    >>> len(cloud), cloud.region
    (3, (1.0, 4.0, 5.0, 6.0))
    >>> cloud.select(cloud.easting > 1.5).elevation
    array([0.2, 0.3])
    """

    easting: FloatArray
    northing: FloatArray
    elevation: FloatArray
    sigma: FloatArray | None = None
    classification: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        for name in ("easting", "northing", "elevation", "sigma"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, np.asarray(values, dtype=np.float64))
        if self.classification is not None:
            object.__setattr__(self, "classification", np.asarray(self.classification, dtype=np.uint8))
        columns = {name: values for name, values in vars(self).items() if values is not None}
        if any(values.ndim != 1 or values.shape != self.easting.shape for values in columns.values()):
            shapes = ", ".join(f"{name} {values.shape}" for name, values in columns.items())
            msg = f"A point cloud needs one-dimensional arrays of one length; got {shapes}."
            raise ValueError(msg)

    def __len__(self) -> int:
        return self.easting.size

    @property
    def coordinates(self) -> Coordinates:
        """(easting, northing)."""
        return self.easting, self.northing

    @property
    def region(self) -> Region:
        """
        Smallest (west, east, south, north) around all points.

        Raises
        ------
        ValueError
            There are no points.
        """
        if len(self) == 0:
            msg = "A point cloud without points has no region."
            raise ValueError(msg)
        return (
            float(self.easting.min()),
            float(self.easting.max()),
            float(self.northing.min()),
            float(self.northing.max()),
        )

    def select(self, mask: BoolArray | IntArray | slice) -> Self:
        """Points that `mask` (booleans, positions or a slice) picks, in that order."""
        return type(self)(
            self.easting[mask],
            self.northing[mask],
            self.elevation[mask],
            None if self.sigma is None else self.sigma[mask],
            None if self.classification is None else self.classification[mask],
        )

    @classmethod
    def concatenate(cls, clouds: Sequence[Self]) -> Self:
        """
        Join clouds, in the order given; an empty sequence gives an empty cloud.

        Parameters
        ----------
        clouds : sequence of PointCloud
            Where only some carry classes, the others' points become class 0 (never classified).

        Raises
        ------
        ValueError
            Some clouds carry sigma and others do not: learn them one after the other instead.
        """
        clouds = [cloud for cloud in clouds if len(cloud)]
        if not clouds:
            empty = np.empty(0)
            return cls(empty, empty, empty)
        sigmas = [cloud.sigma for cloud in clouds if cloud.sigma is not None]
        if sigmas and len(sigmas) != len(clouds):
            msg = (
                f"{len(sigmas)} of {len(clouds)} point clouds carry sigma and the others do not. "
                "Give each a sigma, or none, or keep them apart."
            )
            raise ValueError(msg)
        return cls(
            np.concatenate([cloud.easting for cloud in clouds]),
            np.concatenate([cloud.northing for cloud in clouds]),
            np.concatenate([cloud.elevation for cloud in clouds]),
            np.concatenate(sigmas) if sigmas else None,
            _join_classes(clouds),
        )


def check_points(cloud: PointCloud, where: str, *, minimum: int = MINIMUM_POINTS) -> None:
    """
    Refuse a whole source that cannot be terrain in a projected CRS with metres.

    Parameters
    ----------
    cloud : PointCloud
        All points of a source, in the programme's CRS.
    where : str
        Name of the source for messages, usually its path.
    minimum : int
        Smallest number of points accepted.

    Raises
    ------
    InputDataError
        Too few points; coordinates that are NaN, infinite, beyond the Earth or evidently degrees; a sigma that is
        not positive.
    """
    check_count(len(cloud), where, minimum=minimum)
    check_values(cloud, where)
    check_not_degrees(cloud, where)


def check_count(n_points: int, where: str, *, minimum: int = MINIMUM_POINTS) -> None:
    """
    Refuse a source with fewer than `minimum` points.

    Raises
    ------
    InputDataError
    """
    if n_points < minimum:
        msg = (
            f"{where}: {n_points} usable point(s), at least {minimum} are needed. "
            "Check the filters (--classes, --nodata) and whether the right file was given."
        )
        raise InputDataError(msg)


def check_finite(cloud: PointCloud, where: str) -> None:
    """
    Refuse points with NaN or infinite coordinates; any part of a source, in any CRS.

    Raises
    ------
    InputDataError
        Names the column, how many points are affected and the first of them.
    """
    for name in ("easting", "northing", "elevation"):
        values: FloatArray = getattr(cloud, name)
        if not np.isfinite(_largest_magnitude(values)):
            raise InputDataError(_not_finite_message(name, values, where))


def check_values(cloud: PointCloud, where: str) -> None:
    """
    Refuse points with NaN, infinite or absurd coordinates, or a sigma that is not positive; any part of a source.

    Parameters
    ----------
    cloud : PointCloud
        In a projected CRS, metres.
    where : str

    Raises
    ------
    InputDataError
        Names the column, how many points are affected and the first of them.
    """
    check_finite(cloud, where)
    for name, limit in (("easting", _MAX_COORDINATE), ("northing", _MAX_COORDINATE), ("elevation", _MAX_ELEVATION)):
        values: FloatArray = getattr(cloud, name)
        if _largest_magnitude(values) > limit:
            raise InputDataError(_absurd_message(name, values, limit, where))
    if cloud.sigma is not None and len(cloud) and not (cloud.sigma.min() > 0 and np.isfinite(cloud.sigma.max())):
        bad = ~(np.isfinite(cloud.sigma) & (cloud.sigma > 0))
        first = int(np.argmax(bad))
        msg = (
            f"{where}: {int(bad.sum())} of {len(cloud)} sigma values are not positive, finite metres, "
            f"first at point {first}: {cloud.sigma[first]!s}. Correct them, or give one value with --sigma."
        )
        raise InputDataError(msg)


def check_not_degrees(cloud: PointCloud, where: str) -> None:
    """
    Refuse longitudes and latitudes that came in as if they were metres.

    Parameters
    ----------
    cloud : PointCloud
        In a projected CRS; enough points to span a survey.
    where : str

    Raises
    ------
    InputDataError

    Notes
    -----
    A survey of 22 km spans 0.2 degrees, and one in metres spans more than 0.2 m; local coordinates around zero are
    therefore not mistaken for degrees.
    """
    if len(cloud) < MINIMUM_POINTS:
        return
    west, east, south, north = cloud.region
    inside_degrees = west >= -180 and east <= 180 and south >= -90 and north <= 90
    if inside_degrees and 0 < max(east - west, north - south) < _DEGREE_SPAN:
        msg = (
            f"{where}: coordinates look like degrees (easting {west:.6f} to {east:.6f}, northing {south:.6f} to "
            f"{north:.6f}), but the CRS is projected, in metres. If they are longitude and latitude, state "
            "--crs EPSG:4326 (or EPSG:4979 with ellipsoidal heights)."
        )
        raise InputDataError(msg)


def _largest_magnitude(values: FloatArray) -> float:
    """Largest absolute value, NaN where any is NaN, 0 where there are none; makes no temporary array."""
    return max(-float(values.min()), float(values.max())) if values.size else 0.0


def _join_classes(clouds: Sequence[PointCloud]) -> NDArray[np.uint8] | None:
    if all(cloud.classification is None for cloud in clouds):
        return None
    return np.concatenate(
        [np.zeros(len(cloud), np.uint8) if cloud.classification is None else cloud.classification for cloud in clouds]
    )


def _not_finite_message(name: str, values: FloatArray, where: str) -> str:
    bad = ~np.isfinite(values)
    first = int(np.argmax(bad))
    n_nan = int(np.isnan(values).sum())
    return (
        f"{where}: {int(bad.sum())} of {values.size} points have no finite {name} ({n_nan} NaN, "
        f"{int(bad.sum()) - n_nan} infinite), first at point {first}. Remove them from the source; missing "
        "elevations alone can be left out with --nodata nan."
    )


def _absurd_message(name: str, values: FloatArray, limit: float, where: str) -> str:
    bad = np.abs(values) > limit
    first = int(np.argmax(bad))
    hint = (
        "If this marks missing data, state it with --nodata; if heights are in other units, state the CRS."
        if name == "elevation"
        else "Check the CRS, the column order and the scale of the file."
    )
    return (
        f"{where}: {int(bad.sum())} of {values.size} points have an absurd {name}, first at point {first}: "
        f"{values[first]!s}; allowed is up to {limit:g} m in magnitude. {hint}"
    )
