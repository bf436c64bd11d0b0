"""Alignment of a coarse elevation model and a dense cloud: by the dense surface, whichever is the reference."""

from dataclasses import replace

import numpy as np
import pytest
from coarse_and_dense import cloud, elevation_model, rough_ground

from changedetect.coregistration import ModelReference, align, align_across_resolutions, differ_in_resolution
from changedetect.models.lwpr import LWPRSurface

SIDE, CELL, DENSITY = 150.0, 5.0, 2.0
SHIFT = np.array([0.6, -0.4, 0.3])


def moved(points, shift=SHIFT):
    east, north, up = shift
    return replace(
        points, easting=points.easting + east, northing=points.northing + north, elevation=points.elevation + up
    )


def learned(points):
    return LWPRSurface().fit(points.coordinates, points.elevation)


@pytest.fixture(scope="module")
def epochs():
    ground = rough_ground(8, SIDE, relief=5.0)
    return elevation_model(ground, SIDE, CELL), cloud(ground, SIDE, DENSITY)


@pytest.mark.parametrize("is_coarse_reference", [True, False])
def test_a_shift_is_found_far_better_than_by_point_to_surface(epochs, is_coarse_reference):
    reference, epoch = epochs if is_coarse_reference else epochs[::-1]
    model = learned(reference)
    found = align_across_resolutions(moved(epoch), model, "shift")
    error = found.transform.shift + SHIFT
    np.testing.assert_array_less(np.abs(error), 4.0 * found.standard_errors)
    assert found.standard_errors[:2].max() < 0.12
    assert found.standard_errors[2] < 0.02
    if is_coarse_reference:
        plain = align(moved(epoch), ModelReference(model, model.own_kernel_), "shift")
        assert plain.standard_errors[:2].max() > 3.0 * found.standard_errors[:2].max()
    np.testing.assert_allclose(found.median_before, SHIFT[2], rtol=0, atol=0.1)


def test_standard_errors_cover_the_truth():
    scores = []
    for seed in range(3):
        ground = rough_ground(50 + seed, 140.0, relief=4.0)
        model = learned(elevation_model(ground, 140.0, CELL, seed=seed))
        found = align_across_resolutions(moved(cloud(ground, 140.0, DENSITY, seed=90 + seed)), model, "shift")
        scores.append((found.transform.shift + SHIFT) / found.standard_errors)
    assert 0.45 < np.std(scores) < 1.7
    assert np.abs(scores).max() < 4.0


def test_a_step_of_the_datum_is_told_to_the_right_side(epochs):
    coarse, dense = epochs
    low = align_across_resolutions(moved(dense, (0.0, 0.0, -0.8)), learned(coarse), "vertical")
    assert "The epoch lies 0.80 m below the reference" in low.vertical_step
    high = align_across_resolutions(moved(coarse, (0.0, 0.0, 0.8)), learned(dense), "vertical")
    assert "The epoch lies 0.80 m above the reference" in high.vertical_step


def test_only_epochs_of_different_density_differ_in_resolution(epochs):
    coarse, dense = epochs
    assert differ_in_resolution(dense, learned(coarse))
    assert differ_in_resolution(coarse, learned(dense))
    assert not differ_in_resolution(dense, learned(dense))
    assert not differ_in_resolution(coarse, learned(coarse))


def test_stable_areas_restrict_the_coarse_observations(epochs):
    coarse, dense = epochs
    asked = []

    def area_of(points):
        asked.append(len(points))
        return np.where(points.easting > 500_060.0, 0, -1)

    changed = moved(dense, (0.0, 0.0, 0.3))
    changed.elevation[changed.easting < 500_055.0] += 5.0
    found = align_across_resolutions(changed, learned(coarse), "vertical", area_of, ["the east"])
    np.testing.assert_allclose(found.transform["up"], -0.3, rtol=0, atol=0.02)
    assert asked == [len(coarse)]
