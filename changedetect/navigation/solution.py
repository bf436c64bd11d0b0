"""
Navigation solution of a flight: extended Kalman filter, then Rauch-Tung-Striebel smoother.

The filter is causal, as on board: its positions jump at every fix by decimetres, which ruins heights triangulated from
neighbouring photos. The smoother uses the whole flight for every moment and leaves centimetres from photo to photo.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from changedetect.errors import InputDataError
from changedetect.kernels.navigation import N_ERROR, N_STATE
from changedetect.kernels.navigation_filter import filter_forward, smooth_backward
from changedetect.navigation.alignment import align, motion_at
from changedetect.navigation.clock import ClockOffset, estimate_clock_offset
from changedetect.navigation.flight import Flight, InitialState, PhotoList
from changedetect.navigation.latency import LatencyEstimate, estimate_latency
from changedetect.navigation.timeline import Timeline, build_timeline
from changedetect.typing import BoolArray, FloatArray

__all__ = ["NavigationSettings", "NavigationSolution", "Trajectory", "navigate", "run_filter"]

logger = logging.getLogger(__name__)

#: Share of refused fixes above which the logs are held to contradict each other.
_MAX_REFUSED = 0.35


@dataclass(frozen=True)
class NavigationSettings:
    """
    Choices of the filter.

    Parameters
    ----------
    gate_confidence : float
        A fix is refused when its normalised innovation squared exceeds this quantile of chi-square with 3 degrees of
        freedom.
    gps_latency : float, s, optional
        How long after the moment they describe fixes are stamped. None: estimated from the flight.
    node_spacing : float, s
        Largest distance between moments of the trajectory.
    n_iterations : int
        Times the smoother is repeated about its own result: where the start is uncertain by degrees, linearising about
        the filter's first states is not good enough.

    Raises
    ------
    ValueError
        A number is out of range.
    """

    gate_confidence: float = 0.9999
    gps_latency: float | None = None
    node_spacing: float = 0.2
    n_iterations: int = 1

    def __post_init__(self) -> None:
        if not 0.5 <= self.gate_confidence < 1.0 or not self.node_spacing > 0 or self.n_iterations < 0:
            msg = (
                f"gate_confidence {self.gate_confidence} must lie in [0.5, 1), node_spacing {self.node_spacing} be "
                f"positive and n_iterations {self.n_iterations} not be negative."
            )
            raise ValueError(msg)

    @property
    def gate(self) -> float:
        """Largest normalised innovation squared of three components."""
        return float(chi2.ppf(self.gate_confidence, 3))


@dataclass(frozen=True)
class Trajectory:
    """
    Motion of the inertial sensor.

    Parameters
    ----------
    time : array, shape (m,), s
    position, velocity : array, shape (m, 3), ENU, m and m/s
    rotation : array, shape (m, 3, 3)
        Body (FRD) to ENU.
    gyro_bias, accel_bias : array, shape (m, 3), FRD, rad/s and m/s2
    covariance : array, shape (m, 15, 15)
        Of [position, velocity, rotation vector (ENU), gyro bias, accelerometer bias] errors.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    rotation: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray
    covariance: FloatArray

    @classmethod
    def from_states(cls, time: FloatArray, states: FloatArray, covariance: FloatArray) -> Trajectory:
        """Unpack the 21 numbers a node of the kernels."""
        return cls(
            time=time,
            position=states[:, 0:3],
            velocity=states[:, 3:6],
            rotation=states[:, 6:15].reshape(-1, 3, 3),
            gyro_bias=states[:, 15:18],
            accel_bias=states[:, 18:21],
            covariance=covariance,
        )

    def __len__(self) -> int:
        return int(self.time.size)


