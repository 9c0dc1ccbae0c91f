"""The study `ahrs-tdo` on paper: claims, tables beside the publication's, as Markdown, JSON and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scenarios.metrics_ranks import LEVEL
from scenarios.published.ahrs_tdo_filters import CA_CV, FILTERS, TUNING_SEEDS, WALKS
from scenarios.studies.ahrs_tdo import TUNED_UNTIL_S, parameters
from scenarios.studies.ahrs_tdo_claims import NEAR_MINIMUM, PAPER_POSITION, PAPER_VELOCITY, claims, name_of
from scenarios.studies.ahrs_tdo_summary import (
    AXES,
    EVEN,
    METRICS,
    PLAIN,
    PUBLISHED,
    RECOVERED_S,
    SETTLED_S,
    Row,
    Search,
    Summary,
    pairs,
    summarise,
    title_of,
)
from scenarios.studies.document import (
    Table,
    json_text,
    markdown_section,
    markdown_table,
    parameter_table,
    parameter_texts,
    write_text,
)
from scenarios.studies.statistics import CONSISTENT_PCT, Statistic
from scenarios.studies.study import Job, Outcome, Results
from scenarios.studies.verdicts import Claim, count_verdicts, listed_claims, plain, shown, verdict_table

JSON_NAME, PAGE_NAME, REPORT_NAME = "ahrs-tdo.json", "ahrs-tdo.md", "report.html"
INCONSISTENT = "‡"
MARKED = (
    f"{INCONSISTENT} covariance not consistent: mean NEES in its 99 % band at less than {CONSISTENT_PCT:.0f} % of the epochs."
)
HOW = (
    "Two UAVs, 600 s: numbers are means over the seeds with 95 % intervals, errors follower less leader in Earth-fixed axes "
    f"from {SETTLED_S:g} s on; differences are paired. The published numbers are of one run on another trajectory."
)
READINGS = (  # published or left open; done here
    ("The trajectory is a figure without scale, the sky is not given.", "A flight of its own, 8 satellites of GPS above 15°."),
    (
        "Errors of the attitude systems are not given.",
        "0.1° in roll and pitch, 0.3° in heading, correlated over 5 s. The filter is told white noise of the same spread.",
    ),
    (
        "The rule is printed with innovations, its description speaks of the new innovation.",
        "Innovations; “residual” judges what is left.",
    ),
    (
        "The objective is a vector, Z − HX.",
        "O1: its sizes with the weights of the rule. O2: squares with the measurements' covariance. O3: O2 and the prediction.",
    ),
    ("Of the covariance after TDO nothing is said.", "The filter's is kept; “joseph” has that of the correction."),
    (
        "The search space is initialised from posterior and covariance.",
        "Deviations over their σ, ± 3; “raw” searches the states.",
    ),
    (
        "Differences of absolute positions are measurements like any other.",
        "They are made of the same codes as the double differences: their covariance is multiplied by 4.",
    ),
    ("The crystal's scale factor is simulated.", "It is not estimated by the relative filter; “scale known” takes it off."),
)


def tables(summary: Summary) -> list[Table]:
    """All tables that have rows, in reading order."""
    found = [
        rmse_table(summary, "r"),
        rmse_table(summary, "v"),
        spread_table(summary),
        window_table(summary),
        consistency_table(summary),
        *(pair_table(summary, kind) for kind in ("position", "velocity")),
        search_table(summary),
        rule_table(summary),
        walk_table(summary),
        runtime_table(summary),
    ]
    return [table for table in found if table.rows]


def rmse_table(summary: Summary, letter: str) -> Table:
    """RMSE per axis beside the publication's."""
    what, unit, source, published = (
        ("Position", "m", "Table 3", PAPER_POSITION) if letter == "r" else ("Velocity", "m/s", "Table 4", PAPER_VELOCITY)
    )
    metrics = [*(f"{letter}_{axis}" for axis in AXES), f"{letter}_3d"]
    rows = []
    for name, row in summary.rows.items():
        paper = " / ".join(plain(x) for x in published[name]) if name in published else ""
        rows.append((marked(row), *(shown(row.of(m)) for m in metrics), paper, str(len(row.seeds))))
    if summary.bound is not None:
        part = summary.bound[:3] if letter == "r" else summary.bound[3:]
        rows.append(("bound of the whole flight", *(plain(x) for x in part), plain(float(np.linalg.norm(part))), "", ""))
    head = (
        "estimator",
        *(f"{axis.upper()} [{unit}]" for axis in AXES),
        f"3D [{unit}]",
        f"published X / Y / Z ({source})",
        "seeds",
    )
    return Table(f"{what}, RMSE", head, tuple(rows), f"{MARKED}{_shorter(summary)}")


def _shorter(summary: Summary) -> str:
    """Who saw less of the flight than others."""
    names = summary.cut_short
    if not names:
        return ""
    until = max(summary.rows[name].end_s for name in names)
    return f" Until {plain(until)} s of the flight: {', '.join(title_of(name) for name in names)}."


def marked(row: Row) -> str:
    """An estimator's title, with a mark where its covariance is not consistent."""
    title = title_of(row.name)
    return title if row.is_consistent else f"{title} {INCONSISTENT}"


