"""
Coordinate reference systems, horizontal and vertical, and the transformation of points between them.

CRSs cross this boundary as strings: an authority code ("EPSG:32632"), one with heights ("EPSG:32632+5773" levelled,
"EPSG:32632+4979" ellipsoidal), a PROJ string or WKT.

Nothing is guessed. PROJ's ballpark operations, which ignore a datum shift or a missing geoid grid without a word, are
never used; a source whose heights cannot be related to the programme's vertical datum is refused. Grids come from
installed files, never from the network during a run, so that a run can be repeated.

Coordinates are always (easting, northing) or (longitude, latitude), whatever axis order the authority defines.
"""

from __future__ import annotations

from changedetect.crs.definition import (
    check_programme_crs,
    crs_name,
    height_unit,
    horizontal_epsg,
    horizontal_part,
    is_geographic,
    is_same_horizontal,
    is_same_vertical,
    parse_crs,
    surface_standard_name,
    to_cf,
    to_wkt,
    vertical_part,
)
from changedetect.crs.geographic import enclosed_pole, to_longitude_latitude
from changedetect.crs.transform import PointTransform, check_compatible, make_transform

__all__ = [
    "PointTransform",
    "check_compatible",
    "check_programme_crs",
    "crs_name",
    "enclosed_pole",
    "height_unit",
    "horizontal_epsg",
    "horizontal_part",
    "is_geographic",
    "is_same_horizontal",
    "is_same_vertical",
    "make_transform",
    "parse_crs",
    "surface_standard_name",
    "to_cf",
    "to_longitude_latitude",
    "to_wkt",
    "vertical_part",
]
