"""Alignment of whole epochs: change, outliers, order, stable areas, and what is refused."""

import numpy as np
import pytest
import rolling_ground as rolling

from changedetect.coregistration import AlignmentError, ModelReference, align
from changedetect.models.lwpr import LWPRSurface
from changedetect.pointcloud import PointCloud

SHIFT = (0.4, -0.3, 0.2)


def _rise(height, west=0.0, east=0.4):
    """Raise everything between two shares of the site's width."""

    def change(easting, _northing):
        share = (easting - rolling.WEST) / rolling.SIDE
        return height * ((share >= west) & (share < east))

    return change


def _replaced(cloud, **columns):
    names = ("easting", "northing", "elevation", "sigma")
    return PointCloud(**{name: getattr(cloud, name) for name in names} | columns)


@pytest.mark.parametrize("height", [0.1, 0.5, -3.0])
def test_change_on_a_third_of_the_ground_is_not_absorbed(height):
    cloud = rolling.epoch(n=8000, shift=SHIFT, change=_rise(height, 0.3, 0.63))
    alignment = align(cloud, rolling.reference())
    np.testing.assert_allclose(rolling.found_about(alignment), SHIFT, rtol=0, atol=0.012)
    assert 0.55 < alignment.stable_share < 0.75
    assert alignment.nmad_after < 0.05 < alignment.nmad_before


def test_outliers_do_not_move_the_epoch():
    cloud = rolling.epoch(n=8000, shift=SHIFT)
    rng = np.random.default_rng(5)
    is_gross = rng.uniform(size=len(cloud)) < 0.1
    elevation = cloud.elevation + np.where(is_gross, rng.uniform(0.0, 15.0, len(cloud)), 0.0)
    alignment = align(_replaced(cloud, elevation=elevation), rolling.reference())
    np.testing.assert_allclose(rolling.found_about(alignment), SHIFT, rtol=0, atol=0.015)


def test_the_result_does_not_depend_on_the_order():
    cloud, reference = rolling.epoch(shift=SHIFT), rolling.reference()
    order = np.random.default_rng(0).permutation(len(cloud))
    first, second = align(cloud, reference), align(cloud.select(order), reference)
    assert first.to_dict() == second.to_dict()


def test_an_epoch_aligned_to_itself_stays_where_it_is():
    cloud = rolling.epoch(n=8000)
    model = LWPRSurface().fit(cloud.coordinates, cloud.elevation)
    alignment = align(cloud, ModelReference(model, model.own_kernel_))
    moved = rolling.found_about(alignment)
    assert (np.abs(moved) < 4.0 * alignment.standard_errors[:3] + 1e-3).all()


def test_a_learned_surface_serves_as_reference():
    first, second = rolling.epoch(0, n=25000), rolling.epoch(1, n=15000, shift=SHIFT)
    model = LWPRSurface().fit(first.coordinates, first.elevation)
    alignment = align(second, ModelReference(model, model.own_kernel_))
    np.testing.assert_allclose(rolling.found_about(alignment), SHIFT, rtol=0, atol=0.015)
    assert alignment.nmad_after < 0.5 * alignment.nmad_before
    aligned = alignment.apply(second)
    left = aligned.elevation - rolling.ground(*aligned.coordinates)
    assert abs(np.median(left)) < 0.003


def test_a_stated_sigma_weighs_observations():
    cloud = rolling.epoch(n=8000, noise=0.0, shift=SHIFT)
    rng = np.random.default_rng(7)
    sigma = np.where(rng.uniform(size=len(cloud)) < 0.5, 0.02, 0.3)
    noisy = _replaced(cloud, elevation=cloud.elevation + rng.normal(0.0, 1.0, len(cloud)) * sigma, sigma=sigma)
    blind = _replaced(noisy, sigma=None)
    weighted, unweighted = align(noisy, rolling.reference(), "shift"), align(blind, rolling.reference(), "shift")
    assert (weighted.standard_errors <= 1.05 * unweighted.standard_errors).all()
    np.testing.assert_allclose(rolling.found_about(weighted), SHIFT, rtol=0, atol=0.015)


def test_a_vertical_step_is_told_in_plain_words():
    lower = align(rolling.epoch(shift=(0.0, 0.0, 0.41)), rolling.reference())
    assert lower.vertical_step is not None
    assert lower.vertical_step.startswith("The epoch lies 0.41 m below the reference everywhere")
    assert "datum" in lower.vertical_step
    assert align(rolling.epoch(shift=(0.0, 0.0, 0.04)), rolling.reference()).vertical_step is None
    sideways = align(rolling.epoch(shift=(1.5, 0.0, 0.2)), rolling.reference())
    assert sideways.vertical_step is None


def test_stable_areas_decide_against_the_majority():
    cloud = rolling.epoch(n=8000, shift=SHIFT, change=_rise(1.0, 0.0, 0.7))
    is_stable = cloud.easting > rolling.WEST + 0.75 * rolling.SIDE
    area = np.where(is_stable, 0, -1)
    alignment = align(cloud, rolling.reference(), "shift", area)
    np.testing.assert_allclose(rolling.found_about(alignment), SHIFT, rtol=0, atol=0.02)
    assert alignment.n_observations == is_stable.sum()
    wrong = align(cloud, rolling.reference(), "shift")
    assert abs(rolling.found_about(wrong)[2] - SHIFT[2]) > 0.5


