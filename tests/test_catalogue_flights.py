"""Flights in epoch files, in the list of what is due, and in the bookkeeping of errors."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from small_surveys import CRS

from changedetect.catalogue import (
    AnchorRecord,
    CommonErrorRecord,
    Epoch,
    Programme,
    ReconstructionRecord,
    Source,
    anchors_of,
    parse_date,
    plan,
)
from changedetect.catalogue.epoch import read_epoch, write_epoch
from changedetect.errors import ConfigError, ModelStateError
from changedetect.grid import Grid
from changedetect.pipeline import common_errors
from changedetect.pipeline.flight_inputs import is_flight_folder, listing_sha256

FILES = {"../camera.yaml": "a" * 64, "images/with space.jpg": "b" * 64, "imu.csv": "c" * 64}
ERROR = CommonErrorRecord(
    centre=(1.0, 2.0), covariance=tuple(tuple(row) for row in np.eye(5).tolist()), residual_std=0.1
)


def flight_source(**given):
    return Source(uri="flight", kind="flight", **given)


def test_a_flight_and_its_checksums_come_back_from_the_epochs_file(tmp_path):
    source = flight_source(sha256=listing_sha256(FILES), size=10, n_photos=1, files=FILES)
    epoch = Epoch(epoch_id="e", date=parse_date("2024-05-01T02:00"), sources=(source,), label="spring")
    write_epoch(tmp_path / "e.toml", epoch)
    assert read_epoch(tmp_path / "e.toml") == epoch
    assert epoch.flight == source


def test_a_flight_beside_other_sources_is_refused_with_the_files_name(tmp_path):
    path = tmp_path / "e.toml"
    path.write_text('date = 2024-05-01\n[[sources]]\nuri = "f"\nkind = "flight"\n[[sources]]\nuri = "a.laz"\n')
    with pytest.raises(ConfigError, match=r"e\.toml.*a flight is an epoch of its own"):
        read_epoch(path)


def test_the_listing_has_the_checksum_that_sha256sum_of_a_sorted_listing_has():
    import hashlib

    text = "".join(f"{FILES[name]}  {name}\n" for name in sorted(FILES))
    assert listing_sha256(FILES) == hashlib.sha256(text.encode()).hexdigest()


def test_folders_of_points_are_no_flights(tmp_path):
    assert not is_flight_folder(tmp_path)
    (tmp_path / "a.laz").touch()
    (tmp_path / "dem.tif").touch()
    assert not is_flight_folder(tmp_path)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "p.JPG").touch()
    assert is_flight_folder(tmp_path)


@pytest.fixture
def programme(tmp_path):
    made = Programme.create(tmp_path / "site", {"crs": CRS})
    for number, epoch_id in enumerate(("a", "b", "c")):
        date = parse_date(f"2024-0{number + 1}-01")
        made = made.write_epoch(Epoch(epoch_id=epoch_id, date=date, sources=(flight_source(),)))
    return made


def record(epoch_id, settings, anchors=(), **given):
    content = {
        "epoch_id": epoch_id, "source_uri": "flight", "source_sha256": "0" * 64, "settings": settings, "crs": CRS,
        "origin": (48.0, 9.0, 300.0), "photo_key": "p", "matching_key": "m", "n_photos": 3, "n_points": 9,
        "region": (0.0, 1.0, 0.0, 1.0), "common_error": ERROR, "anchors": anchors, "warnings": (), "files": {},
        "software_version": "1", "created": "now",
    }  # fmt: skip
    return ReconstructionRecord(**content | given)


def write(programme, made):
    folder = programme.flight_directory(made.epoch_id) / "points"
    folder.mkdir(parents=True)
    made.write(folder)
    return programme.reconstruction_record(made.epoch_id)[1]


def anchor(epoch_id, sha256, difference=ERROR):
    return AnchorRecord(epoch_id=epoch_id, sha256=sha256, n_shared=100, n_moved=3, difference=difference)


def flights_due(programme):
    return {item.item_id: item.reasons for item in plan(programme) if item.kind == "flight" and item.is_due}


def test_a_flight_is_adjusted_to_the_first_and_to_the_one_before(programme):
    assert anchors_of(programme, []) == ()
    assert anchors_of(programme, ["a"]) == ("a",)
    assert anchors_of(programme, ["a", "b", "c"]) == ("a", "c")


def test_points_follow_their_anchors(programme):
    settings = programme.config.flight_settings
    first = write(programme, record("a", settings))
    assert flights_due(programme) == {"b": ("not reconstructed yet",), "c": ("not reconstructed yet",)}
    second = write(programme, record("b", settings, (anchor("a", first),)))
    write(programme, record("c", settings, (anchor("a", first), anchor("b", "of yesterday"))))
    assert flights_due(programme) == {"c": ("flight b, which it is adjusted to, was reconstructed again",)}
    assert second != first


def test_a_late_flight_changes_the_anchors_of_the_next_alone(programme):
    settings = programme.config.flight_settings
    first = write(programme, record("a", settings))
    write(programme, record("c", settings, (anchor("a", first),)))
    due = flights_due(programme)
    assert due["c"] == ("it is to be adjusted to a and b now, and was adjusted to a",)
    assert "a" not in due


def test_a_record_comes_back_and_a_damaged_one_is_told(programme):
    made = record("a", programme.config.flight_settings, (anchor("x", "1"), anchor("y", "2", None)))
    write(programme, made)
    again = programme.reconstruction_record("a")[0]
    assert again == made
    assert again.bound == ("x",)
    path = programme.flight_directory("a") / "points" / "manifest.json"
    document = json.loads(path.read_text())
    del document["region"]
    path.write_text(json.dumps(document))
    with pytest.raises(ModelStateError, match="it lacks"):
        programme.reconstruction_record("a")


def test_common_errors_cancel_along_the_chain_of_anchors(programme):
    settings = programme.config.flight_settings
    first = write(programme, record("a", settings))
    second = write(programme, record("b", settings, (anchor("a", first),)))
    write(programme, record("c", settings, (anchor("a", first), anchor("b", second))))

    def between(earlier, later):
        return {error.source for error in common_errors.errors_between(programme, earlier, later)}

    assert between("a", "b") == {("photos", "b", "a")}
    assert between("b", "c") == {("photos", "c", "b")}  # the direct one
    assert between("a", "c") == {("photos", "c", "a")}
    assert [e.source for e in common_errors.errors_of(programme, "c")] == [("photos", "c", "a"), ("flight", "a")]


def test_flights_that_nothing_binds_keep_both_their_errors(programme):
    settings = programme.config.flight_settings
    first = write(programme, record("a", settings))
    write(programme, record("b", settings, (anchor("a", first, None),)))
    sources = {error.source for error in common_errors.errors_between(programme, "a", "b")}
    assert sources == {("flight", "a"), ("flight", "b")}


def shares(programme, *epoch_ids):
    """What each epoch of a series carries: sources of errors and the factors of their variances."""
    found = common_errors.errors_apart(programme, epoch_ids)
    return [{error.source: error.factor for error in errors} for errors in found]


def test_what_all_epochs_of_a_series_share_counts_for_none_of_them(programme):
    settings = programme.config.flight_settings
    first = write(programme, record("a", settings))
    second = write(programme, record("b", settings, (anchor("a", first),)))
    write(programme, record("c", settings, (anchor("a", first), anchor("b", second))))
    assert shares(programme, "a", "b", "c") == [{}, {("photos", "b", "a"): 1.0}, {("photos", "c", "a"): 1.0}]
    assert shares(programme, "b", "c") == [{("photos", "b", "a"): 1.0}, {("photos", "c", "a"): 1.0}]


def test_what_some_epochs_share_makes_no_contrast_of_the_series_too_certain(programme):
    settings = programme.config.flight_settings
    first = write(programme, record("a", settings))
    write(programme, record("b", settings, (anchor("a", first),)))
    write(programme, record("c", settings, (anchor("b", "lost"),)))
    late = Epoch(epoch_id="d", date=parse_date("2024-04-01"), sources=(flight_source(),))
    programme = programme.write_epoch(late)
    write(programme, record("d", settings, (anchor("b", "lost"),)))
    epochs = ("a", "b", "c", "d")
    found = shares(programme, *epochs)
    # b, c and d lie as b does: one error of all three, told of the first alone
    assert found[0] == {("photos", "b", "a"): 1.0}
    assert found[1:] == [{}, {("photos", "c", "b"): 1.0}, {("photos", "d", "b"): 1.0}]
    rng = np.random.default_rng(3)
    weights = rng.normal(size=(200, 4))
    weights -= weights.mean(axis=1, keepdims=True)
    for chosen in (epochs, ("b", "c", "a")):
        carried = [{error.source for error in common_errors.errors_of(programme, e)} for e in chosen]
        apart = shares(programme, *chosen)
        w = weights[:, : len(chosen)] - weights[:, : len(chosen)].mean(axis=1, keepdims=True)
        true = sum(w[:, [source in mine for mine in carried]].sum(axis=1) ** 2 for source in set().union(*carried))
        said = w**2 @ np.array([sum(mine.values()) for mine in apart])
        assert (said >= true - 1e-12).all()


def test_an_error_of_half_of_the_epochs_counts_with_their_number(programme):
    settings = programme.config.flight_settings
    first = write(programme, record("a", settings))
    write(programme, record("b", settings, (anchor("a", first, None),)))
    write(programme, record("c", settings, (anchor("b", "lost"),)))
    write_d = Epoch(epoch_id="d", date=parse_date("2024-04-01"), sources=(flight_source(),))
    programme = programme.write_epoch(write_d)
    write(programme, record("d", settings, (anchor("a", first),)))
    found = shares(programme, "a", "b", "c", "d")
    assert found[0] == {("flight", "a"): 2.0}
    assert found[3] == {("photos", "d", "a"): 1.0, ("flight", "a"): 2.0}
    (error,) = common_errors.errors_apart(programme, ("a", "b", "c", "d"))[0]
    grid = Grid(2, 2, 0.0, 4.0, 2.0, CRS)
    (term,) = common_errors.common_terms((error,), np.zeros(grid.shape), grid)
    np.testing.assert_allclose(term.covariance, 2.0 * np.eye(5), rtol=0, atol=0)


def test_the_design_of_a_common_error_is_offset_tilt_and_shift_on_the_slope():
    grid = Grid(4, 5, 100.0, 200.0, 2.0, CRS)
    easting, northing = grid.coordinates()
    elevation = (0.1 * easting - 0.3 * northing).reshape(grid.shape)
    (term,) = common_errors.common_terms((common_errors.EpochError(("flight", "a"), ERROR),), elevation, grid)
    np.testing.assert_allclose(term.design[:, 0], 1.0, rtol=0, atol=0)
    np.testing.assert_allclose(term.design[:, 1], easting - 1.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(term.design[:, 2], northing - 2.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(term.design[:, 3], -0.1, rtol=0, atol=1e-9)
    np.testing.assert_allclose(term.design[:, 4], 0.3, rtol=0, atol=1e-9)
    assert term.design.shape[1] == 5  # a record without bending, as earlier versions wrote it
    bent = replace(ERROR, covariance=tuple(tuple(row) for row in np.eye(8).tolist()))
    (term,) = common_errors.common_terms((common_errors.EpochError(("flight", "a"), bent),), elevation, grid)
    east, north = easting - 1.0, northing - 2.0
    np.testing.assert_allclose(term.design[:, 5:].T, [east**2, east * north, north**2], rtol=1e-12, atol=0)
