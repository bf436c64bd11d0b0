"""Short flights and their statistics, shared by tests of navigation."""

from __future__ import annotations

import numpy as np

from changedetect.synthetic.flight_path import FlightPlan


def short_plan() -> FlightPlan:
    """Give two strips of 250 m: about 70 s."""
    return FlightPlan(n_strips=2, strip_length=250.0)


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    """Mean normalised error squared per degree of freedom, errors of shape (n, k)."""
    solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    return float(np.mean(np.sum(error * solved, axis=1)) / error.shape[1])
