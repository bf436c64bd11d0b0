"""
The difference of two epochs as a surface of its own beside one shared surface.

The later epoch is modelled as f0 + d + noise, the earlier as f0 + noise. f0 follows the terrain with a fine kernel and
is learned from both epochs together; what it leaves over is flat, so the kernel of d may be wide, the noise is found
right, and smoothing bias is common to both epochs and cancels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter

from changedetect.kernels.receptive_fields import N_PLANE
from changedetect.models.cells import merge_cells
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

__all__ = ["LocalDifference", "estimate_difference"]

#: Rounds of alternation between f0 and d; the third changes neither by more than 1 % of the noise.
_ROUNDS = 3
#: Kernel of the thinner epoch against the denser one's from which the shared surface follows the denser epoch alone:
#: the thinner one has little to add, and what it adds would have to be taken off again.
_LOPSIDED = 2.0
#: Squared change in noise variances that is not yet taken for one: moving an epoch by a change that is noise makes the
#: shared surface follow it, and the noise returns enlarged (sd of z 1.02-1.17 instead of 0.98-1.03).
_CHANGE_SHRINKAGE = 4.0
#: Fields along the edge of the window over which a field's noise is pooled: four kernels.
_POOL_FIELDS = 5
#: Kernel of f0 in the finest the denser epoch supports. With 1.0 f0 follows the noise and 7 % of unchanged cells were
#: flagged at 9 observations a m2; with 1.4 it was 5.2 %.
_SHARED_KERNEL = 2.0**0.5
#: Kernel of d in the finest the thinner epoch supports.
_CHANGE_KERNEL = 2.0**1.5
#: The same at the edges of change.
_EDGE_KERNEL = 2.0**0.5
#: Standard deviations by which a wide and a narrow estimate must differ to count as an edge.
_CONTRADICTION = 3.0
#: Area over which a field averages, in squared kernels: n_eff = 20/9 pi h2 per unit density for the bisquare kernel.
FIELD_AREA = 20.0 / 9.0 * np.pi
_SPACING = 0.8


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
    """

    difference: FloatArray
    variance: FloatArray
    freedom: FloatArray
    counts: tuple[FloatArray, FloatArray]
    observed: tuple[BoolArray, BoolArray]
    kernel: float
    terrain: tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class _Estimate:
    difference: FloatArray
    variance: FloatArray
    freedom: FloatArray
    counts: tuple[FloatArray, FloatArray]


