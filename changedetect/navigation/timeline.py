"""
One ordered timeline of inertial intervals, GPS fixes and photos.

Fixes and photos fall between inertial samples. The interval that holds one is divided there, with its mean rate and
force on both sides, so that the filter stands exactly at the moment of the measurement or exposure: nothing is
interpolated afterwards, and the smoother gives the covariance of a photo as it gives that of any other node.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from changedetect.kernels.navigation import compensate_motion
from changedetect.navigation.flight import ImuLog
from changedetect.typing import FloatArray, IntArray

__all__ = ["Timeline", "build_timeline"]

#: Moments closer than this are one node, s.
_SAME_MOMENT = 1e-6


@dataclass(frozen=True)
class Timeline:
    """
    Nodes of the filter and the inertial intervals between them.

    Parameters
    ----------
    time : array, shape (m,), s
        Of the nodes.
    fix, photo : array of int, shape (m,)
        Row of the GPS fix and index of the photo at each node, -1 for none.
    start : array of int, shape (m,)
        Intervals start[k-1]:start[k] lead from node k - 1 to node k.
    duration : array, shape (s,), s
    angular_rate, specific_force : array, shape (s, 3), FRD, rad/s and m/s2
        Constant over each interval; coning and sculling included.
    noise_factor : array, shape (s,)
    """

    time: FloatArray
    fix: IntArray
    photo: IntArray
    start: IntArray
    duration: FloatArray
    angular_rate: FloatArray
    specific_force: FloatArray
    noise_factor: FloatArray


def build_timeline(
    imu: ImuLog, fix_time: FloatArray, photo_time: FloatArray, begin: float, end: float, spacing: float = 0.2
) -> Timeline:
    """
    Lay out the nodes of a flight between two moments.

    Parameters
    ----------
    imu : ImuLog
    fix_time, photo_time : array, shape (q,) and (n,), s
        Those outside [begin, end] get no node.
    begin, end : float, s
        Within the inertial log.
    spacing : float, s
        Largest distance between nodes, so that the trajectory can be drawn and searched.

    Returns
    -------
    timeline : Timeline

    Raises
    ------
    ValueError
        The inertial log does not cover [begin, end].
    """
    if not imu.time[0] <= begin < end <= imu.time[-1]:
        msg = f"The inertial log covers {imu.time[0]:.3f} to {imu.time[-1]:.3f} s, not {begin:.3f} to {end:.3f} s."
        raise ValueError(msg)
    rate, force, factor = _intervals(imu)
    needed = np.concatenate([[begin, end], _inside(fix_time, begin, end), _inside(photo_time, begin, end)])
    nodes = _fill_gaps(_merge(needed, n_exact=needed.size), spacing)
    inner = imu.time[(imu.time > begin) & (imu.time < end)]
    edges = _merge(np.concatenate([nodes, inner]), n_exact=nodes.size)
    # Interval k of the log ends at time[k]; the part before time[0] does not exist.
    source = np.clip(np.searchsorted(imu.time, 0.5 * (edges[:-1] + edges[1:])), 1, imu.time.size - 1)
    return Timeline(
        time=nodes,
        fix=_rows_at(nodes, fix_time),
        photo=_rows_at(nodes, photo_time),
        start=np.searchsorted(edges, nodes).astype(np.int64),
        duration=np.diff(edges),
        angular_rate=np.ascontiguousarray(rate[source]),
        specific_force=np.ascontiguousarray(force[source]),
        noise_factor=np.ascontiguousarray(factor[source]),
    )


def _intervals(imu: ImuLog) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compensated rate and force, and noise factor of the interval that ends at each sample."""
    duration = np.diff(imu.time, prepend=imu.time[0] - imu.interval)
    rate, force = compensate_motion(
        duration, np.ascontiguousarray(imu.angular_rate), np.ascontiguousarray(imu.specific_force)
    )
    factor = np.ones(len(imu)) if imu.noise_factor is None else np.asarray(imu.noise_factor, dtype=np.float64)
    return rate, force, factor


def _inside(time: FloatArray, begin: float, end: float) -> FloatArray:
    return time[(time >= begin) & (time <= end)]


def _fill_gaps(time: FloatArray, spacing: float) -> FloatArray:
    """Divide every distance above the spacing into equal parts below it."""
    parts = np.ceil(np.diff(time) / spacing * (1.0 - 1e-6)).astype(np.int64).clip(1)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(time[:-1], time[1:], parts, strict=True)]
    return np.concatenate([*pieces, time[-1:]])


def _merge(time: FloatArray, n_exact: int) -> FloatArray:
    """Sort; of moments that coincide keep one, preferring the first `n_exact`, which keep their exact values."""
    order = np.lexsort((np.arange(time.size) >= n_exact, np.round(time / _SAME_MOMENT)))
    ordered = time[order]
    keep = np.concatenate([[True], np.diff(np.round(ordered / _SAME_MOMENT)) > 0])
    return np.asarray(ordered[keep], dtype=np.float64)


def _rows_at(nodes: FloatArray, time: FloatArray) -> IntArray:
    """Row of `time` that falls on each node, -1 where none does."""
    rows = np.full(nodes.size, -1, dtype=np.int64)
    if time.size == 0:
        return rows
    index = np.clip(np.searchsorted(nodes, time), 0, nodes.size - 1)
    before = np.maximum(index - 1, 0)
    index = np.where(np.abs(nodes[before] - time) < np.abs(nodes[index] - time), before, index)
    is_near = np.abs(nodes[index] - time) <= 1.5 * _SAME_MOMENT
    rows[index[is_near]] = np.flatnonzero(is_near)
    return rows
