"""What an alignment says and does to differences."""

import json

import numpy as np
import pytest
import rolling_ground as rolling

from changedetect.coregistration import Alignment, align
from changedetect.coregistration.transform import Transform


@pytest.fixture(scope="module")
def alignment():
    return align(rolling.epoch(shift=(0.4, -0.3, 0.2)), rolling.reference(), "rigid_scale")


def test_documents_read_back_through_json(alignment):
    document = json.loads(json.dumps(alignment.to_dict()))
    again = Alignment.from_dict(document)
    assert again.to_dict() == alignment.to_dict()
    assert again.transform == alignment.transform
    np.testing.assert_array_equal(again.covariance, alignment.covariance)


def test_documents_of_another_version_are_refused(alignment):
    with pytest.raises(ValueError, match="format version 99"):
        Alignment.from_dict(alignment.to_dict() | {"format_version": 99})


def test_the_sentence_states_parameters_errors_and_residuals(alignment):
    sentence = alignment.wording()
    assert sentence.startswith("Moved by east +0.4")
    for part in ("mrad", "ppm", "before", "after", "% of the shared ground"):
        assert part in sentence


def test_intervals_enclose_the_parameters_and_widen_with_confidence(alignment):
    narrow, wide = alignment.intervals(0.5), alignment.intervals(0.99)
    assert (narrow[:, 0] < alignment.transform.parameters).all()
    assert (wide[:, 0] < narrow[:, 0]).all()
    assert (wide[:, 1] > narrow[:, 1]).all()


def test_the_variance_of_offsets_is_that_of_random_transforms(alignment):
    rng = np.random.default_rng(0)
    easting, northing = rolling.WEST + rng.uniform(0, 240, 6), rolling.SOUTH + rng.uniform(0, 240, 6)
    slopes = rng.normal(0.0, 0.3, (2, 6))
    elevation = rolling.ground(easting, northing)
    transform = alignment.transform
    steps = rng.multivariate_normal(np.zeros(7), alignment.covariance, 4000)
    offsets = []
    for step in steps:
        moved = transform.stepped(step).apply(easting, northing, elevation)
        before = transform.apply(easting, northing, elevation)
        east, north, up = (a - b for a, b in zip(moved, before, strict=True))
        offsets.append(up - slopes[0] * east - slopes[1] * north)
    places = transform.apply(easting, northing, elevation)
    variance = alignment.covariance_of_offset(places[0], places[1], *slopes, places[2])
    np.testing.assert_allclose(np.var(offsets, axis=0), variance, rtol=0.12, atol=0)
    design = alignment.offset_design(places[0], places[1], *slopes, places[2])
    whole = design @ alignment.covariance @ design.T
    np.testing.assert_allclose(np.diag(whole), variance, rtol=1e-9, atol=0)


def test_a_vertical_shift_errs_everywhere_alike():
    names = ("n_effective", "overlap_share", "stable_share", "median_before", "nmad_before", "median_after")
    values = dict.fromkeys((*names, "nmad_after", "correlation_length"), 0.0)
    alignment = Alignment(
        transform=Transform("vertical", rolling.CENTRE, (0.2,)),
        covariance=np.array([[4e-4]]),
        degrees_of_freedom=np.array([50.0]),
        candidates=(),
        n_observations=0,
        n_used=0,
        vertical_step=None,
        remarks=(),
        **values,
    )
    places, slopes = np.zeros((2, 5)), np.full((2, 5), 0.7)
    np.testing.assert_allclose(alignment.covariance_of_offset(*places, *slopes), 4e-4, rtol=1e-12, atol=0)
