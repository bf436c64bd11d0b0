"""Rolling ground with a known transform between two surveys of it, for tests of co-registration."""

import numpy as np
from scipy.spatial.transform import Rotation

from changedetect.coregistration import GridReference
from changedetect.grid import Grid
from changedetect.pointcloud import PointCloud

WEST, SOUTH, SIDE = 500000.0, 5300000.0, 240
CENTRE = (WEST + SIDE / 2, SOUTH + SIDE / 2, 400.0)


def ground(easting, northing):
    """Elevation, m: slopes of 0.3 rms, at wavelengths from 25 m to 380 m."""
    x, y = easting - WEST, northing - SOUTH
    large = 12.0 * np.sin(x / 60.0) * np.cos(y / 47.0) + 3.0 * np.sin((x + 0.6 * y) / 13.0)
    return 400.0 + large + 0.8 * np.sin(x / 5.0) * np.sin(y / 4.3)


def flat(easting, northing):
    """Elevation, m, of a plane without any texture."""
    return 400.0 + 0.0 * easting + 0.0 * northing


def correlated(rng, std, length, easting, northing):
    """Error field of a standard deviation and Gaussian correlation length, m, at places."""
    waves = rng.normal(0.0, 1.0 / length, (200, 2))
    phases = rng.uniform(0.0, 2.0 * np.pi, 200)
    field = sum(
        np.cos(a * (easting - WEST) + b * (northing - SOUTH) + p) for (a, b), p in zip(waves, phases, strict=True)
    )
    return std * np.sqrt(2.0 / 200) * field


def reference(seed=0, noise=0.03, surface=ground, error=None):
    """Raster of 1 m cells with independent noise, and `error(rng, easting, northing)` if given."""
    rng = np.random.default_rng([seed, 1])
    grid = Grid(SIDE, SIDE, WEST, SOUTH + SIDE, 1.0, "EPSG:32632")
    easting, northing = grid.coordinates()
    elevation = surface(easting, northing) + rng.normal(0.0, noise, easting.size)
    if error is not None:
        elevation += error(rng, easting, northing)
    return GridReference(elevation.reshape(grid.shape), grid)


def epoch(
    seed=0, n=12000, noise=0.03, surface=ground, shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), scale=0.0,
    tilt=(0.0, 0.0), change=None, error=None, margin=5.0,
):  # fmt: skip
    """
    Points of an epoch in its own frame.

    Points on the (changed) ground are carried back by the inverse of p' = c + t + (1 + s) R (p - c), or of a shift
    and tilt; so `shift`, `turn`, `scale` and `tilt` are what `align` should find about `CENTRE`.
    """
    rng = np.random.default_rng([seed, 2])
    easting = rng.uniform(WEST + margin, WEST + SIDE - margin, n)
    northing = rng.uniform(SOUTH + margin, SOUTH + SIDE - margin, n)
    elevation = surface(easting, northing) + rng.normal(0.0, noise, n)
    if change is not None:
        elevation += change(easting, northing)
    if error is not None:
        elevation += error(rng, easting, northing)
    moved = np.stack([easting, northing, elevation]) - (np.array(CENTRE) + shift)[:, None]
    moved[2] -= tilt[0] * moved[0] + tilt[1] * moved[1]
    rotation = Rotation.from_rotvec(turn).as_matrix()
    own = (rotation.T @ moved) / (1.0 + scale) + np.array(CENTRE)[:, None]
    return PointCloud(*own)


def found_about(alignment, centre=CENTRE):
    """(east, north, up), m, by which an alignment moves a place: its own centre is that of the points."""
    place = [np.array([v]) for v in centre]
    return np.array([float(a[0] - b[0]) for a, b in zip(alignment.transform.apply(*place), place, strict=True)])
