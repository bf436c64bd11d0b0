"""
What a photo says of itself: EXIF and XMP.

EXIF [1]_ gives place, time and focal length; drones add angles and accuracies as XMP, each maker with its own names:
DJI and Parrot angles of the camera with pitch -90 straight down, Pix4D's `Camera` and senseFly angles with pitch 0
straight down. Pillow reads both blocks without decoding the picture; XMP is parsed with defusedxml, since a photo may
come from anywhere.

References
----------
.. [1] CIPA DC-008-2023, Exchangeable image file format for digital still cameras: Exif version 3.0.
"""

from __future__ import annotations

import calendar
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from defusedxml import ElementTree  # type: ignore[import-untyped]
from defusedxml.common import DefusedXmlException  # type: ignore[import-untyped]
from PIL import ExifTags, Image, UnidentifiedImageError

from changedetect.errors import InputDataError, MissingInputError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["ELLIPSOID", "HORIZON", "NADIR", "SEA_LEVEL", "PhotoMetadata", "read_photo_metadata"]

#: What angles count from: pitch 0 looks to the horizon (-90 down), or pitch 0 looks down.
HORIZON, NADIR = "horizon", "nadir"
#: What an altitude is said to count from.
ELLIPSOID, SEA_LEVEL = "ellipsoid", "sea level"

#: Prefix under which the properties of each namespace are known here.
_NAMESPACES = {
    "dji.com/drone-dji": "drone-dji",
    "pix4d.com/camera": "Camera",
    "parrot.com/drone-parrot": "drone-parrot",
    "sensefly.com/sensefly": "sensefly",
}
#: Yaw, pitch, roll of each maker, what they count from, and how well they are known (yaw, pitch, roll; degrees).
_ANGLES = (
    (("drone-dji:GimbalYawDegree", "drone-dji:GimbalPitchDegree", "drone-dji:GimbalRollDegree"), HORIZON, (5, 2, 2)),
    (
        ("drone-parrot:CameraYawDegree", "drone-parrot:CameraPitchDegree", "drone-parrot:CameraRollDegree"),
        HORIZON,
        (5.0, 2.0, 2.0),
    ),
    (("Camera:Yaw", "Camera:Pitch", "Camera:Roll"), NADIR, (10.0, 3.0, 3.0)),
    # a fixed wing without a compass: its heading is that of its course
    (("sensefly:Heading", "sensefly:PitchAngle", "sensefly:RollAngle"), NADIR, (15.0, 5.0, 5.0)),
)
_PIX4D_ACCURACY = ("Camera:IMUYawAccuracy", "Camera:IMUPitchAccuracy", "Camera:IMURollAccuracy")
#: Diagonal of 35 mm film, mm: what the equivalent focal length of EXIF refers to.
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
#: Millimetres per unit of the focal plane's resolution: inch, centimetre, millimetre, micrometre.
_RESOLUTION_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
#: RtkFlag of DJI from which positions are differential, and their heights above the ellipsoid.
_RTK_FLOAT = 32
_TIME = re.compile(r"(\d{4})[:\-](\d\d)[:\-](\d\d)[ T](\d\d):(\d\d):(\d\d)")


@dataclass(frozen=True, kw_only=True)
class PhotoMetadata:
    """
    Metadata of one photo; None where it says nothing.

    Attributes
    ----------
    path : path
    width, height : int, pixels
        Of the picture as it is, whatever EXIF says of its size.
    camera : str
        Make and model.
    time : float, s
        Since 1970, in the clock of the camera (EXIF states no time zone).
    latitude, longitude : float, degrees
        WGS 84.
    altitude : float, m
    altitude_above : str
        `ELLIPSOID` or `SEA_LEVEL`; None where the photo does not say, or says what its maker is known to write wrongly.
    relative_altitude : float, m
        Above the place of take-off or above ground.
    position_std : tuple of 3 float, m
        East, north, up.
    angles : tuple of 3 float, degrees
        Yaw from north to east, pitch, roll, turned in this order.
    angles_from : str
        `HORIZON` or `NADIR`.
    angles_std : tuple of 3 float, degrees
        Of yaw, pitch and roll.
    angles_source : str
        Name of the first property.
    focal : float, pixels
        In pixels of the picture as it is.
    focal_source : str
    """

    path: Path
    width: int
    height: int
    camera: str = ""
    time: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    altitude_above: str | None = None
    relative_altitude: float | None = None
    position_std: tuple[float, float, float] | None = None
    angles: tuple[float, float, float] | None = None
    angles_from: str = NADIR
    angles_std: tuple[float, float, float] = (10.0, 3.0, 3.0)
    angles_source: str = ""
    focal: float | None = None
    focal_source: str = ""


