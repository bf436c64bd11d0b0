"""The main job: what is learned, what is made, what is left alone, and what happens when something fails."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from small_surveys import BLOCK, CRS, SIDE, SOUTH, WEST, add_by_hand, make_programme, reopen, snapshot, write_survey

from changedetect.catalogue import plan
from changedetect.errors import OutputError, TemporaryError
from changedetect.io.cog import read_cog
from changedetect.models.registry import load_model
from changedetect.pipeline.lock import programme_lock
from changedetect.pipeline.update import update
from changedetect.pipeline.verify import verify
from changedetect.storage import read_json

FIRST, SECOND, THIRD = "2024-01-01", "2024-07-01", "2025-01-01"
THREE = {FIRST: {}, SECOND: {"step": 0.5}, THIRD: {"step": 0.5}}


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Three epochs, learned; tests that change something copy it."""
    programme = make_programme(tmp_path_factory.mktemp("learned") / "site", THREE)
    result = update(programme)
    assert result.exit_code == 0, result.steps
    return programme


@pytest.fixture
def site(learned, tmp_path):
    """A copy of the learned programme that a test may change; modification times are kept."""
    shutil.copytree(learned.directory, tmp_path / "site", copy_function=shutil.copy2)
    return reopen_at(tmp_path / "site")


def reopen_at(directory, **arguments):
    from changedetect.catalogue import Programme

    return Programme.open(directory, environment={}, **arguments)


def due(programme):
    return {f"{item.kind} {item.item_id}": item.reasons for item in plan(reopen(programme)) if item.is_due}


def done(result):
    return [f"{step['kind']} {step['id']}" for step in result.steps if step["status"] == "made"]


def manifests(programme):
    return {path.parent.name: path.read_bytes() for path in programme.directory.glob("state/*/manifest.json")}


def dod(programme, earlier, later):
    return read_cog(programme.product_directory(f"{earlier}_{later}") / "dod.tif")


def places():
    axis = np.arange(1.0, SIDE - 1.0, 0.7)
    easting, northing = np.meshgrid(WEST + axis, SOUTH + axis)
    return easting.ravel(), northing.ravel()


def assert_same_surfaces(one, other, epoch_id):
    first, second = (load_model(item.state_directory(epoch_id)).predict(places()) for item in (one, other))
    for name in ("elevation", "elevation_std", "noise_std", "n_effective", "age_days"):
        np.testing.assert_allclose(
            getattr(first, name), getattr(second, name), rtol=1e-9, atol=1e-9, err_msg=f"{name} of {epoch_id}"
        )


# --- what an update makes ---------------------------------------------------------------------------------------


def test_an_update_makes_models_maps_and_differences(learned):
    names = {path.name for path in (learned.directory / "products").iterdir() if path.is_dir()}
    pairs = {f"{FIRST}_{SECOND}", f"{SECOND}_{THIRD}", f"{FIRST}_{THIRD}"}
    assert names == {FIRST, SECOND, THIRD} | pairs
    surface = {path.name for path in learned.product_directory(FIRST).iterdir()}
    assert {"elevation.tif", "elevation_std.tif", "noise_std.tif", "age_days.tif", "surface.nc"} <= surface
    change = {path.name for path in learned.product_directory(f"{FIRST}_{SECOND}").iterdir()}
    rasters = {"dod.tif", "dod_std.tif", "level_of_detection.tif", "change_probability.tif", "change_class.tif"}
    assert rasters | {"change.nc", "summary.json", "manifest.json"} <= change


def test_a_step_between_two_epochs_stands_in_the_map(learned):
    values, grid, _ = dod(learned, FIRST, SECOND)
    easting, northing = grid.coordinates()
    west, east, south, north = BLOCK
    inside = (easting > west + 3) & (easting < east - 3) & (northing > south + 3) & (northing < north - 3)
    outside = (easting < west - 3) | (easting > east + 3) | (northing < south - 3) | (northing > north + 3)
    # 4.5 points a square metre, noise 2 cm: the mean over 4 m2 is good to about 1 cm
    np.testing.assert_allclose(np.nanmean(values.ravel()[inside]), 0.5, rtol=0, atol=0.015)
    np.testing.assert_allclose(np.nanmean(values.ravel()[outside]), 0.0, rtol=0, atol=0.005)


