"""The study of the two-stage refuelling navigation: ten published algorithms and the factor graph on four data sets.

A job is one seed: the flight, the tanker's own filter and the subfilters that do not look at the INS are computed once for
all data sets and algorithms. The graph has jobs of its own. Variants change one reading of the publication each; they are
listed in `VARIANTS`. What a job returns is named in `aar_summary`.

Source: Wu et al. (2022).
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgraph.consistency import nees
from factorgraph.errors import InputError
from factorgraph.filters import two_stage
from factorgraph.filters.adaptive import Statistic
from factorgraph.filters.float_ambiguity import FloatSettings, InsBaseline, Scheme
from factorgraph.filters.tightly_coupled import TightSettings, TightTrack
from factorgraph.filters.two_stage import Disturbance, Shared, TwoStageRun, TwoStageSettings
from factorgraph.solution import Fix, Solution
from factorgraph.types import Array, BoolArray
from scenarios.published import aar
from scenarios.published.aar import TANKER, UAV, AarData, AarFlight
from scenarios.studies.aar_summary import DEFAULT, GRAPH, RATIO_THRESHOLD, SWEEP, JobKey, summarise
from scenarios.studies.study import Arrays, Job, Outcome, Results, chosen, seeds

REVISION = 2  # of what a job computes; results of another one are not used again
SCHEMES = dict(zip("12345", Scheme, strict=True))
FILTERS = tuple(number + letter for number in SCHEMES for letter in "ab")
UNAIDED = (Scheme.WLS, Scheme.EKF)


@dataclass(frozen=True, slots=True)
class Tuning:
    """What is tuned: on data set 1 where the publication is silent, then kept for all."""

    accel_walk: float = 1.0  # m/s^2 per sqrt(s)
    ambiguity_walk: float = 1.5  # cycles per sqrt(s): the EKF's success rate on data set 1, seeds 1001 to 1010, is then 89 %
    k0: float = 1.5
    c0: float = 1.5
    c1: float = 4.5
    c2: float = 2.0
    ratio_threshold: float = RATIO_THRESHOLD
    tanker_code_m: float = 30.0  # loose: what its filter corrects in position, the UAV's filter takes for motion


TUNING = Tuning()


@dataclass(frozen=True, slots=True)
class Variant:
    """One reading of the publication: what it changes, and where it is run. What it means is in `aar_record.VARIANTS`."""

    algorithms: tuple[str, ...] = FILTERS
    data: tuple[int, ...] = aar.DATA_SETS
    usual: int = 20  # seeds
    starts: tuple[int, ...] = (0,)
    changes: Mapping[str, Any] = field(default_factory=dict)  # of TwoStageSettings
    statistic: Statistic = "literal"
    noise: aar.Noise = "dd"
    target: Literal["subfilter", "ins"] = "subfilter"


AIDED = ("3a", "3b", "4a", "4b", "5a", "5b")
VARIANTS = {
    DEFAULT: Variant(usual=50),
    "literal-noise": Variant(FILTERS[:6], (1,), usual=50, noise="literal"),
    "normalised": Variant(statistic="normalised"),
    "inflated-float": Variant(FILTERS[2:], (1,), changes={"float_phase": "inflated"}),
    "known-float": Variant(FILTERS[2:], (1,), changes={"float_phase": "known"}),
    "plain-main": Variant(FILTERS[6:], (2, 4), changes={"robust_main": False}),
    "reference-jumps": Variant(AIDED, (1, 4), changes={"reference_jumps": True}),
    "ins-fault": Variant(FILTERS[2:], (3, 4), target="ins"),
    "start": Variant(FILTERS[:6], (1,), starts=(1, 2, 3, 4)),
    SWEEP: Variant((), (1,)),
}


class AarStudy:
    """Ten algorithms and the factor graph on four data sets."""

    name = "aar"
    summary = "two-stage relative navigation for aerial refuelling, after Wu and others (2022)"

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--data", metavar="N", type=int, nargs="+", default=list(aar.DATA_SETS), help="data sets (1 2 3 4)")
        parser.add_argument(
            "--algorithms", metavar="NAME", nargs="+", default=[*FILTERS, GRAPH],
            help="1a to 5b (1 WLS, 2 EKF, 3 IEKF, 4 IBRKF, 5 IBRCAF; a SKF, b AKF) and graph (all)",
        )  # fmt: skip
        parser.add_argument(
            "--variants", metavar="NAME", nargs="+", default=None,
            help=f"readings of the publication: {', '.join(VARIANTS)} (all; {DEFAULT} of a part; {DEFAULT} and {SWEEP} if quick)",
        )  # fmt: skip

    def jobs(self, options: argparse.Namespace) -> Sequence[Job]:
        data = chosen("data set", options.data, aar.DATA_SETS)
        algorithms = chosen("algorithm", options.algorithms, (*FILTERS, GRAPH))
        variants = options.variants or _usual_variants(algorithms, options.quick)
        out = [job for name in chosen("variant", variants, tuple(VARIANTS)) for job in _jobs(name, data, algorithms, options)]
        if not out:
            raise InputError("nothing to do: no variant is run with these data sets and algorithms")
        return out

    def run(self, job: Job) -> Arrays:
        p = job.parameters
        if p["variant"] == SWEEP:
            return sweep(p["seed"])
        if p["algorithms"] == [GRAPH]:
            return solve_graph(p["seed"], p["start"], p["data"])
        return fly(p["variant"], p["seed"], p["start"], p["data"], p["algorithms"])

    def finish(self, results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
        from scenarios.report.aar import write_study
        from scenarios.studies.aar_claims import claims
        from scenarios.studies.aar_record import write_record, write_table
        from scenarios.studies.verdicts import count_verdicts

        cut, command = ByDataSet(results), _command(options)
        summary = summarise(cut)
        written = [
            *write_record(summary, folder, parameters(), command),
            *write_table(summary, folder),
            write_study(summary, cut, folder / "report.html", parameters(), command),
        ]
        found = claims(summary)
        verdicts = [f"claims of the publication: {count_verdicts(found, is_check=False)}"]
        verdicts.append(f"further checks: {count_verdicts(found, is_check=True)}")
        return Outcome((*verdicts, f"written: {', '.join(path.name for path in written)} in {folder}"))


def _command(options: argparse.Namespace) -> str:
    """The command that gives these results again."""
    words = ["relnav study aar"]
    for name in ("trials", "data", "algorithms", "variants"):
        value = getattr(options, name)
        if value not in (None, list(aar.DATA_SETS), [*FILTERS, GRAPH]):
            words.append(f"--{name} {' '.join(map(str, value)) if isinstance(value, list) else value}")
    if options.seed != 1:
        words.append(f"--seed {options.seed}")
    return " ".join([*words, *(["--quick"] if options.quick else [])])


STUDY = AarStudy()


def _usual_variants(algorithms: Sequence[str], is_quick: bool) -> list[str]:
    """The readings that are run when none is named: of a part of the algorithms only the main one."""
    if not set(FILTERS) <= set(algorithms):
        return [DEFAULT]
    return [DEFAULT, SWEEP] if is_quick else list(VARIANTS)


def _jobs(name: str, data: Sequence[int], algorithms: Sequence[str], options: argparse.Namespace) -> Iterator[Job]:
    variant = VARIANTS[name]
    mine = [d for d in data if d in variant.data]
    filters = [a for a in algorithms if a in variant.algorithms]
    tuned = {
        "tuning": parameters(),
        "changes": dict(variant.changes),
        "reading": [variant.statistic, variant.noise, variant.target],
    }
    for seed in seeds(options, variant.usual, quick=3 if name == DEFAULT else 1):
        for start in variant.starts:
            common = {"variant": name, "seed": seed, "start": start, "data": mine, "revision": REVISION, **tuned}
            if mine and (filters or name == SWEEP):
                subset = "" if (mine, filters) == (list(variant.data), list(variant.algorithms)) else _tag(mine, filters)
                yield Job(f"{name}-{start}-{seed:04d}{subset}", {**common, "algorithms": filters})
            if mine and name == DEFAULT and GRAPH in algorithms:
                subset = "" if mine == list(variant.data) else _tag(mine, [])
                yield Job(f"graph-{start}-{seed:04d}{subset}", {**common, "algorithms": [GRAPH]})


def _tag(data: Sequence[int], algorithms: Sequence[str]) -> str:
    """Keeps the trials of a part apart from those of the whole, which they must not replace."""
    return f"-{zlib.crc32(f'{list(data)}{list(algorithms)}'.encode()):08x}"


def parameters() -> dict[str, object]:
    """Everything assumed or tuned, by name."""
    return {**asdict(TUNING), **asdict(aar.ASSUMED), "start_hours": list(aar.START_TIMES)}


@dataclass(frozen=True, slots=True)
class Prepared:
    """A flight of one seed with what all algorithms share."""

    flight: AarFlight
    tanker: TightTrack
    sd_integers: Array  # (K, S) by the satellites of `satellites`
    satellites: tuple[str, ...]


@lru_cache(maxsize=1)
def prepare(seed: int, start: int, noise: aar.Noise) -> Prepared:
    """Simulate a flight and run the tanker's filter."""
    flight = aar.simulate_flight(seed, start, noise)
    shared = _share(flight, flight.problem, None)
    true = aar.true_integers(flight)
    return Prepared(flight, shared.reference, true.sd, true.satellites)


