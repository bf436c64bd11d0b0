"""The index finds every ellipse that holds a point, whatever happened to them before."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from changedetect.kernels.neighbour_index import (
    ENTRY_CELLS,
    ellipse_extent,
    empty_index,
    has_room,
    insert,
    lookup,
    remove,
    update,
)

REACH = 13.8


def metric(half_long, half_short, angle):
    """Metric whose ellipse of squared distance REACH has the given half axes."""
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    d = turn @ np.diag([REACH / half_long**2, REACH / half_short**2]) @ turn.T
    return d[0, 0], d[0, 1], d[1, 1]


def random_ellipses(n, rng, spread=3.0, side=20.0):
    """Centres, and metrics whose sizes span many octaves."""
    centres = rng.uniform(0.0, side, (n, 2))
    sizes = 2.0 ** rng.uniform(-spread, spread, n)
    thin = rng.uniform(0.1, 1.0, n)
    return [
        (*centre, *metric(size, size * ratio, angle))
        for centre, size, ratio, angle in zip(centres, sizes, thin, rng.uniform(0.0, math.pi, n), strict=True)
    ]


def holders(ellipses, x, y):
    """Numbers of the ellipses that hold a point, by visiting all of them."""
    return {
        k
        for k, (cx, cy, xx, xy, yy) in ellipses.items()
        if xx * (x - cx) ** 2 + 2 * xy * (x - cx) * (y - cy) + yy * (y - cy) ** 2 <= REACH
    }


def found(index, x, y):
    """What the index lists for a point, having checked that it lists nothing twice."""
    room = np.empty(len(index.boxes), dtype=np.int64)
    n = lookup(index, x, y, room)
    assert len(set(room[:n].tolist())) == n
    return set(room[:n].tolist())


def filled(ellipses, n_slots=8192, half=1.0):
    index = empty_index(len(ellipses), half, half, n_slots)
    for k, (cx, cy, xx, xy, yy) in enumerate(ellipses):
        assert has_room(index, 1)
        insert(index, k, cx, cy, xx, xy, yy, REACH)
    return index


@pytest.mark.parametrize("spread", [0.0, 3.0])
def test_every_ellipse_that_holds_a_point_is_found(spread):
    rng = np.random.default_rng(1)
    ellipses = random_ellipses(60, rng, spread)
    index = filled(ellipses)
    for x, y in rng.uniform(-5.0, 25.0, (300, 2)):
        assert holders(dict(enumerate(ellipses)), x, y) <= found(index, x, y)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_random_history_of_entering_changing_and_removing_loses_nothing(seed):
    rng = np.random.default_rng(seed)
    index = empty_index(12, 1.0, 1.0, 8192)
    present = {}
    for _ in range(40):
        k, (cx, cy, xx, xy, yy) = int(rng.integers(12)), random_ellipses(1, rng, spread=2.0, side=6.0)[0]
        if k in present and rng.random() < 0.4:
            remove(index, k)
            del present[k]
        elif k in present:
            cx, cy = present[k][:2]
            update(index, k, cx, cy, xx, xy, yy, REACH)
            present[k] = (cx, cy, xx, xy, yy)
        else:
            update(index, k, cx, cy, xx, xy, yy, REACH)
            present[k] = (cx, cy, xx, xy, yy)
        for x, y in rng.uniform(-2.0, 8.0, (3, 2)):
            listed = found(index, x, y)
            assert holders(present, x, y) <= listed
            assert listed <= set(present)


def test_a_slow_change_of_size_is_followed():
    index = empty_index(1, 1.0, 1.0, 8192)
    ellipse = {}
    for size in np.geomspace(0.3, 30.0, 120):
        ellipse[0] = (0.4, -0.7, *metric(size, 0.5 * size, 0.3))
        update(index, 0, *ellipse[0], REACH)
        for angle in np.linspace(0.0, 6.0, 7):
            x, y = 0.4 + 0.999 * size * math.cos(angle), -0.7 + 0.999 * size * math.sin(angle)
            assert holders(ellipse, x, y) <= found(index, x, y)
    # it stands once, in the cells of one level
    assert index.level_count.sum() == 1


def test_a_removed_ellipse_leaves_nothing_behind():
    rng = np.random.default_rng(2)
    ellipses = random_ellipses(30, rng)
    index = filled(ellipses)
    free_before = empty_index(30, 1.0, 1.0, 8192).counters[2]
    for k in rng.permutation(30):
        remove(index, int(k))
    assert index.counters[2] == free_before
    assert index.level_count.sum() == 0
    for x, y in rng.uniform(0.0, 20.0, (50, 2)):
        assert found(index, x, y) == set()


def test_many_ellipses_in_one_place_overflow_a_cell_without_loss():
    ellipses = [(0.1, 0.2, *metric(1.0, 1.0, 0.0))] * 50
    index = filled(ellipses)
    assert found(index, 0.1, 0.2) == set(range(50))
    for k in range(0, 50, 3):
        remove(index, k)
    assert found(index, 0.1, 0.2) == set(range(50)) - set(range(0, 50, 3))


def test_the_number_of_candidates_does_not_grow_with_the_number_of_ellipses():
    rng = np.random.default_rng(3)
    listed = []
    for n in (150, 1500):
        side = math.sqrt(n / 0.143) / 3.72  # a constant number of ellipses overlaps everywhere
        ellipses = [(*centre, *metric(1.0, 1.0, 0.0)) for centre in rng.uniform(0.0, side, (n, 2))]
        index = filled(ellipses, 2**15)
        points = rng.uniform(1.5, side - 1.5, (400, 2))
        listed.append(np.mean([len(found(index, x, y)) for x, y in points]))
    np.testing.assert_allclose(listed[1], listed[0], rtol=0.15, atol=0.0)
    assert listed[1] < 12.0  # 6.2 hold a point on average


@pytest.mark.parametrize(
    "broken", [(1.0, 1.0, 1.0), (1.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (1.0, 0.0, 1e-12), (math.inf, 0.0, 1.0)]
)
def test_an_ellipse_without_bounds_is_listed_everywhere(broken):
    index = empty_index(2, 1.0, 1.0, 1024)
    insert(index, 0, 0.0, 0.0, *broken, REACH)
    update(index, 1, 0.0, 0.0, *broken, REACH)
    assert found(index, 1e6, -1e6) == {0, 1}
    update(index, 1, 0.0, 0.0, *metric(1.0, 1.0, 0.0), REACH)
    assert found(index, 1e6, -1e6) == {0}
    assert found(index, 0.0, 0.0) == {0, 1}


def test_extent_is_the_bounding_box_of_the_ellipse():
    xx, xy, yy = metric(3.0, 0.5, 0.7)
    angle = np.linspace(0.0, 2.0 * math.pi, 20_001)
    x = 3.0 * np.cos(angle) * math.cos(0.7) - 0.5 * np.sin(angle) * math.sin(0.7)
    y = 3.0 * np.cos(angle) * math.sin(0.7) + 0.5 * np.sin(angle) * math.cos(0.7)
    np.testing.assert_allclose(ellipse_extent(xx, xy, yy, REACH), (x.max(), y.max()), rtol=2e-6, atol=0.0)


def test_no_ellipse_needs_more_cells_than_room_is_made_for():
    rng = np.random.default_rng(4)
    index = empty_index(1, 1.0, 1.0, 8192)
    for cx, cy, xx, xy, yy in random_ellipses(200, rng):
        insert(index, 0, cx, cy, xx, xy, yy, REACH)
        _, left, right, bottom, top = index.boxes[0]
        assert (right - left + 1) * (top - bottom + 1) <= ENTRY_CELLS
        remove(index, 0)


def test_room_ends_before_the_arrays_do():
    index = empty_index(500, 1.0, 1.0, 256)
    entered = []
    rng = np.random.default_rng(5)
    for k in range(500):
        if not has_room(index, 1):
            break
        entered.append((*rng.uniform(0.0, 40.0, 2), *metric(1.0, 1.0, 0.0)))
        insert(index, k, *entered[-1], REACH)
    assert 0 < len(entered) < 500
    for x, y in rng.uniform(0.0, 40.0, (100, 2)):
        assert holders(dict(enumerate(entered)), x, y) <= found(index, x, y)


@pytest.mark.parametrize("far", [4e5, 5e6, 1e12, -1e12])
def test_places_far_from_the_origin_are_found(far):
    index = empty_index(1, 1.0, 1.0, 1024)
    insert(index, 0, far, -far, *metric(1.0, 1.0, 0.0), REACH)
    assert found(index, far + 0.5, -far - 0.5) == {0}


def test_distant_cells_that_share_a_list_do_no_harm():
    # cells of 0.4 repeat after 2^28 of them
    period = 0.4 * 2**28
    ellipses = [(0.2, 0.2, *metric(1.0, 1.0, 0.0)), (0.2 + period, 0.2, *metric(1.0, 1.0, 0.0))]
    index = filled(ellipses)
    assert 0 in found(index, 0.2, 0.2)
    assert 1 in found(index, 0.2 + period, 0.2)
    remove(index, 0)
    assert 0 not in found(index, 0.2, 0.2)
    assert 1 in found(index, 0.2 + period, 0.2)
