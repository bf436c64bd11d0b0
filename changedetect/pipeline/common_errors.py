"""
Errors that all of an epoch shares, traced to where they come from.

An epoch's heights carry the error of the transform that moved it, or of the flight it was made from; a flight adjusted
to another carries that one's errors and a small one of its own. What two epochs have in common cancels in their
difference, the rest enters as coherent terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from changedetect.differencing import CoherentTerm

if TYPE_CHECKING:
    from changedetect.catalogue import AnchorRecord, CommonErrorRecord, Programme
    from changedetect.coregistration import Alignment
    from changedetect.grid import Grid
    from changedetect.typing import FloatArray

__all__ = ["EpochError", "common_terms", "errors_apart", "errors_between", "errors_of"]


@dataclass(frozen=True)
class EpochError:
    """
    One independent error of a whole epoch.

    Attributes
    ----------
    source : tuple of str
        What it comes from: ("transform", epoch), ("flight", epoch) or ("photos", epoch, epoch it was adjusted to).
    content : Alignment or CommonErrorRecord
        With its covariance.
    factor : float
        That the covariance counts with.
    """

    source: tuple[str, ...]
    content: Alignment | CommonErrorRecord
    factor: float = 1.0


def errors_between(programme: Programme, earlier: str, later: str) -> tuple[EpochError, ...]:
    """
    Errors of the difference of two epochs: those that one has and the other has not.

    Parameters
    ----------
    programme : Programme
    earlier, later : str
        Epoch ids.
    """
    bound = None if _transform(programme, later) is not None else _anchor(programme, later, earlier)
    if bound is not None and bound.difference is not None and _transform(programme, earlier) is None:
        return (EpochError(("photos", later, earlier), bound.difference),)
    first, second = errors_of(programme, earlier), errors_of(programme, later)
    common = {error.source for error in first} & {error.source for error in second}
    return tuple(error for error in (*first, *second) if error.source not in common)


def errors_of(programme: Programme, epoch_id: str) -> tuple[EpochError, ...]:
    """
    Errors that all of an epoch shares.

    Parameters
    ----------
    programme : Programme
    epoch_id : str

    Notes
    -----
    An epoch moved by a transform of its own lies as the reference does, but for the error of the transform. A flight
    adjusted to the photos of another lies as that one does, but for the error of that adjustment. A flight that was
    neither moved nor adjusted lies where its GPS put it. Files of points that were not moved are taken as they are.
    """
    transform = _transform(programme, epoch_id)
    if transform is not None:
        alignment, reference = transform
        return (EpochError(("transform", epoch_id), alignment), *errors_of(programme, reference))
    found = _flight(programme, epoch_id)
    if found is None:
        return ()
    for anchor in found[1]:
        if anchor.difference is not None:
            own = EpochError(("photos", epoch_id, anchor.epoch_id), anchor.difference)
            return (own, *errors_of(programme, anchor.epoch_id))
    return (EpochError(("flight", epoch_id), found[0]),)


def errors_apart(programme: Programme, epoch_ids: Sequence[str]) -> list[tuple[EpochError, ...]]:
    """
    Errors of every epoch of a series, as if no two epochs had one in common.

    Parameters
    ----------
    programme : Programme
    epoch_ids : sequence of str

    Returns
    -------
    errors : list of tuple of EpochError
        One tuple an epoch.

    Notes
    -----
    Only differences of epochs mean anything. An error e that k of n epochs share adds e sum_S w_i to a contrast of
    weights w, sum w = 0: nothing where k = n, and as much as one of the other n - k epochs sharing -e. With m the
    number of epochs on the smaller side, (sum_S w_i)^2 <= m sum_S w_i^2 there (Cauchy and Schwarz): an error of its
    own of m times the variance for each of these makes the variance of no contrast too small, and is exact for m = 1,
    as where every flight was adjusted to the first one.
    """
    found = [errors_of(programme, epoch_id) for epoch_id in epoch_ids]
    sharers: dict[tuple[str, ...], list[int]] = {}
    for k, errors in enumerate(found):
        for error in errors:
            sharers.setdefault(error.source, []).append(k)
    by_source = {error.source: error for errors in found for error in errors}
    apart: list[list[EpochError]] = [[] for _ in epoch_ids]
    for source, inside in sharers.items():
        outside = [k for k in range(len(found)) if k not in inside]
        side = min(inside, outside, key=len)
        for k in side:
            apart[k].append(replace(by_source[source], factor=float(len(side))))
    return [tuple(errors) for errors in apart]


def common_terms(errors: Sequence[EpochError], elevation: FloatArray, grid: Grid) -> list[CoherentTerm]:
    """
    Errors as functions of place.

    Parameters
    ----------
    errors : sequence of EpochError
    elevation : array, shape (n_rows, n_cols), m
        Terrain; where it is NaN the ground counts as level.
    grid : Grid
    """
    steep_north, steep_east = (
        np.gradient(elevation, -grid.resolution, grid.resolution)
        if min(grid.shape) > 1
        else (np.zeros(grid.shape), np.zeros(grid.shape))
    )
    slope_east, slope_north = np.nan_to_num(steep_east).ravel(), np.nan_to_num(steep_north).ravel()
    height = np.where(np.isfinite(elevation), elevation, np.nanmedian(elevation)).ravel()
    easting, northing = grid.coordinates()
    terms = []
    for error in errors:
        content = error.content
        if error.source[0] == "transform":
            design = content.offset_design(easting, northing, slope_east, slope_north, height)  # type: ignore[union-attr]
        else:
            centre = content.centre  # type: ignore[union-attr]
            east, north = easting - centre[0], northing - centre[1]
            columns = [np.ones(east.size), east, north, -slope_east, -slope_north, east**2, east * north, north**2]
            design = np.column_stack(columns[: len(content.covariance)])
        terms.append(CoherentTerm(design, error.factor * np.asarray(content.covariance, dtype=np.float64)))
    return terms


def _transform(programme: Programme, epoch_id: str) -> tuple[Alignment, str] | None:
    """The transform estimated for an epoch and applied to it, and the reference; None where there is none."""
    found = programme.state_record(epoch_id)
    record = None if found is None else found[0].alignment
    if record is None or record.shared_with is not None:
        return None
    alignment = record.applied()
    return None if alignment is None else (alignment, record.reference)


def _flight(programme: Programme, epoch_id: str) -> tuple[CommonErrorRecord, tuple[AnchorRecord, ...]] | None:
    found = programme.reconstruction_record(epoch_id)
    return None if found is None else (found[0].common_error, found[0].anchors)


def _anchor(programme: Programme, epoch_id: str, other: str) -> AnchorRecord | None:
    """How a flight was adjusted to another; None where it was not."""
    found = _flight(programme, epoch_id)
    anchors = () if found is None else found[1]
    return next((anchor for anchor in anchors if anchor.epoch_id == other), None)