def test_lineage_is_recorded(learned):
    second, _ = learned.state_record(SECOND)
    _, first_sha256 = learned.state_record(FIRST)
    assert (second.parent, second.parent_sha256) == (FIRST, first_sha256)
    assert learned.state_record(FIRST)[0].parent is None
    product, _ = learned.product_record(f"{FIRST}_{SECOND}")
    assert product.states == {FIRST: first_sha256, SECOND: learned.state_record(SECOND)[1]}
    assert product.config_sha256 == learned.config.config_sha256


def test_checksums_of_hand_written_sources_are_recorded_when_they_are_learned(learned):
    from changedetect.storage import sha256_of_file

    record, _ = learned.state_record(FIRST)
    path = learned.directory / "inputs" / f"{FIRST}.laz"
    assert record.sources[0].sha256 == sha256_of_file(path)
    assert (record.sources[0].n_read, record.n_points) == (1800, 1800)


def test_the_run_manifest_says_what_was_done_and_with_what(learned):
    (path,) = (learned.directory / "runs").glob("*.json")
    document = read_json(path)
    assert (document["status"], document["exit_code"]) == ("succeeded", 0)
    assert document["run_id"] == path.stem
    assert document["config_sha256"] == learned.config.config_sha256
    assert [step["kind"] for step in document["steps"]] == ["model", "epoch"] * 3 + ["pair"] * 3
    assert document["library_versions"]["numpy"] == np.__version__
    tags = dod(learned, FIRST, SECOND)[2]
    assert tags["run_id"] == document["run_id"]


def test_all_maps_of_a_programme_share_their_cells_and_colours(learned):
    grids = [dod(learned, *pair.product_id.split("_"))[1] for pair in learned.pairs()]
    assert all(grid.west % 0.5 == 0.0 and grid.north % 0.5 == 0.0 for grid in grids)
    records = [learned.product_record(pair.product_id)[0] for pair in learned.pairs()]
    assert len({json.dumps(record.colour_limits) for record in records}) == 1
    low, high = records[0].colour_limits["dod"]
    assert low == -high


def test_maps_cover_exactly_the_bounds_and_points_outside_are_left_out(tmp_path):
    bounds = (WEST + 4.0, WEST + 20.0, SOUTH + 2.0, SOUTH + 18.0)
    programme = make_programme(tmp_path / "site", {FIRST: {}}, bounds=bounds)
    update(programme)
    _, grid, _ = read_cog(programme.product_directory(FIRST) / "elevation.tif")
    assert grid.region == bounds
    record, _ = programme.state_record(FIRST)
    assert record.sources[0].n_read == 1800
    np.testing.assert_allclose(record.n_points, 1800 * 256 / 400, rtol=0.05, atol=0)


def test_the_reference_mode_runs_the_whole_chain(tmp_path):
    surveys = {FIRST: {"n_points": 4000}, SECOND: {"n_points": 4000, "step": 0.5}}
    programme = make_programme(tmp_path / "site", surveys, model="reference")
    result = update(programme)
    assert result.exit_code == 0, result.steps
    assert programme.state_record(SECOND)[0].mode == "reference"
    values, grid, _ = dod(programme, FIRST, SECOND)
    easting, northing = grid.coordinates()
    west, east, south, north = BLOCK
    inside = (easting > west + 3) & (easting < east - 3) & (northing > south + 3) & (northing < north - 3)
    np.testing.assert_allclose(np.nanmean(values.ravel()[inside]), 0.5, rtol=0, atol=0.05)
    assert update(reopen(programme)).run_id is None


