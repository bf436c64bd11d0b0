"""What is written of a flight is what the readers find."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from numpy.testing import assert_allclose
from simulated_flights import short_plan

from changedetect.io.camera_file import read_camera_file
from changedetect.io.flight import read_flight
from changedetect.io.flight_files import (
    write_camera_file,
    write_initial_state,
    write_logs,
    write_photos,
    write_pose_table,
    write_positions,
    write_site,
)
from changedetect.navigation.alignment import attitude_covariance, attitude_from_angles
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.navigation.flight import InitialState
from changedetect.pipeline.flight_inputs import flight_date
from changedetect.synthetic.flight_path import GpsErrors, simulate_flight

CAMERA = CameraIntrinsics(64, 48, 90.0, 91.0, 31.0, 24.5, -0.1, 0.02, 1e-4, -2e-4)
START = datetime(2024, 5, 1, 2)


@pytest.fixture(scope="module")
def flight():
    return replace(simulate_flight(short_plan(), gps=GpsErrors(offset_std=1.0), seed=6).flight, camera=CAMERA)


@pytest.fixture(scope="module")
def folder(flight, tmp_path_factory):
    path = tmp_path_factory.mktemp("written") / "flight"
    names = write_logs(path, flight)
    assert names == ("imu.csv", "gps.csv", "images.csv")
    write_photos(
        path / "images", flight.photos.names, (np.full((48, 64), k, np.uint8) for k in range(len(flight.photos)))
    )
    write_camera_file(path / "camera.yaml", CAMERA, flight.mount)
    write_site(path / "site.json", flight)
    write_positions(
        path / "geo.txt", flight.photos.names, np.tile([1.0, 2.0, 3.0], (len(flight.photos), 1)), flight.origin
    )
    angles = (1.0, -2.0, 75.0)
    state = InitialState(
        time=0.01,
        rotation=attitude_from_angles(*angles),
        velocity=np.array([28.0, 7.0, -0.5]),
        rotation_covariance=attitude_covariance(*angles, np.array([1.0, 1.0, 3.0])),
        velocity_std=0.5,
    )
    write_initial_state(path / "init.json", state, (1.0, 1.0, 3.0), START)
    return path


def test_logs_noise_place_and_photos_come_back(flight, folder):
    read = read_flight(folder)
    assert_allclose(read.imu.angular_rate, flight.imu.angular_rate, rtol=0, atol=1e-8)
    assert_allclose(read.imu.specific_force, flight.imu.specific_force, rtol=0, atol=1e-6)
    assert_allclose(read.gps.position, flight.gps.position, rtol=0, atol=1e-3)
    assert_allclose(read.gps.position_std, flight.gps.position_std, rtol=0, atol=1e-3)
    assert read.gps.offset_std == 1.0
    assert read.photos.names == flight.photos.names
    assert_allclose(read.photos.time, flight.photos.time, rtol=0, atol=1e-5)
    assert_allclose(read.photos.position, np.tile([1.0, 2.0, 3.0], (len(flight.photos), 1)), rtol=0, atol=2e-3)
    for name, value in vars(flight.imu_noise).items():
        assert_allclose(getattr(read.imu_noise, name), value, rtol=1e-9, atol=0)
    assert read.nominal_height == flight.nominal_height
    assert read.origin == flight.origin


def test_lens_and_mounting_come_back(flight, folder):
    camera, mount = read_camera_file(folder / "camera.yaml")
    assert camera == CAMERA
    assert_allclose(mount.antenna_body, flight.mount.antenna_body, rtol=0, atol=0)
    assert_allclose(mount.rotation_body_camera, flight.mount.rotation_body_camera, rtol=0, atol=0)


def test_the_first_state_and_the_date_come_back(folder, flight):
    initial = read_flight(folder).initial
    assert_allclose(initial.rotation, attitude_from_angles(1.0, -2.0, 75.0), rtol=0, atol=1e-12)
    assert_allclose(initial.velocity, [28.0, 7.0, -0.5], rtol=0, atol=1e-12)

    class Source:
        paths = (folder / "images" / flight.photos.names[0],)

    assert flight_date(folder, Source()) == START


def test_pose_tables_hold_quaternions_with_w_first(tmp_path):
    turn = attitude_from_angles(10.0, 20.0, 30.0)
    write_pose_table(tmp_path / "p.csv", ["a.jpg"], np.array([1.5]), np.array([[1.0, 2.0, 3.0]]), turn[None])
    header, row = (tmp_path / "p.csv").read_text().split()
    assert header == "image,time_s,x,y,z,qw,qx,qy,qz"
    w, x, y, z = (float(v) for v in row.split(",")[5:])
    assert_allclose(turn[0, 0], 1 - 2 * (y * y + z * z), rtol=0, atol=1e-9)
    assert_allclose(w * w + x * x + y * y + z * z, 1.0, rtol=0, atol=1e-9)
