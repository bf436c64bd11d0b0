"""Simulated flights: the path is consistent with itself and its inertial log with the path."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from simulated_flights import short_plan

from changedetect.kernels.navigation import compensate_motion, propagate
from changedetect.navigation.alignment import attitude_to_angles
from changedetect.navigation.flight import ImuNoise
from changedetect.navigation.frame import EarthModel, LocalFrame
from changedetect.synthetic.flight_path import FlightPlan, GpsErrors, simulate_flight

NO_NOISE = ImuNoise(*[1e-14] * 6)


@pytest.fixture(scope="module")
def clean():
    frame = LocalFrame(60.0, 10.0, 100.0)
    return simulate_flight(short_plan(), NO_NOISE, GpsErrors(), seed=1, origin=frame, earth=EarthModel.at(frame))


def test_velocity_is_the_derivative_of_position(clean) -> None:
    t = np.linspace(5.0, clean.path.end - 5.0, 300)
    h = 1e-3
    difference = (clean.path.position(t + h) - clean.path.position(t - h)) / (2 * h)
    assert_allclose(clean.path.velocity(t), difference, rtol=0, atol=1e-4)
    assert_allclose(np.hypot(*clean.path.velocity(t)[:, :2].T), 30.0, rtol=1e-9, atol=0)


def test_strips_are_straight_level_antiparallel_and_over_the_origin(clean) -> None:
    courses, places = [], []
    for begin, end in clean.path.strips:
        t = np.linspace(begin, end, 50)
        velocity = clean.path.velocity(t)
        courses.append(np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])))
        places.append(clean.path.position(t))
        assert np.ptp(courses[-1]) < 1e-6
        angles = attitude_to_angles(clean.path.rotation(t))
        assert np.abs(angles[:, 0]).max() < 8.0
    assert_allclose(abs(courses[0][0] - courses[1][0]) % 360, 180.0, rtol=0, atol=1e-6)
    centre = np.concatenate(places).mean(axis=0)
    assert np.all(np.abs(centre[:2]) < 60.0)
    assert_allclose(centre[2], 100.0, rtol=0, atol=2.0)


@pytest.mark.parametrize("spacing", [20.0, 60.0, 150.0])
def test_strips_are_as_far_apart_as_planned(spacing: float) -> None:
    plan = FlightPlan(n_strips=3, strip_length=200.0, strip_spacing=spacing, heading_deg=0.0)
    path = simulate_flight(plan, NO_NOISE, seed=1).path
    across = [path.position(np.linspace(*strip, 20))[:, 0].mean() for strip in path.strips]
    assert_allclose(np.abs(np.diff(across)), spacing, rtol=0, atol=0.1 * spacing + 1.0)
    assert_allclose(abs(across[2] - across[0]), 2 * spacing, rtol=0, atol=0.2 * spacing + 2.0)
    along = np.array([np.sort(path.position(np.array(strip))[:, 1]) for strip in path.strips])
    assert_allclose(along, np.tile([-100.0, 100.0], (3, 1)), rtol=0, atol=5.0)


def test_turns_are_banked_as_their_rate_demands(clean) -> None:
    t = np.linspace(8.0, clean.path.strips[0][0] - 4.0, 50)  # the first turn, past its entry
    rate = np.gradient(np.unwrap(np.arctan2(*clean.path.velocity(t)[:, :2].T)), t)
    roll = attitude_to_angles(clean.path.rotation(t))[:, 0]
    assert_allclose(np.mean(roll), np.mean(np.degrees(np.arctan(30.0 * rate / 9.80665))), rtol=0, atol=2.0)


def test_integrating_the_clean_log_gives_the_path_back(clean) -> None:
    """Dead reckoning over the whole flight on a rotating, curved Earth: millimetres and microradians."""
    imu, path, earth = clean.flight.imu, clean.path, clean.flight.earth
    rate, force = compensate_motion(np.full(len(imu), 0.01), imu.angular_rate, imu.specific_force)
    t0 = np.array([0.0])
    state = np.concatenate([path.position(t0)[0], path.velocity(t0)[0], path.rotation(t0)[0].ravel(), np.zeros(6)])
    end, _, _ = propagate(
        state,
        np.full(len(imu), 0.01),
        rate,
        force,
        np.ones(len(imu)),
        NO_NOISE.densities,
        np.array([earth.gradient, earth.gravity]),
        np.array(earth.rotation),
    )
    t1 = imu.time[-1:]
    assert_allclose(end[:3], path.position(t1)[0], rtol=0, atol=0.02)
    assert_allclose(end[3:6], path.velocity(t1)[0], rtol=0, atol=5e-4)
    turn = Rotation.from_matrix(path.rotation(t1)[0] @ end[6:15].reshape(3, 3).T).magnitude()
    assert turn < 5e-6


def test_noise_has_the_stated_size() -> None:
    noise = ImuNoise()
    a = simulate_flight(short_plan(), noise, seed=3)
    b = simulate_flight(short_plan(), NO_NOISE, seed=3)
    white = a.flight.imu.angular_rate - a.gyro_bias - b.flight.imu.angular_rate + b.gyro_bias
    assert_allclose(white.std(), noise.gyro_noise / np.sqrt(0.01), rtol=0.03, atol=0)
    biases = np.array(
        [simulate_flight(FlightPlan(n_strips=1, strip_length=60.0), noise, seed=s).gyro_bias[0] for s in range(6)]
    )
    assert 0.5 < biases.std() / noise.gyro_bias_std < 1.5


def test_a_delayed_outlying_and_interrupted_receiver() -> None:
    gps = GpsErrors(latency=0.1, outages=((20.0, 30.0),), outlier_share=0.1, velocity_std=0.1, offset_std=2.0)
    simulated = simulate_flight(short_plan(), gps=gps, seed=5)
    log, path = simulated.flight.gps, simulated.path
    assert not np.any((log.time > 20.1) & (log.time < 30.1))
    moment = log.time - 0.1
    antenna = path.position(moment) + path.rotation(moment) @ simulated.flight.mount.antenna_body
    residual = log.position - antenna - simulated.gps_offset
    is_outlier = np.linalg.norm(residual, axis=1) > 12
    assert 0.04 < is_outlier.mean() < 0.16
    assert_allclose(residual[~is_outlier].std(), 2.0, rtol=0.1, atol=0)
    assert_allclose((log.velocity - path.velocity(moment)).std(), 0.1, rtol=0.4, atol=0.05)


def test_the_same_seed_gives_the_same_flight() -> None:
    a, b = (simulate_flight(FlightPlan(n_strips=1, strip_length=90.0), seed=8) for _ in range(2))
    assert np.array_equal(a.flight.imu.specific_force, b.flight.imu.specific_force)
    assert np.array_equal(a.flight.gps.position, b.flight.gps.position)
    c = simulate_flight(FlightPlan(n_strips=1, strip_length=90.0), seed=9)
    assert not np.array_equal(a.flight.gps.position, c.flight.gps.position)


def test_photos_lie_on_the_strips_with_their_labels(clean) -> None:
    photos = clean.flight.photos
    for label, (begin, end) in zip(("0", "1"), clean.path.strips, strict=True):
        times = photos.time[[s == label for s in photos.strip]]
        assert times.size == np.ceil((end - begin - 0.00317) / (4 / 15))
        assert np.all((times > begin) & (times < end))
