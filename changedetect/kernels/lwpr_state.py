"""
State of Locally Weighted Projection Regression for two inputs and one output.

A receptive field with two inputs starts with two projections and never gains one, so its local model is always the
full plane and its state is a fixed set of numbers. They are laid out as one record of five cache lines; what only
metric learning touches lies in a second record. The number of samples N, the activation mass W and the forgetting
factor lambda obey the same recursion from the same start for both projections and are kept once.

References
----------
.. [1] Vijayakumar, D'Souza & Schaal (2005), Incremental online learning in high dimensions, Neural Computation 17,
   doi:10.1162/089976605774320557.
.. [2] Klanke, Vijayakumar & Schaal (2008), A library for locally weighted projection regression, JMLR 9, 623-626.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = [
    "BISQUARE",
    "ERROR_GATE",
    "FIELD_DTYPE",
    "GAUSSIAN",
    "METRIC_DTYPE",
    "TINY",
    "TRUST_COUNT",
    "UPDATE_THRESHOLD",
    "Parameters",
]

GAUSSIAN = 0
BISQUARE = 1

#: A sample updates the receptive fields it activates by more than this.
UPDATE_THRESHOLD = 0.001
#: Residuals count once N (1 - lambda) exceeds this.
ERROR_GATE = 0.1
#: A slope is used, and a field trusted, once N exceeds 2 n with n = 2 inputs.
TRUST_COUNT = 4.0
#: Start value of W and N.
TINY = 1e-10

#: State of one receptive field, float64, in normalised space. Symbols of the paper and what they mean:
#:
#: ====================== ===========================================================================
#: centre                 c
#: D                      distance metric, symmetric; activation w = K((x - c)' D (x - c))
#: mean, beta0            weighted means of the inputs and of the target
#: U1, U2 / P1, P2        projection axes / input loadings of the two projections
#: SXY1, SXY2             sums of w t z, slowly forgotten, whose directions are U1, U2
#: SSX1, SSX2             sums of w s z; P = SSX / SSs2
#: SSs2                   sums of w s^2
#: beta                   slopes, sum of w s t over SSs2
#: W, W2, Wcv             sums of w, of w^2, and of w since residuals count (the latter two beyond [1]_)
#: E2, Ecv                sums of w e^2 (after the update) and of w e_cv^2 (slopes before it)
#: N, lam                 unweighted number of updates, forgetting factor
#: p                      sum of leverages, (w s)^2 / SSs2
#: trusted                1 once the field may answer
#: epoch_mass             sum of w over the samples of the newest epoch, without forgetting
#: observed_time          survey time at which the field was last observed, days since 1970-01-01
#: ====================== ===========================================================================
FIELD_DTYPE = np.dtype(
    [
        (name, np.float64)
        for name in (
            *("centre_x", "centre_y", "D_xx", "D_xy", "D_yy", "mean_x", "mean_y", "beta0"),
            *("U1_x", "U1_y", "U2_x", "U2_y", "P1_x", "P1_y", "P2_x", "P2_y"),
            *("SXY1_x", "SXY1_y", "SXY2_x", "SXY2_y", "SSX1_x", "SSX1_y", "SSX2_x", "SSX2_y"),
            *("SSs2_1", "SSs2_2", "beta_1", "beta_2", "W", "W2", "Wcv", "E2"),
            *("Ecv_1", "Ecv_2", "N", "lam", "p", "trusted", "epoch_mass", "observed_time"),
        )
    ]
)

#: What metric learning adds: M upper triangular with D = M'M, its learning rates alpha, their logarithms b and memory
#: eta (incremental delta-bar-delta), and the memory terms H, r of the leave-one-out gradient for both projections.
METRIC_DTYPE = np.dtype(
    [
        (name, np.float64)
        for name in (
            *("M_xx", "M_xy", "M_yy", "alpha_xx", "alpha_xy", "alpha_yy"),
            *("b_xx", "b_xy", "b_yy", "eta_xx", "eta_xy", "eta_yy", "H_1", "H_2", "r_1", "r_2"),
        )
    ]
)


class Parameters(NamedTuple):
    """
    Settings of a learner in normalised space, as the kernels take them; defaults are those of [2]_.

    Attributes
    ----------
    kernel : int
        `GAUSSIAN` or `BISQUARE`.
    w_gen, w_prune : float
        A field is added where no activation exceeds w_gen, and pruned where a second one exceeds w_prune.
    init_lambda, final_lambda, tau_lambda : float
        Forgetting: lambda moves from its first to its last value as lambda <- tau lambda + (1 - tau) final.
    init_s2 : float
        Start value of SSs2.
    init_m_xx, init_m_xy, init_m_yy : float
        Upper triangular factor of the metric of new fields.
    update_d, diag_only, meta : bool
        Learn metrics; only the diagonal of M; with adaptive learning rates.
    penalty, init_alpha, meta_rate : float
        Weight of the penalty on D, first learning rate of M, and the rate at which learning rates adapt.
    survey_time : float, days since 1970-01-01
        Time given to fields created now.
    """

    kernel: int = GAUSSIAN
    w_gen: float = 0.1
    w_prune: float = 1.0
    init_lambda: float = 0.999
    final_lambda: float = 0.99999
    tau_lambda: float = 0.9999
    init_s2: float = 1e-10
    init_m_xx: float = 5.0
    init_m_xy: float = 0.0
    init_m_yy: float = 5.0
    update_d: bool = True
    diag_only: bool = True
    meta: bool = False
    penalty: float = 1e-6
    init_alpha: float = 50.0
    meta_rate: float = 250.0
    survey_time: float = 0.0
