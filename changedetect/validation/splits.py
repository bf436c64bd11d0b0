"""
Which observations are held out: a share of them at random, or whole blocks of ground.

A choice follows from positions and a seed alone, so every method learns and answers for the same points, in whatever
order they come. Observations at one position go together: a twin on the other side would be a hint.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import numpy as np

from changedetect.errors import ConfigError, InputDataError
from changedetect.models.lwpr import point_density

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.typing import BoolArray, Coordinates, FloatArray, IntArray

__all__ = ["HOLD_OUT_KINDS", "HoldOutKind", "default_block_side", "hold_out_blocks", "hold_out_random", "thin"]

HoldOutKind: TypeAlias = Literal["random", "blocks"]
HOLD_OUT_KINDS: tuple[HoldOutKind, ...] = get_args(HoldOutKind)

#: Positions that agree to this are the same place, m.
_QUANTUM_M = 1e-3
#: Side of a held-out block in mean distances of points: a gap of two dozen missing points.
_BLOCK_SPACINGS = 5.0


def hold_out_random(coordinates: Coordinates, share: float = 0.1, seed: int = 0) -> BoolArray:
    """
    Choose single positions at random.

    Parameters
    ----------
    coordinates : (easting, northing), arrays of shape (n,), m
    share : float, between 0 and 1
        Of the positions.
    seed : int
        Another seed makes another choice.

    Returns
    -------
    is_held_out : array, shape (n,), bool

    Raises
    ------
    ConfigError
        The share is not between 0 and 1.

    Examples
    --------
    >>> easting, northing = np.arange(10000.0), np.zeros(10000)
    >>> chosen = hold_out_random((easting, northing), share=0.2)
    >>> chosen.mean().round(2)
    0.2
    >>> bool((hold_out_random((easting[::-1], northing), share=0.2) == chosen[::-1]).all())
    True
    """
    _require_share(share)
    return _uniform(_quantised(coordinates, _QUANTUM_M), seed) < share


def hold_out_blocks(
    coordinates: Coordinates, share: float = 0.1, seed: int = 0, side: float | None = None
) -> tuple[BoolArray, float]:
    """
    Choose square blocks of ground at random until they hold a share of the points: gaps, as occlusion leaves them.

    Parameters
    ----------
    coordinates : (easting, northing), arrays of shape (n,), m
    share : float, between 0 and 1
        Of the points.
    seed : int
        Decides which blocks, and where their lattice begins.
    side : float, optional, m
        Of a block; see `default_block_side`.

    Returns
    -------
    is_held_out : array, shape (n,), bool
    side : float, m

    Raises
    ------
    ConfigError
        The share is not between 0 and 1, or the side is not positive.
    InputDataError
        Fewer than ten blocks hold points.
    """
    _require_share(share)
    side = default_block_side(coordinates) if side is None else side
    if not (math.isfinite(side) and side > 0.0):
        msg = f"The side of a held-out block must be positive, in metres; got {side!r}."
        raise ConfigError(msg)
    offset = _uniform(np.array([[1, 2], [0, 0]], dtype=np.int64), seed)
    shifted = (coordinates[0] + offset[0] * side, coordinates[1] + offset[1] * side)
    block, label, count = np.unique(
        _quantised(shifted, side, whole=np.floor), axis=1, return_inverse=True, return_counts=True
    )
    if count.size < 10:
        msg = (
            f"Blocks of {side:g} m are too large for this survey: {count.size} of them hold its points, and 10 are "
            "needed. Choose smaller ones (block side)."
        )
        raise InputDataError(msg)
    order = np.argsort(_uniform(block, seed), kind="stable")
    held = np.cumsum(count[order])
    n_blocks = max(1, int(np.searchsorted(held, share * held[-1], side="left")))
    is_chosen = np.zeros(count.size, dtype=np.bool_)
    is_chosen[order[:n_blocks]] = True
    return is_chosen[label.reshape(-1)], side


def default_block_side(coordinates: Coordinates) -> float:
    """
    Side of a block that holds about two dozen points, m, in two digits.

    Notes
    -----
    Five mean distances of points where there are points. A surface cannot be known in the middle of much larger gaps,
    and a good model says so instead of answering; smaller ones are no gap.
    """
    side = _BLOCK_SPACINGS / math.sqrt(point_density(*coordinates))
    return round(side, 1 - math.floor(math.log10(side)))


def thin(coordinates: Coordinates, n_points: int, seed: int = 0) -> IntArray:
    """
    Choose `n_points` observations at random, all of them where there are no more.

    Parameters
    ----------
    coordinates : (easting, northing), arrays of shape (n,), m
    n_points : int
    seed : int

    Returns
    -------
    chosen : array, shape (min(n, n_points),), int64
        Indices, ascending. Which of several observations at one position are taken depends on their order.
    """
    # another stream than that of the hold-outs: what is thinned away must not depend on what is held out
    rank = np.argsort(_uniform(_quantised(coordinates, _QUANTUM_M), ~seed), kind="stable")
    return np.asarray(np.sort(rank[:n_points]), dtype=np.int64)


def _require_share(share: float) -> None:
    if not 0.0 < share < 1.0:
        msg = f"The share of held-out points must lie between 0 and 1; got {share!r}."
        raise ConfigError(msg)


def _quantised(coordinates: Coordinates, quantum: float, whole: np.ufunc = np.rint) -> IntArray:
    """Coordinates in whole quanta, shape (2, n)."""
    return np.asarray(whole(np.stack(coordinates) / quantum), dtype=np.int64)


def _uniform(key: IntArray, seed: int) -> FloatArray:
    """
    Map pairs of whole numbers, shape (2, n), to numbers that look uniform on [0, 1), shape (n,).

    The finaliser of splitmix64 (Steele, Lea & Flood 2014, doi:10.1145/2714064.2660195), applied to seed and keys.
    """
    mixed: NDArray[np.uint64] = np.full(key.shape[1], np.array(seed, dtype=np.int64).view(np.uint64))
    for part in (np.zeros(key.shape[1], dtype=np.int64), *key):
        with np.errstate(over="ignore"):
            mixed = mixed ^ part.view(np.uint64)
            mixed = mixed + np.uint64(0x9E3779B97F4A7C15)
            mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            mixed = mixed ^ (mixed >> np.uint64(31))
    return np.asarray((mixed >> np.uint64(11)) * 2.0**-53, dtype=np.float64)
