"""Coordinate reference systems: parts, equality, and transformations that are right or refused."""

from __future__ import annotations

import json
import logging
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from numpy.testing import assert_allclose
from pyproj import CRS

from changedetect import crs as crs_module
from changedetect.crs import (
    check_compatible,
    check_programme_crs,
    crs_name,
    height_unit,
    horizontal_epsg,
    horizontal_part,
    is_geographic,
    is_same_horizontal,
    is_same_vertical,
    make_transform,
    parse_crs,
    surface_standard_name,
    to_cf,
    to_wkt,
    vertical_part,
)
from changedetect.crs import transform as transform_module
from changedetect.errors import CRSMismatchError, InputDataError, VerticalDatumError

SITE_DATUM = (
    'COMPOUNDCRS["Quarry",{},VERTCRS["Quarry heights",VDATUM["Bench mark 7"],CS[vertical,1],'
    'AXIS["gravity-related height (H)",up,LENGTHUNIT["metre",1]]]]'
).format(CRS("EPSG:32632").to_wkt())
UNKNOWN_DATUM = SITE_DATUM.replace("Bench mark 7", "unknown")
LOCAL_TM = "+proj=tmerc +lat_0=-33.89 +lon_0=151.19 +ellps=WGS84 +units=m"
US_FOOT = 1200 / 3937  # m, by definition


@pytest.fixture(autouse=True)
def _forget_warnings() -> None:
    """Warnings are logged once a process; each test counts anew."""
    transform_module._warn_heights_undeclared.cache_clear()
    transform_module._warn_inaccurate.cache_clear()


def points(*rows: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    easting, northing, elevation = np.array(rows, dtype=float).T.copy()
    return easting, northing, elevation


# what a CRS is


@pytest.mark.parametrize("text", ["", "hello", "EPSG:999999", "EPSG:32632+", "PROJCS[broken"])
def test_a_text_that_is_no_crs_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(CRSMismatchError, match=r"Cannot understand .* Write an EPSG code such as EPSG:32632"):
        parse_crs(text)


@pytest.mark.parametrize(
    ("text", "horizontal", "vertical"),
    [
        ("EPSG:32632", "EPSG:32632", None),
        ("EPSG:32632+5773", "EPSG:32632", "EPSG:5773"),
        ("EPSG:32632+4979", "EPSG:32632", "ellipsoid:EPSG:4979"),
        ("EPSG:4979", "EPSG:4326", "ellipsoid:EPSG:4979"),
        ("EPSG:4326+5773", "EPSG:4326", "EPSG:5773"),
        ("EPSG:2263+6360", "EPSG:2263", "EPSG:6360"),
    ],
)
def test_a_crs_splits_into_its_parts(text: str, horizontal: str, vertical: str | None) -> None:
    assert horizontal_part(text) == horizontal
    assert vertical_part(text) == vertical
    assert horizontal_epsg(text) == int(horizontal[5:])


@pytest.mark.parametrize("version", ["WKT2", "WKT1"])
@pytest.mark.parametrize("text", ["EPSG:32632", "EPSG:32632+5773", "EPSG:26917+5713", "EPSG:2193", "EPSG:2263+6360"])
def test_wkt_means_the_same_as_the_code(text: str, version: str) -> None:
    wkt = to_wkt(text, version)  # type: ignore[arg-type]
    assert is_same_horizontal(text, wkt)
    assert is_same_vertical(text, wkt)
    assert wkt.startswith({"WKT1": ("PROJCS", "COMPD_CS"), "WKT2": ("PROJCRS", "COMPOUNDCRS")}[version])


def test_ellipsoidal_heights_survive_in_wkt2_and_are_refused_in_wkt1() -> None:
    assert vertical_part(to_wkt("EPSG:32632+4979")) == "ellipsoid:EPSG:4979"
    with pytest.raises(CRSMismatchError, match="cannot be written as WKT1"):
        to_wkt("EPSG:32632+4979", "WKT1")


@pytest.mark.parametrize("code", [26917, 6404, 32755, 2193, 3035, 25832, 31467])
def test_equality_is_one_of_meaning_not_of_spelling(code: int) -> None:
    text = f"EPSG:{code}"
    for spelling in (
        CRS(text).to_wkt("WKT1_ESRI"),
        CRS(text).to_wkt("WKT1_GDAL"),
        CRS(text).to_json(),
        rasterio.crs.CRS.from_epsg(code).to_wkt(),
    ):
        assert is_same_horizontal(text, spelling)
        assert make_transform(text, spelling).is_identity


def test_a_compound_crs_equals_its_horizontal_part_horizontally_only() -> None:
    assert is_same_horizontal("EPSG:32632+5773", "EPSG:32632")
    assert not is_same_vertical("EPSG:32632+5773", "EPSG:32632")
    assert is_same_vertical("EPSG:32632", "EPSG:25832")


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("EPSG:25832+5783", "EPSG:25832+7837"),  # DHHN92, DHHN2016
        ("EPSG:26917+5713", "EPSG:26917+6647"),  # CGVD28, CGVD2013
        ("EPSG:32632+5773", "EPSG:32632+3855"),  # EGM96, EGM2008
        ("EPSG:32632+4979", "EPSG:32632+5773"),  # ellipsoidal, levelled
        ("EPSG:26917+5703", "EPSG:26917+6360"),  # metres, feet
        ("EPSG:32632+5714", "EPSG:32632+5715"),  # height, depth
        ("EPSG:32632+4979", "EPSG:25832+4937"),  # ellipsoidal in two frames
    ],
)
def test_heights_of_different_datums_units_or_signs_are_not_the_same(first: str, second: str) -> None:
    assert not is_same_vertical(first, second)
    assert not is_same_vertical(second, first)


