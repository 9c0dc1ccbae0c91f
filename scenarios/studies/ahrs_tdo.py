"""Study `ahrs-tdo`: the adaptive relative filter with Tasmanian devil optimisation, its controls, and other estimators.

Jobs, a file each:

    SCENE-SEED        one simulated flight, all filters of that scene (`ahrs_tdo_filters.FILTERS`), epoch by epoch
    graph-SEED ...    other estimators on the same flights from raw measurements (`OTHERS`)
    searches-SEED     updates of the plain filter, each searched by every method: how near they come to Gauss-Newton
    rules-SEED        how often each rule triggers at a few updates, without and with a fault
    walks-SEED        constant velocity and acceleration over a range of walks, on the first half of the flight
    bound             the posterior Cramer-Rao bound

Errors are follower less leader in Earth-fixed axes (ECEF), like the publication's. Source: Lu et al. (2024); spec ahrs_tdo.md.
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import numpy as np

from factorgraph.consistency import nees, standard_deviations
from factorgraph.errors import InputError
from factorgraph.filters.relative.filtering import RelativeTrack, Update
from factorgraph.filters.relative.flight import Configuration, Formation, truth_of
from factorgraph.problem import NavigationProblem
from factorgraph.sampling import interpolate
from factorgraph.types import Array
from scenarios.corrected import relative_snapshot
from scenarios.published import ahrs_tdo, ahrs_tdo_filters
from scenarios.published.ahrs_tdo import FOLLOWER, LEADER
from scenarios.published.ahrs_tdo_filters import EVALUATIONS, FILTERS, TUNING_SEEDS
from scenarios.studies.optimisers import on_grid
from scenarios.studies.study import Arrays, Job, Outcome, Results, chosen, seeds
from swarm.corrector import CorrectorSettings
from swarm.objective import Which

REVISION = 1  # of what a job computes; results of another one are not used again
PHASES = "graph-phases"  # the graph with carrier phases, which the published system lacks
OTHERS = {
    "graph": "factor graph, whole flight",
    "moving-horizon": "sliding window",
    "eskf": "error-state Kalman filter",
    PHASES: "factor graph with carrier phases",
}
FLIGHT_S = 600.0
BOUND, SEARCHES, RULES, TUNING = "bound", "searches", "rules", "walks"
SEARCH_METHODS = ("tdo", "pso", "ga")
SEARCHED_S = (100.0, 252.0, 350.0, 452.0)  # two quiet updates, two while the follower is pushed aside
JUDGED_S = (100.0, 200.0, 350.0, 550.0)
TUNED_UNTIL_S = 300.0
WALKED = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)
GRID = np.unique(np.round(np.geomspace(30, EVALUATIONS, 60)))  # evaluations (G,) at which histories are kept
QUICK = ("cv", "ca", "ahrs", "ahrs-tdo-o1", "ahrs-tdo-o2", "ahrs-nis-o3", "no-abs")
USUAL, USUAL_QUICK = 20, 2


class AhrsTdoStudy:
    """All filters on the same flights."""

    name = "ahrs-tdo"
    summary = "relative navigation with attitude systems, UWB and Tasmanian devil optimisation, after Lu and others (2024)"

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        known = (*FILTERS, *OTHERS)
        parser.add_argument(
            "--configurations", metavar="NAME", nargs="+", default=None,
            help=f"only these, without searches, rules and tuning: {', '.join(known)} (all; a part if quick)",
        )  # fmt: skip
        parser.add_argument(
            "--seconds", type=float, default=FLIGHT_S, help=f"of the flight that the relative filters see ({FLIGHT_S:g})"
        )

    def jobs(self, options: argparse.Namespace) -> Sequence[Job]:
        if not options.seconds >= 10.0:
            raise InputError(f"--seconds must be at least 10, got {options.seconds:g}")
        quick = (*QUICK, "graph") if options.quick else (*FILTERS, *OTHERS)
        asked = chosen("configuration", options.configurations or quick, (*FILTERS, *OTHERS))
        trials = seeds(options, USUAL, USUAL_QUICK)
        found = list(_flights(asked, trials, options.seconds))
        if options.configurations is None:
            found += _sidelines(trials, options)
        return found

    def run(self, job: Job) -> Arrays:
        p = job.parameters
        work: Mapping[str, Callable[[], dict[str, Any]]] = {
            BOUND: bound,
            SEARCHES: lambda: searches(p["seed"], p["seconds"]),
            RULES: lambda: rules(p["seed"], p["seconds"]),
            TUNING: lambda: walks(p["seed"]),
        }
        if p["part"] in OTHERS:
            return solve(p["part"], p["seed"])
        return work[p["part"]]() if p["part"] in work else fly(p["part"], p["seed"], p["filters"], p["seconds"])

    def finish(self, results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
        from scenarios.studies.ahrs_tdo_record import write

        return write(results, folder, command_line(options))


STUDY = AhrsTdoStudy()


def command_line(options: argparse.Namespace) -> str:
    """The command that gives these results again."""
    words = ["relnav study ahrs-tdo", *(["--quick"] if options.quick else [])]
    words += [f"--trials {options.trials}"] if options.trials is not None else []
    words += [f"--configurations {' '.join(options.configurations)}"] if options.configurations else []
    words += [f"--seconds {options.seconds:g}"] if options.seconds != FLIGHT_S else []
    return " ".join([*words, *([f"--seed {options.seed}"] if options.seed != 1 else [])])


def _flights(asked: Sequence[str], trials: Sequence[int], seconds: float) -> Iterator[Job]:
    """Jobs of the filters, scene by scene, and of the other estimators."""
    scenes = {name: FILTERS[name].scene for name in asked if name in FILTERS}
    for seed in trials:
        for scene in dict.fromkeys(scenes.values()):
            filters = [name for name in scenes if scenes[name] == scene]
            settings = {name: ahrs_tdo_filters.told(FILTERS[name]) for name in filters}
            whole = filters == [name for name, f in FILTERS.items() if f.scene == scene] and seconds == FLIGHT_S
            tag = "" if whole else f"-{zlib.crc32(f'{filters}{seconds}'.encode()):08x}"  # a part is filed apart from the whole
            told = {"part": scene, "filters": filters, "settings": settings, "seconds": seconds, "seed": seed}
            yield Job(f"{scene}-{seed:04d}{tag}", told | {"revision": REVISION})
        for method in OTHERS:
            if method in asked:
                yield Job(f"{method}-{seed:04d}", {"part": method, "seed": seed, "revision": REVISION})


def _sidelines(trials: Sequence[int], options: argparse.Namespace) -> Iterator[Job]:
    """Jobs that are not estimators on flights."""
    common = {"revision": REVISION, "seconds": options.seconds}
    for seed in trials:
        for part in (SEARCHES, RULES):
            yield Job(f"{part}-{seed:04d}", {"part": part, "seed": seed} | common)
    if not options.quick:
        yield from (Job(f"{TUNING}-{seed:04d}", {"part": TUNING, "seed": seed} | common) for seed in TUNING_SEEDS)
    yield Job(BOUND, {"part": BOUND, "revision": REVISION})


# flights


@lru_cache(maxsize=1)
def prepared(scene: ahrs_tdo_filters.Scene, seed: int) -> Formation:
    """`ahrs_tdo_filters.formation`, kept for the next job."""
    return ahrs_tdo_filters.formation(scene, seed)


def shortened(formation: Formation, until_s: float) -> Formation:
    """The flight up to a time."""
    return replace(formation, t_s=formation.t_s[formation.t_s <= until_s + 1e-6])


def fly(scene: ahrs_tdo_filters.Scene, seed: int, names: Sequence[str], seconds: float) -> dict[str, Any]:
    """All asked filters on one flight; arrays are NAME/WHAT."""
    formation = shortened(prepared(scene, seed), seconds)
    truth = _truth(formation)
    out: dict[str, Any] = {"t_s": formation.t_s, "truth_r_m": truth[0], "truth_v_mps": truth[1]}
    for name in names:
        f = FILTERS[name]
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        began = time.process_time()
        track = formation.run(f.configuration, ahrs_tdo_filters.corrector(f, rng))
        spent = time.process_time() - began
        out |= {f"{name}/{what}": x for what, x in _judge(track, truth).items()}
        out[f"{name}/runtime_s"] = np.array(spent)
    return _small(out)


def _truth(formation: Formation) -> tuple[Array, Array]:
    found = truth_of(formation, LEADER, FOLLOWER)
    assert found is not None and found[1] is not None
    return found[0], found[1]


def _judge(track: RelativeTrack, truth: tuple[Array, Array]) -> dict[str, Any]:
    r, v, P = track.pair(0, 1)
    return errors(r - truth[0], v - truth[1], P) | {
        "nis": track.nis,
        "n_rows": track.n_rows,
        "triggered": track.triggered,
        "statistic": track.statistic,
        "threshold": track.threshold,
    }


def errors(r: Array, v: Array, P: Array) -> dict[str, Any]:
    """Errors of position and velocity (K, 3) with P (K, 6, 6), position first."""
    both = np.hstack([r, v])
    return {"position_error_m": r, "velocity_error_mps": v, "sigma": standard_deviations(P), "nees": nees(both, P)}


def _small(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Single precision is enough to keep."""
    return {name: x.astype(np.float32) if x.dtype == np.float64 else x for name, x in arrays.items()}


