"""Epochs are aligned on their way in: what is recorded, what stays valid, what is refused."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import rolling_ground as rolling
from small_surveys import reopen, run

from changedetect.catalogue import Programme, plan
from changedetect.io.cog import read_cog
from changedetect.io.las import write_points
from changedetect.models.registry import load_model
from changedetect.pipeline.update import update
from changedetect.pointcloud import PointCloud
from changedetect.storage import read_json, sha256_of_file

CRS = "EPSG:32632+5773"
FIRST, SECOND, THIRD = "2024-01-01", "2024-07-01", "2025-01-01"
SHIFT = (0.4, -0.3, 0.2)
DATA = Path(os.environ.get("CHANGEDETECT_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def _write(programme, epoch_id, cloud):
    path = programme.directory / "inputs" / f"{epoch_id}.laz"
    path.parent.mkdir(exist_ok=True)
    write_points(path, cloud, CRS)
    (programme.directory / "epochs").mkdir(exist_ok=True)
    (programme.directory / "epochs" / f"{epoch_id}.toml").write_text(
        f'date = {epoch_id}\n[[sources]]\nuri = "inputs/{epoch_id}.laz"\n'
    )


def _programme(directory, clouds, **coregistration):
    programme = Programme.create(directory, {"name": "site", "crs": CRS, "resolution": 5.0})
    lines = [f"{key} = {json.dumps(value)}\n" for key, value in coregistration.items()]
    with (directory / "programme.toml").open("a") as settings:
        settings.write("".join(["[coregistration]\n", *lines]))
    for epoch_id, cloud in clouds.items():
        _write(programme, epoch_id, cloud)
    return reopen(programme)


def _epoch(seed, shift=(0.0, 0.0, 0.0), **how):
    return rolling.epoch(seed, 15000, shift=shift, margin=0.0, **how)


def _clouds():
    return {FIRST: _epoch(0), SECOND: _epoch(1, SHIFT), THIRD: _epoch(2, (-0.5, 0.1, -0.6))}


def _record(programme, epoch_id):
    return programme.state_record(epoch_id)[0].alignment


def _predicted(programme, epoch_id):
    places = rolling.WEST + np.linspace(30.0, 210.0, 400), rolling.SOUTH + np.linspace(200.0, 40.0, 400)
    return load_model(programme.state_directory(epoch_id)).predict(places)


def _polygon(west, east, name):
    south, north = rolling.SOUTH, rolling.SOUTH + rolling.SIDE
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    geometry = {"type": "Polygon", "coordinates": [ring]}
    return {"type": "Feature", "properties": {"name": name}, "geometry": geometry}


def _write_areas(path, *features):
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": list(features)}))


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    programme = _programme(tmp_path_factory.mktemp("aligned") / "site", _clouds())
    before = sha256_of_file(programme.directory / "inputs" / f"{SECOND}.laz")
    result = update(programme)
    assert result.exit_code == 0, result.steps
    assert sha256_of_file(programme.directory / "inputs" / f"{SECOND}.laz") == before
    return programme, result


def test_a_displaced_epoch_is_moved_onto_the_first(learned):
    programme, _ = learned
    assert _record(programme, FIRST) is None
    for epoch_id, shift in ((SECOND, SHIFT), (THIRD, (-0.5, 0.1, -0.6))):
        record = _record(programme, epoch_id)
        assert (record.reference, record.is_applied, record.kind) == (FIRST, True, "shift")
        alignment = record.applied()
        assert (np.abs(rolling.found_about(alignment) - shift) < 3.5 * alignment.standard_errors).all()
        assert (alignment.standard_errors < 0.05).all()
        assert record.estimate["nmad_after"] < record.estimate["nmad_before"]
        assert np.shape(record.estimate["covariance"]) == (3, 3)
    dod = read_cog(programme.product_directory(f"{FIRST}_{SECOND}") / "dod.tif")[0]
    assert abs(np.nanmedian(dod)) < 0.01


def test_a_vertical_step_is_a_warning_of_the_run(learned):
    _, result = learned
    (warning,) = [warning for warning in result.warnings if warning.startswith(THIRD)]
    assert "m above the reference everywhere, as a step of the vertical datum" in warning
    assert warning.endswith("It was taken out.")


def test_update_and_status_report_the_alignment(learned, capsys):
    programme, _ = learned
    first, second, _ = run(capsys, "status", programme.directory)["epochs"]
    assert first["alignment"] is None
    assert second["alignment"]["wording"].startswith("Moved by east +0.")
    assert second["alignment"]["estimate"]["transform"]["kind"] == "shift"
    document = run(capsys, "update", programme.directory)
    assert document["run_id"] is None
    assert document["epochs"][1]["alignment"] == second["alignment"]


def test_incremental_learning_equals_learning_from_scratch_though_aligned(learned, tmp_path):
    scratch, _ = learned
    clouds = _clouds()
    site = _programme(tmp_path / "site", {epoch_id: clouds[epoch_id] for epoch_id in (FIRST, THIRD)})
    assert update(site).exit_code == 0
    before = _record(site, THIRD)
    _write(site, SECOND, clouds[SECOND])
    result = update(reopen(site))
    origins = {step["id"]: step["origin"] for step in result.steps if step["kind"] == "model"}
    assert origins == {SECOND: "sources", THIRD: "stored evidence"}
    assert _record(reopen(site), THIRD) == before
    for epoch_id in (SECOND, THIRD):
        one, other = _predicted(site, epoch_id), _predicted(scratch, epoch_id)
        np.testing.assert_allclose(one.elevation, other.elevation, rtol=0, atol=1e-9)


def test_an_epoch_before_the_first_makes_all_be_aligned_anew(tmp_path):
    clouds = _clouds()
    site = _programme(tmp_path / "site", {epoch_id: clouds[epoch_id] for epoch_id in (SECOND, THIRD)})
    assert update(site).exit_code == 0
    _write(site, FIRST, clouds[FIRST])
    result = update(reopen(site))
    reasons = {step["id"]: step["reasons"] for step in result.steps if step["kind"] == "model"}
    assert reasons[SECOND] == [f"it is to be aligned to epoch {FIRST} now"]
    assert reasons[THIRD] == [f"it is to be aligned to epoch {FIRST} now, and was aligned to epoch {SECOND}"]
    np.testing.assert_allclose(
        rolling.found_about(_record(reopen(site), THIRD).applied()), (-0.5, 0.1, -0.6), rtol=0, atol=0.05
    )
    assert [item for item in plan(reopen(site)) if item.is_due] == []


def test_the_very_points_of_the_first_epoch_show_no_change_at_all(tmp_path):
    cloud = _epoch(0)
    order = np.random.default_rng(0).permutation(len(cloud))
    site = _programme(tmp_path / "site", {FIRST: cloud, SECOND: cloud.select(order)})
    assert update(site).exit_code == 0
    assert not _record(site, SECOND).is_applied
    dod = read_cog(site.product_directory(f"{FIRST}_{SECOND}") / "dod.tif")[0]
    np.testing.assert_array_equal(dod[np.isfinite(dod)], 0.0)
    summary = read_json(site.product_directory(f"{FIRST}_{SECOND}") / "summary.json")
    assert summary["area_raised_m2"] + summary["area_lowered_m2"] == 0.0


def test_stable_areas_decide_and_their_change_makes_the_epoch_stale(tmp_path):
    # two thirds rose: unchanged ground cannot be found, it has to be given
    def rise(easting, _northing):
        return 1.0 * (easting < rolling.WEST + 160.0)

    site = _programme(
        tmp_path / "site", {FIRST: _epoch(0), SECOND: _epoch(1, SHIFT, change=rise)}, stable_areas="stable.geojson"
    )
    areas = site.directory / "stable.geojson"
    east = _polygon(rolling.WEST + 165.0, rolling.WEST + 240.0, "car park")
    _write_areas(areas, east)
    assert update(site).exit_code == 0
    record = _record(site, SECOND)
    np.testing.assert_allclose(rolling.found_about(record.applied()), SHIFT, rtol=0, atol=0.15)
    _write_areas(areas, east, _polygon(rolling.WEST + 10.0, rolling.WEST + 30.0, "quarry"))
    (item,) = [item for item in plan(reopen(site)) if item.is_due and item.kind == "model"]
    assert item.reasons == ("the stable areas in stable.geojson have changed",)
    result = update(reopen(site))
    assert any("Stable area 'quarry' changed by +" in warning for warning in result.warnings)


def test_stable_areas_that_cannot_be_read_fail_the_epoch_and_name_the_setting(tmp_path):
    site = _programme(tmp_path / "site", {FIRST: _epoch(0), SECOND: _epoch(1)}, stable_areas="absent.gpkg")
    result = update(site)
    assert result.exit_code == 66
    (failed,) = [step for step in result.steps if step["status"] == "failed"]
    assert failed["id"] == SECOND
    assert "coregistration.stable_areas cannot be used" in failed["error"]["message"]
    assert site.state_record(FIRST) is not None


@pytest.mark.parametrize("settings", [{"transform": "none"}, {"enabled": False}])
def test_an_epoch_can_be_left_where_it_is(settings, tmp_path):
    site = _programme(tmp_path / "site", {FIRST: _epoch(0), SECOND: _epoch(1, (0.0, 0.0, 0.5))}, **settings)
    result = update(site)
    record = _record(site, SECOND)
    if "enabled" in settings:
        assert record is None
    else:
        assert not record.is_applied
        assert record.applied() is None
        assert record.wording.startswith("Not moved, as set. Would be: Moved by")
        assert any(warning.endswith("It was left in, as set.") for warning in result.warnings)
    dod = read_cog(site.product_directory(f"{FIRST}_{SECOND}") / "dod.tif")[0]
    assert np.nanmedian(dod) == pytest.approx(-0.5, abs=0.02)


def test_flat_ground_is_aligned_vertically_and_refused_where_more_is_demanded(tmp_path):
    clouds = {FIRST: _epoch(0, surface=rolling.flat), SECOND: _epoch(1, (0.0, 0.0, 0.2), surface=rolling.flat)}
    lenient = _programme(tmp_path / "lenient", clouds)
    result = update(lenient)
    assert result.exit_code == 0
    assert _record(lenient, SECOND).kind == "vertical"
    assert any("Aligned vertically only: slopes vary too little" in warning for warning in result.warnings)
    strict = _programme(tmp_path / "strict", clouds, transform="shift")
    result = update(strict)
    assert result.exit_code == 65
    (failed,) = [step for step in result.steps if step["status"] == "failed"]
    assert (
        f"Epoch {SECOND} cannot be aligned to epoch {FIRST}: A transform of kind 'shift'" in failed["error"]["message"]
    )


def test_an_epoch_with_too_little_overlap_goes_in_as_it_is_with_a_warning(tmp_path):
    cloud = _epoch(1)
    moved = PointCloud(cloud.easting + rolling.SIDE + 0.8, cloud.northing, cloud.elevation)
    site = _programme(tmp_path / "site", {FIRST: _epoch(0), SECOND: moved})
    result = update(site)
    assert result.exit_code == 0
    (warning,) = [warning for warning in result.warnings if warning.startswith(SECOND)]
    assert "Not aligned, for want of" in warning
    assert _record(site, SECOND).kind == "none"


def test_elevations_in_feet_are_refused_and_the_first_epoch_stays(tmp_path):
    cloud = _epoch(1)
    feet = PointCloud(cloud.easting, cloud.northing, cloud.elevation / 0.3048)
    site = _programme(tmp_path / "site", {FIRST: _epoch(0), SECOND: feet})
    result = update(site)
    assert result.exit_code == 65
    (failed,) = [step for step in result.steps if step["status"] == "failed"]
    assert "Elevations look like feet, not metres" in failed["error"]["message"]
    assert site.state_record(FIRST) is not None
    assert site.state_record(SECOND) is None


@pytest.mark.real
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real surveys under {DATA} (set CHANGEDETECT_DATA)")
def test_the_road_of_toronto_comes_to_lie_on_itself(tmp_path, monkeypatch):
    monkeypatch.setenv("CHANGEDETECT_DATA", str(DATA))
    site = tmp_path / "toronto"
    definition = Path(__file__).resolve().parents[2] / "surveys" / "toronto_spit"
    (site / "epochs").mkdir(parents=True)
    for path in (definition / "programme.toml", *definition.glob("epochs/*.toml")):
        (site / path.relative_to(definition)).write_text(path.read_text())
    programme = Programme.open(site)
    result = update(programme)
    assert result.exit_code == 0
    earlier, later = (epoch.epoch_id for epoch in programme.epochs)
    up = _record(programme, later).applied().transform["up"]
    assert up == pytest.approx(0.41, abs=0.03)
    assert any("0.42 m below the reference everywhere" in warning for warning in result.warnings)
    # the road: 3 m either side of its middle line from (634296, 4831377) to (634398, 4831487)
    along = np.linspace(0.0, 1.0, 300)
    across = np.linspace(-3.0, 3.0, 7)[:, None]
    direction = np.array([102.0, 110.0]) / np.hypot(102.0, 110.0)
    places = (
        (634296.0 + 102.0 * along - across * direction[1]).ravel(),
        (4831377.0 + 110.0 * along + across * direction[0]).ravel(),
    )
    models = [load_model(programme.state_directory(epoch_id)) for epoch_id in (earlier, later)]
    difference = models[1].predict(places).elevation - models[0].predict(places).elevation
    assert np.isfinite(difference).mean() > 0.95
    assert abs(np.nanmedian(difference)) < 0.03
    assert abs(np.nanmean(difference)) < 0.03
