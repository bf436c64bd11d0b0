"""Photos without logs through the pipeline: rendered photos with EXIF, a model of known poses, the real sets."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import photo_samples as samples
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from changedetect.cli.app import app
from changedetect.errors import ConfigError, InputDataError
from changedetect.io.colmap import read_colmap
from changedetect.navigation.alignment import ENU_FROM_NED
from changedetect.photogrammetry.lens import to_colmap
from changedetect.photogrammetry.orientation import OrientationSettings
from changedetect.pipeline import reconstruct as pipeline
from changedetect.pipeline.flight_run import FlightRun, read_flight_source
from changedetect.pipeline.flight_store import FlightStore
from changedetect.pipeline.photo_source import read_photo_source
from changedetect.pipeline.reconstruct import ReconstructOptions, reconstruct

DATA = Path(os.environ.get("CHANGEDETECT_DATA", "../shared/data"))
#: Camera axes (right, down, forward) in body axes (forward, right, down) of a camera that looks ahead.
AHEAD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def flown():
    return rendered.fly(0, n_photos=3)


def write_photos(folder, flown, seed=3, spoil=lambda k, fields: fields):
    """Photos as a drone writes them: GPS good to a metre, angles to degrees, 20.5 mm equivalent for a lens of 36."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    truth = flown.truth
    # 160 x 120 of 4:3 has the film's diagonal: 520 pixels are 56 mm; EXIF says 58
    shift = rng.normal(0, 2.0, 3) * [1, 1, 0]
    for k, name in enumerate(truth.names):
        place = truth.position[k] + shift + rng.normal(0, [0.8, 0.8, 0.2])
        latitude, longitude, height = rendered.ORIGIN.to_geodetic(place)
        turn = Rotation.from_rotvec(rng.normal(0, np.radians([1.5, 1.5, 5.0]))).as_matrix()
        body = ENU_FROM_NED @ turn @ truth.rotation[k] @ AHEAD.T
        yaw, pitch, roll = Rotation.from_matrix(body).as_euler("ZYX", degrees=True)
        fields = {
            "latitude": float(latitude),
            "longitude": float(longitude),
            "altitude": float(height),
            "time": f"2024:05:01 10:{k // 30:02d}:{2 * k % 60:02d}",
            "focal35": 58,
            "focal": None,
            "xmp": samples.dji(
                yaw=yaw, pitch=pitch, roll=roll, absolute=float(height) + 12.0, relative=float(height) - 300
            ),
        }
        samples.write_photo(folder / name.replace(".png", ".jpg"), flown.photos[k], **spoil(k, fields))
    return folder


@pytest.fixture(scope="module")
def folder(flown, tmp_path_factory):
    return write_photos(tmp_path_factory.mktemp("photos") / "flight", flown)


@pytest.fixture(scope="module")
def report(folder, tmp_path_factory):
    output = tmp_path_factory.mktemp("out") / "points.laz"
    return reconstruct([folder], output, ReconstructOptions(workers=1)), output


def height_error(path, shift=(0.0, 0.0)):
    """Heights against the true ground, after a horizontal shift and without offset and tilt."""
    cloud = laspy.read(path)
    east = (np.asarray(cloud.x) - 500000.0) / 0.9996 - shift[0]
    north = (np.asarray(cloud.y) - 5316300.224) / 0.9996 - shift[1]
    error = np.asarray(cloud.z) - rendered.hills(east, north)
    error = error - np.median(error)
    design = np.column_stack([np.ones(east.size), east, north])
    for _ in range(10):
        good = np.abs(error) < 5 * np.median(np.abs(error))
        error = error - design @ np.linalg.lstsq(design[good], error[good], rcond=None)[0]
    return error


