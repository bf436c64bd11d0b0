"""Regions (west, east, south, north) of ground: joining, comparing, telling."""

from __future__ import annotations

from changedetect.typing import Region

__all__ = ["common_ground", "describe_region", "join_regions", "regions_overlap", "unit_hint"]

#: Metres; the US survey foot differs by two parts in a million.
_FOOT = 0.3048


def join_regions(one: Region | None, other: Region) -> Region:
    """
    Smallest region around both; None is nothing.

    Examples
    --------
    >>> join_regions((0.0, 2.0, 0.0, 2.0), (1.0, 3.0, -1.0, 1.0))
    (0.0, 3.0, -1.0, 2.0)
    """
    if one is None:
        return other
    return min(one[0], other[0]), max(one[1], other[1]), min(one[2], other[2]), max(one[3], other[3])


def common_ground(one: Region, other: Region) -> Region | None:
    """
    Ground that two regions both hold; None where they do not overlap or only touch.

    Examples
    --------
    >>> common_ground((0.0, 2.0, 0.0, 2.0), (1.0, 3.0, -1.0, 1.0))
    (1.0, 2.0, 0.0, 1.0)
    """
    west, east = max(one[0], other[0]), min(one[1], other[1])
    south, north = max(one[2], other[2]), min(one[3], other[3])
    return (west, east, south, north) if west < east and south < north else None


def regions_overlap(one: Region, other: Region) -> bool:
    """Whether two regions share a point."""
    return one[0] <= other[1] and other[0] <= one[1] and one[2] <= other[3] and other[2] <= one[3]


def unit_hint(region: Region, known: Region) -> str:
    """
    Sentence for a message where a region away from a known one lies on it when its coordinates are taken for feet.

    Examples
    --------
    >>> unit_hint((3280.0, 3290.0, 6560.0, 6570.0), (1000.0, 1010.0, 2000.0, 2010.0))
    'Times 0.3048 they overlap: the coordinates look like feet. State a CRS in feet, or convert them to metres. '
    >>> unit_hint((3280.0, 3290.0, 6560.0, 6570.0), (0.0, 10.0, 0.0, 10.0))
    ''
    """
    west, east, south, north = (_FOOT * value for value in region)
    if not regions_overlap((west, east, south, north), known):
        return ""
    return (
        f"Times {_FOOT} they overlap: the coordinates look like feet. State a CRS in feet, or convert them to metres. "
    )


def describe_region(region: Region) -> str:
    """Say where a region lies, for messages."""
    west, east, south, north = region
    return f"easting {west:.1f} to {east:.1f}, northing {south:.1f} to {north:.1f}"
