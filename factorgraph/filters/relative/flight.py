"""The relative filter on a navigation problem: which vehicle is the reference, what is measured when, and the run.

    vehicles    attitude and specific force at the rate of the IMU, and a position and velocity of each one's own (`OwnMotion`)
    epochs      times of GNSS, ranges and heights, and between them so that no step is longer than LONGEST_STEP_S
    rows        double differences against the reference, absolute differences, ranges, heights

The reference is the vehicle or base station that most links touch, of those the first. All followers with a receiver are
differenced against it, whatever ends their links have: pairs are differences of followers. Where that fails, and without links, a
follower has absolute differences instead, which then say nothing twice. Without links the reference is the first vehicle; where
anchors are heard, the ground at the origin of n. What the filter is told is the problem's: noise of receivers, IMUs and ranges.
Scales and biases that the problem lets ranges have are constants of the filter where asked (`Configuration.calibrate_ranges`);
the source estimates neither.

`prepare` does what all configurations share, `Formation.run` filters. Source: Lu et al. (2024); spec ahrs_tdo.md, sections 1,
2.7 and 2.8.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError, positive
from factorgraph.filters.relative import filtering
from factorgraph.filters.relative.filtering import Correct, Form, Options, RelativeTrack, Update
from factorgraph.filters.relative.motion import (
    PERFECT,
    AccelModel,
    AttitudeReferenced,
    Increments,
    Motion,
    Mover,
    Smooth,
)
from factorgraph.filters.relative.rows import (
    KINDS,
    MATCH_S,
    AbsoluteDifferences,
    CodeAndRate,
    Distances,
    HeightRow,
    Heights,
    PairNoise,
    Places,
    RangeRow,
    Source,
    arms,
    epoch_of,
    epochs_of,
    measured_at,
)
from factorgraph.filters.relative.start import placed, rest_until
from factorgraph.geodesy import LocalFrame
from factorgraph.grid import subdivided
from factorgraph.measurements import Tag
from factorgraph.models.double_differences import PairEpochs, pair_epochs
from factorgraph.models.receivers import Receiver
from factorgraph.problem import NavigationProblem, RangeModel
from factorgraph.sampling import interpolate
from factorgraph.types import Array

GROUND = "the ground"  # as a reference
LONGEST_STEP_S = 1.0
START_SIGMA = (100.0, 10.0)  # m, m/s of a start without any position


@dataclass(frozen=True, slots=True)
class OwnTrack:
    """Where a vehicle's own filter has it, at its epochs."""

    t_s: Array  # (K,)
    r_n: Array  # (K, 3) of the body
    v_n: Array  # (K, 3)
    P: Array  # (K, 6, 6)


@dataclass(frozen=True, slots=True)
class OwnMotion:
    """What a vehicle tells of itself: sample k holds from edges[k] to edges[k + 1]."""

    edges: Array  # (n + 1,)
    f_b: Array  # (n, 3) mean specific force, calibrated
    w_b: Array  # (n, 3) mean inertial rate, calibrated
    C_nb: Array  # (n, 3, 3) at the middle of the sample
    model: AccelModel
    track: OwnTrack | None  # None: without absolute position


@dataclass(frozen=True, slots=True)
class Configuration:
    """One relative filter. Source: spec ahrs_tdo.md, section 2.8."""

    motion: Literal["attitude", "velocity", "acceleration"] = "attitude"
    walk: float = 1.0  # of constant velocity [m/s per sqrt(s)] or acceleration [m/s^2 per sqrt(s)]
    coloured: bool = False  # attitude errors are states with a correlation time, not white noise
    kinds: tuple[str, ...] = KINDS  # measurements used
    absolute_factor: float = 4.0  # on the covariance of absolute differences, which share their code with double differences
    range_scale: float = 1.0  # of the crystal, where it is known
    calibrate_ranges: bool = False  # estimate the scales and biases that the problem says ranges may have
    strong_tracking: bool = False
    update: Form = "linear"
    robust: bool = False  # ranges and heights weighed with the problem's losses

    def __post_init__(self) -> None:
        positive(self, "walk", "absolute_factor", "range_scale")
        unknown = sorted(set(self.kinds) - set(KINDS))
        if unknown:
            raise InputError(f"no measurements called {unknown[0]}; there are {', '.join(KINDS)}")