def test_neighbouring_utm_zones_and_sister_datums_are_not_the_same() -> None:
    assert not is_same_horizontal("EPSG:32632", "EPSG:32633")
    assert not is_same_horizontal("EPSG:26917", "EPSG:32617")


def test_an_unnamed_vertical_datum_in_metres_counts_as_undeclared() -> None:
    assert vertical_part(UNKNOWN_DATUM) is None
    assert vertical_part(SITE_DATUM) is not None


def test_a_site_datum_keeps_its_name() -> None:
    assert crs_name(SITE_DATUM) == "Quarry"
    assert "Bench mark 7" in (vertical_part(SITE_DATUM) or "")
    assert to_cf(SITE_DATUM)["geopotential_datum_name"] == "Bench mark 7"


def test_names_tell_ellipsoidal_heights() -> None:
    assert crs_name("EPSG:32632+4979") == "WGS 84 / UTM zone 32N + ellipsoidal height"
    assert crs_name("EPSG:32632") == "WGS 84 / UTM zone 32N"


def test_height_units_are_read_from_the_crs() -> None:
    assert height_unit("EPSG:32632") is None
    assert height_unit("EPSG:32632+4979") == ("metre", 1.0)
    name, metres = height_unit("EPSG:2263+6360") or ("", 0.0)
    assert name == "US survey foot"
    assert_allclose(metres, US_FOOT, rtol=1e-15, atol=0)


def test_longitude_and_latitude_are_told_from_metres() -> None:
    assert is_geographic("EPSG:4979")
    assert is_geographic("EPSG:4326+5773")
    assert not is_geographic("EPSG:32632+5773")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("EPSG:32632+4979", "height_above_reference_ellipsoid"),
        ("EPSG:32632+5773", "surface_altitude"),
        ("EPSG:32632+3855", "surface_altitude"),
        ("EPSG:32632+5714", "height_above_mean_sea_level"),
        ("EPSG:25832+7837", "surface_height_above_geopotential_datum"),
        ("EPSG:26917+5713", "surface_height_above_geopotential_datum"),
        (SITE_DATUM, "surface_height_above_geopotential_datum"),
        ("EPSG:32632", None),
        (UNKNOWN_DATUM, None),
    ],
)
def test_the_cf_standard_name_follows_the_vertical_datum(text: str, name: str | None) -> None:
    assert surface_standard_name(text) == name


