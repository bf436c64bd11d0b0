"""Correcting the clock of a camera that the pictures themselves contradict."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from changedetect.errors import InputDataError
from changedetect.io.flight import read_flight
from changedetect.io.photo_folder import is_photo_folder
from changedetect.navigation.photo_clock import PictureClock, clock_from_attitudes
from changedetect.navigation.solution import navigate
from changedetect.pipeline.flight_run import FlightRun, read_flight_source

__all__ = ["with_camera_in_time"]

logger = logging.getLogger(__name__)

#: Squared deviation from navigation per pose parameter beyond which the clock is looked at.
_CONTRADICTION = 4.0
#: The largest offset that is corrected, s, as where photos state positions.
_CORRECTED = 2.0
_PASSES = 3
#: Share of the contradiction that an offset has to explain to be believed, at first and once one is found.
_CONVINCING, _REFINING = 0.4, 0.05


def with_camera_in_time(run: FlightRun, directory: Path, *, camera_file: Path | None = None) -> FlightRun:
    """
    Same flight with the times of its photos corrected, where pictures and logs show that the camera's clock is off.

    Parameters
    ----------
    run : FlightRun
        Is oriented by this.
    directory : path
        Folder of the flight.
    camera_file : path, optional

    Raises
    ------
    InputDataError
        The clocks differ by more than 2 s; the message says by how much.

    Notes
    -----
    Photos that agree with navigation are left alone. Where they do not, the offset at which the adjusted attitudes
    follow the inertial log is taken, if it explains most of the contradiction, and the flight is navigated again. The
    second pass finds what the first, whose tracks were found with wrong predictions, left over.
    """
    if is_photo_folder(directory):
        return run
    total = 0.0
    for _ in range(_PASSES):
        if run.oriented.adjustment.prior_chi2 <= _CONTRADICTION:
            return run
        found = _estimate(run, directory, camera_file)
        if found is None or not found.explains(_REFINING if total else _CONVINCING):
            return run
        total += found.seconds
        if abs(total) > _CORRECTED:
            msg = (
                f"The clock of the camera is off by {total:+.2f} s (± {found.std:.2f} s) from the navigation logs of "
                f"{directory}: only then do the pictures turn as the inertial log does. Add that to time_s in "
                f"images.csv (offsets up to {_CORRECTED:.0f} s are corrected without asking)."
            )
            raise InputDataError(msg)
        logger.warning(
            "%s: camera clock off by %+.2f ± %.2f s, as the pictures show; photo times corrected",
            directory,
            total,
            found.std,
        )
        run = replace(run, source=read_flight_source(directory, camera_file=camera_file, camera_clock=total))
    return run


def _estimate(run: FlightRun, directory: Path, camera_file: Path | None) -> PictureClock | None:
    flight = read_flight(directory, camera_file=camera_file)
    adjusted, poses = run.oriented.adjustment.block, run.source.poses
    turn = poses.origin.rotation_from_ecef @ run.origin.rotation_from_ecef.T
    return clock_from_attitudes(poses.time, turn @ adjusted.rotation, navigate(flight).smoothed, flight.mount)
