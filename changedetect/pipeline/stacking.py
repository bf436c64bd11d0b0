"""All epochs of a programme as deviations from one shared surface, on one grid, with the errors of each."""

from __future__ import annotations

import logging
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from changedetect.differencing import TooLittleGroundError
from changedetect.differencing.shared_surface import FIELD_AREA
from changedetect.errors import ModelStateError
from changedetect.models.cells import Cells
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice
from changedetect.models.reference import ReferenceLWPR
from changedetect.pipeline.common_errors import common_terms, errors_apart, errors_between
from changedetect.pipeline.pairs import stable_cells
from changedetect.timeseries.deviations import EpochCells, LocalDeviation, estimate_deviation, learn_shared_surface
from changedetect.timeseries.edges import EdgeFinder
from changedetect.timeseries.errors import epoch_errors
from changedetect.timeseries.stack import Stack, StackLayers

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from changedetect.catalogue import Programme
    from changedetect.differencing.coherent import CoherentTerm
    from changedetect.differencing.error_model import ErrorModel
    from changedetect.grid import Grid
    from changedetect.pipeline.learn import Model
    from changedetect.timeseries.differences import TermsOfEpochs
    from changedetect.typing import FloatArray

__all__ = ["EpochLoader", "add_errors", "stack_epochs"]

logger = logging.getLogger(__name__)

if TYPE_CHECKING:
    EpochLoader = Callable[[str], Model]

T = TypeVar("T")

#: Effective number of observations from which a place counts as observed in reference mode.
_REFERENCE_MINIMUM = 2.0


def stack_epochs(load: EpochLoader, epoch_ids: Sequence[str], grid: Grid, directory: Path) -> Stack:
    """
    Deviations of all epochs from the surface they share.

    Parameters
    ----------
    load : callable
        Gives the model of an epoch by its id. Models are asked for one at a time and not kept.
    epoch_ids : sequence of str
        In the order of time, learned in one mode.
    grid : Grid
    directory : Path
        Scratch space, for the evidence of the epochs and the layers of the stack.

    Returns
    -------
    stack : Stack

    Raises
    ------
    ModelStateError
        The epochs were learned in different modes.
    """
    first = load(epoch_ids[0])
    if isinstance(first, LWPRSurface):
        return _adaptive_stack(load, epoch_ids, grid, directory)
    return _reference_stack(load, epoch_ids, grid, directory)


def _adaptive_stack(load: EpochLoader, epoch_ids: Sequence[str], grid: Grid, directory: Path) -> Stack:
    epochs = [_set_aside(_of_kind(load(name), LWPRSurface, name), directory / f"cells_{name}") for name in epoch_ids]
    shared = learn_shared_surface(epochs, grid.region)
    west, _, south, _ = grid.region
    lattice = Lattice(
        0.0, grid.resolution, round(south / grid.resolution), round(west / grid.resolution), grid.n_rows, grid.n_cols
    )
    side = math.sqrt(FIELD_AREA) * shared.kernel
    stacks = []
    for name in ("wide", "narrow"):
        (directory / name).mkdir()
        stacks.append(Stack(len(epochs), grid.shape, grid.resolution, side, directory / name))
    wide_stack, narrow_stack = stacks
    edges = EdgeFinder(grid.shape)
    for k, epoch in enumerate(epochs):
        wide, narrow = estimate_deviation(shared, epoch, lattice)
        edges.add(wide, narrow)
        wide_stack.put(k, _north_up(wide))
        narrow_stack.put(k, _north_up(narrow))
    at_edges = edges.edges()[::-1]
    for k in range(len(epochs)):
        wide_stack.replace(k, narrow_stack.layers(k), at_edges)
    elevation, slope = shared.terrain(lattice)
    wide_stack.terrain = (elevation[::-1], slope[::-1])
    return wide_stack


