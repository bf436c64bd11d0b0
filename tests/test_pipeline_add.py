"""Adding epochs: everything is checked first, and nothing is half-written."""

from __future__ import annotations

import numpy as np
import pytest
from small_surveys import CRS, SIDE, SOUTH, WEST, make_programme, reopen, snapshot, survey, write_survey

from changedetect.catalogue import Programme, Source, parse_date, plan
from changedetect.errors import (
    ConfigError,
    CRSMismatchError,
    InputDataError,
    MissingInputError,
    OutputExistsError,
    TemporaryError,
    VerticalDatumError,
)
from changedetect.grid import Grid
from changedetect.io.cog import write_cog
from changedetect.pipeline.ingest import add_epoch
from changedetect.pipeline.lock import programme_lock
from changedetect.pipeline.update import update
from changedetect.storage import sha256_of_file

EPOCH = "2024-01-01"


@pytest.fixture
def programme(tmp_path):
    return Programme.create(tmp_path / "site", {"crs": CRS, "resolution": 0.5})


def add(programme, path, epoch_id=EPOCH, date=None, **arguments):
    options = {
        key: arguments.pop(key) for key in ("crs", "sigma", "classes", "columns", "nodata", "band") if key in arguments
    }
    paths = path if isinstance(path, list) else [path]
    sources = [Source(uri=str(item), **options) for item in paths]
    added = add_epoch(reopen(programme), epoch_id, sources, parse_date(date or epoch_id), **arguments)
    return added, reopen(programme)


def assert_refused(programme, path, error, match, **arguments):
    """Check that `add` raises and leaves the programme's folder as it was."""
    before = {name for name in snapshot(programme.directory) if not name.endswith(".lock")}
    with pytest.raises(error, match=match):
        add(programme, path, **arguments)
    assert {name for name in snapshot(programme.directory) if not name.endswith(".lock")} == before


def write_table(path, cloud, header="easting,northing,elevation"):
    rows = zip(cloud.easting, cloud.northing, cloud.elevation, strict=True)
    path.write_text("\n".join([header, *(f"{e:.3f},{n:.3f},{z}" for e, n, z in rows)]) + "\n")
    return path


# --- what is remembered -----------------------------------------------------------------------------------------


def test_an_added_epoch_is_remembered_with_checksum_size_points_and_ground(programme, tmp_path):
    path = write_survey(tmp_path / "in" / "a.laz")
    added, programme = add(programme, path, label="first")
    (epoch,) = programme.epochs
    (source,) = epoch.sources
    assert epoch == added.epoch
    assert (source.sha256, source.size, source.n_points) == (sha256_of_file(path), path.stat().st_size, 1800)
    assert source.uri == str(path)
    assert epoch.label == "first"
    assert added.n_points == 1800
    west, east, south, north = epoch.region
    assert WEST <= west < east <= WEST + SIDE
    assert SOUTH <= south < north <= SOUTH + SIDE
    assert [item.item_id for item in plan(programme)] == [EPOCH, EPOCH]


def test_a_file_inside_the_programme_is_remembered_relative_to_it(programme):
    path = write_survey(programme.directory / "inputs" / "a.laz")
    added, _ = add(programme, path)
    assert added.epoch.sources[0].uri == "inputs/a.laz"


def test_several_files_make_one_epoch(programme, tmp_path):
    paths = [write_survey(tmp_path / "a.laz", 1), write_survey(tmp_path / "b.laz", 2)]
    added, programme = add(programme, paths)
    assert added.n_points == 3600
    assert update(programme).exit_code == 0


def test_a_table_with_named_columns_and_a_stated_crs_is_added_and_learned(programme, tmp_path):
    path = write_table(tmp_path / "a.csv", survey(), header="x_m,y_m,h_m")
    _, programme = add(programme, path, crs=CRS, columns=("x_m", "y_m", "h_m"), sigma=0.02)
    assert update(programme).exit_code == 0
    assert programme.state_record(EPOCH)[0].n_points == 1800


