"""Simulated flights with photos: what they show is what the truth says."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from changedetect.kernels.rendering import look
from changedetect.navigation.poses import CameraPoses
from changedetect.photogrammetry.block import ImageBlock
from changedetect.synthetic.flight_photos import FlightDesign, fly_programme, undistorted
from changedetect.synthetic.flight_scene import CELL, FlightChange, draw_scene, scene_nodes

SMALL = FlightDesign(n_strips=2, n_photos=4, size=(240, 200), bend=0.0, pixel_noise=0.0)


@pytest.fixture(scope="module")
def flown():
    return fly_programme(SMALL, seed=4)


def test_changes_lie_in_the_ground_many_photos_see_and_apart_from_each_other():
    east, north = scene_nodes(60.0, 60.0, CELL)
    views = np.where((np.abs(east) < 25) & (np.abs(north) < 30), 5, 3)
    for seed in range(8):
        scene = draw_scene(60.0, 60.0, views, 0.3, seed=seed)
        assert {c.kind for c in scene.changes} == {"mound", "pit", "plateau", "paint"}
        for k, one in enumerate(scene.changes):
            assert views[one.is_inside(east, north)].min() == 5
            for other in scene.changes[k + 1 :]:
                assert np.hypot(one.east - other.east, one.north - other.north) > one.radius + other.radius


def test_the_first_epoch_has_no_change_and_objects_stand_away_from_changes(flown):
    scene = flown[0].scene
    assert not np.any(scene.change(0))
    east, north = scene.nodes(CELL)
    for change in scene.changes:
        assert not np.any(scene.objects[change.is_inside(east, north)])
    assert_allclose(scene.surface(1) - scene.surface(0), scene.change(1), rtol=0, atol=1e-12)


def test_a_bell_has_its_height_in_the_middle_and_a_plateau_is_level():
    mound = FlightChange("mound", 3.0, 4.0, 5.0, 1.0)
    assert mound.rise(np.array([3.0]), np.array([4.0])) == [1.0]
    assert mound.rise(np.array([8.0]), np.array([4.0])) == [0.0]
    plateau = FlightChange("plateau", 0.0, 0.0, 5.0, 0.3)
    assert_allclose(plateau.rise(np.linspace(0, 3.9, 5), np.zeros(5)), 0.3, rtol=1e-12, atol=0)


def test_paint_changes_the_look_and_not_the_ground(flown):
    scene = flown[0].scene
    paint = next(c for c in scene.changes if c.kind == "paint")
    east, north = scene.nodes(scene.texture_cell)
    inside = np.hypot(east - paint.east, north - paint.north) < 0.5 * paint.radius
    before, after = scene.brightness(0)[inside], scene.brightness(1)[inside]
    assert abs(np.corrcoef(before, after)[0, 1]) < 0.6
    outside = np.min([np.hypot(east - c.east, north - c.north) / c.radius for c in scene.changes], axis=0) > 1.5
    assert np.corrcoef(scene.brightness(0)[outside], scene.brightness(1)[outside])[0, 1] > 0.8


def test_undistorted_directions_project_back_to_their_pixels():
    camera = FlightDesign().camera
    rng = np.random.default_rng(0)
    pixel = rng.uniform([0, 0], [camera.width, camera.height], (100, 2))
    direction = undistorted(camera, pixel)
    projected, _ = cv2.projectPoints(direction, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    assert_allclose(projected[:, 0], pixel, rtol=0, atol=1e-4)


def test_a_photo_shows_the_ground_where_the_estimators_lens_model_projects_it(flown):
    """The renderer inverts the lens by itself; the estimator's projection must find the same brightness."""
    epoch = flown[0]
    photo = next(epoch.photos()).astype(float)
    position, rotation = epoch.true_poses()
    poses = CameraPoses(epoch.names, epoch.time, position, rotation, np.zeros((len(position), 6, 6)), SMALL.origin)
    block = ImageBlock.from_poses(poses, SMALL.camera)
    scene = epoch.scene
    rng = np.random.default_rng(1)
    place = position[0, :2] + rng.uniform(-15, 15, (400, 2))
    surface = scene.surface(0)
    height = look(place, surface, -scene.half_east, -scene.half_north, CELL)
    projected = block.project(np.column_stack([place, height]), 0)
    inside = block.is_inside(projected, 0, 3.0)
    level = look(place, scene.objects, -scene.half_east, -scene.half_north, CELL) == 0.0
    used = inside & level
    assert used.sum() > 50
    shown = cv2.remap(photo, *projected[used, :2].astype(np.float32).T[:, :, None], cv2.INTER_LINEAR)[:, 0]
    true = look(place[used], cv2.GaussianBlur(scene.brightness(0), (0, 0), 1.3), -scene.half_east, -scene.half_north,
                scene.texture_cell)  # fmt: skip
    assert np.corrcoef(shown, true)[0, 1] > 0.97


def test_the_same_seed_gives_the_same_flight_and_another_one_another(flown):
    again = fly_programme(SMALL, seed=4)
    assert_allclose(
        again[1].simulated.flight.imu.angular_rate, flown[1].simulated.flight.imu.angular_rate, rtol=0, atol=0
    )
    assert np.array_equal(next(again[1].photos()), next(flown[1].photos()))
    other = fly_programme(SMALL, seed=5)
    assert not np.array_equal(next(other[0].photos()), next(flown[0].photos()))


def test_epochs_differ_in_their_paths_and_gps_offsets(flown):
    first, second = (epoch.simulated for epoch in flown)
    assert np.linalg.norm(first.gps_offset - second.gps_offset) > 0.1
    assert np.abs(flown[0].true_poses()[0] - flown[1].true_poses()[0]).max() > 0.5


def test_designs_that_cannot_be_reconstructed_are_refused():
    with pytest.raises(ValueError, match="at least 1, 1, 4 and 200 x 200"):
        replace(SMALL, n_photos=3)
    with pytest.raises(ValueError, match="side_overlap"):
        replace(SMALL, side_overlap=0.95)
    with pytest.raises(ValueError, match="is too little for four"):
        fly_programme(replace(SMALL, n_strips=1, baseline=14.0, height=60.0))
