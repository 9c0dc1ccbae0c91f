"""Precise orbits and clocks: SP3-c and SP3-d files, read and interpolated.

Positions are ECEF at equidistant epochs. Around an instant t the nodes are turned into the ECEF frame of t, so that the
Earth's rotation does not bend the orbit, and interpolated by the polynomial of degree 10 through the eleven nearest of one
unbroken run; its derivative, less the rotation's own, is the velocity. Clocks are linear between neighbouring epochs, plus
the relativistic -2 r.v / c^2, which the files leave out. There is nothing before the first or after the last epoch, nor
within a gap.

Positions are those of the file: of satellites' centres of mass where it says so, as the IGS does, one to three metres from
the antennas that broadcast orbits are of. Differences between receivers do not notice.

Source: Hilla (2016), The extended standard product 3 orbit format (SP3-d); Schenewerk (2003), A brief review of basic GPS
orbit interpolation strategies.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS, MU_M3S2, OMEGA_E_RPS
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import ReadReport
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights._rinex_text import gpst, number, unpacked

DEGREE = 10
MISSING_CLOCK_US = 999_999.0
SYSTEM_OF_TIME = {"GPS": "G", "GAL": "E", "QZS": "J", "TAI": "T", "BDT": "C", "UTC": "R", "GLO": "R"}
TAI_GPST_S = 19.0
SAME_S = 1e-3  # epochs closer are one


@dataclass(frozen=True, slots=True)
class PreciseOrbits:
    """Nodes of all satellites, sorted by satellite and time; unbroken runs of equal spacing have one number."""

    satellites: tuple[str, ...]
    first: IntArray  # (s + 1,) first node of each satellite
    t_s: Array  # (n,) seconds from the owner's reference instant
    pos: Array  # (n, 3)
    clock_s: Array  # (n,) NaN where absent
    run_first: IntArray  # (n,) first node of the run this one is in
    run_end: IntArray  # (n,) one past its last

    def covers(self, satellites: tuple[str, ...], sat: IntArray, t_s: Array) -> tuple[BoolArray, IntArray]:
        """Which rows (n,) lie within a run long enough and between two clocks, and the first of these two nodes."""
        place = {name: i for i, name in enumerate(self.satellites)}
        mine = np.array([place.get(name, -1) for name in satellites] or [-1])[sat]
        node = np.zeros(len(sat), np.int64)
        inside = (mine >= 0) & np.isfinite(t_s)
        for i in np.unique(mine[inside]):
            rows = np.flatnonzero(inside & (mine == i))
            a, b = self.first[i], self.first[i + 1]
            node[rows] = a + np.searchsorted(self.t_s[a:b], t_s[rows] + SAME_S, side="right") - 1
            inside[rows] = node[rows] >= a
        node = np.clip(node, 0, len(self.t_s) - 1)
        end = self.run_end[node]
        inside &= (end - self.run_first[node] > DEGREE) & (t_s <= self.t_s[end - 1] + SAME_S)
        node = np.where(inside, np.minimum(node, end - 2), 0)
        return inside & np.isfinite(self.clock_s[node] + self.clock_s[np.minimum(node + 1, len(self.t_s) - 1)]), node

    def clock_at(self, node: IntArray, t_s: Array) -> tuple[Array, Array]:
        """Clock offset and rate (n,) without relativity, linear from each node to the next."""
        rate = (self.clock_s[node + 1] - self.clock_s[node]) / (self.t_s[node + 1] - self.t_s[node])
        return self.clock_s[node] + rate * (t_s - self.t_s[node]), rate

    def states(self, node: IntArray, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """Position and velocity (n, 3), clock offset with relativity and its rate (n,) at covered instants."""
        start = np.clip(node - DEGREE // 2, self.run_first[node], self.run_end[node] - DEGREE - 1)
        nodes = start[:, None] + np.arange(DEGREE + 1)
        step = self.t_s[start + 1] - self.t_s[start]
        value, slope = _lagrange((t_s - self.t_s[start]) / step)
        angle = OMEGA_E_RPS * (self.t_s[nodes] - t_s[:, None])
        c, s, p = np.cos(angle), np.sin(angle), self.pos[nodes]
        turned = np.stack([c * p[..., 0] - s * p[..., 1], s * p[..., 0] + c * p[..., 1], p[..., 2]], axis=-1)
        r = np.einsum("nj,njk->nk", value, turned)
        inertial = np.einsum("nj,njk->nk", slope, turned) / step[:, None]
        v = inertial + OMEGA_E_RPS * np.column_stack([r[:, 1], -r[:, 0], np.zeros(len(r))])
        clock, rate = self.clock_at(node, t_s)
        # d(r.v)/dt = v^2 + r.a in the inertial frame, a = -mu r / |r|^3
        relativity = -2 * np.einsum("ni,ni->n", r, v) / C_MPS**2
        changes = -2 * (np.einsum("ni,ni->n", inertial, inertial) - MU_M3S2 / np.linalg.norm(r, axis=1)) / C_MPS**2
        return r, v, clock + relativity, rate + changes


def _lagrange(u: Array) -> tuple[Array, Array]:
    """Weights (n, DEGREE + 1) of nodes 0, 1, ... for the value at u (n,) and for the derivative by u."""
    j = np.arange(DEGREE + 1)
    below = j[:, None] - j[None, :]
    scale = np.prod(np.where(below == 0, 1, below), axis=1)
    d = np.repeat((u[:, None] - j)[:, None, :], DEGREE + 1, axis=1)  # row i: the factors of weight i
    d[:, j, j] = 1.0
    value = np.prod(d, axis=2) / scale
    slope = np.zeros_like(value)
    for k in range(DEGREE + 1):  # leave out one factor after the other
        rest = d.copy()
        rest[:, :, k] = 1.0
        slope += np.where(j != k, np.prod(rest, axis=2) / scale, 0.0)
    return value, slope


def is_sp3(path: Path) -> bool:
    """Whether a file begins as SP3 files do."""
    start = unpacked(path)[0][:3]
    return start[:1] == b"#" and start[1:2].isalpha() and start[2:3] in (b"P", b"V")


def read_sp3(paths: Sequence[Path]) -> tuple[PreciseOrbits, GpsTime, ReadReport]:
    """Read SP3 files of following days into one set; times count from the instant returned.

    Raises InputError for files of another kind or version, of an unknown time system, or without a usable position.
    Missing positions, absent and predicted clocks are counted; of an epoch that two files have the later file's stays.
    """
    records: dict[tuple[str, float], tuple[Array, float]] = {}
    dropped: Counter[str] = Counter()
    reference: GpsTime | None = None
    for path in paths:
        reference = _read(path, records, dropped, reference)
    source = ", ".join(str(path) for path in paths)
    if not records or reference is None:
        raise InputError(f"{source}: no usable position in any record")
    return _assembled(records), reference, ReadReport(source, len(records), dict(dropped))


def _read(
    path: Path, records: dict[tuple[str, float], tuple[Array, float]], dropped: Counter[str], reference: GpsTime | None
) -> GpsTime | None:
    """Add a file's records; returns the instant that times count from."""
    lines = unpacked(path)[0].decode("ascii", "replace").splitlines()
    if not lines or lines[0][:1] != "#" or lines[0][2:3] not in "PV":
        raise InputError(f"{path}, line 1: not an SP3 file (it must begin with #cP, #dP or the like)")
    if lines[0][1] not in "cd":
        raise InputError(f"{path}, line 1: SP3-{lines[0][1]} is not supported (c and d are)")
    system = _time_system(path, lines)
    t = None
    for i, line in enumerate(lines):
        if line.startswith("EOF"):
            break
        if line.startswith("*"):
            t, reference = _epoch(path, i, line, system, reference)
        elif line.startswith("P") and t is not None:
            _position(line, t, records, dropped)
    else:
        dropped["no EOF: the file ends early"] += 1
    return reference


