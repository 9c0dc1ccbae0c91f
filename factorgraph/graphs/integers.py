"""Integers of the graph's carrier phases: start values, datum, fixing, holding and releasing.

Ambiguities are single differences rover - reference per arc, in cycles. Each epoch's clock per signal is free, so only
differences between arcs that meet are determined: in every connected set of arcs the longest is the datum, a constant
integer, and all others are integers relative to it. No pivot satellite changes, no ambiguity changes with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from ambiguity import partial
from factorgraph.graphs.blocks import CODE, PHASE, GnssBlock
from factorgraph.graphs.build import GnssLink, describe_arcs
from factorgraph.graphs.optimizer import DIMENSION, Graph
from factorgraph.graphs.parameters import LETTERS
from factorgraph.models.arcs import split_at_steps
from factorgraph.problem import AmbiguitySettings
from factorgraph.types import Array, IntArray


def connected_arcs(block: GnssBlock) -> IntArray:
    """Component (arcs,) of every arc: arcs observed in one clock group at one epoch belong together."""
    n = len(block.amb_key)
    parent = np.arange(n)

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    rows = np.flatnonzero((block.arc >= 0) & block.active)
    assert block.rows.clocks is not None
    clock = block.rows.clocks.of_row[rows]
    arc = block.arc[rows]
    for i in np.flatnonzero(clock[1:] == clock[:-1]):
        a, b = root(int(arc[i])), root(int(arc[i + 1]))
        if a != b:
            parent[b] = a
    return np.array([root(i) for i in range(n)], np.int64)


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
    cycles = (block.y[phase] - clock[label[phase]]) / block.wavelength_m[phase]
    for arc in range(n):
        mine = cycles[block.arc[phase] == arc]
        mine = mine[np.isfinite(mine)]
        block.amb_value[arc] = np.median(mine) if len(mine) else 0.0
    length = np.bincount(block.arc[phase], minlength=n)
    component = connected_arcs(block)
    for c in np.unique(component):
        members = np.flatnonzero(component == c)
        datum = int(members[np.argmax(length[members])])
        block.amb_value[members] -= block.amb_value[datum] - np.round(block.amb_value[datum])
        block.amb_key[datum] = 0
        data.state[datum] = "datum"
    block.renew()


def split_slipped(data: GnssLink, settings: AmbiguitySettings) -> int:
    """Split arcs whose residuals step (slips that no detector saw); all ambiguities start anew. Returns the splits."""
    block = data.block
    block.predict()
    res = block.residuals()
    lam = block.wavelength_m
    new, split = split_at_steps(res, block.rows.sigma, block.arc, block.rows.t_s, 0.3 * lam, settings.min_arc_epochs)
    if split:
        block.arc = new
        describe_arcs(data)
        data.slips["residual step"] = data.slips.get("residual step", 0) + split
        start_ambiguities(data)
    return split


@dataclass(frozen=True, slots=True)
class FixRound:
    """What one attempt achieved."""

    fixed: int
    ratio: float
    success_rate: float


def tail_covariance(net: gtsam.GaussianBayesNet, keys: list[int]) -> Array:
    """Covariance of variables that were eliminated last: R of the net's tail, inverted. `keys` scalar variables."""
    n = net.size()
    tail = []
    for i in range(n - 1, -1, -1):
        c = net.at(i)
        if chr(gtsam.symbolChr(c.keys()[0])) not in ("a", *LETTERS.values()):
            break
        tail.append(c)
    tail.reverse()
    index: dict[int, int] = {}
    size = 0
    for c in tail:
        index[c.keys()[0]] = size
        size += c.R().shape[0]
    R = np.zeros((size, size))
    for c in tail:
        own, *parents = c.keys()
        i, d = index[own], c.R().shape[0]
        R[i : i + d, i : i + d] = c.R()
        S, col = c.S(), 0
        for p in parents:
            width = DIMENSION[chr(gtsam.symbolChr(p))]
            R[i : i + d, index[p] : index[p] + width] = S[:, col : col + width]
            col += width
    Ri = np.linalg.inv(R)
    P = Ri @ Ri.T
    pick = [index[k] for k in keys]
    return P[np.ix_(pick, pick)]


def fix_integers(graph: Graph, links: list[GnssLink], net: gtsam.GaussianBayesNet, settings: AmbiguitySettings) -> FixRound:
    """Fix what can be fixed of all free ambiguities jointly; fixed ones become constants."""
    free = [
        (data, i)
        for data in links
        for i in range(len(data.block.amb_key))
        if data.block.amb_key[i] != 0 and data.state[i] == "float"
    ]
    if not free:
        return FixRound(0, np.nan, 1.0)
    keys = [int(d.block.amb_key[i]) for d, i in free]
    present = [k for k in keys if graph.values.exists(k)]
    free = [f for f, k in zip(free, keys, strict=True) if graph.values.exists(k)]
    if not present:
        return FixRound(0, np.nan, 1.0)
    Q = tail_covariance(net, present)
    a = np.array([d.block.amb_value[i] for d, i in free])
    for data, _ in free:
        if len(data.float_cyc) != len(data.block.amb_key):
            data.float_cyc, data.float_sigma = data.block.amb_value.copy(), np.full(len(data.block.amb_key), np.nan)
    for j, (data, i) in enumerate(free):
        if np.isnan(data.float_sigma[i]):
            data.float_sigma[i] = np.sqrt(Q[j, j])
    result = partial.fix(a, 0.5 * (Q + Q.T), ratio_threshold=settings.ratio_threshold, min_success_rate=settings.min_success_rate)
    count = 0
    for j, (data, i) in enumerate(free):
        if result.fixed[j]:
            data.block.amb_value[i] = result.integers[j]
            data.block.amb_key[i] = 0
            data.state[i] = "fixed"
            count += 1
    if count:
        for data in links:
            data.block.renew()
    return FixRound(count, float(result.ratio), float(result.success_rate))


def release_refused(links: list[GnssLink], settings: AmbiguitySettings) -> int:
    """Release fixed arcs whose phase residuals refuse the integer; returns how many."""
    released = 0
    for data in links:
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
