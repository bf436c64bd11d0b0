"""Where a list beside the photos says that a photo was taken; it replaces what the photo says of itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from changedetect.io.photo_metadata import ELLIPSOID, NADIR

if TYPE_CHECKING:
    from changedetect.io.photo_metadata import PhotoMetadata

__all__ = ["PhotoPlace", "with_place"]


@dataclass(frozen=True, kw_only=True)
class PhotoPlace:
    """
    Place and attitude of one photo; None where the list says nothing.

    Attributes
    ----------
    latitude, longitude : float, degrees
        WGS 84.
    height : float, m
    height_above : str
        `ELLIPSOID`, `SEA_LEVEL` or None.
    std : tuple of 3 float, m
        East, north, up.
    angles : tuple of 3 float, degrees
        Yaw, pitch, roll.
    angles_from : str
        `NADIR` or `HORIZON`.
    angles_std : tuple of 3 float, degrees
    time : float, s
        In one time base for all photos.
    source : str
        Name of the list.
    """

    latitude: float
    longitude: float
    height: float | None = None
    height_above: str | None = ELLIPSOID
    std: tuple[float, float, float] | None = None
    angles: tuple[float, float, float] | None = None
    angles_from: str = NADIR
    angles_std: tuple[float, float, float] | None = None
    time: float | None = None
    source: str = ""


def with_place(photo: PhotoMetadata, place: PhotoPlace) -> PhotoMetadata:
    """
    Photo with what a list says of it.

    The accuracy of the photo's own GPS is left aside even where the list gives none: it belongs to another position.
    """
    changes: dict[str, Any] = {
        "latitude": place.latitude,
        "longitude": place.longitude,
        "position_std": place.std,
    }
    if place.height is not None:
        changes |= {"altitude": place.height, "altitude_above": place.height_above, "relative_altitude": None}
    if place.angles is not None:
        changes |= {
            "angles": place.angles,
            "angles_from": place.angles_from,
            "angles_std": place.angles_std or photo.angles_std,
            "angles_source": place.source,
        }
    if place.time is not None:
        changes["time"] = place.time
    return replace(photo, **changes)
