"""A pyramid of receptive fields: local planes from coarse to fine, each level on what the coarser ones left over."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from changedetect.kernels.receptive_fields import (
    N_FIT,
    N_PLANE,
    add_surface,
    blend_planes,
    fit_planes,
    pool_noise,
    shrink_planes,
    survey_support,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from changedetect.models.cells import Cells
    from changedetect.typing import FloatArray, Region

__all__ = ["CellPyramid", "Lattice", "Level", "build_level", "noise_variance", "refine", "scale_bank", "windows"]

#: Radius of the blending kernel in lattice spacings. While levels add up, wide: weights w / Gamma then let the fields
#: win that lie on one side of an edge. For the finished surface narrow: one field for one place.
_LEVEL_REACH = 2.0
_SURFACE_REACH = 1.5
#: Effective number of observations below which a plane is not fitted.
N_MINIMUM = 4.0
#: A field whose observations' centroid lies further from its centre than this many kernels extrapolates.
CENTROID_LIMIT = 0.75
#: Kernel, in the finest kernels an epoch's density supports, within which observations must surround a place.
SUPPORT_KERNELS = 2.0
#: Lattice steps on every side over which the noise variance is pooled.
NOISE_REACH = 3
#: Lattice steps along the edge of the window, applied twice, over which the typical detail of a level is averaged.
_DETAIL_WINDOW = 15
#: Lattice steps over which the prior variance of detail is pooled: of 0.7, 1.2 and 2.0 the last had the least error on
#: dense and on sparse data.
_PRIOR_REACH = 2.0
#: A squared coefficient counts at most this many noise variances, so that an edge does not sway the ground beside it.
_RATIO_LIMIT = 100.0
#: Detail of a level against that of the next coarser one, at most: 2**(-H) is 0.7 for ground as rough as a random walk.
_LARGEST_DETAIL_RATIO = 0.8
#: Largest cells, in kernels, from which a field is computed: the plane inside a cell is exact, its activation is not.
_CELL_LIMIT = 0.7
#: Receptive fields along one edge of a block of work; bounds memory and changes no result.
_BLOCK_FIELDS = 512


@dataclass(frozen=True)
class Lattice:
    """
    A block of the square lattice of receptive fields of one level.

    Attributes
    ----------
    kernel : float, m
        Kernel size h of the fields.
    spacing : float, m
    first_row, first_column, n_rows, n_columns : int
        Field (i, j) has its centre at easting (first_column + j + 1/2) * spacing, northing likewise.
    """

    kernel: float
    spacing: float
    first_row: int
    first_column: int
    n_rows: int
    n_columns: int

    @classmethod
    def covering(cls, region: Region, kernel: float, spacing: float) -> Lattice:
        """Fields over a region and two spacings beyond it."""
        west, east, south, north = region
        first_row = math.floor(south / spacing) - 2
        first_column = math.floor(west / spacing) - 2
        n_rows = math.ceil(north / spacing) + 2 - first_row
        n_columns = math.ceil(east / spacing) + 2 - first_column
        return cls(kernel, spacing, first_row, first_column, n_rows, n_columns)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of fields."""
        return self.n_rows, self.n_columns

    def centres(self) -> tuple[FloatArray, FloatArray]:
        """Easting and northing of the field centres, m, row by row."""
        easting = (self.first_column + np.arange(self.n_columns) + 0.5) * self.spacing
        northing = (self.first_row + np.arange(self.n_rows) + 0.5) * self.spacing
        grid = np.meshgrid(easting, northing)
        return grid[0].ravel(), grid[1].ravel()


