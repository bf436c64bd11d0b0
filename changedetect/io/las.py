"""
Point clouds in LAS, LAZ and COPC files [1]_.

Points that their producer withdrew are never used: those flagged withheld or synthetic, and those classed as noise
(7 and 18) unless these classes are asked for. COPC is read as the LAZ file it is [2]_.

References
----------
.. [1] ASPRS (2019), LAS specification 1.4 - R15.
.. [2] COPC specification 1.0, https://copc.io.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import laspy
import lazrs  # type: ignore[import-untyped]
import numpy as np

from changedetect.crs import to_wkt
from changedetect.errors import CRSMismatchError, InputDataError, OutputError
from changedetect.io.las_header import check_chunks, check_header, crs_of_header, readable
from changedetect.io.source import (
    CHUNK_SIZE,
    PointSource,
    SourceOptions,
    constant_sigma,
    settle_crs,
    sigma_in_metres,
)
from changedetect.pointcloud import PointCloud
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from datetime import date
    from pathlib import Path

    from numpy.typing import NDArray

    from changedetect.typing import BoolArray

__all__ = ["SIGMA_DIMENSION", "LasSource", "write_points"]

logger = logging.getLogger(__name__)

#: Extra dimension with the standard deviation of each elevation, in the unit of the heights.
SIGMA_DIMENSION = "sigma_z"
#: One thread per core where chunks allow it, else one.
_BACKENDS = (laspy.LazBackend.LazrsParallel, laspy.LazBackend.Lazrs)
#: ASPRS classes low point (noise) and high noise.
_NOISE_CLASSES = (7, 18)
_SELECTION = (
    laspy.DecompressionSelection.XY_RETURNS_CHANNEL
    | laspy.DecompressionSelection.Z
    | laspy.DecompressionSelection.CLASSIFICATION
    | laspy.DecompressionSelection.FLAGS
    | laspy.DecompressionSelection.ALL_EXTRA_BYTES
)
_MAX_INT32 = 2**31 - 1


class LasSource(PointSource):
    """
    Points of a LAS, LAZ or COPC file.

    Parameters
    ----------
    path : path
    options : SourceOptions
        `crs`, `sigma` and `classes` apply.

    Raises
    ------
    InputDataError
        The file is damaged, truncated, of an unknown version, or holds no points.
    CRSMismatchError
        Its CRS cannot be understood.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        check_header(path)
        with readable(path), laspy.open(path, laz_backend=_BACKENDS, decompression_selection=_SELECTION) as reader:
            header = reader.header
            if header.are_points_compressed and header.point_count:
                check_chunks(path, header)
            found = crs_of_header(header)
        if not (np.isfinite(header.scales).all() and (header.scales > 0).all() and np.isfinite(header.offsets).all()):
            msg = (
                f"{path} is damaged: coordinates have the scales {header.scales} and offsets {header.offsets}; scales "
                "are positive, 0.001 or so. Export it again."
            )
            raise InputDataError(msg)
        if header.point_count == 0:
            msg = f"{path} holds no points: its header announces 0. Export it again."
            raise InputDataError(msg)
        super().__init__(path, options, settle_crs(path, found, options.crs), int(header.point_count))

    def iter_chunks(self, chunk_size: int = CHUNK_SIZE) -> Iterator[PointCloud]:
        """
        Read the points in the order of the file; see `PointSource.iter_chunks`.

        Raises
        ------
        InputDataError
            The file is damaged or truncated, or no point passes the filters: the message counts the classes there.
        """
        counts = np.zeros(256, np.int64)
        n_read = n_kept = n_flagged = 0
        with (
            readable(self.path),
            laspy.open(self.path, laz_backend=_BACKENDS, decompression_selection=_SELECTION) as reader,
        ):
            for points in reader.chunk_iterator(chunk_size):
                classes = np.asarray(points.classification, dtype=np.uint8)
                flagged = _flagged(points)
                keep = self._wanted(classes) & ~flagged
                counts += np.bincount(classes, minlength=256)
                n_read += classes.size
                n_flagged += int(flagged.sum())
                cloud = self._cloud(points, classes)
                cloud = cloud if keep.all() else cloud.select(keep)
                n_kept += len(cloud)
                if len(cloud):
                    yield cloud
        if n_read != self.n_points:
            msg = f"{self.path} is truncated: its header announces {self.n_points} points, {n_read} could be read."
            raise InputDataError(msg)
        self._report(n_read, n_kept, n_flagged, counts)

    def _wanted(self, classes: NDArray[np.uint8]) -> BoolArray:
        if self.options.classes is None:
            return ~np.isin(classes, _NOISE_CLASSES)
        return np.isin(classes, self.options.classes)

    def _cloud(self, points: Any, classes: NDArray[np.uint8]) -> PointCloud:
        sigma = constant_sigma(self.options, classes.size)
        if sigma is None and SIGMA_DIMENSION in points.point_format.extra_dimension_names:
            sigma = sigma_in_metres(np.asarray(points[SIGMA_DIMENSION], dtype=np.float64), self.crs)
        return PointCloud(np.asarray(points.x), np.asarray(points.y), np.asarray(points.z), sigma, classes)

    def _report(self, n_read: int, n_kept: int, n_flagged: int, counts: NDArray[np.int64]) -> None:
        present = ", ".join(f"{code} ({counts[code]} points)" for code in np.flatnonzero(counts))
        if n_kept == 0:
            classes = self.options.classes
            wanted = "other than noise" if classes is None else f"of class {' or '.join(map(str, classes))}"
            msg = (
                f"{self.path}: no usable point {wanted}. Classes in the file: {present}; {n_flagged} of {n_read} "
                "points are flagged withheld or synthetic. Choose classes with --classes, or leave the option out."
            )
            raise InputDataError(msg)
        if n_kept < n_read:
            logger.info("%s: %d of %d points used; classes in the file: %s", self.path, n_kept, n_read, present)


