"""Sensors that repeat their last value: a logger or a sensor that hangs, while time stamps go on.

Equal values alone prove nothing: a coarse or slowly sampled sensor repeats itself, all the more at rest. What counts is
a stretch of them that the sensor does not show elsewhere, while something else of it moves:

  - an axis of the IMU, while the other axes of the same triad change by several of their own steps;
  - all six axes, of an IMU whose steps are finer than what any such sensor scatters;
  - the code of most satellites of an epoch, which changes by tens to hundreds of metres a second;
  - position fixes, followed by a jump as long as the way travelled since;
  - ranges of a pair of radios, of finer steps than their scatter.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph.measurements import GnssStream, ImuStream, PositionStream, RangeStream
from factorgraph.types import Array, BoolArray

AXIS_S, AXIS_SAMPLES = 2.0, 50  # shortest stretch of one axis
ALL_S, ALL_SAMPLES = 1.0, 20  # of all six axes
CHANGES = 0.5  # share of samples of a living axis that differ from the one before
LIVING_STEPS = 3.0  # an axis moves when it scatters by so many of its own steps
FINE_FORCE_MPS2, FINE_RATE_RPS = 0.02, 2e-3  # steps below the scatter of every sensor of this kind
SAME_M = 1e-6  # of code
FIXES, FIXES_S, JUMP_M = 5, 3.0, 3.0
RANGES, RANGES_S, FINE_RANGE_M, RANGE_REPEATS = 10, 2.0, 0.05, 0.2


def _runs(same: BoolArray) -> Iterator[tuple[int, int]]:
    """First and last row of each stretch of equal rows; same (n - 1,): row i + 1 equals row i."""
    edges = np.diff(np.concatenate([[0], same.astype(np.int8), [0]]))
    yield from zip(np.flatnonzero(edges > 0).tolist(), np.flatnonzero(edges < 0).tolist(), strict=True)


def _from_to(t_s: Array, a: int, b: int) -> str:
    return f"from {t_s[a]:.1f} to {t_s[b]:.1f} s"


def imu(stream: ImuStream, C_bs: Array) -> Iterator[str]:
    """Stretches in which axes of an IMU are frozen. C_bs (3, 3): from the axes of its columns to the body."""
    # columns as they stand in the file: products with a rotation differ in their last digits
    f, w = (np.round(x @ C_bs, 9) for x in (stream.f_b, stream.w_b))
    declared_level = not np.any(f[:, :2]) or not np.any(stream.f_b[:, :2])
    still = [np.diff(x, axis=0) == 0 for x in (f, w)]
    together = list(_all_six(stream.t_s, f, w, still[0].all(axis=1) & still[1].all(axis=1)))
    for a, b in together:
        yield f"all six axes of the IMU repeat one sample {_from_to(stream.t_s, a, b)}"
    if not np.any(w) and not declared_level:
        yield "the gyroscope reads exactly zero throughout"
    for triad, x, same in (("accelerometer", f, still[0]), ("gyroscope", w, still[1])):
        if declared_level or together:
            continue
        for axis in range(3):
            for a, b in _single(stream.t_s, x, same, axis):
                yield f"axis {axis} of the {triad} repeats {x[a, axis]:.6g} {_from_to(stream.t_s, a, b)}"


def _all_six(t_s: Array, f: Array, w: Array, same: BoolArray) -> Iterator[tuple[int, int]]:
    """Stretches, but not the whole, in which an IMU of fine steps repeats its sample."""
    long = [(a, b) for a, b in _runs(same) if b - a >= ALL_SAMPLES and t_s[b] - t_s[a] >= ALL_S and b - a < len(same)]
    if long and _step(f) <= FINE_FORCE_MPS2 and _step(w) <= FINE_RATE_RPS:
        yield from long


def _single(t_s: Array, x: Array, same: BoolArray, axis: int) -> Iterator[tuple[int, int]]:
    """Stretches in which one axis of x (n, 3) rests and another is alive."""
    long = [(a, b) for a, b in _runs(same[:, axis]) if b - a >= AXIS_SAMPLES and t_s[b] - t_s[a] >= AXIS_S]
    outside = np.ones(len(same), bool)
    for a, b in long:
        outside[a:b] = False
    if not long or (outside.sum() > AXIS_SAMPLES and same[outside, axis].mean() > 1 - CHANGES):
        return
    others = [k for k in range(3) if k != axis]
    for a, b in long:
        alive = [np.std(x[a:b, k]) > LIVING_STEPS * _step(x[a:b, [k]]) and same[a:b, k].mean() < 1 - CHANGES for k in others]
        if any(alive):
            yield a, b


def _step(x: Array) -> float:
    """The usual smallest change (median over columns of their 1 % quantiles) between neighbouring rows; 0 without any."""
    steps = [np.abs(d[d != 0]) for d in np.diff(x, axis=0).T]
    return float(np.median([np.quantile(s, 0.01) if s.size else 0.0 for s in steps]))


def receiver(stream: GnssStream) -> Iterator[str]:
    """Stretches in which most satellites' code repeats the epoch before."""
    order = np.lexsort((stream.epoch, stream.signal, stream.sat))
    a, b = order[:-1], order[1:]
    pair = (stream.sat[a] == stream.sat[b]) & (stream.signal[a] == stream.signal[b]) & (stream.epoch[b] == stream.epoch[a] + 1)
    pair &= np.isfinite(stream.code_m[a] - stream.code_m[b])
    a, b = a[pair], b[pair]
    n = len(stream.t_s)
    pairs = np.bincount(stream.epoch[b], minlength=n)
    equal = np.bincount(stream.epoch[b], np.abs(stream.code_m[b] - stream.code_m[a]) < SAME_M, n)
    for first, last in _runs(((equal > 0.5 * pairs) & (pairs >= 3))[1:]):
        if last - first >= 2:
            yield f"the receiver repeats its observations {_from_to(stream.t_s, first, last)}"