def read_photo_metadata(path: Path) -> PhotoMetadata:
    """
    Read the metadata of a photo.

    Parameters
    ----------
    path : path
        JPEG, TIFF, PNG or whatever Pillow opens.

    Raises
    ------
    MissingInputError
        There is no such file.
    InputDataError
        The file is not a picture.
    """
    if not path.is_file():
        msg = f"No such photo: {path}."
        raise MissingInputError(msg)
    try:
        with Image.open(path) as picture:
            width, height = picture.size
            exif = picture.getexif()
            main: Mapping[int, Any] = dict(exif)
            detail: Mapping[int, Any] = exif.get_ifd(ExifTags.IFD.Exif)
            gps: Mapping[int, Any] = exif.get_ifd(ExifTags.IFD.GPSInfo)
            packet = picture.info.get("xmp") or picture.info.get("XML:com.adobe.xmp") or b""
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        msg = f"{path} cannot be read as a picture: {error}. Copy it again from the camera, or remove it."
        raise InputDataError(msg) from error
    xmp = _properties(path, packet)
    tag = ExifTags.Base
    make, model = (str(main.get(key, "")).strip(" \0") for key in (tag.Make, tag.Model))
    focal, focal_source = _focal(main, detail, xmp, width, height)
    angles, angles_from, angles_std, angles_source = _angles(xmp)
    latitude, longitude = _place(gps, xmp)
    altitude, above = _altitude(gps, xmp)
    relative = _first(xmp, "drone-dji:RelativeAltitude", "sensefly:Height", "Camera:AboveGroundAltitude")
    return PhotoMetadata(
        path=path,
        width=width,
        height=height,
        camera=model if model.startswith(make) else f"{make} {model}".strip(),
        time=_time(main, detail),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        altitude_above=above,
        relative_altitude=relative,
        position_std=_position_std(gps, xmp),
        angles=angles,
        angles_from=angles_from,
        angles_std=angles_std,
        angles_source=angles_source,
        focal=focal,
        focal_source=focal_source,
    )


def _properties(path: Path, packet: bytes | str) -> dict[str, str]:
    """Properties of the drones' namespaces, as `prefix:name`, written as attributes or as elements."""
    raw = packet.encode() if isinstance(packet, str) else packet
    raw = raw.strip(b"\0 \r\n")
    if not raw:
        return {}
    try:
        root = ElementTree.fromstring(raw, forbid_dtd=True)
    except (ElementTree.ParseError, DefusedXmlException, ValueError) as error:
        msg = f"{path}: its XMP is damaged ({error}). Copy the photo again, or remove its XMP (exiftool -xmp:all=)."
        raise InputDataError(msg) from error
    found: dict[str, str] = {}
    for element in root.iter():
        items = [*element.attrib.items(), (element.tag, element.text or "")]
        for name, text in items:
            uri, _, local = str(name).lstrip("{").rpartition("}")
            prefix = next((p for part, p in _NAMESPACES.items() if part in uri), None)
            if prefix is not None and str(text).strip():
                found.setdefault(f"{prefix}:{local}", str(text).strip())
    return found


def _number(value: Any) -> float | None:
    """Finite number of an EXIF rational or of XMP text (`+39.80`, `3980/100`); None for anything else."""
    try:
        if isinstance(value, str) and "/" in value:
            numerator, denominator = value.split("/")
            number = float(numerator) / float(denominator)
        else:
            number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _first(xmp: Mapping[str, str], *names: str) -> float | None:
    return next((number for name in names if (number := _number(xmp.get(name))) is not None), None)


def _time(main: Mapping[int, Any], detail: Mapping[int, Any]) -> float | None:
    text = str(detail.get(ExifTags.Base.DateTimeOriginal) or main.get(ExifTags.Base.DateTime) or "")
    match = _TIME.match(text)
    if match is None:
        return None
    year, month, day, hour, minute, second = (int(part) for part in match.groups())
    if not (1 <= month <= 12 and 1 <= day <= 31):
        return None
    whole = calendar.timegm((year, month, day, hour, minute, second))
    digits = re.sub(r"\D", "", str(detail.get(ExifTags.Base.SubsecTimeOriginal, "")))
    return whole + (float(f"0.{digits}") if digits else 0.0)


def _place(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[float | None, float | None]:
    """Latitude and longitude; XMP first, which has more digits. Both zero means that the receiver had no fix."""
    latitude = _first(xmp, "drone-dji:GpsLatitude", "drone-dji:Latitude", "sensefly:Latitude")
    longitude = _first(
        xmp, "drone-dji:GpsLongitude", "drone-dji:GpsLongtitude", "drone-dji:Longitude", "sensefly:Longitude"
    )
    if latitude is None or longitude is None:
        latitude = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef), "S")
        longitude = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef), "W")
    if latitude is None or longitude is None or not (abs(latitude) <= 90 and abs(longitude) <= 360):
        return None, None
    return (None, None) if latitude == 0 and longitude == 0 else (latitude, longitude)


