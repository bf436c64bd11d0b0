"""
Text models of COLMAP [1]_: cameras.txt, images.txt, points3D.txt.

Poses are world to camera, a quaternion with the scalar first and a translation: centre = -R^T t. The centre of the
top-left pixel is (0.5, 0.5). The frame has no place on Earth and no scale, unless the model was aligned to
Earth-centred coordinates (`colmap model_aligner --alignment_type ecef`); otherwise the positions in the photos give it
both.

References
----------
.. [1] https://colmap.github.io/format.html
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from changedetect.errors import InputDataError
from changedetect.io.posed_photos import PosedPhotos, files_of
from changedetect.photogrammetry.lens import from_colmap

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.navigation.camera import CameraIntrinsics
    from changedetect.typing import FloatArray

__all__ = ["find_colmap", "read_colmap"]

logger = logging.getLogger(__name__)

_FOLDERS = (".", "sparse", "sparse/0", "colmap", "colmap/sparse/0", "model")
#: Distances from the centre of the Earth that a place near its surface has, m.
_GEOCENTRIC = (6.3e6, 6.45e6)


def find_colmap(directory: Path) -> Path | None:
    """
    Folder of a COLMAP text model in a folder, None where there is none.

    Raises
    ------
    InputDataError
        There is a binary model only.
    """
    for name in _FOLDERS:
        folder = directory / name
        if (folder / "cameras.txt").is_file() and (folder / "images.txt").is_file():
            return folder
        if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file():
            msg = (
                f"{folder} holds a binary COLMAP model. Write it as text: colmap model_converter --input_path {folder} "
                f"--output_path {folder} --output_type TXT"
            )
            raise InputDataError(msg)
    return None


def read_colmap(folder: Path, directory: Path) -> PosedPhotos:
    """
    Read a text model.

    Parameters
    ----------
    folder : path
        With cameras.txt and images.txt, and points3D.txt where there are points.
    directory : path
        Of the photos; see `files_of`.

    Raises
    ------
    InputDataError
        A line cannot be read, a camera model cannot be expressed, or a photo names a camera that is not there.
    MissingInputError
        A photo is missing.
    """
    cameras = _cameras(folder / "cameras.txt")
    names, pose, camera_of = _images(folder / "images.txt", cameras)
    order = np.argsort(np.array(names))
    paths = files_of(folder, directory, [names[k] for k in order])
    world_to_camera = Rotation.from_quat(pose[order, :4], scalar_first=True).as_matrix()
    position = -np.einsum("nji,nj->ni", world_to_camera, pose[order, 4:])
    used = sorted({camera_of[k] for k in order})
    distance = float(np.median(np.linalg.norm(position, axis=1)))
    depth, error = _points(folder / "points3D.txt", position)
    return PosedPhotos(
        path=folder,
        paths=tuple(paths),
        time=np.arange(len(paths), dtype=np.float64),
        rotation=np.ascontiguousarray(world_to_camera.transpose(0, 2, 1)),
        position=position,
        cameras=tuple(cameras[key] for key in used),
        lens=np.array([used.index(camera_of[k]) for k in order], dtype=np.int64),
        is_geocentric=_GEOCENTRIC[0] < distance < _GEOCENTRIC[1],
        depth=depth,
        pixel_error=error,
    )


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines with their numbers, without comments; empty ones stay, for photos without points have them."""
    text = path.read_text(encoding="utf-8").splitlines()
    return [(k, line) for k, line in enumerate(text, 1) if not line.lstrip().startswith("#")]


def _cameras(path: Path) -> dict[int, CameraIntrinsics]:
    found: dict[int, CameraIntrinsics] = {}
    for number, line in _lines(path):
        fields = line.split()
        if not fields:
            continue
        try:
            key, model, width, height = int(fields[0]), fields[1], int(fields[2]), int(fields[3])
            values = np.array([float(field) for field in fields[4:]])
        except (ValueError, IndexError) as error:
            msg = f"{path}, line {number}: {line[:60]!r} is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS ({error})."
            raise InputDataError(msg) from error
        try:
            found[key] = from_colmap(model, width, height, values)
        except ValueError as error:
            msg = f"{path}, line {number}: {error}"
            raise InputDataError(msg) from error
    if not found:
        msg = f"{path} holds no cameras. Write the model again: colmap model_converter --output_type TXT."
        raise InputDataError(msg)
    return found


def _images(path: Path, cameras: dict[int, CameraIntrinsics]) -> tuple[list[str], FloatArray, list[int]]:
    """Names, poses (quaternion, translation; shape (n, 7)) and cameras of the photos."""
    names: list[str] = []
    poses: list[list[float]] = []
    camera_of: list[int] = []
    lines = _lines(path)
    while lines and not lines[-1][1].strip() and len(lines) % 2:
        lines.pop()
    for number, line in lines[::2]:
        fields = line.split(maxsplit=9)
        try:
            pose, camera, name = [float(field) for field in fields[1:8]], int(fields[8]), fields[9].strip()
        except (ValueError, IndexError) as error:
            msg = (
                f"{path}, line {number}: {line[:60]!r} is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME ({error}). "
                "Each photo has two lines, the second with its points, or empty."
            )
            raise InputDataError(msg) from error
        if camera not in cameras:
            msg = f"{path}, line {number}: {name} has camera {camera}, which cameras.txt does not list."
            raise InputDataError(msg)
        if not np.all(np.isfinite(pose)) or np.linalg.norm(pose[:4]) < 1e-6:
            msg = f"{path}, line {number}: the pose of {name} is {pose}; expected a quaternion and a translation."
            raise InputDataError(msg)
        names.append(name)
        poses.append(pose)
        camera_of.append(camera)
    if len(names) < 3:
        msg = f"{path} holds {len(names)} photos; at least 3 that overlap are needed."
        raise InputDataError(msg)
    return names, np.array(poses), camera_of


def _points(path: Path, position: FloatArray) -> tuple[float | None, float | None]:
    """Median distance of the points from the cameras, and mean reprojection error; None without points."""
    if not path.is_file():
        return None, None
    rows = [line.split(maxsplit=8)[1:8] for _, line in _lines(path) if line.strip()]
    if not rows:
        return None, None
    try:
        table = np.array([[float(row[k]) for k in (0, 1, 2, 6)] for row in rows])
    except (ValueError, IndexError) as error:
        msg = f"{path}: a line is not POINT3D_ID X Y Z R G B ERROR TRACK ({error})."
        raise InputDataError(msg) from error
    middle = np.median(table[:, :3], axis=0)
    return float(np.median(np.linalg.norm(position - middle, axis=1))), float(table[:, 3].mean())
