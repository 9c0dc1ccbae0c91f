"""Measurement blocks: whole-flight vectorised residuals and Jacobians, in factors of one epoch or interval each.

A block holds all rows of one source (a link's differences, a receiver's code, a set of ranges). Each iteration it
evaluates every row at once; a factor is a slice of them and the variables that they see. Row i of factor f reads

    e_i = sqrt(w_i) / sigma_i (h_i(x) - z_i),  common clocks projected out (models.differencing)

with robust weights w_i per row, never per factor.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from factorgraph.assembly._point_kernels import one_way
from factorgraph.assembly.engine import Covariances
from factorgraph.assembly.nodes import Nodes
from factorgraph.assembly.parameters import Parameter
from factorgraph.assembly.variables import Point, Query, VehicleVariables
from factorgraph.attitude import skew
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.robust import Loss
from factorgraph.models.robust import cost as robust_cost
from factorgraph.models.robust import weight as robust_weight
from factorgraph.types import Array, BoolArray, IntArray

KINDS = (
    *("code", "phase", "doppler", "range", "position", "height"),
    *("velocity", "attitude", "magnetic", "bearing", "constraint"),
)
CODE, PHASE, DOPPLER, RANGE, POSITION, HEIGHT, VELOCITY, ATTITUDE, MAGNETIC, BEARING, CONSTRAINT = range(len(KINDS))


@dataclass(slots=True)
class Rows:
    """What is constant over the iterations: one entry per scalar row, sorted by factor, then clock group."""

    kind: IntArray  # (n,) index into KINDS
    t_s: Array
    sigma: Array
    factor: CommonGroups  # rows -> factors
    clocks: CommonGroups | None  # rows -> common clocks, None where rows are independent
    source: str
    label: list[str]
    label_index: IntArray
    group: list[str]  # names of signal groups
    group_index: IntArray
    azimuth_rad: Array
    elevation_rad: Array
    persistence: Array | float = 1.0  # times the standard deviation of a single row that sigma is, for errors that last
    cn0_dbhz: Array | None = None  # (n,) the weaker of the two where differenced

    @property
    def single_sigma(self) -> Array:
        """Standard deviations (n,) of the rows by themselves: what residuals are judged by."""
        return self.sigma / self.persistence


@dataclass(slots=True)
class Whitened:
    """What factors hand out. An engine's factors may hold this and not their block, which holds them."""

    e: Array = field(default_factory=lambda: np.zeros(0))  # (n,) whitened predicted - measured
    Jw: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (n, w)


