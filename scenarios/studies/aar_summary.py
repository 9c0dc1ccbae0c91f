"""Statistics of the aerial-refuelling study: its trials reduced to numbers with intervals over the seeds.

Trials are read one at a time; of each only scalars are kept. An algorithm is an ambiguity scheme (1 WLS, 2 EKF, 3 IEKF,
4 IBRKF, 5 IBRCAF) with a main filter (a standard, SKF; b adaptive, AKF), or "graph". Errors are norms of three components.

    P_corr   epochs whose integer least-squares solution is right; the graph has none
    P_fix    epochs with ratio >= 3; of the graph, those at which every satellite used has its integer held
    P_SE     epochs that are fixed and right. All in percent of all epochs
    wrong    of the fixed epochs, those with a wrong integer
    ratio    second smallest over smallest squared norm; above 1000 it counts as 1000, epochs without one are left out
    NEES     of relative position and velocity (6), of the graph's baseline (3); an estimator is called consistent where
             the mean over the seeds lies in its 99 % band at 90 % of the epochs

Intervals are 95 % bootstrap intervals over the seeds, differences are paired: both methods saw the same noise.
Source: Wu and others 2022, eqs. 31 to 33, for ratio, ADOP and P_SE.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from factorgraph.consistency import band, mean_difference
from factorgraph.errors import InputError
from factorgraph.types import Array, BoolArray
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

FORMAT = 1
SCHEMES = {"1": "WLS", "2": "EKF", "3": "IEKF", "4": "IBRKF", "5": "IBRCAF"}
FILTERS = {"a": "SKF", "b": "AKF"}
GRAPH = "graph"
ALGORITHMS = (*(scheme + main for scheme in SCHEMES for main in FILTERS), GRAPH)
DEFAULT = "default"
SWEEP = "sweep"
RATIO_THRESHOLD = 3.0
RATIO_CAP = 1000.0
MANOEUVRES_S = (20.0, 65.0, 180.0, 300.0)  # where the flight state changes
MANOEUVRE_HALF_S = 5.0
DIGITS = 4  # significant, of every number of the summary


class JobKey(NamedTuple):
    """One trial of the study."""

    variant: str
    data: int
    seed: int
    start: int = 0


class Cell(NamedTuple):
    """What a row of the summary is about."""

    variant: str
    data: int
    algorithm: str
    start: int = 0


METRICS = {
    "p_corr": Metric("P_corr", "%", 1),
    "p_fix": Metric("P_fix", "%", 1),
    "p_se": Metric("P_SE", "%", 1),
    "wrong_fix": Metric("wrong of the fixed", "%", -1),
    "ratio_mean": Metric("ratio, mean", "", 1),
    "ratio_median": Metric("ratio, median", "", 1),
    "adop_mean": Metric("ADOP, mean", "cycles", -1),
    "success_rate": Metric("bootstrapped success rate, mean", "%", 1),
    "baseline_rms": Metric("baseline error RMS", "m", -1),
    "baseline_mean": Metric("baseline error, mean", "m", -1),
    "baseline_max": Metric("baseline error, largest", "m", -1),
    "baseline_rms_fixed": Metric("baseline error RMS, fixed", "m", -1),
    "baseline_mean_fixed": Metric("baseline error, mean, fixed", "m", -1),
    "baseline_max_fixed": Metric("baseline error, largest, fixed", "m", -1),
    "velocity_rms": Metric("velocity error RMS", "m/s", -1),
    "velocity_mean": Metric("velocity error, mean", "m/s", -1),
    "velocity_max": Metric("velocity error, largest", "m/s", -1),
    "velocity_rms_fixed": Metric("velocity error RMS, fixed", "m/s", -1),
    "main_rms": Metric("main filter's baseline error RMS", "m", -1),
    "main_max": Metric("main filter's baseline error, largest", "m", -1),
    "nees_mean": Metric("NEES, mean", "", 0),
    "nees_in_band": Metric("epochs with NEES in its 99 % band", "%", 0),
    "nis_mean": Metric("NIS per measurement, mean", "", 0),
    "ins_sigma": Metric("claimed σ of the INS position, median", "m", 0),
    "alpha_mean": Metric("adaptive factor, mean", "", 0),
    "adapted_wrong": Metric("epochs with a wrong fix at which the factor acts", "%", 0),
    "adapted_right": Metric("epochs with a right fix at which the factor acts", "%", 0),
    "runtime": Metric("runtime", "s", -1),
    "fault_ratio_median": Metric("ratio in fault windows, median", "", 1),
    "fault_p_se": Metric("P_SE in fault windows", "%", 1),
    "clear_p_se": Metric("P_SE outside fault windows", "%", 1),
    "fault_baseline_rms": Metric("baseline error RMS in fault windows", "m", -1),
    "fault_baseline_max": Metric("baseline error in fault windows, largest", "m", -1),
    "fault_velocity_max": Metric("velocity error in fault windows, largest", "m/s", -1),
    "velocity_manoeuvre": Metric("velocity error RMS at manoeuvre changes", "m/s", -1),
    "velocity_elsewhere": Metric("velocity error RMS elsewhere", "m/s", -1),
    "velocity_spike": Metric("velocity error RMS at manoeuvre changes over elsewhere", "", -1),
}


VARIANT_KEPT = (  # of other variants than the main set
    "p_corr", "p_fix", "p_se", "wrong_fix", "ratio_mean", "adop_mean", "baseline_rms", "baseline_rms_fixed", "velocity_rms",
    "velocity_max", "nees_mean", "adapted_wrong", "adapted_right", "fault_p_se", "fault_ratio_median",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """All numbers of one algorithm on one data set, by the names of `METRICS`; "name@20" is the one at or from 20 s."""

    cell: Cell
    n_epochs: int
    seeds: tuple[int, ...]
    nees_consistent: float  # % of epochs at which the mean NEES over the seeds is in its 99 % band
    statistics: Mapping[str, Statistic]

    @property
    def is_consistent(self) -> bool:
        return not self.nees_consistent < CONSISTENT_PCT

    def at_times(self, metric: str) -> list[tuple[float, Statistic]]:
        """The "metric@t" statistics by time [s]."""
        found = [(name.split("@"), value) for name, value in self.statistics.items() if "@" in name]
        return sorted((float(at), value) for (name, at), value in found if name == metric)


Difference = PairedDifference[Cell]


@dataclass(frozen=True, slots=True)
class Curve:
    """Means over seeds (labels, x) with intervals."""

    name: str
    x_title: str
    x: tuple[float, ...]
    labels: tuple[str, ...]
    mean: tuple[tuple[float, ...], ...]
    lower: tuple[tuple[float, ...], ...]
    upper: tuple[tuple[float, ...], ...]
    n: int

    def of(self, label: str) -> tuple[Array, Array, Array]:
        """Mean, lower and upper (x,) of one label."""
        i = self.labels.index(label)
        return np.array(self.mean[i]), np.array(self.lower[i]), np.array(self.upper[i])


@dataclass(frozen=True, slots=True)
class Summary:
    """Everything the study says in numbers."""

    rows: tuple[Row, ...] = ()
    differences: tuple[Difference, ...] = ()
    curves: tuple[Curve, ...] = ()
    sweep: Mapping[str, Statistic] = field(default_factory=dict)

    def row(self, algorithm: str, data: int, variant: str = DEFAULT, start: int = 0) -> Row | None:
        cell = Cell(variant, data, algorithm, start)
        return next((row for row in self.rows if row.cell == cell), None)

    def statistic(self, metric: str, algorithm: str, data: int, variant: str = DEFAULT, start: int = 0) -> Statistic | None:
        row = self.row(algorithm, data, variant, start)
        return None if row is None else row.statistics.get(metric)

    def difference(self, metric: str, first: Cell, second: Cell) -> Difference | None:
        return next((d for d in self.differences if (d.metric, d.first, d.second) == (metric, first, second)), None)

    def curve(self, name: str) -> Curve | None:
        return next((curve for curve in self.curves if curve.name == name), None)

    def seeds(self, data: int, variant: str = DEFAULT, start: int = 0) -> tuple[int, ...]:
        """Seeds of a data set, those of any algorithm."""
        rows = (row for row in self.rows if (row.cell.variant, row.cell.data, row.cell.start) == (variant, data, start))
        return tuple(sorted({seed for row in rows for seed in row.seeds}))


def algorithm_name(algorithm: str) -> str:
    """As it is called in tables: "IBRCAF-AKF (5b)"."""
    if algorithm == GRAPH:
        return "factor graph"
    return f"{SCHEMES[algorithm[0]]}-{FILTERS[algorithm[1]]} ({algorithm})"


def metric_of(name: str) -> Metric:
    """What a statistic's name means, those at times included."""
    base, _, at = name.partition("@")
    metric = METRICS[base] if base in METRICS else Metric(base, "", 0)
    return Metric(f"{metric.title} at {at} s", metric.unit, metric.better) if at else metric


