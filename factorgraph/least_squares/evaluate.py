"""Measurement blocks evaluated by their symbolic models: y and J as `predict` sets them, by automatic differentiation.

An `Evaluator` belongs to one block. It gathers what is constant while the block's points stay with their states (times, lever
arms, samples, increments, satellites) once, and in each evaluation only states and parameters. GNSS points and their Jacobians
are evaluated once per epoch and rows follow by the chain rule; all other rows go through one function from states to residual.

Rows that are linear with constant coefficients (motion priors, nodes, integers, priors of parameters) have no model: the
block predicts them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit

from factorgraph.assembly.atmosphere import NodeBlock
from factorgraph.assembly.barometer import BarometerBlock
from factorgraph.assembly.blocks import (
    DOPPLER,
    Block,
    Endpoint,
    EndsBlock,
    GnssBlock,
    HeightBlock,
    JointBlock,
    PositionBlock,
    RangeBlock,
)
from factorgraph.assembly.constraints import NonHolonomicBlock, StillBlock, ZeroRotationBlock
from factorgraph.assembly.inertial_block import ImuBlock
from factorgraph.assembly.parameters import Parameter
from factorgraph.assembly.priors import MotionBlock, ParameterPrior, StatePrior
from factorgraph.assembly.sensors import (
    AttitudeBlock,
    FixVelocityBlock,
    HeadingBlock,
    MagneticBlock,
    Mounting,
    VectorBlock,
    VelocityBlock,
    VisionBlock,
)
from factorgraph.assembly.switches import SwitchBlock
from factorgraph.assembly.variables import Query, VehicleVariables
from factorgraph.assembly.wide_lanes import WideLaneBlock
from factorgraph.least_squares.functions import Samples, codegen_wanted, linearised
from factorgraph.measurements import ImuStream
from factorgraph.models.symbolic import gnss, inertial, motion, point, ranging, sensors
from factorgraph.models.symbolic.symbols import Model
from factorgraph.types import Array, IntArray

LINEAR = (MotionBlock, ParameterPrior, JointBlock, NodeBlock, SwitchBlock, WideLaneBlock)  # constant Jacobians


class Evaluator(ABC):
    """Sets a block's y and J at the current variables."""

    @abstractmethod
    def evaluate(self) -> None:
        """Set y and J of the block."""


def evaluator(block: Block, codegen: bool | None = None) -> Evaluator:
    """The evaluator of a block; `codegen`: compiled functions, by the environment variable where None.

    Raises TypeError for a kind of block that has no symbolic model.
    """
    compiled = codegen_wanted() if codegen is None else codegen
    if isinstance(block, LINEAR):
        return _Linear(block)
    if isinstance(block, GnssBlock):
        return _Gnss(block, compiled)
    if isinstance(block, ImuBlock):
        return _Imu(block, compiled)
    if isinstance(block, ZeroRotationBlock):
        return _ZeroRotation(block, compiled)
    if isinstance(block, StatePrior):
        return _Linear(block) if block.vehicle.mode == "motion" else _Start(block, compiled)
    if isinstance(block, EndsBlock) and type(block) in RECIPES:
        return _Ends(block, compiled)
    raise TypeError(f"{type(block).__name__} has no symbolic model")


def evaluate(block: Block, codegen: bool | None = None) -> None:
    """Set y and J of a block once; who evaluates it again keeps its `evaluator`."""
    evaluator(block, codegen).evaluate()


@dataclass(slots=True)
class _Linear(Evaluator):
    block: Block

    def evaluate(self) -> None:
        self.block.predict()


# ends


