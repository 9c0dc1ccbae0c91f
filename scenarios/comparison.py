"""Solutions of one flight side by side: errors at the same epochs, and the figures a table shows of them.

Epochs of a pair or vehicle are those of the method with fewest that all others cover; what has no state of its own there
is carried to it by `factorgraph.interpolation`, with the covariance of the state before. An epoch counts for a quantity
when every method that estimates it has an error there. Errors are against truth; where none is known, differences to the
first method take their place, and tell agreement, not accuracy.

    RMSE     sqrt(mean |e|^2) of the horizontal, vertical and all components; "95 %" is that percentile of |e|
    heading  rotation about the vertical: the up component of the attitude error
    NEES/dof mean of e' P^-1 e / 3 of position or baseline, 1 expected; band: two-sided 95 % per epoch
    NIS/dof  sum of NIS / sum of its degrees of freedom over the flight, 1 expected
    bound    sqrt(mean trace B) over the same epochs, B the posterior Cramer-Rao bound of the baseline

Source: Bar-Shalom et al. (2001), sec. 5.4.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from factorgraph.interpolation import earlier_state, interpolate, interpolate_pair
from factorgraph.measurements import ImuStream, Truth
from factorgraph.problem import NavigationProblem
from factorgraph.solution import Diagnostics, Fix, PairSolution, Solution, VehicleSolution
from factorgraph.types import Array, BoolArray
from scenarios.metrics import ErrorSeries, covered, fix_percentage, pair_errors, pair_name, statistics, vehicle_errors

TRUTH = "truth"
SAME_S = 1e-6  # times closer than this are one epoch
ALIKE = 0.005  # values that differ by less, relatively, are equally good
PLACES = ("baseline", "position")  # what horizontal, vertical and NEES are of

T = TypeVar("T")
Bound = tuple[Array, dict[tuple[str, str], Array]]  # times (K,); pair -> covariances (K, 6, 6)


@dataclass(frozen=True, slots=True)
class Cost:
    """What solving once cost, reading the flight not counted."""

    wall_s: float  # median of the runs
    cpu_s: float  # of all threads, median of the runs
    peak_mb: float  # largest resident memory over that before
    n_runs: int = 1


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a method went: its solution and cost, or why there is none."""

    method: str
    solution: Solution | None = None
    cost: Cost | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of the table."""

    key: str
    label: str
    unit: str
    best: float = 0.0  # the value it should be near; NaN: none is better


SUBJECT_METRICS = (
    Metric("horizontal_rmse_m", "horizontal RMSE", "m"),
    Metric("horizontal_p95_m", "horizontal 95 %", "m"),
    Metric("vertical_rmse_m", "vertical RMSE", "m"),
    Metric("vertical_p95_m", "vertical 95 %", "m"),
    Metric("rmse_m", "3D RMSE", "m"),
    Metric("p95_m", "3D 95 %", "m"),
    Metric("velocity_rmse_mps", "velocity RMSE", "m/s"),
    Metric("attitude_rmse_deg", "attitude RMSE", "°"),
    Metric("heading_rmse_deg", "heading RMSE", "°"),
    Metric("fixed_percent", "integers fixed", "%", 100.0),
    Metric("nees_per_dof", "NEES / dof", "", 1.0),
    Metric("nees_in_band_percent", "NEES in 95 % band", "%", 95.0),
    Metric("rmse_over_bound", "3D RMSE / bound", "", float("nan")),
)
METHOD_METRICS = (
    Metric("nis_per_dof", "NIS / dof", "", 1.0),
    Metric("iterations", "iterations", "", float("nan")),
    Metric("wall_s", "wall time", "s"),
    Metric("cpu_s", "CPU time", "s"),
    Metric("peak_mb", "peak memory", "MB"),
)


@dataclass(frozen=True, slots=True)
class Subject:
    """A pair or vehicle as every method sees it, at the same epochs."""

    name: str
    against: str  # TRUTH, or the method whose solution stands for it
    n_epochs: int  # with errors of every method
    errors: dict[str, tuple[ErrorSeries, ...]]  # by method: baseline or position, then the others; against `against`
    differences: dict[str, tuple[ErrorSeries, ...]]  # by method, to the first method, whose own are zero
    values: dict[str, dict[str, float]]  # by method, by key of SUBJECT_METRICS; NaN where not known
    bound_rmse_m: float = float("nan")

    @property
    def has_truth(self) -> bool:
        return self.against == TRUTH


@dataclass(frozen=True, slots=True)
class Comparison:
    """Everything a table or page of a comparison says."""

    name: str
    outcomes: tuple[Outcome, ...]
    subjects: tuple[Subject, ...]
    values: dict[str, dict[str, float]] = field(default_factory=dict)  # by method, by key of METHOD_METRICS

    @property
    def solutions(self) -> dict[str, Solution]:
        """Those of the methods that finished."""
        return {o.method: o.solution for o in self.outcomes if o.solution is not None}

    @property
    def failed(self) -> tuple[Outcome, ...]:
        return tuple(o for o in self.outcomes if o.solution is None)


def compared(outcomes: Sequence[Outcome], problem: NavigationProblem, bound: Bound | None = None) -> Comparison:
    """Errors and figures of all finished methods of a flight; differences are to the first one that has the subject."""
    found = {o.method: o.solution for o in outcomes if o.solution is not None}
    pairs = [
        _pair_subject(key, found, problem, bound)
        for key in _unique((p.reference, p.rover) for s in found.values() for p in s.pairs)
    ]
    moving = _unique(v.name for s in found.values() for v in s.vehicles if not v.is_fixed)
    vehicles = [_vehicle_subject(name, found, problem) for name in moving]
    values = {o.method: _method_values(o) for o in outcomes}
    return Comparison(problem.name, tuple(outcomes), tuple(s for s in (*pairs, *vehicles) if s is not None), values)


def best_of(metric: Metric, values: Mapping[str, float]) -> set[str]:
    """The methods whose value of a metric is best, or as good within ALIKE; none where all are, or none can be better."""
    known = {name: v for name, v in values.items() if np.isfinite(v)}
    if len(known) < 2 or not np.isfinite(metric.best):
        return set()
    # ratios to one: a half is as far from it as two is
    away = {m: abs(np.log(max(v, 1e-300))) if metric.best == 1.0 else abs(v - metric.best) for m, v in known.items()}
    best = known[min(away, key=lambda m: away[m])]
    alike = {m for m, v in known.items() if abs(v - best) <= ALIKE * abs(best)}
    return alike if len(alike) < len(known) else set()


def figure(metric: Metric, value: float) -> str:
    """A value as text, three significant digits, without its unit; a dash where it is not known."""
    if not np.isfinite(value):
        return "–"
    if metric.key == "iterations":
        return f"{value:.0f}"
    if metric.unit == "%":
        return f"{value:.1f}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _unique(items: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(items))


# epochs


def _common_times(times: Sequence[Array]) -> Array:
    """Times of the series with fewest epochs that all series cover."""
    base = min(times, key=len)
    keep = np.ones(len(base), bool)
    for t_s in times:
        if len(t_s) < 2:
            keep &= np.abs(base - t_s[0]) < SAME_S if len(t_s) else False
        else:
            keep &= covered(t_s, _snapped(base, t_s))
    return np.asarray(base[keep])


def _snapped(t_s: Array, to_s: Array) -> Array:
    """Times t_s (n,), those that a time of to_s is next to replaced by it."""
    after = np.clip(np.searchsorted(to_s, t_s), 0, len(to_s) - 1)
    before = np.maximum(after - 1, 0)
    near = np.where(np.abs(to_s[before] - t_s) < np.abs(to_s[after] - t_s), to_s[before], to_s[after])
    return np.where(np.abs(near - t_s) < SAME_S, near, t_s)


def _vehicle_at(solution: Solution, vehicle: VehicleSolution, imu: ImuStream | None, t_s: Array) -> VehicleSolution:
    """A vehicle at times within its solution; at its own states exactly."""
    at = _snapped(t_s, vehicle.t_s)
    k = earlier_state(vehicle.t_s, at)
    picked = replace(
        vehicle,
        t_s=t_s,
        r_n=vehicle.r_n[k],
        v_n=vehicle.v_n[k],
        q_nb=vehicle.q_nb[k],
        bias_gyro=vehicle.bias_gyro[k],
        bias_accel=vehicle.bias_accel[k],
        P=vehicle.P[k],
    )
    if np.array_equal(vehicle.t_s[k], at):
        return picked
    moved = interpolate(vehicle, imu, solution.frame, at)
    return replace(picked, r_n=moved.r_n, v_n=moved.v_n, q_nb=moved.q_nb)


def _pair_at(solution: Solution, pair: PairSolution, problem: NavigationProblem, t_s: Array) -> PairSolution:
    """A pair at times within its solution; at its own epochs exactly. Truth is known at those only."""
    at = _snapped(t_s, pair.t_s)
    k = earlier_state(pair.t_s, at)
    own = np.abs(pair.t_s[k] - at) < SAME_S

    def truth(values: Array | None) -> Array | None:
        return None if values is None else np.where(own[:, None], values[k], np.nan)

    picked = replace(
        pair,
        t_s=t_s,
        baseline_enu=pair.baseline_enu[k],
        velocity_enu=pair.velocity_enu[k],
        P=pair.P[k],
        fix=pair.fix[k],
        ratio=pair.ratio[k],
        n_sat=pair.n_sat[k],
        truth_enu=truth(pair.truth_enu),
        truth_velocity_enu=truth(pair.truth_velocity_enu),
    )
    if own.all():
        return picked
    (a, imu_a), (b, imu_b) = ((solution.vehicle(name), _imu(problem, name)) for name in (pair.reference, pair.rover))
    moved = interpolate_pair(a, b, imu_a, imu_b, solution.frame, at, pair.reference_lever_b, pair.rover_lever_b)
    return replace(picked, baseline_enu=moved.baseline_enu, velocity_enu=moved.velocity_enu)


def _imu(problem: NavigationProblem, name: str) -> ImuStream | None:
    """The IMU of a vehicle, or of the one that carries it; None for names that the problem does not know."""
    known = {v.name: v for v in problem.vehicles}
    return known[known[name].carrier or name].imu if name in known else None


# subjects


def _pair_subject(
    key: tuple[str, str], found: Mapping[str, Solution], problem: NavigationProblem, bound: Bound | None
) -> Subject | None:
    mine = {m: (s, p) for m, s in found.items() for p in s.pairs if (p.reference, p.rover) == key}
    t_s = _common_times([p.t_s for _, p in mine.values()])
    if not len(t_s):
        return None
    pairs = {m: _pair_at(s, p, problem, t_s) for m, (s, p) in mine.items()}
    first, reference = next(iter(pairs.items()))
    known = {m: np.isfinite(p.truth_enu).all(axis=1).sum() for m, p in pairs.items() if p.truth_enu is not None}
    known = {m: n for m, n in known.items() if n}
    differences = {
        m: tuple(pair_errors(replace(p, truth_enu=reference.baseline_enu, truth_velocity_enu=reference.velocity_enu)))
        for m, p in pairs.items()
    }
    if known:
        # each brings the truth at its own epochs: that of the sparsest is known at most of them
        true = pairs[max(known, key=lambda m: known[m])]
        errors = {
            m: tuple(pair_errors(replace(p, truth_enu=true.truth_enu, truth_velocity_enu=true.truth_velocity_enu)))
            for m, p in pairs.items()
        }
    else:
        errors = differences
    subject = _subject(pair_name(reference), TRUTH if known else first, errors, differences, list(pairs))
    for m, p in pairs.items():
        subject.values[m]["fixed_percent"] = fix_percentage(p.fix, Fix.FIXED) if np.any(p.fix != Fix.NONE.value) else np.nan
    if bound is None or key not in bound[1] or not known:
        return subject
    return _with_bound(subject, bound[0], bound[1][key])


def _with_bound(subject: Subject, grid_s: Array, covariance: Array) -> Subject:
    series = next((e for found in subject.errors.values() for e in found if e.quantity == "baseline"), None)
    if series is None:
        return subject
    t_s = series.t_s[np.isfinite(series.error).all(axis=1)]
    rmse = float(np.sqrt(np.mean(np.interp(t_s, grid_s, np.trace(covariance[:, :3, :3], axis1=1, axis2=2)))))
    for values in subject.values.values():
        values["rmse_over_bound"] = values["rmse_m"] / rmse
    return replace(subject, bound_rmse_m=rmse)


def _vehicle_subject(name: str, found: Mapping[str, Solution], problem: NavigationProblem) -> Subject | None:
    mine = {m: (s, v) for m, s in found.items() for v in s.vehicles if v.name == name}
    t_s = _common_times([v.t_s for _, v in mine.values()])
    if not len(t_s):
        return None
    vehicles = {m: _vehicle_at(s, v, _imu(problem, name), t_s) for m, (s, v) in mine.items()}
    first, reference = next(iter(vehicles.items()))
    truth = next((v.truth for v in vehicles.values() if v.truth is not None), None)
    stand_in = Truth(reference.t_s, reference.r_n, reference.v_n, reference.q_nb)
    differences = {m: tuple(vehicle_errors(replace(v, truth=stand_in))) for m, v in vehicles.items()}
    errors = {m: tuple(vehicle_errors(replace(v, truth=truth))) for m, v in vehicles.items()}
    known = any(errors.values())
    return _subject(name, TRUTH if known else first, errors if known else differences, differences, list(vehicles))


def _subject(
    name: str,
    against: str,
    errors: Mapping[str, tuple[ErrorSeries, ...]],
    differences: Mapping[str, tuple[ErrorSeries, ...]],
    methods: Sequence[str],
) -> Subject:
    judged, apart = _same_epochs(errors), _same_epochs(differences)
    counts = [int(np.isfinite(e.error).all(axis=1).sum()) for s in judged.values() for e in s if e.quantity in PLACES]
    # what stands for the truth has no errors
    values = {m: _values(() if m == against else judged.get(m, ()), against == TRUTH) for m in methods}
    return Subject(name, against, max(counts, default=0), judged, apart, values)


def _same_epochs(errors: Mapping[str, tuple[ErrorSeries, ...]]) -> dict[str, tuple[ErrorSeries, ...]]:
    """Errors made unknown at epochs at which another method's error of the quantity is."""
    usable: dict[str, BoolArray] = {}
    for series in (e for found in errors.values() for e in found):
        known = np.isfinite(series.error).all(axis=1)
        usable[series.quantity] = np.asarray(usable.get(series.quantity, known) & known)
    return {
        m: tuple(replace(e, error=np.where(usable[e.quantity][:, None], e.error, np.nan)) for e in found)
        for m, found in errors.items()
    }


