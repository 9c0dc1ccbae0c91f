"""An assembled problem for CasADi's solvers of nonlinear programs: a check of our own solver, and a way to add constraints.

    minimise    sum_i rho_i(r_i(d))      over d = S x
    subject to  low <= d <= high,  low <= g(d) <= high

d are local deviations of all variables from the current values, and the common clocks of GNSS rows as variables of their own;
S is diagonal and makes the columns of dr/dx unit vectors at the start. r are the whitened rows of all blocks by their symbolic
models at d, not linearised, so that all derivatives are CasADi's and exact. rho is t^2 / 2 with the robust weights that the
blocks have now, or a smooth loss written out. Eliminating the clocks of such rows is what their projection does
(`models.differencing`), so the minimum is that of `assembly.optimizer` where nothing is constrained.

The Gauss-Newton Hessian J^T W J, W = rho'(t) / t, leaves out the curvature of rows; it never is indefinite. Points that belong
to a state without increments turn with a gyroscope bias that has no column there: it is held at the last solution's, and the
program solved again from there until the cost stays.

fatrop wants stages, x_{k+1} = f(x_k, u_k), and a cost that is a sum over them. An interval's row would give such an f with its
noise as control by inverting the logarithm of extended poses; here the deviation of the next state is the control,

    x_k = (states at k, constants),   u_k = (states at k + 1, clocks at k),   x_{k+1} = (I u_k, constants)

which is the same problem with a linear f: the row itself stays in the cost. What lives at no one time (ambiguities, atmosphere,
biases of sensors) is carried along. Rows between states further apart than neighbours have no place there. fatrop damps the
Hessian of a stage whose pivots it takes for zero: where unit columns leave directions of 1e-8, as the common position of two
vehicles that codes alone know beside their phases, it ends short of the optimum and says so.

Source: Waechter and Biegler (2006) for ipopt; Vanroye et al. (2023) for fatrop; Nocedal and Wright (2006), ch. 10 and 18.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import casadi as ca
import numpy as np

from factorgraph.assembly.blocks import KINDS, Block, EndsBlock, GnssBlock, RangeBlock
from factorgraph.assembly.constraints import ZeroRotationBlock
from factorgraph.assembly.inertial_block import ImuBlock
from factorgraph.assembly.keys import dimension
from factorgraph.assembly.optimizer import Graph
from factorgraph.assembly.priors import StatePrior
from factorgraph.assembly.sensors import VectorBlock
from factorgraph.errors import InputError
from factorgraph.least_squares.evaluate import LINEAR, RECIPES, evaluator
from factorgraph.least_squares.functions import Samples, linearised
from factorgraph.models.symbolic import gnss, inertial, motion, point
from factorgraph.models.symbolic.symbols import Model, Symbols
from factorgraph.types import Array, BoolArray, IntArray

Hessian = Literal["gauss-newton", "exact", "limited-memory"]
HESSIANS: dict[str, tuple[Hessian, ...]] = {  # of each solver, the default first
    "ipopt": ("gauss-newton", "exact", "limited-memory"),
    "sqpmethod": ("gauss-newton",),  # its QPs must be convex
    "fatrop": ("gauss-newton", "exact"),
}
QUIET_QP: dict[str, dict[str, Any]] = {
    "qrqp": {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False},
    "daqp": {"error_on_fail": False},
}
ROUNDS = 6
SETTLED = 1e-9  # change of the cost, relative, that is not worth another round
BIAS = slice(15, 21)  # of a body's state as `models.symbolic.point` takes it, gyroscope first
SMOOTH = ("pseudo-huber", "cauchy", "geman-mcclure")


@dataclass(frozen=True, slots=True)
class Solver:
    """Which solver, by CasADi's name, and what it may do."""

    name: str = "ipopt"
    hessian: Hessian | None = None  # None: the solver's default
    qp: str = "qrqp"  # of sqpmethod
    max_iterations: int = 100
    tolerance: float = 1e-8  # of the scaled gradient


@dataclass(frozen=True, slots=True)
class SmoothLoss:
    """A loss of normalised residuals t that is written out: 1/2 t^2 for small t, of width c.

    pseudo-huber   c^2 (sqrt(1 + t^2 / c^2) - 1);   cauchy, geman-mcclure as in `models.robust`
    """

    kernel: str
    width: float

    def __post_init__(self) -> None:
        if self.kernel not in SMOOTH:
            raise InputError(f"loss {self.kernel!r} is not smooth; written out can be: {', '.join(SMOOTH)}")
        if not self.width > 0:
            raise InputError(f"SmoothLoss.width must be positive, got {self.width}")

    def cost(self, t: ca.MX) -> ca.MX:
        """rho(t), entry by entry."""
        c2 = self.width**2
        s = t**2 / c2
        if self.kernel == "pseudo-huber":
            return c2 * s / (ca.sqrt(1 + s) + 1)
        return c2 / 2 * ca.log1p(s) if self.kernel == "cauchy" else c2 / 2 * s / (1 + s)

    def weight(self, t: ca.MX) -> ca.MX:
        """rho'(t) / t, entry by entry."""
        s = t**2 / self.width**2
        return {"pseudo-huber": 1 / ca.sqrt(1 + s), "cauchy": 1 / (1 + s), "geman-mcclure": 1 / (1 + s) ** 2}[self.kernel]


