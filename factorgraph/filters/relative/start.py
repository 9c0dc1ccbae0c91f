"""Where the followers are at first, from ranges alone: least squares over the time in which they hardly move.

While the IMUs show rest, all ranges see one place; without rest, those of the first seconds do, less surely the later they are. A
place and its mirror image in the plane of the anchors explain ranges equally well: the first heights, roughly believed, choose.
Every start is tried from several places in and around the box of the anchors, and the best one kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from factorgraph.errors import InputError
from factorgraph.filters.relative.motion import position, velocity
from factorgraph.filters.relative.rows import HeightRow, RangeRow
from factorgraph.measurements import ImuStream
from factorgraph.rest import rest_spans
from factorgraph.types import Array

LATEST_REST_S = 2.0  # after the first epoch, that still counts as standing at first
MOVING_S = 3.0  # of ranges used without rest
SPEED_MPS = (0.1, 5.0)  # how fast the followers may be, at rest and not
HEIGHT_SIGMA_M = 1.0  # of the first height, which may be read after take-off
STARTS = 12
FEWEST = 3  # tags that place something
UNKNOWN_M = 100.0  # standard deviation of what ranges do not tell
ROBUST_SIGMAS = 2.0  # ranges further off count less


def rest_until(imus: Sequence[ImuStream], first_s: float) -> float | None:
    """Until when all vehicles stand still from the beginning; None where one does not."""
    ends = []
    for imu in imus:
        spans = rest_spans(imu)
        mine = spans[(spans[:, 0] <= first_s + LATEST_REST_S) & (spans[:, 1] > first_s)] if len(spans) else spans
        if not len(mine):
            return None
        ends.append(float(mine[0, 1]))
    return min(ends)


def placed(
    ranges: dict[int, list[RangeRow]],
    heights: dict[int, list[HeightRow]],
    t_s: Array,
    names: Sequence[str],
    rest_s: float | None,
) -> tuple[Array, Array]:
    """Velocities and positions (6 M,) of the followers over the ground at the first epoch, and their covariance.

    Raises InputError naming a follower that hears too few tags, or where too few anchors are heard.
    """
    M = len(names) - 1
    speed = SPEED_MPS[0] if rest_s is not None else SPEED_MPS[1]
    until = rest_s if rest_s is not None else float(t_s[0]) + MOVING_S
    used = [(row, float(t_s[k] - t_s[0])) for k in sorted(ranges) if t_s[k] <= until for row in ranges[k]]
    _enough(used, names, until)
    first_heights: dict[int, HeightRow] = {}
    for k in sorted(heights):
        for one in heights[k]:
            first_heights.setdefault(one.follower, one)
    arms = np.array([row.arm_e for row, _ in used])
    ends = np.array([(row.a, row.b) for row, _ in used])
    measured = np.array([row.range_m for row, _ in used])
    sigma = np.array([np.hypot(row.sigma_m, speed * since) for row, since in used])

    def residuals(p: Array) -> Array:
        r = np.vstack([np.zeros(3), p.reshape(M, 3)])
        out = [(np.linalg.norm(r[ends[:, 1]] - r[ends[:, 0]] + arms, axis=1) - measured) / sigma]
        out += [np.array([(h.up_e @ r[h.follower + 1] - h.height_m) / HEIGHT_SIGMA_M]) for h in first_heights.values()]
        return np.concatenate(out)

    anchors = np.array([row.arm_e if row.b == 0 else -row.arm_e for row, _ in used if 0 in (row.a, row.b)])
    low, high = anchors.min(axis=0), anchors.max(axis=0)
    rng = np.random.default_rng(0)
    middle, width = 0.5 * (low + high), np.maximum(high - low, 1.0)
    tries = [
        least_squares(
            residuals, (middle + width * rng.uniform(-0.75, 0.75, (M, 3))).ravel(), loss="cauchy", f_scale=ROBUST_SIGMAS
        )
        for _ in range(STARTS)
    ]
    best = min(tries, key=lambda found: float(found.cost))
    own = np.linalg.inv(best.jac.T @ best.jac + np.eye(3 * M) / UNKNOWN_M**2)
    x, P = np.zeros(6 * M), np.zeros((6 * M, 6 * M))
    for i in range(M):
        x[position(i)] = best.x[3 * i : 3 * i + 3]
        P[velocity(i), velocity(i)] = speed**2 * np.eye(3)
        for j in range(M):
            P[position(i), position(j)] = own[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
    return x, P


def _enough(used: Sequence[tuple[RangeRow, float]], names: Sequence[str], until: float) -> None:
    """Raises InputError for a follower with ranges to fewer than three other tags, or where hardly an anchor is heard."""
    for i in range(1, len(names)):
        n = len({row.label for row, _ in used if i in (row.a, row.b)})
        if n < FEWEST:
            raise InputError(
                f"vehicle {names[i]}: ranges to {n} tags until {until:.1f} s, too few to place it; at least {FEWEST} are needed"
            )
    n = len({row.label for row, _ in used if 0 in (row.a, row.b)})
    if n < FEWEST:
        raise InputError(f"ranges to {n} anchors until {until:.1f} s, too few to place anything; at least {FEWEST} are needed")
