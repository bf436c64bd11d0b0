"""
What width of change a difference resolves, which epoch sets it, and which changes are too small for it.

The answer at a cell is a mean over the kernel behind it and, where an observation itself is a mean over ground (the
cell of a raster), over that. Narrower change comes out too low and too wide; its volume stays right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt, find_objects

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.differencing.objects import ChangeObjects
    from changedetect.typing import BoolArray, FloatArray, JSONObject

__all__ = [
    "CHANGE_NOT_RESOLVED",
    "FIELD_AREA",
    "KERNEL_WIDTH",
    "LIMITED_BY_EARLIER",
    "LIMITED_BY_LATER",
    "NO_RESOLUTION",
    "RESOLVED_ALIKE",
    "ObjectSize",
    "Resolution",
    "describe_resolution",
    "object_sizes",
    "resolution_classes",
    "supported_width",
]

RESOLVED_ALIKE = 0
LIMITED_BY_EARLIER = 1
LIMITED_BY_LATER = 2
CHANGE_NOT_RESOLVED = 3
NO_RESOLUTION = 255

#: Full width at half maximum of the bisquare kernel, in kernels: (1 - q / 4)^2 = 1/2 at sqrt(q) = 1.08.
KERNEL_WIDTH = 4.0 * math.sqrt(1.0 - math.sqrt(0.5))
#: Area over which a field averages, in squared kernels: n_eff = 20/9 pi h2 per unit density for the bisquare kernel.
FIELD_AREA = 20.0 / 9.0 * math.pi
#: Structures narrower than two spacings of the observations alias (Nyquist).
_SPACINGS = 2.0
#: One epoch limits the resolution where it is coarser than the other this many times.
_LIMIT_RATIO = 2.0
#: A change is resolved where it is wider than this many resolutions at half of its height. A point-like change comes
#: out with one.
_RESOLVED_WIDTH = 1.5
#: Percentile of the absolute change of an object that counts as its height.
_HEIGHT_PERCENTILE = 95.0


@dataclass(frozen=True)
class Resolution:
    """
    Ground resolution of a difference; arrays of shape (n_rows, n_cols), north up.

    Attributes
    ----------
    earlier, later : array, m
        What each epoch supports with the kernel behind the answer, see `supported_width`; NaN where not known.
    unresolved_std : array, m
        Standard deviation of the finer epoch's ground about a plane within the kernel: detail in which the coarser
        epoch cannot show change. NaN where not known.
    footprints : (earlier, later), m
        Side of the square that one observation averages, as found; 0 for points.
    """

    earlier: FloatArray
    later: FloatArray
    unresolved_std: FloatArray
    footprints: tuple[float, float] = (0.0, 0.0)

    @property
    def width(self) -> FloatArray:
        """Resolution of the difference, m: that of the coarser epoch."""
        return np.maximum(self.earlier, self.later)

    def north_up(self) -> Resolution:
        """Return the same with the order of rows reversed."""
        return Resolution(self.earlier[::-1], self.later[::-1], self.unresolved_std[::-1], self.footprints)

    def within(self, known: BoolArray) -> Resolution:
        """Return the same with NaN outside `known`."""
        return Resolution(
            np.where(known, self.earlier, np.nan),
            np.where(known, self.later, np.nan),
            np.where(known, self.unresolved_std, np.nan),
            self.footprints,
        )


def supported_width(kernel: float, count: FloatArray, count_kernel: float, footprint: float = 0.0) -> FloatArray:
    """
    Resolution that one epoch supports.

    Parameters
    ----------
    kernel : float, m
        Kernel that the epoch's density asks for.
    count : array
        Effective number of observations of the epoch under the kernel that was used.
    count_kernel : float, m
        The kernel that was used.
    footprint : float, m
        Side of the square that one observation averages.

    Returns
    -------
    width : array, m
        Full width at half maximum of kernel and footprint together, or two local spacings of the observations where
        that is more.

    Examples
    --------
    >>> dense = supported_width(2.0, np.array([100.0]), 2.0)
    >>> round(float(dense[0]), 2)
    4.33
    >>> thin = supported_width(2.0, np.array([4.0]), 2.0)
    >>> round(float(thin[0]), 2)
    5.28
    """
    with np.errstate(divide="ignore"):
        spacing = count_kernel * np.sqrt(FIELD_AREA / np.maximum(count, 1e-9))
    return np.asarray(np.maximum(np.hypot(KERNEL_WIDTH * kernel, footprint), _SPACINGS * spacing))


@dataclass(frozen=True)
class ObjectSize:
    """
    Size of a change object against the resolution there.

    Attributes
    ----------
    width : float, m
        Of the widest place of the object's part above half its height.
    resolution : float, m
        Of the difference there.
    is_resolved : bool
        Whether height and outline mean what they say. Otherwise the change is real, narrower and higher than mapped;
        its volume holds.
    """

    width: float
    resolution: float
    is_resolved: bool


def object_sizes(objects: ChangeObjects, dod: FloatArray, width: FloatArray, cell: float) -> dict[int, ObjectSize]:
    """
    Sizes of all objects.

    Parameters
    ----------
    objects : ChangeObjects
    dod, width : array, shape (n_rows, n_cols), m
        Change, and resolution of the difference.
    cell : float, m

    Returns
    -------
    sizes : dict of number to ObjectSize
    """
    sizes = {}
    windows = find_objects(objects.labels)
    for number in np.unique(objects.labels[objects.labels > 0]).tolist():
        window = windows[number - 1]
        region = objects.labels[window] == number
        change = np.abs(np.where(region, dod[window], 0.0))
        high = region & (change >= 0.5 * np.percentile(change[region], _HEIGHT_PERCENTILE))
        inner = distance_transform_edt(np.pad(high, 1))
        across = (2.0 * float(np.max(inner)) - 1.0) * cell
        resolution = float(np.median(width[window][high]))
        sizes[number] = ObjectSize(across, resolution, across >= _RESOLVED_WIDTH * resolution)
    return sizes


def resolution_classes(
    resolution: Resolution, objects: ChangeObjects, sizes: dict[int, ObjectSize]
) -> NDArray[np.uint8]:
    """
    Say of every cell which epoch limits the resolution, and whether a change there is resolved.

    Returns
    -------
    classes : array, shape (n_rows, n_cols), uint8
        0 both epochs resolve alike, 1 the earlier epoch limits, 2 the later one, 3 change found here is too small for
        its height and outline to be resolved, 255 not known.
    """
    earlier, later = resolution.earlier, resolution.later
    classes = np.full(earlier.shape, NO_RESOLUTION, np.uint8)
    classes[np.isfinite(resolution.width)] = RESOLVED_ALIKE
    with np.errstate(invalid="ignore"):
        classes[earlier > _LIMIT_RATIO * later] = LIMITED_BY_EARLIER
        classes[later > _LIMIT_RATIO * earlier] = LIMITED_BY_LATER
    unresolved = np.array([number for number, size in sizes.items() if not size.is_resolved], np.int32)
    classes[np.isin(objects.labels, unresolved) & (classes != NO_RESOLUTION)] = CHANGE_NOT_RESOLVED
    return classes


def describe_resolution(
    resolution: Resolution, classes: NDArray[np.uint8], sizes: dict[int, ObjectSize], cell: float
) -> JSONObject:
    """
    Sum up what a difference resolves, for `summary.json`.

    Returns
    -------
    document : dict
        Widths in m, areas in m2, and `statement` in plain words; None where nothing is known.
    """
    known = np.isfinite(resolution.width)
    if not known.any():
        return {"width_m": None, "statement": "No ground was observed by both epochs."}
    median = {
        name: float(np.nanmedian(a[known]))
        for name, a in (
            ("width_m", resolution.width),
            ("width_earlier_m", resolution.earlier),
            ("width_later_m", resolution.later),
        )
    }
    detail = resolution.unresolved_std[known & np.isfinite(resolution.unresolved_std)]
    area = cell**2
    n_unresolved = sum(not size.is_resolved for size in sizes.values())
    document: JSONObject = {
        **median,
        "footprint_earlier_m": resolution.footprints[0],
        "footprint_later_m": resolution.footprints[1],
        "unresolved_std_m": float(np.median(detail)) if detail.size else None,
        "area_limited_by_earlier_m2": area * int(np.count_nonzero(classes == LIMITED_BY_EARLIER)),
        "area_limited_by_later_m2": area * int(np.count_nonzero(classes == LIMITED_BY_LATER)),
        "n_objects_not_resolved": n_unresolved,
    }
    document["statement"] = _statement(document)
    return document


def _statement(found: JSONObject) -> str:
    width, earlier, later = found["width_m"], found["width_earlier_m"], found["width_later_m"]
    if earlier > _LIMIT_RATIO * later:
        text = f"The earlier epoch resolves {earlier:.2g} m, the later {later:.2g} m: the earlier one limits the map. "
    elif later > _LIMIT_RATIO * earlier:
        text = f"The later epoch resolves {later:.2g} m, the earlier {earlier:.2g} m: the later one limits the map. "
    else:
        text = f"Both epochs resolve about {width:.2g} m. "
    text += (
        f"Change narrower than {width:.2g} m comes out lower and wider than it is, change narrower than "
        f"{0.45 * width:.2g} m with less than half its height, and may not be seen at all."
    )
    detail = found["unresolved_std_m"]
    if detail is not None and max(earlier, later) > _LIMIT_RATIO * min(earlier, later):
        text += (
            f" The ground of the finer epoch varies by {detail:.2g} m (standard deviation) within that width; whether "
            "that detail changed cannot be told."
        )
    n = found["n_objects_not_resolved"]
    if n:
        text += f" {n} of the changes found {'is' if n == 1 else 'are'} too small for height and outline to be right."
    return text