def _joint_region(earlier: Cells, later: Cells) -> Region:
    a, b = earlier.region, later.region
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def _surface(cells: Cells, region: Region, kernel: float) -> Level:
    level, _ = build_level(
        CellPyramid(cells).for_kernel(kernel), Lattice.covering(region, kernel, _SPACING * kernel), 0.0, None
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
    lattice = Lattice.covering(region, kernel, _SPACING * kernel)
    a, b = (fit_lattice(CellPyramid(cells).for_kernel(kernel), lattice) for cells in (earlier, later))
    both = _is_observed(a) & _is_observed(b)
    planes = np.zeros((N_PLANE, *lattice.shape))
    variance = _value_variance(a, _POOL_FIELDS)[0] + _value_variance(b, _POOL_FIELDS)[0]
    squared = np.where(both, (b[..., 0] - a[..., 0]) ** 2, 0.0)
    share = np.maximum(0.0, 1.0 - _CHANGE_SHRINKAGE * variance / np.maximum(squared, 1e-300))
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
    fine = _SHARED_KERNEL * min(kernels)
    wide = _CHANGE_KERNEL * max(kernels)
    change: Level | None = None
    left: tuple[Cells, Cells] = (earlier, later)
    is_lopsided = max(kernels) >= _LOPSIDED * min(kernels)
    for _ in range(1 if is_lopsided else _ROUNDS):
        if is_lopsided:
            shared = _surface(earlier if kernels[0] < kernels[1] else later, region, fine)
        else:
            moved = later if change is None else _without(later, change)
            shared = _surface(merge_cells([earlier, moved]), region, fine)
        left = (_without(earlier, shared), _without(later, shared))
        change = _change(*left, region, wide)
    return _sharpened(
        _estimate(left, wide, lattice),
        _estimate(left, _EDGE_KERNEL * max(kernels), lattice),
        (_is_surrounded(earlier, kernels[0], lattice), _is_surrounded(later, kernels[1], lattice)),
        wide,
        _terrain(shared, lattice, height),
    )


def _terrain(shared: Level, lattice: Lattice, height: float) -> tuple[FloatArray, FloatArray]:
    """Elevation, counted from `height`, and slope of the shared surface on the output cells."""
    blended = shared.blend(*lattice.centres())
    slope = np.hypot(blended[:, 1], blended[:, 2])
    return height + blended[:, 0].reshape(lattice.shape), slope.reshape(lattice.shape)


def _estimate(left: tuple[Cells, Cells], kernel: float, lattice: Lattice) -> _Estimate:
    """Difference of the local planes of what two epochs leave over, with one kernel for both."""
    output = Lattice(kernel, lattice.spacing, lattice.first_row, lattice.first_column, *lattice.shape)
    fits = [fit_lattice(CellPyramid(cells).for_kernel(kernel), output) for cells in left]
    reach = max(3, round(4.0 * kernel / lattice.spacing) | 1)
    variances, freedoms = zip(*(_value_variance(fit, reach) for fit in fits), strict=True)
    variance = variances[0] + variances[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = variance**2 / (variances[0] ** 2 / freedoms[0] + variances[1] ** 2 / freedoms[1])
    usable = (fits[0][..., 10] >= N_MINIMUM) & (fits[1][..., 10] >= N_MINIMUM)
    return _Estimate(
        np.where(usable, fits[1][..., 0] - fits[0][..., 0], np.nan),
        variance,
        freedom,
        (fits[0][..., 10], fits[1][..., 10]),
    )


def _sharpened(
    wide: _Estimate,
    narrow: _Estimate,
    observed: tuple[BoolArray, BoolArray],
    kernel: float,
    terrain: tuple[FloatArray, FloatArray],
) -> LocalDifference:
    """
    The wide estimate, but the narrow one where the two contradict each other: at the edges of change.

    The wide kernel's data hold the narrow one's, so the variance of their difference is about the difference of their
    variances; beyond three standard deviations of it the wide kernel has smeared an edge (Lepski's rule).
    """
    spread = np.maximum(narrow.variance - wide.variance, 0.0)
    with np.errstate(invalid="ignore"):
        is_edge = (narrow.difference - wide.difference) ** 2 > _CONTRADICTION**2 * spread
    is_edge &= np.isfinite(narrow.difference)

    def chosen(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.where(is_edge, a, b)

    return LocalDifference(
        difference=chosen(narrow.difference, wide.difference),
        variance=chosen(narrow.variance, wide.variance),
        freedom=chosen(narrow.freedom, wide.freedom),
        counts=(chosen(narrow.counts[0], wide.counts[0]), chosen(narrow.counts[1], wide.counts[1])),
        observed=observed,
        kernel=kernel,
        terrain=terrain,
    )


def _is_observed(fits: FloatArray) -> BoolArray:
    observed: BoolArray = (fits[..., 10] >= N_MINIMUM) & (fits[..., 13] <= CENTROID_LIMIT)
    return observed


def _is_surrounded(cells: Cells, finest: float, lattice: Lattice) -> BoolArray:
    """Where an epoch's observations surround a place closely, by the same rule as for its surface."""
    kernel = SUPPORT_KERNELS * finest
    surrounded: BoolArray = support(CellPyramid(cells).for_kernel(kernel), lattice, kernel)[0] > 0.0
    return surrounded


def _value_variance(fits: FloatArray, reach: int) -> tuple[FloatArray, FloatArray]:
    """
    Variance of the local value and its degrees of freedom.

    The window of 4 x 4 kernels holds 16 h2 / 7 h2 = 2.3 times the effective number of observations of one field.
    """
    usable = (fits[..., 10] >= N_MINIMUM) & (fits[..., 12] > 0.0)
    residual = uniform_filter(np.where(usable, fits[..., 11], 0.0), reach, mode="constant")
    freedom = uniform_filter(np.where(usable, fits[..., 12], 0.0), reach, mode="constant")
    factor = residual / np.maximum(freedom, 1e-12)
    return np.maximum(factor, 1e-12) * fits[..., 3], np.maximum(2.3 * (fits[..., 10] - 3.0), 1.0)
