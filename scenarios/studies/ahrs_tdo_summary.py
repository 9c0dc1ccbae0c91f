"""Statistics of the study `ahrs-tdo`: trials reduced to numbers with intervals over the seeds.

    RMSE       of one seed over its epochs from SETTLED_S on, per axis of ECEF, or "3d" of the norm; then the mean over seeds
    std        standard deviation of the error of one seed, likewise
    manoeuvre  epochs from the start of a push to RECOVERED_S after its end, "quiet" all others
    NEES       of relative position and velocity (6); a filter is consistent where the mean over the seeds lies in its 99 %
               band at 90 % of the epochs
    bound      root of the mean square over seeds and epochs over that of the bound
    NIS        mean per row, with the 95 % band that white innovations would have

Intervals of means are Student's, of paired differences bootstrapped over the seeds; both filters of a pair saw the same noise.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, get_args

import numpy as np

from factorgraph.consistency import average_nees, mean_interval, nis_band
from factorgraph.types import Array, BoolArray
from scenarios.metrics_ranks import PairedTest, paired_test
from scenarios.published.ahrs_tdo import MANOEUVRES
from scenarios.published.ahrs_tdo_filters import CA_CV, FILTERS
from scenarios.studies.ahrs_tdo import BOUND, GRID, OTHERS, PHASES, RULES, SEARCH_METHODS, SEARCHES, TUNING
from scenarios.studies.statistics import (
    CONSISTENT_PCT,
    NAN,
    NEES_PROB,
    Metric,
    PairedDifference,
    Statistic,
    compared,
    gain_percent,
    mean_of_known,
)
from scenarios.studies.study import Arrays, Job, Results
from swarm.objective import Which

SETTLED_S = 60.0  # the first straight leg is not counted
RECOVERED_S = 7.0
SAME_END_S = 5.0  # flights that end this near to each other are equally long
AXES = "xyz"
PUBLISHED = "ahrs-tdo-o1"  # our reading of the published system
PLAIN = "ahrs"
EVEN = 1e-6  # relative differences of a searched minimum that do not matter
OBJECTIVES: tuple[Which, ...] = get_args(Which)
BOUND_SET = tuple(name for name in OTHERS if name != PHASES)  # estimators of what the bound is of

METRICS = {
    **{f"r_{axis}": Metric(f"position {axis.upper()}, RMSE", "m", -1) for axis in AXES},
    "r_3d": Metric("position, RMSE", "m", -1),
    **{f"v_{axis}": Metric(f"velocity {axis.upper()}, RMSE", "m/s", -1) for axis in AXES},
    "v_3d": Metric("velocity, RMSE", "m/s", -1),
    **{f"r_std_{axis}": Metric(f"position {axis.upper()}, std", "m", -1) for axis in AXES},
    "r_std": Metric("position, std", "m", -1),
    **{f"v_std_{axis}": Metric(f"velocity {axis.upper()}, std", "m/s", -1) for axis in AXES},
    "v_std": Metric("velocity, std", "m/s", -1),
    "r_p95": Metric("position, 95 % of epochs within", "m", -1),
    "v_p95": Metric("velocity, 95 % of epochs within", "m/s", -1),
    "r_manoeuvre": Metric("position at manoeuvres, RMSE", "m", -1),
    "v_manoeuvre": Metric("velocity at manoeuvres, RMSE", "m/s", -1),
    "r_quiet": Metric("position elsewhere, RMSE", "m", -1),
    "v_quiet": Metric("velocity elsewhere, RMSE", "m/s", -1),
    "triggered": Metric("updates corrected", "%", 0),
    "triggered_manoeuvre": Metric("updates corrected at manoeuvres", "%", 0),
    "triggered_quiet": Metric("updates corrected elsewhere", "%", 0),
    "nees": Metric("NEES, mean", "", 0),
    "nis": Metric("NIS per row, mean", "", 0),
    "runtime": Metric("runtime", "s", -1),
}


class Norms(NamedTuple):
    """Sizes of the errors of all seeds, (n,) each."""

    position_m: Array
    velocity_mps: Array


@dataclass(frozen=True)  # no slots: cached properties need a place
class Row:
    """One estimator over all seeds."""

    name: str
    seeds: tuple[int, ...]
    values: Mapping[str, Array]  # by METRICS (S,), NaN where a seed has none
    norms: Norms
    nees: Array  # (S, K)
    t_s: Array  # (K,)
    nis_band: tuple[float, float]  # of the mean over all seeds, per row

    def of(self, metric: str) -> Statistic | None:
        """A number with its interval over the seeds; None where no seed has it."""
        return statistic(self.values[metric]) if metric in self.values else None

    @cached_property
    def nees_consistent(self) -> float:
        """Percent of epochs at which the mean NEES over the seeds lies in its band."""
        return 100 * average_nees(self.t_s, self.nees, 6, NEES_PROB).share_inside

    @property
    def is_consistent(self) -> bool:
        return self.nees_consistent >= CONSISTENT_PCT

    @property
    def end_s(self) -> float:
        """Until when it saw the flight."""
        return float(self.t_s[-1])


Difference = PairedDifference[str]


@dataclass(frozen=True, slots=True)
class Search:
    """Methods on recorded updates with one objective: excess over Gauss-Newton's minimum, S seeds, U updates each."""

    objective: str
    excess: Mapping[str, Array]  # by method (S, U)
    history: Mapping[str, Array]  # by method (S, U, G)
    evals: Mapping[str, float]  # used, mean

    def score(self, method: str) -> Array:
        """Mean logarithm (S,) over a seed's updates of what the excess is taken as."""
        return np.asarray(np.mean(np.log10(np.maximum(self.excess[method], EVEN)), axis=1))

    def evals_to(self, method: str, excess: float) -> float:
        """Median evaluations after which a search is this near; infinite where most never are."""
        near = self.history[method].reshape(-1, len(GRID)) <= excess
        return float(np.median(np.where(near.any(axis=1), GRID[np.argmax(near, axis=1)], np.inf)))

    def against(self, first: str, second: str) -> PairedTest:
        """Paired test over the seeds, second less first."""
        return paired_test(self.score(first), self.score(second))