def _share(flight: AarFlight, problem: Any, tanker: TightTrack | None) -> Shared:
    models = dict.fromkeys((TANKER, UAV), aar.imu_model())
    tight = TightSettings(TUNING.tanker_code_m, settings(flight.noise, "1a").doppler_mps)
    return two_stage.share(problem, flight.start, models, tanker, tight)


def settings(noise: aar.Noise, algorithm: str, variant: Variant = VARIANTS[DEFAULT]) -> TwoStageSettings:
    """The settings of an algorithm; sigma0 are the undifferenced standard deviations of the simulation."""
    told = aar.scenario(0, noise).vehicle[0].gnss
    assert told is not None
    sigma, t = told.noise.noise, TUNING
    floats = FloatSettings(sigma.code_m, sigma.phase_m, t.accel_walk, t.ambiguity_walk, t.c0, t.c1, t.c2, variant.statistic)
    base = TwoStageSettings(floats, sigma.doppler_mps, t.ratio_threshold, algorithm.endswith("b"), t.k0, variant.statistic)
    return replace(base, **variant.changes)


def fly(variant_name: str, seed: int, start: int, data: Sequence[int], algorithms: Sequence[str]) -> dict[str, Any]:
    """All asked algorithms on all asked data sets of one seed; names are DATA/ALGORITHM/NAME."""
    variant = VARIANTS[variant_name]
    prepared = prepare(seed, start, variant.noise)
    out: dict[str, Any] = {}
    for number in data:
        case = aar.data_set(prepared.flight, number)
        shared = _share(prepared.flight, case.problem, prepared.tanker)
        disturbance = Disturbance(case.velocity_fault_mps, variant.target) if np.any(case.velocity_fault_mps) else None
        truth = Truth.of(prepared, shared, case)
        out |= {f"{number}/{name}": x for name, x in truth.shared.items()}
        floats: dict[Scheme, Any] = {}
        for algorithm in algorithms:
            scheme, s = SCHEMES[algorithm[0]], settings(variant.noise, algorithm, variant)
            began = time.perf_counter()
            if scheme in UNAIDED and scheme not in floats:
                floats[scheme] = two_stage.float_solutions(shared, scheme, s.floats, disturbance)
            run = two_stage.run(shared, scheme, s, disturbance, floats.get(scheme))
            spent = time.perf_counter() - began
            out |= {f"{number}/{algorithm}/{name}": x for name, x in truth.judge(run).items()}
            out[f"{number}/{algorithm}/runtime_s"] = np.float32(spent)
    return out


