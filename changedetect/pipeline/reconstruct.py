"""From flight folders to point clouds with honest standard deviations."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from changedetect.crs import crs_name, make_transform
from changedetect.errors import ConfigError, InputDataError
from changedetect.io.control_points import read_control_points
from changedetect.io.las import write_points
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.block import TRACK
from changedetect.photogrammetry.calibration import describe_lens
from changedetect.photogrammetry.control import ControlPoint
from changedetect.photogrammetry.covariance import PointUncertainty, flight_difference, point_uncertainty
from changedetect.photogrammetry.dense import DensePoints, dense_points
from changedetect.photogrammetry.orientation import OrientationSettings, OrientedTogether, Step, orient_together
from changedetect.pipeline.flight_inputs import flights_below
from changedetect.pipeline.flight_run import (
    METHODS,
    FlightRun,
    FlightSource,
    default_workers,
    read_flight_source,
)
from changedetect.pipeline.flight_store import FlightStore
from changedetect.pipeline.photo_agreement import check_agreement
from changedetect.pipeline.photo_clock import with_camera_in_time
from changedetect.pipeline.queries import require_absent, require_suffix
from changedetect.pointcloud import PointCloud
from changedetect.storage import write_json
from changedetect.typing import FloatArray, IntArray, JSONObject

__all__ = [
    "FlightPart",
    "FlightPoints",
    "ReconstructOptions",
    "output_crs",
    "reconstruct",
    "write_flight",
]

logger = logging.getLogger(__name__)

#: WGS 84 with ellipsoidal heights: what GPS and the local frame refer to.
_GEODETIC = "EPSG:4979"
_REPORT_SUFFIX = ".report.json"


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """
    Choices of a reconstruction.

    Attributes
    ----------
    crs : str, optional
        Of the points; by default what site.json states, else the UTM zone with heights above the ellipsoid.
    method : str, optional
        One of `METHODS`; by default poses that another program adjusted are taken as given, all others are adjusted.
    calibrate : bool
        Estimate the lens parameters and mounting angles that the photos determine.
    dense : bool
        A point for every cell of a fine grid instead of those of the adjustment.
    work : path, optional
        Folder for the results of steps; `OUTPUT.work` by default.
    camera_file : path, optional
    control, checks : path, optional
        Lists of surveyed points marked in the photos, used or compared only; see `changedetect.io.control_points`.
    workers : int
        Threads; 0 takes all cores.
    overwrite, dry_run : bool
    """

    crs: str | None = None
    method: str | None = None
    calibrate: bool = False
    dense: bool = False
    work: Path | None = None
    camera_file: Path | None = None
    control: Path | None = None
    checks: Path | None = None
    workers: int = 0
    overwrite: bool = False
    dry_run: bool = False


@dataclass(frozen=True)
class FlightPart:
    """
    What belongs to one flight in an adjustment that may hold several.

    Attributes
    ----------
    adjustment : Adjustment
    points : array of int
        Numbers of the flight's points.
    flight : int
        Its number in the block: photos of two flights may have the same names.
    """

    adjustment: Adjustment
    points: IntArray
    flight: int = 0

    @property
    def images(self) -> IntArray:
        """Positions of the flight's photos in the block."""
        return np.flatnonzero(self.adjustment.block.flight == self.flight)


@dataclass(frozen=True)
class FlightPoints:
    """
    Points of one flight.

    Attributes
    ----------
    cloud : PointCloud
        In the output's CRS, with sigma: of each height against the flight's own surface.
    n_views : array, shape (n,), uint8
        Photos each point was seen in.
    uncertainty : PointUncertainty
    """

    cloud: PointCloud
    n_views: IntArray
    uncertainty: PointUncertainty


