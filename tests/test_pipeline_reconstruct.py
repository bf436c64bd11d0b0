"""Flights through the pipeline: steps kept and used again, points written, bad input named, the simulated flight."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from numpy.testing import assert_allclose
from photogrammetry import rendered
from typer.testing import CliRunner

from changedetect.cli.app import app
from changedetect.errors import InputDataError, MissingInputError, OutputExistsError, UsageError
from changedetect.navigation.frame import LocalFrame
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.orientation import OrientationSettings
from changedetect.photogrammetry.ties import TieSettings
from changedetect.photogrammetry.tracks import TrackSettings
from changedetect.pipeline import reconstruct as pipeline
from changedetect.pipeline.flight_run import FlightRun, FlightSource, read_flight_source
from changedetect.pipeline.flight_store import FlightStore, key_of
from changedetect.pipeline.photo_agreement import check_agreement
from changedetect.pipeline.reconstruct import ReconstructOptions, output_crs, reconstruct

DATA = Path(os.environ.get("CHANGEDETECT_DATA", "../shared/data"))
SIMULATED = DATA / "flight_sim"
SETTINGS = OrientationSettings(tracks=TrackSettings(n_features=400), ties=TieSettings(n_features=500))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Rendered photos as files, with poses as navigation gives them."""
    folder = tmp_path_factory.mktemp("photos")
    flown = rendered.fly(0, n_photos=4)
    for name, grey in zip(flown.truth.names, flown.photos, strict=True):
        cv2.imwrite(str(folder / name), grey)
    poses = rendered.perturbed(flown.truth, 100)
    paths = tuple(folder / name for name in poses.names)
    return FlightSource("flight", poses, rendered.CAMERA, paths, 0.0, {})


def a_run(source, directory):
    return FlightRun(source, FlightStore(directory), SETTINGS, source.poses.origin)


@pytest.fixture(scope="module")
def finished(source, tmp_path_factory):
    directory = tmp_path_factory.mktemp("work")
    run = a_run(source, directory)
    assert run.oriented.adjustment.points.size > 300
    return run


def test_steps_are_kept_and_used_again(source, finished, tmp_path):
    again = a_run(source, shutil.copytree(finished.store.directory, tmp_path / "work"))
    (tmp_path / "work" / "features.npz").unlink()  # not needed once the rest is there
    for name in ("points", "camera_covariance", "weight", "origin"):
        expected = getattr(finished.oriented.adjustment, name)
        assert_allclose(getattr(again.oriented.adjustment, name), expected, rtol=0, atol=0)
    assert_allclose(again.matching.tracks.pixel, finished.matching.tracks.pixel, rtol=0, atol=0)
    assert len(again.matching.pairs) == len(finished.matching.pairs)
    assert not (tmp_path / "work" / "features.npz").exists()


def test_damaged_steps_are_made_anew(source, finished, tmp_path, caplog):
    again = a_run(source, shutil.copytree(finished.store.directory, tmp_path / "work"))
    path = tmp_path / "work" / "features.npz"
    path.write_bytes(path.read_bytes()[:1000])
    assert_allclose(again.features[3].pixel, finished.features[3].pixel, rtol=0, atol=0)
    assert "damaged" in caplog.text
    assert FlightStore(tmp_path / "work").load_features(again.photo_key) is not None


def test_steps_of_other_poses_or_photos_are_not_used(source, finished):
    moved = replace(source.poses, position=source.poses.position + 1.0)
    other = a_run(replace(source, poses=moved), finished.store.directory)
    assert other.photo_key == finished.photo_key
    assert other.matching_key != finished.matching_key
    assert finished.store.load_matching(other.matching_key) is None
    fewer = a_run(replace(source, paths=source.paths[::-1]), finished.store.directory)
    assert fewer.photo_key != finished.photo_key


def test_keys_tell_arrays_settings_and_values_apart():
    assert key_of(np.zeros(3)) != key_of(np.zeros((3, 1)))
    assert key_of(SETTINGS) == key_of(replace(SETTINGS))
    assert key_of(SETTINGS) != key_of(replace(SETTINGS, min_views=4))
    assert key_of("a", "b") != key_of("ab")


