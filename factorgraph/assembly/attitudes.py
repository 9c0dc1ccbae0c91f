"""Start attitudes of the vehicles with an IMU: alignment, and several starts compared where it leaves the heading open.

Alignment goes by velocities that a graph without IMUs found, good to a decimetre per second. What it leaves open, carrier
phase and ranges may tell: a short piece of the flight is solved from headings evenly spread, float ambiguities and all, and
the start whose cost is least is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factorgraph import alignment
from factorgraph.alignment import ALTERNATIVE, APART_RAD, HEADINGS, Alignment, Directions, align
from factorgraph.assembly import integers
from factorgraph.assembly.build import build
from factorgraph.assembly.engine import Engine
from factorgraph.assembly.optimizer import optimise
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import exp_so3, log_so3, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.measurements import AttitudeStream, MagneticStream, PositionStream
from factorgraph.models.compass import antenna_line
from factorgraph.models.receivers import Receiver
from factorgraph.problem import Constraints, NavigationProblem, Vehicle
from factorgraph.rest import inside, rest_spans
from factorgraph.solution import Status
from factorgraph.types import Array, BoolArray, IntArray

LEVER_MPS = 0.1  # velocity of an antenna about the body origin that is worth aligning again without it
PIECE_S = 40.0  # of the flight, in which starts are compared
AT_ONCE_S, BETWEEN_S = 0.02, 0.3  # fixes of two antennas are compared at one time, or between two that follow each other fast
RESTING = 0.8  # part of the piece at rest beyond which no motion tells a heading
SPREAD_RAD = 0.5  # standard deviation of a direction that is no use
STARTS_ITERATIONS, STARTS_TOLERANCE = 15, 1e-3


def start_attitudes(
    problem: NavigationProblem,
    vehicles: list[VehicleVariables],
    rough: list[VehicleVariables],
    rx: dict[str, Receiver],
    engine: Callable[[], Engine],
) -> list[str]:
    """Attitudes and biases into vehicles that already have positions and velocities of their antennas; returns notes.

    rough: the same vehicles without their IMUs, as the start graph left them.
    """
    notes = []
    for v in vehicles:
        if v.mode != "imu":
            continue
        found = _aligned(v, (*directions_of(v.vehicle), *_antenna_lines(problem, v, rx)))
        if not found.is_decided:
            found = _compared(problem, v, rough, rx, engine, found)
        v.attitude_prior = found.prior
        v.R, v.bias = found.C_nb, found.bias
        notes.append(f"{v.name}: {_told(found)}")
    return notes


def _told(found: Alignment) -> str:
    if not found.is_decided:
        return "nothing tells the heading at the start; level from the accelerometer"
    by = {"motion": "velocity changes", "starts compared": "the best of several starts"}.get(found.way, found.way)
    return f"start heading by {by}, to {np.degrees(found.sigma_rad[2]):.1f} deg"


def _aligned(v: VehicleVariables, given: tuple[Directions, ...]) -> Alignment:
    """Alignment of a vehicle; its positions and velocities become those of the body origin."""
    vehicle = v.vehicle
    heading = None if vehicle.heading_hint_rad is None else (vehicle.heading_hint_rad, vehicle.heading_sigma_rad)
    if vehicle.constraints.lateral_mps > 0:
        given = (*given, alignment.course(v.t_s, v.v, vehicle.constraints.lateral_mps))
    found = align(v.imu, v.t_s, v.r, v.v, v.frame, vehicle.imu_noise, heading, given)
    lever = _lever(vehicle)
    i = np.clip(np.searchsorted(v.imu.t_s, v.t_s), 0, len(v.imu.t_s) - 1)
    about = np.cross(v.imu.w_b[i] - found.bias[:, :3], lever)
    v.r = v.r - found.C_nb @ lever
    v.v = v.v - np.einsum("kij,kj->ki", found.C_nb, about)
    if found.is_decided and np.sqrt(np.mean(np.sum(about**2, axis=1))) > LEVER_MPS:
        found = align(v.imu, v.t_s, v.r, v.v, v.frame, vehicle.imu_noise, heading, given)
    return found


def _lever(vehicle: Vehicle) -> Array:
    """The point of the body (3,) that a graph without attitudes places."""
    if vehicle.gnss is not None:
        return np.asarray(vehicle.gnss.lever_b, float)
    levers = [p.lever_b for p in vehicle.positions]
    return np.mean(levers, axis=0) if levers else np.zeros(3)


# directions


def directions_of(vehicle: Vehicle) -> tuple[Directions, ...]:
    """Directions that a vehicle's attitude systems, magnetometers and pairs of position fixes tell."""
    found = [d for s in vehicle.attitudes if (d := _of_attitudes(s)) is not None]
    found += [d for s in vehicle.magnetics if (d := _of_magnetics(s)) is not None]
    fixes = vehicle.positions
    for i, a in enumerate(fixes):
        found += [d for b in fixes[i + 1 :] if (d := between_fixes(a, b)) is not None]
    return tuple(found)


