"""Photos: whole, missing, damaged, of another size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError, MissingInputError
from changedetect.io.images import PhotoFiles, photo_size


@pytest.fixture
def photos(tmp_path):
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{k}.jpg" for k in range(3)] + [tmp_path / "3.png"]
    for path in paths:
        cv2.imwrite(str(path), cv2.resize(rng.integers(0, 255, (12, 16), dtype=np.uint8), (64, 48)))
    return paths


def test_photos_come_as_grey_arrays_and_are_kept(photos):
    files = PhotoFiles(photos, (64, 48))
    assert len(files) == 4
    assert files(3).shape == (48, 64)
    assert files(3).dtype == np.uint8
    assert files(3) is files(3)
    assert_allclose(files(3), cv2.imread(str(photos[3]), cv2.IMREAD_GRAYSCALE), rtol=0, atol=0)


def test_the_orientation_flag_for_screens_is_ignored(photos):
    data = photos[0].read_bytes()
    # EXIF with one entry, orientation 6: shown turned by 90 degrees
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    segment = b"Exif\0\0" + tiff
    photos[1].write_bytes(data[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + data[2:])
    assert cv2.imread(str(photos[1])).shape[:2] == (64, 48)  # OpenCV itself would turn it
    assert_allclose(PhotoFiles(photos, (64, 48))(1), PhotoFiles(photos, (64, 48))(0), rtol=0, atol=0)


def test_missing_photos_are_named(photos, tmp_path):
    photos[1].unlink()
    with pytest.raises(MissingInputError, match=r"1 of 4 photos do not exist.*1\.jpg"):
        PhotoFiles(photos, (64, 48))


def test_a_truncated_photo_is_named(photos):
    data = photos[2].read_bytes()
    photos[2].write_bytes(data[: len(data) // 2])
    files = PhotoFiles(photos, (64, 48))
    with pytest.raises(InputDataError, match=r"2\.jpg is truncated"):
        files(2)


def test_a_file_that_is_no_picture_is_named(photos):
    photos[2].write_bytes(b"not a picture")
    with pytest.raises(InputDataError, match=r"2\.jpg cannot be read as a picture"):
        PhotoFiles(photos, (64, 48))


def test_photos_of_another_size_than_the_camera_file_are_refused(photos):
    assert photo_size(photos[0]) == (64, 48)
    with pytest.raises(InputDataError, match=r"0\.jpg is 64 x 48 pixels, but camera\.yaml states 128 x 96"):
        PhotoFiles(photos, (128, 96), "camera.yaml")
    with pytest.raises(InputDataError, match="turned by 90 degrees"):
        PhotoFiles(photos, (48, 64))
