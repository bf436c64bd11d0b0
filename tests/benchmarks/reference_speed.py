"""
Speed of reference mode, one core: learning and prediction per sample, with few and with many receptive fields.

    python tests/benchmarks/reference_speed.py

Learning, fixed metric, w_gen 0.1: samples in random order over ground of constant density, so that a sample activates
as many receptive fields of a hundred as of ten thousand. The two learners take turns, batch by batch, and the fastest
and the median batch of each are given, in processor time of the one thread that works: on a shared machine the fastest
says what the code costs, the median what the neighbours leave of the caches. Bars: 1.5 us per point, and 1.3 for the
ratio of many to few; prediction 0.5 us per cell.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from changedetect.kernels.lwpr import learn
from changedetect.kernels.lwpr_predict import NoisePrior, predict_surface
from changedetect.kernels.lwpr_search import LWPRState
from changedetect.kernels.lwpr_state import GAUSSIAN, Parameters
from changedetect.models.reference import ReferenceLWPR, ReferenceSettings

KERNEL_M = 1.0
#: Receptive fields per kernel^2 that random samples leave at w_gen 0.1, measured.
PACKING = 0.143
PARAMETERS = Parameters(
    w_gen=0.1, update_d=False, init_lambda=0.99, final_lambda=0.999, init_m_xx=1 / KERNEL_M, init_m_yy=1 / KERNEL_M
)
BATCH, N_BATCHES = 10_000, 150


def ground(x, y):
    return np.sin(x / 3.0) + 0.3 * np.cos(y / 2.0)


class Learner:
    """Receptive fields over a square, already packed, and random samples of its interior."""

    def __init__(self, n_fields):
        self.side = np.sqrt(n_fields / PACKING) * KERNEL_M
        self.state = LWPRState()
        self.rng = np.random.default_rng(n_fields)
        self.learn(max(200 * n_fields, 20_000), 0.0)
        self.learned = 0.0

    def learn(self, n, margin):
        """Learn n samples at least `margin` from the border; return microseconds per sample."""
        x, y = self.rng.uniform(margin, self.side - margin, (2, n))
        target = ground(x, y) + 0.1 * self.rng.standard_normal(n)
        start = time.thread_time()
        learn(self.state, x, y, target, PARAMETERS)
        return (time.thread_time() - start) / n * 1e6

    def predict(self, n_cells, cell=0.25):
        """Predict a regular grid in the interior; return microseconds per cell."""
        n = int(np.sqrt(n_cells))
        axis = 0.5 * self.side + cell * (np.arange(n) - 0.5 * n)
        x, y = (a.ravel() for a in np.meshgrid(axis, axis))
        start = time.thread_time()
        predict_surface(self.state, x, y, GAUSSIAN, NoisePrior(0.01, 4.0))
        return (time.thread_time() - start) / len(x) * 1e6


def row(name, few, many, bar):
    print(f"{name:44s} {few:8.3f} {many:8.3f} {many / few:7.2f}   {bar}")


def main():
    Learner(50).predict(1000)  # compile
    few, many = Learner(100), Learner(10_000)
    margin = 4.0 * KERNEL_M  # beyond the reach of a receptive field: as many are active as anywhere
    times = {"learn": [], "predict": []}
    masses = [learner.state.fields["epoch_mass"].sum() for learner in (few, many)]
    for _ in range(N_BATCHES):
        times["learn"].append([learner.learn(BATCH, margin) for learner in (few, many)])
    gained = [
        (learner.state.fields["epoch_mass"].sum() - mass) / (BATCH * N_BATCHES)
        for learner, mass in zip((few, many), masses, strict=True)
    ]
    for _ in range(N_BATCHES):
        # the few cover 26 kernels, 18 of them interior: 70 x 70 cells, as many times as needed
        times["predict"].append([learner.predict(70 * 70 if learner is few else 500 * 500) for learner in (few, many)])
    print(f"{'microseconds per point or cell, one core':44s} {'few':>8s} {'many':>8s} {'ratio':>7s}   bar")
    row("receptive fields", few.state.n_fields, many.state.n_fields, "")
    row("activation mass per sample", *gained, "equal")
    row("learning, fastest batch", *np.min(times["learn"], axis=0), "<= 1.5, ratio <= 1.3")
    row("learning, median batch", *np.median(times["learn"], axis=0), "<= 1.5, ratio <= 1.3")
    row("prediction on a grid, fastest", *np.min(times["predict"], axis=0), "<= 0.5")
    row("prediction on a grid, median", *np.median(times["predict"], axis=0), "<= 0.5")

    rng = np.random.default_rng(1)
    n = 1_000_000
    easting, northing = rng.uniform(0.0, 100.0, (2, n))
    elevation = ground(easting, northing) + 0.05 * rng.standard_normal(n)
    for kernel_m in (2.9, 0.29):
        start = time.thread_time()
        model = ReferenceLWPR(ReferenceSettings(initial_kernel_m=kernel_m)).fit((easting, northing), elevation)
        seconds = time.thread_time() - start
        print(f"ReferenceLWPR.fit, 1 000 000 points, {model.state_.n_fields} fields: {seconds:.2f} us per point")


if __name__ == "__main__":
    main()
