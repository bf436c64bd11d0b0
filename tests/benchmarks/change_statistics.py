"""
Errors of differences: false positives and power, area means, volumes, objects, real surveys held out, cost.

Run: python tests/benchmarks/change_statistics.py chain|points|dem|means|volumes|real|cost [--seeds N]
[--scenes scenes.py] [--cases corr:9,het:9] [--plain]

`points` and `dem` take the two scenes of a file that gives `point_epoch`, `ground`, `change`, `dem_pair`; what the file
displaces the later epoch by is taken out, so that only the statistics of the errors are tested. `chain` leaves it in
and aligns by the package's own means. `means` and `volumes` draw differences with known errors. `--plain` predicts no
errors. `real` reads the surveys under CHANGEDETECT_DATA.
"""

import argparse
import importlib.util
import math
import os
import resource
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import ndimage

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

from error_fields import change_maps, evidence, quiet, smooth_field  # noqa: E402

from changedetect.config import DifferencingConfig  # noqa: E402
from changedetect.coregistration import ModelReference, align  # noqa: E402
from changedetect.differencing import CoherentTerm, area_budget, difference_models, find_objects_of_change, sum_std  # noqa: E402
from changedetect.differencing.clusters import normal_score  # noqa: E402
from changedetect.differencing.covariates import error_covariates  # noqa: E402
from changedetect.differencing.error_model import estimate_errors  # noqa: E402
from changedetect.differencing.error_scale import half_width_scale  # noqa: E402
from changedetect.differencing.maps import judge_change  # noqa: E402
from changedetect.differencing.pair import _adaptive_evidence, cell_errors  # noqa: E402
from changedetect.differencing.prediction import predict_errors  # noqa: E402
from changedetect.grid import Grid  # noqa: E402
from changedetect.models.lwpr import LWPRSurface  # noqa: E402
from changedetect.pointcloud import PointCloud  # noqa: E402

DATA = Path(os.environ.get("CHANGEDETECT_DATA", "../shared/data"))
SETTINGS = DifferencingConfig()
MARGIN = {100.0: 1.6, 9.0: 2.1, 2.5: 4.2}  # m, more than the radius of a field of the difference


