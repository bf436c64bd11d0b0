"""The time axis of a programme: the command, its files, what it refuses."""

from __future__ import annotations

import csv

import netCDF4
import numpy as np
import pytest
import shapely
import xarray as xr
from numpy.testing import assert_allclose
from small_surveys import BLOCK, SIDE, SOUTH, WEST, add_by_hand, make_programme, reopen, run, snapshot, write_zones
from test_pipeline_real import real, survey  # noqa: F401

from changedetect.cli import main
from changedetect.io.cog import read_cog
from changedetect.io.series import CELL_LAYERS, SERIES_CLASSES, TIME_LAYERS
from changedetect.pipeline.update import update
from changedetect.storage import read_json

DATES = ["2023-01-01", "2023-03-01", "2023-06-01", "2023-09-01", "2024-01-01", "2024-04-01"]
CLASS = {c.meaning: c.value for c in SERIES_CLASSES}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Six surveys; the block is raised by 0.20 m from the fourth on, the east was not seen in the second."""
    surveys = {date: {"step": 0.2 * (k >= 3)} for k, date in enumerate(DATES)}
    programme = make_programme(tmp_path_factory.mktemp("series") / "site", surveys)
    settings = (programme.directory / "programme.toml").read_text()
    (programme.directory / "programme.toml").write_text(f"{settings}\n[coregistration]\nenabled = false\n")
    programme = reopen(programme)
    assert update(programme).exit_code == 0
    return programme.directory


@pytest.fixture(scope="module")
def zones(tmp_path_factory):
    west, east, south, north = BLOCK
    boxes = {
        "block": shapely.box(west + 1, south + 1, east - 1, north - 1),
        "rim": shapely.box(WEST, SOUTH, WEST + 4.0, SOUTH + SIDE),
        "elsewhere": shapely.box(WEST + 5 * SIDE, SOUTH, WEST + 6 * SIDE, SOUTH + SIDE),
    }
    return write_zones(tmp_path_factory.mktemp("zones") / "zones.gpkg", boxes.values(), boxes)


@pytest.fixture(scope="module")
def made(site, zones, tmp_path_factory):
    output = tmp_path_factory.mktemp("made") / "series.nc"
    assert main(["series", str(site), "-o", str(output), "--zones", str(zones), "--quiet"]) == 0
    return output


def inside(dataset, margin):
    west, east, south, north = BLOCK
    x, y = dataset.x.values[None, :], dataset.y.values[:, None]
    return (x > west + margin) & (x < east - margin) & (y > south + margin) & (y < north - margin)


def test_the_step_is_found_where_and_when_it_was(made):
    with xr.open_dataset(made) as series:
        block, far = inside(series, 1.5), ~inside(series, -2.0)
        assert series.sizes["time"] == 6
        assert series.epoch_id.values.tolist() == DATES
        assert (series.series_class.values[block] == CLASS["break_raised"]).mean() > 0.95
        assert_allclose(series.break_size.values[block].mean(), 0.2, rtol=0, atol=0.01)
        time = series.break_time.values[block]
        assert ((time > np.datetime64(DATES[2])) & (time < np.datetime64(DATES[3]))).mean() > 0.95
        assert (series.confirming_surveys.values[block] == 3).mean() > 0.8
        assert series.break_probability.values[block].mean() > 0.95
        seen = series.n_surveys.values >= 2
        assert (series.series_class.values[far & seen] != CLASS["no_change_found"]).mean() < 0.12
        assert_allclose(series.dod.values[4][block].mean(), 0.2, rtol=0, atol=0.01)
        assert_allclose(np.nanmean(series.dod.values[2]), 0.0, rtol=0, atol=0.01)


def test_changes_share_the_error_of_the_first_epoch(made):
    with xr.open_dataset(made) as series:
        known = np.isfinite(series.dod.values)
        assert (series.dod.values[0][known[0]] == 0.0).all()
        assert (series.dod_std.values[0][known[0]] == 0.0).all()
        for k in range(1, 6):
            expected = np.hypot(series.epoch_std.values[0], series.epoch_std.values[k])
            assert_allclose(series.dod_std.values[k][known[k]], expected[known[k]], rtol=1e-5, atol=0)


def test_the_file_follows_the_conventions(made):
    with netCDF4.Dataset(made) as file:
        assert file.Conventions.startswith("CF-1.11")
        assert file.false_alarm_level == pytest.approx(0.05)
        assert set(TIME_LAYERS) | set(CELL_LAYERS) <= set(file.variables)
        for name in TIME_LAYERS:
            variable = file.variables[name]
            assert variable.dimensions == ("time", "y", "x")
            assert variable.grid_mapping == "spatial_ref"
            assert "_FillValue" in variable.ncattrs()
            assert variable.chunking()[0] == 1
        for name in CELL_LAYERS:
            assert file.variables[name].dimensions == ("y", "x")
        for axis in ("time", "x", "y"):
            assert "_FillValue" not in file.variables[axis].ncattrs()
            assert file.variables[axis].bounds in file.variables
        assert file.variables["trend"].units == "m year-1"
        assert file.variables["break_time"].units == file.variables["time"].units
        flags = file.variables["series_class"]
        assert len(flags.flag_meanings.split()) == len(flags.flag_values)
        assert flags.flag_values.dtype == flags.dtype


def test_the_grid_is_that_of_the_maps(site, made):
    path = site / "products" / f"{DATES[0]}_{DATES[5]}" / "dod.tif"
    dod = read_cog(path)[0]
    with xr.open_dataset(made) as series:
        assert series.dod.shape[1:] == dod.shape
        inner = inside(series, 1.5)
        assert_allclose(series.dod.values[5][inner].mean(), dod[inner].mean(), rtol=0, atol=0.005)


def test_zones_have_series_breaks_and_budgets(made):
    with xr.open_dataset(made) as series:
        assert series.zone.values.tolist() == ["block", "rim", "elsewhere"]
        change, std = series.zone_change.values, series.zone_change_std.values
        assert_allclose(change[0], [0.0, 0.0, 0.0, 0.2, 0.2, 0.2], rtol=0, atol=0.01)
        assert (std[0, 1:] > 0.0).all()
        assert np.isnan(change[2]).all()
        assert series.zone_series_class.values[0] == CLASS["break_raised"]
        assert series.zone_series_class.values[1] == CLASS["no_change_found"]
        assert np.isnan(series.zone_series_class.values[2])
        assert_allclose(series.zone_volume_net.values[0, -1], 0.2 * 36.0, rtol=0.05, atol=0)
    with made.with_name("series_zones.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["zone"] for row in rows] == ["all ground", "block", "rim", "elsewhere"]
    assert rows[1]["class"] == "break_raised"
    assert DATES[2] < rows[1]["break_time"] < DATES[3]
    assert rows[1]["confirming_surveys"] == "3"
    with made.with_name("series_budgets.csv").open() as stream:
        budgets = list(csv.DictReader(stream))
    assert len(budgets) == 4 * (5 + 4)  # four areas; five epochs since the first and four more since the previous
    steps = [row for row in budgets if row["zone"] == "block" and row["since"] == "previous"]
    assert [row["epoch_earlier"] for row in steps] == DATES[1:5]
    jump = next(row for row in steps if row["epoch_later"] == DATES[3])
    assert float(jump["volume_net_lower_m3"]) < 7.2 < float(jump["volume_net_upper_m3"]) + 0.3
    assert next(row for row in budgets if row["zone"] == "elsewhere")["change_mean_m"] == ""


def test_the_document_tells_classes_zones_and_what_is_outside(site, zones, tmp_path, capsys):
    done = run(capsys, "series", site, "-o", tmp_path / "s.nc", "--zones", zones, "--resolution", 1)
    assert done["files"]["budgets"] == str(tmp_path / "s_budgets.csv")
    assert sum(done["area_m2"].values()) == pytest.approx(SIDE**2, rel=0.05)
    block, rim, elsewhere = done["zones"]
    assert (block["name"], block["class"], rim["class"]) == ("block", "break_raised", "no_change_found")
    assert elsewhere["class"] == "not_observed"
    assert elsewhere["trend_m_per_year"] is None
    assert [entry["epoch_id"] for entry in block["series"]] == DATES
    assert any("zone 'elsewhere' lies outside" in text for text in done["warnings"])
    assert not list(tmp_path.glob(".s-*"))


def test_people_read_two_tables(site, zones, tmp_path, capsys):
    assert main(["series", str(site), "-o", str(tmp_path / "s.nc"), "--zones", str(zones), "--resolution", "1"]) == 0
    text = capsys.readouterr().out
    assert "no change found" in text
    assert "block" in text
    assert "2023-0" in text


def test_monitoring_is_more_careful(site, tmp_path, capsys):
    one = run(capsys, "series", site, "-o", tmp_path / "one.nc", "--resolution", 1)
    many = run(capsys, "series", site, "-o", tmp_path / "many.nc", "--resolution", 1, "--monitoring")
    assert many["area_m2"]["no_change_found"] >= one["area_m2"]["no_change_found"]
    with xr.open_dataset(tmp_path / "many.nc") as series:
        assert 0.005 < series.false_alarm_level < 0.03


def test_a_dry_run_checks_everything_and_writes_nothing(site, zones, tmp_path, capsys):
    before = snapshot(tmp_path)
    done = run(capsys, "series", site, "-o", tmp_path / "s.nc", "--zones", zones, "--dry-run")
    assert (done["n_zones"], len(done["epochs"])) == (3, 6)
    assert any("zone 'elsewhere' lies outside" in text for text in done["warnings"])
    assert snapshot(tmp_path) == before


def test_what_cannot_be_meant_is_refused(site, zones, tmp_path, capsys):
    done = run(capsys, "series", site, "-o", tmp_path / "s.tif", expect=2)
    assert "s.tif' does not end in .nc." in done["error"]["message"]
    run(capsys, "series", site, "-o", tmp_path / "s.nc", "--zones", tmp_path / "none.gpkg", expect=66)
    run(capsys, "series", tmp_path / "nowhere", "-o", tmp_path / "s.nc", expect=66)
    (tmp_path / "s.nc").write_text("kept")
    run(capsys, "series", site, "-o", tmp_path / "s.nc", expect=73)
    assert (tmp_path / "s.nc").read_text() == "kept"
    (tmp_path / "t_zones.csv").write_text("kept")
    run(capsys, "series", site, "-o", tmp_path / "t.nc", "--zones", zones, expect=73)
    (tmp_path / "file").write_text("no folder")
    run(capsys, "series", site, "-o", tmp_path / "file" / "s.nc", expect=73)
    done = run(capsys, "series", site, "-o", tmp_path / "u.nc", "--bounds", 5, 1, 0, 1, expect=78)
    assert "west" in done["error"]["message"]


def test_bounds_away_from_the_data_are_refused(site, tmp_path, capsys):
    away = (WEST + 100, WEST + 120, SOUTH, SOUTH + SIDE)
    for words in ((), ("--dry-run",)):
        done = run(capsys, "series", site, "-o", tmp_path / "s.nc", "--bounds", *away, *words, expect=78)
        message = done["error"]["message"]
        assert f"easting {away[0]:.1f} to {away[1]:.1f}" in message
        assert f"the data span easting {WEST:.1f}" in message
    done = run(capsys, "surface", site, DATES[0], "-o", tmp_path / "s.tif", "--bounds", *away, expect=78)
    assert "--bounds" in done["error"]["message"]
    assert not list(tmp_path.iterdir())


def test_bounds_in_a_gap_of_all_data_are_refused(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {DATES[0]: {}, DATES[1]: {"shift": 60.0}})
    with (programme.directory / "programme.toml").open("a") as stream:
        stream.write("\n[coregistration]\nenabled = false\n")
    run(capsys, "update", programme.directory)
    gap = (WEST + 35, WEST + 45, SOUTH, SOUTH + SIDE)
    done = run(capsys, "series", programme.directory, "-o", tmp_path / "s.nc", "--bounds", *gap, expect=65)
    assert "a gap in all data" in done["error"]["message"]
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


def test_one_epoch_is_no_series(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {DATES[0]: {}})
    assert update(programme).exit_code == 0
    done = run(capsys, "series", tmp_path / "site", "-o", tmp_path / "s.nc", expect=65)
    assert "needs two learned epochs" in done["error"]["message"]
    assert not (tmp_path / "s.nc").exists()


def test_an_epoch_that_is_not_learned_is_left_out_and_told(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {DATES[0]: {}, DATES[1]: {}})
    assert update(programme).exit_code == 0
    add_by_hand(programme.directory, DATES[2], seed=7)
    done = run(capsys, "series", tmp_path / "site", "-o", tmp_path / "s.nc")
    assert [epoch["epoch_id"] for epoch in done["epochs"]] == DATES[:2]
    assert done["warnings"] == [f"epoch {DATES[2]} has not been learned and is left out"]
    with xr.open_dataset(tmp_path / "s.nc") as series:
        assert np.isnan(series.trend.values).all()  # two surveys have none
        assert (series.series_class.values[5:-5, 5:-5] == CLASS["no_change_found"]).mean() > 0.85


def test_surveys_of_different_ground_have_nothing_in_common(tmp_path, capsys):
    programme = make_programme(
        tmp_path / "site", {DATES[0]: {}, DATES[1]: {"shift": 30.0}}, bounds=[WEST, WEST + 50.0, SOUTH, SOUTH + SIDE]
    )
    text = (programme.directory / "programme.toml").read_text()
    (programme.directory / "programme.toml").write_text(f"{text}\n[coregistration]\nenabled = false\n")
    run(capsys, "update", programme.directory)
    summary = read_json(programme.directory / "products" / f"{DATES[0]}_{DATES[1]}" / "summary.json")
    assert summary["warnings"] == ["no ground was observed by both epochs: the maps hold no difference"]
    for command in (("diff", "-o", tmp_path / "maps"), ("volume", "-o", tmp_path / "volumes.csv")):
        verb, *output = command
        error = run(capsys, verb, programme.directory, *DATES[:2], *output, expect=65)["error"]
        assert f"Epochs {DATES[0]} and {DATES[1]} of '{programme.directory}' observed no ground" in error["message"]
        assert not output[1].exists()
    done = run(capsys, "series", programme.directory, "-o", tmp_path / "s.nc")
    assert done["area_m2"]["too_few_surveys"] > 700.0
    assert sum(done["area_m2"].values()) == done["area_m2"]["too_few_surveys"]
    assert done["whole"]["class"] == "too_few_surveys"
    with xr.open_dataset(tmp_path / "s.nc") as series:
        assert np.isnan(series.dod.values[1]).all()
        assert series.observed.values[1].sum() > 1000


def test_the_reference_mode_has_series_too(tmp_path, capsys):
    surveys = {date: {"step": 0.3 * (k >= 2)} for k, date in enumerate(DATES[:4])}
    programme = make_programme(tmp_path / "site", surveys, model="reference")
    assert update(programme).exit_code == 0
    run(capsys, "series", programme.directory, "-o", tmp_path / "s.nc")
    with xr.open_dataset(tmp_path / "s.nc") as series:
        block = inside(series, 2.0)
        assert_allclose(series.dod.values[3][block].mean(), 0.3, rtol=0, atol=0.05)
        assert 399.0 < series.elevation.values[block].mean() < 402.0


@real
def test_the_sandbar_has_a_series(survey, capsys, tmp_path):  # noqa: F811
    site = survey("grand_canyon_sandbar")
    assert main(["update", str(site), "--quiet"]) == 0
    capsys.readouterr()
    done = run(capsys, "series", site, "-o", tmp_path / "series.nc")
    assert len(done["epochs"]) == 3
    with xr.open_dataset(tmp_path / "series.nc") as series:
        assert -2.0 < np.nanmin(series.dod.values) < -0.3
        assert 0.3 < np.nanmax(series.dod.values) < 2.5
