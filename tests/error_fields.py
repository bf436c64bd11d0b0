"""Differences with known errors and changes, made without the package's own random fields."""

import math

import numpy as np
from scipy.ndimage import gaussian_filter

from changedetect.config import DifferencingConfig
from changedetect.differencing.maps import Evidence, judge_change
from changedetect.differencing.pair import cell_errors


def smooth_field(rng, shape, std, length):
    """Gaussian field of covariance std^2 exp(-r^2 / (2 length^2)), lengths in cells."""
    width = length / math.sqrt(2.0)
    margin = math.ceil(4 * width)
    white = rng.standard_normal([n + 2 * margin for n in shape])
    field = gaussian_filter(white, width, mode="wrap")[margin:-margin, margin:-margin]
    # a Gaussian filter of width w leaves white noise with variance 1 / (4 pi w^2)
    return std * math.sqrt(4.0 * math.pi) * width * field


def evidence(difference, local_std, local_length=1.5, slope=None, resolution=1.0):
    """What the estimator would say of a difference whose independent errors have this std and correlation."""
    shape = difference.shape
    everywhere = np.isfinite(difference)
    flat = np.full(shape, 20.0)
    return Evidence(
        difference=difference,
        variance=np.broadcast_to(np.asarray(local_std, float) ** 2, shape).copy(),
        freedom=np.full(shape, 1e4),
        counts=(flat, flat),
        observed=(everywhere, everywhere),
        terrain=(np.zeros(shape), np.full(shape, 0.1) if slope is None else slope),
        correlation_length=local_length * resolution * math.sqrt(2.0 * math.pi),
    )


def quiet(seed, shape=(200, 200), local=0.01, correlated=0.0, length=12.0):
    """Errors alone: independent ones as the estimator's kernel correlates them, and correlated ones."""
    rng = np.random.default_rng(seed)
    d = smooth_field(rng, shape, local, 1.5)
    return d + smooth_field(rng, shape, correlated, length) if correlated > 0.0 else d


def change_maps(difference, local_std=0.01, resolution=1.0, confidence=0.95, **kwargs):
    """Full maps of a difference."""
    found = evidence(difference, local_std, resolution=resolution)
    errors = cell_errors(found, resolution, **kwargs)
    return judge_change(found, errors, DifferencingConfig(confidence=confidence))