class _States:
    """States of one vehicle as `point.end_of` wants them."""

    def __init__(self, vehicle: VehicleVariables) -> None:
        self.vehicle = vehicle
        if vehicle.mode == "imu":
            frame = vehicle.frame
            self.gravity = Samples(linearised(point.gravity), len(vehicle.t_s))
            self.gravity.set({"centre": frame.rotate_from_ecef(frame.origin_ecef), "w_ie": frame.w_ie_n})

    def table(self) -> Array:
        """(K, 39) of a vehicle with IMU, (K, 6) without one, (K, 3) of a fixed one; at the current variables."""
        v = self.vehicle
        if v.mode == "fixed":
            return v.r
        if v.mode == "motion":
            return np.hstack([v.r, v.v])
        self.gravity.set({"r": v.r})
        pull = self.gravity.run()
        return np.hstack([v.R.reshape(-1, 9), v.r, v.v, v.bias, v.preintegrated_bias, pull["g"], pull["g_r"]])


@dataclass(slots=True)
class _EndInputs:
    """Inputs of one end of a model, by the end's name in it."""

    end: Endpoint
    name: str
    query: Query = field(init=False)
    stream: ImuStream | None = field(init=False)
    states: _States = field(init=False)

    def __post_init__(self) -> None:
        self.query, self.stream, self.states = self.end.query, self._stream(), _States(self.end.vehicle)

    def _stream(self) -> ImuStream | None:
        return self.end.vehicle.imu if self.end.vehicle.mode == "imu" else None

    @property
    def is_current(self) -> bool:
        """Whether the constant inputs are still those of the end."""
        return self.end.query is self.query and self._stream() is self.stream

    @property
    def shape(self) -> point.EndShape:
        end, mode = self.end, self.end.vehicle.mode
        offsets = len(end.offsets) + (end.vehicle.imu_offset is not None)
        if mode == "imu":
            return point.EndShape("near" if end.query.increments is None else "carried", end.lever is not None, offsets)
        return point.EndShape(mode, end.lever is not None, offsets)

    def constant(self) -> dict[str, Array]:
        """Inputs that stay while points do."""
        v, q = self.end.vehicle, self.query
        if v.mode != "imu":
            return {f"{self.name}_sample": q.dt_s}
        i = np.clip(np.searchsorted(v.imu.t_s, v.t_s[q.k] + q.dt_s), 0, len(v.imu.t_s) - 1)
        inputs = {
            f"{self.name}_sample": np.column_stack([q.dt_s, q.lever_b, v.imu.w_b[i], v.imu.f_b[i]]),
            f"{self.name}_earth": v.frame.w_ie_n,
        }
        if (inc := q.increments) is not None:
            parts = (inc.dR, inc.dv, inc.dp, inc.dR_dbg, inc.dv_dbg, inc.dv_dba, inc.dp_dbg, inc.dp_dba)
            inputs[f"{self.name}_increments"] = np.column_stack([part.reshape(len(q.k), -1) for part in parts])
        return inputs

    def current(self) -> dict[str, Array]:
        """Inputs at the current variables."""
        inputs = {f"{self.name}_state": self.states.table()[self.query.k]}
        if self.end.lever is not None:
            inputs[f"{self.name}_lever"] = self.end.lever.value
        if ahead := self.end.ahead():
            sign, late = np.array(ahead).T
            inputs |= {f"{self.name}_sign": sign, f"{self.name}_ahead": late}
        return inputs


# rows of ends


@dataclass(frozen=True, slots=True)
class _Recipe:
    """Which model a block has: options beside the shapes of its ends, and inputs beside theirs."""

    model: Model
    options: tuple[Hashable, ...]
    inputs: dict[str, Any]
    target: bool = False  # whether the model also sees something that is no end, in the second end's place


def _values(**parameters: Parameter | None) -> dict[str, Array]:
    return {name: p.value for name, p in parameters.items() if p is not None}


def _axes(m: Mounting) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(axes) for axes in m.axes)


def _mounted(m: Mounting) -> dict[str, Array]:
    return {f"mounting{i}": p.value for i, p in enumerate(m.parameters)}


def _range(b: RangeBlock) -> _Recipe:
    inputs = {"z": b.z_m, **_values(bias=b.bias, scale=b.scale)}
    if b.anchor_n is not None:
        inputs["anchor"] = b.anchor_n
    return _Recipe(ranging.point_range, (b.bias is not None, b.scale is not None), inputs, b.b is None)


def _position(b: PositionBlock) -> _Recipe:
    return _Recipe(ranging.position, (), {"z": b.z_n})