def test_a_step_of_the_vertical_datum_is_said_in_plain_words(tmp_path, caplog):
    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {"offset": -0.41}})
    with (programme.directory / "programme.toml").open("a") as settings:
        settings.write("[coregistration]\nenabled = false\n")
    result = update(reopen(programme))
    words = (
        "epochs differ by a median of -0.41 m over 100 % of the area, as a vertical datum or registration step would"
    )
    assert result.warnings == (f"{FIRST} to {SECOND}: {words}, and co-registration did not take it out",)
    assert words in caplog.text
    summary = read_json(programme.product_directory(f"{FIRST}_{SECOND}") / "summary.json")
    assert summary["warnings"][0].startswith(words)


def test_real_change_of_a_part_is_no_datum_step(learned):
    summary = read_json(learned.product_directory(f"{FIRST}_{SECOND}") / "summary.json")
    assert summary["warnings"] == []
    assert summary["systematic_offset_m"] is None


# --- what an update leaves alone --------------------------------------------------------------------------------


def test_a_second_update_does_nothing_and_touches_nothing(site):
    before = snapshot(site.directory)
    result = update(site)
    assert (result.run_id, result.exit_code, result.n_due, result.steps) == (None, 0, 0, ())
    assert snapshot(site.directory) == before


def test_a_moved_modification_time_alone_makes_nothing_stale(site):
    os.utime(site.directory / "inputs" / f"{SECOND}.laz")
    assert due(site) == {}


def test_sources_that_are_gone_make_nothing_stale(site):
    shutil.rmtree(site.directory / "inputs")
    assert due(site) == {}
    assert update(reopen(site)).run_id is None


def test_a_new_epoch_leaves_the_models_before_it_alone(site):
    before = manifests(site)
    add_by_hand(site.directory, "2025-06-01", seed=9)
    result = update(reopen(site))
    assert done(result) == [
        "model 2025-06-01",
        "epoch 2025-06-01",
        f"pair {THIRD}_2025-06-01",
        f"pair {FIRST}_2025-06-01",
    ]
    after = manifests(site)
    assert {name: after[name] for name in before} == before


def test_another_rule_adds_its_pairs_and_keeps_the_others(site):
    programme = reopen(site, flags={"pairs": "all"})
    assert due(programme) == {}
    add_by_hand(site.directory, "2025-06-01", seed=9)
    result = update(reopen(site, flags={"pairs": "first"}))
    assert done(result)[2:] == [f"pair {FIRST}_2025-06-01"]
    assert verify(reopen(site, flags={"pairs": "first"})) == ()


# --- what makes things stale ------------------------------------------------------------------------------------


def test_changed_settings_of_the_difference_remake_differences_alone(site):
    programme = reopen(site, flags={"differencing.confidence": 0.9})
    result = update(programme)
    assert {name.split()[0] for name in done(result)} == {"pair"}
    assert result.steps[0]["reasons"] == ["setting differencing.confidence is 0.9, was 0.95"]


def test_changed_settings_of_the_model_remake_everything(site):
    programme = reopen(site, flags={"memory_days": 100.0})
    assert len(done(update(programme))) == 9
    assert update(reopen(site, flags={"memory_days": 100.0})).run_id is None
    assert due(site)[f"model {FIRST}"] == ("setting memory_days is 730.0, was 100.0",)


def test_a_lost_product_file_is_made_again_and_nothing_else(site):
    (site.product_directory(f"{FIRST}_{SECOND}") / "dod.tif").unlink()
    assert due(site) == {f"pair {FIRST}_{SECOND}": ("dod.tif is missing",)}
    assert done(update(reopen(site))) == [f"pair {FIRST}_{SECOND}"]
    assert verify(reopen(site)) == ()


def test_a_truncated_model_file_is_learned_again(site):
    path = next(site.state_directory(THIRD).glob("evidence*.nc"))
    path.write_bytes(path.read_bytes()[:100])
    reasons = due(site)
    assert reasons[f"model {THIRD}"][0].startswith(f"{path.name} has 100 bytes, was written with")
    assert f"model {THIRD}" in done(update(reopen(site)))
    assert verify(reopen(site)) == ()


def test_a_damaged_manifest_is_made_again(site):
    (site.state_directory(THIRD) / "manifest.json").write_text("{")
    assert "is damaged" in due(site)[f"model {THIRD}"][0]
    assert update(reopen(site)).exit_code == 0
    assert verify(reopen(site)) == ()


