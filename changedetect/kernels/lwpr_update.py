"""One sample and one receptive field: activation, means, local regression and residuals."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from changedetect.kernels.lwpr_state import ERROR_GATE, GAUSSIAN, TRUST_COUNT

__all__ = ["activation", "activation_derivatives", "count_sample", "squared_distance", "squared_reach", "update_field"]


@njit(cache=True, error_model="numpy", nogil=True)
def activation(q: float, kernel: int) -> float:
    """
    Activation w of a receptive field at squared metric distance q.

    Gaussian: exp(-q / 2). Bisquare: (1 - q / 4)^2 up to q = 4, 0 beyond.
    """
    if kernel == GAUSSIAN:
        return math.exp(-0.5 * q)
    u = 1.0 - 0.25 * q
    return u * u if u >= 0.0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def activation_derivatives(q: float, w: float, kernel: int) -> tuple[float, float]:
    """First and second derivative of the activation in q."""
    if kernel == GAUSSIAN:
        return -0.5 * w, 0.25 * w
    return -0.5 * (1.0 - 0.25 * q), 0.125


@njit(cache=True, error_model="numpy", nogil=True)
def squared_reach(level: float, kernel: int) -> float:
    """Squared metric distance beyond which no activation exceeds `level` (level 0: beyond which all are 0)."""
    if kernel == GAUSSIAN:
        # exp underflows to zero below -745.14
        return -2.0 * math.log(level) if level > 0.0 else 1492.0
    return 4.0 * (1.0 - math.sqrt(min(max(level, 0.0), 1.0)))


@njit(cache=True, error_model="numpy", nogil=True)
def squared_distance(rf: np.void, x: float, y: float) -> float:
    """Squared metric distance q = (x - c)' D (x - c)."""
    dx, dy = x - rf["centre_x"], y - rf["centre_y"]
    return rf["D_xx"] * dx * dx + 2.0 * rf["D_xy"] * dx * dy + rf["D_yy"] * dy * dy


