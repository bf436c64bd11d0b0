"""
False positives and power of the difference on scenes with known change and independent noise of 5 cm.

Run: python tests/benchmarks/difference_calibration.py [--seeds 5]
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from changedetect.config import DifferencingConfig
from changedetect.differencing import difference_models
from changedetect.grid import Grid
from changedetect.models.lwpr import LWPRSurface
from changedetect.synthetic import benchmark_points

MARGIN = {2.5: 4.2, 9.0: 2.1, 100.0: 1.6}  # m, more than the radius of a field of the difference


def epochs(density: float, seed: int):
    """Scene, and models of the two epochs."""
    surveys = benchmark_points(seed, density=density)
    models = [LWPRSurface(resolution=0.25).fit((s.cloud.easting, s.cloud.northing), s.cloud.elevation) for s in surveys]
    return surveys[0].scene, models


def draw(density: float, seed: int):
    """Share flagged and z where nothing changed; (height, power, mean change) of every patch."""
    scene, models = epochs(density, seed)
    grid = Grid.from_region(scene.region, 0.5, scene.crs)
    maps = difference_models(*models, grid, DifferencingConfig())
    easting, northing = grid.coordinates()
    label = scene.change_labels(easting, northing, margin=MARGIN[density]).reshape(grid.shape)
    inner = np.zeros(grid.shape, bool)
    rim = int(np.ceil(MARGIN[density] / grid.resolution))
    inner[rim:-rim, rim:-rim] = True
    flagged = (maps.change_class == 1) | (maps.change_class == 2)
    stable = inner & (label == 0) & np.isfinite(maps.dod)
    truth = scene.change(easting, northing).reshape(grid.shape)
    patches = []
    for k in range(1, label.max() + 1):
        cells = (label == k) & np.isfinite(maps.dod)
        patches.append((round(float(truth[cells].mean()), 2), flagged[cells].mean(), maps.dod[cells].mean()))
    return flagged[stable].mean(), maps.z_score[stable].std(), patches


def edge_width(density: float, seed: int) -> float:
    """Distance, m, over which the mean profile across the edges of the 0.5 m patch rises from 10 to 90 % of it."""
    scene, models = epochs(density, seed)
    grid = Grid.from_region(scene.region, 0.125, scene.crs)
    easting, northing = grid.coordinates()
    patch = np.argwhere(scene.change(easting, northing).reshape(grid.shape) > 0.4)
    (north, west), (south, east) = patch.min(axis=0), patch.max(axis=0) + 1
    dod = difference_models(*models, grid, DifferencingConfig()).dod / 0.5
    reach, inside = 24, slice(32, -32)
    sides = [
        dod[north:south, west - reach : west + reach][inside].mean(axis=0),
        dod[north:south, east - reach : east + reach][inside].mean(axis=0)[::-1],
        dod[north - reach : north + reach, west:east][:, inside].mean(axis=1),
        dod[south - reach : south + reach, west:east][:, inside].mean(axis=1)[::-1],
    ]
    rise = np.maximum.accumulate(np.mean(sides, axis=0))
    low, high = (np.interp(level, rise, np.arange(rise.size)) for level in (0.1, 0.9))
    return float(high - low) * grid.resolution


def main() -> None:
    """Print one row per density."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    n_seeds = parser.parse_args().seeds
    for density in MARGIN:
        false, spread, power, mean = [], [], {}, {}
        for seed in range(n_seeds):
            share, z, patches = draw(density, seed)
            false.append(share)
            spread.append(z)
            for height, found, change in patches:
                power.setdefault(height, []).append(found)
                mean.setdefault(height, []).append(change)
        print(
            f"{density:6.1f} points/m2  false positives {100 * np.mean(false):.1f} % (from {100 * min(false):.1f} to "
            f"{100 * max(false):.1f})  sd of z {np.mean(spread):.2f}"
        )
        for height in sorted(power):
            found, average = 100 * np.mean(power[height]), np.mean(mean[height])
            print(f"        {height:+.2f} m: found {found:5.1f} %, mean {average:+.4f} m")
        widths = [edge_width(density, seed) for seed in range(n_seeds)]
        print(f"        step of 0.5 m: 10 to 90 % over {np.mean(widths):.2f} m")


if __name__ == "__main__":
    main()
