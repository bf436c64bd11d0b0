"""Folders of photos, and models of other programs, as the source of a reconstruction."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from changedetect.errors import InputDataError
from changedetect.io.colmap import find_colmap, read_colmap
from changedetect.io.opensfm import find_opensfm, read_opensfm
from changedetect.io.photo_folder import placed_photos, read_photo_folder
from changedetect.io.posed_photos import PosedPhotos
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.lens import reduced_camera
from changedetect.photogrammetry.similarity import fit_similarity
from changedetect.pipeline.flight_run import FlightSource
from changedetect.typing import FloatArray

__all__ = ["read_photo_source"]

logger = logging.getLogger(__name__)

#: Photos whose longer side is larger are read at half or a quarter of their size, pixels.
_LONGEST_SIDE = 3000
_FEWEST = 3
#: Of poses that another program adjusted and gives no accuracy for: what they move a feature by, pixels; that of a
#: photo with a few dozen independent features.
_KNOWN_POSE_STD = 0.1
#: Distance taken for a model without points, m.
_USUAL_DEPTH = 100.0
#: Semi-major axis of WGS 84, m: where latitude, longitude and height 0 lie.
_EQUATOR = 6378137.0


def read_photo_source(directory: Path, *, camera_file: Path | None = None) -> FlightSource:
    """
    Read a folder without logs: a model of COLMAP, OpenSfM or OpenDroneMap with its photos, or photos alone.

    Parameters
    ----------
    directory : path
        See `changedetect.io.colmap`, `changedetect.io.opensfm` and `changedetect.io.photo_folder`; the first that is
        there is taken.
    camera_file : path, optional
        For photos alone; models state their lenses.

    Raises
    ------
    MissingInputError, InputDataError, VerticalDatumError
        The folder cannot be used; the message names the file and the fix.
    """
    colmap = find_colmap(directory)
    opensfm = find_opensfm(directory) if colmap is None else None
    if camera_file is not None and (colmap or opensfm):
        logger.warning("%s is not used: the model %s states its lenses", camera_file, colmap or opensfm)
    if colmap is not None:
        return _from_model(directory, read_colmap(colmap, directory))
    if opensfm is not None:
        return _from_model(directory, read_opensfm(opensfm, directory))
    found = read_photo_folder(directory, camera_file=camera_file)
    if len(found.poses) < _FEWEST:
        msg = f"{directory} has {len(found.poses)} photos; at least {_FEWEST} that overlap are needed."
        raise InputDataError(msg)
    reduction = _reduction(found.camera)
    lens_std = found.lens_std
    if lens_std is not None:
        lens_std = (lens_std[0], lens_std[1] / reduction, lens_std[2] / reduction, *lens_std[3:])
    return FlightSource(
        label=str(directory),
        poses=found.poses,
        camera=reduced_camera(found.camera, reduction),
        paths=found.paths,
        correlation_time=0.0,
        navigation=found.description | {"reduction": reduction},
        lens_std=lens_std,
        has_heading=found.has_heading,
        reduction=reduction,
        camera_file=found.camera_file,
    )


def _from_model(directory: Path, model: PosedPhotos) -> FlightSource:
    """Source of a model whose poses are known."""
    first = model.cameras[0]
    size = first.width, first.height
    odd = next((camera for camera in model.cameras if (camera.width, camera.height) != size), None)
    if odd is not None:
        msg = (
            f"{model.path} has cameras of {first.width} x {first.height} and of {odd.width} x {odd.height} pixels; "
            "photos of one flight have one size. Make a model of each camera's photos."
        )
        raise InputDataError(msg)
    reduction = _reduction(first)
    cameras = tuple(reduced_camera(camera, reduction) for camera in model.cameras)
    placed, origin, common, description = _placed(directory, model)
    scale = float(description["scale"])
    depth = scale * model.depth if model.depth is not None else _USUAL_DEPTH
    std = _KNOWN_POSE_STD / cameras[0].fx
    covariance = np.tile(np.diag([(std * depth) ** 2] * 3 + [std**2] * 3), (len(model.paths), 1, 1))
    poses = CameraPoses(
        names=tuple(path.name for path in model.paths),
        time=model.time,
        position=placed[0],
        rotation=placed[1],
        covariance=covariance,
        origin=origin,
        common_covariance=common,
    )
    return FlightSource(
        label=str(directory),
        poses=poses,
        camera=cameras[0],
        paths=model.paths,
        correlation_time=0.0,
        navigation=description | {"model_pixel_error": model.pixel_error, "reduction": reduction},
        is_known=True,
        reduction=reduction,
        camera_file=str(model.path),
        other_lenses=cameras[1:],
        lens=model.lens if len(cameras) > 1 else None,
    )


def _placed(
    directory: Path, model: PosedPhotos
) -> tuple[tuple[FloatArray, FloatArray], LocalFrame, FloatArray | None, dict[str, Any]]:
    """Positions and rotations in ENU, its origin, the covariance all share, and a description."""
    description: dict[str, Any] = {"source": "known poses", "model": str(model.path), "scale": 1.0}
    if model.origin is not None:
        return (model.position, model.rotation), model.origin, None, description | {"placed_by": "reference_lla"}
    if model.is_geocentric:
        latitude, longitude, height = _geodetic(model.position).T
        origin = LocalFrame(round(float(latitude[0]), 4), round(float(longitude[0]), 4), round(float(height.min())))
        rotation = np.einsum("ij,njk->nik", origin.rotation_from_ecef, model.rotation)
        position = origin.to_enu(latitude, longitude, height)
        return (position, rotation), origin, None, description | {"placed_by": "Earth-centred coordinates"}
    stated = placed_photos(directory, model.paths)
    fitted = fit_similarity(model.position, stated.position)
    n = len(model.paths)
    common = np.zeros((6, 6))
    common[:3, :3] = np.diag(fitted.residual_std**2 / n + stated.shared_std**2)
    logger.info(
        "%s: placed by the positions of %d photos, scale %.4g, left %.2f, %.2f, %.2f m east, north, up",
        model.path, n, fitted.scale, *fitted.residual_std,
    )  # fmt: skip
    rotation = np.einsum("ij,njk->nik", fitted.rotation, model.rotation)
    return (
        (fitted.apply(model.position), rotation),
        stated.origin,
        common,
        description
        | {
            "placed_by": stated.source,
            "scale": fitted.scale,
            "left_m": fitted.residual_std.tolist(),
        },
    )


def _geodetic(position: FloatArray) -> FloatArray:
    """Latitude, longitude and height of Earth-centred coordinates, shape (n, 3)."""
    equator = LocalFrame(0.0, 0.0, 0.0)
    return equator.to_geodetic((position - np.array([_EQUATOR, 0.0, 0.0])) @ equator.rotation_from_ecef.T)


def _reduction(camera: CameraIntrinsics) -> int:
    """Pixels that are read as one, across and down."""
    longest = max(camera.width, camera.height)
    for factor in (1, 2, 4):
        if longest <= factor * _LONGEST_SIDE or camera.width % (2 * factor) or camera.height % (2 * factor):
            break
    if factor > 1:
        logger.info("photos of %d x %d pixels are read at 1/%d of their size", camera.width, camera.height, factor)
    return factor