def test_cf_attributes_hold_single_parameters_and_wkt() -> None:
    attributes = to_cf("EPSG:32632+5773")
    assert attributes["grid_mapping_name"] == "transverse_mercator"
    assert attributes["longitude_of_central_meridian"] == 9.0
    assert attributes["geopotential_datum_name"] == "EGM96 geoid"
    assert is_same_vertical(attributes["crs_wkt"], "EPSG:32632+5773")


# what a programme may use


@pytest.mark.parametrize(
    "text", ["EPSG:32632", "EPSG:32632+5773", "EPSG:32632+4979", "EPSG:2193", "EPSG:3031", LOCAL_TM, SITE_DATUM]
)
def test_projected_crs_in_metres_suit_a_programme(text: str) -> None:
    assert check_programme_crs(f"  {text} ") == text


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("EPSG:4326", "is geographic"),
        ("EPSG:4979", "is geographic"),
        ("EPSG:4978", "is geocentric"),
        ("EPSG:5773", "is vertical alone"),
        ("EPSG:2263", "is in US survey foot"),
        ("EPSG:2263+5703", "is in US survey foot"),
        ("EPSG:2048", "axes that point south and west"),
        ("EPSG:3857", "Web Mercator"),
        ('LOCAL_CS["site",UNIT["metre",1]]', "local system without a place"),
    ],
)
def test_a_programme_in_another_kind_of_crs_is_refused_with_the_fix(text: str, why: str) -> None:
    with pytest.raises(CRSMismatchError, match=rf"{why}.*EPSG:32") as caught:
        check_programme_crs(text)
    assert caught.value.exit_code == 65


@pytest.mark.parametrize("text", ["EPSG:26918+6360", "EPSG:32632+5715"])
def test_a_programme_with_heights_in_feet_or_depths_is_refused(text: str) -> None:
    with pytest.raises(VerticalDatumError, match="must be in metres, counted upwards"):
        check_programme_crs(text)


# transformations


@pytest.mark.parametrize("text", ["EPSG:32632", "EPSG:32632+5773", "EPSG:32632+4979", SITE_DATUM])
def test_the_same_crs_is_the_identity_without_a_copy(text: str) -> None:
    given = points((5e5, 5e6, 1.0), (np.nextafter(5e5, 6e5), 5e6, np.pi))
    transform = make_transform(text, to_wkt(text))
    result = transform(*given)
    assert transform.is_identity
    assert transform.operation == "identity"
    assert all(new is old for new, old in zip(result, given, strict=True))


def test_longitude_latitude_and_ellipsoidal_height_reach_utm() -> None:
    """On the central meridian easting is 500 km and northing the scaled meridian arc (Snyder 1987, eq. 3-21)."""
    given = points((9.0, 48.0, 300.0), (9.01, 48.0, -20.0))
    easting, northing, elevation = make_transform("EPSG:4979", "EPSG:32632+4979")(*given)
    assert_allclose(easting[0], 500_000.0, rtol=0, atol=1e-6)
    assert_allclose(northing[0], 0.9996 * _meridian_arc(48.0), rtol=0, atol=1e-4)
    np.testing.assert_array_equal(elevation, [300.0, -20.0])
    assert easting[1] > easting[0]


def _meridian_arc(latitude_deg: float) -> float:
    a, f = 6378137.0, 1 / 298.257223563
    e2, phi = f * (2 - f), np.radians(latitude_deg)
    latitudes = np.linspace(0.0, phi, 200_001)
    return float(np.trapezoid(a * (1 - e2) / (1 - e2 * np.sin(latitudes) ** 2) ** 1.5, latitudes))


