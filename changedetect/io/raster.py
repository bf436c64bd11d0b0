"""Elevation rasters as observations: the centre of every valid cell is one point."""

from __future__ import annotations

import logging
import math
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import rasterio
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning, RasterioError, RasterioIOError
from rasterio.windows import Window

from changedetect.crs import height_unit
from changedetect.errors import InputDataError
from changedetect.io.source import CHUNK_SIZE, PointSource, SourceOptions, constant_sigma, settle_crs
from changedetect.pointcloud import PointCloud

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from changedetect.typing import BoolArray, FloatArray

__all__ = ["RasterSource"]

logger = logging.getLogger(__name__)

#: Values that programs write where nothing was measured.
_FILL_VALUES = (-9999.0, -99999.0, -10000.0, -32767.0, -32768.0, 65535.0)
#: Beyond this no elevation is meant, in any unit (float32 minimum, 1e20, -1e38 ...).
_FILL_MAGNITUDE = 1e6
_METRES = frozenset({"", "m", "metre", "meter", "metres", "meters", "unknown"})
_FEET = {
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(("us survey foot", "us-ft", "us_ft", "ftus"), 1200 / 3937),
}
#: Zeros this far (m) from every other elevation are no water level but cells left blank.
_ZERO_GAP = 50.0


class RasterSource(PointSource):
    """
    Cells of an elevation raster in any format that rasterio reads.

    Parameters
    ----------
    path : path
    options : SourceOptions
        `crs`, `sigma`, `nodata` (as stored, before scale and offset) and `band` apply. Missing cells are those equal
        to `nodata`, else those the file marks (nodata value, mask, alpha); NaN cells in any case.

    Raises
    ------
    InputDataError
        Not a raster, damaged, without georeference, an image or a classified map, or its unit contradicts its CRS.
    CRSMismatchError
        Its CRS cannot be understood.

    Notes
    -----
    A cell's elevation stands at its centre. Rotated and sheared rasters are placed by their affine transform. Scale
    and offset of the band are applied.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        with _open(path) as dataset:
            _check_dataset(path, dataset, options.band)
            found = None if dataset.crs is None else dataset.crs.to_wkt(version="WKT2_2019")
            unit = dataset.units[options.band - 1]
        super().__init__(path, options, settle_crs(path, found, options.crs), None)
        self._check_unit(unit)

    def iter_chunks(self, chunk_size: int = CHUNK_SIZE) -> Iterator[PointCloud]:
        """
        Read the valid cells block by block; see `PointSource.iter_chunks`.

        Raises
        ------
        InputDataError
            The file is damaged, has no valid cell, or holds a fill value that nobody declared.
        """
        n_valid = n_zero = 0
        nearest_to_zero = math.inf
        with _open(self.path) as dataset:
            for window in _windows(dataset, self.options.band, chunk_size):
                cloud = self._read_window(dataset, window)
                if len(cloud) == 0:
                    continue
                heights = np.abs(cloud.elevation)
                n_valid += heights.size
                n_zero += heights.size - int(np.count_nonzero(heights))
                nearest_to_zero = min(nearest_to_zero, float(heights.min(initial=math.inf, where=heights > 0)))
                yield cloud
        if n_valid == 0:
            msg = (
                f"{self.path}: band {self.options.band} has no valid cell; all are nodata. "
                "Check --band and --nodata, or whether the right file was given."
            )
            raise InputDataError(msg)
        if self.options.nodata is None and n_zero and _ZERO_GAP < nearest_to_zero < math.inf:
            msg = (
                f"{self.path}: {n_zero} of {n_valid} cells are exactly 0 while all others lie at least "
                f"{nearest_to_zero:.0f} m away from it; they look like missing data that nothing marks. State "
                "--nodata 0 if they are, --nodata nan if they are ground."
            )
            raise InputDataError(msg)

    def _read_window(self, dataset: Any, window: Window) -> PointCloud:
        band = self.options.band
        try:
            stored = dataset.read(band, window=window)
            is_marked = dataset.read_masks(band, window=window) == 0
        except RasterioIOError as error:
            msg = f"{self.path} is damaged or truncated: {error}. Copy or download it again and compare its size."
            raise InputDataError(msg) from error
        valid = ~self._missing(stored, is_marked)
        self._refuse_fill(stored[valid], dataset.nodata)
        rows, cols = np.nonzero(valid)
        columns = cols + (window.col_off + 0.5)
        lines = rows + (window.row_off + 0.5)
        t = dataset.transform
        elevation = stored[valid].astype(np.float64)
        scale, offset = dataset.scales[band - 1], dataset.offsets[band - 1]
        if (scale, offset) != (1.0, 0.0):
            elevation = elevation * scale + offset
        return PointCloud(
            t.a * columns + t.b * lines + t.c,
            t.d * columns + t.e * lines + t.f,
            elevation,
            constant_sigma(self.options, elevation.size),
        )

    def _missing(self, stored: NDArray[Any], is_marked: BoolArray) -> BoolArray:
        is_nan: BoolArray = np.isnan(stored) if stored.dtype.kind == "f" else np.zeros(stored.shape, bool)
        nodata = self.options.nodata
        if nodata is None:
            return is_nan | is_marked
        if math.isnan(nodata) or not _fits(nodata, stored.dtype):
            return is_nan
        is_nodata: BoolArray = stored == stored.dtype.type(nodata)
        return is_nan | is_nodata

    def _refuse_fill(self, valid: FloatArray, declared: float | None) -> None:
        """Stop where cells that count as valid hold what programs write for missing ones."""
        if valid.size == 0:
            return
        lowest, highest = float(valid.min()), float(valid.max())
        is_fill = np.isin(valid, _FILL_VALUES) if lowest <= -9999.0 or highest >= 65535.0 else np.zeros(0, bool)
        if max(-lowest, highest) > _FILL_MAGNITUDE:
            is_fill = np.abs(valid) > _FILL_MAGNITUDE
        if not is_fill.any():
            return
        value = float(valid[np.argmax(is_fill)])
        stated = "declares no nodata value" if declared is None else f"declares nodata {declared!r}"
        msg = (
            f"{self.path}: {int(is_fill.sum())} cells of a block hold {value!r}, which looks like a mark for missing "
            f"data, but the file {stated}. If it is one, state --nodata {value!r}."
        )
        raise InputDataError(msg)

    def _check_unit(self, unit: str | None) -> None:
        """The band's unit must be that of the CRS's heights, metres where these are undeclared."""
        name = (unit or "").strip().lower()
        if not name:
            return
        declared = None if self.crs is None else height_unit(self.crs)
        metres = 1.0 if name in _METRES else _FEET.get(name)
        expected = 1.0 if declared is None else declared[1]
        if metres is not None and math.isclose(metres, expected, rel_tol=1e-9):
            return
        wanted = "metres" if declared is None else f"{declared[0]}, as its CRS says"
        msg = (
            f"{self.path}: band {self.options.band} is in {unit!r}, expected are {wanted}. State a CRS whose heights "
            "are in that unit (--crs EPSG:2263+6360 is in US survey feet, say), or convert the raster to metres."
        )
        raise InputDataError(msg)


def _open(path: Path) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # reported as an error below
            return rasterio.open(path)
    except RasterioError as error:
        msg = (
            f"{path} cannot be opened as a raster: {error}. It may be damaged, or of a format that this installation "
            "of GDAL does not read."
        )
        raise InputDataError(msg) from error


def _check_dataset(path: Path, dataset: Any, band: int) -> None:
    if dataset.count == 0 and dataset.subdatasets:
        names = ", ".join(name.rsplit(":", 1)[-1] for name in dataset.subdatasets)
        msg = (
            f"{path} holds several rasters ({names}). Extract the elevation, for example with "
            f"`gdal_translate {dataset.subdatasets[0]} elevation.tif`."
        )
        raise InputDataError(msg)
    if band > dataset.count:
        msg = f"{path} has {dataset.count} band(s); band {band} was asked for. Choose another with --band."
        raise InputDataError(msg)
    colour = dataset.colorinterp[band - 1]
    if colour in (ColorInterp.palette, ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha):
        msg = (
            f"{path}: band {band} is a picture or a classified map (colour {colour.name}), not elevations. "
            "Give the elevation model, or another --band."
        )
        raise InputDataError(msg)
    if dataset.dtypes[band - 1].startswith("complex"):
        msg = f"{path}: band {band} holds complex numbers, not elevations. Choose another with --band."
        raise InputDataError(msg)
    if dataset.transform.is_identity or dataset.transform.determinant == 0:
        msg = (
            f"{path} has no georeference: its cells have no coordinates. Add a geotransform "
            "(gdal_edit.py -a_ullr, or a world file beside it)."
        )
        raise InputDataError(msg)


def _windows(dataset: Any, band: int, chunk_size: int) -> Iterator[Window]:
    """Windows of whole stored blocks, about `chunk_size` cells each, row by row."""
    block_rows, block_cols = dataset.block_shapes[band - 1]
    n_rows = max(1, chunk_size // (dataset.width * block_rows)) * block_rows
    n_cols = dataset.width
    if block_rows * dataset.width > chunk_size:
        n_cols = min(dataset.width, max(1, chunk_size // (block_rows * block_cols)) * block_cols)
    for row in range(0, dataset.height, n_rows):
        for col in range(0, dataset.width, n_cols):
            yield Window(col, row, min(n_cols, dataset.width - col), min(n_rows, dataset.height - row))


def _fits(value: float, dtype: np.dtype[Any]) -> bool:
    """Whether a number of this type can hold `value`."""
    if dtype.kind == "f":
        return True
    info = np.iinfo(dtype)
    return value.is_integer() and info.min <= value <= info.max
