"""Change objects as polygons: a GeoPackage with its style inside, and the same style beside it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from xml.etree import ElementTree as ET

import numpy as np
import pyogrio
import shapely
from rasterio.features import shapes
from rasterio.transform import Affine

from changedetect.crs import horizontal_part, to_wkt
from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from changedetect.differencing import ChangeObject, ChangeObjects
    from changedetect.grid import Grid

__all__ = ["LAYER", "object_polygons", "write_objects"]

#: Name of the layer.
LAYER = "objects"
_FIELDS: dict[str, Any] = {
    "number": np.int32,
    "kind": object,
    "area_m2": np.float64,
    "volume_m3": np.float64,
    "volume_std_m3": np.float64,
    "volume_lower_m3": np.float64,
    "volume_upper_m3": np.float64,
    "mean_m": np.float64,
    "mean_std_m": np.float64,
    "extreme_m": np.float64,
    "q_value": np.float64,
    "epoch_earlier": object,
    "epoch_later": object,
}
#: Fill and outline of lowered and raised ground: the colours of the change classes.
_COLOURS = {"lowered": ("178,24,43,110", "103,0,31,255"), "raised": ("33,102,172,110", "5,48,97,255")}
_STYLE_TABLE = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256), f_table_schema TEXT(256),
    f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT,
    useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
    update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')))
"""


def object_polygons(labels: NDArray[np.int32], grid: Grid) -> dict[int, shapely.MultiPolygon]:
    """
    Outlines of the objects of a raster, along cell borders.

    Parameters
    ----------
    labels : array, shape (n_rows, n_cols), int32
        Number of the object of each cell, 0 outside all.
    grid : Grid

    Returns
    -------
    polygons : dict of number to MultiPolygon
        In the CRS of the grid; valid.
    """
    parts: dict[int, list[shapely.Geometry]] = {}
    for outline, value in shapes(labels, mask=labels > 0, connectivity=4, transform=Affine(*grid.transform)):
        parts.setdefault(int(value), []).append(shapely.geometry.shape(outline))
    return {number: _multi(found) for number, found in sorted(parts.items())}


def _multi(parts: Sequence[shapely.Geometry]) -> shapely.MultiPolygon:
    joined = shapely.union_all(list(parts))
    if isinstance(joined, shapely.MultiPolygon):
        return joined
    return shapely.MultiPolygon([cast("shapely.Polygon", joined)])


def write_objects(path: Path, objects: ChangeObjects, grid: Grid, *, epochs: tuple[str, str]) -> None:
    """
    Write change objects as a GeoPackage, and their style as ``NAME.qml`` beside it.

    Parameters
    ----------
    path : path
        With the suffix ``.gpkg``; replaced where it exists.
    objects : ChangeObjects
        None at all give an empty layer.
    grid : Grid
        Of the raster of objects.
    epochs : (earlier, later)
        Ids, stored with every object.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    polygons = object_polygons(objects.labels, grid)
    rows = [_row(item, epochs) for item in objects.items]
    data = [np.array([row[k] for row in rows], dtype) for k, dtype in enumerate(_FIELDS.values())]
    geometry = np.array([shapely.to_wkb(polygons[item.number]) for item in objects.items], object)
    with atomic_path(Path(path)) as temporary:
        pyogrio.raw.write(
            temporary,
            geometry,
            data,
            list(_FIELDS),
            layer=LAYER,
            driver="GPKG",
            geometry_type="MultiPolygon",
            crs=to_wkt(horizontal_part(grid.crs)),
        )
        _add_style(temporary, _style())
    with atomic_path(Path(path).with_suffix(".qml")) as temporary:
        temporary.write_text(_style(), encoding="utf-8")


def _row(item: ChangeObject, epochs: tuple[str, str]) -> tuple[Any, ...]:
    return (
        item.number,
        "raised" if item.is_raised else "lowered",
        item.area,
        item.volume.value,
        item.volume.std,
        item.volume.lower,
        item.volume.upper,
        item.mean.value,
        item.mean.std,
        item.extreme,
        item.q_value,
        *epochs,
    )


def _add_style(path: Path, style: str) -> None:
    """Store a default style in the way QGIS does, in a table of the GeoPackage."""
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(_STYLE_TABLE)
        database.execute(
            "INSERT INTO layer_styles (f_table_name, f_geometry_column, styleName, styleQML, styleSLD, useAsDefault, "
            "description, owner, f_table_catalog, f_table_schema) VALUES (?, 'geom', ?, ?, '', 1, ?, '', '', '')",
            (LAYER, "change", style, "Change objects, lowered red and raised blue"),
        )
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('layer_styles', 'attributes', "
            "'layer_styles')"
        )


def _style() -> str:
    """QML of a categorised polygon layer, labelled with the volume."""
    document = ET.Element("qgis", version="3.22.0", styleCategories="Symbology|Labeling", labelsEnabled="1")
    renderer = ET.SubElement(document, "renderer-v2", type="categorizedSymbol", attr="kind", enableorderby="0")
    categories = ET.SubElement(renderer, "categories")
    symbols = ET.SubElement(renderer, "symbols")
    for k, (kind, (fill, outline)) in enumerate(_COLOURS.items()):
        ET.SubElement(categories, "category", value=kind, symbol=str(k), label=kind, render="true", type="string")
        symbol = ET.SubElement(symbols, "symbol", name=str(k), type="fill", alpha="1", clip_to_extent="1")
        layer = ET.SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1", "pass": "0", "locked": "0"})
        options = ET.SubElement(layer, "Option", type="Map")
        for name, value in {
            "color": fill,
            "outline_color": outline,
            "outline_style": "solid",
            "outline_width": "0.3",
            "outline_width_unit": "MM",
            "style": "solid",
        }.items():
            ET.SubElement(options, "Option", name=name, value=value, type="QString")
    labelling = ET.SubElement(document, "labeling", type="simple")
    settings = ET.SubElement(labelling, "settings", calloutType="simple")
    ET.SubElement(
        settings,
        "text-style",
        fieldName="format_number(volume_m3, 0) || ' m³'",
        isExpression="1",
        fontSize="8",
        textColor="30,30,30,255",
    )
    ET.indent(document)
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + ET.tostring(document, encoding="unicode")
