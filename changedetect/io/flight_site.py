"""Small files of a flight folder: site.json (place, sensors, plan) and init.json (initial state)."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from changedetect.errors import InputDataError
from changedetect.io.flight_gps import GpsDefaults
from changedetect.io.flight_imu import ImuRange
from changedetect.navigation.alignment import ENU_FROM_NED, attitude_covariance, attitude_from_angles
from changedetect.navigation.flight import ImuNoise, InitialState
from changedetect.navigation.frame import EarthModel, LocalFrame

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["Site", "read_initial_state", "read_site"]

logger = logging.getLogger(__name__)

_GRAVITY = 9.80665


@dataclass(frozen=True)
class Site:
    """
    What is known of place, sensors and plan beside the logs.

    Parameters
    ----------
    origin : LocalFrame, optional
        None: the first fix becomes the origin.
    gravity : float, m/s2, optional
        Measured magnitude; None: normal gravity.
    earth_rotates : bool
        Whether the inertial data hold the Earth's rotation (all real ones do).
    imu_noise : ImuNoise
    imu_range : ImuRange
    is_sampled_instantly : bool
        Inertial rows are values at their stamp instead of means over the interval before it.
    gps : GpsDefaults
    nominal_height : float, m, optional
        Planned height above ground.
    """

    origin: LocalFrame | None = None
    gravity: float | None = None
    earth_rotates: bool = True
    imu_noise: ImuNoise = field(default_factory=ImuNoise)
    imu_range: ImuRange = field(default_factory=ImuRange)
    is_sampled_instantly: bool = False
    gps: GpsDefaults = field(default_factory=GpsDefaults)
    nominal_height: float | None = None

    def earth(self, origin: LocalFrame) -> EarthModel:
        """Gravity and rotation of the Earth at the origin; a flat Earth at rest where the data hold no rotation."""
        if self.earth_rotates:
            return EarthModel.at(origin, self.gravity)
        return EarthModel(_GRAVITY if self.gravity is None else self.gravity)


def read_site(path: Path) -> Site:
    """
    Read site.json.

    Parameters
    ----------
    path : path
        All keys are optional: `origin` {lat_deg, lon_deg, alt_ellipsoidal_m}, `gravity_m_s2`, `earth_rotation_in_imu`,
        `geoid_separation_m`, `imu` {gyro_noise_deg_s_rtHz, accel_noise_ug_rtHz, gyro_bias_std_deg_s,
        accel_bias_std_mg, gyro_instability_deg_h, accel_instability_mg, range_deg_s, range_g, sample}, `gps`
        {sigma_h_m, sigma_v_m, sigma_vel_m_s, bias_std_m}, `flight` {nominal_height_m}.

    Returns
    -------
    site : Site

    Raises
    ------
    InputDataError
        The file is not JSON, or a value is not the number it should be.
    """
    document = _load(path)
    imu, gps, plan = (_section(path, document, key) for key in ("imu", "gps", "flight"))
    origin = None
    if "origin" in document:
        place = _section(path, document, "origin")
        numbers = [_number(path, place, k, "origin") for k in ("lat_deg", "lon_deg", "alt_ellipsoidal_m")]
        try:
            origin = LocalFrame(*(_required(path, "origin", v) for v in numbers))
        except ValueError as error:
            msg = f"{path}: {error}"
            raise InputDataError(msg) from error
    rate_range, force_range = _number(path, imu, "range_deg_s", "imu"), _number(path, imu, "range_g", "imu")
    return Site(
        origin=origin,
        gravity=_number(path, document, "gravity_m_s2", ""),
        earth_rotates=bool(document.get("earth_rotation_in_imu", True)),
        imu_noise=_imu_noise(path, imu),
        imu_range=ImuRange(
            None if rate_range is None else math.radians(rate_range),
            None if force_range is None else force_range * _GRAVITY,
        ),
        is_sampled_instantly=_is_instant(path, imu),
        gps=GpsDefaults(
            horizontal_std=_number(path, gps, "sigma_h_m", "gps"),
            vertical_std=_number(path, gps, "sigma_v_m", "gps"),
            velocity_std=_number(path, gps, "sigma_vel_m_s", "gps") or GpsDefaults.velocity_std,
            offset_std=_number(path, gps, "bias_std_m", "gps") or 0.0,
            geoid_separation=_number(path, document, "geoid_separation_m", ""),
        ),
        nominal_height=_number(path, plan, "nominal_height_m", "flight"),
    )


def read_initial_state(path: Path) -> InitialState:
    """
    Read init.json: attitude and velocity at one moment.

    Parameters
    ----------
    path : path
        Keys `time_s`, `roll_pitch_yaw_deg` (body forward-right-down against north-east-down), `sigma_deg` (of the
        three), `vel_ned_m_s`, `vel_sigma_m_s`.

    Returns
    -------
    initial : InitialState

    Raises
    ------
    InputDataError
        The file is not JSON, a key is missing, or a value is not possible.
    """
    document = _load(path)
    time = _required(path, "time_s", _number(path, document, "time_s", ""))
    speed_std = _required(path, "vel_sigma_m_s", _number(path, document, "vel_sigma_m_s", ""))
    triples = {}
    for key in ("roll_pitch_yaw_deg", "sigma_deg", "vel_ned_m_s"):
        values = document.get(key)
        if not isinstance(values, list) or len(values) != 3 or not all(_is_number(v) for v in values):
            msg = f"{path}: {key} is {values!r}; expected three numbers."
            raise InputDataError(msg)
        triples[key] = np.array(values, dtype=np.float64)
    if np.any(triples["sigma_deg"] <= 0) or speed_std <= 0:
        msg = f"{path}: sigma_deg {triples['sigma_deg'].tolist()} and vel_sigma_m_s {speed_std} must be positive."
        raise InputDataError(msg)
    roll, pitch, yaw = (float(v) for v in triples["roll_pitch_yaw_deg"])
    return InitialState(
        time=time,
        rotation=attitude_from_angles(roll, pitch, yaw),
        velocity=ENU_FROM_NED @ triples["vel_ned_m_s"],
        rotation_covariance=attitude_covariance(roll, pitch, yaw, triples["sigma_deg"]),
        velocity_std=speed_std,
    )


def _imu_noise(path: Path, imu: dict[str, Any]) -> ImuNoise:
    units = {
        "gyro_noise_deg_s_rtHz": ("gyro_noise", math.radians(1.0)),
        "accel_noise_ug_rtHz": ("accel_noise", 1e-6 * _GRAVITY),
        "gyro_bias_std_deg_s": ("gyro_bias_std", math.radians(1.0)),
        "accel_bias_std_mg": ("accel_bias_std", 1e-3 * _GRAVITY),
        "gyro_instability_deg_h": ("gyro_instability", math.radians(1.0) / 3600.0),
        "accel_instability_mg": ("accel_instability", 1e-3 * _GRAVITY),
    }
    stated = {}
    for key, (name, factor) in units.items():
        value = _number(path, imu, key, "imu")
        if value is not None:
            stated[name] = value * factor
    if "gyro_noise" not in stated or "accel_noise" not in stated:
        logger.info("%s: noise of the inertial sensor not stated; a low-cost one is assumed", path)
    try:
        return ImuNoise(**stated)
    except ValueError as error:
        msg = f"{path}: {error}"
        raise InputDataError(msg) from error


def _is_instant(path: Path, imu: dict[str, Any]) -> bool:
    sample = str(imu.get("sample", "mean over the preceding interval"))
    if sample.startswith("mean"):
        return False
    if sample.startswith("instant"):
        return True
    msg = f"{path}: imu.sample is {sample!r}; expected 'mean over the preceding interval' or 'instantaneous'."
    raise InputDataError(msg)


def _load(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        msg = f"{path} is not JSON: {error}. Correct it, or remove it to have everything found from the logs."
        raise InputDataError(msg) from error
    if not isinstance(document, dict):
        msg = f"{path} holds {type(document).__name__}, not an object with keys."
        raise InputDataError(msg)
    return document


def _section(path: Path, document: dict[str, Any], key: str) -> dict[str, Any]:
    section = document.get(key, {})
    if not isinstance(section, dict):
        msg = f"{path}: {key} is {section!r}; expected an object with keys."
        raise InputDataError(msg)
    return section


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(path: Path, section: dict[str, Any], key: str, where: str) -> float | None:
    """Value of a key, None where absent; anything but a finite number is refused."""
    if key not in section:
        return None
    if not _is_number(section[key]):
        msg = f"{path}: {f'{where}.' if where else ''}{key} is {section[key]!r}; expected a number."
        raise InputDataError(msg)
    return float(section[key])


def _required(path: Path, key: str, value: float | None) -> float:
    if value is None:
        msg = f"{path}: {key} is missing."
        raise InputDataError(msg)
    return value