@dataclass(frozen=True, slots=True)
class Truth:
    """What a data set truly holds, at its epochs."""

    baseline_n: Array  # (K, 3)
    velocity_n: Array  # (K, 3)
    to_enu: Array  # (K, 3, 3) from n, at the tanker
    sd_integers: Array  # (K, S)
    shared: dict[str, Any]  # arrays that all algorithms have in common

    @classmethod
    def of(cls, prepared: Prepared, shared: Shared, case: AarData) -> Truth:
        data = shared.data
        tanker, uav = (shared.problem.vehicle(name).truth for name in (TANKER, UAV))
        assert tanker is not None and uav is not None and tanker.v_n is not None and uav.v_n is not None
        column = [prepared.satellites.index(s) for s in data.satellites]
        seen = data.usable
        b = uav.r_n - tanker.r_n
        arrays = {
            "t_s": tanker.t_s,
            "n_sat": seen.sum(axis=1),
            "baseline_m": np.linalg.norm(b, axis=1),
            "faulted": case.faulted,
            "elevation_deg": np.where(seen, np.rad2deg(data.elevation_rad), np.nan),
            "azimuth_deg": np.where(seen, np.rad2deg(_azimuth(data.sat_rover, uav.r_n, shared)), np.nan),
            "satellites": np.array(data.satellites),
            "truth_tanker_n": tanker.r_n,
            "truth_uav_n": uav.r_n,
        }
        to_enu = shared.problem.frame.C_to_enu(tanker.r_n)
        return cls(b, uav.v_n - tanker.v_n, to_enu, prepared.sd_integers[:, column], _small(arrays))

    def judge(self, run: TwoStageRun) -> dict[str, Any]:
        """Arrays of one algorithm: indicators and errors, east-north-up."""
        main = np.concatenate([run.main_baseline_n - self.baseline_n, run.velocity_n - self.velocity_n], axis=1)
        moving = run.main_P[:, :6, :6]
        return _small({
            "ratio": run.ratio,
            "adop_cyc": run.adop_cyc,
            "success_rate": run.success_rate,
            "correct": self.correct(run.resolved),
            "fixed": run.fixed,
            "baseline_error_m": self._enu(run.baseline_n - self.baseline_n),
            "velocity_error_mps": self._enu(main[:, 3:]),
            "main_baseline_error_m": self._enu(main[:, :3]),
            "nees": nees(main, moving),
            "nis": run.nis,
            "ins_sigma_m": run.ins_sigma_m,
            "alpha": run.alpha,
        })  # fmt: skip

    def correct(self, resolved: Sequence[two_stage.Resolved | None]) -> BoolArray:
        """Whether the nearest integers of an epoch are the true ones."""
        sd = self.sd_integers
        return np.array([
            f is not None and np.array_equal(f.integers, sd[k, f.order[1:]] - sd[k, f.order[0]]) for k, f in enumerate(resolved)
        ])  # fmt: skip

    def _enu(self, x_n: Array) -> Array:
        return np.asarray(np.einsum("kij,kj->ki", self.to_enu, x_n))


