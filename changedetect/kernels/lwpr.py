"""
Learning with Locally Weighted Projection Regression: samples one after the other, receptive fields added and pruned.

The arrays grow outside the kernel: `learn` hands a batch to the kernel, which stops where the next sample might not
fit, makes room, and lets it go on.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from changedetect.kernels.lwpr_metric import update_metric
from changedetect.kernels.lwpr_state import FIELD_DTYPE, METRIC_DTYPE, TINY, UPDATE_THRESHOLD, Parameters
from changedetect.kernels.lwpr_update import activation, count_sample, squared_distance, squared_reach, update_field
from changedetect.kernels.memory import aligned_records, prefetch
from changedetect.kernels.neighbour_index import (
    VERSION,
    NeighbourIndex,
    empty_index,
    has_room,
    insert,
    lookup,
    prefetch_cells,
    remove,
    update,
)
from changedetect.typing import FloatArray, IntArray

_METRIC = ("D_xx", "D_xy", "D_yy")

__all__ = ["LWPRState", "Trace", "active_fields", "build_index", "learn", "search_level"]


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
    """

    fields: NDArray[np.void] = field(default_factory=lambda: aligned_records(64, FIELD_DTYPE))
    metrics: NDArray[np.void] = field(default_factory=lambda: aligned_records(64, METRIC_DTYPE))
    n_fields: int = 0
    n_pruned: int = 0

    def reserve(self, capacity: int) -> None:
        """Make room for `capacity` receptive fields."""
        if capacity > len(self.fields):
            for name, dtype in (("fields", FIELD_DTYPE), ("metrics", METRIC_DTYPE)):
                grown = aligned_records(capacity, dtype)
                grown[: self.n_fields] = getattr(self, name)[: self.n_fields]
                setattr(self, name, grown)

    def copy(self) -> LWPRState:
        """Return a state that shares no array with this one."""
        other = LWPRState(n_fields=0, n_pruned=self.n_pruned)
        other.reserve(self.n_fields)
        other.fields[: self.n_fields] = self.fields[: self.n_fields]
        other.metrics[: self.n_fields] = self.metrics[: self.n_fields]
        other.n_fields = self.n_fields
        return other


class Trace(NamedTuple):
    """
    What happened at each of n samples.

    Attributes
    ----------
    online_prediction : array, shape (n,)
        Activation-weighted mean over the trusted fields after they learned the sample (0 where there is none): in-sample,
        neither a forecast nor an innovation.
    largest_activation : array, shape (n,)
        Before a field was added; 0 where none exceeds what any rule asks for.
    n_fields : array, shape (n,), int64
        Number of receptive fields after the sample.
    """

    online_prediction: FloatArray
    largest_activation: FloatArray
    n_fields: IntArray