@dataclass(frozen=True)
class Level:
    """
    Receptive fields of one level and how far each is blended.

    Attributes
    ----------
    lattice : Lattice
    planes : array, shape (N_PLANE, n_rows, n_columns)
    reach : float
        Radius of the blending kernel, lattice spacings.
    disagreement : float
        Share of the variance between neighbouring fields that adds to the variance: 1 for a finished surface, whose
        smoothing bias it shows; 0 for the levels it is made of, whose bias the next level takes away.
    """

    lattice: Lattice
    planes: FloatArray
    reach: float = _SURFACE_REACH
    disagreement: float = 1.0

    def blend(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at places of shape (n,): array (n, 8), see `blend_planes`."""
        blended = np.empty((easting.size, 8))
        lattice = self.lattice
        blend_planes(
            np.ascontiguousarray(easting), np.ascontiguousarray(northing), self.planes, lattice.spacing,
            lattice.first_row, lattice.first_column, self.reach, self.disagreement, blended,
        )  # fmt: skip
        return blended

    def add_to(self, easting: FloatArray, northing: FloatArray, surface: FloatArray) -> None:
        """Add value and slopes at places of shape (n,) to an array (n, 3); nothing where no field answers."""
        lattice = self.lattice
        # undefined planes may hold anything; their weight is 0
        fields = np.where(self.planes[4] > 0.0, self.planes[[4, 0, 1, 2]], 0.0)
        add_surface(
            np.ascontiguousarray(easting), np.ascontiguousarray(northing),
            np.ascontiguousarray(np.moveaxis(fields, 0, -1)), lattice.spacing, lattice.first_row,
            lattice.first_column, self.reach, surface,
        )  # fmt: skip


class CellPyramid:
    """
    The same moments over cells of doubling size, made when first asked for.

    Parameters
    ----------
    cells : Cells
        The finest.
    """

    def __init__(self, cells: Cells) -> None:
        self._sizes = [cells]

    def for_kernel(self, kernel: float) -> Cells:
        """Coarsest cells of at most `_CELL_LIMIT` kernels, or the finest there are."""
        k = max(0, math.floor(math.log2(_CELL_LIMIT * kernel / self._sizes[0].cell_size)))
        while len(self._sizes) <= k:
            self._sizes.append(self._sizes[-1].coarsened())
        return self._sizes[k]


def scale_bank(finest: float, coarsest: float, ratio: float) -> list[float]:
    """Kernel sizes, m, coarse to fine, each `ratio` times the next and ending with `finest`."""
    n = max(0, math.ceil(math.log(coarsest / finest) / math.log(ratio) - 1e-9))
    return [finest * ratio**k for k in range(n, -1, -1)]


def windows(
    cells: Cells, lattice: Lattice, radius: float
) -> Iterator[tuple[tuple[slice, slice], FloatArray, int, int]]:
    """
    Blocks of a lattice with the cells around them; blocks bound the memory and change no result.

    Parameters
    ----------
    cells : Cells
    lattice : Lattice
    radius : float, m
        How far beyond its centre a field sees.

    Yields
    ------
    part : (slice, slice)
        Rows and columns of the fields of this block.
    window : array, shape (n, m, N_MOMENTS)
        Moments of the cells that these fields see.
    row, column : int
        Lattice indices of the window's first cell.
    """
    c = cells.cell_size
    for i in range(0, lattice.n_rows, _BLOCK_FIELDS):
        for j in range(0, lattice.n_columns, _BLOCK_FIELDS):
            part = (
                slice(i, min(i + _BLOCK_FIELDS, lattice.n_rows)),
                slice(j, min(j + _BLOCK_FIELDS, lattice.n_columns)),
            )
            south = (lattice.first_row + part[0].start) * lattice.spacing - radius
            west = (lattice.first_column + part[1].start) * lattice.spacing - radius
            north = (lattice.first_row + part[0].stop) * lattice.spacing + radius
            east = (lattice.first_column + part[1].stop) * lattice.spacing + radius
            rows = (math.floor(south / c), math.floor(north / c) + 1)
            columns = (math.floor(west / c), math.floor(east / c) + 1)
            yield part, cells.window(c, rows, columns), rows[0], columns[0]


def _walk_blocks(
    kernel_function: Callable[..., None], cells: Cells, lattice: Lattice, results: FloatArray
) -> FloatArray:
    """Run a kernel over all fields of a lattice, block by block."""
    for part, window, row, column in windows(cells, lattice, 2.0 * lattice.kernel):
        kernel_function(
            window, cells.cell_size, row, column, lattice.kernel, lattice.spacing,
            lattice.first_row + part[0].start, lattice.first_column + part[1].start, results[part],
        )  # fmt: skip
    return results


def fit_lattice(cells: Cells, lattice: Lattice) -> FloatArray:
    """
    Local planes of all fields of a lattice.

    Parameters
    ----------
    cells : Cells
        Weights are 1 / variance.
    lattice : Lattice

    Returns
    -------
    fits : array, shape (n_rows, n_columns, N_FIT)
    """
    return _walk_blocks(fit_planes, cells, lattice, np.zeros((*lattice.shape, N_FIT)))


def noise_variance(cells: Cells, kernel: float, spacing: float) -> Level:
    """
    Variance of an observation of unit weight, as a surface.

    Parameters
    ----------
    cells : Cells
        Weights are 1, or 1 / sigma**2 as stated by the source.
    kernel : float, m
        Small against what bends the ground.
    spacing : float, m

    Returns
    -------
    level : Level
        Its values are variances: m2 for weights of one, else the factor by which the stated variances are off.
    """
    cells, _ = cells.centred()
    lattice = Lattice.covering(cells.region, kernel, spacing)
    fits = fit_lattice(cells, lattice)
    usable = (fits[..., 10] >= N_MINIMUM + 1.0) & (fits[..., 12] > 0.0)
    wider = kernel
    while not usable.any() and wider < 1e4 * kernel:
        wider *= 2.0
        fits = fit_lattice(cells, Lattice.covering(cells.region, wider, spacing))
        lattice = Lattice.covering(cells.region, wider, spacing)
        usable = (fits[..., 10] >= N_MINIMUM + 1.0) & (fits[..., 12] > 0.0)
    typical = float(np.median(fits[usable][:, 11] / fits[usable][:, 12])) if usable.any() else 1.0
    # neighbouring windows share most of their fields: every other one will do
    wide = Lattice.covering(cells.region, lattice.kernel, 2.0 * lattice.spacing)
    row, column = 2 * wide.first_row - lattice.first_row, 2 * wide.first_column - lattice.first_column
    pooled = np.empty(wide.shape)
    pool_noise(fits, row, column, NOISE_REACH, N_MINIMUM + 1.0, typical, pooled)
    planes = np.zeros((N_PLANE, *wide.shape))
    planes[0] = np.maximum(pooled, 1e-4 * typical + 1e-12)
    planes[4] = 1.0
    return Level(wide, planes)


def _detail_variance(fits: FloatArray, base: FloatArray) -> FloatArray:
    """Typical variance of what a level adds to the coarser surface, averaged over a neighbourhood; m2."""
    usable = (fits[..., 9] > 0.0) & (fits[..., 10] >= N_MINIMUM) & (base[1] > 0.0)
    if not usable.any():
        return np.zeros(usable.shape)
    excess = np.where(usable, fits[..., 0] ** 2 - np.maximum(fits[..., 3] - base[0], 0.0), 0.0)
    weight = usable.astype(np.float64)
    overall = excess.sum() / weight.sum()

    def smooth(values: FloatArray) -> FloatArray:
        # a triangle in each direction: as good as a Gaussian and its cost does not grow with the window
        for _ in range(2):
            values = uniform_filter(values, _DETAIL_WINDOW, mode="constant")
        return values

    local: FloatArray = np.maximum((smooth(excess) + 1e-3 * overall) / (np.maximum(smooth(weight), 0.0) + 1e-3), 0.0)
    return local


def _prior_variance(fits: FloatArray, shrinkage: float) -> FloatArray:
    """
    Variance of the true values and slopes of a level's planes, pooled over the neighbourhood; m2.

    The squares of fitted coefficients exceed their noise variance C by that variance. Pooled with weights 1 / C, so
    that well-determined planes speak for the others, it is (mean(b^2 / C) - c) / mean(1 / C).
    """
    prior = np.full((2, *fits.shape[:2]), np.inf)
    if shrinkage == 0.0:
        return prior
    fitted = (fits[..., 9] > 0.0) & (fits[..., 10] >= N_MINIMUM)

    def smooth(values: FloatArray) -> FloatArray:
        filled = np.where(fitted, values, 0.0)
        smoothed: FloatArray = gaussian_filter(filled, _PRIOR_REACH, truncate=2.5, mode="constant")
        return smoothed

    mass = smooth(np.ones(fitted.shape))
    squares = fits[..., :3] ** 2
    noise = np.where(fitted[..., None], np.maximum(fits[..., (3, 6, 8)], 1e-14), 1.0)
    ratio = np.minimum(squares / noise, _RATIO_LIMIT)
    for k, part in enumerate((slice(0, 1), slice(1, 3))):
        excess = smooth(ratio[..., part].mean(axis=-1)) - shrinkage * mass
        precision = smooth((1.0 / noise[..., part]).mean(axis=-1))
        prior[k] = np.where(fitted, np.maximum(excess, 0.0) / np.where(fitted, precision, 1.0), 0.0)
    return prior


def build_level(cells: Cells, lattice: Lattice, shrinkage: float, coarser: Level | None) -> tuple[Level, FloatArray]:
    """
    Receptive fields of one kernel size on what the coarser levels left over.

    Parameters
    ----------
    cells : Cells
        Moments of the residuals, of a size that suits the kernel.
    lattice : Lattice
        Fields to fit.
    shrinkage : float
    coarser : Level or None
        None makes this the base: planes are taken as fitted.

    Returns
    -------
    level : Level
        Values are this level's share, the variance is that of the sum of all levels so far.
    detail : array, shape (n_rows, n_columns), m2
        Typical variance of that share around there.
    """
    base = np.zeros((2, *lattice.shape))
    if coarser is not None:
        at_centres = coarser.blend(*lattice.centres())
        base[0] = at_centres[:, 3].reshape(lattice.shape)
        base[1] = at_centres[:, 7].reshape(lattice.shape)
    fits = fit_lattice(cells, lattice)
    planes = np.zeros((N_PLANE, *lattice.shape))
    prior = _prior_variance(fits, shrinkage)
    detail = _detail_variance(fits, base)
    shrink_planes(fits, base, prior, detail, lattice.kernel, N_MINIMUM, planes)
    return Level(lattice, planes, _LEVEL_REACH, 0.0), detail


def _unresolved_variance(levels: list[Level], details: list[FloatArray]) -> FloatArray:
    """
    Variance of what still finer levels would add, on the finest lattice; m2.

    Detail shrinks from level to level; continued as a geometric series t r + t r**2 + ... with the ratio r of the last
    two levels there, which on self-similar ground is exact.
    """
    finest = levels[-1].lattice
    if len(levels) < 2:
        return np.zeros(finest.shape)
    last, coarser = details[-1], levels[-2].lattice
    easting, northing = finest.centres()
    row = np.clip(np.floor(northing / coarser.spacing).astype(np.int64) - coarser.first_row, 0, coarser.n_rows - 1)
    column = np.clip(
        np.floor(easting / coarser.spacing).astype(np.int64) - coarser.first_column, 0, coarser.n_columns - 1
    )
    before = details[-2][row, column].reshape(finest.shape)
    ratio = np.minimum(last / np.maximum(before, 1e-12), _LARGEST_DETAIL_RATIO)
    unresolved: FloatArray = last * ratio / (1.0 - ratio)
    return unresolved


def refine(
    cells: Cells, kernels: tuple[float, ...], lattice_spacing: float, shrinkage: float
) -> tuple[Level, FloatArray]:
    """
    A pyramid of receptive fields, summed into the fields of its finest level.

    Parameters
    ----------
    cells : Cells
        Finest moments.
    kernels : tuple of float, m
        Coarse to fine.
    lattice_spacing : float
        In kernels.
    shrinkage : float

    Returns
    -------
    level : Level
        Each field holds value, slope and variance of the sum of all levels at its centre, so that a prediction costs
        the same however many levels there are.
    unresolved : array, shape (n_rows, n_columns), m2
        Variance of detail too fine for these kernels; not part of the level's variance.
    """
    if len(cells) == 0:
        msg = "a pyramid needs at least one occupied cell"
        raise ValueError(msg)
    region = cells.region
    cells, height = cells.centred()
    sizes = CellPyramid(cells)
    levels: list[Level] = []
    details: list[FloatArray] = []
    suited = cells
    places, removed, n_removed = cells.places, np.zeros((len(cells), 3)), 0
    for kernel in kernels:
        if sizes.for_kernel(kernel) is not suited:
            suited = sizes.for_kernel(kernel)
            places, removed, n_removed = suited.places, np.zeros((len(suited), 3)), 0
        for level in levels[n_removed:]:
            level.add_to(*places, removed)
        n_removed = len(levels)
        left = suited.with_surface_removed(removed)
        lattice = Lattice.covering(region, kernel, lattice_spacing * kernel)
        level, detail = build_level(left, lattice, shrinkage, levels[-1] if levels else None)
        levels.append(level)
        details.append(detail)
    finest = levels[-1]
    places = finest.lattice.centres()
    total = np.zeros((places[0].size, 3))
    for level in levels:
        level.add_to(*places, total)
    planes = finest.planes.copy()
    planes[:3] = total.T.reshape(3, *finest.lattice.shape)
    planes[0] += height
    planes[4] = planes[4] > 0.0
    return Level(finest.lattice, planes), _unresolved_variance(levels, details)


def support(cells: Cells, lattice: Lattice, kernel: float) -> FloatArray:
    """
    Where observations surround the field centres of a lattice.

    Parameters
    ----------
    cells : Cells
    lattice : Lattice
        Places to judge.
    kernel : float, m
        Observations within two kernels count.

    Returns
    -------
    judged : array, shape (4, n_rows, n_columns)
        1 where there are enough observations on all sides, else 0; mean time of these observations, days; mean noise
        variance of one of them, m2; 1 where there are enough, if only on one side.
    """
    wide = Lattice(kernel, lattice.spacing, lattice.first_row, lattice.first_column, *lattice.shape)
    found = _walk_blocks(survey_support, cells, wide, np.zeros((*lattice.shape, 4)))
    judged = np.empty((4, *lattice.shape))
    judged[3] = found[..., 0] >= N_MINIMUM
    judged[0] = (judged[3] > 0.0) & (found[..., 1] <= CENTROID_LIMIT)
    judged[1] = found[..., 2]
    judged[2] = found[..., 3]
    return judged
