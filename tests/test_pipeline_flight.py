"""Flights inside a programme: simulated, added, reconstructed, adjusted to each other, differenced, judged."""

from __future__ import annotations

import json
import logging
import shutil

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose
from small_flights import CRS, FIRST, SECOND, TrueChange, fly, nmad
from small_surveys import run, snapshot

from changedetect.catalogue import Programme, plan
from changedetect.cli import main
from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.points import SourceOptions, open_points
from changedetect.pipeline.common_errors import errors_between, errors_of
from changedetect.pipeline.update import update
from changedetect.pipeline.verify import verify
from changedetect.storage import sha256_of_file


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Two flights over one site, and their truth."""
    return fly(tmp_path_factory.mktemp("flights"))


@pytest.fixture(scope="module")
def first(flights, tmp_path_factory):
    """A programme with the first flight, updated."""
    site = tmp_path_factory.mktemp("first") / "site"
    assert main(["init", str(site), "--crs", CRS, "--resolution", "0.5", "--quiet"]) == 0
    assert main(["add", str(site), FIRST, str(flights / "epoch1"), "--quiet"]) == 0
    assert main(["update", str(site), "--quiet"]) == 0
    return site


@pytest.fixture(scope="module")
def both(first, flights, tmp_path_factory):
    """The same with the second flight added and updated."""
    site = shutil.copytree(first, tmp_path_factory.mktemp("both") / "site")
    assert main(["add", str(site), SECOND, str(flights / "epoch2"), "--quiet"]) == 0
    assert main(["update", str(site), "--quiet"]) == 0
    return site


def opened(site, **flags):
    return Programme.open(site, environment={}, flags=flags)


def due(site):
    return {(item.kind, item.item_id): item.reasons for item in plan(opened(site)) if item.is_due}


def test_an_added_flight_is_remembered_file_by_file_and_where_it_lies(first, flights):
    epoch = opened(first).epoch(FIRST)
    source = epoch.flight
    assert source.uri == (flights / "epoch1").as_posix()
    assert source.n_photos == 10
    assert {"imu.csv", "gps.csv", "images.csv", "camera.yaml", "images/e1_0000.jpg"} <= set(source.files)
    assert source.files["imu.csv"] == sha256_of_file(flights / "epoch1" / "imu.csv")
    assert epoch.date_text == "2024-05-01T02:00:00"  # as init.json says
    assert not (first / "sources").exists()


def test_a_dry_run_of_add_checks_the_flight_and_writes_nothing(first, flights, capsys):
    before = snapshot(first)
    document = run(capsys, "add", first, SECOND, flights / "epoch2", "--dry-run")
    assert document["n_photos"] == 10
    assert document["sources"][0]["kind"] == "flight"
    assert document["date"] == "2024-10-30T02:00:00"
    assert snapshot(first) == before


def test_flights_are_not_moved_nor_mixed_nor_read_as_points(first, flights, capsys):
    folder = str(flights / "epoch2")
    for options, code, message in (
        (["--move"], 78, "Leave --move out"),
        (["--sigma", "0.1"], 78, "site.json and camera.yaml"),
        ([str(flights / "epoch1")], 65, "an epoch of its own"),
    ):
        assert main(["add", str(first), SECOND, folder, *options]) == code
        assert message in capsys.readouterr().err


def test_the_same_flight_twice_and_a_flight_elsewhere_are_refused(first, flights, capsys, tmp_path):
    copy = shutil.copytree(flights / "epoch1", tmp_path / "copy")
    assert main(["add", str(first), "2024-06-01", str(copy)]) == 65
    assert "is in the programme already, in epoch '2024-05-01'" in capsys.readouterr().err
    site = json.loads((copy / "site.json").read_text())
    site["origin"]["lat_deg"] += 0.02
    (copy / "site.json").write_text(json.dumps(site))
    gps = (copy / "gps.csv").read_text().splitlines()
    rows = [line.split(",") for line in gps[1:]]
    moved = [",".join([row[0], f"{float(row[1]) + 0.02:.9f}", *row[2:]]) for row in rows]
    (copy / "gps.csv").write_text("\n".join([gps[0], *moved]) + "\n")
    (copy / "geo.txt").unlink()
    assert main(["add", str(first), "2024-06-01", str(copy)]) == 65
    assert "do not overlap the programme" in capsys.readouterr().err


def test_difference_of_flights_is_the_truth(both, flights):
    truth = TrueChange(both, flights / "truth", (FIRST, SECOND))
    error = truth.dod - truth.change
    stable = error[truth.is_stable]
    assert abs(np.median(stable)) < 0.05
    assert nmad(stable) < 0.12
    assert np.mean(np.abs(error[truth.is_open]) < truth.lod[truth.is_open]) > 0.90
    for kind, tolerance in (("mound", 0.08), ("pit", 0.08), ("plateau", 0.08), ("paint", 0.06)):
        found, true = truth.means(kind)
        assert abs(found - true) < tolerance, kind
    painted = np.isfinite(truth.dod) & (truth.distance("paint") < 0)
    assert np.isin(truth.change_class[painted], (1, 2)).mean() < 0.1


def test_a_later_flight_leaves_what_was_published_as_it_was(first, both):
    for folder in (f"flights/{FIRST}/points", f"state/{FIRST}"):
        assert sha256_of_file(first / folder / "manifest.json") == sha256_of_file(both / folder / "manifest.json")
        assert verify(opened(first)) == ()


def test_the_later_flight_is_bound_to_the_earlier_by_ground_that_did_not_change(both, flights):
    record, _ = opened(both).reconstruction_record(SECOND)
    (anchor,) = record.anchors
    assert anchor.epoch_id == FIRST
    assert anchor.n_shared > 300
    own = np.sqrt(np.diag(record.common_error.covariance))
    between = np.sqrt(np.diag(anchor.difference.covariance))
    assert own[0] > 0.5  # the GPS offset of a metre
    assert between[0] < 0.06
    assert np.all(between[3:] < 0.03)
    report = json.loads((both / f"flights/{SECOND}/points/report.json").read_text())
    west, east, south, north = record.region
    left_out = np.array(report["left_out_as_changed"])
    assert len(left_out) == anchor.n_moved > 20
    assert np.all((left_out > [west - 5, south - 5]) & (left_out < [east + 5, north + 5]))


def test_points_carry_sigma_that_covers_and_the_state_says_where_they_come_from(both):
    programme = opened(both)
    record, sha256 = programme.reconstruction_record(FIRST)
    cloud = next(open_points(both / f"flights/{FIRST}/points/points.laz", SourceOptions()).iter_chunks())
    assert len(cloud) == record.n_points
    assert 0.02 < np.median(cloud.sigma) < 0.3
    state, _ = programme.state_record(FIRST)
    assert state.sources[0].derived_sha256 == sha256
    assert state.sources[0].sha256 == programme.epoch(FIRST).flight.sha256


def test_an_updated_programme_is_current_verified_and_told(both, capsys):
    assert due(both) == {}
    assert update(opened(both)).run_id is None
    assert verify(opened(both)) == ()
    document = run(capsys, "status", both)
    assert [item["kind"] for item in document["items"]][:3] == ["flight", "model", "epoch"]
    assert document["epochs"][1]["alignment"]["shared_with"] == FIRST
    assert main(["status", str(both)]) == 0
    assert "Adjusted to the photos of epoch 2024-05-01" in capsys.readouterr().out
    record = json.loads(max((both / "runs").glob("*.json")).read_text())
    step = next(step for step in record["steps"] if step["kind"] == "flight")
    assert step["adjusted_to"][FIRST] > 300
    assert step["n_photos"] == 10


def test_a_file_that_changed_is_named_and_what_was_learned_stays(both, flights, tmp_path, capsys):
    site = shutil.copytree(both, tmp_path / "site")
    flight = shutil.copytree(flights / "epoch2", tmp_path / "epoch2")
    path = site / "epochs" / f"{SECOND}.toml"
    path.write_text(path.read_text().replace((flights / "epoch2").as_posix(), flight.as_posix()))
    text = (flight / "gps.csv").read_text()
    (flight / "gps.csv").write_text(text + "\n")
    (flight / "images" / "e2_0003.jpg").unlink()
    findings = verify(opened(site))
    assert {f.message.split(": ")[1] for f in findings} == {"gps.csv is another file", "images/e2_0003.jpg is missing"}
    assert due(site) == {}  # points and models need no photos once they are made
    shutil.rmtree(site / "flights" / SECOND / "points")
    result = update(opened(site))
    assert result.exit_code == InputDataError.exit_code
    (failed,) = [step for step in result.steps if step["status"] == "failed"]
    assert failed["kind"] == "flight"
    assert "gps.csv is another file, images/e2_0003.jpg is missing" in failed["error"]["message"]
    assert "add the epoch again with --overwrite" in failed["error"]["message"]
    assert (site / "state" / FIRST / "manifest.json").is_file()
    assert not [item for item in due(site) if item[1] == FIRST]
    shutil.rmtree(flight)
    assert update(opened(site)).exit_code == MissingInputError.exit_code


def test_a_damaged_photo_fails_its_epoch_alone_and_is_named(first, flights, tmp_path):
    site = shutil.copytree(first, tmp_path / "site")
    flight = shutil.copytree(flights / "epoch2", tmp_path / "epoch2")
    photo = flight / "images" / "e2_0004.jpg"
    photo.write_bytes(photo.read_bytes()[:-3000])
    assert main(["add", str(site), SECOND, str(flight), "--quiet"]) == 0
    before = sha256_of_file(site / "state" / FIRST / "manifest.json")
    result = update(opened(site))
    assert result.exit_code == 65
    (failed,) = [step for step in result.steps if step["status"] == "failed"]
    assert "e2_0004.jpg is truncated" in failed["error"]["message"]
    assert not (site / "flights" / SECOND / "points").exists()
    assert sha256_of_file(site / "state" / FIRST / "manifest.json") == before


def test_a_run_that_was_stopped_goes_on_where_it_was(both, tmp_path, caplog):
    site = shutil.copytree(both, tmp_path / "site")
    points = site / "flights" / SECOND / "points"
    before = next(open_points(points / "points.laz", SourceOptions()).iter_chunks())
    shutil.rmtree(points)

    def stop(_done, _total, label):
        if "earlier flights" in label:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        update(opened(site), on_progress=stop)
    assert not points.exists()
    assert not list((site / "flights" / SECOND).glob("*.tmp*"))
    with caplog.at_level(logging.INFO):
        assert update(opened(site)).exit_code == 0
    for step in ("features", "matching", "adjustment"):
        assert f"{SECOND}/steps/{step}.npz: kept from an earlier run" in caplog.text
    again = next(open_points(points / "points.laz", SourceOptions()).iter_chunks())
    assert_allclose(again.elevation, before.elevation, rtol=0, atol=0)


def test_a_withdrawn_flight_takes_its_points_along_and_those_bound_to_it_are_due(both, tmp_path, capsys):
    site = shutil.copytree(both, tmp_path / "site")
    document = run(capsys, "withdraw", site, FIRST)
    assert f"flights/{FIRST}" in document["removed"]
    assert not (site / "flights" / FIRST).exists()
    reasons = due(site)[("flight", SECOND)]
    assert reasons == (f"it is to be adjusted to no flight now, and was adjusted to {FIRST}",)
    assert ("model", SECOND) in due(site)


def test_settings_make_points_due_and_joint_alone_only_where_it_matters(both):
    assert not [item for item in plan(opened(both, **{"flights.joint": "always"})) if item.is_due]
    never = {(i.kind, i.item_id) for i in plan(opened(both, **{"flights.joint": "never"})) if i.is_due}
    assert ("flight", SECOND) in never
    assert ("flight", FIRST) not in never
    dense = {(i.kind, i.item_id) for i in plan(opened(both, **{"flights.dense": True})) if i.is_due}
    assert {("flight", FIRST), ("flight", SECOND)} <= dense


def test_flights_apart_are_aligned_by_their_surfaces(both, flights, tmp_path):
    site = shutil.copytree(both, tmp_path / "site")
    result = update(opened(site, **{"flights.joint": "never"}))
    assert result.exit_code == 0
    programme = opened(site)
    assert programme.reconstruction_record(SECOND)[0].anchors == ()
    alignment = programme.state_record(SECOND)[0].alignment
    assert alignment.is_applied
    assert alignment.shared_with is None
    truth = TrueChange(site, flights / "truth", (FIRST, SECOND))
    error = (truth.dod - truth.change)[truth.is_stable]
    assert abs(np.median(error)) < 0.08
    assert nmad(error) < 0.15
    assert [error.source for error in errors_between(programme, FIRST, SECOND)] == [("transform", SECOND)]


def test_errors_that_flights_share_cancel_and_others_do_not(both):
    programme = opened(both)
    assert [error.source for error in errors_of(programme, FIRST)] == [("flight", FIRST)]
    assert [error.source for error in errors_of(programme, SECOND)] == [("photos", SECOND, FIRST), ("flight", FIRST)]
    (error,) = errors_between(programme, FIRST, SECOND)
    assert error.source == ("photos", SECOND, FIRST)
    summary = json.loads((both / f"products/{FIRST}_{SECOND}/summary.json").read_text())
    offset = np.sqrt(error.content.covariance[0][0])
    assert summary["volume_net_std_m3"] > 0.8 * offset * summary["area_observed_m2"]


def test_a_series_of_flights_knows_their_errors_and_what_of_them_cancels(both, tmp_path, capsys):
    (error,) = errors_between(opened(both), FIRST, SECOND)
    offset = np.sqrt(error.content.covariance[0][0])
    done = run(capsys, "series", both, "-o", tmp_path / "series.nc", "--resolution", 1)
    first, second = done["whole"]["series"]
    assert first["change_mean_std_m"] == 0.0
    assert 0.8 * offset < second["change_mean_std_m"] < 0.3  # the GPS offset of a metre is that of both
    with xr.open_dataset(tmp_path / "series.nc") as series:
        known = np.isfinite(series.dod.values[1])
        assert series.dod_std.values[1][known].min() > 0.8 * offset