def _set_aside(model: LWPRSurface, path: Path) -> EpochCells:
    """Write the evidence of an epoch where it is read again round by round."""
    cells = model.own_cells()
    arrays = {"row": cells.row, "column": cells.column, "moments": cells.moments}
    for name, array in arrays.items():
        np.save(f"{path}_{name}.npy", array)

    def read(cell_size: float) -> Cells:
        return Cells(cell_size, *(np.load(f"{path}_{name}.npy") for name in arrays))

    return EpochCells(partial(read, cells.cell_size), model.own_kernel_)


def _north_up(local: LocalDeviation) -> StackLayers:
    return StackLayers(
        local.value[::-1], local.variance[::-1], local.freedom[::-1], local.count[::-1], local.observed[::-1]
    )


def _reference_stack(load: EpochLoader, epoch_ids: Sequence[str], grid: Grid, directory: Path) -> Stack:
    """Predictions themselves are the deviations, from zero; their mean is the terrain."""
    coordinates = grid.coordinates()
    models = [_of_kind(load(name), ReferenceLWPR, name) for name in epoch_ids]
    side = max(model.kernel_size for model in models) * math.sqrt(4.0 * math.pi)
    stack = Stack(len(models), grid.shape, grid.resolution, side, directory)
    total, number = np.zeros(grid.shape), np.zeros(grid.shape)
    height = 0.0
    for k, model in enumerate(models):
        prediction = model.predict(coordinates)
        count = model.observed(coordinates).reshape(grid.shape)
        if k == 0:  # single precision resolves heights above the site, not above the sea
            height = float(np.round(np.nanmean(prediction.elevation)))
        value = prediction.elevation.reshape(grid.shape) - height
        observed = (count >= _REFERENCE_MINIMUM) & np.isfinite(value)
        total += np.where(observed, value, 0.0)
        number += observed
        variance = prediction.elevation_std.reshape(grid.shape) ** 2
        stack.put(k, StackLayers(value, variance, np.maximum(count - 3.0, 1.0), count, observed))
    elevation = height + np.where(number > 0, total / np.maximum(number, 1.0), 0.0)
    north, east = np.gradient(elevation, grid.resolution) if min(grid.shape) > 1 else (elevation * 0.0,) * 2
    stack.terrain = (elevation, np.hypot(north, east))
    return stack


def _of_kind(model: object, kind: type[T], name: str) -> T:
    if not isinstance(model, kind):
        msg = f"Epoch '{name}' was learned in another mode than the first one; run `changedetect update`."
        raise ModelStateError(msg)
    return model


def add_errors(
    programme: Programme, epoch_ids: Sequence[str], stack: Stack, grid: Grid
) -> tuple[list[ErrorModel], TermsOfEpochs]:
    """
    Errors of every epoch beyond the independent ones, as for the differences of pairs.

    Parameters
    ----------
    programme : Programme
    epoch_ids : sequence of str
    stack : Stack
        Receives their variances.
    grid : Grid

    Returns
    -------
    models : list of ErrorModel
        Correlated errors of each epoch, found on the programme's stable areas, or on ground found not to have changed.
    terms : callable
        Gives what whole epochs share, of alignments and of flights: for the number of one epoch its share of the
        errors of all, as `errors_apart`; for two, earlier first, the errors of their difference.
    """
    stable = stable_cells(programme, grid)
    try:
        models = epoch_errors(stack, stable)
    except TooLittleGroundError as error:
        logger.warning("%s ('%s'); unchanged ground is found instead", error, programme.stable_areas_path)
        models = epoch_errors(stack, None)
    seen = np.any(stack.observed, axis=0)
    elevation: FloatArray = np.where(seen, stack.terrain[0], np.nan)

    apart = errors_apart(programme, epoch_ids)

    def terms(epochs: tuple[int, ...]) -> list[CoherentTerm]:
        if len(epochs) == 1:
            errors = apart[epochs[0]]
        else:
            earlier, later = (epoch_ids[k] for k in epochs)
            errors = errors_between(programme, earlier, later)
        return common_terms(errors, elevation, grid) if errors and seen.any() else []

    for k in range(stack.n_epochs):
        for term in terms((k,)):
            stack.coherent[k] += term.variance(stack.shape).astype(np.float32)
    return models, terms
