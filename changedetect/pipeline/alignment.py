"""Aligning the points of an epoch to the surface of the programme's first epoch, on their way in."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from changedetect.catalogue import AlignmentRecord, Epoch, Programme
from changedetect.coregistration import Alignment, AlignmentError, ModelReference, align
from changedetect.errors import InputDataError, MissingInputError, ModelStateError
from changedetect.io.zones import Zone, read_zones
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.reference import ReferenceLWPR
from changedetect.pointcloud import PointCloud
from changedetect.storage import sha256_of_file
from changedetect.typing import IntArray

__all__ = ["align_epoch", "stable_area_numbers"]

logger = logging.getLogger(__name__)


def align_epoch(
    programme: Programme,
    epoch: Epoch,
    reference_id: str,
    cloud: PointCloud,
    model: LWPRSurface | ReferenceLWPR,
) -> tuple[PointCloud, AlignmentRecord]:
    """
    Estimate how an epoch is displaced from the reference surface, and move it there as the settings say.

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
    kind = "auto" if settings.transform == "none" else settings.transform
    kernel = model.own_kernel_ if isinstance(model, LWPRSurface) else model.kernel_size
    names = [f"stable area '{zone.name}'" for zone in zones]
    try:
        alignment = align(cloud, ModelReference(model, kernel), kind, area, names)
    except AlignmentError as error:
        if kind != "auto" or error.cause == "units":
            msg = f"Epoch {epoch.epoch_id} cannot be aligned to epoch {reference_id}: {error}"
            raise AlignmentError(msg, error.cause) from error
        warning = f"Not aligned, for want of {error.cause}: {error} Differences hold the offset of this epoch, if any."
        return cloud, replace(record, wording=warning, warnings=(warning,))
    is_applied = settings.transform != "none"
    record = replace(
        record,
        is_applied=is_applied,
        wording=alignment.wording() if is_applied else f"Not moved, as set. Would be: {alignment.wording()}",
        warnings=_warnings(alignment, is_applied=is_applied),
        estimate=alignment.to_dict(),
    )
    return alignment.apply(cloud) if is_applied else cloud, record


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
