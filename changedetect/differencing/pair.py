"""The difference of two models on a grid."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing.maps import ChangeMaps, judge_change
from changedetect.differencing.shared_surface import FIELD_AREA, LocalDifference, estimate_difference
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice
from changedetect.models.reference import ReferenceLWPR

if TYPE_CHECKING:
    from changedetect.config import DifferencingConfig
    from changedetect.grid import Grid
    from changedetect.models.base import SurfaceModel
    from changedetect.typing import FloatArray

__all__ = ["difference_models"]

#: A cell counts as observed by a reference-mode epoch with at least this effective number of observations.
_REFERENCE_MINIMUM = 2.0


def difference_models(
    earlier: SurfaceModel, later: SurfaceModel, grid: Grid, settings: DifferencingConfig
) -> ChangeMaps:
    """
    Change from one epoch to a later one.

    Parameters
    ----------
    earlier, later : LWPRSurface or ReferenceLWPR
        Models of the two epochs, both of the same kind.
    grid : Grid
        Output cells, in the CRS of the models; its corner lies on multiples of the resolution.
    settings : DifferencingConfig

    Returns
    -------
    maps : ChangeMaps

    Raises
    ------
    ValueError
        The models are of different kinds, or of one that cannot be differenced.

    Notes
    -----
    In adaptive mode the evidence of the two epochs is differenced about one shared surface, see
    `estimate_difference`; what a model remembers of still earlier epochs takes no part. In reference mode the two
    predictions are subtracted and their variances added.
    """
    if isinstance(earlier, LWPRSurface) and isinstance(later, LWPRSurface):
        return _difference_adaptive(earlier, later, grid, settings)
    if isinstance(earlier, ReferenceLWPR) and isinstance(later, ReferenceLWPR):
        return _difference_reference(earlier, later, grid, settings)
    msg = f"cannot difference a {type(earlier).__name__} and a {type(later).__name__}; learn both with one mode"
    raise ValueError(msg)


def _difference_adaptive(
    earlier: LWPRSurface, later: LWPRSurface, grid: Grid, settings: DifferencingConfig
) -> ChangeMaps:
    west, _, south, _ = grid.region
    lattice = Lattice(
        0.0, grid.resolution, round(south / grid.resolution), round(west / grid.resolution), grid.n_rows, grid.n_cols
    )
    kernels = (earlier.own_kernel_, later.own_kernel_)
    local = estimate_difference(earlier.own_cells(), later.own_cells(), kernels, lattice)
    return _north_up(local, settings)


def _north_up(local: LocalDifference, settings: DifferencingConfig) -> ChangeMaps:
    return judge_change(
        local.difference[::-1],
        local.variance[::-1],
        local.freedom[::-1],
        (local.counts[0][::-1], local.counts[1][::-1]),
        (local.observed[0][::-1], local.observed[1][::-1]),
        math.sqrt(FIELD_AREA) * local.kernel,
        settings,
    )


def _difference_reference(
    earlier: ReferenceLWPR, later: ReferenceLWPR, grid: Grid, settings: DifferencingConfig
) -> ChangeMaps:
    coordinates = grid.coordinates()

    def raster(values: FloatArray) -> FloatArray:
        return values.reshape(grid.shape)

    first, second = earlier.predict(coordinates), later.predict(coordinates)
    counts = raster(earlier.observed(coordinates)), raster(later.observed(coordinates))
    variance = raster(first.elevation_std**2 + second.elevation_std**2)
    observed = tuple(
        (count >= _REFERENCE_MINIMUM) & np.isfinite(raster(p.elevation))
        for count, p in zip(counts, (first, second), strict=True)
    )
    freedom = np.maximum(np.minimum(counts[0], counts[1]) - 3.0, 1.0)
    return judge_change(
        raster(second.elevation - first.elevation),
        variance,
        freedom,
        counts,
        (observed[0], observed[1]),
        max(earlier.kernel_size, later.kernel_size) * math.sqrt(4.0 * math.pi),
        settings,
    )
