"""Filter and smoother on simulated flights: consistency, outages, outliers, delays, clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from simulated_flights import nees, short_plan

from changedetect.errors import InputDataError
from changedetect.navigation.alignment import align, attitude_to_angles
from changedetect.navigation.clock import estimate_clock_offset
from changedetect.navigation.flight import ImuNoise
from changedetect.navigation.frame import EarthModel, LocalFrame
from changedetect.navigation.photos import camera_poses
from changedetect.navigation.solution import NavigationSettings, navigate
from changedetect.synthetic.flight_path import FlightPlan, GpsErrors, simulate_flight

KNOWN_DELAY = NavigationSettings(gps_latency=0.0)


@pytest.fixture(scope="module")
def survey():
    """Four strips with the low-cost sensor, solved."""
    simulated = simulate_flight(FlightPlan(n_strips=4, strip_length=300.0), gps=GpsErrors(offset_std=1.0), seed=11)
    return simulated, navigate(simulated.flight)


def errors_of(simulated, trajectory, rows=slice(None)):
    """Nine errors at nodes, less the offset of the GPS that no filter can see."""
    error = simulated.error_state(
        trajectory.time[rows], trajectory.position[rows], trajectory.velocity[rows], trajectory.rotation[rows]
    )
    error[:, :3] += simulated.gps_offset
    return error


@pytest.mark.parametrize("noise", [ImuNoise(), ImuNoise.mid()], ids=["low", "mid"])
def test_errors_of_filter_and_smoother_are_as_large_as_they_say(noise: ImuNoise) -> None:
    """Normalised error squared per degree of freedom; the mean of few, correlated flights scatters by a quarter."""
    ratios = {"filtered": [], "smoothed": []}
    for seed in range(4):
        simulated = simulate_flight(short_plan(), noise, seed=seed)
        solution = navigate(simulated.flight, KNOWN_DELAY)
        rows = np.flatnonzero(solution.timeline.photo >= 0)
        for name, values in ratios.items():
            trajectory = getattr(solution, name)
            values.append(nees(errors_of(simulated, trajectory, rows), trajectory.covariance[rows][:, :9, :9]))
    assert 0.6 < np.mean(ratios["filtered"]) < 1.5
    assert 0.6 < np.mean(ratios["smoothed"]) < 1.5


def test_smoothed_poses_change_from_photo_to_photo_ten_times_less_than_filtered_ones(survey) -> None:
    simulated, solution = survey
    rows = np.flatnonzero(solution.timeline.photo >= 0)
    consecutive = np.diff(solution.timeline.time[rows]) < 0.4
    change = {
        name: np.sqrt(
            np.mean(np.diff(errors_of(simulated, getattr(solution, name), rows), axis=0)[consecutive] ** 2, axis=0)
        )
        for name in ("filtered", "smoothed")
    }
    assert np.all(change["smoothed"][:3] < 0.03)
    assert np.all(change["smoothed"][:3] < 0.15 * change["filtered"][:3])
    assert np.all(np.degrees(change["smoothed"][6:]) < 0.05)


def test_relative_covariance_of_consecutive_photos_describes_their_relative_error(survey) -> None:
    simulated, solution = survey
    poses = camera_poses(simulated.flight, solution)
    rows = np.flatnonzero(solution.timeline.photo >= 0)
    error = errors_of(simulated, solution.smoothed, rows)[:, [0, 1, 2, 6, 7, 8]]
    consecutive = np.diff(poses.time) < 0.4
    relative = np.diff(error, axis=0)[consecutive]
    assert 0.7 < nees(relative, poses.relative_covariance[consecutive]) < 1.4
    assert np.linalg.eigvalsh(poses.relative_covariance).min() > 0
    assert_allclose(poses.common_covariance[:3, :3], np.eye(3), rtol=1e-12, atol=0)


def test_camera_pose_is_the_sensors_moved_by_the_mount(survey) -> None:
    simulated, solution = survey
    poses = camera_poses(simulated.flight, solution)
    mount = simulated.flight.mount
    true_rotation = simulated.path.rotation(poses.time)
    true_camera = simulated.path.position(poses.time) + true_rotation @ mount.camera_body + simulated.gps_offset
    assert np.all(
        np.abs(true_camera - poses.position) < 4.5 * np.sqrt(np.diagonal(poses.covariance, axis1=1, axis2=2)[:, :3])
    )
    down = poses.rotation[:, :, 2]
    assert np.all(down[:, 2] < -0.97)  # strips are flown level: the optical axis points down
    h = 1e-3
    moved = simulated.path.position(poses.time + h) + simulated.path.rotation(poses.time + h) @ mount.camera_body
    assert_allclose(poses.velocity, (moved + simulated.gps_offset - true_camera) / h, rtol=0, atol=0.3)


def test_causal_poses_are_the_filters(survey) -> None:
    simulated, solution = survey
    causal = camera_poses(simulated.flight, solution, causal=True)
    smooth = camera_poses(simulated.flight, solution)
    assert causal.cross_covariance is None
    assert np.trace(causal.covariance.mean(axis=0)) > 2 * np.trace(smooth.covariance.mean(axis=0))


@pytest.mark.parametrize("outage", [10.0, 30.0])
def test_an_outage_is_survived_with_covariance_that_covers_the_error(outage: float) -> None:
    simulated = simulate_flight(
        FlightPlan(n_strips=3, strip_length=300.0), gps=GpsErrors(outages=((50.0, 50.0 + outage),)), seed=5
    )
    solution = navigate(simulated.flight, KNOWN_DELAY)
    inside = (solution.timeline.time > 50.0) & (solution.timeline.time < 50.0 + outage)
    for trajectory in (solution.filtered, solution.smoothed):
        error = errors_of(simulated, trajectory, inside)
        std = np.sqrt(np.diagonal(trajectory.covariance[inside], axis1=1, axis2=2)[:, :9])
        assert np.mean(np.abs(error) < 2 * std) > 0.85
        assert np.all(np.abs(error) < 4.5 * std)
    before = np.searchsorted(solution.timeline.time, 49.0)
    last = np.flatnonzero(inside)[-1]
    assert solution.filtered.covariance[last, 0, 0] > 2 * solution.filtered.covariance[before, 0, 0]
    assert solution.smoothed.covariance[last, 0, 0] < solution.filtered.covariance[last, 0, 0]


def test_outliers_are_refused_and_do_no_harm(caplog: pytest.LogCaptureFixture) -> None:
    gps = GpsErrors(outlier_share=0.05, outlier_size=50.0)
    simulated = simulate_flight(short_plan(), gps=gps, seed=4)
    solution = navigate(simulated.flight)
    assert solution.n_refused > 0.03 * len(simulated.flight.gps)
    assert "refused as outliers" in caplog.text
    rms = np.sqrt(np.mean(errors_of(simulated, solution.smoothed)[:, :3] ** 2, axis=0))
    assert np.all(rms < 0.8)


def test_a_jump_of_the_receiver_for_ten_seconds_is_ridden_out(caplog: pytest.LogCaptureFixture) -> None:
    simulated = simulate_flight(FlightPlan(n_strips=3, strip_length=300.0), seed=7)
    gps = simulated.flight.gps
    jumped = (gps.time > 50.0) & (gps.time < 60.0)
    position = gps.position + np.where(jumped[:, None], [30.0, -40.0, 20.0], 0.0)
    solution = navigate(replace(simulated.flight, gps=replace(gps, position=position)), KNOWN_DELAY)
    assert np.count_nonzero(~solution.is_used[jumped, 0]) >= 0.95 * np.count_nonzero(jumped)
    assert "the first at 50." in caplog.text
    error = errors_of(simulated, solution.smoothed)
    std = np.sqrt(np.diagonal(solution.smoothed.covariance, axis1=1, axis2=2)[:, :9])
    assert np.all(np.abs(error[:, :3]) < 4.5 * std[:, :3])


@pytest.mark.parametrize(("latency", "velocity_std"), [(0.12, None), (-0.05, 0.2), (0.6, None)])
def test_delay_of_the_fixes_is_found(latency: float, velocity_std: float | None) -> None:
    gps = GpsErrors(latency=latency, velocity_std=velocity_std, offset_std=1.0)
    found = navigate(simulate_flight(FlightPlan(n_strips=3, strip_length=300.0), gps=gps, seed=3).flight).latency
    assert found.is_estimated
    assert abs(found.seconds - latency) < 4 * found.std
    assert found.std < 0.02


def test_fixes_without_delay_are_left_alone(survey) -> None:
    _, solution = survey
    assert solution.latency.seconds == 0.0
    assert not solution.latency.is_estimated
    assert 0.9 < solution.nis_per_dof < 1.1


def test_clocks_more_than_a_second_apart_are_refused() -> None:
    simulated = simulate_flight(short_plan(), gps=GpsErrors(latency=2.0), seed=3)
    with pytest.raises(
        InputDataError, match=r"simulated flight 3.*(Bring both logs to one time base|both clocks agree)"
    ):
        navigate(simulated.flight)


@pytest.fixture(scope="module")
def photographed():
    """Flight whose photos carry positions of 2 m noise and another datum, some of them far off."""
    simulated = simulate_flight(FlightPlan(n_strips=4, strip_length=300.0), seed=3)
    photos = simulated.flight.photos
    rng = np.random.default_rng(0)
    position = simulated.path.position(photos.time) + rng.normal(0, 2, (len(photos), 3)) + np.array([1.0, 2.0, 3.0])
    position[::17] += 60.0
    return simulated, replace(photos, position=position), navigate(simulated.flight, KNOWN_DELAY)


@pytest.mark.parametrize("offset", [0.3, -1.2])
def test_clock_of_the_camera_is_found_from_the_photos_own_positions(photographed, offset: float) -> None:
    simulated, photos, _ = photographed
    flight = replace(simulated.flight, photos=replace(photos, time=photos.time - offset))
    solution = navigate(flight, KNOWN_DELAY)
    assert solution.camera_clock.is_applied
    assert abs(solution.camera_clock.seconds - offset) < 4 * solution.camera_clock.std
    assert solution.camera_clock.std < 0.03
    poses = camera_poses(flight, solution)
    assert_allclose(poses.time, photos.time, rtol=0, atol=4 * solution.camera_clock.std)


def test_a_camera_in_time_is_left_alone(photographed) -> None:
    simulated, photos, solution = photographed
    clock = estimate_clock_offset(photos, solution.smoothed, simulated.flight.mount)
    assert not clock.is_applied
    assert clock.seconds == 0.0
    assert 1.0 < clock.position_std < 3.0


def test_a_camera_clock_off_by_seconds_is_refused_with_the_value_to_add(photographed) -> None:
    simulated, photos, solution = photographed
    late = replace(photos, time=photos.time - 5.0)
    with pytest.raises(InputDataError, match=r"off by \+(4\.9|5\.0)\d* s .*images\.csv"):
        estimate_clock_offset(late, solution.smoothed, simulated.flight.mount)


def test_too_few_positions_say_nothing(photographed) -> None:
    simulated, photos, solution = photographed
    position = np.full_like(photos.position, np.nan)
    position[:4] = photos.position[:4]
    few = replace(photos, position=position)
    assert estimate_clock_offset(few, solution.smoothed, simulated.flight.mount) is None
    assert estimate_clock_offset(replace(photos, position=None), solution.smoothed, simulated.flight.mount) is None


def test_alignment_in_motion_is_within_its_stated_error() -> None:
    for seed in range(4):
        simulated = simulate_flight(short_plan(), seed=seed)
        initial = align(simulated.flight)
        error = simulated.error_state(
            np.array([initial.time]), np.zeros((1, 3)), initial.velocity[None], initial.rotation[None]
        )[0]
        assert nees(error[None, 6:], initial.rotation_covariance[None]) < 4.0
        assert np.all(np.abs(error[3:6]) < 4 * initial.velocity_std)
        assert abs(attitude_to_angles(initial.rotation)[0]) < 50.0


def test_a_rotating_earth_is_accounted_for() -> None:
    """Left out, 15 degrees an hour and the Coriolis force would be seen by the better sensor's covariance."""
    frame = LocalFrame(60.0, 10.0, 100.0)
    simulated = simulate_flight(short_plan(), ImuNoise.mid(), seed=2, origin=frame, earth=EarthModel.at(frame))
    solution = navigate(simulated.flight, KNOWN_DELAY)
    error = errors_of(simulated, solution.smoothed)
    assert nees(error, solution.smoothed.covariance[:, :9, :9]) < 1.8
    ignored = navigate(replace(simulated.flight, earth=EarthModel(simulated.flight.earth.gravity)), KNOWN_DELAY)
    bias = simulated.gyro_bias.mean(axis=0) - np.array(
        [s.gyro_bias.mean(axis=0) for s in (solution.smoothed, ignored.smoothed)]
    )
    assert np.linalg.norm(bias[0]) < np.linalg.norm(bias[1])  # what is left out goes into the bias


