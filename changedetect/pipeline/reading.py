"""From the files of an epoch to checked points in the programme's CRS and bounds."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from changedetect.catalogue import POINTS_FOLDER, Epoch, Programme, Source, SourceRecord
from changedetect.errors import InputDataError, ModelStateError
from changedetect.io.points import SourceOptions, iter_programme_chunks, open_points
from changedetect.pipeline.regions import describe_region, join_regions, unit_hint
from changedetect.pointcloud import PointCloud, check_count
from changedetect.storage import sha256_of_file
from changedetect.typing import Region

__all__ = ["EpochPoints", "read_epoch_points", "read_source"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EpochPoints:
    """
    The observations of one epoch.

    Attributes
    ----------
    cloud : PointCloud
        In the programme's CRS, inside its bounds.
    records : tuple of SourceRecord
        What was read, one for each source.
    """

    cloud: PointCloud
    records: tuple[SourceRecord, ...]


def read_epoch_points(programme: Programme, epoch: Epoch) -> EpochPoints:
    """
    Read all sources of an epoch.

    Raises
    ------
    MissingInputError
        A source does not exist.
    InputDataError
        A source has changed since it was added, cannot be used, or too few points remain.
    CRSMismatchError, VerticalDatumError
        A source's CRS is not known or cannot be brought to the programme's.
    ModelStateError
        The epoch's flight has not been reconstructed.
    """
    if epoch.flight is not None:
        return _read_flight_points(programme, epoch, epoch.flight)
    read = [read_source(programme, source) for source in epoch.sources]
    clouds = [cloud for cloud, _ in read]
    _require_same_sigma(epoch.sources, clouds)
    cloud = PointCloud.concatenate(clouds)
    check_count(len(cloud), f"epoch {epoch.epoch_id}")
    return EpochPoints(cloud, tuple(record for _, record in read))


def read_source(programme: Programme, source: Source) -> tuple[PointCloud, SourceRecord]:
    """
    Read one source, whole, checked, in the programme's CRS, and keep what lies inside its bounds.

    Raises
    ------
    MissingInputError, InputDataError, CRSMismatchError, VerticalDatumError
        As `read_epoch_points`.
    """
    path = source.path(programme.directory)
    opened = open_points(path, _options(source))
    status = path.stat()
    sha256 = sha256_of_file(path)
    if source.sha256 is not None and source.sha256 != sha256:
        msg = (
            f"'{path}' is not the file that was added: its SHA-256 is {sha256[:12]}..., and {source.sha256[:12]}... is "
            "recorded. Restore it, or add the epoch again with --overwrite."
        )
        raise InputDataError(msg)
    parts, n_read = [], 0
    extent: Region | None = None
    for chunk in iter_programme_chunks(opened, programme.config.crs):
        n_read += len(chunk)
        if len(chunk):
            extent = join_regions(extent, chunk.region)
        parts.append(_inside(chunk, programme.config.bounds))
    cloud = PointCloud.concatenate(parts)
    if len(cloud) == 0 and extent is not None and programme.config.bounds is not None:
        msg = (
            f"'{path}' lies outside the programme: its points span {describe_region(extent)} in "
            f"{programme.config.crs}, the bounds are {describe_region(programme.config.bounds)}. "
            f"{unit_hint(extent, programme.config.bounds)}Check the CRS of the "
            "file (--crs), or the bounds in programme.toml."
        )
        raise InputDataError(msg)
    logger.info("%s: %d of %d points used", path, len(cloud), n_read)
    record = SourceRecord(
        uri=source.uri,
        sha256=sha256,
        size=status.st_size,
        modified_ns=status.st_mtime_ns,
        options=source.reading_options(),
        n_read=n_read,
        n_used=len(cloud),
        crs=opened.crs,
    )
    return cloud, record


def _read_flight_points(programme: Programme, epoch: Epoch, source: Source) -> EpochPoints:
    """Points that `update` made from a flight, as one source: the flight itself."""
    folder = programme.flight_directory(epoch.epoch_id) / POINTS_FOLDER
    found = programme.reconstruction_record(epoch.epoch_id)
    if found is None:
        msg = (
            f"The flight of epoch '{epoch.epoch_id}' has not been reconstructed. Run: changedetect update "
            f"{programme.directory}"
        )
        raise ModelStateError(msg)
    record, manifest_sha256 = found
    name = next(name for name in record.files if name.endswith(".laz"))
    opened = open_points(folder / name, SourceOptions(crs=programme.config.crs))
    cloud = PointCloud.concatenate([_inside(chunk, programme.config.bounds) for chunk in opened.iter_chunks()])
    check_count(len(cloud), f"epoch {epoch.epoch_id}")
    logger.info("%s: %d of %d points used", folder / name, len(cloud), record.n_points)
    read = SourceRecord(
        uri=source.uri,
        sha256=record.source_sha256,
        size=int(record.files[name]["size"]),
        modified_ns=0,
        options=source.reading_options(),
        n_read=record.n_points,
        n_used=len(cloud),
        crs=record.crs,
        derived_sha256=manifest_sha256,
    )
    return EpochPoints(cloud, (read,))


def _options(source: Source) -> SourceOptions:
    return SourceOptions(
        crs=source.crs,
        sigma=source.sigma,
        classes=source.classes,
        columns=source.columns,
        nodata=source.nodata,
        band=source.band,
    )


def _inside(cloud: PointCloud, bounds: Region | None) -> PointCloud:
    if bounds is None:
        return cloud
    west, east, south, north = bounds
    inside = (cloud.easting >= west) & (cloud.easting <= east) & (cloud.northing >= south) & (cloud.northing <= north)
    return cloud if inside.all() else cloud.select(inside)


def _require_same_sigma(sources: Sequence[Source], clouds: Sequence[PointCloud]) -> None:
    """Weights in 1/m2 and weights of one cannot be mixed within an epoch."""
    with_sigma = [source.name for source, cloud in zip(sources, clouds, strict=True) if cloud.sigma is not None]
    without = [source.name for source, cloud in zip(sources, clouds, strict=True) if cloud.sigma is None]
    if with_sigma and without:
        msg = (
            f"Sources of one epoch either all carry a sigma or none does: {', '.join(with_sigma)} do, "
            f"{', '.join(without)} do not. State --sigma for all of them."
        )
        raise InputDataError(msg)
