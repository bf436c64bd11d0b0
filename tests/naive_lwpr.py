"""
Slow oracle of Locally Weighted Projection Regression: matrices and loops, straight from the equations.

It shares no code with the package. Every receptive field is an object of small numpy arrays, every sum is a loop over
projections, nothing is specialised to two inputs beyond `n_inputs` itself, and every sample visits every field.
Symbols are those of Vijayakumar, D'Souza & Schaal (2005), doi:10.1162/089976605774320557, and Klanke, Vijayakumar &
Schaal (2008), JMLR 9, 623-626: D = M'M metric, U and P projection axes and loadings, s projected inputs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

UPDATE_THRESHOLD = 0.001
ERROR_GATE = 0.1


@dataclass
class NaiveSettings:
    """Every setting of a learner, in normalised units; names are the paper's."""

    init_D: np.ndarray
    diag_only: bool = True
    update_D: bool = True
    meta: bool = False
    meta_rate: float = 250.0
    penalty: float = 1e-6
    w_gen: float = 0.1
    w_prune: float = 1.0
    init_lambda: float = 0.999
    final_lambda: float = 0.99999
    tau_lambda: float = 0.9999
    init_S2: float = 1e-10
    kernel: str = "gaussian"
    init_alpha: float = 50.0
    norm_in: np.ndarray = field(default_factory=lambda: np.ones(2))
    norm_out: float = 1.0


class NaiveField:
    """One receptive field: centre c, metric D, and the statistics of its local regression."""

    def __init__(self, x, y, settings, template=None):
        n = len(x)
        self.c = np.array(x, dtype=float)
        self.m = np.zeros(n)
        self.R = min(2, n)
        if template is None:
            self.D = np.array(settings.init_D, dtype=float)
            self.M = np.linalg.cholesky(self.D).T
            self.alpha = np.full((n, n), float(settings.init_alpha))
            self.beta0 = y
        else:
            self.D, self.M, self.alpha = template.D.copy(), template.M.copy(), template.alpha.copy()
            self.R = template.R
            self.beta0 = template.beta0
        self.b = np.log(self.alpha + 1e-10)
        self.eta = np.zeros((n, n))
        self.U = np.eye(n)[:, : self.R].copy()
        self.P = np.eye(n)[:, : self.R].copy()
        self.beta = np.zeros(self.R)
        self.SSs2 = np.full(self.R, settings.init_S2)
        self.SSY = np.zeros(self.R)
        self.SSX = np.zeros((n, self.R))
        self.SXY = np.zeros((n, self.R))
        self.W = np.full(self.R, 1e-10)
        self.N = np.full(self.R, 1e-10)
        self.lam = np.full(self.R, float(settings.init_lambda))
        self.E2 = 0.0
        self.Ecv = np.zeros(self.R)
        self.H = np.zeros(self.R)
        self.r = np.zeros(self.R)
        self.p = 0.0
        self.trusted = False

    def project(self, x_centred):
        """Projected inputs s_j and the deflated inputs z_j they were taken from."""
        s, z = np.zeros(self.R), np.zeros((len(x_centred), self.R))
        residual = np.array(x_centred)
        for j in range(self.R):
            z[:, j] = residual
            s[j] = self.U[:, j] @ residual
            residual = residual - self.P[:, j] * s[j]
        return s, z

    def n_used(self):
        """R*, the number of projections that have seen enough samples to be used."""
        return self.R if self.N[self.R - 1] > 2 * len(self.c) else self.R - 1