def summarise(results: Mapping[JobKey, Mapping[str, Array]]) -> Summary:
    """Reduce the arrays of all jobs, loading one job at a time.

    Raises InputError where the trials of one data set differ in their epochs.
    """
    trials = _Trials()
    sweeps: dict[str, list[Array]] = defaultdict(list)
    for key in sorted(results):
        arrays = results[key]
        if key.variant == SWEEP:
            for name in SWEEP_ARRAYS:
                if name in arrays:
                    sweeps[name].append(np.asarray(arrays[name], float))
        else:
            trials.add(key, arrays)
    curves, sweep = _sweep(sweeps)
    return Summary(trials.rows(), trials.differences(), curves, sweep)


# one trial


def algorithms(arrays: Mapping[str, Array]) -> list[str]:
    """Those whose results a trial holds."""
    return [name for name in ALGORITHMS if f"{name}/correct" in arrays]


def windows(faulted: BoolArray) -> list[slice]:
    """Unbroken runs of faulted epochs (K,)."""
    edge = np.flatnonzero(np.diff(np.concatenate([[False], faulted, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in zip(edge[::2], edge[1::2], strict=True)]


def capped(ratio: Array) -> Array:
    """Ratios as they enter means: what is beyond the cap counts as the cap, NaN stays."""
    return np.minimum(ratio, RATIO_CAP)


def measure(arrays: Mapping[str, Array], algorithm: str, data: int) -> dict[str, float]:
    """The numbers of one algorithm in one trial, by the names of `METRICS`; unknown ones are left out."""
    t_s = np.asarray(arrays["t_s"], float)
    K = len(t_s)

    def get(name: str) -> Array:
        key = f"{algorithm}/{name}"
        return np.asarray(arrays[key], float) if key in arrays else np.full(K, np.nan)

    def size(name: str) -> Array:
        found = get(name)
        return np.linalg.norm(found, axis=1) if found.ndim == 2 else found

    right, fixed = get("correct") > 0, get("fixed") > 0
    success = right & fixed
    ratio, baseline, velocity, main = (
        capped(get("ratio")),
        size("baseline_error_m"),
        size("velocity_error_mps"),
        size("main_baseline_error_m"),
    )
    found = {
        "p_corr": _percent(right) if algorithm != GRAPH else NAN,
        "p_fix": _percent(fixed),
        "p_se": _percent(success),
        "wrong_fix": _percent(~right[fixed]),
        "ratio_mean": mean_of_known(ratio),
        "ratio_median": _median(ratio),
        "adop_mean": mean_of_known(get("adop_cyc")),
        "success_rate": 100 * mean_of_known(get("success_rate")),
        "main_rms": _rms(main),
        "main_max": _largest(main),
        "nis_mean": mean_of_known(get("nis")),
        "ins_sigma": _median(get("ins_sigma_m")),
        "runtime": mean_of_known(get("runtime_s").reshape(-1)),
    }
    for name, values in (("baseline", baseline), ("velocity", velocity)):
        for suffix, kept in (("", values), ("_fixed", values[fixed])):
            found |= {
                f"{name}_rms{suffix}": _rms(kept),
                f"{name}_mean{suffix}": mean_of_known(kept),
                f"{name}_max{suffix}": _largest(kept),
            }
    found |= _consistency(get("nees"), algorithm) | _adaptation(get("alpha"), fixed, right)
    faulted = np.asarray(arrays["faulted"], bool) if "faulted" in arrays else np.zeros(K, bool)
    if faulted.any():
        found |= _in_windows(t_s, faulted, ratio, success, baseline, velocity)
    if data == 1:
        found |= _at_manoeuvres(t_s, velocity)
    return {name: value for name, value in found.items() if np.isfinite(value) and name.split("@")[0] in METRICS}


def _consistency(nees: Array, algorithm: str) -> dict[str, float]:
    known = nees[np.isfinite(nees)]
    lower, upper = band(float(nees_dimension(algorithm)), NEES_PROB)
    return {"nees_mean": mean_of_known(known), "nees_in_band": _percent((known >= lower) & (known <= upper))}


def nees_dimension(algorithm: str) -> int:
    """Components of the error whose NEES is stored."""
    return 3 if algorithm == GRAPH else 6


def _adaptation(alpha: Array, fixed: BoolArray, right: BoolArray) -> dict[str, float]:
    if not np.isfinite(alpha).any():
        return {}
    acts = alpha < 1
    wrong = acts[fixed & ~right]
    return {"alpha_mean": mean_of_known(alpha), "adapted_wrong": _percent(wrong), "adapted_right": _percent(acts[fixed & right])}


def _in_windows(
    t_s: Array, faulted: BoolArray, ratio: Array, success: BoolArray, baseline: Array, velocity: Array
) -> dict[str, float]:
    found = {
        "fault_ratio_median": _median(ratio[faulted]),
        "fault_p_se": _percent(success[faulted]),
        "clear_p_se": _percent(success[~faulted]),
        "fault_baseline_rms": _rms(baseline[faulted]),
        "fault_baseline_max": _largest(baseline[faulted]),
        "fault_velocity_max": _largest(velocity[faulted]),
    }
    for w in windows(faulted):
        at = f"@{t_s[w][0]:g}"
        found |= {f"fault_ratio_median{at}": _median(ratio[w]), f"fault_p_se{at}": _percent(success[w])}
        found |= {f"fault_baseline_max{at}": _largest(baseline[w])}
    return found


def _at_manoeuvres(t_s: Array, velocity: Array) -> dict[str, float]:
    near = np.abs(t_s[:, None] - np.array(MANOEUVRES_S)) <= MANOEUVRE_HALF_S
    found = {f"velocity_manoeuvre@{at:g}": _rms(velocity[near[:, i]]) for i, at in enumerate(MANOEUVRES_S)}
    inside, outside = _rms(velocity[near.any(axis=1)]), _rms(velocity[~near.any(axis=1)])
    spike = inside / outside if outside > 0 else float("nan")
    return found | {"velocity_manoeuvre": inside, "velocity_elsewhere": outside, "velocity_spike": spike}


def _percent(hits: BoolArray) -> float:
    return 100 * float(np.mean(hits)) if hits.size else float("nan")


def _finite(x: Array) -> Array:
    return x[np.isfinite(x)]


def _median(x: Array) -> float:
    x = _finite(x)
    return float(np.median(x)) if x.size else float("nan")


def _rms(x: Array) -> float:
    x = _finite(x)
    return float(np.sqrt(np.mean(x**2))) if x.size else float("nan")


def _largest(x: Array) -> float:
    x = _finite(x)
    return float(np.max(x)) if x.size else float("nan")


# over the seeds


class _Trials:
    """Scalars of every trial and running sums of the NEES, no arrays of trials."""

    def __init__(self) -> None:
        self.values: dict[Cell, dict[int, dict[str, float]]] = defaultdict(dict)
        self.nees: dict[Cell, tuple[Array, Array]] = {}  # sum and count, (K,)

    def add(self, key: JobKey, arrays: Mapping[str, Array]) -> None:
        K = len(arrays["t_s"])
        for algorithm in algorithms(arrays):
            cell = Cell(key.variant, key.data, algorithm, key.start)
            total, count = self.nees.setdefault(cell, (np.zeros(K), np.zeros(K)))
            if len(total) != K:
                raise InputError(f"{key}: {K} epochs, other trials of this data set have {len(total)}; run them again alike")
            self.values[cell][key.seed] = measure(arrays, algorithm, key.data)
            if f"{algorithm}/nees" in arrays:
                nees = np.asarray(arrays[f"{algorithm}/nees"], float)
                total += np.where(np.isfinite(nees), nees, 0.0)
                count += np.isfinite(nees)

    def rows(self) -> tuple[Row, ...]:
        return tuple(self._row(cell) for cell in sorted(self.values, key=_order))

    def _row(self, cell: Cell) -> Row:
        seeds, values = tuple(sorted(self.values[cell])), self.values[cell]
        names = dict.fromkeys(name for seed in seeds for name in values[seed])
        names = names if cell.variant == DEFAULT else {name: None for name in names if name in VARIANT_KEPT}
        statistics = {name: _statistic(np.array([values[s][name] for s in seeds if name in values[s]])) for name in names}
        total, count = self.nees[cell]
        consistent = _rounded(_nees_consistent(total, count, nees_dimension(cell.algorithm)))
        return Row(cell, len(total), seeds, consistent, statistics)

    def differences(self) -> tuple[Difference, ...]:
        found = []
        for metric, first, second in _comparisons(sorted(self.values, key=_order)):
            a, b = self.values[first], self.values[second]
            seeds = [seed for seed in sorted(a) if seed in b and metric in a[seed] and metric in b[seed]]
            if seeds:
                x, y = (np.array([v[seed][metric] for seed in seeds]) for v in (a, b))
                found.append(_difference(metric, first, second, x, y))
        return tuple(found)


def _order(cell: Cell) -> tuple[bool, str, int, int, int]:
    return cell.variant != DEFAULT, cell.variant, cell.data, cell.start, ALGORITHMS.index(cell.algorithm)


def _nees_consistent(total: Array, count: Array, dimension: int) -> float:
    """% of epochs at which the mean over the trials lies in the band of that mean."""
    judged = count > 0
    if not judged.any():
        return float("nan")
    lower, upper = band(dimension * count[judged], NEES_PROB)
    return _percent((total[judged] >= lower) & (total[judged] <= upper))


def _statistic(x: Array) -> Statistic:
    return _compared(np.zeros_like(x), x)


def _compared(a: Array, b: Array, compare: Callable[[Array, Array], Array] = mean_difference) -> Statistic:
    """Like `compared`, to the digits of the summary."""
    found = compared(a, b, compare)
    value, lower, upper, low, high = map(_rounded, found.numbers)
    return Statistic(value, lower, upper, low, high, found.n)


def _difference(metric: str, first: Cell, second: Cell, a: Array, b: Array) -> Difference:
    sign = metric_of(metric).better
    usable = np.all(a != 0)  # a percentage of nothing is not known
    percent = _compared(a, b, gain_percent) if usable else Statistic(NAN, NAN, NAN, NAN, NAN, len(a))
    won, lost = int(np.sum(sign * (b - a) > 0)), int(np.sum(sign * (b - a) < 0))
    return Difference(metric, first, second, _compared(a, b), percent, won, lost)


SCHEME_METRICS = ("p_se", "ratio_mean", "baseline_rms", "velocity_rms")
FAULT_METRICS = ("fault_p_se",)
FILTER_METRICS = ("baseline_rms", "velocity_rms", "velocity_max", "p_se", "velocity_manoeuvre", "velocity_elsewhere")
SCHEME_PAIRS = ("12", "23", "13", "34", "45", "3g", "5g")


def _comparisons(cells: list[Cell]) -> Iterator[tuple[str, Cell, Cell]]:
    """Metric, first and second of everything that is compared: schemes beside the same main filter, filters, variants."""
    here = set(cells)

    def of(data: int, digit: str, main: str) -> Cell:
        return Cell(DEFAULT, data, GRAPH if digit == "g" else digit + main)

    wanted: list[tuple[tuple[str, ...], Cell, Cell]] = []
    for data in sorted({cell.data for cell in cells}):
        for main in FILTERS:
            for pair in SCHEME_PAIRS:
                wanted.append((SCHEME_METRICS + FAULT_METRICS, of(data, pair[0], main), of(data, pair[1], main)))
            if data != 1:
                wanted += [(("p_se",), of(1, digit, main), of(data, digit, main)) for digit in SCHEMES]
        for digit in SCHEMES:
            wanted.append((FILTER_METRICS, of(data, digit, "a"), of(data, digit, "b")))
    for cell in cells:
        if cell.variant != DEFAULT and cell.start == 0:
            wanted.append((("p_se",), Cell(DEFAULT, cell.data, cell.algorithm), cell))
    for metrics, one, other in wanted:
        if one in here and other in here:
            yield from ((metric, one, other) for metric in metrics)


# sweeps of figures 7 and 8

SWEEP_ARRAYS = ("code_sigma_m", "adop_code", "ins_sigma_m", "adop_ins", "success_ins", "bias_m", "success_bias")
SWEEP_LABELS = ("WLS", "EKF", "IEKF")
SWEEP_CURVES = (  # name, abscissa, its title, labels, factor
    ("adop_code", "code_sigma_m", "code σ [m]", SWEEP_LABELS, 1.0),
    ("adop_ins", "ins_sigma_m", "INS position σ [m]", SWEEP_LABELS, 1.0),
    ("success_ins", "ins_sigma_m", "INS position σ [m]", SWEEP_LABELS[1:], 100.0),
    ("success_bias", "bias_m", "bias of the INS position [m]", SWEEP_LABELS[1:], 100.0),
)


def _sweep(arrays: Mapping[str, list[Array]]) -> tuple[tuple[Curve, ...], dict[str, Statistic]]:
    """Curves over the seeds and the numbers the claims need: slopes (cycles per metre) and the excess of IEKF over EKF."""
    curves: list[Curve] = []
    numbers: dict[str, Statistic] = {}
    for name, abscissa, title, labels, factor in SWEEP_CURVES:
        if not arrays.get(name) or not arrays.get(abscissa):
            continue
        x = arrays[abscissa][0]
        if any(y.shape != (len(labels), len(x)) for y in arrays[name]):
            raise InputError(f"sweep: {name} must have shape ({len(labels)}, {len(x)}) in every trial")
        y = factor * np.array(arrays[name])  # (seeds, labels, x)
        curves.append(_curve(name, title, x, labels, y))
        if name == "adop_code":
            slope = np.array([[np.polyfit(x, row, 1)[0] for row in seed] for seed in y])
            numbers |= {f"slope {label}": _statistic(slope[:, i]) for i, label in enumerate(labels)}
            numbers |= {f"slope WLS-{labels[i]}": _compared(slope[:, i], slope[:, 0]) for i in (1, 2)}
        if name == "adop_ins":
            excess = 100 * (y[:, 2] / y[:, 1] - 1)
            numbers["largest excess of IEKF"] = _statistic(excess.max(axis=1))
            curves.append(_curve("adop_ins_excess", title, x, ("IEKF",), excess[:, None]))
        if name == "success_bias":
            curves.append(_curve("success_bias_gain", title, x, ("IEKF",), y[:, 1:] - y[:, :1]))
    return tuple(curves), numbers


def _curve(name: str, title: str, x: Array, labels: tuple[str, ...], y: Array) -> Curve:
    points = [[_statistic(y[:, i, j]) for j in range(len(x))] for i in range(len(labels))]

    def table(part: str) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(float(getattr(point, part)) for point in row) for row in points)

    abscissa = tuple(_rounded(v) for v in x)
    return Curve(name, title, abscissa, labels, table("value"), table("lower"), table("upper"), len(y))


# JSON


def to_json(summary: Summary) -> dict[str, Any]:
    """The summary as plain lists and dictionaries; unknown numbers are None."""
    return {
        "format": FORMAT,
        "statistic": ["mean", "lower", "upper", "smallest seed", "largest seed", "seeds where not n_seeds"],
        "rows": [
            {
                "cell": list(row.cell),
                "epochs": row.n_epochs,
                "seeds": _runs(row.seeds),
                "n_seeds": len(row.seeds),
                "nees_consistent": _plain(row.nees_consistent),
                "statistics": {name: _listed(value, len(row.seeds)) for name, value in row.statistics.items()},
            }
            for row in summary.rows
        ],
        "differences": [
            [d.metric, list(d.first), list(d.second), _listed(d.difference), _listed(d.percent), d.better, d.worse]
            for d in summary.differences
        ],
        "curves": [
            {"name": c.name, "x_title": c.x_title, "x": list(c.x), "labels": list(c.labels), "n": c.n}
            | {part: [[_plain(v) for v in row] for row in getattr(c, part)] for part in ("mean", "lower", "upper")}
            for c in summary.curves
        ],
        "sweep": {name: _listed(value) for name, value in summary.sweep.items()},
    }


def from_json(content: Mapping[str, Any]) -> Summary:
    """A summary from what `to_json` made of it. Raises InputError for another format."""
    if content.get("format") != FORMAT:
        raise InputError(f"results of the refuelling study: format {content.get('format')!r}, this version reads {FORMAT}")
    rows = tuple(
        Row(
            Cell(*row["cell"]),
            row["epochs"],
            tuple(seed for first, last in row["seeds"] for seed in range(first, last + 1)),
            _number(row["nees_consistent"]),
            {name: _read(value, row["n_seeds"]) for name, value in row["statistics"].items()},
        )
        for row in content["rows"]
    )
    differences = tuple(
        Difference(metric, Cell(*first), Cell(*second), _read(difference), _read(percent), better, worse)
        for metric, first, second, difference, percent, better, worse in content["differences"]
    )
    curves = tuple(_read_curve(c) for c in content["curves"])
    return Summary(rows, differences, curves, {name: _read(value) for name, value in content["sweep"].items()})


def _read_curve(c: Mapping[str, Any]) -> Curve:
    mean, lower, upper = (tuple(tuple(_number(v) for v in row) for row in c[part]) for part in ("mean", "lower", "upper"))
    return Curve(c["name"], c["x_title"], tuple(c["x"]), tuple(c["labels"]), mean, lower, upper, c["n"])


def _runs(seeds: tuple[int, ...]) -> list[list[int]]:
    """First and last of every unbroken run of ascending seeds."""
    runs: list[list[int]] = []
    for seed in seeds:
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return runs


def _listed(s: Statistic, n_usual: int = 0) -> list[float | int | None]:
    """The numbers of a statistic; the number of seeds only where it is not the usual one."""
    return [*map(_plain, s.numbers), *([] if s.n == n_usual else [s.n])]


def _read(found: list[Any], n_usual: int = 0) -> Statistic:
    value, lower, upper, low, high = (_number(v) for v in found[:5])
    return Statistic(value, lower, upper, low, high, int(found[5]) if len(found) > 5 else n_usual)


def _plain(value: float) -> float | int | None:
    if not np.isfinite(value):
        return None
    return int(value) if value == int(value) else value


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else float("nan")
