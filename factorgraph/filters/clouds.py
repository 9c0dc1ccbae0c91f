"""A stage and its transition seen by a cloud of sigma points in place of Jacobians.

With P = L L' of the vehicles' errors, all of them jointly, and points d_i = +-gamma L e_i (`sigma_points`), every point is a
state of its own that IMU intervals carry and measurement models see: blocks are evaluated once, with their queries repeated for
all points. From the images follow mean, slope and what no slope explains,

    f(d) ~ f_0 + delta + F d,   cov = F P F' + E E',      h(d) ~ h_0 + delta' + H d,  cov = H P H' + E' E''

so that covariances, gains and cross covariances are those of the unscented or cubature filter. Ambiguities, nodes and parameters
enter with their Jacobians at the mean: all but some parameters are linear there, and cubature points of thirty instead of a
hundred dimensions stand nearer.

Source: Lefebvre, Bruyninckx and De Schutter (2002) for filters by statistical linearisation; Morelande and Moran (2007),
An unscented transformation for conditionally linear models.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph.assembly.blocks import Endpoint, EndsBlock, GnssBlock
from factorgraph.assembly.nodes import Nodes
from factorgraph.assembly.pieces import TABLES
from factorgraph.assembly.priors import MotionBlock
from factorgraph.assembly.sensors import Measured, VectorBlock
from factorgraph.assembly.variables import Query, VehicleVariables
from factorgraph.attitude import log_so3
from factorgraph.filters.sequential import Part, StageRows, Stages
from factorgraph.filters.sigma_points import Rule, parts, slope, spread
from factorgraph.models.imu_interval import Intervals, States, carry
from factorgraph.models.preintegration import Increments
from factorgraph.types import Array

OTHERS = (*TABLES, "y", "J", "w", "u", "active", "by_rover", "clock_index")  # arrays that nothing is predicted from
REACH = (10.0, 10.0)  # m, m/s: standard deviation of points at most
Numbers = TypeVar("Numbers", bound=NDArray[Any])
Clouds = dict[int, VehicleVariables]  # vehicle -> one whose states are the points


@dataclass(frozen=True, slots=True)
class Sloped:
    """What a cloud shows of a function: images less that of the mean (m,), slope (m, states), and the rest, cov = E E'."""

    mean: Array
    slope: Array
    E: Array  # (m, states + 1)


class Cloud:
    """Sigma points of a flight's stages; unscented rules must not take anything off a covariance (alpha^2 <= beta)."""

    def __init__(self, stages: Stages, rule: Callable[[int], Rule]) -> None:
        self.s, self.rule = stages, rule(stages.n_states)
        # roots of the intervals' noise, velocity along body axes
        self.noise = {i: np.linalg.inv(block.intervals.whitening) for i, block in stages.imu.items()}
        self.linear = {i: _transition(block) for i, block in stages.motion.items()}

    def _near(self, L: Array) -> Array:
        """A root (n, n) whose points stay near where it says that positions and velocities are hardly known."""
        sigma, most = np.sqrt(np.einsum("ij,ij->i", L, L)), np.full(len(L), np.inf)
        for v in self.s.vehicles:
            at = self.s.offset[v.index] + (3 if v.mode == "imu" else 0)
            most[at : at + 6] = np.repeat(REACH, 3)
        return np.asarray(np.minimum(1.0, most / np.maximum(sigma, 1e-300))[:, None] * L)

    def _sloped(self, L: Array, Y: Array) -> Sloped:
        mean, G, E = parts(np.ascontiguousarray(Y), self.rule.weight, self.rule.shifted, self.rule.shift)
        return Sloped(mean, slope(L, G), E)

    def transition(self, k: int, L: Array) -> tuple[Sloped, Array]:
        """From stage k, whose states have a covariance of root L (n, n), to the next, and a root (n, n) of its noise.

        State k + 1 becomes the one carried from the mean.
        """
        D = spread(L, self.rule.gamma)
        Y, noise = np.empty_like(D), np.zeros((len(L), len(L)))
        for v in self.s.vehicles:
            own = slice(self.s.offset[v.index], self.s.offset[v.index] + sum(v.dims))
            if v.mode == "imu":
                Y[:, own] = self._carried(v, k, D[:, own])
                noise[own, own] = self.noise[v.index][k]
                speed = slice(own.start + 6, own.start + 9)
                noise[speed, own] = v.R[k + 1] @ noise[speed, own]
            else:
                F, root = self.linear[v.index]
                Y[:, own], noise[own, own] = D[:, own] @ F[k].T, root[k]
                v.v[k + 1], v.r[k + 1] = v.v[k], v.r[k] + (v.t_s[k + 1] - v.t_s[k]) * v.v[k]
        return self._sloped(L, Y), noise

    def _carried(self, v: VehicleVariables, k: int, x: Array) -> Array:
        """Deviations (s, 15) at stage k + 1 from those at stage k."""
        block, n = self.s.imu[v.index], len(x)
        at, bias = self._points(v, k, x)
        part = Intervals(*(_alike(getattr(block.intervals, name)[k], n) for name in Intervals.__dataclass_fields__))
        fixed = (_alike(block.at_bias[k], n), _alike(block.gravitation_n[k], n), v.frame.w_ie_n)
        scale = v.imu_scale - v.applied_scale if block.scales else None
        R, r, vel = carry(part, at.R, at.r_n, at.v_n, bias, *fixed, scale)
        v.R[k + 1], v.r[k + 1], v.v[k + 1], v.bias[k + 1] = R[0], r[0], vel[0], v.bias[k]
        back = R[0].T
        return np.hstack([log_so3(back @ R), (r - r[0]) @ back.T, vel - vel[0], x[:, 9:]])

    def _points(self, v: VehicleVariables, k: int, x: Array) -> tuple[States, Array]:
        """States and biases (s, 6; gyroscope first) at deviations (s, 15) from state k."""
        here = States(*(_alike(own[k], len(x)) for own in (v.R, v.r, v.v)))
        at, _ = self.s.chart.move(here, x[:, :9])
        return at, v.bias[k] + np.hstack([x[:, 12:15], x[:, 9:12]])

    def rows(self, k: int, L: Array) -> tuple[StageRows, Array]:
        """Rows of stage k, whose states have a covariance of root L (n, n), and E (m, states + 1)."""
        pieces = self.s.parts(k, k + 1, evaluate=False)
        L = self._near(L)
        D = spread(L, self.rule.gamma)
        clouds = {v.index: self._vehicle(v, k, D[:, self.s.offset[v.index] :]) for v in self.s.vehicles} if pieces else {}
        images = {p.of.number: (p.row0, _seen(p, clouds, len(D))) for p in pieces}
        rows = self.s.stage_rows(k, pieces)
        E = np.zeros((len(rows.e), len(L) + 1))
        if not rows.at:
            return rows, E
        Y = np.hstack([y[:, i - row0 : j - row0] for number, i, j in rows.at for row0, y in (images[number],)])
        seen, m = self._sloped(L, Y), Y.shape[1]
        e, H = rows.e.copy(), rows.H.copy()
        e[:m], H[:m, : len(L)], E[:m] = seen.mean, -seen.slope, seen.E
        return replace(rows, e=e, H=H), E

    def _vehicle(self, v: VehicleVariables, k: int, x: Array) -> VehicleVariables:
        """A vehicle whose states are the points x (s, columns) about state k."""
        cloud, n = copy.copy(v), len(x)
        cloud.t_s, cloud.preintegrated_bias = np.full(n, v.t_s[k]), np.tile(v.preintegrated_bias[k], (n, 1))
        if v.mode == "imu":
            at, cloud.bias = self._points(v, k, x[:, :15])
            cloud.R, cloud.r, cloud.v = at.R, at.r_n, at.v_n
        else:
            cloud.R, cloud.bias = np.tile(v.R[k], (n, 1, 1)), np.tile(v.bias[k], (n, 1))
            cloud.r, cloud.v = v.r[k] + x[:, :3], v.v[k] + x[:, 3:6]
        return cloud


