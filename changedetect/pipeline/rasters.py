"""Grids of products, and surfaces on them."""

from __future__ import annotations

import numpy as np

from changedetect.config import ProgrammeConfig
from changedetect.errors import ConfigError
from changedetect.grid import Grid
from changedetect.io.netcdf import SURFACE_LAYERS
from changedetect.models.base import SurfaceModel
from changedetect.pipeline.regions import common_ground, describe_region
from changedetect.typing import FloatArray, Region

__all__ = ["predict_layers", "product_grid"]

#: A raster of more cells is refused: 20 000 x 20 000.
_MAX_CELLS = 4e8
#: Cells predicted at a time, along each side.
_BLOCK = 512


def product_grid(
    config: ProgrammeConfig, region: Region, *, resolution: float | None = None, bounds: Region | None = None
) -> Grid:
    """
    Return the grid of a product: the bounds given, the programme's, or else `region`, snapped outwards.

    All grids of a resolution have their cell borders on its multiples, so that rasters of different epochs overlay
    cell by cell even where their extents differ.

    Raises
    ------
    ConfigError
        Resolution or bounds enclose nothing, the bounds no part of `region`, or the raster would be too large to be
        meant.
    """
    cell = config.resolution if resolution is None else resolution
    west, east, south, north = bounds or config.bounds or region
    if not cell > 0.0:
        msg = f"The resolution must be above zero, not {cell:g} m."
        raise ConfigError(msg)
    if not (west < east and south < north):
        msg = f"Bounds are west east south north with west < east and south < north, not {west} {east} {south} {north}."
        raise ConfigError(msg)
    if common_ground((west, east, south, north), region) is None:
        which = "Bounds given (--bounds)" if bounds else "The bounds of the settings (see `changedetect config show`)"
        msg = (
            f"{which} hold no data: they are {describe_region((west, east, south, north))}, the data span "
            f"{describe_region(region)} in {config.crs}. Give west east south north in this CRS, or leave them out."
        )
        raise ConfigError(msg)
    n_cells = (east - west) * (north - south) / cell**2
    if n_cells > _MAX_CELLS:
        size = f"{east - west:,.0f} m x {north - south:,.0f} m at {cell:g} m"
        msg = (
            f"A raster of {size} has {n_cells:,.0f} cells; at most {_MAX_CELLS:,.0f} are made. Set bounds in "
            "programme.toml (are there stray points far from the site?) or a coarser resolution."
        )
        raise ConfigError(msg)
    return Grid.from_region((west, east, south, north), cell, config.crs)


def predict_layers(model: SurfaceModel, grid: Grid) -> dict[str, FloatArray]:
    """
    Evaluate a surface at the cell centres of a grid.

    Returns
    -------
    layers : dict of name to array, shape (n_rows, n_cols), float64
        The fields of `Prediction`.
    """
    layers = {name: np.full(grid.shape, np.nan) for name in SURFACE_LAYERS}
    for rows, cols, block in grid.blocks(_BLOCK):
        prediction = model.predict(block.coordinates())
        for name, layer in layers.items():
            layer[rows, cols] = getattr(prediction, name).reshape(block.shape)
    return layers
