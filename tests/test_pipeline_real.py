"""The surveys defined in `surveys/`, from their files to their maps."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from small_surveys import run

from changedetect.catalogue import Programme, plan
from changedetect.io.cog import read_cog
from changedetect.storage import read_json

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("CHANGEDETECT_DATA", REPOSITORY.parent / "shared" / "data"))


def real(test):
    """Mark a test that reads the real surveys; it is skipped where they are not."""
    skip = pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
    return pytest.mark.real(skip(test))


@pytest.fixture
def survey(tmp_path, monkeypatch):
    """Return a function that copies a survey's definition to where a test may work."""
    monkeypatch.setenv("CHANGEDETECT_DATA", str(DATA))

    def copy(name):
        definition = REPOSITORY / "surveys" / name
        ignored = shutil.ignore_patterns("state", "products", "runs", ".lock", "*.tmp-*")
        return shutil.copytree(definition, tmp_path / name, ignore=ignored)

    return copy


def elevations(site, epoch_id):
    return read_cog(site / "products" / epoch_id / "elevation.tif")[0]


@pytest.mark.parametrize("name", sorted(path.parent.name for path in REPOSITORY.glob("surveys/*/programme.toml")))
def test_every_survey_definition_is_valid(name):
    programme = Programme.open(REPOSITORY / "surveys" / name, environment={})
    assert len(programme.epochs) >= 2
    assert len([item for item in plan(programme) if item.kind == "model"]) == len(programme.epochs)


@pytest.mark.parametrize("name", ["toronto_spit", "st_leonards_beach", "grand_canyon_sandbar"])
def test_a_survey_without_its_data_says_what_to_set(name, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("CHANGEDETECT_DATA", raising=False)
    site = shutil.copytree(REPOSITORY / "surveys" / name, tmp_path / name)
    document = run(capsys, "update", site, expect=66)
    assert "needs the environment variable CHANGEDETECT_DATA" in document["steps"][0]["error"]["message"]


@real
def test_the_toronto_pair_is_learned_and_its_datum_step_is_said(survey, capsys):
    site = survey("toronto_spit")
    document = run(capsys, "update", site)
    assert [epoch["n_points"] for epoch in document["epochs"]] == [45955, 41915]
    (warning,) = document["warnings"]
    assert "The epoch lies 0.42 m below the reference everywhere, as a step of the vertical datum would" in warning
    (summary,) = document["pairs"]
    np.testing.assert_allclose(summary["change_median_m"], 0.0, rtol=0, atol=0.02)
    assert summary["change_nmad_m"] < 0.15
    ground = elevations(site, "2015-04-07")
    assert 73.0 < np.nanmin(ground) < np.nanmax(ground) < 105.0
    assert 0.2 < np.mean(np.isfinite(ground)) < 0.7  # open water and the surroundings stay empty
    assert run(capsys, "verify", site)["findings"] == []


@real
def test_the_sandbar_is_learned_and_its_change_found(survey, capsys):
    site = survey("grand_canyon_sandbar")
    document = run(capsys, "update", site)
    assert [epoch["n_points"] for epoch in document["epochs"]] == [1984, 1929, 1297]
    # the bar grew all over from 2017 to 2018: that is no misalignment
    assert not document["epochs"][1]["alignment"]["is_applied"]
    assert any("Not aligned, for want of stable ground" in warning for warning in document["warnings"])
    assert len(document["pairs"]) == 3
    values, _, _ = read_cog(site / "products" / "2018-09-26_2019-10-05" / "dod.tif")
    assert -2.5 < np.nanmin(values) < -0.8
    assert np.nanmax(values) < 2.5
    net = {pair["epoch_earlier"] + pair["epoch_later"]: pair["volume_net_m3"] for pair in document["pairs"]}
    assert net["2017-09-302018-09-26"] > 0 > net["2018-09-262019-10-05"]
    assert run(capsys, "update", site)["run_id"] is None


@real
def test_the_beach_is_learned_from_rasters_whose_grids_differ(survey, capsys):
    site = survey("st_leonards_beach")
    for path in sorted((site / "epochs").glob("*.toml"))[3:]:
        path.unlink()
    document = run(capsys, "update", site)
    assert len(document["epochs"]) == 3
    shapes = {
        read_cog(site / "products" / epoch["epoch_id"] / "elevation.tif")[1].region for epoch in document["epochs"]
    }
    assert shapes == {(299840.0, 300060.0, 5773164.0, 5773732.0)}
    for epoch in document["epochs"]:
        ground = elevations(site, epoch["epoch_id"])
        assert -12.0 < np.nanmin(ground) < np.nanmax(ground) < 40.0
    quiet = read_json(site / "products" / "2018-06-06_2018-07-13" / "summary.json")
    assert quiet["area_observed_m2"] > 50_000


@pytest.mark.slow
@real
def test_all_six_epochs_of_the_beach_run_through(survey, capsys):
    site = survey("st_leonards_beach")
    document = run(capsys, "update", site)
    assert len(document["epochs"]) == 6
    assert len(document["pairs"]) == 6
    assert run(capsys, "verify", site)["findings"] == []
