"""What width of change a map resolves: the number means what it says, epoch by epoch and change by change."""

import numpy as np
import pytest
from coarse_and_dense import SOUTH, WEST, cloud, elevation_model, rough_ground
from scipy import stats

from changedetect.config import DifferencingConfig
from changedetect.differencing import ChangeObjects, difference_models, find_objects_of_change
from changedetect.differencing.resolution import (
    CHANGE_NOT_RESOLVED,
    LIMITED_BY_EARLIER,
    LIMITED_BY_LATER,
    NO_RESOLUTION,
    RESOLVED_ALIKE,
    Resolution,
    describe_resolution,
    object_sizes,
    resolution_classes,
    supported_width,
)
from changedetect.differencing.shared_surface import estimate_difference
from changedetect.grid import Grid
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.pyramid import Lattice

NOTHING = ChangeObjects((), np.zeros((4, 5), np.int32), np.full((4, 5), 0.5))


def learned(points, resolution=None):
    return LWPRSurface(resolution=resolution).fit(points.coordinates, points.elevation)


def difference(earlier, later, side, cell):
    """Local difference on cells of a square, and which of them lie away from its rim."""
    n = int(side / cell)
    lattice = Lattice(0.0, cell, round(SOUTH / cell), round(WEST / cell), n, n)
    kernels = (earlier.own_kernel_, later.own_kernel_)
    found = estimate_difference(earlier.own_cells(), later.own_cells(), kernels, lattice)
    return found, found.observed[0] & found.observed[1]


def significant(found):
    z = found.difference / np.sqrt(found.variance)
    return np.abs(z) > stats.t.ppf(0.975, np.maximum(found.freedom, 1.0)), z


def strip(width, height):
    return lambda easting, northing: np.where(np.abs(easting - WEST - 30.0) < 0.5 * width, height, 0.0)


@pytest.mark.parametrize(("share", "expected"), [(0.45, 0.5), (1.0, 0.89)])
def test_a_strip_of_the_stated_width_comes_out_as_stated(share, expected):
    ground, middle = rough_ground(1, 60.0, relief=0.0, shortest=4.0), []
    for seed in range(3):
        thin = learned(cloud(ground, 60.0, 2.5, seed=2 * seed, noise=1.0))
        width = float(np.median(difference(thin, thin, 60.0, 0.5)[0].resolution.width))
        later = cloud(ground, 60.0, 2.5, seed=2 * seed + 1, noise=1.0, change=strip(share * width, 0.6))
        found, _ = difference(thin, learned(later), 60.0, 0.5)
        middle.append(found.difference[10:-10, 59:61].mean())
    np.testing.assert_allclose(np.mean(middle) / 0.6, expected, rtol=0, atol=0.1)


def test_the_coarser_epoch_sets_the_resolution():
    ground = rough_ground(2, 60.0)
    thin, dense = (learned(cloud(ground, 60.0, density)) for density in (0.7, 30.0))
    for earlier, later in ((thin, dense), (dense, thin)):
        found, _ = difference(earlier, later, 60.0, 1.0)
        inner = (slice(10, -10), slice(10, -10))
        widths = [np.median(a[inner]) for a in (found.resolution.earlier, found.resolution.later)]
        assert max(widths) > 3.0 * min(widths)
        assert (widths[0] > widths[1]) == (earlier is thin)
        np.testing.assert_allclose(np.median(found.resolution.width[inner]), max(widths), rtol=1e-12, atol=0.0)


def test_unresolved_detail_is_that_of_the_finer_epochs_ground():
    smooth, rough = (rough_ground(6, 80.0, relief=relief) for relief in (0.0, 3.0))
    for ground, low, high in ((smooth, 0.0, 0.02), (rough, 0.1, 3.0)):
        found, both = difference(learned(cloud(ground, 80.0, 0.5)), learned(cloud(ground, 80.0, 20.0)), 80.0, 1.0)
        assert low <= np.median(found.resolution.unresolved_std[both]) <= high


def test_an_elevation_model_of_means_is_compared_with_means():
    """Unchanged ground is flagged at the nominal rate, with an error near that of the cells themselves."""
    flagged, scores = [], []
    for seed in range(5):
        ground = rough_ground(20 + seed, 140.0)
        earlier = learned(elevation_model(ground, 140.0, 4.0, seed=seed))
        later = learned(cloud(ground, 140.0, 3.0, seed=100 + seed))
        found, both = difference(earlier, later, 140.0, 2.0)
        assert found.resolution.footprints[0] == pytest.approx(4.0, rel=0.5)
        both[:6], both[-6:], both[:, :6], both[:, -6:] = False, False, False, False
        hits, z = significant(found)
        flagged.append(hits[both])
        scores.append(z[both])
        # 5 cm a cell, some 60 cells under the wide kernel: 0.007 m; the ground's detail would make it 0.02
        assert np.median(np.sqrt(found.variance[both])) < 0.011
    # five maps hold some 100 independent places
    assert 0.01 < np.concatenate(flagged).mean() < 0.095
    assert 0.85 < np.concatenate(scores).std() < 1.15