def _height(b: HeightBlock) -> _Recipe:
    return _Recipe(ranging.height, (b.bias is not None,), {"z": b.z_m, **_values(bias=b.bias)})


def _barometer(b: BarometerBlock) -> _Recipe:
    bias = b.nodes[0].value
    return _Recipe(ranging.barometer, (), {"z": b.z_m, "late": b.late, "before": bias[b.node], "after": bias[b.node + 1]})


def _fix_velocity(b: FixVelocityBlock) -> _Recipe:
    return _Recipe(sensors.fix_velocity, (), {"z": b.z_n})


def _velocity(b: VelocityBlock) -> _Recipe:
    inputs = {"z": b.z_b, **_values(scale=b.scale), **_mounted(b.mounting)}
    return _Recipe(sensors.odometer, (b.scale is not None, _axes(b.mounting)), inputs)


def _attitude(b: AttitudeBlock) -> _Recipe:
    return _Recipe(sensors.attitude, (_axes(b.mounting),), {"z": b.C_ns, **_mounted(b.mounting)})


def _heading(b: HeadingBlock) -> _Recipe:
    return _Recipe(sensors.heading, (_axes(b.mounting),), {"z": b.heading_rad, **_mounted(b.mounting)})


def _magnetic(b: MagneticBlock) -> _Recipe:
    inputs = {"z": b.m_b, "field": b.field_n, **_values(bias=b.bias), **_mounted(b.mounting)}
    return _Recipe(sensors.magnetometer, (b.bias is not None, _axes(b.mounting)), inputs)


def _vision(b: VisionBlock) -> _Recipe:
    inputs = {"z": b.z, **_mounted(b.mounting)}
    if b.landmark_n is not None:
        inputs["landmark"] = b.landmark_n
    return _Recipe(sensors.vision, (_axes(b.mounting),), inputs, b.landmark_n is not None)


def _non_holonomic(b: NonHolonomicBlock) -> _Recipe:
    return _Recipe(motion.travel, (_axes(b.mounting),), _mounted(b.mounting))


def _still(_: StillBlock) -> _Recipe:
    return _Recipe(motion.still, (), {})


RECIPES: dict[type[EndsBlock], Callable[[Any], _Recipe]] = {
    RangeBlock: _range,
    PositionBlock: _position,
    HeightBlock: _height,
    BarometerBlock: _barometer,
    FixVelocityBlock: _fix_velocity,
    VelocityBlock: _velocity,
    AttitudeBlock: _attitude,
    HeadingBlock: _heading,
    MagneticBlock: _magnetic,
    VisionBlock: _vision,
    NonHolonomicBlock: _non_holonomic,
    StillBlock: _still,
}


class _Ends(Evaluator):
    """Blocks whose rows are one model of their ends and parameters."""

    def __init__(self, block: EndsBlock, codegen: bool) -> None:
        self.block, self.codegen = block, codegen
        self._prepare()

    def _prepare(self) -> None:
        block = self.block
        self.ends = [_EndInputs(end, name) for end, name in zip(block.ends(), "ab", strict=False)]
        recipe = RECIPES[type(block)](block)
        shapes = [end.shape for end in self.ends]
        function = linearised(recipe.model, *shapes, *([None] if recipe.target else []), *recipe.options, codegen=self.codegen)
        n = len(self.ends[0].query.k)
        self.samples = Samples(function, n)
        for end in self.ends:
            self.samples.set(end.constant())
        outputs = [str(name) for name in function.name_out()]
        self.of_end = [f"e_{end.name}" for end in self.ends]
        self.of_parameter = [name for name in outputs if name != "e" and name not in self.of_end]

    def evaluate(self) -> None:
        if not all(end.is_current for end in self.ends):
            self._prepare()
        block = self.block
        self.samples.set(RECIPES[type(block)](block).inputs)
        for end in self.ends:
            self.samples.set(end.current())
        out = self.samples.run()
        components = out["e"].shape[1]
        rows: Any = slice(None)
        if isinstance(block, VectorBlock):
            rows = block.of_row * components + block.component

        def of(name: str) -> Array:
            return out[name].reshape(self.samples.n * components, -1)[rows] if name in out else np.zeros((block.n, 0))

        block.y = -out["e"].ravel()[rows]
        block.J = block.columns_of.join([of(name) for name in self.of_end], [of(name) for name in self.of_parameter])