def test_an_elevation_raster_is_added_and_learned(programme, tmp_path):
    grid = Grid.from_region((WEST, WEST + SIDE, SOUTH, SOUTH + SIDE), 0.5, CRS)
    easting, northing = grid.coordinates()
    array = (400.0 + 0.05 * (easting - WEST) + 0.01 * (northing - SOUTH)).reshape(grid.shape)
    array[:4] = np.nan
    write_cog(tmp_path / "dem.tif", array, grid, nodata=np.nan, description="elevation", unit="m", tags={})
    added, programme = add(programme, tmp_path / "dem.tif")
    assert added.n_points == 36 * 40
    assert update(programme).exit_code == 0


def test_a_source_in_geographic_coordinates_is_brought_to_the_programmes_crs(tmp_path):
    from pyproj import Transformer

    programme = Programme.create(tmp_path / "site", {"crs": "EPSG:32632+4979", "resolution": 0.5})
    cloud = survey()
    transform = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    longitude, latitude = transform.transform(cloud.easting, cloud.northing)
    rows = zip(longitude, latitude, cloud.elevation, strict=True)
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["lon,lat,h", *(f"{x:.10f},{y:.10f},{z}" for x, y, z in rows)]))
    added, _ = add(programme, path, crs="EPSG:4979", columns=("lon", "lat", "h"))
    np.testing.assert_allclose(added.region, cloud.region, rtol=0, atol=1e-3)


def test_a_late_epoch_is_said_to_be_one(programme, tmp_path):
    _, programme = add(programme, write_survey(tmp_path / "a.laz", 1), "2024-06-01")
    added, programme = add(programme, write_survey(tmp_path / "b.laz", 2), "2024-01-01")
    assert added.is_late
    added, _ = add(programme, write_survey(tmp_path / "c.laz", 3), "2024-09-01")
    assert not added.is_late


def test_a_dry_run_checks_and_writes_nothing(programme, tmp_path):
    path = write_survey(tmp_path / "a.laz")
    before = snapshot(programme.directory)
    added, reopened = add(programme, path, dry_run=True)
    assert added.n_points == 1800
    assert reopened.epochs == ()
    assert snapshot(programme.directory) == before
    (tmp_path / "empty.laz").write_bytes(b"")
    with pytest.raises(InputDataError):
        add(programme, tmp_path / "empty.laz", dry_run=True)


# --- moving sources ---------------------------------------------------------------------------------------------


def test_moved_files_lie_in_the_programme_and_no_longer_where_they_were(programme, tmp_path):
    path = write_survey(tmp_path / "in" / "a.laz")
    sha256 = sha256_of_file(path)
    added, programme = add(programme, path, move=True)
    kept = programme.directory / "sources" / EPOCH / "a.laz"
    assert not path.exists()
    assert sha256_of_file(kept) == sha256
    assert added.epoch.sources[0].uri == f"sources/{EPOCH}/a.laz"
    assert update(programme).exit_code == 0


def test_a_move_that_is_refused_leaves_the_files_where_they_are(programme, tmp_path):
    path = write_survey(tmp_path / "a.laz", n_points=9)
    assert_refused(programme, path, InputDataError, "at least 10 are needed", move=True)
    assert path.exists()


def test_moved_files_of_the_same_name_are_refused(programme, tmp_path):
    paths = [write_survey(tmp_path / name / "a.laz", seed) for seed, name in enumerate("xy")]
    with pytest.raises(InputDataError, match=r"need different file names, not a\.laz, a\.laz"):
        add(programme, paths, move=True)
    assert all(path.exists() for path in paths)
    assert reopen(programme).epochs == ()


# --- what is refused --------------------------------------------------------------------------------------------


