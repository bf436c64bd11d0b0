"""
Cloud Optimized GeoTIFF: one quantity per file, georeferenced, self-describing, whole or absent.

The driver orders tiles and overviews in one pass over a finished raster [1]_ and forbids later edits, so everything
is set on a GeoTIFF in memory first and copied once.

References
----------
.. [1] OGC 21-026 (2023), OGC Cloud Optimized GeoTIFF Standard; GDAL, COG driver.
.. [2] OGC 19-008r4 (2019), OGC GeoTIFF Standard 1.1: vertical keys exist only beside a compound CRS.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import rasterio
from rasterio._err import CPLE_BaseError  # what GDAL's copy raises; rasterio.errors does not offer it
from rasterio.crs import CRS
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.shutil import copy as copy_raster

from changedetect.crs import crs_name, horizontal_part, is_same_horizontal, to_wkt, vertical_part
from changedetect.errors import CRSMismatchError, InputDataError, MissingInputError, OutputError
from changedetect.grid import Grid
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

__all__ = ["Category", "read_cog", "storable_crs", "write_cog"]

_CREATION_OPTIONS = {
    "BLOCKSIZE": "512",
    "COMPRESS": "DEFLATE",
    "PREDICTOR": "YES",
    "BIGTIFF": "IF_SAFER",
    "STATISTICS": "YES",
    "SPARSE_OK": "FALSE",
    "NUM_THREADS": "ALL_CPUS",
}


@dataclass(frozen=True)
class Category:
    """
    One class of a classified raster.

    Attributes
    ----------
    value : int
        0-254.
    meaning : str
        One word of letters, digits and `_ - . + @`, as CF `flag_meanings` wants it.
    label : str
        For a legend.
    colour : (red, green, blue, alpha)
        0-255 each.
    """

    value: int
    meaning: str
    label: str
    colour: tuple[int, int, int, int]


def write_cog(
    path: Path,
    array: NDArray[Any],
    grid: Grid,
    *,
    nodata: float,
    description: str,
    unit: str,
    tags: Mapping[str, str],
    categories: Sequence[Category] | None = None,
    overview: Literal["average", "mode"] = "average",
) -> None:
    """
    Write one layer as Cloud Optimized GeoTIFF, atomically; the same input gives the same bytes.

    Parameters
    ----------
    path : path
    array : array, shape (n_rows, n_cols)
        Floating point, stored as float32, or uint8. Row 0 in the north.
    grid : Grid
        Its cells are areas (AREA_OR_POINT=Area).
    nodata : float
        NaN for floating point, outside the categories for uint8.
    description : str
        Name of the band.
    unit : str
        Of the values, "m"; "1" where there is none, as UDUNITS writes it.
    tags : mapping of str to str
        Written to the file as they are.
    categories : sequence of Category, optional
        Of a uint8 raster: written as colour table and as the band's `flag_values` and `flag_meanings`.
    overview : {"average", "mode"}
        How overviews are made: means of the data, or the most frequent class. No data never spreads into either.

    Raises
    ------
    OutputError
        The file cannot be written, or does not read back as it was given.
    CRSMismatchError
        The grid's CRS is not understood.
    ValueError
        Shape or type of the array do not fit.

    Notes
    -----
    A compound CRS is stored whole. Ellipsoidal heights over a projected CRS are not expressible in GeoTIFF [2]_: the
    horizontal CRS is stored. The tag `vertical_crs` names the datum in either case, as "EPSG:5773" or
    "ellipsoid:EPSG:4979".
    """
    path = Path(path)
    band = _as_band(array, grid, categories)
    vertical = vertical_part(grid.crs)
    if vertical is not None:
        tags = {**tags, "vertical_crs": vertical}
    crs = storable_crs(grid.crs)
    profile = {
        "driver": "GTiff",
        "height": grid.n_rows,
        "width": grid.n_cols,
        "count": 1,
        "dtype": band.dtype,
        "crs": CRS.from_wkt(to_wkt(crs)),
        "transform": rasterio.Affine(*grid.transform),
        "nodata": nodata,
        "BIGTIFF": "IF_SAFER",
    }
    options = _CREATION_OPTIONS | {"OVERVIEW_RESAMPLING": overview.upper()}
    with atomic_path(path) as temporary, rasterio.Env(GDAL_PAM_ENABLED="NO"), MemoryFile() as memory:
        try:
            with memory.open(**profile) as raster:
                raster.write(band, 1)
                raster.update_tags(AREA_OR_POINT="Area", **tags)
                raster.set_band_description(1, description)
                raster.set_band_unit(1, unit)
                if categories is not None:
                    raster.write_colormap(1, {c.value: c.colour for c in categories})
                    raster.update_tags(1, **_flag_tags(categories))
            with memory.open() as raster:
                copy_raster(raster, temporary, driver="COG", **options)
            _require_intact(temporary, path, band, grid, crs)
        except (RasterioError, CPLE_BaseError) as error:
            msg = f"Cannot write {path}: {error}. Free space, or choose another place to write to."
            raise OutputError(msg) from error


def read_cog(path: Path) -> tuple[NDArray[Any], Grid, dict[str, str]]:
    """
    Read a single-layer raster at full resolution.

    Parameters
    ----------
    path : path

    Returns
    -------
    array : array, shape (n_rows, n_cols)
        As stored; no data is NaN, or the class value the file declares.
    grid : Grid
        `crs` as "EPSG:h+v" where both parts have a code, else as WKT.
    tags : dict of str to str
        Of the file and its band, with `description` and `unit`.

    Raises
    ------
    MissingInputError
        There is no such file.
    InputDataError
        It is no raster, has several bands, no CRS, or cells that are not square and north up.
    """
    path = Path(path)
    if not path.is_file():
        msg = f"No such file: {path}. Check the name, or run the step that writes it."
        raise MissingInputError(msg)
    try:
        with rasterio.open(path) as raster:
            a, b, west, d, e, north = tuple(raster.transform)[:6]
            if raster.count != 1 or raster.crs is None or b or d or a != -e:
                msg = (
                    f"{path} is not a product of this software: {raster.count} band(s), CRS {raster.crs}, transform "
                    f"{tuple(raster.transform)[:6]}; one band, a CRS and square north-up cells are expected."
                )
                raise InputDataError(msg)
            tags = raster.tags() | raster.tags(1)
            tags |= {"description": raster.descriptions[0] or "", "unit": raster.units[0] or ""}
            crs = _whole_crs(raster.crs.to_wkt(version="WKT2_2019"), tags.get("vertical_crs"))
            grid = Grid(raster.height, raster.width, west, north, a, crs)
            return raster.read(1), grid, tags
    except (RasterioError, CPLE_BaseError) as error:
        msg = f"{path} cannot be read as a raster: {error}. Restore it, or run the step that writes it again."
        raise InputDataError(msg) from error


def _as_band(array: NDArray[Any], grid: Grid, categories: Sequence[Category] | None) -> NDArray[Any]:
    if array.shape != grid.shape:
        msg = f"The array has shape {array.shape}, its grid {grid.shape}; both are (n_rows, n_cols)."
        raise ValueError(msg)
    if categories is not None and array.dtype != np.uint8:
        msg = f"A raster of categories is uint8; got {array.dtype}."
        raise ValueError(msg)
    if array.dtype == np.uint8:
        return array
    if not np.issubdtype(array.dtype, np.floating):
        msg = f"A raster is floating point or uint8; got {array.dtype}."
        raise ValueError(msg)
    return array.astype(np.float32, copy=False)


def _flag_tags(categories: Sequence[Category]) -> dict[str, str]:
    return {
        "flag_values": " ".join(str(c.value) for c in categories),
        "flag_meanings": " ".join(c.meaning for c in categories),
    }


def storable_crs(text: str) -> str:
    """Return the part of a CRS that GeoTIFF can express: all, or the horizontal part under ellipsoidal heights."""
    vertical = vertical_part(text)
    return horizontal_part(text) if vertical is not None and vertical.startswith("ellipsoid:") else text


def _whole_crs(wkt: str, vertical: str | None) -> str:
    """
    CRS of the data, from the file's and the tag `vertical_crs`.

    "EPSG:h+v", as a user writes it, where codes exist. GeoTIFF drops the datum of a site's own vertical CRS and all
    of ellipsoidal heights; the tag keeps the first as WKT. The stored CRS is returned where neither helps.
    """
    horizontal = horizontal_part(wkt)
    vertical = vertical or vertical_part(wkt)
    if vertical is None:
        return horizontal if horizontal.startswith("EPSG:") else wkt
    code = vertical.removeprefix("ellipsoid:")
    if code.startswith("EPSG:") and horizontal.startswith("EPSG:"):
        return f"{horizontal}+{code.removeprefix('EPSG:')}"
    if vertical.startswith("VERTCRS["):
        return f'COMPOUNDCRS["{crs_name(wkt)}",{to_wkt(horizontal)},{vertical}]'
    return wkt


def _require_intact(written: Path, path: Path, band: NDArray[Any], grid: Grid, crs: str) -> None:
    """Prove, before anything is replaced, that the file says what it was told."""
    with rasterio.open(written) as raster:
        stored = raster.crs.to_wkt(version="WKT2_2019") if raster.crs is not None else None
        if stored is None or not is_same_horizontal(stored, crs):
            msg = (
                f"GeoTIFF cannot store the CRS {crs_name(crs)!r}: it would read back as "
                f"{'none' if stored is None else crs_name(stored)!r}. Use one with an EPSG code."
            )
            raise CRSMismatchError(msg)
        layout = raster.tags(ns="IMAGE_STRUCTURE").get("LAYOUT")
        is_placed = tuple(raster.transform)[:6] == grid.transform and raster.shape == grid.shape
        if layout != "COG" or not is_placed or not np.array_equal(raster.read(1), band, equal_nan=True):
            msg = f"{path} did not read back as it was written and was not put in place. Check the storage, run again."
            raise OutputError(msg)
