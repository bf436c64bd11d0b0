"""Deviations of all epochs on one grid, on disk where they would not fit into memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.typing import BoolArray, FloatArray

__all__ = ["Stack", "StackLayers"]

_LAYERS = ("value", "variance", "freedom", "count", "correlated", "coherent")


@dataclass(frozen=True)
class StackLayers:
    """
    What one epoch says, all of shape (n_rows, n_cols), north up.

    Attributes
    ----------
    value, variance : array, m, m2
        Deviation from the shared surface; NaN where not observed. The variance is that of independent errors.
    freedom, count : array
        Degrees of freedom of the variance; effective number of observations.
    observed : array, bool
    """

    value: FloatArray
    variance: FloatArray
    freedom: FloatArray
    count: FloatArray
    observed: BoolArray


class Stack:
    """
    Deviations of all epochs, float32.

    Parameters
    ----------
    n_epochs : int
    shape : (n_rows, n_cols)
    resolution : float, m
    correlation_length : float, m
        Side of the square over which estimates of neighbouring cells share their data.
    directory : Path
        For files that hold the layers; the operating system keeps in memory what fits.

    Attributes
    ----------
    value, variance, freedom, count : array, shape (n_epochs, n_rows, n_cols)
        See `StackLayers`.
    correlated, coherent : array, shape (n_epochs, n_rows, n_cols), m2
        Variance of the errors that are correlated in space, and of what co-registration leaves.
    tails : array, shape (n_epochs,)
        Degrees of freedom of the tails of the correlated errors.
    terrain : pair of array, m, 1
        Shared elevation and slope.
    """

    value: NDArray[np.float32]
    variance: NDArray[np.float32]
    freedom: NDArray[np.float32]
    count: NDArray[np.float32]
    correlated: NDArray[np.float32]
    coherent: NDArray[np.float32]

    def __init__(
        self, n_epochs: int, shape: tuple[int, int], resolution: float, correlation_length: float, directory: Path
    ) -> None:
        self.n_epochs = n_epochs
        self.shape = shape
        self.resolution = resolution
        self.correlation_length = correlation_length
        self.tails: FloatArray = np.full(n_epochs, np.inf)
        self.terrain: tuple[FloatArray, FloatArray] = (np.zeros(shape), np.zeros(shape))
        for name in _LAYERS:
            layer = np.lib.format.open_memmap(
                directory / f"{name}.npy", mode="w+", dtype=np.float32, shape=(n_epochs, *shape)
            )
            setattr(self, name, layer)
        self.observed: NDArray[np.bool_] = np.lib.format.open_memmap(
            directory / "observed.npy", mode="w+", dtype=np.bool_, shape=(n_epochs, *shape)
        )

    def put(self, epoch: int, layers: StackLayers) -> None:
        """Store an epoch; what it did not observe becomes NaN."""
        known = layers.observed & np.isfinite(layers.value) & (layers.variance > 0.0)
        self.value[epoch] = np.where(known, layers.value, np.nan)
        self.variance[epoch] = np.where(known, layers.variance, np.nan)
        self.freedom[epoch] = np.where(known, layers.freedom, np.nan)
        self.count[epoch] = np.where(layers.observed, layers.count, 0.0)
        self.observed[epoch] = layers.observed

    def layers(self, epoch: int) -> StackLayers:
        """Return what an epoch says, in float64."""
        return StackLayers(
            np.asarray(self.value[epoch], np.float64),
            np.asarray(self.variance[epoch], np.float64),
            np.asarray(self.freedom[epoch], np.float64),
            np.asarray(self.count[epoch], np.float64),
            np.asarray(self.observed[epoch]),
        )

    def replace(self, epoch: int, layers: StackLayers, where: BoolArray) -> None:
        """Put other estimates of an epoch in place in some cells."""
        known = where & layers.observed & np.isfinite(layers.value)
        for name in ("value", "variance", "freedom", "count"):
            layer = getattr(self, name)
            layer[epoch] = np.where(known, getattr(layers, name), layer[epoch])

    def series(self, rows: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Series of the cells of some rows.

        Returns
        -------
        values, variances, freedom : array, shape (n_cells, n_epochs), m, m2, 1
            Total variance of each epoch's own error, and its degrees of freedom (Satterthwaite); NaN where not
            observed.
        """
        values = self._columns(self.value, rows)
        local, correlated = self._columns(self.variance, rows), self._columns(self.correlated, rows)
        total = local + correlated + self._columns(self.coherent, rows)
        inverse = (local / total) ** 2 / self._columns(self.freedom, rows) + (correlated / total) ** 2 / self.tails
        return values, total, 1.0 / np.maximum(inverse, 1e-12)

    def _columns(self, layer: NDArray[np.float32], rows: slice) -> FloatArray:
        return np.ascontiguousarray(layer[:, rows].reshape(self.n_epochs, -1).T.astype(np.float64))
