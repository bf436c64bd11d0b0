"""The smoother against a factor graph of GTSAM: other people's code, another parametrisation, the same problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from changedetect.navigation.flight import InitialState
from changedetect.navigation.solution import NavigationSettings, NavigationSolution, navigate
from changedetect.synthetic.flight_path import FlightPlan, simulate_flight

gtsam = pytest.importorskip("gtsam")


@pytest.fixture(scope="module")
def solved():
    """A minute of flight that starts from a known state without photos: every node is a fix or fills a gap."""
    simulated = simulate_flight(FlightPlan(n_strips=1, strip_length=200.0), seed=21)
    t0 = simulated.flight.imu.time[100:101]
    rng = np.random.default_rng(1)
    std = np.radians([2.0, 2.0, 4.0])
    initial = InitialState(
        time=float(t0[0]),
        rotation=Rotation.from_rotvec(rng.normal(0, std)).as_matrix() @ simulated.path.rotation(t0)[0],
        velocity=simulated.path.velocity(t0)[0] + rng.normal(0, 0.5, 3),
        rotation_covariance=np.diag(std**2),
        velocity_std=0.5,
        position=simulated.path.position(t0)[0] + rng.normal(0, 3, 3),
        position_std=3.0,
    )
    flight = replace(simulated.flight, initial=initial, photos=None)
    return flight, navigate(flight, NavigationSettings(gps_latency=0.0))


def factor_graph(flight, solution: NavigationSolution):
    """Combined preintegration between nodes, fixes with lever arm, priors; poses and covariances of every node."""
    P, V, B = (lambda k: gtsam.symbol("x", k)), (lambda k: gtsam.symbol("v", k)), (lambda k: gtsam.symbol("b", k))
    noise, first, timeline = flight.imu_noise, flight.initial, solution.timeline
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(flight.earth.gravity)
    gyro, accel, gyro_walk, accel_walk = noise.densities
    params.setGyroscopeCovariance(gyro * np.eye(3))
    params.setAccelerometerCovariance(accel * np.eye(3))
    params.setIntegrationCovariance(1e-12 * np.eye(3))
    params.setBiasOmegaCovariance(gyro_walk * np.eye(3))
    params.setBiasAccCovariance(accel_walk * np.eye(3))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    R0 = first.rotation
    pose0 = gtsam.Pose3(gtsam.Rot3(R0), first.position)
    covariance = np.zeros((6, 6))  # GTSAM: rotation then translation, both in body axes
    covariance[:3, :3] = R0.T @ first.rotation_covariance @ R0
    covariance[3:, 3:] = first.position_std**2 * np.eye(3)
    graph.add(gtsam.PriorFactorPose3(P(0), pose0, gtsam.noiseModel.Gaussian.Covariance(covariance)))
    graph.add(gtsam.PriorFactorVector(V(0), first.velocity, gtsam.noiseModel.Isotropic.Sigma(3, first.velocity_std)))
    accel0 = np.hypot(noise.accel_bias_std, noise.accel_instability)
    gyro0 = np.hypot(noise.gyro_bias_std, noise.gyro_instability)
    bias_noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([accel0, gyro0], 3))
    graph.add(gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), bias_noise))
    for k in range(len(timeline.time)):
        state = solution.filtered
        values.insert(P(k), gtsam.Pose3(gtsam.Rot3(state.rotation[k]), state.position[k]))
        values.insert(V(k), state.velocity[k])
        values.insert(B(k), gtsam.imuBias.ConstantBias(state.accel_bias[k], state.gyro_bias[k]))
        if k:
            bias = gtsam.imuBias.ConstantBias(state.accel_bias[k - 1], state.gyro_bias[k - 1])
            preintegrated = gtsam.PreintegratedCombinedMeasurements(params, bias)
            for i in range(timeline.start[k - 1], timeline.start[k]):
                preintegrated.integrateMeasurement(
                    timeline.specific_force[i], timeline.angular_rate[i], timeline.duration[i]
                )
            graph.add(gtsam.CombinedImuFactor(P(k - 1), V(k - 1), P(k), V(k), B(k - 1), B(k), preintegrated))
        j = timeline.fix[k]
        if j >= 0:
            model = gtsam.noiseModel.Diagonal.Sigmas(flight.gps.position_std[j])
            graph.add(gtsam.GPSFactorArm(P(k), flight.gps.position[j], flight.mount.antenna_body, model))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, result)
    poses = [result.atPose3(P(k)) for k in range(len(timeline.time))]
    return poses, [marginals.marginalCovariance(P(k)) for k in range(0, len(poses), 20)]


def test_smoothed_poses_and_covariances_agree_with_gtsams(solved) -> None:
    flight, solution = solved
    poses, covariances = factor_graph(flight, solution)
    ours = solution.smoothed
    position = np.array([pose.translation() for pose in poses])
    rotation = np.array([pose.rotation().matrix() for pose in poses])
    std = np.sqrt(np.diagonal(ours.covariance, axis1=1, axis2=2))
    assert np.abs((position - ours.position) / std[:, :3]).max() < 0.15
    turn = Rotation.from_matrix(rotation @ ours.rotation.transpose(0, 2, 1)).as_rotvec()
    # GTSAM rotates the force by the attitude at the start of a sample, not along it: 0.1 standard deviations here.
    assert np.abs(turn / std[:, 6:9]).max() < 0.3
    for row, covariance in zip(range(0, len(poses), 20), covariances, strict=True):
        R = ours.rotation[row]
        assert_allclose(np.sqrt(np.diag(R @ covariance[3:, 3:] @ R.T)), std[row, :3], rtol=0.05, atol=0)
        assert_allclose(np.sqrt(np.diag(R @ covariance[:3, :3] @ R.T)), std[row, 6:9], rtol=0.05, atol=0)