@dataclass(frozen=True, slots=True)
class Walks:
    """Tuning of a smooth motion, mean over the tuning seeds."""

    name: str
    walk: Array  # (W,)
    position_m: Array  # (W,)
    velocity_mps: Array
    n: int

    @property
    def merit(self) -> Array:
        """What is made small (W,): the geometric mean of both errors, each over its best."""
        return np.asarray(np.sqrt(self.position_m / self.position_m.min() * self.velocity_mps / self.velocity_mps.min()))

    @property
    def best(self) -> float:
        return float(self.walk[np.argmin(self.merit)])


@dataclass(frozen=True, slots=True)
class Summary:
    """Everything that the study says in numbers."""

    rows: Mapping[str, Row]  # in the order of FILTERS and OTHERS
    searches: Mapping[str, Search] = field(default_factory=dict)  # by objective
    rules: Mapping[str, Mapping[str, Statistic]] = field(default_factory=dict)  # by rule and mismatch, percent
    walks: Mapping[str, Walks] = field(default_factory=dict)  # by filter
    bound: Array | None = None  # (6,) RMS over the flight, position first

    def of(self, name: str, metric: str) -> Statistic | None:
        """A number of an estimator, None where it was not run."""
        return self.rows[name].of(metric) if name in self.rows else None

    def compare(self, metric: str, first: str, second: str) -> Difference | None:
        """Two estimators on their common seeds, None where there are none."""
        if not (first in self.rows and second in self.rows):
            return None
        a, b = self.rows[first], self.rows[second]
        common = [s for s in a.seeds if s in b.seeds]
        if metric not in a.values or metric not in b.values or not common:
            return None
        x, y = (row.values[metric][[row.seeds.index(s) for s in common]] for row in (a, b))
        known = np.isfinite(x) & np.isfinite(y)
        x, y = x[known], y[known]
        if not len(x):
            return None
        better = METRICS[metric].better * (y - x)
        percent = compared(x, y, gain_percent)
        return Difference(metric, first, second, compared(x, y), percent, int(np.sum(better > 0)), int(np.sum(better < 0)))

    def ratio(self, metric: str, first: str, second: str) -> Statistic | None:
        """first / second, seed by seed."""
        if self.compare(metric, first, second) is None:
            return None
        a, b = self.rows[first], self.rows[second]
        common = [s for s in a.seeds if s in b.seeds]
        return statistic(np.array([a.values[metric][a.seeds.index(s)] / b.values[metric][b.seeds.index(s)] for s in common]))

    def cdf_distance(self, metric: str, first: str, second: str) -> float:
        """Largest distance of the distributions of two estimators' error sizes, all seeds and epochs together."""
        x, y = (np.sort(getattr(self.rows[name].norms, metric)) for name in (first, second))
        at = np.concatenate([x, y])
        shares = [np.searchsorted(one, at, side="right") / max(len(one), 1) for one in (x, y)]
        return float(np.max(np.abs(shares[0] - shares[1])))

    @property
    def published_scene(self) -> list[Row]:
        """Estimators of the flight as published."""
        return [row for name, row in self.rows.items() if name in OTHERS or FILTERS[name].scene == "published"]

    @property
    def best(self) -> Row | None:
        """The estimator without carrier phases that has the smallest position error on the flight as published."""
        return self.best_of([row.name for row in self.published_scene if row.name != PHASES])

    def best_of(self, names: Collection[str]) -> Row | None:
        """That of the smallest position error, of those that saw as much of the flight as any estimator."""
        left_out = self.cut_short
        found = [row for name, row in self.rows.items() if name in names and name not in left_out]
        known = [row for row in found if np.isfinite(np.mean(row.values["r_3d"]))]
        return min(known, key=lambda row: float(np.mean(row.values["r_3d"])), default=None)

    @property
    def cut_short(self) -> list[str]:
        """Estimators that saw less of the flight than others."""
        whole = max((row.end_s for row in self.rows.values()), default=0.0)
        return [name for name, row in self.rows.items() if row.end_s < whole - SAME_END_S]

    def over_bound(self, name: str) -> list[Statistic | None]:
        """Errors of an estimator over the bound, in the order of `bound`; of none where either is missing."""
        if self.bound is None or name not in self.rows:
            return []
        values = self.rows[name].values
        errors = (values[f"{letter}_{axis}"] for letter in "rv" for axis in AXES)
        return [_root(statistic((x / least) ** 2)) for x, least in zip(errors, self.bound, strict=True)]

    @property
    def n_seeds(self) -> int:
        return max((len(row.seeds) for row in self.rows.values()), default=0)