@dataclass(slots=True)
class Block(ABC):
    """Base of all blocks; subclasses say how rows are predicted."""

    rows: Rows
    y: Array = field(init=False)  # (n,) measured - predicted
    J: Array = field(init=False)  # (n, w) d predicted / d local columns
    w: Array = field(init=False)  # (n,) robust weights
    white: Whitened = field(default_factory=Whitened, init=False)
    u: Array = field(init=False)  # (n,) sqrt(w) / sigma
    active: BoolArray = field(init=False)  # (n,) rows in use
    structure: int = field(default=0, init=False)  # counts changes of the factors' keys
    nodes: list[Nodes] = field(default_factory=list, init=False)  # what changes slowly and these rows see

    def __post_init__(self) -> None:
        self.w = np.ones(len(self.rows.sigma))
        self.active = np.ones(len(self.rows.sigma), bool)

    @property
    def n(self) -> int:
        return len(self.rows.sigma)

    @property
    def e(self) -> Array:
        """(n,) whitened predicted - measured."""
        return self.white.e

    @property
    def Jw(self) -> Array:
        """(n, w) whitened Jacobian."""
        return self.white.Jw

    @abstractmethod
    def keys(self, f: int) -> list[int]:
        """Keys of factor f, in the order of the columns; 0 where there is a constant in place of the variable."""

    def key_table(self) -> IntArray:
        """Those of all factors (factors, k)."""
        n = len(self.rows.factor.start)
        return np.array([self.keys(f) for f in range(n)], np.int64).reshape(n, len(self.widths()))

    @abstractmethod
    def widths(self) -> tuple[int, ...]:
        """Column counts of those keys."""

    @abstractmethod
    def predict(self) -> None:
        """Set y and J at the current variables."""

    @property
    def is_stale(self) -> bool:
        """Whether the arcs that it was made for are no more."""
        return False

    @property
    def version(self) -> tuple[int, ...]:
        """Changes when the factors' keys do."""
        return (self.structure,)

    def refresh(self) -> None:  # noqa: B027 - most blocks have nothing to renew
        """Renew what depends on the preintegration bias."""

    def normalised(self) -> Array:
        """Residuals (n,) over the standard deviation of a single row, the group's common clock taken out."""
        s = self.rows.single_sigma
        clocks = self.rows.clocks
        if clocks is None:
            return self.y / s
        u = self._clock_u(clocks)
        res = self.y - clocks.mean(self.y, u)[clocks.of_row]
        h = clocks.leverage(u)
        return res / (s * np.sqrt(np.maximum(1 - h, 0.05)))

    def residuals(self) -> Array:
        """Residuals (n,) with the common clocks taken out."""
        clocks = self.rows.clocks
        if clocks is None:
            return self.y
        return self.y - clocks.mean(self.y, self._clock_u(clocks))[clocks.of_row]

    def _clock_u(self, clocks: CommonGroups) -> Array:
        """sqrt(w) / sigma (n,); as without robust weights in groups that have lost all of theirs, which would never return."""
        u = np.sqrt(self.w) / self.rows.sigma
        lost = clocks.sum(u * u) == 0
        return np.where(lost[clocks.of_row] & self.active, 1 / self.rows.sigma, u) if np.any(lost) else u

    def reweight(self, losses: Mapping[str, Loss], afresh: bool = False) -> None:
        """Robust weights of the current residuals.

        The common clocks are those of the weights before, or, `afresh`, the medians of their groups: least squares' own
        would be drawn off by gross errors, and a loss that redescends would then reject all rows alike.
        """
        self.w = np.where(self.active, self.w, 0.0)
        clocks = self.rows.clocks
        if afresh and clocks is not None:
            centre = clocks.median(self.y, self.active)
            self._weigh((self.y - centre[clocks.of_row]) / self.rows.single_sigma, losses)
        self._weigh(self.normalised(), losses)

    def _weigh(self, t: Array, losses: Mapping[str, Loss]) -> None:
        for index, name in enumerate(KINDS):
            mine = self.active & (self.rows.kind == index)
            if name in losses and np.any(mine):
                self.w[mine] = robust_weight(losses[name], t[mine])

    def cost(self, losses: Mapping[str, Loss]) -> float:
        """Robust cost at the current residuals; the clock means use the current weights. Priors (kind -1) are quadratic."""
        rows = self.rows
        r = self.residuals() / rows.single_sigma
        scale = np.broadcast_to(np.asarray(1 / np.square(rows.persistence)), r.shape)
        total = 0.5 * float(np.sum(scale[rows.kind < 0] * r[rows.kind < 0] ** 2))
        for index, name in enumerate(KINDS):
            mine = self.active & (rows.kind == index)
            if np.any(mine):
                total += float(np.sum(scale[mine] * robust_cost(losses.get(name), r[mine])))
        return total

    def whiten(self) -> None:
        self.u = np.sqrt(self.w) / self.rows.sigma
        if self.rows.clocks is None:
            self.white.e, self.white.Jw = -self.u * self.y, self.u[:, None] * self.J
        else:
            clocks = self.rows.clocks
            self.white.e, self.white.Jw = -clocks.project(self.y, self.u), clocks.project(self.J, self.u)

    def slices(self, f: int) -> tuple[int, int]:
        start = self.rows.factor.start
        return int(start[f]), int(start[f + 1]) if f + 1 < len(start) else self.n

    def columns(self, f: int) -> tuple[list[int], list[Array]]:
        """Keys of the variables of factor f and its whitened Jacobians by them."""
        i, j = self.slices(f)
        used = [(k, self.Jw[i:j, a:b]) for k, (a, b) in zip(self.keys(f), self.edges(), strict=True) if k]
        own = [k for k, _ in used], [J for _, J in used]
        scalars = self.scalars()
        if scalars is None:
            return own
        matrix = scalars.matrix(f)
        return own[0] + scalars.of(f), own[1] + [matrix[:, k : k + 1] for k in range(matrix.shape[1])]

    def scalars(self) -> ScalarColumns | None:
        """Columns of scalar variables, of which each factor has its own number, behind those of `keys`."""
        return None

    def explained(self, cov: Covariances) -> Array:
        """diag(J P J^T) (n,) of the whitened rows: what of their variance the solution follows. Call `whiten` before."""
        scalars, table = self.scalars(), self.key_table()
        if table.size and np.all(table) and (scalars is None or not len(scalars.keys)):
            return _quadratic(self.Jw, cov.joints(table.tolist()), self.rows.factor.of_row)  # type: ignore[no-any-return]
        used = [self.columns(f) for f in range(len(self.rows.factor.start))]
        alike = len({len(keys) for keys, _ in used}) == 1 and bool(used[0][0])
        P = (
            cov.joints([keys for keys, _ in used])
            if alike
            else [cov.joint(keys) if keys else np.zeros((0, 0)) for keys, _ in used]
        )
        rows = [np.einsum("ij,jk,ik->i", J, P_f, J) for P_f, J in zip(P, (np.hstack(parts) for _, parts in used), strict=True)]
        return np.concatenate(rows)

    def edges(self) -> list[tuple[int, int]]:
        """Column ranges of the keys."""
        ends = np.cumsum((0, *self.widths())).tolist()
        return list(itertools.pairwise(ends))


