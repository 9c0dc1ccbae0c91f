"""Trajectories: waypoints, manoeuvres, formation flight, standstill, and kinematic flight over the ellipsoid.

Most descriptions of a motion are sampled every `NODE_S` and become two quintic splines, one of the position in n and one
of pitch, roll and heading. Both are four times continuously differentiable, so specific force and rates are smooth, and
the trajectory can be evaluated at any time, which measurements with odd time stamps need.

Attitude follows the motion. Heading is along the track and pitch is the climb angle; `coordinated` banks so that no
specific force acts sideways, tan(roll) = a_right / (g + a_up); `level` keeps the wings level, like a car.

In `kinematic` flight it is the other way round: speed along the front axis and Euler angles against the level at the
place itself are given, piecewise linear in time, and the position follows on the WGS-84 ellipsoid,

    dL/dt = v_N / (M + h),   dlambda/dt = v_E / ((N + h) cos L),   dh/dt = v_U

Nothing is blended: acceleration and rates step where segments meet, which are best put at sampling instants of the IMU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal, Protocol

import numpy as np
from pydantic import Field, PositiveFloat
from scipy.integrate import OdeSolution, solve_ivp
from scipy.interpolate import BSpline, make_interp_spline

from factorgraph import geodesy
from factorgraph.attitude import euler_from_matrix, matrix_from_euler, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import Truth
from factorgraph.problem import Vec3
from factorgraph.types import Array
from scenarios.flights.schema import Table

NODE_S = 0.1
MARGIN_S = 2.0  # before the start and after the end, for receivers whose clocks are off
STANDARD_GRAVITY = 9.80665
SLOW_MPS = 0.5  # below, the track does not tell the heading
TURN_SMOOTHING_S = 2.0  # of headings found around a standstill
ODE_STEP_S = 5.0  # largest, of an eighth-order method: rounding only
ODE_TOLERANCE_M = 1e-9
BLENDS = 3  # passes of the moving average that blends manoeuvres: the profiles become twice differentiable

Follow = Literal["coordinated", "level"]


class Waypoint(Table):
    t_s: float
    r_n: Vec3


class Waypoints(Table):
    """Through given points at given times; starts and ends without acceleration."""

    kind: Literal["waypoints"]
    points: tuple[Waypoint, ...] = Field(min_length=2)
    attitude: Follow = "coordinated"
    heading_deg: float = 0.0  # of a vehicle that never moves


class Segment(Table):
    """A manoeuvre; what is not given stays as it is."""

    duration_s: PositiveFloat
    accel_mps2: float = 0.0  # along the track
    climb_mps: float = 0.0
    turn_dps: float = 0.0  # positive to the right
    bank_deg: float = Field(default=0.0, gt=-80, lt=80)  # turns as this bank does, in addition


class Manoeuvres(Table):
    """A table of manoeuvres, blended over `blend_s`, repeated until the end where `repeat` says so."""

    kind: Literal["manoeuvres"]
    start_n: Vec3 = (0.0, 0.0, 0.0)
    speed_mps: float = Field(default=0.0, ge=0)
    heading_deg: float = 0.0
    segments: tuple[Segment, ...] = Field(min_length=1)
    repeat: bool = False
    blend_s: float = Field(default=4.0, ge=4 * NODE_S)
    attitude: Follow = "coordinated"
    sway_m: float = Field(default=0.0, ge=0)  # wandering about the table's track
    sway_s: PositiveFloat = 30.0


class OffsetAt(Table):
    t_s: float
    offset_m: Vec3


class Wave(Table):
    """A sine about the offset, sin(2 pi t / period + phase)."""

    size_m: Vec3  # amplitudes
    period_s: PositiveFloat
    phase_deg: float = 0.0


class Push(Table):
    """A constant acceleration away from the place in the formation, and smoothly back to it within `back_s`."""

    t_s: float
    duration_s: PositiveFloat
    accel_mps2: Vec3
    back_s: PositiveFloat = 25.0
    blend_s: float = Field(default=0.6, ge=4 * NODE_S)


class Formation(Table):
    """At an offset (right, front, up) from another vehicle, constant or moving between `offsets` in straight, blended legs.

    Waves and pushes, in the same axes, come on top of it.
    """

    kind: Literal["formation"]
    leader: str
    frame: Literal["track", "body"] = "track"  # track: level, along the leader's heading
    offset_m: Vec3 | None = None
    offsets: tuple[OffsetAt, ...] = ()
    blend_s: float = Field(default=6.0, ge=4 * NODE_S)
    waves: tuple[Wave, ...] = ()
    pushes: tuple[Push, ...] = ()
    attitude: Follow = "coordinated"
    sway_m: float = Field(default=0.0, ge=0)
    sway_s: PositiveFloat = 30.0


class Static(Table):
    """At rest on the Earth."""

    kind: Literal["static"]
    r_n: Vec3 = (0.0, 0.0, 0.0)
    heading_deg: float = 0.0


class Hover(Table):
    """A multicopter that wanders about a place, its rotors' thrust along its up axis, pointing where it likes."""

    kind: Literal["hover"]
    r_n: Vec3 = (0.0, 0.0, 0.0)
    heading_deg: float = 0.0
    turn_deg: float = Field(default=0.0, ge=0)  # wandering of the heading, rms
    sway_m: float = Field(default=1.0, gt=0)
    sway_s: PositiveFloat = 15.0


