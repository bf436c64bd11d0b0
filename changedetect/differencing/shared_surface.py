"""
The difference of two epochs as a surface of its own beside one shared surface.

The later epoch is modelled as f0 + d + noise, the earlier as f0 + noise. f0 follows the terrain with a fine kernel and
is learned from both epochs together; what it leaves over is flat, so the kernel of d may be wide, the noise is found
right, and smoothing bias is common to both epochs and cancels.

Where one epoch is much coarser than the other, f0 is the denser one's surface, averaged over the ground that one
observation of the coarser epoch averages; see `footprint`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

from changedetect.differencing.resolution import FIELD_AREA, Resolution, supported_width
from changedetect.kernels.receptive_fields import N_PLANE
from changedetect.models.cells import merge_cells
from changedetect.models.footprint import average_surface, find_footprint
from changedetect.models.pyramid import (
    CENTROID_LIMIT,
    N_MINIMUM,
    SUPPORT_KERNELS,
    CellPyramid,
    Lattice,
    Level,
    build_level,
    fit_lattice,
    support,
)

if TYPE_CHECKING:
    from changedetect.models.cells import Cells
    from changedetect.typing import BoolArray, FloatArray, Region

__all__ = ["FIELD_AREA", "LocalDifference", "estimate_difference"]

#: Rounds of alternation between f0 and d; the third changes neither by more than 1 % of the noise.
_ROUNDS = 3
#: Kernel of the thinner epoch against the denser one's from which the shared surface follows the denser epoch alone:
#: the thinner one has little to add, and what it adds would have to be taken off again.
LOPSIDED = 2.0
#: Squared change in noise variances that is not yet taken for one: moving an epoch by a change that is noise makes the
#: shared surface follow it, and the noise returns enlarged (sd of z 1.02-1.17 instead of 0.98-1.03).
CHANGE_SHRINKAGE = 4.0
#: Fields along the edge of the window over which a field's noise is pooled: four kernels.
POOL_FIELDS = 5
#: Kernel of f0 in the finest the denser epoch supports. With 1.0 f0 follows the noise and 7 % of unchanged cells were
#: flagged at 9 observations a m2; with 1.4 it was 5.2 %.
SHARED_KERNEL = 2.0**0.5
#: Kernel of d in the finest the thinner epoch supports.
CHANGE_KERNEL = 2.0**1.5
#: The same at the edges of change.
EDGE_KERNEL = 2.0**0.5
#: Where the shared surface follows the denser epoch alone, nothing of d can enter it, and d may have a finer kernel.
LOPSIDED_EDGE_KERNEL = 1.0
#: Standard deviations by which a wide and a narrow estimate must differ to count as an edge.
CONTRADICTION = 3.0
SPACING = 0.8
#: Finest kernel that a density supports, in mean spacings of the observations.
KERNEL_OF_SPACING = 1.16


@dataclass(frozen=True)
class LocalDifference:
    """
    Difference on a lattice of output cells, row 0 in the south.

    Attributes
    ----------
    difference, variance : array, shape (n_rows, n_columns), m, m2
    freedom : array
        Degrees of freedom of the variance.
    counts : pair of array
        Effective numbers of observations, earlier and later.
    observed : pair of array, bool
    kernel : float, m
        Kernel size of the difference.
    terrain : pair of array, m, 1
        Elevation of the shared surface and its slope, rise over run; of no meaning where neither epoch has data.
    resolution : Resolution
    """

    difference: FloatArray
    variance: FloatArray
    freedom: FloatArray
    counts: tuple[FloatArray, FloatArray]
    observed: tuple[BoolArray, BoolArray]
    kernel: float
    terrain: tuple[FloatArray, FloatArray]
    resolution: Resolution


@dataclass(frozen=True)
class _Estimate:
    difference: FloatArray
    variance: FloatArray
    freedom: FloatArray
    counts: tuple[FloatArray, FloatArray]
    resolution: Resolution


@dataclass(frozen=True)
class _LeftOver:
    """What two epochs leave over the surface they share, and the ground one observation of each averages, m."""

    cells: tuple[Cells, Cells]
    shared: Level
    footprints: tuple[float, float]


def _joint_region(earlier: Cells, later: Cells) -> Region:
    a, b = earlier.region, later.region
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def _surface(cells: Cells, region: Region, kernel: float) -> Level:
    level, _ = build_level(
        CellPyramid(cells).for_kernel(kernel), Lattice.covering(region, kernel, SPACING * kernel), 0.0, None
    )
    return level


def _without(cells: Cells, level: Level, sign: float = 1.0) -> Cells:
    """Cells less sign * level; where the level is not defined nothing is taken off."""
    return cells.with_surface_removed(sign * level.blend(*cells.places))


def _change(earlier: Cells, later: Cells, region: Region, kernel: float) -> Level:
    """
    Difference of the local planes of what two epochs leave over the shared surface, shrunk to what exceeds noise.

    Only where both epochs surround a field: an extrapolated change would be taken off ground that one epoch alone saw
    and would grow from round to round.
    """
    lattice = Lattice.covering(region, kernel, SPACING * kernel)
    a, b = (fit_lattice(CellPyramid(cells).for_kernel(kernel), lattice) for cells in (earlier, later))
    both = is_observed(a) & is_observed(b)
    planes = np.zeros((N_PLANE, *lattice.shape))
    variance = value_variance(a, POOL_FIELDS)[0] + value_variance(b, POOL_FIELDS)[0]
    squared = np.where(both, (b[..., 0] - a[..., 0]) ** 2, 0.0)
    share = np.maximum(0.0, 1.0 - CHANGE_SHRINKAGE * variance / np.maximum(squared, 1e-300))
    for k, scale in enumerate((1.0, kernel, kernel)):
        planes[k] = np.where(both, share * (b[..., k] - a[..., k]), 0.0) / scale
    planes[4] = both
    return Level(lattice, planes)


def estimate_difference(
    earlier: Cells, later: Cells, kernels: tuple[float, float], lattice: Lattice
) -> LocalDifference:
    """
    Later minus earlier surface, its variance, and where both saw the ground.

    Parameters
    ----------
    earlier, later : Cells
        Evidence of the two epochs, weights 1 / variance of an observation.
    kernels : (earlier, later), m
        The finest that each epoch's density supports. The shared surface follows the denser epoch, the difference
        the thinner one.
    lattice : Lattice
        Output cells; only its spacing and extent matter.

    Returns
    -------
    result : LocalDifference

    Notes
    -----
    The variance of each epoch's local linear fit is that of its weights times a factor s2 = residual sum / degrees of
    freedom, both summed over a window of two kernels either side; observations are taken as independent.
    """
    region = _joint_region(earlier, later)
    earlier, height = earlier.centred()
    later = later.with_surface_removed(np.tile([height, 0.0, 0.0], (len(later), 1)))
    fine, wide = SHARED_KERNEL * min(kernels), CHANGE_KERNEL * max(kernels)
    factors: tuple[float, ...] = (CHANGE_KERNEL, EDGE_KERNEL)
    if max(kernels) >= LOPSIDED * min(kernels):
        left = _over_denser(earlier, later, kernels, fine)
        factors += (LOPSIDED_EDGE_KERNEL,)
    else:
        left = _over_both(earlier, later, region, (fine, wide))
    denser = earlier if kernels[0] < kernels[1] else later
    found = _estimate(left, factors[0], kernels, lattice, denser)
    for factor in factors[1:]:
        found = _sharpened(found, _estimate(left, factor, kernels, lattice, denser))
    return LocalDifference(
        difference=found.difference,
        variance=found.variance,
        freedom=found.freedom,
        counts=found.counts,
        observed=(is_surrounded(earlier, kernels[0], lattice), is_surrounded(later, kernels[1], lattice)),
        kernel=wide,
        terrain=_terrain(left.shared, lattice, height),
        resolution=found.resolution,
    )


def _over_both(earlier: Cells, later: Cells, region: Region, kernels: tuple[float, float]) -> _LeftOver:
    """Find the shared surface of both epochs and their difference, with kernels (of f0, of d), in turn."""
    change: Level | None = None
    for _ in range(_ROUNDS):
        moved = later if change is None else _without(later, change)
        shared = _surface(merge_cells([earlier, moved]), region, kernels[0])
        left = (_without(earlier, shared), _without(later, shared))
        change = _change(*left, region, kernels[1])
    return _LeftOver(left, shared, (0.0, 0.0))


def _over_denser(earlier: Cells, later: Cells, kernels: tuple[float, float], fine: float) -> _LeftOver:
    """
    Take the surface of the denser epoch alone for the shared one.

    Observations of the coarser one off that surface are left out: nothing can be taken off them, and their bare heights
    would count as change within the kernel's reach.
    """
    is_earlier = kernels[0] < kernels[1]
    dense, coarse = (earlier, later) if is_earlier else (later, earlier)
    shared = _surface(dense, dense.region, fine)

    def plane(easting: FloatArray, northing: FloatArray) -> FloatArray:
        blended = shared.blend(easting, northing)
        return np.where(blended[:, 7:] > 0.0, blended[:, :3], np.nan)

    footprint = find_footprint(coarse, plane, max(kernels) / KERNEL_OF_SPACING, fine)
    averaged = average_surface(plane, coarse.places, footprint, fine)
    left_dense = _without(dense, shared)
    left_coarse = coarse.select(averaged.known).with_surface_removed(averaged.surface[averaged.known])
    if is_earlier:
        return _LeftOver((left_dense, left_coarse), shared, (0.0, footprint))
    return _LeftOver((left_coarse, left_dense), shared, (footprint, 0.0))


def _terrain(shared: Level, lattice: Lattice, height: float) -> tuple[FloatArray, FloatArray]:
    """Elevation, counted from `height`, and slope of the shared surface on the output cells."""
    blended = shared.blend(*lattice.centres())
    slope = np.hypot(blended[:, 1], blended[:, 2])
    return height + blended[:, 0].reshape(lattice.shape), slope.reshape(lattice.shape)


def _estimate(
    left: _LeftOver, factor: float, kernels: tuple[float, float], lattice: Lattice, denser: Cells
) -> _Estimate:
    """Difference of the local planes of what two epochs leave over, with one kernel for both."""
    kernel = factor * max(kernels)
    output = Lattice(kernel, lattice.spacing, lattice.first_row, lattice.first_column, *lattice.shape)
    fits = [fit_lattice(CellPyramid(cells).for_kernel(kernel), output) for cells in left.cells]
    reach = max(3, round(4.0 * kernel / lattice.spacing) | 1)
    variances, freedoms = zip(*(value_variance(fit, reach) for fit in fits), strict=True)
    variance = variances[0] + variances[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = variance**2 / (variances[0] ** 2 / freedoms[0] + variances[1] ** 2 / freedoms[1])
    counts = (fits[0][..., 10], fits[1][..., 10])
    usable = (counts[0] >= N_MINIMUM) & (counts[1] >= N_MINIMUM)
    widths = [
        supported_width(factor * own, count, kernel, footprint)
        for own, count, footprint in zip(kernels, counts, left.footprints, strict=True)
    ]
    return _Estimate(
        np.where(usable, fits[1][..., 0] - fits[0][..., 0], np.nan),
        variance,
        freedom,
        counts,
        Resolution(widths[0], widths[1], _detail_std(denser, kernel, lattice), left.footprints),
    )


def _detail_std(cells: Cells, kernel: float, lattice: Lattice) -> FloatArray:
    """
    Standard deviation of the ground about planes within a kernel, m, on the output cells; noise is taken off.

    It varies over kernels, not cells: found on a lattice of fields and interpolated from there.
    """
    fields = Lattice.covering(cells.region, kernel, SPACING * kernel)
    fits = fit_lattice(CellPyramid(cells).for_kernel(kernel), fields)
    usable = (fits[..., 10] >= N_MINIMUM) & (fits[..., 12] > 0.0)
    weight = np.where(usable, fits[..., 9], 1.0)
    detail = np.where(usable, np.maximum(fits[..., 11] - fits[..., 12], 0.0) / weight, 0.0)
    rows = (np.arange(lattice.n_rows) + lattice.first_row + 0.5) * lattice.spacing / fields.spacing
    columns = (np.arange(lattice.n_columns) + lattice.first_column + 0.5) * lattice.spacing / fields.spacing
    places = np.meshgrid(rows - fields.first_row - 0.5, columns - fields.first_column - 0.5, indexing="ij")
    share, variance = (map_coordinates(a, places, order=1) for a in (usable.astype(np.float64), detail))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.where(share > 0.0, variance / share, np.nan)))


def _sharpened(wide: _Estimate, narrow: _Estimate) -> _Estimate:
    """
    Take the wide estimate, but the narrow one where the two contradict each other: at the edges of change.

    The wide kernel's data hold the narrow one's, so the variance of their difference is about the difference of their
    variances; beyond three standard deviations of it the wide kernel has smeared an edge (Lepski's rule).
    """
    spread = np.maximum(narrow.variance - wide.variance, 0.0)
    with np.errstate(invalid="ignore"):
        is_edge = (narrow.difference - wide.difference) ** 2 > CONTRADICTION**2 * spread
    is_edge &= np.isfinite(narrow.difference)

    def chosen(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.where(is_edge, a, b)

    return _Estimate(
        chosen(narrow.difference, wide.difference),
        chosen(narrow.variance, wide.variance),
        chosen(narrow.freedom, wide.freedom),
        (chosen(narrow.counts[0], wide.counts[0]), chosen(narrow.counts[1], wide.counts[1])),
        Resolution(
            chosen(narrow.resolution.earlier, wide.resolution.earlier),
            chosen(narrow.resolution.later, wide.resolution.later),
            chosen(narrow.resolution.unresolved_std, wide.resolution.unresolved_std),
            wide.resolution.footprints,
        ),
    )


def is_observed(fits: FloatArray) -> BoolArray:
    observed: BoolArray = (fits[..., 10] >= N_MINIMUM) & (fits[..., 13] <= CENTROID_LIMIT)
    return observed


def is_surrounded(cells: Cells, finest: float, lattice: Lattice) -> BoolArray:
    """Where an epoch's observations surround a place closely, by the same rule as for its surface."""
    kernel = SUPPORT_KERNELS * finest
    surrounded: BoolArray = support(CellPyramid(cells).for_kernel(kernel), lattice, kernel)[0] > 0.0
    return surrounded


def value_variance(fits: FloatArray, reach: int) -> tuple[FloatArray, FloatArray]:
    """
    Variance of the local value and its degrees of freedom.

    The window of 4 x 4 kernels holds 16 h2 / 7 h2 = 2.3 times the effective number of observations of one field.
    """
    usable = (fits[..., 10] >= N_MINIMUM) & (fits[..., 12] > 0.0)
    residual = uniform_filter(np.where(usable, fits[..., 11], 0.0), reach, mode="constant")
    freedom = uniform_filter(np.where(usable, fits[..., 12], 0.0), reach, mode="constant")
    factor = residual / np.maximum(freedom, 1e-12)
    return np.maximum(factor, 1e-12) * fits[..., 3], np.maximum(2.3 * (fits[..., 10] - 3.0), 1.0)
