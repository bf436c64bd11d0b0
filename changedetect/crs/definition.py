"""What a CRS text means: its horizontal and vertical parts, their equality, and its names in other vocabularies."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any, Literal

from pyproj import CRS
from pyproj.enums import WktVersion
from pyproj.exceptions import CRSError

from changedetect.errors import CRSMismatchError, VerticalDatumError

__all__ = [
    "authority_or_wkt",
    "brief",
    "check_located",
    "check_programme_crs",
    "crs_name",
    "height_ratio",
    "height_unit",
    "horizontal_crs",
    "horizontal_epsg",
    "horizontal_part",
    "is_geographic",
    "is_same_horizontal",
    "is_same_vertical",
    "parse_crs",
    "surface_standard_name",
    "to_cf",
    "to_wkt",
    "unbound",
    "vertical_crs",
    "vertical_part",
]

_UNNAMED_DATUMS = frozenset({"", "unknown", "undefined", "unnamed", "not specified", "user-defined"})


@lru_cache(maxsize=256)
def parse_crs(text: str) -> CRS:
    """
    Understand a CRS given as text.

    Raises
    ------
    CRSMismatchError
        The text names no CRS that PROJ knows.
    """
    try:
        return CRS.from_user_input(text.strip())
    except CRSError as error:
        msg = (
            f"Cannot understand the coordinate reference system {_shorten(text)!r}: {_shorten(str(error), 200)}. "
            "Write an EPSG code such as EPSG:32632, with heights EPSG:32632+5773 (levelled) or EPSG:32632+4979 "
            "(ellipsoidal), a PROJ string, or WKT."
        )
        raise CRSMismatchError(msg) from error


def check_programme_crs(text: str) -> str:
    """
    Check that a CRS can carry a programme: projected, metres along all axes, north up.

    Parameters
    ----------
    text : str
        As the user wrote it. Heights may be declared (levelled or ellipsoidal) or not.

    Returns
    -------
    text : str
        The same, without surrounding blanks.

    Raises
    ------
    CRSMismatchError
        Unknown, geographic, geocentric, local, not in metres, pointing south or west, or Web Mercator, whose lengths
        are stretched by 1 / cos(latitude).
    VerticalDatumError
        Heights not in metres, or counted downwards.

    Examples
    --------
    >>> check_programme_crs(" EPSG:32632+5773 ")
    'EPSG:32632+5773'
    """
    crs = parse_crs(text)
    check_located(crs, text)
    horizontal = horizontal_crs(crs)
    if not horizontal.is_projected:
        raise CRSMismatchError(_programme_message(text, "is geographic, in degrees"))
    if any(axis.unit_conversion_factor != 1.0 for axis in horizontal.axis_info):
        raise CRSMismatchError(_programme_message(text, f"is in {horizontal.axis_info[0].unit_name}"))
    directions = {axis.direction.lower() for axis in horizontal.axis_info}
    if directions not in ({"east", "north"}, {"north"}, {"south"}):  # polar grids name one direction twice
        raise CRSMismatchError(_programme_message(text, f"has axes that point {' and '.join(sorted(directions))}"))
    operation = unbound(horizontal).coordinate_operation
    if operation is not None and operation.method_name == "Popular Visualisation Pseudo Mercator":
        raise CRSMismatchError(_programme_message(text, "is Web Mercator, which falsifies lengths, areas and volumes"))
    vertical = vertical_crs(crs)
    if vertical is not None and _height_scale(vertical) != 1.0:
        axis = vertical.axis_info[-1]
        msg = (
            f"The programme's heights must be in metres, counted upwards; those of {_shorten(text)!r} are in "
            f"{axis.unit_name}, {axis.direction}. Choose the vertical CRS of the same datum in metres, for example "
            "EPSG:5703 instead of EPSG:6360."
        )
        raise VerticalDatumError(msg)
    return text.strip()


def horizontal_part(text: str) -> str:
    """Horizontal CRS: "EPSG:n" where it is exactly that, else WKT."""
    return authority_or_wkt(horizontal_crs(parse_crs(text)))


def vertical_part(text: str) -> str | None:
    """
    Vertical CRS: "EPSG:n" or WKT for levelled heights, "ellipsoid:EPSG:n" with the geographic 3-D CRS for ellipsoidal
    ones, None where the heights are not declared.

    Examples
    --------
    >>> vertical_part("EPSG:32632+5773"), vertical_part("EPSG:32632+4979"), vertical_part("EPSG:32632")
    ('EPSG:5773', 'ellipsoid:EPSG:4979', None)
    """
    vertical = vertical_crs(parse_crs(text))
    if vertical is None:
        return None
    return f"ellipsoid:{authority_or_wkt(vertical)}" if vertical.is_geographic else authority_or_wkt(vertical)


def horizontal_epsg(text: str) -> int | None:
    """EPSG code of the horizontal part, None where it has none."""
    code: int | None = unbound(horizontal_crs(parse_crs(text))).to_epsg()
    return code


def crs_name(text: str) -> str:
    """Name for people, with the heights named too."""
    crs = parse_crs(text)
    vertical = vertical_crs(crs)
    if vertical is not None and vertical.is_geographic and not crs.is_compound:
        return f"{crs.name} + ellipsoidal height"
    return str(crs.name)


def is_geographic(text: str) -> bool:
    """Whether horizontal coordinates are longitude and latitude."""
    return bool(horizontal_crs(parse_crs(text)).is_geographic)


def height_unit(text: str) -> tuple[str, float] | None:
    """Name of the unit of declared heights and its length in metres; None where heights are not declared."""
    vertical = vertical_crs(parse_crs(text))
    if vertical is None:
        return None
    axis = vertical.axis_info[-1]
    return axis.unit_name, float(axis.unit_conversion_factor)


def to_wkt(text: str, version: Literal["WKT2", "WKT1"] = "WKT2") -> str:
    """
    Well-known text of a CRS.

    Parameters
    ----------
    text : str
    version : {"WKT2", "WKT1"}
        ISO 19162:2019, or OGC 01-009 as GDAL writes it, which many readers of LAS files expect.

    Raises
    ------
    CRSMismatchError
        `text` is not a CRS, or has ellipsoidal heights and WKT1 is asked for.
    """
    crs = parse_crs(text)
    vertical = vertical_crs(crs)
    if version == "WKT1" and vertical is not None and vertical.is_geographic:
        msg = (
            f"{crs_name(text)!r} cannot be written as WKT1, which knows no ellipsoidal heights beside a projection. "
            "Write WKT2, or declare levelled heights."
        )
        raise CRSMismatchError(msg)
    return str(crs.to_wkt(WktVersion.WKT2_2019 if version == "WKT2" else WktVersion.WKT1_GDAL))


def to_cf(text: str) -> dict[str, Any]:
    """
    Attributes of a CF grid mapping variable: single parameters and `crs_wkt` (WKT2), as CF section 5.6.1 asks.

    Levelled heights add `geopotential_datum_name`; ellipsoidal heights show in `crs_wkt` alone.
    """
    attributes: dict[str, Any] = parse_crs(text).to_cf()
    return attributes


def surface_standard_name(text: str) -> str | None:
    """
    CF standard name of an elevation in this CRS.

    Returns
    -------
    name : str or None
        `height_above_reference_ellipsoid` for ellipsoidal heights; `surface_altitude` above a geoid model (EGM84,
        EGM96, EGM2008); `height_above_mean_sea_level` above mean sea level;
        `surface_height_above_geopotential_datum` for levelled heights of a national or local datum. None where the
        heights are not declared: each of the names would claim a datum nobody stated, so the variable goes without.

    References
    ----------
    .. [1] CF Standard Name Table, version 83, https://cfconventions.org/standard-names.html

    Examples
    --------
    >>> surface_standard_name("EPSG:25832+7837")
    'surface_height_above_geopotential_datum'
    """
    vertical = vertical_crs(parse_crs(text))
    if vertical is None:
        return None
    if vertical.is_geographic:
        return "height_above_reference_ellipsoid"
    name = f"{unbound(vertical).name} {_datum_name(vertical)}".lower()
    if re.search(r"egm ?(84|96|2008)|geoid", name):
        return "surface_altitude"
    if "mean sea level" in name:
        return "height_above_mean_sea_level"
    return "surface_height_above_geopotential_datum"


def is_same_horizontal(first: str, second: str) -> bool:
    """Whether horizontal coordinates in both CRSs are the same numbers: equal in meaning, not by code or name."""
    return _equal_horizontal(horizontal_crs(parse_crs(first)), horizontal_crs(parse_crs(second)))


def is_same_vertical(first: str, second: str) -> bool:
    """Whether heights in both CRSs are the same numbers; two CRSs that declare no heights count as the same."""
    return height_ratio(vertical_crs(parse_crs(first)), vertical_crs(parse_crs(second))) == 1.0


def horizontal_crs(crs: CRS) -> CRS:
    """Two-dimensional horizontal part; a bound CRS keeps its transformation."""
    part = crs.sub_crs_list[0] if crs.is_compound else crs
    return part.to_2d() if len(part.axis_info) == 3 and not part.is_geocentric else part


def vertical_crs(crs: CRS) -> CRS | None:
    """Vertical CRS, or the geographic 3-D CRS for ellipsoidal heights; None where the datum is not declared."""
    if crs.is_compound:
        part = crs.sub_crs_list[1]
        unnamed = _datum_name(part).strip().lower() in _UNNAMED_DATUMS and not part.is_bound
        return None if unnamed and _height_scale(part) == 1.0 else part
    if len(crs.axis_info) == 3 and not crs.is_geocentric and crs.geodetic_crs is not None:
        return crs.geodetic_crs.to_3d()
    return None


def unbound(crs: CRS) -> CRS:
    """CRS without the transformation that a PROJ string like +towgs84 binds to it."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def _datum_name(crs: CRS) -> str:
    datum = unbound(crs).datum
    return "" if datum is None else str(datum.name)


