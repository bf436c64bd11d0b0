"""
QGIS style sidecars: colours that mean the same on every map of a programme.

QGIS applies `NAME.qml` when it opens `NAME.tif` from the same folder. Limits are always passed in and never taken
from the raster by QGIS, so that maps of different epochs compare.

References
----------
.. [1] Brewer, Harrower & Penn State (2003), ColorBrewer, scheme RdBu (marked colour-blind safe).
.. [2] Nuñez, Anderton & Renslow (2018), doi:10.1371/journal.pone.0199239, the cividis ramp.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from changedetect.storage import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from changedetect.io.cog import Category

__all__ = ["write_diverging_style", "write_paletted_style", "write_sequential_style"]

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
#: Darker than paper, so that ground which was compared and found unchanged does not look like ground without data.
_NEUTRAL = "#e8e8e8"
#: At 0, 1/3, 2/3 and all of the limit, RdBu of [1]_.
_REDS = ("#fddbc7", "#ef8a62", "#b2182b", "#67001f")
_BLUES = ("#d1e5f0", "#67a9cf", "#2166ac", "#053061")
#: Five stops of cividis, [2]_.
_SEQUENTIAL = ("#00224e", "#434e6c", "#7d7c78", "#bcae6c", "#fee838")


def write_diverging_style(
    path: Path, limit: float, *, level_of_detection: float = 0.0, unit: str = "m", neutral_label: str = ""
) -> None:
    """
    Write a style symmetric about zero: red where lowered, blue where raised.

    Parameters
    ----------
    path : path
        The raster's name with the suffix `.qml`.
    limit : float
        Value of full colour; larger changes keep that colour.
    level_of_detection : float
        Values within +- this are neutral grey; the colour starts with a visible step outside. It may exceed `limit`.
    unit : str
        Shown in the legend.
    neutral_label : str
        Words for the neutral band in the legend, instead of its width.

    Raises
    ------
    ValueError
        `limit` is not finite and positive, or `level_of_detection` is negative or not finite.
    OutputError
        The file cannot be written.

    Notes
    -----
    A colour is a function of the value and the limit alone: where two maps share the limit, the same colour means the
    same change. The level of detection only cuts the neutral band out of it.
    """
    if not (math.isfinite(limit) and limit > 0.0 and math.isfinite(level_of_detection) and level_of_detection >= 0.0):
        msg = (
            f"A diverging style needs a finite limit above 0 and a finite level_of_detection of at least 0; got limit "
            f"{limit!r} and level_of_detection {level_of_detection!r}."
        )
        raise ValueError(msg)
    values = [limit * k / (len(_REDS) - 1) for k in range(len(_REDS))]
    # the first stop lies a millionth of the range outside the neutral band, which makes the step
    start = max(level_of_detection, 0.0) + 1e-6 * limit
    kept = [start, *(v for v in values if v > start)]
    reds, blues = ([(v, _colour_at(v, values, ramp)) for v in kept] for ramp in (_REDS, _BLUES))
    stops = [(-v, c, f"{-v:+.3g} {unit}") for v, c in reversed(reds)]
    if level_of_detection > 0.0:
        within = neutral_label or f"within +/-{level_of_detection:.3g} {unit} (level of detection)"
        stops += [(-level_of_detection, _NEUTRAL, within), (level_of_detection, _NEUTRAL, within)]
    else:
        stops.append((0.0, _NEUTRAL, f"0 {unit}"))
    stops += [(v, c, f"{v:+.3g} {unit}") for v, c in blues]
    _write(path, _pseudocolour(stops))


def _colour_at(value: float, values: Sequence[float], ramp: Sequence[str]) -> str:
    """Colour of a ramp at a value, between its stops in proportion, beyond them that of the end."""
    k = min(max(sum(v <= value for v in values) - 1, 0), len(values) - 2)
    share = min(max((value - values[k]) / (values[k + 1] - values[k]), 0.0), 1.0)
    channels = ((int(ramp[j][i : i + 2], 16) for j in (k, k + 1)) for i in (1, 3, 5))
    return "#" + "".join(f"{round((1.0 - share) * low + share * high):02x}" for low, high in channels)


def write_sequential_style(path: Path, minimum: float, maximum: float, *, unit: str = "m") -> None:
    """
    Write a style of one ramp, dark at `minimum` and light at `maximum`; values outside keep the end colours.

    Raises
    ------
    ValueError
        The limits are not finite or not ascending.
    OutputError
        The file cannot be written.
    """
    if not (math.isfinite(minimum) and math.isfinite(maximum) and minimum < maximum):
        msg = f"A sequential style needs finite limits, minimum < maximum; got {minimum!r} and {maximum!r}."
        raise ValueError(msg)
    step = (maximum - minimum) / (len(_SEQUENTIAL) - 1)
    stops = [(minimum + i * step, c, f"{minimum + i * step:.5g} {unit}".rstrip()) for i, c in enumerate(_SEQUENTIAL)]
    _write(path, _pseudocolour(stops))


def write_paletted_style(path: Path, categories: Iterable[Category]) -> None:
    """
    Write a style of one colour per class value.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    renderer = _renderer("paletted")
    palette = ET.SubElement(renderer, "colorPalette")
    for category in categories:
        red, green, blue, alpha = category.colour
        attributes = {"value": str(category.value), "color": f"#{red:02x}{green:02x}{blue:02x}", "alpha": str(alpha)}
        ET.SubElement(palette, "paletteEntry", attributes, label=category.label)
    _write(path, renderer)


def _pseudocolour(stops: Sequence[tuple[float, str, str]]) -> ET.Element:
    """Renderer of (value, colour, label) stops, colours interpolated between them."""
    first, last = repr(stops[0][0]), repr(stops[-1][0])
    renderer = _renderer("singlebandpseudocolor", classificationMin=first, classificationMax=last)
    shader = ET.SubElement(
        ET.SubElement(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED",
        classificationMode="1",
        clip="0",
        minimumValue=first,
        maximumValue=last,
        labelPrecision="4",
    )
    for value, colour, label in stops:
        ET.SubElement(shader, "item", value=repr(value), color=colour, alpha="255", label=label)
    return renderer


def _renderer(kind: str, **limits: str) -> ET.Element:
    attributes = {"type": kind, "band": "1", "alphaBand": "-1", "opacity": "1", "nodataColor": ""}
    renderer = ET.Element("rasterrenderer", attributes | limits)
    ET.SubElement(renderer, "rasterTransparency")
    origin = ET.SubElement(renderer, "minMaxOrigin")
    for tag, text in {
        "limits": "None",  # "MinMax" would let QGIS replace our limits by the raster's
        "extent": "WholeRaster",
        "statAccuracy": "Exact",
        "cumulativeCutLower": "0.02",
        "cumulativeCutUpper": "0.98",
        "stdDevFactor": "2",
    }.items():
        ET.SubElement(origin, tag).text = text
    return renderer


def _write(path: Path, renderer: ET.Element) -> None:
    document = ET.Element("qgis", version="3.22.0", styleCategories="Symbology")
    pipe = ET.SubElement(document, "pipe")
    pipe.append(renderer)
    ET.SubElement(pipe, "brightnesscontrast", brightness="0", contrast="0", gamma="1")
    ET.SubElement(pipe, "huesaturation", colorizeOn="0", grayscaleMode="0", saturation="0")
    ET.SubElement(pipe, "rasterresampler", maxOversampling="2")
    ET.indent(document)
    text = _DOCTYPE + ET.tostring(document, encoding="unicode") + "\n"
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")
