"""One rough ground seen by a coarse elevation model, whose cells are means, and by a dense cloud."""

from __future__ import annotations

import numpy as np

from changedetect.pointcloud import PointCloud
from changedetect.synthetic import fractal_ground

WEST, SOUTH = 500_000.0, 5_300_000.0


def rough_ground(seed, side, relief=3.0, shortest=1.0):
    rng = np.random.default_rng(seed)
    region = (WEST, WEST + side, SOUTH, SOUTH + side)
    return fractal_ground(
        region, rng, relief_std=relief, roughness=0.7, shortest=shortest, longest=1.5 * side, n_waves=120
    )


def elevation_model(ground, side, cell, seed=0, noise=0.05, average=1.0, change=None):
    """Cells of a raster as points; each is the mean over a square of `average` cells, a sample where that is 0."""
    centres = (np.arange(int(side / cell)) + 0.5) * cell
    easting, northing = (a.ravel() for a in np.meshgrid(WEST + centres, SOUTH + centres))
    offsets = ((np.arange(8) + 0.5) / 8.0 - 0.5) * cell * average if average else np.zeros(1)
    elevation = np.zeros(easting.size)
    for east in offsets:
        for north in offsets:
            elevation += ground(easting + east, northing + north)
            elevation += 0.0 if change is None else change(easting + east, northing + north)
    elevation = elevation / offsets.size**2 + np.random.default_rng(seed).normal(0.0, noise, easting.size)
    return PointCloud(easting, northing, elevation)


def cloud(ground, side, density, seed=1, noise=0.05, change=None, margin=0.0):
    """Points, samples of the ground, on the square less a margin."""
    rng = np.random.default_rng(seed)
    n = int(density * (side - 2.0 * margin) ** 2)
    easting = WEST + rng.uniform(margin, side - margin, n)
    northing = SOUTH + rng.uniform(margin, side - margin, n)
    elevation = ground(easting, northing) + rng.normal(0.0, noise, n)
    if change is not None:
        elevation += change(easting, northing)
    return PointCloud(easting, northing, elevation)