def test_an_epoch_id_that_exists_is_refused_and_replaced_when_asked(programme, tmp_path):
    one, other = write_survey(tmp_path / "a.laz", 1), write_survey(tmp_path / "b.laz", 2)
    _, programme = add(programme, one)
    assert_refused(
        programme, other, OutputExistsError, f"Epoch '{EPOCH}' exists. Choose another id, or pass --overwrite"
    )
    _, programme = add(programme, other, overwrite=True)
    assert programme.epochs[0].sources[0].name == "b.laz"


def test_the_same_file_twice_is_refused_whatever_its_name(programme, tmp_path):
    path = write_survey(tmp_path / "a.laz")
    copy = tmp_path / "copy of a.laz"
    copy.write_bytes(path.read_bytes())
    _, programme = add(programme, path)
    assert_refused(
        programme,
        copy,
        InputDataError,
        rf"is in the programme already, in epoch '{EPOCH}' \(same content",
        epoch_id="2025-01-01",
    )
    fresh = write_survey(tmp_path / "b.laz", 2)
    again = tmp_path / "b2.laz"
    again.write_bytes(fresh.read_bytes())
    assert_refused(programme, [fresh, again], InputDataError, "in this epoch, as 'b.laz'", epoch_id="2025-01-01")


def test_the_same_file_as_in_a_hand_written_epoch_is_refused(tmp_path):
    programme = make_programme(tmp_path / "site", {EPOCH: {}})
    path = programme.directory / "inputs" / f"{EPOCH}.laz"
    assert_refused(programme, path, InputDataError, f"in epoch '{EPOCH}'", epoch_id="2025-01-01")
    assert update(programme).exit_code == 0
    copy = tmp_path / "copy.laz"
    copy.write_bytes(path.read_bytes())
    path.unlink()
    assert_refused(programme, copy, InputDataError, f"in epoch '{EPOCH}'", epoch_id="2025-01-01")


def test_a_file_that_changed_after_it_was_added_is_refused_when_it_is_learned(programme, tmp_path):
    path = write_survey(tmp_path / "a.laz", 1)
    _, programme = add(programme, path)
    write_survey(path, 2)
    result = update(programme)
    assert result.exit_code == 65
    assert "is not the file that was added" in result.steps[0]["error"]["message"]


def test_a_missing_file_is_refused(programme, tmp_path):
    assert_refused(programme, tmp_path / "absent.laz", MissingInputError, "No such file")


def test_a_folder_is_refused_with_a_hint(programme, tmp_path):
    assert_refused(programme, tmp_path, InputDataError, r"is a folder. Name the files in it")