class Carried(Table):
    """No motion of its own: a further antenna of a vehicle."""

    kind: Literal["carried"]
    carrier: str


class Rates(Table):
    """Acceleration along the front axis and rates of the Euler angles; what is not given stays as it is."""

    duration_s: PositiveFloat
    accel_mps2: float = 0.0
    roll_dps: float = 0.0  # right wing down
    pitch_dps: float = 0.0  # nose up
    yaw_dps: float = 0.0  # to the right


class Kinematic(Table):
    """Flight along the front axis; angles against the level at the place itself, whatever forces that takes."""

    kind: Literal["kinematic"]
    lat_deg: float = Field(gt=-90, lt=90)  # at the start, like all below
    lon_deg: float = Field(ge=-360, le=360)
    h_m: float  # above the ellipsoid
    heading_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    speed_mps: float = Field(ge=0)
    segments: tuple[Rates, ...] = Field(min_length=1)


AnyTable = Waypoints | Manoeuvres | Formation | Static | Hover | Carried | Kinematic
TrajectoryTable = Annotated[AnyTable, Field(discriminator="kind")]


@dataclass(frozen=True, slots=True)
class Motion:
    """Position, velocity, attitude of the body origin at some times, and the rate of the body against n."""

    r_n: Array  # (n, 3)
    v_n: Array  # (n, 3)
    C_nb: Array  # (n, 3, 3)
    w_nb_b: Array  # (n, 3)

    def point(self, lever_b: Vec3) -> tuple[Array, Array]:
        """Position and velocity (n, 3) of a point of the body."""
        lever = np.asarray(lever_b, float)
        return self.r_n + self.C_nb @ lever, self.v_n + np.einsum("nij,nj->ni", self.C_nb, np.cross(self.w_nb_b, lever))


class Trajectory(Protocol):
    """A motion that is known at any time of the flight and a little before and after."""

    def at(self, t_s: Array) -> Motion:
        """The motion at times (n,)."""

    def euler(self, t_s: Array) -> Array:
        """Pitch, roll and heading in n (n, 3); the heading continuous, without jumps of 2 pi."""


def truth(trajectory: Trajectory, t_s: Array) -> Truth:
    """The reference at times (n,)."""
    motion = trajectory.at(t_s)
    return Truth(t_s, motion.r_n, motion.v_n, quat_from_matrix(motion.C_nb))


@dataclass(frozen=True, slots=True)
class SplineTrajectory:
    """Quintic splines of position in n and of pitch, roll and heading."""

    position: BSpline
    angles: BSpline

    def at(self, t_s: Array) -> Motion:
        """The motion at times (n,)."""
        r, v, euler, rate = (np.asarray(s(t_s, nu)) for s in (self.position, self.angles) for nu in (0, 1))
        return Motion(r, v, matrix_from_euler(*euler.T), _body_rate(euler, rate))

    def euler(self, t_s: Array) -> Array:
        """Pitch, roll and heading (n, 3)."""
        return np.asarray(self.angles(t_s))


