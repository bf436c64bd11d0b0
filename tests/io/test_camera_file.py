"""Camera files as ROS and OpenCV write them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.camera_file import read_camera_file

ROS = """# pinhole
image_width: 1024
image_height: 768
camera_matrix: {rows: 3, cols: 3, data: [2050, 0, 517.5, 0, 2051, 379.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.12, 0.05, 0.0002, -0.0001, 0.01]}
R_body_cam: {rows: 3, cols: 3, data: [0, -1, 0, 1, 0, 0, 0, 0, 1]}
t_body_cam: {rows: 1, cols: 3, data: [0.15, 0.02, 0.1]}
gps_antenna_body: [-0.4, 0, -0.25]
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_ros_file_with_mounting(tmp_path: Path) -> None:
    camera, mount = read_camera_file(write(tmp_path / "camera.yaml", ROS))
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (
        1024,
        768,
        2050,
        2051,
        517.5,
        379.5,
    )
    assert_allclose(camera.distortion, [-0.12, 0.05, 0.0002, -0.0001, 0.01], rtol=0, atol=0)
    assert_allclose(mount.rotation_body_camera @ [0, -1, 0], [1, 0, 0], rtol=0, atol=0)  # top of the image is forward
    assert_allclose(mount.camera_body, [0.15, 0.02, 0.1], rtol=0, atol=0)
    assert_allclose(mount.antenna_body, [-0.4, 0, -0.25], rtol=0, atol=0)


def test_a_file_written_by_opencv_itself(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1024)
    storage.write("image_height", 768)
    storage.write("camera_matrix", np.array([[2050.0, 0, 517.5], [0, 2050, 379.5], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[-0.12, 0.05, 2e-4, -1e-4]]))
    storage.release()
    camera, mount = read_camera_file(path)
    assert (camera.fx, camera.cx, camera.k1, camera.k3) == (2050.0, 517.5, -0.12, 0.0)
    assert_allclose(mount.rotation_body_camera, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("image_width: 1024\n", ""), r"image_width is None; expected a number"),
        (("2050, 0, 517.5", "0, 0, 517.5"), r"focal lengths are positive"),
        (("2050, 0, 517.5", "2050, 0, 5.1"), None),
        (("2050, 0, 517.5", "2050, 0, -5.1"), r"principal point .* outside the image.*Metashape"),
        (("plumb_bob", "equidistant"), r"distortion_model 'equidistant'.*plumb_bob"),
        (("data: [-0.12, 0.05,", "data: [a, 0.05,"), r"distortion_coefficients is"),
        (("data: [-0.12, 0.05,", "data: [1, -0.12, 0.05,"), r"6 numbers; expected k1"),
        (("[0, -1, 0, 1, 0, 0, 0, 0, 1]", "[0, 1, 0, 1, 0, 0, 0, 0, 1]"), r"not a rotation matrix"),
        (("image_width: 1024", "image_width: [1024"), r"is not YAML"),
    ],
)
def test_impossible_files_are_refused_by_name(tmp_path: Path, change: tuple[str, str], message: str | None) -> None:
    path = write(tmp_path / "camera.yaml", ROS.replace(*change))
    if message is None:
        assert read_camera_file(path)[0].cx == 5.1
        return
    with pytest.raises(InputDataError, match=rf"camera\.yaml.*{message}"):
        read_camera_file(path)


def test_missing_and_empty_files(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"none\.yaml"):
        read_camera_file(tmp_path / "none.yaml")
    with pytest.raises(InputDataError, match="holds no camera"):
        read_camera_file(write(tmp_path / "empty.yaml", "# nothing\n"))