@dataclass(frozen=True, slots=True)
class Box:
    """Limits of one component of a variable's value."""

    key: int
    component: int
    low: float
    high: float


@dataclass(slots=True)
class Limits:
    """Limits of values: of components of variables, of heights, of ranges. Infinite where there is none on that side."""

    boxes: list[Box] = field(default_factory=list)
    heights: list[tuple[int, float, float]] = field(default_factory=list)  # vehicle's place in the graph, low, high
    ranges: list[tuple[RangeBlock, float, float]] = field(default_factory=list)  # predicted, bias and scale included

    def parameter(self, graph: Graph, name: str, low: float, high: float) -> None:
        """Limit every component of a parameter, as of a range bias or scale. Raises InputError for an unknown name."""
        if name not in graph.parameters.of_name:
            raise InputError(f"no parameter {name!r}; there are: {', '.join(graph.parameters.of_name) or 'none'}")
        parameter = graph.parameters.of_name[name]
        self.boxes += [Box(parameter.key, i, low, high) for i in range(len(parameter.value))]

    def bias(self, graph: Graph, vehicle: str, sensor: str, axis: int, low: float, high: float) -> None:
        """Limit an axis of the "accelerometer" [m/s^2] or "gyroscope" [rad/s] bias at all times. Raises InputError."""
        v = graph.vehicles[_vehicle(graph, vehicle)]
        if v.mode != "imu" or sensor not in ("accelerometer", "gyroscope") or axis not in (0, 1, 2):
            raise InputError(f"vehicle {vehicle} has no bias of axis {axis} of {sensor!r}")
        component = axis + 3 * (sensor == "gyroscope")
        self.boxes += [Box(v.keys(k)[2], component, low, high) for k in range(len(v.t_s))]

    def height(self, graph: Graph, vehicle: str, low: float, high: float) -> None:
        """Limit the up coordinate [m] of a vehicle's states at all times. Raises InputError for an unknown vehicle."""
        i = _vehicle(graph, vehicle)
        if graph.vehicles[i].mode == "fixed":
            raise InputError(f"vehicle {vehicle} does not move: its height cannot be limited")
        self.heights.append((i, low, high))

    def range(self, block: RangeBlock, low: float, high: float = np.inf) -> None:
        """Limit all ranges [m] of a block as the model predicts them."""
        self.ranges.append((block, low, high))


@dataclass(frozen=True, slots=True)
class Answer:
    """How a solver ended. Variables were moved where it succeeded; otherwise they are where they were."""

    success: bool
    status: str  # in the solver's words
    iterations: int
    seconds: float  # in the solver, without writing the problem down
    cost: float  # objective at the last iterate
    clocks: int  # unknowns beside the graph's variables
    refusing: str | None  # measurement furthest from the last iterate, in words, where it failed


def solve(
    graph: Graph,
    solver: Solver | None = None,
    bounds: Limits | None = None,
    losses: Mapping[str, SmoothLoss] | None = None,
) -> Answer:
    """Minimise over all variables of an assembled graph from their current values, and move them there.

    losses: by kind of measurement, written out in place of the blocks' robust weights; all other rows keep those they have.
    Meant for pieces of up to some 30 stages. Raises InputError for a solver that is unknown or not available, for limits that
    exclude each other, and for rows that the solver's structure cannot hold.
    """
    solver = Solver() if solver is None else solver
    hessian = _checked(solver)
    return _Program(graph, bounds or Limits(), losses or {}, staged=solver.name == "fatrop").run(solver, hessian)


def _vehicle(graph: Graph, name: str) -> int:
    for i, v in enumerate(graph.vehicles):
        if v.name == name:
            return i
    raise InputError(f"no vehicle {name!r}; there are: {', '.join(v.name for v in graph.vehicles)}")


def _checked(solver: Solver) -> Hessian:
    """The Hessian to use. Raises InputError for what cannot be used."""
    if solver.name not in HESSIANS:
        raise InputError(f"no solver {solver.name!r}; there are: {', '.join(HESSIANS)}")
    if not ca.has_nlpsol(solver.name):
        raise InputError(f"this build of CasADi has no solver {solver.name!r}")
    if solver.name == "sqpmethod" and (solver.qp not in QUIET_QP or not ca.has_conic(solver.qp)):
        raise InputError(f"no QP solver {solver.qp!r}; there are: {', '.join(q for q in QUIET_QP if ca.has_conic(q))}")
    known = HESSIANS[solver.name]
    if solver.hessian is not None and solver.hessian not in known:
        raise InputError(f"solver {solver.name} has no Hessian {solver.hessian!r}; there are: {', '.join(known)}")
    return solver.hessian or known[0]


