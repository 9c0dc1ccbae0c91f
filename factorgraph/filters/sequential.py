"""An assembled problem seen stage by stage: what a recursive filter needs of the blocks of a whole flight.

Stage k holds the error states of all vehicles at grid time k (columns as in `assembly.variables`: rotation, position in the
body frame, velocity, accelerometer and gyroscope bias; or position and velocity), the parameters, and those ambiguities and
nodes that are alive: from the first stage that sees them to the last. From stage to stage

    d_{k+1} = F d_k + w,   F = -inv(J_j) J_i,   Q = inv(J_j' J_j)

with the whitened Jacobians J_i, J_j of the interval's rows (inertial or motion prior) at the predicted states, where the rows
are zero. Scalars stay as they are; they enter with a wide prior, nodes then with the row of their process.

Rows are evaluated for several stages at once, at states that are carried from the first of them without measurements: the
filter's mean is then a deviation from those, and innovations are e - H d.

Rows that see states of two times are no measurements of a stage; they are counted and left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgraph.assembly.atmosphere import NodeBlock
from factorgraph.assembly.blocks import CODE, CONSTRAINT, Block, EndsBlock, GnssBlock
from factorgraph.assembly.inertial_block import ImuBlock
from factorgraph.assembly.keys import dimension
from factorgraph.assembly.optimizer import Graph
from factorgraph.assembly.parameters import Parameter
from factorgraph.assembly.pieces import sliced
from factorgraph.assembly.priors import MotionBlock, ParameterPrior, StatePrior
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.errors import InputError
from factorgraph.filters.charts import BODY, Chart
from factorgraph.models.imu_interval import States, carry_along, evaluate
from factorgraph.types import Array, BoolArray, IntArray

AMBIGUITY_UNITS = 100.0  # standard deviation of an ambiguity at its first phase
NODE_FACTOR = 1e3  # of a node before its process is applied, over the process's own


@dataclass(slots=True)
class Scalar:
    """Where the value of an ambiguity or a node is, and from which stage to which it is alive."""

    values: Array
    index: int
    sigma: float
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class StageRows:
    """Whitened rows of one stage at the states they were evaluated at: e = measured - predicted."""

    e: Array  # (m,)
    H: Array  # (m, n)
    share: Array  # (m,) of a row that common clocks leave; they take clocks rows together
    kind: IntArray  # (m,) -1 of processes
    judged: BoolArray  # (m,) rows whose standard deviation is that of a single measurement
    judged_clocks: float
    at: list[tuple[int, int, int]]  # block, first row, one past the last

    @property
    def clocks(self) -> int:
        """Directions that common clocks took."""
        return round(len(self.e) - float(self.share.sum()))

    @property
    def dof(self) -> int:
        return len(self.e) - self.clocks


@dataclass(frozen=True, slots=True)
class _Sorted:
    """A block with the stages of its factors, which never decrease."""

    block: EndsBlock
    number: int
    stage: IntArray  # (factors,)
    alive: list[bool]
    judged: BoolArray  # (n,) rows; undifferenced codes stand for errors that persist, constraints for nothing measured


class Part:
    """Factors f0 to f1 - 1 of a block, evaluated."""

    def __init__(self, of: _Sorted, f0: int, f1: int, part: EndsBlock) -> None:
        self.of, self.f0, self.f1, self.part = of, f0, f1, part
        self.row0 = of.block.slices(f0)[0]

    @cached_property
    def left(self) -> Array:
        """Shares (n,) of the whitened rows that common clocks leave."""
        clocks = self.part.rows.clocks
        return np.ones(self.part.n) if clocks is None else 1 - clocks.leverage(self.part.u)


def usable(block: Block) -> bool:
    """Whether a chain of stages can see the block's rows: of one time, of neighbouring ones, or of constants."""
    return isinstance(block, (EndsBlock, ImuBlock, MotionBlock, StatePrior, ParameterPrior, NodeBlock))


