"""
Several flights over one site, adjusted together.

Features matched between flights bind their poses to each other far more firmly than GPS does, so that differences need
no co-registration afterwards. The one duty is to bind on ground that did not move: a point shared by two flights is
triangulated from each flight alone, and kept only where the two agree, by itself and together with its neighbours.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from changedetect.errors import InputDataError
from changedetect.photogrammetry.block import EPOCH_TIE, ImageBlock, Observations
from changedetect.photogrammetry.triangulation import triangulate
from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = [
    "JointSettings",
    "SharedPoints",
    "compare_flights",
    "count_shared",
    "drop_changed",
    "require_shared",
    "shared_between_flights",
    "unchanged",
]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class JointSettings:
    """
    How ground that moved is kept out of the shared points.

    Attributes
    ----------
    max_z : float
        Largest standardised disagreement of a point alone.
    radius : float, m
        Neighbourhood in which disagreements are averaged.
    max_local_z : float
        Largest standardised disagreement of a neighbourhood.
    floor : float, m
        Neighbourhoods that disagree by less are kept whatever their significance.
    min_shared : int
        Fewest shared points two flights need to be adjusted together.
    """

    max_z: float = 3.5
    radius: float = 6.0
    max_local_z: float = 4.0
    floor: float = 0.06
    min_shared: int = 30


@dataclass(frozen=True)
class SharedPoints:
    """
    Points that two flights see, triangulated from each alone.

    Attributes
    ----------
    point : array, shape (n,), int64
        Number among the observations compared.
    place : array, shape (n, 3), ENU, m
        From the earlier flight.
    difference : array, shape (n, 3), m
        Later flight minus earlier.
    covariance : array, shape (n, 3, 3), m^2
        Of the difference, from the pixels alone.
    """

    point: IntArray
    place: FloatArray
    difference: FloatArray
    covariance: FloatArray


def shared_between_flights(block: ImageBlock, ties: Observations) -> Observations:
    """
    Points that at least two photos of at least two flights see, marked as ties between epochs.

    Parameters
    ----------
    block : ImageBlock
    ties : Observations
        Joined matches of the whole block.
    """
    n_flights = int(block.flight.max()) + 1
    counts = np.zeros((ties.n_points, n_flights), np.int64)
    np.add.at(counts, (ties.point, block.flight[ties.image]), 1)
    is_shared = (counts >= 2).sum(axis=1) >= 2
    fine = counts[ties.point, block.flight[ties.image]] >= 2
    kept, _ = ties.keep(is_shared[ties.point] & fine)
    return replace(kept, kind=np.full(len(kept), EPOCH_TIE))


def compare_flights(block: ImageBlock, shared: Observations) -> list[SharedPoints]:
    """
    Triangulate shared points from each flight alone; one result for each pair of flights with common points.

    Parameters
    ----------
    block : ImageBlock
        Adjusted poses.
    shared : Observations
        From `shared_between_flights`.
    """
    n_flights = int(block.flight.max()) + 1
    flight = block.flight[shared.image]
    solved = [
        triangulate(block, shared, weight=np.where(flight == g, shared.sigma**-2.0, 0.0)) for g in range(n_flights)
    ]
    out = []
    for a in range(n_flights):
        for b in range(a + 1, n_flights):
            both = np.isfinite(solved[a].points[:, 0]) & np.isfinite(solved[b].points[:, 0])
            if both.any():
                out.append(
                    SharedPoints(
                        np.flatnonzero(both),
                        solved[a].points[both],
                        (solved[b].points - solved[a].points)[both],
                        (solved[a].covariance + solved[b].covariance)[both],
                    )
                )
    return out


def unchanged(pair: SharedPoints, settings: JointSettings) -> BoolArray:
    """
    Which shared points lie on ground that did not move between two flights.

    Parameters
    ----------
    pair : SharedPoints
        From adjusted poses; what the poses leave in common must be small beside the changes sought.
    settings : JointSettings

    Returns
    -------
    unchanged : array, shape (n,), bool

    Notes
    -----
    Alone: Mahalanobis length of the difference, its scale taken from the points themselves (median over that of a
    chi distribution with three degrees of freedom, 1.538), so that correlated pixel errors do not count as change.
    Together: weighted mean of the height differences within the radius; half of the neighbours' variance is taken as
    shared, since neighbours lie under the same distortions of a photo.
    """
    solved = np.linalg.solve(pair.covariance, pair.difference[..., None])[..., 0]
    length = np.sqrt(np.maximum(np.sum(pair.difference * solved, axis=1), 0.0))
    scale = max(float(np.median(length)) / 1.538, 1e-9)
    alone = length <= settings.max_z * max(scale, 1.0)
    variance = pair.covariance[:, 2, 2] * scale**2
    weight = np.where(alone | (length < 3 * settings.max_z * scale), 1.0 / variance, 0.0)
    near = cKDTree(pair.place[:, :2]).query_ball_point(pair.place[:, :2], settings.radius)
    keep = alone.copy()
    for k, members in enumerate(near):
        neighbours = np.asarray(members, dtype=np.int64)
        w = weight[neighbours]
        total = float(w.sum())
        if neighbours.size < 4 or total <= 0:
            continue
        mean = float(w @ pair.difference[neighbours, 2]) / total
        spread = np.sqrt(0.5 / total + 0.5 * float(np.median(variance[neighbours])) / np.sqrt(neighbours.size))
        keep[k] &= abs(mean) <= max(settings.max_local_z * spread, settings.floor)
    return np.asarray(keep, dtype=np.bool_)


def drop_changed(
    block: ImageBlock, shared: Observations, settings: JointSettings, names: tuple[str, ...]
) -> tuple[Observations, FloatArray]:
    """
    Shared points without those on ground that moved.

    Parameters
    ----------
    block : ImageBlock
        Adjusted poses.
    shared : Observations
    settings : JointSettings
    names : tuple of str
        Of the flights, for messages.

    Returns
    -------
    shared : Observations
    moved : array, shape (n, 3), ENU, m
        Places of the points left out.

    Raises
    ------
    InputDataError
        Two flights have too few points in common.
    """
    is_moved = np.zeros(shared.n_points, dtype=bool)
    place = np.full((shared.n_points, 3), np.nan)
    for pair in compare_flights(block, shared):
        keep = unchanged(pair, settings)
        is_moved[pair.point[~keep]] = True
        place[pair.point] = pair.place
    kept, _ = shared.keep(~is_moved[shared.point])
    require_shared(block, kept, settings, names)
    logger.info("%d of %d points shared by flights lie on ground that changed", is_moved.sum(), is_moved.size)
    return kept, place[is_moved]


def count_shared(block: ImageBlock, shared: Observations) -> IntArray:
    """
    Points that each two flights have in common, shape (n_flights, n_flights); all points of a flight on the diagonal.

    Parameters
    ----------
    block : ImageBlock
    shared : Observations
        From `shared_between_flights`.
    """
    seen = np.zeros((shared.n_points, int(block.flight.max()) + 1), dtype=np.int64)
    seen[shared.point, block.flight[shared.image]] = 1
    return np.asarray(seen.T @ seen)


def require_shared(block: ImageBlock, shared: Observations, settings: JointSettings, names: tuple[str, ...]) -> None:
    """
    Refuse flights that no chain of shared points joins.

    Raises
    ------
    InputDataError
    """
    n_flights = len(names)
    common = count_shared(block, shared)
    reached, frontier = {0}, [0]
    while frontier:
        g = frontier.pop()
        for other in np.flatnonzero(common[g] >= settings.min_shared):
            if int(other) not in reached:
                reached.add(int(other))
                frontier.append(int(other))
    missing = [names[g] for g in range(n_flights) if g not in reached]
    if missing:
        most = max(int(common[names.index(name)][np.arange(n_flights) != names.index(name)].max()) for name in missing)
        msg = (
            f"Flight {missing[0]} shares {most} ground points with the others; at least {settings.min_shared} are "
            "needed to adjust them together. Do they show the same ground? Reconstruct them one by one instead."
        )
        raise InputDataError(msg)
