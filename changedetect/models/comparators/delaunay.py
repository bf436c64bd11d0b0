"""Linear interpolation on the Delaunay triangulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import Delaunay, QhullError

from changedetect.models.comparators.base import LocalAnswer, PointModel
from changedetect.models.comparators.observations import Observations

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["DelaunayLinear"]

#: Noise is taken to be at least this, m: data without any would have infinite weights.
_LEAST_NOISE = 1e-6


@dataclass(frozen=True, eq=False)
class _Mesh:
    triangulation: Delaunay
    elevation: FloatArray
    variance: FloatArray


@dataclass(frozen=True, eq=False)
class _Prepared:
    mesh: _Mesh
    noise_std: float


@dataclass(kw_only=True, eq=False)
class DelaunayLinear(PointModel[_Prepared]):
    """
    The irregular mesh: triangles between observations, linear inside, nothing outside their convex hull.

    Attributes
    ----------
    held_out_share : float, between 0 and 1
        Part of the observations left out, once, to estimate the noise.
    random_seed : int
        Of their choice.
    max_points : int or None

    Notes
    -----
    With barycentric weights b the interpolated noise has variance sum b_i^2 s_i^2, which is reported as that of the
    surface; the error of the straight triangle is not in it. A held-out observation misses the mesh of the others by
    (1 + sum b_i^2) s^2 in the square if the ground is straight between them; s follows from the median of the
    normalised misses, so that edges and outliers count little. Points at one position are averaged first.
    """

    held_out_share: float = 0.1
    random_seed: int = 0
    max_points: int | None = 2_000_000

    def _estimate(self, observations: Observations) -> dict[str, float]:
        rng = np.random.default_rng(self.random_seed)
        is_held_out = rng.uniform(size=len(observations)) < self.held_out_share
        kept, left = np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out)
        mesh = _triangulate(observations.positions[kept], observations.elevation[kept], np.ones(kept.size))
        elevation, weight2 = _interpolate(mesh, observations.positions[left])
        miss = np.abs(observations.elevation[left] - elevation) / np.sqrt(1.0 + weight2)
        inside = miss[np.isfinite(miss)]
        if inside.size == 0:
            msg = (
                f"None of the {left.size} observations held out of {len(observations)} lies inside the mesh of the "
                "others, so the noise cannot be estimated. Raise held_out_share or give more points."
            )
            raise ValueError(msg)
        # 1.4826 times the median of absolute normal deviates is their standard deviation
        return {"noise_std": max(1.4826 * float(np.median(inside)), _LEAST_NOISE)}

    def _prepare(self, observations: Observations, parameters: dict[str, float]) -> _Prepared:
        noise_std = parameters["noise_std"]
        variance = np.where(observations.variance > 0.0, observations.variance, noise_std**2)
        mesh = _triangulate(observations.positions, observations.elevation, variance)
        return _Prepared(mesh, noise_std)

    def _answer(self, prepared: _Prepared, easting: FloatArray, northing: FloatArray) -> LocalAnswer:
        elevation, variance = _interpolate(prepared.mesh, np.column_stack([easting, northing]))
        is_inside = np.isfinite(elevation)
        return LocalAnswer(
            elevation=elevation,
            elevation_std=np.sqrt(variance),
            noise_std=np.full(elevation.shape, prepared.noise_std),
            n_effective=np.where(is_inside, prepared.noise_std**2 / variance, 0.0),
        )


def _triangulate(positions: FloatArray, elevation: FloatArray, variance: FloatArray) -> _Mesh:
    """Average points at one position with weights 1 / variance, then triangulate."""
    places, label = np.unique(positions, axis=0, return_inverse=True)
    precision = np.bincount(label, 1.0 / variance)
    height = np.bincount(label, elevation / variance) / precision
    try:
        triangulation = Delaunay(places)
    except QhullError as error:
        msg = f"{len(places)} positions span no triangle: they lie at one place or on one line."
        raise ValueError(msg) from error
    return _Mesh(triangulation, height, 1.0 / precision)


def _interpolate(mesh: _Mesh, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Elevation and noise variance of the mesh at places, NaN outside it, each of shape (n,)."""
    triangle = mesh.triangulation.find_simplex(places)
    affine = mesh.triangulation.transform[triangle]
    two = np.einsum("nij,nj->ni", affine[:, :2], places - affine[:, 2])
    weight = np.column_stack([two, 1.0 - two.sum(axis=1)])
    corner = mesh.triangulation.simplices[triangle]
    elevation = np.sum(weight * mesh.elevation[corner], axis=1)
    variance = np.sum(weight**2 * mesh.variance[corner], axis=1)
    is_inside = triangle >= 0
    return np.where(is_inside, elevation, np.nan), np.where(is_inside, variance, np.nan)
