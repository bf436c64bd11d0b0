"""The pose contract: shapes, selection, storage."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from changedetect.errors import MissingInputError, ModelStateError
from changedetect.navigation.camera import CameraIntrinsics, CameraMount
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses


def make_poses(n: int = 4, *, cross: bool = True) -> CameraPoses:
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, 6, 6))
    return CameraPoses(
        names=tuple(f"IMG_{k}.jpg" for k in range(n)),
        time=np.arange(n) * 0.27,
        position=rng.normal(size=(n, 3)),
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        covariance=A @ A.transpose(0, 2, 1),
        origin=LocalFrame(-33.89, 151.19, 40.0),
        cross_covariance=rng.normal(size=(n - 1, 6, 6)) if cross else None,
        common_covariance=np.eye(6),
        velocity=rng.normal(size=(n, 3)),
    )


def test_saved_poses_come_back_with_the_same_bits(tmp_path) -> None:
    poses = make_poses()
    poses.save(tmp_path / "poses.nc")
    back = CameraPoses.load(tmp_path / "poses.nc")
    assert back.names == poses.names
    assert back.origin == poses.origin
    for name in ("time", "position", "rotation", "covariance", "cross_covariance", "common_covariance", "velocity"):
        assert np.array_equal(getattr(back, name), getattr(poses, name)), name
    assert back.angular_rate is None


def test_poses_without_options_come_back_without_them(tmp_path) -> None:
    poses = make_poses(cross=False)
    poses.save(tmp_path / "poses.nc")
    assert CameraPoses.load(tmp_path / "poses.nc").cross_covariance is None


def test_a_file_of_something_else_is_refused(tmp_path) -> None:
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "other.nc")
    with pytest.raises(ModelStateError, match=r"other\.nc does not hold camera poses"):
        CameraPoses.load(tmp_path / "other.nc")
    with pytest.raises(MissingInputError, match=r"none\.nc"):
        CameraPoses.load(tmp_path / "none.nc")


def test_a_file_that_lost_a_variable_is_refused(tmp_path) -> None:
    make_poses().save(tmp_path / "poses.nc")
    with xr.open_dataset(tmp_path / "poses.nc") as dataset:
        dataset.load().drop_vars("rotation").to_netcdf(tmp_path / "less.nc")
    with pytest.raises(ModelStateError, match=r"less\.nc holds incomplete camera poses.*rotation"):
        CameraPoses.load(tmp_path / "less.nc")


@pytest.mark.parametrize("name", ["time", "position", "rotation", "covariance", "velocity"])
def test_shapes_that_do_not_agree_are_refused(name: str) -> None:
    poses = make_poses()
    content = {**vars(poses), name: getattr(poses, name)[:-1]}
    with pytest.raises(ValueError, match=f"{name} of 4 camera poses"):
        CameraPoses(**content)


def test_selection_keeps_order_and_the_cross_covariance_of_a_run() -> None:
    poses = make_poses(5)
    run = poses.select(["IMG_3.jpg", "IMG_1.jpg", "IMG_2.jpg"])
    assert run.names == ("IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg")
    assert np.array_equal(run.cross_covariance, poses.cross_covariance[1:3])
    assert poses.select(["IMG_0.jpg", "IMG_2.jpg"]).cross_covariance is None
    with pytest.raises(ValueError, match=r"No pose for DSC_1\.jpg"):
        poses.select(["DSC_1.jpg"])


def test_relative_covariance_of_fully_correlated_errors_is_zero() -> None:
    poses = make_poses()
    same = CameraPoses(
        **{
            **vars(poses),
            "covariance": np.tile(np.eye(6), (4, 1, 1)),
            "cross_covariance": np.tile(np.eye(6), (3, 1, 1)),
        }
    )
    assert np.all(same.relative_covariance == 0)
    assert np.array_equal(same.total_covariance, np.tile(2 * np.eye(6), (4, 1, 1)))


def test_a_mirrored_mount_is_refused() -> None:
    with pytest.raises(ValueError, match="not a rotation matrix"):
        CameraMount(np.diag([1.0, 1.0, -1.0]))


def test_a_lever_arm_of_two_numbers_is_refused() -> None:
    with pytest.raises(ValueError, match="antenna_body"):
        CameraMount(antenna_body=np.zeros(2))


def test_a_camera_without_size_is_refused() -> None:
    with pytest.raises(ValueError, match="sizes and focal lengths are positive"):
        CameraIntrinsics(0, 768, 2050.0, 2050.0, 512.0, 384.0)


def test_camera_matrix_and_distortion_are_in_opencvs_order() -> None:
    camera = CameraIntrinsics(1024, 768, 2050.0, 2051.0, 517.5, 379.5, -0.12, 0.05, 2e-4, -1e-4, 0.01)
    assert np.array_equal(camera.matrix, [[2050.0, 0, 517.5], [0, 2051.0, 379.5], [0, 0, 1]])
    assert np.array_equal(camera.distortion, [-0.12, 0.05, 2e-4, -1e-4, 0.01])
