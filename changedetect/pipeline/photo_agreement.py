"""Whether the photos of a flight agree with each other and with its navigation, judged after the adjustment."""

from __future__ import annotations

import logging

import numpy as np

from changedetect.errors import InputDataError
from changedetect.photogrammetry.adjustment import Adjustment
from changedetect.pipeline.flight_run import FlightRun
from changedetect.typing import IntArray

__all__ = ["attitude_scatter", "check_agreement"]

logger = logging.getLogger(__name__)

#: Deviation of adjusted from navigated poses, over its variance, beyond which a user is warned.
_MAX_PRIOR_CHI2 = 4.0
#: Squared scatter of the attitudes, over its variance, beyond which the photos are not those of the flight: mountings
#: up to 6 degrees off and cameras 5 % longer leave 2.5 at most, photos of another flight 430, copies of one photo 66.
_MAX_SCATTER = 25.0
#: Fewest points that photos which belong together can leave.
_FEWEST_POINTS = 30


def check_agreement(run: FlightRun, adjustment: Adjustment, images: IntArray, points: IntArray) -> None:
    """
    Refuse a flight whose photos are not those of its logs; warn where both contradict each other.

    Parameters
    ----------
    run : FlightRun
    adjustment : Adjustment
        Of this flight, or of several.
    images, points : array of int
        Positions of the flight's photos and numbers of its points in it.

    Raises
    ------
    InputDataError
        Hardly any point fits the photos, or their attitudes deviate from navigation as those of other photos would.
    """
    source = run.source
    if points.size < _FEWEST_POINTS:
        msg = (
            f"{source.label}: only {points.size} points fit the photos that show them, at least {_FEWEST_POINTS} are "
            "needed. Check that the photos are in the order that their list says, of one flight, and of its logs."
        )
        raise InputDataError(msg)
    if adjustment.prior_chi2 <= _MAX_PRIOR_CHI2:
        return
    has_logs = source.has_heading is None and not source.is_known
    scatter = attitude_scatter(run, adjustment, images) if has_logs else 0.0
    if scatter > _MAX_SCATTER:
        msg = (
            f"{source.label}: from photo to photo the pictures turn otherwise than the logs say, by "
            f"{np.sqrt(scatter):.0f} standard deviations. The photos are of another flight, out of order, or off in "
            "time by seconds: put those of this flight into its folder and check their list."
        )
        raise InputDataError(msg)
    logger.warning(
        "%s: photos and navigation contradict each other (squared deviation of the poses %.1f times what their "
        "covariance allows). Check the clock of the camera, its mounting, the camera file, and whether photos and "
        "logs are of one flight",
        source.label,
        adjustment.prior_chi2,
    )


def attitude_scatter(run: FlightRun, adjustment: Adjustment, images: IntArray) -> float:
    """
    Mean square by which adjusted attitudes deviate from navigated ones about their median, over its variance.

    Deviations are taken about the axes of the camera, where an error of its mounting is the same in all photos.
    """
    rotation = adjustment.block.rotation[images]
    deviation = np.einsum("nji,nj->ni", rotation, adjustment.pose_correction[images, 3:])
    covariance = np.swapaxes(rotation, 1, 2) @ run.source.poses.total_covariance[:, 3:, 3:] @ rotation
    apart = deviation - np.median(deviation, axis=0)
    return float(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(covariance), apart).mean()) / 3.0
