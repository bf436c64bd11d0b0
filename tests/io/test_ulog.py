"""
PX4 logs. The files are written here, byte by byte, as the ULog specification says: header, format and subscription
messages, data messages.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError
from changedetect.io.flight import read_flight
from changedetect.io.flight_gps import GpsDefaults
from changedetect.io.flight_imu import ImuRange
from changedetect.io.ulog import read_ulog
from changedetect.navigation.flight import ImuNoise

pytest.importorskip("pyulog")

SENSOR = (
    "sensor_combined:uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;"
)
OLD_GPS = (
    "vehicle_gps_position:uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
    "float eph;float epv;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;float s_variance_m_s;uint8_t fix_type;"
)
NEW_GPS = (
    "sensor_gps:uint64_t timestamp;double latitude_deg;double longitude_deg;double altitude_msl_m;"
    "double altitude_ellipsoid_m;float eph;float epv;uint8_t fix_type;"
)
CAMERA = "camera_capture:uint64_t timestamp;uint32_t seq;"


def write_ulog(path: Path, topics: list[tuple[str, str, list[tuple]]]) -> Path:
    """Topics as (format, struct of one row, rows)."""

    def message(kind: bytes, payload: bytes) -> bytes:
        return struct.pack("<Hc", len(payload), kind) + payload

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    out += message(b"B", bytes(40))
    for fmt, _, _ in topics:
        out += message(b"F", fmt.encode())
    for number, (fmt, _, _) in enumerate(topics):
        out += message(b"A", struct.pack("<BH", 0, number) + fmt.split(":")[0].encode())
    data = []
    for number, (_, layout, rows) in enumerate(topics):
        data += [(row[0], message(b"D", struct.pack("<H", number) + struct.pack(layout, *row))) for row in rows]
    for _, packed in sorted(data, key=lambda item: item[0]):
        out += packed
    path.write_bytes(out)
    return path


def sensor_rows(n: int = 600) -> list[tuple]:
    rng = np.random.default_rng(1)
    rows = []
    for k in range(n):
        gyro, acc = rng.normal(0, 0.01, 3), rng.normal(0, 0.1, 3) + np.array([0, 0, -9.8])
        rows.append((1_000_000 + 10_000 * (k + 1), *gyro, 10_000, *acc, 10_000))
    return rows


def old_rows(n: int = 30) -> list[tuple]:
    return [
        (
            1_050_000 + 200_000 * k,
            453_288_346 + 450 * k,
            -932_309_515,
            250_400,
            222_400,
            1.5,
            2.5,
            25.0,
            0.5,
            0.1,
            0.2,
            3,
        )
        for k in range(n)
    ]


LOG = [(SENSOR, "<Q3fI3fI", sensor_rows()), (OLD_GPS, "<Qiiiiffffff" + "B", old_rows())]


def read(path: Path, defaults: GpsDefaults | None = None):
    return read_ulog(path, ImuNoise(), ImuRange(), defaults or GpsDefaults())


def test_a_log_of_integers_before_version_1_14(tmp_path: Path) -> None:
    imu, fixes = read(write_ulog(tmp_path / "log.ulg", LOG))
    assert len(imu) == 600
    assert_allclose(imu.time[:2], [1.01, 1.02], rtol=0, atol=1e-9)
    assert_allclose(imu.specific_force.mean(axis=0), [0, 0, -9.8], rtol=0, atol=0.02)
    assert_allclose(fixes.latitude[0], 45.3288346, rtol=0, atol=1e-9)
    assert_allclose(fixes.height, 222.4, rtol=0, atol=1e-9)
    assert_allclose(fixes.std[0], [1.5, 1.5, 2.5], rtol=1e-6, atol=0)
    assert_allclose(fixes.velocity_ned[0], [25.0, 0.5, 0.1], rtol=1e-6, atol=0)


def test_a_log_of_degrees_since_version_1_14(tmp_path: Path) -> None:
    rows = [(1_050_000 + 200_000 * k, 45.3 + 1e-5 * k, -93.2, 250.0, 222.0, 1.0, 2.0, 3 if k else 2) for k in range(20)]
    path = write_ulog(tmp_path / "log.ulg", [LOG[0], (NEW_GPS, "<QddddffB", rows)])
    _, fixes = read(path)
    assert len(fixes) == 19  # the first was a 2-D fix
    assert_allclose(fixes.height, 222.0, rtol=0, atol=1e-9)
    assert fixes.velocity_ned is None


def test_heights_above_sea_level_alone_need_the_geoid(tmp_path: Path) -> None:
    rows = [(*row[:4], 0, *row[5:]) for row in old_rows()]
    path = write_ulog(tmp_path / "log.ulg", [LOG[0], (OLD_GPS, "<QiiiiffffffB", rows)])
    with pytest.raises(InputDataError, match=r"sea level alone.*geoid_separation_m"):
        read(path)
    _, fixes = read(path, GpsDefaults(geoid_separation=-28.0))
    assert_allclose(fixes.height, 222.4, rtol=0, atol=1e-9)


def test_a_receiver_without_fix_a_missing_topic_and_a_damaged_file(tmp_path: Path) -> None:
    never = [(*row[:-1], 1) for row in old_rows()]
    with pytest.raises(InputDataError, match="never had a 3-D fix"):
        read(write_ulog(tmp_path / "never.ulg", [LOG[0], (OLD_GPS, "<QiiiiffffffB", never)]))
    with pytest.raises(InputDataError, match=r"no topic vehicle_gps_position or sensor_gps"):
        read(write_ulog(tmp_path / "half.ulg", LOG[:1]))
    (tmp_path / "noise.ulg").write_bytes(b"not a log" * 50)
    with pytest.raises(InputDataError, match=r"noise\.ulg cannot be read as a PX4 log"):
        read(tmp_path / "noise.ulg")


def test_a_folder_with_a_px4_log_and_photos_is_a_flight(tmp_path: Path) -> None:
    capture = (CAMERA, "<QI", [(2_000_000 + 266_667 * k, k) for k in range(5)])
    write_ulog(tmp_path / "flight.ulg", [*LOG, capture])
    (tmp_path / "images").mkdir()
    for k in range(5):
        (tmp_path / "images" / f"DSC_{k}.JPG").write_bytes(b"jpeg")
    flight = read_flight(tmp_path)
    assert flight.photos.names == ("DSC_0.JPG", "DSC_1.JPG", "DSC_2.JPG", "DSC_3.JPG", "DSC_4.JPG")
    assert_allclose(flight.photos.time[:2], [2.0, 2.266667], rtol=0, atol=1e-9)
    assert_allclose(flight.gps.velocity[0], [0.5, 25.0, -0.1], rtol=1e-6, atol=0)  # north, east, down to ENU
    assert flight.earth.rotation[1] > 0  # a real flight is on a rotating Earth
    (tmp_path / "images" / "DSC_9.JPG").write_bytes(b"jpeg")
    with pytest.raises(InputDataError, match=r"5 camera messages and .* 6 photos"):
        read_flight(tmp_path)
