"""Areas of interest from vector files: polygons in the programme's CRS, and the cells they cover."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pyogrio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError
from rasterio.features import rasterize
from rasterio.transform import Affine

from changedetect.crs import PointTransform, crs_name, horizontal_part, make_transform
from changedetect.errors import CRSMismatchError, InputDataError, MissingInputError

if TYPE_CHECKING:
    from changedetect.grid import Grid
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["Zone", "covered_cells", "read_zones"]

#: Columns a zone's name is taken from, the first that exists; upper and lower case are the same.
_NAME_COLUMNS = ("name", "zone", "label", "title", "id", "location")
AnyPolygon: TypeAlias = shapely.Polygon | shapely.MultiPolygon
_KINDS = "Name a GeoPackage, GeoJSON or shapefile with polygons."
_FIX = "Open the file in QGIS, run 'Fix geometries' or delete the feature, and save it again."


@dataclass(frozen=True)
class Zone:
    """
    An area of interest.

    Attributes
    ----------
    name : str
        Unique in its file.
    polygon : shapely.Polygon or shapely.MultiPolygon
        In the programme's CRS, m.
    """

    name: str
    polygon: AnyPolygon


def read_zones(path: Path, crs: str, *, layer: str | None = None, name_column: str | None = None) -> tuple[Zone, ...]:
    """
    Read polygons from a GeoPackage, GeoJSON, shapefile or any other vector file.

    Parameters
    ----------
    path : path
    crs : str
        CRS of the programme; zones in another are reprojected.
    layer : str, optional
        Needed where the file has several layers.
    name_column : str, optional
        Column that holds the names; otherwise a column called name, zone, label, title, id or location, else numbers.

    Returns
    -------
    zones : tuple of Zone
        In the order of the file.

    Raises
    ------
    MissingInputError
        There is no such file.
    InputDataError
        The file is no vector file, has several layers and none is named, no features, or a feature that is empty,
        invalid or no polygon; the message names the feature.
    CRSMismatchError
        The file states no CRS, or one that cannot be reached.

    Examples
    --------
    >>> import tempfile
    >>> text = '{"type": "Polygon", "coordinates": [[[9.0, 48.0], [9.1, 48.0], [9.1, 48.1], [9.0, 48.0]]]}'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "zone.geojson"
    ...     _ = file.write_text('{"type": "Feature", "properties": {"name": "slip"}, "geometry": ' + text + "}")
    ...     zone = read_zones(file, "EPSG:32632")[0]
    >>> zone.name, round(zone.polygon.area / 1e6)
    ('slip', 41)
    """
    path = Path(path)
    if not path.exists():
        msg = f"'{path}' does not exist. {_KINDS}"
        raise MissingInputError(msg)
    layer = _only_layer(path, layer)
    meta, geometries, columns = _read(path, layer)
    where = f"'{path}'" if layer is None else f"'{path}', layer '{layer}'"
    source = meta["crs"]
    if source is None:
        msg = f"{where} states no coordinate reference system. Assign one in QGIS (Layer > Set CRS) and save it."
        raise CRSMismatchError(msg)
    if len(geometries) == 0:
        msg = f"{where} holds no features; polygons are expected. Draw them in QGIS, or name another file."
        raise InputDataError(msg)
    names = _names(where, list(meta["fields"]), columns, len(geometries), name_column)
    transform = _way(where, source, crs)
    zones = []
    for number, (name, binary) in enumerate(zip(names, geometries, strict=True), start=1):
        what = f"{where}: feature {number} ('{name}')"
        zones.append(Zone(name, _projected(what, _checked(what, binary), transform)))
    return tuple(zones)


def _way(where: str, source: str, crs: str) -> PointTransform:
    """From the CRS of the zones to the programme's."""
    try:
        return make_transform(horizontal_part(source), horizontal_part(crs), has_heights=False)
    except InputDataError as error:
        msg = f"{where}: {error} {_save_as(crs)}"
        raise CRSMismatchError(msg) from error


def _projected(what: str, polygon: AnyPolygon, transform: PointTransform) -> AnyPolygon:
    def moved(vertices: FloatArray) -> FloatArray:
        easting, northing, _ = transform(vertices[:, 0], vertices[:, 1], np.zeros(len(vertices)))
        return np.column_stack([easting, northing])

    try:
        return shapely.transform(polygon, moved)
    except InputDataError as error:
        msg = f"{what}: {error} {_save_as(transform.target)}"
        raise CRSMismatchError(msg) from error


