"""What every reader of observed points has in common: its options, its chunks, its missing values."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.crs import height_unit, parse_crs
from changedetect.errors import ConfigError, CRSMismatchError, InputDataError
from changedetect.pointcloud import PointCloud

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from changedetect.typing import FloatArray

__all__ = [
    "CHUNK_SIZE",
    "PointSource",
    "SourceOptions",
    "constant_sigma",
    "drop_missing",
    "report_dropped",
    "settle_crs",
    "sigma_in_metres",
]

logger = logging.getLogger(__name__)

#: Points handed over at a time: about 50 MB of coordinates.
CHUNK_SIZE = 2_000_000


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """
    What the user states about a source, over what the file says itself.

    Attributes
    ----------
    crs : str, optional
        CRS of the coordinates, heights included: "EPSG:26917+5713". Replaces the file's own.
    sigma : float, m, optional
        Standard deviation of every elevation. Replaces the file's own values.
    classes : tuple of int, optional
        ASPRS classes to keep (LAS).
    columns : tuple of str, optional
        Tables: columns that hold easting, northing, elevation and, if there, sigma, as names in the header or as
        positions counted from 1. For a table without header also the names of all its columns from the left, "_" for
        one to skip: ("_", "northing", "easting", "elevation", "_").
    nodata : float, optional
        Elevation that marks a missing value, as stored. NaN: empty and NaN elevations are missing, and nothing else.
    band : int
        Band of a raster, counted from 1.

    Raises
    ------
    ConfigError
        A value is out of range.
    """

    crs: str | None = None
    sigma: float | None = None
    classes: tuple[int, ...] | None = None
    columns: tuple[str, ...] | None = None
    nodata: float | None = None
    band: int = 1

    def __post_init__(self) -> None:
        if self.sigma is not None and not (math.isfinite(self.sigma) and self.sigma > 0):
            msg = f"sigma is a standard deviation in metres, positive and finite; got {self.sigma!r}."
            raise ConfigError(msg)
        if self.classes is not None and not (self.classes and all(0 <= code <= 255 for code in self.classes)):
            msg = f"classes are ASPRS codes from 0 to 255, at least one (2 is ground); got {self.classes!r}."
            raise ConfigError(msg)
        if self.columns is not None and len(self.columns) < 3:
            msg = f"columns need at least easting, northing and elevation; got {self.columns!r}."
            raise ConfigError(msg)
        if self.band < 1:
            msg = f"Bands are counted from 1; got band {self.band}."
            raise ConfigError(msg)


class PointSource(ABC):
    """
    A file of observed points, opened and understood but not yet read.

    Attributes
    ----------
    path : path
    options : SourceOptions
    crs : str or None
        CRS of the coordinates: as the user stated it, else as found in the file, else None.
    n_points : int or None
        Number of points in the file before any filter; None where only reading tells.
    """

    def __init__(self, path: Path, options: SourceOptions, crs: str | None, n_points: int | None) -> None:
        self.path = path
        self.options = options
        self.crs = crs
        self.n_points = n_points

    @abstractmethod
    def iter_chunks(self, chunk_size: int = CHUNK_SIZE) -> Iterator[PointCloud]:
        """
        Read the points in the order of the file.

        Parameters
        ----------
        chunk_size : int
            About how many points at most come at a time; bounds the memory, changes no value.

        Yields
        ------
        cloud : PointCloud
            In the source's CRS, heights in its unit; points that the options exclude are left out.

        Raises
        ------
        InputDataError
            The content cannot be read, or the options leave nothing.
        """

    def read(self) -> PointCloud:
        """All points at once, in the source's CRS."""
        return PointCloud.concatenate(list(self.iter_chunks()))

    def require_crs(self) -> str:
        """
        CRS of the source.

        Raises
        ------
        CRSMismatchError
            Neither the file nor the user states it.
        """
        if self.crs is None:
            msg = (
                f"{self.path} does not say in which coordinate reference system it is. State it, with the vertical "
                "datum if it is known: --crs EPSG:32632+5773, say."
            )
            raise CRSMismatchError(msg)
        return self.crs


def settle_crs(path: Path, found: str | None, stated: str | None) -> str | None:
    """
    Decide between the CRS found in a file and the one the user states: the user's word counts.

    Raises
    ------
    CRSMismatchError
        The text that counts cannot be understood.
    """
    if stated is not None:
        parsed = parse_crs(stated)
        if found is not None and not _is_known_equal(found, parsed.to_wkt()):
            logger.warning("%s: the CRS stated, %s, replaces the one in the file", path, stated)
        return stated.strip()
    if found is None or not found.strip():
        return None
    try:
        parse_crs(found)
    except CRSMismatchError as error:
        msg = f"{path}: the CRS in the file cannot be understood. State it with --crs, as in EPSG:32632+5773. ({error})"
        raise CRSMismatchError(msg) from error
    return found


def constant_sigma(options: SourceOptions, n_points: int) -> FloatArray | None:
    """Sigma the user states, for each of `n_points`; None where none is stated."""
    return None if options.sigma is None else np.full(n_points, options.sigma)


def sigma_in_metres(values: FloatArray, crs: str | None) -> FloatArray:
    """Standard deviations stored in a file, which are in the unit of its heights."""
    unit = None if crs is None else height_unit(crs)
    return values if unit is None or unit[1] == 1.0 else values * unit[1]


def drop_missing(cloud: PointCloud, nodata: float | None) -> PointCloud:
    """
    Leave out points whose elevation is `nodata`; NaN elevations only where `nodata` is stated to be NaN.

    Points with NaN otherwise stay in, for the checks to refuse: a hole that nobody declared is not dropped silently.
    """
    if nodata is None:
        return cloud
    missing = np.isnan(cloud.elevation) if math.isnan(nodata) else cloud.elevation == nodata
    if not missing.any():
        return cloud
    return cloud.select(~missing)


def report_dropped(path: Path, n_dropped: int, n_total: int, nodata: float | None) -> None:
    """
    Log how many points were left out as missing, and refuse when none is left.

    Raises
    ------
    InputDataError
        All points were missing.
    """
    if n_total and n_dropped == n_total:
        msg = f"{path}: all {n_total} points have the elevation {nodata!r} that --nodata declares missing."
        raise InputDataError(msg)
    if n_dropped:
        logger.info("%s: %d of %d points left out, elevation %r is nodata", path, n_dropped, n_total, nodata)


def _is_known_equal(found: str, stated: str) -> bool:
    try:
        return bool(parse_crs(found).equals(parse_crs(stated), ignore_axis_order=True))
    except CRSMismatchError:
        return False
