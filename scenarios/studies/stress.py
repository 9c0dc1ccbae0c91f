"""Study `stress`: what the factor graph makes of faults, wrong installations and unknown starts.

Every trial solves one simulated flight twice with the same draws: as it should be, and with the fault of its case. What
counts is the ratio of the two errors, whether the faults were found, and whether the covariance still tells the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph import registry
from factorgraph.attitude import matrix_from_quat
from factorgraph.consistency import nees
from factorgraph.measurements import Calibration
from factorgraph.problem import ImuCalibration, NavigationProblem, Vehicle
from factorgraph.solution import Fix, PairSolution, Solution, Status
from factorgraph.types import Array
from scenarios.simulate import Scenario, SimulatedFlight, load_scenario, simulate
from scenarios.studies.slip_truth import judge
from scenarios.studies.study import Arrays, Job, Outcome, Results, chosen, seeds
from scenarios.studies.trials import replace_duration, wrong_times

REVISION = 1
FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the flight: where consistency is judged across seeds
LEVER_M, OFFSET_S = 0.3, 0.05
OUTLIER_SHARE, OUTLIER_M = 0.1, (5.0, 40.0)
SLIPS_PER_HOUR = 20.0
HEADING_RAD = np.deg2rad(5.0)

Measured = dict[str, float]


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of trouble."""

    summary: str
    scenario: str = "two-uav"
    duration_s: float = 180.0
    scene: Callable[[Scenario], Scenario] | None = None  # what the simulation does worse
    install: Callable[[NavigationProblem, np.random.Generator], tuple[NavigationProblem, Array]] | None = None
    measure: Callable[[SimulatedFlight, Solution, Array], Measured] | None = None  # besides errors; gets what `install` changed
    calm: bool = False  # the scenario is the trouble: the other flight has a sky without disturbances


def _receivers(scene: Scenario, **changes: Any) -> Scenario:
    """The scenario with fields of every receiver changed."""
    vehicles = tuple(
        v if v.gnss is None else v.model_copy(update={"gnss": v.gnss.model_copy(update=changes)}) for v in scene.vehicle
    )
    return scene.model_copy(update={"vehicle": vehicles})


def _with_rover(problem: NavigationProblem, change: Callable[[Vehicle], Vehicle]) -> NavigationProblem:
    rover = problem.wanted_pairs[0].rover
    return replace(problem, vehicles=tuple(change(v) if v.name == rover else v for v in problem.vehicles))


def _wrong_lever(problem: NavigationProblem, rng: np.random.Generator) -> tuple[NavigationProblem, Array]:
    """The rover's antenna declared LEVER_M away from where it is, in a random direction."""
    off = rng.normal(size=3)
    off *= LEVER_M / np.linalg.norm(off)

    def change(v: Vehicle) -> Vehicle:
        assert v.gnss is not None
        x, y, z = (np.array(v.gnss.lever_b) + off).tolist()
        return replace(v, gnss=replace(v.gnss, lever_b=(x, y, z), calibration=Calibration(lever_m=LEVER_M)))

    return _with_rover(problem, change), -off


def _late_imu(problem: NavigationProblem, rng: np.random.Generator) -> tuple[NavigationProblem, Array]:
    """The rover's IMU with time tags OFFSET_S late or early."""
    off = OFFSET_S * rng.choice([-1.0, 1.0])

    def change(v: Vehicle) -> Vehicle:
        assert v.imu is not None
        imu = replace(v.imu, t_s=v.imu.t_s + off)
        return replace(v, imu=imu, imu_calibration=ImuCalibration(time_s=2 * OFFSET_S))

    return _with_rover(problem, change), np.array([off])


def _unknown_heading(problem: NavigationProblem, rng: np.random.Generator) -> tuple[NavigationProblem, Array]:
    """Every IMU's heading declared at random and hardly believed."""

    def change(v: Vehicle) -> Vehicle:
        if v.imu is None:
            return v
        return replace(v, heading_hint_rad=float(rng.uniform(-np.pi, np.pi)), heading_sigma_rad=3.0)

    return replace(problem, vehicles=tuple(change(v) for v in problem.vehicles)), np.zeros(0)


