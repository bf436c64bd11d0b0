"""
Accuracy and calibration of the surface beside kriging (dense) and exact Gaussian process regression (sparse).

Trees scene, 60 x 60 m, 40 000 or 2 500 points; error against the noise-free truth on a 180 x 180 grid half a metre
inside the rim; all methods on the same points in the same run.

Run: python tests/benchmarks/surface_accuracy.py [--seeds 5]
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from changedetect.models.comparators import comparators
from changedetect.models.lwpr import LWPRSurface
from changedetect.synthetic import trees_scene

PEERS = {40_000: "kriging", 2_500: "gpr_matern32"}


def score(model, scene, points, at):
    """RMSE; coverage at 95 % of surface, observations and those of the least and the largest noise; CPU seconds."""
    easting, northing, elevation = points
    start = time.process_time()
    answer = model.fit((easting, northing), elevation).predict(at)
    seconds = time.process_time() - start
    truth = scene.surface(*at)
    known = np.isfinite(answer.elevation)
    error = (answer.elevation - truth)[known]
    observed = truth + np.random.default_rng(0).normal(size=truth.size) * scene.noise_std(*at)
    spread = np.hypot(answer.elevation_std, answer.noise_std)
    surface = np.mean(np.abs(error) < 1.96 * answer.elevation_std[known])
    inside = (np.abs(observed - answer.elevation) < 1.96 * spread)[known]
    low, high = np.quantile(answer.noise_std[known], (0.25, 0.75))
    quiet, noisy = inside[answer.noise_std[known] <= low].mean(), inside[answer.noise_std[known] >= high].mean()
    return np.sqrt(np.mean(error**2)), surface, inside.mean(), quiet, noisy, seconds


def main() -> None:
    """Print one row per seed and size, then medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    n_seeds = parser.parse_args().seeds
    for n, peer in PEERS.items():
        ratios, covers = [], []
        for seed in range(n_seeds):
            scene = trees_scene(seed)
            west, east, south, north = scene.region
            rng = np.random.default_rng([seed, n])
            easting, northing = rng.uniform(west, east, n), rng.uniform(south, north, n)
            noise = rng.normal(size=n) * scene.noise_std(easting, northing)
            points = (easting, northing, scene.surface(easting, northing) + noise)
            axes = np.linspace(west + 0.5, east - 0.5, 180), np.linspace(south + 0.5, north - 0.5, 180)
            at = tuple(a.ravel() for a in np.meshgrid(*axes))
            ours, theirs = score(LWPRSurface(), scene, points, at), score(comparators()[peer](), scene, points, at)
            ratios.append(ours[0] / theirs[0])
            covers.append(ours[1:5])
            print(
                f"{n:6d} seed {seed}  lwpr {ours[0]:.3f} m  {peer} {theirs[0]:.3f} m  ratio {ratios[-1]:.3f}  coverage "
                f"surface {ours[1]:.3f} ({theirs[1]:.3f})  observations {ours[2]:.3f} ({theirs[2]:.3f})  "
                f"cpu {ours[5]:.2f} s ({theirs[5]:.2f} s)"
            )
        cover = np.median(covers, axis=0)
        print(
            f"{n:6d} median ratio {np.median(ratios):.3f}, from {min(ratios):.3f} to {max(ratios):.3f}; "
            f"median coverage surface {cover[0]:.3f}, observations {cover[1]:.3f}, where noise is found least "
            f"{cover[2]:.3f} and largest {cover[3]:.3f}"
        )


if __name__ == "__main__":
    main()
