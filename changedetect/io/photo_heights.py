"""
Heights of photos above the ellipsoid, from what they state.

EXIF counts from sea level, RTK from the ellipsoid, and the altitude of aircraft without RTK from a pressure or a GPS
height that may be a hundred metres off; their altitude above the place of take-off, from a barometer, is good to
decimetres from photo to photo.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.crs import make_transform
from changedetect.errors import InputDataError, VerticalDatumError
from changedetect.io.photo_metadata import ELLIPSOID, SEA_LEVEL

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from changedetect.io.photo_metadata import PhotoMetadata
    from changedetect.typing import FloatArray

__all__ = ["PhotoHeights", "photo_heights"]

logger = logging.getLogger(__name__)

#: Standard deviations, m: a GPS height from photo to photo and as a whole, a barometer's from photo to photo, a level
#: that is not known (the geoid lies within 106 m of the ellipsoid), and a height above the place of take-off.
_GPS_STD, _GPS_SHARED_STD, _BAROMETER_STD, _LEVEL_STD, _TAKE_OFF_STD = 2.0, 6.0, 0.3, 30.0, 1000.0
#: Differences of absolute and relative altitude that vary by more say that one of them jumps, m.
_MAX_JUMP = 5.0


@dataclass(frozen=True)
class PhotoHeights:
    """
    Heights.

    Attributes
    ----------
    height : array, shape (n,), m
        Above the ellipsoid, as well as is known.
    std : array, shape (n,), m
        Of each, without what all share.
    shared_std : float, m
    above : str
        What the heights count from, in words.
    """

    height: FloatArray
    std: FloatArray
    shared_std: float
    above: str


def photo_heights(
    directory: Path, photos: Sequence[PhotoMetadata], geoid_separation: float | None = None
) -> PhotoHeights:
    """
    Find heights above the ellipsoid.

    Parameters
    ----------
    directory : path
        For messages.
    photos : sequence of PhotoMetadata
    geoid_separation : float, m, optional
        Height of sea level above the ellipsoid, from site.json.

    Raises
    ------
    InputDataError
        A photo states no height, or they count from different levels.
    """
    absolute = np.array([np.nan if p.altitude is None else p.altitude for p in photos], dtype=np.float64)
    relative = np.array([np.nan if p.relative_altitude is None else p.relative_altitude for p in photos])
    kinds = {photo.altitude_above for photo in photos}
    if len(kinds) > 1:
        odd = next(photo for photo in photos if photo.altitude_above != photos[0].altitude_above)
        msg = (
            f"{odd.path.name} states its altitude above {odd.altitude_above or 'an unknown level'}, "
            f"{photos[0].path.name} above {photos[0].altitude_above or 'an unknown level'}. RTK may have been lost in "
            "between: give all heights in geo.txt or photos.csv, or leave those photos out."
        )
        raise InputDataError(msg)
    if np.isnan(absolute).any() and np.isnan(relative).any():
        lacking = photos[int(np.flatnonzero(np.isnan(absolute))[0])].path
        msg = f"{lacking} states no altitude. Give heights in geo.txt or photos.csv beside the photos."
        raise InputDataError(msg)
    stated = [photo.position_std for photo in photos]
    if kinds == {ELLIPSOID} and not np.isnan(absolute).any():
        std = np.array([_GPS_STD if s is None else s[2] for s in stated])
        return PhotoHeights(absolute, std, _GPS_SHARED_STD if None in stated else 0.0, "WGS 84 ellipsoid")
    if kinds == {SEA_LEVEL} and not np.isnan(absolute).any():
        return _from_sea_level(directory, photos, absolute, geoid_separation)
    if np.isnan(relative).any():
        logger.warning(
            "%s: the photos do not say what their altitudes count from; taken as above the ellipsoid, good to %.0f m "
            "as a whole. Heights serve for differences only; control points (--gcp) tie them down",
            directory, _LEVEL_STD,
        )  # fmt: skip
        return PhotoHeights(absolute, np.full(len(photos), _GPS_STD), _LEVEL_STD, "unknown")
    return _from_take_off(directory, photos, absolute, relative)


def _from_sea_level(
    directory: Path, photos: Sequence[PhotoMetadata], absolute: FloatArray, separation: float | None
) -> PhotoHeights:
    """Heights above sea level, raised by the geoid."""
    std = np.array([_GPS_STD if p.position_std is None else p.position_std[2] for p in photos])
    if separation is not None:
        return PhotoHeights(absolute + separation, std, _GPS_SHARED_STD, f"sea level, {separation:+.2f} m by site.json")
    longitude = np.array([photo.longitude for photo in photos], dtype=np.float64)
    latitude = np.array([photo.latitude for photo in photos], dtype=np.float64)
    try:
        raised = make_transform("EPSG:4326+5773", "EPSG:4979")(longitude, latitude, absolute.copy())[2]
    except VerticalDatumError as error:
        logger.warning(
            "%s: EXIF counts altitudes from sea level and the geoid there is not known (%s). They are taken as above "
            "the ellipsoid, good to %.0f m as a whole: state geoid_separation_m in site.json, or give control points",
            directory, error, _LEVEL_STD,
        )  # fmt: skip
        return PhotoHeights(absolute, std, _LEVEL_STD, "sea level, taken as the ellipsoid")
    return PhotoHeights(raised, std, _GPS_SHARED_STD, "sea level, raised by EGM96")


def _from_take_off(
    directory: Path, photos: Sequence[PhotoMetadata], absolute: FloatArray, relative: FloatArray
) -> PhotoHeights:
    """Differences of heights from the barometer, their level from the altitude the aircraft states."""
    std = np.full(len(photos), _BAROMETER_STD)
    if np.isnan(absolute).any():
        logger.warning(
            "%s: the photos state altitudes above the place of take-off only; heights count from there", directory
        )
        return PhotoHeights(relative, std, _TAKE_OFF_STD, "place of take-off")
    level = absolute - relative
    jump = np.abs(level - np.median(level))
    if jump.max() > _MAX_JUMP:
        logger.warning(
            "%s: absolute and relative altitudes disagree by %.0f m in %s; the relative ones are believed",
            directory, float(jump.max()), photos[int(jump.argmax())].path.name,
        )  # fmt: skip
    logger.warning(
        "%s: absolute altitudes of this aircraft count from a level that is not known; relative ones are used, and all "
        "heights are good to %.0f m as a whole. Control points (--gcp) or geo.txt tie them down", directory, _LEVEL_STD,
    )  # fmt: skip
    return PhotoHeights(relative + float(np.median(level)), std, _LEVEL_STD, "aircraft's altitude, level unknown")
