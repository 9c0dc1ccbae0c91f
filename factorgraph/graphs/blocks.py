"""Measurement blocks: whole-flight vectorised residuals and Jacobians, handed to GTSAM one factor per epoch.

A block holds all rows of one source (a link's differences, a receiver's code, a set of ranges). Each iteration it
evaluates every row at once; its `gtsam.CustomFactor`s only pick their slices. Row i of factor f reads

    e_i = sqrt(w_i) / sigma_i (h_i(x) - z_i),  common clocks projected out (models.differencing)

with robust weights w_i per row, never per factor.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factorgraph.graphs.variables import Query, VehicleVariables
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.robust import cost as robust_cost
from factorgraph.models.robust import weight as robust_weight
from factorgraph.problem import RangeModel, Robust
from factorgraph.types import Array, BoolArray, IntArray

KINDS = ("code", "phase", "doppler", "range", "position", "height")
CODE, PHASE, DOPPLER, RANGE, POSITION, HEIGHT = range(len(KINDS))


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


@dataclass(slots=True)
class Block:
    """Base of all blocks; subclasses say how rows are predicted."""

    rows: Rows
    y: Array = field(init=False)  # (n,) measured - predicted
    J: Array = field(init=False)  # (n, w) d predicted / d local columns
    w: Array = field(init=False)  # (n,) robust weights
    e: Array = field(init=False)  # (n,) whitened predicted - measured
    Jw: Array = field(init=False)  # (n, w) whitened
    u: Array = field(init=False)  # (n,) sqrt(w) / sigma
    active: BoolArray = field(init=False)  # (n,) rows in use
    made: gtsam.NonlinearFactorGraph | None = field(default=None, init=False)  # its factors, until their keys change

    def __post_init__(self) -> None:
        self.w = np.ones(len(self.rows.sigma))
        self.active = np.ones(len(self.rows.sigma), bool)

    @property
    def n(self) -> int:
        return len(self.rows.sigma)

    def keys(self, f: int) -> list[int]:
        """GTSAM keys of factor f, in the order of the columns."""
        raise NotImplementedError

    def widths(self) -> tuple[int, ...]:
        """Column counts of those keys."""
        raise NotImplementedError

    def predict(self) -> None:
        """Set y and J at the current variables."""
        raise NotImplementedError

    def refresh(self) -> None:
        """Renew what depends on the preintegration bias."""

    def normalised(self) -> Array:
        """Residuals (n,) over their own standard deviation, the group's common clock taken out."""
        s = self.rows.sigma
        clocks = self.rows.clocks
        if clocks is None:
            return self.y / s
        u = np.sqrt(self.w) / s
        res = self.y - clocks.mean(self.y, u)[clocks.of_row]
        h = clocks.leverage(u)
        return res / (s * np.sqrt(np.maximum(1 - h, 0.05)))

    def residuals(self) -> Array:
        """Residuals (n,) with the common clocks taken out."""
        clocks = self.rows.clocks
        if clocks is None:
            return self.y
        return self.y - clocks.mean(self.y, np.sqrt(self.w) / self.rows.sigma)[clocks.of_row]

    def reweight(self, robust: dict[str, Robust]) -> None:
        self.w = np.where(self.active, self.w, 0.0)
        t = self.normalised()
        for index, name in enumerate(KINDS):
            mine = self.active & (self.rows.kind == index)
            if name in robust and np.any(mine):
                self.w[mine] = robust_weight(robust[name], t[mine])

    def cost(self, robust: dict[str, Robust]) -> float:
        """Robust cost at the current residuals; the clock means use the current weights."""
        r = self.residuals() / self.rows.sigma
        total = 0.0
        for index, name in enumerate(KINDS):
            mine = self.active & (self.rows.kind == index)
            if np.any(mine):
                total += float(np.sum(robust_cost(robust.get(name), r[mine])))
        return total

    def whiten(self) -> None:
        self.u = np.sqrt(self.w) / self.rows.sigma
        if self.rows.clocks is None:
            self.e, self.Jw = -self.u * self.y, self.u[:, None] * self.J
        else:
            self.e, self.Jw = -self.rows.clocks.project(self.y, self.u), self.rows.clocks.project(self.J, self.u)

    def slices(self, f: int) -> tuple[int, int]:
        start = self.rows.factor.start
        return int(start[f]), int(start[f + 1]) if f + 1 < len(start) else self.n

    def columns(self, f: int) -> list[Array]:
        """Whitened Jacobians of factor f, one per key."""
        i, j = self.slices(f)
        return [self.Jw[i:j, a:b] for a, b in self.edges()]

    def edges(self) -> list[tuple[int, int]]:
        """Column ranges of the keys."""
        ends = np.cumsum((0, *self.widths())).tolist()
        return list(itertools.pairwise(ends))

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """The block's factors; made once."""
        if self.made is None:
            self.made = gtsam.NonlinearFactorGraph()
            edges = self.edges()
            for f in range(len(self.rows.factor.start)):
                i, j = self.slices(f)
                self.made.add(self._carrier(f, i, j, edges))
        return self.made

    def _carrier(self, f: int, i: int, j: int, edges: list[tuple[int, int]]) -> gtsam.CustomFactor:
        """A factor that hands out rows i:j of what `whiten` computed."""

        def error(_factor: gtsam.CustomFactor, _values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            if jacobians is not None:
                Jw = self.Jw[i:j]
                for slot, (a, b) in enumerate(edges):
                    jacobians[slot] = Jw[:, a:b]
            return self.e[i:j]

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(j - i), self.keys(f), error)