@dataclass(slots=True)
class Offset:
    """A time offset to be estimated: observed at the query's time + sign * value, `applied_s` of it in the query already."""

    parameter: Parameter
    sign: float
    applied_s: float = 0.0


@dataclass(slots=True)
class Endpoint:
    """One end of an observation: a vehicle's point, with its columns.

    The columns of the vehicle's state are followed by those of the lever arm (3) and of each time offset (1), where they are
    estimated. With the IMU's own offset a point belongs to the IMU's clock, which is ahead by what is not yet applied to it.
    """

    vehicle: VehicleVariables
    query: Query
    lever: Parameter | None = None  # correction of the lever arm, body frame
    offsets: list[Offset] = field(default_factory=list)

    @property
    def width(self) -> int:
        return sum(self.dims)

    @property
    def state_dims(self) -> tuple[int, ...]:
        dims = self.vehicle.dims
        return dims[:2] if self.vehicle.mode == "imu" and self.query.increments is None else dims

    @property
    def dims(self) -> tuple[int, ...]:
        return (*self.state_dims, *(len(p.value) for p in self.parameters))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        imu = self.vehicle.imu_offset
        return (
            *((self.lever,) if self.lever is not None else ()),
            *(offset.parameter for offset in self.offsets),
            *((imu,) if imu is not None else ()),
        )

    def keys(self, row: int) -> tuple[int, ...]:
        return (*self.vehicle.keys(int(self.query.k[row]))[: len(self.state_dims)], *(p.key for p in self.parameters))

    def key_table(self, entries: IntArray) -> IntArray:
        """Keys (n, k) of query entries."""
        states = self.vehicle.key_table[self.query.k[entries], : len(self.state_dims)]
        parameters = np.array([p.key for p in self.parameters], np.int64)
        return np.hstack([states, np.tile(parameters, (len(entries), 1))])

    def identities(self) -> list[tuple[str, int]]:
        """What tells the columns' variables of one row apart from those of another end."""
        states = [("state", 10 * self.vehicle.index + i) for i in range(len(self.state_dims))]
        return [*states, *(("parameter", p.key) for p in self.parameters)]

    def ahead(self) -> list[tuple[float, float]]:
        """Sign and part not yet applied [s] of each time offset, in the order of their columns."""
        ahead_s = [(o.sign, o.sign * float(o.parameter.value[0]) - o.applied_s) for o in self.offsets]
        if self.vehicle.imu_offset is not None:
            ahead_s.append((1.0, float(self.vehicle.imu_offset.value[0]) - self.vehicle.imu_applied_s))
        return ahead_s

    def points(self, velocity: bool = True) -> Point:
        """The observed points with the columns of states and parameters."""
        q, v = self.query, self.vehicle
        if not self.parameters:
            return v.points(q, velocity)
        if self.lever is not None:
            q = replace(q, lever_b=q.lever_b + self.lever.value)
        ahead_s = self.ahead()
        p = v.points(q, velocity or bool(ahead_s))
        r, vel, J_r, J_v = p.r_n, p.v_n, [p.J_r], [p.J_v]
        if self.lever is not None:
            rate = v.body_rate(v.t_s[q.k] + q.dt_s, q.k)
            J_r.append(p.R)
            J_v.append(p.R @ skew(rate))
        if ahead_s:
            a = v.acceleration(q, p)
            late = sum(dt for _, dt in ahead_s)
            r, vel = r + vel * late + 0.5 * a * late**2, vel + a * late
            J_r = [J + late * rate for J, rate in zip(J_r, J_v, strict=True)]
            for sign, _ in ahead_s:
                J_r.append(sign * vel[:, :, None])
                J_v.append(sign * a[:, :, None])
        return Point(r, vel, np.concatenate(J_r, axis=2), np.concatenate(J_v, axis=2), p.R)

    def refresh(self) -> bool:
        """Renew the increments, at the current time offsets; tells whether points now belong to other states."""
        step = 0.0
        for o in self.offsets:
            now = o.sign * float(o.parameter.value[0])
            step, o.applied_s = step + now - o.applied_s, now
        if step == 0.0:
            self.query = self.vehicle.refresh(self.query)
            return False
        before, had = self.query.k, self.query.increments is None
        self.query = self.vehicle.query(self.vehicle.t_s[before] + self.query.dt_s + step, self.query.lever_b)
        return had != (self.query.increments is None) or bool(np.any(self.query.k != before))


