"""The camera's clock from how the pictures turn."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_flights import short_plan

from changedetect.navigation.photo_clock import clock_from_attitudes
from changedetect.navigation.solution import navigate
from changedetect.synthetic.flight_path import simulate_flight


@pytest.fixture(scope="module")
def flown():
    simulated = simulate_flight(short_plan(), seed=3)
    return simulated, navigate(simulated.flight).smoothed


def attitudes(simulated, offset, rng, noise_deg=0.02, boresight_deg=(0.3, -0.2, 0.4)):
    """What adjusted pictures show of photos listed `offset` seconds early."""
    body = simulated.path.rotation(simulated.flight.photos.time + offset)
    camera = body @ simulated.flight.mount.rotation_body_camera
    off = Rotation.from_rotvec(np.radians(boresight_deg)) * Rotation.from_rotvec(
        np.radians(noise_deg) * rng.standard_normal((len(camera), 3))
    )
    return (Rotation.from_matrix(camera) * off).as_matrix()


@pytest.mark.parametrize("offset", [-1.5, -0.3, 0.08, 0.6])
def test_the_offset_is_found_whatever_the_mounting(flown, offset):
    simulated, trajectory = flown
    time = simulated.flight.photos.time
    found = clock_from_attitudes(
        time, attitudes(simulated, offset, np.random.default_rng(0)), trajectory, simulated.flight.mount
    )
    assert abs(found.seconds - offset) < 0.03
    assert found.explains(0.4)


def test_a_camera_in_time_is_left_alone(flown):
    simulated, trajectory = flown
    rotation = attitudes(simulated, 0.0, np.random.default_rng(1))
    found = clock_from_attitudes(simulated.flight.photos.time, rotation, trajectory, simulated.flight.mount)
    assert abs(found.seconds) <= 0.02
    assert not found.explains(0.4)


def test_few_photos_say_nothing(flown):
    simulated, trajectory = flown
    rotation = attitudes(simulated, 0.0, np.random.default_rng(2))
    time = simulated.flight.photos.time
    assert clock_from_attitudes(time[:4], rotation[:4], trajectory, simulated.flight.mount) is None
