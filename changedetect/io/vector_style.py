"""
QGIS styles of polygon layers: rules with one symbol each, and a label.

Kept as text, because a GeoPackage stores its style in a table of its own.

References
----------
.. [1] QGIS 3.22, QgsRuleBasedRenderer and QgsPalLayerSettings, as the program itself saves them.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = ["LOWERED", "RAISED", "UNCERTAIN", "Rule", "polygon_style", "store_style"]

#: Red, blue and grey of the change classes: (red, green, blue) of fill and of outline.
LOWERED = ((178, 24, 43), (103, 0, 31))
RAISED = ((33, 102, 172), (5, 48, 97))
UNCERTAIN = ((150, 150, 150), (82, 82, 82))

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
_TABLE = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256), f_table_schema TEXT(256),
    f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT,
    useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
    update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')))
"""
#: Time of the style: fixed, so that the same objects give the same file.
_UPDATED = "2000-01-01T00:00:00.000Z"


@dataclass(frozen=True)
class Rule:
    """
    Which polygons are drawn how.

    Attributes
    ----------
    condition : str
        QGIS expression.
    label : str
        For the legend.
    fill, outline : (red, green, blue)
    opacity : int
        Of the fill, 0 to 255.
    width : float, mm
        Of the outline.
    is_dashed : bool
    """

    condition: str
    label: str
    fill: tuple[int, int, int]
    outline: tuple[int, int, int]
    opacity: int
    width: float = 0.3
    is_dashed: bool = False


def polygon_style(rules: Sequence[Rule], label: str) -> str:
    """
    QML of a polygon layer.

    Parameters
    ----------
    rules : sequence of Rule
        Every rule that a polygon meets draws it, in this order.
    label : str
        QGIS expression of the text beside a polygon.

    Returns
    -------
    text : str
    """
    document = ET.Element("qgis", version="3.22.0", styleCategories="Symbology|Labeling", labelsEnabled="1")
    renderer = ET.SubElement(document, "renderer-v2", type="RuleRenderer", symbollevels="1", enableorderby="0")
    listed = ET.SubElement(renderer, "rules", key="{00000000-0000-4000-8000-000000000000}")
    symbols = ET.SubElement(renderer, "symbols")
    for k, rule in enumerate(rules):
        key = f"{{00000000-0000-4000-8000-{k + 1:012d}}}"
        ET.SubElement(listed, "rule", filter=rule.condition, key=key, symbol=str(k), label=rule.label)
        symbol = ET.SubElement(symbols, "symbol", name=str(k), type="fill", alpha="1", clip_to_extent="1")
        attributes = {"class": "SimpleFill", "enabled": "1", "pass": str(k), "locked": "0"}
        layer = ET.SubElement(symbol, "layer", attributes)
        options = ET.SubElement(layer, "Option", type="Map")
        for name, value in _symbol_options(rule).items():
            ET.SubElement(options, "Option", name=name, value=value, type="QString")
            ET.SubElement(layer, "prop", k=name, v=value)  # read by versions before 3.24
    labelling = ET.SubElement(document, "labeling", type="simple")
    settings = ET.SubElement(labelling, "settings", calloutType="simple")
    text = {"fieldName": label, "isExpression": "1", "fontSize": "9", "fontWeight": "75"}
    text |= {"fontSizeUnit": "Point", "textColor": "20,20,20,255", "textOpacity": "1", "namedStyle": "Bold"}
    style = ET.SubElement(settings, "text-style", text)
    halo = {"bufferDraw": "1", "bufferSize": "0.5", "bufferSizeUnits": "MM", "bufferColor": "255,255,255,220"}
    ET.SubElement(style, "text-buffer", halo | {"bufferOpacity": "1"})
    ET.SubElement(settings, "placement", placement="1", centroidInside="1")
    ET.SubElement(settings, "rendering", obstacle="1", displayAll="0", scaleVisibility="0")
    ET.indent(document)
    return _DOCTYPE + ET.tostring(document, encoding="unicode") + "\n"


def _symbol_options(rule: Rule) -> dict[str, str]:
    fill, outline = (",".join(str(c) for c in colour) for colour in (rule.fill, rule.outline))
    return {
        "color": f"{fill},{rule.opacity}",
        "outline_color": f"{outline},255",
        "outline_style": "dash" if rule.is_dashed else "solid",
        "outline_width": str(rule.width),
        "outline_width_unit": "MM",
        "style": "solid" if rule.opacity else "no",
        "joinstyle": "bevel",
    }


def store_style(path: Path, layer: str, style: str, description: str) -> None:
    """
    Store the default style of a layer in the way QGIS does, in a table of the GeoPackage.

    Parameters
    ----------
    path : path
        GeoPackage that has the layer, its geometry in the column ``geom``, and no styles yet.
    layer : str
    style : str
        QML.
    description : str
    """
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(_TABLE)
        database.execute(
            "INSERT INTO layer_styles (f_table_name, f_geometry_column, styleName, styleQML, styleSLD, useAsDefault, "
            "description, owner, f_table_catalog, f_table_schema, update_time) "
            "VALUES (?, 'geom', ?, ?, '', 1, ?, '', '', '', ?)",
            (layer, "change", style, description, _UPDATED),
        )
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, last_change) "
            "VALUES ('layer_styles', 'attributes', 'layer_styles', ?)",
            (_UPDATED,),
        )
