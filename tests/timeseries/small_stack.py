"""Small stacks and surveys for tests of time series."""

from __future__ import annotations

import numpy as np

from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice
from changedetect.timeseries.deviations import EpochCells
from changedetect.timeseries.stack import Stack, StackLayers

WEST, SOUTH, SIDE, CELL = 500000.0, 5000000.0, 20.0, 0.5
REGION = (WEST, WEST + SIDE, SOUTH, SOUTH + SIDE)
LATTICE = Lattice(0.0, CELL, round(SOUTH / CELL), round(WEST / CELL), 40, 40)


def epoch(seed, density=9.0, noise=0.05, change=None, kept=None):
    """Evidence of a survey of rolling ground; `change` and `kept` are functions of east and north."""
    rng = np.random.default_rng(seed)
    east, north = rng.uniform(0.0, SIDE, (2, rng.poisson(density * SIDE**2)))
    z = 300.0 + np.sin(east / 3.0) + 0.5 * np.cos(north / 2.0) + rng.normal(0.0, noise, east.size)
    if change is not None:
        z += change(east, north)
    if kept is not None:
        here = kept(east, north)
        east, north, z = east[here], north[here], z[here]
    model = LWPRSurface(resolution=CELL)
    model.fit((WEST + east, SOUTH + north), z, None, 0.0)
    return EpochCells(model.own_cells, model.own_kernel_)


def stack_of(values, directory, variance=1e-4, resolution=1.0, length=3.0):
    """Stack with these deviations, shape (n_epochs, n_rows, n_cols); NaN is not observed."""
    n, *shape = values.shape
    stack = Stack(n, tuple(shape), resolution, length, directory)
    full = np.ones(shape)
    for k, value in enumerate(values):
        seen = np.isfinite(value)
        stack.put(k, StackLayers(value, full * np.broadcast_to(variance, n)[k], 100.0 * full, 50.0 * full, seen))
    stack.terrain = (np.zeros(shape), 0.1 * full)
    return stack
