"""
Receptive fields along edges: their metric follows the level lines of the surface found so far.

Round fields of one size cannot resolve the rim of a crown or a scarp and average its noise at once. Along such a line
the ground hardly varies: a field that is long along it, narrow across, and bent as it bends has as many observations
and a third of the blur. Whether the ground asks for it is measured, not assumed: long fields and the surface found so
far compete by their leave-one-out errors, and what wins replaces that surface only as far as the difference of the two
exceeds noise.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from changedetect.kernels.steered_fields import N_GEOMETRY, N_STEERED, fit_steered_planes
from changedetect.models.pyramid import N_MINIMUM, windows

if TYPE_CHECKING:
    from changedetect.models.cells import Cells
    from changedetect.models.pyramid import Lattice, Level
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["level_lines", "steer"]

#: Length over width of a steered field; 3 resolves less, 6 gains nothing on dense and loses on sparse ground.
_ELONGATION = 4.5
#: Standard deviations, in kernels, of the Gaussian windows over which direction and curvature of level lines are found.
_DIRECTION_WINDOW = 1.13
_CURVATURE_WINDOW = 2.0
#: Largest curvature of a level line, times the kernel along it: the parabola of the field stands for an arc.
_CURVATURE_LIMIT = 0.5
#: Roughness, in variances of the surface, from which a field may be steered: of one of local processes, of a pyramid,
#: whose blur is not in its variance.
_ROUGHNESS, _ROUGHNESS_OF_PYRAMID = 1.0, 2.0
#: Residual variance of long fields against that of round ones below which they are taken; against leave-one-out errors
#: of another surface any advantage counts.
_ADVANTAGE = 0.9
#: Standard deviation, in lattice steps, of the window over which they are compared.
_COMPARE_REACH = 1.0
#: A squared difference counts at most this many noise variances in the comparison with noise.
_RATIO_LIMIT = 100.0


def _filled(level: Level) -> FloatArray:
    """Values at the field centres about their median, undefined ones copied from the nearest defined field."""
    defined = level.planes[4] > 0.0
    values = level.planes[0]
    if not defined.all():
        nearest = distance_transform_edt(~defined, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    centred: FloatArray = values - np.median(values)
    return centred


def level_lines(level: Level, kernel: float, roughness_limit: float = _ROUGHNESS) -> FloatArray:
    """
    Direction and curvature of the surface's level lines, and where the surface is rougher than its own error.

    Parameters
    ----------
    level : Level
        A finished surface, defined at one field at least.
    kernel : float, m
        Kernel size that the density of observations supports.
    roughness_limit : float
        In variances of the surface.

    Returns
    -------
    geometry : array, shape (n_rows, n_columns, N_GEOMETRY)
        See `changedetect.kernels.steered_fields`.

    Notes
    -----
    Across is the leading direction of the structure tensor; the curvature is f_vv / f_u with u across and v along,
    from Gaussian derivatives. Roughness is the variance of the surface in the window about its plane there.
    """
    spacing = level.lattice.spacing
    values = _filled(level)

    def smooth(a: FloatArray, window: float, order: tuple[int, int] = (0, 0)) -> FloatArray:
        reach = window * kernel / spacing
        smoothed: FloatArray = gaussian_filter(a, reach, order=order, truncate=2.5)
        return smoothed / spacing ** sum(order)

    north, east = (np.asarray(g, np.float64) for g in np.gradient(values, spacing))
    near = _DIRECTION_WINDOW
    angle = 0.5 * np.arctan2(2.0 * smooth(east * north, near), smooth(east * east - north * north, near))
    ex, ey = np.cos(angle), np.sin(angle)
    mean = smooth(values, near)
    slope = (near * kernel) ** 2 * (smooth(east, near) ** 2 + smooth(north, near) ** 2)
    roughness = smooth(values * values, near) - mean * mean - slope

    wide = _CURVATURE_WINDOW
    across = smooth(values, wide, (0, 1)) * ex + smooth(values, wide, (1, 0)) * ey
    along = (
        smooth(values, wide, (0, 2)) * ey * ey
        - 2.0 * smooth(values, wide, (1, 1)) * ex * ey
        + smooth(values, wide, (2, 0)) * ex * ex
    )
    limit = _CURVATURE_LIMIT / (kernel * math.sqrt(_ELONGATION))
    # where the surface does not rise across, no curvature is defined and the limit is as good as any
    curvature = along * across / np.maximum(across * across, 1e-12)
    geometry = np.empty((*level.lattice.shape, N_GEOMETRY))
    geometry[..., 0], geometry[..., 1] = ex, ey
    geometry[..., 2] = np.clip(curvature, -limit, limit)
    geometry[..., 3] = (level.planes[4] > 0.0) & (roughness > roughness_limit * level.planes[3])
    return geometry


def _fit(
    cells: Cells, lattice: Lattice, geometry: FloatArray, kernel: float, elongation: float, left_out: FloatArray | None
) -> FloatArray:
    """Planes of the steered fields of a lattice, each of the area of a round field of this kernel."""
    along, across = kernel * math.sqrt(elongation), kernel / math.sqrt(elongation)
    fits = np.zeros((*lattice.shape, N_STEERED))
    for part, window, row, column in windows(cells, lattice, 2.0 * along):
        rival = np.zeros((0, 0))
        if left_out is not None:
            n_rows, n_columns, _ = window.shape
            rival = np.zeros((n_rows, n_columns))
            a, b = cells.row - row, cells.column - column
            inside = (a >= 0) & (a < n_rows) & (b >= 0) & (b < n_columns)
            rival[a[inside], b[inside]] = left_out[inside]
        fit_steered_planes(
            window, cells.cell_size, row, column, along, across, lattice.spacing,
            lattice.first_row + part[0].start, lattice.first_column + part[1].start,
            np.ascontiguousarray(geometry[part]), rival, fits[part],
        )  # fmt: skip
    return fits


def _pooled(values: FloatArray, among: BoolArray) -> FloatArray:
    """Mean over the neighbourhood of what is among the chosen, infinite elsewhere."""

    def smooth(a: FloatArray) -> FloatArray:
        smoothed: FloatArray = gaussian_filter(a, _COMPARE_REACH, truncate=2.5, mode="constant")
        return smoothed

    mass = smooth(among.astype(np.float64))
    pooled = smooth(np.where(among, values, 0.0)) / np.where(among, mass, 1.0)
    return np.where(among, pooled, np.inf)


def steer(cells: Cells, level: Level, kernel: float, left_out: FloatArray | None = None) -> Level:
    """
    Replace fields at edges by fields along them.

    Parameters
    ----------
    cells : Cells
        The observations of the surface, with their noise variances.
    level : Level
        The surface found so far.
    kernel : float, m
        Kernel size that the density of observations supports; a steered field has the area of such a field.
    left_out : array, shape (m,), m2, optional
        Squared error of the surface found so far at every cell when that cell is left out. Without it, round fields of
        the same area stand for that surface.

    Returns
    -------
    level : Level
        The same fields where the ground asks for nothing else.

    Notes
    -----
    Long fields are taken where their leave-one-out error, pooled over the neighbourhood, is below the other's at the
    same cells: as in the paper's eqs 5 and 6, the metric of a field follows that error.
    With d the difference to the surface found so far and C the noise variance of the steered value, the surface moves
    by s d, s = max(0, 1 - 1 / mean(d**2 / C)): empirical Bayes as for the levels of the pyramid.
    """
    geometry = level_lines(level, kernel, _ROUGHNESS_OF_PYRAMID if left_out is None else _ROUGHNESS)
    if not (geometry[..., 3] > 0.0).any():
        return level
    cells, height = cells.centred()
    fits = _fit(cells, level.lattice, geometry, kernel, _ELONGATION, left_out)
    is_long = fits[..., 4] >= N_MINIMUM
    if left_out is None:
        round_fits = _fit(cells, level.lattice, geometry, kernel, 1.0, None)
        limit = _ADVANTAGE * _pooled(round_fits[..., 5], round_fits[..., 4] >= N_MINIMUM)
    else:
        limit = _pooled(fits[..., 6], is_long)
    taken = is_long & (_pooled(fits[..., 5], is_long) < limit)
    planes = level.planes.copy()
    noise = np.where(taken, fits[..., 3], 1.0)
    difference = fits[..., 0] + height - planes[0]
    excess = np.maximum(_pooled(np.minimum(difference**2 / noise, _RATIO_LIMIT), taken), 1.0)
    s = np.where(taken, 1.0 - 1.0 / excess, 0.0)
    planes[0] += s * difference
    planes[1] += s * (fits[..., 1] - planes[1])
    planes[2] += s * (fits[..., 2] - planes[2])
    planes[3] += s * (fits[..., 3] - planes[3])
    moved = s > 0.0
    left = fits[..., 5] + ((1.0 - s) * difference) ** 2 + 1e-8
    planes[4] = np.where(moved, 1.0 / np.where(moved, left, 1.0), planes[4])
    return dataclasses.replace(level, planes=planes)
