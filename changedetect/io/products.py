"""
Product folders: everything a pair or an epoch gives to the outside, published as a whole.

A folder is written beside its target and renamed into place, so that readers never see a raster of one run beside a
raster of another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from changedetect.io.cog import write_cog
from changedetect.io.netcdf import (
    CHANGE_LAYERS,
    CLASS_LAYERS,
    CLASS_NODATA,
    SURFACE_LAYERS,
    ChangeMetadata,
    SurfaceMetadata,
    write_change,
    write_surface,
)
from changedetect.io.qml import write_diverging_style, write_paletted_style, write_sequential_style
from changedetect.io.vrt import write_significant_change
from changedetect.storage import atomic_directory, sha256_of_file

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from changedetect.grid import Grid
    from changedetect.io.netcdf import ProductMetadata

__all__ = [
    "CHANGE_RASTERS",
    "SIGNIFICANT_CHANGE",
    "SURFACE_RASTERS",
    "ChangeMetadata",
    "ProductFile",
    "SurfaceMetadata",
    "write_change_products",
    "write_epoch_products",
]

#: Layers of a pair and of an epoch that are published as GeoTIFF; the NetCDF file holds all layers.
CHANGE_RASTERS = (
    "dod",
    "dod_std",
    "level_of_detection",
    "change_probability",
    "change_class",
    "resolution",
    "resolution_class",
)
SURFACE_RASTERS = ("elevation", "elevation_std", "noise_std", "age_days")
#: The virtual raster of the change where it is significant, 0 where it is not.
SIGNIFICANT_CHANGE = "dod_significant"
#: The neutral band of the change reaches over the level of detection of this share (percent) of the cells ...
_NEUTRAL_PERCENTILE = 95.0
#: ... but not beyond this multiple of the median: few bad cells must not turn a whole map grey.
_NEUTRAL_MEDIANS = 2.0


@dataclass(frozen=True)
class ProductFile:
    """A published file: name inside its folder, size in bytes, SHA-256."""

    name: str
    n_bytes: int
    sha256: str


def write_change_products(
    directory: Path,
    change: Mapping[str, NDArray[Any]],
    grid: Grid,
    meta: ChangeMetadata,
    *,
    add_files: Callable[[Path], None] | None = None,
) -> list[ProductFile]:
    """
    Publish the change between two epochs: a GeoTIFF for each of `CHANGE_RASTERS`, `dod_significant.vrt`, a `.qml` for
    each of these, and `change.nc` with all layers.

    Parameters
    ----------
    directory : path
        Folder of the pair. An existing one is replaced as a whole, or left as it is when anything fails.
    change : mapping of name to array, shape (n_rows, n_cols)
        All of `changedetect.io.netcdf.CHANGE_LAYERS`: floating point with NaN for no data, m where they are lengths;
        `change_class` and `resolution_class` uint8 (values of `CLASS_LAYERS`, 255 outside all data).
    grid : Grid
    meta : ChangeMetadata
    add_files : callable taking the folder, optional
        Adds further files (summary, objects, report) to the folder before it is published.

    Returns
    -------
    files : list of ProductFile, by name
        Everything in the folder.

    Raises
    ------
    OutputError
        The folder cannot be written.
    ValueError
        Layers are missing, unknown or of another shape than the grid.
    """
    tags = _common_tags(meta) | {
        "epoch_earlier": meta.epoch_earlier,
        "epoch_later": meta.epoch_later,
        "datetime_earlier": meta.datetime_earlier,
        "datetime_later": meta.datetime_later,
        "confidence": f"{meta.confidence:g}",
    }
    with atomic_directory(Path(directory)) as folder:
        write_change(folder / "change.nc", change, grid, meta)
        for name in CHANGE_RASTERS:
            is_class = name in CLASS_LAYERS
            write_cog(
                folder / f"{name}.tif",
                change[name],
                grid,
                nodata=CLASS_NODATA if is_class else math.nan,
                description=CHANGE_LAYERS[name].long_name,
                unit=CHANGE_LAYERS[name].unit,
                tags=tags | {"layer": name},
                categories=CLASS_LAYERS.get(name),
                overview="mode" if is_class else "average",
            )
        write_significant_change(
            folder / f"{SIGNIFICANT_CHANGE}.vrt",
            grid,
            description=f"{CHANGE_LAYERS['dod'].long_name}; 0 where below the level of detection",
            dod="dod.tif",
            change_class="change_class.tif",
        )
        _write_change_styles(folder, change, meta)
        if add_files is not None:
            add_files(folder)
        return _inventory(folder)


def write_epoch_products(
    directory: Path,
    surface: Mapping[str, NDArray[Any]],
    grid: Grid,
    meta: SurfaceMetadata,
    *,
    add_files: Callable[[Path], None] | None = None,
) -> list[ProductFile]:
    """
    Publish the surface of an epoch: `elevation.tif`, `elevation_std.tif`, `noise_std.tif`, `age_days.tif`, a `.qml`
    for each, and `surface.nc` with all layers.

    Parameters
    ----------
    directory : path
        Folder of the epoch. An existing one is replaced as a whole, or left as it is when anything fails.
    surface : mapping of name to array, shape (n_rows, n_cols)
        All of `changedetect.io.netcdf.SURFACE_LAYERS`, floating point, NaN for no data.
    grid : Grid
    meta : SurfaceMetadata
    add_files : callable taking the folder, optional
        Adds further files to the folder before it is published.

    Returns
    -------
    files : list of ProductFile, by name

    Raises
    ------
    OutputError
        The folder cannot be written.
    ValueError
        Layers are missing, unknown or of another shape than the grid.
    """
    tags = _common_tags(meta) | {"epoch": meta.epoch, "datetime": meta.datetime}
    with atomic_directory(Path(directory)) as folder:
        write_surface(folder / "surface.nc", surface, grid, meta)
        for name in SURFACE_RASTERS:
            write_cog(
                folder / f"{name}.tif",
                surface[name],
                grid,
                nodata=math.nan,
                description=SURFACE_LAYERS[name].long_name,
                unit=SURFACE_LAYERS[name].unit,
                tags=tags | {"layer": name},
            )
            limits = _limits(name, surface[name], meta.colour_limits, is_from_zero=name != "elevation")
            write_sequential_style(folder / f"{name}.qml", *limits, unit="days" if name == "age_days" else "m")
        if add_files is not None:
            add_files(folder)
        return _inventory(folder)


def _common_tags(meta: ProductMetadata) -> dict[str, str]:
    return {
        "programme": meta.programme,
        "run_id": meta.run_id,
        "config_sha256": meta.config_sha256,
        "changedetect_version": meta.changedetect_version,
    }


def _inventory(folder: Path) -> list[ProductFile]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [ProductFile(str(path.relative_to(folder)), path.stat().st_size, sha256_of_file(path)) for path in files]


def _write_change_styles(folder: Path, change: Mapping[str, NDArray[Any]], meta: ChangeMetadata) -> None:
    _write_dod_styles(folder, change["dod"], change["level_of_detection"], meta.colour_limits)
    for name in ("dod_std", "level_of_detection", "resolution"):
        limits = _limits(name, change[name], meta.colour_limits, is_from_zero=True)
        write_sequential_style(folder / f"{name}.qml", *limits, unit="m")
    limits = meta.colour_limits.get("change_probability", (0.0, 1.0))
    write_sequential_style(folder / "change_probability.qml", *limits, unit="")
    for name, classes in CLASS_LAYERS.items():
        write_paletted_style(folder / f"{name}.qml", classes)


def _write_dod_styles(
    folder: Path,
    dod: NDArray[Any],
    level_of_detection: NDArray[Any],
    colour_limits: Mapping[str, tuple[float, float]],
) -> None:
    """
    Styles of the change and of the significant change, in the programme's colours.

    A style sees values alone. So that colour means significance in the change itself too, its neutral band is about as
    wide as the largest level of detection; the significant change is neutral cell by cell.
    """
    finite = level_of_detection[np.isfinite(level_of_detection)]
    neutral = smallest = 0.0
    if finite.size:
        median, high = (float(v) for v in np.percentile(finite, (50.0, _NEUTRAL_PERCENTILE)))
        neutral, smallest = min(high, _NEUTRAL_MEDIANS * median), float(finite.min())
    if "dod" in colour_limits:
        limit = max(abs(bound) for bound in colour_limits["dod"])
    else:
        limit = _limits("dod", np.abs(dod), {}, is_from_zero=True)[1]
    write_diverging_style(folder / "dod.qml", limit, level_of_detection=neutral, unit="m")
    write_diverging_style(
        folder / f"{SIGNIFICANT_CHANGE}.qml",
        limit,
        level_of_detection=smallest,
        unit="m",
        neutral_label="below the level of detection of the cell",
    )


def _limits(
    name: str, array: NDArray[Any], colour_limits: Mapping[str, tuple[float, float]], *, is_from_zero: bool
) -> tuple[float, float]:
    """The programme's limits of a layer, else those that 96 % (98 % from zero) of its values lie within."""
    if name in colour_limits:
        return colour_limits[name]
    finite = array[np.isfinite(array)]
    low, high = (float(v) for v in np.percentile(finite, (2.0, 98.0))) if finite.size else (0.0, 0.0)
    low = 0.0 if is_from_zero else low
    return (low, high) if low < high else (low, low + 1.0)
