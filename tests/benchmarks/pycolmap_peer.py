"""One epoch of the simulated flight by pycolmap: features, spatial matching, mapping, similarity to true poses."""

from __future__ import annotations

import csv
import os
import time
from pathlib import Path

import numpy as np


def run_pycolmap(flight: Path, poses: Path, lens: list[float], folder: Path, workers: int):
    """
    Reconstruct a flight.

    Parameters
    ----------
    flight : path
        Folder with `images/` and `geo.txt`.
    poses : path
        True poses: the model's own frame is laid on them by a similarity of camera centres.
    lens : list of 8 float
        fx, fy, cx, cy, k1, k2, p1, p2 with the centre of the first pixel at (0, 0); COLMAP counts from its corner.
    folder : path
        For the database and the model.
    workers : int

    Returns
    -------
    points : array, shape (n, 3), ENU, m
    views : array, shape (n,)
    seconds : dict of str to (wall, processor), s
    """
    import pycolmap

    pycolmap.logging.minloglevel = 2
    folder.mkdir(parents=True, exist_ok=True)
    database = folder / "database.db"
    database.unlink(missing_ok=True)
    shifted = [*lens[:2], lens[2] + 0.5, lens[3] + 0.5, *lens[4:]]
    reader = pycolmap.ImageReaderOptions(camera_model="OPENCV", camera_params=",".join(str(p) for p in shifted))
    seconds: dict[str, tuple[float, float]] = {}

    def timed(name, function):
        wall, busy = time.perf_counter(), time.process_time()
        result = function()
        seconds[name] = time.perf_counter() - wall, time.process_time() - busy
        return result

    extraction = pycolmap.FeatureExtractionOptions(num_threads=workers, use_gpu=False)
    timed(
        "features",
        lambda: pycolmap.extract_features(
            database,
            flight / "images",
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        ),
    )
    _write_priors(pycolmap, database, flight / "geo.txt")
    pairing = pycolmap.SpatialPairingOptions(
        max_num_neighbors=20, max_distance=60.0, ignore_z=True, num_threads=workers
    )
    matching = pycolmap.FeatureMatchingOptions(num_threads=workers, use_gpu=False)
    timed(
        "matching",
        lambda: pycolmap.match_spatial(
            database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
        ),
    )
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=workers,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )
    models = timed(
        "mapping", lambda: pycolmap.incremental_mapping(database, flight / "images", folder, options=options)
    )
    model = max(models.values(), key=lambda found: found.num_reg_images())
    return (*_in_enu(model, poses), seconds)


def _write_priors(pycolmap, database: Path, geo: Path) -> None:
    """Positions of the photos, for the choice of pairs."""
    rows = [line.split() for line in geo.read_text().splitlines()[1:]]
    place = {row[0]: np.array([float(row[2]), float(row[1]), float(row[3])]) for row in rows}
    opened = pycolmap.Database.open(os.fspath(database))
    for image in opened.read_all_images():
        prior = pycolmap.PosePrior(
            corr_data_id=image.data_id,
            position=place[image.name],
            coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
        )
        opened.write_pose_prior(prior)
    opened.close()


def _in_enu(model, poses: Path) -> tuple[np.ndarray, np.ndarray]:
    with poses.open() as stream:
        true = {row["image"]: [float(row[axis]) for axis in "xyz"] for row in csv.DictReader(stream)}
    images = [image for image in model.images.values() if image.has_pose]
    found = np.array([image.projection_center() for image in images])
    target = np.array([true[image.name] for image in images])
    scale, turn, shift = similarity(found, target)
    points = np.array([point.xyz for point in model.points3D.values()])
    views = np.array([point.track.length() for point in model.points3D.values()])
    return scale * points @ turn.T + shift, views


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that lay one set of points on another (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = float(np.trace(np.diag(d) @ sign) / np.mean(np.sum(a**2, axis=1)))
    return scale, turn, target.mean(axis=0) - scale * turn @ source.mean(axis=0)
