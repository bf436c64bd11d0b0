"""What makes ground hard to survey, as rasters: noise, density, slope, roughness, all in logarithms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["COVARIATES", "error_covariates"]

#: Names, and what each is the logarithm of.
COVARIATES = {
    "noise": "standard deviation of an observation, m",
    "density": "effective number of observations behind a cell",
    "slope": "rise over run of the terrain",
    "roughness": "standard deviation of the terrain about its smooth form, m",
}
#: Slopes and roughness below this are level ground: rise over run, m.
_LEVEL = 0.03
_SMOOTH = 0.01
#: Width of the smooth form, kernels of the difference.
_SMOOTHING = 1.5


def error_covariates(
    variance: FloatArray,
    counts: tuple[FloatArray, FloatArray],
    terrain: tuple[FloatArray, FloatArray],
    known: BoolArray,
    smoothing: float,
) -> dict[str, FloatArray]:
    """
    Covariates of the errors of a difference.

    Parameters
    ----------
    variance : array, shape (n_rows, n_cols), m2
        Of the difference, from independent errors alone.
    counts : pair of array
        Effective number of observations, earlier and later.
    terrain : pair of array, m, 1
        Elevation and slope.
    known : array, bool
        Where the difference is known.
    smoothing : float, cells
        Kernel of the difference.

    Returns
    -------
    covariates : dict of name to array, shape (n_rows, n_cols)
        In logarithms; 0 where the difference is not known.
    """
    pooled = 1.0 / (1.0 / np.where(known, counts[0], 1.0) + 1.0 / np.where(known, counts[1], 1.0))
    elevation, slope = terrain
    width = _SMOOTHING * smoothing
    mass = np.maximum(gaussian_filter(known.astype(np.float64), width), 1e-6)
    smooth = gaussian_filter(np.where(known, elevation, 0.0), width) / mass
    rough = gaussian_filter(np.where(known, (elevation - smooth) ** 2, 0.0), width) / mass
    # single precision is plenty for logarithms, and these are held as long as the difference is
    noise = 0.5 * np.log(np.where(known, variance, 1.0) * pooled)
    return {
        "noise": np.where(known, noise, 0.0).astype(np.float32),
        "density": np.where(known, np.log(pooled), 0.0).astype(np.float32),
        "slope": np.where(known, np.log(slope + _LEVEL), 0.0).astype(np.float32),
        "roughness": np.where(known, 0.5 * np.log(rough + _SMOOTH**2), 0.0).astype(np.float32),
    }