def _table(summary: Summary, title: str, metrics: Sequence[str], note: str = "", form: str = ".3g") -> Table:
    """A row for each estimator that has one of some metrics."""
    rows = []
    for row in summary.rows.values():
        cells = [shown(row.of(m), "", form) for m in metrics]
        if any(cell != "–" for cell in cells):
            rows.append((marked(row), *cells))
    return Table(title, ("estimator", *(METRICS[m].heading for m in metrics)), tuple(rows), note)


def spread_table(summary: Summary) -> Table:
    return _table(summary, "Standard deviations and 95 % of the epochs", ("r_std", "r_p95", "v_std", "v_p95"), MARKED)


def window_table(summary: Summary) -> Table:
    note = f"Manoeuvres: from the start of a push to {RECOVERED_S:g} s after its end."
    metrics = ("r_manoeuvre", "r_quiet", "v_manoeuvre", "v_quiet", "triggered_manoeuvre", "triggered_quiet", "triggered")
    return _table(summary, "At manoeuvres and elsewhere", metrics, note)


def consistency_table(summary: Summary) -> Table:
    """NEES and NIS with their bands."""
    rows = []
    for row in summary.rows.values():
        lower, upper = row.nis_band
        band = f"{plain(lower)} to {plain(upper)}" if np.isfinite(lower) else "–"
        cells = (shown(row.of("nees")), plain(row.nees_consistent, ".0f"), shown(row.of("nis")), band)
        rows.append((marked(row), *cells))
    head = (
        "estimator",
        "NEES, mean (6)",
        "mean NEES in 99 % band [% of epochs]",
        "NIS per row (1)",
        "95 % band of white innovations",
    )
    return Table("Consistency", head, tuple(rows), MARKED)


def pair_table(summary: Summary, kind: str) -> Table:
    """Paired differences of position or velocity."""
    rows = []
    letter = "r" if kind == "position" else "v"
    for first, second in pairs():
        cells = []
        for metric in (f"{letter}_3d", f"{letter}_manoeuvre", f"{letter}_quiet"):
            d = summary.compare(metric, first, second)
            cells.append(shown(d.percent, "", ".1f") if d else "–")
        d = summary.compare(f"{letter}_3d", first, second)
        if d is not None:
            rows.append((name_of(first), name_of(second), shown(d.difference), *cells, d.tally))
    unit = METRICS[f"{letter}_3d"].unit
    head = (
        "first",
        "second",
        f"second less first [{unit}]",
        "in percent",
        "at manoeuvres [%]",
        "elsewhere [%]",
        "seeds better / worse / even",
    )
    return Table(
        f"Paired differences, {kind} RMSE",
        head,
        tuple(rows),
        "Bootstrap intervals over the seeds; negative: the second is better.",
        2,
    )


def search_table(summary: Summary) -> Table:
    """Excess of every method over Gauss-Newton on recorded updates."""
    rows = []
    for which, search in summary.searches.items():
        for method, x in search.excess.items():
            quartiles = np.quantile(x, (0.25, 0.5, 0.75))
            near, needed = plain(100 * float(np.mean(x <= NEAR_MINIMUM)), ".0f"), search.evals_to(method, NEAR_MINIMUM)
            spread = f"{plain(float(quartiles[0]), '.1e')} to {plain(float(quartiles[2]), '.1e')}"
            cells = (which, method.upper(), plain(float(quartiles[1]), ".1e"), spread, plain(float(x.max()), ".1e"))
            rows.append((*cells, near, plain(needed, ",.0f"), f"{search.evals[method]:,.0f}", _tested(search, method)))
    head = (
        "objective", "method", "J/J(GN) − 1, median", "quartiles", "largest", f"within {NEAR_MINIMUM:g} [%]",
        "evaluations until then", "all evaluations", "TDO against it",
    )  # fmt: skip
    note = (
        "Updates recorded from the plain filter, two of them at manoeuvres. Wilcoxon's signed-rank test over the seeds of mean "
        f"logarithms, differences below {EVEN:g} even. Below zero: lower than Gauss-Newton, which for O1 is reweighted. The "
        "least of O3 lies where the filter's posterior is, the origin of the searched deviations, to which TDO's steps contract."
    )
    return Table("Searches of recorded updates", head, tuple(rows), note, 2)


def _tested(search: Search, method: str) -> str:
    if method == "tdo" or "tdo" not in search.excess:
        return ""
    test = search.against("tdo", method)
    word = "no difference" if test.p >= LEVEL or test.sign == 0 else "lower" if test.sign > 0 else "higher"
    return f"{word} (p = {plain(test.p, '.2g')})"


def rule_table(summary: Summary) -> Table:
    """Detection probabilities of the rules."""
    mismatches = list(dict.fromkeys(name for of in summary.rules.values() for name in of))
    rows = tuple((rule, *(shown(of.get(m), "", ".1f") for m in mismatches)) for rule, of in summary.rules.items())
    note = (
        "Percent of updates at which a rule triggers, noise as the filter believes it, at updates recorded from the plain filter."
    )
    return Table("What the rules see [%]", ("rule", *mismatches), rows, note)


