"""
How far points may be wrong: each by itself, and all of a flight together.

A point's own pixels give V^-1, independent from point to point. Poses and lens add an error that all points of a region
share: it does not average out, so it is handed on apart, as the covariance of the flight's offset and tilt and as a
standard deviation of what remains after them. Pixels of one photo are not independent either: distortions that no lens
model describes (rolling shutter, air, stabiliser) move neighbouring features alike. Their correlation is measured on
the residuals, and the poses' covariance uses the number of independent observations it leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.distance import pdist, squareform

from changedetect.kernels.bundle import coordinate_modes, point_covariances
from changedetect.photogrammetry.block import Observations
from changedetect.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from changedetect.photogrammetry.adjustment import Adjustment

__all__ = [
    "PixelCorrelation",
    "PointUncertainty",
    "SystematicError",
    "flight_difference",
    "height_design",
    "pixel_correlation",
    "point_arrays",
    "point_uncertainty",
]

#: Distances at which the correlation of residuals is measured, pixels; 0 to 1 of the photo's diagonal in uneven steps.
_EDGES = np.array([0.0, 0.008, 0.016, 0.03, 0.05, 0.08, 0.12, 0.17, 0.25, 0.4])
_SAMPLE = 350
_CHUNK = 20_000
#: Points that offset and tilt of a pattern of errors are fitted to.
_SAMPLE_POINTS = 4_000


@dataclass(frozen=True)
class PixelCorrelation:
    """
    Correlation of residuals within a photo.

    Attributes
    ----------
    distance : array, shape (k,), pixels
        Middle of each class of distance.
    correlation : array, shape (k,)
    design_effect : float
        Observations of a photo per independent observation; 1 for white noise.
    """

    distance: FloatArray
    correlation: FloatArray
    design_effect: float

    @property
    def length(self) -> float:
        """Distance at which the correlation has fallen to 1 / e, pixels; 0 where it never is that high."""
        below = np.flatnonzero(self.correlation < np.exp(-1.0))
        if below.size == 0:
            return float(self.distance[-1])
        k = int(below[0])
        if k == 0:
            return 0.0
        c0, c1 = self.correlation[k - 1], self.correlation[k]
        share = (c0 - np.exp(-1.0)) / (c0 - c1)
        return float(self.distance[k - 1] + share * (self.distance[k] - self.distance[k - 1]))


@dataclass(frozen=True)
class SystematicError:
    """
    Error that all points of a flight share: z = offset + tilt_east * (east - e0) + tilt_north * (north - n0).

    Attributes
    ----------
    centre : tuple of 2 float, m
        e0, n0 in ENU: the middle of the points.
    covariance : array, shape (3, 3)
        Of offset (m), tilt east and tilt north (m per m).
    residual_std : float, m
        Root mean square, over the points, of the standard deviation that poses and lens leave after offset and tilt.
    bend_std : array, shape (3,), m per m^2
        Of the bending: coefficients of e^2, e n and n^2 in a surface fitted with offset and tilt.
    """

    centre: tuple[float, float]
    covariance: FloatArray
    residual_std: float
    bend_std: FloatArray

    def describe(self) -> dict[str, Any]:
        """Content for a report."""
        std = np.sqrt(np.diag(self.covariance))
        return {
            "centre_enu_m": list(self.centre),
            "offset_std_m": float(std[0]),
            "tilt_east_std_m_per_m": float(std[1]),
            "tilt_north_std_m_per_m": float(std[2]),
            "covariance": self.covariance.tolist(),
            "residual_std_m": self.residual_std,
            "bend_std_m_per_m2": self.bend_std.tolist(),
        }


@dataclass(frozen=True)
class PointUncertainty:
    """
    Standard deviations of the heights of one flight's points, and the error they share.

    Attributes
    ----------
    sigma_own : array, shape (n,), m
        Of the point's own pixels.
    sigma_shared : array, shape (n,), m
        Of poses and lens, after the flight's offset and tilt.
    sigma_local : array, shape (n,), m
        The same after its bending too.
    covariance : array, shape (n, 3, 3), m^2
        Whole covariance of the position in ENU, offset and tilt included.
    systematic : SystematicError
    """

    sigma_own: FloatArray
    sigma_shared: FloatArray
    sigma_local: FloatArray
    covariance: FloatArray
    systematic: SystematicError

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of each height against the flight's own surface, m."""
        return np.hypot(self.sigma_own, self.sigma_shared)