def share_states(a: Endpoint, b: Endpoint) -> None:
    """Let two points of one vehicle follow from the same states, so that their columns are the same."""
    if a.vehicle is not b.vehicle or a.vehicle.mode != "imu":
        return
    states = np.minimum(a.query.k, b.query.k)
    for end in (a, b):
        q = end.query
        if np.any(q.k != states):
            end.query = end.vehicle.query(end.vehicle.t_s[q.k] + q.dt_s, q.lever_b, states)


def interval_of(ends: Sequence[Endpoint]) -> IntArray:
    """A number (m,) for the states that the measurements of some ends belong to."""
    interval = np.zeros(len(ends[0].query.k), np.int64)
    for end in ends:
        interval = interval * len(end.vehicle.t_s) + end.query.k
    return interval


class Columns:
    """Columns of a block with several ends: those of one end after those of another, what they share only once."""

    def __init__(self, ends: Sequence[Endpoint], more: Sequence[Parameter] = ()) -> None:
        self.ends, self.more = tuple(ends), tuple(more)
        self._slots: list[tuple[int, int]] = []  # end and position of every key
        known: dict[tuple[str, int], int] = {}
        dims: list[int] = []
        slot_of: list[list[int]] = []
        for e, end in enumerate(self.ends):
            slot_of.append([])
            for i, (identity, d) in enumerate(zip(end.identities(), end.dims, strict=True)):
                if identity not in known:
                    known[identity] = len(dims)
                    dims.append(d)
                    self._slots.append((e, i))
                slot_of[-1].append(known[identity])
        edges = np.cumsum([0, *dims])
        self._at = [
            np.concatenate([np.arange(edges[s], edges[s + 1]) for s in slots] or [np.zeros(0, np.int64)]) for slots in slot_of
        ]
        self._width = int(edges[-1])
        self.dims = (*dims, *(len(p.value) for p in self.more))
        self.shared = self._width < sum(end.width for end in self.ends)

    def keys(self, row: int) -> list[int]:
        of_end = [end.keys(row) for end in self.ends]
        return [*(of_end[e][i] for e, i in self._slots), *(p.key for p in self.more)]

    def key_table(self, entries: IntArray) -> IntArray:
        """Keys (n, k) of query entries."""
        of_end = [end.key_table(entries) for end in self.ends]
        own = [of_end[e][:, i] for e, i in self._slots] + [np.full(len(entries), p.key) for p in self.more]
        return np.column_stack(own) if own else np.zeros((len(entries), 0), np.int64)

    def join(self, parts: Sequence[Array], more: Sequence[Array] = ()) -> Array:
        """Jacobian (n, w) from one part per end (n, w_e) and one per further parameter (n, d)."""
        if not self.shared:
            return np.hstack([*parts, *more])
        J = np.zeros((len(parts[0]), self._width))
        for at, part in zip(self._at, parts, strict=True):
            J[:, at] += part
        return np.hstack([J, *more])