def test_transforming_there_and_back_returns_the_points() -> None:
    rng = np.random.default_rng(3)
    given = (rng.uniform(4e5, 6e5, 500), rng.uniform(5e6, 5.2e6, 500), rng.uniform(0, 900, 500))
    there = make_transform("EPSG:32632+5773", "EPSG:32633+5773")(*given)
    back = make_transform("EPSG:32633+5773", "EPSG:32632+5773")(*there)
    assert np.abs(there[0] - given[0]).max() > 1e5
    for new, old in zip(back, given, strict=True):
        assert_allclose(new, old, rtol=0, atol=1e-6)


def test_inputs_are_never_modified() -> None:
    given = points((9.0, 48.0, 300.0), (9.5, 48.5, 1.0))
    copies = [values.copy() for values in given]
    make_transform("EPSG:4979", "EPSG:32632+4979")(*given)
    make_transform("EPSG:4326+6360", "EPSG:4326+5703")(*given)
    for values, copy in zip(given, copies, strict=True):
        np.testing.assert_array_equal(values, copy)


def test_no_points_transform_to_no_points() -> None:
    empty = np.empty(0)
    assert [v.size for v in make_transform("EPSG:4326", "EPSG:32632")(empty, empty, empty)] == [0, 0, 0]


def test_levelled_heights_stay_when_only_the_horizontal_crs_changes() -> None:
    _, _, elevation = make_transform("EPSG:4326+5773", "EPSG:32632+5773")(*points((9.0, 48.0, 123.456)))
    np.testing.assert_array_equal(elevation, [123.456])


def test_us_survey_feet_become_metres_along_all_axes() -> None:
    """New York Long Island: the false easting is 300 km, and the latitude of origin lies at northing 0."""
    transform = make_transform("EPSG:2263+6360", "EPSG:32118+5703")  # the same grid in feet and in metres
    easting, northing, elevation = transform(*points((984250.0, 0.0, 100.0), (1_000_000.0, 200_000.0, -3.0)))
    assert_allclose(easting, [300_000.0, 1e6 * US_FOOT], rtol=0, atol=1e-5)
    assert_allclose(northing, [0.0, 2e5 * US_FOOT], rtol=0, atol=1e-5)
    assert_allclose(elevation, [100 * US_FOOT, -3 * US_FOOT], rtol=1e-15, atol=0)
    assert "heights times 0.3048006" in transform.operation


def test_feet_in_height_alone_are_converted() -> None:
    transform = make_transform("EPSG:26918+8228", "EPSG:26918+5703")  # international feet
    easting, _, elevation = transform(*points((5e5, 4.5e6, 10.0)))
    assert easting[0] == 5e5
    assert_allclose(elevation, [3.048], rtol=1e-15, atol=0)


def test_depths_become_heights() -> None:
    _, _, elevation = make_transform("EPSG:32632+5715", "EPSG:32632+5714")(*points((5e5, 5e6, 12.5)))
    np.testing.assert_array_equal(elevation, [-12.5])


@pytest.mark.parametrize("target", ["EPSG:26918", "EPSG:26918+5703"])
def test_a_source_in_feet_that_is_silent_on_heights_is_refused(target: str) -> None:
    with pytest.raises(VerticalDatumError, match=r"US survey foot .* --crs EPSG:2263\+6360"):
        make_transform("EPSG:2263", target)


def test_an_offset_between_datums_that_is_exactly_known_is_applied() -> None:
    """Baltic 1977 height to Black Sea height is defined as +0.4 m (EPSG operation 5447)."""
    _, _, elevation = make_transform("EPSG:32638+5705", "EPSG:32638+5735")(*points((5e5, 4.6e6, 300.0)))
    assert_allclose(elevation, [300.4], rtol=0, atol=1e-9)


def test_a_regional_mean_between_datums_is_too_inaccurate() -> None:
    with pytest.raises(VerticalDatumError, match=r"0\.2 m accurate .* --crs EPSG:25832\+7837"):
        make_transform("EPSG:25832+5783", "EPSG:25832+7837")


