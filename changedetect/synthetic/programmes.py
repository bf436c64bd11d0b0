"""Monitoring programmes with known truth, and the benchmark pairs."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from changedetect.grid import Grid
from changedetect.synthetic.patches import Rectangle
from changedetect.synthetic.scenes import dem_scene, demo_scene, patch_scene
from changedetect.synthetic.surfaces import SurfaceSum, rasterize
from changedetect.synthetic.surveys import CorrelatedError, SurveyDesign, SurveyErrors, survey_dem, survey_points

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.synthetic.scenes import Scene
    from changedetect.synthetic.surveys import DemSurvey, Survey
    from changedetect.typing import BoolArray, FloatArray

__all__ = [
    "BenchmarkCase",
    "EpochPlan",
    "SimulatedEpoch",
    "SimulatedProgramme",
    "TrueVolume",
    "benchmark_dems",
    "benchmark_points",
    "demo_programme",
    "simulate_programme",
]

BenchmarkCase: TypeAlias = Literal["independent", "correlated", "heteroscedastic"]

#: Seed of the demonstration programme as it is committed.
DEMO_SEED = 20240315


@dataclass(frozen=True)
class EpochPlan:
    """When and how a scene is to be surveyed."""

    date: date
    design: SurveyDesign


@dataclass(frozen=True, kw_only=True)
class SimulatedEpoch:
    """
    One survey epoch of a simulated programme.

    Attributes
    ----------
    epoch_id : str
        The date, ISO 8601.
    date : datetime.date
    survey : Survey
    """

    epoch_id: str
    date: date
    survey: Survey


@dataclass(frozen=True, kw_only=True)
class TrueVolume:
    """Material moved between two epochs, m3: `fill` >= 0, `cut` <= 0, `net` = fill + cut."""

    fill: float
    cut: float

    @property
    def net(self) -> float:
        """Fill plus cut, m3."""
        return self.fill + self.cut


@dataclass(frozen=True, kw_only=True)
class SimulatedProgramme:
    """
    The surveys of a scene in order of time, with the truth on any grid.

    Attributes
    ----------
    scene : Scene
        Epoch k surveyed its stage k.
    epochs : tuple of SimulatedEpoch
    """

    scene: Scene
    epochs: tuple[SimulatedEpoch, ...]

    def grid(self, resolution: float) -> Grid:
        """Grid over the scene's region, in its CRS."""
        return Grid.from_region(self.scene.region, resolution, self.scene.crs)

    def true_elevation(self, grid: Grid, epoch: int) -> FloatArray:
        """Elevation at the cell centres when epoch number `epoch` was surveyed, shape (n_rows, n_cols), m."""
        return rasterize(self.scene.elevation_at(epoch), grid)

    def true_change(self, grid: Grid, earlier: int, later: int) -> FloatArray:
        """Later minus earlier at the cell centres, shape (n_rows, n_cols), m."""
        return rasterize(SurfaceSum(self.scene.changes_between(earlier, later)), grid)

    def is_covered(self, grid: Grid, epoch: int) -> BoolArray:
        """Whether the cell centres lie outside the gaps of an epoch, shape (n_rows, n_cols)."""
        return self.epochs[epoch].survey.is_covered(*grid.coordinates()).reshape(grid.shape)

    def true_volume(self, earlier: int, later: int, *, resolution: float = 0.1) -> TrueVolume:
        """
        Volumes moved between two epochs, by the midpoint rule on a grid of `resolution` m.

        Notes
        -----
        For the smooth changes of the demonstration the rule is good to 0.01 % at 0.1 m; vertical edges cost up to
        height x perimeter x resolution / 2 where they do not lie on cell borders.
        """
        change = self.true_change(self.grid(resolution), earlier, later)
        return TrueVolume(
            fill=float(np.maximum(change, 0.0).sum()) * resolution**2,
            cut=float(np.minimum(change, 0.0).sum()) * resolution**2,
        )


def simulate_programme(scene: Scene, plans: Sequence[EpochPlan], *, random_seed: int = 0) -> SimulatedProgramme:
    """
    Survey every stage of a scene in turn.

    Parameters
    ----------
    scene : Scene
    plans : sequence of EpochPlan
        One for each stage of the scene, dates ascending.
    random_seed : int
        Epoch k uses the stream (random_seed, k): adding an epoch changes no other.

    Returns
    -------
    programme : SimulatedProgramme

    Raises
    ------
    ValueError
        The number of plans differs from that of the stages, or the dates do not ascend.
    """
    if len(plans) != scene.n_stages:
        msg = f"A scene of {scene.n_stages} stages needs as many epochs; got {len(plans)} plans."
        raise ValueError(msg)
    dates = [plan.date for plan in plans]
    if any(later <= earlier for earlier, later in itertools.pairwise(dates)):
        msg = f"The dates of the epochs must ascend; got {', '.join(day.isoformat() for day in dates)}."
        raise ValueError(msg)
    epochs = tuple(
        SimulatedEpoch(
            epoch_id=plan.date.isoformat(),
            date=plan.date,
            survey=survey_points(scene, plan.design, [random_seed, k], stage=k),
        )
        for k, plan in enumerate(plans)
    )
    return SimulatedProgramme(scene=scene, epochs=epochs)


