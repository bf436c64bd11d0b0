"""
Time series of cells: false alarms over many epochs, power, dates, calibration of the null, ways beside it, cost.

Run: python tests/benchmarks/time_series.py null|cells|ways|cost [--scene iid|corr|mixed] [--epochs N] [--seeds N]

`null` draws series of known variances. `cells` simulates a site of 60 x 60 m at 9 observations a m2 (noise 5 cm), 50
epochs a month apart on average, with patches of 10 x 10 m that change; `corr` adds to each epoch an error of 3 cm that
is correlated over 4 m, `mixed` has densities from 4 to 25, errors of 1 to 4 cm, a quarter of each epoch missing, and an
error of 6 cm in the first. Nothing is told to the estimator; with `--known` (not `mixed`) it is told the variance of
the correlated errors, so that only the statistics over time are tested, and quickly. `ways` compares differences
against the first epoch, each with a shared surface of its own, with one surface shared by all.
"""

import argparse
import math
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy import ndimage

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

from error_fields import smooth_field  # noqa: E402

from changedetect.differencing.shared_surface import estimate_difference  # noqa: E402
from changedetect.grid import Grid  # noqa: E402
from changedetect.models.lwpr import LWPRSurface  # noqa: E402
from changedetect.models.pyramid import Lattice  # noqa: E402
from changedetect.pipeline.stacking import stack_epochs  # noqa: E402
from changedetect.timeseries import judgement as J  # noqa: E402
from changedetect.timeseries.errors import epoch_errors  # noqa: E402
from changedetect.timeseries.judgement import ChangePrior, estimate_prior, judge_series  # noqa: E402

WEST, SOUTH, SIDE, CELL = 500000.0, 5000000.0, 60.0, 0.5
GRID = Grid.from_region((WEST, WEST + SIDE, SOUTH, SOUTH + SIDE), CELL, "EPSG:32632")
LATTICE = Lattice(0.0, CELL, round(SOUTH / CELL), round(WEST / CELL), *GRID.shape)
NOISE = 0.05
MARGIN = 3.0  # m
ALARM = 0.05


def step(at, size):
    """Level of a step at an epoch."""
    return lambda k, _years: size * (k >= at)


#: Corner (east, north) of each patch, 10 m wide, and its level at epoch k and time in years.
PATCHES = {
    "step 5 cm, epoch 25": ((4, 4), step(25, 0.05)),
    "step 10 cm, epoch 25": ((18, 4), step(25, 0.10)),
    "trend 1 cm/year": ((32, 4), lambda _k, years: 0.01 * years),
    "trend 3 cm/year": ((46, 4), lambda _k, years: 0.03 * years),
    "10 cm, epochs 25 to 30": ((4, 18), lambda k, _years: 0.10 * (25 <= k <= 30)),
    "10 cm, epoch 25 alone": ((18, 18), lambda k, _years: 0.10 * (k == 25)),
    "step 10 cm, newest epoch": ((32, 18), lambda k, years: 0.10 * (k == 49)),
    "step 10 cm, newest two": ((46, 18), step(48, 0.10)),
}


def terrain(east, north):
    """Rolling ground with detail."""
    smooth = 2.0 * np.sin(east / 7.0) + 1.5 * np.cos(north / 5.0 + east / 11.0)
    return smooth + 0.3 * np.sin(east / 1.9) * np.cos(north / 2.3)


def scene(name, n_epochs, seed, changes=True):
    """Yield model and time of each epoch."""
    rng = np.random.default_rng([seed, len(name), n_epochs])
    days = np.cumsum(rng.uniform(20.0, 40.0, n_epochs))
    for k in range(n_epochs):
        density, error = 9.0, {"iid": 0.0, "corr": 0.03}.get(name)
        if name == "mixed":
            density = rng.choice([4.0, 9.0, 25.0])
            error = 0.06 if k == 0 else rng.choice([0.01, 0.02, 0.04])
        east, north = rng.uniform(0.0, SIDE, (2, rng.poisson(density * SIDE**2)))
        z = terrain(east, north) + rng.normal(0.0, NOISE, east.size)
        if error:
            field = smooth_field(rng, (120, 120), error, 8.0)
            z += ndimage.map_coordinates(field, [north / CELL - 0.5, east / CELL - 0.5], order=1, mode="nearest")
        for (e, n), level in PATCHES.values() if changes else ():
            inside = (east > e) & (east < e + 10) & (north > n) & (north < n + 10)
            z += inside * level(k, (days[k] - days[0]) / 365.25)
        if name == "mixed":
            hole = rng.uniform(0.0, SIDE, 2)
            kept = np.maximum(np.abs(east - hole[0]), np.abs(north - hole[1])) > 0.25 * SIDE
            east, north, z = east[kept], north[kept], z[kept]
        model = LWPRSurface(resolution=CELL)
        model.fit((WEST + east, SOUTH + north), z, None, float(days[k]))
        yield model, days[k]


