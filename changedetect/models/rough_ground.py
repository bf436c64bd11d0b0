"""
The finest detail of a surface: local Gaussian processes on what the receptive fields leave over.

Receptive fields of a few observations each average over them; on ground that is rough at the distance of the
observations, and well measured, that blurs more than it calms. There the finest levels of the pyramid give way to
the process that the left-over is around each place: its variance is found there, its correlation length is a
fixed share of the coarser fields' kernel, since what a smooth surface leaves over is as long as its kernel. On
sparse or very noisy ground the process falls back on the coarser surface by itself.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter

from changedetect.kernels.local_gp import N_LOCAL, local_processes, neighbour_products
from changedetect.kernels.receptive_fields import N_PLANE
from changedetect.models.pyramid import Lattice, Level, refine, windows

if TYPE_CHECKING:
    from collections.abc import Iterator

    from changedetect.models.cells import Cells
    from changedetect.typing import FloatArray, IntArray

__all__ = ["refine_by_processes"]

#: Kernels, in the finest one, of the levels that stay receptive fields.
_COARSE = 4.5
#: Correlation length in kernels of the finest of these; 0.2 and 0.4 cost 1 to 3 % on four of five surveys.
_CORRELATION_LENGTH = 0.3
#: Radius, in such kernels, within which cells take part.
_RADIUS = 1.0
#: Standard deviations, in lattice steps, of the windows over which the process's variance is found: some 40 cells, and
#: some 400 where the 40 do not differ from them by more than chance.
_NEAR, _WIDE = 2.6, 8.0
#: Weight of the survey as a whole, in cells, where the windows hold next to nothing.
_FEW = 1e-3
#: Leave-one-out errors, in standard deviations, beyond which a cell's noise is taken to be as large as its error.
_DOUBT = 5.0
#: Neighbours of a cell whose products with it are taken.
_N_NEIGHBOURS = 4
#: Degrees of freedom that variance is taken to have, at least.
_LEAST_FREEDOM = 4.0
#: Share of the variance between neighbouring coarse planes that is error: the blend of planes that differ because the
#: ground bends is much closer to it than they are. 0.02 and 0.1 on smooth ground; 1 makes no difference on rough one.
_COARSE_DISAGREEMENT = 0.1
#: Variance of the process, in mean squares of the left-over, at least: noise is not known better.
_SMALLEST = 0.02


def _field_of(cells: Cells, lattice: Lattice) -> tuple[IntArray, IntArray]:
    """Row and column of the field in whose square each cell's observations lie."""
    easting, northing = cells.places
    row = np.floor(northing / lattice.spacing).astype(np.int64) - lattice.first_row
    column = np.floor(easting / lattice.spacing).astype(np.int64) - lattice.first_column
    return np.clip(row, 0, lattice.n_rows - 1), np.clip(column, 0, lattice.n_columns - 1)


def process_variance(left: Cells, lattice: Lattice, length: float, radius: float) -> tuple[FloatArray, FloatArray]:
    """
    Variance of the true left-over around each field, and how well it is known.

    Parameters
    ----------
    left : Cells
        Moments of what is left over a coarse surface.
    lattice : Lattice
    length, radius : float, m
        Correlation length of the process, and how far neighbours lie.

    Returns
    -------
    variance : array, shape (n_rows, n_columns), m2
    freedom : array, shape (n_rows, n_columns)
        Its degrees of freedom: cells in the near window.

    Notes
    -----
    Least squares on products of neighbouring cells, t = sum(rho_ij z_i z_j) / sum(rho_ij**2), over a near and a wide
    window. The near one counts as far as it differs from the wide one by more than chance: with t - T the difference
    and s**2 its sampling variance, by 1 - s**2 / (t - T)**2.
    """
    row, column = _field_of(left, lattice)
    field = row * lattice.n_columns + column
    easting, northing = left.places
    mean = left.moments[:, 7] / left.moments[:, 1]
    products = np.empty((len(left), 2))
    for _, window, row0, column0, here in _blocks(left, lattice, radius, (row, column)):
        part = np.empty((here.size, 2))
        neighbour_products(
            window, left.cell_size, row0, column0, length, radius, np.ascontiguousarray(easting[here]),
            np.ascontiguousarray(northing[here]), _N_NEIGHBOURS, part,
        )  # fmt: skip
        products[here] = part

    def window_sum(values: FloatArray, reach: float) -> FloatArray:
        binned = np.bincount(field, values, lattice.n_rows * lattice.n_columns).reshape(lattice.shape)
        return np.asarray(gaussian_filter(binned, reach, truncate=3.0, mode="constant"), np.float64)

    product, mass, square = mean * products[:, 0], products[:, 1], mean**2
    few = _FEW * float(mass.mean())
    found = []
    for reach in (_NEAR, _WIDE):
        weight = window_sum(mass, reach) + few
        found.append((window_sum(product, reach) + few * max(float(product.sum() / mass.sum()), 0.0)) / weight)
    near, wide = found
    # a window of standard deviation r averages over 4 pi r**2 fields
    n_near = np.maximum(4.0 * math.pi * _NEAR**2 * window_sum(np.ones(len(left)), _NEAR), 1.0)
    total = (window_sum(square, _WIDE) + _FEW * square.mean()) / (window_sum(np.ones(len(left)), _WIDE) + _FEW)
    chance = 2.0 * total**2 / n_near
    difference = near - wide
    share = np.clip(1.0 - chance / np.maximum(difference**2, 1e-30), 0.0, 1.0)
    variance: FloatArray = np.maximum(wide + share * difference, _SMALLEST * total)
    return variance, n_near