def _height_scale(vertical: CRS) -> float:
    """Metres upwards per unit of height."""
    axis = vertical.axis_info[-1]
    return float(axis.unit_conversion_factor) * (-1.0 if axis.direction.lower() == "down" else 1.0)


def height_ratio(first: CRS | None, second: CRS | None) -> float | None:
    """Factor between heights of one datum; None where the datums differ."""
    if first is None or second is None:
        return 1.0 if first is second else None
    if first.is_geographic or second.is_geographic:
        same = first.is_geographic and second.is_geographic and first.equals(second, ignore_axis_order=True)
    elif first.is_bound or second.is_bound:
        same = first.equals(second)
    else:
        same = first.datum is not None and first.datum == second.datum
    return _height_scale(first) / _height_scale(second) if same else None


def _equal_horizontal(first: CRS, second: CRS) -> bool:
    if first.equals(second, ignore_axis_order=True):
        return True
    if not (first.is_projected and second.is_projected) or first.is_bound or second.is_bound:
        return False
    # The same projection written with another axis order, as WKT1 does to EPSG:2193: PROJ calls them different.
    base, other = first.geodetic_crs, second.geodetic_crs
    axes = [sorted((a.direction.lower(), a.unit_conversion_factor) for a in crs.axis_info) for crs in (first, second)]
    return (
        base is not None
        and base.equals(other, ignore_axis_order=True)
        and first.coordinate_operation == second.coordinate_operation
        and axes[0] == axes[1]
    )


