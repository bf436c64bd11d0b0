"""Flight folders: what is read, and every way in which a log can be wrong."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from simulated_flights import short_plan

from changedetect.errors import ChangeDetectError, InputDataError, MissingInputError, VerticalDatumError
from changedetect.io.flight import read_flight
from changedetect.navigation.alignment import attitude_to_angles
from changedetect.navigation.photos import camera_poses
from changedetect.navigation.solution import navigate
from changedetect.synthetic.flight_path import simulate_flight

CAMERA = """image_width: 1024
image_height: 768
camera_matrix: {rows: 3, cols: 3, data: [2050, 0, 517.5, 0, 2050, 379.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [-0.12, 0.05, 0.0002, -0.0001, 0]}
R_body_cam: {rows: 3, cols: 3, data: [0, -1, 0, 1, 0, 0, 0, 0, 1]}
t_body_cam: {rows: 1, cols: 3, data: [0.15, 0.02, 0.1]}
gps_antenna_body: {rows: 1, cols: 3, data: [-0.4, 0, -0.25]}
"""


@dataclass
class Tables:
    """Contents of a flight folder that a test may spoil before writing."""

    imu: np.ndarray
    gps: np.ndarray
    names: list[str]
    photo_time: np.ndarray
    site: dict
    imu_header: str = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,acc_x_m_s2,acc_y_m_s2,acc_z_m_s2"
    gps_header: str = "time_s,lat_deg,lon_deg,alt_m,sigma_h_m,sigma_v_m"

    def write(self, folder: Path) -> Path:
        (folder / "images").mkdir(parents=True)
        write_table(folder / "imu.csv", self.imu_header, self.imu, "%.8f")
        write_table(folder / "gps.csv", self.gps_header, self.gps, "%.9f")
        rows = [f"{name},{time:.6f}" for name, time in zip(self.names, self.photo_time, strict=True)]
        (folder / "images.csv").write_text("\n".join(["image,time_s", *rows]) + "\n")
        for name in self.names:
            (folder / "images" / name).write_bytes(b"jpeg")
        (folder / "site.json").write_text(json.dumps(self.site))
        (folder / "camera.yaml").write_text(CAMERA)
        return folder


def write_table(path: Path, header: str, rows: np.ndarray, fmt: str) -> None:
    np.savetxt(path, rows, fmt=fmt, delimiter=",", header=header, comments="")


@pytest.fixture(scope="module")
def simulated():
    return simulate_flight(short_plan(), seed=6)


@pytest.fixture
def tables(simulated) -> Tables:
    flight = simulated.flight
    imu, gps, photos = flight.imu, flight.gps, flight.photos
    geodetic = flight.origin.to_geodetic(gps.position)
    return Tables(
        imu=np.column_stack([imu.time, imu.angular_rate, imu.specific_force]),
        gps=np.column_stack([gps.time, geodetic, gps.position_std[:, [0, 2]]]),
        names=list(photos.names),
        photo_time=photos.time.copy(),
        site={
            "origin": {"lat_deg": -33.89, "lon_deg": 151.19, "alt_ellipsoidal_m": 40.0},
            "gravity_m_s2": 9.80665,
            "earth_rotation_in_imu": False,
            "imu": {"gyro_noise_deg_s_rtHz": 0.05, "accel_noise_ug_rtHz": 600.0, "accel_bias_std_mg": 10.0},
            "gps": {"bias_std_m": 1.0},
            "flight": {"nominal_height_m": 100.0},
        },
    )


def test_a_folder_gives_the_logs_in_si_units_and_enu(tables: Tables, simulated, tmp_path: Path) -> None:
    flight = read_flight(tables.write(tmp_path / "f"))
    truth = simulated.flight
    assert_allclose(flight.imu.specific_force, truth.imu.specific_force, rtol=0, atol=1e-8)
    assert_allclose(flight.gps.position, truth.gps.position, rtol=0, atol=1e-3)
    assert flight.gps.offset_std == 1.0
    assert flight.photos.names == truth.photos.names
    assert_allclose(flight.imu_noise.accel_noise, truth.imu_noise.accel_noise, rtol=1e-9, atol=0)
    assert flight.camera.k1 == -0.12
    assert flight.earth.rotation == (0.0, 0.0, 0.0)
    assert flight.initial is None
    poses = camera_poses(flight, navigate(flight))
    error = simulated.path.position(poses.time) - poses.position
    assert np.sqrt(np.mean(error**2)) < 0.8


def test_degrees_and_g_are_taken_by_the_names_of_their_columns(tables: Tables, simulated, tmp_path: Path) -> None:
    tables.imu[:, 1:4] = np.degrees(tables.imu[:, 1:4])
    tables.imu[:, 4:7] /= 9.80665
    tables.imu_header = "time_s,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,acc_x_g,acc_y_g,acc_z_g"
    flight = read_flight(tables.write(tmp_path / "f"))
    assert_allclose(flight.imu.angular_rate, simulated.flight.imu.angular_rate, rtol=0, atol=1e-8)
    assert_allclose(flight.imu.specific_force, simulated.flight.imu.specific_force, rtol=0, atol=1e-6)


def test_heights_above_sea_level_become_ellipsoidal(tables: Tables, simulated, tmp_path: Path) -> None:
    tables.gps[:, 3] -= 22.5
    tables.gps_header = tables.gps_header.replace("alt_m", "alt_msl_m")
    tables.site["geoid_separation_m"] = 22.5
    flight = read_flight(tables.write(tmp_path / "f"))
    assert_allclose(flight.gps.position, simulated.flight.gps.position, rtol=0, atol=1e-3)


def test_an_initial_state_is_turned_into_enu(tables: Tables, tmp_path: Path) -> None:
    folder = tables.write(tmp_path / "f")
    init = {
        "time_s": 1.0,
        "roll_pitch_yaw_deg": [1.0, 2.0, 90.0],
        "sigma_deg": [1.0, 1.0, 3.0],
        "vel_ned_m_s": [3.0, 30.0, -1.0],
        "vel_sigma_m_s": 0.5,
    }
    (folder / "init.json").write_text(json.dumps(init))
    initial = read_flight(folder).initial
    assert_allclose(initial.velocity, [30.0, 3.0, 1.0], rtol=0, atol=1e-12)
    assert_allclose(attitude_to_angles(initial.rotation), [1.0, 2.0, 90.0], rtol=0, atol=1e-9)
    assert_allclose(initial.rotation_covariance[2, 2], np.radians(3.0) ** 2, rtol=0.02, atol=0)
    (folder / "init.json").write_text(json.dumps({**init, "sigma_deg": [1.0, 0.0, 3.0]}))
    with pytest.raises(InputDataError, match=r"init\.json: sigma_deg .* must be positive"):
        read_flight(folder)


def test_photos_are_sorted_by_time_and_positions_of_geo_txt_are_kept(
    tables: Tables, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tables.write(tmp_path / "f")
    lines = (folder / "images.csv").read_text().splitlines()
    (folder / "images.csv").write_text("\n".join([lines[0], *reversed(lines[1:])]) + "\n")
    (folder / "geo.txt").write_text(f"EPSG:4326\n{tables.names[2]} 151.19 -33.89 140.0\nother.jpg 1 2 3\n")
    photos = read_flight(folder).photos
    assert np.all(np.diff(photos.time) > 0)
    assert photos.names == tuple(tables.names)
    assert "not listed in the order of time" in caplog.text
    assert_allclose(photos.position[2], [0.0, 0.0, 100.0], rtol=0, atol=1e-6)
    assert np.isnan(photos.position[0]).all()


def spoil_units_of_rate(t: Tables) -> None:
    t.imu[:, 1:4] = np.degrees(t.imu[:, 1:4])


def spoil_units_of_force(t: Tables) -> None:
    t.imu[:, 4:7] /= 9.80665


def spoil_axes(t: Tables) -> None:
    t.imu[:, [2, 3, 5, 6]] *= -1


def spoil_time_order(t: Tables) -> None:
    t.imu[500, 0] = t.imu[100, 0]


def spoil_stamp(t: Tables) -> None:
    t.imu[500, 0] = t.imu[499, 0]


def spoil_gap(t: Tables) -> None:
    t.imu = np.delete(t.imu, slice(2000, 2120), axis=0)


def spoil_saturation(t: Tables) -> None:
    t.imu[:, 1] = np.clip(t.imu[:, 1] * 4, -0.12, 0.12)


def spoil_cell(t: Tables) -> None:
    t.imu[321, 4] = np.nan


def spoil_base(t: Tables) -> None:
    t.gps[:, 0] += 1.3e9


def spoil_zero(t: Tables) -> None:
    t.gps[:, 1:3] = 0.0


def spoil_no_rows(t: Tables) -> None:
    t.gps = t.gps[:0]


def spoil_integers(t: Tables) -> None:
    t.gps[:, 1:3] *= 1e7


def spoil_swap(t: Tables) -> None:
    t.gps[:, [1, 2]] = t.gps[:, [2, 1]]


def spoil_sigma(t: Tables) -> None:
    t.gps[7, 4] = 0.0


def spoil_sea_level(t: Tables) -> None:
    t.gps[:, 3] -= 22.5
    t.site["geoid_separation_m"] = 22.5


def spoil_sea_level_unknown(t: Tables) -> None:
    t.gps[:, 3] -= 45.0


def spoil_no_geoid(t: Tables) -> None:
    t.gps_header = t.gps_header.replace("alt_m", "alt_msl_m")


def spoil_gps_order(t: Tables) -> None:
    t.gps[[20, 40]] = t.gps[[40, 20]]


def spoil_photo_clock(t: Tables) -> None:
    t.photo_time += 3600.0


def spoil_some_photos(t: Tables) -> None:
    t.photo_time[-2:] += 600.0


def spoil_photo_times(t: Tables) -> None:
    t.photo_time = np.floor(t.photo_time)


def spoil_origin(t: Tables) -> None:
    t.site["origin"]["lat_deg"] = "south"


def spoil_header(t: Tables) -> None:
    t.imu_header = t.imu_header.replace("_rad_s", "")


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (spoil_units_of_rate, InputDataError, r"imu\.csv.*gyro_x_deg_s"),
        (spoil_units_of_force, InputDataError, r"imu\.csv.*magnitude of 1\.\d* m/s2.*acc_x_g"),
        (spoil_axes, InputDataError, r"imu\.csv: the z axis shows 1?\d\.\d+ m/s2.*forward-left-up"),
        (spoil_time_order, InputDataError, r"imu\.csv, line 502: time goes back"),
        (spoil_stamp, InputDataError, r"imu\.csv, line 502: the stamp .* is that of the line before"),
        (spoil_gap, InputDataError, r"imu\.csv: no inertial samples for 1\.21 s between lines 2001 and 2002"),
        (spoil_saturation, InputDataError, r"imu\.csv: the angular rate is saturated in \d+ of \d+ samples"),
        (spoil_cell, InputDataError, r"imu\.csv, line 323, column acc_x_m_s2: 'nan' is not a finite number"),
        (spoil_header, InputDataError, r"imu\.csv has no columns gyro_x_rad_s or gyro_x_deg_s"),
        (spoil_base, InputDataError, r"gps\.csv: only 0 of \d+ fixes fall into the inertial log.*one time base"),
        (spoil_zero, InputDataError, r"gps\.csv: every fix is at latitude 0, longitude 0"),
        (spoil_no_rows, InputDataError, r"gps\.csv holds no fixes"),
        (spoil_integers, InputDataError, r"gps\.csv, line 2: latitude .* are not degrees.*1e-7"),
        (spoil_swap, InputDataError, r"gps\.csv, line 2: latitude 151\.\d+.* not degrees.*order"),
        (spoil_sigma, InputDataError, r"gps\.csv, line 9: sigma_h_m is 0"),
        (spoil_gps_order, InputDataError, r"gps\.csv, line \d+: time goes back"),
        (spoil_sea_level, VerticalDatumError, r"gps\.csv: .*22\.\d m below the planned height.*Rename it alt_msl_m"),
        (spoil_sea_level_unknown, VerticalDatumError, r"gps\.csv: .*4[45]\.\d m below.*geoid_separation_m"),
        (spoil_no_geoid, VerticalDatumError, r"gps\.csv gives heights above sea level.*geoid_separation_m"),
        (spoil_photo_clock, InputDataError, r"images\.csv: 64 of 64 photos .* \+36\d\d\.\d+ s apart"),
        (spoil_some_photos, InputDataError, r"images\.csv: 2 of 64 photos .* photo_0062\.jpg"),
        (spoil_photo_times, InputDataError, r"images\.csv, lines 2 and 3: photo_0000.* have the same time"),
        (spoil_origin, InputDataError, r"site\.json: origin\.lat_deg is 'south'"),
    ],
)
def test_a_spoilt_log_ends_in_one_clear_error(
    tables: Tables, tmp_path: Path, spoil, error: type[ChangeDetectError], message: str
) -> None:
    spoil(tables)
    with pytest.raises(error, match=message):
        read_flight(tables.write(tmp_path / "f"))


def test_repeated_rows_empty_fixes_and_short_gaps_are_bridged_and_said(
    tables: Tables, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tables.imu = np.delete(np.insert(tables.imu, 300, tables.imu[299], axis=0), slice(1500, 1508), axis=0)
    tables.gps[50:53, 1:3] = 0.0
    tables.gps = np.insert(tables.gps, 80, tables.gps[79], axis=0)
    n_fixes = len(tables.gps)
    flight = read_flight(tables.write(tmp_path / "f"))
    assert "1 repeated rows left out, the first at line 302" in caplog.text
    assert "1 gaps of up to 0.090 s bridged" in caplog.text
    assert "3 rows at latitude 0, longitude 0 (no fix) left out, the first at line 52" in caplog.text
    assert "1 fixes with the stamp of the one before left out" in caplog.text
    assert len(flight.gps) == n_fixes - 4
    factor = flight.imu.noise_factor
    assert np.count_nonzero(factor > 1) == 1
    assert factor.max() > 3


@pytest.mark.parametrize("stated", [True, False], ids=["range stated", "range found"])
def test_saturated_samples_are_found_and_trusted_less(
    tables: Tables, tmp_path: Path, caplog: pytest.LogCaptureFixture, stated: bool
) -> None:
    tables.imu[3000:3012, 3] = 1.5 if not stated else np.radians(90.0)
    if stated:
        tables.site["imu"]["range_deg_s"] = 90.0
    flight = read_flight(tables.write(tmp_path / "f"))
    assert "angular rate saturated in 12 of" in caplog.text
    assert np.array_equal(np.flatnonzero(flight.imu.noise_factor > 1), np.arange(3000, 3012))


def test_missing_parts_are_named(tables: Tables, tmp_path: Path) -> None:
    folder = tables.write(tmp_path / "f")
    (folder / "images" / tables.names[3]).unlink()
    with pytest.raises(MissingInputError, match=r"images\.csv names 1 photo\(s\).*photo_0003\.jpg"):
        read_flight(folder)
    (folder / "gps.csv").unlink()
    with pytest.raises(MissingInputError, match=r"gps\.csv.*flight folder holds"):
        read_flight(folder)
    with pytest.raises(MissingInputError, match="No such folder"):
        read_flight(tmp_path / "none")


def test_a_line_cut_off_is_named(tables: Tables, tmp_path: Path) -> None:
    folder = tables.write(tmp_path / "f")
    text = (folder / "imu.csv").read_text()
    (folder / "imu.csv").write_text(text[:-40])
    with pytest.raises(InputDataError, match=r"imu\.csv, line \d+: \d cells where the header has 7 columns"):
        read_flight(folder)


def test_a_photo_listed_twice_is_refused(tables: Tables, tmp_path: Path) -> None:
    tables.names[5] = tables.names[4]
    with pytest.raises(InputDataError, match=r"images\.csv, line 7: photo_0004\.jpg is listed already on line 6"):
        read_flight(tables.write(tmp_path / "f"))


def test_without_site_and_camera_the_defaults_of_a_real_flight_hold(tables: Tables, tmp_path: Path) -> None:
    folder = tables.write(tmp_path / "deep" / "f")
    (folder / "site.json").unlink()
    (folder / "camera.yaml").unlink()
    (folder / "images.csv").unlink()
    flight = read_flight(folder)
    assert flight.photos is None
    assert flight.camera is None
    assert flight.earth.rotation[2] < 0  # southern hemisphere
    assert np.linalg.norm(flight.gps.position[0]) < 20.0


def test_values_sampled_at_an_instant_become_means(tables: Tables, tmp_path: Path) -> None:
    tables.site["imu"]["sample"] = "instantaneous"
    imu = read_flight(tables.write(tmp_path / "f")).imu
    assert_allclose(imu.angular_rate[10], 0.5 * (tables.imu[9, 1:4] + tables.imu[10, 1:4]), rtol=0, atol=1e-7)
    tables.site["imu"]["sample"] = "sometimes"
    with pytest.raises(InputDataError, match=r"imu\.sample is 'sometimes'"):
        read_flight(tables.write(tmp_path / "g"))
