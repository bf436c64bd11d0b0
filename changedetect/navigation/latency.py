"""
How long after the moment they describe GPS fixes are stamped.

At 30 m/s a receiver's delay of 100 ms is 3 m along the track, with a sign that turns with the heading: no constant
offset describes it. The filter carries the derivative of its innovations by the delay along, so one pass gives the
estimate and its standard error; a second pass, with the fixes moved, makes it exact.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

from changedetect.errors import InputDataError
from changedetect.navigation.flight import Flight

__all__ = ["LatencyEstimate", "estimate_latency"]

logger = logging.getLogger(__name__)

#: Delays above this are a fault of the clocks, s.
_BOUND = 1.0
#: Longest step of one pass, s: the fixes are linear in the delay only over a fraction of a turn.
_LONGEST_STEP = 0.4
_N_PASSES = 8
#: Standard errors that a delay must differ from none to be believed.
_BELIEVED = 3.0


@dataclass(frozen=True)
class LatencyEstimate:
    """
    Delay of the GPS stamps.

    Parameters
    ----------
    seconds : float, s
        Used: a fix stamped t describes the moment t - seconds.
    std : float, s
        Standard error of the estimate; 0 where it was given.
    is_estimated : bool
        False where it was given, or where no delay could be told from none.
    """

    seconds: float
    std: float
    is_estimated: bool


def estimate_latency(flight: Flight, step: Callable[[float], tuple[float, float]]) -> LatencyEstimate:
    """
    Delay that makes the fixes most likely.

    Parameters
    ----------
    flight : Flight
        For messages.
    step : callable
        For a delay in seconds: what one pass of the filter would add to it, and the standard error.

    Returns
    -------
    latency : LatencyEstimate
        Zero where it differs from zero by less than 3 standard errors.

    Raises
    ------
    InputDataError
        The delay lies beyond 1 s.
    """
    seconds = 0.0
    std = math.inf
    for _ in range(_N_PASSES):
        change, std = step(seconds)
        if not math.isfinite(change):
            return LatencyEstimate(0.0, math.inf, False)
        seconds += max(-_LONGEST_STEP, min(_LONGEST_STEP, change))
        if abs(seconds) > _BOUND:
            msg = (
                f"GPS and inertial clock of {flight.label} differ by more than {_BOUND:.0f} s: the fixes fit better "
                f"the further they are moved {'back' if seconds > 0 else 'ahead'}. Bring both logs to one time base "
                "(GPS time runs 18 s ahead of UTC since 2017). If they are, the inertial axes are not "
                "forward-right-down or its units not as stated."
            )
            raise InputDataError(msg)
        if abs(change) < 0.2 * std:
            break
    if abs(seconds) < _BELIEVED * std:
        logger.debug("%s: GPS delay %.4f +- %.4f s cannot be told from none", flight.label, seconds, std)
        return LatencyEstimate(0.0, std, False)
    logger.info("%s: GPS stamps are %.3f +- %.3f s late; corrected", flight.label, seconds, std)
    return LatencyEstimate(seconds, std, True)
