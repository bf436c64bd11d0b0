"""Comparing models on an epoch's own points: read as `update` reads them, nothing of the programme changed."""

from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from small_surveys import make_programme, reopen, snapshot

from changedetect.catalogue import Programme
from changedetect.errors import ConfigError, MissingInputError, OutputExistsError
from changedetect.pipeline.compare import compare_epoch, method_names
from changedetect.validation import ComparisonOptions

FIRST = "2024-01-01"
QUICK = ComparisonOptions(hold_outs=("random",), is_isolated=False)
REPOSITORY = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("CHANGEDETECT_DATA", REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="module")
def programme(tmp_path_factory):
    return make_programme(tmp_path_factory.mktemp("compared") / "site", {FIRST: {}})


def test_the_points_are_those_of_the_epoch_inside_the_bounds(programme, tmp_path):
    whole = compare_epoch(programme, FIRST, ["block_mean"], QUICK)
    assert whole["n_available"] == whole["n_points"] == 1800
    shutil.copytree(programme.directory, tmp_path / "site")
    path = tmp_path / "site" / "programme.toml"
    path.write_text(path.read_text() + "bounds = [500000.0, 500010.0, 5300000.0, 5300020.0]\n")
    half = compare_epoch(Programme.open(tmp_path / "site", environment={}), FIRST, ["block_mean"], QUICK)
    np.testing.assert_allclose(half["n_points"], 900, rtol=0, atol=100)


def test_an_epoch_need_not_be_learned_and_nothing_is_changed(programme):
    before = snapshot(programme.directory)
    compare_epoch(programme, FIRST, ["adaptive", "delaunay"], QUICK)
    assert snapshot(programme.directory) == before


def test_the_programmes_own_model_and_settings_come_first(programme):
    assert method_names(programme)[:2] == ("adaptive", "reference")
    flags = {"model": "reference", "lwpr.initial_kernel_m": 6.0}
    own = reopen(programme, flags=flags)
    assert method_names(own)[:2] == ("reference", "adaptive")
    (coarse,) = compare_epoch(own, FIRST, ["reference"], QUICK)["hold_outs"]
    (default,) = compare_epoch(programme, FIRST, ["reference"], QUICK)["hold_outs"]
    assert coarse["evaluations"][0]["own"]["rmse"] > 1.2 * default["evaluations"][0]["own"]["rmse"]


def test_a_dry_run_reads_and_plans(programme, tmp_path):
    plan = compare_epoch(programme, FIRST, None, QUICK, plot=tmp_path / "a.png", dry_run=True)
    assert [item["name"] for item in plan["hold_outs"][0]["evaluations"]] == list(method_names(programme))
    assert all(item["common"] is None for item in plan["hold_outs"][0]["evaluations"])
    assert not (tmp_path / "a.png").exists()


def test_what_cannot_be_done_is_refused_before_anything_is_read(programme, tmp_path, monkeypatch):
    with pytest.raises(MissingInputError, match="has no epoch '2020-01-01'"):
        compare_epoch(programme, "2020-01-01", ["adaptive"], QUICK)
    with pytest.raises(ConfigError, match=r"Unknown methods: krigging\. Known are adaptive, reference"):
        compare_epoch(programme, FIRST, ["krigging"], QUICK)
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        compare_epoch(programme, FIRST, ["block_mean"], QUICK, plot=tmp_path / "a.png")
    compare_epoch(programme, FIRST, ["block_mean"], QUICK, plot=tmp_path / "a.png", overwrite=True)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_missing_packages_are_named_with_the_fix(programme, tmp_path, monkeypatch):
    found = importlib.util.find_spec

    def without_extras(name, package=None):
        return None if name in ("sklearn", "matplotlib") else found(name, package)

    monkeypatch.setattr("changedetect.validation.methods.find_spec", without_extras)
    monkeypatch.setattr("changedetect.validation.plot.find_spec", without_extras)
    with pytest.raises(ConfigError, match=r"needs scikit-learn.*pip install 'changedetect\[compare\]'"):
        compare_epoch(programme, FIRST, ["gpr_rbf"], QUICK)
    with pytest.raises(ConfigError, match=r"needs matplotlib.*pip install 'changedetect\[compare\]'"):
        compare_epoch(programme, FIRST, ["block_mean"], QUICK, plot=tmp_path / "a.png")
    plan = compare_epoch(programme, FIRST, None, QUICK, dry_run=True)
    skipped = {item["name"]: item["skipped"] for item in plan["hold_outs"][0]["evaluations"]}
    assert skipped["gpr_matern32"] == "needs scikit-learn: pip install 'changedetect[compare]'"
    assert skipped["kriging"] is None


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
def test_real_ground_is_foretold_about_as_well_as_by_kriging_and_more_honestly(tmp_path, monkeypatch):
    monkeypatch.setenv("CHANGEDETECT_DATA", str(DATA))
    site = shutil.copytree(REPOSITORY / "surveys" / "toronto_spit", tmp_path / "site")
    options = ComparisonOptions(hold_outs=("random",), is_isolated=False, max_points=12_000)
    programme = Programme.open(site, environment={})
    names = ["adaptive", "kriging", "block_mean"]
    (hold_out,) = compare_epoch(programme, "2015-04-07", names, options)["hold_outs"]
    adaptive, kriging, blocks = (item["common"] for item in hold_out["evaluations"])
    assert hold_out["n_common"] > 1000
    assert adaptive["rmse"] < 1.25 * kriging["rmse"] < 0.7 * blocks["rmse"]
    assert adaptive["nlpd"] < kriging["nlpd"]
    np.testing.assert_allclose(adaptive["coverage_95"], 0.95, rtol=0, atol=0.03)
