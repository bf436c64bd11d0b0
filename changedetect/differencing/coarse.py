"""Sums and means over square blocks of cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["block_means", "block_sums"]


def block_sums(values: FloatArray, factor: int) -> FloatArray:
    """
    Sums over blocks of cells.

    Parameters
    ----------
    values : array, shape (n_rows, n_cols)
    factor : int
        Cells along the side of a block.

    Returns
    -------
    sums : array, shape (ceil(n_rows / factor), ceil(n_cols / factor))
    """
    lacking = [(0, -n % factor) for n in values.shape]
    padded = np.pad(values, lacking) if np.any(lacking) else values
    n_rows, n_cols = padded.shape
    # rows first: whole rows are added at a time
    rows = padded.reshape(n_rows // factor, factor, n_cols).sum(axis=1)
    return np.asarray(rows.reshape(n_rows // factor, n_cols // factor, factor).sum(axis=2))


def block_means(values: FloatArray, known: BoolArray, factor: int) -> tuple[FloatArray, FloatArray]:
    """
    Means over blocks of cells, and the share of each block that is known.

    Parameters
    ----------
    values : array, shape (n_rows, n_cols)
    known : array, bool
    factor : int
        Cells along the side of a block.

    Returns
    -------
    mean, share : array, shape (ceil(n_rows / factor), ceil(n_cols / factor))
        The mean is NaN where nothing is known.
    """
    count = block_sums(known.astype(np.float64), factor)
    with np.errstate(invalid="ignore"):
        return block_sums(np.where(known, values, 0.0), factor) / count, count / factor**2
