"""The commands as people and scripts use them: documents, texts, exit codes."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
import xarray as xr
from small_surveys import CRS, SIDE, SOUTH, WEST, make_programme, reopen, run, snapshot, write_survey

from changedetect.cli import main
from changedetect.io.cog import read_cog
from changedetect.models.registry import load_model
from changedetect.pipeline.lock import programme_lock
from changedetect.pipeline.update import update

FIRST, SECOND = "2024-01-01", "2024-07-01"


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    programme = make_programme(tmp_path_factory.mktemp("learned") / "site", {FIRST: {}, SECOND: {"step": 0.5}})
    assert update(programme).exit_code == 0
    return programme


@pytest.fixture
def site(learned, tmp_path):
    shutil.copytree(learned.directory, tmp_path / "site", copy_function=shutil.copy2)
    return tmp_path / "site"


def places(path, rows, header="easting,northing"):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


# --- from nothing to maps ---------------------------------------------------------------------------------------


def test_init_add_update_lead_from_files_to_maps(tmp_path, capsys):
    site = tmp_path / "site"
    made = run(capsys, "init", site, "--crs", CRS, "--resolution", 0.5, "--name", "My site")
    assert made["command"] == "init"
    assert made["config"]["resolution"] == 0.5
    for seed, epoch_id in enumerate((FIRST, SECOND)):
        path = write_survey(tmp_path / f"{seed}.laz", seed, step=0.5 * seed)
        added = run(capsys, "add", site, epoch_id, path, "--label", "flown low")
        assert (added["epoch_id"], added["date"], added["n_points"]) == (epoch_id, epoch_id, 1800)
        assert len(added["sources"][0]["sha256"]) == 64
    before = run(capsys, "status", site)
    assert before["n_due"] == 5
    assert [epoch["model"] for epoch in before["epochs"]] == [None, None]
    done = run(capsys, "update", site)
    assert {step["status"] for step in done["steps"]} == {"made"}
    assert done["significant_change"]
    assert [epoch["parent"] for epoch in done["epochs"]] == [None, FIRST]
    (pair,) = done["pairs"]
    np.testing.assert_allclose(pair["volume_net_m3"], 32.0, rtol=0.05, atol=0)
    assert (site / "products" / f"{FIRST}_{SECOND}" / "dod.tif").is_file()
    after = run(capsys, "status", site)
    assert after["n_due"] == 0
    assert run(capsys, "verify", site)["findings"] == []
    assert run(capsys, "update", site)["run_id"] is None


def test_update_ends_with_a_table_of_epochs_volumes_and_places(site, capsys):
    assert main(["update", str(site)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("Nothing to do: all models and products are up to date.\n")
    for word in (FIRST, SECOND, "1,800", "adaptive", "raised m3", "±", f"Maps lie in {site / 'products'}"):
        assert word in text


def test_status_says_what_is_to_do_and_why(site, capsys):
    (site / "products" / FIRST / "elevation.tif").unlink()
    assert main(["status", str(site)]) == 0
    assert f"To do: maps of {FIRST}: elevation.tif is missing" in capsys.readouterr().out


def test_update_returns_ten_for_significant_change_only_when_asked_and_only_when_new(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {"step": 0.5}})
    run(capsys, "update", programme.directory, "--exit-code", expect=10)
    run(capsys, "update", programme.directory, "--exit-code", expect=0)


def test_update_takes_pairs_and_workers(site, capsys):
    document = run(capsys, "update", site, "--pairs", "all", "--workers", 1)
    assert document["n_due"] == 0


def test_a_failed_epoch_gives_its_exit_code_and_is_told(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {}})
    (programme.directory / "inputs" / f"{SECOND}.laz").write_bytes(b"no LAS file")
    assert main(["update", str(programme.directory)]) == 65
    captured = capsys.readouterr()
    assert f"Failed: model of {SECOND}:" in captured.out
    assert "is not a LAS or LAZ file" in captured.err
    document = run(capsys, "update", programme.directory, expect=65)
    assert document["steps"][0]["error"]["class"] == "InputDataError"


# --- dry runs and overwriting -----------------------------------------------------------------------------------


def test_dry_runs_touch_nothing_and_say_what_would_be_done(tmp_path, site, capsys):
    new = write_survey(tmp_path / "new.laz", 9)
    table = places(tmp_path / "places.csv", [(WEST + 5, SOUTH + 5)])
    (site / "products" / FIRST / "elevation.tif").unlink()
    before = snapshot(tmp_path)
    assert run(capsys, "init", tmp_path / "other", "--crs", CRS, "--dry-run")["dry_run"]
    assert run(capsys, "add", site, "2025-01-01", new, "--dry-run")["n_points"] == 1800
    assert run(capsys, "update", site, "--dry-run")["n_due"] == 1
    assert run(capsys, "predict", site, FIRST, table, "-o", tmp_path / "out.csv", "--dry-run")["n_points"] == 1
    assert run(capsys, "surface", site, FIRST, "-o", tmp_path / "out.tif", "--dry-run")["shape"] == [40, 40]
    assert run(capsys, "diff", site, FIRST, SECOND, "-o", tmp_path / "maps", "--dry-run")["dry_run"]
    assert len(run(capsys, "simulate", tmp_path / "demo", "--dry-run", "--density", 1)["files"]) == 14
    assert snapshot(tmp_path) == before


def test_outputs_that_exist_are_kept_unless_overwriting_is_asked_for(tmp_path, site, capsys):
    table = places(tmp_path / "places.csv", [(WEST + 5, SOUTH + 5)])
    commands = [
        ("predict", site, FIRST, table, "-o", tmp_path / "out.csv"),
        ("surface", site, FIRST, "-o", tmp_path / "out.tif"),
        ("diff", site, FIRST, SECOND, "-o", tmp_path / "maps"),
        ("init", tmp_path / "new", "--crs", CRS),
    ]
    for command in commands:
        run(capsys, *command)
        error = run(capsys, *command, expect=73)["error"]
        assert error["class"] == "OutputExistsError"
        assert "--overwrite" in error["message"]
        run(capsys, *command, "--overwrite")


def test_diff_never_replaces_a_folder_that_holds_something_else(tmp_path, site, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    run(capsys, "diff", site, FIRST, SECOND, "-o", tmp_path / "mine", "--overwrite", expect=73)
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"
    (tmp_path / "empty").mkdir()
    run(capsys, "diff", site, FIRST, SECOND, "-o", tmp_path / "empty")


# --- asking models ----------------------------------------------------------------------------------------------


def test_predict_writes_what_the_model_says_bit_for_bit(tmp_path, site, capsys):
    rng = np.random.default_rng(4)
    easting, northing = WEST + rng.uniform(0, SIDE, 50), SOUTH + rng.uniform(0, SIDE, 50)
    rows = [*zip(easting.tolist(), northing.tolist(), strict=True), (WEST + 500.0, SOUTH)]
    table = places(tmp_path / "places.csv", [(n, "x", e) for e, n in rows], header="Northing,name,Easting")
    document = run(capsys, "predict", site, SECOND, table, "-o", tmp_path / "out.csv")
    assert (document["n_points"], document["n_without_answer"]) == (51, 1)
    with (tmp_path / "out.csv").open() as stream:
        written = list(csv.DictReader(stream))
    assert list(written[0]) == ["easting", "northing", "elevation", "elevation_std", "noise_std", "n_effective"]
    expected = load_model(site / "state" / SECOND).predict(
        (np.append(easting, WEST + 500.0), np.append(northing, SOUTH))
    )
    for name in ("elevation", "elevation_std", "noise_std", "n_effective"):
        np.testing.assert_array_equal([float(row[name]) for row in written], getattr(expected, name))
    assert (written[-1]["elevation"], written[-1]["n_effective"]) == ("nan", "0.0")


def test_predict_takes_a_table_without_header(tmp_path, site, capsys):
    (tmp_path / "places.csv").write_text(f"{WEST + 5},{SOUTH + 5}\n\n{WEST + 6},{SOUTH + 6}\n")
    assert run(capsys, "predict", site, FIRST, tmp_path / "places.csv", "-o", tmp_path / "out.csv")["n_points"] == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no places"),
        ("easting,northing\n", "holds no places"),
        ("lon,lat\n1,2\n", "has no column 'easting'"),
        ("easting,northing\n1,2\nx,3\n", "line 3: 'x' is no finite coordinate"),
        ("easting,northing\n1,2\n1\n", "line 3: '' is no finite coordinate"),
        ("easting,northing\n1,inf\n", "line 2: 'inf' is no finite coordinate"),
    ],
)
def test_predict_refuses_a_wrong_table_and_writes_nothing(tmp_path, site, capsys, text, message):
    (tmp_path / "places.csv").write_text(text)
    command = ("predict", site, FIRST, tmp_path / "places.csv", "-o", tmp_path / "out.csv")
    assert message in run(capsys, *command, expect=65)["error"]["message"]
    assert not (tmp_path / "out.csv").exists()


def test_surface_writes_one_layer_or_all(tmp_path, site, capsys):
    command = ("surface", site, FIRST, "--resolution", 1, "--bounds", WEST + 2, WEST + 12, SOUTH + 4, SOUTH + 10)
    document = run(capsys, *command, "-o", tmp_path / "std.tif", "--layer", "elevation_std")
    assert document["shape"] == [6, 10]
    array, grid, tags = read_cog(tmp_path / "std.tif")
    assert grid.region == (WEST + 2, WEST + 12, SOUTH + 4, SOUTH + 10)
    assert (tags["layer"], tags["epoch"]) == ("elevation_std", FIRST)
    assert (array > 0).all()
    run(capsys, *command, "-o", tmp_path / "all.nc")
    with xr.open_dataset(tmp_path / "all.nc") as dataset:
        assert {"elevation", "elevation_std", "noise_std", "n_effective", "age_days"} <= set(dataset.data_vars)
        np.testing.assert_array_equal(dataset["elevation_std"][0], array)
    error = run(capsys, *command, "-o", tmp_path / "all.xyz", expect=2)["error"]
    assert "all.xyz' does not end in .tif or .tiff or .nc." in error["message"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--resolution", -1), "must be above zero"),
        (("--resolution", 0), "must be above zero"),
        (("--bounds", 5, 4, 3, 2), "west < east and south < north"),
        (("--bounds", 0, 2e7, 0, 2e7), "are there stray points"),
        (("--bounds", 0, 2e7, 0, 2e6), "Bounds given (--bounds) hold no data"),
    ],
)
def test_surface_refuses_a_grid_that_cannot_be_meant(tmp_path, site, capsys, options, message):
    error = run(capsys, "surface", site, FIRST, "-o", tmp_path / "out.tif", "--dry-run", *options, expect=78)["error"]
    assert message in error["message"]


def test_diff_writes_the_same_maps_as_update(tmp_path, site, capsys):
    document = run(capsys, "diff", site, FIRST, SECOND, "-o", tmp_path / "maps")
    assert document["output"]["summary"]["epoch_later"] == SECOND
    one = read_cog(tmp_path / "maps" / "dod.tif")[0]
    np.testing.assert_array_equal(one, read_cog(site / "products" / f"{FIRST}_{SECOND}" / "dod.tif")[0])
    error = run(capsys, "diff", site, SECOND, FIRST, "-o", tmp_path / "back", expect=65)["error"]
    assert "goes from an earlier epoch to a later one" in error["message"]
    assert f"in this order: {FIRST} {SECOND}" in error["message"]


def test_outputs_do_not_replace_what_the_programme_keeps(tmp_path, site, capsys):
    before = snapshot(site)
    for command in (
        ("diff", site, FIRST, SECOND, "-o", site / "state" / FIRST, "--overwrite"),
        ("diff", site, FIRST, SECOND, "-o", site / "products" / FIRST, "--overwrite"),
        ("surface", site, FIRST, "-o", site / "products" / FIRST / "elevation.tif", "--overwrite"),
        ("series", site, "-o", site / "state" / FIRST / "model.nc", "--overwrite"),
        ("volume", site, FIRST, SECOND, "-o", site / "runs" / "volumes.csv"),
    ):
        assert "which the programme keeps for itself" in run(capsys, *command, expect=2)["error"]["message"]
    shutil.copytree(site / "state" / FIRST, tmp_path / "model")
    error = run(capsys, "diff", site, FIRST, SECOND, "-o", tmp_path / "model", "--overwrite", expect=73)["error"]
    assert "holds something else than products" in error["message"]
    assert snapshot(site) == before


def test_a_model_that_is_not_current_is_used_with_a_warning(tmp_path, site, capsys):
    path = site / "epochs" / f"{FIRST}.toml"
    path.write_text(path.read_text() + "sigma = 0.05\n")
    assert main(["surface", str(site), FIRST, "-o", str(tmp_path / "out.tif")]) == 0
    assert f"the model of {FIRST} is not up to date" in capsys.readouterr().err


def test_an_epoch_that_is_not_learned_or_not_known_is_missing_input(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    command = ("surface", programme.directory, FIRST, "-o", tmp_path / "out.tif")
    assert "has not been learned. Run: changedetect update" in run(capsys, *command, expect=66)["error"]["message"]
    command = ("surface", programme.directory, "2020-01-01", "-o", tmp_path / "out.tif")
    assert "has no epoch '2020-01-01'" in run(capsys, *command, expect=66)["error"]["message"]


# --- options of add ---------------------------------------------------------------------------------------------


def test_add_needs_a_date_where_the_id_is_none(tmp_path, site, capsys):
    path = write_survey(tmp_path / "new.laz", 9)
    error = run(capsys, "add", site, "after-storm", path, expect=78)["error"]
    assert "no --date is given, and the epoch id 'after-storm' is not a date" in error["message"]
    added = run(capsys, "add", site, "after-storm", path, "--date", "2025-02-03T04:05")
    assert added["date"] == "2025-02-03T04:05:00"


def test_add_reads_classes_repeated_or_with_commas(tmp_path, site, capsys):
    classification = np.repeat(np.array([2, 3, 9], np.uint8), 600)
    path = write_survey(tmp_path / "new.laz", 9, classification=classification)
    command = ("add", site, "2025-01-01", path, "--dry-run")
    assert run(capsys, *command, "--classes", "2")["n_points"] == 600
    assert run(capsys, *command, "--classes", "2,9")["n_points"] == 1200
    assert run(capsys, *command, "--classes", "2", "--classes", "9")["n_points"] == 1200
    assert "classes are whole numbers" in run(capsys, *command, "--classes", "ground", expect=2)["error"]["message"]
    assert "from 0 to 255" in run(capsys, *command, "--classes", "300", expect=2)["error"]["message"]


@pytest.mark.parametrize("sigma", ["-1", "0", "nan", "inf"])
def test_add_refuses_a_sigma_that_is_none(tmp_path, site, capsys, sigma):
    error = run(capsys, "add", site, "2024-05-05", tmp_path / "any.laz", "--sigma", sigma, expect=2)["error"]
    assert "above zero" in error["message"]


def test_add_refuses_an_epoch_that_exists_with_73_and_a_file_twice_with_65(tmp_path, site, capsys):
    run(capsys, "add", site, FIRST, write_survey(tmp_path / "new.laz", 9), expect=73)
    copy = tmp_path / "copy.laz"
    shutil.copy(site / "inputs" / f"{FIRST}.laz", copy)
    error = run(capsys, "add", site, "2025-01-01", copy, expect=65)["error"]
    assert f"in epoch '{FIRST}'" in error["message"]


# --- settings ---------------------------------------------------------------------------------------------------


def test_config_show_tells_each_value_and_its_source(site, capsys, monkeypatch, tmp_path):
    (tmp_path / "extra.toml").write_text("memory_days = 10\n")
    monkeypatch.setenv("CHANGEDETECT_DIFFERENCING__CONFIDENCE", "0.9")
    settings = run(capsys, "config", "show", site, "--config", tmp_path / "extra.toml")["settings"]
    assert settings["memory_days"] == {"value": 10.0, "source": str(tmp_path / "extra.toml")}
    assert settings["differencing.confidence"]["source"] == "environment CHANGEDETECT_DIFFERENCING__CONFIDENCE"
    assert settings["model"] == {"value": "adaptive", "source": "default.toml"}
    assert main(["config", "show", str(site)]) == 0
    assert "differencing.confidence" in capsys.readouterr().out


def test_an_unknown_key_in_programme_toml_is_a_configuration_error(site, capsys):
    path = site / "programme.toml"
    path.write_text(path.read_text() + "[adaptive]\nkernal_ratio = 2\n")
    for command in (("status", site), ("update", site), ("config", "show", site)):
        error = run(capsys, *command, expect=78)["error"]
        assert "unknown key 'kernal_ratio' in section [adaptive]. Did you mean 'kernel_ratio'?" in error["message"]


def test_init_refuses_a_crs_that_cannot_carry_a_programme(tmp_path, capsys):
    for crs in ("EPSG:4326", "EPSG:2227", "EPSG:99999999"):
        run(capsys, "init", tmp_path / "site", "--crs", crs, expect=65)
    run(capsys, "init", tmp_path / "site", "--crs", CRS, "--profile", "submarine", expect=78)
    run(capsys, "init", tmp_path / "site", "--crs", CRS, "--resolution", -1, expect=78)
    run(capsys, "init", tmp_path / "site", "--crs", CRS, "--bounds", 3, 1, 0, 1, expect=78)
    assert not (tmp_path / "site").exists()


# --- verify, locks, simulation ----------------------------------------------------------------------------------


def test_verify_returns_65_and_names_what_is_damaged(site, capsys):
    path = site / "products" / FIRST / "elevation.tif"
    path.write_bytes(path.read_bytes()[:-1])
    document = run(capsys, "verify", site, expect=65)
    assert document["n_errors"] == 1
    assert document["findings"][0]["subject"] == f"products/{FIRST}"
    assert main(["verify", str(site)]) == 65
    assert f"error: products/{FIRST}: elevation.tif has" in capsys.readouterr().out


def test_a_programme_in_use_gives_75(site, capsys):
    (site / "products" / FIRST / "elevation.tif").unlink()
    with programme_lock(site):
        error = run(capsys, "update", site, expect=75)["error"]
    assert error["class"] == "TemporaryError"
    assert "is locked by process" in error["message"]


def test_a_simulated_programme_is_ready_for_update(tmp_path, capsys):
    document = run(capsys, "simulate", tmp_path / "demo", "--density", 2, "--seed", 5)
    assert sorted(document["files"]) == sorted(
        str(path.relative_to(tmp_path / "demo")) for path in (tmp_path / "demo").rglob("*") if path.is_file()
    )
    run(capsys, "simulate", tmp_path / "again", "--density", 2, "--seed", 5)
    for name in document["files"]:
        assert (tmp_path / "demo" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    run(capsys, "simulate", tmp_path / "demo", expect=73)
    assert len(run(capsys, "update", tmp_path / "demo")["epochs"]) == 3
    truth = json.loads((tmp_path / "demo" / "truth" / "truth.json").read_text())
    assert set(truth["volumes"]) == {pair.product_id for pair in reopen_pairs(tmp_path / "demo")}


def reopen_pairs(directory):
    from changedetect.catalogue import Programme

    return reopen(Programme.open(directory, environment={})).pairs("all")