class NaiveLWPR:
    """A learner that visits every receptive field with every sample."""

    def __init__(self, settings):
        self.settings = settings
        self.fields = []
        self.n_pruned = 0

    # -- activation ---------------------------------------------------------------------------------------------

    def activation(self, q):
        """Return w, dw/dq and d2w/dq2 at squared metric distance q."""
        if self.settings.kernel == "gaussian":
            w = np.exp(-q / 2)
            return w, -w / 2, w / 4
        u = 1 - q / 4
        return (u * u if u >= 0 else 0.0), -u / 2, 1 / 8

    # -- one sample ---------------------------------------------------------------------------------------------

    def update(self, x, y):
        """Learn one sample; return the activation-weighted in-sample prediction (0 where no field is trusted)."""
        x, y = np.asarray(x) / self.settings.norm_in, float(y) / self.settings.norm_out
        weights = []
        numerator = denominator = 0.0
        for rf in self.fields:
            delta = x - rf.c
            w, dw, ddw = self.activation(float(delta @ rf.D @ delta))
            weights.append(w)
            if w > UPDATE_THRESHOLD:
                prediction = self._update_field(rf, x, y, w, dw, ddw)
                if rf.trusted:
                    numerator += w * prediction
                    denominator += w
        self._add_or_prune(x, y, weights)
        return numerator / denominator * self.settings.norm_out if denominator > 0 else 0.0

    def _add_or_prune(self, x, y, weights):
        order = sorted(range(len(weights)), key=lambda k: -weights[k])  # stable: the first of equals leads
        w_max = weights[order[0]] if order else 0.0
        if w_max <= self.settings.w_gen:
            template = None
            if w_max > 0.1 * self.settings.w_gen and self.fields[order[0]].trusted:
                template = self.fields[order[0]]
            self.fields.append(NaiveField(x, y, self.settings, template))
        elif len(order) > 1 and weights[order[1]] > self.settings.w_prune:
            first, second = order[0], order[1]
            # the wider of the two goes, the second where they are equally wide
            victim = first if np.trace(self.fields[first].D) < np.trace(self.fields[second].D) else second
            last = self.fields.pop()
            if victim < len(self.fields):
                self.fields[victim] = last
            self.n_pruned += 1

    def _update_field(self, rf, x, y, w, dw, ddw):
        R, n = rf.R, len(x)
        # a. means
        a0 = rf.lam[0] * rf.W[0]
        rf.m = (a0 * rf.m + w * x) / (a0 + w)
        rf.beta0 = (a0 * rf.beta0 + w * y) / (a0 + w)
        x_centred, y_centred = x - rf.m, y - rf.beta0
        # b. projections with the old axes and slopes
        s, z = rf.project(x_centred)
        targets, e_cv_all = np.zeros(R), np.zeros(R)
        for j in range(R):
            targets[j] = y_centred if j == 0 else e_cv_all[j - 1]
            e_cv_all[j] = y_centred - sum(rf.beta[i] * s[i] for i in range(j + 1))
        rf.W = rf.lam * rf.W + w
        # c. partial least squares statistics
        for j in range(R):
            rf.SXY[:, j] = (0.9 + 0.1 * rf.lam[j]) * rf.SXY[:, j] + w * targets[j] * z[:, j]
            if rf.SXY[:, j] @ rf.SXY[:, j] > 1e-24:
                rf.U[:, j] = rf.SXY[:, j] / np.linalg.norm(rf.SXY[:, j])
            rf.SSs2[j] = rf.lam[j] * rf.SSs2[j] + w * s[j] ** 2
            rf.SSY[j] = rf.lam[j] * rf.SSY[j] + w * s[j] * targets[j]
            rf.SSX[:, j] = rf.lam[j] * rf.SSX[:, j] + w * s[j] * z[:, j]
            rf.beta[j] = rf.SSY[j] / rf.SSs2[j]
            rf.P[:, j] = rf.SSX[:, j] / rf.SSs2[j]
        rf.p = rf.lam[R - 1] * rf.p + sum((w * s[j]) ** 2 / rf.SSs2[j] for j in range(R))
        # d. residuals with the new axes
        s, _ = rf.project(x_centred)
        used = rf.n_used()
        fitted = sum(rf.beta[j] * s[j] for j in range(used))
        e, e_cv = y_centred - fitted, e_cv_all[used - 1]
        if rf.N[0] * (1 - rf.lam[0]) > ERROR_GATE:
            rf.E2 = rf.lam[R - 1] * rf.E2 + w * e**2
            for j in range(R):
                rf.Ecv[j] = rf.lam[j] * rf.Ecv[j] + w * e_cv_all[j] ** 2
        if rf.N[0] > 2 * n:
            rf.trusted = True
        prediction = rf.beta0 + fitted
        # e. metric
        if self.settings.update_D:
            self._update_metric(rf, x, s, e, e_cv, w, dw, ddw)
        # g. counts and forgetting
        rf.N = rf.lam * rf.N + 1
        rf.lam = self.settings.tau_lambda * rf.lam + (1 - self.settings.tau_lambda) * self.settings.final_lambda
        return prediction

    # -- metric -------------------------------------------------------------------------------------------------

    def _metric_derivatives(self, rf, delta):
        """First and second derivatives of q and of the penalty J2 in every learned element of M."""
        n, M, D = len(delta), rf.M, rf.D
        g = self.settings.penalty / n
        dq, ddq, dJ2, ddJ2 = (np.zeros((n, n)) for _ in range(4))
        for a in range(n):
            for b in range(a, n):
                if self.settings.diag_only:
                    if a == b:
                        dq[a, a] = 2 * M[a, a] * delta[a] ** 2
                        ddq[a, a] = 2 * delta[a] ** 2
                        dJ2[a, a] = 4 * g * D[a, a] * M[a, a]
                        ddJ2[a, a] = 2 * g * (2 * D[a, a] + 4 * M[a, a] ** 2)
                else:
                    dq[a, b] = 2 * delta[b] * sum(M[a, i] * delta[i] for i in range(a, n))
                    ddq[a, b] = 2 * delta[b] ** 2
                    dJ2[a, b] = 4 * g * sum(D[i, b] * M[a, i] for i in range(a, n))
                    ddJ2[a, b] = 4 * g * (D[b, b] + sum(M[a, i] ** 2 for i in range(a, n)) + M[a, b] ** 2)
        return dq, ddq, dJ2, ddJ2

    def _update_metric(self, rf, x, s, e, e_cv, w, dw, ddw):
        active = rf.N * (1 - rf.lam[0]) > ERROR_GATE
        if not active[0]:
            return
        R, n, W = rf.R, len(x), rf.W[0]
        kappa = np.where(active, s / rf.SSs2, 0.0)
        h = w * sum(s[j] * kappa[j] for j in range(R))
        E = rf.Ecv[R - 1] if (rf.N[R - 1] > 2 * n or R == 1) else rf.Ecv[R - 2]
        T = min(1.0, (rf.E2 / (E + 1e-10)) ** 4)
        dJ1 = (-E / W + e_cv**2 - sum(2 * kappa[j] * e * rf.H[j] + 2 * kappa[j] ** 2 * rf.r[j] for j in range(R))) / W
        dq, ddq, dJ2, ddJ2 = self._metric_derivatives(rf, x - rf.c)
        G = w / W * dJ2 + dw * dq * dJ1
        learned = np.eye(n, dtype=bool) if self.settings.diag_only else np.triu(np.ones((n, n), dtype=bool))
        if self.settings.meta:
            S = e * sum(s[j] * kappa[j] for j in range(R))
            cross = sum(4 * (kappa[j] * e / W + kappa[j] * S) * rf.H[j] for j in range(R))
            ddJ1 = (2 * (e**2 * h / w - e_cv**2 / W) + E / W**2 + cross) / W
            Q = w / W * ddJ2 + (ddw * dq**2 + dw * ddq) * dJ1 + (dw * dq) ** 2 * ddJ1
            for a, b in np.argwhere(learned):
                step = np.clip(self.settings.meta_rate * T * G[a, b] * rf.eta[a, b], -0.1, 0.1)
                rf.b[a, b] = np.clip(rf.b[a, b] - step, -10.0, 10.0)
                rf.alpha[a, b] = np.exp(rf.b[a, b])
                decay = max(0.0, 1 - rf.alpha[a, b] * T * Q[a, b])
                rf.eta[a, b] = rf.eta[a, b] * decay - rf.alpha[a, b] * T * G[a, b]
        largest = np.abs(rf.M).max()
        for a, b in np.argwhere(learned):
            step = rf.alpha[a, b] * T * G[a, b]
            if step > 0.1 * largest:
                rf.alpha[a, b] /= 2
            else:
                rf.M[a, b] -= step
        rf.D = rf.M.T @ rf.M
        for j in range(R):
            if active[j]:
                rf.H[j] = rf.lam[j] * rf.H[j] + T * w * s[j] * e_cv / (1 - h)
                rf.r[j] = rf.lam[j] * rf.r[j] + T * w**2 * e_cv**2 * s[j] ** 2 / (1 - h)

    # -- prediction ---------------------------------------------------------------------------------------------

    def predict(self, x, cutoff):
        """Return prediction and confidence bound at one place; 0 and 1e20 * norm_out where nothing contributes."""
        x = np.asarray(x) / self.settings.norm_in
        parts = []
        for rf in self.fields:
            delta = x - rf.c
            w = self.activation(float(delta @ rf.D @ delta))[0]
            if w > cutoff and rf.trusted:
                used = rf.n_used()
                s, _ = rf.project(x - rf.m)
                value = rf.beta0 + sum(rf.beta[j] * s[j] for j in range(used))
                gamma = rf.Ecv[used - 1] / (rf.W[used - 1] - rf.p)
                variance = gamma * (1 + w * sum(s[j] ** 2 / rf.SSs2[j] for j in range(used)))
                parts.append((w, value, variance))
        if not parts:
            return 0.0, 1e20 * self.settings.norm_out
        w, value, variance = (np.array(column) for column in zip(*parts, strict=True))
        mean = w @ value / w.sum()
        # the disagreement about the mean, not the difference of two large sums
        conf = np.sqrt(abs(w @ variance + w @ (value - mean) ** 2)) / w.sum()
        return mean * self.settings.norm_out, conf * self.settings.norm_out
