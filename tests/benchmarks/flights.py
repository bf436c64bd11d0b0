"""
Accuracy of points reconstructed from the simulated two-epoch flight, against its truth.

For every epoch: the paper's chain (filter poses, two views), smoothed poses, the bundle adjustment (with the tracks and
ties found for the smoothed poses), and a point for every cell of a fine grid on top of it. Then both epochs adjusted
together and differenced, point against local plane. NMAD of heights on open ground after removing offset and tilt;
`+shift` removes a horizontal shift too (the GPS is a metre or two off, and ground slopes).

`--simulated` does the same as `--programme` with small flights of the package's own simulator, with the lens stated
right and wrong.

`--pycolmap` runs pycolmap (pip install pycolmap) on the first epoch beside the front-end, both from nothing, with the
same number of threads; `--programme` takes both flights through `init`, `add`, `add`, `update` and judges the maps.

Run: CHANGEDETECT_DATA=DIR python tests/benchmarks/flights.py [--work DIR] [--workers 2] [--pycolmap] [--programme]
[--simulated]
"""

import argparse
import csv
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np
import rasterio
import yaml
from scipy.ndimage import map_coordinates, maximum_filter
from scipy.optimize import minimize
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import small_flights

from changedetect.cli import main as changedetect_main
from changedetect.crs import make_transform
from changedetect.io.camera_file import read_camera_file
from changedetect.io.cog import read_cog
from changedetect.navigation.frame import LocalFrame
from changedetect.pipeline.flight_store import load_finished
from changedetect.pipeline.reconstruct import ReconstructOptions, reconstruct
from changedetect.synthetic.flight_photos import FlightDesign

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).resolve().parents[3] / "shared" / "data")) / "flight_sim"
CRS = "EPSG:32756+4979"
ORIGIN = LocalFrame(-33.89, 151.19, 40.0)
#: Photographed by both strips, m from the origin.
EAST, NORTH = 88.0, 36.0
#: Of k1 and p1 of either flight of a simulated programme: the lens as it is, another lens, the same wrong one.
_LENS_ERRORS = (((0.0, 0.0), (0.0, 0.0)), ((0.0, 0.0), (0.01, 0.0005)), ((0.01, 0.0005), (0.01, 0.0005)))


def nmad(values):
    """Robust standard deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


class Truth:
    """Surface of an epoch, and where trees and houses stand."""

    def __init__(self, epoch):
        with rasterio.open(DATA / "truth" / f"dem_epoch{epoch}.tif") as source:
            self.surface, self.transform = source.read(1), source.transform
        with rasterio.open(DATA / "truth" / "ground.tif") as source:
            ground = source.read(1)
        with rasterio.open(DATA / "truth" / "dem_epoch1.tif") as source:
            objects = np.abs(source.read(1) - ground) > 0.05
        self.near_object = maximum_filter(objects, 13).astype(float)

    def sample(self, raster, east, north, order=1):
        column = (east - self.transform.c) / self.transform.a - 0.5
        row = (north - self.transform.f) / self.transform.e - 0.5
        return map_coordinates(raster, [row, column], order=order, mode="nearest")

    def height(self, east, north):
        return self.sample(self.surface, east, north)

    def is_open(self, east, north):
        inside = (np.abs(east) < EAST) & (np.abs(north) < NORTH)
        return inside & (self.sample(self.near_object, east, north, 0) < 0.5)


def read_enu(path, crs):
    """Points of a file in the simulator's frame, their sigma and views."""
    cloud = laspy.read(path)
    longitude, latitude, height = make_transform(crs, "EPSG:4979")(
        np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)
    )
    return ORIGIN.to_enu(latitude, longitude, height), np.asarray(cloud["sigma_z"]), np.asarray(cloud["n_views"])


def flattened(points, error):
    """Error after a robust offset and tilt."""
    design = np.column_stack([np.ones(len(points)), points[:, :2]])
    weight = np.ones(len(points))
    for _ in range(30):
        fit = np.linalg.lstsq(design * weight[:, None], error * weight, rcond=None)[0]
        left = error - design @ fit
        weight = 1 / (1 + (left / (2 * max(nmad(left), 1e-6))) ** 2)
    return left


def judge(truth, points):
    """Which points count, errors after offset and tilt, the same after the best horizontal shift, and the shift."""
    good = truth.is_open(points[:, 0], points[:, 1])
    used = points[good]

    def error(shift):
        return flattened(used, used[:, 2] - truth.height(used[:, 0] - shift[0], used[:, 1] - shift[1]))

    simplex = np.array([[0.0, 0.0], [1.0, 0.3], [-0.3, 1.0]])
    settings = {"xatol": 0.02, "fatol": 1e-4, "initial_simplex": simplex}
    best = minimize(lambda shift: nmad(error(shift)), np.zeros(2), method="Nelder-Mead", options=settings)
    return good, error((0, 0)), error(best.x), best.x