def test_an_empty_a_truncated_and_a_foreign_file_are_refused(programme, tmp_path):
    whole = write_survey(tmp_path / "a.laz").read_bytes()
    for name, content in (("empty.laz", b""), ("short.laz", whole[: len(whole) // 2]), ("text.laz", b"no points\n")):
        (tmp_path / name).write_bytes(content)
        assert_refused(programme, tmp_path / name, InputDataError, name)


def test_a_file_without_crs_is_refused_and_accepted_with_one_stated(programme, tmp_path):
    path = write_table(tmp_path / "a.csv", survey())
    assert_refused(programme, path, CRSMismatchError, "does not say in which coordinate reference system")
    add(programme, path, crs=CRS)


def test_an_undeclared_vertical_datum_is_refused_with_the_fix(programme, tmp_path):
    path = write_table(tmp_path / "a.csv", survey())
    assert_refused(programme, path, VerticalDatumError, r"does not declare the vertical datum.*5773", crs="EPSG:32632")


def test_a_foot_based_crs_without_vertical_unit_is_refused(tmp_path):
    programme = Programme.create(tmp_path / "site", {"crs": "EPSG:26910", "resolution": 0.5})
    path = write_table(tmp_path / "a.csv", survey())
    assert_refused(programme, path, VerticalDatumError, "does not say in which unit heights are", crs="EPSG:2227")


@pytest.mark.parametrize("bad", ["nan", "inf", "99999"])
def test_elevations_that_cannot_be_are_refused(programme, tmp_path, bad):
    path = write_table(tmp_path / "a.csv", survey())
    lines = path.read_text().splitlines()
    lines[5] = lines[5].rpartition(",")[0] + f",{bad}"
    path.write_text("\n".join(lines))
    assert_refused(programme, path, InputDataError, "a.csv", crs=CRS)


def test_nan_declared_to_be_missing_is_left_out(programme, tmp_path):
    path = write_table(tmp_path / "a.csv", survey())
    lines = path.read_text().splitlines()
    lines[5] = lines[5].rpartition(",")[0] + ",nan"
    path.write_text("\n".join(lines))
    added, programme = add(programme, path, crs=CRS, nodata=float("nan"))
    assert added.n_points == 1799
    assert update(programme).exit_code == 0
    assert plan(reopen(programme)) == plan(programme)
    assert not any(item.is_due for item in plan(reopen(programme)))


def test_too_few_points_and_classes_that_filter_everything_away_are_refused(programme, tmp_path):
    assert_refused(programme, write_survey(tmp_path / "few.laz", n_points=9), InputDataError, "at least 10 are needed")
    path = write_survey(tmp_path / "a.laz", classification=np.full(1800, 5, np.uint8))
    assert_refused(programme, path, InputDataError, r"no usable point of class 2.*5 \(1800 points\)", classes=(2,))


def test_a_source_outside_the_bounds_is_refused_with_both_regions(tmp_path):
    bounds = (WEST, WEST + SIDE, SOUTH, SOUTH + SIDE)
    programme = Programme.create(tmp_path / "site", {"crs": CRS, "bounds": bounds})
    path = write_survey(tmp_path / "far.laz", shift=5000.0)
    assert_refused(
        programme,
        path,
        InputDataError,
        r"lies outside the programme: its points span easting 505000.* the bounds are easting 500000",
    )


def test_a_source_with_a_handful_of_points_inside_the_bounds_is_refused(tmp_path):
    bounds = (WEST, WEST + 1.0, SOUTH, SOUTH + 1.0)
    programme = Programme.create(tmp_path / "site", {"crs": CRS, "bounds": bounds})
    assert_refused(programme, write_survey(tmp_path / "a.laz"), InputDataError, f"epoch {EPOCH}: . usable point")


def test_a_survey_of_another_site_is_refused(programme, tmp_path):
    _, programme = add(programme, write_survey(tmp_path / "a.laz", 1))
    path = write_survey(tmp_path / "far.laz", 2, shift=5000.0)
    assert_refused(
        programme,
        path,
        InputDataError,
        rf"do not overlap the programme: they span easting 505000.*epoch '{EPOCH}' spans easting 500000",
        epoch_id="2025-01-01",
    )


def test_a_survey_of_another_site_than_a_learned_hand_written_epoch_is_refused(tmp_path):
    programme = make_programme(tmp_path / "site", {EPOCH: {}})
    update(programme)
    path = write_survey(tmp_path / "far.laz", 2, shift=5000.0)
    assert_refused(programme, path, InputDataError, "do not overlap", epoch_id="2025-01-01")


def test_two_epochs_of_one_date_are_refused(programme, tmp_path):
    _, programme = add(programme, write_survey(tmp_path / "a.laz", 1), "morning", "2024-01-01")
    path = write_survey(tmp_path / "b.laz", 2)
    assert_refused(programme, path, ConfigError, "have the same date", epoch_id="evening", date="2024-01-01")
    add(programme, path, "evening", "2024-01-01T18:00")


def test_adding_while_an_update_runs_is_put_off(programme, tmp_path):
    path = write_survey(tmp_path / "a.laz")
    with programme_lock(programme.directory), pytest.raises(TemporaryError, match="is locked by process"):
        add(programme, path)
