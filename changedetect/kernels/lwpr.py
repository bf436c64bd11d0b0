"""
Learning with Locally Weighted Projection Regression: samples one after the other, receptive fields added and pruned.

The arrays grow outside the kernel: `learn` hands a batch to the kernel, which stops where the next sample might not
fit, makes room, and lets it go on.

References
----------
.. [1] Vijayakumar, D'Souza & Schaal (2005), Incremental online learning in high dimensions, Neural Computation 17,
   doi:10.1162/089976605774320557.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from changedetect.kernels.lwpr_metric import update_metric
from changedetect.kernels.lwpr_search import (
    ActiveFields,
    LWPRState,
    active_fields,
    build_index,
    enter_field,
    search_level,
)
from changedetect.kernels.lwpr_state import TINY, UPDATE_THRESHOLD, Parameters
from changedetect.kernels.lwpr_update import count_sample, squared_distance, squared_reach, update_field
from changedetect.kernels.memory import prefetch
from changedetect.kernels.neighbour_index import (
    VERSION,
    NeighbourIndex,
    empty_index,
    has_room,
    lookup,
    prefetch_cells,
    remove,
)
from changedetect.typing import FloatArray, IntArray

__all__ = ["Trace", "learn"]


class Trace(NamedTuple):
    """
    What happened at each of n samples.

    Attributes
    ----------
    online_prediction : array, shape (n,)
        Activation-weighted mean over the trusted fields after they learned the sample (0 where there is none):
        in-sample, neither a forecast nor an innovation.
    largest_activation : array, shape (n,)
        Before a field was added; 0 where none exceeds what any rule asks for.
    n_fields : array, shape (n,), int64
        Number of receptive fields after the sample.
    """

    online_prediction: FloatArray
    largest_activation: FloatArray
    n_fields: IntArray


class _Samples(NamedTuple):
    """Inputs and target of each sample, normalised."""

    x: FloatArray
    y: FloatArray
    target: FloatArray


class _Learner(NamedTuple):
    """
    What a batch is learned with.

    `counts` holds the numbers of fields and of pruned fields; `reach` is the squared metric distance beyond which a
    field cannot matter to a sample.
    """

    fields: NDArray[np.void]
    metrics: NDArray[np.void]
    counts: IntArray
    neighbours: NeighbourIndex
    use_index: bool
    reach: float
    parameters: Parameters


@njit(cache=True, error_model="numpy", nogil=True)
def _create_field(learner: _Learner, template: int, x: float, y: float, target: float) -> None:
    """
    Add a receptive field at a sample; a template other than -1 gives its metric, learning rates and intercept.

    The sample itself is not learned. It counts in the epoch's mass: it was an observation at the centre.
    """
    k, parameters = learner.counts[0], learner.parameters
    rf, metric = learner.fields[k], learner.metrics[k]
    if template >= 0:
        source = learner.metrics[template]
        m_xx, m_xy, m_yy = source["M_xx"], source["M_xy"], source["M_yy"]
        alpha_xx, alpha_xy, alpha_yy = source["alpha_xx"], source["alpha_xy"], source["alpha_yy"]
        rf["beta0"] = learner.fields[template]["beta0"]
    else:
        m_xx, m_xy, m_yy = parameters.init_m_xx, parameters.init_m_xy, parameters.init_m_yy
        alpha_xx = alpha_xy = alpha_yy = parameters.init_alpha
        rf["beta0"] = target
    metric["M_xx"], metric["M_xy"], metric["M_yy"] = m_xx, m_xy, m_yy
    metric["alpha_xx"], metric["alpha_xy"], metric["alpha_yy"] = alpha_xx, alpha_xy, alpha_yy
    metric["b_xx"], metric["b_xy"] = np.log(alpha_xx + TINY), np.log(alpha_xy + TINY)
    metric["b_yy"] = np.log(alpha_yy + TINY)
    metric["eta_xx"] = metric["eta_xy"] = metric["eta_yy"] = 0.0
    metric["H_1"] = metric["H_2"] = metric["r_1"] = metric["r_2"] = 0.0
    rf["centre_x"], rf["centre_y"] = x, y
    rf["D_xx"], rf["D_xy"], rf["D_yy"] = m_xx * m_xx, m_xx * m_xy, m_xy * m_xy + m_yy * m_yy
    rf["mean_x"] = rf["mean_y"] = 0.0
    rf["U1_x"] = rf["U2_y"] = rf["P1_x"] = rf["P2_y"] = 1.0
    rf["U1_y"] = rf["U2_x"] = rf["P1_y"] = rf["P2_x"] = 0.0
    rf["SXY1_x"] = rf["SXY1_y"] = rf["SXY2_x"] = rf["SXY2_y"] = 0.0
    rf["SSX1_x"] = rf["SSX1_y"] = rf["SSX2_x"] = rf["SSX2_y"] = 0.0
    rf["SSs2_1"] = rf["SSs2_2"] = parameters.init_s2
    rf["beta_1"] = rf["beta_2"] = 0.0
    rf["W"] = rf["N"] = TINY
    rf["W2"] = rf["Wcv"] = rf["E2"] = rf["Ecv_1"] = rf["Ecv_2"] = rf["p"] = rf["trusted"] = 0.0
    rf["lam"] = parameters.init_lambda
    rf["epoch_mass"] = 1.0
    rf["observed_time"] = parameters.survey_time
    if learner.use_index:
        enter_field(learner.neighbours, learner.fields, k, learner.reach, parameters.update_d)
    learner.counts[0] += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _prune(learner: _Learner, first: int, second: int) -> None:
    """Delete the wider of two receptive fields (the second, if equally wide); the last field moves to its place."""
    fields, index = learner.fields, learner.neighbours
    trace_first = fields[first]["D_xx"] + fields[first]["D_yy"]
    trace_second = fields[second]["D_xx"] + fields[second]["D_yy"]
    victim = first if trace_first < trace_second else second
    last = learner.counts[0] - 1
    if learner.use_index:
        remove(index, victim)
    if victim != last:
        fields[victim] = fields[last]
        learner.metrics[victim] = learner.metrics[last]
        if learner.use_index:
            remove(index, last)
            enter_field(index, fields, victim, learner.reach, learner.parameters.update_d)
    learner.counts[0] -= 1
    learner.counts[1] += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _learn_sample(
    learner: _Learner, x: float, y: float, target: float, active: ActiveFields, n_active: int
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
    parameters = learner.parameters
    first, second, w_max, w_second = -1, -1, 0.0, 0.0
    numerator = denominator = 0.0
    for i in range(n_active):
        k, w = active.number[i], active.weight[i]
        if w > w_max:
            second, w_second = first, w_max
            first, w_max = k, w
        elif w > w_second:
            second, w_second = k, w
        if w > UPDATE_THRESHOLD:
            rf = learner.fields[k]
            answer, e, e_cv, s_1, s_2 = update_field(rf, x, y, target, w)
            if rf["trusted"] > 0.0:
                numerator += w * answer
                denominator += w
            if parameters.update_d:
                q, metric = active.distance[i], learner.metrics[k]
                is_changed = update_metric(rf, metric, x, y, w, q, e, e_cv, s_1, s_2, parameters)
                if is_changed and learner.use_index:
                    enter_field(learner.neighbours, learner.fields, k, learner.reach, True)
            count_sample(rf, parameters.tau_lambda, parameters.final_lambda)
    prediction = numerator / denominator if denominator > 0.0 else 0.0
    return prediction, first, second, w_max, w_second


@njit(cache=True, error_model="numpy", nogil=True)
def _fetch_ahead(learner: _Learner, samples: _Samples, i: int, near: IntArray, n_near: int) -> None:
    """Ask for the fields that a later sample will update, of which the geometry has been asked for before."""
    if i < samples.x.shape[0]:
        for j in range(n_near):
            if squared_distance(learner.fields[near[j]], samples.x[i], samples.y[i]) <= learner.reach:
                for line in range(1, 5):
                    prefetch(learner.fields, near[j], line)
                if learner.parameters.update_d:
                    prefetch(learner.metrics, near[j], 0)
                    prefetch(learner.metrics, near[j], 1)


@njit(cache=True, error_model="numpy", nogil=True)
def _learn_samples(learner: _Learner, samples: _Samples, start: int, trace: Trace) -> int:
    """
    Learn samples from number `start` on.

    Returns the number of the first sample not learned: the end, or where the arrays might overflow.
    """
    parameters, index, use_index = learner.parameters, learner.neighbours, learner.use_index
    level = search_level(parameters)
    n_samples, capacity = samples.x.shape[0], learner.fields.shape[0]
    near, ahead, far = np.arange(capacity), np.arange(capacity), np.arange(capacity)
    active = ActiveFields(np.empty(capacity, dtype=np.int64), np.empty(capacity), np.empty(capacity))
    n_near, n_ahead, n_far = learner.counts[0], 0, 0
    near_version, ahead_version, far_version = -1, -1, -1
    for i in range(start, n_samples):
        x, y, target = samples.x[i], samples.y[i], samples.target[i]
        if not use_index:
            n_near = learner.counts[0]
        elif near_version != index.counters[VERSION]:
            n_near = lookup(index, x, y, near)
        n_active = active_fields(x, y, learner.fields, parameters.kernel, level, near, n_near, active)
        n_entries = n_active + 1 if parameters.update_d else 1
        if learner.counts[0] == capacity or (use_index and not has_room(index, n_entries)):
            return i
        if use_index:
            # later samples are looked up now, so that their fields are on their way while this one is learned
            _fetch_ahead(learner, samples, i + 1, ahead, n_ahead)
            later = min(i + 2, n_samples - 1)
            n_far, far_version = lookup(index, samples.x[later], samples.y[later], far), index.counters[VERSION]
            for j in range(n_far):
                prefetch(learner.fields, far[j], 0)
            later = min(i + 3, n_samples - 1)
            prefetch_cells(index, samples.x[later], samples.y[later])
        prediction, first, second, w_max, w_second = _learn_sample(learner, x, y, target, active, n_active)
        if w_max <= parameters.w_gen:
            is_like_first = w_max > 0.1 * parameters.w_gen and learner.fields[first]["trusted"] > 0.0
            _create_field(learner, first if is_like_first else -1, x, y, target)
        elif w_second > parameters.w_prune:
            _prune(learner, first, second)
        trace.online_prediction[i] = prediction
        trace.largest_activation[i] = w_max
        trace.n_fields[i] = learner.counts[0]
        if use_index:
            near, ahead, far = ahead, far, near
            n_near, n_ahead = n_ahead, n_far
            near_version, ahead_version = ahead_version, far_version
    return n_samples


def learn(
    state: LWPRState,
    x: FloatArray,
    y: FloatArray,
    target: FloatArray,
    parameters: Parameters,
    *,
    use_index: bool = True,
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

    Notes
    -----
    Each sample updates every field it activates by more than 0.001; then, where none exceeds w_gen, a field is added
    with the sample as its centre, or, where a second one exceeds w_prune, the wider of the two most active is deleted.
    """
    n = len(x)
    trace = Trace(np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64))
    counts = np.array([state.n_fields, state.n_pruned], dtype=np.int64)
    reach = squared_reach(search_level(parameters), parameters.kernel)
    key = (reach, parameters.update_d)
    if not use_index or state.index_key != key:
        state.index = None
    done, n_slots = 0, 1024
    while done < n:
        if state.n_fields == len(state.fields):
            state.reserve(2 * len(state.fields))
        if use_index and state.index is None:
            state.index, state.index_key = build_index(state.fields, state.n_fields, *key, n_slots), key
        index = empty_index(1, 1.0, 1.0) if state.index is None else state.index
        # the very first field is learned alone: it shows the index how large fields are
        end = n if state.n_fields or not use_index else done + 1
        learner = _Learner(state.fields, state.metrics, counts, index, use_index, reach, parameters)
        done = _learn_samples(learner, _Samples(x[:end], y[:end], target[:end]), done, trace)
        state.n_fields, state.n_pruned = int(counts[0]), int(counts[1])
        if done < n:
            # the index is built anew, larger if that is what the sample wanted
            is_crowded = use_index and done < end and state.n_fields < len(state.fields)
            n_slots = 2 * index.n_slots if is_crowded else index.n_slots
            state.index = None
    return trace
