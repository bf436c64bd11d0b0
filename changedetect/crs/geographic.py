"""Longitude and latitude for catalogues and overviews, where metres do not matter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pyproj import Transformer

from changedetect.crs.definition import horizontal_crs, parse_crs

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = ["enclosed_pole", "to_longitude_latitude"]


def to_longitude_latitude(crs: str, easting: FloatArray, northing: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Place on WGS 84, good enough to find data by.

    Parameters
    ----------
    crs : str
        Horizontal, or with heights, which do not matter here.
    easting, northing : array, shape (n,)

    Returns
    -------
    longitude, latitude : array, shape (n,), degrees
        Longitude from -180 to 180. Where PROJ knows no transformation between the datums the shift between them, up to
        some hundred metres, is left out: never use this for data.

    Examples
    --------
    >>> longitude, latitude = to_longitude_latitude("EPSG:32632+5773", np.array([5e5]), np.array([5316300.224]))
    >>> float(longitude[0]), round(float(latitude[0]), 6)
    (9.0, 48.0)
    """
    transformer = Transformer.from_crs(horizontal_crs(parse_crs(crs)), "EPSG:4326", always_xy=True)
    longitude, latitude = transformer.transform(easting, northing, errcheck=True)
    return (np.asarray(longitude) + 180.0) % 360.0 - 180.0, np.asarray(latitude)


def enclosed_pole(crs: str, west: float, east: float, south: float, north: float) -> float | None:
    """
    Latitude of the pole that lies in a region, 90 or -90; None where none does.

    Parameters
    ----------
    crs : str
    west, east, south, north : float
        Region in that CRS.

    Examples
    --------
    >>> enclosed_pole("EPSG:3031", -500.0, 500.0, -500.0, 500.0)
    -90.0
    >>> enclosed_pole("EPSG:32632", 4e5, 6e5, 5e6, 6e6) is None
    True
    """
    transformer = Transformer.from_crs("EPSG:4326", horizontal_crs(parse_crs(crs)), always_xy=True)
    for latitude in (90.0, -90.0):
        easting, northing = transformer.transform(0.0, latitude)
        if west <= easting <= east and south <= northing <= north:
            return latitude
    return None