def test_frames_that_are_only_nominally_alike_do_not_carry_ellipsoidal_heights() -> None:
    with pytest.raises(VerticalDatumError, match=r"1 m accurate .* state it: --crs EPSG:4937\."):
        make_transform("EPSG:4979", "EPSG:25832+4937")


def test_unrelated_vertical_datums_are_refused() -> None:
    with pytest.raises(VerticalDatumError, match=r"'Quarry heights'.*'EGM96 height'.* knows no transformation"):
        make_transform(SITE_DATUM, "EPSG:32632+5773")


def test_a_missing_geoid_grid_is_named_with_the_command_that_installs_it() -> None:
    with pytest.raises(VerticalDatumError, match=r"pyproj sync --file us_nga_egm96_15\.tif"):
        make_transform("EPSG:4979", "EPSG:32632+5773")
    with pytest.raises(VerticalDatumError, match="us_nga_egm96_15"):
        check_compatible("EPSG:32632+5773", "EPSG:32632+4979")


@pytest.mark.parametrize(
    ("source", "target", "fix"),
    [
        ("EPSG:26917", "EPSG:26917+5713", r"--crs EPSG:26917\+5713"),
        ("EPSG:4326", "EPSG:26917+5713", r"--crs EPSG:4326\+5713"),
        ("EPSG:26917+5713", "EPSG:26917", r"--crs EPSG:26917\+5713, or .* --crs EPSG:26917\."),
        ("EPSG:32632", "EPSG:32632+4979", r"--crs EPSG:32632\+4979"),
        (UNKNOWN_DATUM, "EPSG:32632+5773", r"--crs EPSG:32632\+5773"),
    ],
)
def test_heights_declared_on_one_side_only_are_refused_with_the_option(source: str, target: str, fix: str) -> None:
    with pytest.raises(VerticalDatumError, match=fix):
        check_compatible(source, target)


def test_heights_declared_nowhere_are_kept_with_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            _, _, elevation = make_transform("EPSG:25832", "EPSG:25833")(*points((5e5, 5e6, 1.25)))
    np.testing.assert_array_equal(elevation, [1.25])
    warned = [record for record in caplog.records if "declares a vertical datum" in record.getMessage()]
    assert len(warned) == 1


def test_declared_heights_give_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        make_transform("EPSG:32632+5773", "EPSG:32632+5773")
    assert not caplog.records


def test_a_datum_shift_is_applied_and_its_accuracy_logged(caplog: pytest.LogCaptureFixture) -> None:
    """GDA94 to GDA2020 moves Australia by about 1.8 m to the north-east; a ballpark operation would not."""
    given = points((300_000.0, 5_800_000.0, 1.0))
    easting, northing, _ = make_transform("EPSG:28355", "EPSG:7855")(*given)
    assert_allclose(np.hypot(easting - 300_000.0, northing - 5_800_000.0), 1.55, rtol=0, atol=0.05)
    with caplog.at_level(logging.WARNING):
        make_transform("EPSG:32617+5713", "EPSG:26917+5713")
    assert "accuracy of 4 m" in caplog.text


def test_a_ballpark_operation_is_refused() -> None:
    with pytest.raises(CRSMismatchError, match=r"cannot be transformed .* --crs EPSG:2958"):
        make_transform("EPSG:26917", "EPSG:2958")


def test_a_missing_datum_grid_is_named() -> None:
    with pytest.raises(CRSMismatchError, match=r"us_noaa_nadcon5_nad83_1986_nad83_harn_conus\.tif"):
        make_transform("EPSG:26912", "EPSG:6404")


def test_a_horizontal_operation_of_nine_metres_is_refused_where_it_would_be_used() -> None:
    with pytest.raises(CRSMismatchError, match=r"only 9 m accurate.*pyproj sync --file"):
        make_transform("EPSG:4267", "EPSG:32617")(*points((-79.3, 43.6, 80.0)))