@dataclass(slots=True)
class EndsBlock(Block):
    """A block whose columns are those of its ends and of parameters; factors with several rows are those of one interval."""

    columns_of: Columns = field(init=False)

    @abstractmethod
    def ends(self) -> list[Endpoint]:
        """The ends, in the order of the columns."""

    def parameters(self) -> list[Parameter]:
        """Parameters besides those of the ends."""
        return []

    def __post_init__(self) -> None:
        Block.__post_init__(self)
        self.columns_of = Columns(self.ends(), self.parameters())

    def keys(self, f: int) -> list[int]:
        return self.columns_of.keys(int(self.entries()[f]))

    def key_table(self) -> IntArray:
        return self.columns_of.key_table(self.entries())

    def entries(self) -> IntArray:
        """Query entry (factors,) of every factor."""
        return self.rows.factor.start

    def widths(self) -> tuple[int, ...]:
        return self.columns_of.dims

    def regroup(self) -> None:
        """Sort rows into factors again after their points moved to other states: the rows of one interval share a factor."""
        self.rows.factor = CommonGroups.from_labels(interval_of(self.ends()))

    def refresh(self) -> None:
        if any([end.refresh() for end in self.ends()]):
            self.regroup()
            self.columns_of = Columns(self.ends(), self.parameters())
            self.structure += 1


@dataclass(slots=True)
class PositionBlock(EndsBlock):
    """Position fixes: three rows per fix, r_antenna - z."""

    end: Endpoint
    z_n: Array  # (m, 3)

    def ends(self) -> list[Endpoint]:
        return [self.end]

    def entries(self) -> IntArray:
        return np.arange(len(self.rows.factor.start))

    def regroup(self) -> None:
        """A factor per fix, whatever its state."""

    def predict(self) -> None:
        p = self.end.points(velocity=False)
        self.y = (self.z_n - p.r_n).ravel()
        self.J = p.J_r.reshape(self.n, -1)


@dataclass(slots=True)
class HeightBlock(EndsBlock):
    """Up coordinates of a point, with a bias where one is estimated."""

    end: Endpoint
    z_m: Array  # (n,)
    bias: Parameter | None = None

    def ends(self) -> list[Endpoint]:
        return [self.end]

    def parameters(self) -> list[Parameter]:
        return [] if self.bias is None else [self.bias]

    def predict(self) -> None:
        p = self.end.points(velocity=False)
        bias = 0.0 if self.bias is None else self.bias.value[0]
        self.y = self.z_m - p.r_n[:, 2] - bias
        self.J = self.columns_of.join([p.J_r[:, 2, :]], [] if self.bias is None else [np.ones((self.n, 1))])


@dataclass(slots=True)
class RangeBlock(EndsBlock):
    """Ranges between two points: z = (1 + scale) |a - b| + bias.

    `a` is on a vehicle; `b` on another vehicle or fixed.
    """

    a: Endpoint
    b: Endpoint | None
    anchor_n: Array | None  # (n, 3) when b is None
    z_m: Array  # (n,)
    bias: Parameter | None = None
    scale: Parameter | None = None

    def ends(self) -> list[Endpoint]:
        return [self.a] if self.b is None else [self.a, self.b]

    def parameters(self) -> list[Parameter]:
        return [p for p in (self.bias, self.scale) if p is not None]

    def predict(self) -> None:
        pa = self.a.points(velocity=False)
        if self.b is not None:
            pb = self.b.points(velocity=False)
            d, others = pa.r_n - pb.r_n, [-pb.J_r]
        else:
            assert self.anchor_n is not None
            d, others = pa.r_n - self.anchor_n, []
        rho = np.maximum(np.linalg.norm(d, axis=1), 1e-6)
        e = d / rho[:, None]
        bias, scale = (0.0 if p is None else p.value[0] for p in (self.bias, self.scale))
        self.y = self.z_m - (1 + scale) * rho - bias
        J = [(1 + scale) * np.einsum("ni,niw->nw", e, part) for part in (pa.J_r, *others)]
        own = [by for p, by in ((self.bias, np.ones(self.n)), (self.scale, rho)) if p is not None]
        self.J = self.columns_of.join(J, [column[:, None] for column in own])


