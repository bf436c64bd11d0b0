"""
Survey flights with known truth: path, inertial and GPS logs.

The path is a lawn-mower over the origin: straight strips, coordinated turns between them, gusts that shake the
attitude, a steady wind that makes the nose depart from the course. Everything is a smooth function of time, so truth
can be asked at any moment. Inertial samples are true integrals of angular rate and specific force over each interval,
summed from steps five times as short: what a strapdown algorithm must undo, coning and sculling included.

Frames as in `changedetect.navigation`: local east-north-up (ENU), body forward-right-down (FRD).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from changedetect.navigation.alignment import ENU_FROM_NED
from changedetect.navigation.camera import CameraMount
from changedetect.navigation.flight import Flight, GpsLog, ImuLog, ImuNoise, PhotoList
from changedetect.navigation.frame import EarthModel, LocalFrame
from changedetect.typing import FloatArray

__all__ = ["FlightPlan", "GpsErrors", "SimulatedFlight", "TruePath", "simulate_flight"]

_GRAVITY = 9.80665
#: Steps of the path, s, and of the inertial integrals within one sample.
_STEP = 2e-3
_STEPS_PER_SAMPLE = 5


@dataclass(frozen=True)
class FlightPlan:
    """
    Lawn-mower survey about the origin.

    Parameters
    ----------
    n_strips : int
    strip_length, strip_spacing : float, m
        The spacing is less than twice the radius of the turns.
    height : float, m
        Above the origin.
    speed : float, m/s
        Over ground.
    heading_deg : float, degrees
        Course of the first strip, from north to east.
    bank_deg : float, degrees
        In turns.
    wind : tuple of 2 floats, m/s
        East and north; the nose turns into it.
    photo_interval : float, s
    roll_time : float, s
        To enter or leave a turn.
    """

    n_strips: int = 6
    strip_length: float = 400.0
    strip_spacing: float = 60.0
    height: float = 100.0
    speed: float = 30.0
    heading_deg: float = 90.0
    bank_deg: float = 35.0
    wind: tuple[float, float] = (2.0, -3.0)
    photo_interval: float = 4.0 / 15.0
    roll_time: float = 2.0


@dataclass(frozen=True)
class GpsErrors:
    """
    How a GPS receiver errs.

    Parameters
    ----------
    rate : float, Hz
    horizontal_std, vertical_std : float, m
        White noise of a fix.
    offset_std : float, m
        Of an offset on every axis that lasts the whole flight.
    velocity_std : float, m/s, optional
        None: the receiver gives no velocity.
    latency : float, s
        How long after the moment it describes a fix is stamped.
    outages : tuple of (begin, end), s
        No fixes there.
    outlier_share, outlier_size : float
        Share of the fixes that are off by an error of that standard deviation (m) on every axis.
    """

    rate: float = 5.0
    horizontal_std: float = 2.0
    vertical_std: float = 2.0
    offset_std: float = 0.0
    velocity_std: float | None = None
    latency: float = 0.0
    outages: tuple[tuple[float, float], ...] = ()
    outlier_share: float = 0.0
    outlier_size: float = 50.0


@dataclass(frozen=True)
class TruePath:
    """
    True motion of the inertial sensor, at any moment of the flight.

    Parameters
    ----------
    begin, end : float, s
    strips : tuple of (begin, end), s
        When the aircraft flies straight over the survey.
    """

    begin: float
    end: float
    strips: tuple[tuple[float, float], ...]
    _motion: CubicHermiteSpline = field(repr=False)
    _course: CubicHermiteSpline = field(repr=False)
    _plan: FlightPlan = field(repr=False)
    _gusts: FloatArray = field(repr=False)

    def position(self, time: FloatArray) -> FloatArray:
        """ENU, m, shape (n, 3)."""
        return np.asarray(self._motion(time), dtype=np.float64)

    def velocity(self, time: FloatArray) -> FloatArray:
        """ENU, m/s, shape (n, 3)."""
        course = self._course(time)
        climb = _gust(self._gusts[3], time, 1)
        return np.column_stack([self._plan.speed * np.sin(course), self._plan.speed * np.cos(course), climb])

    def rotation(self, time: FloatArray) -> FloatArray:
        """Body (FRD) to ENU, shape (n, 3, 3)."""
        return np.asarray(ENU_FROM_NED @ self._ned(time).as_matrix(), dtype=np.float64)

    def _ned(self, time: FloatArray) -> Rotation:
        course, turning = self._course(time), self._course(time, 1)
        east, north = self._plan.wind
        across = east * np.cos(course) - north * np.sin(course)  # wind to the right of the course
        yaw = course - np.arcsin(np.clip(across / self._plan.speed, -0.9, 0.9)) + _gust(self._gusts[0], time)
        pitch = math.radians(3.0) + _gust(self._gusts[1], time)
        roll = np.arctan(self._plan.speed * turning / _GRAVITY) + _gust(self._gusts[2], time)
        return Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))


@dataclass(frozen=True)
class SimulatedFlight:
    """
    Logs of a flight and the truth behind them.

    Parameters
    ----------
    flight : Flight
        Without initial state: navigation has to align itself.
    path : TruePath
    gyro_bias, accel_bias : array, shape (n, 3), FRD, rad/s and m/s2
        At `flight.imu.time`.
    gps_offset : array, shape (3,), ENU, m
    """

    flight: Flight
    path: TruePath
    gyro_bias: FloatArray
    accel_bias: FloatArray
    gps_offset: FloatArray

    def error_state(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, rotation: FloatArray
    ) -> FloatArray:
        """
        Nine errors (true less estimate) of a trajectory.

        Parameters
        ----------
        time : array, shape (m,), s
        position, velocity : array, shape (m, 3), ENU
        rotation : array, shape (m, 3, 3)
            Body to ENU.

        Returns
        -------
        error : array, shape (m, 9)
            Position (m), velocity (m/s), rotation vector in ENU (rad).
        """
        turn = Rotation.from_matrix(self.path.rotation(time) @ rotation.transpose(0, 2, 1)).as_rotvec()
        return np.hstack([self.path.position(time) - position, self.path.velocity(time) - velocity, turn])


def simulate_flight(
    plan: FlightPlan | None = None,
    imu_noise: ImuNoise | None = None,
    gps: GpsErrors | None = None,
    *,
    seed: int = 0,
    imu_rate: float = 100.0,
    origin: LocalFrame | None = None,
    earth: EarthModel | None = None,
    mount: CameraMount | None = None,
) -> SimulatedFlight:
    """
    Fly a plan once.

    Parameters
    ----------
    plan : FlightPlan, optional
    imu_noise : ImuNoise, optional
        Low-cost by default.
    gps : GpsErrors, optional
    seed : int
        Of gusts, biases and noise.
    imu_rate : float, Hz
    origin : LocalFrame, optional
    earth : EarthModel, optional
        Flat and at rest by default.
    mount : CameraMount, optional
        By default a camera that looks down and an antenna 0.4 m behind and 0.25 m above the inertial sensor.

    Returns
    -------
    simulated : SimulatedFlight

    Examples
    --------
    >>> flight = simulate_flight(FlightPlan(n_strips=1, strip_length=120.0), seed=1).flight
    >>> len(flight.gps) > 50, len(flight.photos) > 10
    (True, True)
    """
    plan, imu_noise, gps = plan or FlightPlan(), imu_noise or ImuNoise(), gps or GpsErrors()
    origin = origin or LocalFrame(-33.89, 151.19, 40.0)
    earth = earth or EarthModel(_GRAVITY)
    mount = mount or _down_looking()
    rng = np.random.default_rng(seed)
    path = _fly(plan, rng)
    clean = _true_imu(path, imu_rate, earth)
    imu, gyro_bias, accel_bias = _with_imu_errors(clean, imu_noise, rng)
    log, offset = _observe_gps(path, gps, mount, rng)
    flight = Flight(
        imu=imu,
        gps=log,
        origin=origin,
        earth=earth,
        imu_noise=imu_noise,
        mount=mount,
        photos=_photograph(path, plan.photo_interval),
        label=f"simulated flight {seed}",
        nominal_height=plan.height,
    )
    return SimulatedFlight(flight, path, gyro_bias, accel_bias, offset)


def _down_looking() -> CameraMount:
    """Top of the image forward, camera axis down, lever arms of a small aircraft."""
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return CameraMount(rotation, np.array([0.15, 0.02, 0.1]), np.array([-0.4, 0.0, -0.25]))


def _turns(plan: FlightPlan) -> tuple[list[tuple[float, float]], list[tuple[float, float]], float]:
    """
    Turns as (begin, signed angle), strips as (begin, end), and the end of the flight.

    Between strips the aircraft swings out by an angle a and back by 180 degrees + a, which carries it across by
    2 R cos a - V T sin a, the second term from the time T it takes to roll from one bank into the other, and beyond
    the end of the strip by 2 R sin a + V T cos a, which it flies back before the next strip. Before the first strip
    comes half a circle, so that the inertial errors are observable by then.
    """
    diameter = 2.0 * plan.speed**2 / (_GRAVITY * math.tan(math.radians(plan.bank_deg)))
    rolling = plan.speed * plan.roll_time
    swing = math.acos(min(plan.strip_spacing / math.hypot(diameter, rolling), 1.0)) - math.atan2(rolling, diameter)
    turns: list[tuple[float, float]] = []
    strips: list[tuple[float, float]] = []
    time = 6.0

    def add(angle: float) -> None:
        nonlocal time
        turns.append((time, angle))
        time += _turn_duration(plan, angle)

    add(math.pi)
    for strip in range(plan.n_strips):
        if strip:
            side = 1.0 if strip % 2 else -1.0
            add(-side * swing)
            add(side * (math.pi + swing))
            time += (diameter * math.sin(swing) + rolling * math.cos(swing)) / plan.speed
        strips.append((time + 1.0, time + 1.0 + plan.strip_length / plan.speed))
        time = strips[-1][1] + 1.0
    add(math.pi / 2)
    return turns, strips, time + 2.0


def _turn_duration(plan: FlightPlan, angle: float) -> float:
    rate = _GRAVITY * math.tan(math.radians(plan.bank_deg)) / plan.speed
    return abs(angle) / rate + plan.roll_time


def _fly(plan: FlightPlan, rng: np.random.Generator) -> TruePath:
    """Integrate course and position on a fine grid; cubic Hermite pieces between are exact to nanometres."""
    turns, strips, end = _turns(plan)
    time = np.arange(0.0, end + _STEP / 2, _STEP)
    rate = np.zeros_like(time)
    for begin, angle in turns:
        rate += _turning(plan, time - begin, angle)
    course = math.radians(plan.heading_deg) - math.pi + cumulative_simpson(rate, x=time, initial=0.0)
    attitude = [_draw_gust(rng, std, 0.5) for std in np.radians([1.0, 1.0, 1.5])]
    gusts = np.stack([*attitude, _draw_gust(rng, 0.7, 2.0)])  # about a metre per second squared up and down
    velocity = np.column_stack([plan.speed * np.sin(course), plan.speed * np.cos(course), _gust(gusts[3], time, 1)])
    position = cumulative_simpson(velocity, x=time, axis=0, initial=0.0)
    over = np.zeros(time.size, dtype=np.bool_)
    for begin, stop in strips:
        over |= (time >= begin) & (time <= stop)
    centre = 0.5 * (position[over].min(axis=0) + position[over].max(axis=0))
    position += np.array([0.0, 0.0, plan.height]) - centre * np.array([1.0, 1.0, 0.0])
    return TruePath(
        begin=0.0,
        end=float(time[-1]),
        strips=tuple(strips),
        _motion=CubicHermiteSpline(time, position, velocity),
        _course=CubicHermiteSpline(time, course, rate),
        _plan=plan,
        _gusts=gusts,
    )


def _turning(plan: FlightPlan, since: FloatArray, angle: float) -> FloatArray:
    """Rate of a turn that begins at 0, rad/s: cosine ramps of `roll_time` on both sides of a constant rate."""
    duration = _turn_duration(plan, angle)
    ramp = np.minimum(since, duration - since) / plan.roll_time
    shape = np.where(ramp <= 0, 0.0, 0.5 - 0.5 * np.cos(np.pi * np.clip(ramp, 0.0, 1.0)))
    return np.asarray(angle / (duration - plan.roll_time) * shape, dtype=np.float64)


def _draw_gust(rng: np.random.Generator, std: float, decay: float) -> FloatArray:
    """
    Eight sinusoids of 0.1 to 1.5 Hz, shape (3, 8): amplitude, angular frequency, phase.

    `std` is that of their sum; amplitudes fall with frequency to the power of `decay`.
    """
    frequency = np.exp(rng.uniform(math.log(0.1), math.log(1.5), 8))
    weight = frequency**-decay
    amplitude = std * math.sqrt(2.0) * weight / np.linalg.norm(weight)
    return np.stack([amplitude, 2.0 * np.pi * frequency, rng.uniform(0.0, 2.0 * np.pi, 8)])


def _gust(gust: FloatArray, time: FloatArray, derivative: int = 0) -> FloatArray:
    amplitude, frequency, phase = gust
    angle = np.multiply.outer(np.asarray(time, dtype=np.float64), frequency) + phase
    wave = np.sin(angle) if derivative == 0 else frequency * np.cos(angle)
    return np.asarray(wave @ amplitude, dtype=np.float64)


def _true_imu(path: TruePath, rate: float, earth: EarthModel) -> ImuLog:
    """Means of true angular rate and specific force over each sampling interval."""
    n = int((path.end - path.begin) * rate)
    fine = path.begin + np.arange(n * _STEPS_PER_SAMPLE + 1) / (rate * _STEPS_PER_SAMPLE)
    dt = 1.0 / (rate * _STEPS_PER_SAMPLE)
    rotation = Rotation.from_matrix(path.rotation(fine))
    spin = np.array(earth.rotation)
    # The sensor turns against inertial space: seen from there ENU has turned by spin * dt during a step.
    turn = (rotation[:-1].inv() * Rotation.from_rotvec(spin * dt) * rotation[1:]).as_rotvec()
    position, velocity = path.position(fine), path.velocity(fine)
    gravity = np.column_stack(
        [
            -earth.gradient * position[:, 0],
            -earth.gradient * position[:, 1],
            2.0 * earth.gradient * position[:, 2] - earth.gravity,
        ]
    )
    unfelt = gravity - 2.0 * np.cross(spin, velocity)
    felt = np.diff(velocity, axis=0) - 0.5 * dt * (unfelt[:-1] + unfelt[1:])
    middle = rotation[:-1] * Rotation.from_rotvec(0.5 * turn)
    push = middle.inv().apply(felt)
    shape = (n, _STEPS_PER_SAMPLE, 3)
    return ImuLog(
        time=fine[_STEPS_PER_SAMPLE::_STEPS_PER_SAMPLE],
        angular_rate=turn.reshape(shape).sum(axis=1) * rate,
        specific_force=push.reshape(shape).sum(axis=1) * rate,
    )


def _with_imu_errors(clean: ImuLog, noise: ImuNoise, rng: np.random.Generator) -> tuple[ImuLog, FloatArray, FloatArray]:
    """Add white noise, switch-on bias and its Gauss-Markov wandering."""
    n, dt = len(clean), clean.interval
    gyro_bias = rng.normal(0.0, noise.gyro_bias_std, 3) + _wander(noise.gyro_instability, n, dt, noise, rng)
    accel_bias = rng.normal(0.0, noise.accel_bias_std, 3) + _wander(noise.accel_instability, n, dt, noise, rng)
    imu = ImuLog(
        time=clean.time,
        angular_rate=clean.angular_rate + gyro_bias + rng.normal(0.0, noise.gyro_noise / math.sqrt(dt), (n, 3)),
        specific_force=clean.specific_force + accel_bias + rng.normal(0.0, noise.accel_noise / math.sqrt(dt), (n, 3)),
    )
    return imu, gyro_bias, accel_bias


def _wander(std: float, n: int, dt: float, noise: ImuNoise, rng: np.random.Generator) -> FloatArray:
    """First-order Gauss-Markov process, shape (n, 3)."""
    from scipy.signal import lfilter

    keep = math.exp(-dt / noise.correlation_time)
    drive = rng.normal(0.0, std * math.sqrt(1.0 - keep * keep), (n, 3))
    drive[0] = rng.normal(0.0, std, 3)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0), dtype=np.float64)


def _observe_gps(
    path: TruePath, gps: GpsErrors, mount: CameraMount, rng: np.random.Generator
) -> tuple[GpsLog, FloatArray]:
    """Fixes of the antenna, stamped late by the latency."""
    moment = np.arange(path.begin + 0.5 / gps.rate, path.end, 1.0 / gps.rate)
    n = moment.size
    std = np.array([gps.horizontal_std, gps.horizontal_std, gps.vertical_std])
    offset = rng.normal(0.0, gps.offset_std, 3)
    noise = rng.normal(0.0, 1.0, (n, 3)) * std
    wrong = rng.random(n) < gps.outlier_share
    noise[wrong] += rng.normal(0.0, gps.outlier_size, (int(wrong.sum()), 3))
    antenna = path.position(moment) + path.rotation(moment) @ mount.antenna_body
    velocity = None
    if gps.velocity_std is not None:
        h = 1e-3  # the antenna swings about the sensor: central difference of its true position
        ahead = path.position(moment + h) + path.rotation(moment + h) @ mount.antenna_body
        behind = path.position(moment - h) + path.rotation(moment - h) @ mount.antenna_body
        velocity = (ahead - behind) / (2.0 * h) + rng.normal(0.0, gps.velocity_std, (n, 3))
    keep = np.ones(n, dtype=np.bool_)
    for begin, end in gps.outages:
        keep &= (moment < begin) | (moment > end)
    log = GpsLog(
        time=moment[keep] + gps.latency,
        position=(antenna + offset + noise)[keep],
        position_std=np.broadcast_to(std, (n, 3))[keep].copy(),
        velocity=None if velocity is None else velocity[keep],
        velocity_std=None if gps.velocity_std is None else np.full((int(keep.sum()), 3), gps.velocity_std),
        offset_std=gps.offset_std,
    )
    return log, offset


def _photograph(path: TruePath, interval: float) -> PhotoList:
    """Photos along the strips, at moments that fall between inertial samples."""
    times = [np.arange(begin + 0.00317, end, interval) for begin, end in path.strips]
    strips = [str(k) for k, part in enumerate(times) for _ in part]
    names = tuple(f"photo_{k:04d}.jpg" for k in range(len(strips)))
    return PhotoList(names, np.concatenate(times), tuple(Path(name) for name in names), strip=tuple(strips))
