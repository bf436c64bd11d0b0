"""Models of COLMAP and OpenSfM: poses and lenses reproject their own points to where they were seen."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import photo_samples as samples
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.colmap import find_colmap, read_colmap
from changedetect.io.opensfm import find_opensfm, read_opensfm
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.lens import from_colmap

#: Written by pycolmap 4.2.1 for seven photos; every twentieth point was kept.
MODEL = Path(__file__).parent / "samples" / "colmap"


@pytest.fixture
def folder(tmp_path):
    """The model with stand-ins of its photos."""
    shutil.copytree(MODEL, tmp_path / "sparse" / "0")
    (tmp_path / "images").mkdir()
    for k in range(24, 31):
        (tmp_path / "images" / f"DJI_00{k}.JPG").touch()
    return tmp_path


def block_of(found):
    n = len(found.paths)
    names = tuple(path.name for path in found.paths)
    covariance = np.tile(np.eye(6), (n, 1, 1))
    poses = CameraPoses(names, np.arange(n), found.position, found.rotation, covariance, LocalFrame(0, 0, 0))
    return ImageBlock.from_poses(poses, found.cameras[0])


def test_colmap_points_are_seen_where_the_model_says(folder):
    found = read_colmap(find_colmap(folder), folder)
    block = block_of(found)
    rows = [line.split() for line in (MODEL / "points3D.txt").read_text().splitlines() if not line.startswith("#")]
    places = {int(row[0]): np.array(row[1:4], dtype=float) for row in rows}
    lines = [line for line in (MODEL / "images.txt").read_text().splitlines() if not line.startswith("#")]
    errors = []
    for head, seen in zip(lines[::2], lines[1::2], strict=True):
        image = block.names.index(head.split()[9])
        values = np.array(seen.split(), dtype=float).reshape(-1, 3)
        points = np.array([places[int(number)] for number in values[:, 2]])
        # COLMAP counts from the corner of the top-left pixel
        errors.append(block.project(points, image)[:, :2] - (values[:, :2] - 0.5))
    size = np.linalg.norm(np.concatenate(errors), axis=1)
    assert len(size) > 100
    assert np.median(size) < 0.35
    assert size.max() < 4.0
    assert_allclose(found.pixel_error, np.mean([float(row[7]) for row in rows]), rtol=1e-6, atol=0)
    assert 4.0 < found.depth < 9.0
    assert found.origin is None
    assert not found.is_geocentric


def test_the_centre_of_a_colmap_camera_is_that_of_pycolmap(folder):
    found = read_colmap(folder / "sparse" / "0", folder)
    at = [path.name for path in found.paths].index("DJI_0026.JPG")
    # Image.projection_center() of pycolmap for this photo
    assert_allclose(found.position[at], [-0.57802379, -1.52452123, -0.15136667], rtol=0, atol=1e-7)


def test_geocentric_colmap_models_are_told_by_their_distance(folder):
    path = folder / "sparse" / "0" / "images.txt"
    out = []
    for k, line in enumerate(line for line in path.read_text().splitlines() if not line.startswith("#")):
        fields = line.split()
        if k % 2 == 0:
            R = Rotation.from_quat([float(f) for f in fields[1:5]], scalar_first=True).as_matrix()
            shift = np.array([float(f) for f in fields[5:8]]) - R @ [-1.5e5, -4.3e6, 4.7e6]
            fields[5:8] = [repr(float(v)) for v in shift]
        out.append(" ".join(fields))
    path.write_text("\n".join(out) + "\n")
    assert read_colmap(path.parent, folder).is_geocentric


@pytest.mark.parametrize(
    ("model", "values", "expected"),
    [
        ("SIMPLE_PINHOLE", [900, 800, 450], (900, 900, 799.5, 449.5, 0, 0, 0, 0, 0)),
        ("PINHOLE", [900, 910, 800, 450], (900, 910, 799.5, 449.5, 0, 0, 0, 0, 0)),
        ("SIMPLE_RADIAL", [900, 800, 450, 0.1], (900, 900, 799.5, 449.5, 0.1, 0, 0, 0, 0)),
        ("RADIAL", [900, 800, 450, 0.1, 0.2], (900, 900, 799.5, 449.5, 0.1, 0.2, 0, 0, 0)),
        ("OPENCV", [900, 910, 800, 450, 0.1, 0.2, 0.3, 0.4], (900, 910, 799.5, 449.5, 0.1, 0.2, 0.3, 0.4, 0)),
        (
            "FULL_OPENCV",
            [900, 910, 800, 450, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0],
            (900, 910, 799.5, 449.5, 0.1, 0.2, 0.3, 0.4, 0.5),
        ),
    ],
)
def test_every_lens_that_can_be_expressed_is(model, values, expected):
    assert from_colmap(model, 1600, 900, np.array(values, float)) == CameraIntrinsics(1600, 900, *expected)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras.txt", "OPENCV", "OPENCV_FISHEYE", r"cameras\.txt, line 4: .*'OPENCV_FISHEYE' is not supported"),
        ("cameras.txt", "1 OPENCV 1600", "1 OPENCV wide", r"cameras\.txt, line 4: .* is not CAMERA_ID MODEL"),
        ("cameras.txt", "1 OPENCV", "7 OPENCV", r"images\.txt, line 5: DJI_0027\.JPG has camera 1, which"),
        ("images.txt", " 1 DJI_0027.JPG", "", r"images\.txt, line 5: .*Each photo has two lines"),
        ("images.txt", "0.99872251318029748", "nan", r"images\.txt, line 5: the pose of DJI_0027\.JPG is"),
        ("points3D.txt", "1 0.774", "1 east", r"points3D\.txt: a line is not POINT3D_ID"),
    ],
)
def test_colmap_models_that_cannot_be_read_are_named(folder, file, old, new, message):
    path = folder / "sparse" / "0" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputDataError, match=message):
        read_colmap(path.parent, folder)


def test_missing_photos_and_binary_models_are_named(folder, tmp_path):
    (folder / "images" / "DJI_0026.JPG").unlink()
    with pytest.raises(MissingInputError, match=r"has 1 of 7 photos that are neither in .*: DJI_0026\.JPG"):
        read_colmap(folder / "sparse" / "0", folder)
    for name in ("cameras", "images"):
        (folder / "sparse" / "0" / f"{name}.txt").rename(folder / "sparse" / "0" / f"{name}.bin")
    with pytest.raises(InputDataError, match="colmap model_converter"):
        find_colmap(folder)


KEY = "v2 dji fc300s 4000 2250 brown 0.5555"
LENS = {"focal_x": 0.58, "focal_y": 0.581, "c_x": 0.002, "c_y": -0.003, "k1": -0.02, "k2": 0.03}
LENS |= {"p1": 1e-3, "p2": -2e-3, "k3": 0.001}


def opensfm(folder: Path, **changes):
    """Four cameras over a plain, in the form that OpenSfM writes within OpenDroneMap."""
    folder.mkdir(exist_ok=True)
    shots = {}
    for k in range(4):
        samples.write_photo(folder / f"DJI_{k:04d}.JPG")
        R = Rotation.from_euler("xyz", [179.0, 1.0, 40.0 + k], degrees=True)  # world to camera
        centre = np.array([10.0 * k, 5.0 * (k % 2), 40.0])
        shots[f"DJI_{k:04d}.JPG"] = {
            "rotation": R.as_rotvec().tolist(),
            "translation": (-R.as_matrix() @ centre).tolist(),
            "camera": KEY,
            "orientation": 1,
            "capture_time": 1466699519.0 + 7 * (3 - k),
            "gps_dop": 15.0,
            "gps_position": centre.tolist(),
            "vertices": [],
            "faces": [],
            "scale": 1.0,
            "covariance": [],
            "merge_cc": 0,
        }
    camera = {"projection_type": "brown", "width": 4000, "height": 2250, **LENS}
    points = {str(k): {"color": [1.0, 2.0, 3.0], "coordinates": [5.0 * k, 2.0 * k, 0.0]} for k in range(7)}
    model = {
        "cameras": {KEY: camera},
        "shots": shots,
        "points": points,
        "biases": {},
        "rig_cameras": {},
        "rig_instances": {},
        "reference_lla": {"latitude": 46.84, "longitude": -91.99, "altitude": 0.0},
    }
    model |= changes
    (folder / "reconstruction.json").write_text(json.dumps([model]))
    return folder


def test_opensfm_models_are_in_enu_with_lenses_of_the_photos_size(tmp_path):
    folder = opensfm(tmp_path / "f")
    found = read_opensfm(find_opensfm(folder), folder)
    assert [path.name for path in found.paths] == [f"DJI_{k:04d}.JPG" for k in (3, 2, 1, 0)]  # by capture time
    assert_allclose(found.position[0], [30.0, 5.0, 40.0], rtol=0, atol=1e-9)
    assert_allclose(found.rotation[0] @ [0, 0, 1], [0, 0, -1], rtol=0, atol=0.03)  # looks down
    assert found.origin == LocalFrame(46.84, -91.99, 0.0)
    camera = found.cameras[0]
    assert_allclose(
        [camera.fx, camera.fy, camera.k1, camera.p2, camera.k3], [92.8, 92.96, -0.02, -2e-3, 0.001], rtol=1e-9, atol=0
    )
    # pixel = (normalised * 160 + 160 / 2) - 0.5, as OpenSfM denormalises
    assert_allclose([camera.cx, camera.cy], [79.5 + 0.32, 44.5 - 0.48], rtol=0, atol=1e-9)
    assert 40 < found.depth < 50


def test_the_largest_part_of_an_opensfm_model_is_taken(tmp_path, caplog):
    folder = opensfm(tmp_path / "f")
    path = folder / "reconstruction.json"
    whole = json.loads(path.read_text())[0]
    part = whole | {"shots": {"DJI_0000.JPG": whole["shots"]["DJI_0000.JPG"]}}
    path.write_text(json.dumps([part, whole]))
    assert len(read_opensfm(path, folder).paths) == 4
    assert "holds 2 parts that are not joined; the largest, 4 photos" in caplog.text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reference_lla": None}, r"reconstruction\.json has no place on Earth: reference_lla"),
        ({"cameras": {KEY: {"projection_type": "fisheye", "focal": 0.5}}}, r"projection 'fisheye', which is not supp"),
        ({"cameras": {}}, r"a shot has camera 'v2 dji .*', which the file does not list"),
        (
            {"cameras": {KEY: {"projection_type": "brown", "width": 4000, "height": 3000, **LENS}}},
            r"DJI_0003\.JPG is 160 x 90 pixels, but camera .* is 4000 x 3000: another shape",
        ),
        ({"cameras": {KEY: {"projection_type": "brown", "width": 4000, "height": 2250}}}, r"brown is incomplete"),
        ({"shots": {"a": {"rotation": [0, 0, 0]}}}, r"holds 1 photos; at least 3"),
    ],
)
def test_opensfm_models_that_cannot_be_used_are_named(tmp_path, changes, message):
    folder = opensfm(tmp_path / "f", **changes)
    with pytest.raises(InputDataError, match=message):
        read_opensfm(folder / "reconstruction.json", folder)


def test_files_that_are_no_reconstruction_are_named(tmp_path):
    path = tmp_path / "reconstruction.json"
    for text, message in (("[", "is not JSON"), ('[{"a": 1}]', "is not a reconstruction of OpenSfM")):
        path.write_text(text)
        with pytest.raises(InputDataError, match=message):
            read_opensfm(path, tmp_path)
