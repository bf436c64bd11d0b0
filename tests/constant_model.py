"""The simplest surface model, importable from a process that a test starts."""

from __future__ import annotations

import numpy as np

from changedetect.models.base import Prediction


class ConstantModel:
    """Predicts the mean of what it learned, and only west of a line."""

    def __init__(self, share: float = 1.0, fails: bool = False, reserve: int = 0) -> None:
        self.share, self.fails, self.reserve = share, fails, reserve

    def fit(self, coordinates, elevation, sigma=None, survey_time=None):
        if self.fails and len(elevation) > 400:  # not while warming up
            msg = "I cannot learn this"
            raise ValueError(msg)
        if len(elevation) > 400:
            self.held = np.ones(self.reserve, np.uint8)
        self.mean, self.west = elevation.mean(), np.quantile(coordinates[0], self.share)
        return self

    def predict(self, coordinates):
        known = coordinates[0] <= self.west
        full = np.where(known, 1.0, np.nan)
        return Prediction(
            elevation=self.mean * full,
            elevation_std=0.1 * full,
            noise_std=full,
            n_effective=np.where(known, 1.0, 0.0),
            age_days=0.0 * full,
        )
