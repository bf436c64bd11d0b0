"""
Every surface model on held-out points of two real surveys, single points and blocks, several seeds.

Toronto: airborne lidar, ground class, 0.5 points/m2. Brighton Beach: photogrammetry from a drone, a
park with trees, thinned.
Exact Gaussian processes cope with 5000 points and compete on the third set alone, Toronto thinned. Medians over the
seeds; then RMSE, CRPS and NLPD relative to the best comparator's of the same run.

Run: CHANGEDETECT_DATA=FOLDER python tests/benchmarks/holdout_real.py [--seeds 5] [--sets toronto] [--models ...]
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from changedetect.config import ProgrammeConfig
from changedetect.io.points import SourceOptions, open_points
from changedetect.pointcloud import PointCloud
from changedetect.validation import ComparisonOptions, compare_methods, known_methods

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
#: File, classes, resolution (m) and number of points after thinning.
SETS = {
    "toronto": ("ttp_lidar/ttp_2015_thinned.laz", (2,), 1.0, None),
    "brighton": ("uav_brighton_beach/model.laz", None, 0.25, 60_000),
    "toronto_thin": ("ttp_lidar/ttp_2015_thinned.laz", (2,), 1.0, 5_500),
}


def read(name: str) -> PointCloud:
    """All points of a set."""
    path, classes, _, _ = SETS[name]
    options = SourceOptions(crs=None, sigma=None, classes=classes, columns=None, nodata=None)
    return PointCloud.concatenate(list(open_points(DATA / path, options).iter_chunks()))


def compare(name: str, seeds: range, chosen: list[str] | None) -> list:
    """One comparison a seed."""
    _, _, resolution, n_points = SETS[name]
    known = known_methods(ProgrammeConfig(crs="EPSG:26917", resolution=resolution))
    cloud = read(name)
    n_learned = 0.9 * min(len(cloud), n_points or len(cloud))
    picked = [known[item] for item in chosen or known if (known[item].max_points or n_learned) >= n_learned]
    options = [ComparisonOptions(max_points=n_points, seed=seed) for seed in seeds]
    return [compare_methods(cloud, picked, item) for item in options]


def ratio_to_best(hold_out, score: str) -> float | None:
    """Score of the first method over the best comparator's (difference for NLPD); LWPR as published is none."""
    ours = getattr(hold_out.evaluations[0].common, score)
    others = [
        getattr(item.common, score)
        for item in hold_out.evaluations
        if item.name not in ("adaptive", "reference") and item.common is not None
    ]
    if not others:
        return None
    return ours - min(others) if score == "nlpd" else ours / min(others)


def report(name: str, comparisons: list) -> None:
    """One table for each hold-out, medians over the seeds."""
    for number, kind in enumerate(item.kind for item in comparisons[0].hold_outs):
        runs = [comparison.hold_outs[number] for comparison in comparisons]
        first = runs[0]
        place = kind if first.block_side is None else f"blocks of {first.block_side:g} m"
        print(f"\n**{name}, {place}**: {first.n_learned} learned, {first.n_held_out} held out, "
              f"{first.n_common} answered by all (first seed)\n")  # fmt: skip
        print("| method | answered | RMSE m | CRPS m | NLPD | NLPD median | in 50 % | 90 % | 95 % | quiet | noisy "
              "| CPU s | memory MB |\n" + "|---" * 13 + "|")  # fmt: skip
        for at, evaluation in enumerate(first.evaluations):
            items = [run.evaluations[at] for run in runs]
            if any(item.common is None for item in items):
                print(f"| {evaluation.title} | {evaluation.skipped or 'no answers'} |" + " |" * 11)
                continue
            answered = np.median([i.n_answered / r.n_held_out for i, r in zip(items, runs, strict=True)])
            of = {key: np.median([getattr(i.common, key) for i in items]) for key in vars(items[0].common)}
            quarters = [np.median([getattr(i, key).coverage_95 for i in items]) for key in ("quiet", "noisy")]
            memory = np.median([i.peak_memory_bytes or 0 for i in items]) / 1e6
            thinned = f" ({evaluation.n_learned} points)" if evaluation.is_subsampled else ""
            print(f"| {evaluation.title}{thinned} | {100 * answered:.1f} % | {of['rmse']:.4f} | {of['crps']:.4f} | "
                  f"{of['nlpd']:.3f} | {of['nlpd_median']:.3f} | {of['coverage_50']:.3f} | {of['coverage_90']:.3f} | "
                  f"{of['coverage_95']:.3f} | {quarters[0]:.3f} | {quarters[1]:.3f} | "
                  f"{np.median([i.cpu_seconds for i in items]):.1f} | {memory:.0f} |")  # fmt: skip
        for score in ("rmse", "crps", "nlpd"):
            values = [value for value in (ratio_to_best(run, score) for run in runs) if value is not None]
            if values:
                relation = "minus" if score == "nlpd" else "over"
                print(f"\n{score} {relation} the best comparator's: median {np.median(values):.3f}, "
                      f"from {min(values):.3f} to {max(values):.3f}")  # fmt: skip
        sys.stdout.flush()


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--sets", default=",".join(SETS))
    parser.add_argument("--models", default=None)
    given = parser.parse_args()
    chosen = None if given.models is None else given.models.split(",")
    for name in given.sets.split(","):
        report(name, compare(name, range(given.seeds), chosen))


if __name__ == "__main__":
    main()