def test_ground_that_the_coarse_epoch_alone_saw_does_not_spoil_the_rim():
    flagged = []
    for seed in range(4):
        ground = rough_ground(30 + seed, 130.0, relief=8.0)
        earlier = learned(elevation_model(ground, 130.0, 4.0, seed=seed))
        later = learned(cloud(ground, 130.0, 3.0, seed=60 + seed, margin=35.0))
        found, both = difference(earlier, later, 130.0, 2.0)
        assert both.sum() > 500
        # bare heights of metres beyond the rim would stand in the difference and in its variance
        assert np.median(np.abs(found.difference[both])) < 0.03
        assert np.percentile(np.sqrt(found.variance[both]), 95) < 0.15
        flagged.append(significant(found)[0][both].mean())
    # a map of 60 m holds some five independent places
    assert np.mean(flagged) < 0.17


def test_a_narrow_change_is_marked_as_not_resolved_and_a_wide_one_is_not():
    ground = rough_ground(40, 160.0)

    def change(easting, northing):
        east, north = easting - WEST, northing - SOUTH
        narrow = (np.abs(east - 30.0) < 1.5) & (np.abs(north - 80.0) < 1.5)
        wide = (np.abs(east - 105.0) < 25.0) & (np.abs(north - 80.0) < 25.0)
        return np.where(narrow | wide, 3.0, 0.0)

    earlier = learned(cloud(ground, 160.0, 0.7, noise=0.03), 0.5)
    later = learned(cloud(ground, 160.0, 20.0, noise=0.03, seed=2, change=change), 0.5)
    grid = Grid.from_region((WEST, WEST + 160.0, SOUTH, SOUTH + 160.0), 1.0, "EPSG:32632")
    maps = difference_models(earlier, later, grid, DifferencingConfig())
    objects = find_objects_of_change(maps, 1.0, 0.95, 0.05)
    sizes = object_sizes(objects, maps.dod, maps.resolution.width, 1.0)
    classes = resolution_classes(maps.resolution, objects, sizes)
    row, narrow, wide = 80, 30, 105
    assert objects.labels[row, wide] > 0
    assert sizes[objects.labels[row, wide]].is_resolved
    np.testing.assert_allclose(maps.dod[row, wide], 3.0, rtol=0.03, atol=0.0)
    assert classes[row, wide] == LIMITED_BY_EARLIER
    assert objects.labels[row, narrow] > 0
    assert not sizes[objects.labels[row, narrow]].is_resolved
    assert maps.dod[row, narrow] < 2.4
    assert classes[row, narrow] == CHANGE_NOT_RESOLVED
    document = describe_resolution(maps.resolution, classes, sizes, 1.0)
    assert "the earlier one limits the map" in document["statement"]
    assert document["n_objects_not_resolved"] >= 1
    assert document["area_limited_by_earlier_m2"] > 0.8 * 160.0**2


def resolution_of(earlier, later, shape=(4, 5)):
    return Resolution(np.full(shape, earlier), np.full(shape, later), np.full(shape, 0.2))


@pytest.mark.parametrize(
    ("earlier", "later", "expected"),
    [
        (3.0, 3.0, RESOLVED_ALIKE),
        (3.0, 5.0, RESOLVED_ALIKE),
        (9.0, 3.0, LIMITED_BY_EARLIER),
        (3.0, 9.0, LIMITED_BY_LATER),
    ],
)
def test_an_epoch_limits_where_it_is_more_than_twice_as_coarse(earlier, later, expected):
    found = resolution_of(earlier, later)
    found.earlier[0, 0] = np.nan
    classes = resolution_classes(found, NOTHING, {})
    assert classes[0, 0] == NO_RESOLUTION
    assert (classes.ravel()[1:] == expected).all()


@pytest.mark.parametrize(("resolution", "is_resolved"), [(3.0, True), (6.0, True), (8.0, False)])
def test_an_object_is_as_wide_as_its_high_part(resolution, is_resolved):
    labels = np.zeros((60, 60), np.int32)
    labels[10:50, 20:40] = 1
    dod = np.where(labels > 0, 0.1, 0.0)
    dod[12:48, 25:35] = 1.0  # ten cells wide, with low flanks that are significant too
    objects = ChangeObjects((), labels, np.full(labels.shape, 0.5))
    size = object_sizes(objects, -dod, np.full(labels.shape, resolution), 1.0)[1]
    np.testing.assert_allclose(size.width, 10.0, rtol=0, atol=1.0)
    assert size.is_resolved == is_resolved


def test_thin_ground_is_resolved_by_its_spacing_and_dense_ground_by_the_kernel():
    counts = np.array([4.0, 9.0, 1000.0])
    widths = supported_width(1.0, counts, 1.0)
    assert (np.diff(widths) <= 0.0).all()
    np.testing.assert_allclose(widths[-1], 2.165, rtol=1e-3, atol=0.0)
    np.testing.assert_allclose(supported_width(1.0, counts, 1.0, footprint=3.0)[-1], np.hypot(2.165, 3.0), rtol=1e-3)


def test_nothing_observed_resolves_nothing():
    found = resolution_of(np.nan, np.nan)
    classes = resolution_classes(found, NOTHING, {})
    assert (classes == NO_RESOLUTION).all()
    assert describe_resolution(found, classes, {}, 1.0)["width_m"] is None