def _time_system(path: Path, lines: Sequence[str]) -> str:
    """Letter of the time system."""
    name = next((line[9:12] for line in lines if line.startswith("%c")), "GPS")
    name = "GPS" if name == "ccc" else name
    if name not in SYSTEM_OF_TIME:
        raise InputError(f"{path}: unknown time system {name!r} ({', '.join(SYSTEM_OF_TIME)} are known)")
    return SYSTEM_OF_TIME[name]


def _epoch(path: Path, i: int, line: str, system: str, reference: GpsTime | None) -> tuple[float, GpsTime]:
    fields = line[1:].split()
    try:
        year, month, day, hour, minute = (int(x) for x in fields[:5])
        when = gpst(year, month, day, hour, minute, float(fields[5]), system)
    except (ValueError, IndexError):
        raise InputError(f"{path}, line {i + 1}: {line.strip()!r} is not an epoch") from None
    when = when + -TAI_GPST_S if system == "T" else when
    reference = reference or GpsTime(when.week, 0.0)
    return when - reference, reference


def _position(line: str, t: float, records: dict[tuple[str, float], tuple[Array, float]], dropped: Counter[str]) -> None:
    name = (line[1:2].strip() or "G") + line[2:4].replace(" ", "0")
    pos = np.array([number(line[4 + 14 * k : 18 + 14 * k]) for k in range(3)]) * 1e3
    clock_us = number(line[46:60])
    if not np.all(np.isfinite(pos)) or not np.any(pos):
        dropped["position missing"] += 1
        return
    if not abs(clock_us) < MISSING_CLOCK_US:
        dropped["clock missing"] += 1
        clock_us = np.nan
    records[name, round(t / SAME_S) * SAME_S] = (pos, clock_us * 1e-6)


def _assembled(records: dict[tuple[str, float], tuple[Array, float]]) -> PreciseOrbits:
    keys = sorted(records)
    names = tuple(sorted({name for name, _ in keys}))
    sat = np.searchsorted(names, [name for name, _ in keys])
    t = np.array([at for _, at in keys])
    new_satellite = np.diff(sat, prepend=-1) != 0
    step = np.diff(t, prepend=np.inf)
    usual = np.median(step[~new_satellite]) if np.any(~new_satellite) else np.inf
    run_first = np.flatnonzero(new_satellite | (np.abs(step - usual) > SAME_S))
    length = np.diff(np.append(run_first, len(t)))
    return PreciseOrbits(
        names,
        np.append(np.flatnonzero(new_satellite), len(t)),
        t,
        np.array([records[key][0] for key in keys]),
        np.array([records[key][1] for key in keys]),
        np.repeat(run_first, length),
        np.repeat(run_first + length, length),
    )
