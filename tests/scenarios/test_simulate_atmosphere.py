"""Fields of the simulated atmosphere: their size, their reach, the same for every receiver, none where none is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.types import Array
from scenarios.simulate import load_scenario, simulate
from scenarios.simulate.atmosphere import DISTURBANCES, WEATHER, Rays, Waves, ionosphere_m, pierced, wet_m
from scenarios.studies import replace_duration

ORIGIN = (0.8, 0.2)


def rays(n: int, el_deg: float, h_m: float = 100.0, east_m: Array | float = 0.0) -> Rays:
    rng = np.random.default_rng(1)
    lon = ORIGIN[1] + np.broadcast_to(east_m, n) / 6_371_000.0 / np.cos(ORIGIN[0])
    el = np.full(n, np.deg2rad(el_deg))
    return Rays(rng.uniform(0, 600, n), np.full(n, ORIGIN[0]), lon, np.full(n, h_m), rng.uniform(0, 2 * np.pi, n), el)


@pytest.mark.parametrize(("kind", "near_m", "far_m"), [(DISTURBANCES, 2e3, 2e5), (WEATHER, 3e2, 4e4)])
def test_waves_have_unit_variance_and_a_reach(
    kind: tuple[tuple[float, float], tuple[float, float]], near_m: float, far_m: float
) -> None:
    rng = np.random.default_rng(2)
    values = []
    for _ in range(60):
        waves = Waves.drawn(rng, *kind, together=kind is WEATHER)
        x = np.array([[0.0, 0.0], [near_m, 0.0], [far_m, 0.0], [0.0, far_m]])
        values.append(waves.at(x, np.full(4, 10.0)))
    v = np.array(values)
    assert v.std() == pytest.approx(1.0, abs=0.15)
    assert np.std(v[:, 1] - v[:, 0]) < 0.15 < 0.6 < np.std(v[:, 2] - v[:, 0])


def test_rays_pierce_overhead_and_far_away() -> None:
    lat, lon, slant = pierced(rays(5, 90.0))
    np.testing.assert_allclose([lat, lon], [np.full(5, ORIGIN[0]), np.full(5, ORIGIN[1])], atol=1e-9)
    np.testing.assert_allclose(slant, 1.0)
    lat, _, slant = pierced(rays(200, 10.0))
    assert 900e3 < 6_371_000 * np.abs(lat - ORIGIN[0]).max() < 1400e3 and 2.2 < slant[0] < 3.0


def test_a_gradient_is_what_it_says() -> None:
    """Vertical delays 20 km apart along its direction: millimetres per kilometre."""
    rng = np.random.default_rng(3)
    changes = []
    for _ in range(40):
        seed = int(rng.integers(1 << 30))
        a, b = (ionosphere_m(rays(1, 90.0, east_m=x), 0.0, 2.0, np.random.default_rng(seed), ORIGIN)[0] for x in (0.0, 20e3))
        changes.append(b - a)
    assert np.abs(changes).max() == pytest.approx(0.04, rel=0.05) and np.std(changes) == pytest.approx(0.04 / np.sqrt(2), rel=0.3)


def test_wet_delays_fall_off_with_height_and_grow_to_the_horizon() -> None:
    places = (rays(9, 90.0), rays(9, 90.0, 4100.0), rays(9, 10.0))
    low, high, flat = (np.abs(wet_m(r, 0.02, np.random.default_rng(4), ORIGIN)) for r in places)
    np.testing.assert_allclose(high / low, np.exp(-2.0), rtol=1e-9)
    np.testing.assert_allclose(flat / low, 5.6, rtol=0.02)
    assert not np.any(wet_m(rays(3, -5.0), 0.02, np.random.default_rng(4), ORIGIN))


def test_receivers_share_the_fields_and_scenarios_without_have_none() -> None:
    """Differential delays of 20 km: centimetres that differ from satellite to satellite; of one place none."""
    scenario = replace_duration(load_scenario("long-baseline"), 20.0)
    calm = scenario.model_copy(update={"environment": scenario.environment.model_copy(
        update={"wet_m": 0.0, "ionosphere_waves_m": 0.0, "ionosphere_gradient_ppm": 0.0})})  # fmt: skip
    disturbed, without = (simulate(s, 5).problem for s in (scenario, calm))
    change = []
    for a, b in zip(disturbed.vehicles, without.vehicles, strict=True):
        assert a.gnss is not None and b.gnss is not None
        lam = b.gnss.stream.wavelength_m
        code, phase = a.gnss.stream.code_m - b.gnss.stream.code_m, (a.gnss.stream.phase_cyc - b.gnss.stream.phase_cyc) * lam
        # code and phase are bent opposite ways: their sum is twice the wet delay
        assert np.abs(code + phase).max() < 0.5 and np.abs(code - phase).max() > 0.1
        first = b.gnss.stream.epoch == 10
        names = np.array(b.gnss.stream.satellites)[b.gnss.stream.sat[first]]
        signals = np.array(b.gnss.stream.signals)[b.gnss.stream.signal[first]]
        change.append(dict(zip(zip(names.tolist(), signals.tolist(), strict=True), code[first].tolist(), strict=True)))
    common = sorted(set(change[0]) & set(change[1]))
    difference = np.array([change[1][k] - change[0][k] for k in common])
    assert len(common) > 20 and 0.005 < np.std(difference) < 0.3
