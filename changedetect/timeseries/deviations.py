"""
One shared surface of all epochs, and each epoch's deviation from it.

The two-epoch estimator of `changedetect.differencing.shared_surface` for any number of epochs: epoch e observes
f0 + d_e + noise. f0 follows the terrain with a fine kernel and is learned from all epochs together; the deviations
have a wider kernel of their own, the same for all epochs, so that smoothing bias is common to them. Only differences of
deviations mean anything: a constant could be moved from f0 to all d_e.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from changedetect.differencing.shared_surface import (
    CHANGE_KERNEL,
    CHANGE_SHRINKAGE,
    EDGE_KERNEL,
    LOPSIDED,
    POOL_FIELDS,
    SHARED_KERNEL,
    SPACING,
    is_observed,
    is_surrounded,
    value_variance,
)
from changedetect.kernels.receptive_fields import N_PLANE
from changedetect.models.cells import Cells, merge_cells
from changedetect.models.pyramid import N_MINIMUM, CellPyramid, Lattice, Level, build_level, fit_lattice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.typing import BoolArray, FloatArray, Region

__all__ = ["CellSource", "EpochCells", "LocalDeviation", "SharedSurface", "estimate_deviation", "learn_shared_surface"]

#: Gives the evidence of one epoch, weights 1 / variance of an observation; called once a round, so that no more than
#: one epoch need be in memory.
CellSource: TypeAlias = Callable[[], Cells]

#: Rounds of alternation between the shared surface and the deviations; a third moves a step by less than 0.1 %.
_ROUNDS = 2


@dataclass(frozen=True)
class EpochCells:
    """
    Evidence of one epoch.

    Attributes
    ----------
    load : callable
        Gives the cells.
    kernel : float, m
        The finest that the density of the epoch supports.
    """

    load: CellSource
    kernel: float


@dataclass(frozen=True)
class SharedSurface:
    """
    What all epochs have in common.

    Attributes
    ----------
    height : float, m
        Level that elevations are counted from.
    levels : tuple of Level
        Coarse to fine, each on what the coarser left over; their sum is f0.
    kernel : float, m
        Common kernel of the deviations.
    """

    height: float
    levels: tuple[Level, ...]
    kernel: float

    def taken_off(self, cells: Cells) -> Cells:
        """Moments of what is left over the surface; where a level is not defined nothing is taken off."""
        level = np.zeros((len(cells), 3))
        level[:, 0] = self.height
        left = cells.with_surface_removed(level)
        for fields in self.levels:
            left = left.with_surface_removed(fields.blend(*left.places))
        return left

    def terrain(self, lattice: Lattice) -> tuple[FloatArray, FloatArray]:
        """Elevation, m, and slope, rise over run, on a lattice of output cells."""
        total = np.zeros((lattice.n_rows * lattice.n_columns, 3))
        for fields in self.levels:
            total += fields.blend(*lattice.centres())[:, :3]
        slope = np.hypot(total[:, 1], total[:, 2]).reshape(lattice.shape)
        return self.height + total[:, 0].reshape(lattice.shape), slope


@dataclass(frozen=True)
class LocalDeviation:
    """
    Deviation of one epoch from the shared surface on output cells, row 0 in the south.

    Attributes
    ----------
    value, variance : array, shape (n_rows, n_columns), m, m2
        NaN value where too few observations are near. The variance is that of independent errors.
    freedom : array
        Degrees of freedom of the variance.
    count : array
        Effective number of observations.
    observed : array, bool
        Where the epoch's observations surround the place.
    """

    value: FloatArray
    variance: FloatArray
    freedom: FloatArray
    count: FloatArray
    observed: BoolArray


def learn_shared_surface(epochs: Sequence[EpochCells], region: Region) -> SharedSurface:
    """
    Learn the surface that all epochs share.

    Parameters
    ----------
    epochs : sequence of EpochCells
        At least one.
    region : (west, east, south, north), m
        Ground of all epochs together.

    Returns
    -------
    shared : SharedSurface

    Notes
    -----
    In each round every epoch is moved by its own deviation, as far as that exceeds noise, before all are summed: else
    the surface follows whichever epoch has observations at a place. Moments are summed epoch by epoch, so that memory
    is that of one epoch and of the sum, and the cost is linear in the epochs.

    Where some epochs are much sparser than the densest, a coarse surface is learned from all, and a fine one from the
    dense epochs on what it leaves over.
    """
    finest = min(epoch.kernel for epoch in epochs)
    dense = [epoch for epoch in epochs if epoch.kernel < LOPSIDED * finest]
    common = CHANGE_KERNEL * max(epoch.kernel for epoch in dense)
    height = epochs[0].load().centred()[1]
    shared = SharedSurface(height, (), common)
    if len(dense) < len(epochs):
        coarse = SHARED_KERNEL * max(epoch.kernel for epoch in epochs)
        shared = SharedSurface(height, (_surface(_summed(epochs, shared, None), region, coarse),), common)
    changes: list[Level] | None = None
    found = shared
    for k in range(_ROUNDS):
        if k > 0:
            changes = [_change(found.taken_off(epoch.load()), region, common) for epoch in dense]
        fine = _surface(_summed(dense, shared, changes), region, SHARED_KERNEL * finest)
        found = SharedSurface(height, (*shared.levels, fine), common)
    return found


def _summed(epochs: Sequence[EpochCells], shared: SharedSurface, changes: Sequence[Level] | None) -> Cells:
    """What all epochs leave over a surface, each moved by its deviation."""
    total: Cells | None = None
    for k, epoch in enumerate(epochs):
        left = shared.taken_off(epoch.load())
        if changes is not None:
            left = left.with_surface_removed(changes[k].blend(*left.places))
        total = left if total is None else merge_cells([total, left])
    if total is None:
        msg = "a shared surface needs at least one epoch"
        raise ValueError(msg)
    return total


def _surface(cells: Cells, region: Region, kernel: float) -> Level:
    lattice = Lattice.covering(region, kernel, SPACING * kernel)
    return build_level(CellPyramid(cells).for_kernel(kernel), lattice, 0.0, None)[0]


def _change(left: Cells, region: Region, kernel: float) -> Level:
    """Local planes of what an epoch leaves over the shared surface, shrunk to what exceeds noise."""
    lattice = Lattice.covering(region, kernel, SPACING * kernel)
    fits = fit_lattice(CellPyramid(left).for_kernel(kernel), lattice)
    seen = is_observed(fits)
    variance = value_variance(fits, POOL_FIELDS)[0]
    squared = np.where(seen, fits[..., 0] ** 2, 0.0)
    share = np.maximum(0.0, 1.0 - CHANGE_SHRINKAGE * variance / np.maximum(squared, 1e-300))
    planes = np.zeros((N_PLANE, *lattice.shape))
    for k, scale in enumerate((1.0, kernel, kernel)):
        planes[k] = np.where(seen, share * fits[..., k], 0.0) / scale
    planes[4] = seen
    return Level(lattice, planes)


def estimate_deviation(
    shared: SharedSurface, epoch: EpochCells, lattice: Lattice
) -> tuple[LocalDeviation, LocalDeviation]:
    """
    Deviation of an epoch from the shared surface, with the common kernel and with half of it.

    Parameters
    ----------
    shared : SharedSurface
    epoch : EpochCells
        A much sparser epoch than the others has a kernel of its own: what it says is smoother.
    lattice : Lattice
        Output cells; only its spacing and extent matter.

    Returns
    -------
    wide, narrow : LocalDeviation
        The narrow one is for the edges of change.
    """
    cells = epoch.load()
    observed = is_surrounded(cells, epoch.kernel, lattice)
    left = shared.taken_off(cells)
    wide = max(shared.kernel, CHANGE_KERNEL * epoch.kernel)
    narrow = EDGE_KERNEL / CHANGE_KERNEL * wide
    return _deviation(left, wide, lattice, observed), _deviation(left, narrow, lattice, observed)


def _deviation(left: Cells, kernel: float, lattice: Lattice, observed: BoolArray) -> LocalDeviation:
    output = Lattice(kernel, lattice.spacing, lattice.first_row, lattice.first_column, *lattice.shape)
    fits = fit_lattice(CellPyramid(left).for_kernel(kernel), output)
    reach = max(3, round(4.0 * kernel / lattice.spacing) | 1)
    variance, freedom = value_variance(fits, reach)
    value = np.where(fits[..., 10] >= N_MINIMUM, fits[..., 0], np.nan)
    return LocalDeviation(value, variance, freedom, fits[..., 10], observed)
