"""
Photos without logs: Brighton Beach (drone, 18 photos) against the cloud another program made of the same photos, and
Seneca (fixed wing, 40 photos).

Points are moved onto the reference by a similarity (robust point-to-plane ICP); then heights are compared with the
median of the reference's points within 0.25 m. Both programs estimate the lens from near-vertical photos, which leaves
a bending of the ground nearly free: what remains after a quadratic surface is given too, and how far the camera heights
of either bend against the barometer's. Coverage is that of 95 % intervals by sigma_z, and with the reference's own
bending in the budget too: its standard error is that of the same photos adjusted as the reference was, positions good
to 10 m, no angles, every lens parameter free.

Run: CHANGEDETECT_DATA=DIR python tests/benchmarks/photos.py [--work DIR] [--workers 2] [--dense]
"""

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import laspy
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from changedetect.crs import make_transform
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.adjustment import LENS_PARAMETERS, adjust
from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.common_error import common_error, error_factor, point_modes
from changedetect.photogrammetry.covariance import point_uncertainty
from changedetect.photogrammetry.orientation import OrientationSettings
from changedetect.photogrammetry.priors import pose_information
from changedetect.pipeline.flight_run import FlightRun, read_flight_source
from changedetect.pipeline.flight_store import FlightStore
from changedetect.pipeline.reconstruct import ReconstructOptions, output_crs, reconstruct

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
_RADIUS = 0.25
#: Prior of a lens of which nothing is known: focal length, cx, cy, k1, k2, k3, p1, p2, aspect.
_LOOSE_LENS = (0.3, 50.0, 50.0, 0.3, 0.3, 0.3, 0.01, 0.01, 0.01)
_SAMPLE = 60_000


@dataclass(frozen=True)
class Judged:
    """Heights against the reference, m."""

    n: int
    nmad: float
    p95: float
    bent: float
    covered: float
    covered_with_reference: float
    left_covered: float
    bend: np.ndarray
    bend_distance: float


