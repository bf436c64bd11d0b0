"""
Peers beside ours in one run: M3C2 of py4dgeo on the point scene, Nuth and Kaab's method of xdem on the DEM scene.

Run: PEERS_PYTHON=/path/of/venv/bin/python python tests/benchmarks/change_peers.py points|alignment [--seeds N]
     [--scenes scenes.py] [--density 9] [--size 2000]

The peers need versions of their own (`pip install py4dgeo xdem` in a virtual environment); PEERS_PYTHON is its
interpreter, this one by default. Every method runs in a process of its own, whose time is that of the whole: start,
read, compute, write. The later epoch stays displaced: ours aligns, M3C2 is given no registration error.
"""

import argparse
import importlib.util
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

#: Radius of M3C2's cylinder and of its normals, m.
CYLINDER, NORMALS = 0.5, 1.0
MARGIN = {100.0: 1.6, 9.0: 2.1, 2.5: 4.2}


def m3c2(source, target):
    """Distances and levels of detection of py4dgeo's M3C2 on the cells of the map."""
    import py4dgeo

    data = np.load(source)
    epochs = [py4dgeo.Epoch(data[name]) for name in ("earlier", "later")]
    side = np.arange(0.25, 100.0, 0.5)
    north, east = np.meshgrid(side[::-1], side, indexing="ij")
    near = np.column_stack([east.ravel(), north.ravel(), data["height"]])
    method = py4dgeo.M3C2(
        epochs=tuple(epochs), corepoints=near, normal_radii=[NORMALS], cyl_radius=CYLINDER, max_distance=3.0,
        registration_error=0.0,
    )  # fmt: skip
    distance, uncertainty = method.run()
    np.savez(target, dod=distance.reshape(200, 200), lod=uncertainty["lodetection"].reshape(200, 200))


def ours(source, target):
    """Alignment, models, difference, on the same cells; with argument `given` the epochs are taken as aligned."""
    from changedetect.config import DifferencingConfig
    from changedetect.coregistration import ModelReference, align
    from changedetect.differencing import CoherentTerm, difference_models
    from changedetect.grid import Grid
    from changedetect.models.lwpr import LWPRSurface
    from changedetect.pointcloud import PointCloud

    data = np.load(source)
    earlier, later = (PointCloud(*(np.ascontiguousarray(c) for c in data[name].T)) for name in ("earlier", "later"))
    grid = Grid.from_region((0.0, 100.0, 0.0, 100.0), 0.5, "EPSG:32632")
    first = LWPRSurface(resolution=0.25).fit(earlier.coordinates, earlier.elevation)
    terms = []
    if str(data["case"]) == "corr":
        alignment = align(later, ModelReference(first, first.own_kernel_))
        later = alignment.apply(later)
        elevation = np.nan_to_num(first.predict(grid.coordinates()).elevation.reshape(grid.shape))
        north, east = np.gradient(elevation, -0.5, 0.5)
        design = alignment.offset_design(*grid.coordinates(), east.ravel(), north.ravel(), elevation.ravel())
        terms = [CoherentTerm(design, alignment.covariance)]
    second = LWPRSurface(resolution=0.25).fit(later.coordinates, later.elevation)
    maps = difference_models(first, second, grid, DifferencingConfig(), coherent=terms)
    np.savez(target, dod=maps.dod, lod=maps.level_of_detection)


def nuth_kaab(source, target):
    """Shift that xdem's method finds, and the time of its fit."""
    import rasterio
    import xdem

    data = np.load(source)
    transform = rasterio.Affine(*data["transform"])
    rasters = [
        xdem.DEM.from_array(data[name].astype("f4"), transform=transform, crs=32632, nodata=-9999)
        for name in ("earlier", "later")
    ]
    start = time.perf_counter()
    method = xdem.coreg.NuthKaab()
    method.fit(*rasters, random_state=1)
    affine = method.meta["outputs"]["affine"]
    shift = [affine["shift_x"], affine["shift_y"], affine["shift_z"]]
    np.savez(target, shift=shift, seconds=time.perf_counter() - start)


def ours_alignment(source, target):
    """Shift that `align` finds, and the time of its fit."""
    from changedetect.coregistration import GridReference, align
    from changedetect.grid import Grid
    from changedetect.pointcloud import PointCloud

    data = np.load(source)
    rows, cols = data["earlier"].shape
    a, _, west, _, _, north = data["transform"]
    grid = Grid(rows, cols, float(west), float(north), float(a), "EPSG:32632")
    cloud = PointCloud(*grid.coordinates(), data["later"].astype(np.float64).ravel())
    reference = GridReference(data["earlier"].astype(np.float64), grid)
    start = time.perf_counter()
    found = align(cloud, reference, "shift")
    np.savez(target, shift=found.transform.shift, seconds=time.perf_counter() - start)


WORKERS = {"m3c2": m3c2, "ours": ours, "nuth_kaab": nuth_kaab, "ours_alignment": ours_alignment}


