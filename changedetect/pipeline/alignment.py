"""Aligning the points of an epoch to the surface of the programme's first epoch, on their way in."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely

from changedetect.catalogue import AlignmentRecord, Epoch, Programme
from changedetect.coregistration import (
    Alignment,
    AlignmentError,
    Kind,
    ModelReference,
    align,
    align_across_resolutions,
    differ_in_resolution,
)
from changedetect.errors import InputDataError, MissingInputError, ModelStateError
from changedetect.io.zones import Zone, read_zones
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.reference import ReferenceLWPR
from changedetect.pointcloud import PointCloud
from changedetect.storage import sha256_of_file
from changedetect.typing import IntArray

__all__ = ["align_epoch", "stable_area_numbers"]

logger = logging.getLogger(__name__)

#: Surfaces and photos contradict each other beyond this many standard errors, if it is more than this, m.
_CONTRADICTION, _WORTH_TELLING = 4.0, 0.05


def align_epoch(
    programme: Programme,
    epoch: Epoch,
    reference_id: str,
    cloud: PointCloud,
    model: LWPRSurface | ReferenceLWPR,
) -> tuple[PointCloud, AlignmentRecord]:
    """
    Estimate how an epoch is displaced from the reference surface, and move it there as the settings say.

    A flight that was adjusted to the photos of an earlier one lies as that one does, far more exactly than surfaces can
    tell; unless a kind of transform is demanded, it is moved as that one was, and the estimate is a check.

    Parameters
    ----------
    programme : Programme
    epoch : Epoch
    reference_id : str
        The first epoch.
    cloud : PointCloud
        Points of the epoch, in the programme's CRS.
    model : LWPRSurface or ReferenceLWPR
        Of the first epoch.

    Returns
    -------
    cloud : PointCloud
        Moved, or as given.
    record : AlignmentRecord

    Raises
    ------
    AlignmentError
        Elevations are in another unit; or a kind of transform was demanded that the epoch does not allow.
    MissingInputError, InputDataError, CRSMismatchError
        The file of stable areas cannot be used.
    """
    settings = programme.config.coregistration
    found = programme.state_record(reference_id)
    if found is None:
        msg = f"'{programme.state_directory(reference_id)}' has no manifest: the reference epoch is not learned."
        raise ModelStateError(msg)
    areas, area = programme.stable_areas_path, None
    zones = () if areas is None else _stable_areas(areas, programme.config.crs)
    if zones:
        area = stable_area_numbers(cloud, zones)
    record = AlignmentRecord(
        reference=reference_id,
        reference_sha256=found[0].evidence_sha256,
        stable_areas_sha256=None if areas is None else sha256_of_file(areas),
        is_applied=False,
        wording=f"Has the very points of epoch {reference_id}, nothing to align.",
        warnings=(),
        estimate=None,
    )
    if _is_same(cloud, model):
        return cloud, record
    bound = _bound_to(programme, epoch) if settings.transform == "auto" else None
    kind = "auto" if settings.transform == "none" else settings.transform
    kernel = model.own_kernel_ if isinstance(model, LWPRSurface) else model.kernel_size
    names = [f"stable area '{zone.name}'" for zone in zones]
    try:
        alignment = _estimated(cloud, model, kernel, kind, area, zones, names)
    except AlignmentError as error:
        if bound is not None:
            return _as_bound(programme, cloud, record, bound, None)
        named = f" (Stable areas: '{areas}'.)" if areas is not None and error.cause == "stable ground" else ""
        if kind != "auto" or error.cause == "units":
            msg = f"Epoch {epoch.epoch_id} cannot be aligned to epoch {reference_id}: {error}{named}"
            raise AlignmentError(msg, error.cause) from error
        warning = (
            f"Not aligned, for want of {error.cause}: {error} Differences hold the offset of this epoch, if any.{named}"
        )
        return cloud, replace(record, wording=warning, warnings=(warning,))
    if bound is not None:
        return _as_bound(programme, cloud, record, bound, alignment)
    is_applied = settings.transform != "none"
    record = replace(
        record,
        is_applied=is_applied,
        wording=alignment.wording() if is_applied else f"Not moved, as set. Would be: {alignment.wording()}",
        warnings=_warnings(alignment, is_applied=is_applied),
        estimate=alignment.to_dict(),
    )
    return alignment.apply(cloud) if is_applied else cloud, record


def _estimated(
    cloud: PointCloud,
    model: LWPRSurface | ReferenceLWPR,
    kernel: float,
    kind: Kind | Literal["auto"],
    area: IntArray | None,
    zones: tuple[Zone, ...],
    names: list[str],
) -> Alignment:
    """By way of the denser epoch's surface where one is much denser than the other and that succeeds."""
    if isinstance(model, LWPRSurface) and differ_in_resolution(cloud, model):
        area_of = partial(stable_area_numbers, zones=zones) if zones else None
        try:
            return align_across_resolutions(cloud, model, kind, area_of, names)
        except AlignmentError as error:
            logger.info("The epochs' resolutions differ; %s Aligned point to surface.", error)
    return align(cloud, ModelReference(model, kernel), kind, area, names)


