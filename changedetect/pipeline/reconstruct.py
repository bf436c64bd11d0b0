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

from changedetect.crs import crs_name
from changedetect.errors import ConfigError, InputDataError
from changedetect.io.control_points import read_control_points
from changedetect.navigation.frame import LocalFrame
from changedetect.photogrammetry.control import ControlPoint
from changedetect.photogrammetry.covariance import flight_difference
from changedetect.photogrammetry.orientation import OrientationSettings, OrientedTogether, Step, orient_together
from changedetect.pipeline.flight_inputs import flights_below
from changedetect.pipeline.flight_points import FlightPart, adjusted_poses, describe_source, write_flight
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
from changedetect.storage import write_json
from changedetect.typing import JSONObject

__all__ = [
    "ReconstructOptions",
    "output_crs",
    "reconstruct",
]

logger = logging.getLogger(__name__)

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
        report["flights"] = [describe_source(run, file) for run, file in zip(runs, files, strict=True)]
        return report
    if options.method == "adjusted":
        folders = zip(runs, directories, strict=True)
        runs = [with_camera_in_time(run, path, camera_file=options.camera_file) for run, path in folders]
    together, parts = _oriented(runs, options)
    for run, part in zip(runs, parts, strict=True):
        check_agreement(run, part.adjustment, part.images, part.points)
    for run, file, part in zip(runs, files, parts, strict=True):
        _, described = write_flight(run, file, part, crs, is_dense=options.dense)
        report["flights"].append(described)
        if options.method == "adjusted":
            adjusted_poses(run, part).save(run.store.directory / "adjusted_poses.nc")
    if runs[0].control and together is None:
        agreement = runs[0].controlled[1]
        report["control"] = None if agreement is None else agreement.describe()
    if together is not None:
        report["together"] = _describe_together(together)
    report["seconds"] = round(time.perf_counter() - began, 1)
    write_json(_report_file(output, len(runs)), report)
    return report


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