def _headings_lost(flight: SimulatedFlight, solution: Solution, truth: Array) -> Measured:
    """Vehicles whose heading is further than HEADING_RAD from the truth in the middle of the flight."""
    lost, n = 0, 0
    for v in solution.vehicles:
        if v.truth is not None and v.truth.q_nb is not None and np.all(np.isfinite(v.q_nb)):
            k = len(v.t_s) // 2
            at = int(np.clip(np.searchsorted(v.truth.t_s, v.t_s[k] - 1e-6), 0, len(v.truth.t_s) - 1))
            C, C_true = matrix_from_quat(v.q_nb[k : k + 1])[0], matrix_from_quat(v.truth.q_nb[at : at + 1])[0]
            turn = C @ C_true.T
            n, lost = n + 1, lost + int(abs(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])) > HEADING_RAD)
    return {"starts": float(n), "starts_missed": float(lost)}


def _parameter_errors(flight: SimulatedFlight, solution: Solution, truth: Array) -> Measured:
    """Largest error of the estimated constants, absolute and in standard deviations."""
    found = solution.diagnostics.parameters
    error = np.array([p.value for p in found]) - truth
    sigma = np.array([p.sigma for p in found])
    return {"parameter_error": float(np.abs(error).max()), "parameter_sigmas": float(np.abs(error / sigma).max())}


def _outliers_found(flight: SimulatedFlight, solution: Solution, truth: Array) -> Measured:
    """How many differenced codes with an outlier lost half of their weight or are listed, and how many others were."""
    pair, table = solution.pairs[0], solution.residuals
    put_in: set[tuple[str, str, int]] = set()
    for name in (pair.reference, pair.rover):
        antenna = flight.problem.vehicle(name).gnss
        assert antenna is not None
        s, sizes = antenna.stream, flight.record.gnss[name].outlier_m
        for i in np.flatnonzero(sizes != 0.0):
            put_in.add((name, s.satellites[s.sat[i]], round(float(s.t_s[s.epoch[i]]))))
    code, source = table.kind.index("code"), f"{pair.reference}-{pair.rover}"
    rows = [i for i in np.flatnonzero(table.kind_index == code) if table.source[table.source_index[i]].startswith(source)]
    bad = np.array(
        [
            any(
                (n, table.label[table.label_index[i]], round(float(table.t_s[i]))) in put_in for n in (pair.reference, pair.rover)
            )
            for i in rows
        ]
    )
    found = np.array(table.outlier[rows] | (table.weight[rows] < 0.5))
    return {
        "outliers": float(bad.sum()),
        "outliers_found": float((bad & found).sum()),
        "good": float((~bad).sum()),
        "good_refused": float((~bad & found).sum()),
    }


def _slips_left(flight: SimulatedFlight, solution: Solution, truth: Array) -> Measured:
    """Slips of the pair, and those left inside an arc or taken off wrongly."""
    found = judge(flight, solution)
    return {"slips": float(sum(found.values())), "slips_missed": float(found["missed"] + found["wrongly repaired"])}


CASES: dict[str, Case] = {
    "outliers": Case(
        f"{100 * OUTLIER_SHARE:.0f} % of all codes are {OUTLIER_M[0]:g} to {OUTLIER_M[1]:g} m off",
        scene=lambda s: _receivers(s, outlier_probability=OUTLIER_SHARE, outlier_m=OUTLIER_M),
        measure=_outliers_found,
    ),
    "slips": Case(
        f"{SLIPS_PER_HOUR:.0f} slips per satellite and hour of 1 to 20 cycles, none of them flagged",
        scene=lambda s: _receivers(s, slips_per_hour=SLIPS_PER_HOUR, lli_probability=0.0, slip_cycles=20),
        measure=_slips_left,
    ),
    "lever-arm": Case(
        f"the rover's antenna is {LEVER_M:g} m from where it is declared", install=_wrong_lever, measure=_parameter_errors
    ),
    "time-offset": Case(
        f"the rover's IMU tags its samples {1e3 * OFFSET_S:.0f} ms late or early",
        duration_s=480.0,
        install=_late_imu,
        measure=_parameter_errors,
    ),
    "heading": Case(
        "headings declared at random, with a standard deviation of 3 rad",
        duration_s=60.0,
        install=_unknown_heading,
        measure=_headings_lost,
    ),
    "long-baseline": Case(
        "20 km from the base, two frequencies, a disturbed ionosphere and weather against a calm sky",
        scenario="long-baseline",
        duration_s=120.0,
        calm=True,
    ),
}