@dataclass(frozen=True, slots=True)
class Formation:
    """A flight ready for relative filters."""

    problem: NavigationProblem
    names: tuple[str, ...]  # the reference first
    t_s: Array  # (K,) epochs
    movers: tuple[Mover, ...]
    places: Places
    own: tuple[OwnTrack | None, ...]
    absolute: tuple[Array, Array, Array]  # (N, K, 3), (N, K, 3), (N, K, 6, 6), ECEF; NaN where unknown
    links: dict[int, PairEpochs]  # by follower
    noise: dict[int, PairNoise]
    ranges: dict[int, list[RangeRow]]  # by epoch
    constants: tuple[float, ...]  # of ranges: prior standard deviations of scales and biases
    heights: dict[int, list[HeightRow]]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]  # what makes its solutions degraded
    # of the movers between the epochs, attitude errors white or coloured, once a configuration has asked for them
    increments: dict[bool, list[Increments]] = field(default_factory=dict, init=False)

    def run(
        self, configuration: Configuration, correct: Correct | None = None, observe: Callable[[int, Update], None] | None = None
    ) -> RelativeTrack:
        """Filter the flight."""
        moving = self._motion(configuration)
        constants = self.constants if configuration.calibrate_ranges else ()
        sources = self._sources(configuration, moving.size + len(constants))
        losses = self.problem.settings.robust if configuration.robust else {}
        options = Options(correct, configuration.update, losses, configuration.strong_tracking, constants, observe)
        return filtering.run(moving, sources, self.t_s, self._start(), options)

    def _motion(self, c: Configuration) -> Motion:
        if c.motion == "attitude":
            known = self.increments.get(c.coloured)
            moving = AttitudeReferenced(self.movers, self.t_s, self.places.reference_e, c.coloured, known)
            self.increments[c.coloured] = moving.increments
            return moving
        return Smooth(c.motion, len(self.names) - 1, self.t_s, c.walk)

    def _sources(self, c: Configuration, n: int) -> list[Source]:
        """Sources in the order of the publication's rows: double differences, absolute differences, ranges."""
        sources: list[Source] = []
        if self.links and {"code", "doppler"} & set(c.kinds):
            sources.append(CodeAndRate(self.links, self.noise, self.places, self.problem.frame, self.t_s, self.names, n, c.kinds))
        alone = [i for i in range(len(self.names) - 1) if i not in self.links]
        if "position" in c.kinds:
            sources.append(AbsoluteDifferences(*self.absolute, self.names, n, c.absolute_factor))
        elif alone:
            sources.append(AbsoluteDifferences(*self.absolute, self.names, n, 1.0, alone))
        if "range" in c.kinds:
            first = n - len(self.constants) if c.calibrate_ranges else None
            sources.append(Distances(self.ranges, n, c.range_scale, first))
        if "height" in c.kinds:
            sources.append(Heights(self.heights, n))
        return sources

    def _start(self) -> tuple[Array, Array]:
        """Followers' velocities and positions at the first epoch, with their covariance: as own filters or ranges have them."""
        M = len(self.names) - 1
        if self.names[0] == GROUND and self.ranges and not any(self.own[1:]):
            imus = [imu for name in self.names[1:] if (imu := self.problem.vehicle(name).imu) is not None]
            until = rest_until(imus, float(self.t_s[0]))
            return placed(self.ranges, self.heights, self.t_s, self.names, until)
        r_e, v_e, P = self.absolute
        x, cov = np.zeros(6 * M), np.zeros((6 * M, 6 * M))
        swap = np.r_[3:6, 0:3]  # own filters have positions first
        known = [bool(np.all(np.isfinite(r_e[i, 0]))) for i in range(M + 1)]
        for i in range(M):
            mine = slice(6 * i, 6 * i + 6)
            if not (known[0] and known[i + 1]):
                cov[mine, mine] = np.diag(np.repeat([START_SIGMA[1] ** 2, START_SIGMA[0] ** 2], 3))
                continue
            x[mine] = np.concatenate([v_e[i + 1, 0] - v_e[0, 0], r_e[i + 1, 0] - r_e[0, 0]])
            for j in range(M):
                if known[j + 1]:
                    shared = P[0, 0] + (P[i + 1, 0] if i == j else 0.0)
                    cov[mine, 6 * j : 6 * j + 6] = shared[np.ix_(swap, swap)]
        return x, cov


