"""Points of an adjusted flight: in the programme's CRS, with their standard deviations, as a file and in words."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from changedetect.crs import make_transform
from changedetect.io.las import write_points
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.photogrammetry.block import TRACK
from changedetect.photogrammetry.calibration import describe_lens
from changedetect.photogrammetry.covariance import PointUncertainty, point_uncertainty
from changedetect.photogrammetry.dense import DensePoints, dense_points
from changedetect.pipeline.flight_run import FlightRun
from changedetect.pointcloud import PointCloud
from changedetect.typing import FloatArray, IntArray, JSONObject

__all__ = ["FlightPart", "FlightPoints", "adjusted_poses", "describe_source", "write_flight"]

logger = logging.getLogger(__name__)

#: WGS 84 with ellipsoidal heights: what GPS and the local frame refer to.
_GEODETIC = "EPSG:4979"


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


def write_flight(
    run: FlightRun,
    file: Path,
    part: FlightPart,
    crs: str,
    *,
    is_dense: bool = False,
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
    is_dense : bool
        A point for every cell of a fine grid instead of those of the adjustment.
    has_bend_apart : bool
        The flight's bending is accounted for elsewhere (`CommonError`); standard deviations of points leave it out.

    Returns
    -------
    points : FlightPoints
    described : dict
        For a report.
    """
    points = _points(run, part, crs, is_dense=is_dense, has_bend_apart=has_bend_apart)
    file.parent.mkdir(parents=True, exist_ok=True)
    extra = {"n_views": (points.n_views.astype(np.uint8), "photos the point was seen in")}
    write_points(file, points.cloud, crs, extra=extra)
    return points, describe_source(run, file) | _describe_result(run, part, points)


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


def adjusted_poses(run: FlightRun, part: FlightPart) -> CameraPoses:
    """Return the poses after the adjustment, in the run's frame."""
    adjustment, mine = part.adjustment, part.images
    n = len(adjustment.block)
    blocks = adjustment.camera_covariance[: 6 * n, : 6 * n].reshape(n, 6, n, 6)
    covariance: FloatArray = np.stack([blocks[k, :, k] for k in mine])
    poses, block = run.source.poses, adjustment.block
    return CameraPoses(poses.names, poses.time, block.position[mine], block.rotation[mine], covariance, run.origin)


def describe_source(run: FlightRun, file: Path) -> JSONObject:
    """Return what is known of a flight before its points are made, and their file."""
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
