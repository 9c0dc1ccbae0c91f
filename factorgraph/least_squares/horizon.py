"""Moving horizon: the last seconds of a flight solved again with every new epoch, for a fixed effort.

The window's problem is that of the whole flight restricted to its states, with what the factors that left it say of the
variables that stayed, the arrival cost

    |e_0 + J_0 d|^2,    d: local deviation from where the variables were when it was formed,

which is the Schur complement of the eliminated states (`fronts.Layout.marginal`). Each step starts from the solution before, the
new state carried there by the IMU, and takes a fixed number of Gauss-Newton iterations, robust weights included. Rows are
evaluated as their blocks are: symbolic models are prepared for whole flights and do not pay for twenty states.

Bounds on biases, heights and scales hold where the solution would leave them: as rows that pull it back, taken away again
where the data pull inward (an active set, one change of it per iteration).

Ambiguities stay float in the window; those that can be fixed condition the newest state that is put out.

Source: Rao, Rawlings and Lee (2001), Constrained linear state estimation, a moving horizon approach; Sibley, Matthies and
Sukhatme (2010), Sliding window filter, for the marginalisation.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from factorgraph.assembly.atmosphere import NodeBlock
from factorgraph.assembly.blocks import Block, EndsBlock, GnssBlock
from factorgraph.assembly.conditioned import Conditioned, EpochIntegers, condition
from factorgraph.assembly.flight import WholeFlight
from factorgraph.assembly.inertial_block import ImuBlock
from factorgraph.assembly.keys import dimension
from factorgraph.assembly.nodes import Nodes
from factorgraph.assembly.optimizer import Graph, Result
from factorgraph.assembly.parameters import Parameter
from factorgraph.assembly.pieces import Staged, intervals_of, rows_of
from factorgraph.assembly.priors import MotionBlock, ParameterPrior, StatePrior
from factorgraph.assembly.result import make_solution
from factorgraph.assembly.rows import plain_rows
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import exp_so3, log_so3, right_jacobian, right_jacobian_inverse
from factorgraph.errors import InputError, positive
from factorgraph.least_squares.engine import Factored, StageEngine, Structure, part_of
from factorgraph.least_squares.fronts import Layout, Part, Undetermined
from factorgraph.models.imu_interval import carry
from factorgraph.problem import AmbiguitySettings, NavigationProblem, Robust
from factorgraph.registry import Progress
from factorgraph.solution import Solution, Status
from factorgraph.types import Array, IntArray

TIGHT = 1e-4  # of a bound's unit: how far a bound that holds may be left
LOST, LASTING = 5.0, 10  # median residual in standard deviations, steps in a row, of a window that diverged
WEAK = 1e4  # standard deviation of ambiguities and nodes when they are first seen, in their units


@dataclass(frozen=True, slots=True)
class Bounds:
    """What physics gives; infinite: not bounded."""

    gyro_bias_rps: float = np.inf  # magnitude per axis
    accel_bias_mps2: float = np.inf
    height_m: tuple[float, float] = (-np.inf, np.inf)  # up coordinate in n
    scale: float = 0.5  # magnitude of a range set's scale error: ranges stay positive


@dataclass(frozen=True, slots=True)
class HorizonSettings:
    """Length and effort of the window."""

    window_s: float = 20.0
    iterations: int = 1  # Gauss-Newton, per step
    bounds: Bounds = Bounds()

    def __post_init__(self) -> None:
        positive(self, "window_s", "iterations")


@dataclass(slots=True)
class Place:
    """Where the value of a variable is."""

    of: VehicleVariables | GnssBlock | Parameter | Nodes
    index: int = 0  # state, arc or node
    part: int = 0  # of a state's variables

    def value(self) -> tuple[Array, ...]:
        """A copy of the current value."""
        of, k = self.of, self.index
        if isinstance(of, VehicleVariables):
            if self.part == 1:
                return (of.v[k].copy(),)
            if self.part == 2:
                return (np.concatenate([of.bias[k, 3:], of.bias[k, :3]]),)
            return (of.R[k].copy(), of.r[k].copy()) if of.mode == "imu" else (of.r[k].copy(),)
        if isinstance(of, GnssBlock):
            return (of.amb_value[k : k + 1].copy(),)
        return (of.value.copy(),) if isinstance(of, Parameter) else (of.value[k : k + 1].copy(),)

    def since(self, before: tuple[Array, ...]) -> Array:
        """Local deviation of the current value from one before."""
        now = self.value()
        if len(now) == 2:
            return np.concatenate([log_so3(before[0].T @ now[0]), before[0].T @ (now[1] - before[1])])
        return now[0] - before[0]

    def move(self, d: Array) -> None:
        """Move the value of a constant by a step; states move together."""
        of, k = self.of, self.index
        if isinstance(of, GnssBlock):
            of.amb_value[k] += d[0]
        elif isinstance(of, Parameter):
            of.value = of.value + d
        elif isinstance(of, Nodes):
            of.value[k] += d[0]


@dataclass(slots=True)
class ArrivalBlock(Block):
    """What left the window says of what stayed."""

    variables: list[int]
    places: list[Place]
    e0: Array
    J0: Array
    before: list[tuple[Array, ...]] = field(init=False)

    def __post_init__(self) -> None:
        Block.__post_init__(self)
        self.before = [place.value() for place in self.places]

    def keys(self, f: int) -> list[int]:
        return self.variables

    def widths(self) -> tuple[int, ...]:
        return tuple(dimension(key) for key in self.variables)

    def predict(self) -> None:
        d = np.concatenate([place.since(before) for place, before in zip(self.places, self.before, strict=True)])
        self.y, self.J = -(self.e0 + self.J0 @ d), self.J0.copy()
        for place, before, (a, b) in zip(self.places, self.before, self.edges(), strict=True):
            if len(before) == 2:  # positions are along body axes, and these have turned since
                self.J[:, a : a + 3] = self.J0[:, a : a + 3] @ right_jacobian_inverse(d[None, a : a + 3])[0]
                self.J[:, a + 3 : b] = self.J0[:, a + 3 : b] @ before[0].T @ place.value()[0]


@dataclass(slots=True)
class BoundBlock(Block):
    """Components held at their bounds, a row each."""

    variables: list[int]
    gradient: Array  # (n, w) of the component in its variable's local columns
    off: Array  # (n,) bound less current value

    def keys(self, f: int) -> list[int]:
        return [self.variables[f]]

    def widths(self) -> tuple[int, ...]:
        return (self.gradient.shape[1],)

    def predict(self) -> None:
        self.y, self.J = self.off, self.gradient


@dataclass(slots=True)
class WeakPrior(Block):
    """Of ambiguities and nodes, where they were when first seen."""

    variables: list[int]
    places: list[Place]
    start: Array  # (n,)

    def keys(self, f: int) -> list[int]:
        return [self.variables[f]]

    def widths(self) -> tuple[int, ...]:
        return (1,)

    def predict(self) -> None:
        self.y = self.start - np.array([place.value()[0][0] for place in self.places])
        self.J = np.ones((self.n, 1))


@dataclass(frozen=True, slots=True)
class Newest:
    """The state put out at a step: what the moving vehicles do, conditioned on the integers that could be fixed."""

    values: list[tuple[Array, Array, Array, Array]]  # r, v, R, bias of each
    keys: list[int]  # of their variables and the parameters
    found: Conditioned  # joint covariance, and how the integers were fixed
    misfit: float  # median of a source's normalised residuals in the window, absolute; the largest of all sources
    spent_s: float


@dataclass(frozen=True, slots=True)
class Lives:
    """First and last stage (n,) at which scalars are seen; nodes live until the next of their series has come."""

    first: dict[int, int]
    last: dict[int, int]

    @classmethod
    def of(cls, staged: Sequence[Staged], processes: Sequence[NodeBlock]) -> Lives:
        first: dict[int, int] = {}
        last: dict[int, int] = {}
        for s in staged:
            scalars = s.block.scalars()
            node_keys = {int(key) for nodes in s.block.nodes for key in nodes.key}
            for f in range(len(s.last)):
                seen = scalars.of(f) if scalars is not None else [key for key in s.block.keys(f) if key in node_keys]
                for key in seen:
                    first[key] = min(first.get(key, int(s.first[f])), int(s.first[f]))
                    last[key] = max(last.get(key, 0), int(s.last[f]))
        for block in processes:
            for f in range(block.n):
                own, before = block.keys(f)
                if before in last and own in first:
                    last[before] = max(last[before], first[own])
        return cls(first, last)


class MovingHorizon:
    """A sliding window over the stages of an assembled flight: one `step` per state time."""

    def __init__(
        self, graph: Graph, settings: HorizonSettings, robust: Mapping[str, Robust], ambiguity: AmbiguitySettings
    ) -> None:
        self.graph, self.settings, self.robust, self.ambiguity = graph, settings, robust, ambiguity
        self.vehicles = [v for v in graph.vehicles if v.mode != "fixed"]
        for v in self.vehicles:
            v.r, v.v, v.R, v.bias = (x.copy() for x in (v.r, v.v, v.R, v.bias))
        self.t_s = graph.vehicles[0].t_s
        self.staged = [Staged.of(b) for b in graph.blocks if isinstance(b, EndsBlock)]
        self.intervals = [b for b in graph.blocks if isinstance(b, ImuBlock | MotionBlock)]
        self.processes = [b for b in graph.blocks if isinstance(b, NodeBlock)]
        self.kept: list[Block] = [b for b in graph.blocks if isinstance(b, ParameterPrior)]  # never leave
        self.arrival: list[Block] = [b for b in graph.blocks if isinstance(b, StatePrior)]
        self.first, self.last = 0, -1
        self.lives = Lives.of(self.staged, self.processes)
        self.places = self._places()
        self.layouts: dict[Hashable, Layout] = {}
        self.start: dict[int, float] = {}  # scalars in the window: where they began
        self.scales = [p for p in graph.parameters if p.name.endswith(" scale") and len(p.value) == 1]  # of range sets

    def _places(self) -> dict[int, Place]:
        places: dict[int, Place] = {}
        for v in self.vehicles:
            for k in range(len(self.t_s)):
                places |= {key: Place(v, k, part) for part, key in enumerate(v.keys(k))}
        places |= {p.key: Place(p) for p in self.graph.parameters}
        for gnss in self.graph.gnss:
            places |= {int(key): Place(gnss, i) for i, key in enumerate(gnss.amb_key) if key}
        for nodes in self.graph.nodes:
            places |= {int(key): Place(nodes, i) for i, key in enumerate(nodes.key)}
        return places

    def step(self) -> Newest:
        """Take in the next state time. Raises InputError at the end of the flight or where a window is singular."""
        began = time.perf_counter()
        if self.last + 1 == len(self.t_s):
            raise InputError(f"the flight ends at {self.t_s[-1]:.2f} s")
        self._carry()
        a, b = self.first, self.last
        blocks = self._rows(a, b)
        states = [[v.keys(k) for v in self.vehicles] for k in range(a, b + 1)]
        constants = [p.key for p in self.graph.parameters]
        ends = {key: min(self.lives.last[key], b) - a for key in self.start}
        structure = Structure.along(blocks, states, constants, ends, self.layouts)
        leaving = self._leaving()
        arrival: Block | None = None
        for iteration in range(self.settings.iterations):
            for block in blocks:
                block.predict()
                block.reweight(self.robust, afresh=iteration == 0)
                block.whiten()
            bounds = self._bounds(a, b)
            for bound in bounds:
                bound.predict()
                bound.whiten()
            every = [*blocks, *bounds]
            if bounds or len(structure.used) != len(every):
                structure = Structure.along(every, states, constants, ends)
            parts = [part_of(block, used) for block, used in zip(every, structure.used, strict=True)]
            found = structure.layout.factorise(parts)
            if isinstance(found, Undetermined):
                if not np.isfinite(found.pivot):
                    raise InputError(f"at {self.t_s[b]:.2f} s rows of the window are not finite")
                raise InputError(f"at {self.t_s[b]:.2f} s nothing in the window determines {self.graph.name_of(found.key)}")
            factored = Factored(found)
            if leaving and iteration + 1 == self.settings.iterations:
                arrival = self._arrival(structure, parts, leaving)
            self._move(factored, structure)
        newest = self._newest(factored, constants, _misfit(blocks), began)
        if arrival is not None:
            self.arrival, self.first = [arrival], a + leaving
            self.start = {key: value for key, value in self.start.items() if self.lives.last[key] >= self.first}
        return newest

    def _leaving(self) -> int:
        """States that are too old for the next window."""
        if self.last + 1 == len(self.t_s):
            return 0
        oldest = self.t_s[self.last + 1] - self.settings.window_s
        return min(int(np.searchsorted(self.t_s[self.first : self.last], oldest)), self.last - self.first)

    def _carry(self) -> None:
        """The next state of every vehicle from the one before, by its IMU."""
        k = self.last
        self.last += 1
        for block in self.intervals if k >= 0 else []:
            v, own = block.vehicle, slice(k, k + 1)
            if isinstance(block, MotionBlock):
                v.r[k + 1], v.v[k + 1] = v.r[k] + v.v[k] * (v.t_s[k + 1] - v.t_s[k]), v.v[k]
                continue
            v.bias[k + 1] = v.bias[k]
            piece = intervals_of(block, k, k + 1)
            scale = v.imu_scale - v.applied_scale if block.scales else None
            at = (piece.at_bias, piece.gravitation_n, v.frame.w_ie_n, scale)
            R, r, vel = carry(piece.intervals, v.R[own], v.r[own], v.v[own], v.bias[own], *at)
            v.R[k + 1], v.r[k + 1], v.v[k + 1] = R[0], r[0], vel[0]

    def _rows(self, a: int, b: int) -> list[Block]:
        """The blocks of the window."""
        blocks: list[Block] = [piece for s in self.staged if (piece := s.between(a, b)) is not None]
        for block in self.intervals if b > a else []:
            blocks.append(intervals_of(block, a, b))
        for key, first in self.lives.first.items():
            if first == b:
                self.start[key] = float(self.places[key].value()[0][0])
        blocks += [rows for block in self.processes if (rows := self._process(block)) is not None]
        weak = list(self.start)
        if weak:
            n = len(weak)
            table = plain_rows(-1, np.zeros(n), np.full(n, WEAK), np.arange(n), "scalars", ["start"], np.zeros(n, np.int64))
            blocks.append(WeakPrior(table, weak, [self.places[key] for key in weak], np.array([self.start[key] for key in weak])))
        return [*blocks, *self.kept, *self.arrival]

    def _process(self, block: NodeBlock) -> NodeBlock | None:
        """The rows of a process whose nodes are all in the window."""
        rows = []
        for f in range(block.n):
            own, before = block.keys(f)
            if own in self.start and (not before or before in self.start):
                rows.append(f)
        return rows_of(block, np.array(rows, np.int64)) if rows else None

    def _arrival(self, structure: Structure, parts: list[Part], leaving: int) -> ArrivalBlock:
        """What the first states of the window say of the rest, about the current values."""
        marginal = structure.layout.marginal(parts, leaving)
        if isinstance(marginal, Undetermined):
            raise InputError(f"nothing in the window determines {self.graph.name_of(marginal.key)}")
        e, J = marginal.rows()
        keys = marginal.keys.tolist()
        n = len(e)
        zeros = np.zeros(n, np.int64)
        rows = plain_rows(-1, np.full(n, self.t_s[self.first + leaving]), np.ones(n), zeros, "arrival", ["arrival"], zeros)
        return ArrivalBlock(rows, keys, [self.places[key] for key in keys], e, J)

    def _move(self, factored: Factored, structure: Structure) -> None:
        for v in self.vehicles:
            v.retract(factored.step, slice(self.first, self.last + 1))
        layout, d = structure.layout, factored.all()
        for key in [*self.start, *(p.key for p in self.graph.parameters)]:
            at = int(layout.index([key])[0])
            self.places[key].move(d[layout.offset[at] : layout.offset[at + 1]])

    def _bounds(self, a: int, b: int) -> list[BoundBlock]:
        """Rows of the bounds that the current values leave: what held before and was not pulled inside is still outside."""
        limits = self.settings.bounds
        if not self.scales and not np.isfinite([limits.gyro_bias_rps, limits.accel_bias_mps2, *limits.height_m]).any():
            return []
        rows: dict[int, list[tuple[int, Array, float]]] = {}

        def check(key: int, value: float, low: float, high: float, row: Array) -> None:
            if not low <= value <= high:
                rows.setdefault(len(row), []).append((key, row, min(max(value, low), high) - value))

        biases = np.repeat([limits.accel_bias_mps2, limits.gyro_bias_rps], 3)
        for v in self.vehicles:
            for k in range(a, b + 1):
                row = np.concatenate([np.zeros(3), v.R[k][2]]) if v.mode == "imu" else np.eye(3)[2]
                check(v.keys(k)[0], float(v.r[k, 2]), *limits.height_m, row)
                if v.mode == "imu":
                    for i, value in enumerate([*v.bias[k, 3:].tolist(), *v.bias[k, :3].tolist()]):
                        check(v.keys(k)[2], value, -biases[i], biases[i], np.eye(6)[i])
        for p in self.scales:
            check(p.key, float(p.value[0]), -limits.scale, limits.scale, np.ones(1))
        blocks = []
        for each in rows.values():
            n = len(each)
            table = plain_rows(-1, np.zeros(n), np.full(n, TIGHT), np.arange(n), "bounds", ["bound"], np.zeros(n, np.int64))
            keys, columns, off = zip(*each, strict=True)
            blocks.append(BoundBlock(table, list(keys), np.array(columns), np.array(off)))
        return blocks

    def _inside(self, value: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        """A state that conditioning moved out of its bounds, brought back to them."""
        r, v, R, bias = value
        limits = self.settings.bounds
        size = np.repeat([limits.gyro_bias_rps, limits.accel_bias_mps2], 3)
        return np.append(r[:2], np.clip(r[2], *limits.height_m)), v, R, np.clip(bias, -size, size)

    def _transport(self, factored: Factored) -> Array:
        """Errors of the newest states and the parameters about where they are now, from errors about where rows were evaluated.

        Positions are along body axes, which turned with the step: what is known of two vehicles' difference, far better than
        where they are, must turn with them.
        """
        parts = []
        for v in self.vehicles:
            T = np.eye(sum(v.dims))
            if v.mode == "imu":
                turn = factored.step(v.key_table[self.last, :1])[:, :3]
                T[:3, :3], T[3:6, 3:6] = right_jacobian(turn)[0], exp_so3(-turn)[0]
            parts.append(T)
        parts += [np.eye(len(p.value)) for p in self.graph.parameters]
        return np.asarray(block_diag(*parts))

    def _newest(self, factored: Factored, constants: list[int], misfit: float, began: float) -> Newest:
        """What is known of the newest state, conditioned on the ambiguities that can be fixed."""
        b = self.last
        keys = [key for v in self.vehicles for key in v.keys(b)] + constants
        links = [(key, self.places[key]) for key in self.start if isinstance(self.places[key].of, GnssBlock)]
        whole = [key for key, place in links if place.of.rows.label[_row_of(place)][0] != "R"]  # type: ignore[union-attr]
        P = factored.covariance([*keys, *whole])
        n, T = len(P) - len(whole), self._transport(factored)
        P[:n] = T @ P[:n]
        P[:, :n] = P[:, :n] @ T.T
        values = [(v.r[b].copy(), v.v[b].copy(), v.R[b].copy(), v.bias[b].copy()) for v in self.vehicles]
        found = condition(P, np.array([self.places[key].value()[0][0] for key in whole]), self.ambiguity)
        at = 0
        for i, v in enumerate(self.vehicles if found.fixed else []):
            values[i] = self._inside(_moved(v, values[i], found.dx[at : at + sum(v.dims)]))
            at += sum(v.dims)
        return Newest(values, keys, found, misfit, time.perf_counter() - began)


def _misfit(blocks: Sequence[Block]) -> float:
    t = [np.abs(b.normalised()[b.active & (b.rows.kind >= 0)]) for b in blocks]
    return max((float(np.median(part)) for part in t if len(part)), default=0.0)


def _lost(newest: Sequence[Newest]) -> IntArray:
    """Steps with which LASTING begin whose residuals are far larger than declared, or not finite."""
    far = np.array([not each.misfit < LOST for each in newest])
    return (
        np.flatnonzero(np.convolve(far, np.ones(LASTING), "valid") == LASTING) if len(far) >= LASTING else np.zeros(0, np.int64)
    )


def _row_of(place: Place) -> int:
    """The label index of an ambiguity's satellite."""
    block = place.of
    assert isinstance(block, GnssBlock)
    return int(block.rows.label_index[np.argmax(block.arc == place.index)])


