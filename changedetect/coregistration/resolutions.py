"""
Aligning epochs of very different density: a coarse elevation model and a drone's cloud.

The surface of a coarse epoch lacks the ground's detail, which then stands in every residual of a dense cloud; a shift
that 5 cm of noise would give to a centimetre is known to a metre. The other way round nothing is lost: the dense
epoch's surface has the detail, is averaged over the ground that one observation of the coarse epoch averages, and the
observations of the coarse epoch are aligned to that. Where the coarse epoch is the reference the transform found is
inverted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.ndimage import uniform_filter

from changedetect.coregistration.point_to_surface import align
from changedetect.kernels.coregistration import interpolate_raster
from changedetect.models.footprint import find_footprint
from changedetect.models.lwpr import LWPRSurface, point_density
from changedetect.models.pyramid import CellPyramid, Lattice, build_level
from changedetect.pointcloud import PointCloud

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from changedetect.coregistration.alignment import Alignment
    from changedetect.coregistration.transform import Kind
    from changedetect.models.cells import Cells
    from changedetect.typing import FloatArray, IntArray

__all__ = ["AveragedReference", "align_across_resolutions", "differ_in_resolution"]

#: One epoch's kernel over the other's from which they are aligned by way of the denser one's surface; that from which
#: a difference follows the denser epoch alone.
_LOPSIDED = 2.0
#: Kernel of the dense surface in the finest that the density supports; of its lattice in kernels; both as for the
#: shared surface of a difference.
_SURFACE_KERNEL = 2.0**0.5
_SPACING = 0.8
#: Kernel that a density supports, in mean spacings.
_KERNEL_OF_SPACING = 1.16
#: Nodes of the averaged surface, at most.
_MOST_NODES = 4_000_000
#: Nodes along the side of the square that an observation averages, at least.
_LEAST_NODES = 5
#: Share of such a square on which the surface must be known: the mean of a part is that of another place.
_LEAST_SHARE = 0.98
#: Nodes, half a kernel of the surface each, beyond which two places share few observations.
_REACH_NODES = 6.0


@dataclass(frozen=True, eq=False)
class AveragedReference:
    """
    The surface of a dense epoch, averaged over squares, on a raster.

    Attributes
    ----------
    elevation : array, shape (n_rows, n_cols), m, float64
        Row 0 in the north; NaN where the surface is not known on enough of the square.
    west, north : float, m
        Of the corner of the first cell.
    step : float, m
    side : float, m
        Of the squares; 0 where nothing was averaged.
    """

    elevation: FloatArray
    west: float
    north: float
    step: float
    side: float

    @classmethod
    def of_cells(cls, cells: Cells, kernel: float, side: float) -> AveragedReference:
        """
        Average the surface of an epoch's evidence.

        Parameters
        ----------
        cells : Cells
        kernel : float, m
            Finest that the epoch's density supports.
        side : float, m
        """
        west, east, south, north = cells.region
        coarsest = math.sqrt((east - west) * (north - south) / _MOST_NODES)
        fine = max(_SURFACE_KERNEL * kernel, coarsest / _SPACING)
        centred, height = cells.centred()
        lattice = Lattice.covering(cells.region, fine, _SPACING * fine)
        level, _ = build_level(CellPyramid(centred).for_kernel(fine), lattice, 0.0, None)
        step, n = max(0.5 * fine, coarsest), 1
        if side > 0.0:
            n = max(_LEAST_NODES, 2 * round(0.5 * side / step) + 1)
            step = max(side / n, coarsest)
        n_rows, n_cols = math.ceil((north - south) / step), math.ceil((east - west) / step)
        easting = west + (np.arange(n_cols) + 0.5) * step
        northing = north - (np.arange(n_rows) + 0.5) * step
        places = np.meshgrid(easting, northing)
        blended = level.blend(places[0].ravel(), places[1].ravel())
        known = (blended[:, 7] > 0.0).reshape(n_rows, n_cols).astype(np.float64)
        value = np.where(known > 0.0, blended[:, 0].reshape(n_rows, n_cols), 0.0)
        share, mean = uniform_filter(known, n, mode="constant"), uniform_filter(value, n, mode="constant")
        elevation = np.where(share >= _LEAST_SHARE, height + mean / np.maximum(share, 1e-12), np.nan)
        return cls(np.ascontiguousarray(elevation), west, north, step, side)

    @property
    def reach(self) -> float:
        """
        Distance, m, beyond which errors at two places have little in common.

        Half a square: a mean over so many observations has little error to share, and slopes over more than the square
        would miss the ground's detail.
        """
        return max(0.5 * self.side, _REACH_NODES * self.step)

    def surface(self, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Elevation, m, at places of shape (n,); its variance is small against the other's and given as 0."""
        elevation = np.empty(easting.size)
        row, column = (self.north - northing) / self.step - 0.5, (easting - self.west) / self.step - 0.5
        interpolate_raster(self.elevation, row, column, elevation)
        return elevation, np.where(np.isnan(elevation), np.nan, 0.0)


def differ_in_resolution(cloud: PointCloud, reference: LWPRSurface) -> bool:
    """Whether one of an epoch and its reference is so much denser that `align_across_resolutions` serves better."""
    kernel = max(_KERNEL_OF_SPACING / math.sqrt(point_density(*cloud.coordinates)), reference.resolution or 0.0)
    ratio = kernel / reference.own_kernel_
    return ratio >= _LOPSIDED or ratio <= 1.0 / _LOPSIDED


def align_across_resolutions(
    cloud: PointCloud,
    reference: LWPRSurface,
    kind: Kind | Literal["auto"] = "auto",
    area_of: Callable[[PointCloud], IntArray] | None = None,
    area_names: Sequence[str] = (),
) -> Alignment:
    """
    Estimate how an epoch must be moved onto a reference that is much coarser, or much denser.

    Parameters
    ----------
    cloud : PointCloud
        Of the epoch, in the CRS of the reference.
    reference : LWPRSurface
        Of one epoch, without memory.
    kind : str
        As for `align`.
    area_of : callable, optional
        Number of the stable area in which each point of a cloud lies, as `align` takes it.
    area_names : sequence of str

    Returns
    -------
    alignment : Alignment
        Its transform moves the epoch into the frame of the reference.

    Raises
    ------
    AlignmentError
        As `align`.
    """
    own = LWPRSurface(reference.settings, reference.memory_days, reference.resolution)
    own.fit(cloud.coordinates, cloud.elevation, cloud.sigma)
    is_coarse = own.own_kernel_ > reference.own_kernel_
    coarse, dense = (own, reference) if is_coarse else (reference, own)
    cells, surface = coarse.own_cells(), dense.own_cells()
    point_like = AveragedReference.of_cells(surface, dense.own_kernel_, 0.0)

    def evaluate(easting: FloatArray, northing: FloatArray) -> FloatArray:
        return point_like.surface(easting, northing)[0][:, None]

    side = find_footprint(cells, evaluate, coarse.own_kernel_ / _KERNEL_OF_SPACING, 2.0 * point_like.step)
    averaged = point_like if side == 0.0 else AveragedReference.of_cells(surface, dense.own_kernel_, side)
    observed = cloud if is_coarse else PointCloud(*cells.places, cells.moments[:, 7] / cells.moments[:, 1])
    found = align(observed, averaged, kind, None if area_of is None else area_of(observed), area_names)
    return found if is_coarse else found.inverted()
