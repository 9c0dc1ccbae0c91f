"""State times, start attitudes and methods by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.attitude import log_so3, matrix_from_euler
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.grid import common_grid
from factorgraph.measurements import HeightStream, ImuStream, PositionStream, RangeStream, Tag
from factorgraph.models.strapdown import ideal_imu
from factorgraph.problem import NavigationProblem, RangeModel, Settings, Vehicle
from factorgraph.registry import create, methods
from factorgraph.start import align, interpolate, rest_bias
from factorgraph.types import Array

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


def flown(t: Array, turning: bool, heading_rad: float = 2.0) -> tuple[Array, Array, Array]:
    """Level turns with coordinated bank, nose along the track, or a straight line at rest speed zero."""
    if not turning:
        n = len(t)
        return np.zeros((n, 3)), np.zeros((n, 3)), np.tile(matrix_from_euler(0.05, -0.03, heading_rad), (n, 1, 1))
    speed, rate = 20.0, 0.1
    psi = heading_rad + rate * t
    v = speed * np.column_stack([np.sin(psi), np.cos(psi), np.zeros_like(t)])
    r = speed / rate * np.column_stack([-np.cos(psi), np.sin(psi), np.zeros_like(t)])
    return r, v, matrix_from_euler(np.zeros_like(t), np.full_like(t, np.arctan(speed * rate / 9.81)), psi)


def aligned(turning: bool, hint: float | None, noise_mps: float = 0.0, bias: float = 0.0) -> tuple[Array, Array, Array]:
    """Attitude errors (K, 3) about east, north, up, the bias found, and the true attitudes."""
    grid = np.arange(31.0)
    t = np.arange(-1, 3101) / 100.0
    r, v, C = flown(t, turning)
    f, w = (x[1:] for x in ideal_imu(FRAME, t, r, v, C))
    imu = ImuStream(t[1:], f, w + bias, True)
    r, v, true = flown(grid, turning)
    noisy = v + np.random.default_rng(0).normal(0.0, noise_mps, v.shape)
    found, b = align(imu, grid, r, noisy, FRAME, hint)
    return log_so3(found @ np.swapaxes(true, 1, 2)), b, true


@pytest.mark.parametrize(("noise_mps", "bound_rad"), [(0.0, 0.02), (0.3, 0.15)])
def test_a_turning_vehicle_is_aligned_without_a_hint(noise_mps: float, bound_rad: float) -> None:
    error, _, _ = aligned(turning=True, hint=None, noise_mps=noise_mps)
    assert np.linalg.norm(error, axis=1).max() < bound_rad


def test_a_vehicle_at_rest_levels_and_takes_the_declared_heading() -> None:
    error, bias, _ = aligned(turning=False, hint=2.0, bias=0.01)
    assert np.abs(error).max() < 0.005
    np.testing.assert_allclose(bias, 0.01, atol=2e-4)  # the Earth's rate is taken for bias: 7e-5
    no_hint, _, _ = aligned(turning=False, hint=None)
    assert np.abs(no_hint[:, :2]).max() < 0.005 and np.ptp(no_hint[:, 2]) < 0.02  # level, heading unknown but steady


def test_heading_from_motion_goes_back_to_the_rest_before() -> None:
    """Twenty seconds at rest, then straight ahead: the gyroscope knows that the vehicle stood as it left."""
    grid, t = np.arange(41.0), np.arange(-1, 4101) / 100.0
    heading = 2.0

    def straight(at: Array) -> tuple[Array, Array, Array]:
        since = np.maximum(at - 20.0, 0.0)[:, None]
        ahead = np.array([np.sin(heading), np.cos(heading), 0.0])
        return since**2 * ahead, 2 * since * ahead, np.tile(matrix_from_euler(0.02, -0.03, heading), (len(at), 1, 1))

    f, w = (x[1:] for x in ideal_imu(FRAME, t, *straight(t)))
    r, v, true = straight(grid)
    found, _ = align(ImuStream(t[1:], f, w, True), grid, r, v, FRAME, None)
    assert np.linalg.norm(log_so3(found @ np.swapaxes(true, 1, 2)), axis=1).max() < 0.05


def test_motion_overrules_a_wrong_hint() -> None:
    error, _, _ = aligned(turning=True, hint=-1.0)
    assert np.linalg.norm(error, axis=1).max() < 0.02


def test_no_rest_no_bias() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(2000) / 100.0
    shaken = ImuStream(t, rng.normal(0, 2, (2000, 3)) + [0, 0, 9.8], rng.normal(0.1, 0.5, (2000, 3)), True)
    np.testing.assert_array_equal(rest_bias(shaken), 0.0)
    calm = np.where((t > 10)[:, None], 0.003, shaken.w_b)
    force = np.where((t > 10)[:, None], np.array([0.0, 0.0, 9.8]), shaken.f_b)
    np.testing.assert_allclose(rest_bias(ImuStream(t, force, calm, True)), 0.003, atol=1e-12)  # later rest counts too


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
