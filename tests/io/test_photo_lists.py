"""Lists of places beside photos: geo.txt of OpenDroneMap, DJI's Timestamp.MRK, photos.csv."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.crs import make_transform
from changedetect.errors import InputDataError
from changedetect.io.mrk import places_of_photos, read_mrk
from changedetect.io.odm import read_geo
from changedetect.io.photo_metadata import ELLIPSOID, HORIZON, NADIR, SEA_LEVEL
from changedetect.io.photo_table import read_photo_table

#: As OpenDroneMap's documentation gives it, with a comment and a line without height.
GEO = """EPSG:4326
# image geo_x geo_y geo_z yaw pitch roll horz_accuracy vert_accuracy
DJI_0028.JPG\t-91.9942096111111\t46.84252125\t198.609
DJI_0032.JPG -91.9938293055556 46.8424584444444 198.609 42.0 nan nan nan nan

DJI_0033.JPG -91.99370269444 46.842543250 198.5 42.9 0.1 -0.4 1.2 2.5
DJI_0034.JPG -91.99357866666 46.842629277
"""

#: Lines of a Phantom 4 RTK (first) and of a Mavic 3 Enterprise, fields divided by tabs.
MRK = (
    "1\t400373.488877\t[2264]\t   -40,N\t     0,E\t    86,V\t44.42824637,Lat\t1.26196331,Lon\t359.494,Ellh\t"
    "0.028, 0.031, 0.055\t16,Q\n"
    "2\t400376.288311\t[2264]\t   -38,N\t   -11,E\t    85,V\t44.42833145,Lat\t1.26197012,Lon\t359.501,Ellh\t"
    "0.012012, 0.011876, 0.026012\t50,Q\n"
    "12\t400379.688311\t[2264]\t    38,N\t    11,E\t    85,V\t1.26198012,Lon\t44.42841145,Lat\t359.511,Ellh\t"
    "0.012012, 0.011876, 0.026012\t50,Q\n"
)


def test_geo_gives_places_and_what_else_is_there(tmp_path):
    (tmp_path / "geo.txt").write_text(GEO)
    places = read_geo(tmp_path / "geo.txt")
    assert list(places) == ["DJI_0028.JPG", "DJI_0032.JPG", "DJI_0033.JPG", "DJI_0034.JPG"]
    first, second, third, last = places.values()
    assert (first.latitude, first.longitude, first.height) == (46.84252125, -91.9942096111111, 198.609)
    assert (first.angles, first.std) == (None, None)
    assert second.angles is None
    assert (third.angles, third.angles_from, third.std) == ((42.9, 0.1, -0.4), NADIR, (1.2, 1.2, 2.5))
    assert last.height is None


def test_geo_in_map_coordinates_is_turned_into_degrees(tmp_path):
    transform = make_transform("EPSG:4979", "EPSG:32615+4979")
    east, north, up = transform(np.array([-91.994]), np.array([46.842]), np.array([200.0]))
    for crs in ("EPSG:32615", "+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs", "EPSG:32615+4979"):
        (tmp_path / "geo.txt").write_text(f"{crs}\na.jpg {east[0]:.4f} {north[0]:.4f} {up[0]:.3f}\n")
        place = read_geo(tmp_path / "geo.txt")["a.jpg"]
        assert_allclose([place.latitude, place.longitude, place.height], [46.842, -91.994, 200.0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:4326\n", r"geo\.txt holds no photos"),
        ("EPSG:4326\na.jpg 9\n", r"geo\.txt, line 2: 2 fields"),
        ("EPSG:4326\n\na.jpg 9 x 3\n", r"geo\.txt, line 3: could not convert"),
        ("EPSG:4326\na.jpg nan 48 3\n", r"geo\.txt, line 2: the position nan 48 is not finite"),
        ("EPSG:4326\na.jpg 9 48 3\na.jpg 9 48 4\n", r"geo\.txt, line 3: a\.jpg is listed twice"),
        ("a.jpg 9 48 3\nb.jpg 9 48 4\n", r"a\.jpg 9 48 3"),
    ],
)
def test_geo_that_cannot_be_read_is_named_with_its_line(tmp_path, text, message):
    (tmp_path / "geo.txt").write_text(text)
    with pytest.raises(InputDataError, match=message):
        read_geo(tmp_path / "geo.txt")


def test_mrk_is_read_by_its_labels(tmp_path):
    path = tmp_path / "100_0001_Timestamp.MRK"
    path.write_text(MRK)
    first, second, last = read_mrk(path)
    assert (first.number, first.latitude, first.longitude, first.height) == (1, 44.42824637, 1.26196331, 359.494)
    assert (last.latitude, last.longitude) == (44.42841145, 1.26198012)  # swapped in the line
    assert first.std == (0.031, 0.028, 0.055)
    assert_allclose(first.lever_arm, [0.0, -0.040, -0.086], rtol=0, atol=1e-12)
    assert (first.fix, second.fix) == (16, 50)
    assert_allclose(first.time, 315964800 + 2264 * 604800 + 400373.488877, rtol=0, atol=1e-6)


def test_mrk_entries_go_to_photos_by_their_number(tmp_path, caplog):
    path = tmp_path / "Timestamp.MRK"
    path.write_text(MRK)
    names = ["DJI_20230531101112_0012_V.JPG", "100_0001_0002.JPG", "DJI_0001.JPG"]
    places = places_of_photos(path, read_mrk(path), names)
    assert places[names[0]].latitude == 44.42841145
    assert places[names[1]].std == (0.011876, 0.012012, 0.026012)
    assert places[names[2]].height_above == ELLIPSOID
    assert "1 of 3 positions are without corrections (DJI_0001.JPG)" in caplog.text
    by_order = places_of_photos(path, read_mrk(path), ["c.jpg", "a.jpg", "b.jpg"])
    assert by_order["b.jpg"].latitude == 44.42833145
    with pytest.raises(InputDataError, match=r"has 3 entries \(photos 1 to 12\) and none for DJI_0007\.JPG"):
        places_of_photos(path, read_mrk(path), ["DJI_0001.JPG", "DJI_0007.JPG"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Lat", "Lot", r"MRK, line 1: no latitude in"),
        ("0.028, 0.031, 0.055", "", r"MRK, line 1: no standard deviations"),
        ("44.42824637,Lat", "144.42824637,Lat", r"MRK, line 1: 144\.4\d+, 1\.26\d+ is not latitude"),
        ("2\t400376", "1\t400376", r"MRK: photo number 1 occurs twice"),
        ("1\t400373.488877", "one\t400373.488877", r"MRK, line 1: 'one' '400373.488877' are not"),
        (MRK, "\n", r"MRK is empty"),
    ],
)
def test_mrk_that_cannot_be_read_is_named_with_its_line(tmp_path, old, new, message):
    path = tmp_path / "Timestamp.MRK"
    path.write_text(MRK.replace(old, new, 1))
    with pytest.raises(InputDataError, match=message):
        read_mrk(path)


def test_a_table_names_its_columns_with_units(tmp_path):
    path = tmp_path / "photos.csv"
    path.write_text(
        "photo,lat_deg,lon_deg,alt_msl_m,yaw_deg,pitch_deg,roll_deg,sigma_h_m,sigma_v_m,sigma_yaw_deg,sigma_tilt_deg,time_s\n"
        "a.jpg,48,9,300,10,1,-1,0.5,,4,1,12.5\nb.jpg,48.1,9,,,,,,,,,\n"
    )
    first, second = read_photo_table(path).values()
    assert (first.height, first.height_above, first.std) == (300.0, SEA_LEVEL, (0.5, 0.5, 0.75))
    assert (first.angles, first.angles_from, first.angles_std) == ((10.0, 1.0, -1.0), NADIR, (4.0, 1.0, 1.0))
    assert first.time == 12.5
    assert (second.height, second.std, second.angles, second.time) == (None, None, None, None)
    path.write_text("photo,lat_deg,lon_deg,alt_m,gimbal_yaw_deg,gimbal_pitch_deg,gimbal_roll_deg\na,48,9,300,1,-90,0\n")
    assert read_photo_table(path)["a"].angles_from == HORIZON


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("photo,lat_deg,lon_deg,alt_m\na,48,9,1\na,48,9,1\n", r"photos\.csv: a is listed twice"),
        ("photo,lat_deg,lon_deg,alt_m\na,151,-33,1\n", r"line 2: latitude 151\.0.* not degrees"),
        ("photo,lat_deg,lon_deg,alt_m,yaw_deg\na,48,9,1,3\n", r"no column pitch_deg, roll_deg"),
        ("photo,lat_deg,lon_deg\na,48,9\n", r"needs one of the columns alt_m"),
        ("photo,lat_deg,lon_deg,alt_m\na,48,east,1\n", r"line 2, column lon_deg: 'east'"),
    ],
)
def test_tables_that_cannot_be_read_are_named(tmp_path, text, message):
    (tmp_path / "photos.csv").write_text(text)
    with pytest.raises(InputDataError, match=message):
        read_photo_table(tmp_path / "photos.csv")