def reconstruct(
    directories: Sequence[Path], output: Path, options: ReconstructOptions, *, on_step: Step | None = None
) -> JSONObject:
    """
    Make points from one flight, or from several adjusted together.

    Parameters
    ----------
    directories : sequence of path
        Flight folders over one site.
    output : path
        One flight: the LAS or LAZ file. Several: a folder, in which every flight gets `NAME.laz`.
    options : ReconstructOptions
    on_step : callable, optional
        Called with how much is done, of how much, and of what.

    Returns
    -------
    report : dict
        Also written beside the points, as `NAME.report.json`.

    Raises
    ------
    InputDataError, MissingInputError
        A flight cannot be used; the message names the file and the fix.
    UsageError
        The output is no LAS or LAZ file for one flight, or looks like a file for several.
    ConfigError
        Options that exclude each other.
    CRSMismatchError, VerticalDatumError
        The points cannot be brought to the CRS asked for.
    OutputExistsError, OutputError
    """
    files = _output_files(directories, output)
    for path in files:
        require_absent(path, overwrite=options.overwrite)
    if options.dense and options.method not in (None, "adjusted", "given"):
        msg = f"Dense points need adjusted poses; leave out --dense or --method {options.method}."
        raise ConfigError(msg)
    if (options.control or options.checks) and (options.method not in (None, "adjusted") or len(directories) > 1):
        msg = "Control points need one flight and adjusted poses; leave out --gcp and --check, or the other flights."
        raise ConfigError(msg)
    if options.checks and not options.control:
        msg = "Check points (--check) need control points (--gcp): without them only the GPS places the flight."
        raise ConfigError(msg)
    if options.method not in (None, *METHODS):
        msg = f"Unknown method {options.method!r}. Choose of {', '.join(METHODS)}."
        raise ValueError(msg)
    began = time.perf_counter()
    runs = _runs(directories, files, output, options, on_step)
    options = replace(options, method=_method(runs, options))
    crs = output_crs(directories[0], runs[0].origin, options.crs)
    report: JSONObject = {
        "method": options.method,
        "crs": crs,
        "origin": [runs[0].origin.latitude, runs[0].origin.longitude, runs[0].origin.height],
        "flights": [],
    }
    for run in runs:
        _ = run.photos  # every photo is checked before hours are spent on the first flight
    if options.dry_run:
        report["flights"] = [_describe_source(run, file) for run, file in zip(runs, files, strict=True)]
        return report
    if options.method == "adjusted":
        folders = zip(runs, directories, strict=True)
        runs = [with_camera_in_time(run, path, camera_file=options.camera_file) for run, path in folders]
    together, parts = _oriented(runs, options)
    for run, part in zip(runs, parts, strict=True):
        check_agreement(run, part.adjustment, part.images, part.points)
    for run, file, part in zip(runs, files, parts, strict=True):
        _, described = write_flight(run, file, part, crs, options)
        report["flights"].append(described)
        if options.method == "adjusted":
            _adjusted_poses(run, part).save(run.store.directory / "adjusted_poses.nc")
    if runs[0].control and together is None:
        agreement = runs[0].controlled[1]
        report["control"] = None if agreement is None else agreement.describe()
    if together is not None:
        report["together"] = _describe_together(together)
    report["seconds"] = round(time.perf_counter() - began, 1)
    write_json(_report_file(output, len(runs)), report)
    return report


def write_flight(
    run: FlightRun,
    file: Path,
    part: FlightPart,
    crs: str,
    options: ReconstructOptions,
    *,
    has_bend_apart: bool = False,
) -> tuple[FlightPoints, JSONObject]:
    """
    Write the points of an adjusted flight.

    Parameters
    ----------
    run : FlightRun
    file : path
        LAS or LAZ.
    part : FlightPart
    crs : str
        Of the points.
    options : ReconstructOptions
        `dense` counts.
    has_bend_apart : bool
        The flight's bending is accounted for elsewhere (`CommonError`); standard deviations of points leave it out.

    Returns
    -------
    points : FlightPoints
    described : dict
        For a report.
    """
    points = _points(run, part, crs, is_dense=options.dense, has_bend_apart=has_bend_apart)
    file.parent.mkdir(parents=True, exist_ok=True)
    extra = {"n_views": (points.n_views.astype(np.uint8), "photos the point was seen in")}
    write_points(file, points.cloud, crs, extra=extra)
    return points, _describe_source(run, file) | _describe_result(run, part, points)


