"""Lens models, against OpenCV and by the laws of their conversions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.errors import InputDataError
from changedetect.kernels.projection import distort
from changedetect.navigation.camera import CameraIntrinsics
from changedetect.photogrammetry.lens import (
    MetashapeCalibration,
    from_colmap,
    from_metashape,
    intrinsics_array,
    normalise,
    rays,
    to_colmap,
    to_metashape,
    with_calibration,
)

WIDE = CameraIntrinsics(4000, 3000, 2300.0, 2310.0, 2011.0, 1490.0, -0.21, 0.06, 0.0007, -0.0011, -0.008)


def some_pixels(n=200, seed=0):
    return np.random.default_rng(seed).uniform([0, 0], [4000, 3000], (n, 2))


def test_distortion_agrees_with_opencv():
    flat = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))
    points = np.column_stack([flat, np.ones(len(flat))])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), WIDE.matrix, WIDE.distortion)[0][:, 0]
    found = np.array([distort(x, y, intrinsics_array(WIDE)) for x, y in flat])
    assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_undistorting_reverses_distorting():
    pixels = some_pixels()
    flat = normalise(pixels, intrinsics_array(WIDE))
    back = np.array([distort(x, y, intrinsics_array(WIDE)) for x, y in flat])
    assert_allclose(back, pixels, rtol=0, atol=1e-7)


def test_rays_are_unit_vectors_turned_into_the_ground_frame():
    turn = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    direction = rays(np.array([[WIDE.cx, WIDE.cy]]), turn, intrinsics_array(WIDE))
    assert_allclose(direction, [[0, 0, -1]], rtol=0, atol=1e-12)
    assert_allclose(np.linalg.norm(rays(some_pixels(), turn, intrinsics_array(WIDE)), axis=1), 1, rtol=1e-12, atol=0)


def test_colmap_counts_half_a_pixel_more_and_comes_back():
    camera = CameraIntrinsics(100, 80, 90.0, 91.0, 49.0, 39.5, 0.1, -0.02, 0.001, 0.002)
    model, parameters = to_colmap(camera)
    assert model == "OPENCV"
    assert_allclose(parameters[2:4], [49.5, 40.0], rtol=0, atol=0)
    assert from_colmap(model, 100, 80, parameters) == camera


def test_colmap_models_with_one_focal_length_are_read():
    camera = from_colmap("SIMPLE_RADIAL", 100, 80, np.array([90.0, 50.0, 40.0, 0.1]))
    assert (camera.fx, camera.fy, camera.cx, camera.k1) == (90.0, 90.0, 49.5, 0.1)


def test_colmap_models_that_cannot_be_expressed_are_refused():
    with pytest.raises(InputDataError, match=r"FISHEYE.*SIMPLE_PINHOLE"):
        from_colmap("FISHEYE", 10, 10, np.zeros(4))
    with pytest.raises(InputDataError, match=r"8 parameters.*4 given"):
        from_colmap("OPENCV", 10, 10, np.zeros(4))
    with pytest.raises(InputDataError, match="no k3"):
        to_colmap(WIDE)


def test_metashape_counts_from_the_middle_swaps_the_decentring_and_comes_back():
    calibration = to_metashape(WIDE)
    assert_allclose([calibration.cx, calibration.cy], [2011.0 - 1999.5, 1490.0 - 1499.5], rtol=0, atol=1e-12)
    assert (calibration.p1, calibration.p2) == (WIDE.p2, WIDE.p1)
    assert from_metashape(calibration) == WIDE


def test_metashape_skew_is_refused():
    with pytest.raises(InputDataError, match=r"b2 = 0\.3"):
        from_metashape(MetashapeCalibration(10, 10, 9.0, b2=0.3))


def test_calibration_corrections_scale_both_focal_lengths():
    moved = with_calibration(WIDE, np.array([0.01, 1.0, -2.0, 0.001, 0.002, 0.003, 0.0001, -0.0002, 0.004]))
    assert_allclose(moved.fx / WIDE.fx, np.exp(0.012), rtol=1e-12, atol=0)
    assert_allclose(moved.fy / WIDE.fy, np.exp(0.008), rtol=1e-12, atol=0)
    assert_allclose([moved.cx, moved.cy, moved.k1, moved.k2], [2012.0, 1488.0, -0.209, 0.062], rtol=1e-12, atol=0)
    assert_allclose([moved.p1, moved.p2, moved.k3], [0.0008, -0.0013, -0.005], rtol=1e-12, atol=0)
