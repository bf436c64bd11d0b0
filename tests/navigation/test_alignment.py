"""Attitude angles and the merging of logs into one timeline."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from changedetect.navigation.alignment import (
    attitude_covariance,
    attitude_from_angles,
    attitude_to_angles,
    motion_at,
)
from changedetect.navigation.flight import GpsLog, ImuLog, ImuNoise, PhotoList
from changedetect.navigation.timeline import build_timeline


def test_nose_north_wings_level() -> None:
    rotation = attitude_from_angles(0.0, 0.0, 0.0)
    assert_allclose(rotation @ [1, 0, 0], [0, 1, 0], rtol=0, atol=1e-12)  # nose north
    assert_allclose(rotation @ [0, 1, 0], [1, 0, 0], rtol=0, atol=1e-12)  # right wing east
    assert_allclose(rotation @ [0, 0, 1], [0, 0, -1], rtol=0, atol=1e-12)  # down


def test_positive_pitch_lifts_the_nose_and_positive_roll_drops_the_right_wing() -> None:
    assert (attitude_from_angles(0.0, 10.0, 45.0) @ [1, 0, 0])[2] > 0.17
    assert (attitude_from_angles(10.0, 0.0, 45.0) @ [0, 1, 0])[2] < -0.17


@given(st.floats(-179, 179), st.floats(-85, 85), st.floats(-179, 179))
def test_angles_come_back(roll: float, pitch: float, yaw: float) -> None:
    assert_allclose(attitude_to_angles(attitude_from_angles(roll, pitch, yaw)), [roll, pitch, yaw], rtol=0, atol=1e-8)


def test_attitude_covariance_is_that_of_perturbed_angles() -> None:
    angles, std = np.array([20.0, -10.0, 130.0]), np.array([0.5, 0.3, 1.0])
    rng = np.random.default_rng(1)
    base = attitude_from_angles(*angles)
    draws = [attitude_from_angles(*(angles + rng.normal(0, std))) @ base.T for _ in range(4000)]
    sample = np.cov(Rotation.from_matrix(draws).as_rotvec().T)
    stated = attitude_covariance(*angles, std)
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert_allclose(sample / scale, stated / scale, rtol=0, atol=0.06)


def parabola(n: int = 21, noise: float = 0.0) -> GpsLog:
    t = np.linspace(-2.0, 2.0, n)
    rng = np.random.default_rng(2)
    position = np.array([5.0, -3.0, 100.0]) + np.outer(t, [20.0, 10.0, 1.0]) + np.outer(t**2 / 2, [1.0, -2.0, 0.0])
    return GpsLog(t, position + rng.normal(0, noise, (n, 3)), np.full((n, 3), 2.0))


def test_motion_of_a_parabola_is_exact() -> None:
    motion = motion_at(parabola(), 0.0)
    assert_allclose(motion.velocity, [20, 10, 1], rtol=0, atol=1e-9)
    assert_allclose(motion.acceleration, [1, -2, 0], rtol=0, atol=1e-9)
    assert_allclose(motion.velocity_std, 2.0 / np.sqrt(np.sum(np.linspace(-2, 2, 21) ** 2)), rtol=1e-6, atol=0)


def test_two_outliers_in_twenty_fixes_do_not_move_the_start() -> None:
    gps = parabola(noise=1.0)
    gps.position[[3, 12]] += 80.0
    motion = motion_at(gps, 0.0)
    assert np.linalg.norm(motion.velocity - [20, 10, 1]) < 3.0
    assert np.linalg.norm(motion.position - [5, -3, 100]) < 4.0


@pytest.fixture
def imu() -> ImuLog:
    t = np.arange(1, 201) * 0.01
    wave = np.column_stack([np.sin(7 * t), np.cos(5 * t), 0.3 * t])
    return ImuLog(t, wave, 10 * wave + np.array([0, 0, -9.8]))


def test_every_moment_gets_a_node_at_its_exact_time(imu: ImuLog) -> None:
    fixes, photos = np.array([0.5, 0.7, 0.9]), np.array([0.61234567, 0.9])
    timeline = build_timeline(imu, fixes, photos, 0.105, 1.5, spacing=0.25)
    assert np.all(np.isin(np.concatenate([fixes, photos, [0.105, 1.5]]), timeline.time))
    assert np.array_equal(timeline.time[timeline.fix >= 0], fixes)
    assert np.array_equal(timeline.time[timeline.photo >= 0], photos)
    assert np.diff(timeline.time).max() <= 0.25 + 1e-9
    assert np.diff(timeline.time).min() > 1e-6


def test_intervals_add_up_to_the_time_between_nodes_and_carry_their_samples(imu: ImuLog) -> None:
    timeline = build_timeline(imu, np.array([0.5, 0.703]), np.array([0.6123]), 0.105, 1.5)
    sums = np.add.reduceat(timeline.duration, timeline.start[:-1])
    assert_allclose(sums, np.diff(timeline.time), rtol=0, atol=1e-12)
    assert timeline.start[-1] == timeline.duration.size
    ends = 0.105 + np.cumsum(timeline.duration)
    source = np.searchsorted(imu.time, ends - 1e-9)
    assert np.abs(timeline.angular_rate - imu.angular_rate[source]).max() < 0.02  # coning is small here


def test_moments_outside_the_span_get_no_node(imu: ImuLog) -> None:
    timeline = build_timeline(imu, np.array([0.01, 1.9]), np.array([0.02]), 0.105, 1.5)
    assert np.all(timeline.fix == -1)
    assert np.all(timeline.photo == -1)
    with pytest.raises(ValueError, match=r"covers 0\.010 to 2\.000 s"):
        build_timeline(imu, np.empty(0), np.empty(0), 0.0, 1.0)


def test_logs_refuse_what_cannot_be() -> None:
    t, three = np.array([0.0, 1.0]), np.ones((2, 3))
    with pytest.raises(ValueError, match="does not increase"):
        ImuLog(t[::-1], three, three)
    with pytest.raises(ValueError, match="angular_rate"):
        ImuLog(t, three[:1], three)
    with pytest.raises(ValueError, match="not positive"):
        GpsLog(t, three, 0 * three)
    with pytest.raises(ValueError, match="go together"):
        GpsLog(t, three, three, velocity=three)
    with pytest.raises(ValueError, match="listed twice"):
        PhotoList(("a.jpg", "a.jpg"), t, (None, None))
    with pytest.raises(ValueError, match="gyro_noise"):
        ImuNoise(gyro_noise=0.0)