def statistic(x: Array) -> Statistic | None:
    """Mean of seeds (S,) with Student's interval; None without a finite one."""
    x = np.asarray(x, float)
    x = x[np.isfinite(x)]
    if not len(x):
        return None
    found = mean_interval(x)
    lower, upper = (v if np.isfinite(v) else NAN for v in (found.lower, found.upper))
    return Statistic(found.value, lower, upper, float(x.min()), float(x.max()), len(x))


def _root(found: Statistic | None) -> Statistic | None:
    """Of a mean square."""
    if found is None:
        return None
    value, lower, upper, low, high = (float(np.sqrt(max(v, 0.0))) for v in found.numbers)
    return Statistic(value, lower, upper, low, high, found.n)


# trials


def summarise(results: Results[Job]) -> Summary:
    """What all jobs together say; trials are read one at a time."""
    trials: dict[str, dict[int, Trial]] = {}
    sidelines: dict[str, list[Arrays]] = {}
    for job, arrays in results.items():
        part = job.parameters["part"]
        if part in (BOUND, SEARCHES, RULES, TUNING):
            sidelines.setdefault(part, []).append(arrays)
            continue
        for name in estimators(arrays):
            trials.setdefault(name, {})[job.parameters["seed"]] = measure(arrays, name)
    order = [name for name in (*FILTERS, *OTHERS) if name in trials]
    return Summary(
        {name: _row(name, trials[name]) for name in order},
        _searches(sidelines.get(SEARCHES, [])),
        _rules(sidelines.get(RULES, [])),
        _walks(sidelines.get(TUNING, [])),
        next((_bound(arrays) for arrays in sidelines.get(BOUND, [])), None),
    )