def pixel_correlation(
    residual: FloatArray, observations: Observations, diagonal: float, *, seed: int = 0
) -> PixelCorrelation:
    """
    Measure how residuals of one photo correlate with distance.

    Parameters
    ----------
    residual : array, shape (n, 2), pixels
    observations : Observations
    diagonal : float, pixels
        Of a photo.
    seed : int
        Of the sample of each photo.

    Notes
    -----
    The design effect is 1 + (N - 1) times the mean correlation over all pairs of a photo's N observations [1]_.
    Correlations below those of chance are taken as nought.

    References
    ----------
    .. [1] Kish (1965), Survey sampling, section 5.4.
    """
    edges = _EDGES * diagonal
    product, counts = np.zeros(edges.size - 1), np.zeros(edges.size - 1)
    rng = np.random.default_rng(seed)
    size = np.sqrt(np.nanmean(residual**2))
    fine = (observations.n_views[observations.point] >= 4) & np.all(np.abs(residual) < 5 * size, axis=1)
    order = np.flatnonzero(fine)
    order = order[np.argsort(observations.image[order], kind="stable")]
    photos, first, members_of = np.unique(observations.image[order], return_index=True, return_counts=True)
    middle = (edges[1:] + edges[:-1]) / 2
    if photos.size == 0 or members_of.max() < 2 or not size > 0:
        return PixelCorrelation(middle, np.zeros(middle.size), 1.0)
    samples = []
    for members in np.split(order, first[1:]):
        mine = rng.choice(members, min(_SAMPLE, members.size), replace=False)
        distance = squareform(pdist(observations.pixel[mine])).reshape(mine.size, mine.size)
        np.fill_diagonal(distance, np.inf)
        bin_of = np.digitize(distance, edges) - 1
        inside = bin_of < edges.size - 1
        both = residual[mine] @ residual[mine].T / 2
        product += np.bincount(bin_of[inside], both[inside], minlength=edges.size - 1)
        counts += np.bincount(bin_of[inside], minlength=edges.size - 1)
        samples.append((bin_of, inside))
    variance = float(np.mean(residual[order] ** 2))
    correlation = np.clip(product / np.maximum(counts, 1) / variance, 0.0, 1.0)
    correlation[correlation < 2 / np.sqrt(np.maximum(counts, 1))] = 0.0
    n_observations = np.bincount(observations.image)[photos]
    effects = [
        1 + (n - 1) * float(np.where(inside, correlation[np.minimum(bin_of, middle.size - 1)], 0.0).mean())
        for n, (bin_of, inside) in zip(n_observations, samples, strict=True)
    ]
    return PixelCorrelation(middle, correlation, float(np.mean(effects)))


def point_uncertainty(adjustment: Adjustment, points: IntArray) -> PointUncertainty:
    """
    Uncertainty of some points of an adjustment, usually those of one flight.

    Parameters
    ----------
    adjustment : Adjustment
    points : array of int
        Their numbers.
    """
    arrays = point_arrays(adjustment, points)
    covariances: Any = point_covariances
    own, shared = covariances(*arrays, adjustment.camera_covariance)
    place = adjustment.points[points]
    modes = _modes(adjustment.camera_covariance)
    design, centre = _design(place)
    fits, left = _fits_of_modes(adjustment, points, design, modes)
    systematic = _systematic(centre, fits, float(np.mean(left[0])))
    after_plane, after_bend = np.sqrt(left)
    return PointUncertainty(np.sqrt(own[:, 2, 2]), after_plane, after_bend, own + shared, systematic)


