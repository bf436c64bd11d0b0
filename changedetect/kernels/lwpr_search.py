"""
The set of receptive fields, and which of them a place activates.

With the Gaussian kernel every field is active everywhere; but none with an activation below a known level matters to
any rule, so only an ellipse around each field has to be searched.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from changedetect.kernels.lwpr_state import FIELD_DTYPE, METRIC_DTYPE, UPDATE_THRESHOLD, Parameters
from changedetect.kernels.lwpr_update import activation, squared_distance, squared_reach
from changedetect.kernels.memory import aligned_records
from changedetect.kernels.neighbour_index import NeighbourIndex, empty_index, has_room, insert, update
from changedetect.typing import FloatArray, IntArray

__all__ = ["ActiveFields", "LWPRState", "active_fields", "build_index", "enter_field", "search_level"]


class ActiveFields(NamedTuple):
    """
    Room for the receptive fields that a place activates, in ascending order.

    Attributes
    ----------
    number : array, int64
    weight, distance : arrays
        Activation w and squared metric distance q.
    """

    number: IntArray
    weight: FloatArray
    distance: FloatArray


@dataclass
class LWPRState:
    """
    The receptive fields of a learner.

    Attributes
    ----------
    fields, metrics : arrays of records, shape (capacity,)
        `FIELD_DTYPE` and `METRIC_DTYPE`; the first `n_fields` are in use.
    n_fields, n_pruned : int
        Receptive fields there are, and how many were pruned so far.
    index : NeighbourIndex or None
        Of the fields, where one is up to date; it follows from them and is no part of the learned state.
    index_key : tuple
        Squared metric distance it was built for, and whether for metrics that change.
    """

    fields: NDArray[np.void] = field(default_factory=lambda: aligned_records(64, FIELD_DTYPE))
    metrics: NDArray[np.void] = field(default_factory=lambda: aligned_records(64, METRIC_DTYPE))
    n_fields: int = 0
    n_pruned: int = 0
    index: NeighbourIndex | None = None
    index_key: tuple[float, bool] = (0.0, False)

    def reserve(self, capacity: int) -> None:
        """Make room for `capacity` receptive fields."""
        if capacity > len(self.fields):
            for name, dtype in (("fields", FIELD_DTYPE), ("metrics", METRIC_DTYPE)):
                grown = aligned_records(capacity, dtype)
                grown[: self.n_fields] = getattr(self, name)[: self.n_fields]
                setattr(self, name, grown)
            self.index = None

    def copy(self) -> LWPRState:
        """Return a state that shares no array with this one."""
        other = LWPRState(n_pruned=self.n_pruned)
        other.reserve(self.n_fields)
        other.fields[: self.n_fields] = self.fields[: self.n_fields]
        other.metrics[: self.n_fields] = self.metrics[: self.n_fields]
        other.n_fields = self.n_fields
        return other

    def indexed(self, kernel: int, level: float) -> NeighbourIndex:
        """Return an index of the fields that finds those with an activation above `level`."""
        reach = squared_reach(level, kernel)
        if self.index is None or self.index_key[0] < reach:
            self.index = build_index(self.fields, self.n_fields, reach)
            self.index_key = (reach, False)
        return self.index


@njit(cache=True, error_model="numpy", nogil=True)
def active_fields(
    x: float,
    y: float,
    fields: NDArray[np.void],
    kernel: int,
    level: float,
    near: IntArray,
    n_near: int,
    active: ActiveFields,
) -> int:
    """
    Receptive fields that a place activates by more than `level`, in ascending order.

    Parameters
    ----------
    x, y : float
        The place, normalised.
    fields : array of FIELD_DTYPE
    kernel : int
    level : float
    near : array, int64
        Candidates, in its first `n_near` elements: all fields, or what an index built for this level found.
    n_near : int
    active : ActiveFields
        Filled.

    Returns
    -------
    n_active : int
    """
    reach = squared_reach(level, kernel) * (1.0 + 1e-9)
    number, weight, distance = active
    n_within = 0
    for i in range(n_near):
        k = near[i]
        q = squared_distance(fields[k], x, y)
        number[n_within], distance[n_within] = k, q  # written always, kept if near: a branch would be mispredicted
        n_within += q <= reach
    n_active = 0
    for i in range(n_within):
        k, q = number[i], distance[i]
        w = activation(q, kernel)
        if w > level:
            # cells list their entries in any order; sums are taken in ascending order with and without index
            j = n_active
            while j > 0 and number[j - 1] > k:
                number[j], weight[j], distance[j] = number[j - 1], weight[j - 1], distance[j - 1]
                j -= 1
            number[j], weight[j], distance[j] = k, w, q
            n_active += 1
    return n_active


@njit(cache=True, error_model="numpy", nogil=True)
def search_level(parameters: Parameters) -> float:
    """
    Activation below which a receptive field cannot matter to a sample.

    It is updated above 0.001, a template above 0.1 w_gen, and pruned (with another) above w_prune.
    """
    return min(UPDATE_THRESHOLD, 0.1 * parameters.w_gen, parameters.w_prune)


@njit(cache=True, error_model="numpy", nogil=True)
def enter_field(index: NeighbourIndex, fields: NDArray[np.void], k: int, reach: float, is_changing: bool) -> None:
    """Enter receptive field k in the index, or tell the index that its metric changed."""
    rf = fields[k]
    if is_changing:
        update(index, k, rf["centre_x"], rf["centre_y"], rf["D_xx"], rf["D_xy"], rf["D_yy"], reach)
    else:
        insert(index, k, rf["centre_x"], rf["centre_y"], rf["D_xx"], rf["D_xy"], rf["D_yy"], reach)


@njit(cache=True, error_model="numpy", nogil=True)
def _fill_index(index: NeighbourIndex, fields: NDArray[np.void], n_fields: int, reach: float, is_changing: bool) -> int:
    """Enter all receptive fields; return how many fitted."""
    for k in range(n_fields):
        if not has_room(index, 1):
            return k
        enter_field(index, fields, k, reach, is_changing)
    return n_fields


def build_index(
    fields: NDArray[np.void], n_fields: int, reach: float, is_changing: bool = False, n_slots: int = 1024
) -> NeighbourIndex:
    """
    Index receptive fields by the ellipses within which they matter.

    Parameters
    ----------
    fields : array of FIELD_DTYPE, shape (capacity,)
    n_fields : int
    reach : float
        Squared metric distance of the ellipses' rim.
    is_changing : bool
        Whether metrics are going to change.
    n_slots : int
        Size to start with; doubled until all fields fit.

    Returns
    -------
    index : NeighbourIndex
    """
    used = fields[:n_fields]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        determinant = used["D_xx"] * used["D_yy"] - used["D_xy"] ** 2
        half_sizes = [np.sqrt(reach * used[name] / determinant) for name in ("D_yy", "D_xx")]
    # where no metric has an extent any size serves: all fields are on the list that every sample visits
    half_width, half_height = (
        float(np.median(size[np.isfinite(size)])) if np.isfinite(size).any() else 1.0 for size in half_sizes
    )
    margin = 1.1 if is_changing else 1.0
    while True:
        index = empty_index(len(fields), margin * half_width, margin * half_height, n_slots)
        if _fill_index(index, fields, n_fields, reach, is_changing) == n_fields:
            return index
        n_slots *= 2