@dataclass(slots=True)
class Endpoint:
    """One end of an observation: a vehicle's point, with its columns."""

    vehicle: VehicleVariables
    query: Query

    @property
    def width(self) -> int:
        return sum(self.dims)

    @property
    def dims(self) -> tuple[int, ...]:
        dims = self.vehicle.dims
        return dims[:2] if self.vehicle.mode == "imu" and self.query.increments is None else dims

    def keys(self, row: int) -> tuple[int, ...]:
        return self.vehicle.keys(int(self.query.k[row]))[: len(self.dims)]

    def refresh(self) -> None:
        self.query = self.vehicle.refresh(self.query)


@dataclass(slots=True)
class PositionBlock(Block):
    """Position fixes: three rows per fix, r_antenna - z."""

    end: Endpoint
    z_n: Array  # (m, 3)

    def keys(self, f: int) -> list[int]:
        return list(self.end.keys(f))

    def widths(self) -> tuple[int, ...]:
        return self.end.dims

    def predict(self) -> None:
        p = self.end.vehicle.points(self.end.query)
        self.y = (self.z_n - p.r_n).ravel()
        self.J = p.J_r.reshape(self.n, -1)

    def refresh(self) -> None:
        self.end.refresh()


@dataclass(slots=True)
class HeightBlock(Block):
    """Up coordinates of a point: the rows of one state interval share a factor."""

    end: Endpoint
    z_m: Array  # (n,)

    def keys(self, f: int) -> list[int]:
        return list(self.end.keys(int(self.rows.factor.start[f])))

    def widths(self) -> tuple[int, ...]:
        return self.end.dims

    def predict(self) -> None:
        p = self.end.vehicle.points(self.end.query)
        self.y = self.z_m - p.r_n[:, 2]
        self.J = p.J_r[:, 2, :]

    def refresh(self) -> None:
        self.end.refresh()


@dataclass(slots=True)
class RangeBlock(Block):
    """Ranges between two points: z = (1 + scale) |a - b| + bias. The rows of one state interval share a factor.

    `a` is on a vehicle; `b` on another vehicle or fixed. Bias and scale are one two-element variable `parameter`.
    """

    a: Endpoint
    b: Endpoint | None
    anchor_n: Array | None  # (n, 3) when b is None
    z_m: Array  # (n,)
    parameter: int | None  # key, or None when neither is estimated
    model: RangeModel
    value: Array = field(default_factory=lambda: np.zeros(2))  # bias [m], scale [1]

    def keys(self, f: int) -> list[int]:
        row = int(self.rows.factor.start[f])
        own = [*self.a.keys(row), *(self.b.keys(row) if self.b is not None else ())]
        return own if self.parameter is None else [*own, self.parameter]

    def widths(self) -> tuple[int, ...]:
        own = (*self.a.dims, *(self.b.dims if self.b is not None else ()))
        return own if self.parameter is None else (*own, 2)

    def predict(self) -> None:
        pa = self.a.vehicle.points(self.a.query)
        if self.b is not None:
            pb = self.b.vehicle.points(self.b.query)
            d, others = pa.r_n - pb.r_n, [-pb.J_r]
        else:
            assert self.anchor_n is not None
            d, others = pa.r_n - self.anchor_n, []
        rho = np.maximum(np.linalg.norm(d, axis=1), 1e-6)
        e = d / rho[:, None]
        scale = 1 + self.value[1]
        self.y = self.z_m - scale * rho - self.value[0]
        J = [scale * np.einsum("ni,niw->nw", e, part) for part in (pa.J_r, *others)]
        if self.parameter is not None:
            J.append(np.column_stack([np.ones(self.n), rho]))
        self.J = np.hstack(J)

    def refresh(self) -> None:
        self.a.refresh()
        if self.b is not None:
            self.b.refresh()


