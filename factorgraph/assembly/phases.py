"""Arcs of a link's phases in the graph: slips found, repaired or made the ends of arcs before and after solutions.

The trajectory of the moment predicts the phases (`factorgraph.models.slips`): the start graph's before the first solution,
the smoothed one, by an IMU where there is one, afterwards. Whenever arcs change, all ambiguities start anew.
"""

from __future__ import annotations

import numpy as np

from factorgraph.assembly.build import GnssLink, describe_arcs
from factorgraph.assembly.engine import Eliminated
from factorgraph.assembly.integers import connected_arcs, start_ambiguities
from factorgraph.models.arcs import CAUSES, PREDICTION, RESIDUAL_STEP, split_at_steps
from factorgraph.models.slips import Phases, Repaired, Steps, find_steps, repair, whole_cycles
from factorgraph.problem import AmbiguitySettings
from factorgraph.solution import SlipTable
from factorgraph.types import Array, IntArray

HALF_SIGMA = 3.0  # agreement of a difference with half a cycle, and disagreement with a whole one
STEP_CYC = 0.3  # smallest step of an arc's residuals that is a slip


def prepare(data: GnssLink, settings: AmbiguitySettings) -> None:
    """Arcs for the first solution, at the start trajectory, with start values of their ambiguities."""
    block = data.block
    if not np.any(block.arc >= 0):
        return
    block.predict()
    rows, steps, repaired = _judged(data, settings)
    _note(data, rows, repaired, steps)
    _renew(data, rows, repaired.arc, repaired.jump_cyc, settings)


def split_slipped(data: GnssLink, settings: AmbiguitySettings, join: bool = True) -> int:
    """End or mend arcs over slips that show in a solution; all ambiguities start anew if any does. Returns how many do.

    join: also mend ends of arcs that the solution now sees through.
    """
    block = data.block
    if not np.any(block.arc >= 0):
        return 0
    block.predict()
    res = block.residuals()
    rows, steps, repaired = _judged(data, settings)
    changes = int(np.sum(steps.slipped)) + (len(repaired.joined) if join else 0)
    if changes:
        _note(data, rows, repaired, steps)
        _renew(data, rows, repaired.arc, repaired.jump_cyc, settings)
        return changes
    arc, min_step = block.arc[rows], STEP_CYC * block.wavelength_m[rows]
    new, split = split_at_steps(res[rows], block.rows.sigma[rows], arc, block.rows.t_s[rows], min_step, settings.min_arc_epochs)
    if split:
        begins = steps.after[(new[steps.before] != new[steps.after]) & (arc[steps.before] == arc[steps.after])]
        data.cause[rows[begins]] = RESIDUAL_STEP
        _renew(data, rows, new, block.jump_cyc[rows], settings)
    return split


def _judged(data: GnssLink, settings: AmbiguitySettings) -> tuple[IntArray, Steps, Repaired]:
    """Rows of the block with phases in arcs, the steps between them and the arcs these make; the block is predicted."""
    block = data.block
    rows = np.flatnonzero(block.arc >= 0)
    table = block.rows
    of_arc = block.unit_m(rows) * block.amb_value[block.arc[rows]]
    phases = Phases(
        epoch=table.factor.of_row[rows],
        t_s=table.t_s[rows],
        series=_series(data, rows),
        arc=block.arc[rows],
        residual_m=block.y[rows] + of_arc,
        jump_cyc=block.jump_cyc[rows],
        gradient=block.by_rover[rows],
        sigma_m=table.sigma[rows],
        wavelength_m=block.wavelength_m[rows],
        half=data.half[rows],
    )
    steps = find_steps(phases)
    least = settings.slip_success if settings.slip_repair else 1.0
    return rows, steps, repair(phases, steps, least, settings.slip_gap_s)


def _series(data: GnssLink, rows: IntArray) -> IntArray:
    table = data.block.rows
    return np.asarray(table.label_index[rows] * len(table.group) + table.group_index[rows])


def _note(data: GnssLink, rows: IntArray, repaired: Repaired, steps: Steps) -> None:
    data.cause[rows[steps.after[steps.slipped]]] = PREDICTION
    data.repairs.update(zip(rows[repaired.joined].tolist(), repaired.sigma_cyc.tolist(), strict=True))