@njit(cache=True, error_model="numpy", nogil=True)
def active_fields(
    x: float,
    y: float,
    fields: NDArray[np.void],
    kernel: int,
    level: float,
    near: IntArray,
    n_near: int,
    active: IntArray,
    weight: FloatArray,
    distance: FloatArray,
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
    active, weight, distance : arrays, shape (>= n_fields,)
        Receive number, activation w and squared metric distance q of the active fields.

    Returns
    -------
    n_active : int
    """
    reach = squared_reach(level, kernel) * (1.0 + 1e-9)
    n_within = 0
    for i in range(n_near):
        k = near[i]
        q = squared_distance(fields[k], x, y)
        active[n_within], distance[n_within] = k, q  # written always, kept if near: a branch would be mispredicted
        n_within += q <= reach
    n_active = 0
    for i in range(n_within):
        k, q = active[i], distance[i]
        w = activation(q, kernel)
        if w > level:
            # cells list their entries in any order; sums are taken in ascending order with and without index
            j = n_active
            while j > 0 and active[j - 1] > k:
                active[j], weight[j], distance[j] = active[j - 1], weight[j - 1], distance[j - 1]
                j -= 1
            active[j], weight[j], distance[j] = k, w, q
            n_active += 1
    return n_active


@njit(cache=True, error_model="numpy", nogil=True)
def _create_field(
    fields: NDArray[np.void],
    metrics: NDArray[np.void],
    k: int,
    template: int,
    x: float,
    y: float,
    target: float,
    parameters: Parameters,
) -> None:
    """
    Start receptive field k at a sample; a template other than -1 gives its metric, learning rates and intercept.

    The sample itself is not learned. It counts in the epoch's mass: it was an observation at the centre.
    """
    rf, metric = fields[k], metrics[k]
    rf["centre_x"], rf["centre_y"] = x, y
    if template >= 0:
        source = metrics[template]
        M_xx, M_xy, M_yy = source["M_xx"], source["M_xy"], source["M_yy"]
        alpha_xx, alpha_xy, alpha_yy = source["alpha_xx"], source["alpha_xy"], source["alpha_yy"]
        rf["beta0"] = fields[template]["beta0"]
    else:
        M_xx, M_xy, M_yy = parameters.init_M_xx, parameters.init_M_xy, parameters.init_M_yy
        alpha_xx = alpha_xy = alpha_yy = parameters.init_alpha
        rf["beta0"] = target
    metric["M_xx"], metric["M_xy"], metric["M_yy"] = M_xx, M_xy, M_yy
    metric["alpha_xx"], metric["alpha_xy"], metric["alpha_yy"] = alpha_xx, alpha_xy, alpha_yy
    metric["b_xx"], metric["b_xy"], metric["b_yy"] = (
        np.log(alpha_xx + TINY),
        np.log(alpha_xy + TINY),
        np.log(alpha_yy + TINY),
    )
    metric["eta_xx"] = metric["eta_xy"] = metric["eta_yy"] = 0.0
    metric["H_1"] = metric["H_2"] = metric["r_1"] = metric["r_2"] = 0.0
    rf["D_xx"], rf["D_xy"], rf["D_yy"] = M_xx * M_xx, M_xx * M_xy, M_xy * M_xy + M_yy * M_yy
    rf["mean_x"] = rf["mean_y"] = 0.0
    rf["U1_x"] = rf["U2_y"] = rf["P1_x"] = rf["P2_y"] = 1.0
    rf["U1_y"] = rf["U2_x"] = rf["P1_y"] = rf["P2_x"] = 0.0
    rf["SXY1_x"] = rf["SXY1_y"] = rf["SXY2_x"] = rf["SXY2_y"] = 0.0
    rf["SSX1_x"] = rf["SSX1_y"] = rf["SSX2_x"] = rf["SSX2_y"] = 0.0
    rf["SSs2_1"] = rf["SSs2_2"] = parameters.init_S2
    rf["beta_1"] = rf["beta_2"] = 0.0
    rf["W"] = rf["N"] = TINY
    rf["W2"] = rf["Wcv"] = rf["E2"] = rf["Ecv_1"] = rf["Ecv_2"] = rf["p"] = rf["trusted"] = 0.0
    rf["lam"] = parameters.init_lambda
    rf["epoch_mass"] = 1.0
    rf["observed_time"] = parameters.survey_time


@njit(cache=True, error_model="numpy", nogil=True)
def _enter(index: NeighbourIndex, fields: NDArray[np.void], k: int, reach: float, is_changing: bool) -> None:
    """Enter receptive field k in the index, or tell the index that its metric changed."""
    rf = fields[k]
    if is_changing:
        update(index, k, rf["centre_x"], rf["centre_y"], rf["D_xx"], rf["D_xy"], rf["D_yy"], reach)
    else:
        insert(index, k, rf["centre_x"], rf["centre_y"], rf["D_xx"], rf["D_xy"], rf["D_yy"], reach)


@njit(cache=True, error_model="numpy", nogil=True)
def _prune(
    fields: NDArray[np.void],
    metrics: NDArray[np.void],
    n_fields: int,
    first: int,
    second: int,
    reach: float,
    index: NeighbourIndex,
    use_index: bool,
    is_changing: bool,
) -> None:
    """Delete the wider of two receptive fields (the second, if equally wide); the last field moves to its place."""
    trace_first = fields[first]["D_xx"] + fields[first]["D_yy"]
    trace_second = fields[second]["D_xx"] + fields[second]["D_yy"]
    victim = first if trace_first < trace_second else second
    last = n_fields - 1
    if use_index:
        remove(index, victim)
    if victim != last:
        fields[victim] = fields[last]
        metrics[victim] = metrics[last]
        if use_index:
            remove(index, last)
            _enter(index, fields, victim, reach, is_changing)


@njit(cache=True, error_model="numpy", nogil=True)
def _learn_sample(
    x: float,
    y: float,
    target: float,
    fields: NDArray[np.void],
    metrics: NDArray[np.void],
    active: IntArray,
    weight: FloatArray,
    distance: FloatArray,
    n_active: int,
    reach: float,
    index: NeighbourIndex,
    use_index: bool,
    parameters: Parameters,
) -> tuple[float, int, int, float, float]:
    """
    Update the active receptive fields with one sample.

    Returns
    -------
    prediction : float
        Activation-weighted mean of the trusted ones after their update, 0 where there is none.
    first, second : int
        The two most active fields, -1 where there is none.
    w_max, w_second : float
        Their activations.
    """
    first, second, w_max, w_second = -1, -1, 0.0, 0.0
    numerator = denominator = 0.0
    for i in range(n_active):
        k, w = active[i], weight[i]
        if w > w_max:
            second, w_second = first, w_max
            first, w_max = k, w
        elif w > w_second:
            second, w_second = k, w
        if w > UPDATE_THRESHOLD:
            rf = fields[k]
            answer, e, e_cv, s_1, s_2 = update_field(rf, x, y, target, w)
            if rf["trusted"] > 0.0:
                numerator += w * answer
                denominator += w
            if parameters.update_D and update_metric(
                rf, metrics[k], x, y, w, distance[i], e, e_cv, s_1, s_2, parameters
            ):
                if use_index:
                    _enter(index, fields, k, reach, True)
            count_sample(rf, parameters.tau_lambda, parameters.final_lambda)
    prediction = numerator / denominator if denominator > 0.0 else 0.0
    return prediction, first, second, w_max, w_second


@njit(cache=True, error_model="numpy", nogil=True)
def search_level(parameters: Parameters) -> float:
    """
    Activation below which a receptive field cannot matter to a sample.

    It is updated above 0.001, a template above 0.1 w_gen, and pruned (with another) above w_prune.
    """
    return min(UPDATE_THRESHOLD, 0.1 * parameters.w_gen, parameters.w_prune)


@njit(cache=True, error_model="numpy", nogil=True)
def _learn_samples(
    x: FloatArray,
    y: FloatArray,
    target: FloatArray,
    start: int,
    fields: NDArray[np.void],
    metrics: NDArray[np.void],
    counts: IntArray,
    index: NeighbourIndex,
    use_index: bool,
    parameters: Parameters,
    trace: Trace,
) -> int:
    """
    Learn samples from number `start` on; `counts` holds the numbers of fields and of pruned fields.

    Returns the number of the first sample not learned: the end, or where the arrays might overflow.
    """
    level = search_level(parameters)
    reach = squared_reach(level, parameters.kernel)
    n_samples, capacity = x.shape[0], fields.shape[0]
    near, ahead, active = np.arange(capacity), np.arange(capacity), np.empty(capacity, dtype=np.int64)
    weight, distance = np.empty(capacity), np.empty(capacity)
    n_near, n_ahead = counts[0], 0
    if use_index and start < n_samples:
        n_near = lookup(index, x[start], y[start], near)
    for i in range(start, n_samples):
        n_fields = counts[0]
        n_active = active_fields(x[i], y[i], fields, parameters.kernel, level, near, n_near, active, weight, distance)
        if n_fields == capacity or (use_index and not has_room(index, n_active + 1 if parameters.update_D else 1)):
            return i
        # look up the next sample now, so that its fields are on their way while this one is learned
        version = index.counters[VERSION]
        if use_index and i + 1 < n_samples:
            n_ahead = lookup(index, x[i + 1], y[i + 1], ahead)
            for j in range(n_ahead):
                prefetch(fields, ahead[j])
            prefetch_cells(index, x[min(i + 2, n_samples - 1)], y[min(i + 2, n_samples - 1)])
        prediction, first, second, w_max, w_second = _learn_sample(
            x[i], y[i], target[i], fields, metrics, active, weight, distance, n_active, reach, index, use_index, parameters
        )
        if w_max <= parameters.w_gen:
            is_like_first = w_max > 0.1 * parameters.w_gen and fields[first]["trusted"] > 0.0
            _create_field(fields, metrics, n_fields, first if is_like_first else -1, x[i], y[i], target[i], parameters)
            if use_index:
                _enter(index, fields, n_fields, reach, parameters.update_D)
            counts[0] += 1
        elif w_second > parameters.w_prune:
            _prune(fields, metrics, n_fields, first, second, reach, index, use_index, parameters.update_D)
            counts[0] -= 1
            counts[1] += 1
        trace.online_prediction[i] = prediction
        trace.largest_activation[i] = w_max
        trace.n_fields[i] = counts[0]
        if not use_index:
            n_near = counts[0]
        elif i + 1 < n_samples:
            if index.counters[VERSION] != version:
                n_ahead = lookup(index, x[i + 1], y[i + 1], ahead)
            near, ahead, n_near = ahead, near, n_ahead
    return n_samples


@njit(cache=True, error_model="numpy", nogil=True)
def _fill_index(
    index: NeighbourIndex, fields: NDArray[np.void], n_fields: int, reach: float, is_changing: bool
) -> int:
    """Enter all receptive fields; return how many fitted."""
    for k in range(n_fields):
        if not has_room(index, 1):
            return k
        _enter(index, fields, k, reach, is_changing)
    return n_fields


def build_index(
    fields: NDArray[np.void],
    n_fields: int,
    reach: float,
    typical: tuple[float, float, float],
    is_changing: bool = False,
    n_slots: int = 1024,
) -> NeighbourIndex:
    """
    Index receptive fields by the ellipses within which they matter.

    Parameters
    ----------
    fields : array of FIELD_DTYPE, shape (capacity,)
    n_fields : int
    reach : float
        Squared metric distance of the ellipses' rim.
    typical : tuple of float
        D_xx, D_xy, D_yy of a typical metric; the median over the fields is taken where there are some.
    is_changing : bool
        Whether metrics are going to change.
    n_slots : int
        Size to start with; doubled until all fields fit.

    Returns
    -------
    index : NeighbourIndex
    """
    metrics = [fields[name][:n_fields] if n_fields else np.array([d]) for name, d in zip(_METRIC, typical, strict=True)]
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = metrics[0] * metrics[2] - metrics[1] ** 2
        half_sizes = [np.sqrt(reach * metric / determinant) for metric in (metrics[2], metrics[0])]
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


def learn(
    state: LWPRState, x: FloatArray, y: FloatArray, target: FloatArray, parameters: Parameters, use_index: bool = True
) -> Trace:
    """
    Learn samples in the order given.

    Parameters
    ----------
    state : LWPRState
        Changed in place.
    x, y, target : arrays, shape (n,)
        Samples, normalised.
    parameters : Parameters
    use_index : bool
        False: visit every receptive field with every sample. The result is the same.

    Returns
    -------
    trace : Trace
    """
    n = len(x)
    trace = Trace(np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64))
    counts = np.array([state.n_fields, state.n_pruned], dtype=np.int64)
    reach = squared_reach(search_level(parameters), parameters.kernel)
    a, b, c = parameters.init_M_xx, parameters.init_M_xy, parameters.init_M_yy
    n_slots, done, index = 1024, 0, None
    while done < n:
        if state.n_fields == len(state.fields):
            state.reserve(2 * len(state.fields))
        elif index is not None:  # it was the index that had no room
            n_slots *= 2
        n_indexed = state.n_fields if use_index else 0
        index = build_index(
            state.fields, n_indexed, reach, (a * a, a * b, b * b + c * c), parameters.update_D, n_slots
        )
        n_slots = index.n_slots
        done = _learn_samples(
            x, y, target, done, state.fields, state.metrics, counts, index, use_index, parameters, trace
        )
        state.n_fields, state.n_pruned = int(counts[0]), int(counts[1])
    return trace
