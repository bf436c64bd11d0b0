"""
Footprint of a raster's data in longitude and latitude, as GeoJSON wants it [1]_.

References
----------
.. [1] Butler et al. (2016), RFC 7946, The GeoJSON Format: 3.1.6 (orientation), 3.1.9 and 5.2 (antimeridian), 5.3
   (poles).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import shapely
from rasterio.features import shapes
from rasterio.transform import Affine

from changedetect.crs import enclosed_pole, to_longitude_latitude

if TYPE_CHECKING:
    from changedetect.grid import Grid
    from changedetect.typing import BoolArray, FloatArray, JSONObject

__all__ = ["Extent", "data_extent", "join_boxes"]

#: Blocks along the longer side of a raster that its footprint is drawn from.
_MOST_BLOCKS = 200
#: Corners of a footprint, at most; it is simplified until it has no more.
_MOST_CORNERS = 300
#: Straight lines on the map bend in longitude and latitude: none is longer than this part of the extent.
_LONGEST_EDGE = 0.05
#: Degrees: about a centimetre.
_DECIMALS = 7


@dataclass(frozen=True)
class Extent:
    """
    Where data lie on Earth.

    Attributes
    ----------
    geometry : dict or None
        GeoJSON Polygon or MultiPolygon; None where there are no data.
    bbox : tuple (west, south, east, north) or None, degrees
        West exceeds east where the data cross the antimeridian.
    """

    geometry: JSONObject | None
    bbox: tuple[float, float, float, float] | None


def data_extent(valid: BoolArray, grid: Grid) -> Extent:
    """
    Footprint of the valid cells of a raster.

    Parameters
    ----------
    valid : array, shape (n_rows, n_cols), bool
    grid : Grid
        In any CRS, with or without heights.

    Returns
    -------
    extent : Extent
        The footprint holds all valid cells; it is drawn along blocks of cells and simplified, so it holds some
        ground beside them.
    """
    if not valid.any():
        return Extent(None, None)
    outline = _outline(valid, grid)
    west, south, east, north = (float(v) for v in shapely.bounds(outline))
    pole = enclosed_pole(grid.crs, west, east, south, north)
    longest = _LONGEST_EDGE * max(east - west, north - south)
    bent = shapely.segmentize(outline, longest)
    corners = shapely.get_coordinates(bent)
    longitude, latitude = to_longitude_latitude(grid.crs, corners[:, 0], corners[:, 1])
    if pole is not None:
        low, high = sorted((pole, float(latitude.min() if pole > 0.0 else latitude.max())))
        return _as_extent(shapely.box(-180.0, low, 180.0, high), (-180.0, low, 180.0, high))
    first = float(longitude[0])

    def project(xy: FloatArray) -> FloatArray:
        # longitudes about the first corner's: a site that crosses 180 degrees stays in one piece
        longitude, latitude = to_longitude_latitude(grid.crs, xy[:, 0], xy[:, 1])
        return np.column_stack([first + (longitude - first + 180.0) % 360.0 - 180.0, latitude])

    on_earth = shapely.simplify(shapely.transform(bent, project), 10.0**-_DECIMALS)  # edges that came out straight
    return _split_at_antimeridian(shapely.make_valid(on_earth))


def _outline(valid: BoolArray, grid: Grid) -> shapely.Geometry:
    """Outline of blocks that hold valid cells, in the grid's CRS, with few corners."""
    n_rows, n_cols = valid.shape
    size = max(1, math.ceil(max(n_rows, n_cols) / _MOST_BLOCKS))
    while True:
        padded = np.pad(valid, ((0, -n_rows % size), (0, -n_cols % size)))
        blocks = padded.reshape(padded.shape[0] // size, size, padded.shape[1] // size, size).any(axis=(1, 3))
        a, _, west, _, e, north = grid.transform
        transform = Affine(a * size, 0.0, west, 0.0, e * size, north)
        parts = [
            shapely.geometry.shape(outline)
            for outline, _ in shapes(blocks.astype(np.uint8), mask=blocks, connectivity=8, transform=transform)
        ]
        whole = shapely.box(west, grid.south, grid.east, north)
        outline = shapely.intersection(
            shapely.union_all([shapely.polygons(shapely.get_exterior_ring(part)) for part in parts]), whole
        )
        if shapely.get_num_coordinates(outline) <= _MOST_CORNERS:
            return outline
        # a polygon a little wider than the blocks may cut their corners and still hold them
        wide = outline.buffer(grid.resolution * size, join_style="mitre")
        simple = wide.simplify(0.99 * grid.resolution * size).intersection(whole)
        if shapely.get_num_coordinates(simple) <= _MOST_CORNERS and simple.contains(outline):
            return simple
        size *= 2


def _split_at_antimeridian(polygon: shapely.Geometry) -> Extent:
    """Cut at 180 degrees east and west and bring every part into -180 to 180."""
    west, south, east, north = (float(v) for v in shapely.bounds(polygon))
    if west >= -180.0 and east <= 180.0:
        return _as_extent(polygon, (west, south, east, north))
    parts = []
    for turn in (-360.0, 0.0, 360.0):
        part = shapely.intersection(polygon, shapely.box(-180.0 + turn, -90.0, 180.0 + turn, 90.0))
        if shapely.area(part) > 0.0:
            parts.append(shapely.transform(part, partial(_turned_back, turn=turn)))
    box = ((west + 180.0) % 360.0 - 180.0, south, (east + 180.0) % 360.0 - 180.0, north)
    return _as_extent(shapely.union_all(parts), box)


def _turned_back(xy: FloatArray, turn: float) -> FloatArray:
    turned: FloatArray = xy - np.array([turn, 0.0])
    return turned


def _as_extent(polygon: shapely.Geometry, box: tuple[float, float, float, float]) -> Extent:
    rounded = shapely.set_precision(polygon, 10.0**-_DECIMALS)
    flat = [part for part in shapely.get_parts(rounded) if isinstance(part, shapely.Polygon)]
    if not flat:  # smaller than the precision
        flat = [shapely.box(*box)]
    rings = [[_ring(p.exterior, is_outer=True), *(_ring(r, is_outer=False) for r in p.interiors)] for p in flat]
    geometry: JSONObject = (
        {"type": "Polygon", "coordinates": rings[0]}
        if len(rings) == 1
        else {"type": "MultiPolygon", "coordinates": rings}
    )
    west, south, east, north = (round(v, _DECIMALS) for v in box)
    return Extent(geometry, (west, south, east, north))


def _ring(ring: shapely.LinearRing, *, is_outer: bool) -> list[list[float]]:
    """Corners, counter-clockwise outside and clockwise around holes."""
    corners: FloatArray = shapely.get_coordinates(ring)
    if bool(shapely.is_ccw(ring)) != is_outer:
        corners = corners[::-1]
    return [[round(float(x), _DECIMALS), round(float(y), _DECIMALS)] for x, y in corners]


def join_boxes(boxes: list[tuple[float, float, float, float]]) -> tuple[float, float, float, float] | None:
    """
    Smallest box around boxes, across the antimeridian where that is narrower.

    Parameters
    ----------
    boxes : list of (west, south, east, north), degrees

    Returns
    -------
    box : (west, south, east, north) or None

    Examples
    --------
    >>> join_boxes([(179.0, 1.0, 179.5, 2.0), (-179.5, 0.0, -179.0, 1.0)])
    (179.0, 0.0, -179.0, 2.0)
    >>> join_boxes([(8.0, 47.0, 9.0, 48.0), (8.5, 46.0, 9.5, 47.5)])
    (8.0, 46.0, 9.5, 48.0)
    """
    if not boxes:
        return None
    first = boxes[0][0]
    wests = [first + (box[0] - first + 180.0) % 360.0 - 180.0 for box in boxes]
    easts = [west + (box[2] - box[0]) % 360.0 for west, box in zip(wests, boxes, strict=True)]
    south, north = min(box[1] for box in boxes), max(box[3] for box in boxes)
    if any((box[0], box[2]) == (-180.0, 180.0) for box in boxes) or max(easts) - min(wests) >= 360.0:
        return -180.0, south, 180.0, north
    west, east = ((v + 180.0) % 360.0 - 180.0 for v in (min(wests), max(easts)))
    return round(west, _DECIMALS), south, round(east, _DECIMALS), north
