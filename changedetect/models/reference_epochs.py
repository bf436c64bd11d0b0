"""What receptive fields keep from one survey epoch to the next, and what is assumed of their noise meanwhile."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from changedetect.kernels.lwpr_predict import NoisePrior, mean_residuals
from changedetect.kernels.lwpr_state import TRUST_COUNT

if TYPE_CHECKING:
    from changedetect.kernels.lwpr_search import LWPRState
    from changedetect.typing import FloatArray

__all__ = ["OBSERVED_MASS", "inherit", "move_to", "noise_prior"]

#: Mass of activations that makes a receptive field observed in an epoch: one sample at its centre.
OBSERVED_MASS = 1.0
#: Forgetting never leaves less than this, so that sums stay far from underflow.
_LEAST_OBSERVATIONS = 1e-3
#: Sums over samples: what forgetting scales. Means, axes, slopes and counts that open gates stay.
_SUMS = (
    *("SXY1_x", "SXY1_y", "SXY2_x", "SXY2_y", "SSX1_x", "SSX1_y", "SSX2_x", "SSX2_y", "SSs2_1", "SSs2_2"),
    *("W", "W2", "Wcv", "E2", "Ecv_1", "Ecv_2", "p"),
)
_METRIC_SUMS = ("H_1", "H_2", "r_1", "r_2")


def inherit(state: LWPRState, decay: float, prior_observations: float, ended: float, forgetting: float) -> None:
    """
    Let an epoch's statistics fade into the prior of the next.

    Parameters
    ----------
    state : LWPRState
        Changed in place.
    decay : float
        Factor of all sums for the time that passes.
    prior_observations : float
        Most observations that a field's sums count for then.
    ended : float, days
        Time of the epoch that ends.
    forgetting : float
        Forgetting factor to start again with.
    """
    fields, metrics = state.fields[: state.n_fields], state.metrics[: state.n_fields]
    is_seen = fields["epoch_mass"] >= OBSERVED_MASS
    fields["observed_time"][is_seen] = ended
    fields["epoch_mass"] = 0.0
    fields["lam"] = forgetting
    with np.errstate(divide="ignore", invalid="ignore"):
        n_effective = np.where(fields["W2"] > 0.0, fields["W"] ** 2 / fields["W2"], 0.0)
        kept = np.clip(decay * n_effective, min(_LEAST_OBSERVATIONS, prior_observations), prior_observations)
        factor = np.where(n_effective > 0.0, np.minimum(kept / n_effective, 1.0), 1.0)
    for name in _SUMS:
        fields[name] *= factor
    for name in _METRIC_SUMS:
        metrics[name] *= factor


def move_to(state: LWPRState, x: FloatArray, y: FloatArray, target: FloatArray, kernel: int) -> None:
    """
    Raise or lower inherited planes to the level of a new epoch's samples, before these are learned.

    What is inherited is a prior for the shape of the ground, not for its height: it would attenuate a change by the
    share that it still has after the last sample, and the way from the old height to the new one would pass for noise.
    Only fields the epoch has not reached yet are moved: all the way if these samples make them observed, less where
    they are met by less.
    """
    fields = state.fields[: state.n_fields]
    is_inherited = fields["epoch_mass"] == 0.0
    if is_inherited.any():
        mean, mass = mean_residuals(state, x, y, target, kernel)
        fields["beta0"] += np.where(is_inherited, mean * np.minimum(mass / OBSERVED_MASS, 1.0), 0.0)


def noise_prior(state: LWPRState, elevations: tuple[float, float, float], weight: float) -> NoisePrior:
    """
    Pooled noise variance of all trusted fields.

    It is their geometric mean, each weighted by what it knows: noise differs between places by factors, and a quiet
    field must not take over the variance of noisy ones. Where no field holds residuals yet, the variance of the
    elevations themselves is all that bounds it.
    """
    fields = state.fields[: state.n_fields]
    mass = fields["Wcv"] * (1.0 - fields["p"] / fields["W"])
    energy = np.where(fields["N"] > TRUST_COUNT, fields["Ecv_2"], fields["Ecv_1"])
    is_known = (fields["trusted"] > 0.0) & (mass > 0.0) & (energy > 0.0)
    if is_known.any():
        mass, energy = mass[is_known], energy[is_known]
        return NoisePrior(float(np.exp(np.average(np.log(energy / mass), weights=mass))), weight)
    count, _, squares = elevations
    return NoisePrior(squares / count if count else math.nan, weight)