@dataclass(frozen=True, slots=True)
class KinematicTrajectory:
    """Speed and Euler angles against the local level, linear between nodes and held beyond them, and the way they lead."""

    frame: LocalFrame
    start: tuple[float, float, float]  # latitude, longitude, height
    nodes: Array  # (k,) [s]
    speed: Array  # (k,)
    angles: Array  # (k, 3) pitch, roll, heading against the local level
    moved: OdeSolution  # what `_geodetic` adds to the start

    def at(self, t_s: Array) -> Motion:
        """The motion at times (n,)."""
        lat, lon, h = _geodetic(self.start, np.asarray(self.moved(t_s)))
        r = self.frame.from_ecef(geodesy.ecef_from_geodetic(lat, lon, h))
        C_nl = np.swapaxes(self.frame.C_to_enu(r), 1, 2)
        euler, rate = self._level(t_s)
        C_lb = matrix_from_euler(*euler.T)
        v = np.interp(t_s, self.nodes, self.speed)[:, None] * C_lb[:, :, 1]
        M, N = _radii(lat)
        w_nl = np.column_stack([-v[:, 1] / (M + h), v[:, 0] / (N + h), v[:, 0] * np.tan(lat) / (N + h)])
        w = _body_rate(euler, rate) + np.einsum("nji,nj->ni", C_lb, w_nl)
        return Motion(r, np.einsum("nij,nj->ni", C_nl, v), C_nl @ C_lb, w)

    def euler(self, t_s: Array) -> Array:
        """Pitch, roll and heading in n (n, 3)."""
        level = self._level(t_s)[0][:, 2]
        pitch, roll, heading = euler_from_matrix(self.at(t_s).C_nb)
        return np.column_stack([pitch, roll, level + np.mod(heading - level + np.pi, 2 * np.pi) - np.pi])

    def _level(self, t_s: Array) -> tuple[Array, Array]:
        """Angles against the local level and their rates (n, 3)."""
        euler = np.column_stack([np.interp(t_s, self.nodes, angle) for angle in self.angles.T])
        slope = np.diff(self.angles, axis=0) / np.diff(self.nodes)[:, None]
        held = np.zeros((1, 3))
        return euler, np.concatenate([held, slope, held])[np.searchsorted(self.nodes, t_s, side="right")]


def _body_rate(euler: Array, rate: Array) -> Array:
    """Rate (n, 3) of the body in its own axes, from pitch, roll and heading and their rates (n, 3)."""
    (th, ga, _), (dth, dga, dpsi) = euler.T, rate.T
    # about the heading, then the pitch, then the roll axis, turned into the body
    up = -dpsi * np.cos(th)
    return np.stack([np.cos(ga) * dth - np.sin(ga) * up, dga - dpsi * np.sin(th), np.sin(ga) * dth + np.cos(ga) * up], axis=-1)


def build(
    tables: dict[str, TrajectoryTable], duration_s: float, rngs: dict[str, np.random.Generator], frame: LocalFrame
) -> dict[str, Trajectory]:
    """Trajectories of all vehicles by name, in `frame`, leaders before their followers.

    rngs: one generator per vehicle, for what wanders. Raises InputError for unknown leaders and for circles of followers.
    """
    nodes = np.arange(-MARGIN_S, duration_s + MARGIN_S + NODE_S, NODE_S)
    done: dict[str, Trajectory] = {}
    left = dict(tables)
    while left:
        ready = [name for name, table in left.items() if (needed := _needed(table)) is None or needed in done]
        for name in ready:
            table = left.pop(name)
            if isinstance(table, Carried):
                done[name] = done[table.carrier]
            elif isinstance(table, Kinematic):
                done[name] = _kinematic(name, table, duration_s, frame)
            else:
                done[name] = _splined(name, table, nodes, duration_s, rngs[name], done)
        if not ready:
            name, needed = next((n, _needed(t)) for n, t in left.items())
            reason = "follows itself in a circle" if needed in tables else f"there are {', '.join(tables)}"
            raise InputError(f"vehicle {name}: cannot follow {needed}: {reason}")
    return {name: done[name] for name in tables}


def _needed(table: TrajectoryTable) -> str | None:
    """The vehicle whose trajectory another follows from."""
    return table.leader if isinstance(table, Formation) else table.carrier if isinstance(table, Carried) else None


