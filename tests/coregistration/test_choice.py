"""The simplest transform that suffices."""

import numpy as np
import pytest
import rolling_ground as rolling

from changedetect.coregistration import AlignmentError, align

SHIFT = (0.4, -0.3, 0.2)


def _correlated(rng, easting, northing):
    return rolling.correlated(rng, 0.03, 15.0, easting, northing)


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("shift", {}),
        ("shift_tilt", {"tilt": (1.5e-3, -1e-3)}),
        ("rigid", {"turn": (0.0, 0.0, 4e-3)}),
        ("rigid_scale", {"scale": 3e-3}),
    ],
)
def test_the_kind_that_was_put_in_is_taken(kind, how):
    alignment = align(rolling.epoch(1, 6000, shift=SHIFT, **how), rolling.reference(1))
    assert alignment.transform.kind == kind
    np.testing.assert_allclose(rolling.found_about(alignment), SHIFT, rtol=0, atol=0.02)
    taken = [candidate for candidate in alignment.candidates if candidate.verdict.startswith("taken")]
    assert [candidate.kind for candidate in taken] == [kind]


def test_correlated_errors_are_not_taken_for_a_tilt():
    kinds = [
        align(
            rolling.epoch(seed, 4000, shift=SHIFT, error=_correlated), rolling.reference(seed, error=_correlated)
        ).transform.kind
        for seed in range(6)
    ]
    assert kinds.count("shift") >= 5


@pytest.mark.parametrize("seed", range(3))
def test_flat_ground_without_texture_is_aligned_vertically_only(seed):
    reference = rolling.reference(seed, surface=rolling.flat)
    alignment = align(rolling.epoch(seed, 4000, surface=rolling.flat, shift=(0.5, 0.0, 0.2)), reference)
    assert alignment.transform.kind == "vertical"
    assert alignment.transform["up"] == pytest.approx(0.2, abs=0.005)
    assert any("slopes vary too little" in remark for remark in alignment.remarks)


@pytest.mark.parametrize("kind", ["shift", "rigid"])
def test_a_horizontal_shift_demanded_on_flat_ground_is_refused(kind):
    with pytest.raises(AlignmentError, match="slopes vary too little") as caught:
        align(rolling.epoch(surface=rolling.flat), rolling.reference(surface=rolling.flat), kind)
    assert caught.value.cause == "slope diversity"


def test_a_kind_that_is_asked_for_is_fitted():
    alignment = align(rolling.epoch(shift=SHIFT), rolling.reference(), "rigid")
    assert alignment.transform.kind == "rigid"
    assert alignment.candidates[0].verdict == "asked for"
    vertical = align(rolling.epoch(shift=(0.0, 0.0, 0.2)), rolling.reference(), "vertical")
    assert vertical.transform.parameters[0] == pytest.approx(0.2, abs=0.01)
