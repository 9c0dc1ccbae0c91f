"""The publication's claims about aerial refuelling, each with our number and a verdict that follows from it.

How verdicts follow stands in `scenarios.studies.verdicts`; the publication's numbers come from one run on unknown satellites.

The publication speaks of schemes without a main filter. What it says of one is judged beside the standard main filter
(SKF) and beside the adaptive one (AKF): reproduced where it holds with both, partly where it holds with one or where only
one was run. A claim of which nothing was run is not tested. Source: Wu and others 2022: table 2, figures 5 to 24, section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scenarios.published.aar import DATA_SETS
from scenarios.studies.aar_summary import (
    ALGORITHMS,
    DEFAULT,
    FILTERS,
    GRAPH,
    RATIO_THRESHOLD,
    SCHEMES,
    Cell,
    Difference,
    Row,
    Summary,
    algorithm_name,
)
from scenarios.studies.statistics import Statistic
from scenarios.studies.verdicts import (
    CHECK_WORDS,
    Claim,
    Verdict,
    at_least_zero,
    at_most,
    holds,
    near,
    negated,
    plain,
    positive,
    seed_count,
    shifted,
    shown,
    together,
    untested,
)

PAPER_SUCCESS = {  # table 2, P_SE in percent
    "1": {1: 57.5, 2: 43.6},
    "2": {1: 88.1, 2: 73.7, 3: 84.0, 4: 81.1},
    "3": {1: 94.4, 2: 81.3, 3: 87.5, 4: 84.2},
    "4": {2: 94.6, 3: 89.2, 4: 87.9},
    "5": {3: 93.7, 4: 93.8},
}
PAPER_RATIO = {  # figure 12 and section 3.2.1, mean ratio
    "1": {1: 4.35, 2: 3.26},
    "2": {1: 6.21, 2: 6.11, 3: 6.98, 4: 6.01},
    "3": {1: 13.03, 2: 9.21, 3: 7.92, 4: 7.31},
    "4": {2: 12.11, 3: 9.31, 4: 8.77},
    "5": {3: 12.43, 4: 12.17},
}
PAPER_GAIN = (("ratio_mean", "2", "3", 109.8), ("p_se", "2", "3", 7.2), ("p_se", "1", "3", 64.2))  # section 3.2.1, percent
PAPER_FILTER_GAIN = (("baseline_rms", 11.11), ("velocity_rms", 30.76))  # section 3.2.2, IEKF-SKF to IEKF-AKF, percent
PAPER_LARGEST = {("4b", 2): (0.76, 0.08), ("5b", 3): (0.55, 0.05), ("5b", 4): (0.45, 0.06)}  # section 3.2.2, m and m/s
PAPER_RMS = {("5b", 4): (0.056, 0.009)}  # section 3.2.2, m and m/s
PAPER_MEANS = (0.10, 0.02)  # conclusion 3, IEKF-AKF, m and m/s
PAPER_ALGORITHMS = {1: ALGORITHMS[:6], 2: ALGORITHMS[:8], 3: ALGORITHMS[2:10], 4: ALGORITHMS[2:10]}  # section 3.2.2
PAPER_INS_LIMIT_M = 1.5  # figure 8
GRAPH_SUCCESS_PCT, GRAPH_RMS_M = 99.5, 0.015
GRAPH_SEES = {  # what differs from what the filters are given
    3: "The graph has no predicted velocity to disturb: Data 3 is Data 1 to it.",
    4: "The graph has no predicted velocity to disturb: of Data 4 it has the code errors alone.",
}
GRAPH_TOLD = (
    "The graph is told the simulated noise, which is the same at all elevations; the filters are told the publication's "
    "elevation model, 2 to 6.6 times larger in variance."
)

SUCCESS_NEAR, SUCCESS_FAR = 3.0, 10.0  # points
RATIO_NEAR, RATIO_FAR = 0.15, 0.40  # of the paper's number
MIN_SEEDS = 50  # asked of comparisons of success rates
WLS_DROP_LIMIT = 3.7  # points: the share of faulted epochs, 44 of 1201
ELSEWHERE_LIMIT_PCT = 5.0
DATA4_RMS_M = 0.10
UNLIKE_POINTS = 10.0
SEES_LITTLE_PCT = 5.0
NOTHING_PCT = 1e-3  # rounding of an ADOP


def claims(summary: Summary) -> list[Claim]:
    """Every claim, judged by the numbers of the summary."""
    return [
        *_table_cells(summary),
        *_orders(summary),
        *_gains(summary),
        *_windows(summary),
        *_main_filters(summary),
        *_positions(summary),
        *_sweeps(summary),
        *_doubts(summary),
        *_graph(summary),
        *_checks(summary),
    ]


# words


def _span(found: Statistic, unit: str = "", form: str = ".3g") -> str:
    if found.n < 2:
        return "One seed"
    return f"Seeds span {plain(found.low, form)} to {plain(found.high, form)}{' ' if unit else ''}{unit}"


def _missing(names: Sequence[str], data: int | None = None) -> str:
    where = "" if data is None else f" on Data {data}"
    return ", ".join(names) + where


def _gap(difference: Difference, unit: str = "", form: str = ".3g") -> str:
    d = difference.difference
    wins = f"better in {difference.better} of {seed_count(d.n)}"
    first, second = (algorithm_name(cell.algorithm) for cell in (difference.first, difference.second))
    return f"{second} less {first}: {shown(d, unit, form)}, {wins}"


# schemes, beside each main filter


class Part(NamedTuple):
    """What is found beside one main filter."""

    verdict: Verdict
    ours: str
    evidence: str


def _by_filter(
    id: str, text: str, paper: str, missing: str, judge: Callable[[str], Part | None], is_check: bool = False
) -> Claim:
    """A claim about schemes from what `judge` finds for "a" (SKF) and "b" (AKF), None where it was not run."""
    found = {name: part for letter, name in FILTERS.items() if (part := judge(letter)) is not None}
    if not found:
        return untested(id, text, paper, missing, is_check)
    verdict = together(part.verdict for part in found.values())
    if len(found) < len(FILTERS) and verdict is Verdict.REPRODUCED:
        verdict = Verdict.PARTLY
    said = dict.fromkeys(part.evidence for part in found.values())
    same = len(said) == 1 and len(found) == len(FILTERS)
    evidence = _capital(next(iter(said))) if same else " ".join(f"{name}: {part.evidence}" for name, part in found.items())
    if len({part.verdict for part in found.values()}) > 1:
        words = (f"with the {name} {_word(part.verdict, is_check)}" for name, part in found.items())
        evidence = f"{_capital(', '.join(words))}. {evidence}"
    evidence += "".join(f" Not run with the {name}." for name in FILTERS.values() if name not in found)
    ours = dict.fromkeys(part.ours for part in found.values())
    numbers = [f"{' and '.join(name for name, part in found.items() if part.ours == value)}: {value}" for value in ours]
    return Claim(id, text, paper, "; ".join(numbers), verdict, evidence, is_check)


def _word(verdict: Verdict, is_check: bool) -> str:
    return CHECK_WORDS[verdict] if is_check else verdict.value


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _scheme_difference(summary: Summary, metric: str, data: int, first: str, second: str, main: str) -> Difference | None:
    """Between two schemes beside one main filter."""
    return summary.difference(metric, Cell(DEFAULT, data, first + main), Cell(DEFAULT, data, second + main))


def robust_advantages(summary: Summary) -> list[str]:
    """Beside which main filters the robust and adaptive schemes succeed more often: in all, then each comparison."""
    compared = ((2, "3", "4"), (3, "3", "4"), (4, "3", "4"), (3, "4", "5"), (4, "4", "5"))
    found = [(data, *told) for data, first, second in compared if (told := _advantage(summary, data, first, second))]
    better = {name for _, names, _ in found for name in names}
    if not found:
        return []
    sentences = [sentence for *_, sentence in found]
    if len(better) == len(FILTERS):
        return sentences
    where = ", ".join(dict.fromkeys(f"Data {data}" for data, names, _ in found if names))
    whole = f"only beside the {next(iter(better))} ({where})" if better else "beside neither main filter"
    return [f"The robust schemes have an advantage {whole}.", *sentences]


def _advantage(summary: Summary, data: int, first: str, second: str) -> tuple[list[str], str] | None:
    """The main filters beside which the second scheme succeeds more often than the first, and that in words."""
    known = {
        name: difference
        for main, name in FILTERS.items()
        if (difference := _scheme_difference(summary, "p_se", data, first, second, main)) is not None
    }
    if len(known) < len(FILTERS):
        return None
    better = [name for name, d in known.items() if positive(d.difference) is Verdict.REPRODUCED]
    where = {0: "beside neither main filter", 2: "beside both main filters"}.get(len(better)) or f"only beside the {better[0]}"
    gaps = ", ".join(f"{name} {shown(d.difference, 'points')}" for name, d in known.items())
    itself = {name: summary.statistic("p_se", first + main, data) for main, name in FILTERS.items()}
    rates = ", ".join(f"{name} {shown(s, '%', '.1f')}" for name, s in itself.items())
    sentence = f"Data {data}: {SCHEMES[second]} succeeds more often than {SCHEMES[first]} {where} ({gaps})"
    return better, f"{sentence}; {SCHEMES[first]} itself: {rates}."


# claims of the publication


def _table_cells(summary: Summary) -> list[Claim]:
    found = []
    for digit, scheme in SCHEMES.items():
        for data, value in PAPER_SUCCESS[digit].items():
            published = Published(value, "Table 2", "p_se", "%", ".1f", SUCCESS_NEAR, SUCCESS_FAR)
            found.append(_number(summary, f"table-2-{scheme}-{data}", f"Success rate of {scheme}", digit, data, published))
    for digit, scheme in SCHEMES.items():
        for data, value in PAPER_RATIO[digit].items():
            published = Published(value, "Fig. 12", "ratio_mean", "", ".2f", RATIO_NEAR * value, RATIO_FAR * value)
            found.append(_number(summary, f"figure-12-{scheme}-{data}", f"Mean ratio of {scheme}", digit, data, published))
    return found


class Published(NamedTuple):
    """A number of the publication, and how far from it ours may be."""

    value: float
    source: str
    metric: str
    unit: str
    form: str
    close: float
    far: float


def _number(summary: Summary, id: str, what: str, digit: str, data: int, published: Published) -> Claim:
    value, source, metric, unit, form, close, far = published

    def judge(main: str) -> Part | None:
        ours = summary.statistic(metric, digit + main, data)
        if ours is None:
            return None
        off = f"{plain(ours.value - value)}{' points' if unit else ''}"
        evidence = f"{_span(ours, form=form)}; our mean is off by {off}."
        return Part(near(ours, value, close, far), shown(ours, unit, form), evidence)

    paper = f"{plain(value, form)}{' ' if unit else ''}{unit} ({source})"
    return _by_filter(id, f"{what} on Data {data}", paper, _missing([SCHEMES[digit]], data), judge)


def _orders(summary: Summary) -> list[Claim]:
    listed = (
        ("order-data-1", "Success rate on Data 1: WLS < EKF < IEKF", 1, ("12", "23"), "57.5, 88.1, 94.4 % (Table 2)"),
        ("order-data-2", "IBRKF succeeds more often than IEKF on Data 2", 2, ("34",), "94.6 against 81.3 % (Table 2)"),
        ("order-data-3", "IBRCAF succeeds more often than IBRKF on Data 3", 3, ("45",), "93.7 against 89.2 % (Table 2)"),
        ("order-data-4", "IBRCAF succeeds more often than IBRKF on Data 4", 4, ("45",), "93.8 against 87.9 % (Table 2)"),
    )
    return [_compared(summary, id, text, data, pairs, paper) for id, text, data, pairs, paper in listed]


def _compared(
    summary: Summary,
    id: str,
    text: str,
    data: int,
    pairs: Sequence[str],
    paper: str = "–",
    rule: Callable[[Statistic], Verdict] = positive,
    is_check: bool = False,
) -> Claim:
    """The success rate of the second scheme of every pair against that of the first."""

    def judge(main: str) -> Part | None:
        found = [_scheme_difference(summary, "p_se", data, pair[0], pair[1], main) for pair in pairs]
        known = [difference for difference in found if difference is not None]
        if len(known) < len(pairs):
            return None
        verdict = together(rule(d.difference) for d in known)
        ours = ", ".join(shown(d.difference, "points") for d in known)
        return Part(verdict, ours, f"{'; '.join(_gap(d, 'points') for d in known)}.")

    names = dict.fromkeys(SCHEMES[digit] for pair in pairs for digit in pair)
    return _by_filter(id, text, paper, "a comparison of " + _missing(list(names), data), judge, is_check)


def _gains(summary: Summary) -> list[Claim]:
    return [_gain(summary, *gain) for gain in PAPER_GAIN]


def _gain(summary: Summary, metric: str, first: str, second: str, value: float) -> Claim:
    def judge(main: str) -> Part | None:
        difference = _scheme_difference(summary, metric, 1, first, second, main)
        if difference is None or not np.isfinite(difference.percent.value):
            return None
        gain = difference.percent
        verdict = near(gain, value, 0.15 * value, 0.5 * value)
        if verdict is Verdict.NOT_REPRODUCED and positive(gain) is Verdict.REPRODUCED:
            verdict = Verdict.PARTLY  # right direction, other size
        return Part(verdict, shown(gain, "%"), f"{_span(gain, '%')}; better in {difference.better} of {seed_count(gain.n)}.")

    id = f"gain-{metric.replace('_', '-')}-{SCHEMES[first]}"
    what = {"ratio_mean": "Mean ratio", "p_se": "Success rate"}[metric]
    text = f"{what} of {SCHEMES[second]} on Data 1, gain over {SCHEMES[first]}"
    return _by_filter(id, text, f"+{value} % (section 3.2.1)", _missing([SCHEMES[first], SCHEMES[second]], 1), judge)


def _windows(summary: Summary) -> list[Claim]:
    return [_keeps_ratio(summary), *(_cures(summary, data) for data in (3, 4)), _grows(summary)]


def _keeps_ratio(summary: Summary) -> Claim:
    def judge(main: str) -> Part | None:
        row = summary.row("4" + main, 2)
        found = row.at_times("fault_ratio_median") if row else []
        if not found:
            return None
        verdict = together(positive(shifted(s, -RATIO_THRESHOLD)) for _, s in found)
        each = ", ".join(f"{plain(at)} s: {shown(s)}" for at, s in found)
        return Part(verdict, ", ".join(f"{plain(s.value)}" for _, s in found), f"median ratio per window {each}.")

    text = "IBRKF keeps the ratio above 3 in the windows of all gross-error sizes (Data 2)"
    return _by_filter("window-ratio-IBRKF", text, "> 3 (Fig. 9, section 3.2.1)", _missing(["IBRKF"], 2), judge)


def _cures(summary: Summary, data: int) -> Claim:
    def judge(main: str) -> Part | None:
        difference = _scheme_difference(summary, "fault_p_se", data, "4", "5", main)
        weak, strong = (summary.statistic("fault_ratio_median", digit + main, data) for digit in "45")
        if difference is None or weak is None or strong is None:
            return None
        parts = [holds(weak.value < RATIO_THRESHOLD), positive(difference.difference)]
        if weak.value < RATIO_THRESHOLD:  # else there is nothing to cure
            parts.append(positive(shifted(strong, -RATIO_THRESHOLD)))
        verdict = together(parts)
        ours = f"P_SE in the windows higher by {shown(difference.difference, 'points')}"
        ratios = f"median ratio in the windows IBRKF {shown(weak)}, IBRCAF {shown(strong)}"
        return Part(verdict, ours, f"{ratios}; {_gap(difference, 'points')}.")

    text = f"IBRKF does not cure the state faults of Data {data}, IBRCAF does"
    paper = f"ratio falls except with IBRCAF (Fig. {10 if data == 3 else 11})"
    return _by_filter(f"window-state-fault-{data}", text, paper, _missing(["IBRKF", "IBRCAF"], data), judge)


def _grows(summary: Summary) -> Claim:
    def judge(main: str) -> Part | None:
        found = {}
        for digit in "123":
            row = summary.row(digit + main, 2)
            sizes = [s.value for _, s in row.at_times("fault_baseline_max")] if row else []
            if sizes:
                found[digit] = sizes
        if not found:
            return None
        parts = {digit: holds(bool(np.all(np.diff(sizes) > 0))) for digit, sizes in found.items()}
        ours = ", ".join(f"{SCHEMES[d]} {' '.join(plain(v) for v in sizes)} m" for d, sizes in found.items())
        growing = [SCHEMES[digit] for digit, verdict in parts.items() if verdict is Verdict.REPRODUCED]
        evidence = f"largest baseline error in each window, mean over seeds, grows with {', '.join(growing) or 'none'}."
        return Part(together(parts.values()), ours, evidence)

    text = "Without a robust scheme errors grow with the size of the gross errors (Data 2)"
    paper = "rapid increase (Figs. 16, 17, section 3.2.2)"
    return _by_filter("window-growth", text, paper, _missing(["WLS", "EKF", "IEKF"], 2), judge)


def _main_filters(summary: Summary) -> list[Claim]:
    """What the adaptive main filter brings, IEKF on Data 1."""
    spike, damp = "velocity-spikes", "velocity-damped"
    spike_text = "With the standard filter the velocity error rises at 20, 65, 180 and 300 s (IEKF, Data 1)"
    damp_text = "The adaptive filter damps the velocity error there (IEKF, Data 1)"
    paper = "(Fig. 14, section 3.2.2)"
    row, difference = summary.row("3a", 1), _filter_difference(summary, "velocity_manoeuvre")
    over = row.statistics.get("velocity_spike") if row else None
    found = []
    if row is None or over is None:
        found.append(untested(spike, spike_text, paper, "3a on Data 1"))
    else:
        each = ", ".join(f"{plain(at)} s {plain(s.value)}" for at, s in row.at_times("velocity_manoeuvre"))
        evidence = f"RMS within 5 s in m/s: {each}; elsewhere {shown(row.statistics['velocity_elsewhere'])}."
        found.append(
            Claim(
                spike,
                spike_text,
                paper,
                f"{shown(over)} times the RMS elsewhere",
                positive(shifted(over, -1)),
                evidence,
            )
        )
    if difference is None:
        found.append(untested(damp, damp_text, paper, "3a and 3b on Data 1"))
    else:
        found.append(Claim(damp, damp_text, paper, _change(difference), _reduced(difference), _velocities(summary, difference)))
    for metric, value in PAPER_FILTER_GAIN:
        found.append(_filter_gain(summary, metric, value))
    return [*found, _mean_errors(summary)]


def _filter_difference(summary: Summary, metric: str, data: int = 1) -> Difference | None:
    return summary.difference(metric, Cell(DEFAULT, data, "3a"), Cell(DEFAULT, data, "3b"))


def _reduced(difference: Difference) -> Verdict:
    return positive(negated(difference.difference))


def _both(summary: Summary, difference: Difference, unit: str) -> str:
    """The numbers of both main filters."""
    cells = (difference.first, difference.second)
    found = {c.algorithm: summary.statistic(difference.metric, c.algorithm, c.data) for c in cells}
    return ", ".join(f"{FILTERS[algorithm[1]]} {shown(s, unit, '.4g')}" for algorithm, s in found.items())


def _velocities(summary: Summary, difference: Difference) -> str:
    return f"{_both(summary, difference, 'm/s')}; {_gap(difference, 'm/s')}."


def _change(difference: Difference) -> str:
    return shown(difference.percent, "%")


def _filter_gain(summary: Summary, metric: str, value: float) -> Claim:
    what = "Baseline" if metric == "baseline_rms" else "Velocity"
    id, text = f"gain-AKF-{what.lower()}", f"{what} RMS of IEKF-AKF against IEKF-SKF on Data 1"
    paper = f"−{value} % (section 3.2.2)"
    difference = _filter_difference(summary, metric)
    if difference is None:
        return untested(id, text, paper, "3a and 3b on Data 1")
    verdict = _reduced(difference)
    if verdict is Verdict.REPRODUCED and not -difference.percent.high <= value <= -difference.percent.low:
        verdict = Verdict.PARTLY  # right direction, other size
    unit = "m" if metric == "baseline_rms" else "m/s"
    evidence = f"{_both(summary, difference, unit)}. {_span(difference.percent, '%')}."
    return Claim(id, text, paper, _change(difference), verdict, evidence)


def _mean_errors(summary: Summary) -> Claim:
    id, text = "means-IEKF-AKF", "Mean errors of IEKF-AKF within 10 cm and 2 cm/s on Data 1"
    paper = "≤ 0.10 m, ≤ 0.02 m/s (conclusion 3)"
    return _bounded(summary, id, text, paper, "3b", 1, ("baseline_mean", "velocity_mean"), PAPER_MEANS)


def _positions(summary: Summary) -> list[Claim]:
    found = []
    for (algorithm, data), bounds in PAPER_LARGEST.items():
        id, text = f"largest-{algorithm}-{data}", f"Largest errors of {algorithm_name(algorithm)} on Data {data}"
        paper = f"{bounds[0]} m, {bounds[1]} m/s (section 3.2.2)"
        found.append(_bounded(summary, id, text, paper, algorithm, data, ("baseline_max", "velocity_max"), bounds))
    for (algorithm, data), bounds in PAPER_RMS.items():
        id, text = f"rms-{algorithm}-{data}", f"RMS errors of {algorithm_name(algorithm)} on Data {data}"
        paper = f"{bounds[0]} m, {bounds[1]} m/s (section 3.2.2)"
        found.append(_bounded(summary, id, text, paper, algorithm, data, ("baseline_rms", "velocity_rms"), bounds))
    return found


def _bounded(
    summary: Summary,
    id: str,
    text: str,
    paper: str,
    algorithm: str,
    data: int,
    metrics: tuple[str, str],
    bounds: tuple[float, float],
) -> Claim:
    row = summary.row(algorithm, data)
    if row is None or any(metric not in row.statistics for metric in metrics):
        return untested(id, text, paper, _missing([algorithm_name(algorithm)], data))
    baseline, velocity = (row.statistics[metric] for metric in metrics)
    fixed = row.statistics.get(metrics[0] + "_fixed")
    evidence = f"Worst seed {plain(baseline.high)} m, {plain(velocity.high)} m/s; fixed epochs alone: {shown(fixed, 'm')}."
    verdict = together([at_most(baseline, bounds[0]), at_most(velocity, bounds[1])])
    return Claim(id, text, paper, f"{shown(baseline, 'm')}; {shown(velocity, 'm/s')}", verdict, evidence + _mark(row))


def _mark(row: Row) -> str:
    if row.is_consistent:
        return ""
    return f" Its claimed covariance is not consistent: mean NEES in its 99 % band at {plain(row.nees_consistent)} % of epochs."


def _sweeps(summary: Summary) -> list[Claim]:
    return [_code_slope(summary), _ins_limit(summary)]


def _code_slope(summary: Summary, id: str = "figure-7", is_check: bool = False) -> Claim:
    text = "ADOP grows steeply with the code σ for WLS, gently for EKF and IEKF (300 s, Data 1)"
    paper = "(Fig. 7)"
    gaps = [summary.sweep.get(f"slope WLS-{label}") for label in ("EKF", "IEKF")]
    slopes = {label: summary.sweep.get(f"slope {label}") for label in ("WLS", "EKF", "IEKF")}
    known = [gap for gap in gaps if gap is not None]
    if len(known) < 2:
        return untested(id, text, paper, "the sweep of the code σ", is_check)
    ours = ", ".join(f"{label} {plain(s.value)}" for label, s in slopes.items() if s is not None) + " cycles/m"
    evidence = f"Slope of WLS less that of EKF {shown(known[0])}, of IEKF {shown(known[1])} cycles/m."
    return Claim(id, text, paper, ours, together(positive(gap) for gap in known), evidence, is_check)


def _ins_limit(summary: Summary) -> Claim:
    id, text = "figure-8", "INS aiding lowers the ADOP while the INS position σ is within 1.5 m, and raises it beyond"
    paper = "crossing at about 1.5 m (Fig. 8)"
    curve = summary.curve("adop_ins_excess")
    if curve is None:
        return untested(id, text, paper, "the sweep of the INS σ")
    x, (excess, _, _) = np.array(curve.x), curve.of("IEKF")
    within, beyond = x <= PAPER_INS_LIMIT_M, x > PAPER_INS_LIMIT_M
    parts = [
        holds(bool(np.all(excess[m] < 0)) if i == 0 else bool(np.any(excess[m] > 0)))
        for i, m in enumerate((within, beyond))
        if m.any()
    ]
    listed = ", ".join(f"{plain(a)} m: {plain(e)} %" for a, e in zip(x, excess, strict=True))
    return Claim(
        id,
        text,
        paper,
        f"{plain(excess.min())} to {plain(excess.max())} %",
        together(parts),
        f"ADOP of IEKF against EKF: {listed}.",
    )


def _doubts(summary: Summary) -> list[Claim]:
    """What is published and cannot be, or hardly."""
    return [_wls_drop_published(summary), _worse_beyond(summary), _sees_wrong_fixes(summary), _literal_noise(summary)]


def _wls_drop(summary: Summary, main: str) -> Difference | None:
    return summary.difference("p_se", Cell(DEFAULT, 1, "1" + main), Cell(DEFAULT, 2, "1" + main))


def _wls_drop_published(summary: Summary) -> Claim:
    def judge(main: str) -> Part | None:
        difference = _wls_drop(summary, main)
        if difference is None:
            return None
        drop = negated(difference.difference)
        why = f"WLS has no memory, with 44 of 1201 epochs faulted it cannot lose more than {WLS_DROP_LIMIT} points"
        return Part(near(drop, 13.9, SUCCESS_NEAR, SUCCESS_FAR), shown(drop, "points"), f"{why}. {_span(drop)}.")

    text = "Success rate of WLS falls by 13.9 points from Data 1 to Data 2"
    return _by_filter("wls-drop", text, "57.5 to 43.6 % (Table 2)", "WLS on Data 1 and 2", judge)


def _worse_beyond(summary: Summary) -> Claim:
    id, text = "adop-beyond", "IEKF has a larger ADOP than EKF where the INS position σ is large"
    paper = "beyond 1.5 m (Fig. 8)"
    excess = summary.sweep.get("largest excess of IEKF")
    if excess is None:
        return untested(id, text, paper, "the sweep of the INS σ")
    evidence = "Largest excess of the ADOP of IEKF over that of EKF; information that is weighted consistently never enlarges it."
    bias = _bias_limit(summary)
    if bias is not None:
        evidence += f" What falls is the success rate when the prior is biased: {bias[1]}."
    return Claim(id, text, paper, shown(excess, "%"), positive(shifted(excess, -NOTHING_PCT)), evidence)


def _bias_limit(summary: Summary) -> tuple[Verdict, str] | None:
    """From which bias of the INS position on IEKF succeeds less often than EKF."""
    curve = summary.curve("success_bias_gain")
    if curve is None:
        return None
    gain, _, upper = curve.of("IEKF")
    worse = np.flatnonzero(np.where(np.isfinite(upper), upper, gain) < 0)
    if not len(worse):
        return Verdict.NOT_REPRODUCED, f"IEKF never below EKF up to a bias of {plain(curve.x[-1])} m"
    i = int(worse[0])
    below = f"by {plain(-gain[i])} points"
    if curve.x[i] == 0:
        return Verdict.PARTLY, f"IEKF is below EKF without any bias already, {below}"
    return Verdict.REPRODUCED, f"IEKF falls below EKF at a bias of {plain(curve.x[i])} m, {below}"


def _sees_wrong_fixes(summary: Summary) -> Claim:
    id, text = "sees-wrong-fixes", "The adaptive factor's statistic (eq. 13) recognises wrongly fixed ambiguities"
    paper = "(section 2.3.3)"
    cases = ((a, data) for data in DATA_SETS for a in ("1b", "2b", "3b"))
    case = next((c for c in cases if summary.statistic("adapted_wrong", *c) is not None), None)
    if case is None:
        return untested(id, text, paper, "an algorithm with the adaptive filter that fixes wrongly")
    wrong, right = (summary.statistic(f"adapted_{which}", *case) for which in ("wrong", "right"))
    assert wrong is not None
    floor = right.value if right is not None else 0.0
    seen = wrong.value > max(2 * floor, SEES_LITTLE_PCT)
    evidence = f"{algorithm_name(case[0])} on Data {case[1]}: the factor acts at {shown(right, '%')} of rightly fixed epochs."
    other = summary.statistic("adapted_wrong", *case, "normalised")
    evidence += (
        f" The normalised statistic acts at {shown(other, '%')} of wrongly fixed ones."
        if other
        else " The normalised statistic was not run."
    )
    return Claim(id, text, paper, f"acts at {shown(wrong, '%')} of wrongly fixed epochs", holds(seen), evidence)


def _literal_noise(summary: Summary) -> Claim:
    def rates(main: str, variant: str) -> dict[str, Statistic]:
        found = ((digit, summary.statistic("p_se", digit + main, 1, variant)) for digit in "123")
        return {digit: s for digit, s in found if s is not None}

    def judge(main: str) -> Part | None:
        known, default = rates(main, "literal-noise"), rates(main, DEFAULT)
        if not known:
            return None
        fits = [near(s, PAPER_SUCCESS[digit][1], SUCCESS_NEAR, UNLIKE_POINTS) for digit, s in known.items()]
        ours, read = (", ".join(f"{SCHEMES[d]} {shown(s, '%')}" for d, s in x.items()) for x in (known, default))
        return Part(together(fits), ours, f"read as double differences {read or 'not run'}.")

    text = "0.37 m and 1 cm are deviations of undifferenced code and phase"
    paper = "WLS 57.5, EKF 88.1, IEKF 94.4 % (Table 2)"
    return _by_filter("literal-noise", text, paper, "the variant literal-noise", judge)


# further checks


def _graph(summary: Summary) -> list[Claim]:
    found = []
    for data in DATA_SETS:
        row = summary.row(GRAPH, data)
        id, text = f"graph-{data}", f"The factor graph on Data {data}: P_SE ≥ {GRAPH_SUCCESS_PCT} %, baseline RMS ≤ 1.5 cm"
        paper = "–"
        if row is None or "baseline_rms" not in row.statistics:
            found.append(untested(id, text, paper, _missing(["the factor graph"], data), True))
            continue
        success, rms = row.statistics["p_se"], row.statistics["baseline_rms"]
        parts = [at_most(shifted(negated(success), 100.0), 100 - GRAPH_SUCCESS_PCT), at_most(rms, GRAPH_RMS_M)]
        wrong = row.statistics.get("wrong_fix")
        worst = f"Worst seed {plain(success.low, '.2f')} %, {plain(100 * rms.high)} cm"
        evidence = f"{worst}; wrong of the fixed epochs {shown(wrong, '%')}."
        ours = f"{shown(success, '%', '.2f')}; {shown(rms, 'cm', scale=100)}"
        seen = "".join(f" {note}" for note in (GRAPH_SEES.get(data), GRAPH_TOLD) if note)
        found.append(Claim(id, text, paper, ours, together(parts), evidence + _mark(row) + seen, True))
    return found


def _checks(summary: Summary) -> list[Claim]:
    return [
        _disjoint_orders(summary),
        _compared(summary, "robust-better", "Data 2: P_SE of IBRKF above IEKF", 2, ("34",), is_check=True),
        _robust_ratio(summary),
        _wls_drop_possible(summary),
        *(_no_lower(summary, data) for data in (3, 4)),
        *_precision(summary),
        *_velocity_checks(summary),
        _fixed_baselines(summary),
        _literal_reported(summary),
    ]


def _disjoint_orders(summary: Summary) -> Claim:
    def judge(main: str) -> Part | None:
        success, ratio = ([summary.statistic(m, d + main, 1) for d in "123"] for m in ("p_se", "ratio_mean"))
        s, r = ([x for x in found if x is not None] for found in (success, ratio))
        if len(s) < 3 or len(r) < 3:
            return None
        n = min(x.n for x in s)
        parts = [holds(a.upper < b.lower) for found in (s, r) for a, b in pairwise(found)]
        ours = ", ".join(shown(x, "%", ".1f") for x in s)
        verdict = together([*parts, holds(n >= MIN_SEEDS)])
        return Part(verdict, ours, f"{seed_count(n)}; mean ratios {', '.join(shown(x) for x in r)}.")

    text = f"Data 1, at least {MIN_SEEDS} seeds: P_SE of WLS < EKF < IEKF with disjoint intervals, mean ratio in the same order"
    return _by_filter("disjoint-orders", text, "–", _missing(["WLS", "EKF", "IEKF"], 1), judge, True)


def _robust_ratio(summary: Summary) -> Claim:
    def judge(main: str) -> Part | None:
        inside = summary.statistic("fault_ratio_median", "4" + main, 2)
        if inside is None:
            return None
        return Part(positive(shifted(inside, -RATIO_THRESHOLD)), shown(inside), f"{_span(inside)}.")

    text = "Data 2: median ratio of IBRKF above 3 inside the fault windows"
    return _by_filter("robust-ratio", text, "–", _missing(["IBRKF"], 2), judge, True)


def _wls_drop_possible(summary: Summary) -> Claim:
    def judge(main: str) -> Part | None:
        difference = _wls_drop(summary, main)
        if difference is None:
            return None
        d = difference.difference
        verdict = holds(-d.low <= WLS_DROP_LIMIT)
        return Part(verdict, shown(negated(d), "points"), f"largest drop of a seed {plain(-d.low)} points.")

    text = f"P_SE of WLS falls by at most {WLS_DROP_LIMIT} points from Data 1 to Data 2, the share of epochs with faults"
    return _by_filter("wls-drop-possible", text, "–", "WLS on Data 1 and 2", judge, True)


def _no_lower(summary: Summary, data: int) -> Claim:
    text = f"Data {data}: P_SE of IBRCAF no lower than that of IBRKF, and that no lower than that of IEKF"
    return _compared(summary, f"no-lower-{data}", text, data, ("34", "45"), rule=at_least_zero, is_check=True)


def _precision(summary: Summary) -> list[Claim]:
    found = [_code_slope(summary, "code-slope", True)]
    id, text = "adop-never-worse", "ADOP of IEKF at most that of EKF whatever the σ of the INS position"
    excess = summary.sweep.get("largest excess of IEKF")
    if excess is None:
        found.append(untested(id, text, "–", "the sweep of the INS σ", True))
    else:
        evidence = f"Largest excess over all seeds and σ {plain(excess.high)} %."
        found.append(Claim(id, text, "–", shown(excess, "%"), holds(excess.high <= NOTHING_PCT), evidence, True))
    id, text = "biased-ins", "With a biased INS prior the success rate of IEKF falls below that of EKF, at a reported bias"
    bias = _bias_limit(summary)
    if bias is None:
        return [*found, untested(id, text, "–", "the sweep of the bias", True)]
    return [*found, Claim(id, text, "–", bias[1], bias[0], "First bias whose paired 95 % interval lies below zero.", True)]


def _velocity_checks(summary: Summary) -> list[Claim]:
    found = []
    id, text = "velocity-at-changes", "Velocity RMS within 5 s of 20, 65, 180, 300 s is lower with the AKF (IEKF, Data 1)"
    inside, outside = (_filter_difference(summary, f"velocity_{where}") for where in ("manoeuvre", "elsewhere"))
    if inside is None:
        found.append(untested(id, text, "–", "3a and 3b on Data 1", True))
    else:
        found.append(Claim(id, text, "–", _change(inside), _reduced(inside), _velocities(summary, inside), True))
    id, text = "velocity-elsewhere", f"Elsewhere velocity RMS is at most {ELSEWHERE_LIMIT_PCT:g} % higher with it (IEKF, Data 1)"
    if outside is None:
        return [*found, untested(id, text, "–", "3a and 3b on Data 1", True)]
    p = outside.percent
    top = p.upper if np.isfinite(p.upper) else p.value
    verdict = Verdict.PARTLY if p.value <= ELSEWHERE_LIMIT_PCT < top else holds(top <= ELSEWHERE_LIMIT_PCT)
    return [*found, Claim(id, text, "–", shown(p, "%"), verdict, _velocities(summary, outside), True)]


def _fixed_baselines(summary: Summary) -> Claim:
    id, text = "fixed-baselines", "Data 4: baseline RMS of IBRCAF-AKF over fixed epochs below 0.10 m, wrong fixes reported"
    row = summary.row("5b", 4)
    rms = row.statistics.get("baseline_rms_fixed") if row else None
    if row is None or rms is None:
        return untested(id, text, "–", _missing(["5b"], 4), True)
    wrong = row.statistics.get("wrong_fix")
    evidence = f"Wrong of the fixed epochs: {shown(wrong, '%')}; worst seed {plain(rms.high)} m."
    return Claim(id, text, "–", shown(rms, "m"), at_most(rms, DATA4_RMS_M), evidence + _mark(row), True)


def _literal_reported(summary: Summary) -> Claim:
    id, text = "literal-reported", "The literal reading of the noise is run and reported beside the default"
    found = [row for row in summary.rows if row.cell.variant == "literal-noise"]
    if not found:
        return untested(id, text, "–", "the variant literal-noise", True)
    names = ", ".join(algorithm_name(row.cell.algorithm) for row in found)
    return Claim(id, text, "–", seed_count(len(found[0].seeds)), Verdict.REPRODUCED, f"Run with {names}.", True)
