"""
Epochs of very different density and source: false positives where nothing changed, and how change comes out.

Run: python tests/benchmarks/resolution.py [--seeds 20] [--scene clouds|model]

clouds: 0.7 against 100 points/m2, noise 5 and 3 cm, rough ground, 120 m. model: an elevation model of 10 m cells, each
the mean over its cell with an error of 10 cm, against 5 points/m2 with 5 cm, 500 m.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from coarse_and_dense import SOUTH, WEST, cloud, elevation_model

from changedetect.config import DifferencingConfig
from changedetect.differencing import difference_models
from changedetect.grid import Grid
from changedetect.models.lwpr import LWPRSurface
from changedetect.synthetic import fractal_ground

#: Side of the ground, m; width of the rim that is left out, m; cell of the map, m.
SCENES = {"clouds": (120.0, 8.0, 0.5), "model": (500.0, 25.0, 1.0)}


def ground_of(scene: str, seed: int):
    """Self-affine ground, H = 0.7."""
    side, relief, shortest = SCENES[scene][0], *{"clouds": (2.5, 0.5), "model": (8.0, 1.0)}[scene]
    region = (WEST, WEST + side, SOUTH, SOUTH + side)
    return fractal_ground(
        region, np.random.default_rng(seed), relief_std=relief, roughness=0.7, shortest=shortest,
        longest=1.5 * side, n_waves=150,
    )  # fmt: skip


def epochs_of(scene: str, seed: int, change=None):
    """The coarse epoch, and the dense one with the change."""
    side, ground = SCENES[scene][0], ground_of(scene, seed)
    if scene == "clouds":
        return cloud(ground, side, 0.7, 100 + seed, 0.05), cloud(ground, side, 100.0, 200 + seed, 0.03, change)
    return elevation_model(ground, side, 10.0, 100 + seed, 0.10), cloud(ground, side, 5.0, 200 + seed, 0.05, change)


def maps_of(scene: str, seed: int, change=None):
    """Maps of the difference, their grid, and cells away from the rim."""
    side, rim, cell = SCENES[scene]
    models = [
        LWPRSurface(resolution=cell).fit(points.coordinates, points.elevation)
        for points in epochs_of(scene, seed, change)
    ]
    grid = Grid.from_region((WEST, WEST + side, SOUTH, SOUTH + side), cell, "EPSG:32632")
    inner = np.zeros(grid.shape, bool)
    k = int(rim / cell)
    inner[k:-k, k:-k] = True
    maps = difference_models(*models, grid, DifferencingConfig())
    return maps, grid, inner & np.isfinite(maps.dod)


def quiet(scene: str, n_seeds: int) -> None:
    """Nothing changed."""
    rows = []
    for seed in range(n_seeds):
        maps, _, inner = maps_of(scene, seed)
        flagged = np.isin(maps.change_class, (1, 2))[inner].mean()
        local = np.mean(np.abs(maps.dod / maps.local_std)[inner] > 1.96)
        rows.append((flagged, local, maps.z_score[inner].std(), np.median(maps.dod_std[inner])))
        print(f"  seed {seed}: flagged {100 * flagged:.1f} %, independent errors alone {100 * local:.1f} %", flush=True)
    flagged, local, spread, std = np.mean(rows, axis=0)
    print(
        f"{scene}: false positives {100 * flagged:.1f} % ({100 * local:.1f} % with independent errors alone), sd of z "
        f"{spread:.2f}, dod_std {std:.4f} m, resolution {np.median(maps.resolution.width[inner]):.1f} m, "
        f"footprints {maps.resolution.footprints}"
    )


def strips(scene: str, n_seeds: int, height: float) -> None:
    """A strip of ground raised, of several widths."""
    side = SCENES[scene][0]
    for width in (3.0, 10.0, 40.0):

        def change(easting, northing, width=width):
            along = np.abs(northing - SOUTH - 0.5 * side) < 0.35 * side
            return np.where((np.abs(easting - WEST - 0.5 * side) < 0.5 * width) & along, height, 0.0)

        found = []
        for seed in range(n_seeds):
            maps, grid, _ = maps_of(scene, seed, change)
            rows, middle = slice(int(0.3 * grid.n_rows), int(0.7 * grid.n_rows)), grid.n_cols // 2
            across = maps.dod[rows].mean(axis=0)
            seen = grid.resolution * np.count_nonzero(across > 0.5 * across[middle])
            found.append((across[middle] / height, seen, np.median(maps.resolution.width[rows, middle])))
        share, seen, resolution = np.mean(found, axis=0)
        print(
            f"{scene}: strip of {width:g} m, {height:g} m high: {100 * share:.0f} % of its height, {seen:.1f} m wide "
            f"on the map, resolution stated there {resolution:.1f} m"
        )


def main() -> None:
    """Print one line a seed and one a result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--scene", choices=sorted(SCENES))
    arguments = parser.parse_args()
    for scene in [arguments.scene] if arguments.scene else sorted(SCENES):
        quiet(scene, arguments.seeds)
        strips(scene, max(1, arguments.seeds // 10), 0.5)


if __name__ == "__main__":
    main()
