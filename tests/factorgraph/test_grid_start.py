"""State times, start values and methods by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.grid import common_grid
from factorgraph.measurements import HeightStream, ImuStream, PositionStream, RangeStream, Tag
from factorgraph.problem import NavigationProblem, RangeModel, Settings, Vehicle
from factorgraph.registry import create, methods
from factorgraph.sampling import interpolate

FRAME = LocalFrame(np.deg2rad(50.0), np.deg2rad(8.0), 300.0)


def imu_over(start_s: float, stop_s: float) -> ImuStream:
    t = np.arange(start_s, stop_s + 1e-9, 0.01)
    return ImuStream(t, np.tile([0.0, 0.0, 9.8], (len(t), 1)), np.zeros((len(t), 3)), True)


def fixes(*t: float) -> PositionStream:
    return PositionStream(np.array(t), np.zeros((len(t), 3)), np.ones((len(t), 3)))


def problem_of(*vehicles: Vehicle, ranges: tuple[RangeModel, ...] = (), step_s: float = 1.0) -> NavigationProblem:
    settings = Settings(max_state_interval_s=step_s)
    return NavigationProblem("grid", GpsTime(2300, 0.0), FRAME, vehicles, ranges=ranges, settings=settings)


# -- grid ------------------------------------------------------------------------------------------


def test_states_stand_at_measurements_and_fill_gaps_evenly() -> None:
    grid = common_grid(problem_of(Vehicle("a", imu=imu_over(0.0, 10.0), positions=(fixes(1.0, 2.0, 4.5, 5.0),))))
    np.testing.assert_allclose(grid, [1.0, 2.0, 2.0 + 2.5 / 3, 2.0 + 5.0 / 3, 4.5, 5.0], atol=1e-12)


@pytest.mark.parametrize("step_s", [0.1, 0.4, 1.0])
def test_no_interval_is_longer_than_asked(step_s: float) -> None:
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0, 40, 30))
    grid = common_grid(problem_of(Vehicle("a", imu=imu_over(0.0, 40.0), positions=(fixes(*times),)), step_s=step_s))
    gaps = np.diff(grid)
    assert gaps.min() > 0 and gaps.max() <= step_s * (1 + 1e-6)


def test_measurements_of_two_vehicles_nearly_at_once_share_a_state() -> None:
    vehicles = [
        Vehicle(n, imu=imu_over(0.0, 5.0), positions=(fixes(*(np.arange(1.0, 4.5) + d)),)) for n, d in (("a", 0.0), ("b", 0.015))
    ]
    np.testing.assert_allclose(common_grid(problem_of(*vehicles)), np.arange(1.0, 4.5), atol=1e-12)


def test_the_span_is_where_every_imu_runs() -> None:
    a = Vehicle("a", imu=imu_over(2.0, 20.0), positions=(fixes(*np.arange(0.0, 31.0)),))
    b = Vehicle("b", imu=imu_over(0.0, 12.5), positions=(fixes(*np.arange(0.0, 31.0)),))
    grid = common_grid(problem_of(a, b))
    assert grid[0] == pytest.approx(2.0) and grid[-1] == pytest.approx(12.5)


def test_without_imu_every_range_and_height_has_its_state() -> None:
    """Nothing carries their measurements between states; with an IMU preintegration does."""
    t = np.array([0.3, 0.7, 1.1])
    tags = (Tag("ta", "a"), Tag("x", position_n=(0.0, 0.0, 0.0)))
    ranges = RangeModel(RangeStream(t, np.zeros(3, int), np.ones(3, int), tags, np.ones(3), np.ones(3)))
    heights = (HeightStream(np.array([0.5]), np.zeros(1), np.ones(1)),)
    plain = Vehicle("a", positions=(fixes(0.0, 2.0),), heights=heights)
    grid = common_grid(problem_of(plain, ranges=(ranges,)))
    assert np.all(np.isin([0.0, 0.3, 0.5, 0.7, 1.1, 2.0], grid))
    carried = common_grid(problem_of(replace(plain, imu=imu_over(-1.0, 3.0)), ranges=(ranges,)))
    np.testing.assert_allclose(carried, [0.0, 1.0, 2.0])


@pytest.mark.parametrize(
    ("vehicle", "message"),
    [
        (Vehicle("base", fixed_n=(0.0, 0.0, 0.0)), "no vehicle moves"),
        (Vehicle("a", imu=imu_over(0.0, 10.0)), "nothing to estimate from"),
        (Vehicle("a", imu=imu_over(0.0, 10.0), positions=(fixes(18.0, 20.0),)), "leap seconds"),
        (Vehicle("a", positions=(fixes(5.0),)), "nothing to smooth"),
        (Vehicle("a", positions=(fixes(0.0, 1e9),)), "wrong time stamp"),
    ],
)
def test_spans_that_cannot_be(vehicle: Vehicle, message: str) -> None:
    with pytest.raises(InputError, match=message):
        common_grid(problem_of(vehicle))


# -- start -----------------------------------------------------------------------------------------


def test_interpolation_passes_over_missing_rows() -> None:
    x = np.array([[0.0, 1.0], [np.nan, 5.0], [2.0, 3.0]])
    found = interpolate(np.array([-1.0, 0.5, 1.0, 9.0]), np.arange(3.0), x)
    np.testing.assert_allclose(found, np.array([[0.0, 1.0], [0.5, 1.5], [1.0, 2.0], [2.0, 3.0]]))


# -- methods ---------------------------------------------------------------------------------------


def test_methods_by_name() -> None:
    assert "graph" in methods()
    assert create("graph").summary
    with pytest.raises(InputError, match="did you mean graph"):
        create("grpah")