def _save_as(crs: str) -> str:
    return (
        f"Or save the zones in the programme's CRS, {crs_name(crs)} (QGIS: Export > Save Features As), and name those."
    )


def covered_cells(polygon: AnyPolygon, grid: Grid) -> tuple[tuple[slice, slice], BoolArray] | None:
    """
    Cells of a grid whose centres lie in a polygon.

    Parameters
    ----------
    polygon : Polygon or MultiPolygon
        In the CRS of the grid.
    grid : Grid

    Returns
    -------
    window : pair of slice
        Rows and columns that hold them.
    inside : array, shape of the window, bool
        None instead of both where the polygon lies outside the grid.
    """
    west, south, east, north = polygon.bounds
    part = grid.intersection((west, east, south, north))
    if part is None:
        return None
    inside = rasterize([(polygon, 1)], out_shape=part.shape, transform=Affine(*part.transform), dtype="uint8") > 0
    row = round((grid.north - part.north) / grid.resolution)
    column = round((part.west - grid.west) / grid.resolution)
    return (slice(row, row + part.n_rows), slice(column, column + part.n_cols)), np.asarray(inside)


def _only_layer(path: Path, layer: str | None) -> str | None:
    """Layer to read; None for a file that has but one and gives it its own name."""
    try:
        available = [str(name) for name, kind in pyogrio.list_layers(path) if kind is not None]
    except DataSourceError as error:
        msg = f"'{path}' cannot be read as a vector file: {str(error).split(';')[0].rstrip('.')}. {_KINDS}"
        raise InputDataError(msg) from error
    if layer is None and len(available) > 1:
        msg = (
            f"'{path}' has {len(available)} layers ({', '.join(available)}). Name one (--layer), or save it in a file "
            "of its own."
        )
        raise InputDataError(msg)
    if layer is not None and layer not in available:
        msg = f"'{path}' has no layer '{layer}'; it has {', '.join(available) or 'none with geometries'}."
        raise InputDataError(msg)
    only = available[0] if len(available) == 1 else None
    return layer or (None if only == path.stem else only)


def _read(path: Path, layer: str | None) -> tuple[dict[str, Any], Any, list[Any]]:
    try:
        meta, _, geometries, columns = pyogrio.raw.read(path, layer=layer)
    except (DataSourceError, DataLayerError) as error:
        msg = f"'{path}' cannot be read as a vector file: {str(error).split(';')[0].rstrip('.')}. {_KINDS}"
        raise InputDataError(msg) from error
    if geometries is None:
        msg = f"'{path}' holds a table without geometries; polygons are expected."
        raise InputDataError(msg)
    return meta, geometries, list(columns)


def _names(where: str, fields: list[str], columns: list[Any], n: int, name_column: str | None) -> list[str]:
    """One name a feature, made unique by its number where it occurs twice or is missing."""
    if name_column is not None and name_column not in fields:
        msg = f"{where} has no column '{name_column}'; it has {', '.join(fields) or 'none'}."
        raise InputDataError(msg)
    lower = [field.lower() for field in fields]
    found = name_column or next((fields[lower.index(c)] for c in _NAME_COLUMNS if c in lower), None)
    if found is None:
        return [str(k) for k in range(1, n + 1)]
    names = ["" if v is None else str(v).strip() for v in columns[fields.index(found)]]
    taken = {name for name in names if name and names.count(name) == 1}
    unique = []
    for number, name in enumerate(names, start=1):
        if name and names.count(name) == 1:
            unique.append(name)
            continue
        candidates = (f"{name} {k}".strip() for k in itertools.count(number, n))
        unique.append(next(candidate for candidate in candidates if candidate not in taken))
        taken.add(unique[-1])
    return unique


def _checked(what: str, binary: bytes | None) -> AnyPolygon:
    try:
        geometry = None if binary is None else shapely.force_2d(shapely.from_wkb(binary))
    except shapely.errors.GEOSException as error:
        msg = f"{what} cannot be read: {error}. {_FIX}"
        raise InputDataError(msg) from error
    if geometry is None or geometry.is_empty:
        msg = f"{what} has no geometry. {_FIX}"
        raise InputDataError(msg)
    if not isinstance(geometry, shapely.Polygon | shapely.MultiPolygon):
        msg = f"{what} is a {geometry.geom_type}; zones are polygons. Delete it, or buffer it in QGIS to a polygon."
        raise InputDataError(msg)
    if not geometry.is_valid:
        reason = shapely.is_valid_reason(geometry)
        msg = f"{what} is not a valid polygon: {reason}. {_FIX}"
        raise InputDataError(msg)
    return geometry