def test_body_axes_turned_the_wrong_way_are_told_from_the_innovations() -> None:
    simulated = simulate_flight(short_plan(), seed=1)
    imu = simulated.flight.imu
    wrong = replace(imu, angular_rate=imu.angular_rate * np.array([1.0, -1.0, -1.0]))
    with pytest.raises(InputDataError, match=r"simulated flight 1.*axes are (not )?forward-right-down"):
        navigate(replace(simulated.flight, imu=wrong))


def test_a_standing_aircraft_cannot_be_aligned_without_init_json() -> None:
    simulated = simulate_flight(short_plan(), seed=1)
    gps = simulated.flight.gps
    still = replace(gps, position=np.tile(gps.position[:1], (len(gps), 1)))
    with pytest.raises(InputDataError, match=r"cannot be aligned.*init\.json"):
        navigate(replace(simulated.flight, gps=still))


def test_logs_without_common_time_are_refused() -> None:
    simulated = simulate_flight(short_plan(), seed=1)
    later = replace(simulated.flight.gps, time=simulated.flight.gps.time + 1.6e9)
    with pytest.raises(InputDataError, match=r"do not overlap.*one time base"):
        navigate(replace(simulated.flight, gps=later))


def test_photos_outside_the_solution_are_named() -> None:
    simulated = simulate_flight(short_plan(), seed=1)
    photos = simulated.flight.photos
    early = replace(photos, time=np.concatenate([[0.5], photos.time[1:]]))
    flight = replace(simulated.flight, photos=early)
    solution = navigate(flight, KNOWN_DELAY)
    with pytest.raises(InputDataError, match=r"1 of \d+ photos.*photo_0000\.jpg at 0\.500 s.*images\.csv"):
        camera_poses(flight, solution)


@pytest.mark.parametrize("settings", [{"gate_confidence": 1.0}, {"node_spacing": 0.0}])
def test_settings_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must lie in"):
        NavigationSettings(**settings)