def test_points_are_written_with_sigma_and_views(source, finished, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "_runs", lambda *_: [finished])  # logs are not part of this test
    output = tmp_path / "points.laz"
    report = reconstruct([tmp_path], output, ReconstructOptions(crs="EPSG:32632+4979"))
    cloud = laspy.read(output)
    assert len(cloud) == report["flights"][0]["n_points"] > 300
    assert int(np.min(cloud["n_views"])) >= 3
    assert 0 < np.median(cloud["sigma_z"]) < 0.2
    assert json.loads((tmp_path / "points.report.json").read_text()) == json.loads(json.dumps(report))
    # 48 N 9 E is the middle of zone 32: easting is 500 km plus east, but for the scale
    assert_allclose(np.median(cloud.x), 500000 + np.median(finished.oriented.adjustment.points[:, 0]), rtol=0, atol=0.1)
    z = cloud.z - 300 - rendered.hills((cloud.x - 500000) / 0.9996, finished.oriented.adjustment.points[:, 1])
    assert np.median(np.abs(z - np.median(z))) < 0.1
    with pytest.raises(OutputExistsError, match="--overwrite"):
        reconstruct([tmp_path], output, ReconstructOptions())


def turned(adjustment, in_camera):
    """The adjustment with attitudes that deviate by rotations, rad, about the axes of the cameras."""
    deviation = np.zeros_like(adjustment.pose_correction)
    deviation[:, 3:] = np.einsum("nij,nj->ni", adjustment.block.rotation, in_camera)
    return replace(adjustment, pose_correction=deviation, prior_chi2=500.0)


def test_a_camera_mounted_askew_is_warned_of_and_photos_of_another_flight_are_refused(finished, caplog):
    adjustment = finished.oriented.adjustment
    images, points = np.arange(len(adjustment.block)), np.arange(len(adjustment.points))
    askew = np.tile(np.radians([6.0, -6.0, 6.0]), (images.size, 1))
    check_agreement(finished, turned(adjustment, askew), images, points)
    assert "contradict each other" in caplog.text
    others = np.random.default_rng(0).normal(0.0, np.radians(3.0), (images.size, 3))
    with pytest.raises(InputDataError, match=r"flight: from photo to photo .*put those of this flight into its folder"):
        check_agreement(finished, turned(adjustment, others), images, points)


def test_photos_that_leave_hardly_any_points_are_refused(finished):
    adjustment = finished.oriented.adjustment
    with pytest.raises(InputDataError, match=r"only 4 points fit the photos.*in the order that their list says"):
        check_agreement(finished, adjustment, np.arange(len(adjustment.block)), np.arange(4))


def test_flights_whose_photos_have_the_same_names_keep_their_own(tmp_path, monkeypatch):
    runs, truths = [], []
    for k in range(2):
        folder = tmp_path / f"flight{k}"
        folder.mkdir()
        flown = rendered.fly(k, n_photos=3)
        for name, grey in zip(flown.truth.names, flown.photos, strict=True):
            cv2.imwrite(str(folder / name), grey)
        poses = rendered.perturbed(flown.truth, 100 + k)
        paths = tuple(folder / name for name in poses.names)
        runs.append(a_run(FlightSource(f"flight{k}", poses, rendered.CAMERA, paths, 0.0, {}), tmp_path / f"work{k}"))
        truths.append(flown.truth.position)
    monkeypatch.setattr(pipeline, "_runs", lambda *_: runs)  # logs are not part of this test
    folders = [tmp_path / "flight0", tmp_path / "flight1"]
    reconstruct(folders, tmp_path / "out", ReconstructOptions(crs="EPSG:32632+4979"))
    for k, run in enumerate(runs):
        found = CameraPoses.load(run.store.directory / "adjusted_poses.nc").position
        own, other = (np.std(found - truth, axis=0)[:2].max() for truth in (truths[k], truths[1 - k]))
        assert own < 0.12
        assert other > 0.3


def test_crs_is_the_users_then_the_sites_then_utm(tmp_path):
    south = LocalFrame(-33.89, 151.19, 40.0)
    assert output_crs(tmp_path, south, None) == "EPSG:32756+4979"
    assert output_crs(tmp_path, LocalFrame(48.0, 9.0, 0.0), None) == "EPSG:32632+4979"
    (tmp_path / "site.json").write_text('{"crs": "EPSG:7856+4979"}')
    assert output_crs(tmp_path, south, None) == "EPSG:7856+4979"
    assert output_crs(tmp_path, south, "EPSG:32756+4979") == "EPSG:32756+4979"