def output_crs(directory: Path, origin: LocalFrame, stated: str | None) -> str:
    """
    CRS of the points.

    Parameters
    ----------
    directory : path
        Flight folder, in which site.json (or that of the folder above) may state `crs`.
    origin : LocalFrame
    stated : str, optional
        By the user; it comes first.

    Returns
    -------
    crs : str
        Without a statement the UTM zone of the origin with heights above the WGS 84 ellipsoid, which is what GPS
        measures: nothing is guessed.
    """
    if stated is not None:
        return stated
    for path in (directory / "site.json", directory.resolve().parent / "site.json"):
        if path.is_file():
            found = json.loads(path.read_text(encoding="utf-8")).get("crs")
            if found is not None:
                return str(found)
            break
    zone = int((origin.longitude + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if origin.latitude >= 0 else 32700) + zone}+4979"


def _output_files(directories: Sequence[Path], output: Path) -> list[Path]:
    if len(directories) == 1:
        require_suffix(output, (".laz", ".las"), "Points are written as LAZ or LAS.")
        return [output]
    require_suffix(output, (), f"{len(directories)} flights are written into a folder, each as NAME.laz.")
    names = [directory.resolve().name for directory in directories]
    if len(set(names)) < len(names):
        msg = f"Flights adjusted together need folders of different names; given: {', '.join(names)}."
        raise InputDataError(msg)
    return [output / f"{name}.laz" for name in names]


def _report_file(output: Path, n_flights: int) -> Path:
    return output.with_suffix(_REPORT_SUFFIX) if n_flights == 1 else output / f"together{_REPORT_SUFFIX}"


def _runs(
    directories: Sequence[Path], files: Sequence[Path], output: Path, options: ReconstructOptions, on_step: Step | None
) -> list[FlightRun]:
    for directory in directories:
        flights = flights_below(directory)
        if flights:
            msg = (
                f"'{directory}' is no flight but holds {'some' if len(flights) > 1 else 'one'}: {', '.join(flights)}. "
                f"Name the flight, such as {directory / flights[0]}; several are adjusted together into a folder."
            )
            raise InputDataError(msg)
    work = options.work or output.with_name(f"{output.name}.work")
    settings = OrientationSettings(workers=default_workers(options.workers))
    runs: list[FlightRun] = []
    for directory, file in zip(directories, files, strict=True):
        source = read_flight_source(directory, is_causal=options.method == "paper", camera_file=options.camera_file)
        store = FlightStore(work if len(directories) == 1 else work / file.stem)
        origin = runs[0].origin if runs else source.poses.origin
        step = on_step
        if on_step is not None and len(directories) > 1:
            step = _named(on_step, file.stem)
        control = _control(options, source)
        runs.append(FlightRun(source, store, settings, origin, step, control))
    return runs


def _method(runs: Sequence[FlightRun], options: ReconstructOptions) -> str:
    """Method asked for, or what suits the sources; refuses one that a source has nothing for."""
    known = [run for run in runs if run.source.is_known]
    photos = [run for run in runs if run.source.has_heading is not None]
    method = options.method
    if method is None:
        is_given = len(known) == len(runs) == 1 and options.control is None
        return "given" if is_given else "adjusted"
    if method in ("smoothed", "paper") and (known or photos):
        msg = (
            f"--method {method} needs the logs of a flight; {[*known, *photos][0].source.label} has none (imu.csv, "
            "gps.csv). Use --method adjusted."
        )
        raise ConfigError(msg)
    if method == "given" and len(known) < len(runs):
        lacking = next(run for run in runs if not run.source.is_known)
        msg = (
            f"--method given needs poses of another program (COLMAP, OpenSfM); {lacking.source.label} has none. Use "
            "--method adjusted."
        )
        raise ConfigError(msg)
    return method


def _control(options: ReconstructOptions, source: FlightSource) -> tuple[ControlPoint, ...]:
    """Surveyed points, those used first, their marks in pixels of the photos as they are read."""
    points: list[ControlPoint] = []
    for path, is_check in ((options.control, False), (options.checks, True)):
        if path is not None:
            points += read_control_points(path, source.poses.origin, is_check=is_check)
    return tuple(replace(point, pixel=(point.pixel + 0.5) / source.reduction - 0.5) for point in points)


def _named(on_step: Step, name: str) -> Step:
    def step(done: int, total: int, label: str) -> None:
        on_step(done, total, f"{name}: {label}")

    return step


