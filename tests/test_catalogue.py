"""Programmes, epochs, sources, and what derives from what."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest
from small_surveys import CRS, make_programme, reopen

from changedetect.catalogue import (
    ChangeProduct,
    Epoch,
    Programme,
    Source,
    parse_date,
    plan,
    survey_time_days,
    validate_epoch_id,
)
from changedetect.catalogue.epoch import read_epoch, write_epoch
from changedetect.errors import (
    ConfigError,
    CRSMismatchError,
    InputDataError,
    MissingInputError,
    OutputExistsError,
)

SOURCE = '[[sources]]\nuri = "a.laz"\n'


@pytest.fixture
def programme(tmp_path):
    return Programme.create(tmp_path / "site", {"crs": CRS, "resolution": 0.5})


def write_epochs(programme, dates):
    folder = programme.directory / "epochs"
    folder.mkdir(exist_ok=True)
    for epoch_id, date in dates.items():
        (folder / f"{epoch_id}.toml").write_text(f"date = {date}\n{SOURCE}")
    return reopen(programme)


# --- epochs -----------------------------------------------------------------------------------------------------


def test_an_epoch_reads_back_as_it_was_written(tmp_path):
    source = Source(
        uri="${DATA}/ä b.csv",
        crs="EPSG:25832+7837",
        sigma=0.05,
        classes=(2, 9),
        columns=("x", "y", "z"),
        nodata=-9999.0,
        band=2,
        sha256="0" * 64,
        size=12,
        n_points=34,
    )
    plain = Source(uri="b.laz")
    epoch = Epoch(
        epoch_id="2024-05-01",
        date=datetime(2024, 5, 1, 13, 30),
        sources=(source, plain),
        label='after "the storm"',
        region=(0.0, 1.5, 2.0, 3.0),
    )
    path = tmp_path / "2024-05-01.toml"
    write_epoch(path, epoch)
    assert read_epoch(path) == epoch


def test_nodata_may_be_nan_and_counts_as_unchanged(tmp_path):
    path = tmp_path / "2024-05-01.toml"
    path.write_text(f"date = 2024-05-01\n{SOURCE}nodata = nan\n")
    first, second = read_epoch(path).sources[0], read_epoch(path).sources[0]
    assert first.reading_options() == second.reading_options()
    assert first.reading_options()["nodata"] == "nan"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"date = 2024-05-01\n{SOURCE}sgma = 1\n", r"\[\[sources\]\] 1: unknown key 'sgma'. Did you mean 'sigma'\?"),
        (f"date = 2024-05-01\nlabl = 'x'\n{SOURCE}", r"unknown key 'labl'. Did you mean 'label'\?"),
        (
            f"epoch_id = 'b'\ndate = 2024-05-01\n{SOURCE}",
            "unknown key 'epoch_id'. Allowed there: date, sources, label, region",
        ),
        (SOURCE, "date = None; the date of the survey is needed"),
        (f"date = 'yesterday'\n{SOURCE}", "date 'yesterday' is not a date"),
        ("date = 2024-05-01\n", r"needs at least one table \[\[sources\]\]"),
        (
            "date = 2024-05-01\n[[sources]]\ncrs = 'EPSG:32632'\n",
            r"\[\[sources\]\] 1: uri is not valid: Field required",
        ),
        (f"date = 2024-05-01\n{SOURCE}sigma = 0\n", "sigma = 0 is not valid: Input should be greater than 0"),
        (f"date = 2024-05-01\n{SOURCE}classes = [300]\n", "classes.0 = 300 is not valid"),
        (
            f"format_version = 7\ndate = 2024-05-01\n{SOURCE}",
            "format_version = 7; this version of changedetect reads 1",
        ),
        ("date = \n", "is not valid TOML"),
    ],
)
def test_a_wrong_epoch_file_is_refused_with_what_is_wrong(tmp_path, text, message):
    path = tmp_path / "2024-05-01.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_epoch(path)


@pytest.mark.parametrize("epoch_id", ["", ".hidden", "a/b", "a b", "ü", "a.", "x" * 65, "../up"])
def test_an_epoch_id_that_is_no_safe_folder_name_is_refused(epoch_id):
    with pytest.raises(ConfigError, match=r"is not an epoch id. Use up to 64 letters, digits"):
        validate_epoch_id(epoch_id)


@pytest.mark.parametrize("epoch_id", ["2024-05-01", "2024-05-01T12.30", "before_storm", "7"])
def test_usual_epoch_ids_are_accepted(epoch_id):
    assert validate_epoch_id(epoch_id) == epoch_id


def test_dates_with_a_time_zone_are_converted_to_utc():
    assert parse_date("2024-05-01T01:30+02:00") == datetime(2024, 4, 30, 23, 30)
    assert parse_date("2024-05-01") == datetime(2024, 5, 1)
    assert survey_time_days(datetime(2024, 5, 1)) == 19844.0


# --- sources ----------------------------------------------------------------------------------------------------


def test_a_source_is_found_relative_to_the_programme_or_by_a_variable():
    home = Path("/site")
    assert Source(uri="in/a.laz").path(home) == Path("/site/in/a.laz")
    assert Source(uri="/data/a.laz").path(home) == Path("/data/a.laz")
    assert Source(uri="${ROOT}/a.laz").path(home, {"ROOT": "/mnt"}) == Path("/mnt/a.laz")


def test_a_source_whose_variable_is_not_set_says_which():
    with pytest.raises(MissingInputError, match=r"needs the environment variable ROOT, which is not set.*export ROOT="):
        Source(uri="${ROOT}/a.laz").path(Path("/site"), {})


# --- programmes -------------------------------------------------------------------------------------------------


def test_a_new_programme_opens_with_what_it_was_given(tmp_path):
    made = Programme.create(tmp_path / "a" / "site", {"crs": CRS, "bounds": (0.0, 9.0, 0.0, 8.0), "profile": "drone"})
    opened = Programme.open(tmp_path / "a" / "site", environment={})
    assert opened.config == made.config
    assert opened.config.bounds == (0.0, 9.0, 0.0, 8.0)
    assert opened.config.resolution == 0.25
    assert opened.epochs == ()
    assert plan(opened) == ()


def test_an_existing_programme_is_replaced_only_when_asked(programme):
    with pytest.raises(OutputExistsError, match="the programme has been made before"):
        Programme.create(programme.directory, {"crs": CRS})
    Programme.create(programme.directory, {"crs": CRS, "resolution": 2.0}, overwrite=True)
    assert reopen(programme).config.resolution == 2.0


def test_a_dry_run_makes_no_programme(tmp_path):
    Programme.create(tmp_path / "site", {"crs": CRS}, dry_run=True)
    assert not (tmp_path / "site").exists()


def test_a_folder_without_programme_says_how_to_make_one(tmp_path):
    with pytest.raises(MissingInputError, match=r"is no programme.*changedetect init"):
        Programme.open(tmp_path)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2225", "nonsense"])
def test_a_programme_needs_a_projected_crs_in_metres(tmp_path, crs):
    with pytest.raises(CRSMismatchError):
        Programme.create(tmp_path / "site", {"crs": crs})
    assert not (tmp_path / "site").exists()


def test_epochs_come_in_the_order_of_time_whatever_their_names(programme):
    programme = write_epochs(programme, {"b": "2024-01-01", "a": "2025-01-01", "c": "2024-06-01T10:00:00"})
    assert [epoch.epoch_id for epoch in programme.epochs] == ["b", "c", "a"]


def test_two_epochs_of_one_moment_are_refused(programme):
    programme = write_epochs(programme, {"a": "2024-01-01", "b": "2024-01-01"})
    with pytest.raises(ConfigError, match=r"'a' and 'b' have the same date, 2024-01-01. Give each its time"):
        _ = programme.epochs


def test_epochs_whose_products_would_share_a_folder_are_refused(programme):
    programme = write_epochs(
        programme, {"a": "2024-01-01", "b_c": "2024-02-01", "a_b": "2024-03-01", "c": "2024-04-01"}
    )
    with pytest.raises(
        ConfigError, match="products/a_b_c would hold both the difference of a and b_c and the difference"
    ):
        _ = programme.epochs


def test_an_unknown_epoch_is_answered_with_those_there_are(programme):
    with pytest.raises(MissingInputError, match="none yet"):
        programme.epoch("x")
    programme = write_epochs(programme, {"a": "2024-01-01"})
    with pytest.raises(MissingInputError, match=r"no epoch 'x'. Its epochs: a"):
        programme.epoch("x")


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("consecutive", ["a_b", "b_c", "c_d", "a_d"]),
        ("first", ["a_b", "a_c", "a_d"]),
        ("all", ["a_b", "a_c", "a_d", "b_c", "b_d", "c_d"]),
    ],
)
def test_rules_choose_the_pairs_they_name(programme, rule, expected):
    assert [pair.product_id for pair in programme.pairs(rule, ["a", "b", "c", "d"])] == expected


@pytest.mark.parametrize("rule", ["consecutive", "first", "all"])
def test_two_epochs_make_one_pair_and_one_makes_none(programme, rule):
    assert programme.pairs(rule, ["a", "b"]) == (ChangeProduct("a", "b"),)
    assert programme.pairs(rule, ["a"]) == ()
    assert programme.pairs(rule, []) == ()


def test_a_pair_goes_from_earlier_to_later(programme):
    programme = write_epochs(programme, {"a": "2024-01-01", "b": "2025-01-01"})
    assert programme.pair("a", "b") == ChangeProduct("a", "b")
    for earlier, later in (("b", "a"), ("a", "a")):
        with pytest.raises(InputDataError, match="goes from an earlier epoch to a later one"):
            programme.pair(earlier, later)


def test_everything_of_a_new_programme_is_due_in_the_order_it_is_made(tmp_path):
    surveys = {"2024-01-01": {}, "2024-02-01": {}, "2024-03-01": {}}
    items = plan(make_programme(tmp_path / "site", surveys))
    assert [(item.kind, item.item_id) for item in items] == [
        ("model", "2024-01-01"),
        ("epoch", "2024-01-01"),
        ("model", "2024-02-01"),
        ("epoch", "2024-02-01"),
        ("model", "2024-03-01"),
        ("epoch", "2024-03-01"),
        ("pair", "2024-01-01_2024-02-01"),
        ("pair", "2024-02-01_2024-03-01"),
        ("pair", "2024-01-01_2024-03-01"),
    ]
    assert {item.reasons for item in items} == {("not learned yet",), ("not made yet",)}
