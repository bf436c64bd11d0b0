"""Slow, obvious versions of the fast kernels; they share no code with the package."""

from __future__ import annotations

import numpy as np


def moments(easting, northing, elevation, weight, centre):
    """Sums n, w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz, wzz about a cell centre."""
    x, y, z, w = easting - centre[0], northing - centre[1], elevation, weight
    terms = [np.ones_like(w), w, w * x, w * y, w * x * x, w * x * y, w * y * y, w * z, w * x * z, w * y * z, w * z * z]
    return np.array([np.sum(t) for t in terms])


def bisquare(squared_distance):
    """LWPR's compact kernel: (1 - q / 4)**2 for q < 4."""
    return np.where(squared_distance < 4.0, (1.0 - squared_distance / 4.0) ** 2, 0.0)


def local_plane(easting, northing, elevation, weight, centre, kernel):
    """
    Weighted least squares through points: value, slopes times kernel, their covariance, n_eff, residual sum, freedom.

    `weight` is one over the variance of an observation.
    """
    x, y = (easting - centre[0]) / kernel, (northing - centre[1]) / kernel
    activation = bisquare(x * x + y * y)
    design = np.column_stack([np.ones_like(x), x, y])
    w = np.diag(activation * weight)
    normal = np.linalg.inv(design.T @ w @ design)
    smoother = normal @ design.T @ w
    beta = smoother @ elevation
    covariance = smoother @ np.diag(1.0 / weight) @ smoother.T
    residual = elevation - design @ beta
    total = activation * weight
    n_effective = total.sum() ** 2 / np.sum(total**2)
    # expectation of the weighted residual sum under unit variance factor
    hat = design @ smoother
    left = np.eye(len(x)) - hat
    freedom = np.sum(np.diag(left @ np.diag(1.0 / weight) @ left.T) * total)
    return beta, covariance, n_effective, float(np.sum(total * residual**2)), freedom