def prepare(problem: NavigationProblem, motions: Mapping[str, OwnMotion], receivers: Mapping[str, Receiver]) -> Formation:
    """A flight for relative filters: `motions` of every moving vehicle, `receivers` of those with GNSS.

    Raises InputError where there is nothing to filter, or where a vehicle's samples do not cover the epochs.
    """
    names = _order(problem)
    first = problem.vehicle(names[0]) if names[0] != GROUND else None
    stands = first is None or first.is_fixed
    missing = [name for name in names[1 if stands else 0 :] if name not in motions]
    if missing:
        raise InputError(f"vehicle {missing[0]}: the relative filter needs its attitude and specific force, so an IMU")
    frame = problem.frame
    links, notes = _links(problem, names, receivers)
    t_s, warnings = _epochs(problem, names, motions, links)
    full = {name: motions[name] for name in names if name in motions}
    origin_n = None
    if stands:
        origin_n = np.zeros(3) if first is None else np.asarray(first.fixed_n, float)
        full[names[0]] = _standing(frame, t_s, origin_n)
    at = [_held(full[name], t_s, frame) for name in names]
    levers = [receivers[name].lever_b if name in receivers else (0.0, 0.0, 0.0) for name in names]
    turning = [arms(C, w, np.asarray(lever)) for (_, _, C, w), lever in zip(at, levers, strict=True)]
    places = Places(at[0][0], at[0][1], np.array([a for a, _ in turning]), np.array([v for _, v in turning]))
    movers = tuple(_mover(name, full[name], frame) for name in names)
    ranges, constants, skipped = _ranges(problem, names, t_s, [C for _, _, C, _ in at], origin_n)
    return Formation(
        problem=problem,
        names=names,
        t_s=t_s,
        movers=movers,
        places=places,
        own=tuple(full[name].track for name in names),
        absolute=_absolute([full[name].track for name in names], t_s, frame),
        links=links,
        noise={i: PairNoise(receivers[names[0]].antenna.noise, receivers[names[i + 1]].antenna.noise) for i in links},
        ranges=ranges,
        constants=constants,
        heights=_heights(problem, names, t_s) if names[0] == GROUND else {},
        notes=(*notes, *((f"{skipped} ranges to tags that this filter does not place were left out",) if skipped else ())),
        warnings=warnings,
    )


def _order(problem: NavigationProblem) -> tuple[str, ...]:
    """Names of what has relative states, the reference first."""
    moving = [v.name for v in problem.bodies if not v.is_fixed]
    touched = [end for link in problem.links for end in (link.reference, link.rover)]
    bodies = [v.name for v in problem.bodies]
    candidates = sorted(
        {name for name in touched if name in bodies}, key=lambda name: (-touched.count(name), touched.index(name))
    )
    if candidates:
        first = candidates[0]
    elif any(tag.position_n is not None for model in problem.ranges for tag in model.stream.tags):
        first = GROUND
    else:
        first = moving[0] if moving else ""
    names = (first, *(name for name in moving if name != first))
    if len(names) < 2:
        raise InputError(f"a relative filter needs two moving vehicles, a base or anchors; there is {names[0] or 'none'}")
    return names


def _links(
    problem: NavigationProblem, names: Sequence[str], receivers: Mapping[str, Receiver]
) -> tuple[dict[int, PairEpochs], list[str]]:
    """Differences of every follower against the reference, by follower, and what cannot be had."""
    found: dict[int, PairEpochs] = {}
    notes: list[str] = []
    if not problem.links or names[0] not in receivers:
        return found, notes
    for i, name in enumerate(names[1:]):
        if name in receivers:
            try:
                found[i] = pair_epochs(receivers[names[0]], receivers[name], problem.settings, needs_phase=False)
            except InputError as error:
                notes.append(f"not differenced: {error}")
    return found, notes


