"""Point clouds: the value, and the checks at the edge."""

from __future__ import annotations

import re

import numpy as np
import pytest

from changedetect.errors import InputDataError
from changedetect.pointcloud import (
    PointCloud,
    check_count,
    check_finite,
    check_not_degrees,
    check_points,
    check_values,
)


def survey(n: int = 20, **changes: object) -> PointCloud:
    i = np.arange(n, dtype=float)
    columns: dict[str, object] = {"easting": 5e5 + i, "northing": 5e6 + 2 * i, "elevation": 100 + 0.1 * i}
    return PointCloud(**(columns | changes))  # type: ignore[arg-type]


def with_value(name: str, position: int, value: float) -> PointCloud:
    columns = {key: np.array(getattr(survey(), key)) for key in ("easting", "northing", "elevation")}
    columns[name][position] = value
    return PointCloud(**columns)


def test_arrays_become_float64_and_classes_uint8() -> None:
    cloud = PointCloud(np.array([1, 2]), np.array([3, 4]), np.array([5, 6], dtype=np.float32), None, np.array([2, 9]))
    assert cloud.easting.dtype == cloud.elevation.dtype == np.float64
    assert cloud.classification is not None
    assert cloud.classification.dtype == np.uint8


def test_float64_arrays_are_not_copied() -> None:
    easting = np.zeros(3)
    assert PointCloud(easting, np.ones(3), np.ones(3)).easting is easting


@pytest.mark.parametrize("bad", [np.zeros(19), np.zeros((20, 1)), np.array(1.0)])
@pytest.mark.parametrize("name", ["northing", "elevation", "sigma", "classification"])
def test_arrays_of_other_shapes_are_refused(name: str, bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match=f"one length; got .*{name}"):
        survey(**{name: bad})


def test_region_is_west_east_south_north() -> None:
    assert survey(3).region == (5e5, 5e5 + 2, 5e6, 5e6 + 4)
    with pytest.raises(ValueError, match="no region"):
        _ = survey(0).region


def test_selecting_keeps_all_columns_together() -> None:
    cloud = survey(6, sigma=np.arange(1.0, 7.0), classification=np.arange(6))
    picked = cloud.select(np.array([4, 1]))
    assert picked.sigma is not None
    assert picked.classification is not None
    np.testing.assert_array_equal(picked.easting, [5e5 + 4, 5e5 + 1])
    np.testing.assert_array_equal(picked.sigma, [5, 2])
    np.testing.assert_array_equal(picked.classification, [4, 1])
    assert len(cloud.select(np.zeros(6, bool))) == 0


def test_concatenating_the_parts_gives_the_whole() -> None:
    cloud = survey(10, sigma=np.arange(1.0, 11.0), classification=np.arange(10))
    joined = PointCloud.concatenate(
        [cloud.select(slice(0, 4)), cloud.select(slice(4, 4)), cloud.select(slice(4, None))]
    )
    for name in ("easting", "northing", "elevation", "sigma", "classification"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(cloud, name))


def test_concatenating_nothing_gives_an_empty_cloud() -> None:
    assert len(PointCloud.concatenate([])) == 0


def test_points_without_class_become_never_classified_beside_others() -> None:
    joined = PointCloud.concatenate([survey(2, classification=np.array([2, 2])), survey(1)])
    assert joined.classification is not None
    np.testing.assert_array_equal(joined.classification, [2, 2, 0])


def test_concatenating_known_and_unknown_sigma_is_refused() -> None:
    with pytest.raises(ValueError, match="1 of 2 point clouds carry sigma"):
        PointCloud.concatenate([survey(2, sigma=np.ones(2)), survey(2)])


def test_a_good_survey_passes() -> None:
    check_points(survey(), "a.laz")
    check_points(survey(sigma=np.full(20, 0.05)), "a.laz")


@pytest.mark.parametrize("n", [0, 1, 9])
def test_fewer_than_ten_points_are_refused(n: int) -> None:
    with pytest.raises(InputDataError, match=rf"a\.laz: {n} usable point.*at least 10"):
        check_points(survey(n), "a.laz")
    check_count(n, "a.laz", minimum=n)


@pytest.mark.parametrize("name", ["easting", "northing", "elevation"])
@pytest.mark.parametrize(("value", "counts"), [(np.nan, "1 NaN, 0 infinite"), (-np.inf, "0 NaN, 1 infinite")])
def test_coordinates_that_are_not_finite_are_counted_and_located(name: str, value: float, counts: str) -> None:
    cloud = with_value(name, 7, value)
    with pytest.raises(InputDataError, match=rf"1 of 20 points have no finite {name} \({counts}\), first at point 7"):
        check_finite(cloud, "a.csv")
    with pytest.raises(InputDataError, match=f"no finite {name}"):
        check_points(cloud, "a.csv")


@pytest.mark.parametrize(
    ("name", "value"), [("elevation", -32768.0), ("elevation", 12_001.0), ("easting", 2e8), ("northing", -1e30)]
)
def test_absurd_coordinates_are_located_with_their_value(name: str, value: float) -> None:
    with pytest.raises(InputDataError, match=re.escape(f"absurd {name}, first at point 3: {value!s}")):
        check_values(with_value(name, 3, value), "a.csv")


def test_the_heights_and_depths_of_the_earth_pass() -> None:
    check_values(with_value("elevation", 0, 8_849.0), "a.csv")
    check_values(with_value("elevation", 0, -10_994.0), "a.csv")


@pytest.mark.parametrize("value", [0.0, -0.05, np.nan, np.inf])
def test_a_sigma_that_is_not_positive_is_refused(value: float) -> None:
    sigma = np.full(20, 0.05)
    sigma[[4, 9]] = value
    with pytest.raises(InputDataError, match=r"2 of 20 sigma values .* first at point 4"):
        check_values(survey(sigma=sigma), "a.csv")


def test_degrees_in_place_of_metres_are_recognised() -> None:
    i = np.arange(20.0)
    cloud = PointCloud(151.19 + i * 1e-5, -33.89 + i * 1e-5, i)
    with pytest.raises(InputDataError, match=r"look like degrees .* --crs EPSG:4326"):
        check_points(cloud, "a.csv")


def test_local_coordinates_around_zero_are_no_degrees() -> None:
    i = np.arange(-20.0, 20.0)
    check_points(PointCloud(i, i, i), "a.csv")
    check_not_degrees(PointCloud(np.zeros(3), np.zeros(3), np.zeros(3)), "a last, short chunk")