def estimators(arrays: Arrays) -> list[str]:
    """Whose errors a trial holds."""
    return [name.partition("/")[0] for name in arrays if name.endswith("/nees")]


@dataclass(frozen=True, slots=True)
class Trial:
    """One estimator on one seed."""

    values: Mapping[str, float]
    norms: Norms
    nees: Array  # (K,)
    t_s: Array  # (K,)
    nis_rows: Array  # rows (k,) of every update


def measure(arrays: Arrays, name: str) -> Trial:
    """Numbers of one trial from SETTLED_S on; shorter flights are counted whole."""
    t_s = np.asarray(arrays["t_s"], float)
    counted = t_s >= SETTLED_S if t_s[-1] > SETTLED_S else np.ones(len(t_s), bool)
    t_s, mine = (
        t_s[counted],
        {w: np.asarray(arrays[f"{name}/{w}"], float)[counted] for w in ("position_error_m", "velocity_error_mps")},
    )
    r, v = mine["position_error_m"], mine["velocity_error_mps"]
    nees_of = np.asarray(arrays[f"{name}/nees"], float)[counted]
    inside = manoeuvring(t_s)
    norms = Norms(np.linalg.norm(r, axis=1), np.linalg.norm(v, axis=1))
    values: dict[str, float] = {"nees": mean_of_known(nees_of), "runtime": float(arrays[f"{name}/runtime_s"])}
    for letter, error, size in (("r", r, norms.position_m), ("v", v, norms.velocity_mps)):
        values |= {f"{letter}_{axis}": _rms(error[:, i]) for i, axis in enumerate(AXES)}
        values |= {f"{letter}_std_{axis}": float(np.std(error[:, i])) for i, axis in enumerate(AXES)}
        values |= {f"{letter}_3d": _rms(size), f"{letter}_std": float(np.sqrt(np.sum(np.var(error, axis=0))))}
        values |= {f"{letter}_p95": float(np.quantile(size, 0.95)) if np.isfinite(size).all() else NAN}
        values |= {f"{letter}_manoeuvre": _rms(size[inside]), f"{letter}_quiet": _rms(size[~inside])}
    rows = np.zeros(0)
    if f"{name}/nis" in arrays:
        nis, n_rows = (np.asarray(arrays[f"{name}/{w}"], float)[counted] for w in ("nis", "n_rows"))
        updated = n_rows > 0
        rows = n_rows[updated]
        values["nis"] = float(np.sum(nis[updated]) / np.sum(rows)) if len(rows) else NAN
        if name in FILTERS and FILTERS[name].correction is not None:
            hit = np.asarray(arrays[f"{name}/triggered"], bool)[counted]
            parts = (("triggered", updated), ("triggered_manoeuvre", updated & inside), ("triggered_quiet", updated & ~inside))
            values |= {what: 100 * mean_of_known(hit[at].astype(float)) for what, at in parts}
    return Trial(values, norms, nees_of, t_s, rows)


def manoeuvring(t_s: Array) -> BoolArray:
    """Epochs from the start of a push to RECOVERED_S after its end."""
    return np.asarray(np.any([(t_s >= a) & (t_s <= b + RECOVERED_S) for a, b in MANOEUVRES], axis=0))