def _renew(data: GnssLink, rows: IntArray, arc: IntArray, jump_cyc: Array, settings: AmbiguitySettings) -> None:
    """Give the rows these arcs; phases of arcs that are too short are not used."""
    block = data.block
    jump_cyc, half = whole_cycles(arc, jump_cyc, data.half[rows], data.odd[rows])
    long = np.bincount(arc)[arc] >= settings.min_arc_epochs
    block.active[rows[~long]] = False
    block.arc[rows] = -1
    kept, block.arc[rows[long]] = np.unique(arc[long], return_inverse=True)
    block.jump_cyc[rows] = jump_cyc
    describe_arcs(data)
    block.amb_unit_cyc = np.where(half[kept], 0.5, 1.0)
    start_ambiguities(data)


def open_halves(links: list[GnssLink], eliminated: Eliminated, settings: AmbiguitySettings) -> int:
    """Let arcs be multiples of half a cycle that float ambiguities show to be half a cycle apart from their satellite's next.

    Half a cycle was lost between them unannounced, and nothing tells on which side; returns how many arcs.
    """
    opened = 0
    for data in links:
        block = data.block
        arcs = np.array([i for i in range(len(block.amb_key)) if data.has_integer(i)], np.int64)
        rows = np.flatnonzero(block.arc >= 0)
        series = np.zeros(len(block.amb_key), np.int64)
        series[block.arc[rows]] = _series(data, rows)
        arcs = arcs[np.lexsort((data.arc_start_s[arcs], series[arcs]))]
        i, j = arcs[:-1], arcs[1:]
        component = connected_arcs(block)
        near = (series[i] == series[j]) & (component[i] == component[j])
        near &= (block.amb_unit_cyc[i] == 1.0) & (block.amb_unit_cyc[j] == 1.0)
        near &= np.abs(np.abs(block.amb_value[j] - block.amb_value[i]) % 1 - 0.5) < 0.25
        odd = {int(arc) for pair in zip(i[near], j[near], strict=True) if _is_half_apart(data, pair, eliminated) for arc in pair}
        if odd:
            data.odd |= np.isin(block.arc, list(odd))
            _renew(data, rows, block.arc[rows], block.jump_cyc[rows], settings)
            opened += len(odd)
    return opened


def _is_half_apart(data: GnssLink, pair: tuple[int, int], eliminated: Eliminated) -> bool:
    """Whether the difference of two float ambiguities agrees with half a cycle and with no whole one."""
    block = data.block
    free = [int(block.amb_key[arc]) for arc in pair if block.amb_key[arc] != 0]
    sign = np.array([s for s, arc in zip((-1.0, 1.0), pair, strict=True) if block.amb_key[arc] != 0])
    sigma = float(np.sqrt(sign @ eliminated.covariance(free) @ sign))
    off = abs(abs(float(block.amb_value[pair[1]] - block.amb_value[pair[0]])) % 1 - 0.5)
    return off < HALF_SIGMA * sigma < 0.5 - off


def slip_table(links: list[GnssLink]) -> SlipTable:
    """Every slip taken off and every end of an arc inside the time of its satellite and signal."""
    tables = [_slips(data) for data in links]
    if not tables:
        return SlipTable()
    return SlipTable(
        link=tuple(x for t in tables for x in t.link),
        satellite=tuple(x for t in tables for x in t.satellite),
        signal=tuple(x for t in tables for x in t.signal),
        t_s=np.concatenate([t.t_s for t in tables]),
        cycles=np.concatenate([t.cycles for t in tables]),
        sigma_cyc=np.concatenate([t.sigma_cyc for t in tables]),
        repaired=np.concatenate([t.repaired for t in tables]),
        cause=tuple(x for t in tables for x in t.cause),
    )


def _slips(data: GnssLink) -> SlipTable:
    block, table = data.block, data.block.rows
    rows = np.flatnonzero(block.arc >= 0)
    rows = rows[np.lexsort((table.t_s[rows], _series(data, rows)))]
    before, after = rows[:-1], rows[1:]
    same = _series(data, before) == _series(data, after)
    ended = block.arc[before] != block.arc[after]
    at = np.flatnonzero(same & (ended | np.isin(after, list(data.repairs))))
    at = at[np.argsort(table.t_s[after[at]], kind="stable")]
    before, after, ended = before[at], after[at], ended[at]
    sigma = np.array([data.repairs.get(row, np.nan) for row in after.tolist()])
    return SlipTable(
        link=(table.source,) * len(after),
        satellite=tuple(table.label[i] for i in table.label_index[after]),
        signal=tuple(table.group[i] for i in table.group_index[after]),
        t_s=table.t_s[after],
        cycles=np.where(ended, np.nan, block.jump_cyc[after] - block.jump_cyc[before]),
        sigma_cyc=np.where(ended, np.nan, sigma),
        repaired=~ended,
        cause=tuple(CAUSES[max(cause, 0)] for cause in data.cause[after].tolist()),
    )
