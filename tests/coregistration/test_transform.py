"""Transforms: their own arithmetic, and derivatives against differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from changedetect.coregistration import KINDS, Transform
from changedetect.coregistration.transform import PARAMETER_NAMES

CENTRE = (500100.0, 5300100.0, 400.0)
PARAMETERS = {
    "vertical": (0.4,),
    "shift": (0.3, -0.2, 0.4),
    "shift_tilt": (0.3, -0.2, 0.4, 2e-3, -1e-3),
    "rigid": (0.3, -0.2, 0.4, 2e-3, -1e-3, 3e-3),
    "rigid_scale": (0.3, -0.2, 0.4, 2e-3, -1e-3, 3e-3, 1e-3),
}


def _places(n=40, seed=0):
    rng = np.random.default_rng(seed)
    return tuple(c + rng.uniform(-r, r, n) for c, r in zip(CENTRE, (100.0, 100.0, 20.0), strict=True))


def test_a_shift_moves_every_place_alike():
    moved = Transform("shift", CENTRE, (0.3, -0.2, 0.4)).apply(*_places())
    for after, before, motion in zip(moved, _places(), (0.3, -0.2, 0.4), strict=True):
        np.testing.assert_allclose(after - before, motion, rtol=0, atol=1e-8)


def test_a_tilt_lifts_by_the_distance_from_the_centre():
    easting, northing, elevation = _places()
    moved = Transform("shift_tilt", CENTRE, (0.0, 0.0, 0.1, 2e-3, -1e-3)).apply(easting, northing, elevation)
    lift = 0.1 + 2e-3 * (easting - CENTRE[0]) - 1e-3 * (northing - CENTRE[1])
    np.testing.assert_array_equal(moved[0], easting)
    np.testing.assert_allclose(moved[2] - elevation, lift, rtol=0, atol=1e-9)


def test_rotation_and_scale_turn_about_the_centre():
    vector = (0.02, -0.03, 0.5)
    transform = Transform("rigid_scale", CENTRE, (1.0, 2.0, 3.0, *vector, 0.1))
    offset = np.stack(_places()) - np.array(CENTRE)[:, None]
    expected = 1.1 * Rotation.from_rotvec(vector).apply(offset.T).T + np.add(CENTRE, (1.0, 2.0, 3.0))[:, None]
    np.testing.assert_allclose(np.stack(transform.apply(*_places())), expected, rtol=0, atol=1e-8)


def test_a_quarter_turn_about_the_vertical_takes_east_to_north():
    transform = Transform("rigid", CENTRE, (0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2))
    east_of_centre = [np.array([CENTRE[0] + 10.0]), np.array([CENTRE[1]]), np.array([CENTRE[2]])]
    moved = [float(v[0]) for v in transform.apply(*east_of_centre)]
    np.testing.assert_allclose(moved, (CENTRE[0], CENTRE[1] + 10.0, CENTRE[2]), rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_jacobian_equals_differences_of_the_residual(kind):
    transform = Transform(kind, CENTRE, PARAMETERS[kind])
    gradient = (0.3, -0.15)

    def residual(candidate):
        easting, northing, elevation = candidate.apply(*_places())
        return elevation - gradient[0] * easting - gradient[1] * northing

    slopes = (np.full(40, gradient[0]), np.full(40, gradient[1]))
    jacobian = transform.jacobian(*transform.apply(*_places()), *slopes)
    for k in range(len(transform.names)):
        step = np.zeros(len(transform.names))
        step[k] = 1e-4
        difference = (residual(transform.stepped(step)) - residual(transform.stepped(-step))) / 2e-4
        np.testing.assert_allclose(jacobian[:, k], difference, rtol=1e-5, atol=2e-5)


@given(
    kind=st.sampled_from(KINDS),
    values=st.lists(st.floats(-0.01, 0.01), min_size=7, max_size=7),
    height=st.floats(-100.0, 100.0),
)
def test_documents_read_back_bit_for_bit(kind, values, height):
    transform = Transform(kind, (1.0, 2.0, height), tuple(values[: len(PARAMETER_NAMES[kind])]))
    assert Transform.from_dict(transform.to_dict()) == transform


def test_a_kind_taken_from_another_keeps_what_both_have():
    shift = Transform("shift", CENTRE, (0.3, -0.2, 0.4))
    assert shift.as_kind("rigid").parameters == (0.3, -0.2, 0.4, 0.0, 0.0, 0.0)
    assert shift.as_kind("vertical").parameters == (0.4,)
    assert shift["scale"] == 0.0


def test_unknown_kinds_and_wrong_numbers_of_parameters_are_refused():
    with pytest.raises(ValueError, match="one of vertical, shift"):
        Transform("affine", CENTRE, (0.0,))
    with pytest.raises(ValueError, match="has 3 parameters; got 2"):
        Transform("shift", CENTRE, (0.0, 0.0))