def authority_or_wkt(crs: CRS) -> str:
    """`EPSG:n` where the CRS is exactly that, else WKT."""
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else str(crs.to_wkt())


def brief(text: str) -> str:
    """CRS as the user can write it where that is short, else its name."""
    is_short = len(text.strip()) <= 60
    return text.strip() if is_short or crs_name(text) == "unknown" else crs_name(text)


def _shorten(text: str, length: int = 60) -> str:
    line = " ".join(text.split())
    return line if len(line) <= length else f"{line[:length]}..."


def _programme_message(text: str, what: str) -> str:
    return (
        f"The programme's coordinate reference system {brief(text)!r} {what}. It must be projected, with easting and "
        "northing in metres: use the national grid or the UTM zone of the site (EPSG:326zz north, EPSG:327zz south of "
        "the equator), if you know the vertical datum with it, as in EPSG:32632+5773. Sources may be in any CRS; they "
        "are reprojected."
    )


def check_located(crs: CRS, text: str) -> None:
    """Refuse a CRS in which a horizontal position is not two numbers on a known Earth."""
    horizontal = horizontal_crs(crs)
    if horizontal.is_projected or (horizontal.is_geographic and not horizontal.is_geocentric):
        return
    if horizontal.is_geocentric:
        what = "is geocentric (X, Y, Z from the Earth's centre)"
    elif horizontal.is_vertical:
        what = "is vertical alone: write it after the horizontal one, as in EPSG:32632+5773"
    else:
        what = "is a local system without a place on Earth"
    msg = (
        f"The coordinate reference system {brief(text)!r} {what}. Use a projected one such as EPSG:32632, or "
        "longitude and latitude (EPSG:4326, EPSG:4979) for a source."
    )
    raise CRSMismatchError(msg)