@dataclass(frozen=True)
class NavigationSolution:
    """
    Both solutions of a flight and how well the logs agree.

    Parameters
    ----------
    timeline : Timeline
    filtered : Trajectory
        Causal: at each node after its measurement.
    smoothed : Trajectory
        From the whole flight.
    gain : array, shape (m, 15, 15)
        Of the smoother; it holds the covariance between nodes.
    nis : array, shape (q, 2)
        Normalised innovation squared (3 degrees of freedom) of each fix's position and velocity; NaN where none.
    is_used : array of bool, shape (q, 2)
        Passed the gate.
    latency : LatencyEstimate
    initial : InitialState
    photos : PhotoList, optional
        With times corrected by `camera_clock`.
    camera_clock : ClockOffset, optional
        None where the photos carry no positions, or too few to tell.
    """

    timeline: Timeline
    filtered: Trajectory
    smoothed: Trajectory
    gain: FloatArray
    nis: FloatArray
    is_used: BoolArray
    latency: LatencyEstimate
    initial: InitialState
    photos: PhotoList | None = None
    camera_clock: ClockOffset | None = None

    @property
    def n_refused(self) -> int:
        """Number of GPS positions the gate refused."""
        return int(np.count_nonzero(np.isfinite(self.nis[:, 0]) & ~self.is_used[:, 0]))

    @property
    def nis_per_dof(self) -> float:
        """Mean normalised innovation squared of used positions per degree of freedom; 1 where noise is as stated."""
        used = self.nis[self.is_used[:, 0], 0]
        return float(np.mean(used) / 3.0) if used.size else float("nan")


def navigate(flight: Flight, settings: NavigationSettings | None = None) -> NavigationSolution:
    """
    Filter and smooth a flight.

    Parameters
    ----------
    flight : Flight
    settings : NavigationSettings, optional

    Returns
    -------
    solution : NavigationSolution

    Raises
    ------
    InputDataError
        The logs do not overlap, contradict each other, or the flight cannot be aligned.
    """
    settings = settings or NavigationSettings()
    initial = align(flight)
    if settings.gps_latency is None:
        latency = estimate_latency(flight, lambda seconds: run_filter(flight, initial, settings, seconds).delay_step)
    else:
        latency = LatencyEstimate(settings.gps_latency, 0.0, False)
    solution = _solve(flight, initial, settings, latency)
    if flight.photos is None:
        return solution
    clock = estimate_clock_offset(flight.photos, solution.smoothed, flight.mount, flight.label)
    if clock is not None and clock.is_applied:
        moved = replace(flight, photos=replace(flight.photos, time=flight.photos.time + clock.seconds))
        solution = _solve(moved, initial, settings, latency)
    return replace(solution, camera_clock=clock)


def _solve(
    flight: Flight, initial: InitialState, settings: NavigationSettings, latency: LatencyEstimate
) -> NavigationSolution:
    """Filter and smooth with a known delay of the fixes, then smooth once more about the smoothed states."""
    run = run_filter(flight, initial, settings, latency.seconds)
    _check_agreement(flight, run)
    smoothed, P_smoothed, gain = _smooth(run, np.empty((0, N_STATE)))
    for _ in range(settings.n_iterations):
        reference = smoothed
        again = run_filter(flight, initial, settings, latency.seconds, reference)
        smoothed, P_smoothed, gain = _smooth(again, reference)
    time = run.timeline.time
    return NavigationSolution(
        timeline=run.timeline,
        filtered=Trajectory.from_states(time, run.filtered, run.P_filtered),
        smoothed=Trajectory.from_states(time, smoothed, P_smoothed),
        gain=gain,
        nis=run.nis,
        is_used=run.is_used,
        latency=latency,
        initial=initial,
        photos=flight.photos,
    )