def _bound_to(programme: Programme, epoch: Epoch) -> tuple[str, float] | None:
    """Earlier flight whose photos bind this one, and how well its height difference is known, m."""
    found = None if epoch.flight is None else programme.reconstruction_record(epoch.epoch_id)
    for anchor in () if found is None else found[0].anchors:
        if anchor.difference is not None:
            return anchor.epoch_id, float(np.sqrt(anchor.difference.covariance[0][0]))
    return None


def _as_bound(
    programme: Programme,
    cloud: PointCloud,
    record: AlignmentRecord,
    bound: tuple[str, float],
    check: Alignment | None,
) -> tuple[PointCloud, AlignmentRecord]:
    """Leave a flight where the photos of another put it, moved as that one was."""
    anchor_id, std = bound
    wording = f"Adjusted to the photos of epoch {anchor_id}, height difference ± {std:.3f} m"
    found = programme.state_record(anchor_id)
    moved = None if found is None or found[0].alignment is None else found[0].alignment.applied()
    if moved is not None:
        wording = f"{wording}; moved as that one. {moved.wording()}"
        taken = replace(record, is_applied=True, wording=wording, estimate=moved.to_dict(), shared_with=anchor_id)
        return moved.apply(cloud), taken
    details: dict[str, Any] = {"shared_with": anchor_id, "wording": f"{wording}; not moved."}
    if check is not None:
        details["estimate"] = check.to_dict()
        details["wording"] = f"{wording}; not moved. Surfaces alone: {check.wording()}"
        details["warnings"] = _contradiction(check, std, anchor_id)
    return cloud, replace(record, **details)


def _contradiction(check: Alignment, std: float, anchor_id: str) -> tuple[str, ...]:
    """Warn where surfaces and photos disagree on the height by more than both allow."""
    names = list(check.transform.names)
    up = check.transform["up"]
    error = float(np.hypot(check.standard_errors[names.index("up")], std))
    if abs(up) <= max(_CONTRADICTION * error, _WORTH_TELLING):
        return ()
    return (
        f"unchanged ground lies {-up:+.3f} ± {error:.3f} m off epoch {anchor_id}, to whose photos this flight was "
        "adjusted; check which of both flights has photos of another site or camera among its own",
    )


def stable_area_numbers(cloud: PointCloud, zones: tuple[Zone, ...]) -> IntArray:
    """
    Number of the stable area each point lies in, -1 outside all; the last where areas overlap.

    Parameters
    ----------
    cloud : PointCloud
    zones : tuple of Zone
        In the CRS of the points.

    Returns
    -------
    area : array, shape (n,), int64
    """
    area = np.full(len(cloud), -1, dtype=np.int64)
    for number, zone in enumerate(zones):
        west, south, east, north = zone.polygon.bounds
        near = np.flatnonzero(
            (cloud.easting >= west) & (cloud.easting <= east) & (cloud.northing >= south) & (cloud.northing <= north)
        )
        shapely.prepare(zone.polygon)
        inside = shapely.contains_xy(zone.polygon, cloud.easting[near], cloud.northing[near])
        area[near[inside]] = number
    return area


def _stable_areas(path: Path, crs: str) -> tuple[Zone, ...]:
    """Read the polygons, naming the setting they come from where they cannot be used."""
    try:
        return read_zones(path, crs)
    except (MissingInputError, InputDataError) as error:
        msg = f"The stable areas of the setting coregistration.stable_areas cannot be used: {error}"
        raise type(error)(msg) from error


def _is_same(cloud: PointCloud, model: LWPRSurface | ReferenceLWPR) -> bool:
    """Whether the points are those that a model of one epoch was learned from, in whatever order."""
    if not isinstance(model, LWPRSurface):
        return False
    again = LWPRSurface(model.settings, model.memory_days, model.resolution)
    cells = model.evidence_.cells(0.0)
    if round(float(cells.moments[:, 0].sum())) != len(cloud):
        return False
    again.fit(cloud.coordinates, cloud.elevation, cloud.sigma)
    own = again.evidence_.cells(0.0)
    return own.moments.shape == cells.moments.shape and all(
        np.array_equal(one, other)
        for one, other in ((own.row, cells.row), (own.column, cells.column), (own.moments, cells.moments))
    )


def _warnings(alignment: Alignment, *, is_applied: bool) -> tuple[str, ...]:
    warnings = list(alignment.remarks)
    if alignment.vertical_step is not None:
        done = "It was taken out." if is_applied else "It was left in, as set."
        warnings.insert(0, f"{alignment.vertical_step} {done}")
    return tuple(warnings)
