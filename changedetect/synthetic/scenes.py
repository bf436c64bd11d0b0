"""A site with known ground, noise and changes, and ready-made sites."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from changedetect.synthetic.noise import CanopyNoise, EastwardNoise, SlopeNoise
from changedetect.synthetic.patches import ChangePatch, Ellipse, Rectangle, ScarpRetreat
from changedetect.synthetic.surfaces import Constant, Plane, Surface, SurfaceSum
from changedetect.synthetic.terrain import (
    Channel,
    DuneCrests,
    Scarp,
    analytic_ground,
    fractal_ground,
    random_trees,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.synthetic.patches import Change
    from changedetect.typing import FloatArray, IntArray, Region

__all__ = ["Scene", "Seed", "coast_scene", "dem_scene", "demo_scene", "patch_scene", "trees_scene"]

Seed: TypeAlias = "int | Sequence[int] | np.random.Generator"

#: Orthometric heights on UTM zone 32 N: what a monitoring programme in the Alps or on the North Sea would use.
DEFAULT_CRS = "EPSG:32632+5773"
#: South-west corner of the ready-made sites, m: magnitudes at which careless arithmetic shows.
_CORNER = (500_000.0, 5_300_000.0)
#: Changes of the benchmark scenes, m: two that anything finds, four that take a good test.
_BENCHMARK_HEIGHTS = (0.5, -0.5, 0.10, 0.05, 0.02, -0.20)
_DEM_HEIGHTS = (0.5, -0.5, 0.20, 0.10, 0.05, -0.20)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """
    The truth about a site: elevation at every stage, noise of an observation, changes between stages.

    Attributes
    ----------
    region : (west, east, south, north), m
        What surveys cover; the truth is defined everywhere.
    ground : Surface
        Elevation at stage 0.
    white_noise : Surface
        Standard deviation of an observation's independent error, m.
    changes : tuple of tuple of Change
        `changes[k]` happened between stage k and stage k + 1, and stays.
    crs : str
        Horizontal and vertical.

    Examples
    --------
    >>> scene = demo_scene(7)
    >>> scene.n_stages
    3
    >>> scene.change(np.array([500_017.0]), np.array([5_300_041.0]), earlier=0, later=1)
    array([0.5])
    """

    region: Region
    ground: Surface
    white_noise: Surface
    changes: tuple[tuple[Change, ...], ...] = field(default=())
    crs: str = DEFAULT_CRS

    @property
    def n_stages(self) -> int:
        """Number of different states of the ground."""
        return len(self.changes) + 1

    @property
    def area(self) -> float:
        """Area of the region, m2."""
        west, east, south, north = self.region
        return (east - west) * (north - south)

    def changes_between(self, earlier: int, later: int) -> tuple[Change, ...]:
        """
        All changes after stage `earlier` up to stage `later`.

        Raises
        ------
        ValueError
            The stages do not exist or are not in order.
        """
        if not 0 <= earlier <= later < self.n_stages:
            msg = f"Stages must satisfy 0 <= earlier <= later < {self.n_stages}; got {earlier} and {later}."
            raise ValueError(msg)
        return tuple(change for step in self.changes[earlier:later] for change in step)

    def elevation_at(self, stage: int) -> Surface:
        """Elevation at a stage as one surface."""
        return SurfaceSum((self.ground, *self.changes_between(0, stage)))

    def surface(self, easting: FloatArray, northing: FloatArray, stage: int = 0) -> FloatArray:
        """True elevation at points, shape (n,), m."""
        return self.elevation_at(stage)(easting, northing)

    def noise_std(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Standard deviation of an observation's independent error at points, shape (n,), m."""
        return self.white_noise(easting, northing)

    def change(self, easting: FloatArray, northing: FloatArray, earlier: int = 0, later: int = 1) -> FloatArray:
        """True elevation at stage `later` minus that at stage `earlier`, shape (n,), m."""
        return SurfaceSum(self.changes_between(earlier, later))(easting, northing)

    def change_labels(
        self, easting: FloatArray, northing: FloatArray, *, margin: float, earlier: int = 0, later: int = 1
    ) -> IntArray:
        """
        Which change a point lies in, away from all borders, for scoring.

        Parameters
        ----------
        easting, northing : array, shape (n,), m
        margin : float, m
            At least the radius of the estimator's kernel.
        earlier, later : int
            Stages.

        Returns
        -------
        label : array, shape (n,), int64
            0 where nothing changed within `margin`, k where the point lies at least `margin` inside
            `changes_between(earlier, later)[k - 1]` alone, -1 near borders and where changes overlap.
        """
        label = np.zeros(easting.shape, dtype=np.int64)
        for k, change in enumerate(self.changes_between(earlier, later), start=1):
            distance = change.distance(easting, northing)
            label[distance < margin] = np.where(
                (label == 0)[distance < margin] & (distance <= -margin)[distance < margin], k, -1
            )
        return label


