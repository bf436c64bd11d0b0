"""Objects of change: what is there is found, what is not there is not."""

import numpy as np
from error_fields import change_maps, quiet

from changedetect.differencing import find_objects_of_change

SHAPE = (220, 220)


def patches():
    change = np.zeros(SHAPE)
    change[20:80, 20:80] = 0.5
    change[20:80, 140:200] = -0.2
    change[140:200, 140:200] = 0.1
    return change


def objects(change, seed, correlated=0.03):
    maps = change_maps(quiet(seed, SHAPE, correlated=correlated, length=6.0) + change)
    return find_objects_of_change(maps, 1.0, 0.95, 0.05), maps


def test_patches_are_found_whole_with_little_else():
    change = patches()
    false, power = [], []
    for seed in range(2):
        found, _ = objects(change, seed)
        flagged = found.labels > 0
        near = np.zeros(SHAPE, bool)
        for r, c in ((20, 20), (20, 140), (140, 140)):
            near[r - 4 : r + 64, c - 4 : c + 64] = True
        false.append(np.sum(flagged & ~near) / np.sum(flagged))
        power.append(flagged[change == -0.2].mean())
    assert np.mean(false) < 0.07
    assert np.mean(power) > 0.95


def test_objects_carry_area_volume_and_sign():
    found, maps = objects(patches(), 5)
    largest = found.items[0]
    assert largest.is_raised
    assert largest.number == 1
    np.testing.assert_allclose(largest.area, 3600.0, rtol=0.05, atol=0.0)
    assert largest.volume.lower < 0.5 * largest.area < largest.volume.upper
    inside = found.labels == 1
    np.testing.assert_allclose(largest.mean.value, maps.dod[inside].mean(), rtol=1e-9, atol=0.0)
    np.testing.assert_allclose(largest.extreme, maps.dod[inside].max(), rtol=1e-12, atol=0.0)
    assert largest.n_cells == inside.sum()
    assert (found.direction[inside] == 1.0).all()
    lowered = [item for item in found.items if not item.is_raised]
    assert lowered[0].volume.value < 0.0
    assert (found.direction[found.labels == lowered[0].number] == 0.0).all()
    assert all(item.q_value <= 0.05 for item in found.items)


def test_ground_without_change_rarely_has_objects():
    counts = [len(objects(np.zeros(SHAPE), 20 + seed)[0].items) for seed in range(3)]
    assert np.count_nonzero(counts) <= 1


def test_independent_errors_alone_give_no_objects_either():
    assert len(objects(np.zeros(SHAPE), 30, correlated=0.0)[0].items) <= 1


def test_a_map_without_conspicuous_cells_has_no_objects():
    maps = change_maps(np.zeros((40, 40)))
    found = find_objects_of_change(maps, 1.0, 0.95, 0.05)
    assert found.items == ()
    assert (found.direction == 0.5).all()
