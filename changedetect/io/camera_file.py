"""
Camera files in YAML: ROS `camera_info` and OpenCV's own writing, with the mounting in the aircraft.

Keys: `image_width`, `image_height`, `camera_matrix` and `distortion_coefficients` (k1, k2, p1, p2, k3) as
`{rows, cols, data}`; `R_body_cam` (camera axes to forward-right-down), `t_body_cam` (camera centre, m) and
`gps_antenna_body` (m), all optional. The centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from changedetect.errors import InputDataError, MissingInputError
from changedetect.navigation.camera import CameraIntrinsics, CameraMount

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.typing import FloatArray

__all__ = ["read_camera_file"]

_MODELS = ("plumb_bob", "brown", "radtan")
#: A camera that looks down with the top of its images forward.
_DOWN_LOOKING = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Plain YAML plus OpenCV's matrix tag."""


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def read_camera_file(path: Path) -> tuple[CameraIntrinsics, CameraMount]:
    """
    Read lens and mounting of a camera.

    Parameters
    ----------
    path : path

    Returns
    -------
    camera : CameraIntrinsics
    mount : CameraMount
        Looking down, with the top of the images forward and no lever arms, where the file says nothing.

    Raises
    ------
    MissingInputError
        There is no such file.
    InputDataError
        The file is not YAML, a key is missing or a number impossible, or the lens model is another one.
    """
    document = _load(path)
    model = str(document.get("distortion_model", _MODELS[0]))
    if model not in _MODELS:
        msg = (
            f"{path}: distortion_model {model!r} is not known; this reader takes {', '.join(_MODELS)} (k1, k2, p1, p2, "
            "k3 of OpenCV). Calibrate with that model."
        )
        raise InputDataError(msg)
    K = _matrix(path, document, "camera_matrix", 9).reshape(3, 3)
    lens = _matrix(path, document, "distortion_coefficients", None)
    if lens.size not in (0, 4, 5):
        msg = f"{path}: distortion_coefficients has {lens.size} numbers; expected k1, k2, p1, p2 and perhaps k3."
        raise InputDataError(msg)
    coefficients = np.zeros(5)
    coefficients[: lens.size] = lens
    try:
        camera = CameraIntrinsics(
            int(_number(path, document, "image_width")),
            int(_number(path, document, "image_height")),
            *(float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))),
            *(float(c) for c in coefficients),
        )
        mount = CameraMount(
            _matrix(path, document, "R_body_cam", 9, _DOWN_LOOKING).reshape(3, 3),
            _matrix(path, document, "t_body_cam", 3, [0.0, 0.0, 0.0]),
            _matrix(path, document, "gps_antenna_body", 3, [0.0, 0.0, 0.0]),
        )
    except ValueError as error:
        msg = f"{path}: {error}"
        raise InputDataError(msg) from error
    if abs(camera.cx - camera.width / 2) > camera.width / 2 or abs(camera.cy - camera.height / 2) > camera.height / 2:
        msg = (
            f"{path}: the principal point ({camera.cx:g}, {camera.cy:g}) lies outside the image of {camera.width} x "
            f"{camera.height} pixels. It is counted from the centre of the top-left pixel; Metashape counts from the "
            "middle of the image."
        )
        raise InputDataError(msg)
    return camera, mount


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        msg = f"No such file: {path}. Give the camera file of the flight (YAML, as OpenCV and ROS write it)."
        raise MissingInputError(msg)
    # OpenCV writes "%YAML:1.0", which is no YAML directive.
    text = re.sub(r"\A%YAML:.*\n(---)?", "", path.read_text(encoding="utf-8", errors="replace"))
    try:
        document = yaml.load(text, Loader=_Loader)  # a SafeLoader
    except yaml.YAMLError as error:
        msg = f"{path} is not YAML: {' '.join(str(error).split())}. Correct it, or export the calibration again."
        raise InputDataError(msg) from error
    if not isinstance(document, dict):
        msg = f"{path} holds no camera: expected keys image_width, image_height, camera_matrix."
        raise InputDataError(msg)
    return document


def _number(path: Path, document: dict[str, Any], key: str) -> float:
    value = document.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool):
        msg = f"{path}: {key} is {value!r}; expected a number."
        raise InputDataError(msg)
    return float(value)


def _matrix(
    path: Path, document: dict[str, Any], key: str, size: int | None, default: list[Any] | None = None
) -> FloatArray:
    """Matrix as `{rows, cols, data}` or as plain lists, raveled row by row."""
    value = document.get(key, default)
    if value is None and size is None:
        return np.zeros(0)
    data = value.get("data") if isinstance(value, dict) else value
    try:
        array = np.asarray(data, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if not np.all(np.isfinite(array)) or (size is not None and array.size != size):
        wanted = f"{size} numbers" if size is not None else "numbers"
        msg = f"{path}: {key} is {value!r}; expected {wanted}, as {{rows: r, cols: c, data: [...]}} or a list."
        raise InputDataError(msg)
    return array