def nmad(values):
    """Robust standard deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def read_points(path):
    """Coordinates of a LAS file and sigma_z where it has one, shape (n, 4)."""
    cloud = laspy.read(path)
    sigma = cloud["sigma_z"] if "sigma_z" in cloud.point_format.dimension_names else np.zeros(len(cloud.x))
    points = np.column_stack([cloud.x, cloud.y, cloud.z, sigma])
    if len(points) > _SAMPLE:
        points = points[np.random.default_rng(0).choice(len(points), _SAMPLE, replace=False)]
    return points


def moved_onto(points, reference, steps=40):
    """Points after the similarity that takes them to the reference: robust point-to-plane ICP with scale."""
    tree = cKDTree(reference)
    moved = points + (np.median(reference, axis=0) - np.median(points, axis=0)) * [0, 0, 1]
    centre = moved.mean(axis=0)
    for step in range(steps):
        reach = max(6.0 * 0.85**step, 0.6)
        distance, near = tree.query(moved, k=8)
        close = distance[:, 0] < reach
        patch = reference[near[close]]
        middle = patch.mean(axis=1)
        spread = np.einsum("nki,nkj->nij", patch - middle[:, None], patch - middle[:, None])
        normal = np.linalg.eigh(spread)[1][:, :, 0]
        arm = moved[close] - centre
        error = np.sum((middle - moved[close]) * normal, axis=1)
        design = np.column_stack([normal, np.cross(arm, normal), np.sum(arm * normal, axis=1)])
        weight = 1 / (1 + (error / (2 * max(nmad(error), 0.02))) ** 2)
        x = np.linalg.lstsq(design * weight[:, None], error * weight, rcond=None)[0]
        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        moved = centre + x[:3] + (1 + x[6]) * (moved - centre) @ turn.T
        centre = centre + x[:3]
    return moved


def compare(points, reference_path, bending, reference_bending):
    """
    Heights of points (east, north, up, sigma) against a reference, after a similarity and a quadratic surface too.

    `bending` and `reference_bending`, 3 x 3, are the covariances of either's bending: of e^2, e n, n^2.
    """
    reference = laspy.read(reference_path)
    reference = np.column_stack([reference.x, reference.y, reference.z])
    moved, sigma = moved_onto(points[:, :3], reference), points[:, 3]
    near = cKDTree(reference[:, :2]).query_ball_point(moved[:, :2], _RADIUS)
    height = np.array([np.median(reference[k, 2]) if len(k) >= 3 else np.nan for k in near])
    good = np.isfinite(height)
    error = moved[good, 2] - height[good]
    east, north = (moved[good, :2] - moved[good, :2].mean(axis=0)).T
    design = np.column_stack([np.ones(east.size), east, north, east**2, east * north, north**2])
    left, weight = error, np.ones(error.size)
    for _ in range(20):
        fit = np.linalg.lstsq(design * weight[:, None], error * weight, rcond=None)[0]
        left = error - design @ fit
        weight = 1 / (1 + (left / (2 * nmad(left))) ** 2)
    away = np.abs(error - np.median(error))
    bent = design[:, 3:] - design[:, :3] @ np.linalg.lstsq(design[:, :3], design[:, 3:], rcond=None)[0]
    both = np.sqrt(sigma[good] ** 2 + np.einsum("ni,ij,nj->n", bent, reference_bending, bent))
    alone = np.sqrt(np.maximum(sigma[good] ** 2 - np.einsum("ni,ij,nj->n", bent, bending, bent), 0.02**2))
    return Judged(
        int(good.sum()),
        nmad(error),
        float(np.percentile(away, 95)),
        nmad(left),
        float(np.mean(away < 1.96 * sigma[good])),
        float(np.mean(away < 1.96 * both)),
        float(np.mean(np.abs(left - np.median(left)) < 1.96 * alone)),
        1e3 * fit[3:],
        float(fit[3:] @ np.linalg.solve(bending + reference_bending, fit[3:])),
    )


def as_the_reference(folder, work, workers):
    """Points of the same photos adjusted with hardly any priors, shape (n, 4); covariance of their bending and ours."""
    source = read_flight_source(folder)
    run = FlightRun(source, FlightStore(work), OrientationSettings(workers=workers), source.poses.origin)
    n = len(source.poses)
    loose = np.tile(np.diag([10.0**2] * 3 + [np.radians(20.0) ** 2] * 3), (n, 1, 1))
    information = pose_information(replace(source.poses, covariance=loose), correlation_time=0.0)
    settings = replace(
        run.settings.adjustment, lens=LENS_PARAMETERS[:8], lens_std=_LOOSE_LENS, max_share=1.0, min_views=3
    )
    oriented = run.oriented
    solved = adjust(run.block, oriented.observations, information, settings, start=oriented.adjustment.block)
    everything = np.arange(len(solved.points))
    error = common_error(point_modes(solved, everything, error_factor(solved.camera_covariance)))
    geodetic = run.origin.to_geodetic(solved.points)
    crs = output_crs(folder, run.origin, None)
    places = make_transform("EPSG:4979", crs)(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2])
    points = np.column_stack([*places, point_uncertainty(solved, everything).sigma])
    own = oriented.adjustment
    ours = common_error(point_modes(own, np.arange(len(own.points)), error_factor(own.camera_covariance)))
    return points, error.covariance[5:, 5:], ours.covariance[5:, 5:], float(solved.block.intrinsics[0, 0])


def bend_of_cameras(folder, work):
    """Curvature of adjusted minus stated camera heights, mm per m2, and what is left of them, m."""
    stated = read_flight_source(folder).poses
    adjusted = CameraPoses.load(work / "adjusted_poses.nc")
    up = adjusted.position[:, 2] - stated.position[:, 2]
    east, north = (stated.position[:, :2] - stated.position[:, :2].mean(axis=0)).T
    design = np.column_stack([np.ones(east.size), east, north, east**2 + north**2])
    fit = np.linalg.lstsq(design, up, rcond=None)[0]
    return 1e3 * fit[3], float(np.std(up - design @ fit))


def draw(folder, output, work, picture, cell):
    """Height, hillshade and colour of the points, each cell's mean, in one picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    cloud = laspy.read(output)
    crs = json.loads(output.with_suffix(".report.json").read_text())["crs"]
    x, y, z = (np.asarray(axis) for axis in (cloud.x, cloud.y, cloud.z))
    source, poses = read_flight_source(folder), CameraPoses.load(work / "adjusted_poses.nc")
    longitude, latitude, height = make_transform(crs, "EPSG:4979")(x, y, z)
    enu = poses.origin.to_enu(latitude, longitude, height)
    with np.load(work / "adjustment.npz") as stored:
        block = replace(ImageBlock.from_poses(poses, source.camera), intrinsics=stored["intrinsics"])
    colour, nearest = np.zeros((x.size, 3)), np.full(x.size, np.inf)
    for image, path in enumerate(source.paths):
        pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)[:, :, ::-1]
        seen = block.project(enu, image)
        away = np.hypot(*(enu[:, :2] - block.position[image, :2]).T)
        take = block.is_inside(seen, image) & (away < nearest)
        at = np.rint(seen[take, :2]).astype(int)
        colour[take], nearest[take] = pixels[at[:, 1], at[:, 0]], away[take]
    row, column = ((y.max() - y) / cell).astype(int), ((x - x.min()) / cell).astype(int)
    shape = row.max() + 1, column.max() + 1
    count = np.bincount(row * shape[1] + column, minlength=shape[0] * shape[1]).reshape(shape)

    def mean(values):
        total = np.bincount(row * shape[1] + column, values, minlength=count.size).reshape(shape)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    surface = mean(z)
    by_row, by_column = np.gradient(surface, cell)
    shade = (1 - 0.7 * by_column + 0.7 * by_row) / np.sqrt(1 + by_column**2 + by_row**2)
    painted = np.nan_to_num(np.dstack([mean(colour[:, k]) for k in range(3)]), nan=255).astype(np.uint8)
    _, axes = plt.subplots(1, 3, figsize=(24, 9))
    axes[0].imshow(surface, cmap="terrain", vmin=np.percentile(z, 1), vmax=np.percentile(z, 99))
    axes[1].imshow(shade, cmap="gray", vmin=0.2, vmax=1.6)
    axes[2].imshow(painted)
    plt.tight_layout()
    plt.savefig(picture, dpi=60)
    plt.close()