def _moved(v: VehicleVariables, value: tuple[Array, Array, Array, Array], d: Array) -> tuple[Array, Array, Array, Array]:
    """A vehicle's state moved by a local step."""
    r, vel, R, bias = value
    if v.mode != "imu":
        return r + d[:3], vel + d[3:], R, bias
    return r + R @ d[3:6], vel + d[6:9], R @ exp_so3(d[:3]), bias + np.concatenate([d[12:15], d[9:12]])


@dataclass(slots=True)
class Outputs:
    """A run of the window as an engine that has nothing left to solve, for the solution to be made from."""

    newest: list[Newest]
    packages: tuple[str, ...] = ()

    def predict(self, block: Block) -> None:
        """Set the block's y and J at the current variables."""
        block.predict()

    def linearise(self, graph: Graph, joints: bool) -> Outputs:
        """What was put out is final."""
        return self

    def eliminate(self, lam: float) -> Outputs:
        """Nothing is left to eliminate."""
        return self

    def step(self, keys: Sequence[int] | IntArray) -> Array:
        """No step is left to take."""
        return np.zeros((len(keys), dimension(keys[0]) if len(keys) else 0))

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of variables of one time."""
        return self.joint(keys)

    def covariances(self) -> Outputs:
        """Those of all states when they were the newest."""
        return self

    def remarks(self, graph: Graph) -> list[str]:
        """Steps that fail say so at once."""
        return []

    def joints(self, groups: Sequence[Sequence[int]]) -> Array:
        """Joint covariances (g, d, d) of groups of keys."""
        return np.array([self.joint(keys) for keys in groups])

    def joint(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of keys of one state time, NaN for others; parameters as they were last."""
        own = next((each for each in reversed(self.newest) if set(keys) <= set(each.keys)), None)
        d = sum(dimension(key) for key in keys)
        if own is None:
            return np.full((d, d), np.nan)
        edges = np.cumsum([0, *(dimension(key) for key in own.keys)])
        columns = np.concatenate([np.arange(edges[i], edges[i + 1]) for i in (own.keys.index(key) for key in keys)])
        return np.asarray(own.found.P[np.ix_(columns, columns)])


