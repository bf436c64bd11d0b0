"""A spatially stratified sample of observations that does not depend on their order."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from changedetect.kernels.coregistration import keep_smallest
from changedetect.pointcloud import PointCloud

if TYPE_CHECKING:
    from changedetect.typing import FloatArray, IntArray, Region

__all__ = ["SpatialSample", "thin"]

#: Positions and elevations enter the pseudo-random key to this precision, m.
_KEY_QUANTUM = 1e-4
#: Observations worked on at a time; bounds the memory and changes no result.
_CHUNK = 1_000_000
#: More cells than this are not laid out, however scattered the observations are.
_MAX_CELLS = 2**24


class SpatialSample:
    """
    One observation from every square of a lattice, chosen by a hash of its coordinates.

    Observations may come in any order and in any number of calls; the sample is the same.

    Parameters
    ----------
    region : (west, east, south, north), m
        Ground to sample; observations outside are left out.
    n_cells : int
        About how many squares to lay over the region: the largest size of the sample.

    Examples
    --------
    >>> easting, northing = np.mgrid[0.5:100.0, 0.5:100.0].reshape(2, -1)
    >>> sample = SpatialSample((0.0, 100.0, 0.0, 100.0), 400)
    >>> sample.add(PointCloud(easting, northing, np.zeros(easting.size)))
    >>> len(sample.cloud())
    400
    """

    def __init__(self, region: Region, n_cells: int) -> None:
        west, east, south, north = region
        width, height = max(east - west, 1e-3), max(north - south, 1e-3)
        self.side = max(math.sqrt(width * height / n_cells), max(width, height) / n_cells)
        self._west, self._south = west, south
        self._n_columns = math.floor(width / self.side) + 1
        self._n_rows = math.floor(height / self.side) + 1
        self._has_sigma = False
        self._key = np.zeros(self._n_rows * self._n_columns, dtype=np.uint64)
        self._best = np.full((self._key.size, 4), np.nan)

    def add(self, observations: PointCloud) -> None:
        """Take in observations; all of them carry sigma, or none does."""
        self._has_sigma |= observations.sigma is not None
        for start in range(0, len(observations), _CHUNK):
            part = observations.select(slice(start, start + _CHUNK))
            sigma = np.zeros(len(part)) if part.sigma is None else part.sigma
            key = _pseudo_random_key(part.easting, part.northing, part.elevation)
            cell = self._cell(part.easting, part.northing)
            keep_smallest(cell, key, part.easting, part.northing, part.elevation, sigma, self._key, self._best)

    def cloud(self) -> PointCloud:
        """Return the sample, ordered by square from south-west to north-east."""
        chosen = self._best[~np.isnan(self._best[:, 0])]
        easting, northing, elevation, sigma = np.ascontiguousarray(chosen.T)
        return PointCloud(easting, northing, elevation, sigma if self._has_sigma else None)

    def _cell(self, easting: FloatArray, northing: FloatArray) -> IntArray:
        column = np.floor((easting - self._west) / self.side)
        row = np.floor((northing - self._south) / self.side)
        is_inside = (column >= 0) & (column < self._n_columns) & (row >= 0) & (row < self._n_rows)
        cell: IntArray = np.where(is_inside, row * self._n_columns + column, -1.0).astype(np.int64)
        return cell


def thin(observations: PointCloud, n_target: int) -> PointCloud:
    """
    At most about `n_target` observations, spread evenly over the ground they cover.

    Parameters
    ----------
    observations : PointCloud
        At least one.
    n_target : int

    Returns
    -------
    sample : PointCloud
        Ordered by place, so that sums over it do not depend on the order of the observations. Observations that
        cover a part of their bounding box are sampled from smaller squares, until half of `n_target` are chosen.
    """
    if len(observations) <= n_target:
        order = np.lexsort((observations.elevation, observations.easting, observations.northing))
        return observations.select(order)
    n_cells = n_target
    while True:
        sample = SpatialSample(observations.region, n_cells)
        sample.add(observations)
        chosen = sample.cloud()
        if len(chosen) >= n_target // 2 or n_cells >= _MAX_CELLS:
            return chosen
        n_cells = min(math.ceil(0.9 * n_cells * n_target / len(chosen)), _MAX_CELLS)


def _pseudo_random_key(*columns: FloatArray) -> np.typing.NDArray[np.uint64]:
    """
    Mix coordinates by the finaliser of splitmix64.

    References
    ----------
    .. [1] Steele, Lea & Flood (2014), Fast splittable pseudorandom number generators, doi:10.1145/2714064.2660195
    """
    mixed = np.zeros(columns[0].shape, dtype=np.uint64)
    for column in columns:
        with np.errstate(over="ignore"):
            mixed ^= np.rint(column / _KEY_QUANTUM).astype(np.int64).view(np.uint64)
            mixed += np.uint64(0x9E3779B97F4A7C15)
            mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            mixed ^= mixed >> np.uint64(31)
    return mixed