# figures


def _values(errors: Sequence[ErrorSeries], against_truth: bool) -> dict[str, float]:
    values = {metric.key: float("nan") for metric in SUBJECT_METRICS}
    for series in errors:
        if series.quantity in PLACES:
            for part, columns in (("horizontal_", slice(0, 2)), ("vertical_", slice(2, 3)), ("", slice(0, 3))):
                stats = statistics(series.error[:, columns])
                values |= {f"{part}rmse_m": stats.rmse, f"{part}p95_m": stats.p95}
            if against_truth:
                nees = series.nees
                judged = nees.value[np.isfinite(nees.value)]
                values["nees_per_dof"] = float(np.mean(judged)) / 3 if len(judged) else float("nan")
                values["nees_in_band_percent"] = 100 * nees.share_inside
        elif series.quantity == "attitude":
            values["attitude_rmse_deg"] = float(np.rad2deg(statistics(series.error).rmse))
            values["heading_rmse_deg"] = float(np.rad2deg(statistics(series.error[:, 2]).rmse))
        else:
            values["velocity_rmse_mps"] = statistics(series.error).rmse
    return values


def _method_values(outcome: Outcome) -> dict[str, float]:
    values = {metric.key: float("nan") for metric in METHOD_METRICS}
    if outcome.solution is not None:
        diagnostics = outcome.solution.diagnostics
        values |= {"nis_per_dof": _nis_per_dof(diagnostics), "iterations": float(diagnostics.n_iterations)}
    if outcome.cost is not None:
        values |= {"wall_s": outcome.cost.wall_s, "cpu_s": outcome.cost.cpu_s, "peak_mb": outcome.cost.peak_mb}
    return values


def _nis_per_dof(diagnostics: Diagnostics) -> float:
    used = np.isfinite(diagnostics.nis) & (diagnostics.nis_dof > 0)
    return float(diagnostics.nis[used].sum() / diagnostics.nis_dof[used].sum()) if used.any() else float("nan")
