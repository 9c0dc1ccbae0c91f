"""Pieces of blocks: the rows of a few stages, over the same variables as the whole.

Filters and windows look at a flight stage by stage. A piece shares vehicles, parameters, ambiguities and nodes with the block it
was cut from; only rows, queries and what belongs to rows are its own.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from factorgraph.assembly.atmosphere import NodeBlock
from factorgraph.assembly.blocks import Columns, Endpoint, EndsBlock, GnssBlock, PositionBlock, Rows
from factorgraph.assembly.inertial_block import ImuBlock
from factorgraph.assembly.nodes import Nodes
from factorgraph.assembly.priors import MotionBlock
from factorgraph.assembly.sensors import Measured, VectorBlock
from factorgraph.assembly.variables import Query
from factorgraph.errors import InputError
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.preintegration import Increments
from factorgraph.types import IntArray

TABLES = ("amb_key", "amb_value", "amb_unit_cyc")  # of arcs, not of rows


def sliced(block: EndsBlock, f0: int, f1: int) -> EndsBlock:
    """A block of the factors f0 to f1 - 1 alone; its variables are the same objects."""
    rows, entries, n_entries = _cuts(block, f0, f1)
    part = copy.copy(block)
    for field in fields(block):
        value = getattr(block, field.name, None)
        if isinstance(value, Endpoint):
            setattr(part, field.name, _end(value, entries))
        elif isinstance(value, Measured):
            setattr(part, field.name, _measured(value, entries))
        elif isinstance(value, np.ndarray) and field.name not in TABLES and len(value) in (block.n, n_entries):
            setattr(part, field.name, value[rows if len(value) == block.n else entries])
    part.rows = _rows(block.rows, rows)
    part.white = type(block.white)()
    part.nodes = [_nodes(nodes, rows.start, rows.stop) for nodes in block.nodes]
    if isinstance(part, GnssBlock):
        part.point_rover, part.scalar_columns = part.point_rover - f0, None
    if isinstance(part, VectorBlock):
        part.of_row = part.of_row - entries.start
    part.columns_of = Columns(part.ends(), part.parameters())
    return part


def _cuts(block: EndsBlock, f0: int, f1: int) -> tuple[slice, slice, int]:
    """Rows of factors f0 to f1 - 1, the entries of the ends' queries that these see, and the number of all entries."""
    rows = slice(block.slices(f0)[0], block.slices(f1 - 1)[1])
    if isinstance(block, (GnssBlock, PositionBlock)):
        return rows, slice(f0, f1), len(block.rows.factor.start)
    if isinstance(block, VectorBlock):
        return rows, slice(int(block.of_row[rows.start]), int(block.of_row[rows.stop - 1]) + 1), len(block.measured.t_s)
    return rows, rows, block.n


def _measured(measured: Measured, entries: slice) -> Measured:
    arrays = {f.name: getattr(measured, f.name)[entries] for f in fields(measured) if f.name != "ends"}
    return replace(measured, ends=tuple(_end(end, entries) for end in measured.ends), **arrays)


def _end(end: Endpoint, entries: slice) -> Endpoint:
    q = end.query
    inc = q.increments
    if inc is not None:
        inc = Increments(*(getattr(inc, name)[entries] for name in Increments.__dataclass_fields__))
    return replace(end, query=Query(q.k[entries], q.dt_s[entries], q.lever_b[entries], inc))


def _groups(groups: CommonGroups, rows: slice) -> CommonGroups:
    return CommonGroups.from_labels(groups.of_row[rows])


def _rows(rows: Rows, own: slice) -> Rows:
    part = copy.copy(rows)
    n = len(rows.sigma)
    for field in fields(rows):
        value = getattr(rows, field.name)
        if isinstance(value, np.ndarray) and len(value) == n:
            setattr(part, field.name, value[own])
    part.factor = _groups(rows.factor, own)
    part.clocks = None if rows.clocks is None else _groups(rows.clocks, own)
    return part


def _nodes(nodes: Nodes, i: int, j: int) -> Nodes:
    part = copy.copy(nodes)
    mine = (nodes.row >= i) & (nodes.row < j)
    part.row, part.node, part.scale = nodes.row[mine] - i, nodes.node[mine], nodes.scale[mine]
    return part


Interval = TypeVar("Interval", bound=ImuBlock | MotionBlock)


def intervals_of(block: Interval, a: int, b: int) -> Interval:
    """The intervals between states a to b of a block of all of them."""
    part = copy.copy(block)
    d = block.n // len(block.rows.factor.start)
    part.rows, part.white, part.first = _rows(block.rows, slice(a * d, b * d)), type(block.white)(), a
    part.w, part.active = block.w[a * d : b * d], block.active[a * d : b * d]
    if isinstance(part, MotionBlock):
        part.L, part.J0 = part.L[a:b], part.J0[a:b]
    else:
        part.at_bias, part.gravitation_n = part.at_bias[a:b], part.gravitation_n[a:b]
        part.intervals = part.intervals.between(a, b)
    return part


def rows_of(block: NodeBlock, rows: IntArray) -> NodeBlock:
    """Rows of a process alone."""
    part = copy.copy(block)
    table = copy.copy(block.rows)
    for field in fields(Rows):
        value = getattr(table, field.name)
        if isinstance(value, np.ndarray) and len(value) == block.n:
            setattr(table, field.name, value[rows])
    table.factor = CommonGroups.from_labels(np.arange(len(rows)))
    part.rows, part.white, part.only = table, type(block.white)(), rows
    part.w, part.active = block.w[rows], block.active[rows]
    return part


@dataclass(frozen=True, slots=True)
class Staged:
    """A block with the first and last state that each of its factors sees; the last ones never decrease."""

    block: EndsBlock
    first: IntArray  # (factors,)
    last: IntArray

    @classmethod
    def of(cls, block: EndsBlock) -> Staged:
        entries = block.entries()
        k = np.array([end.query.k[entries] for end in block.ends() if end.vehicle.mode != "fixed"])
        first, last = k.min(axis=0), k.max(axis=0)
        if np.any(np.diff(last) < 0):
            raise InputError(f"{block.rows.source}: rows are not in the order of their states")
        return cls(block, first, last)

    def between(self, a: int, b: int) -> EndsBlock | None:
        """Its factors that see states a to b and no others."""
        f0, f1 = (int(f) for f in np.searchsorted(self.last, [a, b + 1]))
        early = np.flatnonzero(self.first[f0:f1] < a)  # also see a state before: rare, and among the first
        f0 += int(early[-1]) + 1 if len(early) else 0
        return sliced(self.block, f0, f1) if f0 < f1 else None