def trees_scene(
    random_seed: Seed,
    *,
    side: float = 60.0,
    corner: tuple[float, float] = _CORNER,
    n_trees: int = 14,
    tree_height: tuple[float, float] = (4.0, 12.0),
    relief_std: float = 2.5,
) -> Scene:
    """
    Fractal ground with trees and noise that grows to the east: hard on stationary models.

    Parameters
    ----------
    random_seed : int, sequence of int or Generator
    side : float, m
    corner : (west, south), m
    n_trees : int
    tree_height : (lowest, highest), m
    relief_std : float, m

    Returns
    -------
    scene : Scene
        Noise 0.15 + 0.6 (e / side)^2 m, with e from the west, and 0.5 m more on trees.
    """
    rng = np.random.default_rng(random_seed)
    region = _square(corner, side)
    trees = random_trees(region, rng, n_trees=n_trees, height=tree_height)
    return Scene(
        region=region,
        ground=fractal_ground(region, rng, relief_std=relief_std) + trees,
        white_noise=EastwardNoise(corner[0], side, at_west=0.15, growth=0.6) + CanopyNoise(trees, 0.5),
    )


def patch_scene(
    random_seed: Seed,
    *,
    side: float = 100.0,
    corner: tuple[float, float] = _CORNER,
    patch_side: float = 20.0,
    heights: tuple[float, ...] = _BENCHMARK_HEIGHTS,
    noise_std: float = 0.05,
) -> Scene:
    """
    Analytic ground on which square patches change, each by its own height, at random places.

    Parameters
    ----------
    random_seed : int, sequence of int or Generator
    side : float, m
    corner : (west, south), m
    patch_side : float, m
    heights : tuple of float, m
        One per patch; vertical edges.
    noise_std : float, m
    """
    rng = np.random.default_rng(random_seed)
    region = _square(corner, side)
    return Scene(
        region=region,
        ground=analytic_ground(region, rng),
        white_noise=Constant(noise_std),
        changes=(_random_patches(region, rng, patch_side, heights),),
    )


def dem_scene(
    random_seed: Seed,
    *,
    side: float = 2000.0,
    corner: tuple[float, float] = _CORNER,
    relief_std: float = 50.0,
    heights: tuple[float, ...] = _DEM_HEIGHTS,
    noise_std: float = 0.05,
    is_noise_steeper: bool = False,
) -> Scene:
    """
    Mountain-sized fractal ground for rasters, with square patches of a tenth of the side that change.

    Parameters
    ----------
    random_seed : int, sequence of int or Generator
    side : float, m
    corner : (west, south), m
    relief_std : float, m
    heights : tuple of float, m
    noise_std : float, m
        On level ground.
    is_noise_steeper : bool
        Whether the noise grows with slope, up to 4 times at 45 degrees.
    """
    rng = np.random.default_rng(random_seed)
    region = _square(corner, side)
    ground = Plane(corner, 600.0) + fractal_ground(region, rng, relief_std=relief_std, shortest=16.0)
    return Scene(
        region=region,
        ground=ground,
        white_noise=SlopeNoise(ground, noise_std) if is_noise_steeper else Constant(noise_std),
        changes=(_random_patches(region, rng, 0.1 * side, heights),),
    )