# other estimators


def solve(method: str, seed: int) -> dict[str, Any]:
    """Another estimator on the flight's raw measurements: IMU, code, Doppler and ranges, without attitude systems."""
    from factorgraph import registry

    problem = raw(seed, with_phases=method == PHASES)
    began = time.process_time()
    solution = registry.solve(problem, method.removesuffix("-phases"))
    spent = time.process_time() - began
    pair = solution.pairs[0]
    assert pair.truth_enu is not None and pair.truth_velocity_enu is not None
    C = _to_ecef(problem, pair.t_s)
    r, v = pair.baseline_enu - pair.truth_enu, pair.velocity_enu - pair.truth_velocity_enu
    found = errors(np.einsum("kij,kj->ki", C, r), np.einsum("kij,kj->ki", C, v), _turned(C, pair.P))
    arrays = {f"{method}/{what}": x for what, x in found.items()}
    return _small({"t_s": pair.t_s, **arrays, f"{method}/runtime_s": np.array(spent)})


def bound() -> dict[str, Any]:
    """What no estimator of the whole flight can beat, at the truth; seeds do not change it."""
    from factorgraph.bound import posterior_bound

    problem = raw(1)
    found = posterior_bound(problem)
    return _small(
        {"t_s": found.t_s, "sigma": standard_deviations(_turned(_to_ecef(problem, found.t_s), found.pairs[LEADER, FOLLOWER]))}
    )