def positions(stream: PositionStream) -> Iterator[str]:
    """Stretches in which fixes stand still, and then jump."""
    known = np.isfinite(stream.r_n).all(axis=1)
    t_s, sigma_m = stream.t_s[known], stream.sigma_m[known]
    way = np.linalg.norm(np.diff(stream.r_n[known], axis=0), axis=1)
    same = way == 0
    usual = float(np.median(way[~same])) if np.any(~same) else 0.0
    for a, b in _runs(same):
        jump = way[b] if b < len(way) else 0.0
        enough = max(JUMP_M, 5 * usual, 10 * float(np.max(sigma_m[a])))
        if b - a + 1 >= FIXES and t_s[b] - t_s[a] >= FIXES_S and jump > enough:
            yield f"{stream.name} repeats one fix {_from_to(t_s, a, b)}, then jumps by {jump:.1f} m"


def ranges(stream: RangeStream) -> Iterator[str]:
    """Stretches in which the ranges of a pair of radios repeat one value."""
    pair = stream.tag_a * len(stream.tags) + stream.tag_b
    for key in np.unique(pair):
        rows = np.flatnonzero(pair == key)
        t, r = stream.t_s[rows], stream.range_m[rows]
        same = np.diff(r) == 0
        long = [(a, b) for a, b in _runs(same) if b - a >= RANGES and t[b] - t[a] >= RANGES_S]
        outside = np.ones(len(same), bool)
        for a, b in long:
            outside[a:b] = False
        if not long or outside.sum() < RANGES or same[outside].mean() > RANGE_REPEATS or _step(r[:, None]) > FINE_RANGE_M:
            continue
        names = " to ".join(stream.tags[i].name for i in (stream.tag_a[rows[0]], stream.tag_b[rows[0]]))
        for a, b in long:
            yield f"the range {names} repeats {r[a]:.3f} m {_from_to(t, a, b)}"