class StressStudy:
    """Each case on many seeds, with and without its fault."""

    name = "stress"
    summary = "the factor graph under outliers, slips, wrong installations, unknown headings and long baselines"

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--cases", metavar="NAME", nargs="+", default=list(CASES), help=f"{', '.join(CASES)} (all)")

    def jobs(self, options: argparse.Namespace) -> Sequence[Job]:
        cases = chosen("case", options.cases, tuple(CASES))
        return [
            Job(f"{name}-{seed:04d}", {"case": name, "seed": seed, "revision": REVISION, "quick": options.quick})
            for seed in seeds(options, usual=20, quick=2)
            for name in cases
        ]

    def run(self, job: Job) -> Arrays:
        p = job.parameters
        return trial(p["case"], p["seed"], quick=p["quick"])

    def finish(self, results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
        from scenarios.studies.stress_record import write

        return write(results, folder, options)


STUDY = StressStudy()


def trial(name: str, seed: int, quick: bool = False) -> dict[str, Array]:
    """One seed of a case: errors, fixes and consistency without (`clean`) and with (`faulty`) the trouble."""
    case = CASES[name]
    scene = replace_duration(load_scenario(case.scenario), 60.0 if quick else case.duration_s)
    clean = simulate(_calm(scene) if case.calm else scene, seed)
    faulty = simulate(case.scene(scene) if case.scene else scene, seed) if case.scene or case.calm else clean
    problem, truth = faulty.problem, np.zeros(0)
    if case.install is not None:
        problem, truth = case.install(problem, np.random.default_rng([seed, 4]))
    solution = registry.solve(problem, "graph")
    out = {f"clean/{k}": v for k, v in _errors(clean, registry.solve(clean.problem, "graph")).items()}
    out |= {f"faulty/{k}": v for k, v in _errors(faulty, solution).items()}
    if case.measure is not None:
        out |= {k: np.array(v) for k, v in case.measure(faulty, solution, truth).items()}
    return out


def _calm(scene: Scenario) -> Scenario:
    """The scenario with an atmosphere as the estimator's models have it."""
    changes = {"ionosphere_waves_m": 0.0, "ionosphere_gradient_ppm": 0.0, "wet_m": 0.0}
    return scene.model_copy(update={"environment": scene.environment.model_copy(update=changes)})


def _errors(flight: SimulatedFlight, solution: Solution) -> dict[str, Array]:
    """Error, consistency and integers of the first pair."""
    pair = solution.pairs[0]
    error = _error(pair)
    at = [int(f * (len(pair.t_s) - 1)) for f in FRACTIONS]
    wrong = len(wrong_times(flight, solution))
    return {
        "rmse_m": np.array(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "nees": nees(error[at], pair.P[at, :3, :3]),
        "fixed": np.array(np.mean(pair.fix == Fix.FIXED.value)),
        "wrong": np.array(wrong / max(int(np.sum(pair.fix == Fix.FIXED.value)), 1)),
        "converged": np.array(float(solution.diagnostics.status is Status.CONVERGED)),
    }


def _error(pair: PairSolution) -> Array:
    """Error of the baseline (n, 3) where the truth is known."""
    assert pair.truth_enu is not None
    known = np.isfinite(pair.truth_enu[:, 0])
    return np.asarray(np.where(known[:, None], pair.baseline_enu - pair.truth_enu, 0.0))


def parameters() -> Mapping[str, str]:
    """What the cases are made of, for the record."""
    return {name: f"{case.summary}; {case.scenario}, {case.duration_s:g} s" for name, case in CASES.items()}
