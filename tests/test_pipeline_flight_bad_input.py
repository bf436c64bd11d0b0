"""Flights that cannot be used end in a message that names file and fix, from `add` and `reconstruct` alike."""

from __future__ import annotations

import json
import re
import shutil

import cv2
import numpy as np
import pytest
from small_flights import CRS
from small_surveys import snapshot

from changedetect.cli import main
from changedetect.errors import InputDataError
from changedetect.pipeline.reconstruct import ReconstructOptions, reconstruct
from changedetect.pipeline.simulate_flight import simulate_flights
from changedetect.synthetic.flight_photos import FlightDesign


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A flight whose logs are fine; its photos are too small to be worth much."""
    folder = tmp_path_factory.mktemp("flight")
    simulate_flights(folder, FlightDesign(n_epochs=1, n_strips=2, n_photos=5, size=(240, 200)), seed=2)
    for name in ("camera.yaml", "site.json"):
        shutil.move(folder / name, folder / "epoch1" / name)
    return folder / "epoch1"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """An empty programme."""
    folder = tmp_path_factory.mktemp("programme") / "site"
    assert main(["init", str(folder), "--crs", CRS, "--quiet"]) == 0
    return folder


class Log:
    """A log as a table that can be spoilt and written back."""

    def __init__(self, path):
        self.path = path
        lines = path.read_text().splitlines()
        self.header = lines[0]
        self.names = [line.split(",")[0] for line in lines[1:]]
        self.is_named = not self.names[0].replace(".", "").isdigit()
        first = 1 if self.is_named else 0
        self.rows = np.array([[float(v) for v in line.split(",")[first:]] for line in lines[1:]])

    def write(self):
        cells = [",".join(f"{v:.9f}" for v in row) for row in self.rows]
        if self.is_named:
            cells = [f"{name},{row}" for name, row in zip(self.names, cells, strict=True)]
        self.path.write_text("\n".join([self.header, *cells]) + "\n")


def rates_in_degrees(flight):
    log = Log(flight / "imu.csv")
    log.rows[:, 1:4] = np.degrees(log.rows[:, 1:4])
    log.write()


def forces_in_g(flight):
    log = Log(flight / "imu.csv")
    log.rows[:, 4:7] /= 9.80665
    log.write()


def gap_in_imu(flight):
    log = Log(flight / "imu.csv")
    log.rows = np.delete(log.rows, slice(1500, 1600), axis=0)
    log.write()


def doubled_stamps(flight):
    log = Log(flight / "imu.csv")
    log.rows[700:704, 0] = log.rows[699, 0]
    log.write()


def saturated_imu(flight):
    log = Log(flight / "imu.csv")
    log.rows[:, 3] = np.clip(log.rows[:, 3], -0.1, 0.1)
    log.write()


def no_fix(flight):
    log = Log(flight / "gps.csv")
    log.rows[:, 1:3] = 0.0
    log.write()


def jumping_gps(flight):
    log = Log(flight / "gps.csv")
    rng = np.random.default_rng(0)
    jumps = np.repeat(rng.normal(0.0, 300.0, len(log.rows) // 5 + 1), 5)[: len(log.rows)]
    log.rows[:, 1] += jumps / 111_000.0
    log.write()


def gps_clock(flight):
    log = Log(flight / "gps.csv")
    log.rows[:, 0] += 3.0
    log.write()


def gps_of_another_day(flight):
    log = Log(flight / "gps.csv")
    log.rows[:, 0] += 86_400.0
    log.write()


def camera_an_hour_late(flight):
    log = Log(flight / "images.csv")
    log.rows[:, 0] += 3600.0
    log.write()


def camera_seconds_early(flight):
    log = Log(flight / "images.csv")
    log.rows[:, 0] -= 5.0
    log.write()


def sea_level(flight):
    log = Log(flight / "gps.csv")
    log.rows[:, 3] -= 60.0
    log.write()


def missing_photo(flight):
    (flight / "images" / "e1_0002.jpg").unlink()


def copied_photo(flight):
    shutil.copy(flight / "images" / "e1_0001.jpg", flight / "images" / "e1_0004.jpg")


def another_camera(flight):
    path = flight / "images" / "e1_0001.jpg"
    cv2.imwrite(str(path), np.zeros((100, 120), np.uint8))


def no_photos_listed(flight):
    (flight / "images.csv").write_text("image,time_s\n")


def wrong_axes(flight):
    log = Log(flight / "imu.csv")
    log.rows[:, [2, 3, 5, 6]] *= -1
    log.write()


def imu_without_rows(flight):
    path = flight / "imu.csv"
    path.write_text(path.read_text().splitlines()[0] + "\n")


def no_gps(flight):
    (flight / "gps.csv").unlink()


BAD = [
    (rates_in_degrees, 65, r"imu.csv", r"gyro_x_deg_s"),
    (forces_in_g, 65, r"imu.csv", r"rename the columns acc_x_g"),
    (gap_in_imu, 65, r"imu.csv", r"no inertial samples for 1.01 s between lines"),
    (doubled_stamps, 65, r"imu.csv, line 702", r"Give every sample its own time"),
    (saturated_imu, 65, r"imu.csv", r"a wider range, or cut the log"),
    (wrong_axes, 65, r"imu.csv", r"change the sign of y and z"),
    (no_fix, 65, r"gps.csv", r"the receiver never had a fix"),
    (jumping_gps, 65, r"epoch1", r"contradict each other"),
    (gps_clock, 65, r"epoch1", r"clock"),
    (gps_of_another_day, 65, r"gps.csv", r"Bring both to one time base"),
    (camera_an_hour_late, 65, r"images.csv", r"bring the camera's clock to the time base"),
    (camera_seconds_early, 65, r"images.csv", r"off by \+(4\.9|5\.)\d"),
    (sea_level, 65, r"gps.csv", r"rename it alt_msl_m"),
    (missing_photo, 66, r"images.csv", r"e1_0002.jpg. Put them there, or remove their lines"),
    (copied_photo, 65, r"e1_0004.jpg", r"is a copy of e1_0001.jpg. Put the right picture there"),
    (another_camera, 65, r"e1_0001.jpg", r"Use the camera file of these photos"),
    (no_photos_listed, 65, r"images.csv", r"lists no photos"),
    (imu_without_rows, 65, r"imu.csv", r"has 0 inertial samples; at least 10 are needed"),
    (no_gps, 66, r"gps.csv", r"A flight folder holds imu.csv, gps.csv"),
]


@pytest.mark.parametrize(("spoil", "code", "file", "fix"), BAD, ids=[case[0].__name__ for case in BAD])
def test_a_spoilt_flight_is_refused_with_file_and_fix_and_nothing_is_written(
    spoil, code, file, fix, good, site, tmp_path, capsys
):
    flight = shutil.copytree(good, tmp_path / "epoch1")
    spoil(flight)
    before = snapshot(site)
    for arguments in (
        ["add", str(site), "2024-05-01", str(flight)],
        ["reconstruct", str(flight), "-o", str(tmp_path / "points.laz")],
    ):
        assert main([*arguments, "--quiet"]) == code
        message = " ".join(capsys.readouterr().err.split())
        assert file.replace("\\", "") in message
        assert re.search(fix, message), message
    assert snapshot(site) == before
    assert not (tmp_path / "points.laz").exists()


def test_a_folder_of_flights_is_refused_and_names_them(good, site, tmp_path, capsys):
    for name in ("one", "two"):
        shutil.copytree(good, tmp_path / "flights" / name)
    assert main(["add", str(site), "2024-05-01", str(tmp_path / "flights"), "--quiet"]) == 65
    message = capsys.readouterr().err
    assert "one, two" in message
    assert f"changedetect add {site} EPOCH_ID {tmp_path / 'flights' / 'one'}" in message
    assert main(["reconstruct", str(tmp_path / "flights"), "-o", str(tmp_path / "p.laz"), "--quiet"]) == 65
    assert f"one, two. Name the flight, such as {tmp_path / 'flights' / 'one'}" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["flights"]


def few_zero_fixes(flight):
    log = Log(flight / "gps.csv")
    log.rows[40:43, 1:3] = 0.0
    log.write()


def one_jump(flight):
    log = Log(flight / "gps.csv")
    log.rows[60:64, 1] += 200.0 / 111_000.0
    log.write()


def copied_rows(flight):
    log = Log(flight / "imu.csv")
    log.rows = np.insert(log.rows, 300, log.rows[299], axis=0)
    log.write()


def short_gap(flight):
    log = Log(flight / "imu.csv")
    log.rows = np.delete(log.rows, slice(1500, 1510), axis=0)
    log.write()


def camera_a_little_late(flight):
    log = Log(flight / "images.csv")
    log.rows[:, 0] += 0.4
    log.write()


MENDED = [
    (few_zero_fixes, r"gps.csv: 3 rows at latitude 0, longitude 0 \(no fix\) left out"),
    (one_jump, r"\d of \d+ GPS fixes refused as outliers"),
    (copied_rows, r"imu.csv: 1 repeated rows left out"),
    (short_gap, r"imu.csv: 1 gaps of up to 0.110 s bridged"),
    (camera_a_little_late, r"camera clock off by -0\.[345]\d* \+- 0\.\d+ s; photo times corrected"),
]


@pytest.mark.parametrize(("spoil", "warning"), MENDED, ids=[case[0].__name__ for case in MENDED])
def test_what_can_be_mended_is_mended_and_told(spoil, warning, good, site, tmp_path, capsys):
    flight = shutil.copytree(good, tmp_path / "epoch1")
    spoil(flight)
    assert main(["add", str(site), "2024-05-01", str(flight), "--dry-run"]) == 0
    assert re.search(warning, " ".join(capsys.readouterr().err.split()))


def test_a_flight_without_a_date_asks_for_one(good, site, tmp_path, capsys):
    flight = shutil.copytree(good, tmp_path / "epoch1")
    document = json.loads((flight / "init.json").read_text())
    del document["utc"]
    (flight / "init.json").write_text(json.dumps(document))
    assert main(["add", str(site), "spring", str(flight), "--quiet"]) == 78
    assert "Give it with --date" in capsys.readouterr().err
    assert main(["add", str(site), "spring", str(flight), "--date", "2024-05-01", "--dry-run", "--quiet"]) == 0
    document["utc"] = "yesterday"
    (flight / "init.json").write_text(json.dumps(document))
    assert main(["add", str(site), "spring", str(flight), "--quiet"]) == 65
    assert "init.json: utc 'yesterday' is not a date" in capsys.readouterr().err


def test_a_camera_clock_is_read_off_the_pictures_where_photos_state_no_positions(tmp_path, caplog):
    simulate_flights(tmp_path / "flights", FlightDesign(n_epochs=1, n_strips=2, n_photos=5, size=(400, 300)), seed=1)
    flight = tmp_path / "flights" / "epoch1"
    (flight / "geo.txt").unlink()
    late = Log(flight / "images.csv")
    late.rows[:, 0] += 0.3
    late.write()
    report = reconstruct([flight], tmp_path / "points.laz", ReconstructOptions())
    found = report["flights"][0]["navigation"]["camera_clock_s"]
    assert abs(found + 0.3) < 0.06
    assert "as the pictures show; photo times corrected" in caplog.text
    late.rows[:, 0] += 2.2  # two and a half seconds late: features lie nowhere near where they are looked for
    late.write()
    with pytest.raises(InputDataError, match=r"clock of the camera"):
        reconstruct([flight], tmp_path / "later.laz", ReconstructOptions())