def _degrees(parts: Any, reference: Any, negative: str) -> float | None:
    try:
        numbers = [_number(part) for part in parts]
    except TypeError:
        return None
    if len(numbers) != 3 or any(number is None for number in numbers):
        return None
    value = float(sum(float(number or 0.0) / 60.0**k for k, number in enumerate(numbers)))
    return -value if str(reference).strip(" \0").upper() == negative else value


def _altitude(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[float | None, str | None]:
    """Altitude and what it counts from."""
    over_ellipsoid = _first(xmp, "sensefly:AltitudeWGS84")
    if over_ellipsoid is not None:
        return over_ellipsoid, ELLIPSOID
    absolute = _first(xmp, "drone-dji:AbsoluteAltitude")
    value = _number(gps.get(ExifTags.GPS.GPSAltitude))
    raw = gps.get(ExifTags.GPS.GPSAltitudeRef)
    reference = int.from_bytes(raw, "big") if isinstance(raw, bytes) else raw
    if value is not None and reference in (1, 3):
        value = -abs(value)
    if absolute is not None:
        # DJI marks every altitude as above sea level; those of RTK are above the ellipsoid
        flag = _first(xmp, "drone-dji:RtkFlag")
        return absolute, ELLIPSOID if flag is not None and flag >= _RTK_FLOAT else None
    above = {0: SEA_LEVEL, 1: SEA_LEVEL, 2: ELLIPSOID, 3: ELLIPSOID}.get(reference) if reference is not None else None
    return value, above


def _position_std(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[float, float, float] | None:
    """Standard deviations that the photo states: of RTK, of Pix4D's tags, or the horizontal one of EXIF."""
    rtk = [_first(xmp, f"drone-dji:RtkStd{axis}") for axis in ("Lon", "Lat", "Hgt")]
    if all(value is not None and value > 0 for value in rtk):
        return float(rtk[0] or 0), float(rtk[1] or 0), float(rtk[2] or 0)
    level, up = _first(xmp, "Camera:GPSXYAccuracy"), _first(xmp, "Camera:GPSZAccuracy")
    if level is None:
        level = _number(gps.get(ExifTags.GPS.GPSHPositioningError))
    if level is None or level <= 0:
        return None
    return level, level, up if up is not None and up > 0 else 1.5 * level


def _angles(
    xmp: Mapping[str, str],
) -> tuple[tuple[float, float, float] | None, str, tuple[float, float, float], str]:
    for names, counted_from, std in _ANGLES:
        values = [_number(xmp.get(name)) for name in names]
        if values[1] is None or values[0] is None:
            continue
        stated = [_number(xmp.get(name)) for name in _PIX4D_ACCURACY]
        known = [float(s) if s is not None and s > 0 else float(d) for s, d in zip(stated, std, strict=True)]
        angles = (float(values[0]), float(values[1]), float(values[2] or 0.0))
        return angles, counted_from, (known[0], known[1], known[2]), names[0]
    return None, NADIR, (10.0, 3.0, 3.0), ""


def _focal(
    main: Mapping[int, Any], detail: Mapping[int, Any], xmp: Mapping[str, str], width: int, height: int
) -> tuple[float | None, str]:
    """Focal length in pixels of the picture, from the best that is stated."""
    tag = ExifTags.Base
    stated = _number(detail.get(tag.ExifImageWidth)) or _number(main.get(tag.ImageWidth))
    shrunk = max(width, height) / max(stated, _number(detail.get(tag.ExifImageHeight)) or 0.0) if stated else 1.0
    calibrated = _first(xmp, "drone-dji:CalibratedFocalLength")
    if calibrated is not None and calibrated > 0:
        return calibrated * shrunk, "drone-dji:CalibratedFocalLength"
    focal = _number(detail.get(tag.FocalLength))
    per_unit = _number(detail.get(tag.FocalPlaneXResolution))
    unit = _RESOLUTION_UNIT.get(int(_number(detail.get(tag.FocalPlaneResolutionUnit)) or 2))
    if focal and per_unit and unit and focal > 0 and per_unit > 0:
        return focal * per_unit / unit * shrunk, "FocalLength and FocalPlaneXResolution"
    equivalent = _number(detail.get(tag.FocalLengthIn35mmFilm))
    if not equivalent or equivalent <= 0:
        return None, ""
    long, short = max(width, height), min(width, height)
    # 16:9 is cut from a sensor of 4:3, whose diagonal the equivalent refers to
    diagonal = math.hypot(long, short if long <= 1.51 * short else 0.75 * long)
    return equivalent * diagonal / _FILM_DIAGONAL, "FocalLengthIn35mmFilm"