@dataclass(slots=True)
class JointBlock(Block):
    """One empty row per state: no information, only joint elimination of several vehicles' poses and velocities."""

    vehicles: tuple[VehicleVariables, ...]

    def keys(self, f: int) -> list[int]:
        return [key for v in self.vehicles for key in v.keys(f)[:2]]

    def widths(self) -> tuple[int, ...]:
        return tuple(d for v in self.vehicles for d in v.dims[:2])

    def predict(self) -> None:
        self.y, self.J = np.zeros(self.n), np.zeros((self.n, sum(self.widths())))


@dataclass(frozen=True, slots=True)
class ScalarColumns:
    """Columns of a block's scalar variables, sparse: entry e says row `row[e]` has `scale[e]` in local column `column[e]`.

    The whitened and projected columns of factor f are a dense Fortran-ordered piece of `dense`.
    """

    row: IntArray  # (e,) sorted
    column: IntArray  # (e,) within the factor
    scale: Array  # (e,)
    keys: IntArray  # (sum of widths,) factor after factor
    first_key: IntArray  # (factors + 1,)
    start: IntArray  # (factors + 1,) rows of the factors
    first: IntArray  # (factors + 1,) into dense
    dense: Array

    def of(self, f: int) -> list[int]:
        """Keys of factor f."""
        return [int(k) for k in self.keys[self.first_key[f] : self.first_key[f + 1]]]

    @classmethod
    def sorted(cls, row: IntArray, key: IntArray, scale: Array, factor: CommonGroups, n: int) -> ScalarColumns:
        start = np.concatenate([factor.start, [n]]).astype(np.int64)
        order = np.lexsort((key, factor.of_row[row])) if len(row) else np.zeros(0, np.int64)
        f, k = factor.of_row[row][order], key[order]
        new = np.concatenate([[True], (f[1:] != f[:-1]) | (k[1:] != k[:-1])]) if len(row) else np.zeros(0, bool)
        widths = np.bincount(f[new], minlength=len(factor.start))
        first_key = np.concatenate([[0], np.cumsum(widths)]).astype(np.int64)
        column = np.empty(len(row), np.int64)
        column[order] = np.cumsum(new) - 1 - first_key[f]
        by_row = np.argsort(row, kind="stable")
        first = np.concatenate([[0], np.cumsum(widths * np.diff(start))]).astype(np.int64)
        return cls(row[by_row], column[by_row], scale[by_row], k[new], first_key, start, first, np.zeros(first[-1]))

    def matrix(self, f: int) -> Array:
        """View (rows, width) of factor f's columns."""
        rows = int(self.start[f + 1] - self.start[f])
        return self.dense[self.first[f] : self.first[f + 1]].reshape(-1, rows).T


@njit(cache=True)
def _quadratic(J, P, at):  # type: ignore[no-untyped-def]
    """J_i P_at(i) J_i^T (n,) of rows J (n, w) and matrices P (m, w, w)."""
    out = np.zeros(len(J))
    for i in range(len(J)):
        for a in range(J.shape[1]):
            part = 0.0
            for b in range(J.shape[1]):
                part += P[at[i], a, b] * J[i, b]
            out[i] += J[i, a] * part
    return out