def test_a_folder_that_does_not_exist_ends_with_its_exit_code(tmp_path):
    result = CliRunner().invoke(app, ["reconstruct", str(tmp_path / "nowhere"), "-o", str(tmp_path / "p.laz")])
    assert isinstance(result.exception, MissingInputError)
    assert "nowhere" in str(result.exception)


def test_outputs_of_an_unknown_kind_and_flights_of_one_name_are_refused(tmp_path):
    with pytest.raises(UsageError, match=r"points\.csv' does not end in \.laz or \.las"):
        reconstruct([tmp_path], tmp_path / "points.csv", ReconstructOptions())
    with pytest.raises(UsageError, match=r"points\.laz' looks like a file\. 2 flights"):
        reconstruct([tmp_path / "a", tmp_path / "b"], tmp_path / "points.laz", ReconstructOptions())
    with pytest.raises(InputDataError, match="different names; given: a, a"):
        reconstruct([tmp_path / "x" / "a", tmp_path / "y" / "a"], tmp_path / "out", ReconstructOptions())


@pytest.fixture(scope="module")
def simulated_folder(tmp_path_factory):
    """The first epoch of the simulated flight, in a folder that may be written to."""
    if not SIMULATED.is_dir():
        pytest.skip(f"the simulated flight is not in {DATA}; set CHANGEDETECT_DATA")
    folder = tmp_path_factory.mktemp("flight") / "epoch1"
    shutil.copytree(SIMULATED / "epoch1", folder)
    for name in ("camera.yaml", "site.json"):
        shutil.copy(SIMULATED / name, folder / name)
    for path in folder.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    return folder


@pytest.mark.real
def test_a_dry_run_checks_everything_and_writes_nothing(simulated_folder, tmp_path):
    report = reconstruct([simulated_folder], tmp_path / "p.laz", ReconstructOptions(dry_run=True))
    assert report["flights"][0]["n_photos"] == 47
    assert list(tmp_path.iterdir()) == []


@pytest.mark.real
def test_missing_lists_photos_and_cameras_are_named(simulated_folder, tmp_path):
    folder = shutil.copytree(simulated_folder, tmp_path / "flight")
    camera = folder / "camera.yaml"
    camera.write_text(camera.read_text().replace("image_width: 1024", "image_width: 1100"))
    with pytest.raises(InputDataError, match=r"1024 x 768 pixels, but camera\.yaml states 1100 x 768"):
        reconstruct([folder], tmp_path / "p.laz", ReconstructOptions())
    camera.unlink()
    with pytest.raises(InputDataError, match=r"no camera\.yaml"):
        read_flight_source(folder)
    (folder / "images.csv").unlink()
    with pytest.raises(InputDataError, match=r"no images\.csv"):
        read_flight_source(folder)


@pytest.mark.real
@pytest.mark.slow
def test_simulated_flight_is_reconstructed_to_a_decimetre(tmp_path):
    if not SIMULATED.is_dir():
        pytest.skip(f"the simulated flight is not in {DATA}; set CHANGEDETECT_DATA")
    from benchmarks import flights as benchmark

    truth, errors = benchmark.Truth(1), {}
    for method in ("paper", "smoothed", "adjusted"):
        output = tmp_path / f"{method}.laz"
        work = tmp_path / ("paper_work" if method == "paper" else "work")
        report = reconstruct([SIMULATED / "epoch1"], output, ReconstructOptions(method=method, work=work))
        points, sigma, _ = benchmark.read_enu(output, report["crs"])
        good, error, shifted, _ = benchmark.judge(truth, points)
        errors[method] = benchmark.nmad(error), benchmark.nmad(shifted / sigma[good])
    assert 0.7 < errors["paper"][0] < 1.4
    assert errors["smoothed"][0] <= 0.35
    assert errors["adjusted"][0] <= 0.10
    assert 0.85 < errors["adjusted"][1] < 1.2