def test_a_folder_of_photos_becomes_points(folder, report, flown):
    described, output = report
    flight = described["flights"][0]
    assert flight["navigation"]["source"] == "photos"
    assert flight["navigation"]["angles"] == "drone-dji:GimbalYawDegree"
    assert described["method"] == "adjusted"
    assert flight["n_points"] > 300
    assert flight["reprojection_px"]["rms"] < 0.4
    # the lens is found, from a focal length of EXIF that is 3.6 % too long
    lens = flight["lens"]["lenses"][0]
    focal = flight["navigation"]["focal_px"] * np.exp(lens["focal"]["correction"])
    assert_allclose(focal, rendered.CAMERA.fx, rtol=0.02, atol=0)
    assert_allclose(159.5 + lens["cx"]["correction"], rendered.CAMERA.cx, rtol=0, atol=1.0)
    assert_allclose(lens["k1"]["correction"], rendered.CAMERA.k1, rtol=0, atol=0.02)
    # the GPS is off by metres as a whole, and the hills with it
    source = read_photo_source(folder)
    stated = rendered.ORIGIN.to_enu(*source.poses.origin.to_geodetic(source.poses.position).T)
    shift = (stated - flown.truth.position).mean(axis=0)
    assert np.hypot(*shift[:2]) > 1.0
    assert 1.4826 * np.median(np.abs(height_error(output, shift))) < 0.15


def test_a_second_run_takes_up_what_the_first_one_left(folder, report, tmp_path):
    _, output = report
    work = shutil.copytree(output.with_name("points.laz.work"), tmp_path / "work")
    source = read_photo_source(folder)
    run = FlightRun(source, FlightStore(work), OrientationSettings(workers=1), source.poses.origin)
    (work / "features.npz").unlink()
    assert run.rough is not None
    assert run.rough.n_pairs > 20
    assert_allclose(run.rough.start.intrinsics[0, 0], rendered.CAMERA.fx, rtol=0.06, atol=0)
    _ = run.oriented
    assert not (work / "features.npz").exists()
    assert run.calibrated() is run


def test_the_command_prints_one_document_and_a_dry_run_writes_nothing(folder, tmp_path):
    output = tmp_path / "points.laz"
    command = ["reconstruct", str(folder), "-o", str(output), "--dry-run", "--json"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0
    described = json.loads(result.stdout)
    assert described["flights"][0]["navigation"]["focal_from"] == "FocalLengthIn35mmFilm"
    assert described["flights"][0]["n_photos"] == 9
    assert list(tmp_path.iterdir()) == []


def test_methods_that_need_logs_are_refused_for_photos(folder, tmp_path):
    for method in ("smoothed", "paper"):
        with pytest.raises(ConfigError, match=f"--method {method} needs the logs of a flight"):
            reconstruct([folder], tmp_path / "p.laz", ReconstructOptions(method=method))
    with pytest.raises(ConfigError, match="--method given needs poses of another program"):
        reconstruct([folder], tmp_path / "p.laz", ReconstructOptions(method="given"))


def test_a_camera_file_of_another_size_is_refused(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "f")
    (copied / "camera.yaml").write_text(
        "image_width: 640\nimage_height: 480\n"
        "camera_matrix: {rows: 3, cols: 3, data: [520, 0, 320, 0, 520, 240, 0, 0, 1]}\n"
    )
    with pytest.raises(InputDataError, match=r"is 320 x 240 pixels, but camera\.yaml states 640 x 480"):
        reconstruct([copied], tmp_path / "p.laz", ReconstructOptions(dry_run=True))


def test_truncated_photos_are_named(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "f")
    path = copied / "p003.jpg"
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(InputDataError, match=r"p003\.jpg is truncated"):
        reconstruct([copied], tmp_path / "p.laz", ReconstructOptions(workers=1))


def test_photos_of_other_ground_do_not_overlap(flown, tmp_path):
    """Water, or photos that were mixed up: features there are, matches there are none."""
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, photo.shape).astype(np.uint8) for photo in flown.photos]
    other = replace(flown, photos=tuple(cv2.GaussianBlur(grey, (0, 0), 2) for grey in noise))
    folder = write_photos(tmp_path / "f", other)
    with pytest.raises(InputDataError, match=r"The photos do not overlap or show too little: only 1 of 9"):
        reconstruct([folder], tmp_path / "p.laz", ReconstructOptions(workers=1))