@njit(cache=True)
def _point_jacobians(at, by_r, is_rate, by_v, J_r, J_v):  # type: ignore[no-untyped-def]
    """Rows by_r J_r + by_v J_v of the points `at`, the second term for rates only."""
    n, w = len(at), J_r.shape[2]
    J = np.zeros((n, w))
    for i in range(n):
        p = at[i]
        for k in range(3):
            for c in range(w):
                J[i, c] += by_r[i, k] * J_r[p, k, c]
            if is_rate[i]:
                for c in range(w):
                    J[i, c] += by_v[i, k] * J_v[p, k, c]
    return J


@njit(cache=True)
def _project_entries(row, column, scale, u, clock, clock_start, factor, start, first, dense):  # type: ignore[no-untyped-def]
    """dense = P diag(u) C for the sparse columns C, P of models.differencing."""
    dense[:] = 0.0
    n = len(u)
    for e in range(len(row)):
        j = row[e]
        g, f = clock[j], factor[j]
        a = clock_start[g]
        b = clock_start[g + 1] if g + 1 < len(clock_start) else n
        total = 0.0
        for i in range(a, b):
            total += u[i] * u[i]
        base = first[f] + column[e] * (start[f + 1] - start[f]) - start[f]
        dense[base + j] += u[j] * scale[e]
        if total > 0:
            share = scale[e] * u[j] * u[j] / total
            for i in range(a, b):
                dense[base + i] -= u[i] * share


def project_entries(c: ScalarColumns, u: Array, clocks: CommonGroups, factor: CommonGroups) -> None:
    """Fill the whitened and projected columns of every factor."""
    _project_entries(c.row, c.column, c.scale, u, clocks.of_row, clocks.start, factor.of_row, c.start, c.first, c.dense)


