"""`changedetect compare`: its table, its document, its refusals."""

from __future__ import annotations

import pytest
from small_surveys import make_programme, run

from changedetect.cli import main

FIRST = "2024-01-01"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return make_programme(tmp_path_factory.mktemp("compared") / "site", {FIRST: {}}).directory


def test_compare_prints_one_document_and_draws(site, tmp_path, capsys):
    plot = tmp_path / "compare.png"
    options = ("--models", "adaptive,block_mean", "--holdout", "random", "--plot", plot)
    document = run(capsys, "compare", site, FIRST, *options)
    assert (document["command"], document["epoch_id"], document["plot"]) == ("compare", FIRST, str(plot))
    (hold_out,) = document["hold_outs"]
    adaptive, blocks = hold_out["evaluations"]
    assert adaptive["common"]["rmse"] < blocks["common"]["rmse"]
    assert {"nlpd", "crps", "coverage_50", "coverage_90", "coverage_95"} <= set(adaptive["common"])
    assert adaptive["cpu_seconds"] > 0.0
    assert plot.read_bytes().startswith(b"\x89PNG")
    run(capsys, "compare", site, FIRST, *options, expect=73)


def test_compare_prints_a_table_for_people(site, capsys):
    assert (
        main(["compare", str(site), FIRST, "--models", "delaunay", "--holdout", "blocks", "--block-side", "1.5"]) == 0
    )
    text = capsys.readouterr().out
    assert "of 1,800 points held out in blocks of 1.5 m; scores over the" in text
    for word in ("method", "answered", "RMSE m", "NLPD", "95 %", "CPU s", "delaunay"):
        assert word in text


def test_a_dry_run_names_what_is_skipped_and_why(site, tmp_path, capsys):
    arguments = ["compare", str(site), FIRST, "-n", "--holdout", "random", "--plot", str(tmp_path / "a.png")]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "adaptive (LWPR, adaptive mode) learns 1,6" in text
    assert f"Would draw {tmp_path / 'a.png'}" in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "expect", "message"),
    [
        (("--models", "block_mean,krigging"), 2, "unknown: krigging; known are adaptive, reference"),
        (("--models", "krigging", "--models", "kriging"), 2, "unknown: krigging; known"),
        (("--holdout", "rows"), 2, "rows"),
        (("--share", "1.5"), 2, "less than or equal to 0.9"),
        (("--block-side", "-1"), 78, "side of a held-out block must be positive"),
        (("--block-side", "19"), 65, "too large for this survey"),
        (("--max-points", "200", "--share", "0.01"), 65, "at least 20 held out"),
    ],
)
def test_wrong_options_are_refused_with_the_exit_code_of_their_kind(site, capsys, options, expect, message):
    error = run(capsys, "compare", site, FIRST, *options, expect=expect)["error"]
    assert message in error["message"]


def test_no_name_at_all_is_wrong_usage(site, capsys):
    assert "no name given" in run(capsys, "compare", site, FIRST, "--models", ",", expect=2)["error"]["message"]


def test_an_epoch_that_is_not_known_is_missing_input(site, capsys):
    assert "has no epoch" in run(capsys, "compare", site, "2020-01-01", expect=66)["error"]["message"]
