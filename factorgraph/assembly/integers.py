"""Integers of the graph's carrier phases: start values, datum, fixing, holding and releasing.

Ambiguities are single differences rover - reference per arc, in cycles. Each epoch's clock per signal is free, so only
differences between arcs that meet are determined: in every connected set of arcs the longest is the datum, a constant
integer, and all others are integers relative to it. No pivot satellite changes, no ambiguity changes with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambiguity import partial
from factorgraph.assembly import switches
from factorgraph.assembly.blocks import CODE, PHASE, GnssBlock
from factorgraph.assembly.build import GnssLink
from factorgraph.assembly.engine import Eliminated
from factorgraph.assembly.intersystem import start_biases
from factorgraph.assembly.optimizer import Graph
from factorgraph.problem import AmbiguitySettings
from factorgraph.types import Array, IntArray

GROUP = 150  # ambiguities that are fixed jointly at most: the decorrelation costs the cube of their number


class _Sets:
    """Disjoint sets of 0 to n - 1."""

    def __init__(self, n: int) -> None:
        self.parent = np.arange(n)

    def root(self, i: int) -> int:
        parent = self.parent
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    def join(self, a: int, b: int) -> bool:
        """Make the sets of a and b one; False where they are already."""
        a, b = self.root(a), self.root(b)
        self.parent[b] = a
        return a != b


def datum_arcs(component: IntArray, group: IntArray, order: IntArray) -> list[int]:
    """Arcs whose integers may be chosen, the first in `order` that do: one per set of arcs that meet and, within it, one more
    per group that shares the set's clock by a bias of its own.

    All integers of group g in component k may change by c_k + b_g, which clocks and biases take up: as many as a spanning
    forest of the graph that has components and groups as nodes and arcs as edges.
    """
    sets = _Sets(len(component) + int(group.max(initial=-1)) + 1)
    return [int(arc) for arc in order if sets.join(int(component[arc]), len(component) + int(group[arc]))]


def connected_arcs(block: GnssBlock) -> IntArray:
    """Component (arcs,) of every arc: arcs observed under one clock at one epoch belong together."""
    n = len(block.amb_key)
    sets = _Sets(n)
    rows = np.flatnonzero((block.arc >= 0) & block.active)
    assert block.rows.clocks is not None
    clock = block.rows.clocks.of_row[rows]
    arc = block.arc[rows]
    for i in np.flatnonzero(clock[1:] == clock[:-1]):
        sets.join(int(arc[i]), int(arc[i + 1]))
    return np.array([sets.root(i) for i in range(n)], np.int64)


def start_ambiguities(data: GnssLink) -> None:
    """Start values from phase minus code at the current trajectory, and a datum in every connected set."""
    block = data.block
    n = len(block.amb_key)
    if n == 0:
        return
    block.amb_value[:] = 0
    block.predict()
    rows, clocks = block.rows, block.rows.clocks
    assert clocks is not None
    is_code = rows.kind == CODE
    n_groups = len(rows.group)
    label = rows.factor.of_row * n_groups + rows.group_index
    total = np.bincount(label[is_code], (block.y / rows.sigma**2)[is_code], minlength=int(label.max()) + 1)
    weight = np.bincount(label[is_code], (1 / rows.sigma**2)[is_code], minlength=int(label.max()) + 1)
    with np.errstate(invalid="ignore"):
        clock = total / np.where(weight > 0, weight, np.nan)
    phase = np.flatnonzero(block.arc >= 0)
    units = (block.y[phase] - clock[label[phase]]) / block.unit_m(phase)
    for arc in range(n):
        mine = units[block.arc[phase] == arc]
        mine = mine[np.isfinite(mine)]
        block.amb_value[arc] = np.median(mine) if len(mine) else 0.0
    length = np.bincount(block.arc[phase], minlength=n)
    component = connected_arcs(block)
    # relative to an arc of half cycles, whole ones would be no integers
    for datum in datum_arcs(component, data.arc_group, np.lexsort((-length, -block.amb_unit_cyc))):
        members = np.flatnonzero((component == component[datum]) & (data.arc_group == data.arc_group[datum]))
        off_cyc = block.amb_unit_cyc[datum] * (block.amb_value[datum] - np.round(block.amb_value[datum]))
        block.amb_value[members] -= off_cyc / block.amb_unit_cyc[members]
        block.amb_key[datum] = 0
        data.state[datum] = "datum"
    start_biases(block)
    block.renew()


@dataclass(frozen=True, slots=True)
class FixRound:
    """What one attempt achieved."""

    fixed: int
    ratio: float
    success_rate: float


def groups_in_time(start_s: Array, end_s: Array) -> list[IntArray]:
    """Arcs (n,) in groups of neighbours in time, each of at most GROUP: integers are sought for one group after the other."""
    order = np.argsort(start_s + end_s, kind="stable")
    return [np.sort(part) for part in np.array_split(order, -(-len(order) // GROUP))]


def fix_integers(graph: Graph, links: list[GnssLink], eliminated: Eliminated, settings: AmbiguitySettings) -> FixRound:
    """Fix what can be fixed of all free ambiguities jointly; fixed ones become constants."""
    free = [
        (data, i)
        for data in links
        for i in range(len(data.block.amb_key))
        if data.block.amb_key[i] != 0 and data.state[i] == "float" and data.has_integer(i)
    ]
    if not free:
        return FixRound(0, np.nan, 1.0)
    keys = [int(d.block.amb_key[i]) for d, i in free]
    present = [k for k in keys if k in graph.ambiguities]
    free = [f for f, k in zip(free, keys, strict=True) if k in graph.ambiguities]
    if not present:
        return FixRound(0, np.nan, 1.0)
    a = np.array([d.block.amb_value[i] for d, i in free])
    start_s, end_s = (np.array([getattr(d, name)[i] for d, i in free]) for name in ("arc_start_s", "arc_end_s"))
    for data, _ in free:
        if len(data.float_cyc) != len(data.block.amb_key):
            data.float_cyc, data.float_sigma = data.block.amb_value.copy(), np.full(len(data.block.amb_key), np.nan)
    is_fixed, integers, ratios, success = np.zeros(len(a), bool), a.copy(), [], 1.0
    for group in groups_in_time(start_s, end_s):
        Q = eliminated.covariance([present[j] for j in group])
        for j, sigma in zip(group.tolist(), np.sqrt(np.diag(Q)).tolist(), strict=True):
            data, i = free[j]
            if np.isnan(data.float_sigma[i]):
                data.float_sigma[i] = sigma
        result = partial.fix(
            a[group], 0.5 * (Q + Q.T), ratio_threshold=settings.ratio_threshold, min_success_rate=settings.min_success_rate
        )
        is_fixed[group], integers[group] = result.fixed, result.integers
        if np.any(result.fixed):
            ratios.append(float(result.ratio))
            success *= float(result.success_rate)
    count = 0
    switchable = settings.hold == "switchable"
    for j, (data, i) in enumerate(free):
        if is_fixed[j]:
            data.block.amb_value[i] = integers[j]
            if not switchable:
                data.block.amb_key[i] = 0
            data.state[i] = "fixed"
            count += 1
    for data in links if count else []:
        if switchable:
            arcs = [i for (of, i), fixed in zip(free, is_fixed, strict=True) if fixed and of is data]
            graph.blocks.append(switches.hold(data.block, np.array(arcs, np.int64), data.block.rows.source))
        data.block.renew()
    return FixRound(count, min(ratios, default=np.nan), success)


def release_refused(graph: Graph, links: list[GnssLink], settings: AmbiguitySettings) -> int:
    """Release fixed arcs whose phase residuals refuse the integer, or whose switch has opened; returns how many."""
    released = 0
    for data in links if settings.hold == "switchable" else []:
        for switch in (b for b in graph.blocks if isinstance(b, switches.SwitchBlock) and b.of is data.block):
            for i in switch.open_arcs().tolist():
                data.state[i] = "released"
                released += 1
    for data in links if settings.hold == "constant" else []:
        block = data.block
        t = block.residuals() / block.rows.sigma
        for i in np.flatnonzero([s == "fixed" for s in data.state]):
            rows = np.flatnonzero((block.arc == i) & (block.rows.kind == PHASE))
            if len(rows) and np.sqrt(np.mean(t[rows] ** 2)) > settings.release_sigma:
                data.make_free(int(i))
                data.state[i] = "released"
                released += 1
                block.renew()
    return released