def _alike(x: Array, n: int) -> Array:
    """The same n times over, a view."""
    return np.broadcast_to(x, (n, *np.shape(x)))


def _transition(block: MotionBlock) -> tuple[Array, Array]:
    """F and a root of Q (K - 1, 6, 6) of all intervals of a vehicle without IMU."""
    J = block.L @ block.J0
    back = np.linalg.inv(J[:, :, 6:])
    return -back @ J[:, :, :6], np.asarray(back, float)


def _seen(p: Part, clouds: Clouds, n: int) -> Array:
    """Whitened rows (s, m) of a part at all points; the part is left evaluated at the first, the mean."""
    block, part = repeated(p, clouds, n), p.part
    block.predict()
    part.y, part.J = block.y[: part.n], block.J[: part.n]
    part.whiten()
    y = np.ascontiguousarray(block.y.reshape(n, -1).T)
    clocks = part.rows.clocks
    return np.asarray((part.u[:, None] * y if clocks is None else clocks.project(y, part.u)).T)


def repeated(of: Part, clouds: Clouds, n: int) -> EndsBlock:
    """A block of one stage n times over, once for each point; good to be predicted."""
    part, whole = of.part, of.of.block
    of_entries, lengths = len(part.ends()[0].query.k), (whole.n, len(whole.ends()[0].query.k))
    out = copy.copy(part)
    for field in fields(part):
        value = getattr(part, field.name, None)
        if isinstance(value, Endpoint):
            setattr(out, field.name, _end(value, clouds, n))
        elif isinstance(value, Measured):
            ends = tuple(_end(end, clouds, n) for end in value.ends)
            setattr(out, field.name, replace(value, ends=ends))
        elif isinstance(value, np.ndarray) and field.name not in OTHERS and len(getattr(whole, field.name)) in lengths:
            setattr(out, field.name, _tiled(value, n))
    out.rows = copy.copy(part.rows)
    out.rows.kind, out.rows.sigma = _tiled(part.rows.kind, n), _tiled(part.rows.sigma, n)
    out.nodes = [_nodes(nodes, part.n, n) for nodes in part.nodes]
    by_point = np.repeat(np.arange(n), part.n)
    if isinstance(out, GnssBlock):
        out.point_rover = out.point_rover + of_entries * by_point
    if isinstance(out, VectorBlock):
        out.of_row = out.of_row + of_entries * by_point
    return out


def _tiled(x: Numbers, n: int) -> Numbers:
    return np.concatenate([x] * n)  # type: ignore[return-value]


def _end(end: Endpoint, clouds: Clouds, n: int) -> Endpoint:
    q = end.query
    vehicle = clouds.get(end.vehicle.index, end.vehicle)
    k = _tiled(q.k, n) if vehicle is end.vehicle else np.repeat(np.arange(n), len(q.k))
    inc = q.increments
    if inc is not None:
        inc = Increments(*(_tiled(getattr(inc, name), n) for name in Increments.__dataclass_fields__))
    return replace(end, vehicle=vehicle, query=Query(k, _tiled(q.dt_s, n), _tiled(q.lever_b, n), inc))


def _nodes(nodes: Nodes, rows: int, n: int) -> Nodes:
    out = copy.copy(nodes)
    out.row = _tiled(nodes.row, n) + rows * np.repeat(np.arange(n), len(nodes.row))
    out.node, out.scale = _tiled(nodes.node, n), _tiled(nodes.scale, n)
    return out