def write_colmap(folder, flown, scale=0.1):
    """The true poses as a model that floats: turned, scaled, shifted."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    name, values = to_colmap(rendered.CAMERA)
    numbers = " ".join(repr(float(v)) for v in values)
    (model / "cameras.txt").write_text(f"# Camera list\n1 {name} 320 240 {numbers}\n")
    turn = Rotation.from_rotvec([0.4, -0.2, 1.0]).as_matrix()
    lines = ["# Image list"]
    for k, photo in enumerate(flown.truth.names):
        rotation = (turn @ flown.truth.rotation[k]).T
        centre = scale * turn @ flown.truth.position[k] + [1.0, 2.0, 3.0]
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *(-rotation @ centre)))
        lines += [f"{k + 1} {pose} 1 {photo.replace('.png', '.jpg')}", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    east, north = np.meshgrid(np.linspace(-9, 9, 5), np.linspace(-9, 9, 5))
    ground = np.column_stack([east.ravel(), north.ravel(), rendered.hills(east, north).ravel()])
    points = scale * ground @ turn.T + [1.0, 2.0, 3.0]
    rows = [f"{k + 1} {p[0]} {p[1]} {p[2]} 128 128 128 0.3 1 0" for k, p in enumerate(points)]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return model


def test_exact_positions_place_a_model_exactly(folder, flown, tmp_path):
    posed = shutil.copytree(folder, tmp_path / "posed")
    write_colmap(posed, flown)
    geodetic = rendered.ORIGIN.to_geodetic(flown.truth.position)
    rows = [
        f"{name.replace('.png', '.jpg')} {lon:.9f} {lat:.9f} {height:.4f}"
        for name, (lat, lon, height) in zip(flown.truth.names, geodetic, strict=True)
    ]
    (posed / "geo.txt").write_text("EPSG:4979\n" + "\n".join(rows) + "\n")
    source = read_photo_source(posed)
    assert_allclose(source.navigation["scale"], 10.0, rtol=1e-4, atol=0)
    assert source.navigation["placed_by"] == "geo.txt"
    position = source.poses.origin.to_geodetic(source.poses.position)
    assert_allclose(rendered.ORIGIN.to_enu(*position.T), flown.truth.position, rtol=0, atol=0.01)
    assert_allclose(source.poses.rotation, flown.truth.rotation, rtol=0, atol=1e-3)
    output = tmp_path / "points.laz"
    described = reconstruct([posed], output, ReconstructOptions(workers=1))
    assert described["method"] == "given"
    cloud = laspy.read(output)
    assert len(cloud) > 300
    assert 0.02 < np.median(cloud["sigma_z"]) < 0.3
    assert 1.4826 * np.median(np.abs(height_error(output))) < 0.1


def test_a_model_is_placed_by_the_gps_of_the_photos(folder, flown, tmp_path):
    posed = shutil.copytree(folder, tmp_path / "posed")
    model = write_colmap(posed, flown)
    assert_allclose(read_colmap(model, posed).depth, 6.0, rtol=0.1, atol=0)
    source = read_flight_source(posed)
    assert source.is_known
    assert_allclose(source.navigation["scale"], 10.0, rtol=0.15, atol=0)
    assert np.all(np.array(source.navigation["left_m"]) < 2.5)
    assert source.poses.common_covariance is not None


def test_models_at_earth_centred_coordinates_place_themselves(folder, flown, tmp_path):
    posed = shutil.copytree(folder, tmp_path / "posed")
    model = write_colmap(posed, flown)
    frame, lines = rendered.ORIGIN, ["# Image list"]
    origin = _ecef(frame)
    for k, photo in enumerate(flown.truth.names):
        rotation = (frame.rotation_from_ecef.T @ flown.truth.rotation[k]).T
        centre = origin + flown.truth.position[k] @ frame.rotation_from_ecef
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *(-rotation @ centre)))
        lines += [f"{k + 1} {pose} 1 {photo.replace('.png', '.jpg')}", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").unlink()
    source = read_photo_source(posed)
    assert source.navigation["placed_by"] == "Earth-centred coordinates"
    position = source.poses.origin.to_geodetic(source.poses.position)
    assert_allclose(rendered.ORIGIN.to_enu(*position.T), flown.truth.position, rtol=0, atol=1e-3)


def test_models_of_several_lenses_keep_the_lens_of_each_photo(folder, flown, tmp_path):
    posed = shutil.copytree(folder, tmp_path / "posed")
    model = write_colmap(posed, flown)
    cameras, images = model / "cameras.txt", model / "images.txt"
    cameras.write_text(cameras.read_text() + "5 SIMPLE_PINHOLE 320 240 530.0 160.0 120.0\n")
    images.write_text(images.read_text().replace(" 1 p004.jpg", " 5 p004.jpg"))
    source = read_photo_source(posed)
    run = FlightRun(source, FlightStore(tmp_path / "w"), OrientationSettings(), source.poses.origin)
    assert_allclose([run.block.lens_of(3)[0], run.block.lens_of(4)[0]], [520.0, 530.0], rtol=0, atol=0)
    assert len(run.photos) == 9
    cameras.write_text(cameras.read_text().replace("320 240 530.0", "640 480 530.0"))
    with pytest.raises(InputDataError, match="has cameras of 320 x 240 and of 640 x 480 pixels"):
        read_photo_source(posed)


def test_models_of_opensfm_stand_where_their_reference_says(folder, flown, tmp_path, caplog):
    posed = shutil.copytree(folder, tmp_path / "posed")
    lens = rendered.CAMERA
    camera = {
        "projection_type": "brown", "width": 320, "height": 240, "focal_x": lens.fx / 320, "focal_y": lens.fy / 320,
        "c_x": (lens.cx - 159.5) / 320, "c_y": (lens.cy - 119.5) / 320,
        **{name: getattr(lens, name) for name in ("k1", "k2", "p1", "p2", "k3")},
    }  # fmt: skip
    shots = {}
    for k, name in enumerate(flown.truth.names):
        R = flown.truth.rotation[k].T
        shots[name.replace(".png", ".jpg")] = {
            "rotation": Rotation.from_matrix(R).as_rotvec().tolist(),
            "translation": (-R @ flown.truth.position[k]).tolist(),
            "camera": "v2 dji",
            "capture_time": float(k),
        }
    reference = {"latitude": 48.0, "longitude": 9.0, "altitude": 300.0}
    (posed / "opensfm").mkdir()
    file = posed / "opensfm" / "reconstruction.json"
    file.write_text(json.dumps([{"cameras": {"v2 dji": camera}, "shots": shots, "points": {}}]))
    (posed / "opensfm" / "reference_lla.json").write_text(json.dumps(reference))
    source = read_photo_source(posed, camera_file=tmp_path / "camera.yaml")
    assert "camera.yaml is not used: the model" in caplog.text
    assert source.poses.origin == rendered.ORIGIN
    assert_allclose(source.poses.position, flown.truth.position, rtol=0, atol=1e-9)
    assert_allclose(source.poses.rotation, flown.truth.rotation, rtol=0, atol=1e-9)
    for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"):
        assert_allclose(getattr(source.camera, name), getattr(lens, name), rtol=1e-12, atol=1e-12)
    assert source.navigation["placed_by"] == "reference_lla"


def _ecef(frame):
    from changedetect.navigation import frame as module

    return module._ecef(frame.latitude, frame.longitude, frame.height)


def test_large_photos_are_read_reduced(flown, tmp_path):
    """6400 x 4800 pixels become 1600 x 1200, with the lens and the marks of control points."""
    folder = tmp_path / "f"
    large = [np.asarray(cv2.resize(photo, (6400, 4800), interpolation=cv2.INTER_NEAREST)) for photo in flown.photos[:3]]
    write_photos(folder, replace(flown, photos=tuple(large), truth=flown.truth.select(flown.truth.names[:3])))
    source = read_photo_source(folder)
    assert source.reduction == 4
    assert (source.camera.width, source.camera.height) == (1600, 1200)
    assert_allclose(source.camera.cx, 799.5, rtol=0, atol=1e-9)
    run = FlightRun(source, FlightStore(tmp_path / "w"), OrientationSettings(), source.poses.origin)
    grey = run.photos(0)
    assert grey.shape == (1200, 1600)
    expected = cv2.resize(flown.photos[0], (1600, 1200), interpolation=cv2.INTER_NEAREST)
    assert np.median(np.abs(grey.astype(int) - expected.astype(int))) <= 3
    marks = "EPSG:4979\n9.0 48.0 300.0 801.5 401.5 p000.jpg a\n9.0 48.0 300.0 100 100 p001.jpg a\n"
    (tmp_path / "gcp.txt").write_text(marks)
    control = pipeline._control(ReconstructOptions(control=tmp_path / "gcp.txt"), source)
    assert_allclose(control[0].pixel[0], [200.0, 100.0], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_two_flights_of_photos_are_adjusted_together(flown, tmp_path):
    """A mound of 0.8 m between them; metres of GPS and percents of lens do not show in the difference."""
    later = rendered.fly(1, ground=rendered.raised_hills, n_photos=3, prefix="q")
    folders = [write_photos(tmp_path / "a", flown, seed=3), write_photos(tmp_path / "b", later, seed=4)]
    described = reconstruct(folders, tmp_path / "out", ReconstructOptions(workers=2))
    assert described["together"]["n_moved_points"] > 50
    first, second = (laspy.read(tmp_path / "out" / f"{name}.laz") for name in "ab")
    tree = cKDTree(np.column_stack([first.x, first.y]))
    distance, near = tree.query(np.column_stack([second.x, second.y]), k=6)
    close = distance[:, 5] < 1.0
    difference = np.asarray(second.z)[close] - np.median(np.asarray(first.z)[near[close]], axis=1)
    assert abs(np.median(difference)) < 0.05
    assert 1.4826 * np.median(np.abs(difference - np.median(difference))) < 0.08
    assert 0.4 < np.percentile(difference, 99) < 1.0


@pytest.mark.real
@pytest.mark.slow
def test_brighton_beach_is_reconstructed_to_decimetres(tmp_path):
    if not (DATA / "uav_brighton_beach").is_dir():
        pytest.skip(f"the photos of Brighton Beach are not in {DATA}; set CHANGEDETECT_DATA")
    from benchmarks import photos as benchmark

    output = tmp_path / "points.laz"
    described = reconstruct([DATA / "uav_brighton_beach"], output, ReconstructOptions(workers=2))
    assert described["flights"][0]["n_photos"] == 18
    bending = 1e-8 * np.eye(3)  # a tenth of a millimetre per square metre
    points = benchmark.read_points(output)
    judged = benchmark.compare(points, DATA / "uav_brighton_beach" / "model.laz", bending, bending)
    assert judged.nmad <= 0.30


@pytest.mark.real
@pytest.mark.slow
def test_fixed_wing_photos_of_seneca_run_through(tmp_path):
    if not (DATA / "uav_seneca").is_dir():
        pytest.skip(f"the photos of Seneca are not in {DATA}; set CHANGEDETECT_DATA")
    output = tmp_path / "points.laz"
    reconstruct([DATA / "uav_seneca"], output, ReconstructOptions(workers=2))
    described = json.loads(output.with_suffix(".report.json").read_text())
    assert described["flights"][0]["n_points"] > 4000
    cloud = laspy.read(output)
    # fields, level within metres, about 70 m below the aircraft
    assert np.ptp(np.percentile(cloud.z, [5, 95])) < 12.0
