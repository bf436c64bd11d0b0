"""Folders of photos: priors from what they state, lists beside them, and everything that does not belong together."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import photo_samples as samples
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.photo_folder import is_photo_folder, read_photo_folder
from changedetect.photogrammetry.priors import pose_information

CAMERA = """image_width: 160
image_height: 90
camera_matrix: {rows: 3, cols: 3, data: [92.0, 0, 79.5, 0, 92.0, 44.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [0.01, 0, 0, 0, 0]}
"""


def photos(folder: Path, n=5, **fields):
    """A line of photos 10 m apart to the north; a field may be a function of the photo's number."""
    folder.mkdir(exist_ok=True)
    for k in range(n):
        mine = {"latitude": 48.0 + k * 8.993e-5, "longitude": 9.0, "time": f"2024:05:01 10:00:{2 * k:02d}"}
        mine |= {"xmp": samples.dji(yaw=10.0, absolute=340.0 + 0.1 * k, relative=40.0 + 0.1 * k), "altitude": 340.0}
        mine |= {name: value(k) if callable(value) else value for name, value in fields.items()}
        grey = np.full((90, 160), 100 + k, np.uint8)
        samples.write_photo(folder / f"DJI_{k + 1:04d}.JPG", mine.pop("grey", grey), **mine)
    return folder


def test_photos_become_poses_with_honest_priors(tmp_path, caplog):
    found = read_photo_folder(photos(tmp_path / "f"))
    poses = found.poses
    assert poses.names[0] == "DJI_0001.JPG"
    step = np.diff(poses.position, axis=0)
    assert_allclose(step, np.tile([0.0, 10.0, 0.1], (4, 1)), rtol=0, atol=0.02)
    # looking down, the top of the photo to 10 degrees east of north
    top = poses.rotation[0] @ [0, -1, 0]
    assert_allclose(top, [np.sin(np.radians(10)), np.cos(np.radians(10)), 0.0], rtol=0, atol=2e-3)
    assert_allclose(np.sqrt(np.diag(poses.covariance[0]))[:3], [1.5, 1.5, 0.3], rtol=0, atol=1e-9)
    assert_allclose(np.sqrt(np.diag(poses.common_covariance))[:3], [3.0, 3.0, 30.0], rtol=0, atol=1e-9)
    assert "count from a level that is not known" in caplog.text
    assert found.has_heading.all()
    assert found.lens_std is not None
    assert found.description["angles"] == "drone-dji:GimbalYawDegree"


def test_photos_come_in_the_order_of_time_whatever_their_names(tmp_path):
    found = read_photo_folder(photos(tmp_path / "f", time=lambda k: f"2024:05:01 10:00:{20 - 2 * k:02d}"))
    assert found.poses.names[0] == "DJI_0005.JPG"
    assert np.all(np.diff(found.poses.time) > 0)


def test_photos_without_a_time_go_by_their_names(tmp_path):
    found = read_photo_folder(photos(tmp_path / "f", time=lambda k: None if k == 3 else "2024:05:01 10:00:00"))
    assert found.poses.names == tuple(sorted(found.poses.names))
    assert np.all(np.isfinite(pose_information(found.poses, correlation_time=0.0)))


def test_rtk_heights_need_no_excuse(tmp_path, caplog):
    def xmp(k):
        extra = samples.RTK.format(latitude=48.0 + k * 8.993e-5, longitude=9.0)
        return samples.dji(extra=extra, absolute=340.0)

    found = read_photo_folder(photos(tmp_path / "f", xmp=xmp))
    assert found.poses.common_covariance is None
    assert_allclose(np.sqrt(np.diag(found.poses.covariance[2]))[:3], [0.01254, 0.01132, 0.02551], rtol=1e-9, atol=0)
    assert caplog.text == ""


def test_altitudes_above_sea_level_are_raised_by_the_geoid_of_site_json(tmp_path, caplog):
    folder = photos(tmp_path / "f", xmp=samples.PIX4D.format(yaw=0, pitch=0, roll=0))
    low = read_photo_folder(folder)
    assert "counts altitudes from sea level and the geoid there is not known" in caplog.text
    assert np.sqrt(low.poses.common_covariance[2, 2]) == 30.0
    (folder / "site.json").write_text(json.dumps({"geoid_separation_m": 47.5}))
    high = read_photo_folder(folder)
    assert_allclose(high.poses.origin.height - low.poses.origin.height, 47.5, rtol=0, atol=1.0)
    assert high.poses.common_covariance[2, 2] < 40.0


def test_altitudes_that_jump_give_way_to_relative_ones(tmp_path, caplog):
    found = read_photo_folder(
        photos(tmp_path / "f", xmp=lambda k: samples.dji(absolute=340.0 + 80.0 * (k == 2), relative=40.0))
    )
    assert_allclose(np.diff(found.poses.position[:, 2]), 0.0, rtol=0, atol=0.01)
    assert "disagree by 80 m in DJI_0003.JPG" in caplog.text


def test_pitch_counted_from_the_wrong_zero_is_found(tmp_path, caplog):
    right = read_photo_folder(photos(tmp_path / "right"))
    xmp = samples.PIX4D.format(yaw=10.0, pitch=-89.9, roll=0.0)  # nadir 0 stated, -90 given
    wrong = read_photo_folder(photos(tmp_path / "wrong", xmp=xmp))
    assert_allclose(wrong.poses.rotation, right.poses.rotation, rtol=0, atol=1e-6)
    assert "Camera:Yaw: a pitch of -90 degrees would look away from the ground if 0 meant straight down" in caplog.text
    caplog.clear()
    other = read_photo_folder(photos(tmp_path / "other", xmp=samples.dji(yaw=10.0, pitch=0.1)))
    assert_allclose(other.poses.rotation, right.poses.rotation, rtol=0, atol=5e-3)
    assert "if 0 meant the horizon" in caplog.text


def test_photos_of_the_horizon_are_left_out(tmp_path, caplog):
    found = read_photo_folder(photos(tmp_path / "f", xmp=lambda k: samples.dji(pitch=-5.0 if k == 0 else -90.0)))
    assert len(found.poses) == 4
    assert "1 of 5 photos look at the horizon and are left out: DJI_0001.JPG" in caplog.text
    with pytest.raises(InputDataError, match=r"The photos do not look down: .* pitch of 75 degrees"):
        read_photo_folder(photos(tmp_path / "g", xmp=samples.dji(pitch=75.0)))


def test_photos_without_angles_look_down_with_headings_to_be_found(tmp_path):
    found = read_photo_folder(photos(tmp_path / "f", xmp="", altitude_ref=2))
    assert not found.has_heading.any()
    assert_allclose(found.poses.rotation[0] @ [0, 0, 1], [0, 0, -1], rtol=0, atol=1e-12)
    assert np.sqrt(found.poses.covariance[0, 5, 5]) > 3.0


def test_a_camera_file_states_the_lens(tmp_path, caplog):
    folder = photos(tmp_path / "f")
    (folder / "camera.yaml").write_text(CAMERA)
    found = read_photo_folder(folder)
    assert (found.camera.fx, found.camera.k1, found.lens_std) == (92.0, 0.01, None)
    assert "focal length" not in caplog.text
    (folder / "camera.yaml").write_text(CAMERA.replace("92.0", "150.0"))
    read_photo_folder(folder)
    assert "states a focal length of 150 pixels" in caplog.text


def test_places_come_from_geo_txt_where_there_is_one(tmp_path, caplog):
    folder = photos(tmp_path / "f", latitude=None, altitude=None, xmp="")
    lines = [f"DJI_{k:04d}.JPG 9.0 {48 + k * 1e-4:.6f} {340 + k} 90 1.0 -2.0 0.5 0.8" for k in range(1, 6)]
    (folder / "geo.txt").write_text("EPSG:4326\n" + "\n".join(lines) + "\n")
    found = read_photo_folder(folder)
    assert_allclose(np.diff(found.poses.position[:, 2]), 1.0, rtol=0, atol=0.01)
    assert_allclose(np.sqrt(np.diag(found.poses.covariance[0]))[:3], [0.5, 0.5, 0.8], rtol=1e-9, atol=0)
    assert_allclose((found.poses.rotation[0] @ [0, -1, 0])[:2], [1.0, 0.0], rtol=0, atol=0.02)
    assert found.has_heading.all()
    (folder / "geo.txt").write_text("EPSG:4326\n" + "\n".join(lines) + "\nDJI_0099.JPG 9 48 340\n")
    with pytest.raises(MissingInputError, match=r"geo\.txt names 1 photo\(s\) that are not in the folder: DJI_0099"):
        read_photo_folder(folder)


def test_places_come_from_a_table_where_there_is_one(tmp_path):
    folder = photos(tmp_path / "f", latitude=None, altitude=None, xmp="")
    rows = [f"DJI_{k:04d}.JPG,{48 + k * 1e-4:.6f},9.0,{340 + k},90,-90,0,0.5" for k in range(1, 6)]
    header = "photo,lat_deg,lon_deg,alt_m,gimbal_yaw_deg,gimbal_pitch_deg,gimbal_roll_deg,sigma_h_m"
    (folder / "photos.csv").write_text("\n".join([header, *rows]) + "\n")
    found = read_photo_folder(folder)
    assert_allclose((found.poses.rotation[0] @ [0, -1, 0])[:2], [1.0, 0.0], rtol=0, atol=1e-9)
    assert found.description["positions"] == "photos.csv"
    (folder / "photos.csv").write_text("photo,lat_deg,lon_deg\n" + "DJI_0001.JPG,48,9\n")
    with pytest.raises(InputDataError, match=r"photos\.csv needs one of the columns alt_m"):
        read_photo_folder(folder)


def test_places_come_from_an_mrk_file_where_there_is_one(tmp_path):
    folder = photos(tmp_path / "f", xmp=samples.dji(yaw=10.0))
    line = (
        "{n}\t400373.4888{n}\t[2264]\t   -40,N\t     0,E\t    86,V\t{lat:.8f},Lat\t9.00000000,Lon\t340.500,Ellh\t"
        "0.012000, 0.013000, 0.025000\t50,Q\n"
    )
    (folder / "100_0001_Timestamp.MRK").write_text("".join(line.format(n=n, lat=48 + n * 1e-4) for n in range(1, 6)))
    found = read_photo_folder(folder)
    assert_allclose(np.sqrt(np.diag(found.poses.covariance[0]))[:3], [0.013, 0.012, 0.025], rtol=1e-9, atol=0)
    assert found.poses.common_covariance is None
    assert found.description["heights"] == "WGS 84 ellipsoid"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"latitude": None},
            r"5 of 5 photos in .* have no GPS position in EXIF \(DJI_0001\.JPG, \.\.\.\)\. .*geo\.txt",
        ),
        (
            {"latitude": lambda k: 48.1 if k == 4 else 48.0 + k * 9e-5},
            r"DJI_0005\.JPG and 0 more of 5 photos .* 11,\d+ m",
        ),
        (
            {"time": lambda k: f"2024:05:{1 + (k > 2):02d} 10:00:{k:02d}"},
            r"DJI_0004\.JPG was taken 24 hours after the photo before it",
        ),
        ({"model": lambda k: "FC6310R" if k == 1 else "FC300S"}, r"DJI_0002\.JPG is of DJI FC6310R, 4 of 5"),
        (
            {"grey": lambda k: np.zeros((160, 90) if k == 3 else (90, 160), np.uint8)},
            r"DJI_0004\.JPG is of 90 x 160 pixels, 4 of 5 photos are of 160 x 90",
        ),
        ({"focal35": None, "focal": None}, r"DJI_0001\.JPG and 4 more state no focal length in EXIF.*--camera"),
        ({"focal35": lambda k: 20 + 15 * (k == 2)}, r"DJI_0003\.JPG has a focal length of .*the lens was zoomed"),
        ({"xmp": "", "altitude": None}, r"DJI_0001\.JPG states no altitude.*geo\.txt"),
        ({"n": 2}, r"has 2 photos; at least 3 that overlap are needed"),
    ],
)
def test_photos_that_cannot_be_used_are_named_with_the_fix(tmp_path, fields, message):
    with pytest.raises(InputDataError, match=message):
        read_photo_folder(photos(tmp_path / "f", **fields))


