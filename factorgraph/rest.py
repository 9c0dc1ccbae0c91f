"""When a vehicle stands still, as its IMU shows: nothing shakes and nothing turns.

Over windows of a second the scatter of specific force and rate about their means is compared with what idling engines and
hands leave of it,

    T = (var f_x + var f_y + var f_z) / (3 FORCE^2) + (var w_x + var w_y + var w_z) / (3 RATE^2),

the generalised likelihood ratio of constant against arbitrary force and rate. T below a threshold is rest, if mean rate and
magnitude of force are those of most such windows. A smooth ride may be as quiet as rest, so known speeds count: no window
known to move is rest, and the threshold stays well below the quietest of the windows that are known to move. An IMU too quiet
to tell the two apart then shows no rest at all, rather than a wrong one.

Source: Skog, Händel, Nilsson and Rantakokko (2010), zero-velocity detection.
"""

from __future__ import annotations

import numpy as np

from factorgraph.measurements import ImuStream
from factorgraph.models.preintegration import crossing, gaps
from factorgraph.types import Array, BoolArray, IntArray

WINDOW_S, HOP_S = 1.0, 0.25
FORCE_MPS2, RATE_RPS = 0.15, 0.03  # scatter per axis of a vehicle that stands with its engine on
BELOW_MOTION = 0.5  # threshold, of the scatter statistic that hardly a window in motion stays below
QUIETEST_MOTION = 0.01  # fraction of windows in motion that may be quieter than that
MOVING_MPS = 1.0
STANDING_MPS = 0.3  # known speeds above deny rest
SAME_RATE_RPS, SAME_FORCE_MPS2 = 0.01, 0.2  # from the median of the quiet windows
MIN_SAMPLES = 10  # of a window


def rest_spans(imu: ImuStream, t_known_s: Array | None = None, speed_mps: Array | None = None) -> Array:
    """Start and end (m, 2) of the stretches at rest, at least WINDOW_S long.

    t_known_s, speed_mps (n,): speeds known from other sensors at some times.
    """
    first, last = _windows(imu)
    if not len(first):
        return np.zeros((0, 2))
    f_mean, f_var = _moments(imu.f_b, first, last)
    w_mean, w_var = _moments(imu.w_b, first, last)
    T = f_var / (3 * FORCE_MPS2**2) + w_var / (3 * RATE_RPS**2)
    start, end = imu.t_s[first], imu.t_s[last - 1]
    fastest = _known_speed(start, end, t_known_s, speed_mps)
    moving = fastest > MOVING_MPS
    threshold = 1.0
    if np.any(moving):
        threshold = min(threshold, BELOW_MOTION * float(np.quantile(T[moving], QUIETEST_MOTION)))
    quiet = (T < threshold) & ~(fastest > STANDING_MPS) & ~crossing(gaps(imu), start, end)
    if not np.any(quiet):
        return np.zeros((0, 2))
    size = np.linalg.norm(f_mean, axis=1)
    quiet &= np.all(np.abs(w_mean - np.median(w_mean[quiet], axis=0)) < SAME_RATE_RPS, axis=1)
    quiet &= np.abs(size - np.median(size[quiet])) < SAME_FORCE_MPS2 if np.any(quiet) else False
    return union(start[quiet], end[quiet])


def _windows(imu: ImuStream) -> tuple[IntArray, IntArray]:
    """First row and row after the last (m,) of windows that overlap by all but HOP_S."""
    starts = np.arange(imu.t_s[0], imu.t_s[-1] - WINDOW_S + 1e-6, HOP_S)
    first = np.searchsorted(imu.t_s, starts - 1e-6).astype(np.int64)
    last = np.searchsorted(imu.t_s, starts + WINDOW_S + 1e-6).astype(np.int64)
    full = last - first >= MIN_SAMPLES
    return first[full], last[full]


def _moments(x: Array, first: IntArray, last: IntArray) -> tuple[Array, Array]:
    """Means (m, 3) and sums of the axes' variances (m,) of rows first:last."""
    centre = x.mean(axis=0)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(x - centre, axis=0)])
    squares = np.concatenate([[0.0], np.cumsum(np.sum((x - centre) ** 2, axis=1))])
    n = (last - first).astype(float)
    mean = (sums[last] - sums[first]) / n[:, None]
    variance = (squares[last] - squares[first]) / n - np.sum(mean**2, axis=1)
    return mean + centre, np.maximum(variance, 0.0)


def _known_speed(start: Array, end: Array, t_s: Array | None, speed: Array | None) -> Array:
    """Largest known speed (m,) inside each window, -1 where none is known."""
    out = np.full(len(start), -1.0)
    if t_s is None or speed is None or not len(t_s):
        return out
    a, b = np.searchsorted(t_s, start - HOP_S), np.searchsorted(t_s, end + HOP_S)
    some = np.flatnonzero(b > a)
    padded = np.append(speed, -1.0)
    edges = np.column_stack([a[some], b[some]]).ravel()
    out[some] = np.maximum.reduceat(padded, edges)[::2]
    return out


def union(start: Array, end: Array) -> Array:
    """Disjoint spans (m, 2) that cover spans start, end (n,); those less than HOP_S apart are one."""
    if not len(start):
        return np.zeros((0, 2))
    order = np.argsort(start, kind="stable")
    start, end = start[order], np.maximum.accumulate(end[order])
    new = np.concatenate([[True], start[1:] > end[:-1] + HOP_S])
    return np.column_stack([start[new], end[np.append(np.flatnonzero(new)[1:] - 1, len(end) - 1)]])


def zero_spans(t_s: Array, speed_mps: Array, zero_mps: Array) -> Array:
    """Start and end (m, 2) of the stretches of WINDOW_S or more in which an odometer reads less than zero_mps (n,)."""
    zero = np.abs(speed_mps) < zero_mps
    whole = np.diff(t_s) <= WINDOW_S  # between neighbouring readings
    both = np.flatnonzero(zero[:-1] & zero[1:] & whole)
    spans = union(t_s[both], t_s[both + 1])
    return spans[spans[:, 1] - spans[:, 0] >= WINDOW_S]


def inside(spans: Array, start_s: Array, end_s: Array) -> BoolArray:
    """Which intervals [start, end] (n,) lie whole inside one of disjoint spans (m, 2)."""
    if not len(spans):
        return np.zeros(len(start_s), bool)
    i = np.clip(np.searchsorted(spans[:, 0], start_s + 1e-6, side="right") - 1, 0, len(spans) - 1)
    return np.asarray((spans[i, 0] <= start_s + 1e-6) & (end_s <= spans[i, 1] + 1e-6))
