"""A survey is taken out: everything is as if it had never come, and nothing of the user's is lost."""

import pytest
from small_surveys import make_programme, reopen

from changedetect.errors import MissingInputError
from changedetect.pipeline.update import update
from changedetect.pipeline.verify import verify
from changedetect.pipeline.withdraw import withdraw_epoch
from changedetect.storage import read_json

FIRST, SECOND, THIRD = "2024-01-01", "2024-04-01", "2024-07-01"


@pytest.fixture
def site(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {"step": 0.3}, THIRD: {"step": 0.5}})
    update(programme)
    return reopen(programme)


def volumes(programme, pair):
    summary = read_json(programme.product_directory(pair) / "summary.json")
    return summary["volume_net_m3"], summary["area_raised_m2"]


def test_after_withdrawing_all_is_as_if_the_survey_had_never_come(site, tmp_path):
    plan = withdraw_epoch(site, SECOND)
    assert plan.n_to_learn == 1
    assert plan.kept_as.is_file()
    assert (site.directory / "inputs" / f"{SECOND}.laz").is_file()
    programme = reopen(site)
    update(programme)
    assert [epoch.epoch_id for epoch in reopen(programme).epochs] == [FIRST, THIRD]
    assert verify(reopen(programme)) == ()
    never = make_programme(tmp_path / "never", {FIRST: {"seed": 0}, THIRD: {"step": 0.5, "seed": 2}})
    update(never)
    assert volumes(programme, f"{FIRST}_{THIRD}") == pytest.approx(volumes(never, f"{FIRST}_{THIRD}"), rel=1e-9)


def test_a_dry_run_and_an_unknown_epoch_change_nothing(site):
    before = sorted(str(path) for path in site.directory.rglob("*"))
    plan = withdraw_epoch(site, SECOND, dry_run=True)
    assert f"{FIRST}_{SECOND}" in {folder.name for folder in plan.removed}
    with pytest.raises(MissingInputError, match="has no epoch '2025-01-01'"):
        withdraw_epoch(site, "2025-01-01")
    assert sorted(str(path) for path in site.directory.rglob("*")) == before


def test_a_withdrawal_that_was_cut_short_is_finished_by_a_second_one(site):
    kept = site.directory / "withdrawn" / f"{SECOND}.toml"
    kept.parent.mkdir()
    site.epoch_path(SECOND).replace(kept)
    plan = withdraw_epoch(reopen(site), SECOND)
    assert plan.removed
    assert not any(folder.exists() for folder in plan.removed)
    with pytest.raises(MissingInputError, match="has no epoch"):
        withdraw_epoch(reopen(site), SECOND)