def _oriented(runs: list[FlightRun], options: ReconstructOptions) -> tuple[OrientedTogether | None, list[FlightPart]]:
    """Adjustment of every flight, or of all together."""
    if options.method is not None and options.method != "adjusted":
        results = [run.unadjusted(options.method) for run in runs]
        return None, [FlightPart(result, np.arange(len(result.points))) for result in results]
    if options.calibrate:
        runs[:] = [run.calibrated() for run in runs]
    if len(runs) == 1:
        result, _ = runs[0].controlled
        n_own = runs[0].oriented.observations.n_points - len(runs[0].control)
        return None, [FlightPart(result, np.flatnonzero(result.origin < n_own))]
    names = tuple(run.source.label for run in runs)
    flights = [(run.block, run.information, run.features, run.matching, run.oriented) for run in runs]
    apart = float(np.sqrt(2.0) * max(run.offset_std for run in runs))
    together = orient_together(flights, names, apart, runs[0].settings, on_step=runs[0].on_step)
    return together, [FlightPart(together.adjustment, points, k) for k, points in enumerate(together.points)]


def _points(run: FlightRun, part: FlightPart, crs: str, *, is_dense: bool, has_bend_apart: bool) -> FlightPoints:
    """Points of a flight in the CRS, those of the adjustment or one for every cell of a fine grid."""
    adjustment, chosen = part.adjustment, part.points
    uncertainty = point_uncertainty(adjustment, chosen)
    shared = uncertainty.sigma_local if has_bend_apart else uncertainty.sigma_shared
    places, sigma = adjustment.points[chosen], np.hypot(uncertainty.sigma_own, shared)
    n_views = adjustment.observations.n_views[chosen]
    if is_dense:
        found = _dense(run, part)
        places, n_views = found.points, found.n_views
        sigma = np.hypot(found.sigma, shared[found.nearest])
    geodetic = run.origin.to_geodetic(places)
    transform = make_transform(_GEODETIC, crs)
    easting, northing, elevation = transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2])
    usable = np.isfinite(sigma) & (sigma > 0)
    if not usable.all():
        logger.warning("%d points without a standard deviation are left out", int((~usable).sum()))
    cloud = PointCloud(easting, northing, elevation, sigma).select(usable)
    return FlightPoints(cloud, n_views[usable], uncertainty)


def _dense(run: FlightRun, part: FlightPart) -> DensePoints:
    adjustment = part.adjustment
    observations = adjustment.observations
    is_track = observations.kind == TRACK
    sigma = float(np.median(observations.sigma[is_track if is_track.any() else slice(None)]))

    def on_tile(done: int, total: int) -> None:
        if run.on_step is not None:
            run.on_step(done, total, "dense points")

    return dense_points(
        run.photos,
        adjustment.block.select(part.images),
        adjustment.points[part.points],
        sigma,
        run.block.ground_sample_distance(run.matching.ground),
        workers=run.settings.workers,
        on_tile=on_tile,
    )


def _adjusted_poses(run: FlightRun, part: FlightPart) -> CameraPoses:
    """Poses after the adjustment, in the run's frame."""
    adjustment, mine = part.adjustment, part.images
    n = len(adjustment.block)
    blocks = adjustment.camera_covariance[: 6 * n, : 6 * n].reshape(n, 6, n, 6)
    covariance: FloatArray = np.stack([blocks[k, :, k] for k in mine])
    poses, block = run.source.poses, adjustment.block
    return CameraPoses(poses.names, poses.time, block.position[mine], block.rotation[mine], covariance, run.origin)


def _describe_source(run: FlightRun, file: Path) -> JSONObject:
    source = run.source
    return {
        "flight": source.label,
        "file": str(file),
        "n_photos": len(source.poses),
        "navigation": source.navigation,
        "position_std_m": run.pose_std[0],
        "attitude_std_deg": float(np.degrees(run.pose_std[1])),
    }


