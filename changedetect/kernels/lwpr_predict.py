"""Answers of a set of receptive fields: the library's prediction with its confidence bound, and the surface's."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from changedetect.kernels.lwpr_search import ActiveFields, LWPRState, active_fields
from changedetect.kernels.lwpr_state import TRUST_COUNT, UPDATE_THRESHOLD
from changedetect.kernels.neighbour_index import NeighbourIndex, empty_index, lookup
from changedetect.typing import FloatArray

__all__ = [
    "NO_ANSWER",
    "BoundedPrediction",
    "NoisePrior",
    "SurfacePrediction",
    "mean_residuals",
    "predict",
    "predict_surface",
]

#: Confidence bound where no receptive field answers, in normalised units.
NO_ANSWER = 1e20


class BoundedPrediction(NamedTuple):
    """
    Prediction as the library gives it, in normalised units, at n places.

    Attributes
    ----------
    value : array, shape (n,)
        0 where no receptive field answers.
    bound : array, shape (n,)
        Confidence bound, one "standard deviation" that mixes the surface's and the observations' (Klanke et al. 2008);
        1e20 where no receptive field answers.
    largest_activation : array, shape (n,)
        Largest activation above the cutoff, of trusted fields or not; 0 where there is none.
    """

    value: FloatArray
    bound: FloatArray
    largest_activation: FloatArray


class NoisePrior(NamedTuple):
    """
    What is assumed of the noise of a field before it has seen residuals.

    Attributes
    ----------
    variance : float
        Noise variance, normalised.
    weight : float
        Number of observations it counts for.
    """

    variance: float
    weight: float


class SurfacePrediction(NamedTuple):
    """
    The surface and what is known of it, in normalised units, at n places; NaN (counts: 0) where no field answers.

    Attributes
    ----------
    value, value_variance, noise_variance : arrays, shape (n,)
        Surface, its variance, and the variance of one observation about it.
    n_effective : array, shape (n,)
        Effective number of observations that the contributing fields remember, (sum w)^2 / sum w^2 each.
    n_epoch : array, shape (n,)
        Activation mass that they received from the newest epoch.
    observed_time : array, shape (n,), days
        When the most active field was last observed before the newest epoch.
    field_epoch_mass : array, shape (n,)
        Activation mass that the most active field received from the newest epoch.
    """

    value: FloatArray
    value_variance: FloatArray
    noise_variance: FloatArray
    n_effective: FloatArray
    n_epoch: FloatArray
    observed_time: FloatArray
    field_epoch_mass: FloatArray


class _Learned(NamedTuple):
    """What answers: the fields in use, their kernel, the activation they need, and an index for it."""

    fields: NDArray[np.void]
    kernel: int
    cutoff: float
    neighbours: NeighbourIndex


@njit(cache=True, error_model="numpy", nogil=True)
def _room(n: int) -> ActiveFields:
    """Room for n active fields."""
    return ActiveFields(np.empty(n, dtype=np.int64), np.empty(n), np.empty(n))


@njit(cache=True, error_model="numpy", nogil=True)
def _local_answer(rf: np.void, x: float, y: float) -> tuple[float, float, float]:
    """
    Value of a receptive field's plane, its leverage sum_j s_j^2 / SSs2_j, and its residual energy Ecv.

    The second projection counts once it has seen enough samples.
    """
    dx, dy = x - rf["mean_x"], y - rf["mean_y"]
    s_1 = rf["U1_x"] * dx + rf["U1_y"] * dy
    value, leverage = rf["beta0"] + rf["beta_1"] * s_1, s_1 * s_1 / rf["SSs2_1"]
    if not rf["N"] > TRUST_COUNT:
        return value, leverage, rf["Ecv_1"]
    s_2 = rf["U2_x"] * (dx - rf["P1_x"] * s_1) + rf["U2_y"] * (dy - rf["P1_y"] * s_1)
    return value + rf["beta_2"] * s_2, leverage + s_2 * s_2 / rf["SSs2_2"], rf["Ecv_2"]


@njit(cache=True, error_model="numpy", nogil=True)
def _predict_bounded(
    learned: _Learned, x: FloatArray, y: FloatArray, use_index: bool, result: BoundedPrediction
) -> None:
    fields, n_near = learned.fields, learned.fields.shape[0]
    near, active = np.arange(n_near), _room(n_near)
    for i in range(x.shape[0]):
        if use_index:
            n_near = lookup(learned.neighbours, x[i], y[i], near)
        n_active = active_fields(x[i], y[i], fields, learned.kernel, learned.cutoff, near, n_near, active)
        sum_w = sum_wy = sum_variance = mean = scatter = w_max = 0.0
        for j in range(n_active):
            rf, w = fields[active.number[j]], active.weight[j]
            w_max = max(w_max, w)
            if rf["trusted"] > 0.0:
                value, leverage, Ecv = _local_answer(rf, x[i], y[i])
                sum_w += w
                sum_wy += w * value
                sum_variance += w * Ecv / (rf["W"] - rf["p"]) * (1.0 + w * leverage)
                # running weighted mean and scatter: no difference of large sums (West 1979, doi:10.1145/359146.359153)
                step = value - mean
                mean += step * w / sum_w
                scatter += w * step * (value - mean)
        result.value[i] = sum_wy / sum_w if sum_w > 0.0 else 0.0
        result.bound[i] = math.sqrt(abs(sum_variance + scatter)) / sum_w if sum_w > 0.0 else NO_ANSWER
        result.largest_activation[i] = w_max


@njit(cache=True, error_model="numpy", nogil=True)
def _noise(rf: np.void, Ecv: float, prior: NoisePrior) -> float:
    """
    Noise variance Gamma of a field, with the pooled one as a prior.

    Ecv / (Wcv (1 - p / W)) divides the residual energy by the mass it was collected from, less the share spent on
    slopes; the library divides by W - p, too much while residuals before the error gate are missing.
    """
    share = 1.0 - rf["p"] / rf["W"]
    mass = rf["Wcv"] * share
    # in numbers of observations: a mass W of activations w counts as W^2 / sum w^2 of them
    per_mass = rf["W"] / rf["W2"]
    if not (mass > 0.0 and per_mass < math.inf):
        return prior.variance
    return (per_mass * Ecv + prior.weight * prior.variance) / (per_mass * mass + prior.weight)


@njit(cache=True, error_model="numpy", nogil=True)
def _predict_surface(
    learned: _Learned, x: FloatArray, y: FloatArray, prior: NoisePrior, result: SurfacePrediction
) -> None:
    fields = learned.fields
    near, active = np.empty(fields.shape[0], dtype=np.int64), _room(fields.shape[0])
    for i in range(x.shape[0]):
        n_near = lookup(learned.neighbours, x[i], y[i], near)
        n_active = active_fields(x[i], y[i], fields, learned.kernel, learned.cutoff, near, n_near, active)
        sum_w = mean = scatter = sum_deviation = sum_noise = sum_n = sum_epoch = w_max = 0.0
        observed_time, field_epoch_mass = math.nan, 0.0
        for j in range(n_active):
            rf, w = fields[active.number[j]], active.weight[j]
            if rf["trusted"] > 0.0:
                value, leverage, Ecv = _local_answer(rf, x[i], y[i])
                noise = _noise(rf, Ecv, prior)
                per_n = rf["W2"] / (rf["W"] * rf["W"])
                sum_w += w
                step = value - mean
                mean += step * w / sum_w
                scatter += w * step * (value - mean)
                sum_deviation += w * math.sqrt(noise * (per_n + min(0.5 * rf["p"], 1.0) * leverage))
                sum_noise += w * noise
                sum_n += w / per_n
                sum_epoch += w * rf["epoch_mass"]
                if w > w_max:
                    w_max, observed_time, field_epoch_mass = w, rf["observed_time"], rf["epoch_mass"]
        is_answer = sum_w > 0.0
        result.value[i] = mean if is_answer else math.nan
        result.value_variance[i] = (sum_deviation / sum_w) ** 2 + scatter / sum_w if is_answer else math.nan
        result.noise_variance[i] = sum_noise / sum_w if is_answer else math.nan
        result.n_effective[i] = sum_n / sum_w if is_answer else 0.0
        result.n_epoch[i] = sum_epoch / sum_w if is_answer else 0.0
        result.observed_time[i] = observed_time
        result.field_epoch_mass[i] = field_epoch_mass


def predict(
    state: LWPRState, x: FloatArray, y: FloatArray, kernel: int, cutoff: float = 0.001, *, use_index: bool = True
) -> BoundedPrediction:
    """
    Predict as the library does.

    Parameters
    ----------
    state : LWPRState
    x, y : arrays, shape (n,)
        Places, normalised.
    kernel : int
        Kernel the fields were learned with.
    cutoff : float
        Fields answer where their activation exceeds this. 0: wherever it does not underflow.
    use_index : bool
        False: visit every field. The result is the same.

    Returns
    -------
    prediction : BoundedPrediction

    Notes
    -----
    With w_k the activation, y_k the value and Gamma_k = Ecv / (W - p) of the trusted fields,
    value = sum w y / sum w and bound^2 = sum w ((y_k - value)^2 + Gamma_k (1 + w_k sum_j s_j^2 / SSs2_j)) / (sum w)^2.
    """
    n = len(x)
    result = BoundedPrediction(np.zeros(n), np.zeros(n), np.zeros(n))
    index = state.indexed(kernel, cutoff) if use_index else empty_index(1, 1.0, 1.0)
    learned = _Learned(state.fields[: state.n_fields], kernel, float(cutoff), index)
    _predict_bounded(learned, x, y, use_index, result)
    return result


def predict_surface(
    state: LWPRState, x: FloatArray, y: FloatArray, kernel: int, prior: NoisePrior, *, cutoff: float = 0.001
) -> SurfacePrediction:
    """
    Predict the surface, with its own uncertainty and the noise of observations apart.

    Parameters
    ----------
    state : LWPRState
    x, y : arrays, shape (n,)
        Places, normalised.
    kernel : int
        Kernel the fields were learned with.
    prior : NoisePrior
        Noise assumed of fields that have seen few residuals.
    cutoff : float
        Fields answer where their activation exceeds this.

    Returns
    -------
    prediction : SurfacePrediction

    Notes
    -----
    Each field's plane has the variance v_k = Gamma_k (sum w^2 / (sum w)^2 + (p / 2) sum_j s_j^2 / SSs2_j): a weighted
    mean of the target has the variance Gamma sum w^2 / (sum w)^2, a weighted slope Gamma sum (w s)^2 / (sum w s^2)^2,
    and p / 2 is sum (w s)^2 / sum w s^2 on average over the two slopes. Neighbouring fields learned from the same
    samples, so their errors are taken as fully correlated: the surface's variance is (sum w sqrt(v_k) / sum w)^2 plus
    the disagreement sum w (y_k - value)^2 / sum w. The noise is sum w Gamma_k / sum w.
    """
    n = len(x)
    result = SurfacePrediction(*(np.zeros(n) for _ in SurfacePrediction._fields))
    learned = _Learned(state.fields[: state.n_fields], kernel, float(cutoff), state.indexed(kernel, cutoff))
    _predict_surface(learned, x, y, prior, result)
    return result


@njit(cache=True, error_model="numpy", nogil=True)
def _add_residuals(
    learned: _Learned, x: FloatArray, y: FloatArray, target: FloatArray, total: FloatArray, mass: FloatArray
) -> None:
    fields = learned.fields
    near, active = np.empty(fields.shape[0], dtype=np.int64), _room(fields.shape[0])
    for i in range(x.shape[0]):
        n_near = lookup(learned.neighbours, x[i], y[i], near)
        n_active = active_fields(x[i], y[i], fields, learned.kernel, learned.cutoff, near, n_near, active)
        for j in range(n_active):
            k, w = active.number[j], active.weight[j]
            value, _, _ = _local_answer(fields[k], x[i], y[i])
            total[k] += w * (target[i] - value)
            mass[k] += w


def mean_residuals(
    state: LWPRState, x: FloatArray, y: FloatArray, target: FloatArray, kernel: int
) -> tuple[FloatArray, FloatArray]:
    """
    How far samples lie above the plane of each receptive field, on activation-weighted average.

    Parameters
    ----------
    state : LWPRState
    x, y, target : arrays, shape (n,)
        Samples, normalised; nothing is learned from them.
    kernel : int
        Kernel the fields were learned with.

    Returns
    -------
    mean : array, shape (n_fields,)
        0 where no sample activates the field by more than 0.001.
    mass : array, shape (n_fields,)
        Sum of the activations.
    """
    total, mass = np.zeros(state.n_fields), np.zeros(state.n_fields)
    index = state.indexed(kernel, UPDATE_THRESHOLD)
    learned = _Learned(state.fields[: state.n_fields], kernel, UPDATE_THRESHOLD, index)
    _add_residuals(learned, x, y, target, total, mass)
    return total / np.maximum(mass, UPDATE_THRESHOLD), mass
