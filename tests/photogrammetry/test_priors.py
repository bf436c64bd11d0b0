"""Information of the poses of a flight against dense inverses."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.priors import boresight_pattern, pose_information

STD = np.array([0.3, 0.2, 0.25, 0.002, 0.003, 0.007])


def flight(n=6, alike=0.9, *, cross=True, common=None):
    time = np.arange(n) * 0.5
    covariance = np.tile(np.diag(STD**2), (n, 1, 1))
    return CameraPoses(
        tuple(f"{k}.jpg" for k in range(n)),
        time,
        np.zeros((n, 3)),
        np.tile(np.eye(3), (n, 1, 1)),
        covariance,
        LocalFrame(0.0, 0.0, 0.0),
        np.tile(np.diag(alike * STD**2), (n - 1, 1, 1)) if cross else None,
        common,
    )


def chain(n, alike):
    powers = alike ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    return np.kron(powers, np.diag(STD**2))


def test_information_of_a_chain_is_the_inverse_of_its_covariance():
    found = np.linalg.inv(pose_information(flight(alike=0.9)))
    assert_allclose(found, chain(6, 0.9), rtol=1e-6, atol=1e-12)


def test_without_cross_covariance_errors_fade_with_time():
    found = np.linalg.inv(pose_information(flight(cross=False), correlation_time=5.0))
    assert_allclose(found, chain(6, np.exp(-0.1)), rtol=1e-6, atol=1e-12)
    apart = np.linalg.inv(pose_information(flight(cross=False), correlation_time=0.0))
    assert_allclose(apart, chain(6, 0.0), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("stated", [True, False])
def test_an_offset_of_the_whole_flight_is_shared_by_all_photos(stated):
    common = np.diag([1.0, 1.0, 1.0, 0, 0, 0])
    poses = flight(common=common if stated else None)
    found = np.linalg.inv(pose_information(poses, common_std=0.0 if stated else 1.0))
    assert_allclose(found, chain(6, 0.9) + np.kron(np.ones((6, 6)), common), rtol=1e-5, atol=1e-9)


def test_photos_of_perfectly_correlated_error_stay_invertible():
    information = pose_information(flight(alike=1.0))
    assert np.linalg.eigvalsh(information)[0] > 0
    assert_allclose(np.diag(np.linalg.inv(information))[:3], STD[:3] ** 2, rtol=1e-3, atol=0)


def test_a_covariance_that_is_not_positive_names_the_photo():
    poses = flight(cross=False)
    poses.covariance[3, 0, 0] = -1.0
    with pytest.raises(InputDataError, match=r"photo 3\.jpg is not positive definite"):
        pose_information(poses)


def test_boresight_turns_with_the_camera():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pattern = boresight_pattern(np.stack([np.eye(3), turn]))
    assert_allclose(pattern[3:6], np.eye(3), rtol=0, atol=0)
    assert_allclose(pattern[9:12], turn, rtol=0, atol=0)
    assert_allclose(pattern[[0, 1, 2, 6, 7, 8]], 0, rtol=0, atol=0)
