"""Local frame against PROJ."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from changedetect.navigation.frame import EarthModel, LocalFrame


@pytest.mark.parametrize(
    "place", [(-33.89, 151.19, 40.0), (0.0, 0.0, 0.0), (89.9, -179.0, 3000.0), (45.3, -93.2, -50.0)]
)
def test_enu_agrees_with_projs_topocentric_conversion(place: tuple[float, float, float]) -> None:
    latitude, longitude, height = place
    pipeline = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={latitude} +lon_0={longitude} +h_0={height}"
    )
    rng = np.random.default_rng(1)
    lat, lon = latitude + rng.uniform(-0.05, 0.05, 20), longitude + rng.uniform(-0.05, 0.05, 20)
    h = height + rng.uniform(-100, 500, 20)
    expected = np.column_stack(pipeline.transform(lon, lat, h))
    frame = LocalFrame(*place)
    enu = frame.to_enu(lat, lon, h)
    assert_allclose(enu, expected, rtol=0, atol=1e-6)
    back = frame.to_geodetic(enu)
    assert_allclose(back[:, 0], lat, rtol=0, atol=1e-9)
    assert_allclose((back[:, 1] - lon + 180) % 360 - 180, 0.0, rtol=0, atol=1e-8)
    assert_allclose(back[:, 2], h, rtol=0, atol=1e-6)


@given(
    st.floats(-89.0, 89.0), st.floats(-180.0, 180.0), st.floats(-3e4, 3e4), st.floats(-3e4, 3e4), st.floats(-100, 9e3)
)
def test_to_geodetic_undoes_to_enu(lat: float, lon: float, east: float, north: float, up: float) -> None:
    frame = LocalFrame(lat, lon, 10.0)
    enu = np.array([east, north, up])
    assert_allclose(frame.to_enu(*frame.to_geodetic(enu)), enu, rtol=0, atol=1e-5)


@pytest.mark.parametrize("bad", [(91.0, 0.0, 0.0), (0.0, 400.0, 0.0), (0.0, 0.0, np.nan)])
def test_an_impossible_origin_is_refused(bad: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="not a latitude"):
        LocalFrame(*bad)


def test_normal_gravity_at_equator_and_pole() -> None:
    assert_allclose(EarthModel.at(LocalFrame(0.0, 0.0, 0.0)).gravity, 9.7803253359, rtol=1e-10, atol=0)
    assert_allclose(EarthModel.at(LocalFrame(90.0, 0.0, 0.0)).gravity, 9.8321849378, rtol=1e-9, atol=0)


def test_earth_rotation_points_north_at_the_equator_and_up_at_the_pole() -> None:
    assert_allclose(EarthModel.at(LocalFrame(0.0, 0.0, 0.0)).rotation, (0, 7.292115e-5, 0), rtol=0, atol=1e-18)
    assert_allclose(EarthModel.at(LocalFrame(90.0, 0.0, 0.0)).rotation, (0, 0, 7.292115e-5), rtol=0, atol=1e-18)
    assert EarthModel.at(LocalFrame(10.0, 0.0, 0.0), gravity=9.81).gravity == 9.81
