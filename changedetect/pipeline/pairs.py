"""The difference of two epochs of a programme with everything that is known about its errors."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing import (
    ChangeMaps,
    ChangeObjects,
    CoherentTerm,
    ObjectSize,
    TooLittleGroundError,
    describe_resolution,
    difference_models,
    find_objects_of_change,
    object_sizes,
    resolution_classes,
    summarise,
)
from changedetect.io.zones import covered_cells, read_zones
from changedetect.pipeline.common_errors import common_terms, errors_between
from changedetect.pipeline.rasters import predict_layers, product_grid
from changedetect.pipeline.regions import join_regions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.catalogue import Programme
    from changedetect.grid import Grid
    from changedetect.models.base import SurfaceModel
    from changedetect.pipeline.learn import ModelShelf
    from changedetect.typing import BoolArray, JSONObject

__all__ = ["PairDifference", "difference_pair", "stable_cells"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PairDifference:
    """
    What two epochs of a programme differ by.

    Attributes
    ----------
    grid : Grid
    maps : ChangeMaps
    objects : ChangeObjects
        At a false discovery rate of one less the programme's confidence.
    sizes : dict of an object's number to ObjectSize
    resolution_class : array, shape (n_rows, n_cols), uint8
        As `resolution_classes` gives it.
    summary : dict
        As `summarise` gives it, and `resolution` as `describe_resolution` does.
    """

    grid: Grid
    maps: ChangeMaps
    objects: ChangeObjects
    sizes: dict[int, ObjectSize]
    resolution_class: NDArray[np.uint8]
    summary: JSONObject


def difference_pair(programme: Programme, earlier: str, later: str, models: ModelShelf) -> PairDifference:
    """
    Difference two epochs.

    Parameters
    ----------
    programme : Programme
    earlier, later : str
        Epoch ids, in the order of time.
    models : ModelShelf

    Returns
    -------
    difference : PairDifference

    Notes
    -----
    The errors of the alignments of both epochs to the programme's first enter as coherent terms. Where the programme
    names stable areas the correlated errors are estimated there, else on ground found not to have changed.
    """
    config = programme.config
    first, second = models.get(earlier), models.get(later)
    grid = product_grid(config, join_regions(first.region, second.region))
    terms = _alignment_terms(programme, (earlier, later), first, grid)
    try:
        stable = stable_cells(programme, grid)
        maps = difference_models(first, second, grid, config.differencing, stable=stable, coherent=terms)
    except TooLittleGroundError as error:
        areas = programme.stable_areas_path
        logger.warning("%s to %s: %s ('%s'); unchanged ground is found instead", earlier, later, error, areas)
        maps = difference_models(first, second, grid, config.differencing, coherent=terms)
    confidence = config.differencing.confidence
    objects = find_objects_of_change(maps, grid.resolution, confidence, 1.0 - confidence)
    sizes = object_sizes(objects, maps.dod, maps.resolution.width, grid.resolution)
    classes = resolution_classes(maps.resolution, objects, sizes)
    summary = summarise(maps, grid, objects, confidence)
    summary["resolution"] = describe_resolution(maps.resolution, classes, sizes, grid.resolution)
    return PairDifference(grid, maps, objects, sizes, classes, summary)


def stable_cells(programme: Programme, grid: Grid) -> BoolArray | None:
    """Cells in the programme's stable areas; None where it names none."""
    areas = programme.stable_areas_path
    if areas is None:
        return None
    stable = np.zeros(grid.shape, bool)
    for zone in read_zones(areas, grid.crs):
        covered = covered_cells(zone.polygon, grid)
        if covered is not None:
            window, inside = covered
            stable[window] |= inside
    return stable


def _alignment_terms(
    programme: Programme, epoch_ids: tuple[str, str], surface: SurfaceModel, grid: Grid
) -> list[CoherentTerm]:
    """Errors that whole epochs share and the other has not; ground that the earlier did not see counts as level."""
    errors = errors_between(programme, *epoch_ids)
    return common_terms(errors, predict_layers(surface, grid)["elevation"], grid) if errors else []
