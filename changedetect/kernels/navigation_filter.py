"""
Error-state extended Kalman filter of an inertial solution with GPS, and its fixed-interval smoother.

States, frames and units are those of `changedetect.kernels.navigation`. After each measurement the error goes into the
nominal state and starts again from zero (closed loop).

References
----------
.. [1] Friedland (1969), Treatment of bias in recursive filtering, IEEE Trans. Automatic Control 14, 359.
.. [2] Rauch, Tung & Striebel (1965), Maximum likelihood estimates of linear dynamic systems, AIAA J. 3, 1445.
.. [3] Bell (1994), The iterated Kalman smoother as a Gauss-Newton method, SIAM J. Optimization 4, 626.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from changedetect.kernels.navigation import (
    N_ERROR,
    N_STATE,
    corrected_state,
    propagate,
    rotation_of,
    state_difference,
)
from changedetect.kernels.small_matrices import cholesky_solve, congruence, cross, product, times_vector

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["accumulate_cross_covariance", "filter_forward", "smooth_backward"]


@njit(cache=True, error_model="numpy")
def _stepped(state: FloatArray, step: FloatArray, reference: FloatArray) -> FloatArray:
    """
    State moved by an error vector.

    With a reference (shape (21,), else (0,)) errors add up as vectors in its tangent space, as Gauss-Newton has it;
    composing two rotations of some degrees instead would be off by half their product.
    """
    if reference.size == 0:
        return corrected_state(state, step)
    return corrected_state(reference, state_difference(state, reference) + step)


@njit(cache=True, error_model="numpy")
def _update(
    state: FloatArray,
    P: FloatArray,
    H: FloatArray,
    innovation: FloatArray,
    variance: FloatArray,
    gate: float,
    by_delay: FloatArray,
    response: FloatArray,
    delay_sums: FloatArray,
    reference: FloatArray,
) -> tuple[FloatArray, FloatArray, float, bool]:
    """
    Kalman update by three measurements, refused where the normalised innovation squared exceeds the gate.

    Returns the state, its covariance (Joseph's form), the normalised innovation squared and whether the measurement
    was used. `by_delay` is the derivative of the measurement by a delay of its stamp; `response`, the derivative of
    the estimation error, and `delay_sums` are carried along in place.
    """
    HP = product(H, P)
    S = product(HP, H.T)
    for i in range(3):
        S[i, i] += variance[i]
    both = np.empty((3, 2))
    expected = times_vector(H, response)
    for i in range(3):
        both[i, 0], both[i, 1] = innovation[i], by_delay[i] + expected[i]
    weighted = cholesky_solve(S, both)
    nis = 0.0
    for i in range(3):
        nis += innovation[i] * weighted[i, 0]
    if not nis <= gate:
        return state, P, nis, False
    K = cholesky_solve(S, HP).T.copy()
    for i in range(3):
        delay_sums[0] += both[i, 1] * weighted[i, 1]
        delay_sums[1] += both[i, 1] * weighted[i, 0]
        for j in range(N_ERROR):
            response[j] -= K[j, i] * both[i, 1]
    IKH = -product(K, H)
    for i in range(N_ERROR):
        IKH[i, i] += 1.0
    P_new = congruence(IKH, P)
    for i in range(N_ERROR):
        for j in range(N_ERROR):
            for k in range(3):
                P_new[i, j] += K[i, k] * variance[k] * K[j, k]
    return _stepped(state, times_vector(K, innovation), reference), P_new, nis, True


@njit(cache=True, error_model="numpy")
def _update_position(
    state: FloatArray,
    P: FloatArray,
    z: FloatArray,
    variance: FloatArray,
    lever: FloatArray,
    gate: float,
    response: FloatArray,
    delay_sums: FloatArray,
    reference: FloatArray,
) -> tuple[FloatArray, FloatArray, float, bool]:
    """Position of the antenna: z = p + R l + noise; a delay d of its stamp makes it p - v d."""
    arm = times_vector(rotation_of(state), lever)
    H = np.zeros((3, N_ERROR))
    innovation = np.empty(3)
    for i in range(3):
        H[i, i] = 1.0
        innovation[i] = z[i] - state[i] - arm[i]
    _set_minus_skew(H, 6, arm)
    return _update(state, P, H, innovation, variance, gate, -state[3:6], response, delay_sums, reference)


@njit(cache=True, error_model="numpy")
def _update_velocity(
    state: FloatArray,
    P: FloatArray,
    z: FloatArray,
    variance: FloatArray,
    lever: FloatArray,
    rate: FloatArray,
    gate: float,
    acceleration: FloatArray,
    response: FloatArray,
    delay_sums: FloatArray,
    reference: FloatArray,
) -> tuple[FloatArray, FloatArray, float, bool]:
    """Velocity of the antenna: z = v + R (w x l) + noise, with w the measured rate less the bias."""
    R = rotation_of(state)
    w = np.empty(3)
    for i in range(3):
        w[i] = rate[i] - state[15 + i]
    swing = times_vector(R, cross(w, lever))
    H = np.zeros((3, N_ERROR))
    innovation = np.empty(3)
    lever_matrix = np.zeros((3, 3))
    _set_minus_skew(lever_matrix, 0, lever)
    by_bias = product(R, lever_matrix)  # d(R (w x l)) / d(gyro bias) = R [l]x
    for i in range(3):
        H[i, 3 + i] = 1.0
        innovation[i] = z[i] - state[3 + i] - swing[i]
        for j in range(3):
            H[i, 9 + j] = -by_bias[i, j]
    _set_minus_skew(H, 6, swing)
    return _update(state, P, H, innovation, variance, gate, -acceleration, response, delay_sums, reference)


@njit(cache=True, error_model="numpy")
def _set_minus_skew(H: FloatArray, column: int, v: FloatArray) -> None:
    """Write -[v]x into three columns: the derivative of exp([phi]x) v by phi."""
    H[0, column + 1], H[0, column + 2] = v[2], -v[1]
    H[1, column], H[1, column + 2] = -v[2], v[0]
    H[2, column], H[2, column + 1] = v[1], -v[0]


@njit(cache=True, error_model="numpy")
def filter_forward(
    state: FloatArray,
    P: FloatArray,
    start: IntArray,
    duration: FloatArray,
    angular_rate: FloatArray,
    specific_force: FloatArray,
    noise_factor: FloatArray,
    fix: IntArray,
    position: FloatArray,
    position_variance: FloatArray,
    velocity: FloatArray,
    velocity_variance: FloatArray,
    lever: FloatArray,
    gate: float,
    noise: FloatArray,
    gravity: FloatArray,
    earth_rate: FloatArray,
    reference: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, BoolArray, FloatArray]:
    """
    Error-state extended Kalman filter over the nodes of a flight.

    Parameters
    ----------
    state, P : array, shape (21,) and (15, 15)
        At the first node, before its measurement.
    start : array, shape (m,)
        Intervals start[k-1]:start[k] lead from node k - 1 to node k; start[0] = 0.
    duration, angular_rate, specific_force, noise_factor
        Inertial intervals, see `propagate`.
    fix : array, shape (m,)
        Row of the GPS measurement at each node, -1 for none.
    position, position_variance, velocity, velocity_variance : array, shape (q, 3), n, m, m2, m/s, m2/s2
        GPS; NaN velocity is not used.
    lever : array, shape (3,), b, m
        Antenna.
    gate : float
        Largest normalised innovation squared (3 degrees of freedom) that is believed.
    noise, gravity, earth_rate
        See `propagate`.
    reference : array, shape (m, 21) or (0, 21)
        States about which the dynamics are linear, from an earlier smoothing: an iteration of Gauss and Newton [3]_.
        Empty: the filtered states themselves, as an extended Kalman filter does.

    Returns
    -------
    predicted, filtered : array, shape (m, 21)
        Before and after the measurement of the node.
    P_predicted, P_filtered : array, shape (m, 15, 15)
    transition : array, shape (m, 15, 15)
        From node k - 1 to k; the identity at the first.
    nis : array, shape (q, 2)
        Normalised innovation squared of position and velocity, NaN where there was none.
    is_used : array of bool, shape (q, 2)
    delay_sums : array, shape (2,)
        A and b of a delay common to all GPS stamps: its estimate is b / A (s) with variance 1 / A. The delay is a
        constant bias of the measurements, and this is its filter, run beside that of the state [1]_.
    """
    m, q = start.size, position.shape[0]
    predicted, filtered = np.empty((m, N_STATE)), np.empty((m, N_STATE))
    P_predicted, P_filtered = np.empty((m, N_ERROR, N_ERROR)), np.empty((m, N_ERROR, N_ERROR))
    transition = np.empty((m, N_ERROR, N_ERROR))
    nis = np.full((q, 2), np.nan)
    is_used = np.zeros((q, 2), dtype=np.bool_)
    response, delay_sums = np.zeros(N_ERROR), np.zeros(2)
    current, cov = state.copy(), P.copy()
    for k in range(m):
        about = reference[k] if reference.shape[0] else np.empty(0)
        Phi, acceleration = np.eye(N_ERROR), np.zeros(3)
        last = start[k]
        if k:
            first = start[k - 1]
            before = current
            origin = reference[k - 1] if reference.shape[0] else current
            moved, Phi, Q = propagate(
                origin,
                duration[first:last],
                angular_rate[first:last],
                specific_force[first:last],
                noise_factor[first:last],
                noise,
                gravity,
                earth_rate,
            )
            if reference.shape[0]:
                step = state_difference(moved, about) + times_vector(Phi, state_difference(current, origin))
                current = corrected_state(about, step)
            else:
                current = moved
            cov = congruence(Phi, cov) + Q
            response = times_vector(Phi, response)
            acceleration = (current[3:6] - before[3:6]) / np.sum(duration[first:last])
        transition[k] = Phi
        predicted[k], P_predicted[k] = current, cov
        j = fix[k]
        if j >= 0:
            current, cov, nis[j, 0], is_used[j, 0] = _update_position(
                current, cov, position[j], position_variance[j], lever, gate, response, delay_sums, about
            )
            if not math.isnan(velocity[j, 0]):
                rate = angular_rate[max(last - 1, 0)]
                current, cov, nis[j, 1], is_used[j, 1] = _update_velocity(
                    current,
                    cov,
                    velocity[j],
                    velocity_variance[j],
                    lever,
                    rate,
                    gate,
                    acceleration,
                    response,
                    delay_sums,
                    about,
                )
        filtered[k], P_filtered[k] = current, cov
    return predicted, filtered, P_predicted, P_filtered, transition, nis, is_used, delay_sums


@njit(cache=True, error_model="numpy")
def smooth_backward(
    predicted: FloatArray,
    filtered: FloatArray,
    P_predicted: FloatArray,
    P_filtered: FloatArray,
    transition: FloatArray,
    reference: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Rauch-Tung-Striebel smoother over the nodes of `filter_forward`.

    Parameters
    ----------
    predicted, filtered : array, shape (m, 21)
    P_predicted, P_filtered, transition : array, shape (m, 15, 15)
    reference : array, shape (m, 21) or (0, 21)
        That of the filter.

    Returns
    -------
    smoothed : array, shape (m, 21)
    P_smoothed : array, shape (m, 15, 15)
    gain : array, shape (m, 15, 15)
        G_k = P_filtered_k Phi_(k+1)^T P_predicted_(k+1)^-1 [2]_; zero at the last node. The covariance
        between errors of nodes k and k + 1 is G_k P_smoothed_(k+1).
    """
    m = filtered.shape[0]
    smoothed, P_smoothed = filtered.copy(), P_filtered.copy()
    gain = np.zeros((m, N_ERROR, N_ERROR))
    for k in range(m - 2, -1, -1):
        crossed = product(transition[k + 1], P_filtered[k])
        G = cholesky_solve(P_predicted[k + 1], crossed).T.copy()
        if reference.shape[0]:
            innovation = state_difference(smoothed[k + 1], reference[k + 1])
            innovation -= state_difference(predicted[k + 1], reference[k + 1])
            smoothed[k] = _stepped(filtered[k], times_vector(G, innovation), reference[k])
        else:
            innovation = state_difference(smoothed[k + 1], predicted[k + 1])
            smoothed[k] = corrected_state(filtered[k], times_vector(G, innovation))
        P_smoothed[k] = P_filtered[k] + congruence(G, P_smoothed[k + 1] - P_predicted[k + 1])
        gain[k] = G
    return smoothed, P_smoothed, gain


@njit(cache=True, error_model="numpy")
def accumulate_cross_covariance(P_smoothed: FloatArray, gain: FloatArray, nodes: IntArray) -> FloatArray:
    """
    Covariance between the smoothed errors of chosen nodes and of the next chosen ones.

    Parameters
    ----------
    P_smoothed, gain : array, shape (m, 15, 15)
        From `smooth_backward`.
    nodes : array, shape (n,)
        Increasing.

    Returns
    -------
    cross : array, shape (n - 1, 15, 15)
        E[e_i e_j^T] = G_i G_(i+1) ... G_(j-1) P_j for consecutive chosen nodes i, j.
    """
    cross = np.empty((max(nodes.size - 1, 0), N_ERROR, N_ERROR))
    for n in range(nodes.size - 1):
        chained = P_smoothed[nodes[n + 1]].copy()
        for k in range(nodes[n + 1] - 1, nodes[n] - 1, -1):
            chained = product(gain[k], chained)
        cross[n] = chained
    return cross
