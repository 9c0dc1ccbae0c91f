"""Atmosphere against RTKLIB and against what the physics must do."""

import numpy as np
import pytest

from factorgraph.models import atmosphere
from factorgraph.types import Array

KLOBUCHAR = np.array([8.3819e-09, 1.4901e-08, -5.9605e-08, -5.9605e-08, 8.3968e04, 1.6384e04, -1.3107e05, -6.5536e04])


def directions(rng: np.random.Generator, n: int) -> tuple[Array, Array, Array, Array, Array]:
    lat, lon = np.deg2rad(rng.uniform(-85, 85, n)), np.deg2rad(rng.uniform(-180, 180, n))
    return lat, lon, rng.uniform(0, 9000, n), np.deg2rad(rng.uniform(0, 360, n)), np.deg2rad(rng.uniform(1, 90, n))


def test_both_agree_with_rtklib() -> None:
    rtklib = pytest.importorskip("pyrtklib5")
    rng = np.random.default_rng(3)
    lat, lon, h, az, el = directions(rng, 300)
    tow = rng.uniform(0, 604_800, 300)
    ours_t = atmosphere.troposphere_m(lat, h, el)
    ours_i = atmosphere.klobuchar_m(KLOBUCHAR, tow, lat, lon, az, el)
    pos, azel, ion = rtklib.Arr1Ddouble(3), rtklib.Arr1Ddouble(2), rtklib.Arr1Ddouble(8)
    for k in range(8):
        ion[k] = KLOBUCHAR[k]
    for i in range(300):
        pos[0], pos[1], pos[2], azel[0], azel[1] = lat[i], lon[i], h[i], az[i], el[i]
        time = rtklib.gpst2time(2176, tow[i])
        assert ours_t[i] == pytest.approx(rtklib.tropmodel(time, pos, azel, 0.7), abs=1e-6)
        assert ours_i[i] == pytest.approx(rtklib.ionmodel(time, ion, pos, azel), abs=1e-6)


def test_zenith_delays_have_their_size() -> None:
    assert atmosphere.troposphere_m(np.deg2rad(45), 0.0, np.pi / 2) == pytest.approx(2.4, abs=0.1)
    night = atmosphere.klobuchar_m(KLOBUCHAR, np.array([2 * 3600.0]), np.deg2rad(45), 0.0, np.zeros(1), np.array([np.pi / 2]))
    assert night[0] == pytest.approx(1.5, abs=0.01)  # 5 ns at night


def test_delay_grows_towards_the_horizon_and_shrinks_with_height() -> None:
    el = np.deg2rad(np.arange(5.0, 90.0))
    assert np.all(np.diff(atmosphere.troposphere_m(0.8, 100.0, el)) < 0)
    assert np.all(np.diff(atmosphere.klobuchar_m(KLOBUCHAR, np.full(el.size, 7200.0), 0.8, 0.1, np.zeros(el.size), el)) < 0)
    assert np.all(np.diff(atmosphere.troposphere_m(0.8, np.linspace(0, 9e3, 20), 0.5)) < 0)


def test_below_the_horizon_is_zero_and_absent_stays_absent() -> None:
    el = np.array([-0.1, np.nan])
    tropo = atmosphere.troposphere_m(0.8, 100.0, el)
    iono = atmosphere.klobuchar_m(KLOBUCHAR, np.zeros(2), 0.8, 0.1, np.zeros(2), el)
    assert tropo[0] == 0 and iono[0] == 0
    assert np.isnan(tropo[1]) and np.isnan(iono[1])


def test_niells_mapping_is_rtklibs() -> None:
    rtklib = pytest.importorskip("pyrtklib5")
    rng = np.random.default_rng(4)
    lat, _, h, _, el = directions(rng, 100)
    el = np.maximum(el, np.deg2rad(3.0))
    pos, azel, wet = rtklib.Arr1Ddouble(3), rtklib.Arr1Ddouble(2), rtklib.Arr1Ddouble(1)
    for i in range(100):
        time = rtklib.gpst2time(2300, rng.uniform(0, 604_800) + 604_800 * rng.integers(0, 52))
        pos[0], pos[1], pos[2], azel[0], azel[1] = lat[i], 0.2, h[i], 0.3, el[i]
        day = rtklib.time2doy(time)
        assert atmosphere.niell_dry(lat[i], h[i], el[i], day) == pytest.approx(rtklib.tropmapf(time, pos, azel, wet), rel=1e-9)
        assert atmosphere.niell_wet(lat[i], el[i]) == pytest.approx(wet[0], rel=1e-9)


def test_mappings_agree_where_the_earth_is_flat() -> None:
    el = np.deg2rad(np.array([90.0, 60.0, 30.0, 15.0, 5.0]))
    plain, niell = (atmosphere.troposphere_m(0.8, 100.0, el, day_of_year=day) for day in (None, 150.0))
    share = niell / plain
    np.testing.assert_allclose(share[:2], 1.0, atol=1e-3)
    assert np.all(np.diff(share) < 0) and 0.85 < share[-1] < 0.9
    below = atmosphere.troposphere_m(0.8, 100.0, np.array([-0.1, np.nan]), day_of_year=150.0)
    assert below[0] == 0 and np.isnan(below[1])