def demo_programme(random_seed: int = DEMO_SEED, *, density: float = 9.0) -> SimulatedProgramme:
    """
    Return the demonstration: three epochs of `demo_scene`, the second one with a gap over unchanged ground.

    Parameters
    ----------
    random_seed : int
    density : float, points per m2

    Returns
    -------
    programme : SimulatedProgramme
        Epochs 2024-03-15, 2024-09-10 and 2025-03-20.

    Examples
    --------
    >>> programme = demo_programme()
    >>> [epoch.epoch_id for epoch in programme.epochs]
    ['2024-03-15', '2024-09-10', '2025-03-20']
    >>> round(programme.true_volume(0, 1).fill, 1)
    153.6
    """
    scene = demo_scene(random_seed)
    west, _, south, _ = scene.region
    gap = Rectangle((west + 14.0, south + 13.0), length=9.0, width=12.0, azimuth_deg=15.0)
    full, with_gap = SurveyDesign(density=density), SurveyDesign(density=density, gaps=(gap,))
    plans = [
        EpochPlan(date(2024, 3, 15), full),
        EpochPlan(date(2024, 9, 10), with_gap),
        EpochPlan(date(2025, 3, 20), full),
    ]
    return simulate_programme(scene, plans, random_seed=random_seed)


def benchmark_points(
    random_seed: int, *, density: float, case: BenchmarkCase = "independent", side: float = 100.0
) -> tuple[Survey, Survey]:
    """
    Two point surveys of `patch_scene`, before and after its patches changed.

    Parameters
    ----------
    random_seed : int
        Draws ground, places of the patches, direction of the misregistration, points and noise.
    density : float, points per m2
    case : "independent" or "correlated"
        Independent noise of 5 cm; or, on top, an error of 2 cm over 10 m in each survey and a misregistration of
        3.6 cm horizontally and 1 cm vertically of the later one.
    side : float, m

    Returns
    -------
    earlier, later : Survey
    """
    scene = patch_scene([random_seed, 0], side=side, patch_side=0.2 * side)
    if case == "independent":
        errors = (SurveyErrors(), SurveyErrors())
    elif case == "correlated":
        errors = _correlated_pair(random_seed, CorrelatedError(0.02, 10.0), horizontal=0.036, up=0.01)
    else:
        msg = f"Unknown case {case!r} of the point benchmark; use 'independent' or 'correlated'."
        raise ValueError(msg)
    earlier = survey_points(scene, SurveyDesign(density=density, errors=errors[0]), [random_seed, 1], stage=0)
    later = survey_points(scene, SurveyDesign(density=density, errors=errors[1]), [random_seed, 2], stage=1)
    return earlier, later


def benchmark_dems(
    random_seed: int, *, size: int = 2000, resolution: float = 1.0, case: BenchmarkCase = "independent"
) -> tuple[DemSurvey, DemSurvey]:
    """
    Two rasters of `dem_scene`, before and after its patches changed.

    Parameters
    ----------
    random_seed : int
    size : int
        Rows and columns.
    resolution : float, m
    case : "independent", "correlated" or "heteroscedastic"
        Independent noise of 5 cm; or, on top, an error of 5 cm over 30 cells in each raster and a displacement of the
        later one by 0.8 cells and 0.3 m; or, also, white noise that grows with slope.

    Returns
    -------
    earlier, later : DemSurvey
    """
    if case not in ("independent", "correlated", "heteroscedastic"):
        msg = f"Unknown case {case!r} of the raster benchmark; use 'independent', 'correlated' or 'heteroscedastic'."
        raise ValueError(msg)
    side = size * resolution
    scene = dem_scene([random_seed, 0], side=side, relief_std=side / 40.0, is_noise_steeper=case == "heteroscedastic")
    grid = Grid.from_region(scene.region, resolution, scene.crs)
    if case == "independent":
        errors = (SurveyErrors(), SurveyErrors())
    else:
        field = CorrelatedError(0.05, 30.0 * resolution)
        errors = _correlated_pair(random_seed, field, horizontal=0.8 * resolution, up=0.3)
    earlier = survey_dem(scene, grid, errors[0], [random_seed, 1], stage=0)
    later = survey_dem(scene, grid, errors[1], [random_seed, 2], stage=1)
    return earlier, later


def _correlated_pair(
    random_seed: int, field: CorrelatedError, *, horizontal: float, up: float
) -> tuple[SurveyErrors, SurveyErrors]:
    """Both surveys carry an error field; the later one is displaced in a random direction."""
    direction = np.random.default_rng([random_seed, 3]).uniform(0.0, 2.0 * np.pi)
    shift = (horizontal * float(np.cos(direction)), horizontal * float(np.sin(direction)), up)
    return SurveyErrors(correlated=(field,)), SurveyErrors(correlated=(field,), shift=shift)
