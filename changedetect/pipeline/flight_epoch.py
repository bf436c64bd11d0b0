"""From the flight of an epoch to its points, inside a programme: restartable, with lineage, whole or absent."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import changedetect
from changedetect.catalogue import (
    POINTS_FOLDER,
    STEPS_FOLDER,
    AnchorRecord,
    CommonErrorRecord,
    Epoch,
    Programme,
    ReconstructionRecord,
    Source,
    describe_files,
)
from changedetect.crs import make_transform
from changedetect.errors import InputDataError, MissingInputError, ModelStateError
from changedetect.navigation.frame import LocalFrame
from changedetect.photogrammetry.anchored import Anchor, AnchoredFlight, FinishedFlight, orient_to_anchors
from changedetect.photogrammetry.common_error import CommonError, common_error, error_factor, point_modes
from changedetect.photogrammetry.orientation import OrientationSettings, Step
from changedetect.pipeline.flight_inputs import check_files, flight_files, listing_sha256
from changedetect.pipeline.flight_points import FlightPart, write_flight
from changedetect.pipeline.flight_run import FlightRun, default_workers, read_flight_source
from changedetect.pipeline.flight_store import FlightStore, load_finished, save_finished
from changedetect.pipeline.manifest import utc_now
from changedetect.pipeline.photo_agreement import check_agreement
from changedetect.pipeline.photo_clock import with_camera_in_time
from changedetect.storage import atomic_directory, sha256_of_file, write_json
from changedetect.typing import FloatArray, JSONObject

__all__ = ["POINTS_FILE", "open_flight", "reconstruct_epoch"]

logger = logging.getLogger(__name__)

POINTS_FILE = "points.laz"
_ORIENTATION_FILE, _REPORT_FILE = "orientation.npz", "report.json"
_GEODETIC = "EPSG:4979"


@dataclass(frozen=True)
class _Opened:
    """A flight read from its folder, and the checksum of its files."""

    run: FlightRun
    sha256: str


def open_flight(directory: Path, store: FlightStore, *, workers: int = 0, on_step: Step | None = None) -> FlightRun:
    """
    Read and navigate the flight of an epoch, and check its photos.

    Parameters
    ----------
    directory : path
    store : FlightStore
    workers : int
        Threads; 0 takes all cores.
    on_step : callable, optional

    Raises
    ------
    MissingInputError, InputDataError, VerticalDatumError
        The flight cannot be used; the message names the file and the fix.
    """
    source = read_flight_source(directory)
    settings = OrientationSettings(workers=default_workers(workers))
    run = FlightRun(source, store, settings, source.poses.origin, on_step)
    _ = run.photos  # every photo is checked before minutes are spent
    return run


def reconstruct_epoch(
    programme: Programme, epoch: Epoch, anchor_ids: Sequence[str], *, on_step: Step | None = None
) -> JSONObject:
    """
    Make the points of an epoch's flight and put them in place of older ones, whole.

    Parameters
    ----------
    programme : Programme
    epoch : Epoch
        Whose source is a flight.
    anchor_ids : sequence of str
        Earlier epochs it is adjusted to, reconstructed already; they stay as they are.
    on_step : callable, optional
        Called with how much is done, of how much, and of what.

    Returns
    -------
    details : dict
        For the run's manifest.

    Raises
    ------
    MissingInputError, InputDataError
        The flight cannot be used; what was made before stays.

    Notes
    -----
    Poses that another program adjusted (COLMAP, OpenSfM) are taken as they are. Every step leaves its result in
    `flights/EPOCH_ID/steps/` under a key of everything it depends on, so that a run that was stopped goes on where it
    was.
    """
    config = programme.config
    opened = _opened(programme, epoch, on_step)
    warnings: list[str] = []
    if opened.run.source.is_known:
        run, anchored = opened.run, None
        finished = FinishedFlight(run.unadjusted("given"), run.origin)
    else:
        run = with_camera_in_time(opened.run, _flight(epoch).path(programme.directory))
        run = run.calibrated() if config.flights.calibrate else run
        anchors = [_anchor(programme, epoch_id) for epoch_id in anchor_ids]
        anchored = _anchored(run, epoch.epoch_id, anchors, warnings, is_demanded=config.flights.joint == "always")
        alone = FinishedFlight(run.oriented.adjustment, run.origin)
        finished = alone if anchored is None else anchored.finished
    everything = np.arange(len(finished.adjustment.points))
    part = FlightPart(finished.adjustment, everything)
    check_agreement(run, part.adjustment, part.images, part.points)
    factor = error_factor(finished.adjustment.camera_covariance)
    error = common_error(point_modes(finished.adjustment, everything, factor))
    with atomic_directory(programme.flight_directory(epoch.epoch_id) / POINTS_FOLDER) as folder:
        points, described = write_flight(
            run, folder / POINTS_FILE, part, config.crs, is_dense=config.flights.dense, has_bend_apart=True
        )
        described["file"] = POINTS_FILE
        save_finished(folder / _ORIENTATION_FILE, finished)
        records = _anchor_records(programme, anchor_ids, anchored, run.origin)
        if anchored is not None:
            described["left_out_as_changed"] = _in_crs(anchored.moved, run.origin, config.crs)[:, :2].round(2).tolist()
        write_json(folder / _REPORT_FILE, described)
        ReconstructionRecord(
            epoch_id=epoch.epoch_id,
            source_uri=_flight(epoch).uri,
            source_sha256=opened.sha256,
            settings=config.flight_settings,
            crs=config.crs,
            origin=(run.origin.latitude, run.origin.longitude, run.origin.height),
            photo_key=run.photo_key,
            matching_key=run.matching_key,
            n_photos=len(run.source.poses),
            n_points=len(points.cloud),
            region=points.cloud.region,
            common_error=_recorded(error, run.origin, config.crs),
            anchors=records,
            warnings=tuple(warnings),
            files=describe_files(folder),
            software_version=changedetect.__version__,
            created=utc_now(),
        ).write(folder)
    return {
        "n_photos": len(run.source.poses),
        "n_points": len(points.cloud),
        "sigma_z_m": described["sigma_z_m"],
        "reprojection_px": described["reprojection_px"],
        "adjusted_to": {record.epoch_id: record.n_shared for record in records if record.difference is not None},
        "left_out_as_changed": {record.epoch_id: record.n_moved for record in records},
        "warnings": warnings,
    }


def _flight(epoch: Epoch) -> Source:
    if epoch.flight is None:
        msg = f"epoch {epoch.epoch_id} is made of files of points, not of a flight"
        raise ValueError(msg)
    return epoch.flight


def _opened(programme: Programme, epoch: Epoch, on_step: Step | None) -> _Opened:
    """Read the flight; refuse one whose files are not those that were added."""
    source = _flight(epoch)
    directory = source.path(programme.directory)
    if not directory.is_dir():
        msg = (
            f"The flight of epoch {epoch.epoch_id} is not there: '{directory}' is no folder. Put it back, or add the "
            "epoch again with --overwrite."
        )
        raise MissingInputError(msg)
    complaints = check_files(directory, source)
    if complaints:
        msg = (
            f"The flight in '{directory}' is not what was added as epoch {epoch.epoch_id}: {', '.join(complaints[:5])}"
            f"{f' and {len(complaints) - 5} more' if len(complaints) > 5 else ''}. Restore the files, or add the epoch "
            "again with --overwrite."
        )
        raise InputDataError(msg)
    store = FlightStore(programme.flight_directory(epoch.epoch_id) / STEPS_FOLDER)
    run = open_flight(directory, store, workers=programme.config.machine.workers, on_step=on_step)
    names = flight_files(directory, run.source)
    if source.files is not None:
        new = sorted({*names} - {*source.files})
        if new:
            msg = (
                f"The flight in '{directory}' has files that were not there when it was added as epoch "
                f"{epoch.epoch_id}: {', '.join(new[:5])}. Remove them, or add the epoch again with --overwrite."
            )
            raise InputDataError(msg)
        return _Opened(run, source.sha256 or listing_sha256(source.files))
    return _Opened(run, listing_sha256({name: sha256_of_file(path) for name, path in names.items()}))


def _anchor(programme: Programme, epoch_id: str) -> Anchor:
    """Load an earlier flight; its features and matches are made anew where the steps were deleted."""
    found = programme.reconstruction_record(epoch_id)
    folder = programme.flight_directory(epoch_id)
    if found is None:
        msg = f"'{folder / POINTS_FOLDER}' has no manifest: the flight of epoch {epoch_id} is not reconstructed."
        raise ModelStateError(msg)
    record, store = found[0], FlightStore(folder / STEPS_FOLDER)
    finished = load_finished(folder / POINTS_FOLDER / _ORIENTATION_FILE)
    features, matching = store.load_features(record.photo_key), store.load_matching(record.matching_key)
    if features is None or matching is None:
        logger.info("%s: features of an earlier flight are made anew", epoch_id)
        run = _opened(programme, programme.epoch(epoch_id), None).run
        features, matching = run.features, run.matching
    return Anchor(epoch_id, finished, features, matching.pairs)


def _anchored(
    run: FlightRun, name: str, anchors: Sequence[Anchor], warnings: list[str], *, is_demanded: bool
) -> AnchoredFlight | None:
    """Adjust to the anchors; None, with a warning, where too little ground is shared."""
    if not anchors:
        return None
    flight = (run.block, run.information, run.features, run.matching, run.oriented)
    apart = float(np.sqrt(2.0) * run.offset_std)
    try:
        return orient_to_anchors(flight, anchors, name, run.origin, apart, run.settings, on_step=run.on_step)
    except InputDataError as error:
        if is_demanded:
            raise
        warnings.append(f"Adjusted by itself: {error} Differences to it rest on co-registration.")
        return None


def _anchor_records(
    programme: Programme, anchor_ids: Sequence[str], anchored: AnchoredFlight | None, origin: LocalFrame
) -> tuple[AnchorRecord, ...]:
    records = []
    for epoch_id in anchor_ids:
        found = programme.reconstruction_record(epoch_id)
        difference = None if anchored is None else anchored.differences.get(epoch_id)
        records.append(
            AnchorRecord(
                epoch_id=epoch_id,
                sha256="" if found is None else found[1],
                n_shared=0 if anchored is None else anchored.n_shared.get(epoch_id, 0),
                n_moved=0 if anchored is None else anchored.n_moved.get(epoch_id, 0),
                difference=None if difference is None else _recorded(difference, origin, programme.config.crs),
            )
        )
    return tuple(records)


def _in_crs(place: FloatArray, origin: LocalFrame, crs: str) -> FloatArray:
    """Easting, northing and elevation of places in a local frame, shape (n, 3)."""
    geodetic = origin.to_geodetic(place)
    return np.column_stack(make_transform(_GEODETIC, crs)(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]))


def _recorded(error: CommonError, origin: LocalFrame, crs: str) -> CommonErrorRecord:
    """Error in the programme's CRS: grid north and true north differ by less than matters to a covariance."""
    easting, northing, _ = _in_crs(np.array([[*error.centre, 0.0]]), origin, crs)[0]
    return CommonErrorRecord(
        centre=(float(easting), float(northing)),
        covariance=tuple(tuple(float(v) for v in row) for row in error.covariance),
        residual_std=error.residual_std,
    )
