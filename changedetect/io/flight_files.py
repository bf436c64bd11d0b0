"""Writing a flight folder: logs, photos and the small files beside them, in the form that `read_flight` takes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import yaml  # type: ignore[import-untyped]
from scipy.spatial.transform import Rotation

from changedetect.errors import OutputError
from changedetect.navigation.alignment import ENU_FROM_NED
from changedetect.storage import atomic_path, write_json
from changedetect.typing import FloatArray, JSONObject

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from changedetect.navigation.camera import CameraIntrinsics, CameraMount
    from changedetect.navigation.flight import Flight, GpsLog, ImuLog, ImuNoise, InitialState, PhotoList
    from changedetect.navigation.frame import LocalFrame

__all__ = [
    "write_camera_file",
    "write_initial_state",
    "write_logs",
    "write_photos",
    "write_pose_table",
    "write_positions",
    "write_site",
]

_GRAVITY = 9.80665
_JPEG_QUALITY = 95


def write_logs(directory: Path, flight: Flight) -> tuple[str, ...]:
    """
    Write imu.csv, gps.csv and images.csv.

    Parameters
    ----------
    directory : path
    flight : Flight

    Returns
    -------
    names : tuple of str
        Of the files.
    """
    _write_imu(directory / "imu.csv", flight.imu)
    _write_gps(directory / "gps.csv", flight.gps, flight.origin)
    if flight.photos is None:
        return "imu.csv", "gps.csv"
    _write_photo_list(directory / "images.csv", flight.photos)
    return "imu.csv", "gps.csv", "images.csv"


def write_photos(
    directory: Path, names: Sequence[str], photos: Iterable[NDArray[np.uint8]], on_photo: Any = None
) -> None:
    """
    Write grey photos as JPEG.

    Parameters
    ----------
    directory : path
    names : sequence of str
    photos : iterable of arrays, shape (height, width), uint8
    on_photo : callable, optional
        Called with the number of photos written.

    Raises
    ------
    OutputError
        A photo cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    for count, (name, grey) in enumerate(zip(names, photos, strict=True), start=1):
        with atomic_path(directory / name) as temporary:
            if not cv2.imwrite(str(temporary), grey, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]):
                msg = f"'{directory / name}' cannot be written as a picture. Use a name that ends in .jpg."
                raise OutputError(msg)
        if on_photo is not None:
            on_photo(count)


def write_camera_file(path: Path, camera: CameraIntrinsics, mount: CameraMount) -> None:
    """Write camera.yaml: ROS `camera_info` with the mounting in the aircraft."""

    def matrix(values: FloatArray, columns: int) -> dict[str, Any]:
        data = [float(v) for v in np.asarray(values).ravel()]
        return {"rows": len(data) // columns, "cols": columns, "data": data}

    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_matrix": matrix(camera.matrix, 3),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": matrix(camera.distortion, 5),
        "R_body_cam": matrix(mount.rotation_body_camera, 3),
        "t_body_cam": matrix(mount.camera_body, 3),
        "gps_antenna_body": matrix(mount.antenna_body, 3),
    }
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None), encoding="utf-8")


def write_site(path: Path, flight: Flight) -> None:
    """Write site.json: origin, gravity, noise of the sensors, planned height."""
    write_json(path, site_document(flight))


def site_document(flight: Flight) -> JSONObject:
    """Content of site.json for a flight."""
    origin, gps = flight.origin, flight.gps
    document: JSONObject = {
        "origin": {
            "lat_deg": origin.latitude,
            "lon_deg": origin.longitude,
            "alt_ellipsoidal_m": origin.height,
        },
        "gravity_m_s2": flight.earth.gravity,
        "earth_rotation_in_imu": any(rate != 0.0 for rate in flight.earth.rotation),
        "imu": _noise_document(flight.imu_noise),
        "gps": {
            "sigma_h_m": float(gps.position_std[0, 0]),
            "sigma_v_m": float(gps.position_std[0, 2]),
            "bias_std_m": gps.offset_std,
        },
    }
    if flight.nominal_height is not None:
        document["flight"] = {"nominal_height_m": flight.nominal_height}
    return document