# GNSS


class _GnssRows:
    """Rows of one kind, ranges or range rates: their predictions and what those change with the points."""

    def __init__(self, block: GnssBlock, rows: IntArray, is_rate: bool, codegen: bool) -> None:
        self.rows, self.at, self.size = rows, block.point_rover[rows], 6 if is_rate else 3
        differencing = "single" if block.reference is None else "difference" if block.place_n is None else "placed"
        model = gnss.doppler if is_rate else gnss.code_or_phase
        self.samples = Samples(linearised(model, differencing, codegen=codegen), len(rows))
        for name in ("rover", "reference"):
            sat = getattr(block, f"sat_{name}")[rows]
            self.samples.set({f"sat_{name}": np.hstack([sat, getattr(block, f"vel_{name}")[rows]]) if is_rate else sat})
        if block.place_n is not None:
            self.samples.set({"place": block.place_n[self.at]})

    def predict(self, points: dict[str, dict[str, Array]]) -> dict[str, Array]:
        """h (rows,) and h_rover, h_reference (rows, 3 or 6) by the points."""
        for name, p in points.items():
            self.samples.set({name: np.hstack([p["r"], p["v"]])[self.at, : self.size]})
        return self.samples.run()


class _Gnss(Evaluator):
    """Points once per epoch, then rows of ranges and of range rates."""

    def __init__(self, block: GnssBlock, codegen: bool) -> None:
        self.block, self.codegen = block, codegen
        self._prepare()

    def _prepare(self) -> None:
        block = self.block
        self.sat = (block.sat_rover, block.sat_reference, block.place_n, block.rows.kind)
        self.ends = {name: _EndInputs(end, "a") for name, end in zip(("rover", "reference"), block.ends(), strict=False)}
        self.points = {}
        for name, end in self.ends.items():
            self.points[name] = Samples(linearised(point.point, end.shape, codegen=self.codegen), len(end.query.k))
            self.points[name].set(end.constant())
        is_rate = block.rows.kind == DOPPLER
        parts = ((np.flatnonzero(~is_rate), False), (np.flatnonzero(is_rate), True))
        self.parts = [_GnssRows(block, rows, rate, self.codegen) for rows, rate in parts if len(rows)]

    def _is_current(self) -> bool:
        block = self.block
        now = (block.sat_rover, block.sat_reference, block.place_n, block.rows.kind)
        same = all(a is b for a, b in zip(self.sat, now, strict=True))
        return same and all(end.is_current for end in self.ends.values())

    def evaluate(self) -> None:
        if not self._is_current():
            self._prepare()
        block = self.block
        points = {}
        for name, samples in self.points.items():
            samples.set(self.ends[name].current())
            points[name] = samples.run()
        h, by_rover = np.empty(block.n), np.empty((block.n, 3))
        J = [np.zeros((block.n, end.end.width)) for end in self.ends.values()]
        for part in self.parts:
            out = part.predict(points)
            h[part.rows], by_rover[part.rows] = out["h"][:, 0], out["h_rover"][:, :3]
            for columns, (name, p) in zip(J, points.items(), strict=True):
                if columns.shape[1]:
                    _chain(out[f"h_{name}"], part.at, p["r_a"], p["v_a"], part.rows, columns)
        block.by_rover = by_rover
        block.y = block.z - h - _linear_terms(block)
        block.J = block.columns_of.join(J, [(block.bias_of == i)[:, None].astype(float) for i in range(len(block.biases))])