class Stages:
    """Positions of all variables, lifetimes of scalars, rows and transitions of stages."""

    def __init__(self, graph: Graph, chart: Chart = BODY) -> None:
        self.graph, self.vehicles, self.chart = graph, [v for v in graph.vehicles if v.mode != "fixed"], chart
        self.t_s = graph.vehicles[0].t_s
        self.K = len(self.t_s)
        self.offset: dict[int, int] = {}  # vehicle -> first column
        self.place: dict[int, int] = {}  # key of a state or parameter -> first column
        self.stage: dict[int, int] = {}  # key of a state -> its stage
        self.left_out: list[str] = []
        n = 0
        for v in self.vehicles:
            self.offset[v.index] = n
            edges = np.cumsum([0, *v.dims]).tolist()
            for k in range(self.K):
                self.place.update((key, n + at) for key, at in zip(v.keys(k), edges, strict=False))
                self.stage.update((key, k) for key in v.keys(k))
            n += sum(v.dims)
        self.n_states = n
        self.parameters: list[Parameter] = list(graph.parameters)
        for p in self.parameters:
            self.place[p.key] = n
            n += len(p.value)
        self.n_fixed = n
        self.sorted = [s for i, b in enumerate(graph.blocks) if (s := self._sorted(b, i)) is not None]
        self.scalars = self._scalars()
        self.processes = self._processes()
        self.live = self._lives()
        self.imu = {b.vehicle.index: b for b in graph.blocks if isinstance(b, ImuBlock)}
        self.motion = {b.vehicle.index: b for b in graph.blocks if isinstance(b, MotionBlock)}

    def _sorted(self, block: Block, number: int) -> _Sorted | None:
        if isinstance(block, (ImuBlock, MotionBlock, StatePrior, ParameterPrior, NodeBlock)):
            return None
        if not usable(block) or not isinstance(block, EndsBlock):
            self.left_out.append(f"{block.rows.source}: {len(block.rows.factor.start)} constraints between two times")
            return None
        entry = block.entries()
        of_end = np.array([end.query.k[entry] for end in block.ends() if end.vehicle.mode != "fixed"])
        stage = of_end.max(axis=0)
        alone = of_end.min(axis=0) == stage
        if not np.all(alone):
            self.left_out.append(f"{block.rows.source}: {int(np.sum(~alone))} groups of rows that see two times")
        if np.any(np.diff(stage) < 0):
            raise InputError(f"{block.rows.source}: rows are not in the order of their states")
        judged = block.rows.kind != CONSTRAINT
        if isinstance(block, GnssBlock) and block.reference is None:
            judged &= block.rows.kind != CODE
        return _Sorted(block, number, stage, alone.tolist(), judged)

    def _scalars(self) -> dict[int, Scalar]:
        found: dict[int, Scalar] = {}

        def see(key: int, values: Array, index: int, sigma: float, stage: int) -> None:
            known = found.setdefault(key, Scalar(values, index, sigma, stage, stage))
            known.first, known.last = min(known.first, stage), max(known.last, stage)

        for s in self.sorted:
            b = s.block
            where = {}
            if isinstance(b, GnssBlock):
                where = {int(key): (b, "amb_value", i) for i, key in enumerate(b.amb_key) if key}
            tables = {int(key): (nodes.value, i) for nodes in b.nodes for i, key in enumerate(nodes.key)}
            columns = b.scalars()
            if columns is None and not tables:
                continue
            for f, stage in enumerate(s.stage.tolist()):
                keys = columns.of(f) if columns is not None else [key for key in b.keys(f) if key in tables]
                for key in keys:
                    if key in where:
                        see(key, b.amb_value, where[key][2], AMBIGUITY_UNITS, stage)  # type: ignore[attr-defined]
                    else:
                        see(key, *tables[key], 0.0, stage)
        return found

    def _processes(self) -> dict[int, list[tuple[NodeBlock, int]]]:
        """Rows of nodes by the stage at which they apply; nodes live until the next of their series has entered."""
        due: dict[int, list[tuple[NodeBlock, int]]] = {}
        for block in self.graph.blocks:
            if isinstance(block, NodeBlock):
                for f in range(block.n):
                    own, before = block.keys(f)
                    if own not in self.scalars:
                        continue
                    s = self.scalars[own]
                    s.sigma = NODE_FACTOR * float(block.rows.sigma[f])
                    at = s.first
                    if before and before in self.scalars:
                        b = self.scalars[before]
                        b.last, at = max(b.last, s.first), max(at, b.first)
                        s.last = max(s.last, at)
                    due.setdefault(at, []).append((block, f))
        return due

    def _lives(self) -> list[list[int]]:
        """Keys of the scalars of every stage, in order."""
        alive: list[list[int]] = [[] for _ in range(self.K)]
        for key in sorted(self.scalars):
            s = self.scalars[key]
            for k in range(s.first, s.last + 1):
                alive[k].append(key)
        return alive

    def start(self) -> tuple[Array, Array]:
        """Mean deviation (n,) from the start values and covariance (n, n) of states and parameters of the first stage."""
        P, d = np.zeros((self.n_fixed, self.n_fixed)), np.zeros(self.n_fixed)
        for block in self.graph.blocks:
            if isinstance(block, StatePrior):
                block.predict()
                block.whiten()
                own = slice(self.offset[block.vehicle.index], self.offset[block.vehicle.index] + block.n)
                P[own, own] = np.linalg.inv(block.Jw.T @ block.Jw)
                d[own] = -P[own, own] @ block.Jw.T @ block.e
        for p in self.parameters:
            own = slice(self.place[p.key], self.place[p.key] + len(p.value))
            P[own, own], d[own] = np.diag(p.sigma**2), p.prior - p.value
        return d, P

    def carry(self, a: int, b: int) -> None:
        """States a + 1 to b - 1 of all vehicles from state a, without measurements."""
        own, both = slice(a, b - 1), slice(a, b)
        for v in self.vehicles:
            v.bias[both] = v.bias[a]
            if v.index in self.imu:
                block = self.imu[v.index]
                scale = v.imu_scale - v.applied_scale if block.scales else None
                at = (v.bias[a], block.at_bias[own], block.gravitation_n[own], v.frame.w_ie_n, scale)
                carry_along(block.intervals.between(own.start, own.stop), States(v.R[both], v.r[both], v.v[both]), *at)
            else:
                v.v[both] = v.v[a]
                v.r[both] = v.r[a] + (v.t_s[both] - v.t_s[a])[:, None] * v.v[a]

    def transitions(self, a: int, b: int) -> tuple[Array, Array]:
        """F and Q (b - a - 1, n, n) of states and parameters between stages a to b - 1, at the current states."""
        n, m = self.n_fixed, max(b - a - 1, 0)
        F, Q = np.tile(np.eye(n), (m, 1, 1)), np.zeros((m, n, n))
        if not m:
            return F, Q
        for v in self.vehicles:
            at, w = self.offset[v.index], sum(v.dims)
            own = slice(at, at + w)
            if v.index in self.imu:
                J, kept = self._inertial(v, a, b)
            else:
                block = self.motion[v.index]
                J, kept = (block.L @ block.J0)[a : b - 1], []
            back = np.linalg.inv(J[:, :, w : 2 * w])
            F[:, own, own] = -back @ J[:, :, :w]
            for i, column in enumerate(kept):
                F[:, own, column] = -(back @ J[:, :, 2 * w + i, None])[..., 0]
            Q[:, own, own] = back @ np.swapaxes(back, 1, 2)
        return F, Q

    def chain(self) -> tuple[Array, Array, Array]:
        """F (K - 1, n, n), offset c (K - 1, states) and Q of all intervals, as their blocks hold them."""
        F, Q = np.tile(np.eye(self.n_fixed), (self.K - 1, 1, 1)), np.zeros((self.K - 1, self.n_fixed, self.n_fixed))
        c = np.zeros((self.K - 1, self.n_states))
        for v in self.vehicles if self.K > 1 else []:
            at, w = self.offset[v.index], sum(v.dims)
            own, block = slice(at, at + w), self.imu[v.index] if v.index in self.imu else self.motion[v.index]
            J, e = block.Jw.reshape(self.K - 1, w, -1), block.e.reshape(self.K - 1, w)
            back = np.linalg.inv(J[:, :, w : 2 * w])
            F[:, own, own], Q[:, own, own] = -back @ J[:, :, :w], back @ np.swapaxes(back, 1, 2)
            c[:, own] = -np.einsum("kij,kj->ki", back, e)
            for i, key in enumerate(block.keys(0)[6:]):
                first = self.place[key]
                F[:, own, first : first + 3] = -back @ J[:, :, 2 * w + 3 * i : 2 * w + 3 * i + 3]
        return F, c, Q

    def _inertial(self, v: VehicleVariables, a: int, b: int) -> tuple[Array, list[int]]:
        block = self.imu[v.index]
        own, both = slice(a, b - 1), slice(a, b)
        change = v.imu_scale - v.applied_scale if block.scales else None
        part, states = block.intervals.between(a, b - 1), States(v.R[both], v.r[both], v.v[both])
        _, J = evaluate(part, states, v.bias[both], block.at_bias[own], block.gravitation_n[own], v.frame.w_ie_n, change)
        columns = [self.place[p.key] + i for p in block.scales for i in range(3)]
        return J[:, :, block.kept] if block.scales else J, columns

    def rows(self, a: int, b: int) -> Iterator[StageRows]:
        """Rows of stages a to b - 1 at the current states."""
        parts = self.parts(a, b)
        for k in range(a, b):
            yield self.stage_rows(k, parts)

    def parts(self, a: int, b: int, evaluate: bool = True) -> list[Part]:
        """What the blocks say of stages a to b - 1, evaluated at the current states or yet to be evaluated."""
        parts = []
        for s in self.sorted:
            f0, f1 = (int(x) for x in np.searchsorted(s.stage, [a, b]))
            if f1 > f0:
                part = Part(s, f0, f1, sliced(s.block, f0, f1))
                if evaluate:
                    part.part.predict()
                    part.part.whiten()
                parts.append(part)
        return parts

    def rows_at_hand(self) -> Iterator[StageRows]:
        """Rows of all stages as the blocks hold them: evaluated and whitened by the caller."""
        parts = [Part(s, 0, len(s.stage), s.block) for s in self.sorted]
        for k in range(self.K):
            yield self.stage_rows(k, parts)

    def stage_rows(self, k: int, parts: Sequence[Part]) -> StageRows:
        """Rows of stage k among those of parts."""
        place = {key: self.n_fixed + i for i, key in enumerate(self.live[k])}
        n = self.n_fixed + len(place)
        es, Hs, shares, kinds, judged, at = [], [], [], [], [], []
        for p in parts:
            lo, hi = (int(x) for x in np.searchsorted(p.of.stage[p.f0 : p.f1], [k, k + 1]))
            for f in range(lo, hi):
                if not p.of.alive[p.f0 + f]:
                    continue
                i, j = p.part.slices(f)
                es.append(-p.part.e[i:j])
                Hs.append(self._factor(p.part, f, n, place))
                shares.append(p.left[i:j])
                kinds.append(p.part.rows.kind[i:j])
                judged.append(p.of.judged[p.row0 + i : p.row0 + j])
                at.append((p.of.number, p.row0 + i, p.row0 + j))
        for block, f in self.processes.get(k, []):
            e, H = self._process(block, f, n, place)
            es.append(e)
            Hs.append(H)
            shares.append(np.ones(1))
            kinds.append(np.full(1, -1))
            judged.append(np.zeros(1, bool))
        if not es:
            none = np.zeros(0)
            return StageRows(none, np.zeros((0, n)), none, np.zeros(0, np.int64), np.zeros(0, bool), 0.0, [])
        share, counts = np.concatenate(shares), np.concatenate(judged)
        lost = float(np.sum((1 - share)[counts]))
        return StageRows(np.concatenate(es), np.vstack(Hs), share, np.concatenate(kinds), counts, lost, at)

    def _factor(self, part: EndsBlock, f: int, n: int, place: dict[int, int]) -> Array:
        """Whitened Jacobian (rows, n) of a factor."""
        i, j = part.slices(f)
        H = np.zeros((j - i, n))
        for key, (c0, c1) in zip(part.keys(f), part.edges(), strict=True):
            if key:
                first = self.place[key] if key in self.place else place[key]
                H[:, first : first + c1 - c0] += part.Jw[i:j, c0:c1]
        scalars = part.scalars()
        if scalars is not None and scalars.first_key[f + 1] > scalars.first_key[f]:
            H[:, [place[key] for key in scalars.of(f)]] = scalars.matrix(f)
        return H

    def _process(self, block: NodeBlock, f: int, n: int, place: dict[int, int]) -> tuple[Array, Array]:
        """Whitened row (1,), (1, n) of a node against the one before it."""
        own, before = block.keys(f)
        sigma, x, H = float(block.rows.sigma[f]), self.scalars[own], np.zeros((1, n))
        H[0, place[own]] = 1 / sigma
        y = -x.values[x.index]
        if before in place:
            o, decay = self.scalars[before], float(block.decay[f])
            H[0, place[before]] = -decay / sigma
            y += decay * o.values[o.index]
        return np.array([y / sigma]), H

    def move(self, a: int, D: Array) -> Array:
        """Move the states of stages a to a + m - 1 by D (m, states).

        Returns what takes errors about the states before to errors about those now (m, states, states).
        """
        at = slice(a, a + len(D))
        T = np.tile(np.eye(D.shape[1]), (len(D), 1, 1))
        for v in self.vehicles:
            first = self.offset[v.index]
            x = D[:, first : first + sum(v.dims)]
            if v.mode == "imu":
                pose = slice(first, first + 9)
                moved, T[:, pose, pose] = self.chart.move(States(v.R[at], v.r[at], v.v[at]), x[:, :9])
                v.R[at], v.r[at], v.v[at] = moved.R, moved.r_n, moved.v_n
                v.bias[at, 3:] += x[:, 9:12]
                v.bias[at, :3] += x[:, 12:15]
            else:
                v.r[at] += x[:, :3]
                v.v[at] += x[:, 3:6]
        return T

    def move_parameters(self, d: Array) -> None:
        """Move the parameters by d (n,)."""
        for p in self.parameters:
            at = self.place[p.key]
            p.value = p.value + d[at : at + len(p.value)]

    def move_scalars(self, keys: Sequence[int], d: Array) -> None:
        """Move the scalars `keys` of a stage by d (n,)."""
        for i, key in enumerate(keys):
            s = self.scalars[key]
            s.values[s.index] += d[self.n_fixed + i]

    def stage_of(self, keys: Sequence[int]) -> int:
        """The stage of the states among keys, or the last one at which all scalars are there."""
        of_states = [self.stage[key] for key in keys if key in self.stage]
        return of_states[0] if of_states else min((self.scalars[k].last for k in keys if k in self.scalars), default=self.K - 1)

    def columns(self, k: int, keys: Sequence[int]) -> IntArray:
        """Columns (d,) of variables at stage k; -1 for scalars that are not there and states of other stages."""
        out = []
        for key in keys:
            if key in self.place:
                n = dimension(key)
                first = self.place[key] if self.stage.get(key, k) == k else -1
                out += [first + i if first >= 0 else -1 for i in range(n)]
            else:
                out.append(self.n_fixed + self.live[k].index(key) if key in self.live[k] else -1)
        return np.array(out, np.int64)
