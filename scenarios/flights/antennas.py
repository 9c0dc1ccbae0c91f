"""Two antennas of one vehicle: do they stand as their lever arms say?

Of a vehicle that moves forward, the course resolves the vector between them along and across the vehicle. Where it points
the other way than the difference of the lever arms, the antennas (or their files) are interchanged; across, the lever arms
have other axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from factorgraph.problem import NavigationProblem, Vec3, Vehicle
from factorgraph.types import Array
from scenarios.flights.epochs import every, points

MOVING_MPS = 2.0
STEP_S = 0.5  # least time between positions whose difference is the course
MIN_LENGTH_M = 0.3  # horizontal, between lever arms
MIN_POINTS, BLOCKS = 40, 16
SURE = 6.0  # standard deviations
SAME_S = 0.02
MAX_EPOCHS = 1500


@dataclass(frozen=True, slots=True)
class _Path:
    """Positions (n, 3) in n of an antenna."""

    name: str
    t_s: Array
    r_n: Array
    lever_b: Vec3


def doubts(vehicle: Vehicle, problem: NavigationProblem) -> Iterator[str]:
    """What is doubtful of the antennas of a vehicle, for every pair of them."""
    paths = list(_paths(vehicle, problem))
    for i, a in enumerate(paths):
        for b in paths[i + 1 :]:
            if text := _compare(a, b):
                yield text


def _paths(vehicle: Vehicle, problem: NavigationProblem) -> Iterator[_Path]:
    for fixes in vehicle.positions:
        known = np.isfinite(fixes.r_n).all(axis=1)
        if known.any():
            yield _Path(fixes.name, fixes.t_s[known], fixes.r_n[known], fixes.lever_b)
    carried = [v for v in problem.vehicles if v.carrier == vehicle.name]
    for v in [vehicle, *carried] if carried else []:
        if v.gnss is not None:
            stream = every(v.gnss.stream, STEP_S, MAX_EPOCHS)
            r_n = problem.frame.from_ecef(points(stream, problem.t0, v.gnss.noise).r_ecef)
            known = np.isfinite(r_n).all(axis=1)
            yield _Path(v.name, stream.t_s[known], r_n[known], v.gnss.lever_b)


def _compare(a: _Path, b: _Path) -> str:
    told = np.subtract(b.lever_b, a.lever_b)[:2]  # right, forward
    if np.linalg.norm(told) < MIN_LENGTH_M or len(b.t_s) < MIN_POINTS or len(a.t_s) < MIN_POINTS:
        return ""
    seen, sigma = _seen(a, b)
    if not np.linalg.norm(seen) > SURE * sigma:
        return ""
    length = float(np.linalg.norm(told))
    across = told[::-1] * np.sign(seen @ told[::-1])
    as_told, reversed_, crossed = (float(np.linalg.norm(seen - x)) for x in (told, -told, across))
    text = f"from {a.name} to {b.name} it is {_words(seen)} as the course tells, {_words(told)} as their lever arms do"
    if reversed_ < 0.5 * length and as_told - reversed_ > SURE * sigma:
        return f"{text}: are the two interchanged, or is a sign of lever_b wrong?"
    if crossed < 0.5 * length and as_told - crossed > SURE * sigma and as_told > 0.7 * length:
        return f"{text}: are the axes of lever_b others than declared?"
    return ""


def _words(right_forward: Array) -> str:
    x, y = right_forward.tolist()
    return f"{abs(y):.2f} m {'forward' if y >= 0 else 'back'} and {abs(x):.2f} m {'right' if x >= 0 else 'left'}"


def _seen(a: _Path, b: _Path) -> tuple[Array, float]:
    """Mean of the vector from a to b, right and forward (2,), while moving, and its standard deviation; NaN where unknown."""
    at = np.clip(np.searchsorted(b.t_s, a.t_s - SAME_S), 0, len(b.t_s) - 1)
    both = np.abs(b.t_s[at] - a.t_s) <= SAME_S
    t, r = a.t_s[both], a.r_n[both]
    d = b.r_n[at[both]] - r
    k = max(1, round(STEP_S / float(np.median(np.diff(t))))) if len(t) > 1 else 1
    if len(t) < MIN_POINTS + 2 * k:
        return np.full(2, np.nan), np.nan
    v = (r[2 * k :] - r[: -2 * k])[:, :2] / (t[2 * k :] - t[: -2 * k])[:, None]
    speed = np.linalg.norm(v, axis=1)
    moving = (speed > MOVING_MPS) & (t[2 * k :] - t[: -2 * k] < 6 * k * float(np.median(np.diff(t))))
    if moving.sum() < MIN_POINTS:
        return np.full(2, np.nan), np.nan
    forward = v[moving] / speed[moving, None]
    east, north = d[k:-k][moving, :2].T
    vectors = np.column_stack([east * forward[:, 1] - north * forward[:, 0], east * forward[:, 0] + north * forward[:, 1]])
    means = np.array([block.mean(axis=0) for block in np.array_split(vectors, BLOCKS)])
    return np.median(means, axis=0), float(np.max(means.std(axis=0, ddof=1)) * np.sqrt(np.pi / 2 / BLOCKS))
