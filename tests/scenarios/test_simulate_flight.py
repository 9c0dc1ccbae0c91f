"""Whole simulated flights: descriptions, reproducibility, independence of sensors, flight folders."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.measurements import GnssStream, ImuStream, RangeStream, Truth
from scenarios.flights import load
from scenarios.simulate import Scenario, load_scenario, simulate
from scenarios.simulate.scenario import built_in, parse
from scenarios.simulate.write import write_flight

SMALL = """
[scenario]
name = "small"
t0 = 2024-03-01T12:00:00
origin = { lat_deg = -33.0, lon_deg = 151.0, h_m = 20.0 }
duration_s = 20.0

[[vehicle]]
name = "one"
trajectory = { kind = "manoeuvres", speed_mps = 15.0, segments = [{ duration_s = 20.0, turn_dps = 5.0 }] }
imu = { rate_hz = 100.0, gyro_gm_deg_h = 20.0, gyro_gm_s = 300.0 }
gnss = { lever_b = [0.0, 0.5, 0.2], multipath_m = 0.2 }
heights = [{ sigma_m = 0.3 }]
heading_hint = true

[[vehicle]]
name = "two"
trajectory = { kind = "formation", leader = "one", offset_m = [10.0, -10.0, 1.0] }
gnss = { rate_hz = 2.0, signals = ["E1C", "G1C", "G2W"], noise = { elevation = "flat" } }
positions = [{ rate_hz = 2.0 }]
motion = { accel_mps2_rthz = [2.0, 2.0, 1.0] }

[[range]]
tags = [{ name = "t1", vehicle = "one" }, { name = "t2", vehicle = "two" }, { name = "a", position_m = [0.0, 0.0, 3.0] }]
bias_sigma_m = 0.2

[[link]]
reference = "one"
rover = "two"