def test_a_moving_frame_needs_the_epoch_of_the_coordinates() -> None:
    """ITRF2014 to ETRS89: Europe moves 2.5 cm a year, 0.24 m from 2015 to 2024.5 [1].

    [1] Altamimi (2018), EUREF Technical Note 1, eq. for time-dependent parameters.
    """
    given = points((9.0, 48.0, 1.0))
    with pytest.raises(CRSMismatchError, match="depends on the epoch"):
        make_transform("EPSG:9000", "EPSG:25832")(*given)
    at = {
        year: np.array(make_transform("EPSG:9000", "EPSG:25832", coordinate_epoch=year)(*given))[:2, 0]
        for year in (2015.0, 2024.5)
    }
    assert_allclose(np.hypot(*(at[2024.5] - at[2015.0])), 0.0247 * 9.5, rtol=0, atol=0.01)


def test_points_outside_the_domain_are_counted_and_the_first_is_named() -> None:
    with pytest.raises(
        InputDataError, match=r"2 of 3 points cannot be transformed .* first at point 1: \(9\.0, 95\.0\)"
    ):
        make_transform("EPSG:4326", "EPSG:32632")(*points((9.0, 48.0, 0), (9.0, 95.0, 0), (8.0, -91.0, 0)))


@pytest.mark.parametrize("text", ["EPSG:4978", "EPSG:5773", 'LOCAL_CS["site",UNIT["metre",1]]'])
def test_a_source_without_horizontal_place_is_refused(text: str) -> None:
    with pytest.raises(CRSMismatchError, match=r"geocentric|vertical alone|local system"):
        check_compatible(text, "EPSG:32632")


def test_a_datum_shift_bound_to_a_proj_string_is_applied() -> None:
    bound = "+proj=utm +zone=32 +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7 +units=m"
    easting, northing, _ = make_transform(bound, "EPSG:32632")(*points((5e5, 5.4e6, 1.0)))
    assert 50 < np.hypot(easting[0] - 5e5, northing[0] - 5.4e6) < 1000
    assert make_transform(bound, bound).is_identity
    assert check_programme_crs(bound) == bound


def test_a_transform_travels_between_processes() -> None:
    transform = make_transform("EPSG:4979", "EPSG:32632+4979")
    given = points((9.0, 48.0, 300.0))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(transform))(*given), transform(*given))


def test_the_network_stays_off() -> None:
    make_transform("EPSG:4979", "EPSG:32632+4979")
    assert not pyproj.network.is_network_enabled()


def test_an_installed_geoid_grid_is_used(tmp_path: Path) -> None:
    """A grid with a constant undulation of 47.25 m under the name of EGM96: heights drop by just that."""
    folder = tmp_path / "grids"
    folder.mkdir()
    with rasterio.open(
        folder / "us_nga_egm96_15.tif",
        "w",
        driver="GTiff",
        width=41,
        height=41,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=rasterio.Affine(0.25, 0, 4.0, 0, -0.25, 53.0),
    ) as dataset:
        dataset.write(np.full((1, 41, 41), 47.25, np.float32))
        dataset.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
        dataset.set_band_description(1, "geoid_undulation")
        dataset.set_band_unit(1, "metre")
    program = (
        "import json, numpy as np\n"
        "from changedetect.crs import make_transform\n"
        "t = make_transform('EPSG:4979', 'EPSG:32632+5773')\n"
        "there = t(np.array([9.0]), np.array([48.0]), np.array([300.0]))\n"
        "back = make_transform('EPSG:32632+5773', 'EPSG:4979')(*there)\n"
        "print(json.dumps([[float(v[0]) for v in there], [float(v[0]) for v in back]]))\n"
    )
    root = str(Path(crs_module.__file__).parents[2])
    run = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PROJ_USER_WRITABLE_DIRECTORY": str(folder), "PYTHONPATH": root},
    )
    assert run.returncode == 0, run.stderr
    there, back = json.loads(run.stdout)
    assert_allclose(there[2], 252.75, rtol=0, atol=1e-6)
    assert_allclose(back, [9.0, 48.0, 300.0], rtol=0, atol=1e-8)
