"""The relative filter as a method of `factorgraph.registry`: from a problem to a solution.

Every vehicle is prepared by itself (`own`), then the formation is filtered (`flight`). Pairs that are wanted are differences of
the relative filter's states; vehicles are where their own filters have them or, without any, where the filter has them over the
ground. Innovations stand in for residuals.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.result import configuration, versions
from factorgraph.attitude import quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.filters.relative.filtering import Correct, RelativeTrack, Update
from factorgraph.filters.relative.flight import GROUND, Configuration, Formation, prepare, truth_of
from factorgraph.filters.relative.own import own_motions
from factorgraph.filters.relative.rows import KINDS, measured_at
from factorgraph.geodesy import C_en, geodetic_from_ecef
from factorgraph.models.receivers import receivers
from factorgraph.problem import Link, NavigationProblem
from factorgraph.registry import Progress
from factorgraph.solution import (
    AmbiguityTable,
    Diagnostics,
    Fix,
    PairSolution,
    ResidualTable,
    Solution,
    Status,
    VehicleSolution,
)
from factorgraph.types import Array, IntArray


@dataclass(frozen=True, slots=True)
class RelativeFilter:
    """A relative filter of one configuration; what `correct` makes for a run judges and replaces its updates."""

    name: str
    summary: str
    configuration: Configuration = field(default_factory=Configuration)
    correct: Callable[[], Correct] | None = None

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Raises InputError where vehicles have no IMU, or no attitude can be had."""
        spent: dict[str, float] = {}
        at = time.perf_counter()

        def stage(name: str, fraction: float) -> None:
            nonlocal at
            now = time.perf_counter()
            spent[name], at = now - at, now
            progress(name, fraction)

        rx = receivers(problem)
        motions = own_motions(problem, rx)
        stage("vehicles", 0.4)
        formation = prepare(problem, motions, rx)
        stage("measurements", 0.5)
        innovations = Innovations(formation)
        correct = None if self.correct is None else self.correct()
        track = formation.run(self.configuration, correct, innovations.add)
        stage("relative filter", 1.0)
        return solution(formation, track, innovations.table(problem.settings.outlier_sigma), self.name, spent)


class Innovations:
    """What every row measured less its prediction, with the standard deviation that was expected of it."""

    def __init__(self, formation: Formation) -> None:
        self.t_s, self.labels = formation.t_s, dict[str, int]()
        self.parts: list[Array] = []

    def add(self, k: int, update: Update) -> None:
        """One update of the filter."""
        rows = update.rows
        nu, H = rows.linearised(update.x_prior)
        sigma = np.sqrt(np.einsum("mi,ij,mj->m", H, update.P_prior, H) + np.diag(rows.R))
        label = [self.labels.setdefault(name, len(self.labels)) for name in rows.labels]
        self.parts.append(np.column_stack([rows.kind, label, np.full(len(nu), self.t_s[k]), nu, sigma]))

    def table(self, outlier_sigma: float) -> ResidualTable:
        """All of them."""
        if not self.parts:
            return ResidualTable()
        kind, label, t_s, nu, sigma = np.concatenate(self.parts).T
        n, unknown = len(nu), np.full(len(nu), np.nan)
        return ResidualTable(
            KINDS, ("relative filter",), tuple(self.labels), kind.astype(np.int64), np.zeros(n, np.int64), label.astype(np.int64),
            t_s, nu, sigma, np.ones(n), np.abs(nu) > outlier_sigma * sigma, unknown, unknown,
        )  # fmt: skip