def _epochs(
    problem: NavigationProblem, names: Sequence[str], motions: Mapping[str, OwnMotion], links: Mapping[int, PairEpochs]
) -> tuple[Array, tuple[str, ...]]:
    """Times (K,) of measurements, merged within MATCH_S, with others between them; and what lies outside IMUs and attitudes."""
    times = [pair.t_rover_s for pair in links.values()]
    times += [model.stream.t_s for model in problem.ranges]
    times += [h.t_s for v in problem.vehicles for h in v.heights]
    times += [track.t_s for name in names if name in motions and (track := motions[name].track) is not None]
    wanted = epochs_of(np.concatenate([np.zeros(0), *times]))
    mine = [name for name in names if name in motions]
    first, last = max(motions[name].edges[0] for name in mine), min(motions[name].edges[-1] for name in mine)
    inside = wanted[(wanted >= first - 1e-6) & (wanted <= last + 1e-6)]
    if len(inside) < 2:
        raise InputError(f"no measurements between {first:.1f} and {last:.1f} s, where all vehicles have IMU and attitude")
    lost = int(np.sum(np.abs(wanted - np.clip(wanted, first, last)) > LONGEST_STEP_S))
    warnings = (
        (f"{lost} epochs are left out: IMUs and attitudes of all vehicles cover {first:.1f} to {last:.1f} s only",)
        if lost
        else ()
    )
    return subdivided(inside, LONGEST_STEP_S), warnings


def _standing(frame: LocalFrame, t_s: Array, place_n: Array) -> OwnMotion:
    """A reference that stands on the ground."""
    edges = np.array([t_s[0] - 1.0, t_s[-1] + 1.0])
    none = np.zeros((len(t_s), 3))
    track = OwnTrack(t_s, none + place_n, none, np.zeros((len(t_s), 6, 6)))
    return OwnMotion(edges, -frame.gravity(place_n[None]), frame.w_ie_n[None], np.eye(3)[None], PERFECT, track)


def _held(own: OwnMotion, t_s: Array, frame: LocalFrame) -> tuple[Array, Array, Array, Array]:
    """Position and velocity (K, 3), ECEF, carried from the own filter's latest epoch; attitude (K, 3, 3) and rate (K, 3)."""
    sample = np.clip(np.searchsorted(own.edges, t_s) - 1, 0, len(own.f_b) - 1)
    C = frame.C_en.T @ own.C_nb[sample]
    if own.track is None:
        return np.tile(frame.origin_ecef, (len(t_s), 1)), np.zeros((len(t_s), 3)), C, own.w_b[sample]
    track = own.track
    last = np.clip(np.searchsorted(track.t_s, t_s + MATCH_S) - 1, 0, len(track.t_s) - 1)
    r_n = track.r_n[last] + track.v_n[last] * (t_s - track.t_s[last])[:, None]
    return frame.to_ecef(r_n), frame.rotate_to_ecef(track.v_n[last]), C, own.w_b[sample]


def _mover(name: str, own: OwnMotion, frame: LocalFrame) -> Mover:
    C_eb = np.ascontiguousarray(frame.C_en.T @ own.C_nb)
    return Mover(name, own.edges, np.einsum("kij,kj->ki", C_eb, own.f_b), C_eb, own.model, frame.C_en)


def _absolute(tracks: Sequence[OwnTrack | None], t_s: Array, frame: LocalFrame) -> tuple[Array, Array, Array]:
    N, K = len(tracks), len(t_s)
    r_e, v_e, P = np.full((N, K, 3), np.nan), np.full((N, K, 3), np.nan), np.full((N, K, 6, 6), np.nan)
    turn = np.kron(np.eye(2), frame.C_en.T)
    for i, track in enumerate(tracks):
        if track is not None:
            at = measured_at(track.t_s, t_s)
            has = at >= 0
            r_e[i, has], v_e[i, has] = frame.to_ecef(track.r_n[at[has]]), frame.rotate_to_ecef(track.v_n[at[has]])
            P[i, has] = turn @ track.P[at[has]] @ turn.T
    return r_e, v_e, P