def analyse(name, n_epochs, seed, is_known):
    """Stack, judgement, times, of a scene, by the code of the command."""
    models, days = zip(*scene(name, n_epochs, seed), strict=True)
    shelf = {str(k): model for k, model in enumerate(models)}
    with tempfile.TemporaryDirectory() as folder:
        stack = stack_epochs(shelf.__getitem__, list(shelf), GRID, Path(folder))
        if is_known:
            stack.correlated[:] = {"iid": 0.0, "corr": 0.03**2}[name]
        else:
            epoch_errors(stack, None)
        series = stack.series(slice(None))
    prior = estimate_prior(*series, np.array(days))
    return series, judge_series(*series, np.array(days), prior, 1.0 - ALARM), np.array(days)


def masks():
    """Inside of each patch, and the quiet ground."""
    east, north = GRID.easting[None, :] - WEST, GRID.northing[:, None] - SOUTH
    inside, touched = {}, np.zeros(GRID.shape, bool)
    for name, ((e, n), _) in PATCHES.items():
        inside[name] = (np.maximum(np.abs(east - e - 5), np.abs(north - n - 5)) < 5 - MARGIN).ravel()
        touched |= np.maximum(np.abs(east - e - 5), np.abs(north - n - 5)) < 5 + MARGIN
    return inside, ~touched.ravel()


def cells(name, n_epochs, seeds, is_known):
    """False alarms and power by kind of change."""
    inside, quiet = masks()
    alarms, scatter, found = [], [], {patch: [] for patch in PATCHES}
    for seed in range(seeds):
        (values, variances, _), judged, days = analyse(name, n_epochs, seed, is_known)
        known = quiet & (judged.n_surveys >= 2)
        classes = judged.series_class
        mean = np.nansum(values / variances, axis=1) / np.nansum(1.0 / variances, axis=1)
        ratio = np.nansum((values - mean[:, None]) ** 2 / variances, axis=1) / (judged.n_surveys - 1.0)
        alarms.append([np.mean(classes[known] == c) for c in range(8)])
        scatter.append(np.mean(ratio[known]))
        for patch, here in inside.items():
            dates = np.searchsorted(days, judged.break_time[here])
            found[patch].append(
                [*(np.mean(classes[here] == c) for c in range(8)), np.mean(judged.p_value[here] <= ALARM),
                 np.median(dates), np.mean(judged.break_size[here]), np.mean(judged.break_size_std[here]),
                 np.mean(judged.trend[here]), np.mean(judged.trend_std[here]),
                 np.mean(judged.confirming_surveys[here])]
            )  # fmt: skip
        print(f"  seed {seed}: alarms {100 * (1 - alarms[-1][0]):.2f} %", flush=True)
    rates = 100 * (1 - np.array(alarms)[:, 0])
    by_class = "  ".join(f"{100 * v:.2f}" for v in np.mean(alarms, axis=0))
    print(
        f"{name}, {n_epochs} epochs, {seeds} seeds: false alarms {rates.mean():.2f} % +- "
        f"{rates.std() / math.sqrt(max(seeds - 1, 1)):.2f} ({rates.min():.1f} to {rates.max():.1f}), "
        f"chi2/dof {np.mean(scatter):.3f}; share by class {by_class}"
    )
    print("  patch: alarm | classes 0-7 % | epoch | size, std | trend, std m/year | confirming")
    for patch, rows in found.items():
        m = np.mean(rows, axis=0)
        shares = " ".join(f"{100 * v:.0f}" for v in m[:8])
        print(
            f"  {patch}: {100 * m[8]:.1f} % | {shares} | {m[9]:.1f} | {m[10]:+.4f} {m[11]:.4f} | "
            f"{m[12]:+.4f} {m[13]:.4f} | {m[14]:.1f}",
            flush=True,
        )