def coast_scene(random_seed: Seed, *, side: float = 120.0, corner: tuple[float, float] = _CORNER) -> Scene:
    """
    Dunes over a cliff that retreats twice, and a channel: directional ground and erosion.

    Parameters
    ----------
    random_seed : int, sequence of int or Generator
    side : float, m
    corner : (west, south), m

    Returns
    -------
    scene : Scene
        Three stages: the cliff retreats by 3 m, then by 2 m; a mound of 0.4 m grows in the north of the beach.
    """
    rng = np.random.default_rng(random_seed)
    region = _square(corner, side)
    west, south = corner
    cliff = Scarp((west + 0.35 * side, south), azimuth_deg=rng.uniform(-5.0, 5.0), height=4.0, width=1.5)
    retreated = cliff.retreated(3.0)
    dunes = DuneCrests((west + 0.6 * side, south), rng.uniform(10.0, 30.0), wavelength=18.0, height=1.2, wander=2.0)
    channel = Channel(
        (west + 0.15 * side, south), rng.uniform(-4.0, 4.0), depth=0.8, half_width=2.0, bank_width=3.0,
        meander_amplitude=3.0, meander_wavelength=0.5 * side,
    )  # fmt: skip
    beach = Plane(corner, 1.0, slope_east=0.02) + fractal_ground(region, rng, relief_std=0.3, shortest=4.0)
    mound = ChangePatch(Ellipse((west + 0.2 * side, south + 0.8 * side), 14.0, 9.0), 0.4, "mound")
    return Scene(
        region=region,
        ground=beach + cliff + dunes + channel,
        white_noise=Constant(0.05),
        changes=((ScarpRetreat(cliff, 3.0),), (ScarpRetreat(retreated, 2.0), mound)),
    )


def demo_scene(random_seed: Seed, *, corner: tuple[float, float] = _CORNER) -> Scene:
    """
    Return the site of the demonstration programme: 60 m x 60 m of gentle ground with a brook, three stages.

    Parameters
    ----------
    random_seed : int, sequence of int or Generator
        Draws the ground; the changes stand at fixed places.
    corner : (west, south), m

    Returns
    -------
    scene : Scene
        Noise 0.04 m. Between stage 0 and 1 a plateau of +0.50 m is filled (16 m x 16 m at full height), between 1
        and 2 a hollow of -0.30 m is eroded; a mound grows by 0.20 m in the first and 0.15 m in the second interval.
    """
    rng = np.random.default_rng(random_seed)
    region = _square(corner, 60.0)
    west, south = corner
    brook = Channel(
        (west + 31.0, south), 12.0, depth=0.7, half_width=1.0, bank_width=3.0,
        meander_amplitude=2.5, meander_wavelength=45.0,
    )  # fmt: skip
    ground = Plane((west + 30.0, south + 30.0), 432.0, slope_east=0.03, slope_north=-0.05)
    plateau = ChangePatch(Rectangle((west + 17.0, south + 41.0), 18.0, 18.0), 0.50, "plateau", edge=1.0)
    hollow = ChangePatch(Ellipse((west + 46.0, south + 17.0), 10.0, 7.0, 30.0), -0.30, "plateau", edge=2.5)
    accretion = Ellipse((west + 49.0, south + 47.0), 8.0, 6.0, 20.0)
    return Scene(
        region=region,
        ground=ground + fractal_ground(region, rng, relief_std=0.6, shortest=5.0) + brook,
        white_noise=Constant(0.04),
        changes=(
            (plateau, ChangePatch(accretion, 0.20, "mound")),
            (hollow, ChangePatch(accretion, 0.15, "mound")),
        ),
    )


def _square(corner: tuple[float, float], side: float) -> Region:
    west, south = corner
    return west, west + side, south, south + side


def _random_patches(
    region: Region, rng: np.random.Generator, patch_side: float, heights: tuple[float, ...]
) -> tuple[ChangePatch, ...]:
    """Squares that do not touch, at random places in the cells of a lattice, with the heights in random order."""
    west, east, south, north = region
    n_cols = int(np.ceil(np.sqrt(len(heights))))
    n_rows = -(-len(heights) // n_cols)
    room = np.array([(east - west) / n_cols, (north - south) / n_rows])
    play = 0.9 * room - patch_side
    if np.any(play < 0.0):
        msg = f"{len(heights)} patches of {patch_side:g} m do not fit apart into {region}; make them smaller or fewer."
        raise ValueError(msg)
    slots = rng.permutation(n_cols * n_rows)[: len(heights)]
    patches = []
    for slot, height in zip(slots, heights, strict=True):
        middle = (np.array([slot % n_cols, slot // n_cols]) + 0.5) * room + rng.uniform(-0.5, 0.5, 2) * play
        square = Rectangle((west + float(middle[0]), south + float(middle[1])), patch_side, patch_side)
        patches.append(ChangePatch(square, height, "box"))
    return tuple(patches)