[settings]
max_state_interval_s = 0.5
"""
BASE = """
[[vehicle]]
name = "base"
is_base = true
trajectory = { kind = "static", r_n = [30.0, 40.0, 2.0] }
gnss = { lever_b = [0.0, 0.0, 1.5] }
"""


def with_base() -> Scenario:
    return parse(SMALL.replace("[[range]]", BASE + "\n[[range]]"))


@pytest.mark.parametrize("name", built_in())
def test_built_in_scenarios_simulate(name: str) -> None:
    scenario = load_scenario(name)
    flight = simulate(scenario, seed=3)
    assert flight.problem.name == name
    assert len(flight.problem.vehicles) == 1 or flight.problem.links
    assert all(vehicle.truth is not None for vehicle in flight.problem.vehicles)
    assert any(vehicle.gnss is not None or vehicle.positions for vehicle in flight.problem.vehicles)
    for vehicle in flight.problem.vehicles:
        if vehicle.gnss is None:
            continue
        counts = np.bincount(vehicle.gnss.stream.epoch)
        assert counts.min() >= 8
    for model in flight.problem.ranges:
        assert len(model.stream.t_s) > 600 and 3.0 < model.stream.range_m.min() < model.stream.range_m.max() < 250.0


def test_two_uav_fly_in_formation() -> None:
    one, two = (v.truth for v in simulate(load_scenario("two-uav"), seed=1).problem.vehicles)
    assert one is not None and two is not None and one.v_n is not None and two.v_n is not None
    distance = np.linalg.norm(one.r_n - two.r_n, axis=1)
    assert 20 < distance.min() and distance.max() < 70
    assert 15 < np.linalg.norm(two.v_n, axis=1).min() and np.linalg.norm(one.v_n, axis=1).max() < 30


def test_same_seed_same_flight_other_seed_other_noise() -> None:
    a, b, c = (simulate(parse(SMALL), seed).problem for seed in (1, 1, 2))
    for x, y in zip(a.vehicles, b.vehicles, strict=True):
        assert np.array_equal(x.gnss.stream.code_m, y.gnss.stream.code_m)  # type: ignore[union-attr]
    assert np.array_equal(a.ranges[0].stream.range_m, b.ranges[0].stream.range_m)
    assert np.all(a.vehicles[0].imu.f_b != c.vehicles[0].imu.f_b)  # type: ignore[union-attr]


def test_another_vehicle_leaves_the_others_noise_unchanged() -> None:
    a, b = simulate(parse(SMALL), 7).problem, simulate(with_base(), 7).problem
    assert len(b.vehicles) == 3 and b.vehicle("base").is_fixed
    np.testing.assert_allclose(b.vehicle("base").fixed_n, (30.0, 40.0, 3.5), atol=1e-9)  # type: ignore[arg-type]
    for v in a.vehicles:
        other = b.vehicle(v.name)
        _assert_same(v.gnss.stream, other.gnss.stream)  # type: ignore[union-attr]
        _assert_same(v.imu, other.imu)
    _assert_same(a.ranges[0].stream, b.ranges[0].stream)


def _assert_same(a: object, b: object, atol: float = 0.0) -> None:
    if a is None:
        assert b is None
        return
    assert isinstance(a, GnssStream | ImuStream | RangeStream | Truth) or dataclasses.is_dataclass(a)
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            np.testing.assert_allclose(y, x, rtol=0, atol=atol, err_msg=field.name)
        else:
            assert x == y, field.name


def test_a_written_flight_reads_back_as_the_same_problem(tmp_path: Path) -> None:
    flight = simulate(with_base(), 5)
    path = write_flight(flight, tmp_path / "folder")
    assert path.name == "flight.toml"
    loaded = load(tmp_path / "folder")
    ours, back = flight.problem, loaded.problem
    assert not any(report.dropped for report in loaded.reports)
    assert (back.t0, back.frame, back.links, back.pairs, back.settings) == (
        ours.t0,
        ours.frame,
        ours.links,
        ours.pairs,
        ours.settings,
    )
    for a, b in zip(ours.vehicles, back.vehicles, strict=True):
        assert (a.name, a.imu_noise, a.motion) == (b.name, b.imu_noise, b.motion)
        np.testing.assert_allclose(a.fixed_n or (), b.fixed_n or (), atol=1e-9)
        np.testing.assert_allclose(a.heading_hint_rad or 0.0, b.heading_hint_rad or 0.0, atol=1e-12)
        _assert_same(a.imu, b.imu)
        for x, y in zip((*a.positions, *a.heights), (*b.positions, *b.heights), strict=True):
            _assert_same(x, y)
        _assert_same(a.truth, b.truth, atol=1e-14)
        assert a.gnss is not None and b.gnss is not None
        assert (a.gnss.lever_b, a.gnss.noise) == (b.gnss.lever_b, b.gnss.noise)
        # RINEX holds 1 mm, 0.001 cycle, 0.001 Hz; twelve decimals of an orbit's numbers are 1 mm
        _assert_same(a.gnss.stream, b.gnss.stream, atol=1.5e-3)
    for m, n in zip(ours.ranges, back.ranges, strict=True):
        _assert_same(m.stream, n.stream)
        assert (m.bias_sigma_m, m.scale_sigma, m.per_pair) == (n.bias_sigma_m, n.scale_sigma, n.per_pair)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration_s = 20.0\n\n", "duration = 20.0\n\n", "scenario: unknown key duration; did you mean duration_s?"),
        ("rate_hz = 100.0", "rate_hz = -1", "rate_hz: Input should be greater than 0"),
        ('leader = "one"', 'leader = "won"', "cannot follow won"),
        ("max_state_interval_s", "max_state_intervals", "unknown key max_state_intervals; did you mean max_state_interval_s?"),
        ("turn_dps = 5.0", "turn_rate = 5.0", "unknown key turn_rate; did you mean turn_dps?"),
        ('vehicle = "two" }', 'vehicle = "too" }', "tag t2: no vehicle too; did you mean two?"),
        ("h_m = 20.0 }", "h_m = 20.0, heading_deg = 3 }", "origin.heading_deg"),
        ('name = "small"', "name = ", "scenario: "),
        ('name = "two"', 'name = "one"', "names of vehicles must be distinct; repeated: one"),
        ('name = "two"', 'name = "../two"', "vehicle[1].name: String should match pattern"),
        ('"G2W"]', '"G2"]', 'signal "G2": write system, band and attribute'),
    ],
)
def test_wrong_descriptions_name_the_key(old: str, new: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        simulate(parse(SMALL.replace(old, new, 1)), 0)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_unknown_scenarios_name_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no scenario or file two-uavs; did you mean two-uav\?"):
        load_scenario("two-uavs")
    with pytest.raises(InputError, match=os.strerror(21)):
        load_scenario(tmp_path)
    own = tmp_path / "own.toml"
    own.write_text(SMALL, encoding="utf-8")
    assert load_scenario(own).scenario.name == "small"