def horizontal_offset(work, epoch):
    """Mean horizontal error of the adjusted camera positions, m: what places the changes."""
    from changedetect.navigation.poses import CameraPoses

    poses = CameraPoses.load(work / "adjusted_poses.nc")
    with (DATA / "truth" / f"poses_epoch{epoch}.csv").open() as stream:
        true = {row["image"]: [float(row[axis]) for axis in "xyz"] for row in csv.DictReader(stream)}
    return (poses.position - np.array([true[name] for name in poses.names])).mean(axis=0)


def one_epoch(epoch, folder, workers):
    """Print a row per method."""
    truth = Truth(epoch)
    for method in ("paper", "smoothed", "adjusted", "dense"):
        output = folder / f"epoch{epoch}_{method}.laz"
        start, busy = time.perf_counter(), time.process_time()
        work = folder / f"work_{epoch}_{'paper' if method == 'paper' else 'smoothed'}"
        is_dense = method == "dense"
        chain = "adjusted" if is_dense else method
        options = ReconstructOptions(method=chain, dense=is_dense, work=work, workers=workers, overwrite=True)
        report = reconstruct([DATA / f"epoch{epoch}"], output, options)
        seconds, busy = time.perf_counter() - start, time.process_time() - busy
        points, sigma, _ = read_enu(output, report["crs"])
        density = report["flights"][0]["points_per_m2"]
        if is_dense:
            some = np.random.default_rng(0).choice(len(points), 60_000, replace=False)
            points, sigma = points[some], sigma[some]
        good, error, shifted, shift = judge(truth, points)
        z = shifted / sigma[good]
        covered = np.mean(np.abs(z) < 1.96)
        print(
            f"{epoch}      {method:9s} {density:9.1f}  {nmad(error):8.3f}  {nmad(shifted):8.3f}  "
            f"({shift[0]:+.2f}, {shift[1]:+.2f})  {np.median(sigma):6.3f}  {nmad(z):5.2f}  {100 * covered:5.1f}  "
            f"{seconds:6.1f}  {busy:6.1f}",
            flush=True,
        )


def both_epochs(folder, workers):
    """Print the difference of the flights adjusted together."""
    start, busy = time.perf_counter(), time.process_time()
    options = ReconstructOptions(work=folder / "work_together", workers=workers, overwrite=True)
    report = reconstruct([DATA / "epoch1", DATA / "epoch2"], folder / "together", options)
    print(f"\ntogether: {time.perf_counter() - start:.1f} s, {time.process_time() - busy:.1f} s of processor")
    print(json.dumps({k: v for k, v in report["together"].items() if k != "differences"}))
    clouds = [read_enu(folder / "together" / f"epoch{e}.laz", report["crs"]) for e in (1, 2)]
    truths = [Truth(e) for e in (1, 2)]
    for epoch, (points, *_), truth in zip((1, 2), clouds, truths, strict=True):
        _, error, shifted, shift = judge(truth, points)
        print(f"  epoch {epoch}: {nmad(error):.3f} m, {nmad(shifted):.3f} after a shift of {np.round(shift, 2)}")
    offset = horizontal_offset(folder / "work_together" / "epoch1", 1)
    difference, std, place = point_differences(*clouds)
    place = place - offset[:2]
    changes = json.loads((DATA / "truth" / "truth.json").read_text())["changes"]
    away = np.min([np.hypot(place[:, 0] - c["x"], place[:, 1] - c["y"]) - c["radius"] for c in changes], axis=0)
    stable = truths[0].is_open(place[:, 0], place[:, 1]) & (away > 2)
    d = difference[stable]
    print(f"  stable ground: median {np.median(d):+.3f} m, NMAD {nmad(d):.3f} m, sd of z {nmad(d / std[stable]):.2f}")
    for change in changes:
        inside = np.hypot(place[:, 0] - change["x"], place[:, 1] - change["y"]) < change["radius"]
        at = place[inside, 0], place[inside, 1]
        true = truths[1].height(*at) - truths[0].height(*at)
        print(
            f"  {change['kind']:8s} {inside.sum():4d} points  mean {difference[inside].mean():+.3f} m  "
            f"truth {true.mean():+.3f} m"
        )