@dataclass(slots=True)
class GnssBlock(EndsBlock):
    """Code, phase and Doppler of a receiver, or their differences rover - reference. One factor per epoch.

    Predicted (common clocks projected out): |s - a_rover| - |s' - a_ref| for code and phase (+ lambda N), and
    e . (v_s - v_a) likewise for Doppler. `reference` is None for undifferenced rows.

    Of a moving reference, differences are to tell where the rover is relative to it, not where it is: 20 m change them by
    5 mm at 5 km, less than antennas and atmosphere leave for minutes on end. They are therefore predicted for a reference
    at `place_n`, known beforehand, and a rover at `place_n` + a_rover - a_ref.
    """

    rover: Endpoint
    reference: Endpoint | None
    point_rover: IntArray  # (n,) row -> query entry of the rover (one per factor)
    z: Array  # (n,) rover minus reference observation, corrected
    sat_rover: Array  # (n, 3) satellite in n
    vel_rover: Array
    sat_reference: Array  # (n, 3), zeros when undifferenced
    vel_reference: Array
    wavelength_m: Array  # (n,)
    arc: IntArray  # (n,) ambiguity arc of a phase row, -1 elsewhere
    amb_key: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (arcs,) 0: constant
    amb_value: Array = field(default_factory=lambda: np.zeros(0))  # (arcs,) units
    amb_unit_cyc: Array = field(default_factory=lambda: np.zeros(0))  # (arcs,) 1; 0.5 where halves of a cycle are open
    jump_cyc: Array = field(init=False)  # (n,) repaired slips within the row's arc
    by_rover: Array = field(init=False)  # (n, 3) gradient of the prediction by the rover's antenna
    place_n: Array | None = None  # (m, 3) one per factor: where a moving reference is taken to be
    biases: list[Parameter] = field(default_factory=list)  # constants between groups that share clocks
    bias_of: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (n,) row -> bias, -1 none; empty without biases
    clock_index: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (n,) clock within epoch and kind
    scalar_columns: ScalarColumns | None = None  # until factors are renewed

    def __post_init__(self) -> None:
        self.regroup()
        EndsBlock.__post_init__(self)
        self.jump_cyc = np.zeros(self.n)

    def ends(self) -> list[Endpoint]:
        return [self.rover] if self.reference is None else [self.rover, self.reference]

    def parameters(self) -> list[Parameter]:
        return self.biases

    def entries(self) -> IntArray:
        return np.arange(len(self.rows.factor.start))

    def regroup(self) -> None:
        """A factor per epoch, whatever its states; two antennas of one vehicle are seen from the same state."""
        if self.reference is not None:
            share_states(self.rover, self.reference)

    def sightings(self) -> tuple[IntArray, Array]:
        """Keys (m,) of ambiguities and nodes that are variables, and the times at which factors have them."""
        c = self.scalars()
        t_s = self.rows.t_s[self.rows.factor.start]
        return c.keys, np.repeat(t_s, np.diff(c.first_key))

    def scalars(self) -> ScalarColumns:
        """Columns of the ambiguities and nodes that are variables."""
        if self.scalar_columns is None:
            arc_free = self.arc >= 0
            arc_free[arc_free] = self.amb_key[self.arc[arc_free]] != 0
            a = np.flatnonzero(arc_free)
            row = np.concatenate([a, *(nodes.row for nodes in self.nodes)])
            key = np.concatenate([self.amb_key[self.arc[a]], *(nodes.key[nodes.node] for nodes in self.nodes)])
            scale = np.concatenate([self.unit_m(a), *(nodes.scale for nodes in self.nodes)])
            self.scalar_columns = ScalarColumns.sorted(row, key, scale, self.rows.factor, self.n)
        return self.scalar_columns

    def unit_m(self, phases: IntArray) -> Array:
        """Metres per unit of the ambiguities of phase rows (m,)."""
        return np.asarray(self.wavelength_m[phases] * self.amb_unit_cyc[self.arc[phases]])

    def renew(self) -> None:
        """Call when ambiguities became constants or variables: the factors' keys change with them."""
        self.scalar_columns = None
        self.structure += 1

    def whiten(self) -> None:
        Block.whiten(self)
        c = self.scalars()
        if len(c.row):
            assert self.rows.clocks is not None
            project_entries(c, self.u, self.rows.clocks, self.rows.factor)

    def predict(self) -> None:
        has_rate = bool(np.any(self.rows.kind == DOPPLER))
        rover = self.rover.points(velocity=has_rate)
        if self.reference is None:
            y, by_r, e = self._one_way(rover.r_n, rover.v_n, self.sat_rover, self.vel_rover)
            self.J = self.columns_of.join([self._jacobian(by_r, e, rover)], self._of_biases())
        else:
            reference = self.reference.points(velocity=has_rate)
            at = reference.r_n if self.place_n is None else self.place_n
            y, by_r, e = self._one_way(at + (rover.r_n - reference.r_n), rover.v_n, self.sat_rover, self.vel_rover)
            y_ref, by_r_ref, e_ref = self._one_way(at, reference.v_n, self.sat_reference, self.vel_reference)
            y -= y_ref
            by_r_ref = by_r_ref if self.place_n is None else by_r
            parts = [self._jacobian(by_r, e, rover), -self._jacobian(by_r_ref, e_ref, reference)]
            self.J = self.columns_of.join(parts, self._of_biases())
        self.by_rover = by_r
        phase = np.flatnonzero(self.arc >= 0)
        y[phase] += self.unit_m(phase) * self.amb_value[self.arc[phase]] + self.wavelength_m[phase] * self.jump_cyc[phase]
        for nodes in self.nodes:
            y += nodes.seen(self.n)
        if self.biases:
            y += np.append([float(bias.value[0]) for bias in self.biases], 0.0)[self.bias_of]  # -1: the appended zero
        self.y = self.z - y

    def _of_biases(self) -> list[Array]:
        return [(self.bias_of == i)[:, None].astype(float) for i in range(len(self.biases))]

    def _one_way(self, r: Array, v: Array, sat: Array, vel: Array) -> tuple[Array, Array, Array]:
        """Range or range rate (n,) of every row to its point r, v (m, 3), its gradient by r (n, 3), and the direction (n, 3)."""
        return one_way(self.point_rover, self.rows.kind == DOPPLER, r, v, sat, vel)  # type: ignore[no-any-return]

    def _jacobian(self, by_r: Array, e: Array, point: Point) -> Array:
        return np.asarray(_point_jacobians(self.point_rover, by_r, self.rows.kind == DOPPLER, -e, point.J_r, point.J_v))
