"""
Which lens parameters and mounting angles a flight determines.

A flight at one height over flat ground hardly tells focal length from height, or principal point from tilt; then a
self-calibration bends the ground to fit. All parameters are therefore estimated once with honest priors, and only those
that the photos know much better than the priors are freed; the others stay as the camera file has them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from changedetect.photogrammetry.adjustment import LENS_PARAMETERS, Adjustment, AdjustmentSettings, adjust
from changedetect.photogrammetry.block import ImageBlock, Observations
from changedetect.typing import BoolArray, FloatArray

__all__ = ["Observability", "describe_lens", "observable_parameters"]

logger = logging.getLogger(__name__)

#: A parameter is freed where its standard error is at most this share of the prior's.
_MAX_SHARE = 0.2
_BORESIGHT_STD = np.radians(0.5)


@dataclass(frozen=True)
class Observability:
    """
    What one flight says of its camera.

    Attributes
    ----------
    share : array, shape (5,)
        Standard error over prior standard deviation of log focal length, cx, cy, k1, k2; the worst of several lenses.
    lens : tuple of str
        Parameters worth estimating.
    boresight_share : array, shape (3,)
        The same for the mounting angles about the camera's axes, the worst of several flights.
    boresight : bool
        Whether all three are worth estimating.
    prior_boresight : float, rad
    """

    share: FloatArray
    lens: tuple[str, ...]
    boresight_share: FloatArray
    boresight: bool
    prior_boresight: float

    def describe(self) -> dict[str, Any]:
        """Content for a report."""
        return {
            "freed": list(self.lens) + (["boresight"] if self.boresight else []),
            "std_over_prior": dict(zip(LENS_PARAMETERS, self.share.tolist(), strict=True)),
            "boresight_std_over_prior": self.boresight_share.tolist(),
        }


def observable_parameters(
    block: ImageBlock,
    observations: Observations,
    information: FloatArray,
    *,
    start: ImageBlock | None = None,
    max_share: float = _MAX_SHARE,
) -> Observability:
    """
    Estimate all parameters once and say which of them the photos determine.

    Parameters
    ----------
    block : ImageBlock
    observations : Observations
    information : array, shape (6 n, 6 n)
    start : ImageBlock, optional
        Poses to begin with.
    max_share : float
        Largest standard error, as a share of the prior's, of a parameter worth estimating.

    Notes
    -----
    Standard errors heed the correlation of residuals within photos (`PixelCorrelation`): with as many observations as
    tracks give, every parameter would seem determined.
    """
    settings = AdjustmentSettings(lens=LENS_PARAMETERS, boresight_std=_BORESIGHT_STD, rounds=1)
    trial = adjust(block, observations, information, settings, start=start)
    share = (trial.lens_std / np.asarray(settings.lens_std)).max(axis=0)
    boresight = (trial.boresight_std / _BORESIGHT_STD).max(axis=0)
    good: BoolArray = share <= max_share
    names = tuple(name for name, is_good in zip(LENS_PARAMETERS, good, strict=True) if is_good)
    left = [name for name in LENS_PARAMETERS if name not in names]
    if left:
        logger.info("not determined by these photos, left as given: %s", ", ".join(left))
    return Observability(share, names, boresight, bool((boresight <= max_share).all()), float(_BORESIGHT_STD))


def describe_lens(adjustment: Adjustment, settings: AdjustmentSettings) -> dict[str, Any]:
    """Corrections of lens and mounting with standard errors, for a report."""
    lenses = [
        {
            name: {"correction": float(correction), "std": float(std)}
            for name, correction, std in zip(LENS_PARAMETERS, corrections, stds, strict=True)
            if name in settings.lens
        }
        for corrections, stds in zip(adjustment.lens_correction, adjustment.lens_std, strict=True)
    ]
    out: dict[str, Any] = {"adjusted": list(settings.lens), "lenses": lenses}
    if settings.boresight_std > 0:
        out["boresight_deg"] = np.degrees(adjustment.boresight).tolist()
        out["boresight_std_deg"] = np.degrees(adjustment.boresight_std).tolist()
    return out