@dataclass(slots=True)
class MotionBlock(Block):
    """Continuous-time motion prior of a vehicle without IMU; rows are already whitened by `L`."""

    vehicle: VehicleVariables
    keys_of: Sequence[tuple[int, int, int, int]]
    L: Array  # (K - 1, 6, 6)
    J0: Array  # (K - 1, 6, 12)

    def keys(self, f: int) -> list[int]:
        return list(self.keys_of[f])

    def widths(self) -> tuple[int, ...]:
        return (3, 3, 3, 3)

    def predict(self) -> None:
        v = self.vehicle
        x = np.hstack([v.r[:-1], v.v[:-1], v.r[1:], v.v[1:]])
        self.y = -np.einsum("nij,njk,nk->ni", self.L, self.J0, x).ravel()
        self.J = (self.L @ self.J0).reshape(self.n, 12)


@dataclass(slots=True)
class IonosphereBlock(Block):
    """Prior and random walk of a link's differential ionosphere: one row per variable, zero mean."""

    of: GnssBlock
    previous: IntArray  # (n,) variable before it in time of the same satellite, -1 for the first

    def keys(self, f: int) -> list[int]:
        own = int(self.of.iono_key[f])
        return [own] if self.previous[f] < 0 else [own, int(self.of.iono_key[self.previous[f]])]

    def widths(self) -> tuple[int, ...]:
        return (1, 1)

    def predict(self) -> None:
        x = self.of.iono_value
        self.y = -np.where(self.previous >= 0, x - x[self.previous], x)
        self.J = np.tile([1.0, -1.0], (self.n, 1))

    def columns(self, f: int) -> list[Array]:
        return Block.columns(self, f)[: len(self.keys(f))]

    def _carrier(self, f: int, i: int, j: int, edges: list[tuple[int, int]]) -> gtsam.CustomFactor:
        return Block._carrier(self, f, i, j, edges[: 1 if self.previous[f] < 0 else 2])


@dataclass(slots=True)
class JointBlock(Block):
    """One empty row per state: no information, only joint elimination of two vehicles' poses and velocities."""

    a: VehicleVariables
    b: VehicleVariables

    def keys(self, f: int) -> list[int]:
        return [*self.a.keys(f)[:2], *self.b.keys(f)[:2]]

    def widths(self) -> tuple[int, ...]:
        return (*self.a.dims[:2], *self.b.dims[:2])

    def predict(self) -> None:
        self.y, self.J = np.zeros(self.n), np.zeros((self.n, sum(self.widths())))


