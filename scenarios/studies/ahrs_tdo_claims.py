"""What the publication on the adaptive AHRS filter claims, each with our number and a verdict that follows from it.

How verdicts follow stands in `scenarios.studies.verdicts`; the publication's numbers come from one run, whose trajectory,
attitude errors and sky are not known.

AHRS+TDO is `ahrs_tdo_summary.PUBLISHED`; other readings of it are named in the evidence. Source: Lu et al. (2024), tables 3
and 4, figures 5 to 16; spec ahrs_tdo.md, sections 4 to 6.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from scenarios.metrics_ranks import LEVEL
from scenarios.published.ahrs_tdo_filters import CA_CV, FILTERS
from scenarios.studies.ahrs_tdo import BOUND, FLIGHT_S, PHASES, SEARCH_METHODS
from scenarios.studies.ahrs_tdo_summary import (
    AXES,
    BOUND_SET,
    EVEN,
    METRICS,
    OBJECTIVES,
    PLAIN,
    PUBLISHED,
    SAME_END_S,
    Difference,
    Row,
    Search,
    Summary,
    title_of,
)
from scenarios.studies.statistics import Statistic
from scenarios.studies.verdicts import (
    Claim,
    Verdict,
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

METHODS = {PUBLISHED: "AHRS+TDO", PLAIN: "AHRS", CA_CV: "CA/CV"}
PAPER_POSITION = {  # table 3, m
    PUBLISHED: (0.27857, 0.28461, 0.34116),
    PLAIN: (0.31351, 0.35852, 0.49446),
    CA_CV: (0.31852, 0.36996, 0.50831),
}
PAPER_VELOCITY = {PUBLISHED: (0.01076, 0.00644, 0.01393), CA_CV: (0.03826, 0.02151, 0.04194)}  # table 4, m/s
PAPER_ABSTRACT = (12, 23, 32)  # percent, position against CA/CV
AIM = 0.5  # of the published best
BOUND_NEAR = 1.10  # times the bound
BOUND_OF = "IMU, code, Doppler and ranges, without attitude systems,"
RMSE_NEAR, RMSE_FAR = 0.15, 0.50  # of the published number
GAIN_NEAR, GAIN_FAR = 5.0, 15.0  # points
SLIGHTLY_PCT = 10.0
CDF_NEAR, CDF_FAR = 0.10, 0.20
POSITION_LEVEL_M, VELOCITY_LEVEL_MPS = (0.2, 1.0), (0.005, 0.05)  # check 12
LITERAL_RATE, NIS_RATE = (10.0, 35.0), (0.5, 1.5)  # check 8, percent
NEAR_MINIMUM = 1e-3  # check 10
RUNTIME_S = 4.0
READINGS = ("ahrs-tdo-o1", "ahrs-tdo-o2", "ahrs-tdo-o3", "ahrs-nis-o3")


def claims(summary: Summary) -> list[Claim]:
    """Every claim and check, judged by the numbers of the summary."""
    return [
        *_tables(summary),
        *_best(summary),
        _slightly(summary),
        _same_distributions(summary),
        *_velocity(summary),
        *_gains(summary),
        *_searched(summary),
        *_swapped(summary),
        *_checks(summary),
    ]


def name_of(name: str) -> str:
    """What the publication calls a filter, or its title here."""
    return METHODS.get(name) or title_of(name)


# numbers


def _tables(summary: Summary) -> Iterator[Claim]:
    for letter, unit, table, source in (("r", "m", PAPER_POSITION, "Table 3"), ("v", "m/s", PAPER_VELOCITY, "Table 4")):
        what = "Position" if letter == "r" else "Velocity"
        for name, values in table.items():
            for axis, value in zip(AXES, values, strict=True):
                id, text = f"table-{letter}-{name}-{axis}", f"{what} {axis.upper()}, RMSE of {METHODS[name]}"
                paper, found = f"{plain(value)} {unit} ({source})", summary.of(name, f"{letter}_{axis}")
                if found is None:
                    yield untested(id, text, paper, name)
                    continue
                verdict = near(found, value, RMSE_NEAR * value, RMSE_FAR * value)
                yield Claim(id, text, paper, shown(found, unit), verdict, _span(found, value, unit))


def _span(found: Statistic, value: float, unit: str) -> str:
    ratio = f"{plain(found.value / value, '.2f')} times the published value"
    return f"Seeds span {plain(found.low)} to {plain(found.high)} {unit}; {ratio}." if found.n > 1 else f"One seed; {ratio}."


def _gains(summary: Summary) -> Iterator[Claim]:
    """Reductions in percent against CA/CV (abstract) and AHRS."""
    for other in (CA_CV, PLAIN):
        for i, axis in enumerate(AXES):
            ours, theirs = PAPER_POSITION[PUBLISHED][i], PAPER_POSITION[other][i]
            value = 100 * (1 - ours / theirs)
            said = f" (abstract: {PAPER_ABSTRACT[i]} %)" if other == CA_CV else ""
            text = f"Position {axis.upper()}: AHRS+TDO reduces the RMSE of {METHODS[other]} by {value:.1f} %"
            yield _gain(summary, f"gain-r-{axis}-{other}", text, f"{value:.1f} % (Table 3){said}", f"r_{axis}", other, value)
    for i, axis in enumerate(AXES):
        value = 100 * (1 - PAPER_VELOCITY[PUBLISHED][i] / PAPER_VELOCITY[CA_CV][i])
        text = f"Velocity {axis.upper()}: AHRS+TDO reduces the RMSE of CA/CV by {value:.1f} %"
        paper = f"{value:.1f} % (Table 4; the abstract's {(350, 330, 300)[i]} % is the ratio of the errors and no reduction)"
        yield _gain(summary, f"gain-v-{axis}-{CA_CV}", text, paper, f"v_{axis}", CA_CV, value)


def _gain(summary: Summary, id: str, text: str, paper: str, metric: str, other: str, value: float) -> Claim:
    found = summary.compare(metric, other, PUBLISHED)
    if found is None:
        return untested(id, text, paper, f"{PUBLISHED}, {other}")
    reduction = negated(found.percent)
    return Claim(id, text, paper, shown(reduction, "%", ".1f"), near(reduction, value, GAIN_NEAR, GAIN_FAR), _told(found))


def _velocity(summary: Summary) -> Iterator[Claim]:
    for i, axis in enumerate(AXES):
        value = PAPER_VELOCITY[CA_CV][i] / PAPER_VELOCITY[PUBLISHED][i]
        text = f"Velocity {axis.upper()}: errors of CA/CV are {value:.2f} times those of AHRS+TDO"
        found = summary.ratio(f"v_{axis}", CA_CV, PUBLISHED)
        if found is None:
            yield untested(f"ratio-v-{axis}", text, f"{value:.2f} (Table 4)", f"{PUBLISHED}, {CA_CV}")
            continue
        verdict = near(found, value, RMSE_NEAR * value, RMSE_FAR * value)
        plain_ratio = summary.ratio(f"v_{axis}", CA_CV, PLAIN)
        better = summary.ratio(f"v_{axis}", "ca-0.1mg", "ahrs-0.1mg")
        evidence = f"Without TDO the ratio is {shown(plain_ratio, '', '.2f')}"
        evidence += f", and {shown(better, '', '.2f')} with accelerometers of 0.1 mg." if better else "."
        yield Claim(f"ratio-v-{axis}", text, f"{value:.2f} (Table 4)", shown(found, "", ".2f"), verdict, evidence)


# orders


def _best(summary: Summary) -> Iterator[Claim]:
    listed = (
        ("best-position", "AHRS+TDO has the smallest position errors", "Table 3, Fig. 7", "r_3d"),
        ("best-velocity", "AHRS+TDO has the smallest velocity errors", "Table 4, Fig. 12", "v_3d"),
        ("steady-position", "AHRS+TDO is the most stable in position", "std, Fig. 8", "r_std"),
        ("steady-velocity", "AHRS+TDO is the most stable in velocity", "std, Fig. 13", "v_std"),
    )
    for id, text, paper, metric in listed:
        found = {other: d for other in (PLAIN, CA_CV) if (d := summary.compare(metric, other, PUBLISHED)) is not None}
        if not found:
            yield untested(id, text, paper, f"{PUBLISHED}, {PLAIN}, {CA_CV}")
            continue
        verdict = together(positive(negated(d.difference)) for d in found.values())
        ours = "; ".join(f"against {METHODS[other]} {shown(d.percent, '%', '.1f')}" for other, d in found.items())
        others = _other_readings(summary, metric)
        if not summary.rows[PUBLISHED].is_consistent:
            others.append("The covariance of AHRS+TDO is not consistent.")
        yield Claim(id, text, paper, ours, verdict, " ".join([*(f"{_told(d)}" for d in found.values()), *others]))


def _other_readings(summary: Summary, metric: str) -> list[str]:
    """The other readings of AHRS+TDO against the plain filter."""
    said = [
        f"{FILTERS[name].title} {shown(d.percent, '%', '.1f')}"
        for name in READINGS
        if name != PUBLISHED and (d := summary.compare(metric, PLAIN, name)) is not None
    ]
    return [f"Other readings against AHRS: {'; '.join(said)}."] if said else []


def _slightly(summary: Summary) -> Claim:
    id, text = "slightly", "AHRS is slightly better in position than CA/CV"
    paper, found = "1.6, 3.1, 2.7 % in X, Y, Z (Table 3)", summary.compare("r_3d", CA_CV, PLAIN)
    if found is None:
        return untested(id, text, paper, f"{PLAIN}, {CA_CV}")
    gain = negated(found.percent)
    verdict = positive(gain)
    if verdict is Verdict.REPRODUCED and gain.value > SLIGHTLY_PCT:
        verdict = Verdict.PARTLY
    return Claim(id, text, paper, f"AHRS against CA/CV {shown(found.percent, '%', '.1f')}", verdict, _told(found))


def _same_distributions(summary: Summary) -> Claim:
    id, text, paper = "same-cdf", "Position errors of AHRS and CA/CV are distributed nearly alike", "Fig. 7"
    if not (PLAIN in summary.rows and CA_CV in summary.rows):
        return untested(id, text, paper, f"{PLAIN}, {CA_CV}")
    far, velocity = (summary.cdf_distance(what, PLAIN, CA_CV) for what in ("position_m", "velocity_mps"))
    verdict = Verdict.REPRODUCED if far <= CDF_NEAR else Verdict.PARTLY if far <= CDF_FAR else Verdict.NOT_REPRODUCED
    evidence = f"Largest distance of the two distributions over all seeds and epochs; {plain(velocity, '.2f')} in velocity."
    return Claim(id, text, paper, plain(far, ".2f"), verdict, evidence)


# searches


def _searched(summary: Summary) -> Iterator[Claim]:
    """TDO against GA and PSO on recorded updates."""
    for other in (m for m in SEARCH_METHODS if m != "tdo"):
        id, text = f"search-{other}", f"TDO finds lower objectives than {other.upper()}"
        found = {which: s for which, s in summary.searches.items() if {"tdo", other} <= set(s.excess)}
        if not found:
            yield untested(id, text, "Fig. 5", "searches")
            continue
        verdict = together(_lower(s, other) for s in found.values())
        ours = "; ".join(f"{which}: {_medians(s, ('tdo', other))}" for which, s in found.items())
        speed = "; ".join(f"{which}: {_evals_words(s, ('tdo', other))}" for which, s in found.items())
        evidence = [*(_test_words(s, other) for s in found.values()), f"Evaluations to within {NEAR_MINIMUM:g}: {speed}."]
        yield Claim(id, text, "Fig. 5", ours, verdict, " ".join(evidence))


def _lower(search: Search, other: str) -> Verdict:
    test = search.against("tdo", other)
    return holds(test.sign > 0 and test.p < LEVEL)


def _medians(search: Search, methods: Iterable[str]) -> str:
    told = (f"{m.upper()} {plain(float(np.median(search.excess[m])), '.1e')}" for m in methods)
    return f"J/J(Gauss-Newton) − 1, median: {', '.join(told)}"


def _evals_words(search: Search, methods: Iterable[str]) -> str:
    """Medians of evaluations until a search is near the minimum."""
    return ", ".join(f"{m.upper()} {plain(search.evals_to(m, NEAR_MINIMUM), '.0f')}" for m in methods)


def _test_words(search: Search, other: str) -> str:
    test = search.against("tdo", other)
    even = f", even in {test.n_even}" if test.n_even else ""
    return (
        f"{search.objective}: TDO lower in {test.n_higher}, higher in {test.n_lower}{even} of {len(search.score(other))} seeds "
        f"(p = {plain(test.p, '.2g')}; differences below {EVEN:g} count as even)."
    )


def _swapped(summary: Summary) -> Iterator[Claim]:
    """TDO against other searches inside the filter."""
    for other, what in (("ahrs-pso", "PSO"), ("ahrs-ga", "GA")):
        id, text = f"filter-{other}", f"The filter is better with TDO than with {what}"
        found = [d for metric in ("r_3d", "v_3d") if (d := summary.compare(metric, other, "ahrs-tdo-o2")) is not None]
        if not found:
            yield untested(id, text, "Fig. 5", f"ahrs-tdo-o2, {other}")
            continue
        verdict = together(positive(negated(d.difference)) for d in found)
        ours = "; ".join(f"{METRICS[d.metric].title} {shown(d.percent, '%', '.2f')}" for d in found)
        yield Claim(id, text, "implied by Fig. 5", ours, verdict, f"Objective O2. {' '.join(map(_told, found))}")


# checks


def _checks(summary: Summary) -> Iterator[Claim]:
    yield from _levels(summary)
    yield from _rates(summary)
    yield from _minima(summary)
    yield from _ablation(summary)
    yield from _at_manoeuvres(summary)
    yield from _consistent(summary)
    yield _fast_enough(summary)
    yield from _aims(summary)
    yield from _near_bound(summary)


def _levels(summary: Summary) -> Iterator[Claim]:
    """Check 12."""
    for letter, unit, (low, high), what in (
        ("r", "m", POSITION_LEVEL_M, "position"),
        ("v", "m/s", VELOCITY_LEVEL_MPS, "velocity"),
    ):
        id, text = f"level-{letter}", f"AHRS, {what} RMSE per axis between {low:g} and {high:g} {unit}"
        found = {axis: s for axis in AXES if (s := summary.of(PLAIN, f"{letter}_{axis}")) is not None}
        if not found:
            yield untested(id, text, "", PLAIN, is_check=True)
            continue
        verdict = together(holds(low <= s.value <= high) for s in found.values())
        ours = "; ".join(f"{axis.upper()} {shown(s, unit)}" for axis, s in found.items())
        yield Claim(id, text, "", ours, verdict, "Means over the seeds.", is_check=True)


def _rates(summary: Summary) -> Iterator[Claim]:
    """Check 8: false alarms of both rules, at recorded updates with noise as the filter believes it."""
    for rule, word, (low, high) in (("literal", "literal", LITERAL_RATE), ("nis", "NIS", NIS_RATE)):
        id, text = f"rate-{rule}", f"The {word} rule triggers without a fault in {low:g} to {high:g} % of the updates"
        found = summary.rules.get(rule, {}).get("none")
        if found is None:
            yield untested(id, text, "", "rules", is_check=True)
            continue
        flown = summary.of(PUBLISHED if rule == "literal" else "ahrs-nis-o3", "triggered_quiet")
        evidence = (
            f"In the filter on the flight, outside manoeuvres: {shown(flown, '%', '.1f')}." if flown else "Simulated innovations."
        )
        yield Claim(id, text, "", shown(found, "%", ".2f"), holds(low <= found.value <= high), evidence, is_check=True)


def _minima(summary: Summary) -> Iterator[Claim]:
    """Check 10."""
    for which in OBJECTIVES:
        id, text = f"minimum-{which}", f"{which}: all searches come within {NEAR_MINIMUM:g} of Gauss-Newton's minimum"
        search = summary.searches.get(which)
        if search is None:
            yield untested(id, text, "", "searches", is_check=True)
            continue
        worst = {m: float(np.max(x)) for m, x in search.excess.items()}
        verdict = together(holds(x <= NEAR_MINIMUM) for x in worst.values())
        told = (f"{m.upper()} {plain(100 * float(np.mean(x <= NEAR_MINIMUM)), '.0f')} %" for m, x in search.excess.items())
        largest = (f"{m.upper()} {plain(x, '.1e')}" for m, x in worst.items())
        yield Claim(
            id,
            text,
            "",
            f"largest excess: {', '.join(largest)}",
            verdict,
            f"Updates within it: {', '.join(told)}.",
            is_check=True,
        )


def _ablation(summary: Summary) -> Iterator[Claim]:
    """Check 11."""
    id, text = "ablation-velocity", "AHRS has smaller velocity errors than CA/CV"
    found = summary.compare("v_3d", CA_CV, PLAIN)
    if found is None:
        yield untested(id, text, "", f"{PLAIN}, {CA_CV}", is_check=True)
    else:
        ours = f"AHRS against CA/CV {shown(found.percent, '%', '.1f')}"
        yield Claim(id, text, "", ours, positive(negated(found.percent)), _told(found), is_check=True)
    for name in ("ahrs-tdo-o1", "ahrs-tdo-o2"):
        id, text = f"worse-{name}", f"{FILTERS[name].title} is no better than AHRS, since it forgets the prediction"
        told = [d for metric in ("r_3d", "v_3d") if (d := summary.compare(metric, PLAIN, name)) is not None]
        if not told:
            yield untested(id, text, "", f"{PLAIN}, {name}", is_check=True)
            continue
        verdict = together(_no_better(d.difference) for d in told)
        ours = "; ".join(f"{METRICS[d.metric].title} {shown(d.percent, '%', '.1f')}" for d in told)
        yield Claim(id, text, "", ours, verdict, " ".join(map(_told, told)), is_check=True)


def _no_better(difference: Statistic) -> Verdict:
    """Whether errors are not significantly smaller."""
    if positive(difference) is Verdict.REPRODUCED:
        return Verdict.REPRODUCED
    return Verdict.NOT_REPRODUCED if positive(negated(difference)) is Verdict.REPRODUCED else Verdict.PARTLY


def _at_manoeuvres(summary: Summary) -> Iterator[Claim]:
    """Check 13: what corrections bring at manoeuvres and elsewhere."""
    for name in READINGS:
        id, text = f"windows-{name}", f"{FILTERS[name].title} is better than AHRS at manoeuvres, in position and velocity"
        inside = [d for m in ("r_manoeuvre", "v_manoeuvre") if (d := summary.compare(m, PLAIN, name)) is not None]
        if not inside:
            yield untested(id, text, "", f"{PLAIN}, {name}, or the flight was too short", is_check=True)
            continue
        quiet = [d for m in ("r_quiet", "v_quiet") if (d := summary.compare(m, PLAIN, name)) is not None]
        verdict = together(positive(negated(d.difference)) for d in inside)
        ours = "; ".join(f"{METRICS[d.metric].title} {shown(d.percent, '%', '.1f')}" for d in inside)
        evidence = "; ".join(f"{METRICS[d.metric].title} {shown(d.percent, '%', '.1f')}" for d in quiet)
        yield Claim(id, text, "", ours, verdict, f"{evidence}.", is_check=True)


def _consistent(summary: Summary) -> Iterator[Claim]:
    for name in (PLAIN, PUBLISHED, "ahrs-nis-o3", "graph"):
        id, text = f"nees-{name}", f"The covariance of {name_of(name)} is consistent"
        row = summary.rows.get(name)
        if row is None:
            yield untested(id, text, "", name, is_check=True)
            continue
        ours = f"NEES {shown(row.of('nees'))}, expected 6"
        evidence = f"The mean over the seeds lies in its 99 % band at {plain(row.nees_consistent, '.0f')} % of the epochs."
        yield Claim(id, text, "", ours, holds(row.is_consistent), evidence, is_check=True)


def _fast_enough(summary: Summary) -> Claim:
    id, text = "runtime", f"Relative filters without TDO take at most {RUNTIME_S:g} s for the flight"
    times = {name: s for name, row in summary.rows.items() if name in FILTERS and (s := row.of("runtime")) is not None}
    plain_ones = {name: s for name, s in times.items() if FILTERS[name].correction is None}
    if not plain_ones:
        return untested(id, text, "", "relative filters without TDO", is_check=True)
    slowest = max(plain_ones, key=lambda name: plain_ones[name].value)
    evidence = "Processor time, without simulation and the vehicles' own filters."
    if len(times) > len(plain_ones):
        most = max(times.keys() - plain_ones.keys(), key=lambda name: times[name].value)
        evidence += f" With corrections at most {shown(times[most], 's', '.2g')}, {name_of(most)}."
    ours = f"{shown(times[slowest], 's', '.2g')}, {name_of(slowest)}"
    return Claim(id, text, "", ours, holds(times[slowest].value <= RUNTIME_S), evidence, is_check=True)


def _aims(summary: Summary) -> Iterator[Claim]:
    """Half of the published best; carrier phases beside it, which the published system lacks."""
    best = summary.best
    if best is None:
        return
    mark = "" if best.is_consistent else " Its covariance is not consistent."
    for letter, unit, values, what in (
        ("r", "m", PAPER_POSITION[PUBLISHED], "Position"),
        ("v", "m/s", PAPER_VELOCITY[PUBLISHED], "Velocity"),
    ):
        for i, axis in enumerate(AXES):
            found, aim = best.of(f"{letter}_{axis}"), AIM * values[i]
            if found is None:
                continue
            text = f"{what} {axis.upper()}: the best estimator reaches half of the published best, {plain(aim)} {unit}"
            said = _least_words(summary, 3 * (letter == "v") + i, aim, unit) + mark
            phases = summary.of(PHASES, f"{letter}_{axis}")
            said += f" With carrier phases the graph has {shown(phases, unit)}." if phases else ""
            said += _seen_words(summary, best)
            ours = f"{name_of(best.name)}: {shown(found, unit)}"
            yield Claim(f"aim-{letter}-{axis}", text, "", ours, holds(found.value <= aim), said, is_check=True)


def _least_words(summary: Summary, i: int, aim: float, unit: str) -> str:
    """Whether an aim can be reached at all."""
    if summary.bound is None:
        return "The bound was not computed."
    least = float(summary.bound[i])
    of = f"the bound of {BOUND_OF} over the whole flight is {plain(least)} {unit}"
    if least <= aim:
        return f"It can be reached with these sensors: {of}."
    return f"In the mean over flights it cannot be reached with these sensors: {of}, {plain(least / aim, '.2f')} times the aim."


def _seen_words(summary: Summary, best: Row) -> str:
    """Who is not compared because of having seen less of the flight, and how much of it was seen."""
    left_out = [row.name for row in summary.published_scene if row.name in summary.cut_short]
    said = f" Until {plain(best.end_s)} s of the flight." if left_out or best.end_s < FLIGHT_S - SAME_END_S else ""
    if left_out:
        said += f" Left out, since they saw less of it: {', '.join(title_of(name) for name in left_out)}."
    return said


def _near_bound(summary: Summary) -> Iterator[Claim]:
    """How near the best estimator of the bound's own measurements comes to it."""
    best = summary.best_of(BOUND_SET)
    ratios = summary.over_bound(best.name) if best is not None else []
    for first, letter, what in ((0, "r", "Position"), (3, "v", "Velocity")):
        id = f"bound-{letter}"
        text = f"{what}: the best estimator of {BOUND_OF} is within {100 * (BOUND_NEAR - 1):.0f} % of their bound"
        found = [(axis, s) for axis, s in zip(AXES, ratios[first : first + 3], strict=False) if s is not None]
        if best is None or not found:
            yield untested(id, text, "", f"{BOUND}, {', '.join(BOUND_SET)}", is_check=True)
            continue
        verdict = together(positive(shifted(negated(s), BOUND_NEAR)) for _, s in found)
        told = ", ".join(f"{axis.upper()} {shown(s, '', '.2f')}" for axis, s in found)
        ours = f"{name_of(best.name)}: {told} times the bound"
        evidence = "Root mean square over all seeds and epochs; partly met where the mean is within it and its interval is not."
        evidence += "" if best.is_consistent else " Its covariance is not consistent."
        yield Claim(id, text, "", ours, verdict, evidence + _seen_words(summary, best), is_check=True)


# words


def _told(d: Difference) -> str:
    unit = METRICS[d.metric].unit
    wins = f"better in {d.better} of {seed_count(d.difference.n)}"
    return f"{name_of(d.second)} less {name_of(d.first)}, {METRICS[d.metric].title}: {shown(d.difference, unit)}, {wins}."
