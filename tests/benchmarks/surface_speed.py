"""
Cost of the adaptive surface model, per point and per cell, on one core.

Run: python tests/benchmarks/surface_speed.py
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numba
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from changedetect.models.lwpr import LWPRSurface
from changedetect.synthetic import benchmark_points


def measure(density: float, repeats: int) -> tuple[float, float, float, float]:
    """Medians: learning us per point, prediction us per cell, state bytes per point and per m2."""
    cloud = benchmark_points(1, density=density)[0].cloud
    coordinates = (cloud.easting, cloud.northing)
    west, south = np.floor(cloud.easting.min()), np.floor(cloud.northing.min())
    step = (np.arange(400) + 0.5) * 0.25
    cells = [a.ravel() for a in np.meshgrid(west + step, south + step)]
    learning, prediction = [], []
    for _ in range(repeats + 1):
        start = time.thread_time()
        model = LWPRSurface(resolution=0.25).fit(coordinates, cloud.elevation)
        model.observed((cells[0][:1], cells[1][:1]))  # receptive fields are built on first use
        middle = time.thread_time()
        model.predict(cells)
        learning.append((middle - start) / len(cloud))
        prediction.append((time.thread_time() - middle) / cells[0].size)
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder))
        size = sum(f.stat().st_size for f in Path(folder).iterdir())
    area = float(np.ptp(cloud.easting) * np.ptp(cloud.northing))
    # the first round compiles
    return 1e6 * np.median(learning[1:]), 1e6 * np.median(prediction[1:]), size / len(cloud), size / area


def main() -> None:
    """Print one row per density."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    numba.set_num_threads(1)
    print("points/m2  learning us/point  prediction us/cell  state bytes/point  state bytes/m2")
    for density in (1.0, 10.0, 100.0):
        row = measure(density, repeats)
        print(f"{density:9.0f}  {row[0]:17.2f}  {row[1]:18.2f}  {row[2]:17.1f}  {row[3]:14.0f}")


if __name__ == "__main__":
    main()
