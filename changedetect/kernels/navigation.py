"""
Inertial navigation: strapdown mechanisation and the statistics of its error.

Frames: n = local east-north-up (ENU), Cartesian, fixed to the Earth; b = body, forward-right-down (FRD).
Rows of the nominal state (`N_STATE` = 21 numbers): 0-2 position n (m), 3-5 velocity n (m/s), 6-14 rotation b to n (row
by row), 15-17 gyro bias b (rad/s), 18-20 accelerometer bias b (m/s2).
Rows of the error state (`N_ERROR` = 15): dp, dv, phi, d(gyro bias), d(accelerometer bias). True = estimate + error,
with the true rotation exp([phi]x) R, so phi is a small rotation in n.

Inertial samples are means over an interval: specific force and angular rate in b. Continuous dynamics of the error [1]_
(12.16 to 12.28, here for a Cartesian Earth-fixed frame):

    dp' = dv
    dv' = G dp - 2 [w]x dv - [R f]x phi - R (d(accelerometer bias) + noise)
    phi' = -[w]x phi - R (d(gyro bias) + noise)
    bias' = noise

with w the Earth's rotation and G the gradient of gravity.

References
----------
.. [1] Groves (2013), Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., ch. 5, 14.
.. [2] Savage (1998), Strapdown inertial navigation integration algorithm design, J. Guidance 21 (1, 2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from changedetect.kernels.small_matrices import (
    cross,
    product,
    rotation_matrix,
    rotation_series,
    rotation_vector,
    times_vector,
)

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = [
    "N_ERROR",
    "N_STATE",
    "compensate_motion",
    "corrected_state",
    "propagate",
    "rotation_of",
    "state_difference",
]

N_STATE = 21
N_ERROR = 15


@njit(cache=True, error_model="numpy")
def rotation_of(state: FloatArray) -> FloatArray:
    """Rotation b to n of a nominal state, shape (21,), as a matrix of shape (3, 3)."""
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = state[6 + 3 * i + j]
    return R


@njit(cache=True, error_model="numpy")
def _set_rotation(state: FloatArray, R: FloatArray) -> None:
    for i in range(3):
        for j in range(3):
            state[6 + 3 * i + j] = R[i, j]


@njit(cache=True, error_model="numpy")
def state_difference(state: FloatArray, reference: FloatArray) -> FloatArray:
    """
    Error vector that takes one nominal state to another.

    Parameters
    ----------
    state, reference : array, shape (21,)

    Returns
    -------
    error : array, shape (15,)
        Such that `reference` corrected by it is `state`.
    """
    error = np.empty(N_ERROR)
    phi = rotation_vector(product(rotation_of(state), rotation_of(reference).T))
    for i in range(3):
        error[i] = state[i] - reference[i]
        error[3 + i] = state[3 + i] - reference[3 + i]
        error[6 + i] = phi[i]
        error[9 + i] = state[15 + i] - reference[15 + i]
        error[12 + i] = state[18 + i] - reference[18 + i]
    return error


@njit(cache=True, error_model="numpy")
def corrected_state(state: FloatArray, error: FloatArray) -> FloatArray:
    """
    State with an error vector added, the inverse of `state_difference`.

    Parameters
    ----------
    state : array, shape (21,)
    error : array, shape (15,)

    Returns
    -------
    corrected : array, shape (21,)
    """
    out = state.copy()
    for i in range(6):
        out[i] += error[i]
        out[15 + i] += error[9 + i]
    _set_rotation(out, product(rotation_matrix(error[6:9]), rotation_of(state)))
    return out


@njit(cache=True, error_model="numpy")
def compensate_motion(
    duration: FloatArray, angular_rate: FloatArray, specific_force: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """
    Add to the interval means what rotation and acceleration changing inside the interval contribute.

    Coning and sculling with one previous sample ([2]_ of the module): with the increments a = rate * duration and
    b = force * duration, the rotation vector of interval k is a_k + (a_(k-1) x a_k) / 12 and the velocity increment
    b_k + (a_(k-1) x b_k + b_(k-1) x a_k) / 12, beside the rotation of the force within the interval at constant rate,
    which `propagate` applies.

    Parameters
    ----------
    duration : array, shape (n,), s
    angular_rate, specific_force : array, shape (n, 3), b, rad/s and m/s2

    Returns
    -------
    angular_rate, specific_force : array, shape (n, 3)
        Constant rates that lead to the same rotation and velocity.
    """
    rate, force = angular_rate.copy(), specific_force.copy()
    for k in range(1, duration.size):
        t = duration[k - 1] / 12.0
        coning = cross(angular_rate[k - 1], angular_rate[k])
        sculling_a = cross(angular_rate[k - 1], specific_force[k])
        sculling_b = cross(specific_force[k - 1], angular_rate[k])
        for i in range(3):
            rate[k, i] += t * coning[i]
            force[k, i] += t * (sculling_a[i] + sculling_b[i])
    return rate, force


@njit(cache=True, error_model="numpy")
def _move(
    state: FloatArray, dt: float, rate: FloatArray, force: FloatArray, gravity: FloatArray, earth_rate: FloatArray
) -> FloatArray:
    """Advance the state in place by one interval of constant rates; return the mean specific force in n."""
    angle, turn, force_b = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        angle[i] = dt * (rate[i] - state[15 + i])
        turn[i] = -dt * earth_rate[i]
        force_b[i] = force[i] - state[18 + i]
    R = rotation_of(state)
    force_n = times_vector(product(rotation_series(turn, 1), R), times_vector(rotation_series(angle, 1), force_b))
    coriolis = cross(earth_rate, state[3:6])
    for i in range(3):
        acceleration = force_n[i] - 2.0 * coriolis[i]
        if i < 2:
            acceleration -= gravity[0] * state[i]
        else:
            acceleration += 2.0 * gravity[0] * state[2] - gravity[1]
        state[i] += dt * state[3 + i] + 0.5 * dt * dt * acceleration
        state[3 + i] += dt * acceleration
    _set_rotation(state, product(rotation_series(turn, 0), product(R, rotation_series(angle, 0))))
    return force_n


@njit(cache=True, error_model="numpy")
def _transform_rows(
    A: FloatArray, dt: float, f: FloatArray, R: FloatArray, gradient: float, earth_rate: FloatArray
) -> None:
    """
    Multiply A by the transition matrix of one interval, in place.

    exp(F dt) to second order in dt, and to third where attitude turns into position; f is the specific force in n.
    """
    phi, v, rate, force = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for j in range(A.shape[1]):
        for i in range(3):
            phi[i], v[i] = A[6 + i, j], A[3 + i, j]
        turning, coriolis, tilt = cross(earth_rate, phi), cross(earth_rate, v), cross(phi, f)
        for i in range(3):
            rate[i] = -turning[i]
            force[i] = tilt[i] - 2.0 * coriolis[i]
            for k in range(3):
                rate[i] -= R[i, k] * A[9 + k, j]
                force[i] -= R[i, k] * A[12 + k, j]
        force[0] -= gradient * A[0, j]
        force[1] -= gradient * A[1, j]
        force[2] += 2.0 * gradient * A[2, j]
        jerk = cross(rate, f)
        for i in range(3):
            A[i, j] += dt * (v[i] + dt * (0.5 * force[i] + dt / 6.0 * jerk[i]))
            A[3 + i, j] += dt * (force[i] + 0.5 * dt * jerk[i])
            A[6 + i, j] += dt * rate[i]


@njit(cache=True, error_model="numpy")
def _add_noise(Q: FloatArray, dt: float, noise: FloatArray, factor: float) -> None:
    """Add the noise of one interval; white acceleration integrates to velocity and position within it."""
    accel = factor * factor * noise[1] * dt
    gyro = factor * factor * noise[0] * dt
    for i in range(3):
        Q[i, i] += accel * dt * dt / 3.0
        Q[i, 3 + i] += accel * dt / 2.0
        Q[3 + i, i] += accel * dt / 2.0
        Q[3 + i, 3 + i] += accel
        Q[6 + i, 6 + i] += gyro
        Q[9 + i, 9 + i] += noise[2] * dt
        Q[12 + i, 12 + i] += noise[3] * dt


@njit(cache=True, error_model="numpy")
def propagate(
    state: FloatArray,
    duration: FloatArray,
    angular_rate: FloatArray,
    specific_force: FloatArray,
    noise_factor: FloatArray,
    noise: FloatArray,
    gravity: FloatArray,
    earth_rate: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Carry a state and its error statistics over a run of inertial intervals.

    Parameters
    ----------
    state : array, shape (21,)
    duration : array, shape (n,), s
    angular_rate, specific_force : array, shape (n, 3), b, rad/s and m/s2
        Constant over each interval, see `compensate_motion`.
    noise_factor : array, shape (n,)
        Factor on the noise densities' square roots of each interval; 1 for a sample as specified.
    noise : array, shape (4,)
        Spectral densities of gyro (rad2/s), accelerometer (m2/s3), gyro bias (rad2/s3) and accelerometer bias (m2/s5).
    gravity : array, shape (2,)
        Gradient (1/s2) and magnitude (m/s2).
    earth_rate : array, shape (3,), n, rad/s

    Returns
    -------
    state : array, shape (21,)
    transition, process_noise : array, shape (15, 15)
    """
    transition = np.eye(N_ERROR)
    Q = np.zeros((N_ERROR, N_ERROR))
    current = state.copy()
    for k in range(duration.size):
        dt = duration[k]
        R = rotation_of(current)
        force_n = _move(current, dt, angular_rate[k], specific_force[k], gravity, earth_rate)
        R = 0.5 * (R + rotation_of(current))  # in the middle of the interval, to second order
        _transform_rows(transition, dt, force_n, R, gravity[0], earth_rate)
        _transform_rows(Q, dt, force_n, R, gravity[0], earth_rate)
        Q = Q.T.copy()  # T Q T^T = T (T Q)^T for a symmetric Q
        _transform_rows(Q, dt, force_n, R, gravity[0], earth_rate)
        _add_noise(Q, dt, noise, noise_factor[k])
    return current, transition, Q
