"""Observing a scene: where points fall, which errors they carry, and what is missing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from changedetect.pointcloud import PointCloud
from changedetect.synthetic.surfaces import SurfaceSum
from changedetect.synthetic.terrain import correlated_field

if TYPE_CHECKING:
    from changedetect.grid import Grid
    from changedetect.synthetic.patches import Footprint
    from changedetect.synthetic.scenes import Scene, Seed
    from changedetect.synthetic.surfaces import Surface
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["CorrelatedError", "DemSurvey", "Survey", "SurveyDesign", "SurveyErrors", "survey_dem", "survey_points"]


@dataclass(frozen=True)
class CorrelatedError:
    """An error field of a whole survey, normal with `std` m and Gaussian covariance over `length` m."""

    std: float
    length: float


@dataclass(frozen=True, kw_only=True)
class SurveyErrors:
    """
    What is wrong with a survey beyond chance.

    Attributes
    ----------
    white_scale : float
        Factor on the scene's white noise; 0 switches it off.
    correlated : tuple of CorrelatedError
        Fields drawn anew for every survey; they add.
    shift : (east, north, up), m
        Misregistration: every measured position is displaced by this.
    outlier_share : float, 0 to 1
        Part of the observations that are gross errors.
    outlier_std : float, m
        Standard deviation of a gross error, on top of the rest.
    """

    white_scale: float = 1.0
    correlated: tuple[CorrelatedError, ...] = field(default=())
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    outlier_share: float = 0.0
    outlier_std: float = 5.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.outlier_share <= 1.0:
            msg = f"The share of outliers must lie between 0 and 1; got {self.outlier_share!r}."
            raise ValueError(msg)


@dataclass(frozen=True, kw_only=True)
class SurveyDesign:
    """
    Where a survey's points fall.

    Attributes
    ----------
    density : float, points per m2
        Mean over the scene's region, before gaps.
    density_ratio : float
        Density at the eastern border over that at the western border; it changes linearly.
    gaps : tuple of Footprint
        No point falls inside.
    is_sigma_reported : bool
        Whether the cloud carries the standard deviation of each point's white noise.
    errors : SurveyErrors
    """

    density: float
    density_ratio: float = 1.0
    gaps: tuple[Footprint, ...] = field(default=())
    is_sigma_reported: bool = False
    errors: SurveyErrors = field(default=SurveyErrors())

    def __post_init__(self) -> None:
        if not (self.density > 0.0 and self.density_ratio > 0.0):
            msg = f"Density and density ratio must be positive; got {self.density!r} and {self.density_ratio!r}."
            raise ValueError(msg)


@dataclass(frozen=True, kw_only=True)
class Survey:
    """
    One simulated acquisition and the truth behind it.

    Attributes
    ----------
    cloud : PointCloud
        As measured: displaced, noisy, with gaps, in the scene's CRS.
    scene : Scene
    stage : int
        State of the ground that was surveyed.
    design : SurveyDesign
    correlated_error : Surface
        The error fields that were drawn, at true positions, m.
    is_outlier : array, shape (n,), bool
    """

    cloud: PointCloud
    scene: Scene
    stage: int
    design: SurveyDesign
    correlated_error: Surface
    is_outlier: BoolArray

    def surface(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """True elevation at the surveyed stage, shape (n,), m."""
        return self.scene.surface(easting, northing, self.stage)

    def noise_std(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Standard deviation of this survey's white noise, shape (n,), m."""
        return self.design.errors.white_scale * self.scene.noise_std(easting, northing)

    def is_covered(self, easting: FloatArray, northing: FloatArray) -> BoolArray:
        """Whether positions lie in the region and in no gap, shape (n,)."""
        west, east, south, north = self.scene.region
        inside = (easting >= west) & (easting <= east) & (northing >= south) & (northing <= north)
        return inside & ~_in_gaps(self.design.gaps, easting, northing)


@dataclass(frozen=True, kw_only=True)
class DemSurvey:
    """
    One simulated elevation raster.

    Attributes
    ----------
    elevation : array, shape (n_rows, n_cols), m
        As measured; NaN in gaps. Row 0 in the north.
    grid : Grid
    scene : Scene
    stage : int
    errors : SurveyErrors
    """

    elevation: FloatArray
    grid: Grid
    scene: Scene
    stage: int
    errors: SurveyErrors