def raw(seed: int, with_phases: bool = False) -> NavigationProblem:
    """The published flight without attitude systems."""
    flight = ahrs_tdo.simulate_flight(seed)
    problem = flight.simulated.problem if with_phases else flight.problem
    return replace(problem, vehicles=tuple(replace(v, attitudes=()) for v in problem.vehicles))


def _to_ecef(problem: NavigationProblem, t_s: Array) -> Array:
    """Rotations (k, 3, 3) from east-north-up at the leader to Earth-fixed axes."""
    truth = problem.vehicle(LEADER).truth
    assert truth is not None
    C = problem.frame.C_to_enu(interpolate(t_s, truth.t_s, truth.r_n)) @ problem.frame.C_en
    return np.swapaxes(C, 1, 2)


def _turned(C: Array, P: Array) -> Array:
    """Covariances (k, 6, 6) in axes turned by C (k, 3, 3)."""
    both = np.zeros((len(C), 6, 6))
    both[:, :3, :3], both[:, 3:, 3:] = C, C
    return np.asarray(both @ P @ np.swapaxes(both, 1, 2))


# single updates


def recorded(seed: int, times_s: Sequence[float], seconds: float) -> list[Update]:
    """Updates of the plain filter at some times of the flight."""
    formation = shortened(prepared("published", seed), seconds)
    wanted = {int(np.argmin(np.abs(formation.t_s - t))) for t in times_s if t <= formation.t_s[-1]}
    found: list[Update] = []
    formation.run(Configuration(), observe=lambda k, update: found.append(update) if k in wanted else None)
    return found


def searches(seed: int, seconds: float) -> dict[str, Any]:
    """Every method on the same updates and objectives, OBJECTIVE/METHOD/excess (S,) and /history (S, G).

    The excess is J / J_gn - 1 with the minimum J_gn of Gauss-Newton; evaluations are those of TDO for all methods.
    """
    updates = recorded(seed, SEARCHED_S, seconds)
    out: dict[str, list[Any]] = {}
    for i, update in enumerate(updates):
        for which in get_args(Which):
            settings = CorrectorSettings(objective=which)
            best, runs = ahrs_tdo_filters.searched(relative_snapshot(update), settings, SEARCH_METHODS, seed * 1000 + i)
            for method, run in runs.items():
                history = on_grid(run.history_evals, run.history, GRID)
                out.setdefault(f"{which}/{method}/excess", []).append(run.cost / best - 1.0)
                out.setdefault(f"{which}/{method}/evals", []).append(float(run.n_evals))
                out.setdefault(f"{which}/{method}/history", []).append(history / best - 1.0)
    return {name: np.array(x) for name, x in out.items()}


def rules(seed: int, seconds: float) -> dict[str, Any]:
    """Share of updates at which each rule triggers, RULE/MISMATCH (S,)."""
    rng = np.random.default_rng([seed, zlib.crc32(RULES.encode())])
    out: dict[str, list[float]] = {}
    for update in recorded(seed, JUDGED_S, seconds):
        for rule, shares in ahrs_tdo_filters.rates(update, rng).items():
            for mismatch, share in shares.items():
                out.setdefault(f"{rule}/{mismatch}", []).append(share)
    return {name: np.array(x) for name, x in out.items()}


def walks(seed: int) -> dict[str, Any]:
    """Error of constant velocity and acceleration for every walk, on the first half of the flight, NAME/WHAT (W,)."""
    formation = shortened(prepared("published", seed), TUNED_UNTIL_S)
    r, v = _truth(formation)
    out: dict[str, Any] = {"walk": np.array(WALKED)}
    for name in ("cv", "ca"):
        found = []
        for walk in WALKED:
            track = formation.run(replace(FILTERS[name].configuration, walk=walk))
            r_est, v_est, _ = track.pair(0, 1)
            found.append([_rms(r_est - r), _rms(v_est - v)])
        out[f"{name}/position_m"], out[f"{name}/velocity_mps"] = np.array(found).T
    return out


def _rms(x: Array) -> float:
    """Of norms (K, 3)."""
    return float(np.sqrt(np.mean(np.sum(x * x, axis=1))))


def parameters() -> dict[str, object]:
    """Everything assumed or tuned, by name."""
    return {**asdict(ahrs_tdo.ASSUMED), **ahrs_tdo_filters.TUNED}
