"""Volumes of a programme: whole, by zone, by band of elevation; the command that prints them."""

from __future__ import annotations

import csv

import pytest
import shapely
from small_surveys import SIDE, SOUTH, WEST, make_programme, reopen, run, snapshot, write_zones

from changedetect.cli import main
from changedetect.pipeline.learn import ModelShelf
from changedetect.pipeline.pairs import difference_pair
from changedetect.pipeline.update import update
from changedetect.storage import read_json

FIRST, SECOND = "2024-01-01", "2024-07-01"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    programme = make_programme(tmp_path_factory.mktemp("volumes") / "site", {FIRST: {}, SECOND: {"step": 0.5}})
    assert update(programme).exit_code == 0
    return programme.directory


@pytest.fixture(scope="module")
def zones(tmp_path_factory):
    half = SIDE / 2
    boxes = {
        "west": shapely.box(WEST, SOUTH, WEST + half, SOUTH + SIDE),
        "east": shapely.box(WEST + half, SOUTH, WEST + SIDE, SOUTH + SIDE),
        "elsewhere": shapely.box(WEST + 5 * SIDE, SOUTH, WEST + 6 * SIDE, SOUTH + SIDE),
    }
    return write_zones(tmp_path_factory.mktemp("zones") / "zones.gpkg", boxes.values(), boxes)


def test_the_volumes_of_the_command_are_those_of_the_summary(site, capsys):
    done = run(capsys, "volume", site, FIRST, SECOND)
    summary = read_json(site / "products" / f"{FIRST}_{SECOND}" / "summary.json")
    for kind in ("raised", "lowered", "net"):
        assert done["whole"][f"volume_{kind}_m3"] == pytest.approx(summary[f"volume_{kind}_m3"], rel=1e-9)
        low, high = done["whole"][f"volume_{kind}_interval_m3"]
        assert low <= done["whole"][f"volume_{kind}_m3"] < high
    assert summary["objects"]["n_raised"] >= 1
    assert summary["error_model"]["stable_share"] > 0.0


def test_zones_add_up_to_the_whole_and_one_outside_is_told(site, zones, capsys, tmp_path):
    table = tmp_path / "volumes.csv"
    done = run(capsys, "volume", site, FIRST, SECOND, "--zones", zones, "--bands", 2, "-o", table)
    west, east, elsewhere = done["zones"]
    assert [zone["name"] for zone in done["zones"]] == ["west", "east", "elsewhere"]
    total = west["volume_net_m3"] + east["volume_net_m3"]
    assert total == pytest.approx(done["whole"]["volume_net_m3"], abs=1e-6)
    assert elsewhere["change_mean_m"] is None
    assert any("zone 'elsewhere' holds no ground" in text for text in done["warnings"])
    bands = sum(band["volume_net_m3"] for band in done["bands"])
    assert bands == pytest.approx(done["whole"]["volume_net_m3"], abs=1e-6)
    with table.open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["kind"] for row in rows][:4] == ["whole", "zone", "zone", "zone"]
    assert float(rows[1]["volume_net_m3"]) == west["volume_net_m3"]
    assert float(rows[1]["volume_net_lower_m3"]) < float(rows[1]["volume_net_upper_m3"])


def test_people_read_a_table(site, zones, capsys):
    assert main(["volume", str(site), FIRST, SECOND, "--zones", str(zones)]) == 0
    text = capsys.readouterr().out
    assert "all ground" in text
    assert "west" in text


def test_a_dry_run_checks_the_zones_and_writes_nothing(site, zones, capsys, tmp_path):
    before = snapshot(tmp_path)
    done = run(capsys, "volume", site, FIRST, SECOND, "--zones", zones, "-o", tmp_path / "v.csv", "--dry-run")
    assert done["n_zones"] == 3
    assert done["warnings"] == ["zone 'elsewhere' lies outside the ground of both epochs"]
    assert snapshot(tmp_path) == before
    run(capsys, "volume", site, FIRST, SECOND, "--zones", tmp_path / "none.gpkg", "--dry-run", expect=66)


def test_what_cannot_be_meant_is_refused(site, capsys, tmp_path):
    run(capsys, "volume", site, FIRST, SECOND, "--bands", 0, expect=2)
    done = run(capsys, "volume", site, FIRST, SECOND, "--layer", "one", expect=2)
    assert "name it with --zones" in done["error"]["message"]
    run(capsys, "volume", site, FIRST, "2030-01-01", expect=66)
    done = run(capsys, "volume", site, FIRST, SECOND, "-o", tmp_path / "v.txt", expect=2)
    assert "v.txt' does not end in .csv or .gpkg." in done["error"]["message"]
    done = run(capsys, "volume", site, FIRST, SECOND, "-o", tmp_path / "v.gpkg", expect=2)
    assert "--zones" in done["error"]["message"]
    (tmp_path / "v.csv").write_text("kept")
    run(capsys, "volume", site, FIRST, SECOND, "-o", tmp_path / "v.csv", expect=73)
    assert (tmp_path / "v.csv").read_text() == "kept"


def test_zones_are_not_overwritten_with_their_budgets(site, zones, capsys):
    before = zones.read_bytes()
    done = run(capsys, "volume", site, FIRST, SECOND, "--zones", zones, "-o", zones, "--overwrite", expect=2)
    assert "read and written at once" in done["error"]["message"]
    assert zones.read_bytes() == before


def stable_site(folder, box):
    path = write_zones(folder / "stable.gpkg", [box], ["road"])
    programme = make_programme(folder / "site", {FIRST: {}, SECOND: {"step": 0.5}})
    assert update(programme).exit_code == 0
    text = (programme.directory / "programme.toml").read_text()
    (programme.directory / "programme.toml").write_text(f'{text}\n[coregistration]\nstable_areas = "{path}"\n')
    return reopen(programme)


def test_errors_are_estimated_on_the_stable_areas_of_the_programme(tmp_path):
    programme = stable_site(tmp_path, shapely.box(WEST, SOUTH, WEST + SIDE / 2, SOUTH + SIDE))
    found = difference_pair(programme, FIRST, SECOND, ModelShelf(programme))
    easting, _ = found.grid.coordinates()
    stable = found.maps.errors.stable
    assert stable.any()
    assert not stable.ravel()[easting > WEST + SIDE / 2].any()


def test_stable_areas_that_hold_hardly_any_ground_are_told_and_left_aside(tmp_path, caplog):
    programme = stable_site(tmp_path, shapely.box(WEST + 1.0, SOUTH + 1.0, WEST + 2.0, SOUTH + 2.0))
    found = difference_pair(programme, FIRST, SECOND, ModelShelf(programme))
    assert "unchanged ground is found instead" in caplog.text
    assert found.maps.errors.stable.sum() > 200
