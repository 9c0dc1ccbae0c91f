"""The common time grid of a problem's states."""

from __future__ import annotations

import numpy as np

from factorgraph.errors import InputError
from factorgraph.problem import NavigationProblem, Vehicle
from factorgraph.types import Array

MERGE_S = 0.02
MAX_STATES = 400_000


def _own_times(problem: NavigationProblem, vehicle: Vehicle) -> Array:
    """Times at which a vehicle wants a state of its own."""
    times = [np.zeros(0)]
    if vehicle.gnss is not None and not vehicle.is_fixed:
        times.append(vehicle.gnss.stream.t_s)
    times += [p.t_s for p in vehicle.positions]
    if vehicle.imu is None and not vehicle.is_fixed:  # nothing carries its measurements between states
        times += [h.t_s for h in vehicle.heights]
        for model in problem.ranges:
            stream = model.stream
            mine = np.array([tag.vehicle == vehicle.name for tag in stream.tags])
            times.append(stream.t_s[mine[stream.tag_a] | mine[stream.tag_b]])
        times += [s.t_s for s in problem.visions if s.target.vehicle == vehicle.name]
    return np.concatenate(times)


def _all_times(problem: NavigationProblem, vehicle: Vehicle) -> Array:
    times = [_own_times(problem, vehicle), *(h.t_s for h in vehicle.heights)]
    times += vehicle.motion_times
    times += [s.t_s for s in problem.visions if vehicle.name in (s.observer.vehicle, s.target.vehicle)]
    for model in problem.ranges:
        mine = np.array([tag.vehicle == vehicle.name for tag in model.stream.tags])
        times.append(model.stream.t_s[mine[model.stream.tag_a] | mine[model.stream.tag_b]])
    return np.concatenate(times)


def subdivided(edges: Array, step_s: float) -> Array:
    """Times (n,) from the first of `edges` to the last, equally spaced between them by no more than a step."""
    count = np.maximum(1, np.ceil(np.diff(edges) / step_s - 1e-6)).astype(int)
    inner = [a + (b - a) * np.arange(n) / n for a, b, n in zip(edges[:-1], edges[1:], count, strict=True)]
    return np.concatenate([*inner, edges[-1:]])


def common_grid(problem: NavigationProblem) -> Array:
    """State times (K,): measurement epochs of every moving vehicle, merged, gaps filled to `max_state_interval_s`.

    The span is where measurements are and every IMU runs. Raises InputError when there is no such span.
    """
    moving = [v for v in problem.bodies if not v.is_fixed]
    if not moving:
        raise InputError("no vehicle moves: every vehicle has a fixed position")
    measured = np.concatenate([_all_times(problem, v) for v in problem.vehicles if not v.is_fixed])
    if not len(measured):
        raise InputError("nothing to estimate from: no vehicle has GNSS, positions, ranges or another sensor beside an IMU")
    first, last = float(measured.min()), float(measured.max())
    for v in moving:
        if v.imu is not None:
            start, stop = float(v.imu.t_s[0]), float(v.imu.t_s[-1])
            if start >= last or stop <= first:
                raise InputError(
                    f"vehicle {v.name}: its IMU runs from {start:.1f} to {stop:.1f} s but the other measurements are from "
                    f"{first:.1f} to {last:.1f} s after t0; check time systems, leap seconds and time offsets"
                )
            first, last = max(first, start), min(last, stop)
    if last - first < 1e-3:
        raise InputError(f"sensors overlap for only {max(last - first, 0):.3f} s: nothing to smooth")
    own = np.unique(np.concatenate([_own_times(problem, v) for v in problem.vehicles if not v.is_fixed]))
    own = own[(own >= first - 1e-9) & (own <= last + 1e-9)]
    edges = own if len(own) else np.array([first])
    if edges[0] - first > MERGE_S:
        edges = np.concatenate([[first], edges])
    if last - edges[-1] > MERGE_S:
        edges = np.concatenate([edges, [last]])
    keep = np.concatenate([[True], np.diff(edges) > (MERGE_S if all(v.imu is not None for v in moving) else 1e-3)])
    edges = edges[keep]
    step = problem.settings.max_state_interval_s
    if (last - first) / step + len(edges) > MAX_STATES:
        states = (last - first) / step
        raise InputError(
            f"the flight spans {last - first:.0f} s and would need {states:.0f} states; check for a wrong time stamp "
            f"or raise settings.max_state_interval_s above {step} s"
        )
    return subdivided(edges, step)
