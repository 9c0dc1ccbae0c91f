"""Wide lanes first: integer differences of two bands' ambiguities, held while the ambiguities themselves are open.

Over long baselines the ionosphere keeps single ambiguities from being fixed soon, and the difference N1 - N2 of one
satellite's much less: its wavelength is 0.75 m of L1 and L5, 0.86 m of L1 and L2, 5.9 m of L2 and L5 (extra-wide). The
differences of neighbouring bands are fixed together by the same rules as ambiguities, from the float solution's covariance.
Codes and phases alone, without geometry and atmosphere (Melbourne-Wuebbena), must not contradict: a difference whose mean lies
half a cycle or more from its integer, with a standard deviation that tells, is left out. What is held is a tight constraint
between the two ambiguities; it ends when the phases of either refuse it, and says nothing more once both are fixed.

Source: Forssell, Martin-Neira and Harris (1997); Teunissen, Joosten and Tiberius (2002) for cascades and least squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambiguity import partial
from factorgraph.assembly.blocks import CODE, PHASE, GnssBlock
from factorgraph.assembly.build import GnssLink
from factorgraph.assembly.engine import Eliminated
from factorgraph.assembly.optimizer import Graph
from factorgraph.assembly.rows import plain_rows
from factorgraph.assembly.switches import HeldBlock
from factorgraph.models.combinations import melbourne_wuebbena
from factorgraph.problem import AmbiguitySettings
from factorgraph.types import Array, BoolArray, IntArray

SIGMA_CYC = 0.01
TELLING_CYC = 1 / 6  # standard deviation of a mean that three of them, half a cycle, can contradict
CONTRADICTED_CYC = 0.5
SAME_M = 1e-6  # wavelengths that differ by less are of one band


@dataclass(slots=True)
class WideLaneBlock(HeldBlock):
    """Constraints first - second = integer between ambiguities of a link, one row each."""

    first: IntArray  # (n,) arcs
    second: IntArray

    @property
    def pairs(self) -> list[tuple[int, int]]:
        return list(zip(self.first.tolist(), self.second.tolist(), strict=True))

    def keys(self, f: int) -> list[int]:
        if not self.active[f]:
            return [0, 0]
        return [int(self.of.amb_key[self.first[f]]), int(self.of.amb_key[self.second[f]])]

    def widths(self) -> tuple[int, ...]:
        return (1, 1)

    def predict(self) -> None:
        self.y = self.integer - (self.of.amb_value[self.first] - self.of.amb_value[self.second])
        self.J = np.tile([1.0, -1.0], (self.n, 1))


def hold(graph: Graph, links: list[GnssLink], eliminated: Eliminated, settings: AmbiguitySettings) -> int:
    """Hold the wide lanes that can be fixed and are not held yet; returns how many."""
    held = 0
    for data in links:
        block = data.block
        pairs = open_pairs(data, {p for b in graph.blocks if isinstance(b, WideLaneBlock) and b.of is block for p in b.pairs})
        known = np.array([not k or int(k) in graph.ambiguities for k in block.amb_key], bool)
        pairs = pairs[np.all(known[pairs], axis=1)]
        if not len(pairs):
            continue
        arcs = np.unique(pairs)
        free = arcs[block.amb_key[arcs] != 0]
        Z = (pairs[:, :1] == free).astype(float) - (pairs[:, 1:] == free)
        Q = Z @ eliminated.covariance(block.amb_key[free].tolist()) @ Z.T
        value = block.amb_value[pairs[:, 0]] - block.amb_value[pairs[:, 1]]
        limits = (settings.ratio_threshold, settings.min_success_rate)
        got = partial.fix_ordered(value, 0.5 * (Q + Q.T), -np.diag(Q), *limits)  # the least precise are left out first
        pairs, integers = pairs[got.fixed], got.integers[got.fixed]
        keep = ~contradicted(block, pairs, integers)
        if np.any(keep):
            graph.blocks.append(_wide_lanes(block, pairs[keep], integers[keep]))
            held += int(keep.sum())
    return held


def _wide_lanes(block: GnssBlock, pairs: IntArray, integers: Array) -> WideLaneBlock:
    n = len(pairs)
    nothing = np.zeros(n, np.int64)
    table = plain_rows(-1, np.zeros(n), np.full(n, SIGMA_CYC), np.arange(n), block.rows.source, ["wide lane"], nothing)
    return WideLaneBlock(table, of=block, first=pairs[:, 0], second=pairs[:, 1], integer=integers, valid_for=block.amb_key)


def open_pairs(data: GnssLink, held: set[tuple[int, int]]) -> IntArray:
    """Pairs (p, 2) of arcs of one satellite in neighbouring bands, in view together, that are not held yet."""
    block = data.block
    lam = np.zeros(len(block.amb_key))
    phase = np.flatnonzero((block.arc >= 0) & block.active)
    lam[block.arc[phase]] = block.wavelength_m[phase]
    fits = (lam > 0) & (block.amb_unit_cyc == 1.0) & [data.has_integer(i) for i in range(len(lam))]
    names = np.array(data.arc_satellite)
    found = []
    for name in np.unique(names[fits]):
        mine = np.flatnonzero(fits & (names == name))
        for a in mine.tolist():
            above = lam[mine][lam[mine] > lam[a] + SAME_M]
            for b in mine[np.isclose(lam[mine], above.min(initial=np.inf))].tolist():
                overlaps = min(data.arc_end_s[a], data.arc_end_s[b]) > max(data.arc_start_s[a], data.arc_start_s[b])
                if overlaps and (block.amb_key[a] or block.amb_key[b]) and (a, b) not in held:
                    found.append((a, b))
    return np.array(found, np.int64).reshape(-1, 2)


def contradicted(block: GnssBlock, pairs: IntArray, integers: Array) -> BoolArray:
    """Which pairs (p,) codes and phases alone contradict; `integers` (p,) in the datum of the link's ambiguities.

    The combination's mean over a pair's epochs is compared with the median of the pairs of the same two signals.
    """
    rows = block.rows
    place = (rows.factor.of_row * len(rows.group) + rows.group_index) * len(rows.label) + rows.label_index
    codes = np.flatnonzero(rows.kind == CODE)
    codes = codes[np.argsort(place[codes])]
    off, sigma, signals = np.full(len(pairs), np.nan), np.full(len(pairs), np.nan), np.zeros((len(pairs), 2), np.int64)
    for p, (first, second) in enumerate(pairs):
        one, two = (np.flatnonzero((block.arc == arc) & (rows.kind == PHASE)) for arc in (first, second))
        _, i, j = np.intersect1d(rows.factor.of_row[one], rows.factor.of_row[two], return_indices=True)
        one, two = one[i], two[j]
        with_code = [codes[np.minimum(np.searchsorted(place[codes], place[of]), len(codes) - 1)] for of in (one, two)]
        known = (place[with_code[0]] == place[one]) & (place[with_code[1]] == place[two])
        if np.any(known):
            four = np.array([part[known] for part in (one, two, *with_code)])
            signals[p] = rows.group_index[four[:2, 0]]
            mean, sigma[p] = _mean_wide_lane(block, four)
            off[p] = mean - integers[p]
    out = np.zeros(len(pairs), bool)
    for kind in np.unique(signals[np.isfinite(off)], axis=0):
        mine = np.isfinite(off) & np.all(signals == kind, axis=1)
        out |= mine & (sigma < TELLING_CYC) & (np.abs(off - np.median(off[mine])) >= CONTRADICTED_CYC)
    return out


def _mean_wide_lane(block: GnssBlock, four: IntArray) -> tuple[float, float]:
    """Mean of N1 - N2 and its standard deviation from rows (4, m) of two phases and their codes."""
    z = block.z[four]
    z[:2] -= block.wavelength_m[four[:2]] * block.jump_cyc[four[:2]]
    l1, l2 = block.wavelength_m[four[:2]]
    s1, s2 = block.rows.sigma[four[2:]]
    of_codes = np.abs(l2 - l1) / (l2 + l1) * np.hypot(s1 / l1, s2 / l2)
    return float(melbourne_wuebbena(z[0], z[1], z[2], z[3], l1, l2).mean()), float(np.sqrt(np.mean(of_codes**2) / len(l1)))


def release_refused(graph: Graph, settings: AmbiguitySettings) -> int:
    """End constraints of arcs whose phase residuals refuse them; returns how many."""
    released = 0
    for held in graph.blocks:
        if isinstance(held, WideLaneBlock) and not held.is_stale:
            rows = np.flatnonzero(held.of.arc >= 0)
            arc = held.of.arc[rows]
            sq = (held.of.residuals() / held.of.rows.sigma)[rows] ** 2
            n = len(held.of.amb_key)
            rms = np.sqrt(np.bincount(arc, sq, n) / np.maximum(np.bincount(arc, minlength=n), 1))
            refused = held.active & (np.maximum(rms[held.first], rms[held.second]) > settings.release_sigma)
            held.active &= ~refused
            released += int(refused.sum())
    return released