def _azimuth(sat_n: Array, r_n: Array, shared: Shared) -> Array:
    enu = np.einsum("kij,ksj->ksi", shared.problem.frame.C_to_enu(r_n), sat_n - r_n[:, None])
    return np.asarray(np.arctan2(enu[..., 0], enu[..., 1]))


def _small(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Single precision is enough to keep."""
    return {name: x.astype(np.float32) if x.dtype == np.float64 else x for name, x in arrays.items()}


def solve_graph(seed: int, start: int, data: Sequence[int]) -> dict[str, Any]:
    """The factor graph over the whole flight. It has no predicted velocity to disturb: data set 3 is data set 1 to it."""
    from factorgraph import registry
    from scenarios.studies.trials import wrong_times

    prepared = prepare(seed, start, "dd")
    done: dict[int, dict[str, Any]] = {}
    for number in data:
        same = {3: 1}.get(number, number)
        if same not in done:
            case = aar.data_set(prepared.flight, same)
            began = time.perf_counter()
            solution = registry.solve(case.problem, GRAPH)
            spent = time.perf_counter() - began
            flight = replace(prepared.flight.simulated, problem=case.problem)
            done[same] = _judge_graph(solution, wrong_times(flight, solution), spent)
    return {f"{number}/{GRAPH}/{name}": x for number in data for name, x in done[{3: 1}.get(number, number)].items()}


def _judge_graph(solution: Solution, wrong: set[int], spent: float) -> dict[str, Any]:
    """As `Truth.judge`. An epoch is fixed when every ambiguity observed then is held at an integer."""
    pair, table = solution.pairs[0], solution.ambiguities
    assert pair.truth_enu is not None and pair.truth_velocity_enu is not None
    error = pair.baseline_enu - pair.truth_enu
    unknown = np.full(len(pair.t_s), np.nan)
    held = pair.fix == Fix.FIXED.value
    for first, last, state in zip(table.t_start_s, table.t_end_s, table.state, strict=True):
        if state not in ("fixed", "datum"):
            held &= (pair.t_s < first - HALF_S) | (pair.t_s > last + HALF_S)
    return _small({
        "ratio": unknown,
        "adop_cyc": unknown,
        "success_rate": unknown,
        "correct": np.array([round(t) not in wrong for t in pair.t_s]) & held,
        "fixed": held,
        "baseline_error_m": error,
        "velocity_error_mps": pair.velocity_enu - pair.truth_velocity_enu,
        "main_baseline_error_m": error,
        "nees": nees(error, pair.P[:, :3, :3]),
        "runtime_s": np.array(spent),
    })  # fmt: skip


CODE_SIGMAS_M = (0.1, 0.2, 0.37, 0.6, 1.0, 1.5, 2.0, 3.0)  # of differences
INS_SIGMAS_M = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0)
BIASES_M = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)
BIASED_SIGMA_M = 0.1  # claimed of the biased prior
SWEEP_EPOCH = 300
HALF_S = 0.5  # of the interval between epochs


def sweep(seed: int) -> dict[str, Any]:
    """ADOP at 300 s against the precision of code and of an imposed INS prior, success rates with a biased one."""
    prepared = prepare(seed, 0, "dd")
    shared = _share(prepared.flight, prepared.flight.problem, prepared.tanker)
    truth = Truth.of(prepared, shared, aar.data_set(prepared.flight, 1))
    s = settings("dd", "3b")
    n = SWEEP_EPOCH + 1
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(7,)))
    unit = rng.normal(0.0, 1.0, (shared.data.n_epochs, 3))

    def prior(sigma: float, bias: float = 0.0) -> list[InsBaseline]:
        shift = bias / np.sqrt(3.0)
        return [InsBaseline(b + sigma * u + shift, sigma**2 * np.eye(3)) for b, u in zip(truth.baseline_n, unit, strict=True)]

    def rate(scheme: Scheme, ins: list[InsBaseline] | None) -> float:
        return float(np.mean(truth.correct(two_stage.float_solutions(shared, scheme, s.floats, ins=ins)[1])))

    def adop(scheme: Scheme, floats: FloatSettings, ins: list[InsBaseline] | None) -> float:
        found = two_stage.float_solutions(shared, scheme, floats, ins=ins, n_epochs=n)[1][SWEEP_EPOCH]
        assert found is not None
        return found.adop_cyc

    codes = [replace(s.floats, code_m=0.5 * sigma) for sigma in CODE_SIGMAS_M]
    aided = [two_stage.run(shared, Scheme.IEKF, replace(s, floats=c), n_epochs=n).adop_cyc[SWEEP_EPOCH] for c in codes]
    ekf, ekf_adop = rate(Scheme.EKF, None), adop(Scheme.EKF, s.floats, None)
    imposed = [prior(sigma) for sigma in INS_SIGMAS_M]
    p, wls = len(INS_SIGMAS_M), adop(Scheme.WLS, s.floats, None)
    return {
        "code_sigma_m": np.array(CODE_SIGMAS_M),
        "adop_code": np.array([
            [adop(Scheme.WLS, c, None) for c in codes], [adop(Scheme.EKF, c, None) for c in codes], aided,
        ]),
        "ins_sigma_m": np.array(INS_SIGMAS_M),
        "adop_ins": np.array([[wls] * p, [ekf_adop] * p, [adop(Scheme.IEKF, s.floats, ins) for ins in imposed]]),
        "success_ins": np.array([[ekf] * p, [rate(Scheme.IEKF, ins) for ins in imposed]]),
        "bias_m": np.array(BIASES_M),
        "success_bias": np.array([[ekf] * len(BIASES_M), [rate(Scheme.IEKF, prior(BIASED_SIGMA_M, b)) for b in BIASES_M]]),
    }  # fmt: skip


class ByDataSet(Mapping[JobKey, Arrays]):
    """Results of jobs cut by data set, those of filters and of the graph together; one file is kept open at a time."""

    def __init__(self, results: Results[Job]) -> None:
        self._results = results
        self._jobs: dict[JobKey, list[Job]] = {}
        for job in results:
            p = job.parameters
            for number in p["data"]:
                self._jobs.setdefault(JobKey(p["variant"], number, p["seed"], p["start"]), []).append(job)
        self._last: dict[str, Arrays] = {}

    def __getitem__(self, key: JobKey) -> Arrays:
        jobs = self._jobs[key]
        self._last = {job.key: self._last[job.key] if job.key in self._last else self._results[job] for job in jobs}
        if key.variant == SWEEP:
            return self._last[jobs[0].key]
        prefix = f"{key.data}/"
        merged = {name: x for arrays in self._last.values() for name, x in arrays.items()}
        return {name.removeprefix(prefix): x for name, x in merged.items() if name.startswith(prefix)}

    def __iter__(self) -> Iterator[JobKey]:
        return iter(sorted(self._jobs))

    def __len__(self) -> int:
        return len(self._jobs)
