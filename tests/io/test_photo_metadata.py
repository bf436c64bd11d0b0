"""EXIF and XMP of photos: every maker's names, units and conventions, as in their files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import photo_samples as samples
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.photo_metadata import ELLIPSOID, HORIZON, NADIR, SEA_LEVEL, read_photo_metadata

DATA = Path(os.environ.get("CHANGEDETECT_DATA", "../shared/data"))


def test_dji_photos_give_place_angles_of_the_gimbal_and_no_trusted_level(tmp_path):
    path = samples.write_photo(
        tmp_path / "a.jpg", latitude=46.842607083, longitude=-91.994559889, altitude=198.309, xmp=samples.dji()
    )
    found = read_photo_metadata(path)
    assert (found.width, found.height, found.camera) == (160, 90, "DJI FC300S")
    assert_allclose([found.latitude, found.longitude], [46.842607083, -91.994559889], rtol=0, atol=1e-9)
    assert found.angles == (45.0, -89.9, 0.0)
    assert found.angles_from == HORIZON
    assert (found.altitude, found.altitude_above, found.relative_altitude) == (198.31, None, 39.8)
    assert found.time == 1466699519.0
    assert found.position_std is None


def test_rtk_positions_of_dji_have_their_own_accuracy_and_count_from_the_ellipsoid(tmp_path):
    extra = samples.RTK.format(latitude=-33.890123456, longitude=151.190987654)
    path = samples.write_photo(tmp_path / "a.jpg", latitude=-33.89, longitude=151.19, xmp=samples.dji(extra=extra))
    found = read_photo_metadata(path)
    assert_allclose([found.latitude, found.longitude], [-33.890123456, 151.190987654], rtol=0, atol=1e-12)
    assert found.position_std == (0.01254, 0.01132, 0.02551)
    assert found.altitude_above == ELLIPSOID


def test_pix4d_tags_count_pitch_from_nadir_and_state_accuracies(tmp_path):
    xmp = samples.PIX4D.format(yaw="12.5", pitch="-150/100", roll="0.25")
    path = samples.write_photo(tmp_path / "a.jpg", latitude=-10.0, longitude=20.0, altitude=300, xmp=xmp)
    found = read_photo_metadata(path)
    assert found.angles == (12.5, -1.5, 0.25)
    assert found.angles_from == NADIR
    assert found.angles_std == (4.5, 1.5, 1.5)
    assert found.position_std == (1.7, 1.7, 2.6)
    assert (found.altitude, found.altitude_above) == (300.0, SEA_LEVEL)
    assert_allclose([found.latitude, found.longitude], [-10.0, 20.0], rtol=0, atol=1e-9)


def test_parrot_counts_from_the_horizon_and_sensefly_from_nadir(tmp_path):
    found = read_photo_metadata(samples.write_photo(tmp_path / "a.jpg", xmp=samples.PARROT))
    assert (found.angles, found.angles_from) == ((121.7, -89.6, 0.3), HORIZON)
    found = read_photo_metadata(samples.write_photo(tmp_path / "b.jpg", xmp=samples.SENSEFLY))
    assert_allclose(found.angles, [60.58016014, 0.7250059843, -3.4277398585], rtol=0, atol=1e-9)
    assert found.angles_from == NADIR
    assert (found.altitude_above, found.relative_altitude) == (ELLIPSOID, 71.865234375)
    assert_allclose(found.altitude, 283.8970032, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("reference", "altitude", "above"),
    [(0, 12.5, SEA_LEVEL), (1, -12.5, SEA_LEVEL), (2, 12.5, ELLIPSOID), (3, -12.5, ELLIPSOID)],
)
def test_the_reference_of_the_altitude_is_heeded(tmp_path, reference, altitude, above):
    path = samples.write_photo(tmp_path / "a.jpg", latitude=1, longitude=2, altitude=12.5, altitude_ref=reference)
    found = read_photo_metadata(path)
    assert (found.altitude, found.altitude_above) == (altitude, above)


def test_focal_lengths_are_in_pixels_of_the_picture_as_it_is(tmp_path):
    def focal(**fields):
        return read_photo_metadata(samples.write_photo(tmp_path / "a.jpg", **fields)).focal

    full = np.hypot(160, 120) / np.hypot(36, 24)  # 16:9 is cut from 4:3
    assert_allclose(focal(), 20 * full, rtol=1e-9, atol=0)
    square = np.zeros((120, 160), np.uint8)
    assert_allclose(focal(grey=square), 20 * full, rtol=1e-9, atol=0)
    # 16393.443 pixels an inch and 4.3 mm on 4000 pixels, shrunk to 160
    assert_allclose(
        focal(focal=4.3, plane=16393.443, full_width=4000), 4.3 * 16393.443 / 25.4 * 0.04, rtol=1e-5, atol=0
    )
    calibrated = 'drone-dji:CalibratedFocalLength="3666.666504"'
    assert_allclose(
        focal(full_width=5472, xmp=samples.dji(extra=calibrated)), 3666.666504 * 160 / 5472, rtol=1e-9, atol=0
    )
    assert focal(focal35=None, focal=None) is None


def test_what_a_photo_does_not_say_is_none(tmp_path):
    path = samples.write_photo(tmp_path / "a.jpg", time=None, focal35=0, focal=None, make="", model="")
    found = read_photo_metadata(path)
    assert (found.time, found.latitude, found.altitude, found.angles, found.focal, found.camera) == (*[None] * 5, "")


def test_a_receiver_without_a_fix_writes_zeros_which_are_no_place(tmp_path):
    found = read_photo_metadata(samples.write_photo(tmp_path / "a.jpg", latitude=0.0, longitude=0.0))
    assert found.latitude is None


def test_fractions_of_a_second_and_positioning_errors_are_read(tmp_path):
    path = samples.write_photo(tmp_path / "a.jpg", latitude=1, longitude=2, subsecond="250", h_error=4.2)
    found = read_photo_metadata(path)
    assert found.time == 1466699519.25
    assert_allclose(found.position_std, [4.2, 4.2, 6.3], rtol=1e-9, atol=0)


def test_files_that_are_no_pictures_and_damaged_xmp_are_named(tmp_path):
    with pytest.raises(MissingInputError, match=r"No such photo: .*nothing\.jpg"):
        read_photo_metadata(tmp_path / "nothing.jpg")
    (tmp_path / "text.jpg").write_text("no picture")
    with pytest.raises(InputDataError, match=r"text\.jpg cannot be read as a picture"):
        read_photo_metadata(tmp_path / "text.jpg")
    path = samples.write_photo(tmp_path / "a.jpg", xmp="<x:xmpmeta>")
    with pytest.raises(InputDataError, match=r"a\.jpg: its XMP is damaged"):
        read_photo_metadata(path)


def test_xmp_that_would_blow_up_is_refused(tmp_path):
    bomb = '<!DOCTYPE a [<!ENTITY b "bbbb"><!ENTITY c "&b;&b;&b;">]><a>&c;</a>'
    with pytest.raises(InputDataError, match="XMP is damaged"):
        read_photo_metadata(samples.write_photo(tmp_path / "a.jpg", xmp=bomb))


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "angles", "above"),
    [
        ("uav_brighton_beach/images/DJI_0024.JPG", (-140.0, -89.9, 0.0), None),
        ("uav_seneca/images/IMG_0501.jpg", (49.77978897, 8.687478065, -2.111712933), ELLIPSOID),
    ],
)
def test_real_photos_say_what_their_lists_say(name, angles, above):
    if not (DATA / name).is_file():
        pytest.skip(f"{name} is not in {DATA}; set CHANGEDETECT_DATA")
    found = read_photo_metadata(DATA / name)
    assert_allclose(found.angles, angles, rtol=0, atol=1e-9)
    assert found.altitude_above == above