def load_scenes(path):
    """Import the file of scenes."""
    spec = importlib.util.spec_from_file_location("scenes", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def score(maps, truth, resolution, margin):
    """False positives, sd of z, flagged area that is false, power by height (cells, objects), mean by height."""
    steps = int(margin / resolution) + 1
    quiet_ground = ndimage.binary_erosion(truth == 0, iterations=steps, border_value=0) & np.isfinite(maps.dod)
    flagged = (maps.change_class == 1) | (maps.change_class == 2)
    objects = find_objects_of_change(maps, resolution, 0.95, 0.05)
    found = objects.labels > 0
    heights = {}
    for height in np.unique(truth[truth != 0]):
        inside = ndimage.binary_erosion(truth == height, iterations=steps)
        heights[round(float(height), 2)] = flagged[inside].mean(), found[inside].mean(), maps.dod[inside].mean()
    far = ndimage.binary_erosion(truth == 0, iterations=steps, border_value=1)
    false_area = (found & far).sum() / max(found.sum(), 1)
    return flagged[quiet_ground].mean(), maps.z_score[quiet_ground].std(), false_area, heights


def report(name, results):
    """One row, and one line a height."""
    false = [r[0] for r in results]
    print(
        f"{name}: false positives {100 * np.mean(false):.1f} % ({100 * min(false):.1f} to {100 * max(false):.1f})  "
        f"sd of z {np.mean([r[1] for r in results]):.2f}  "
        f"false area of objects {100 * np.mean([r[2] for r in results]):.1f} %"
    )
    for height in results[0][3]:
        cells, objects, mean = np.mean([r[3][height] for r in results], axis=0)
        print(f"      {height:+.2f} m: cells {100 * cells:5.1f} %  objects {100 * objects:5.1f} %  mean {mean:+.4f} m")
    sys.stdout.flush()


def points(scenes, n_seeds, densities):
    """Point scene, independent and correlated errors."""
    grid = Grid.from_region((0.0, 100.0, 0.0, 100.0), 0.5, "EPSG:32632")
    easting, northing = grid.coordinates()
    truth = scenes.change(easting, northing).reshape(grid.shape)
    for density in densities:
        for case in ("iid", "corr"):
            results = []
            for seed in range(n_seeds):
                models = []
                for s, is_later in ((1000 + 2 * seed, False), (1001 + 2 * seed, True)):
                    p = scenes.point_epoch(int(density * 1e4), s, later=is_later, case=case)
                    p -= np.array([0.03, -0.02, 0.01]) * (is_later and case == "corr")
                    x, y, z = (np.ascontiguousarray(c) for c in p.T)
                    models.append(LWPRSurface(resolution=0.25).fit((x, y), z))
                maps = difference_models(*models, grid, SETTINGS)
                results.append(score(maps, truth, 0.5, MARGIN[density]))
            report(f"points {case:4s} {density:g}/m2, {n_seeds} seeds", results)


def epochs(scenes, case, density, seed):
    """Points of both epochs: the file's cases, and noise that grows with slope, or a fifth of the ground missing."""
    clouds = []
    for s, is_later in ((1000 + 2 * seed, False), (1001 + 2 * seed, True)):
        p = scenes.point_epoch(int(density * 1e4), s, later=is_later, case="corr" if case == "corr" else "iid")
        rng = np.random.default_rng([s, 3])
        if case == "het":
            step = 0.05
            ahead = scenes.ground(p[:, 0] + step, p[:, 1]), scenes.ground(p[:, 0], p[:, 1] + step)
            slope = np.hypot(*(a - scenes.ground(p[:, 0], p[:, 1]) for a in ahead)) / step
            p[:, 2] += rng.normal(0.0, 0.05, len(p)) * np.sqrt((1.0 + 3.0 * np.clip(slope, 0.0, 1.0)) ** 2 - 1.0)
        if case == "gappy":
            gone = np.zeros(len(p), bool)
            for x, y, radius in zip(*rng.uniform(0.0, 100.0, (2, 60)), rng.uniform(1.0, 5.0, 60), strict=True):
                gone |= np.hypot(p[:, 0] - x, p[:, 1] - y) < radius
            p = p[~gone]
        clouds.append(PointCloud(*(np.ascontiguousarray(c) for c in p.T)))
    return clouds


def whole_chain(scenes, n_seeds, cases, first_seed=0, size=100.0):
    """Alignment by the package's own means, nothing handed over; then the difference with the alignment's errors."""
    grid = Grid.from_region((0.0, size, 0.0, 100.0), 0.5, "EPSG:32632")
    easting, northing = grid.coordinates()
    truth = scenes.change(easting, northing).reshape(grid.shape)
    for case, density in cases:
        results, misses, predicted = [], [], 0
        for seed in range(first_seed, first_seed + n_seeds):
            earlier, later = (cloud.select(cloud.easting < size + 3.0) for cloud in epochs(scenes, case, density, seed))
            first = LWPRSurface(resolution=0.25).fit(earlier.coordinates, earlier.elevation)
            alignment = align(later, ModelReference(first, first.own_kernel_))
            later = alignment.apply(later)
            second = LWPRSurface(resolution=0.25).fit(later.coordinates, later.elevation)
            elevation = np.nan_to_num(first.predict(grid.coordinates()).elevation.reshape(grid.shape))
            north, east = np.gradient(elevation, -0.5, 0.5)
            design = alignment.offset_design(easting, northing, east.ravel(), north.ravel(), elevation.ravel())
            terms = (CoherentTerm(design, alignment.covariance),)
            maps = difference_models(first, second, grid, SETTINGS, coherent=terms)
            predicted += maps.errors.prediction is not None
            results.append(score(maps, truth, 0.5, MARGIN[density]))
            print(f"   seed {seed}: false positives {100 * results[-1][0]:.1f} %", file=sys.stderr, flush=True)
            misses.append(alignment.transform.shift + np.array([0.03, -0.02, 0.01]) * (case == "corr"))
        rms = 100.0 * np.sqrt(np.mean(np.square(misses), axis=0))
        report(f"chain {case:5s} {density:g}/m2, {n_seeds} seeds, {size:g} x 100 m, {predicted} predicted", results)
        print(f"      alignment: rms error east {rms[0]:.2f}, north {rms[1]:.2f}, up {rms[2]:.2f} cm", flush=True)


def dem(scenes_path, n_seeds, cells):
    """DEM scene without displacement of the later grid."""
    text = Path(scenes_path).read_text().replace("else (0.7, -0.4, 0.3)", "else (0.0, 0.0, 0.0)")
    names = {}
    exec(compile(text, str(scenes_path), "exec"), names)  # the scene's own source, one number changed
    for case in ("iid", "corr", "het"):
        results = []
        for seed in range(n_seeds):
            earlier, later, truth = names["dem_pair"](cells, case, 7 + seed)
            grid = Grid.from_region((0.0, float(cells), 0.0, float(cells)), 1.0, "EPSG:32632")
            places = grid.coordinates()
            models = [LWPRSurface(resolution=1.0).fit(places, z.astype(float).ravel()) for z in (earlier, later)]
            maps = difference_models(*models, grid, SETTINGS)
            results.append(score(maps, truth, 1.0, 6.0))
        report(f"dem {case:4s} {cells} x {cells}, {n_seeds} seeds", results)


def means(n_seeds):
    """Means of squares on ground that took no part in the estimate: the error model of one half predicts the other."""
    scores = {50: [], 100: [], 200: []}
    for seed in range(n_seeds):
        rng = np.random.default_rng(500 + seed)
        shape = (400, 800)
        d = quiet(seed, shape, local=0.01) + smooth_field(rng, shape, 0.02, 8.0) + smooth_field(rng, shape, 0.02, 25.0)
        stable = np.zeros(shape, bool)
        stable[:, :400] = True
        found = evidence(d, 0.01)
        maps = judge_change(found, cell_errors(found, 1.0, stable), SETTINGS)
        for side, values in scores.items():
            for r in range(0, 400, side):
                for c in range(400, 800, side):
                    window = np.s_[r : r + side, c : c + side]
                    values.append(d[window].sum() / sum_std(maps, np.ones((side, side)), 1.0, window))
    for side, values in scores.items():
        print(f"means of {side} m squares: sd of z {np.std(values):.2f} ({len(values)} squares, {n_seeds} draws)")


def volumes(n_draws):
    """Intervals of patch volumes and of raised and lowered volume of the whole map."""
    shape = (150, 150)
    change = np.zeros(shape)
    change[20:60, 20:60], change[20:60, 90:130], change[90:130, 20:60] = 0.5, -0.4, 0.1
    targets = {"+0.5 m patch": change == 0.5, "+0.1 m patch": change == 0.1, "whole": np.ones(shape, bool)}
    covered, ratio = {}, {}
    for draw in range(n_draws):
        maps = change_maps(quiet(9000 + draw, shape, local=0.01, correlated=0.02, length=6.0) + change)
        objects = find_objects_of_change(maps, 1.0, 0.95, 0.05)
        for name, inside in targets.items():
            budget = area_budget(maps, 1.0, 0.95, inside, objects.direction)
            truths = {"net": change, "raised": np.maximum(change, 0.0), "lowered": np.maximum(-change, 0.0)}
            for kind, field in truths.items():
                if kind != "net" and name != "whole":
                    continue
                true, q = field[inside].sum(), getattr(budget, kind)
                covered.setdefault((name, kind), []).append(q.lower <= true <= q.upper)
                ratio.setdefault((name, kind), []).append((q.value, true, q.std))
    for key, hits in covered.items():
        value, true, std = np.array(ratio[key]).T
        print(
            f"volume {key[0]:13s} {key[1]:8s} covered {100 * np.mean(hits):.1f} % of {n_draws}  "
            f"mean {value.mean():.1f} of {true[0]:.1f} m3  sd {value.std():.1f}, stated {np.mean(std):.1f}"
        )


def toronto():
    """Lidar pair and ground away from the shores, where nothing is known to have changed."""
    import laspy

    models, regions = [], []
    for year in (2015, 2023):
        file = laspy.read(DATA / "ttp_lidar" / f"ttp_{year}_thinned.laz")
        keep = np.asarray(file.classification) == 2
        x, y, z = (np.ascontiguousarray(np.asarray(a)[keep], float) for a in (file.x, file.y, file.z))
        models.append(LWPRSurface(resolution=1.0).fit((x, y), z))
        regions.append((x.min(), x.max(), y.min(), y.max()))
    west, east, south, north = np.array(regions).T
    grid = Grid.from_region((west.min(), east.max(), south.min(), north.max()), 1.0, "EPSG:26917")
    rows, cols = np.mgrid[: grid.n_rows, : grid.n_cols]
    inland = cols > np.interp(
        rows, [0, 100, 200, 250, 320, 450, 600, 680, 760], [260, 240, 240, 190, 180, 190, 180, 170, 220]
    )
    yield "Toronto 2015-2023", _adaptive_evidence(*models, grid), inland, None


def beach():
    """Six surface models of a beach on the strip 25 m either side of the line that bounds it."""
    import pyogrio
    import rasterio
    import shapely
    from rasterio.features import rasterize
    from rasterio.transform import Affine

    from changedetect.io.zones import read_zones

    folder = DATA / "sandpyper_leo"
    grid = Grid.from_region((299840.0, 300060.0, 5773164.0, 5773732.0), 1.0, "EPSG:32755")
    frame = shapely.box(grid.west, grid.south, grid.east, grid.north)
    line = next(z for z in read_zones(folder / "shoremasks.gpkg", grid.crs) if z.name == "leo").polygon.boundary
    strip = rasterize(
        [(shapely.intersection(line, frame).buffer(25.0), 1)], grid.shape, transform=Affine(*grid.transform)
    )
    transects = rasterize(
        [(shapely.from_wkb(g).buffer(0.5), 1) for g in pyogrio.raw.read(folder / "leo_lod_transects.gpkg")[2]],
        grid.shape,
        transform=Affine(*grid.transform),
    )
    models = []
    for day in ("20180606", "20180713", "20180920", "20190211", "20190328", "20190731"):
        with rasterio.open(folder / f"leo_{day}_dsm_1m.tif") as file:
            z, t = file.read(1).astype(float), file.transform
        r, c = np.nonzero(np.isfinite(z))
        models.append((day, LWPRSurface(resolution=1.0).fit((t.c + t.a * (c + 0.5), t.f + t.e * (r + 0.5)), z[r, c])))
    for (a, earlier), (b, later) in pairwise(models):
        yield f"beach {a}-{b}", _adaptive_evidence(earlier, later, grid), strip > 0, transects > 0


def held_out(name, found, ground, transects, side=40):
    """Fit on every second block, judge the others, predicted from those or not; a robust offset is taken off first."""
    known = found.known & (ground if transects is not None else True)
    offset = half_width_scale(found.difference[known])[0]
    if transects is not None:
        offset = float(np.median(found.difference[known & transects]))
    d = np.where(known, found.difference - offset, np.nan)
    variance = np.where(known, found.variance, 0.0)
    reach = found.correlation_length / math.sqrt(2.0 * math.pi)
    covariates = error_covariates(variance, found.counts, found.terrain, known, reach)
    noise = math.exp(float(np.median(covariates["noise"][known])))
    _, stable = estimate_errors(d, variance, covariates, 1.0, reach)
    rows, cols = np.mgrid[: d.shape[0], : d.shape[1]]
    block = ((rows // side) + (cols // side)) % 2
    plain, corrected, freedom = (np.full(d.shape, np.nan) for _ in range(3))
    is_predicted = np.zeros(2, bool)
    ratio = []
    for k in (0, 1):
        held = (block == k) & known
        model, kept = estimate_errors(np.where(held, np.nan, d), np.where(held, 0.0, variance), covariates, 1.0, reach)
        s2 = model.correlated_variance(covariates, d.shape)
        ratio.append(float(np.sqrt(np.median(s2[held]))) / noise)
        plain[held] = d[held] / np.sqrt(variance + s2)[held]
        freedom[held] = model.scale.freedom
        # the held-out blocks are predicted from the others
        prediction = predict_errors(d, (variance, s2), model, kept & ~held, 1.0, noise=noise)
        if prediction is None:
            corrected[held] = plain[held]
        else:
            corrected[held] = ((d - prediction.error) / np.sqrt(variance + prediction.variance))[held]
            is_predicted[k] = True
    before = np.where(known, d / np.sqrt(np.where(known, variance, 1.0)), np.nan)
    grounds = {"found stable": stable & known}
    grounds["away from shores" if transects is None else "transects"] = known & (
        ground if transects is None else transects
    )
    print(
        f"{name} (offset {offset:+.3f} m, errors over noise {ratio[0]:.1f} and {ratio[1]:.1f}, "
        f"halves predicted: {is_predicted.sum()})"
    )
    for label, where in grounds.items():
        print(f"   {label:17s} {where.sum():7d} cells", end="")
        for title, z in (("independent alone", before), ("held out", plain), ("predicted", corrected)):
            spread = 1.4826 * np.median(np.abs(z[where]))
            flagged = np.mean(np.abs(normal_score(z[where], freedom[where] if z is not before else math.inf)) > 1.96)
            print(f"  {title}: robust sd of z {spread:.2f}, flagged {100 * flagged:.1f} %", end="")
        print()
    sys.stdout.flush()


def cost(predict):
    """CPU time and memory of the error model and of polygons on 2000 x 2000 cells, six patches of which change."""
    rng = np.random.default_rng(1)
    shape = (2000, 2000)
    difference = quiet(1, shape) + smooth_field(rng, shape, 0.05, 30.0)
    for k, height in enumerate((0.5, -0.5, 0.2, -0.2, 0.1, 0.05)):
        difference[300 + 800 * (k % 2) : 500 + 800 * (k % 2), 200 + 600 * (k // 2) : 400 + 600 * (k // 2)] += height
    found = evidence(difference, 0.01)
    # compiled code is loaded once a process
    cell_errors(evidence(difference[200:600, 100:500], 0.01), 1.0, predict=predict)
    before, start, wall = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time(), time.time()
    errors = cell_errors(found, 1.0, predict=predict)
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    cpu, wall = time.process_time() - start, time.time() - wall
    print(f"error model 2000 x 2000: {cpu:.1f} s CPU, {wall:.1f} s wall, {used / 1024:.0f} MB more")
    maps = judge_change(found, errors, SETTINGS)
    for side in (50, 200, 2000):
        start = time.process_time()
        sum_std(maps, np.ones((side, side)), 1.0, np.s_[:side, :side])
        print(f"polygon of {side * side} cells: {time.process_time() - start:.4f} s")
    start = time.process_time()
    judge_change(found, errors, SETTINGS)
    print(f"maps 2000 x 2000: {time.process_time() - start:.1f} s CPU")
    start = time.process_time()
    find_objects_of_change(maps, 1.0, 0.95, 0.05)
    print(f"objects 2000 x 2000: {time.process_time() - start:.1f} s CPU")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["chain", "points", "dem", "means", "volumes", "real", "cost"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--scenes", default="../shared/scenes.py")
    parser.add_argument("--densities", default="100,9,2.5")
    parser.add_argument("--cells", type=int, default=2000)
    parser.add_argument("--cases", default="corr:9,het:9,iid:9,iid:2.5,gappy:9")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--size", type=float, default=100.0, help="width of the ground, m")
    parser.add_argument("--predict", action="store_true", help="predict errors from ground found not to have changed")
    options = parser.parse_args()
    if options.predict:
        global SETTINGS  # noqa: PLW0603
        SETTINGS = DifferencingConfig(predict_errors="always")
    if options.part == "points":
        points(load_scenes(options.scenes), options.seeds, [float(v) for v in options.densities.split(",")])
    elif options.part == "chain":
        cases = [(c.split(":")[0], float(c.split(":")[1])) for c in options.cases.split(",")]
        whole_chain(load_scenes(options.scenes), options.seeds, cases, options.first_seed, options.size)
    elif options.part == "dem":
        dem(options.scenes, options.seeds, options.cells)
    elif options.part == "means":
        means(options.seeds)
    elif options.part == "volumes":
        volumes(options.seeds)
    elif options.part == "real":
        for case in (*toronto(), *beach()):
            held_out(*case)
    else:
        cost(options.predict)


if __name__ == "__main__":
    main()