def test_a_state_of_another_format_is_learned_again(site):
    path = site.state_directory(THIRD) / "manifest.json"
    path.write_text(path.read_text().replace('"format_version": 2', '"format_version": 0', 1))
    assert "has format_version 0, this version of changedetect reads 2" in due(site)[f"model {THIRD}"][0]
    assert update(reopen(site)).exit_code == 0


def test_a_source_that_changed_on_disk_is_learned_again(site):
    write_survey(site.directory / "inputs" / f"{THIRD}.laz", 77, step=0.2)
    assert due(site)[f"model {THIRD}"] == (f"source {THIRD}.laz has changed on disk",)
    assert done(update(reopen(site)))[0] == f"model {THIRD}"


def test_a_changed_date_or_reading_option_is_learned_again(site):
    path = site.epoch_path(THIRD)
    text = path.read_text()
    path.write_text(text.replace(f"date = {THIRD}", "date = 2025-01-02"))
    assert due(site)[f"model {THIRD}"] == ("its date has changed",)
    path.write_text(text + "sigma = 0.05\n")
    assert due(site)[f"model {THIRD}"] == (f"source {THIRD}.laz is to be read differently",)


# --- late surveys -----------------------------------------------------------------------------------------------


def test_a_late_survey_rebuilds_what_follows_it_without_reading_those_sources_again(site):
    before = manifests(site)
    shutil.rmtree(site.directory / "inputs")
    add_by_hand(site.directory, "2024-04-01", seed=9, step=0.5)
    assert due(site)[f"model {SECOND}"] == (f"it follows epoch 2024-04-01 now, and followed epoch {FIRST}",)
    result = update(reopen(site))
    assert result.exit_code == 0, result.steps
    origins = {step["id"]: step["origin"] for step in result.steps if step["kind"] == "model"}
    assert origins == {"2024-04-01": "sources", SECOND: "stored evidence", THIRD: "stored evidence"}
    assert manifests(site)[FIRST] == before[FIRST]
    assert {(finding.severity, finding.subject.split("/")[0]) for finding in verify(reopen(site))} == {
        ("warning", "epochs")
    }


def test_incremental_and_late_learning_equal_learning_from_scratch(site, tmp_path):
    add_by_hand(site.directory, "2024-04-01", seed=9, step=0.5)
    assert update(reopen(site)).exit_code == 0
    shutil.copytree(site.directory, tmp_path / "scratch")
    for name in ("state", "products", "runs"):
        shutil.rmtree(tmp_path / "scratch" / name)
    scratch = reopen_at(tmp_path / "scratch")
    assert update(scratch).exit_code == 0
    for epoch in scratch.epochs:
        assert_same_surfaces(site, scratch, epoch.epoch_id)
    for pair in scratch.pairs():
        one, other = (dod(item, pair.earlier, pair.later)[0] for item in (reopen(site), scratch))
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-7)  # stored as float32


def test_a_removed_epoch_makes_its_followers_stale(site):
    site.epoch_path(SECOND).unlink()
    assert due(site)[f"model {THIRD}"] == (f"it follows epoch {FIRST} now, and followed epoch {SECOND}",)
    assert update(reopen(site)).exit_code == 0
    findings = verify(reopen(site))
    assert {finding.severity for finding in findings} == {"warning"}
    assert {finding.subject for finding in findings} >= {f"state/{SECOND}", f"products/{SECOND}"}


# --- when something fails ---------------------------------------------------------------------------------------