def write_points(
    path: Path,
    cloud: PointCloud,
    crs: str,
    *,
    scale: float = 0.001,
    created: date | None = None,
    extra: Mapping[str, tuple[NDArray[Any], str]] | None = None,
) -> None:
    """
    Write a point cloud as LAZ (or LAS, by the suffix), atomically.

    Parameters
    ----------
    path : path
        An existing file is replaced.
    cloud : PointCloud
        Metres in `crs`. Sigma goes into the extra dimension `sigma_z` (float32).
    crs : str
        Written as WKT 1, which most readers of LAS expect; as WKT 2 where only that can express it: a projected CRS
        with ellipsoidal heights.
    scale : float, m
        Coordinates are rounded to this.
    created : date, optional
        Creation date in the header; today by default. With a fixed date the same points give the same bytes.
    extra : mapping of str to (array, str), optional
        Further dimensions by name: one value a point, stored in the array's type, and a description of at most 32
        characters.

    Raises
    ------
    InputDataError
        There are no points, or they spread too far for whole numbers of `scale`.
    CRSMismatchError
        `crs` cannot be understood.
    OutputError
        The file cannot be written.

    Notes
    -----
    Version 1.4, point format 6. Coordinates are stored relative to whole metres at the south-west lower corner.
    """
    if len(cloud) == 0:
        msg = f"Nothing to write to {path}: the point cloud holds no points."
        raise InputDataError(msg)
    columns = (cloud.easting, cloud.northing, cloud.elevation)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.creation_date = created
    header.generating_software = "changedetect"
    header.scales = np.full(3, scale)
    header.offsets = np.array([np.floor(values.min()) for values in columns])
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(_wkt_for_las(crs)))
    if cloud.sigma is not None:
        header.add_extra_dim(laspy.ExtraBytesParams(SIGMA_DIMENSION, np.float32, "standard deviation of z"))
    for name, (values, description) in (extra or {}).items():
        header.add_extra_dim(laspy.ExtraBytesParams(name, values.dtype, description))
    integers = [np.rint((v - offset) / scale) for v, offset in zip(columns, header.offsets, strict=True)]
    if max(float(values.max()) for values in integers) > _MAX_INT32:
        msg = (
            f"The points for {path} spread over more than {_MAX_INT32 * scale:.0f} m, too far for a scale of {scale} m."
        )
        raise InputDataError(msg)
    record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    record.X, record.Y, record.Z = (values.astype(np.int32) for values in integers)
    record.return_number[:] = 1
    record.number_of_returns[:] = 1
    if cloud.classification is not None:
        record.classification[:] = cloud.classification
    if cloud.sigma is not None:
        record[SIGMA_DIMENSION] = cloud.sigma.astype(np.float32)
    for name, (values, _) in (extra or {}).items():
        record[name] = values
    with atomic_path(path) as temporary:
        _write(temporary, path, header, record)


def _write(temporary: Path, path: Path, header: laspy.LasHeader, record: Any) -> None:
    compress = path.suffix.lower() != ".las"
    try:
        with laspy.open(temporary, mode="w", header=header, do_compress=compress) as writer:
            writer.write_points(record)
    except (laspy.LaspyException, lazrs.LazrsError) as error:
        msg = f"Cannot write {path}: {error}. Free space, or choose another place to write to."
        raise OutputError(msg) from error


def _wkt_for_las(crs: str) -> str:
    try:
        return to_wkt(crs, "WKT1")
    except CRSMismatchError:
        return to_wkt(crs, "WKT2")


def _flagged(points: Any) -> BoolArray:
    """Points withheld or synthetic."""
    flagged: BoolArray = np.asarray(points.withheld, dtype=bool) | np.asarray(points.synthetic, dtype=bool)
    return flagged