def _blocks(
    left: Cells, lattice: Lattice, radius: float, field: tuple[IntArray, IntArray]
) -> Iterator[tuple[tuple[slice, slice], FloatArray, int, int, IntArray]]:
    """Yield the blocks of `windows`, and which cells lie in the squares of a block's fields."""
    row, column = field
    for part, window, row0, column0 in windows(left, lattice, radius + lattice.spacing):
        inside = (row >= part[0].start) & (row < part[0].stop) & (column >= part[1].start) & (column < part[1].stop)
        yield part, window, row0, column0, np.flatnonzero(inside)


def refine_by_processes(
    cells: Cells, kernels: tuple[float, ...], lattice_spacing: float, shrinkage: float
) -> tuple[Level, FloatArray]:
    """
    A surface of coarse receptive fields and local Gaussian processes on what they leave over.

    Parameters
    ----------
    cells : Cells
        Finest moments, with their noise variances.
    kernels : tuple of float, m
        Coarse to fine; the finest ones give the lattice only.
    lattice_spacing : float
        In kernels.
    shrinkage : float

    Returns
    -------
    level : Level
        Fields of the finest lattice, each with value, slope and variance of the surface at its centre.
    left_out : array, shape (m,), m2
        Squared error of the surface at every cell when that cell is left out: the noise of the cell's mean included.

    Notes
    -----
    With t the variance of the process, C its covariance with noise and k that with the place, the surface has variance
    t - k'C^-1 k + (1 - sum(C^-1 k))**2 v: of the coarse surface's variance v only that part counts which the
    observations nearby do not correct. The first part counts nu / (nu - 2) times, nu the degrees of freedom behind t:
    the variance of Student's t, which the error has where the variance of the process is itself an estimate.
    """
    coarse = tuple(k for k in kernels if k >= _COARSE * kernels[-1]) or kernels[:1]
    base = replace(refine(cells, coarse, lattice_spacing, shrinkage)[0], disagreement=_COARSE_DISAGREEMENT)
    left = cells.with_surface_removed(base.blend(*cells.places)[:, :3])
    lattice = Lattice.covering(cells.region, kernels[-1], lattice_spacing * kernels[-1])
    length, radius = _CORRELATION_LENGTH * coarse[-1], _RADIUS * coarse[-1]
    variance, freedom = process_variance(left, lattice, length, radius)
    alone = _answers(left, lattice, variance, length, radius, at_cells=True)
    noise = left.moments[:, 12] / left.moments[:, 0] ** 2
    left_out = (left.moments[:, 7] / left.moments[:, 1] - alone[:, 0]) ** 2
    # what its neighbours contradict says little
    doubtful = left_out > _DOUBT**2 * (alone[:, 3] + noise)
    trusted = left.with_noise(np.where(doubtful, left_out, noise) * left.moments[:, 0])
    fits = _answers(trusted, lattice, variance, length, radius, at_cells=False)
    below = base.blend(*lattice.centres()).reshape(*lattice.shape, -1)
    planes = np.zeros((N_PLANE, *lattice.shape))
    planes[:3] = np.moveaxis(below[..., :3] + fits[..., :3], -1, 0)
    freedom = np.maximum(freedom, _LEAST_FREEDOM)
    planes[3] = fits[..., 3] * freedom / (freedom - 2.0) + (1.0 - fits[..., 4]) ** 2 * below[..., 3]
    planes[4] = below[..., 7] > 0.0
    return Level(lattice, planes), left_out


def _answers(
    left: Cells, lattice: Lattice, variance: FloatArray, length: float, radius: float, *, at_cells: bool
) -> FloatArray:
    """
    Evaluate the processes at the fields of a lattice, or at every cell without the cell itself.

    Returns
    -------
    answers : array, shape (n_rows, n_columns, N_LOCAL) or (m, N_LOCAL)
    """
    field = _field_of(left, lattice)
    easting, northing = left.places if at_cells else lattice.centres()
    index = np.arange(lattice.n_rows * lattice.n_columns).reshape(lattice.shape)
    prior = variance[field] if at_cells else variance.reshape(-1)
    answers = np.zeros((easting.size, N_LOCAL))
    for part, window, row0, column0, cells in _blocks(left, lattice, radius, field):
        here = cells if at_cells else index[part].reshape(-1)
        answer = np.empty((here.size, N_LOCAL))
        local_processes(
            window, left.cell_size, row0, column0, length, radius, np.ascontiguousarray(easting[here]),
            np.ascontiguousarray(northing[here]), at_cells, np.ascontiguousarray(prior[here]), answer,
        )  # fmt: skip
        answers[here] = answer
    return answers if at_cells else answers.reshape(*lattice.shape, N_LOCAL)