def test_one_failed_epoch_does_not_lose_the_others(tmp_path):
    programme = make_programme(tmp_path / "site", THREE)
    broken = programme.directory / "inputs" / f"{SECOND}.laz"
    whole = broken.read_bytes()
    broken.write_bytes(whole[:3000])
    result = update(programme)
    assert result.exit_code == 65
    assert done(result) == [
        f"model {FIRST}",
        f"epoch {FIRST}",
        f"model {THIRD}",
        f"epoch {THIRD}",
        f"pair {FIRST}_{THIRD}",
    ]
    document = read_json(next((programme.directory / "runs").glob("*.json")))
    assert (document["status"], document["exit_code"]) == ("failed", 65)
    failed = [step for step in document["steps"] if step["status"] == "failed"]
    assert [step["id"] for step in failed] == [SECOND]
    assert str(broken) in failed[0]["error"]["message"]
    assert not programme.state_directory(SECOND).exists()

    broken.write_bytes(whole)
    result = update(reopen(programme))
    assert result.exit_code == 0
    assert done(result)[:4:2] == [f"model {SECOND}", f"model {THIRD}"]
    assert verify(reopen(programme)) == ()


def test_a_failed_epoch_fails_again_and_changes_nothing_else(tmp_path):
    programme = make_programme(tmp_path / "site", THREE)
    (programme.directory / "inputs" / f"{SECOND}.laz").unlink()
    assert update(programme).exit_code == 66
    before = manifests(programme)
    again = update(reopen(programme))
    assert (again.exit_code, done(again)) == (66, [])
    assert manifests(programme) == before


def test_the_last_good_state_survives_a_failed_renewal(site):
    before = manifests(site)[SECOND]
    (site.directory / "inputs" / f"{SECOND}.laz").write_bytes(b"no LAS file")
    result = update(reopen(site))
    assert result.exit_code == 65
    assert manifests(site)[SECOND] == before


def test_too_few_points_is_an_error_of_that_epoch(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {"n_points": 9}})
    result = update(programme)
    assert result.exit_code == 65
    assert "9 usable point(s), at least 10 are needed" in result.steps[2]["error"]["message"]