def _row(name: str, trials: Mapping[int, Trial]) -> Row:
    seeds = tuple(sorted(trials))
    first = trials[seeds[0]]
    seeds = tuple(s for s in seeds if len(trials[s].t_s) == len(first.t_s))
    kept = [trials[s] for s in seeds]
    names = dict.fromkeys(name for trial in kept for name in trial.values)
    values = {what: np.array([trial.values.get(what, NAN) for trial in kept]) for what in names}
    rows = np.concatenate([trial.nis_rows for trial in kept])
    lower, upper = nis_band(rows) if len(rows) else (NAN, NAN)
    per = float(np.mean(rows)) if len(rows) else NAN
    norms = Norms(*(np.concatenate([getattr(trial.norms, what) for trial in kept]) for what in Norms._fields))
    return Row(name, seeds, values, norms, np.array([trial.nees for trial in kept]), first.t_s, (lower / per, upper / per))


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else NAN


# sidelines


def _searches(trials: Sequence[Arrays]) -> dict[str, Search]:
    found: dict[str, Search] = {}
    for which in OBJECTIVES if trials else ():
        methods = [m for m in SEARCH_METHODS if f"{which}/{m}/excess" in trials[0]]
        stacked = {
            what: {m: np.array([arrays[f"{which}/{m}/{what}"] for arrays in trials]) for m in methods}
            for what in ("excess", "history", "evals")
        }
        evals = {m: float(np.mean(x)) for m, x in stacked["evals"].items()}
        found[which] = Search(which, stacked["excess"], stacked["history"], evals)
    return found


def _rules(trials: Sequence[Arrays]) -> dict[str, dict[str, Statistic]]:
    """Mean over the updates of a seed, then over the seeds."""
    found: dict[str, dict[str, Statistic]] = {}
    for name in trials[0] if trials else ():
        rule, _, mismatch = name.partition("/")
        of = statistic(np.array([100 * np.mean(arrays[name]) for arrays in trials]))
        if of is not None:
            found.setdefault(rule, {})[mismatch] = of
    return found


def _walks(trials: Sequence[Arrays]) -> dict[str, Walks]:
    found = {}
    for name in ("cv", "ca") if trials else ():
        position, velocity = (np.mean([a[f"{name}/{what}"] for a in trials], axis=0) for what in ("position_m", "velocity_mps"))
        found[name] = Walks(name, np.asarray(trials[0]["walk"], float), position, velocity, len(trials))
    return found


def _bound(arrays: Arrays) -> Array:
    counted = np.asarray(arrays["t_s"]) >= SETTLED_S
    return np.asarray(np.sqrt(np.mean(np.square(np.asarray(arrays["sigma"], float)[counted]), axis=0)))


def title_of(name: str) -> str:
    """An estimator in words."""
    return FILTERS[name].title if name in FILTERS else OTHERS[name]


def pairs() -> Iterator[tuple[str, str]]:
    """First and second of every comparison of the record: the plain filter against all, and what the publication compares."""
    yield CA_CV, PLAIN
    yield CA_CV, PUBLISHED
    for name, one in FILTERS.items():
        if one.scene == "published" and name not in (PLAIN, "cv", "ca"):
            yield PLAIN, name
    for name, one in FILTERS.items():
        if one.scene != "published":
            yield (PLAIN if plain_of(name) == name else plain_of(name)), name
    yield "ahrs-tdo-o2", "ahrs-pso"
    yield "ahrs-tdo-o2", "ahrs-ga"
    yield "ahrs-tdo-o2", "ahrs-gauss-newton"


def plain_of(name: str) -> str:
    """The filter without correction on the same scene."""
    scene = FILTERS[name].scene
    return next(
        other
        for other, one in FILTERS.items()
        if one.scene == scene and one.correction is None and one.configuration.motion == "attitude"
    )
