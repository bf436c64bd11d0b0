"""
Index of ellipses in the plane: which ones may reach a point, in a time that does not grow with their number.

Every ellipse is entered in all cells of a square grid that it (or its bounding box) touches, so a point looks up the
one cell it lies in. Grids with cells of 2^level serve ellipses of different sizes; a few ellipses of odd sizes, and
all that are too large or too thin for any grid, go to a list that every point visits. Cells are found by hashing, so
empty ground costs nothing and there are no borders. A cell is one cache line and overflows into a chain of others.

The index returns a superset of the ellipses that hold the point. Callers test each one themselves, hence it can never
change a result, only the time taken: two cells that share a list (the packed key wraps around) do no harm.

Kernels neither raise nor allocate. `has_room` says beforehand whether entries will fit; if not, the caller builds a
larger index.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from changedetect.kernels.memory import aligned_records, prefetch
from changedetect.typing import FloatArray, IntArray

__all__ = [
    "ENTRY_CELLS",
    "NeighbourIndex",
    "ellipse_extent",
    "empty_index",
    "has_room",
    "insert",
    "lookup",
    "prefetch_cells",
    "remove",
    "update",
]

#: Cells along one side of the bounding box of the largest ellipse of a level.
_CELLS_ACROSS = 5.0
#: Most cells an ellipse can touch: one more than its size along each axis, and one for rounding.
ENTRY_CELLS = int(_CELLS_ACROSS + 2) ** 2
#: Entries of a cell record; with its key, count and link it fills 64 bytes.
_ENTRIES = 12
#: Levels lie in 0 ... _N_LEVELS - 1, the typical ellipse at _MIDDLE; the last one is the list every point visits.
_N_LEVELS = 48
_MIDDLE = 24
_EVERYWHERE = _N_LEVELS
_NONE = -1
_COORDINATE_MASK = (1 << 28) - 1
#: So many ellipses of odd sizes are listed everywhere rather than on levels that every point would have to look up.
_MAX_ODD = 36
#: Beyond this ratio of the eigenvalues of a metric rounding could move the ellipse, so it is called unbounded.
_MAX_CONDITION = 1e8
#: An ellipse that may change is entered larger than it is by this factor, so that slow changes rarely cost anything.
_MARGIN = 1.1
#: It is entered on a finer level once it would fit there even if it were this much larger.
_SHRINKAGE = 1.5

_CELL_DTYPE = np.dtype([("key", np.int64), ("next", np.int32), ("count", np.int32), ("entries", np.int32, (_ENTRIES,))])

# places in NeighbourIndex.counters
_SLOTS_USED, _FREE, _N_FREE, _LOWEST, _HIGHEST, VERSION = range(6)


class NeighbourIndex(NamedTuple):
    """
    The arrays of an index.

    Attributes
    ----------
    cells : array of records, shape (n_slots + n_overflow,)
        Hash table of cells, a power of two long: packed cell (-1: unused), entries, and number of the record that
        holds more of them (-1: none). Behind it the overflow records, of which the free ones are chained.
    boxes : array, shape (capacity, 5), int64
        Level, first and last column, first and last row of cells under which an entry stands; level -1: not entered.
    level_count : array, shape (n_levels + 1,), int64
        Number of entries of each level.
    counters : array, shape (6,), int64
        Slots in use, first free overflow record, number of free ones, lowest and highest level in use, and a version
        that counts changes.
    cell_size : array, shape (n_levels, 2)
        Cell width and height of each level, in the units of the coordinates.
    n_slots : int
    """

    cells: NDArray[np.void]
    boxes: IntArray
    level_count: IntArray
    counters: IntArray
    cell_size: FloatArray
    n_slots: int


def empty_index(capacity: int, half_width: float, half_height: float, n_slots: int = 1024) -> NeighbourIndex:
    """
    Make an index with nothing in it.

    Parameters
    ----------
    capacity : int
        Entries are numbered 0 ... capacity - 1.
    half_width, half_height : float
        Half the bounding box of a typical ellipse; it decides the cell size, which only speed depends on.
    n_slots : int
        Length of the hash table, a power of two.

    Returns
    -------
    index : NeighbourIndex
    """
    n_overflow = max(n_slots // 4, 2 * ENTRY_CELLS)
    cells = aligned_records(n_slots + n_overflow, _CELL_DTYPE)
    cells["key"] = _NONE
    cells["next"][:n_slots] = _NONE
    cells["next"][n_slots:] = np.arange(n_slots + 1, n_slots + n_overflow + 1)
    middle = np.array([half_width, half_height]) * (2.0 / _CELLS_ACROSS)
    return NeighbourIndex(
        cells=cells,
        boxes=np.full((capacity, 5), _NONE, dtype=np.int64),
        level_count=np.zeros(_N_LEVELS + 1, dtype=np.int64),
        counters=np.array([0, n_slots, n_overflow, _N_LEVELS, _NONE, 0], dtype=np.int64),
        cell_size=np.ldexp(middle, (np.arange(_N_LEVELS) - _MIDDLE)[:, np.newaxis]),
        n_slots=n_slots,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def ellipse_extent(d_xx: float, d_xy: float, d_yy: float, reach: float) -> tuple[float, float]:
    """
    Half width and height of the bounding box of {v : v' D v <= reach}.

    The half width is sqrt(reach (D^-1)_xx). It is infinite where D is so close to singular, or so broken, that a box
    computed from it might miss a point whose computed distance is within reach.

    Parameters
    ----------
    d_xx, d_xy, d_yy : float
        Elements of the metric D.
    reach : float
        Squared metric distance.

    Returns
    -------
    half_width, half_height : float
    """
    determinant = d_xx * d_yy - d_xy * d_xy
    trace = d_xx + d_yy
    if not (trace * trace < _MAX_CONDITION * determinant):
        return math.inf, math.inf
    scale = 1.000001 * math.sqrt(reach / determinant)
    return scale * math.sqrt(d_yy), scale * math.sqrt(d_xx)


@njit(cache=True, error_model="numpy", nogil=True)
def has_room(index: NeighbourIndex, n_entries: int) -> bool:
    """Whether `n_entries` more ellipses can be entered whatever their size."""
    cells = n_entries * ENTRY_CELLS
    return index.counters[_N_FREE] >= cells and 5 * (index.counters[_SLOTS_USED] + cells) <= 3 * index.n_slots


@njit(cache=True, error_model="numpy", nogil=True)
def insert(
    index: NeighbourIndex, entry: int, x: float, y: float, d_xx: float, d_xy: float, d_yy: float, reach: float
) -> None:
    """
    Enter an ellipse that will stay as it is; call `has_room` first.

    Parameters
    ----------
    index : NeighbourIndex
        Changed in place.
    entry : int
        Number under which `lookup` returns it.
    x, y : float
        Centre c.
    d_xx, d_xy, d_yy, reach : float
        The ellipse is (p - c)' D (p - c) <= reach.
    """
    half_width, half_height = ellipse_extent(d_xx, d_xy, d_yy, reach)
    _set_box(index, entry, x, y, half_width, half_height)
    box = index.boxes[entry]
    if box[0] == _EVERYWHERE:
        _push(index, _pack(_EVERYWHERE, 0, 0), entry)
        return
    width, height = index.cell_size[box[0]]
    for row in range(box[3], box[4] + 1):
        for column in range(box[1], box[2] + 1):
            left, bottom = column * width - x, row * height - y
            if _least_distance(left, left + width, bottom, bottom + height, d_xx, d_xy, d_yy) <= 1.000001 * reach:
                _push(index, _pack(box[0], column, row), entry)


@njit(cache=True, error_model="numpy", nogil=True)
def update(
    index: NeighbourIndex, entry: int, x: float, y: float, d_xx: float, d_xy: float, d_yy: float, reach: float
) -> None:
    """
    Enter an ellipse that may change, or tell that it did; call `has_room` first.

    It is entered with its whole bounding box and a margin, and anew only when it outgrew them or fits a finer level.

    Parameters
    ----------
    index, entry, x, y, d_xx, d_xy, d_yy, reach
        As for `insert`.
    """
    half_width, half_height = ellipse_extent(d_xx, d_xy, d_yy, reach)
    box = index.boxes[entry]
    level = box[0]
    if level != _NONE:
        # a finer level only when well within it, or a metric that trembles would wander to and fro
        wanted = _level_for(index, _SHRINKAGE * half_width, _SHRINKAGE * half_height)
        if level == _EVERYWHERE:
            if _is_odd(wanted):
                return
        elif level <= wanted:
            width, height = index.cell_size[level]
            if (
                _cell(x - half_width, width) >= box[1]
                and _cell(x + half_width, width) <= box[2]
                and _cell(y - half_height, height) >= box[3]
                and _cell(y + half_height, height) <= box[4]
            ):
                return
        remove(index, entry)
    _set_box(index, entry, x, y, _MARGIN * half_width, _MARGIN * half_height)
    for row in range(box[3], box[4] + 1):
        for column in range(box[1], box[2] + 1):
            _push(index, _pack(box[0], column, row), entry)


@njit(cache=True, error_model="numpy", nogil=True)
def remove(index: NeighbourIndex, entry: int) -> None:
    """Take an ellipse out of the index, in place."""
    box = index.boxes[entry]
    for row in range(box[3], box[4] + 1):
        for column in range(box[1], box[2] + 1):
            _pull(index, _pack(box[0], column, row), entry)
    index.level_count[box[0]] -= 1
    index.counters[VERSION] += 1
    box[0] = _NONE


@njit(cache=True, error_model="numpy", nogil=True)
def lookup(index: NeighbourIndex, x: float, y: float, found: IntArray) -> int:
    """
    List the ellipses that may hold a point.

    Parameters
    ----------
    index : NeighbourIndex
    x, y : float
        The point.
    found : array, int64
        Receives the entries, each once, in no particular order; as long as the index has entries.

    Returns
    -------
    n_found : int
    """
    n_found = 0
    for level in range(index.counters[_LOWEST], index.counters[_HIGHEST] + 1):
        if index.level_count[level] > 0:
            column, row = _cell(x, index.cell_size[level, 0]), _cell(y, index.cell_size[level, 1])
            n_found = _append_list(index, _pack(level, column, row), found, n_found)
    if index.level_count[_EVERYWHERE] > 0:
        n_found = _append_list(index, _pack(_EVERYWHERE, 0, 0), found, n_found)
    return n_found


@njit(cache=True, error_model="numpy", nogil=True)
def prefetch_cells(index: NeighbourIndex, x: float, y: float) -> None:
    """Ask for the cells that `lookup` will read for a point."""
    for level in range(index.counters[_LOWEST], index.counters[_HIGHEST] + 1):
        if index.level_count[level] > 0:
            column, row = _cell(x, index.cell_size[level, 0]), _cell(y, index.cell_size[level, 1])
            prefetch(index.cells, _first_slot(index, _pack(level, column, row)), 0)


@njit(cache=True, error_model="numpy", nogil=True)
def _cell(coordinate: float, size: float) -> int:
    """Cell number along one axis; absurd coordinates are clipped to what an integer holds."""
    return math.floor(min(max(coordinate / size, -1e15), 1e15))


@njit(cache=True, error_model="numpy", nogil=True)
def _pack(level: int, column: int, row: int) -> int:
    """One number for a cell of a level; distant cells may share it."""
    return (level << 56) | ((row & _COORDINATE_MASK) << 28) | (column & _COORDINATE_MASK)


@njit(cache=True, error_model="numpy", nogil=True)
def _first_slot(index: NeighbourIndex, key: int) -> int:
    """Slot where the search for a key starts."""
    # the products stay below 2^63: 28-bit columns and rows times 31-bit primes
    mixed = (key & _COORDINATE_MASK) * 1640531527 + ((key >> 28) & _COORDINATE_MASK) * 2147483629 + (key >> 56)
    return (mixed ^ (mixed >> 29) ^ (mixed >> 13)) & (index.n_slots - 1)


@njit(cache=True, error_model="numpy", nogil=True)
def _slot_of(index: NeighbourIndex, key: int) -> int:
    """Slot that holds the key, or the unused one where it belongs (linear probing)."""
    slot = _first_slot(index, key)
    while index.cells[slot]["key"] != key and index.cells[slot]["key"] != _NONE:
        slot = (slot + 1) & (index.n_slots - 1)
    return slot


@njit(cache=True, error_model="numpy", nogil=True)
def _level_for(index: NeighbourIndex, half_width: float, half_height: float) -> int:
    """Finest level whose cells are large enough for the box."""
    half_cells = 0.5 * _CELLS_ACROSS
    width, height = index.cell_size[_MIDDLE]
    ratio = max(half_width / (half_cells * width), half_height / (half_cells * height))
    if not ratio < math.ldexp(1.0, _N_LEVELS - 1 - _MIDDLE):
        return _EVERYWHERE
    mantissa, exponent = math.frexp(ratio)
    # ratio = mantissa 2^exponent with mantissa in [0.5, 1): a power of two fits its own level, and with the slack so
    # does the typical ellipse, whatever its rounding; ENTRY_CELLS allows for it
    if mantissa <= 0.5 * (1.0 + 1e-5):
        exponent -= 1
    return max(_MIDDLE + exponent, 0)


@njit(cache=True, error_model="numpy", nogil=True)
def _is_odd(level: int) -> bool:
    """Whether a level is neither that of the typical ellipse nor a neighbour of it."""
    return abs(level - _MIDDLE) > 1


@njit(cache=True, error_model="numpy", nogil=True)
def _set_box(index: NeighbourIndex, entry: int, x: float, y: float, half_width: float, half_height: float) -> None:
    """Choose the level of an entry and the cells of its box, and count it; the caller fills the cells."""
    level = _level_for(index, half_width, half_height)
    if _is_odd(level) and index.level_count[_EVERYWHERE] < _MAX_ODD:
        level = _EVERYWHERE
    box = index.boxes[entry]
    box[0] = level
    box[1:] = 0
    if level != _EVERYWHERE:
        width, height = index.cell_size[level]
        # far from the origin the differences below are rounded by more than the slack of the extent
        half_width += 1e-15 * abs(x)
        half_height += 1e-15 * abs(y)
        box[1], box[2] = _cell(x - half_width, width), _cell(x + half_width, width)
        box[3], box[4] = _cell(y - half_height, height), _cell(y + half_height, height)
        index.counters[_LOWEST] = min(index.counters[_LOWEST], level)
        index.counters[_HIGHEST] = max(index.counters[_HIGHEST], level)
    index.level_count[level] += 1
    index.counters[VERSION] += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _least_distance(
    left: float, right: float, bottom: float, top: float, d_xx: float, d_xy: float, d_yy: float
) -> float:
    """
    Least squared metric distance between the origin and a rectangle.

    Outside the rectangle it is reached on a side that faces the origin; along a side the distance is a parabola.
    """
    is_beside, is_above = left > 0.0 or right < 0.0, bottom > 0.0 or top < 0.0
    if not (is_beside or is_above):
        return 0.0
    least = math.inf
    if is_beside:
        dx = left if left > 0.0 else right
        dy = min(max(-d_xy * dx / d_yy, bottom), top)
        least = d_xx * dx * dx + 2.0 * d_xy * dx * dy + d_yy * dy * dy
    if is_above:
        dy = bottom if bottom > 0.0 else top
        dx = min(max(-d_xy * dy / d_xx, left), right)
        least = min(least, d_xx * dx * dx + 2.0 * d_xy * dx * dy + d_yy * dy * dy)
    return least


@njit(cache=True, error_model="numpy", nogil=True)
def _push(index: NeighbourIndex, key: int, entry: int) -> None:
    """Add an entry to the list of a cell. The first record always has the gaps, the others are full."""
    slot = _slot_of(index, key)
    cell = index.cells[slot]
    if cell["key"] == _NONE:
        cell["key"] = key
        index.counters[_SLOTS_USED] += 1
    if cell["count"] == _ENTRIES:
        fresh = index.counters[_FREE]
        index.counters[_FREE] = index.cells[fresh]["next"]
        index.counters[_N_FREE] -= 1
        index.cells[fresh] = cell
        cell["next"] = fresh
        cell["count"] = 0
    cell["entries"][cell["count"]] = entry
    cell["count"] += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _pull(index: NeighbourIndex, key: int, entry: int) -> None:
    """Take an entry out of the list of a cell, if it is there: the newest one of the first record fills the gap."""
    slot = _slot_of(index, key)
    first = index.cells[slot]
    record = slot
    while record != _NONE:
        cell = index.cells[record]
        for i in range(cell["count"]):
            if cell["entries"][i] == entry:
                first["count"] -= 1
                cell["entries"][i] = first["entries"][first["count"]]
                if first["count"] == 0 and first["next"] != _NONE:
                    emptied = first["next"]
                    index.cells[slot] = index.cells[emptied]
                    index.cells[emptied]["next"] = index.counters[_FREE]
                    index.counters[_FREE] = emptied
                    index.counters[_N_FREE] += 1
                return
        record = cell["next"]


@njit(cache=True, error_model="numpy", nogil=True)
def _append_list(index: NeighbourIndex, key: int, found: IntArray, n_found: int) -> int:
    """Append the entries of one cell to `found`; return how many there are then."""
    record = _slot_of(index, key)
    while record != _NONE:
        cell = index.cells[record]
        for i in range(cell["count"]):
            found[n_found] = cell["entries"][i]
            n_found += 1
        record = cell["next"]
    return n_found
