"""Errors that whole maps share: what co-registration leaves of shifts, tilts and datum steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from changedetect.typing import BoolArray, FloatArray

__all__ = ["CoherentTerm", "likely_errors"]


@dataclass(frozen=True)
class CoherentTerm:
    """
    An error that is a linear function of a few uncertain parameters.

    Attributes
    ----------
    design : array, shape (n_rows * n_cols, k)
        Derivative of the difference of every cell, row by row from the north-west, in each parameter.
    covariance : array, shape (k, k)
        Of the parameters; the units of design times root of covariance are m.

    Raises
    ------
    ValueError
        Shapes do not match, or a variance is negative or not finite.

    Notes
    -----
    A shift (de, dn, du) of the later epoch has rows (-df/de, -df/dn, 1) with the slopes of the terrain.
    """

    design: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        k = self.covariance.shape[0]
        if self.design.ndim != 2 or self.covariance.shape != (k, k) or self.design.shape[1] != k:
            msg = (
                f"a coherent term has a design of shape (n_cells, k) and a covariance of shape (k, k); got "
                f"{self.design.shape} and {self.covariance.shape}"
            )
            raise ValueError(msg)
        if not np.isfinite(self.covariance).all() or (np.diag(self.covariance) < 0.0).any():
            msg = "the covariance of a coherent term holds values that are not finite or variances below zero"
            raise ValueError(msg)

    def variance(self, shape: tuple[int, int]) -> FloatArray:
        """
        Variance of every cell, m2.

        Parameters
        ----------
        shape : (n_rows, n_cols)

        Raises
        ------
        ValueError
            The design is of another number of cells.
        """
        self._check(shape)
        quadratic = np.einsum("ij,jk,ik->i", self.design, self.covariance, self.design)
        return np.asarray(quadratic.reshape(shape))

    def independent_errors(self, shape: tuple[int, int]) -> list[FloatArray]:
        """
        Split the error into k uncorrelated ones.

        Parameters
        ----------
        shape : (n_rows, n_cols)

        Returns
        -------
        errors : list of array, shape (n_rows, n_cols), m
            Each for one standard deviation; their squares add up to the variance.

        Raises
        ------
        ValueError
            The design is of another number of cells.
        """
        self._check(shape)
        return [(self.design @ column).reshape(shape) for column in self._root().T]

    def independent_sums(self, weights: FloatArray) -> FloatArray:
        """
        Weighted sums over all cells of each of the `independent_errors`, shape (k,).

        Parameters
        ----------
        weights : array, shape (n_rows, n_cols)
            Zero where the difference is not known.
        """
        return np.asarray(self._gradient(weights) @ self._root())

    def _gradient(self, weights: FloatArray) -> FloatArray:
        """Weighted sum over all cells per unit of each parameter, shape (k,)."""
        flat = weights.ravel()
        used = np.flatnonzero(flat)
        return np.asarray(flat[used] @ self.design[used])

    def _root(self) -> FloatArray:
        """R with covariance = R R', shape (k, k); the covariance may be singular."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    def _check(self, shape: tuple[int, int]) -> None:
        if self.design.shape[0] != shape[0] * shape[1]:
            msg = f"a coherent term describes {self.design.shape[0]} cells; the map has {shape[0]} x {shape[1]}"
            raise ValueError(msg)

    def variance_of_sum(self, weights: FloatArray) -> float:
        """
        Variance of a weighted sum over all cells.

        Parameters
        ----------
        weights : array, shape (n_rows, n_cols)
            Zero where the difference is not known.
        """
        gradient = self._gradient(weights)
        return float(gradient @ self.covariance @ gradient)


def likely_errors(
    difference: FloatArray, errors: Sequence[FloatArray], ground: BoolArray, n_independent: float
) -> FloatArray:
    """
    What coherent errors most likely contribute to a difference.

    Parameters
    ----------
    difference : array, shape (n_rows, n_cols), m
    errors : sequence of array, shape (n_rows, n_cols), m
        Independent errors, each for one standard deviation (`CoherentTerm.independent_errors`).
    ground : array, shape (n_rows, n_cols), bool
        Unchanged, and known.
    n_independent : float
        How many independent values the ground holds: its cells err together.

    Returns
    -------
    contribution : array, shape (n_rows, n_cols), m

    Notes
    -----
    Posterior mean of their sizes, each normal with variance one before, given differences of equal variance of which
    as many count as are independent. On ground that knows nothing of them the contribution is nought.
    """
    columns = np.column_stack([error[ground] for error in errors])
    values = difference[ground]
    weight = n_independent / max(float(np.sum(values**2)), 1e-300)  # n_independent / n over the mean square
    normal = weight * columns.T @ columns + np.eye(columns.shape[1])
    size = np.linalg.solve(normal, weight * columns.T @ values)
    return np.asarray(sum(k * error for k, error in zip(size, errors, strict=True)))