def null(n_series):
    """Rates of p-values of series without change, and of repeated looks."""
    rng = np.random.default_rng(0)
    prior = ChangePrior(0.3)
    print("surveys, variances, missing: share of series with p <= 10, 5, 1, 0.1 %")
    for n in (2, 3, 6, 12, 25, 50):
        for kind, missing in (("equal", 0.0), ("unequal", 0.0), ("unequal", 0.3)):
            std = np.ones(n) if kind == "equal" else np.exp(rng.normal(0.0, 0.7, n))
            days = np.cumsum(rng.exponential(30.0, n))
            values = rng.normal(0.0, std, (n_series, n))
            values[rng.uniform(size=values.shape) < missing] = np.nan
            judged = judge_series(values, np.broadcast_to(std**2, values.shape), None, days, prior, 0.95)
            known = judged.n_surveys >= 2
            rates = [100 * np.mean(judged.p_value[known] <= a) for a in (0.1, 0.05, 0.01, 0.001)]
            print(f"  {n:3d} {kind:8s} {missing:.0%}: " + "  ".join(f"{r:.2f}" for r in rates), flush=True)
    n = 50
    values, days = rng.normal(0.0, 1.0, (n_series // 10, n)), 30.0 * np.arange(n)
    ever, confirmed, watched = (np.zeros(len(values), bool) for _ in range(3))
    level = J.monitoring_level(n, ALARM)
    for k in range(2, n + 1):
        judged = judge_series(values[:, :k], np.ones((len(values), k)), None, days[:k], prior, 0.95)
        ever |= judged.p_value <= ALARM
        watched |= judged.p_value <= level
        confirmed |= np.isin(judged.series_class, (J.BREAK_LOWERED, J.BREAK_RAISED))
    print(
        f"  looked at after each of 50 surveys: ever p <= 5 % {100 * ever.mean():.1f} %, ever a confirmed break "
        f"{100 * confirmed.mean():.1f} %; at the level of monitoring, {level:.4f}: ever {100 * watched.mean():.1f} %"
    )


def ways(seeds):
    """One surface shared by all against one for each pair with the first epoch; ten epochs, step of 10 cm at five."""
    for name in ("iid", "mixed"):
        table = []
        for seed in range(seeds):
            models = [model for model, _ in scene(name, 10, seed, changes=False)]
            for model in models:
                model.own_cells()
            shelf = {str(k): model for k, model in enumerate(models)}
            start = time.perf_counter()
            with tempfile.TemporaryDirectory() as folder:
                stack = stack_epochs(shelf.__getitem__, list(shelf), GRID, Path(folder))
                v, s = np.array(stack.value, float), np.array(stack.variance, float)
            first = time.perf_counter() - start
            start = time.perf_counter()
            pairs = [
                estimate_difference(
                    models[0].own_cells(), m.own_cells(), (models[0].own_kernel_, m.own_kernel_), LATTICE
                )
                for m in models[1:]
            ]
            second = time.perf_counter() - start
            z = (v[1:] - v[0]) / np.sqrt(s[1:] + s[0])
            zp = np.array([p.difference / np.sqrt(p.variance) for p in pairs])
            stds = np.sqrt(np.nanmean(s[1:] + s[0])), np.sqrt(np.mean([np.nanmean(p.variance) for p in pairs]))
            between = [p.difference for p in pairs]
            noise_pairs = np.nanstd(np.diff(between, axis=0)) / math.sqrt(2.0)
            noise_stack = np.nanstd(np.diff(v[1:], axis=0)) / math.sqrt(2.0)
            table.append([np.nanstd(z), np.nanstd(zp), *stds, noise_stack, noise_pairs, first, second])
        m = np.mean(table, axis=0)
        print(
            f"{name}: sd of z shared {m[0]:.3f}, pairs {m[1]:.3f}; std of d {m[2]:.5f}, {m[3]:.5f} m; scatter of later "
            f"epochs {m[4]:.5f}, {m[5]:.5f} m; {m[6]:.1f}, {m[7]:.1f} s",
            flush=True,
        )


def cost():
    """Time and memory by number of epochs."""
    for n in (10, 20, 40):
        models = [model for model, _ in scene("corr", n, 1)]
        for model in models:
            model.own_cells()
        shelf = {str(k): model for k, model in enumerate(models)}
        with tempfile.TemporaryDirectory() as folder:
            t0 = time.process_time()
            stack = stack_epochs(shelf.__getitem__, list(shelf), GRID, Path(folder))
            t1 = time.process_time()
            epoch_errors(stack, None)
            t2 = time.process_time()
            series = stack.series(slice(None))
            judge_series(*series, np.arange(n) * 30.0, estimate_prior(*series, np.arange(n) * 30.0), 0.95)
            t3 = time.process_time()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{n} epochs: deviations {t1 - t0:.1f} s, errors {t2 - t1:.1f} s, judgement {t3 - t2:.1f} s (processor), "
              f"{peak:.0f} MB", flush=True)  # fmt: skip


def main():
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["null", "cells", "ways", "cost"])
    parser.add_argument("--scene", choices=["iid", "corr", "mixed"], default="corr")
    parser.add_argument("--epochs", type=int, default=50)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--known", action="store_true")
    arguments = parser.parse_args()
    if arguments.what == "null":
        null(100_000)
    elif arguments.what == "cells":
        cells(arguments.scene, arguments.epochs, arguments.seeds, arguments.known)
    elif arguments.what == "ways":
        ways(min(arguments.seeds, 3))
    else:
        cost()


if __name__ == "__main__":
    main()