def _of_attitudes(s: AttitudeStream) -> Directions | None:
    """The front and right axes as an attitude system gives them, where it tells a heading."""
    sigma = np.hypot(s.sigma_rad.max(axis=1), s.calibration.mounting_rad)
    ok = np.isfinite(s.sigma_rad[:, 2]) & np.all(np.isfinite(s.q_nb), axis=1)
    # a system of headings alone gives the front axis only, and roughly
    sigma = np.where(np.isfinite(sigma), sigma, np.hypot(s.sigma_rad[:, 2], SPREAD_RAD / 2))
    return _selected("attitude sensor", s.t_s, np.array([0.0, 1.0, 0.0]), matrix_from_quat(s.q_nb)[:, :, 1], sigma, ok)


def _of_magnetics(s: MagneticStream) -> Directions | None:
    field = np.asarray(s.field_n, float)
    strength = float(np.linalg.norm(field))
    ok = np.all(np.isfinite(s.m_b), axis=1) & (np.linalg.norm(s.m_b, axis=1) > 0)
    u_b = s.m_b / np.where(ok, np.linalg.norm(s.m_b, axis=1), 1.0)[:, None]
    sigma = np.hypot(s.sigma.max(axis=1), s.calibration.bias) / strength + s.calibration.mounting_rad
    # across a steep field its direction tells the heading only in part, which the solution's covariance counts for
    return _selected("magnetometer", s.t_s, u_b, np.tile(field / strength, (len(s.t_s), 1)), sigma, ok)


def between_fixes(a: PositionStream, b: PositionStream) -> Directions | None:
    """From one antenna to another on the same vehicle, where both have fixes at once or nearly so; None where they do not."""
    arm = np.asarray(b.lever_b, float) - np.asarray(a.lever_b, float)
    length = float(np.linalg.norm(arm))
    good = np.all(np.isfinite(b.r_n), axis=1)
    if length == 0 or np.count_nonzero(good) < 2:
        return None
    t, r = b.t_s[good], b.r_n[good]
    after = np.clip(np.searchsorted(t, a.t_s), 1, len(t) - 1)
    ahead, behind = t[after] - a.t_s, a.t_s - t[after - 1]
    between = (np.minimum(ahead, behind) >= 0) & (ahead + behind < BETWEEN_S)
    near = between | (np.minimum(np.abs(ahead), np.abs(behind)) < AT_ONCE_S)
    d = np.column_stack([np.interp(a.t_s, t, axis) for axis in r.T]) - a.r_n
    size = np.linalg.norm(d, axis=1)
    sigma = np.hypot(a.sigma_m.max(axis=1), np.interp(a.t_s, t, b.sigma_m[good].max(axis=1))) / length
    ok = near & np.isfinite(size) & (np.abs(size - length) < 3 * sigma * length)
    u_n = d / np.where(ok, size, 1.0)[:, None]
    return _selected("antennas", a.t_s, arm / length, u_n, sigma, ok)


def _antenna_lines(problem: NavigationProblem, v: VehicleVariables, rx: dict[str, Receiver]) -> list[Directions]:
    """Directions between a vehicle's antennas that links tie."""
    own = {u.name for u in problem.vehicles if v.name in (u.name, u.carrier) and u.name in rx}
    lines = [
        antenna_line(rx[link.reference], rx[link.rover], problem.frame, problem.settings.bands, v.t_s, v.r)
        for link in problem.links
        if {link.reference, link.rover} <= own
    ]
    return [line for line in lines if line is not None]


