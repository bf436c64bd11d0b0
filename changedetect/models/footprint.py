"""
How much ground one observation of a coarse epoch averages, found against the surface of a dense one.

A laser point is a sample; the cell of an elevation model may be the mean over the cell, or over more where it was
interpolated or filtered. Subtracting the dense surface at the middle of a cell from the mean over it leaves the
ground's own curvature and roughness, which look like noise, or like change along ridges and ditches. So the dense
surface is averaged over the same ground first; over how much is told by what is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from changedetect.models.cells import Cells
    from changedetect.typing import BoolArray, Coordinates, FloatArray

__all__ = ["AveragedSurface", "Evaluate", "average_surface", "find_footprint"]

Evaluate: TypeAlias = "Callable[[FloatArray, FloatArray], FloatArray]"

#: Sides of the square that an observation may average, in spacings of the observations.
_SIDES = (0.5, 0.71, 1.0, 1.41, 2.0, 2.83)
#: Pairs of neighbouring observations that decide.
_N_PAIRS = 3000
#: Fewer pairs than this cannot decide: observations count as points.
_LEAST_PAIRS = 50
#: Neighbours lie within this many spacings of each other.
_REACH = 1.75
#: A footprint must make the scatter at least this much smaller to be believed.
_LEAST_GAIN = 0.05
#: Places along each side of the square at which the surface is evaluated, at most.
_MOST_PLACES = 16
#: Share of the square on which the surface must be defined: the mean of a part is that of another place.
_LEAST_SHARE = 0.98
#: Places evaluated at a time; bounds the memory.
_BLOCK = 4_000_000


@dataclass(frozen=True)
class AveragedSurface:
    """
    A surface averaged over squares about places.

    Attributes
    ----------
    surface : array, shape (n, k)
        Means of the surface's columns.
    known : array, shape (n,), bool
        Where the surface is defined on enough of the square.
    """

    surface: FloatArray
    known: BoolArray


def average_surface(evaluate: Evaluate, places: Coordinates, side: float, step: float) -> AveragedSurface:
    """
    Mean of a surface over squares.

    Parameters
    ----------
    evaluate : callable
        Takes easting and northing, each shape (n,), m; returns columns, shape (n, k), NaN where not defined.
    places : (easting, northing), each shape (n,), m
        Middles of the squares, whose sides run east and north.
    side : float, m
        0 evaluates at the places themselves.
    step : float, m
        Distance over which the surface varies; it is evaluated about this densely.

    Returns
    -------
    averaged : AveragedSurface
    """
    n = int(np.clip(np.ceil(side / step), 1, _MOST_PLACES))
    offsets = side * ((np.arange(n) + 0.5) / n - 0.5)
    east, north = (o.ravel() for o in np.meshgrid(offsets, offsets))
    per_block = max(1, _BLOCK // east.size)
    means, shares = [], []
    for start in range(0, max(places[0].size, 1), per_block):
        part = slice(start, start + per_block)
        values = evaluate((places[0][part, None] + east).ravel(), (places[1][part, None] + north).ravel())
        values = values.reshape(-1, east.size, values.shape[-1])
        defined = np.isfinite(values[..., 0])
        shares.append(defined.mean(axis=1))
        count = np.maximum(defined.sum(axis=1), 1)
        means.append(np.where(defined[..., None], values, 0.0).sum(axis=1) / count[:, None])
    return AveragedSurface(np.concatenate(means), np.concatenate(shares) >= _LEAST_SHARE)


def find_footprint(cells: Cells, evaluate: Evaluate, spacing: float, step: float) -> float:
    """
    Side of the square that one observation averages.

    Parameters
    ----------
    cells : Cells
        Evidence of the coarse epoch.
    evaluate : callable
        Surface of the dense epoch, see `average_surface`.
    spacing : float, m
        Of the observations of the coarse epoch.
    step : float, m
        Distance over which the dense surface varies.

    Returns
    -------
    side : float, m
        0 where observations are points, or too few lie on the dense surface to tell.

    Notes
    -----
    What is left over the averaged surface is compared between neighbouring observations, so that change which is wider
    than their spacing drops out; the median of the absolute differences keeps narrow change and gross errors out. The
    side that makes it smallest counts if it is at least 5 % smaller than for points.
    """
    easting, northing = cells.places
    # cells are ordered by row, then column: the next one mostly is the neighbour to the east
    near = np.flatnonzero(np.hypot(np.diff(easting), np.diff(northing)) < _REACH * spacing)
    if near.size < _LEAST_PAIRS:
        return 0.0
    near = near[:: max(1, near.size // _N_PAIRS)]
    both = np.concatenate([near, near + 1])
    places = (easting[both], northing[both])
    elevation = cells.moments[both, 7] / cells.moments[both, 1]
    found = [average_surface(evaluate, places, side * spacing, step) for side in (0.0, *_SIDES)]
    known = np.all([f.known for f in found], axis=0)
    n = near.size
    usable = known[:n] & known[n:]
    if np.count_nonzero(usable) < _LEAST_PAIRS:
        return 0.0
    left = [elevation - f.surface[:, 0] for f in found]
    scatter = [float(np.median(np.abs(r[:n] - r[n:])[usable])) for r in left]
    best = int(np.argmin(scatter))
    return ((0.0, *_SIDES)[best] * spacing) if scatter[best] < (1.0 - _LEAST_GAIN) * scatter[0] else 0.0