def walk_table(summary: Summary) -> Table:
    """Tuning of CA and CV."""
    rows = []
    for name, w in summary.walks.items():
        used = WALKS[FILTERS[name].configuration.motion]
        for i, walk in enumerate(w.walk):
            mark = " (used)" if walk == used else ""
            numbers = (plain(float(x[i]), ".3g") for x in (w.position_m, w.velocity_mps, w.merit))
            rows.append((name.upper(), f"{plain(float(walk))}{mark}", *numbers))
    note = (
        f"Mean of seeds {TUNING_SEEDS[0]} to {TUNING_SEEDS[-1]} on the first {TUNED_UNTIL_S:g} s. The merit is the geometric "
        f"mean of both errors over their best. The better filter, {CA_CV.upper()}, stands for CA/CV."
    )
    return Table(
        "Tuning of CA and CV", ("filter", "walk", "position RMSE [m]", "velocity RMSE [m/s]", "merit"), tuple(rows), note
    )


def runtime_table(summary: Summary) -> Table:
    note = "Processor time for the flight of 600 s; of relative filters without simulation, own filters and preparation."
    return _table(summary, "Runtime", ("runtime",), note, ".2g")


def readings_table() -> Table:
    return Table("What is read or done otherwise", ("published or left open", "here"), READINGS, n_text=2)


# files


def write(results: Results[Job], folder: Path, command: str) -> Outcome:
    """The record as JSON and Markdown and the page, in `folder`."""
    from scenarios.report.ahrs_tdo import write_study

    summary = summarise(results)
    judged = claims(summary)
    write_text(folder / JSON_NAME, json_text(record(summary, judged, command)))
    write_text(folder / PAGE_NAME, markdown(summary, judged, command))
    write_study(summary, judged, results, folder / REPORT_NAME, command)
    said = [
        f"claims of the publication: {count_verdicts(judged, is_check=False)}",
        f"further checks: {count_verdicts(judged, is_check=True)}",
        *_aim_lines(judged),
        f"written: {JSON_NAME}, {PAGE_NAME}, {REPORT_NAME} in {folder}",
    ]
    return Outcome(tuple(said))


def _aim_lines(judged: Sequence[Claim]) -> list[str]:
    return [f"{c.text}: {c.word} ({c.ours}). {c.evidence}" for c in judged if c.id.startswith(("aim-r", "bound-r"))]


def markdown(summary: Summary, judged: Sequence[Claim], command: str) -> str:
    """The record as a page of the documentation."""
    parts = [
        "# Attitude systems, UWB and TDO: a study after Lu and others (2024)\n",
        f"`{command}`. {HOW} AHRS+TDO is the reading “{FILTERS[PUBLISHED].title}”, AHRS “{FILTERS[PLAIN].title}”, CA/CV "
        f"“{FILTERS[CA_CV].title}”.\n",
        f"Claims of the publication: {count_verdicts(judged, False)}. Further checks: {count_verdicts(judged, True)}.\n",
        markdown_section(readings_table()),
        "## Claims\n",
        markdown_table(verdict_table([c for c in judged if not c.is_check], "published")),
        "## Further checks\n",
        markdown_table(verdict_table([c for c in judged if c.is_check], "")),
        *(markdown_section(table) for table in tables(summary)),
        markdown_section(parameter_table(parameter_texts(parameters()))),
    ]
    return "\n".join(parts)


def record(summary: Summary, judged: Sequence[Claim], command: str) -> dict[str, Any]:
    """What the JSON file holds; unknown numbers are None."""
    return {
        "study": "ahrs-tdo",
        "command": command,
        "parameters": parameter_texts(parameters()),
        "statistic": ["mean", "lower", "upper", "smallest seed", "largest seed", "seeds"],
        "claims": listed_claims(judged),
        "rows": [
            {
                "name": row.name,
                "title": title_of(row.name),
                "seeds": list(row.seeds),
                "nees_consistent": _number(row.nees_consistent),
                "statistics": {m: _listed(found) for m in row.values if (found := row.of(m)) is not None},
            }
            for row in summary.rows.values()
        ],
        "differences": [
            [metric, first, second, _listed(d.difference), _listed(d.percent), d.better, d.worse]
            for first, second in pairs()
            for metric in ("r_3d", "v_3d", "r_manoeuvre", "v_manoeuvre", "r_quiet", "v_quiet")
            if (d := summary.compare(metric, first, second)) is not None
        ],
        "searches": [
            {"objective": which, "method": m, "excess": [_number(float(v)) for v in np.quantile(x, (0.25, 0.5, 0.75, 1.0))]}
            for which, s in summary.searches.items()
            for m, x in s.excess.items()
        ],
        "rules": {rule: {m: _listed(s) for m, s in of.items()} for rule, of in summary.rules.items()},
        "bound": None if summary.bound is None else [_number(float(v)) for v in summary.bound],
    }


def _listed(s: Statistic) -> list[float | None]:
    return [_number(v) for v in (*s.numbers, s.n)]


def _number(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None