def flight_difference(adjustment: Adjustment, earlier: IntArray, later: IntArray) -> SystematicError:
    """
    Error that the height difference of two flights adjusted together has everywhere alike.

    Parameters
    ----------
    adjustment : Adjustment
        Of both flights.
    earlier, later : array of int
        Numbers of the points of each.

    Notes
    -----
    What the flights share, such as their common place on the Earth, cancels.
    """
    modes = _modes(adjustment.camera_covariance)
    design, centre = _design(np.concatenate([adjustment.points[earlier], adjustment.points[later]]))
    first, left_first = _fits_of_modes(adjustment, earlier, design[: earlier.size], modes)
    second, left_second = _fits_of_modes(adjustment, later, design[earlier.size :], modes)
    fits = [b - a for a, b in zip(first, second, strict=True)]
    return _systematic(centre, fits, float(np.mean(left_first[0]) + np.mean(left_second[0])))


def height_design(east: FloatArray, north: FloatArray) -> FloatArray:
    """Offset, tilt and bending of heights: columns 1, e, n, e^2, e n, n^2 of places about a middle, shape (n, 6)."""
    return np.column_stack([np.ones(east.size), east, north, east**2, east * north, north**2])


def point_arrays(adjustment: Adjustment, points: IntArray) -> tuple[Any, ...]:
    """Arguments of the kernels for some points, with their observations alone."""
    chosen = np.zeros(len(adjustment.points), dtype=bool)
    chosen[points] = True
    mask: BoolArray = chosen[adjustment.observations.point]
    part, kept = adjustment.observations.keep(mask, min_views=1)
    b = adjustment.block
    return (
        adjustment.points[kept], b.rotation, b.position, b.intrinsics, b.lens,
        part.start, part.image, part.pixel, adjustment.weight[mask],
    )  # fmt: skip


def _modes(covariance: FloatArray) -> FloatArray:
    """Matrix F with F F^T the covariance; directions without variance are left out."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    kept = values > 1e-10 * max(float(values[-1]), 1e-300)
    return np.ascontiguousarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _design(place: FloatArray) -> tuple[FloatArray, tuple[float, float]]:
    centre = (float(np.mean(place[:, 0])), float(np.mean(place[:, 1])))
    return height_design(place[:, 0] - centre[0], place[:, 1] - centre[1]), centre


def _systematic(centre: tuple[float, float], fits: Sequence[FloatArray], variance: float) -> SystematicError:
    plane, bent = fits
    bend_std = np.sqrt(np.sum(bent[3:] ** 2, axis=1))
    return SystematicError(centre, plane @ plane.T, float(np.sqrt(variance)), bend_std)


def _fits_of_modes(
    adjustment: Adjustment, points: IntArray, design: FloatArray, modes: FloatArray
) -> tuple[list[FloatArray], FloatArray]:
    """
    Fit offset and tilt, and these with bending, to every mode.

    Returns
    -------
    fits : list of arrays, shape (3, n_modes) and (6, n_modes)
    left : array, shape (2, n), m^2
        Variance of each point's height that either does not explain.
    """
    spread = np.unique(np.linspace(0, points.size - 1, min(points.size, _SAMPLE_POINTS)).astype(np.int64))
    heights: Any = coordinate_modes
    sampled = heights(*point_arrays(adjustment, points[spread]), modes, 2)
    fits = [np.asarray(np.linalg.lstsq(design[spread, :k], sampled, rcond=None)[0]) for k in (3, 6)]
    left = np.empty((2, points.size))
    for part in (slice(k, k + _CHUNK) for k in range(0, points.size, _CHUNK)):
        moves = heights(*point_arrays(adjustment, points[part]), modes, 2)
        for row, fit in zip(left, fits, strict=True):
            row[part] = np.sum((moves - design[part, : len(fit)] @ fit) ** 2, axis=1)
    return fits, left