def _smooth(run: FilterRun, reference: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return smooth_backward(run.predicted, run.filtered, run.P_predicted, run.P_filtered, run.transition, reference)


@dataclass(frozen=True)
class FilterRun:
    """What one pass of the filter leaves: see `filter_forward`."""

    timeline: Timeline
    predicted: FloatArray
    filtered: FloatArray
    P_predicted: FloatArray
    P_filtered: FloatArray
    transition: FloatArray
    nis: FloatArray
    is_used: BoolArray
    delay_sums: FloatArray

    @property
    def delay_step(self) -> tuple[float, float]:
        """What the GPS delay wants to be changed by, and its standard error, s."""
        information, score = self.delay_sums
        if not information > 0:
            return math.nan, math.inf
        return float(score / information), float(1.0 / math.sqrt(information))


def run_filter(
    flight: Flight,
    initial: InitialState,
    settings: NavigationSettings,
    latency: float,
    reference: FloatArray | None = None,
) -> FilterRun:
    """
    Run the filter once, with fixes taken to be `latency` seconds older than their stamps.

    Parameters
    ----------
    flight : Flight
    initial : InitialState
    settings : NavigationSettings
    latency : float, s
    reference : array, shape (m, 21), optional
        States of the same timeline about which the dynamics are linearised, instead of the filter's own.

    Returns
    -------
    run : FilterRun
    """
    gps, imu = flight.gps, flight.imu
    fix_time = gps.time - latency
    photo_time = flight.photos.time if flight.photos is not None else np.empty(0)
    begin = max(initial.time, imu.time[0])
    last = max(fix_time[-1], photo_time[-1] if photo_time.size else begin)
    timeline = build_timeline(imu, fix_time, photo_time, begin, min(imu.time[-1], last), settings.node_spacing)
    state, P = _first_state(flight, initial, begin, fix_time)
    nowhere = np.full_like(gps.position, np.nan)
    velocity = nowhere if gps.velocity is None else gps.velocity
    velocity_variance = nowhere if gps.velocity_std is None else gps.velocity_std**2
    earth = flight.earth
    results = filter_forward(
        state,
        P,
        timeline.start,
        timeline.duration,
        timeline.angular_rate,
        timeline.specific_force,
        timeline.noise_factor,
        timeline.fix,
        np.ascontiguousarray(gps.position),
        np.ascontiguousarray(gps.position_std**2),
        np.ascontiguousarray(velocity),
        np.ascontiguousarray(velocity_variance),
        np.ascontiguousarray(flight.mount.antenna_body, dtype=np.float64),
        settings.gate,
        flight.imu_noise.densities,
        np.array([earth.gradient, earth.gravity]),
        np.array(earth.rotation, dtype=np.float64),
        np.empty((0, N_STATE)) if reference is None else reference,
    )
    return FilterRun(timeline, *results)


def _first_state(
    flight: Flight, initial: InitialState, begin: float, fix_time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """
    Nominal state and covariance at the first node.

    Without a position of its own the start gets one from the fixes around it, with a standard deviation wide enough
    that counting them twice does not matter and narrow enough that the gate knows an outlier from the first fix on.
    """
    noise = flight.imu_noise
    rotation = np.asarray(initial.rotation, dtype=np.float64)
    position, position_std = initial.position, initial.position_std
    if position is None:
        motion = motion_at(replace(flight.gps, time=fix_time), begin)
        position = motion.position - rotation @ flight.mount.antenna_body
        position_std = 3.0 * motion.position_std + float(np.max(flight.gps.position_std))
    state = np.concatenate([position, initial.velocity, rotation.ravel(), initial.gyro_bias, np.zeros(3)])
    gyro_std = noise.gyro_bias_std if initial.gyro_bias_std is None else initial.gyro_bias_std
    P = np.zeros((N_ERROR, N_ERROR))
    P[0:3, 0:3] = np.eye(3) * (position_std if position_std is not None else 50.0) ** 2
    P[3:6, 3:6] = np.eye(3) * initial.velocity_std**2
    P[6:9, 6:9] = initial.rotation_covariance
    P[9:12, 9:12] = np.eye(3) * (gyro_std**2 + noise.gyro_instability**2)
    P[12:15, 12:15] = np.eye(3) * (noise.accel_bias_std**2 + noise.accel_instability**2)
    return state, P


def _check_agreement(flight: Flight, run: FilterRun) -> None:
    """Refuse logs that contradict each other; say so where some fixes were refused or the noise is not as stated."""
    measured = np.isfinite(run.nis[:, 0])
    refused = measured & ~run.is_used[:, 0]
    share = float(np.count_nonzero(refused)) / max(int(np.count_nonzero(measured)), 1)
    if not np.all(np.isfinite(run.filtered)) or share > _MAX_REFUSED:
        msg = (
            f"Inertial log and GPS of {flight.label} contradict each other: {100 * share:.0f} % of the fixes lie "
            "outside what the inertial sensor allows. Check that body axes are forward-right-down, that rates are "
            "rad/s and forces m/s2, that both clocks agree, and the noise stated for both sensors."
        )
        raise InputDataError(msg)
    if np.any(refused):
        times = flight.gps.time[refused]
        logger.warning(
            "%s: %d of %d GPS fixes refused as outliers, the first at %.3f s, the last at %.3f s",
            flight.label,
            times.size,
            np.count_nonzero(measured),
            times[0],
            times[-1],
        )
    ratio = float(np.mean(run.nis[run.is_used[:, 0], 0]) / 3.0)
    if not 0.5 < ratio < 2.0:
        logger.warning(
            "%s: GPS innovations are %.2f times what the stated noise explains (variance ratio); poses will be %s",
            flight.label,
            ratio,
            "over-confident" if ratio > 1 else "under-confident",
        )
