"""Rest from the IMU: a shaking car, one that glides, wrong speeds, gaps, and an odometer."""

from __future__ import annotations

import numpy as np

from factorgraph.measurements import ImuStream
from factorgraph.rest import inside, rest_spans, union, zero_spans
from factorgraph.types import Array

RATE_HZ = 100.0


def drive(shaken: float, rests: list[tuple[float, float]], seed: int = 0) -> tuple[ImuStream, Array, Array]:
    """A minute of an IMU that shakes by `shaken` m/s^2 in motion and by 0.1 at rest, with speeds once a second."""
    rng, seconds = np.random.default_rng(seed), 60.0
    t = np.arange(0, seconds, 1 / RATE_HZ)
    at_rest = np.any([(t >= a) & (t < b) for a, b in rests] or [np.zeros(len(t), bool)], axis=0)
    size = np.where(at_rest, 0.1, shaken)[:, None]
    f = rng.normal(0, 1, (len(t), 3)) * size + [0.05, -0.1, 9.8]
    w = rng.normal(0, 1, (len(t), 3)) * 0.1 * size + [0.004, -0.01, 0.002]
    known = np.arange(0, seconds, 1.0)
    standing = np.any([(known >= a - 1e-9) & (known < b) for a, b in rests] or [np.zeros(len(known), bool)], axis=0)
    return ImuStream(t, f, w), known, np.where(standing, 0.02, 12.0)


def test_stops_of_a_shaking_car() -> None:
    """Within half a window of the true stops, with and without known speeds, and nowhere else."""
    for seed in range(5):
        imu, t, speed = drive(0.6, [(5.0, 15.0), (40.0, 48.0)], seed=seed)
        for known in ((None, None), (t, speed)):
            spans = rest_spans(imu, *known)
            assert spans.shape == (2, 2)
            np.testing.assert_allclose(spans, [[5.0, 15.0], [40.0, 48.0]], atol=1.3)
            assert np.all(spans[:, 0] >= [4.95, 39.95]) and np.all(spans[:, 1] <= [15.05, 48.05])


def test_a_glide_is_no_rest_where_speeds_are_known() -> None:
    """In motion as quiet as at rest: without speeds the IMU cannot know, with a few of them no rest at all is claimed."""
    imu, t, speed = drive(0.1, [(5.0, 15.0)])
    assert rest_spans(imu).shape[0] == 1
    some = t < 30.0  # the rest of the ride is an outage
    assert not len(rest_spans(imu, t[some], speed[some]))


def test_a_steady_turn_is_no_rest() -> None:
    imu, _, _ = drive(0.6, [(5.0, 15.0), (30.0, 45.0)])
    turning = (imu.t_s >= 30.0) & (imu.t_s < 36.0)
    w = imu.w_b.copy()
    w[turning, 2] += 0.05
    spans = rest_spans(ImuStream(imu.t_s, imu.f_b, w))
    assert not np.any(inside(spans, np.arange(30.5, 35.0), np.arange(31.0, 35.5)))
    assert np.all(inside(spans, np.array([7.0, 38.0]), np.array([13.0, 43.0])))


def test_a_gap_ends_a_rest() -> None:
    imu, _, _ = drive(0.6, [(5.0, 25.0)])
    kept = (imu.t_s < 12.0) | (imu.t_s > 16.0)
    spans = rest_spans(ImuStream(imu.t_s[kept], imu.f_b[kept], imu.w_b[kept]))
    assert len(spans) == 2 and spans[0, 1] <= 12.0 and spans[1, 0] >= 16.0


def test_too_short_for_a_window() -> None:
    t = np.arange(5) / RATE_HZ
    assert rest_spans(ImuStream(t, np.ones((5, 3)), np.zeros((5, 3)))).shape == (0, 2)


def test_zero_readings_of_an_odometer() -> None:
    t = np.arange(0, 20.0, 0.2)
    speed = np.where((t > 4.9) & (t < 9.1), 0.01, 5.0)
    speed[(t > 11.9) & (t < 12.5)] = 0.0  # shorter than a window
    spans = zero_spans(t, speed, np.full(len(t), 0.05))
    np.testing.assert_allclose(spans, [[5.0, 9.0]])


def test_union_and_inside() -> None:
    spans = union(np.array([5.0, 0.0, 0.5, 9.0]), np.array([6.0, 2.0, 1.0, 9.5]))
    np.testing.assert_allclose(spans, [[0.0, 2.0], [5.0, 6.0], [9.0, 9.5]])
    start, end = np.array([0.0, 1.5, 5.5, -1.0, 9.2]), np.array([2.0, 2.5, 5.9, 0.5, 9.3])
    assert inside(spans, start, end).tolist() == [True, False, True, False, True]
    assert not inside(np.zeros((0, 2)), start, end).any()