def _splined(
    name: str,
    table: Waypoints | Manoeuvres | Formation | Static | Hover,
    nodes: Array,
    duration_s: float,
    rng: np.random.Generator,
    done: dict[str, Trajectory],
) -> SplineTrajectory:
    heading = None
    if isinstance(table, Hover):
        return _hovering(table, nodes, rng)
    if isinstance(table, Static):
        r, heading, follow = np.tile(table.r_n, (len(nodes), 1)), np.full(len(nodes), np.deg2rad(table.heading_deg)), "level"
    elif isinstance(table, Waypoints):
        times = [p.t_s for p in table.points]
        if times[0] > 0 or times[-1] < duration_s:
            span = f"{times[0]:g} to {times[-1]:g} s"
            raise InputError(f"vehicle {name}: its waypoints span {span}, not the flight's 0 to {duration_s:g} s")
        r, follow = _through(name, times, [p.r_n for p in table.points], nodes), table.attitude
        if np.linalg.norm(np.ptp(r, axis=0)) < SLOW_MPS * NODE_S:
            heading = np.full(len(nodes), np.deg2rad(table.heading_deg))
    elif isinstance(table, Manoeuvres):
        r, heading = _manoeuvred(name, table, nodes, duration_s)
        follow = table.attitude
        if table.sway_m > 0:
            r, heading = r + _sway(table.sway_m, table.sway_s, nodes, rng), None
    else:
        r, follow = _following(name, table, nodes, rng, done[table.leader]), table.attitude
    return _with_attitude(name, nodes, r, follow == "coordinated", heading)


def _with_attitude(name: str, nodes: Array, r: Array, banks: bool, heading: Array | None) -> SplineTrajectory:
    position = make_interp_spline(nodes, r, k=5)
    v, a = position(nodes, 1), position(nodes, 2)
    if heading is None:
        heading = _heading_along(name, v)
    right = np.column_stack([np.cos(heading), -np.sin(heading)])
    pitch = np.arctan2(v[:, 2], np.hypot(np.hypot(v[:, 0], v[:, 1]), SLOW_MPS))
    roll = np.arctan2(np.sum(a[:, :2] * right, axis=1), STANDARD_GRAVITY + a[:, 2]) if banks else np.zeros(len(nodes))
    return SplineTrajectory(position, make_interp_spline(nodes, np.column_stack([pitch, roll, heading]), k=5))


def _hovering(table: Hover, nodes: Array, rng: np.random.Generator) -> SplineTrajectory:
    position = make_interp_spline(nodes, table.r_n + _sway(table.sway_m, table.sway_s, nodes, rng), k=5)
    turn = np.deg2rad(table.turn_deg) * np.sqrt(3 / 2) * _sway(1.0, 2 * table.sway_s, nodes, rng)[:, 0]
    heading = np.deg2rad(table.heading_deg) + turn
    f = position(nodes, 2) + [0.0, 0.0, STANDARD_GRAVITY]
    right = f[:, 0] * np.cos(heading) - f[:, 1] * np.sin(heading)
    front = f[:, 0] * np.sin(heading) + f[:, 1] * np.cos(heading)
    pitch, roll = np.arctan2(-front, f[:, 2]), np.arctan2(right, np.hypot(front, f[:, 2]))
    return SplineTrajectory(position, make_interp_spline(nodes, np.column_stack([pitch, roll, heading]), k=5))


def _heading_along(name: str, v: Array) -> Array:
    """Continuous heading (n,) of velocities; held and blended across standstills."""
    moving = np.hypot(v[:, 0], v[:, 1]) > SLOW_MPS
    if not np.any(moving):
        raise InputError(f"vehicle {name} never moves faster than {SLOW_MPS} m/s: describe it as static or by manoeuvres")
    heading = np.interp(np.arange(len(v)), np.flatnonzero(moving), np.unwrap(np.arctan2(v[moving, 0], v[moving, 1])))
    return heading if np.all(moving) else _blended(heading, TURN_SMOOTHING_S)


