"""Carrier-phase arcs: where a satellite's ambiguity stays one integer, and where it slipped.

An arc of a receiver pair's single differences ends at a loss-of-lock flag of either receiver, at a gap, where phase and
Doppler disagree, where the geometry-free combination of two bands jumps, or where a receiver begins or ceases to flag its
phase as ambiguous by half a cycle. What these miss shows against a predicted trajectory (`factorgraph.models.slips`) and
in the residuals of the solution (`split_at_steps`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.measurements import GnssStream
from factorgraph.models.clock_jumps import MS_M
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.gnss import PairedRows
from factorgraph.problem import AmbiguitySettings
from factorgraph.types import Array, BoolArray, IntArray

GAP_INTERVALS = 2.5
CAUSES = ("gap", "loss of lock", "phase against Doppler", "geometry-free", "half-cycle flag", "prediction", "residual step")
PREDICTION, RESIDUAL_STEP = 5, 6


@dataclass(frozen=True, slots=True)
class Arcs:
    """Arc of every paired row (-1: no usable phase) and what ended arcs."""

    of_row: IntArray  # (n,)
    count: int
    cause: IntArray  # (n,) of a row that begins an arc after another: index into CAUSES; -1 elsewhere
    half: BoolArray  # (n,) flagged as ambiguous by half a cycle


def _lock_losses(stream: GnssStream) -> IntArray:
    """Running number of loss-of-lock flags of each row's satellite and signal (n,)."""
    series = stream.sat * max(len(stream.signals), 1) + stream.signal
    order = np.lexsort((stream.epoch, series))
    flag = (stream.lli[order] & 1).astype(np.int64)
    out = np.empty_like(flag)
    out[order] = np.cumsum(flag)  # differences within a series are what counts
    return out


def _doppler_slips(stream: GnssStream, rows: IntArray, previous: IntArray, threshold_cyc: float) -> BoolArray:
    """Phase change against the mean Doppler, the receiver's common clock part removed by the median of each epoch.

    Where the clock jumped by milliseconds, the receiver observed so much earlier or later than its time tags say.
    """
    dt = stream.t_s[stream.epoch[rows]] - stream.t_s[stream.epoch[previous]]
    lam = stream.wavelength_m[rows]
    speed = 0.5 * lam * (stream.doppler_hz[rows] + stream.doppler_hz[previous])
    miss = lam * (stream.phase_cyc[rows] - stream.phase_cyc[previous]) + speed * dt
    slip = np.zeros(len(rows), bool)
    ok = np.flatnonzero(np.isfinite(miss))
    ok = ok[np.argsort(stream.epoch[rows[ok]], kind="stable")]
    groups = CommonGroups.from_labels(stream.epoch[rows[ok]])
    every = np.ones(len(ok), bool)
    jump_s = 1e-3 * np.rint(groups.median(miss[ok], every) / MS_M)
    miss[ok] -= speed[ok] * jump_s[groups.of_row]
    slip[ok] = np.abs(miss[ok] - groups.median(miss[ok], every)[groups.of_row]) > threshold_cyc * lam[ok]
    return slip