def write_initial_state(path: Path, initial: InitialState, std_deg: Sequence[float], begin: datetime) -> None:
    """
    Write init.json.

    Parameters
    ----------
    path : path
    initial : InitialState
    std_deg : sequence of 3 float, degrees
        Of roll, pitch and yaw.
    begin : datetime, UTC
        Moment of time 0 of the logs.
    """
    yaw, pitch, roll = Rotation.from_matrix(ENU_FROM_NED.T @ initial.rotation).as_euler("ZYX", degrees=True)
    document = {
        "time_s": initial.time,
        "utc": f"{begin + timedelta(seconds=initial.time):%Y-%m-%dT%H:%M:%S.%fZ}",
        "roll_pitch_yaw_deg": [float(roll), float(pitch), float(yaw)],
        "sigma_deg": [float(v) for v in std_deg],
        "vel_ned_m_s": [float(v) for v in ENU_FROM_NED.T @ initial.velocity],
        "vel_sigma_m_s": initial.velocity_std,
    }
    write_json(path, document)


def write_positions(path: Path, names: Sequence[str], position: FloatArray, origin: LocalFrame) -> None:
    """
    Write where photos say they were taken, as OpenDroneMap's geo.txt.

    Parameters
    ----------
    path : path
    names : sequence of str
    position : array, shape (n, 3), ENU, m
    origin : LocalFrame
    """
    geodetic = origin.to_geodetic(position)
    rows = [f"{name} {lon:.9f} {lat:.9f} {h:.3f}" for name, (lat, lon, h) in zip(names, geodetic, strict=True)]
    _write_lines(path, "EPSG:4326", rows)


def write_pose_table(
    path: Path, names: Sequence[str], time: FloatArray, position: FloatArray, rotation: FloatArray
) -> None:
    """
    Write camera poses as comma-separated text.

    Parameters
    ----------
    path : path
    names : sequence of str
    time : array, shape (n,), s
    position : array, shape (n, 3), ENU, m
    rotation : array, shape (n, 3, 3)
        Camera axes to ENU; written as a quaternion, w first.
    """
    quaternion = np.roll(Rotation.from_matrix(rotation).as_quat(), 1, axis=1)
    rows = [
        f"{name},{t:.5f}," + ",".join(f"{v:.6f}" for v in p) + "," + ",".join(f"{v:.10f}" for v in q)
        for name, t, p, q in zip(names, time, position, quaternion, strict=True)
    ]
    _write_lines(path, "image,time_s,x,y,z,qw,qx,qy,qz", rows)


def _write_imu(path: Path, imu: ImuLog) -> None:
    rows = [
        f"{t:.5f}," + ",".join(f"{v:.8f}" for v in rate) + "," + ",".join(f"{v:.6f}" for v in force)
        for t, rate, force in zip(imu.time, imu.angular_rate, imu.specific_force, strict=True)
    ]
    _write_lines(path, "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,acc_x_m_s2,acc_y_m_s2,acc_z_m_s2", rows)


def _write_gps(path: Path, gps: GpsLog, origin: LocalFrame) -> None:
    geodetic = origin.to_geodetic(gps.position)
    rows = [
        f"{t:.3f},{place[0]:.9f},{place[1]:.9f},{place[2]:.4f},{std[0]:.3f},{std[2]:.3f}"
        for t, place, std in zip(gps.time, geodetic, gps.position_std, strict=True)
    ]
    _write_lines(path, "time_s,lat_deg,lon_deg,alt_m,sigma_h_m,sigma_v_m", rows)


def _write_photo_list(path: Path, photos: PhotoList) -> None:
    strips = photos.strip or ("0",) * len(photos)
    rows = [f"{name},{t:.5f},{strip}" for name, t, strip in zip(photos.names, photos.time, strips, strict=True)]
    _write_lines(path, "image,time_s,strip", rows)


def _noise_document(noise: ImuNoise) -> JSONObject:
    return {
        "gyro_noise_deg_s_rtHz": float(np.degrees(noise.gyro_noise)),
        "gyro_bias_std_deg_s": float(np.degrees(noise.gyro_bias_std)),
        "gyro_instability_deg_h": float(np.degrees(noise.gyro_instability) * 3600.0),
        "accel_noise_ug_rtHz": noise.accel_noise / _GRAVITY * 1e6,
        "accel_bias_std_mg": noise.accel_bias_std / _GRAVITY * 1e3,
        "accel_instability_mg": noise.accel_instability / _GRAVITY * 1e3,
        "sample": "mean over the preceding interval",
    }


def _write_lines(path: Path, header: str, rows: Sequence[str]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