def run(name, folder, workers, *, dense, cell):
    """Reconstruct one set and print what came of it."""
    output, work = folder / f"{name}{'_dense' if dense else ''}.laz", folder / f"{name}.work"
    start, busy = time.perf_counter(), time.process_time()
    report = reconstruct(
        [DATA / name], output, ReconstructOptions(work=work, workers=workers, dense=dense, overwrite=True)
    )
    wall, busy = time.perf_counter() - start, time.process_time() - busy
    flight = report["flights"][0]
    print(
        f"{name}{' dense' if dense else ''}: {flight['n_photos']} photos, {flight['n_points']:,} points "
        f"({flight['points_per_m2']:.1f} per m2), {flight['views']['mean_views']:.1f} views, reprojection "
        f"{flight['reprojection_px']['rms']:.2f} px, sigma_z {flight['sigma_z_m']['median']:.3f} m, cpu {busy:.0f} s, "
        f"wall {wall:.0f} s"
    )
    lens = flight["lens"]["lenses"][0]
    print("  lens:", {key: (round(v["correction"], 4), round(v["std"], 4)) for key, v in lens.items()})
    moved = flight["pose_residual"]
    print(
        "  poses moved:", np.round(moved["position_rms_m"], 2), "m,", np.round(moved["attitude_rms_deg"], 1), "degrees"
    )
    draw(DATA / name, output, work, output.with_suffix(".png"), cell)
    reference = DATA / name / "model.laz"
    if reference.is_file():
        loose, theirs, ours, focal = as_the_reference(DATA / name, work, workers)
        judged = compare(read_points(output), reference, ours, theirs)
        alike = compare(loose, reference, theirs, theirs)
        curvature, left = bend_of_cameras(DATA / name, work)
        print(
            f"  against {reference.name}: n {judged.n:,}, NMAD {judged.nmad:.3f} m, 95 % {judged.p95:.3f} m; without a "
            f"quadratic surface {judged.bent:.3f} m; camera heights bend {curvature:+.2f} mm/m2 against the barometer, "
            f"left {left:.3f} m"
        )
        print(
            f"  95 % intervals by sigma_z cover {100 * judged.covered:.1f} %, with the reference's bending "
            f"{100 * judged.covered_with_reference:.1f} %, of what a quadratic surface leaves "
            f"{100 * judged.left_covered:.1f} %; the difference bends by {judged.bend.round(2)} mm/m2, standard errors "
            f"{(1e3 * np.sqrt(np.diag(ours))).round(2)} and {(1e3 * np.sqrt(np.diag(theirs))).round(2)} (reference), "
            f"chi-square of the bend {judged.bend_distance:.1f} (3 degrees of freedom)"
        )
        print(
            f"  adjusted as the reference was: NMAD {alike.nmad:.3f} m, bend {alike.bend.round(2)} mm/m2, focal length "
            f"{focal:.0f} px"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--dense", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.work or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        run("uav_brighton_beach", folder, options.workers, dense=False, cell=0.3)
        if options.dense:
            run("uav_brighton_beach", folder, options.workers, dense=True, cell=0.12)
        run("uav_seneca", folder, options.workers, dense=False, cell=1.5)


if __name__ == "__main__":
    main()