def find_arcs(a: GnssStream, b: GnssStream, pairs: PairedRows, usable: BoolArray, settings: AmbiguitySettings) -> Arcs:
    """Arcs of the pair's phases; `usable` (n,) says which paired rows have a phase on both sides worth using."""
    n = len(pairs.a)
    of_row, cause = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    half_a, half_b = (a.lli[pairs.a] & 2) > 0, (b.lli[pairs.b] & 2) > 0
    rows = np.flatnonzero(usable)
    sat = b.sat[pairs.b]
    order = rows[np.lexsort((pairs.epoch[rows], pairs.group[rows], sat[rows]))]
    if not len(order):
        return Arcs(of_row, 0, cause, half_a | half_b)
    series = sat[order] * len(pairs.group_names) + pairs.group[order]
    same = np.concatenate([[False], series[1:] == series[:-1]])
    here, before = order[1:], order[:-1]
    t = b.t_s[pairs.epoch[order]]
    interval = float(np.median(np.diff(b.t_s))) if len(b.t_s) > 1 else 1.0
    reasons: dict[str, BoolArray] = {"gap": np.diff(t) > GAP_INTERVALS * interval}
    lost = np.zeros(len(here), bool)
    for stream, column in ((a, pairs.a), (b, pairs.b)):
        losses = _lock_losses(stream)
        lost |= losses[column[here]] != losses[column[before]]
    reasons["loss of lock"] = lost
    doppler = np.zeros(len(here), bool)
    for stream, column in ((a, pairs.a), (b, pairs.b)):
        found = _doppler_slips(stream, column[here], column[before], settings.slip_phase_doppler_cyc)
        doppler |= found & same[1:]
    reasons["phase against Doppler"] = doppler & ~reasons["gap"]
    reasons["geometry-free"] = _geometry_free_slips(a, b, pairs, sat, order, same, settings.slip_geometry_free_m)
    reasons["half-cycle flag"] = (half_a[here] != half_a[before]) | (half_b[here] != half_b[before])
    cut = np.zeros(len(here), bool)
    for name, flags in reasons.items():
        new = flags & same[1:] & ~cut
        cause[here[new]] = CAUSES.index(name)
        cut |= flags
    starts = np.concatenate([[True], cut | ~same[1:]])
    arc = np.cumsum(starts) - 1
    of_row[order] = arc
    return Arcs(of_row, int(arc[-1]) + 1, cause, half_a | half_b)


def _geometry_free_slips(
    a: GnssStream, b: GnssStream, pairs: PairedRows, sat: IntArray, order: IntArray, same: BoolArray, threshold_m: float
) -> BoolArray:
    """Jumps of the difference between a band's phase and the satellite's mean phase over bands, single-differenced."""
    sd = b.phase_cyc[pairs.b] * b.wavelength_m[pairs.b] - a.phase_cyc[pairs.a] * a.wavelength_m[pairs.a]
    change = np.full(len(sd), np.nan)
    here, before = order[1:], order[:-1]
    change[here[same[1:]]] = sd[here[same[1:]]] - sd[before[same[1:]]]
    key = pairs.epoch * (int(sat.max()) + 1) + sat
    rows = order[np.isfinite(change[order])]
    rows = rows[np.argsort(key[rows], kind="stable")]
    _, first = np.unique(key[rows], return_index=True)
    jump = np.zeros(len(sd), bool)
    for part in np.split(rows, first[1:]) if len(rows) else []:
        if len(part) > 1:
            centre = np.median(change[part])
            off = np.abs(change[part] - centre) > threshold_m
            # with two bands nothing tells which one slipped: cut both
            jump[part] = off if len(part) > 2 else np.full(len(part), bool(np.ptp(change[part]) > threshold_m))
    return jump[here]


def split_at_steps(
    residual: Array, sigma: Array, arc: IntArray, order_t: Array, min_step: Array, min_epochs: int
) -> tuple[IntArray, int]:
    """Split arcs whose residuals (n,) step by more than five sigma and `min_step` (n,); returns new arcs and the number split.

    The split is where the two-sample statistic |m_1 - m_2| / sqrt(s^2/n_1 + s^2/n_2) is largest; s comes from the
    differences of neighbours, so that the step itself and slow residual motion do not inflate it.
    """
    out = arc.copy()
    next_arc = int(arc.max()) + 1 if len(arc) else 0
    split = 0
    rows = np.flatnonzero(arc >= 0)
    rows = rows[np.lexsort((order_t[rows], arc[rows]))]
    _, first = np.unique(arc[rows], return_index=True)
    for part in np.split(rows, first[1:]) if len(rows) else []:
        n = len(part)
        if n < 2 * min_epochs:
            continue
        x = residual[part]
        s = max(float(np.median(sigma[part])), 1.4826 * float(np.median(np.abs(np.diff(x)))) / np.sqrt(2))
        m = np.arange(1, n)
        total = np.cumsum(x)
        left, right = total[:-1] / m, (total[-1] - total[:-1]) / (n - m)
        stat = np.abs(left - right) / (s * np.sqrt(1 / m + 1 / (n - m)))
        stat[: min_epochs - 1] = stat[n - min_epochs :] = 0
        i = int(np.argmax(stat))
        if stat[i] > 5 and abs(left[i] - right[i]) > min_step[part[0]]:
            out[part[i + 1 :]] = next_arc
            next_arc += 1
            split += 1
    return out, split