def test_a_few_photos_without_gps_are_left_out_with_a_warning(tmp_path, caplog):
    found = read_photo_folder(photos(tmp_path / "f", latitude=lambda k: None if k == 1 else 48.0 + k * 9e-5))
    assert "DJI_0002.JPG" not in found.poses.names
    assert "1 of 5 photos have no GPS position and are left out: DJI_0002.JPG" in caplog.text


def test_copies_are_refused(tmp_path):
    folder = photos(tmp_path / "f")
    shutil.copy(folder / "DJI_0002.JPG", folder / "DJI_0002 (copy).JPG")
    with pytest.raises(InputDataError, match=r"DJI_0002.*is a copy of DJI_0002"):
        read_photo_folder(folder)


def test_loss_of_rtk_in_flight_is_refused(tmp_path):
    def xmp(k):
        flag = samples.RTK.format(latitude=48.0 + k * 9e-5, longitude=9.0).replace('"50"', '"16"' if k == 3 else '"50"')
        return samples.dji(extra=flag)

    with pytest.raises(InputDataError, match=r"DJI_0004\.JPG states its altitude above an unknown level"):
        read_photo_folder(photos(tmp_path / "f", xmp=xmp))


def test_folders_with_logs_or_without_photos_are_not_folders_of_photos(tmp_path):
    assert is_photo_folder(photos(tmp_path / "f"))
    assert not is_photo_folder(tmp_path / "nowhere")
    (tmp_path / "f" / "gps.csv").touch()
    assert not is_photo_folder(tmp_path / "f")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingInputError, match=r"neither the logs of a flight .* nor photos"):
        read_photo_folder(tmp_path / "empty")
