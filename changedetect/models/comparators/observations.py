"""The observations a comparator keeps: checked once, about a local origin, and their neighbourhoods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from changedetect.typing import Coordinates, FloatArray, IntArray

__all__ = [
    "MIN_POINTS",
    "Observations",
    "check_positions",
    "check_time",
    "distance_to_kth",
    "nearest",
    "observations_from",
    "stack_observations",
]

#: Fewer observations than this teach none of the methods anything.
MIN_POINTS = 10


@dataclass(frozen=True, eq=False)
class Observations:
    """
    The points of one epoch about a local origin, in an order that does not depend on how they came.

    Attributes
    ----------
    easting, northing : array, shape (n,), m
        Relative to `origin`.
    elevation : array, shape (n,), m
        Relative to `datum`.
    variance : array, shape (n,), m2
        Squares of the sigmas given; 0 where none was.
    origin : (easting, northing), m
        Whole metres near the middle: subtracting it from UTM coordinates is exact.
    datum : float, m
        Mean elevation.
    """

    easting: FloatArray
    northing: FloatArray
    elevation: FloatArray
    variance: FloatArray
    origin: tuple[float, float]
    datum: float

    @property
    def positions(self) -> FloatArray:
        """Easting and northing side by side, shape (n, 2), m."""
        return np.column_stack([self.easting, self.northing])

    def __len__(self) -> int:
        return self.easting.size


def nearest(tree: cKDTree, places: FloatArray, k: int) -> tuple[FloatArray, IntArray]:
    """
    Nearest points of a tree, nearest first.

    Parameters
    ----------
    tree : cKDTree
        Over at least `k` positions.
    places : array, shape (n, 2), m
    k : int

    Returns
    -------
    distance : array, shape (n, k), m
    index : array, shape (n, k), int64
    """
    distance, index = tree.query(places, k=list(range(1, k + 1)))
    return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.int64)


def distance_to_kth(positions: FloatArray, k: int) -> float:
    """Median distance from a position to its k-th neighbour, from at most 2000 positions; at least 1 um, m."""
    sample = positions[:: max(1, len(positions) // 2000)]
    distance, _ = cKDTree(positions).query(sample, k=[k + 1])
    return max(float(np.median(np.asarray(distance))), 1e-6)


def stack_observations(coordinates: Coordinates, elevation: FloatArray, sigma: FloatArray | None) -> FloatArray:
    """
    Check observations and stack easting, northing, elevation and variance.

    Parameters
    ----------
    coordinates : (easting, northing), arrays of shape (n,), m
    elevation : array, shape (n,), m
    sigma : array, shape (n,), m, or None

    Returns
    -------
    points : array, shape (4, n)
        Metres, the last row m2; copies.

    Raises
    ------
    ValueError
        Shapes differ, values are not finite real numbers, or a sigma is not positive.
    """
    easting, northing = check_positions(coordinates)
    heights = _vector(elevation, "elevation", easting.size)
    if sigma is None:
        return np.stack([easting, northing, heights, np.zeros(easting.size)])
    spread = _vector(sigma, "sigma", easting.size)
    if np.any(spread <= 0.0):
        msg = f"Every sigma must be positive, in metres; the smallest is {spread.min()!r}."
        raise ValueError(msg)
    return np.stack([easting, northing, heights, spread**2])


def check_positions(coordinates: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """
    Return easting and northing as finite float64 copies of one shape (n,), m.

    Raises
    ------
    ValueError
        They are anything else.
    """
    if len(coordinates) != 2:
        msg = f"coordinates must be (easting, northing), two arrays; got {len(coordinates)} of them."
        raise ValueError(msg)
    easting = _vector(coordinates[0], "easting", None)
    return easting, _vector(coordinates[1], "northing", easting.size)


def _vector(values: FloatArray, name: str, size: int | None) -> FloatArray:
    """Return `values` as a finite 1-D float64 array of its own."""
    array: NDArray[Any] = np.array(values)
    if array.ndim != 1 or array.dtype.kind not in "fiu":
        msg = f"{name} must be a 1-D array of real numbers; got shape {array.shape}, dtype {array.dtype}."
        raise ValueError(msg)
    if size is not None and array.size != size:
        msg = f"{name} has {array.size} values where easting has {size}; they must agree."
        raise ValueError(msg)
    array = array.astype(np.float64)
    finite = np.isfinite(array)
    if not finite.all():
        msg = f"{name} must be finite; {int((~finite).sum())} of {array.size} values are NaN or infinite."
        raise ValueError(msg)
    return array


def check_time(survey_time: float | None, default: float) -> float:
    """
    Return `survey_time`, or `default` where it is None, in days since 1970-01-01.

    Raises
    ------
    ValueError
        It is not finite.
    """
    if survey_time is None:
        return default
    if not np.isfinite(survey_time):
        msg = f"survey_time must be a finite number of days since 1970-01-01; got {survey_time!r}."
        raise ValueError(msg)
    return float(survey_time)


def observations_from(points: FloatArray) -> Observations:
    """Refer what `stack_observations` returned to a local origin."""
    easting, northing, elevation, variance = points
    origin = (float(np.round(np.median(easting))), float(np.round(np.median(northing))))
    datum = float(elevation.mean())
    return Observations(easting - origin[0], northing - origin[1], elevation - datum, variance, origin, datum)
