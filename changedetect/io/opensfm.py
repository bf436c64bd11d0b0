"""
Models of OpenSfM and OpenDroneMap: reconstruction.json [1]_.

Poses are world to camera, a rotation vector and a translation. The world is ENU about `reference_lla`, in the file or
in reference_lla.json beside it. Lenses are in units of the photo's longer side, about its middle, so that they hold
for photos of any size.

References
----------
.. [1] https://opensfm.org/docs/dataset.html, https://opensfm.org/docs/geometry.html
"""

from __future__ import annotations

import json
import logging
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from changedetect.errors import InputDataError
from changedetect.io.images import photo_size
from changedetect.io.posed_photos import PosedPhotos, files_of
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.navigation.frame import LocalFrame

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["find_opensfm", "read_opensfm"]

logger = logging.getLogger(__name__)

_FILES = ("reconstruction.json", "opensfm/reconstruction.json")
#: Focal length and coefficients of each projection, by the names of the file.
_PROJECTIONS = {
    "perspective": ("focal", "focal", ("k1", "k2")),
    "simple_radial": ("focal_x", "focal_y", ("k1",)),
    "radial": ("focal_x", "focal_y", ("k1", "k2")),
    "brown": ("focal_x", "focal_y", ("k1", "k2", "k3", "p1", "p2")),
}


def find_opensfm(directory: Path) -> Path | None:
    """File of an OpenSfM or OpenDroneMap model in a folder, None where there is none."""
    return next((directory / name for name in _FILES if (directory / name).is_file()), None)


def read_opensfm(path: Path, directory: Path) -> PosedPhotos:
    """
    Read a reconstruction.json.

    Parameters
    ----------
    path : path
    directory : path
        Of the photos; see `files_of`.

    Raises
    ------
    InputDataError
        The file is not a reconstruction, its projection cannot be expressed, or it has no place on Earth.
    MissingInputError
        A photo is missing.
    """
    model = _largest(path)
    shots: dict[str, Any] = model["shots"]
    names = sorted(shots, key=lambda name: (float(shots[name].get("capture_time") or 0.0), name))
    paths = files_of(path, directory, names)
    try:
        turn = np.array([shots[name]["rotation"] for name in names], dtype=np.float64).reshape(-1, 3)
        shift = np.array([shots[name]["translation"] for name in names], dtype=np.float64).reshape(-1, 3)
        keys = [str(shots[name]["camera"]) for name in names]
    except (KeyError, TypeError, ValueError) as error:
        msg = f"{path}: a shot has no rotation, translation or camera of the usual form ({error})."
        raise InputDataError(msg) from error
    used = sorted(set(keys))
    world_to_camera = Rotation.from_rotvec(turn).as_matrix()
    position = -np.einsum("nji,nj->ni", world_to_camera, shift)
    cameras = tuple(_camera(path, key, model["cameras"], paths[keys.index(key)]) for key in used)
    points = [point.get("coordinates") for point in model.get("points", {}).values()]
    depth = None
    if points:
        middle = np.median(np.array(points, dtype=np.float64), axis=0)
        depth = float(np.median(np.linalg.norm(position - middle, axis=1)))
    return PosedPhotos(
        path=path,
        paths=tuple(paths),
        time=np.array([float(shots[name].get("capture_time") or k) for k, name in enumerate(names)]),
        rotation=np.ascontiguousarray(world_to_camera.transpose(0, 2, 1)),
        position=position,
        cameras=cameras,
        lens=np.array([used.index(key) for key in keys], dtype=np.int64),
        origin=_origin(path, model),
        depth=depth,
    )


def _largest(path: Path) -> dict[str, Any]:
    """Reconstruction with the most photos."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        msg = f"{path} is not JSON: {error}. Copy it again from OpenSfM."
        raise InputDataError(msg) from error
    models = [
        m for m in (document if isinstance(document, list) else [document]) if isinstance(m, dict) and m.get("shots")
    ]
    if not models or not isinstance(models[0].get("cameras"), dict):
        msg = f"{path} is not a reconstruction of OpenSfM: expected a list of objects with cameras and shots."
        raise InputDataError(msg)
    models.sort(key=lambda model: len(model["shots"]), reverse=True)
    n = len(models[0]["shots"])
    if len(models) > 1:
        rest = sum(len(model["shots"]) for model in models[1:])
        logger.warning("%s holds %d parts that are not joined; the largest, %d photos, is taken, %d are left out",
                       path, len(models), n, rest)  # fmt: skip
    if n < 3:
        msg = f"{path} holds {n} photos; at least 3 that overlap are needed."
        raise InputDataError(msg)
    return dict(models[0])


def _origin(path: Path, model: Mapping[str, Any]) -> LocalFrame:
    beside = path.parent / "reference_lla.json"
    reference = model.get("reference_lla")
    if reference is None and beside.is_file():
        reference = json.loads(beside.read_text(encoding="utf-8"))
    try:
        return LocalFrame(*(float((reference or {})[key]) for key in ("latitude", "longitude", "altitude")))
    except (KeyError, TypeError, ValueError) as error:
        msg = (
            f"{path} has no place on Earth: reference_lla (latitude, longitude, altitude) is neither in it nor in "
            f"{beside.name} beside it ({error}). Copy that file from the OpenSfM folder too."
        )
        raise InputDataError(msg) from error


def _camera(path: Path, key: str, cameras: Mapping[str, Any], photo: Path) -> CameraIntrinsics:
    """Lens in pixels of the photo as it is."""
    if key not in cameras:
        msg = f"{path}: a shot has camera {key!r}, which the file does not list."
        raise InputDataError(msg)
    stated = cameras[key]
    projection = str(stated.get("projection_type", "perspective"))
    if projection not in _PROJECTIONS:
        msg = (
            f"{path}: camera {key!r} has the projection {projection!r}, which is not supported; use "
            f"{', '.join(_PROJECTIONS)} (OpenDroneMap: --camera-lens brown)."
        )
        raise InputDataError(msg)
    focal_x, focal_y, names = _PROJECTIONS[projection]
    width, height = photo_size(photo)
    of_model = float(stated.get("width", width)) / float(stated.get("height", height))
    if abs(of_model / (width / height) - 1) > 0.01:
        msg = (
            f"{photo} is {width} x {height} pixels, but camera {key!r} of {path} is {stated.get('width')} x "
            f"{stated.get('height')}: another shape. Use the photos that the model was made of, unrotated."
        )
        raise InputDataError(msg)
    side = max(width, height)
    try:
        return CameraIntrinsics(
            width=width,
            height=height,
            fx=float(stated[focal_x]) * side,
            fy=float(stated[focal_y]) * side,
            cx=(width - 1) / 2 + float(stated.get("c_x", 0.0)) * side,
            cy=(height - 1) / 2 + float(stated.get("c_y", 0.0)) * side,
            **{name: float(stated.get(name, 0.0)) for name in names},
        )
    except (KeyError, ValueError) as error:
        msg = f"{path}: camera {key!r} of projection {projection} is incomplete ({error})."
        raise InputDataError(msg) from error