def run(worker, source, folder):
    """Run a worker in a process of its own; its arrays, its wall and processor time, s, and its largest memory, MB."""
    target = folder / f"{worker}.npz"
    is_peer = worker in {"m3c2", "nuth_kaab"}
    python = os.environ.get("PEERS_PYTHON", sys.executable) if is_peer else sys.executable
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [python, __file__, "--worker", worker, str(source), str(target)],
        env={} | environment if not is_peer else {k: v for k, v in environment.items() if k != "PYTHONPATH"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(f"{worker} failed:\n{done.stderr[-2000:]}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return dict(np.load(target)), wall, cpu


def load_scenes(path):
    """Import the file of scenes."""
    spec = importlib.util.spec_from_file_location("scenes", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def points(scenes, n_seeds, density, cases):
    """False positives and power of both on the same points."""
    from scipy import ndimage

    side = np.arange(0.25, 100.0, 0.5)
    north, east = np.meshgrid(side[::-1], side, indexing="ij")
    truth = scenes.change(east, north)
    steps = int(MARGIN[density] / 0.5) + 1
    quiet = ndimage.binary_erosion(truth == 0, iterations=steps, border_value=0)
    heights = sorted({abs(h) for h in np.unique(truth[truth != 0])})
    patches = {h: ndimage.binary_erosion(np.isclose(np.abs(truth), h), iterations=steps) for h in heights}
    for case in cases:
        rows = {"m3c2": [], "ours": []}
        for seed in range(n_seeds):
            with tempfile.TemporaryDirectory() as name:
                source = Path(name) / "scene.npz"
                clouds = [
                    scenes.point_epoch(int(density * 1e4), 1000 + 2 * seed + k, later=k == 1, case=case) for k in (0, 1)
                ]
                ground = scenes.ground(east.ravel(), north.ravel())
                np.savez(source, earlier=clouds[0], later=clouds[1], height=ground, case=case)
                for method, found in rows.items():
                    maps, wall, cpu = run(method, source, Path(name))
                    known = np.isfinite(maps["dod"]) & np.isfinite(maps["lod"])
                    flagged = np.abs(maps["dod"]) > maps["lod"]
                    power = [flagged[patches[h] & known].mean() for h in heights]
                    found.append([flagged[quiet & known].mean(), *power, wall, cpu])
        for method, found in rows.items():
            mean = np.mean(found, axis=0)
            power = ", ".join(f"{100 * h:.0f} cm {100 * p:.0f} %" for h, p in zip(heights, mean[1:-2], strict=True))
            print(
                f"{case} {density:g}/m2, {n_seeds} seeds, {method:5s}: false positives {100 * mean[0]:.1f} %; power "
                f"{power}; whole process {mean[-2]:.1f} s by the clock, {mean[-1]:.1f} s of processor time"
            )
        sys.stdout.flush()


def alignment(n_seeds, size):
    """Error and time of both on the same rasters."""
    from changedetect.synthetic import benchmark_dems

    for case in ("independent", "correlated"):
        rows = {"nuth_kaab": [], "ours_alignment": []}
        for seed in range(n_seeds):
            earlier, later = benchmark_dems(seed, size=size, case=case)
            truth = -np.array(later.errors.shift)
            with tempfile.TemporaryDirectory() as name:
                source = Path(name) / "rasters.npz"
                np.savez(
                    source, earlier=earlier.elevation, later=later.elevation, transform=np.array(earlier.grid.transform)
                )
                for method, found in rows.items():
                    result, wall, cpu = run(method, source, Path(name))
                    error = result["shift"] - truth
                    found.append([np.hypot(*error[:2]), abs(error[2]), float(result["seconds"]), wall, cpu])
        for method, found in rows.items():
            rms = np.sqrt(np.mean(np.square(found), axis=0))
            print(
                f"{case} {size} x {size}, {n_seeds} draws, {method}: rms error {rms[0]:.4f} cells horizontally, "
                f"{rms[1]:.4f} m vertically; fit {rms[2]:.1f} s by the clock, whole process {rms[3]:.1f} s, "
                f"{rms[4]:.1f} s of processor time"
            )
        sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="?", choices=["points", "alignment"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--scenes", default="../shared/scenes.py")
    parser.add_argument("--density", type=float, default=9.0)
    parser.add_argument("--cases", nargs="+", default=["iid", "corr"])
    parser.add_argument("--size", type=int, default=2000)
    parser.add_argument("--worker", nargs=3, metavar=("METHOD", "SOURCE", "TARGET"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        WORKERS[options.worker[0]](*options.worker[1:])
    elif options.part == "points":
        points(load_scenes(options.scenes), options.seeds, options.density, options.cases)
    elif options.part == "alignment":
        alignment(options.seeds, options.size)
    else:
        parser.error("name a part: points or alignment")


if __name__ == "__main__":
    main()