def test_sources_of_one_epoch_with_and_without_sigma_are_refused(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    write_survey(programme.directory / "inputs" / "other.laz", 5, sigma=0.05)
    path = programme.epoch_path(FIRST)
    path.write_text(path.read_text() + '[[sources]]\nuri = "inputs/other.laz"\n')
    result = update(reopen(programme))
    assert result.exit_code == 65
    message = result.steps[0]["error"]["message"]
    assert f"other.laz do, {FIRST}.laz do not. State --sigma for all of them" in message


def test_sources_of_one_epoch_are_learned_together(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    write_survey(programme.directory / "inputs" / "other.laz", 5)
    path = programme.epoch_path(FIRST)
    path.write_text(path.read_text() + '[[sources]]\nuri = "inputs/other.laz"\n')
    assert update(reopen(programme)).exit_code == 0
    assert programme.state_record(FIRST)[0].n_points == 3600


def test_an_unwritable_folder_is_told_and_nothing_is_lost(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    (programme.directory / "state").write_text("a file where a folder should be")
    result = update(programme)
    assert result.exit_code == 73
    assert "Cannot write into" in result.steps[0]["error"]["message"]
    (programme.directory / "state").unlink()
    assert update(reopen(programme)).exit_code == 0


def test_a_programme_folder_that_cannot_be_locked_is_told(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    programme.lock_path.mkdir()
    with pytest.raises(OutputError, match="Make the programme folder writable"):
        update(programme)


def test_an_unexpected_failure_is_recorded_as_a_bug_and_the_rest_goes_on(tmp_path, monkeypatch):
    from changedetect.pipeline import update as module

    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {}})
    real = module.make_epoch_products

    def fails_once(programme, epoch_id, *arguments):
        if epoch_id == FIRST:
            raise ZeroDivisionError("by design")
        return real(programme, epoch_id, *arguments)

    monkeypatch.setattr(module, "make_epoch_products", fails_once)
    result = update(programme)
    assert result.exit_code == 1
    assert f"pair {FIRST}_{SECOND}" in done(result)
    assert next(step for step in result.steps if step["status"] == "failed")["error"]["class"] == "ZeroDivisionError"


def test_an_interrupted_run_says_so_in_its_manifest(tmp_path, monkeypatch):
    from changedetect.pipeline import update as module

    def interrupted(*arguments):
        raise KeyboardInterrupt

    programme = make_programme(tmp_path / "site", {FIRST: {}})
    monkeypatch.setattr(module, "make_epoch_products", interrupted)
    with pytest.raises(KeyboardInterrupt):
        update(programme)
    document = read_json(next((programme.directory / "runs").glob("*.json")))
    assert (document["status"], document["exit_code"]) == ("interrupted", 130)
    assert [step["id"] for step in document["steps"]] == [FIRST]


# --- killed runs and locks --------------------------------------------------------------------------------------


def test_a_run_killed_at_any_moment_is_continued(tmp_path):
    programme = make_programme(tmp_path / "site", THREE)
    command = [sys.executable, "-m", "changedetect.cli", "update", str(programme.directory)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    first = programme.state_directory(FIRST) / "manifest.json"
    deadline = time.monotonic() + 120.0
    while not first.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = first.read_bytes()
    result = update(reopen(programme))
    assert result.exit_code == 0
    assert first.read_bytes() == kept
    assert verify(reopen(programme)) == ()
    statuses = [read_json(path)["status"] for path in sorted((programme.directory / "runs").glob("*.json"))]
    assert statuses == ["killed", "succeeded"]
    assert not [path for path in programme.directory.rglob("*") if ".tmp-" in path.name or ".old-" in path.name]


def test_what_a_killed_run_left_is_cleared_away(site):
    leftover = site.directory / "state" / f"{THIRD}.tmp-123-0123abcd"
    leftover.mkdir()
    (leftover / "model.nc").write_text("half")
    aside = site.directory / "products" / f"{THIRD}.old-123-0123abcd"
    site.product_directory(THIRD).rename(aside)
    add_by_hand(site.directory, "2025-06-01", seed=9)
    assert update(reopen(site)).exit_code == 0
    assert not leftover.exists()
    assert not aside.exists()
    assert verify(reopen(site)) == ()


def test_a_second_writer_is_turned_away_and_told_who_holds_the_lock(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    with (
        programme_lock(programme.directory),
        pytest.raises(
            TemporaryError, match=rf"is locked by process {os.getpid()} on \S+ since .*Wait for it to finish"
        ),
    ):
        update(programme)
    assert update(programme).exit_code == 0


def test_the_lock_of_a_dead_process_is_no_obstacle(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    programme.lock_path.write_text("process 1 on elsewhere since 2020-01-01T00:00:00Z\n")
    assert update(programme).exit_code == 0
    with programme.lock_path.open() as stream:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)


# --- verify -----------------------------------------------------------------------------------------------------


def test_verify_finds_a_changed_byte_that_a_glance_does_not(site):
    path = site.product_directory(f"{FIRST}_{SECOND}") / "dod.tif"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))
    assert due(site) == {}
    (finding,) = verify(reopen(site))
    assert (finding.severity, finding.subject) == ("error", f"products/{FIRST}_{SECOND}")
    assert finding.message.startswith("dod.tif differs from its checksum; remove the folder")


def test_verify_tells_sources_that_changed_or_are_gone(site):
    (site.directory / "inputs" / f"{FIRST}.laz").unlink()
    path = site.directory / "inputs" / f"{SECOND}.laz"
    path.write_bytes(path.read_bytes() + b"\0")
    found = {(finding.severity, finding.subject) for finding in verify(reopen(site))}
    assert ("warning", f"epochs/{FIRST}.toml") in found
    assert ("error", f"epochs/{SECOND}.toml") in found


def test_verify_tells_files_that_are_not_ours(site):
    (site.product_directory(FIRST) / "notes.txt").write_text("mine")
    (finding,) = verify(reopen(site))
    assert (finding.severity, finding.message) == ("warning", "notes.txt was not written by changedetect")


def test_a_programme_with_another_crs_learns_in_it(tmp_path):
    programme = make_programme(tmp_path / "site", {FIRST: {}}, crs="EPSG:32631+5773")
    assert programme.config.crs != CRS
    assert update(programme).exit_code == 0
    west, east, south, north = programme.state_record(FIRST)[0].region
    assert 930_000 < west < east < 960_000
    assert 5_300_000 < south < north < 5_330_000