# unknowns


class _Unknowns:
    """Where local columns are in the vector of unknowns; with stages, what is constant has a copy in each."""

    def __init__(self, graph: Graph, clock_stages: Sequence[int], staged: bool) -> None:
        self.staged = staged
        present = {key for block in graph.blocks for f in range(len(block.rows.factor.start)) for key in _keys(block, f) if key}
        self.stage_of = {key: k for v in graph.vehicles for k in range(len(v.t_s)) for key in v.keys(k) if key in present}
        self.stages = max(self.stage_of.values(), default=0) + 1
        self.constants = sorted(present - self.stage_of.keys())
        self.dim = {key: dimension(key) for key in (*self.stage_of, *self.constants)}
        edges = np.cumsum([0, *self.dim.values()]).tolist()
        self.first = dict(zip(self.dim, edges, strict=False))  # key -> its first column
        self.columns_of_variables = edges[-1]
        self.variable: list[int] = []  # of each unknown: which column, or clock behind those, it is
        self.place: dict[tuple[int, int], int] = {}  # (stage, key) -> first unknown; stage 0 for all where not staged
        self.clock: list[int] = [0] * len(clock_stages)
        self.nx, self.nu = [0] * self.stages, [0] * self.stages
        states: list[list[int]] = [[] for _ in range(self.stages)]
        for key, k in self.stage_of.items():
            states[k].append(key)
        self.states = states
        for k in range(self.stages if staged else 1):
            self._append(k, [*(states[k] if staged else self.stage_of), *self.constants])
            self.nx[k] = len(self.variable) - sum(self.nx) - sum(self.nu)
            if staged and k + 1 < self.stages:
                self._append(k, states[k + 1])
            for clock, of in enumerate(clock_stages):
                if of == k or not staged:
                    self.clock[clock] = len(self.variable)
                    self.variable.append(self.columns_of_variables + clock)
            self.nu[k] = len(self.variable) - sum(self.nx) - sum(self.nu)
        self.size = len(self.variable)

    def _append(self, stage: int, keys: list[int]) -> None:
        for key in keys:
            self.place[stage, key] = len(self.variable)
            self.variable += range(self.first[key], self.first[key] + self.dim[key])

    def stage(self, keys: Sequence[Sequence[int]]) -> IntArray:
        """Earliest stage (n,) among states of each row; 0 without any."""
        return np.array([min((self.stage_of[k] for k in row if k in self.stage_of), default=0) for row in keys], np.int64)

    def columns(self, stage: IntArray, keys: Sequence[Sequence[int]], dims: Sequence[int]) -> IntArray:
        """Unknowns (n, sum of dims) of variables of rows at stages (n,); `size`, where a zero is appended, for constants.

        Raises InputError where a row sees states further apart than neighbours and the solver wants stages.
        """
        found = np.full((len(keys), sum(dims)), self.size, np.int64)
        edges = np.cumsum([0, *dims])
        for row, (k, of) in enumerate(zip(stage.tolist(), keys, strict=True)):
            for key, a, b in zip(of, edges[:-1], edges[1:], strict=True):
                if key in self.dim:
                    if (k * self.staged, key) not in self.place:
                        raise InputError("fatrop's stages hold no rows between states further apart than neighbours")
                    found[row, a:b] = self.place[k * self.staged, key] + np.arange(b - a)
        return found


@dataclass(frozen=True, slots=True)
class _Step:
    """A step as `Graph.move` takes it."""

    unknowns: _Unknowns
    d: Array  # (N,)

    def step(self, keys: Sequence[int] | IntArray) -> Array:
        """Components (n, w) of variables, zeros where no row sees them; the first copy of what has several."""
        u = self.unknowns
        width = dimension(int(keys[0])) if len(keys) else 0
        places = [u.place.get((u.stage_of.get(int(key), 0) * u.staged, int(key))) for key in keys]
        found = [np.zeros(width) if at is None else self.d[at : at + width] for at in places]
        return np.array(found).reshape(len(keys), width)


def _keys(block: Block, f: int) -> list[int]:
    """Keys of all variables of a factor."""
    own = block.scalars()
    return block.keys(f) if own is None else block.keys(f) + own.of(f)


# rows


@functools.cache
def moved(model: Model, *options: Hashable) -> ca.Function:
    """A model's outputs at any local columns: inputs are the model's and `d_` before each group of columns."""
    s = Symbols()
    outputs = model(s, *options)
    found = list(outputs.values())
    for t, x in reversed(s.stages):
        found = ca.substitute(found, [t], [x])
    names = [*s.inputs, *(f"d_{name}" for name in s.columns)]
    return ca.Function(model.__name__, [*s.inputs.values(), *s.columns.values()], found, names, list(outputs), {"cse": True})


