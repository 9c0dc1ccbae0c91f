"""CasADi's derivatives and fronts along time as the engine of assembled problems.

Every block is evaluated by its symbolic model (`evaluate`), exact Jacobian included; the linear systems are factored along the
stages of the grid (`fronts`). Nothing is shared with the GTSAM engine but the rows' meaning, so that each checks the other.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.blocks import Block
from factorgraph.assembly.keys import dimension
from factorgraph.assembly.optimizer import Graph
from factorgraph.least_squares.evaluate import Evaluator, evaluator
from factorgraph.least_squares.fronts import (
    FactorBlock,
    Factorised,
    Layout,
    Part,
    Scalars,
    SelectedCovariance,
    Undetermined,
    Variables,
)
from factorgraph.types import Array, BoolArray, IntArray

REMEMBERED = 64  # layouts of windows


@dataclass(slots=True)
class Factored:
    """A linear problem factored along time."""

    factor: Factorised
    solution: Array | None = None

    def all(self) -> Array:
        """The whole minimiser (N,), by the layout's offsets."""
        if self.solution is None:
            self.solution = self.factor.step()
        return self.solution

    def step(self, keys: Sequence[int] | IntArray) -> Array:
        """The minimiser's components (n, d)."""
        solution = self.all()
        layout = self.factor.layout
        at = layout.index(keys)
        d = int(layout.dim[at[0]]) if len(at) else 0
        return np.asarray(solution[layout.offset[at][:, None] + np.arange(d)])

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of a few variables."""
        return self.factor.covariance(keys)

    def covariances(self) -> SelectedCovariance:
        """Those of all variables that share a front: all states of one time, and what lives then."""
        return self.factor.selected()


@dataclass(slots=True)
class LinearRows:
    """Whitened rows of a linearised problem with their layout."""

    layout: Layout
    parts: list[Part]
    engine: StageEngine

    def eliminate(self, lam: float) -> Factored | None:
        """Eliminate all variables, damped by lam; None where the problem is singular."""
        found = self.layout.factorise(self.parts, lam)
        if isinstance(found, Undetermined):
            self.engine.undetermined = found
            return None
        return Factored(found)


@dataclass(slots=True)
class StageEngine:
    """Blocks evaluated by symbolic models, eliminated front by front."""

    packages: tuple[str, ...] = ("casadi",)
    codegen: bool | None = None  # compiled models; None: as the environment says
    undetermined: Undetermined | None = None  # why the last elimination failed
    _evaluators: dict[int, tuple[Block, Evaluator]] = field(default_factory=dict)
    _structure: tuple[list[object], Structure] | None = None

    def predict(self, block: Block) -> None:
        """Set the block's y and J at the current variables."""
        known = self._evaluators.get(id(block))
        if known is None or known[0] is not block:
            known = self._evaluators[id(block)] = block, evaluator(block, self.codegen)
        known[1].evaluate()

    def linearise(self, graph: Graph, joints: bool) -> LinearRows:
        """The blocks' whitened rows. The states of one time always share a front, so `joints` asks for nothing more."""
        version: list[object] = [(id(block), block.version) for block in graph.blocks]
        if self._structure is None or self._structure[0] != version:
            self._structure = version, Structure.of(graph)
        structure = self._structure[1]
        parts = [part_of(block, used) for block, used in zip(graph.blocks, structure.used, strict=True)]
        return LinearRows(structure.layout, parts, self)

    def remarks(self, graph: Graph) -> list[str]:
        """What the last elimination that failed could not determine."""
        if self.undetermined is None:
            return []
        return [f"nothing measured determines {graph.name_of(self.undetermined.key)}"]


@dataclass(frozen=True, slots=True)
class Structure:
    """Where the variables and rows of a graph go."""

    layout: Layout
    used: list[BoolArray | None]  # (factors, k) of each block: columns that are variables; None: all

    @classmethod
    def of(cls, graph: Graph) -> Structure:
        """The structure of a whole flight."""
        states = [[v.keys(k) for v in graph.vehicles] for k in range(len(graph.vehicles[0].t_s))]
        return cls.along(graph.blocks, states, [p.key for p in graph.parameters], {})

    @classmethod
    def along(
        cls,
        of_blocks: Sequence[Block],
        states: Sequence[Sequence[tuple[int, ...]]],
        constants: Sequence[int],
        ends: Mapping[int, int],
        known: dict[Hashable, Layout] | None = None,
    ) -> Structure:
        """States at their times, ambiguities and nodes while they are seen or until stage ends[key], constants last.

        states: keys of each vehicle's states, stage by stage; known: layouts made before, of which one may do under other names.
        """
        blocks, used = [], []
        for block in of_blocks:
            table = block.key_table()
            mask = None if np.all(table) else table != 0
            blocks.append(factor_block(block, table, mask))
            used.append(mask)
        stage: dict[int, int] = {}
        for k, of_vehicles in enumerate(states):
            for keys_of in of_vehicles:
                stage |= dict.fromkeys(reversed(keys_of), k)  # biases first: the next time sees least of them
        stage |= dict.fromkeys(constants, max(len(states) - 1, 0)) | dict(ends)
        seen = [b.keys.ravel() for b in blocks] + [b.scalars.keys for b in blocks if b.scalars is not None]
        present = set(np.unique(np.concatenate([np.zeros(0, np.int64), *seen])).tolist())
        keys = [*(key for key in stage if key in present), *sorted(present - stage.keys())]
        dims = np.array([dimension(key) for key in keys], np.int64)
        last = np.array([stage.get(key, -1) for key in keys], np.int64)
        key = np.array(keys, np.int64)
        if known is None:
            return cls(Layout(Variables(key, dims, last), blocks), used)
        shape = (dims.tobytes(), last.tobytes(), *(_shape(block, np.argsort(key), np.sort(key)) for block in blocks))
        if shape not in known:
            if len(known) >= REMEMBERED:
                known.clear()
            known[shape] = Layout(Variables(key, dims, last), blocks)
        return cls(known[shape].renamed(key), used)


def _shape(block: FactorBlock, place: IntArray, names: IntArray) -> Hashable:
    """What tells a block from another up to the variables' names; place (v,) of the sorted names (v,)."""
    own = (block.widths, place[np.searchsorted(names, block.keys)].tobytes(), block.start.tobytes())
    if block.scalars is None:
        return own
    s = block.scalars
    return (*own, place[np.searchsorted(names, s.keys)].tobytes(), s.first_key.tobytes(), s.first.tobytes())


def factor_block(block: Block, table: IntArray, used: BoolArray | None) -> FactorBlock:
    """The structure of a block. Where constants stand in for variables, its columns become scalars that differ in number."""
    start = np.append(block.rows.factor.start, block.n).astype(np.int64)
    own = block.scalars()
    if own is not None:
        return FactorBlock(block.widths(), table, start, Scalars(own.keys, own.first_key, own.first))
    if used is None:
        return FactorBlock(block.widths(), table, start)
    first = np.concatenate([[0], np.cumsum(used.sum(axis=1))]).astype(np.int64)  # of one row and width each
    return FactorBlock((), np.zeros((len(table), 0), np.int64), start, Scalars(table[used], first, first))


def part_of(block: Block, used: BoolArray | None) -> Part:
    """The numbers of a block, whitened before."""
    own = block.scalars()
    if own is not None:
        return Part(block.e, block.Jw, own.dense)
    return Part(block.e, block.Jw) if used is None else Part(block.e, np.zeros((block.n, 0)), block.Jw[used])
