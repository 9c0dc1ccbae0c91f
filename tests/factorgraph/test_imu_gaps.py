"""Missing IMU samples: where they are, what stands for them, and what a solution says of them and of absent positions."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.assembly.remarks import LISTED_GAPS, gap_remarks, unplaced_notes
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import HeightStream, ImuStream, PositionStream, RangeStream, Tag
from factorgraph.models.preintegration import crossing, gaps, integrate, sample_means
from factorgraph.problem import Link, NavigationProblem, RangeModel, Vehicle
from factorgraph.types import Array

FRAME = LocalFrame(np.deg2rad(45.0), np.deg2rad(10.0), 100.0)


def imu_at(t_s: Array, is_mean: bool = False) -> ImuStream:
    """Constant force and rate at times t_s (n,)."""
    return ImuStream(t_s, np.tile([0.1, 0.2, 9.8], (len(t_s), 1)), np.tile([0.0, 0.0, 0.3], (len(t_s), 1)), is_mean)


def without(t_s: Array, *missing: tuple[float, float]) -> Array:
    for start, end in missing:
        t_s = t_s[(t_s <= start + 1e-9) | (t_s >= end - 1e-9)]
    return t_s


@pytest.mark.parametrize(
    ("rate_hz", "missing", "found"),
    [
        (100.0, [], []),
        (100.0, [(1.0, 1.09)], []),  # late samples, no longer than 0.1 s
        (100.0, [(1.0, 1.5), (2.0, 5.0)], [(1.0, 1.5), (2.0, 5.0)]),
        (10.0, [(1.0, 1.9)], []),  # not longer than ten samples
        (10.0, [(1.0, 2.5)], [(1.0, 2.5)]),
        (0.5, [], []),
    ],
)
def test_gaps_are_longer_than_a_tenth_of_a_second_and_ten_samples(
    rate_hz: float, missing: list[tuple[float, float]], found: list[tuple[float, float]]
) -> None:
    imu = imu_at(without(np.arange(0.0, 20.0, 1 / rate_hz), *missing))
    np.testing.assert_allclose(gaps(imu), np.array(found).reshape(-1, 2), atol=1e-9)


def test_a_recording_too_short_to_have_an_interval_has_no_gaps() -> None:
    assert gaps(imu_at(np.array([0.0, 5.0]))).shape == (0, 2)
    assert gaps(imu_at(np.array([3.0]))).shape == (0, 2)


def test_intervals_that_only_touch_a_gap_do_not_cross_it() -> None:
    found = np.array([[1.0, 2.0], [4.0, 4.5]])
    start = np.array([0.0, 0.0, 1.2, 2.0, 1.9, 3.0, 4.5, 0.0])
    stop = np.array([1.0, 1.1, 1.3, 4.0, 3.0, 9.0, 9.0, 9.0])
    assert crossing(found, start, stop).tolist() == [False, True, True, False, True, True, False, True]
    assert not crossing(np.zeros((0, 2)), start, stop).any()


@pytest.mark.parametrize("is_mean", [False, True])
def test_samples_around_a_gap_stand_for_those_missing(is_mean: bool) -> None:
    imu = imu_at(without(np.arange(0.0, 4.0, 0.01), (1.0, 3.0)), is_mean)
    last = int(np.searchsorted(imu.t_s, 1.0 + 1e-6)) - 1
    imu.w_b[last], imu.w_b[last + 1] = [0.0, 0.0, 5.0], [0.0, 0.0, -5.0]
    edges, _, w = sample_means(imu)
    np.testing.assert_allclose(edges[last + 1 : last + 3], [1.0, 3.0])
    np.testing.assert_allclose(w[last + 1], [0.0, 0.0, 0.27])  # two of twenty are wrong, and cancel
    before = integrate(imu, np.array([0.5]), np.array([1.0]), np.zeros((1, 6))).dR[0]
    over = integrate(imu, np.array([0.5]), np.array([3.0]), np.zeros((1, 6))).dR[0]
    turned = np.arctan2(*(before.T @ over)[[1, 0], 0])
    assert turned == pytest.approx(2 * 0.27)


def flight(imu: ImuStream, heights_s: Array) -> tuple[NavigationProblem, list[VehicleVariables]]:
    n = len(heights_s)
    heights = HeightStream(heights_s, np.zeros(n), np.ones(n))
    vehicle = Vehicle("one", imu=imu, heights=(heights,))
    problem = NavigationProblem("gaps", GpsTime(2300, 0.0), FRAME, (vehicle,))
    return problem, [VehicleVariables(0, vehicle, np.arange(11.0), FRAME)]


def test_only_points_before_a_gap_follow_from_their_state() -> None:
    _, (v,) = flight(imu_at(without(np.arange(0.0, 10.005, 0.01), (2.5, 4.2))), np.arange(10.0))
    t = np.array([2.0, 2.4, 2.5, 2.6, 3.0, 3.01, 3.1, 4.1, 4.5, 5.0, 5.5])
    carried = [True, True, True, False, True, True, False, False, False, True, True]
    assert v.is_carried(t).tolist() == carried
    free = VehicleVariables(0, v.vehicle, np.arange(11.0), FRAME, use_imu=False)
    assert free.is_carried(t).all()


def test_short_gaps_are_notes_and_long_ones_warnings() -> None:
    imu = imu_at(without(np.arange(0.0, 10.005, 0.01), (2.5, 2.9), (6.0, 8.0)))
    notes, warnings = gap_remarks(*flight(imu, np.arange(0.2, 10.0, 0.5)))
    assert warnings == ["one: no IMU samples from 6.00 to 8.00 s; attitude and motion in between are poorly known"]
    assert notes[0].startswith("one: no IMU samples from 2.50 to 2.90 s;")
    assert notes[1].startswith("one: 5 measurements without IMU samples")
    assert len(notes) == 2


def test_many_gaps_are_summed_up_and_those_outside_the_states_left_out() -> None:
    many = [(k + 0.2, k + 0.5) for k in range(10)]
    imu = imu_at(without(np.arange(-5.0, 30.0, 0.01), (-3.0, -1.0), *many, (20.0, 25.0)))
    (note, _), warnings = gap_remarks(*flight(imu, np.arange(0.0, 10.0, 0.5)))
    assert not warnings
    assert note.count("from ") == LISTED_GAPS + 1  # "follows from" at its end
    assert f"and {10 - LISTED_GAPS} times more ({(10 - LISTED_GAPS) * 0.3:.1f} s)" in note


def _ranges(*tags: Tag, pairs: tuple[tuple[int, int], ...]) -> RangeModel:
    a, b = np.array(pairs).T
    n = len(pairs)
    return RangeModel(RangeStream(np.arange(float(n)), a, b, tags, np.ones(n), np.ones(n)))


@pytest.mark.parametrize(
    ("placed", "pairs", "unplaced"),
    [
        ("", [(0, 1), (1, 2)], ["a, b, c"]),
        ("c", [(0, 1), (1, 2)], []),
        ("c", [(0, 1)], ["a, b"]),
        ("", [(0, 1), (2, 3)], ["a, b"]),  # c ranges to the anchor
        ("b", [(0, 1), (2, 3)], []),
    ],
)
def test_groups_without_absolute_positions_are_named(placed: str, pairs: list[tuple[int, int]], unplaced: list[str]) -> None:
    fix = PositionStream(np.zeros(1), np.zeros((1, 3)), np.ones((1, 3)))
    vehicles = tuple(Vehicle(name, positions=(fix,) if name == placed else ()) for name in "abc")
    tags = (*(Tag(name, vehicle=name) for name in "abc"), Tag("anchor", position_n=(0.0, 0.0, 0.0)))
    ranges = (_ranges(*tags, pairs=tuple(pairs)),)
    problem = NavigationProblem("swarm", GpsTime(2300, 0.0), FRAME, vehicles, ranges=ranges)
    assert [note.split(":")[0] for note in unplaced_notes(problem)] == unplaced


def test_a_link_ties_vehicles_to_a_base() -> None:
    vehicles = (Vehicle("base", fixed_n=(0.0, 0.0, 0.0)), Vehicle("rover"))
    linked = NavigationProblem("pair", GpsTime(2300, 0.0), FRAME, vehicles, links=(Link("base", "rover"),))
    assert unplaced_notes(linked) == []
    assert len(unplaced_notes(NavigationProblem("pair", GpsTime(2300, 0.0), FRAME, vehicles))) == 1