def solution(
    formation: Formation, track: RelativeTrack, residuals: ResidualTable, method: str, spent: dict[str, float]
) -> Solution:
    """A filtered formation as a solution of its problem."""
    problem = formation.problem
    finite = np.isfinite(track.x).all(axis=1) & np.isfinite(track.P).all(axis=(1, 2))
    pairs = tuple(
        _pair(formation, track, link) for link in problem.wanted_pairs if {link.reference, link.rover} <= set(formation.names)
    )
    if problem.wanted_pairs and not pairs:
        raise InputError("none of the pairs wanted is one of vehicles that the relative filter places")
    has = track.n_rows > 0
    replaced = int(np.sum(track.triggered))
    notes = [*formation.notes, f"reference of the filter: {formation.names[0]}"]
    if np.any(np.isfinite(track.statistic)):
        notes.append(f"{replaced} of {int(np.sum(has))} updates were judged and replaced by the corrector")
    return Solution(
        name=problem.name,
        method=method,
        t0=problem.t0,
        frame=problem.frame,
        vehicles=tuple(_vehicle(formation, track, i) for i, name in enumerate(formation.names) if name != GROUND),
        pairs=pairs,
        ambiguities=AmbiguityTable(),
        residuals=residuals,
        diagnostics=Diagnostics(
            status=Status.CONVERGED if np.all(finite) else Status.DIVERGED,
            n_iterations=0,
            cost=np.zeros(0),
            runtime_s=spent,
            nis_t_s=track.t_s[has],
            nis=track.nis[has],
            nis_dof=track.n_rows[has].astype(float),
            warnings=formation.warnings,
            notes=tuple(notes),
        ),
        configuration=configuration(problem),
        versions=versions(()),
    )


def _pair(formation: Formation, track: RelativeTrack, link: Link) -> PairSolution:
    a, b = (formation.names.index(name) for name in (link.reference, link.rover))
    r, v, P = track.pair(a, b)
    lat, lon, _ = geodetic_from_ecef(_place(formation, track, a))
    C = C_en(lat, lon)
    both = np.zeros((len(C), 6, 6))
    both[:, :3, :3], both[:, 3:, 3:] = C, C
    true = truth_of(formation, link.reference, link.rover)
    n = len(track.t_s)
    return PairSolution(
        link.reference, link.rover, track.t_s, _turned(C, r), _turned(C, v), both @ P @ np.swapaxes(both, 1, 2),
        np.full(n, Fix.NONE.value), np.full(n, np.nan), _satellites(formation, {a, b}),
        None if true is None else _turned(C, true[0]), None if true is None or true[1] is None else _turned(C, true[1]),
    )  # fmt: skip


def _turned(C: Array, x: Array) -> Array:
    return np.asarray(np.einsum("kij,kj->ki", C, x))


def _place(formation: Formation, track: RelativeTrack, i: int) -> Array:
    """Where a vehicle is (K, 3), ECEF."""
    return np.asarray(formation.places.reference_e + (track.pair(0, i)[0] if i else 0.0))


def _satellites(formation: Formation, vehicles: set[int]) -> IntArray:
    """Satellites (K,) differenced against the reference by the vehicles of a pair, the fewest of them."""
    used = [formation.links[i - 1] for i in vehicles if i - 1 in formation.links]
    counts = []
    for pair in used:
        at = measured_at(pair.t_rover_s, formation.t_s)
        counts.append(np.where(at >= 0, np.sum(pair.usable, axis=1)[at], 0))
    return np.min(counts, axis=0) if counts else np.zeros(len(formation.t_s), np.int64)


def _vehicle(formation: Formation, track: RelativeTrack, i: int) -> VehicleSolution:
    """Where a vehicle's own filter has it; without one, where the relative filter has it over the ground."""
    name, own, frame = formation.names[i], formation.own[i], formation.problem.frame
    if own is not None:
        t_s, r_n, v_n, P6 = own.t_s, own.r_n, own.v_n, own.P
    else:
        r, v, P_e = track.pair(0, i)
        turn = np.kron(np.eye(2), frame.C_en)
        t_s, r_n, v_n, P6 = (
            track.t_s,
            frame.from_ecef(formation.places.reference_e + r),
            frame.rotate_from_ecef(v),
            turn @ P_e @ turn.T,
        )
    mover = formation.movers[i]
    sample = np.clip(np.searchsorted(mover.edges, t_s) - 1, 0, len(mover.C_eb) - 1)
    P = np.full((len(t_s), 15, 15), np.nan)
    P[:, :6, :6] = P6
    unknown = np.full((len(t_s), 3), np.nan)
    q = quat_from_matrix(frame.C_en @ mover.C_eb[sample])
    told = formation.problem.vehicle(name)
    return VehicleSolution(name, t_s, r_n, v_n, q, unknown, unknown, P, told.truth, told.is_fixed)


HONEST = Configuration(
    coloured=True,
    kinds=tuple(kind for kind in KINDS if kind not in ("position", "velocity")),  # absolute differences say the codes again
    calibrate_ranges=True,
    update="iterated",
    robust=True,
)
RELATIVE = RelativeFilter("relative", "relative filter: attitudes and accelerometers of all vehicles, two or many", HONEST)
