"""
Photos without logs: Brighton Beach (drone, 18 photos) against the cloud another program made of the same photos, and
Seneca (fixed wing, 40 photos).

Points are moved onto the reference by a similarity (robust point-to-plane ICP); then heights are compared with the
median of the reference's points within 0.25 m. Both programs estimate the lens from near-vertical photos, which leaves
a bending of the ground nearly free: what remains after a quadratic surface is given too, and how far the camera heights
of either bend against the barometer's.

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
from changedetect.photogrammetry.block import ImageBlock
from changedetect.pipeline.flight_run import read_flight_source
from changedetect.pipeline.reconstruct import ReconstructOptions, reconstruct

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
_RADIUS = 0.25
_SAMPLE = 60_000


@dataclass(frozen=True)
class Judged:
    """Heights against the reference, m."""

    n: int
    nmad: float
    p95: float
    bent: float


def nmad(values):
    """Robust standard deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def read_points(path):
    """Coordinates of a LAS file, shape (n, 3)."""
    cloud = laspy.read(path)
    points = np.column_stack([cloud.x, cloud.y, cloud.z])
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


def compare(path, reference_path):
    """Heights of a cloud against a reference, after a similarity and after a quadratic surface too."""
    reference = laspy.read(reference_path)
    reference = np.column_stack([reference.x, reference.y, reference.z])
    moved = moved_onto(read_points(path), reference)
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
    return Judged(int(good.sum()), nmad(error), float(np.percentile(np.abs(error - np.median(error)), 95)), nmad(left))


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
        judged = compare(output, reference)
        curvature, left = bend_of_cameras(DATA / name, work)
        print(
            f"  against {reference.name}: n {judged.n:,}, NMAD {judged.nmad:.3f} m, 95 % {judged.p95:.3f} m; without a "
            f"quadratic surface {judged.bent:.3f} m; camera heights bend {curvature:+.2f} mm/m2 against the barometer, "
            f"left {left:.3f} m"
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