def beside_pycolmap(folder, workers):
    """Print time and accuracy of the whole front-end and of pycolmap, both from nothing."""
    from pycolmap_peer import run_pycolmap

    truth, flight = Truth(1), DATA / "epoch1"
    options = ReconstructOptions(workers=workers, overwrite=True)
    for attempt in range(2):  # the first compiles, where nothing is cached
        start, busy = time.perf_counter(), time.process_time()
        output = folder / f"timed_{attempt}" / "points.laz"
        shutil.rmtree(output.parent, ignore_errors=True)
        report = reconstruct([flight], output, options)
        seconds, busy = time.perf_counter() - start, time.process_time() - busy
    own, *_ = read_enu(output, report["crs"])
    camera = read_camera_file(DATA / "camera.yaml")[0]
    lens = [camera.fx, camera.fy, camera.cx, camera.cy, camera.k1, camera.k2, camera.p1, camera.p2]
    poses = DATA / "truth" / "poses_epoch1.csv"
    peer, views, parts = run_pycolmap(flight, poses, lens, folder / "pycolmap", workers)
    wall, used = (sum(part[k] for part in parts.values()) for k in (0, 1))
    print("\nfront-end beside     points   NMAD  +shift      s   cpu s")
    rows = [("changedetect", own, seconds, busy), ("pycolmap, >= 3 views", peer[views >= 3], wall, used)]
    for name, points, s, cpu in rows:
        good, error, shifted, _ = judge(truth, points)
        print(f"{name:20s} {good.sum():6d}  {nmad(error):.3f}  {nmad(shifted):.3f}  {s:6.1f}  {cpu:6.1f}")
    print(
        f"pycolmap over changedetect: {wall / seconds:.1f} of wall time, {used / busy:.1f} of processor time; {parts}"
    )


def through_the_programme(folder, joint):
    """Print how the change map of a programme of both flights compares with the truth."""
    site = folder / f"site_{joint}"
    if not site.exists():
        for arguments in (
            ["init", site, "--crs", CRS, "--resolution", "0.5"],
            ["add", site, "2024-05-01", DATA / "epoch1"],
            ["add", site, "2024-11-01", DATA / "epoch2"],
        ):
            _run(arguments)
        with (site / "programme.toml").open("a") as stream:
            stream.write(f'\n[flights]\njoint = "{joint}"\n')
    start = time.perf_counter()
    _run(["update", site])
    print(f"\nprogramme, joint = {joint}: update {time.perf_counter() - start:.0f} s")
    truth = ProgrammeTruth(site)
    error = truth.dod - truth.change
    stable = truth.is_open & (truth.away > 2)
    is_flagged = np.isin(truth.change_class, (1, 2))
    covered = np.mean(np.abs(error[truth.is_open]) < truth.lod[truth.is_open])
    print(
        f"  stable ground: median {np.median(error[stable]):+.3f} m, NMAD {nmad(error[stable]):.3f} m, flagged "
        f"{100 * is_flagged[stable].mean():.1f} %; 95 % interval covers {100 * covered:.1f} % of all open ground"
    )
    for change, inside in truth.patches():
        found, true = truth.dod[inside].mean(), truth.change[inside].mean()
        share = 100 * is_flagged[inside].mean()
        print(f"  {change['kind']:8s} mean {found:+.3f} m  truth {true:+.3f} m  cells flagged {share:.0f} %")


def simulated(folder, seed, size, n_photos, errors):
    """
    Print how the change map of two simulated flights compares with the truth.

    `errors` are added to k1 and p1 of the lens stated for the first and for the second flight.
    """
    site = folder / f"small_{seed}_{errors}".replace(" ", "")
    epochs = small_flights.FIRST, small_flights.SECOND
    flights = small_flights.fly(
        site / "flights", seed=seed, design=FlightDesign(n_strips=2, n_photos=n_photos, size=size)
    )
    _run(["init", site / "site", "--crs", CRS, "--resolution", "0.5"])
    for k, (epoch, error) in enumerate(zip(epochs, errors, strict=True), start=1):
        file = flights / f"epoch{k}" / "camera.yaml"
        camera = yaml.safe_load(file.read_text())
        lens = camera["distortion_coefficients"]["data"]
        lens[0], lens[2] = lens[0] + error[0], lens[2] + error[1]
        file.write_text(yaml.safe_dump(camera))
        _run(["add", site / "site", epoch, flights / f"epoch{k}"])
    _run(["update", site / "site"])
    truth = small_flights.TrueChange(site / "site", flights / "truth", epochs)
    error = truth.dod - truth.change
    covered = np.mean(np.abs(error[truth.is_open]) < truth.lod[truth.is_open])
    everywhere = np.isfinite(error)
    covered_all = np.mean(np.abs(error[everywhere]) < truth.lod[everywhere])
    flagged = np.isin(truth.change_class[truth.is_stable], (1, 2)).mean()
    patches = "  ".join("{} {:+.3f} ({:+.3f})".format(kind, *truth.means(kind)) for kind in ("mound", "pit", "plateau"))
    print(
        f"seed {seed}, 2 x {n_photos} photos, k1 and p1 off by {errors}: NMAD {nmad(error[truth.is_stable]):.3f} m, "
        f"median {np.median(error[truth.is_stable]):+.3f} m, 95 % interval covers {100 * covered:.1f} % of open "
        f"ground seen four times, {100 * covered_all:.1f} % of all cells, flagged "
        f"{100 * flagged:.1f} %; {patches}",
        flush=True,
    )
    return site, truth