@njit(cache=True, error_model="numpy", nogil=True)
def update_field(rf: np.void, x: float, y: float, target: float, w: float) -> tuple[float, float, float, float, float]:
    """
    Learn one sample in one receptive field: all but the metric, and the count, which comes last of all.

    Parameters
    ----------
    rf : record of FIELD_DTYPE
        Changed in place.
    x, y, target : float
        The sample, normalised.
    w : float
        Its activation.

    Returns
    -------
    prediction : float
        Of the updated field at the sample: in-sample, no innovation.
    e : float
        Residual with the new slopes.
    e_cv : float
        Residual with the slopes as they were before this sample.
    s_1, s_2 : float
        Projected inputs on the new axes.

    Notes
    -----
    Order matters: means first, then residuals with the old axes U, loadings P and slopes beta, then their update, then
    residuals with the new ones. Table 1 of Vijayakumar et al. (2005), with the running means and the slow forgetting
    of SXY of the library described by Klanke et al. (2008).
    """
    lam = rf["lam"]
    # weighted means
    a0 = lam * rf["W"]
    W = a0 + w
    mean_x = (a0 * rf["mean_x"] + w * x) / W
    mean_y = (a0 * rf["mean_y"] + w * y) / W
    beta0 = (a0 * rf["beta0"] + w * target) / W
    rf["mean_x"], rf["mean_y"], rf["beta0"], rf["W"] = mean_x, mean_y, beta0, W
    x1, y1, t1 = x - mean_x, y - mean_y, target - beta0

    # projections and residuals, old axes and slopes
    s_1 = rf["U1_x"] * x1 + rf["U1_y"] * y1
    x2, y2 = x1 - rf["P1_x"] * s_1, y1 - rf["P1_y"] * s_1
    s_2 = rf["U2_x"] * x2 + rf["U2_y"] * y2
    t2 = t1 - rf["beta_1"] * s_1  # also e_cv of one projection
    e_cv_2 = t2 - rf["beta_2"] * s_2

    # sums of products; the slope of a projection is beta = SSY / SSs2, so SSY is kept as beta SSs2
    slow = 0.9 + 0.1 * lam
    ws_1, ws_2 = w * s_1, w * s_2
    SSs2_1, SSs2_2 = lam * rf["SSs2_1"] + ws_1 * s_1, lam * rf["SSs2_2"] + ws_2 * s_2
    beta_1 = (lam * rf["SSs2_1"] * rf["beta_1"] + ws_1 * t1) / SSs2_1
    beta_2 = (lam * rf["SSs2_2"] * rf["beta_2"] + ws_2 * t2) / SSs2_2
    rf["SSs2_1"], rf["SSs2_2"], rf["beta_1"], rf["beta_2"] = SSs2_1, SSs2_2, beta_1, beta_2

    sxy_x, sxy_y = slow * rf["SXY1_x"] + w * t1 * x1, slow * rf["SXY1_y"] + w * t1 * y1
    rf["SXY1_x"], rf["SXY1_y"] = sxy_x, sxy_y
    norm2 = sxy_x * sxy_x + sxy_y * sxy_y
    if norm2 > 1e-24:
        norm = math.sqrt(norm2)
        rf["U1_x"], rf["U1_y"] = sxy_x / norm, sxy_y / norm
    sxy_x, sxy_y = slow * rf["SXY2_x"] + w * t2 * x2, slow * rf["SXY2_y"] + w * t2 * y2
    rf["SXY2_x"], rf["SXY2_y"] = sxy_x, sxy_y
    norm2 = sxy_x * sxy_x + sxy_y * sxy_y
    if norm2 > 1e-24:
        norm = math.sqrt(norm2)
        rf["U2_x"], rf["U2_y"] = sxy_x / norm, sxy_y / norm

    ssx_x, ssx_y = lam * rf["SSX1_x"] + ws_1 * x1, lam * rf["SSX1_y"] + ws_1 * y1
    rf["SSX1_x"], rf["SSX1_y"] = ssx_x, ssx_y
    rf["P1_x"], rf["P1_y"] = ssx_x / SSs2_1, ssx_y / SSs2_1
    ssx_x, ssx_y = lam * rf["SSX2_x"] + ws_2 * x2, lam * rf["SSX2_y"] + ws_2 * y2
    rf["SSX2_x"], rf["SSX2_y"] = ssx_x, ssx_y
    rf["P2_x"], rf["P2_y"] = ssx_x / SSs2_2, ssx_y / SSs2_2
    rf["p"] = lam * rf["p"] + ws_1 * ws_1 / SSs2_1 + ws_2 * ws_2 / SSs2_2

    # projections and residuals, new axes and slopes
    s_1 = rf["U1_x"] * x1 + rf["U1_y"] * y1
    s_2 = rf["U2_x"] * (x1 - rf["P1_x"] * s_1) + rf["U2_y"] * (y1 - rf["P1_y"] * s_1)
    N = rf["N"]
    fitted, e_cv = beta_1 * s_1, t2
    if N > TRUST_COUNT:
        fitted += beta_2 * s_2
        e_cv = e_cv_2
        rf["trusted"] = 1.0
    e = t1 - fitted
    if N * (1.0 - lam) > ERROR_GATE:
        rf["E2"] = lam * rf["E2"] + w * e * e
        rf["Ecv_1"] = lam * rf["Ecv_1"] + w * t2 * t2
        rf["Ecv_2"] = lam * rf["Ecv_2"] + w * e_cv_2 * e_cv_2
        rf["Wcv"] = lam * rf["Wcv"] + w
    rf["W2"] = lam * lam * rf["W2"] + w * w
    rf["epoch_mass"] += w
    return beta0 + fitted, e, e_cv, s_1, s_2


@njit(cache=True, error_model="numpy", nogil=True)
def count_sample(rf: np.void, tau: float, final_lambda: float) -> None:
    """Count a sample and anneal the forgetting factor: N <- lambda N + 1, lambda <- tau lambda + (1 - tau) final."""
    rf["N"] = rf["lam"] * rf["N"] + 1.0
    rf["lam"] = tau * rf["lam"] + (1.0 - tau) * final_lambda