def test_a_stable_area_that_changed_is_named():
    cloud = rolling.epoch(n=8000, shift=SHIFT, change=_rise(0.5, 0.8, 1.0))
    share = (cloud.easting - rolling.WEST) / rolling.SIDE
    area = np.select([share < 0.3, (share > 0.4) & (share < 0.7), share > 0.82], [0, 1, 2], -1)
    alignment = align(cloud, rolling.reference(), "shift", area, ("car park", "road", "quarry"))
    np.testing.assert_allclose(rolling.found_about(alignment), SHIFT, rtol=0, atol=0.015)
    assert len(alignment.remarks) == 1
    assert alignment.remarks[0].startswith("Quarry changed by +0.50 m")
    unnamed = align(cloud, rolling.reference(), "shift", area)
    assert unnamed.remarks[0].startswith("Stable area 3 changed")


def test_a_majority_that_disagrees_is_remarked_on():
    higher, lower = _rise(0.5, 0.0, 0.3), _rise(-0.7, 0.7, 1.0)
    cloud = rolling.epoch(n=8000, shift=SHIFT, change=lambda e, n: higher(e, n) + lower(e, n))
    alignment = align(cloud, rolling.reference(), "shift")
    assert 0.3 < alignment.stable_share < 0.45
    assert any("disagrees with the rest" in remark for remark in alignment.remarks)
    np.testing.assert_allclose(rolling.found_about(alignment), SHIFT, rtol=0, atol=0.02)


def test_ground_that_changed_all_over_is_not_taken_for_misaligned():
    def everywhere(rng, easting, northing):
        return 0.3 + rolling.correlated(rng, 0.3, 12.0, easting, northing)

    cloud, reference = rolling.epoch(n=8000, error=everywhere), rolling.reference()
    with pytest.raises(AlignmentError, match="Change cannot be told from error: residuals scatter by 0") as caught:
        align(cloud, reference)
    assert caught.value.cause == "stable ground"
    assert align(cloud, reference, "vertical").transform["up"] == pytest.approx(-0.3, abs=0.15)


def test_no_overlap_is_refused():
    far = rolling.epoch()
    with pytest.raises(AlignmentError, match=r"No overlap: none of .* Check the CRS") as caught:
        align(_replaced(far, easting=far.easting + 5000.0), rolling.reference())
    assert caught.value.cause == "overlap"


def test_overlap_too_small_is_refused():
    cloud = rolling.epoch(n=5000)
    moved = _replaced(cloud, easting=cloud.easting + rolling.SIDE - 6.0)
    with pytest.raises(AlignmentError, match="Overlap too small to align: of 5000 observations") as caught:
        align(moved, rolling.reference())
    assert caught.value.cause == "overlap"


def test_exchanged_axes_and_coordinates_in_feet_are_named():
    cloud = rolling.epoch(n=2000)
    with pytest.raises(AlignmentError, match="easting and northing exchanged"):
        align(_replaced(cloud, easting=cloud.northing, northing=cloud.easting), rolling.reference())
    feet = _replaced(cloud, easting=cloud.easting / 0.3048, northing=cloud.northing / 0.3048)
    with pytest.raises(AlignmentError, match="coordinates are in feet"):
        align(feet, rolling.reference())


@pytest.mark.parametrize(("factor", "unit"), [(1.0 / 0.3048, "feet, not metres"), (0.3048, "reference is in feet")])
def test_elevations_in_another_unit_are_named(factor, unit):
    cloud = rolling.epoch(n=3000)
    with pytest.raises(AlignmentError, match=unit) as caught:
        align(_replaced(cloud, elevation=cloud.elevation * factor), rolling.reference())
    assert caught.value.cause == "units"


def test_a_scale_error_is_named():
    alignment = align(rolling.epoch(scale=4e-3), rolling.reference())
    assert alignment.transform["scale"] == pytest.approx(4e-3, abs=1e-4)
    assert any("0.40% smaller than the reference" in remark for remark in alignment.remarks)


def test_too_few_observations_are_refused():
    with pytest.raises(AlignmentError, match="Too little stable ground: 30 observations"):
        align(rolling.epoch(n=30), rolling.reference())
    cloud = rolling.epoch(n=2000)
    area = np.where(np.arange(2000) < 20, 0, -1)
    with pytest.raises(AlignmentError, match="of 2000 observations 20 lie in the stable areas") as caught:
        align(cloud, rolling.reference(), area=area)
    assert caught.value.cause == "stable ground"


def test_stable_ground_under_one_correlated_error_is_refused():
    def error(rng, easting, northing):
        return rolling.correlated(rng, 0.2, 40.0, easting, northing)

    cloud = rolling.epoch(3, noise=0.01, error=error)
    corner = (cloud.easting < rolling.WEST + 60.0) & (cloud.northing < rolling.SOUTH + 60.0)
    with pytest.raises(AlignmentError, match=r"as good as .* independent ones") as caught:
        align(cloud, rolling.reference(3, noise=0.01), "vertical", np.where(corner, 0, -1))
    assert caught.value.cause == "stable ground"


def test_misuse_is_refused():
    cloud = rolling.epoch(n=2000)
    with pytest.raises(ValueError, match="kind of a transform is auto"):
        align(cloud, rolling.reference(), "affine")
    with pytest.raises(ValueError, match="do not match 2000 observations"):
        align(cloud, rolling.reference(), area=np.zeros(3, dtype=np.int64))
