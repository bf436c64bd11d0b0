"""Stochastic gradient descent of a receptive field's distance metric on its penalised leave-one-out error."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from changedetect.kernels.lwpr_state import ERROR_GATE, TRUST_COUNT, Parameters
from changedetect.kernels.lwpr_update import activation_derivatives

__all__ = ["update_metric"]


@njit(cache=True, error_model="numpy", nogil=True)
def _cost_derivatives(
    rf: np.void, metric: np.void, w: float, e: float, e_cv: float, s_1: float, s_2: float, is_meta: bool
) -> tuple[float, float, float, float]:
    """
    Derivatives of the leave-one-out error J1 in the activation w, and the multipliers of transients.

    Returns
    -------
    dJ1, ddJ1 : float
        First and second derivative; the second is 0 unless wanted.
    T : float
        Transient multiplier, at most 1: small while leave-one-out residuals are much larger than residuals.
    h : float
        Leverage of the sample.

    Notes
    -----
    Both projections are past the error gate together, for they count together.
    """
    W, kappa_1, kappa_2 = rf["W"], s_1 / rf["SSs2_1"], s_2 / rf["SSs2_2"]
    h = w * (s_1 * kappa_1 + s_2 * kappa_2)
    E = rf["Ecv_2"] if rf["N"] > TRUST_COUNT else rf["Ecv_1"]
    T = min(1.0, (rf["E2"] / (E + 1e-10)) ** 4)
    memory_1 = 2.0 * kappa_1 * e * metric["H_1"] + 2.0 * kappa_1 * kappa_1 * metric["r_1"]
    memory_2 = 2.0 * kappa_2 * e * metric["H_2"] + 2.0 * kappa_2 * kappa_2 * metric["r_2"]
    dJ1 = (-E / W + e_cv * e_cv - (memory_1 + memory_2)) / W
    ddJ1 = 0.0
    if is_meta:
        S = e * (s_1 * kappa_1 + s_2 * kappa_2)
        cross = 4.0 * (kappa_1 * e / W + kappa_1 * S) * metric["H_1"]
        cross += 4.0 * (kappa_2 * e / W + kappa_2 * S) * metric["H_2"]
        ddJ1 = (2.0 * (e * e * h / w - e_cv * e_cv / W) + E / (W * W) + cross) / W
    return dJ1, ddJ1, T, h


@njit(cache=True, error_model="numpy", nogil=True)
def _adapted_rate(
    b: float, eta: float, gradient: float, curvature: float, T: float, meta_rate: float
) -> tuple[float, float, float]:
    """
    One step of incremental delta-bar-delta: new learning rate, its logarithm b and its memory eta.

    Sutton (1992), Adapting bias by gradient descent; steps of b are limited to 0.1 and b to 10.
    """
    b -= min(max(meta_rate * T * gradient * eta, -0.1), 0.1)
    b = min(max(b, -10.0), 10.0)
    alpha = math.exp(b)
    eta = eta * max(0.0, 1.0 - alpha * T * curvature) - alpha * T * gradient
    return alpha, b, eta


@njit(cache=True, error_model="numpy", nogil=True)
def _stepped(element: float, alpha: float, gradient: float, T: float, limit: float) -> tuple[float, float]:
    """
    One gradient step of an element of M: the new element and its learning rate.

    A step that would shrink the element by more than `limit` is left out and the rate halved. Growth is not limited:
    the test of the library is signed.
    """
    step = alpha * T * gradient
    if step > limit:
        return element, 0.5 * alpha
    return element - step, alpha


@njit(cache=True, error_model="numpy", nogil=True)
def update_metric(
    rf: np.void,
    metric: np.void,
    x: float,
    y: float,
    w: float,
    q: float,
    e: float,
    e_cv: float,
    s_1: float,
    s_2: float,
    parameters: Parameters,
) -> bool:
    """
    Move the metric of a receptive field one step down the gradient.

    Parameters
    ----------
    rf, metric : records of FIELD_DTYPE and METRIC_DTYPE
        Changed in place, after `update_field` and before `count_sample`.
    x, y : float
        The sample, normalised.
    w, q : float
        Its activation and squared metric distance.
    e, e_cv, s_1, s_2 : float
        What `update_field` returned.
    parameters : Parameters

    Returns
    -------
    is_changed : bool
        False while residuals do not count yet.

    Notes
    -----
    The cost is J1 + J2: the weighted leave-one-out error over the activation mass, and penalty / n times the sum of
    squares of D, n = 2 inputs. Eqs 5-7 and Table 2 of Vijayakumar et al. (2005), doi:10.1162/089976605774320557.
    The gradient in M_ab is (w / W) dJ2 + w' dq dJ1.
    """
    lam = rf["lam"]
    if not rf["N"] * (1.0 - lam) > ERROR_GATE:
        return False
    dJ1, ddJ1, T, h = _cost_derivatives(rf, metric, w, e, e_cv, s_1, s_2, parameters.meta)
    dw, ddw = activation_derivatives(q, w, parameters.kernel)
    W, g = rf["W"], 0.5 * parameters.penalty
    D_xx, D_xy, D_yy = rf["D_xx"], rf["D_xy"], rf["D_yy"]
    M_xx, M_xy, M_yy = metric["M_xx"], metric["M_xy"], metric["M_yy"]
    dx, dy = x - rf["centre_x"], y - rf["centre_y"]
    is_full = not parameters.diag_only

    # derivatives of q and of the penalty in each element; the diagonal form leaves M_xy out of them
    row = M_xx * dx + (M_xy * dy if is_full else 0.0)
    dq_xx, dq_xy, dq_yy = 2.0 * dx * row, 2.0 * dy * row, 2.0 * dy * (M_yy * dy)
    if is_full:
        J2_xx = 4.0 * g * (D_xx * M_xx + D_xy * M_xy)
        J2_xy = 4.0 * g * (D_xy * M_xx + D_yy * M_xy)
    else:
        J2_xx, J2_xy = 4.0 * g * D_xx * M_xx, 0.0
    J2_yy = 4.0 * g * D_yy * M_yy
    scale, slope = w / W, dw * dJ1
    G_xx, G_xy, G_yy = scale * J2_xx + slope * dq_xx, scale * J2_xy + slope * dq_xy, scale * J2_yy + slope * dq_yy

    if parameters.meta:
        square = M_xx * M_xx + M_xy * M_xy if is_full else M_xx * M_xx
        JJ2_xx = 4.0 * g * (D_xx + square + M_xx * M_xx)
        JJ2_xy = 4.0 * g * (D_yy + square + M_xy * M_xy)
        JJ2_yy = 4.0 * g * (D_yy + 2.0 * M_yy * M_yy)
        bend_x, bend_y = 2.0 * dx * dx * dw, 2.0 * dy * dy * dw
        Q_xx = scale * JJ2_xx + (ddw * dq_xx * dq_xx + bend_x) * dJ1 + (dw * dq_xx) ** 2 * ddJ1
        Q_xy = scale * JJ2_xy + (ddw * dq_xy * dq_xy + bend_y) * dJ1 + (dw * dq_xy) ** 2 * ddJ1
        Q_yy = scale * JJ2_yy + (ddw * dq_yy * dq_yy + bend_y) * dJ1 + (dw * dq_yy) ** 2 * ddJ1
        rate = parameters.meta_rate
        metric["alpha_xx"], metric["b_xx"], metric["eta_xx"] = _adapted_rate(
            metric["b_xx"], metric["eta_xx"], G_xx, Q_xx, T, rate
        )
        metric["alpha_yy"], metric["b_yy"], metric["eta_yy"] = _adapted_rate(
            metric["b_yy"], metric["eta_yy"], G_yy, Q_yy, T, rate
        )
        if is_full:
            metric["alpha_xy"], metric["b_xy"], metric["eta_xy"] = _adapted_rate(
                metric["b_xy"], metric["eta_xy"], G_xy, Q_xy, T, rate
            )

    limit = 0.1 * max(abs(M_xx), abs(M_xy), abs(M_yy))
    M_xx, metric["alpha_xx"] = _stepped(M_xx, metric["alpha_xx"], G_xx, T, limit)
    M_yy, metric["alpha_yy"] = _stepped(M_yy, metric["alpha_yy"], G_yy, T, limit)
    if is_full:
        M_xy, metric["alpha_xy"] = _stepped(M_xy, metric["alpha_xy"], G_xy, T, limit)
    metric["M_xx"], metric["M_xy"], metric["M_yy"] = M_xx, M_xy, M_yy
    rf["D_xx"], rf["D_xy"], rf["D_yy"] = M_xx * M_xx, M_xx * M_xy, M_xy * M_xy + M_yy * M_yy

    memory = T * w / (1.0 - h)
    metric["H_1"] = lam * metric["H_1"] + memory * s_1 * e_cv
    metric["H_2"] = lam * metric["H_2"] + memory * s_2 * e_cv
    memory *= w * e_cv * e_cv
    metric["r_1"] = lam * metric["r_1"] + memory * s_1 * s_1
    metric["r_2"] = lam * metric["r_2"] + memory * s_2 * s_2
    return True
