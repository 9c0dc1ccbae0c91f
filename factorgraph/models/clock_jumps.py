"""Jumps of receiver clocks by whole milliseconds, and phases that go on as if there were none.

A receiver that keeps its clock within a millisecond of GPS time sets it back now and then. Codes then jump by whole
milliseconds times c, and with them time tag less clock offset stays the true time. Phases may jump along or not; both is
common to all satellites and signals. Where they do not, code minus phase jumps, and ambiguities would be 300 km apart
on both sides: the phases are made to follow, so that every later step sees one convention.

Source: Kim and Langley (2001), on clock jumps and slips of ambiguities; RINEX 3.05, section 6.7, for the two conventions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph.geodesy import C_MPS
from factorgraph.measurements import GnssStream
from factorgraph.types import Array, BoolArray, IntArray

MS_M = 1e-3 * C_MPS
NEAR_M = 150.0  # of whole milliseconds: code noise, and half of what a clock of 1e-6 drifts between epochs a second apart
NEAR_S = 1e-4
AGREEING = 0.8  # share of the phases
LISTED = 4


@dataclass(frozen=True, slots=True)
class ClockJumps:
    """Jumps of one receiver."""

    t_s: Array  # (j,) time tag of the first epoch after it
    ms: IntArray  # (j,) change of the clock offset
    phases_followed: BoolArray  # (j,) already in the observations

    def __str__(self) -> str:
        """ "2 jumps of the clock, -1 ms at 12.0 s, ..."; empty without any."""
        n = len(self.t_s)
        if not n:
            return ""
        each = [f"{ms:+d} ms at {t:.1f} s" for ms, t in zip(self.ms[:LISTED].tolist(), self.t_s[:LISTED].tolist(), strict=True)]
        made = int(np.sum(~self.phases_followed))
        text = f"{n} jump{'s' * (n > 1)} of the clock: {', '.join(each)}{', ...' * (n > LISTED)}"
        return f"{text}; phases made to follow {made} of them" if made else text


NO_JUMPS = ClockJumps(np.zeros(0), np.zeros(0, np.int64), np.zeros(0, bool))


def phase_lags(stream: GnssStream) -> IntArray:
    """Milliseconds (m,) by which codes jumped more than phases at each epoch, told by code minus phase of most satellites."""
    m = len(stream.t_s)
    series = stream.sat * max(len(stream.signals), 1) + stream.signal
    order = np.lexsort((stream.epoch, series))
    order = order[np.isfinite(stream.code_m[order]) & np.isfinite(stream.phase_cyc[order])]
    before, after = order[:-1], order[1:]
    same = (series[after] == series[before]) & (stream.epoch[after] - stream.epoch[before] == 1)
    before, after = before[same], after[same]
    change = stream.code_m - stream.wavelength_m * stream.phase_cyc
    jump = (change[after] - change[before]) / MS_M
    whole = np.rint(jump)
    near = (whole != 0) & (np.abs(jump - whole) < NEAR_M / MS_M)
    total = np.bincount(stream.epoch[after], minlength=m)
    lags = np.zeros(m, np.int64)
    for k in np.flatnonzero(np.bincount(stream.epoch[after[near]], minlength=m) >= np.maximum(AGREEING * total, 2)):
        values, counts = np.unique(whole[near & (stream.epoch[after] == k)], return_counts=True)
        if counts.max() >= AGREEING * total[k]:
            lags[k] = int(values[np.argmax(counts)])
    return lags


def with_phases_following(stream: GnssStream) -> tuple[GnssStream, IntArray]:
    """The stream with phases that jump where codes do, and the milliseconds (m,) put in at each epoch."""
    lags = phase_lags(stream)
    if not np.any(lags):
        return stream, lags
    added = MS_M * np.cumsum(lags)[stream.epoch] / stream.wavelength_m
    return replace(stream, phase_cyc=stream.phase_cyc + added), lags


def clock_jumps(t_s: Array, clock_s: Array, lags: IntArray) -> ClockJumps:
    """Jumps of a clock's offsets (m,), NaN where unknown, at time tags (m,); `lags` as from `with_phases_following`."""
    known = np.flatnonzero(np.isfinite(clock_s))
    step = np.diff(clock_s[known])
    dt = np.diff(t_s[known])
    drift = float(np.median(step / dt)) if len(step) else 0.0
    jump = (step - drift * dt) / 1e-3
    ms = np.rint(jump).astype(np.int64)
    at = np.flatnonzero((ms != 0) & (np.abs(jump - ms) < NEAR_S / 1e-3))
    return ClockJumps(t_s[known[at + 1]], ms[at], lags[known[at + 1]] == 0)