@dataclass(slots=True)
class GnssBlock(Block):
    """Code, phase and Doppler of a receiver, or their differences rover - reference. One factor per epoch.

    Predicted (common clocks projected out): |s - a_rover| - |s' - a_ref| for code and phase (+ lambda N), and
    e . (v_s - v_a) likewise for Doppler. `reference` is None for undifferenced rows.
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
    amb_value: Array = field(default_factory=lambda: np.zeros(0))  # (arcs,) cycles
    iono: IntArray = field(init=False)  # (n,) row -> ionosphere variable, -1 none
    iono_scale: Array = field(init=False)  # (n,) metres of this row per metre of it
    iono_key: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    iono_value: Array = field(default_factory=lambda: np.zeros(0))  # vertical at L1, rover minus reference [m]
    scalar_cache: dict[int, tuple[list[int], Array]] = field(
        default_factory=dict
    )  # structure of each factor, until factors are renewed

    def __post_init__(self) -> None:
        Block.__post_init__(self)
        self.iono, self.iono_scale = np.full(self.n, -1, np.int64), np.zeros(self.n)

    def _ends(self) -> list[Endpoint]:
        return [self.rover] if self.reference is None else [self.rover, self.reference]

    def keys(self, f: int) -> list[int]:
        own = [k for end in self._ends() for k in end.keys(f)]
        return [*own, *self.scalars(f)[0]]

    def scalars(self, f: int) -> tuple[list[int], Array]:
        """Keys of the ambiguities and ionospheres in factor f that are variables, and their raw columns (rows, keys)."""
        if f not in self.scalar_cache:
            i, j = self.slices(f)
            arc, iono = self.arc[i:j], self.iono[i:j]
            arcs = np.array(sorted(set(arc.tolist()) - {-1}), np.int64)
            arcs = arcs[self.amb_key[arcs] != 0]
            ionospheres = np.array(sorted(set(iono.tolist()) - {-1}), np.int64)
            columns = np.hstack(
                [
                    np.where(arc[:, None] == arcs, self.wavelength_m[i:j, None], 0.0),
                    np.where(iono[:, None] == ionospheres, self.iono_scale[i:j, None], 0.0),
                ]
            )
            self.scalar_cache[f] = ([*self.amb_key[arcs].tolist(), *self.iono_key[ionospheres].tolist()], columns)
        return self.scalar_cache[f]

    def renew(self) -> None:
        """Call when ambiguities became constants or variables: the factors' keys change with them."""
        self.scalar_cache.clear()
        self.made = None

    def _carrier(self, f: int, i: int, j: int, edges: list[tuple[int, int]]) -> gtsam.CustomFactor:
        if not self.scalars(f)[0]:
            return Block._carrier(self, f, i, j, edges)

        def error(_factor: gtsam.CustomFactor, _values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            if jacobians is not None:
                for slot, column in enumerate(self.columns(f)):
                    jacobians[slot] = column
            return self.e[i:j]

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(j - i), self.keys(f), error)

    def widths(self) -> tuple[int, ...]:
        return tuple(d for end in self._ends() for d in end.dims)

    def predict(self) -> None:
        at = self.point_rover
        p = self.rover.vehicle.points(self.rover.query)
        y, J = self._one_way(p.r_n[at], p.v_n[at], p.J_r[at], p.J_v[at], self.sat_rover, self.vel_rover)
        parts = [J]
        if self.reference is not None:
            q = self.reference.vehicle.points(self.reference.query)
            y_ref, J_ref = self._one_way(q.r_n[at], q.v_n[at], q.J_r[at], q.J_v[at], self.sat_reference, self.vel_reference)
            y = y - y_ref
            parts.append(-J_ref)
        phase = self.arc >= 0
        y[phase] += self.wavelength_m[phase] * self.amb_value[self.arc[phase]]
        if len(self.iono_value):
            y += np.where(self.iono >= 0, self.iono_scale * self.iono_value[self.iono], 0.0)
        self.y = self.z - y
        self.J = np.hstack(parts)

    def _one_way(self, r: Array, v: Array, J_r: Array, J_v: Array, sat: Array, vel: Array) -> tuple[Array, Array]:
        d = sat - r
        rho = np.linalg.norm(d, axis=1)
        e = d / rho[:, None]
        rel = vel - v
        rate = np.einsum("ni,ni->n", e, rel)
        is_rate = self.rows.kind == DOPPLER
        # d rate / d r = -(rel - e (e . rel)) / rho
        grad = np.where(is_rate[:, None], -(rel - e * rate[:, None]) / rho[:, None], -e)
        J = np.einsum("ni,niw->nw", grad, J_r)
        J[is_rate] -= np.einsum("ni,niw->nw", e[is_rate], J_v[is_rate])
        return np.where(is_rate, rate, rho), J

    def columns(self, f: int) -> list[Array]:
        own = Block.columns(self, f)
        raw = self.scalars(f)[1]
        if not raw.shape[1]:
            return own
        # whiten and project as the block does for its own columns
        assert self.rows.clocks is not None
        i, j = self.slices(f)
        clock = self.rows.clocks.of_row[i:j] - self.rows.clocks.of_row[i]
        first = np.searchsorted(clock, np.arange(clock[-1] + 1))
        raw = np.asfortranarray(CommonGroups(first, clock).project(raw, self.u[i:j]))
        return [*own, *(raw[:, k : k + 1] for k in range(raw.shape[1]))]

    def refresh(self) -> None:
        for end in self._ends():
            end.refresh()
