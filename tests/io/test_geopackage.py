"""Change objects in a GeoPackage: outlines, numbers, style."""

import sqlite3
from contextlib import closing
from xml.etree import ElementTree as ET

import numpy as np
import pyogrio
import pytest
import shapely

from changedetect.differencing import AreaBudget, ChangeObject, ChangeObjects, ObjectSize, Quantity
from changedetect.grid import Grid
from changedetect.io.geopackage import LAYER, ZONE_LAYER, object_polygons, write_objects, write_zone_budgets
from changedetect.io.zones import Zone

GRID = Grid.from_region((500_000.0, 500_020.0, 5_300_000.0, 5_300_010.0), 0.5, "EPSG:32632+5773")

SIZES = {1: ObjectSize(4.0, 2.0, True), 2: ObjectSize(1.0, 2.0, False)}


def item(number, volume, n_cells):
    return ChangeObject(
        number=number,
        is_raised=volume > 0.0,
        n_cells=n_cells,
        area=0.25 * n_cells,
        volume=Quantity(volume, 0.2, volume - 0.4, volume + 0.4),
        mean=Quantity(volume / (0.25 * n_cells), 0.1, 0.0, 1.0),
        extreme=volume,
        q_value=0.01,
    )


@pytest.fixture
def objects():
    labels = np.zeros(GRID.shape, np.int32)
    labels[2:6, 3:9] = 1
    labels[3, 5] = 0  # a hole
    labels[6, 9] = 1  # touches at a corner
    labels[12:14, 20:30] = 2
    return ChangeObjects((item(1, 3.0, 24), item(2, -1.5, 20)), labels, np.full(GRID.shape, 0.5))


def test_outlines_follow_the_cells_and_are_valid(objects):
    polygons = object_polygons(objects.labels, GRID)
    assert all(p.is_valid and p.geom_type == "MultiPolygon" for p in polygons.values())
    np.testing.assert_allclose([p.area for p in polygons.values()], [6.0, 5.0], rtol=1e-12, atol=0.0)
    assert polygons[2].bounds == (500_010.0, 5_300_003.0, 500_015.0, 5_300_004.0)


def test_what_is_written_reads_back(tmp_path, objects):
    path = tmp_path / "objects.gpkg"
    write_objects(path, objects, GRID, epochs=("2024-01-01", "2024-07-01"), sizes=SIZES)
    meta, _, geometries, columns = pyogrio.raw.read(path, layer=LAYER)
    table = dict(zip(meta["fields"], columns, strict=True))
    assert meta["crs"] == "EPSG:32632"
    assert table["kind"].tolist() == ["raised", "lowered"]
    assert table["epoch_later"].tolist() == ["2024-07-01"] * 2
    assert table["is_resolved"].tolist() == [True, False]
    np.testing.assert_allclose(table["width_m"], [4.0, 1.0], rtol=0.0, atol=0.0)
    np.testing.assert_allclose(table["volume_m3"], [3.0, -1.5], rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(table["volume_lower_m3"], [2.6, -1.9], rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(table["area_m2"], shapely.area(shapely.from_wkb(geometries)), rtol=1e-12, atol=0.0)


def test_the_style_stands_in_the_file_and_beside_it(tmp_path, objects):
    path = tmp_path / "objects.gpkg"
    write_objects(path, objects, GRID, epochs=("a", "b"), sizes=SIZES)
    with closing(sqlite3.connect(path)) as database:
        rows = database.execute("SELECT f_table_name, styleQML, useAsDefault FROM layer_styles").fetchall()
    assert [(row[0], row[2]) for row in rows] == [(LAYER, 1)]
    for text in (rows[0][1], path.with_suffix(".qml").read_text()):
        rules = ET.fromstring(text).findall("renderer-v2/rules/rule")
        symbols = {s.get("name") for s in ET.fromstring(text).findall("renderer-v2/symbols/symbol")}
        assert {rule.get("symbol") for rule in rules} == symbols
        assert sum("raised" in rule.get("label") for rule in rules) == 3
        assert sum("lowered" in rule.get("label") for rule in rules) == 3


def test_every_q_value_falls_under_one_rule(tmp_path, objects):
    write_objects(tmp_path / "o.gpkg", objects, GRID, epochs=("a", "b"), sizes=SIZES)
    rules = ET.parse(tmp_path / "o.qml").getroot().findall("renderer-v2/rules/rule")
    conditions = [r.get("filter").replace('"', "").replace(" = ", " == ").replace("AND", "and") for r in rules[:-1]]
    for q in (0.0, 0.0005, 0.001, 0.005, 0.01, 0.05, 1.0):
        for kind in ("raised", "lowered"):
            assert sum(eval(c, {"kind": kind, "q_value": q}) for c in conditions) == 1


def test_no_objects_give_an_empty_layer_that_opens(tmp_path):
    nothing = ChangeObjects((), np.zeros(GRID.shape, np.int32), np.full(GRID.shape, 0.5))
    write_objects(tmp_path / "objects.gpkg", nothing, GRID, epochs=("a", "b"), sizes=SIZES)
    assert pyogrio.read_info(tmp_path / "objects.gpkg", layer=LAYER)["features"] == 0


def test_an_existing_file_is_replaced(tmp_path, objects):
    for _ in range(2):
        write_objects(tmp_path / "objects.gpkg", objects, GRID, epochs=("a", "b"), sizes=SIZES)
    assert pyogrio.read_info(tmp_path / "objects.gpkg", layer=LAYER)["features"] == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["objects.gpkg", "objects.qml"]


def test_the_same_objects_give_the_same_file(tmp_path, objects):
    for name in ("a", "b"):
        write_objects(tmp_path / name / "objects.gpkg", objects, GRID, epochs=("a", "b"), sizes=SIZES)
    assert (tmp_path / "a" / "objects.gpkg").read_bytes() == (tmp_path / "b" / "objects.gpkg").read_bytes()


def budget(net, half):
    q = Quantity(net, half / 2, net - half, net + half)
    return AreaBudget(10.0, 1.0, q, q, q, q)


def test_zones_carry_their_budgets_and_what_they_amount_to(tmp_path):
    boxes = [shapely.box(500_000 + 5 * k, 5_300_000, 500_004 + 5 * k, 5_300_010) for k in range(4)]
    zones = [Zone(name, box) for name, box in zip("abcd", boxes, strict=True)]
    unseen = AreaBudget(0.0, 4.0, *(Quantity(0.0, 0.0, 0.0, 0.0),) * 3, None)
    budgets = [budget(5.0, 1.0), budget(-5.0, 1.0), budget(0.5, 1.0), unseen]
    write_zone_budgets(tmp_path / "z.gpkg", zones, budgets, GRID.crs, epochs=("a", "b"))
    meta, _, geometries, columns = pyogrio.raw.read(tmp_path / "z.gpkg", layer=ZONE_LAYER)
    table = dict(zip(meta["fields"], columns, strict=True))
    assert table["kind"].tolist() == ["gained", "lost", "no net change", "not observed"]
    np.testing.assert_allclose(table["volume_net_lower_m3"], [4.0, -6.0, -0.5, np.nan], rtol=1e-12, atol=0.0)
    assert [g.bounds for g in shapely.from_wkb(geometries)] == [b.bounds for b in boxes]
    rules = ET.parse(tmp_path / "z.qml").getroot().findall("renderer-v2/rules/rule")
    assert all(sum(f"'{kind}'" in rule.get("filter") for rule in rules) == 1 for kind in table["kind"])