@njit(cache=True)
def _chain(by_point, at, of_r, of_v, rows, out):  # type: ignore[no-untyped-def]
    """out[rows] = by_point (n, 3 or 6) times the Jacobians of points `at`, of_r and of_v (m, 3 w), w columns."""
    w = out.shape[1]
    for i in range(len(at)):
        p, row = at[i], rows[i]
        for k in range(3):
            for c in range(w):
                out[row, c] += by_point[i, k] * of_r[p, k * w + c]
            if by_point.shape[1] == 6:
                for c in range(w):
                    out[row, c] += by_point[i, 3 + k] * of_v[p, k * w + c]


def _linear_terms(block: GnssBlock) -> Array:
    """What ambiguities, repaired slips, nodes and biases between groups add to predictions (n,)."""
    added = np.zeros(block.n)
    phase = np.flatnonzero(block.arc >= 0)
    cycles = block.amb_unit_cyc[block.arc[phase]] * block.amb_value[block.arc[phase]] + block.jump_cyc[phase]
    added[phase] = block.wavelength_m[phase] * cycles
    for nodes in block.nodes:
        np.add.at(added, nodes.row, nodes.scale * nodes.value[nodes.node])
    for i, bias in enumerate(block.biases):
        added[block.bias_of == i] += bias.value[0]
    return added


# between states


class _Imu(Evaluator):
    """Inertial intervals; the whitening is linear and joins outside."""

    def __init__(self, block: ImuBlock, codegen: bool) -> None:
        self.block, self.codegen = block, codegen
        self._prepare()

    def _prepare(self) -> None:
        block = self.block
        part, v = block.intervals, block.vehicle
        self.intervals = part
        n = len(part.dt_s)
        self.samples = Samples(linearised(inertial.imu_interval, bool(block.scales), codegen=self.codegen), n)
        self.samples.set(
            {
                "zeta": part.zeta,
                "by_bias": part.by_bias,
                "by_scale": part.by_scale,
                "bias_0": block.at_bias,
                "dt": part.dt_s,
                "g": block.gravitation_n,
                "w_ie": v.frame.w_ie_n,
            }
        )

    def evaluate(self) -> None:
        block, v = self.block, self.block.vehicle
        if block.intervals is not self.intervals:
            self._prepare()
        n = self.samples.n
        states = np.hstack([v.R.reshape(n + 1, 9), v.r, v.v, v.bias])
        change = v.imu_scale - v.applied_scale
        self.samples.set({"from": states[:-1], "to": states[1:], "scale": np.concatenate([change[3:], change[:3]])})
        out = self.samples.run()
        L = block.intervals.whitening
        parts = [out[name].reshape(n, 15, -1) for name in ("e_from", "e_to", "e_scale") if name in out]
        block.y = -np.matmul(L, out["e"][:, :, None]).ravel()
        block.J = np.matmul(L, np.concatenate(parts, axis=2)).reshape(block.n, -1)[:, block.kept]


class _ZeroRotation(Evaluator):
    """Attitudes at rest."""

    def __init__(self, block: ZeroRotationBlock, codegen: bool) -> None:
        self.block = block
        v = block.vehicle
        self.samples = Samples(linearised(motion.zero_rotation, codegen=codegen), len(block.first))
        self.samples.set({"dt": v.t_s[block.second] - v.t_s[block.first]})

    def evaluate(self) -> None:
        block, R = self.block, self.block.vehicle.R
        self.samples.set({"before": R[block.first], "after": R[block.second]})
        out = self.samples.run()
        block.y, block.J = -out["e"].ravel(), out["e_poses"].reshape(block.n, 12)


class _Start(Evaluator):
    """The first state of a vehicle with IMU."""

    def __init__(self, block: StatePrior, codegen: bool) -> None:
        self.block = block
        self.samples = Samples(linearised(motion.start, codegen=codegen), 1)

    def evaluate(self) -> None:
        block, v = self.block, self.block.vehicle
        state = np.concatenate([v.R[0].ravel(), v.r[0], v.v[0], v.bias[0]])
        self.samples.set({"state": state, "C_0": v.attitude_prior[0], "r_0": block.r, "v_0": block.v})
        out = self.samples.run()
        block.y, block.J = -out["e"].ravel(), out["e_state"].reshape(15, 15)