def _selected(way: alignment.Way, t_s: Array, u_b: Array, u_n: Array, sigma: Array, ok: BoolArray) -> Directions | None:
    ok = ok & (sigma < SPREAD_RAD)
    if not np.any(ok):
        return None
    return Directions(way, t_s[ok], np.broadcast_to(u_b, u_n.shape)[ok], u_n[ok], sigma[ok])


# several starts


@dataclass(frozen=True, slots=True)
class _Tried:
    R: Array  # (n, 3, 3)
    bias: Array  # (n, 6)
    cost: float
    converged: bool


def _compared(
    problem: NavigationProblem,
    v: VehicleVariables,
    rough: list[VehicleVariables],
    rx: dict[str, Receiver],
    engine: Callable[[], Engine],
    found: Alignment,
) -> Alignment:
    """The alignment turned to the best of several headings, if one stands out."""
    rows = _liveliest(v)
    t = v.t_s[rows]
    spans = rest_spans(v.imu, v.t_s, np.linalg.norm(v.v, axis=1))
    if len(rows) < 3 or np.mean(inside(spans, t, t)) > RESTING:
        return found
    try:
        tried = _tried(problem, v, rough, rx, engine, found, rows)
    except InputError:  # receivers of a link that share nothing in just this piece
        return found
    best = tried[0]
    others = [t for t in tried[1:] if np.linalg.norm(log_so3(t.R[0] @ best.R[0].T)) > APART_RAD]
    if not best.converged or any(t.cost - best.cost < ALTERNATIVE for t in others):
        return found
    turn = best.R[0] @ found.C_nb[rows[0]].T
    yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    sigma = np.array([found.sigma_rad[0], found.sigma_rad[1], alignment.DECIDED_RAD])
    C_nb = exp_so3(np.array([0.0, 0.0, yaw])) @ found.C_nb
    bias = found.bias.copy()
    bias[:] = best.bias[0]
    return Alignment(C_nb, bias, "starts compared", sigma, found.declared)


def _liveliest(v: VehicleVariables) -> IntArray:
    """States of the piece of the flight with the greatest changes of velocity."""
    t = v.t_s
    if t[-1] - t[0] <= PIECE_S:
        return np.arange(len(t))
    change = np.concatenate([[0.0], np.cumsum(np.sum(np.diff(v.v[:, :2], axis=0) ** 2, axis=1))])
    last = np.searchsorted(t, t + PIECE_S) - 1
    first = int(np.argmax(np.where(t <= t[-1] - PIECE_S, change[last] - change, -1.0)))
    return np.arange(first, last[first] + 1)


def _tried(
    problem: NavigationProblem,
    v: VehicleVariables,
    rough: list[VehicleVariables],
    rx: dict[str, Receiver],
    engine: Callable[[], Engine],
    found: Alignment,
    rows: IntArray,
) -> list[_Tried]:
    """Solutions of a piece of the flight from several headings, the best first; the other vehicles go without IMUs."""
    piece = replace(problem, visions=(), vehicles=tuple(u if u.name == v.name else _without_imu(u) for u in problem.vehicles))
    tried = []
    for heading in np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False):
        parts = [_part(v if r.index == v.index else r, rows) for r in rough]
        own = next(part for part in parts if part.index == v.index)
        own.R, own.bias = found.turned(heading)[rows], found.bias[rows]
        own.attitude_prior = (own.R[0], alignment.WIDEST_RAD)
        built = build(piece, parts, rx, use_phase=True, engine=engine())
        for data in built.links:
            integers.start_ambiguities(data)
        built.graph.assemble()
        result = optimise(built.graph, problem.settings.robust, STARTS_ITERATIONS, STARTS_TOLERANCE, lambda i, c: None)
        ended = result.status in (Status.CONVERGED, Status.MAX_ITERATIONS)
        tried.append(_Tried(own.R.copy(), own.bias.copy(), result.costs[-1], ended))
    return sorted(tried, key=lambda one: one.cost)


def _part(v: VehicleVariables, rows: IntArray) -> VehicleVariables:
    """A vehicle's variables of some states, at their current positions and velocities."""
    part = VehicleVariables(v.index, v.vehicle, v.t_s[rows], v.frame, use_imu=v.mode == "imu")
    part.r, part.v = v.r[rows].copy(), v.v[rows].copy()
    return part


def _without_imu(vehicle: Vehicle) -> Vehicle:
    return replace(vehicle, imu=None, velocities=(), attitudes=(), magnetics=(), constraints=Constraints())
