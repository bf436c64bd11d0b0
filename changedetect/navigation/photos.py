"""
Camera poses at the photos from a navigation solution.

Photos are nodes of the filter, so their states and covariances are those of the solution itself; only the mounting of
the camera is added: centre = p + R t, rotation = R R_body_camera.
"""

from __future__ import annotations

import logging

import numpy as np

from changedetect.errors import InputDataError
from changedetect.kernels.navigation_filter import accumulate_cross_covariance
from changedetect.navigation.flight import Flight, PhotoList
from changedetect.navigation.poses import CameraPoses
from changedetect.navigation.solution import NavigationSolution, Trajectory
from changedetect.typing import FloatArray, IntArray

__all__ = ["camera_poses"]

logger = logging.getLogger(__name__)


def camera_poses(flight: Flight, solution: NavigationSolution, *, causal: bool = False) -> CameraPoses:
    """
    Poses of every photo with covariance.

    Parameters
    ----------
    flight : Flight
        The one that was solved.
    solution : NavigationSolution
    causal : bool
        True gives the filter's poses, as on board and as in the paper; they have no cross-covariance. By default the
        smoother's.

    Returns
    -------
    poses : CameraPoses
        In ENU at `flight.origin`. `common_covariance` holds the GPS offset of the flight, where one is stated.

    Raises
    ------
    InputDataError
        The flight lists no photos, or photos were taken outside the solution.
    """
    photos = solution.photos
    if photos is None:
        msg = f"{flight.label} lists no photos; poses need their times (images.csv)."
        raise InputDataError(msg)
    nodes = _nodes_of(flight, photos, solution)
    trajectory = solution.filtered if causal else solution.smoothed
    R = trajectory.rotation[nodes]
    arm = R @ flight.mount.camera_body
    jacobian = _pose_jacobian(arm)
    covariance = jacobian @ trajectory.covariance[nodes] @ jacobian.transpose(0, 2, 1)
    cross = None
    if not causal:
        states = accumulate_cross_covariance(solution.smoothed.covariance, solution.gain, nodes)
        cross = jacobian[:-1] @ states @ jacobian[1:].transpose(0, 2, 1)
    common = None
    if flight.gps.offset_std > 0:
        common = np.zeros((6, 6))
        common[:3, :3] = np.eye(3) * flight.gps.offset_std**2
    rate = _angular_rate(solution, trajectory, nodes)
    return CameraPoses(
        names=photos.names,
        time=photos.time,
        position=trajectory.position[nodes] + arm,
        rotation=R @ flight.mount.rotation_body_camera,
        covariance=0.5 * (covariance + covariance.transpose(0, 2, 1)),
        origin=flight.origin,
        cross_covariance=cross,
        common_covariance=common,
        velocity=trajectory.velocity[nodes] + np.cross(rate, arm),
        angular_rate=rate,
    )


def _nodes_of(flight: Flight, photos: PhotoList, solution: NavigationSolution) -> IntArray:
    """Node of each photo; refuses photos outside the solution."""
    of_photo = np.full(len(photos), -1, dtype=np.int64)
    has_photo = np.flatnonzero(solution.timeline.photo >= 0)
    of_photo[solution.timeline.photo[has_photo]] = has_photo
    outside = np.flatnonzero(of_photo < 0)
    if outside.size:
        first = int(outside[0])
        begin, end = solution.timeline.time[[0, -1]]
        msg = (
            f"{outside.size} of {len(photos)} photos of {flight.label} lie outside the navigation solution "
            f"({begin:.3f} to {end:.3f} s), the first {photos.names[first]} at {photos.time[first]:.3f} s. Leave them "
            "out of images.csv, supply the logs of that time, or correct the clock of the camera."
        )
        raise InputDataError(msg)
    return of_photo


def _pose_jacobian(arm: FloatArray) -> FloatArray:
    """Derivative of the camera's error by the 15 errors of the state, shape (n, 6, 15): d(R t) = phi x (R t)."""
    n = arm.shape[0]
    jacobian = np.zeros((n, 6, 15))
    jacobian[:, 0:3, 0:3] = np.eye(3)
    jacobian[:, 3:6, 6:9] = np.eye(3)
    jacobian[:, 0, 7], jacobian[:, 0, 8] = arm[:, 2], -arm[:, 1]
    jacobian[:, 1, 6], jacobian[:, 1, 8] = -arm[:, 2], arm[:, 0]
    jacobian[:, 2, 6], jacobian[:, 2, 7] = arm[:, 1], -arm[:, 0]
    return jacobian


def _angular_rate(solution: NavigationSolution, trajectory: Trajectory, nodes: IntArray) -> FloatArray:
    """Rate of turn about the axes of ENU at nodes, rad/s, from the inertial interval that ends there."""
    timeline = solution.timeline
    measured = timeline.angular_rate[np.maximum(timeline.start[nodes] - 1, 0)]
    body = measured - trajectory.gyro_bias[nodes]
    return np.asarray(np.einsum("nij,nj->ni", trajectory.rotation[nodes], body), dtype=np.float64)