def survey_points(scene: Scene, design: SurveyDesign, random_seed: Seed, *, stage: int = 0) -> Survey:
    """
    Survey a scene with scattered points.

    Parameters
    ----------
    scene : Scene
    design : SurveyDesign
    random_seed : int, sequence of int or Generator
        Positions, noise, error fields and outliers have streams of their own: changing the errors moves no point.
    stage : int

    Returns
    -------
    survey : Survey
    """
    for_positions, for_noise, for_fields, for_outliers = np.random.default_rng(random_seed).spawn(4)
    easting, northing = _positions(scene, design, for_positions)
    errors = design.errors
    white_std = errors.white_scale * scene.noise_std(easting, northing)
    fields = _error_fields(scene, errors, for_fields)
    elevation = scene.surface(easting, northing, stage) + white_std * for_noise.normal(size=easting.size)
    elevation += fields(easting, northing)
    is_outlier = for_outliers.uniform(size=easting.size) < errors.outlier_share
    elevation[is_outlier] += for_outliers.normal(0.0, errors.outlier_std, int(is_outlier.sum()))
    cloud = PointCloud(
        easting=easting + errors.shift[0],
        northing=northing + errors.shift[1],
        elevation=elevation + errors.shift[2],
        sigma=white_std if design.is_sigma_reported else None,
    )
    return Survey(cloud=cloud, scene=scene, stage=stage, design=design, correlated_error=fields, is_outlier=is_outlier)


def survey_dem(
    scene: Scene,
    grid: Grid,
    errors: SurveyErrors,
    random_seed: Seed,
    *,
    stage: int = 0,
    gaps: tuple[Footprint, ...] = (),
) -> DemSurvey:
    """
    Survey a scene as an elevation raster: one observation at every cell centre.

    Parameters
    ----------
    scene : Scene
    grid : Grid
    errors : SurveyErrors
        A cell shows the ground that lies `shift` back from its centre.
    random_seed : int, sequence of int or Generator
    stage : int
    gaps : tuple of Footprint

    Returns
    -------
    survey : DemSurvey
    """
    for_noise, for_fields, for_outliers = np.random.default_rng(random_seed).spawn(3)
    true_easting, true_northing = grid.easting - errors.shift[0], grid.northing - errors.shift[1]
    truth = scene.elevation_at(stage) + _error_fields(scene, errors, for_fields)
    white_std = errors.white_scale * scene.white_noise.on_axes(true_easting, true_northing)
    elevation = truth.on_axes(true_easting, true_northing) + errors.shift[2]
    elevation += white_std * for_noise.normal(size=grid.shape)
    is_outlier = for_outliers.uniform(size=grid.shape) < errors.outlier_share
    elevation[is_outlier] += for_outliers.normal(0.0, errors.outlier_std, int(is_outlier.sum()))
    if gaps:
        elevation[_in_gaps(gaps, *grid.coordinates()).reshape(grid.shape)] = np.nan
    return DemSurvey(elevation=elevation, grid=grid, scene=scene, stage=stage, errors=errors)


def _positions(scene: Scene, design: SurveyDesign, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Uniform to the north, with a linear density to the east, drawn by inverting its distribution function."""
    west, east, south, north = scene.region
    n_points = round(design.density * scene.area)
    u = rng.uniform(size=n_points)
    northing = south + (north - south) * rng.uniform(size=n_points)
    # density 1 + s t on t in (0, 1): F(t) = (t + s t^2 / 2) / (1 + s / 2), inverted without cancellation at s = 0
    s = design.density_ratio - 1.0
    area = u * (1.0 + 0.5 * s)
    easting = west + (east - west) * (2.0 * area / (1.0 + np.sqrt(1.0 + 2.0 * s * area)))
    keep = ~_in_gaps(design.gaps, easting, northing)
    return easting[keep], northing[keep]


def _error_fields(scene: Scene, errors: SurveyErrors, rng: np.random.Generator) -> SurfaceSum:
    return SurfaceSum(
        tuple(
            correlated_field(scene.region, rng, std=error.std, correlation_length=error.length)
            for error in errors.correlated
        )
    )


def _in_gaps(gaps: tuple[Footprint, ...], easting: FloatArray, northing: FloatArray) -> BoolArray:
    inside = np.zeros(easting.shape, dtype=np.bool_)
    for gap in gaps:
        inside |= gap.contains(easting, northing)
    return inside
