"""
What learning and answering cost: time and memory of one method, in a process of its own.

Memory is the peak of the resident set of that process beyond what the interpreter and the libraries took before:
allocations of compiled code and of BLAS are in it, which Python's own accounting does not see. The process is fresh,
so nothing a method before it has left behind counts. A small survey is learned first, so that compiling and loading
are not in the times.
"""

from __future__ import annotations

import gc
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from changedetect.models.base import Prediction, SurfaceModel
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import Coordinates

__all__ = ["Measured", "MethodFailedError", "measure", "measure_isolated"]

_STATUS = Path("/proc/self/status")
_RESET_PEAK = Path("/proc/self/clear_refs")


class MethodFailedError(Exception):
    """A method could not learn the observations or answer; the message says why."""


@dataclass(frozen=True)
class Measured:
    """
    What a method answered, and what that cost.

    Attributes
    ----------
    prediction : Prediction
    wall_seconds, cpu_seconds : float
        Learning and answering, once compiled; CPU time is that of all threads.
    peak_memory_bytes : int or None
        Beyond the state before learning; None where it is not known: not in a process of its own, or not on Linux.
    """

    prediction: Prediction
    wall_seconds: float
    cpu_seconds: float
    peak_memory_bytes: int | None


def measure(build: Callable[[], SurfaceModel], learned: PointCloud, places: Coordinates) -> Measured:
    """
    Learn observations and predict at places, in this process.

    Parameters
    ----------
    build : callable
        Makes a fresh model.
    learned : PointCloud
    places : (easting, northing), arrays of shape (n,), m

    Returns
    -------
    measured : Measured
        Without memory.

    Raises
    ------
    MethodFailedError
        The method refuses the observations, a package is missing, or memory ran out.
    """
    _warm_up(build, is_weighted=learned.sigma is not None)
    return _timed(build, learned, places)


def _timed(build: Callable[[], SurfaceModel], learned: PointCloud, places: Coordinates) -> Measured:
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        model = build().fit(learned.coordinates, learned.elevation, learned.sigma)
        prediction = model.predict(places)
    except (ValueError, ImportError, MemoryError) as error:
        msg = str(error) or type(error).__name__
        raise MethodFailedError(msg) from error
    return Measured(prediction, time.perf_counter() - wall, time.process_time() - cpu, None)


def measure_isolated(build: Callable[[], SurfaceModel], learned: PointCloud, places: Coordinates) -> Measured:
    """
    Do the same in a fresh process, so that memory can be measured; arguments and errors as for `measure`.

    Notes
    -----
    The process is spawned: a script that calls this needs ``if __name__ == "__main__":``.
    """
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(_measure_with_memory, build, learned, places).result()
        except BrokenProcessPool as error:
            msg = "its process was killed; running out of memory looks like this"
            raise MethodFailedError(msg) from error


def _measure_with_memory(build: Callable[[], SurfaceModel], learned: PointCloud, places: Coordinates) -> Measured:
    _warm_up(build, is_weighted=learned.sigma is not None)
    gc.collect()
    before = _start_peak()
    measured = _timed(build, learned, places)
    peak = None if before is None else max(_status("VmHWM") - before, 0)
    return Measured(measured.prediction, measured.wall_seconds, measured.cpu_seconds, peak)


def _warm_up(build: Callable[[], SurfaceModel], *, is_weighted: bool) -> None:
    """Learn a rippled square of 400 points: compiles what has to be compiled, and loads what is loaded late."""
    rng = np.random.default_rng(0)
    easting, northing = rng.uniform(0.0, 20.0, (2, 400))
    elevation = np.sin(easting / 3.0) + rng.normal(0.0, 0.05, 400)
    try:
        build().fit((easting, northing), elevation, np.full(400, 0.05) if is_weighted else None).predict(
            (easting[:50], northing[:50])
        )
    except ImportError as error:
        raise MethodFailedError(str(error)) from error


def _start_peak() -> int | None:
    """Begin a new record of the peak and return the memory in use, bytes; None where the system keeps none."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        _RESET_PEAK.write_text("5")  # see proc(5): resets the peak to the present size
    except OSError:
        return _status("VmHWM")  # what is added beyond the peak of the warm-up
    return _status("VmRSS")


def _status(key: str) -> int:
    """Read a size from the process's status, bytes."""
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(f"{key}:"))
    return int(line.split()[1]) * 1024
