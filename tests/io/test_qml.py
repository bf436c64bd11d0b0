"""Style sidecars: well-formed, symmetric, readable with colour-deficient eyes."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import OutputError
from changedetect.io.cog import Category
from changedetect.io.qml import write_diverging_style, write_paletted_style, write_sequential_style


def stops_of(path):
    """(values, linear RGB colours) of a pseudo-colour style, and its renderer."""
    document = ET.parse(path).getroot()
    assert document.tag == "qgis"
    renderer = document.find("pipe/rasterrenderer")
    assert renderer.get("type") == "singlebandpseudocolor"
    assert renderer.find("minMaxOrigin/limits").text == "None"  # QGIS keeps the limits given here
    shader = renderer.find("rastershader/colorrampshader")
    assert shader.get("colorRampType") == "INTERPOLATED"
    items = shader.findall("item")
    values = np.array([float(item.get("value")) for item in items])
    assert (np.diff(values) > 0).all()
    for low, high in (("classificationMin", "classificationMax"), ("minimumValue", "maximumValue")):
        holder = renderer if low in renderer.attrib else shader
        assert (float(holder.get(low)), float(holder.get(high))) == (values[0], values[-1])
    colours = np.array([[int(item.get("color")[i : i + 2], 16) for i in (1, 3, 5)] for item in items]) / 255.0
    return values, colours, [item.get("label") for item in items]


def linear(colours):
    """Linear light of sRGB (IEC 61966-2-1)."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def luminance(colours):
    return linear(colours) @ [0.2126, 0.7152, 0.0722]


def test_diverging_style_is_symmetric_about_zero(tmp_path):
    write_diverging_style(tmp_path / "dod.qml", 2.0, level_of_detection=0.3)
    values, colours, _ = stops_of(tmp_path / "dod.qml")
    assert_allclose(values, -values[::-1], rtol=0, atol=1e-12)
    assert (values[0], values[-1]) == (-2.0, 2.0)
    assert colours[0, 0] > 2 * colours[0, 2]  # lowered is red
    assert colours[-1, 2] > 2 * colours[-1, 0]  # raised is blue


def test_changes_within_the_level_of_detection_are_neutral_and_those_beyond_are_not(tmp_path):
    write_diverging_style(tmp_path / "dod.qml", 2.0, level_of_detection=0.3)
    values, colours, labels = stops_of(tmp_path / "dod.qml")

    def colour(value):
        return np.array([np.interp(value, values, channel) for channel in colours.T])

    grey = 232 / 255
    for value in (-0.3, -0.1, 0.0, 0.1, 0.3):
        assert_allclose(colour(value), grey, rtol=0, atol=1e-9)
    for value in (-0.301, 0.301):
        assert np.ptp(colour(value)) > 0.1
    assert sum("level of detection" in label for label in labels) == 2
    assert labels[-1] == "+2 m"


@pytest.mark.parametrize("level", [0.01, 0.2, 0.7, 1.4])
def test_a_colour_means_the_same_change_whatever_the_level_of_detection(tmp_path, level):
    write_diverging_style(tmp_path / "plain.qml", 1.0)
    write_diverging_style(tmp_path / "level.qml", 1.0, level_of_detection=level)
    plain, cut = (stops_of(tmp_path / name) for name in ("plain.qml", "level.qml"))
    for value in (-1.6, -0.9, -0.75, -0.3, 0.3, 0.75, 0.9, 1.6):
        if abs(value) > level:
            seen = [[np.interp(value, v, channel) for channel in c.T] for v, c, _ in (plain, cut)]
            assert_allclose(seen[0], seen[1], rtol=0, atol=1.5 / 255)


def test_colours_darken_from_zero_to_both_ends(tmp_path):
    write_diverging_style(tmp_path / "dod.qml", 1.0)
    values, colours, _ = stops_of(tmp_path / "dod.qml")
    bright = luminance(colours)
    assert values[np.argmax(bright)] == 0.0
    assert (np.diff(bright[values <= 0]) > 0).all()
    assert (np.diff(bright[values >= 0]) < 0).all()


# Machado, Oliveira & Fernandes (2009), doi:10.1109/TVCG.2009.113, severity 1.0
DEUTERANOPIA = [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
PROTANOPIA = [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]


@pytest.mark.parametrize("deficiency", [DEUTERANOPIA, PROTANOPIA])
def test_lowered_and_raised_differ_for_colour_deficient_eyes(tmp_path, deficiency):
    write_diverging_style(tmp_path / "dod.qml", 1.0, level_of_detection=0.1)
    _, colours, _ = stops_of(tmp_path / "dod.qml")
    seen = np.clip(linear(colours) @ np.transpose(deficiency), 0, 1)
    seen = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    half = len(seen) // 2
    for lowered, raised in zip(seen[:half], seen[:-half:-1], strict=False):
        blueness = (raised[2] - raised[0]) - (lowered[2] - lowered[0])
        assert blueness > 0.1


def test_sequential_style_spans_its_limits_and_lightens(tmp_path):
    write_sequential_style(tmp_path / "std.qml", 0.0, 0.2)
    values, colours, labels = stops_of(tmp_path / "std.qml")
    assert_allclose(values, np.linspace(0.0, 0.2, 5), rtol=0, atol=1e-12)
    assert (np.diff(luminance(colours)) > 0).all()
    assert labels[0] == "0 m"


def test_paletted_style_lists_every_class(tmp_path):
    categories = [
        Category(0, "same", "the same", (1, 2, 3, 255)),
        Category(2, "up", "higher & > 1 m", (0, 0, 255, 128)),
    ]
    write_paletted_style(tmp_path / "class.qml", categories)
    renderer = ET.parse(tmp_path / "class.qml").getroot().find("pipe/rasterrenderer")
    assert renderer.get("type") == "paletted"
    entries = [dict(entry.attrib) for entry in renderer.findall("colorPalette/paletteEntry")]
    assert entries == [
        {"value": "0", "color": "#010203", "alpha": "255", "label": "the same"},
        {"value": "2", "color": "#0000ff", "alpha": "128", "label": "higher & > 1 m"},
    ]


def test_style_begins_with_the_document_type_qgis_writes(tmp_path):
    write_sequential_style(tmp_path / "std.qml", 0.0, 0.2)
    assert (
        (tmp_path / "std.qml")
        .read_text()
        .startswith("<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n<qgis ")
    )


@pytest.mark.parametrize(("limit", "level"), [(0.0, 0.0), (-1.0, 0.0), (1.0, -0.1), (1.0, np.nan), (np.inf, 0.0)])
def test_impossible_diverging_limits_are_refused(tmp_path, limit, level):
    with pytest.raises(ValueError, match="finite limit above 0"):
        write_diverging_style(tmp_path / "a.qml", limit, level_of_detection=level)


@pytest.mark.parametrize("limits", [(1.0, 1.0), (2.0, 1.0), (0.0, np.nan)])
def test_impossible_sequential_limits_are_refused(tmp_path, limits):
    with pytest.raises(ValueError, match="minimum < maximum"):
        write_sequential_style(tmp_path / "a.qml", *limits)


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError, match=r"Cannot write into .*out"):
        write_sequential_style(tmp_path / "out" / "a.qml", 0.0, 1.0)