def _evaluated(function: ca.Function, samples: Samples, changing: Mapping[str, ca.MX]) -> dict[str, ca.MX]:
    """Outputs (size, n) of a model over the samples of an evaluator; `changing` takes the place of what it held."""
    inputs: dict[str, Any] = {name: ca.DM(held.T) for name, held in samples.inputs.items()}
    result: dict[str, ca.MX] = function.map(samples.n).call({**inputs, **changing})
    return result


class _Rows:
    """Rows of all blocks as expressions of the unknowns d."""

    def __init__(self, graph: Graph, unknowns: _Unknowns, clocks: Mapping[int, IntArray]) -> None:
        self.unknowns, self.clocks = unknowns, clocks
        self.d = ca.MX.sym("d", unknowns.size)
        self.held = ca.MX.sym("held", unknowns.size)  # the last solution's d
        self._d0, self._held0 = ca.vertcat(self.d, 0), ca.vertcat(self.held, 0)  # 0: of constants
        self.codegen = getattr(graph.engine, "codegen", None)

    def at(self, columns: IntArray) -> ca.MX:
        """Unknowns (w, n) of columns (n, w)."""
        return ca.reshape(self._d0[columns.ravel().tolist()], columns.shape[1], columns.shape[0])

    def of_end(self, end: Any, samples: Samples, name: str, stage: IntArray) -> dict[str, ca.MX]:
        """Columns of an end that a model calls `name`; where its bias has none also its states, the bias the last solution's."""
        u, v, k = self.unknowns, end.end.vehicle, end.query.k
        keys = [end.end.keys(i) for i in range(samples.n)]
        local = {f"d_{name}": self.at(u.columns(stage, keys, end.end.dims))}
        if end.shape.mode == "near":
            columns = u.columns(stage, [[v.keys(int(i))[2]] for i in k], [6])[:, [3, 4, 5, 0, 1, 2]]
            state = ca.MX(ca.DM(samples.inputs[f"{name}_state"].T))
            state[BIAS, :] += ca.reshape(self._held0[columns.ravel().tolist()], 6, samples.n)
            local[f"{name}_state"] = state
        return local

    def deviations(self, block: Block) -> ca.MX:
        """Predicted less measured (n,) of a block that is no linear one, in units of its rows."""
        if isinstance(block, GnssBlock):
            return self._gnss(block)
        if isinstance(block, ImuBlock):
            return self._imu(block)
        if isinstance(block, ZeroRotationBlock):
            keys = [block.keys(f) for f in range(len(block.first))]
            columns = self.unknowns.columns(self.unknowns.stage(keys), keys, block.widths())
            return self._whole(block, motion.zero_rotation, (), {"d_poses": self.at(columns)})
        if isinstance(block, StatePrior):
            keys = [block.keys(0)]
            columns = self.unknowns.columns(self.unknowns.stage(keys), keys, block.widths())
            return self._whole(block, motion.start, (), {"d_state": self.at(columns)})
        assert isinstance(block, EndsBlock)
        return self._ends(block)

    def linear(self, block: Block) -> ca.MX:
        """Whitened rows (n,) of a block whose Jacobian is constant."""
        rows, columns, entries = [], [], []
        for f in range(len(block.rows.factor.start)):
            i, j = block.slices(f)
            keys, parts = block.columns(f)
            if not keys:
                continue
            J = np.hstack(parts)
            of = self.unknowns.columns(self.unknowns.stage([keys]), [keys], [p.shape[1] for p in parts])[0]
            rows.append(np.repeat(np.arange(i, j), len(of)))
            columns.append(np.tile(of, j - i))
            entries.append(J.ravel())
        return ca.MX(ca.DM(block.e)) + self._product(rows, columns, entries, block.n)

    def _product(self, rows: list[IntArray], columns: list[IntArray], entries: list[Array], n: int) -> ca.MX:
        """Sparse matrix (n, unknowns + 1) times the unknowns."""
        if not rows:
            return ca.MX(n, 1)
        i, j, a = (np.concatenate(each) for each in (rows, columns, entries))
        used = a != 0
        A = ca.DM.triplet(i[used].tolist(), j[used].tolist(), ca.DM(a[used]), n, self.unknowns.size + 1)
        return A @ self._d0

    def _whole(self, block: Block, model: Model, options: tuple[Hashable, ...], columns: Mapping[str, ca.MX]) -> ca.MX:
        """All rows of a block from a single model."""
        samples: Samples = evaluator_of(block, self.codegen).samples
        return ca.vec(_evaluated(moved(model, *options), samples, columns)["e"])

    def _imu(self, block: ImuBlock) -> ca.MX:
        v = block.vehicle
        scales = [0 if p is None else p.key for p in (v.accel_scale, v.gyro_scale)]
        keys = [[*block.keys(f)[:6], *scales] for f in range(len(block.rows.factor.start))]
        columns = self.unknowns.columns(self.unknowns.stage(keys), keys, (6, 3, 6, 6, 3, 6, 3, 3))
        local = {"d_from": self.at(columns[:, :15]), "d_to": self.at(columns[:, 15:30])}
        if block.scales:
            local["d_scale"] = self.at(columns[:, 30:])
        e = self._whole(block, inertial.imu_interval, (bool(block.scales),), local)
        return ca.diagcat(*(ca.DM(L) for L in block.intervals.whitening)) @ e

    def _ends(self, block: EndsBlock) -> ca.MX:
        known: Any = evaluator_of(block, self.codegen)
        recipe = RECIPES[type(block)](block)
        shapes = [end.shape for end in known.ends]
        function = moved(recipe.model, *shapes, *([None] if recipe.target else []), *recipe.options)
        n, components = known.samples.n, function.numel_out("e")
        rows = np.arange(block.n)
        if isinstance(block, VectorBlock):
            rows = block.of_row * components + block.component
        row_of = np.full(n, -1, np.int64)  # a row of each sample, if it has any
        row_of[rows // components] = np.arange(block.n)
        of_ends = [[end.end.keys(i) for i in range(n)] for end in known.ends]
        more = len(known.of_parameter)
        factor = block.rows.factor.of_row
        of_parameters = [block.keys(int(factor[i]))[-more:] if more and i >= 0 else [0] * more for i in row_of]
        stage = self.unknowns.stage([[k for keys in every for k in keys] for every in zip(*of_ends, of_parameters, strict=True)])
        local: dict[str, ca.MX] = {}
        for end in known.ends:
            local |= self.of_end(end, known.samples, end.name, stage)
        for i, name in enumerate(known.of_parameter):
            group = name.removeprefix("e_")
            local[f"d_{group}"] = self.at(
                self.unknowns.columns(stage, [[k[i]] for k in of_parameters], [function.numel_in(f"d_{group}")])
            )
        return ca.vec(_evaluated(function, known.samples, local)["e"])[rows.tolist()]

    def _gnss(self, block: GnssBlock) -> ca.MX:
        """What points change of ranges by the slope half-way, h' (d / 2) d, and what is linear.

        Ranges are known to 4e-9 m only, more than solvers bear whose steps count on differences of costs; the slope half-way
        leaves out d^3 / (24 rho^2), 1e-13 m of steps of 10 m.
        """
        known: Any = evaluator_of(block, self.codegen)
        factors = len(block.rows.factor.start)
        stage = self.unknowns.stage([block.keys(f) for f in range(factors)])
        points = {}
        for name, end in known.ends.items():
            local = self.of_end(end, known.points[name], "a", stage)
            points[name] = _evaluated(moved(point.point, end.shape), known.points[name], local)
        start = ca.Function("points", [self.d, self.held], [ca.vertcat(p["r"], p["v"]) for p in points.values()])
        at_start = dict(zip(points, _tuple(start(0, 0)), strict=True))
        parts = []
        for part in known.parts:
            model = gnss.doppler if part.size == 6 else gnss.code_or_phase
            differencing = "single" if block.reference is None else "difference" if block.place_n is None else "placed"
            change, middle = {}, {}
            for name, p in points.items():
                now, before = (x[: part.size, part.at.tolist()] for x in (ca.vertcat(p["r"], p["v"]), at_start[name]))
                change[name], middle[name] = now - before, (now + before) / 2
            slope = _evaluated(linearised(model, differencing), part.samples, middle)
            parts.append(sum(ca.sum1(slope[f"h_{name}"] * change[name]).T for name in points))
        order = np.argsort(np.concatenate([part.rows for part in known.parts]))
        return ca.vertcat(*parts)[order.tolist()] + self._linear_terms(block, stage) - block.residuals()

    def _linear_terms(self, block: GnssBlock, stage: IntArray) -> ca.MX:
        """Changes of ambiguities, nodes, biases between groups and common clocks, as rows see them."""
        c, of_row = block.scalars(), block.rows.factor.of_row
        key = c.keys[c.first_key[of_row[c.row]] + c.column]
        rows, columns, entries = (
            [c.row],
            [self.unknowns.columns(stage[of_row[c.row]], key[:, None].tolist(), [1])[:, 0]],
            [c.scale],
        )
        for i, bias in enumerate(block.biases):
            mine = np.flatnonzero(block.bias_of == i)
            rows.append(mine)
            columns.append(self.unknowns.columns(stage[of_row[mine]], [[bias.key]] * len(mine), [1])[:, 0])
            entries.append(np.ones(len(mine)))
        of_clock = self.clocks[id(block)]
        rows.append(np.flatnonzero(of_clock >= 0))
        columns.append(np.array(self.unknowns.clock, np.int64)[of_clock[of_clock >= 0]])
        entries.append(np.ones(len(rows[-1])))
        return self._product(rows, columns, entries, block.n)


def evaluator_of(block: Block, codegen: bool | None) -> Any:
    """A block's evaluator with all inputs set, the block evaluated."""
    known = evaluator(block, codegen)
    known.evaluate()
    return known


def _tuple(found: Any) -> tuple[Any, ...]:
    """What a function returned, as a tuple also where it has one output."""
    return tuple(found) if isinstance(found, (tuple, list)) else (found,)


# the program


class _Program:
    """Objective and constraints of a graph."""

    def __init__(self, graph: Graph, bounds: Limits, losses: Mapping[str, SmoothLoss], staged: bool) -> None:
        graph.predict()
        self.graph, self.bounds, self.losses = graph, bounds, losses
        scales = {id(block): self._whitening(block) for block in graph.blocks}
        clocks, clock_stages = _clocks(graph, scales)
        self.unknowns = u = _Unknowns(graph, clock_stages, staged)
        rows = _Rows(graph, u, clocks)
        self.d, self.held, residuals, kinds, persistence = rows.d, rows.held, [], [], []
        for block in graph.blocks:
            if isinstance(block, LINEAR) or (isinstance(block, StatePrior) and block.vehicle.mode == "motion"):
                block.whiten()
                r, used = rows.linear(block), np.arange(block.n)
            else:
                scale = scales[id(block)]
                used = np.flatnonzero(scale)
                r = (rows.deviations(block) * scale)[used.tolist()]
            residuals.append(r)
            kinds.append(block.rows.kind[used])
            persistence.append(np.broadcast_to(block.rows.persistence, (block.n,))[used])
        self.residual = ca.vertcat(*residuals)
        self.kind, self.persistence = np.concatenate(kinds), np.concatenate(persistence)
        self.boxes = self._boxes()
        self.g, self.g_stage, self.g_limits = self._constraints(rows)

    def _whitening(self, block: Block) -> Array:
        """Factors (n,) on rows; where losses are written out those without robust weights."""
        if isinstance(block, ImuBlock):
            return np.ones(block.n)
        w = block.w.copy()
        for name in self.losses:
            mine = block.rows.kind == KINDS.index(name)
            w[mine] = block.active[mine]
        return np.asarray(np.sqrt(w) / block.rows.sigma)

    def _boxes(self) -> list[tuple[int, float, float]]:
        """Unknowns with limits of their deviations."""
        values = _values(self.graph)
        u, boxes = self.unknowns, []
        limits = [*self.bounds.boxes]
        for i, low, high in self.bounds.heights:
            v = self.graph.vehicles[i]
            if v.mode == "motion":
                limits += [Box(v.keys(k)[0], 2, low, high) for k in range(len(v.t_s))]
        for box in limits:
            if box.low > box.high:
                raise InputError(
                    f"{self.graph.name_of(box.key)} has a lower limit {box.low:g} above its upper limit {box.high:g}"
                )
            if box.key not in u.dim or box.key not in values:
                raise InputError(f"{self.graph.name_of(box.key)} cannot be limited: it is no variable of its own components")
            value = float(values[box.key][box.component])
            at = u.place[u.stage_of.get(box.key, 0) * u.staged, box.key] + box.component
            boxes.append((at, box.low - value, box.high - value))
        return boxes

    def _constraints(self, rows: _Rows) -> tuple[ca.MX, IntArray, Array]:
        """Inequalities g (m,) of unknowns, their stages (m,) and limits (m, 2)."""
        u, g, stages, limits = self.unknowns, [], [], []
        for i, low, high in self.bounds.heights:
            v = self.graph.vehicles[i]
            if v.mode == "imu":
                n = len(v.t_s)
                pose = rows.at(u.columns(np.arange(n), [[v.keys(k)[0]] for k in range(n)], [6]))[3:, :]
                g.append(ca.vec(v.r[:, 2] + ca.sum1(pose * v.R[:, 2, :].T).T))
                stages.append(np.arange(n))
                limits.append(np.tile([low, high], (n, 1)))
        for block, low, high in self.bounds.ranges:
            g.append(rows.deviations(block) + block.z_m)
            stages.append(u.stage([block.keys(f) for f in range(len(block.rows.factor.start))])[block.rows.factor.of_row])
            limits.append(np.tile([low, high], (block.n, 1)))
        stage, limit = np.concatenate([np.zeros(0, np.int64), *stages]), np.concatenate([np.zeros((0, 2)), *limits])
        if np.any(limit[:, 0] > limit[:, 1]):
            raise InputError("a lower limit of heights or ranges is above the upper one")
        return ca.vertcat(*g) if g else ca.MX(0, 1), stage, limit

    def run(self, solver: Solver, hessian: Hessian) -> Answer:
        """Solve, and move the graph's variables where that succeeds."""
        u = self.unknowns
        x, p = ca.MX.sym("x", u.size), ca.MX.sym("p", 2 * u.size)
        r, g = ca.substitute([self.residual, self.g], [self.d, self.held], [p[: u.size] * x, p[u.size :]])
        J = ca.jacobian(r, x)
        scale = self._unit_columns(ca.Function("J", [x, p], [J]))
        f, weight = self._objective(r)
        limits = self.g_limits
        stage_sizes: dict[str, Any] = {}
        if u.staged:
            g, limits, stage_sizes = self._staged(x, g)
        options = _options(solver, hessian, stage_sizes)
        cost = ca.Function("f", [x, p], [f])
        if hessian == "gauss-newton":
            H = J.T @ (ca.diag(weight) @ J)
            if u.staged:
                f = _with_hessian(x, p, f, J.T @ (weight * r), H)
            else:
                options["hess_lag"] = _hessian_of(x, p, g, H, is_upper=solver.name == "ipopt")
        nlp = ca.nlpsol("program", solver.name, {"x": x, "p": p, "f": f, "g": g}, options)
        return self._solved(nlp, cost, scale, limits)

    def _solved(self, nlp: ca.Function, cost: ca.Function, scale: Array, limits: Array) -> Answer:
        """Solve round after round."""
        low, high = np.full(len(scale), -np.inf), np.full(len(scale), np.inf)
        for at, a, b in self.boxes:
            low[at], high[at] = max(low[at], a / scale[at]), min(high[at], b / scale[at])
        x, held, iterations, start = np.clip(0.0, low, high), np.zeros(len(scale)), 0, time.perf_counter()
        for _ in range(ROUNDS):
            p = np.concatenate([scale, held])
            before = float(cost(x, p))
            found = nlp(x0=x, p=p, lbx=low, ubx=high, lbg=limits[:, 0], ubg=limits[:, 1])
            after, x = float(found["f"]), found["x"].full()[:, 0]
            held, stats = x * scale, nlp.stats()
            iterations += int(stats["iter_count"])
            if not stats["success"] or abs(before - after) < SETTLED * (after + 1):
                break
        return self._answer(held, after, stats, iterations, time.perf_counter() - start)

    def _answer(self, d: Array, cost: float, stats: dict[str, Any], iterations: int, seconds: float) -> Answer:
        before, refusing = self.graph.values(), None
        is_finite = bool(np.all(np.isfinite(d)))
        success = bool(stats["success"]) and is_finite
        if is_finite:
            self.graph.move(_Step(self.unknowns, d))
        if not success:
            refusing = self.graph.worst_row()
            self.graph.take(before)
        status = str(stats["return_status"])
        status = f"return code {status}" if status.isdigit() else status
        return Answer(success, status, iterations, seconds, cost, len(self.unknowns.clock), refusing)

    def _unit_columns(self, J: ca.Function) -> Array:
        """Scales (N,) that give the Jacobian at the start columns of length 1; copies of one variable share theirs."""
        n = self.unknowns.size
        value = J(np.zeros(n), np.append(np.ones(n), np.zeros(n)))
        i = np.repeat(np.arange(n), np.diff(value.sparsity().colind()))
        variable = np.array(self.unknowns.variable, np.int64)
        squares = np.bincount(variable[i], np.square(value.nonzeros()), minlength=int(variable.max(initial=0)) + 1)
        return np.asarray(1 / np.sqrt(np.where(squares > 0, squares, 1.0)))[variable]

    def _objective(self, r: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Sum of costs, and weights (n,) rho'(t) / t of all rows."""
        f, weight = ca.MX(0), ca.MX(np.ones(len(self.kind)))
        written: BoolArray = np.zeros(len(self.kind), bool)
        for name, loss in self.losses.items():
            mine = self.kind == KINDS.index(name)
            written |= mine
            at = np.flatnonzero(mine).tolist()
            p = self.persistence[mine]
            t = r[at] * p
            f += ca.sum1(loss.cost(t) / p**2)
            weight[at] = loss.weight(t)
        rest = r[np.flatnonzero(~written).tolist()]
        return f + 0.5 * ca.dot(rest, rest), weight

    def _staged(self, x: ca.MX, g: ca.MX) -> tuple[ca.MX, Array, dict[str, Any]]:
        """Constraints with those between stages among them, limits, and fatrop's sizes."""
        u, every, limits = self.unknowns, [], []
        constants = sum(u.dim[key] for key in u.constants)
        first = np.cumsum([0, *(a + b for a, b in zip(u.nx, u.nu, strict=True))])
        ng = []
        for k in range(u.stages):
            if k + 1 < u.stages:
                after = first[k + 1]
                states = u.nx[k + 1] - constants
                control = first[k] + u.nx[k]
                carried = first[k] + u.nx[k] - constants
                every.append(x[after : after + states] - x[control : control + states])
                every.append(x[after + states : after + u.nx[k + 1]] - x[carried : carried + constants])
                limits.append(np.zeros((u.nx[k + 1], 2)))
            mine = np.flatnonzero(self.g_stage == k)
            every.append(g[mine.tolist()])
            limits.append(self.g_limits[mine])
            ng.append(len(mine))
        sizes = {"structure_detection": "manual", "N": u.stages - 1, "nx": u.nx, "nu": u.nu, "ng": ng}
        return ca.vertcat(*every), np.concatenate(limits), sizes


def _hessian_of(x: ca.MX, p: ca.MX, g: ca.MX, H: ca.MX, is_upper: bool) -> ca.Function:
    """H as the Hessian of the Lagrangian, for the solvers that take one."""
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.shape[0])
    of_f = lam_f * (ca.triu(H) if is_upper else H)
    name = "triu_hess_gamma_x_x" if is_upper else "hess_gamma_x_x"
    return ca.Function("hess_lag", [x, p, lam_f, lam_g], [of_f], ["x", "p", "lam_f", "lam_g"], [name])


def _with_hessian(x: ca.MX, p: ca.MX, f: ca.MX, gradient: ca.MX, H: ca.MX) -> ca.MX:
    """f of x and p whose gradient and Hessian by x CasADi takes as given, for a solver that takes no Hessian itself."""
    n = x.numel()
    given = {"jac_penalty": 0, "never_inline": True, "enable_forward": False, "enable_reverse": False}
    by_gradient = ca.Function("jac_gradient", [x, p, ca.MX.sym("out", n)], [H, ca.MX(n, p.numel())])
    gradient_of = ca.Function("gradient", [x, p], [gradient], {**given, "custom_jacobian": by_gradient})
    by_f = ca.Function("jac_cost", [x, p, ca.MX.sym("out")], [gradient_of(x, p).T, ca.MX(1, p.numel())])
    result: ca.MX = ca.Function("cost", [x, p], [f], {**given, "custom_jacobian": by_f})(x, p)
    return result


def _clocks(graph: Graph, scales: Mapping[int, Array]) -> tuple[dict[int, IntArray], list[int]]:
    """Clock (n,) of each GNSS block's rows, -1 where no row of it counts, and the stage of every clock."""
    stage_of = {key: k for v in graph.vehicles for k in range(len(v.t_s)) for key in v.keys(k)}
    clocks: dict[int, IntArray] = {}
    stages: list[int] = []
    for block in graph.blocks:
        groups = block.rows.clocks
        if groups is None or not isinstance(block, GnssBlock):
            continue
        used = groups.sum(scales[id(block)] ** 2) > 0
        number = np.where(used, len(stages) + np.cumsum(used) - 1, -1)
        clocks[id(block)] = number[groups.of_row]
        factor = block.rows.factor.of_row[groups.start[used]]
        stages += [min((stage_of[key] for key in block.keys(int(f)) if key in stage_of), default=0) for f in factor]
    return clocks, stages


def _values(graph: Graph) -> dict[int, Array]:
    """Current values of all variables but poses, biases accelerometer first, by key."""
    values: dict[int, Array] = {p.key: p.value for p in graph.parameters}
    for v in graph.vehicles:
        if v.mode == "fixed":
            continue
        for k in range(len(v.t_s)):
            own = (v.r[k], v.v[k]) if v.mode == "motion" else (None, v.v[k], np.concatenate([v.bias[k, 3:], v.bias[k, :3]]))
            values |= {key: value for key, value in zip(v.keys(k), own, strict=True) if value is not None}
    for block in graph.gnss:
        values |= {int(key): block.amb_value[[arc]] for arc, key in enumerate(block.amb_key) if key}
    for nodes in graph.nodes:
        values |= {int(key): nodes.value[[i]] for i, key in enumerate(nodes.key)}
    return values


def _options(solver: Solver, hessian: Hessian, stage_sizes: dict[str, Any]) -> dict[str, Any]:
    """What CasADi is told: limits, and to print nothing."""
    options: dict[str, Any] = {"print_time": False, "error_on_fail": False}
    if solver.name == "sqpmethod":
        options |= {"print_header": False, "print_iteration": False, "print_status": False}
        options |= {"qpsol": solver.qp, "qpsol_options": QUIET_QP[solver.qp]}
        return options | {"max_iter": solver.max_iterations, "tol_du": solver.tolerance, "tol_pr": solver.tolerance}
    if solver.name == "fatrop":
        return options | stage_sizes | {"fatrop": {"print_level": 0, "max_iter": solver.max_iterations, "tol": solver.tolerance}}
    own = {"print_level": 0, "sb": "yes", "max_iter": solver.max_iterations, "tol": solver.tolerance}
    own["nlp_scaling_method"] = "none"  # unknowns are scaled
    if hessian == "limited-memory":
        own["hessian_approximation"] = hessian
    return options | {"ipopt": own}