def _describe_result(run: FlightRun, part: FlightPart, points: FlightPoints) -> JSONObject:
    matching, block, adjustment = run.matching, run.block, part.adjustment
    residual = adjustment.residuals
    of_flight = np.isin(adjustment.observations.point, part.points)
    size = np.sqrt(np.sum(residual[of_flight] ** 2, axis=1))
    correction = adjustment.pose_correction[part.images]
    cell = 2.0
    west, _, south, _ = points.cloud.region
    columns, rows = (points.cloud.easting - west) // cell, (points.cloud.northing - south) // cell
    n_occupied = np.unique(columns * 1e6 + rows).size
    sigma = points.cloud.sigma
    horizontal = np.sqrt(np.mean(points.uncertainty.covariance[:, [0, 1], [0, 1]]))
    return {
        "n_points": len(points.cloud),
        "points_per_m2": len(points.cloud) / (n_occupied * cell * cell),
        "ground_sample_distance_m": block.ground_sample_distance(matching.ground),
        "n_strips": int(matching.strip.max()) + 1,
        "tracks": _describe_views(matching.tracks.n_views),
        "ties": _describe_views(matching.ties.n_views)
        | {"pairs_overlapping": matching.n_pairs, "pairs_matched": len(matching.pairs)},
        "views": _describe_views(points.n_views),
        "reprojection_px": {
            "rms": float(np.sqrt(np.mean(size**2) / 2)),
            "median_length": float(np.median(size)),
            "p95_length": float(np.percentile(size, 95)),
        },
        "pixel_error_correlation": {
            "length_px": adjustment.correlation.length,
            "length_m": adjustment.correlation.length * block.ground_sample_distance(matching.ground),
            "observations_per_independent_one": adjustment.correlation.design_effect,
        },
        "pose_residual": {
            "squared_over_prior_per_parameter": adjustment.prior_chi2,
            "position_rms_m": np.sqrt(np.mean(correction[:, :3] ** 2, axis=0)).tolist(),
            "attitude_rms_deg": np.degrees(np.sqrt(np.mean(correction[:, 3:] ** 2, axis=0))).tolist(),
        },
        "lens": describe_lens(adjustment, run.settings.adjustment),
        "sigma_z_m": None if sigma is None else {
            "median": float(np.median(sigma)),
            "p95": float(np.percentile(sigma, 95)),
        },
        "systematic": points.uncertainty.systematic.describe() | {"horizontal_std_m": float(horizontal)},
    }  # fmt: skip


def _describe_views(n_views: IntArray) -> JSONObject:
    counts = np.bincount(n_views)
    return {
        "n_points": int(n_views.size),
        "n_observations": int(n_views.sum()),
        "mean_views": float(n_views.mean()) if n_views.size else 0.0,
        "histogram": {str(k): int(counts[k]) for k in range(counts.size) if counts[k]},
    }


def _describe_together(together: OrientedTogether) -> JSONObject:
    points = together.points
    return {
        "n_shared_points": together.n_shared,
        "n_moved_points": len(together.moved),
        "differences": [
            {"earlier": a, "later": a + 1} | flight_difference(together.adjustment, points[a], points[a + 1]).describe()
            for a in range(len(points) - 1)
        ],
    }


def crs_in_words(report: JSONObject) -> str:
    """Name of the CRS of a report."""
    return crs_name(str(report["crs"]))


def summary_lines(report: JSONObject) -> list[str]:
    """A report in a few lines for people."""
    lines = []
    for flight in report["flights"]:
        if "n_points" not in flight:
            lines.append(f"{flight['flight']}: {flight['n_photos']} photos; would write {flight['file']}")
            continue
        sigma: Any = flight["sigma_z_m"]
        offset = flight["systematic"]["offset_std_m"]
        lines.append(
            f"{flight['file']}: {flight['n_points']:,} points ({flight['points_per_m2']:.1f} per m2) of "
            f"{flight['n_photos']} photos, {flight['views']['mean_views']:.1f} views each, reprojection "
            f"{flight['reprojection_px']['rms']:.2f} px; heights ± {sigma['median']:.3f} m against each other, "
            f"± {offset:.2f} m as a whole"
        )
    control = report.get("control")
    if control is not None:
        n_used = len(control["points"]) - len(control["checks"]) - len(control["refused"])
        rms = control["check_rms_m"]
        judged = (
            "" if rms is None else f"; check points {rms[0]:.3f}, {rms[1]:.3f}, {rms[2]:.3f} m east, north, up (rms)"
        )
        lines.append(f"{n_used} control points used, {len(control['refused'])} refused{judged}")
    for difference in report.get("together", {}).get("differences", []):
        first, second = (report["flights"][difference[name]]["flight"] for name in ("earlier", "later"))
        lines.append(
            f"{first} to {second}: {report['together']['n_shared_points']:,} shared points; difference "
            f"± {difference['offset_std_m']:.3f} m as a whole"
        )
    return lines
