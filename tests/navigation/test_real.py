"""Flights that other people made: a survey by another simulator, and a real aircraft."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_flights import nees
from thor75 import read_thor75

from changedetect.io.flight import read_flight
from changedetect.navigation.alignment import attitude_from_angles, attitude_to_angles
from changedetect.navigation.photos import camera_poses
from changedetect.navigation.solution import navigate

DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))
pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)"),
]


@pytest.mark.parametrize("epoch", ["epoch1", "epoch2"])
@pytest.mark.parametrize("given", [True, False], ids=["initial state given", "aligned in motion"])
def test_poses_of_the_simulated_survey_agree_with_its_truth(epoch: str, given: bool) -> None:
    from dataclasses import replace

    flight = read_flight(DATA / "flight_sim" / epoch)
    if not given:
        flight = replace(flight, initial=None)
    with (DATA / "flight_sim" / "truth" / f"poses_{epoch}.csv").open() as stream:
        truth = list(csv.DictReader(stream))
    solution = navigate(flight)
    poses = camera_poses(flight, solution)
    assert poses.names == tuple(row["image"] for row in truth)
    assert not solution.camera_clock.is_applied
    assert solution.n_refused <= 2
    place = np.array([[float(row[c]) for c in "xyz"] for row in truth])
    # world to camera, scalar first: the camera's own quaternion is a second witness beside the body angles
    quaternion = np.array([[float(row[f"q{c}"]) for c in "xyzw"] for row in truth])
    angles = [[float(row[f"body_{c}_deg"]) for c in ("roll", "pitch", "yaw")] for row in truth]
    turned = np.stack([attitude_from_angles(*a) for a in angles]) @ flight.mount.rotation_body_camera
    as_written = Rotation.from_quat(quaternion).as_matrix()
    assert min(np.abs(as_written - turned).max(), np.abs(as_written.transpose(0, 2, 1) - turned).max()) < 1e-5
    shift = place - poses.position
    turn = Rotation.from_matrix(turned @ poses.rotation.transpose(0, 2, 1)).as_rotvec()
    assert np.all(shift.std(axis=0) < 0.35)
    assert np.all(np.degrees(np.sqrt(np.mean(turn**2, axis=0))) < [0.15, 0.15, 0.4])
    together = np.diff(poses.time) < 0.4
    change = np.diff(np.hstack([shift, turn]), axis=0)[together]
    assert np.all(np.sqrt(np.mean(change[:, :3] ** 2, axis=0)) < 0.03)
    assert np.all(np.degrees(np.sqrt(np.mean(change[:, 3:] ** 2, axis=0))) < 0.04)
    assert 0.4 < nees(change, poses.relative_covariance[together]) < 1.5
    assert nees(np.hstack([shift, turn]), poses.total_covariance) < 2.0


def test_a_real_flight_agrees_with_the_aircrafts_own_filter() -> None:
    flight, onboard = read_thor75(DATA / "ins_umn_thor75")
    solution = navigate(flight)
    assert solution.n_refused == 0
    assert 0.0 < solution.latency.seconds < 0.2
    fast = flight.gps.time[np.linalg.norm(flight.gps.velocity, axis=1) > 10.0]
    moments = solution.timeline.time
    rows = np.flatnonzero((moments > fast[0] + 10.0) & (moments < fast[-1] - 10.0))
    near = np.searchsorted(onboard.time, moments[rows])
    for path in (solution.filtered, solution.smoothed):
        velocity = path.velocity[rows] - onboard.velocity[near]
        assert np.all(np.sqrt(np.mean(velocity**2, axis=0)) < 0.6)
        angle = attitude_to_angles(path.rotation[rows]) - attitude_to_angles(onboard.rotation[near])
        angle = (angle + 180.0) % 360.0 - 180.0
        assert np.all(np.sqrt(np.mean(angle**2, axis=0)) < [2.0, 1.5, 4.0])
