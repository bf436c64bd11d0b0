"""
Accuracy, speed and coverage of co-registration on DEM scenes, with xdem's method of Nuth and Kaab beside it.

Scenes: fractal ground of 1 m cells; six patches change by 0.05 to 0.5 m. Case "independent": 5 cm of noise in each
raster. Case "correlated": and 5 cm of error correlated over 30 cells in each, the later one displaced by 0.8 cells in
a random direction and by 0.3 m.

Run: python tests/benchmarks/alignment.py [--draws 100] [--size 2000] [--cases independent correlated] [--xdem]
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from changedetect.coregistration import GridReference, align
from changedetect.pointcloud import PointCloud
from changedetect.synthetic import benchmark_dems


def draw(case: str, size: int, seed: int):
    """Earlier raster as a reference, the later one as points, and the (east, north, up) that aligns them, m."""
    earlier, later = benchmark_dems(seed, size=size, case=case)
    grid = earlier.grid
    reference = GridReference(np.asarray(earlier.elevation, dtype=np.float64), grid)
    elevation = np.asarray(later.elevation, dtype=np.float64).ravel()
    return reference, PointCloud(*grid.coordinates(), elevation), -np.array(later.errors.shift)


def measure(case: str, draws: int, size: int) -> None:
    """Print errors, their ratio to the standard errors, coverage and time of many draws."""
    errors, scores, hits, seconds, kinds = [], [], [], [], []
    for seed in range(draws):
        reference, cloud, truth = draw(case, size, seed)
        start = time.perf_counter(), time.process_time()
        alignment = align(cloud, reference)
        seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
        error = alignment.transform.shift - truth
        low, high = alignment.intervals()[:3].T
        errors.append(error)
        scores.append(error / alignment.standard_errors[:3])
        hits.append((low <= alignment.transform.shift - error) & (alignment.transform.shift - error <= high))
        kinds.append(alignment.transform.kind)
    horizontal = np.hypot(*np.array(errors)[:, :2].T)
    print(
        f"{case}, {size} x {size} cells, {draws} draws: {', '.join(f'{kinds.count(k)} {k}' for k in sorted({*kinds}))}"
    )
    print(f"  horizontal error (cells): rms {np.sqrt(np.mean(horizontal**2)):.4f}, largest {horizontal.max():.4f}")
    print(f"  vertical error (m): rms {np.sqrt(np.mean(np.array(errors)[:, 2] ** 2)):.4f}")
    print(f"  rms error / standard error (east, north, up): {np.sqrt(np.mean(np.square(scores), axis=0)).round(2)}")
    print(f"  coverage of 95 % intervals: {np.mean(hits, axis=0).round(3)}, all {np.mean(hits):.3f}")
    wall, processor = np.median(seconds, axis=0)
    print(f"  seconds: median {wall:.2f} by the clock, {processor:.2f} of processor time")


def compare_xdem(case: str, size: int, seeds: range) -> None:
    """Print the errors of xdem's NuthKaab on the same scenes, all cells taken as stable."""
    import geoutils
    import rasterio
    import xdem

    for seed in seeds:
        reference, cloud, truth = draw(case, size, seed)
        grid = reference.grid
        transform = rasterio.Affine(*grid.transform)
        rasters = [
            xdem.DEM.from_array(values.astype("f4").reshape(grid.shape), transform=transform, crs=32632, nodata=-9999)
            for values in (reference.elevation, cloud.elevation)
        ]
        start = time.perf_counter()
        method = xdem.coreg.NuthKaab()
        method.fit(*rasters, random_state=seed)
        affine = method.meta["outputs"]["affine"]
        found = np.array([affine["shift_x"], affine["shift_y"], affine["shift_z"]])
        seconds = time.perf_counter() - start
        ours = align(cloud, reference, "shift").transform.shift
        print(
            f"  seed {seed}: xdem {xdem.__version__} (geoutils {geoutils.__version__}) error "
            f"{np.round(found - truth, 4)} in {seconds:.1f} s; align {np.round(ours - truth, 4)}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--size", type=int, default=2000)
    parser.add_argument("--cases", nargs="+", default=["independent", "correlated"])
    parser.add_argument("--xdem", action="store_true", help="compare with xdem on five seeds (pip install xdem)")
    arguments = parser.parse_args()
    for case in arguments.cases:
        if arguments.draws:
            measure(case, arguments.draws, arguments.size)
        if arguments.xdem:
            compare_xdem(case, arguments.size, range(5))


if __name__ == "__main__":
    main()