def _ranges(
    problem: NavigationProblem, names: Sequence[str], t_s: Array, C_eb: Sequence[Array], origin_n: Array | None
) -> tuple[dict[int, list[RangeRow]], tuple[float, ...], int]:
    """Ranges by epoch, sigmas of their constants, and how many are left out because an end is not placed.

    origin_n: where a reference that stands is, whose axes are those of n.
    """
    found: dict[int, list[RangeRow]] = {}
    constants: list[float] = []
    skipped = 0
    for model in problem.ranges:
        stream = model.stream
        places = [_place(tag, names, origin_n) for tag in stream.tags]
        numbers: dict[tuple[str, int, int], int] = {}
        for k, a, b, range_m, sigma_m in zip(
            epoch_of(stream.t_s, t_s), stream.tag_a, stream.tag_b, stream.range_m, stream.sigma_m, strict=True
        ):
            if k < 0:
                continue
            first, second = places[a], places[b]
            if first is None or second is None or first[0] == second[0]:
                skipped += 1
                continue
            arm = C_eb[second[0]][k] @ second[1] - C_eb[first[0]][k] @ first[1]
            label = f"{stream.tags[a].name}-{stream.tags[b].name}"
            pair = (min(a, b), max(a, b)) if model.per_pair else (0, 0)
            scale, bias = (_constant(numbers, constants, what, pair, sigma) for what, sigma in _told(model))
            row = RangeRow(first[0], second[0], arm, float(range_m), float(sigma_m), label, scale, bias)
            found.setdefault(int(k), []).append(row)
    return found, tuple(constants), skipped


def _told(model: RangeModel) -> tuple[tuple[str, float], tuple[str, float]]:
    return ("scale", model.scale_sigma), ("bias", model.bias_sigma_m)


def _constant(
    numbers: dict[tuple[str, int, int], int], constants: list[float], what: str, pair: tuple[int, int], sigma: float
) -> int:
    """Number of a range's constant, a new one where it was not met before; -1 where the problem has none."""
    if not sigma > 0:
        return -1
    key = (what, *pair)
    if key not in numbers:
        numbers[key] = len(constants)
        constants.append(sigma)
    return numbers[key]


def _place(tag: Tag, names: Sequence[str], origin_n: Array | None) -> tuple[int, Array] | None:
    """A tag's vehicle and lever arm; an anchor is one of a reference that stands at origin_n. None where nothing places it."""
    if tag.vehicle is not None and tag.vehicle in names:
        return names.index(tag.vehicle), np.asarray(tag.lever_b, float)
    if tag.position_n is not None and origin_n is not None:
        return 0, np.asarray(tag.position_n, float) - origin_n
    return None


def _heights(problem: NavigationProblem, names: Sequence[str], t_s: Array) -> dict[int, list[HeightRow]]:
    """Heights over the ground by epoch."""
    found: dict[int, list[HeightRow]] = {}
    up = problem.frame.C_en[2]
    for i, name in enumerate(names[1:]):
        for stream in problem.vehicle(name).heights:
            for k, height, sigma in zip(epoch_of(stream.t_s, t_s), stream.up_m, stream.sigma_m, strict=True):
                if k >= 0:
                    found.setdefault(int(k), []).append(HeightRow(i, up, float(height), float(sigma), f"{name}/{stream.name}"))
    return found


def truth_of(formation: Formation, reference: str, rover: str) -> tuple[Array, Array | None] | None:
    """True position and, where known, velocity (K, 3), ECEF, of rover less reference at the epochs; NaN outside the truth.

    None where one of them has none.
    """
    problem, t_s = formation.problem, formation.t_s
    a, b = problem.vehicle(reference).truth, problem.vehicle(rover).truth
    if a is None or b is None:
        return None
    known = (t_s >= max(a.t_s[0], b.t_s[0]) - 1e-6) & (t_s <= min(a.t_s[-1], b.t_s[-1]) + 1e-6)

    def difference(x_a: Array, x_b: Array) -> Array:
        between = interpolate(t_s, b.t_s, x_b) - interpolate(t_s, a.t_s, x_a)
        return problem.frame.rotate_to_ecef(np.where(known[:, None], between, np.nan))

    v = None if a.v_n is None or b.v_n is None else difference(a.v_n, b.v_n)
    return difference(a.r_n, b.r_n), v


def attitude_at(t_s: Array, q_nb: Array, at_s: Array) -> Array:
    """Rotation matrices (m, 3, 3) at times at_s (m,) of quaternions (n, 4): straight between neighbours, which are near."""
    sign = np.cumprod(np.concatenate([[1.0], np.where(np.sum(q_nb[1:] * q_nb[:-1], axis=1) < 0, -1.0, 1.0)]))
    q = q_nb * sign[:, None]
    mixed = np.column_stack([np.interp(at_s, t_s, q[:, j]) for j in range(4)])
    return matrix_from_quat(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))