def _blended(x: Array, width_s: float) -> Array:
    """Moving averages over `width_s` in all; ends held."""
    n = max(1, round(width_s / BLENDS / NODE_S)) | 1
    for _ in range(BLENDS):
        x = np.convolve(np.concatenate([np.full(n // 2, x[0]), x, np.full(n // 2, x[-1])]), np.full(n, 1 / n), mode="valid")
    return x


def _through(name: str, t_s: Sequence[float], x: Sequence[Vec3], nodes: Array) -> Array:
    """Quintic spline through points, its second and third derivative zero at the ends; straight on beyond them."""
    t = _increasing(name, t_s)
    free = [(2, np.zeros(3)), (3, np.zeros(3))]
    spline = make_interp_spline(t, np.asarray(x, float), k=5, bc_type=(free, free))
    inside = np.clip(nodes, t[0], t[-1])
    return np.asarray(spline(inside) + (nodes - inside)[:, None] * spline(inside, 1))


def _increasing(name: str, t_s: Sequence[float]) -> Array:
    t = np.asarray(t_s, float)
    if np.any(np.diff(t) <= 0):
        raise InputError(f"vehicle {name}: times of points must increase, got {', '.join(f'{v:g}' for v in t)}")
    return t


def _manoeuvred(name: str, table: Manoeuvres, nodes: Array, duration_s: float) -> tuple[Array, Array]:
    """Position (n, 3) and heading (n,) by integrating blended profiles of acceleration, turn and climb."""
    length = sum(s.duration_s for s in table.segments)
    if length < duration_s and not table.repeat:
        raise InputError(f"vehicle {name}: its manoeuvres last {length:g} of {duration_s:g} s; add some or set repeat = true")
    ends = np.cumsum([s.duration_s for s in table.segments])
    t = np.maximum(nodes, 0.0)
    which = np.minimum(np.searchsorted(ends, np.mod(t, length) if table.repeat else t, side="right"), len(ends) - 1)

    def profile(values: list[float]) -> Array:
        return _blended(np.array(values)[which], table.blend_s)

    accel, climb, turn, bank = (
        profile([getattr(s, key) * factor for s in table.segments])
        for key, factor in (("accel_mps2", 1.0), ("climb_mps", 1.0), ("turn_dps", np.pi / 180), ("bank_deg", np.pi / 180))
    )
    speed = table.speed_mps + _integral(accel, nodes)
    _check_forward(name, nodes, speed)
    speed = np.maximum(speed, 0.0)
    if np.any(bank != 0):
        turn = turn + STANDARD_GRAVITY * np.tan(bank) / np.maximum(speed, 1.0)
    heading = np.deg2rad(table.heading_deg) + _integral(turn, nodes)
    level = speed[:, None] * np.column_stack([np.sin(heading), np.cos(heading)])
    r = np.column_stack([_integral(level[:, 0], nodes), _integral(level[:, 1], nodes), _integral(climb, nodes)])
    return table.start_n + r, heading


def _check_forward(name: str, t_s: Array, speed: Array) -> None:
    if speed.min() < -0.01:
        at = t_s[int(np.argmin(speed))]
        raise InputError(f"vehicle {name}: its manoeuvres slow it down to {speed.min():.1f} m/s at {at:.0f} s")


def _kinematic(name: str, table: Kinematic, duration_s: float, frame: LocalFrame) -> KinematicTrajectory:
    steps = np.array([s.duration_s for s in table.segments])
    if steps.sum() < duration_s:
        raise InputError(f"vehicle {name}: its segments last {steps.sum():g} of {duration_s:g} s; add some")
    nodes = np.concatenate([[0.0], np.cumsum(steps)])
    rates = np.array([(s.accel_mps2, s.pitch_dps, s.roll_dps, s.yaw_dps) for s in table.segments])
    first = np.array([table.speed_mps, table.pitch_deg, table.roll_deg, table.heading_deg])
    values = first + np.vstack([np.zeros(4), np.cumsum(rates * steps[:, None], axis=0)])
    speed, angles = values[:, 0], np.deg2rad(values[:, 1:])
    _check_forward(name, nodes, speed)
    start = (float(np.deg2rad(table.lat_deg)), float(np.deg2rad(table.lon_deg)), table.h_m)
    return KinematicTrajectory(frame, start, nodes, speed, angles, _integrated(start, nodes, speed, angles, duration_s))


def _integrated(start: tuple[float, float, float], nodes: Array, speed: Array, angles: Array, duration_s: float) -> OdeSolution:
    """Scaled changes of latitude, longitude and height, piece by piece so that no step crosses a kink."""

    def rate(t: float, moved: Array) -> list[float]:
        pitch, _, heading = (np.interp(t, nodes, angle) for angle in angles.T)
        v, (lat, _, h) = np.interp(t, nodes, speed), _geodetic(start, moved)
        M, N = _radii(lat)
        level = v * np.cos(pitch)
        north = level * np.cos(heading) / (M + h)
        east = level * np.sin(heading) / ((N + h) * np.cos(lat))
        return [geodesy.A_M * north, geodesy.A_M * east, v * np.sin(pitch)]

    def solved(begin: float, end: float, moved: Array) -> OdeSolution:
        options = {"method": "DOP853", "max_step": ODE_STEP_S, "rtol": 1e-12, "atol": ODE_TOLERANCE_M, "dense_output": True}
        return solve_ivp(rate, (begin, end), moved, **options).sol

    ends = np.unique(np.append(nodes[nodes < duration_s], duration_s + MARGIN_S))
    before = solved(0.0, -MARGIN_S, np.zeros(3))
    times, pieces, moved = before.ts[::-1], before.interpolants[::-1], np.zeros(3)
    for begin, end in pairwise(ends.tolist()):
        piece = solved(begin, end, moved)
        times, pieces, moved = np.concatenate([times, piece.ts[1:]]), pieces + piece.interpolants, piece(end)
    return OdeSolution(times, pieces)


def _geodetic(start: tuple[float, float, float], moved: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude and height of changes (3, ...) in metres, angles times the equator's radius."""
    return start[0] + moved[0] / geodesy.A_M, start[1] + moved[1] / geodesy.A_M, start[2] + moved[2]


def _radii(lat: Array) -> tuple[Array, Array]:
    """Radii of curvature along the meridian and across it."""
    w2 = 1 - geodesy.E2 * np.sin(lat) ** 2
    return geodesy.A_M * (1 - geodesy.E2) / w2**1.5, geodesy.A_M / np.sqrt(w2)


def _integral(x: Array, nodes: Array) -> Array:
    """Trapezoidal integral (n,), zero at t = 0."""
    total = np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(nodes))])
    return np.asarray(total - np.interp(0.0, nodes, total))


def _sway(size_m: float, period_s: float, nodes: Array, rng: np.random.Generator) -> Array:
    """Three sines per axis (n, 3) of rms `size_m` horizontally and a third of it vertically."""
    phase, spread = rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(0.7, 1.6, (3, 3))
    waves = np.sin(2 * np.pi * nodes[:, None, None] / (period_s * spread) + phase)
    return np.asarray(size_m * np.sqrt(2 / 3) * waves.sum(axis=1) * [1.0, 1.0, 1 / 3])


def _following(name: str, table: Formation, nodes: Array, rng: np.random.Generator, leader: Trajectory) -> Array:
    if (table.offset_m is None) == (not table.offsets):
        raise InputError(f"vehicle {name}: give either offset_m or offsets (two or more, with times)")
    if table.offset_m is not None:
        offset = np.tile(table.offset_m, (len(nodes), 1))
    elif len(table.offsets) < 2:
        raise InputError(f"vehicle {name}: one offset needs no time: write offset_m")
    else:
        t = _increasing(name, [o.t_s for o in table.offsets])
        at = np.array([o.offset_m for o in table.offsets])
        offset = np.column_stack([_blended(np.interp(nodes, t, axis), table.blend_s) for axis in at.T])
    offset = offset + _sway(table.sway_m, table.sway_s, nodes, rng)
    for wave in table.waves:
        phase = 2 * np.pi * nodes / wave.period_s + np.deg2rad(wave.phase_deg)
        offset = offset + np.sin(phase)[:, None] * wave.size_m
    for push in table.pushes:
        offset = offset + _pushed(push, nodes)[:, None] * push.accel_mps2
    motion = leader.at(nodes)
    C = motion.C_nb
    if table.frame == "track":
        heading = leader.euler(nodes)[:, 2]
        C = matrix_from_euler(np.zeros(len(nodes)), np.zeros(len(nodes)), heading)
    return np.asarray(motion.r_n + np.einsum("nij,nj->ni", C, offset))


def _pushed(push: Push, nodes: Array) -> Array:
    """Way (n,) under a push of unit acceleration: t^2 / 2, then the quintic that ends at rest where the push began."""
    duration, back = push.duration_s, push.back_s
    gone, t = np.array([duration**2 / 2, duration * back, 0.0]), nodes - push.t_s  # way and speed, in times of `back`
    ends = np.array([[1.0, 1.0, 1.0], [3.0, 4.0, 5.0], [6.0, 12.0, 20.0]])  # of u^3, u^4, u^5 and their derivatives at 1
    high = np.linalg.solve(ends, -np.array([gone[0] + gone[1], gone[1], 0.0]))
    u = np.clip((t - duration) / back, 0.0, 1.0)
    way = np.where(t < duration, np.clip(t, 0.0, duration) ** 2 / 2, np.polyval([*high[::-1], *gone[::-1]], u))
    return _blended(way, push.blend_s)