def _run(arguments):
    """Run the command line; stop where it fails."""
    code = changedetect_main([*map(str, arguments), "--quiet"])
    if code:
        sys.exit(code)


class ProgrammeTruth:
    """Maps of the difference of both flights, and the truth where the first flight really lies."""

    def __init__(self, site):
        products = site / "products" / "2024-05-01_2024-11-01"
        self.dod, grid, _ = read_cog(products / "dod.tif")
        self.lod = read_cog(products / "level_of_detection.tif")[0]
        self.change_class = read_cog(products / "change_class.tif")[0]
        block = load_finished(site / "flights" / "2024-05-01" / "points" / "orientation.npz").adjustment.block
        with (DATA / "truth" / "poses_epoch1.csv").open() as stream:
            true = {row["image"]: [float(row[axis]) for axis in "xyz"] for row in csv.DictReader(stream)}
        offset = (block.position - np.array([true[name] for name in block.names])).mean(axis=0)
        easting, northing = grid.coordinates()
        longitude, latitude, height = make_transform(CRS, "EPSG:4979")(easting, northing, np.full(easting.size, 40.0))
        enu = ORIGIN.to_enu(latitude, longitude, height) - offset
        self.east, self.north = enu[:, 0].reshape(grid.shape), enu[:, 1].reshape(grid.shape)
        truths = [Truth(epoch) for epoch in (1, 2)]
        self.change = truths[1].height(self.east, self.north) - truths[0].height(self.east, self.north)
        self.is_open = np.isfinite(self.dod) & truths[0].is_open(self.east, self.north)
        self.changes = json.loads((DATA / "truth" / "truth.json").read_text())["changes"]
        self.away = np.min([self._beyond(change) for change in self.changes], axis=0)

    def _beyond(self, change):
        return np.hypot(self.east - change["x"], self.north - change["y"]) - change["radius"]

    def patches(self):
        """Each change and the cells inside it."""
        return [(change, np.isfinite(self.dod) & (self._beyond(change) < 0)) for change in self.changes]


def point_differences(earlier, later, n_neighbours=6, reach=2.5):
    """Later points minus a plane through their neighbours of the earlier epoch, its sigma, and the place."""
    first, sigma_first, _ = earlier
    second, sigma_second, _ = later
    distance, index = cKDTree(first[:, :2]).query(second[:, :2], k=n_neighbours)
    near = first[index]
    design = np.concatenate([np.ones((*near.shape[:2], 1)), near[:, :, :2] - second[:, None, :2]], axis=2)
    normal = np.einsum("nki,nkj->nij", design, design) + np.diag([0.0, 0.05, 0.05])
    rows = np.linalg.solve(normal, design.transpose(0, 2, 1))[:, 0]  # weights of the neighbours
    height = np.sum(rows * near[:, :, 2], axis=1)
    std = np.sqrt(np.sum((rows * sigma_first[index]) ** 2, axis=1) + sigma_second**2)
    good = distance[:, -1] < reach
    return (second[:, 2] - height)[good], std[good], second[good, :2]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="keep results here")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--pycolmap", action="store_true", help="run pycolmap beside the front-end, nothing else")
    parser.add_argument("--simulated", action="store_true", help="judge programmes of small flights, nothing else")
    parser.add_argument("--programme", action="store_true", help="judge the maps of a programme, nothing else")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.work or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if arguments.pycolmap:
            beside_pycolmap(folder, arguments.workers)
        if arguments.programme:
            for joint in ("auto", "never"):
                through_the_programme(folder, joint)
        if arguments.simulated:
            for errors in _LENS_ERRORS:
                for seed in (1, 2, 4):
                    simulated(folder, seed, (512, 384), 6, errors)
        if arguments.pycolmap or arguments.programme or arguments.simulated:
            return
        print("epoch  method    points/m2      NMAD    +shift  (east, north)    sigma  sd(z)  95 %       s  cpu s")
        for epoch in (1, 2):
            one_epoch(epoch, folder, arguments.workers)
        both_epochs(folder, arguments.workers)


if __name__ == "__main__":
    main()