class Horizon:
    """The moving horizon run along a logged flight: every state as it was known when it was the newest."""

    summary = "moving-horizon least squares: a 20 s window with arrival cost, one step per epoch"

    def __init__(self, settings: HorizonSettings | None = None) -> None:
        self.settings = settings or HorizonSettings()

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. The first state's start values look at the whole flight; everything after is causal.

        Raises InputError for what cannot be estimated and where a window is singular.
        """
        built, notes, spent = WholeFlight("moving-horizon", StageEngine).started(problem, progress)
        graph, settings = built.graph, problem.settings
        window = MovingHorizon(graph, self.settings, settings.robust, settings.ambiguity)
        newest = []
        for k in range(len(window.t_s)):
            newest.append(window.step())
            if k % 50 == 0:
                progress("moving horizon", 0.3 + 0.6 * k / len(window.t_s))
        for i, v in enumerate(window.vehicles):
            v.r, v.v, v.R, v.bias = (np.array([each.values[i][j] for each in newest]) for j in range(4))
        graph.assemble()
        graph.engine = Outputs(newest)
        graph.predict()
        graph.reweight(settings.robust)
        steps = np.array([each.spent_s for each in newest])
        spent["moving horizon"] = float(steps.sum())
        notes.append(
            f"steps of the window: median {1e3 * np.median(steps):.1f} ms, 99 % within {1e3 * np.quantile(steps, 0.99):.1f} ms"
        )
        integers = EpochIntegers.of([each.found for each in newest])
        lost_s = window.t_s[_lost(newest)]
        if len(lost_s):
            notes.append(f"the window left its measurements behind at {lost_s[0]:.2f} s")
        result = Result(Status.DIVERGED if len(lost_s) else Status.CONVERGED, [0.0])
        return make_solution(problem, "moving-horizon", built, result, np.nan, spent, notes, integers)
