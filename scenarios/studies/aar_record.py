"""The refuelling study on paper: its tables, a Markdown page with claims and parameters, results as JSON, CSV and Parquet.

Everything is made of the summary alone, so a page can be made again from the JSON file, and says then the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from scenarios.published.aar import DATA_SETS
from scenarios.studies.aar_claims import (
    GRAPH_SEES,
    GRAPH_TOLD,
    PAPER_RATIO,
    PAPER_SUCCESS,
    claims,
    robust_advantages,
)
from scenarios.studies.aar_summary import (
    ALGORITHMS,
    DEFAULT,
    FILTERS,
    GRAPH,
    RATIO_CAP,
    SCHEMES,
    SWEEP,
    Cell,
    Row,
    Summary,
    algorithm_name,
    from_json,
    metric_of,
    to_json,
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
from scenarios.studies.statistics import Statistic
from scenarios.studies.verdicts import count_verdicts, listed_claims, plain, shown, verdict_table
from scenarios.writers import write_csv, write_parquet

JSON_NAME, PAGE_NAME = "aar.json", "aar.md"
WIDE_POINTS = 20.0
VARIANTS = {
    DEFAULT: "main set",
    "literal-noise": "0.37 m, 1 cm and 1 cm/s read as deviations of undifferenced observations",
    "normalised": "normalised statistics of the adaptive factor and the state classes",
    "inflated-float": "float phases in the main filter, with their covariance",
    "known-float": "float phases in the main filter, as if known",
    "plain-main": "robust weights of the codes only in the subfilter",
    "reference-jumps": "the corrections of the tanker's filter count as noise",
    "ins-fault": "velocity fault put into the INS instead of the subfilter's prediction",
    "start": "other start times, hence other satellites",
    SWEEP: "code and INS precision varied",
}
GRAPH_FIXED = (
    "Of the graph an epoch counts as fixed where every satellite used has its integer held; P_SE: fixed and right. It has "
    "neither P_corr nor ratio."
)
ROBUST_LEAD = (
    "Whether the robust scheme (IBRKF) and the robust adaptive one (IBRCAF) succeed more often, beside each main filter:"
)
READINGS = (  # published or left open; done here; variants that show the other reading, on which data set and with what schemes
    (
        "Float phases enter the main filter as if their ambiguities were known.",
        "Phases whose integers fail the test are left out of the main filter.",
        (("known-float", 1, "35"), ("inflated-float", 1, "35")),
    ),
    (
        "Robust weights are those of the subfilter; of the main filter nothing is said.",
        "The main filter shares them.",
        (("plain-main", 2, "45"), ("plain-main", 4, "45")),
    ),
    (
        "The process noise of the ambiguities is not given.",
        "1.5 cycles/√s, tuned on Data 1 with seeds 1001 to 1010 for the success rate of EKF: 0.001 to 0.1 gives 99.9 %, "
        "1.0 93.7 %, 1.5 89.3 %, 2.0 85.6 %; published is 88.1 %. Kept for all data sets.",
        (),
    ),
    (
        "The satellites in view are not given.",
        "The start time is, of eight tried, the one whose single-epoch success and mean ratio come nearest to the published "
        "ones of WLS. Other start times have other satellites.",
        (("start", 1, "13"),),
    ),
    (
        "0.37 m, 1 cm and 1 cm/s, not said of what.",
        "Read as deviations of double differences: half as much undifferenced.",
        (("literal-noise", 1, "123"),),
    ),
    (
        "The tanker navigates by a filter of its own, whose tuning is not given.",
        "It is told codes of 30 m, so that its position is smooth: its corrections look like motion to the UAV's filter.",
        (("reference-jumps", 1, "3"), ("reference-jumps", 4, "5")),
    ),
    (
        "A velocity fault of Data 3 and 4 is put on the predicted state.",
        "It is put on the velocity that the subfilter predicts, not into the INS.",
        (("ins-fault", 3, "345"), ("ins-fault", 4, "45")),
    ),
)


def tables(summary: Summary) -> list[Table]:
    """All tables that have rows, in reading order."""
    return [*overview_tables(summary), *detail_tables(summary)]


def overview_tables(summary: Summary) -> list[Table]:
    """Success rates and ratios beside the published ones, and the graph."""
    found = [
        _paper_table(summary, "Success rate P_SE [%]", "p_se", PAPER_SUCCESS, ".1f", "Table 2"),
        _paper_table(summary, "Mean ratio", "ratio_mean", PAPER_RATIO, ".2f", "Figure 12"),
        _graph_table(summary),
    ]
    return [table for table in found if table.rows]


def detail_tables(summary: Summary) -> list[Table]:
    """All other tables that have rows."""
    found = [
        *(_rates(summary, data) for data in DATA_SETS),
        *(_errors(summary, data) for data in DATA_SETS),
        *(_faults(summary, data) for data in DATA_SETS),
        _manoeuvres(summary),
        _pairs(summary),
        _variants(summary),
        _starts(summary),
    ]
    return [table for table in found if table.rows]


def _paper_table(
    summary: Summary, title: str, metric: str, paper: Mapping[str, Mapping[int, float]], form: str, source: str
) -> Table:
    rows = []
    for data in DATA_SETS:
        for digit, scheme in SCHEMES.items():
            cells = [shown(summary.statistic(metric, digit + main, data), "", form) for main in FILTERS]
            published = paper[digit].get(data)
            if any(cell != "–" for cell in cells):
                rows.append((f"Data {data}", scheme, *cells, "–" if published is None else plain(published, form)))
    head = ("data", "scheme", *FILTERS.values(), source)
    note = "Mean over the seeds with its 95 % interval, beside each main filter. The publication gives one number a scheme."
    return Table(title, head, tuple(rows), note, 2)


def _graph_table(summary: Summary) -> Table:
    """The graph on the data sets, with what it does not share with the filters."""
    columns = (("p_fix", ".2f", 1.0), ("p_se", ".2f", 1.0), ("wrong_fix", ".2f", 1.0), ("baseline_rms", ".3g", 100.0))
    found = [(data, row) for data in DATA_SETS if (row := summary.row(GRAPH, data)) is not None]
    rows = tuple(
        (f"Data {d}", GRAPH_SEES.get(d, "–"), *(shown(row.statistics.get(m), "", form, scale) for m, form, scale in columns))
        for d, row in found
    )
    head = ("data", "what it sees", "fixed [%]", "P_SE [%]", "wrong of the fixed [%]", "baseline RMS [cm]")
    return Table("The factor graph", head, rows, f"{GRAPH_FIXED} {GRAPH_TOLD}", 2)


def graph_note(summary: Summary, data: int) -> str:
    """What to keep in mind beside a number of the graph; empty where it was not run."""
    if summary.row(GRAPH, data) is None:
        return ""
    return " ".join(note for note in (GRAPH_SEES.get(data), GRAPH_TOLD) if note)


def readings(summary: Summary) -> Table:
    """How the publication is read and where it is departed from, with P_SE of the variants that read it otherwise."""
    rows = tuple((published, here, _other_reading(summary, variants)) for published, here, variants in READINGS)
    head = ("published", "here", "the other reading, P_SE [%]")
    note = "In brackets the main set over its own seeds. Several numbers are those of several start times."
    return Table("Readings and departures", head, rows, note, 3)


def _other_reading(summary: Summary, variants: Sequence[tuple[str, int, str]]) -> str:
    told = (f"{name}, Data {data}: {_reading_numbers(summary, name, data, digits)}." for name, data, digits in variants)
    return " ".join(told) or "–"


def _reading_numbers(summary: Summary, variant: str, data: int, digits: str) -> str:
    """P_SE of schemes in a variant, at all its start times."""
    said = []
    for algorithm in (digit + main for digit in digits for main in FILTERS):
        cells = [row.cell for row in summary.rows if row.cell[:3] == (variant, data, algorithm)]
        found = [s for cell in cells if (s := summary.statistic("p_se", algorithm, data, variant, cell.start)) is not None]
        if found:
            default = summary.statistic("p_se", algorithm, data)
            beside = f" [{plain(default.value, '.1f')}]" if default else ""
            said.append(f"{algorithm_name(algorithm)} {', '.join(map(_with_span, found))}{beside}")
    return "; ".join(said) or "not run"


def _with_span(found: Statistic) -> str:
    """A mean with its smallest and largest seed where these lie far apart: some flights fail altogether, others not at all."""
    span = f" (seeds {plain(found.low, '.1f')} to {plain(found.high, '.1f')})" if found.high - found.low > WIDE_POINTS else ""
    return plain(found.value, ".1f") + span


Column = tuple[str, str, str, float]  # head, metric, format, scale


def _by_algorithm(
    summary: Summary, title: str, data: int, columns: Sequence[Column], note: str = "", extra: bool = False
) -> Table:
    """A row for each algorithm on a data set; with `extra` a last column tells whether its covariance is consistent."""
    rows = []
    for row in summary.rows:
        if (row.cell.variant, row.cell.data, row.cell.start) != (DEFAULT, data, 0):
            continue
        cells = [shown(row.statistics.get(metric), "", form, scale) for _, metric, form, scale in columns]
        if any(cell != "–" for cell in cells):
            rows.append((algorithm_name(row.cell.algorithm), *cells, *([_consistency(row)] if extra else [])))
    head = ("algorithm", *(column[0] for column in columns), *(["mean NEES in 99 % band [%]"] if extra else []))
    notes = " ".join(part for part in (note, graph_note(summary, data)) if part)
    return Table(f"{title}, Data {data}", head, tuple(rows), notes)


def _consistency(row: Row) -> str:
    mark = "" if row.is_consistent else " ‡"
    return f"{plain(row.nees_consistent)}{mark}"


def _rates(summary: Summary, data: int) -> Table:
    columns = (
        ("P_corr [%]", "p_corr", ".1f", 1.0),
        ("P_fix [%]", "p_fix", ".1f", 1.0),
        ("P_SE [%]", "p_se", ".1f", 1.0),
        ("wrong of the fixed [%]", "wrong_fix", ".2f", 1.0),
        ("ratio, mean", "ratio_mean", ".2f", 1.0),
        ("ratio, median", "ratio_median", ".2f", 1.0),
        ("ADOP, mean [cycles]", "adop_mean", ".3f", 1.0),
    )
    note = f"A ratio beyond {RATIO_CAP:.0f} counts as {RATIO_CAP:.0f} in its mean; epochs without a ratio are left out."
    note += f" {GRAPH_FIXED}" if summary.row(GRAPH, data) else ""
    return _by_algorithm(summary, "Ambiguities", data, columns, note)


def _errors(summary: Summary, data: int) -> Table:
    columns = (
        ("baseline RMS [m]", "baseline_rms", ".3g", 1.0),
        ("mean [m]", "baseline_mean", ".3g", 1.0),
        ("largest [m]", "baseline_max", ".3g", 1.0),
        ("fixed, RMS [cm]", "baseline_rms_fixed", ".3g", 100.0),
        ("fixed, largest [m]", "baseline_max_fixed", ".3g", 1.0),
        ("main filter RMS [m]", "main_rms", ".3g", 1.0),
        ("velocity RMS [cm/s]", "velocity_rms", ".3g", 100.0),
        ("largest [m/s]", "velocity_max", ".3g", 1.0),
        ("NEES, mean", "nees_mean", ".3g", 1.0),
        ("runtime [s]", "runtime", ".2g", 1.0),
    )
    note = "Norms of three components. ‡ covariance not consistent: mean NEES in its band at less than 90 % of the epochs."
    return _by_algorithm(summary, "Errors", data, columns, note, extra=True)


def _faults(summary: Summary, data: int) -> Table:
    columns = (
        ("ratio, median", "fault_ratio_median", ".2f", 1.0),
        ("P_SE inside [%]", "fault_p_se", ".1f", 1.0),
        ("P_SE outside [%]", "clear_p_se", ".1f", 1.0),
        ("baseline RMS inside [m]", "fault_baseline_rms", ".3g", 1.0),
        ("largest inside [m]", "fault_baseline_max", ".3g", 1.0),
        ("velocity, largest inside [m/s]", "fault_velocity_max", ".3g", 1.0),
    )
    return _by_algorithm(summary, "Fault windows", data, columns)


def _manoeuvres(summary: Summary) -> Table:
    columns = (
        *((f"{at} s", f"velocity_manoeuvre@{at}", ".3g", 100.0) for at in (20, 65, 180, 300)),
        ("all four", "velocity_manoeuvre", ".3g", 100.0),
        ("elsewhere", "velocity_elsewhere", ".3g", 100.0),
    )
    return _by_algorithm(summary, "Velocity RMS within 5 s of the manoeuvre changes [cm/s]", 1, columns)


def _name(cell: Cell) -> str:
    return algorithm_name(cell.algorithm)


def _pairs(summary: Summary) -> Table:
    """Paired differences on the main set."""
    rows = []
    for d in summary.differences:
        if d.metric not in ("p_se", "ratio_mean", "baseline_rms", "velocity_rms", "fault_p_se") or d.second.variant != DEFAULT:
            continue
        where = f"Data {d.first.data}" if d.first.data == d.second.data else f"Data {d.first.data} and {d.second.data}"
        names = (where, metric_of(d.metric).heading, _name(d.first), _name(d.second))
        rows.append((*names, shown(d.difference), shown(d.percent), d.tally))
    head = ("data", "quantity", "first", "second", "second less first", "in percent", "seeds better / worse / even")
    note = "Both methods of a pair saw the same noise."
    if any(row.cell.algorithm == GRAPH for row in summary.rows):
        note += "".join(f" {sees}" for sees in GRAPH_SEES.values()) + f" {GRAPH_TOLD}"
    return Table("Paired differences", head, tuple(rows), note, 4)


def _variants(summary: Summary) -> Table:
    rows = []
    for row in summary.rows:
        if row.cell.variant in (DEFAULT, "start"):
            continue
        values = [
            shown(row.statistics.get(m), "", form) for m, form in (("p_se", ".1f"), ("ratio_mean", ".2f"), ("wrong_fix", ".2f"))
        ]
        values += [shown(row.statistics.get(m)) for m in ("baseline_rms", "velocity_rms", "velocity_max")]
        main = row.cell._replace(variant=DEFAULT)
        gap = summary.difference("p_se", main, row.cell)
        change = shown(gap.difference if gap else None)
        rows.append((row.cell.variant, f"Data {row.cell.data}", _name(row.cell), change, *values, str(len(row.seeds))))
    head = (
        "variant", "data", "algorithm", "P_SE less main set's [points]", "P_SE [%]", "ratio, mean", "wrong of the fixed [%]",
        "baseline RMS [m]", "velocity RMS [m/s]", "velocity, largest [m/s]", "seeds",
    )  # fmt: skip
    used = dict.fromkeys(row[0] for row in rows)
    note = "; ".join(f"{name}: {VARIANTS.get(name, name)}" for name in used)
    paired = "Differences are paired over common seeds."
    return Table("Variants", head, tuple(rows), f"{note}. {paired}" if note else "", 3)


def _starts(summary: Summary) -> Table:
    """P_SE on Data 1 by start time, the main set as start 0."""
    starts = {row.cell.start: row.cell.variant for row in summary.rows if row.cell.variant == "start" and row.cell.data == 1}
    if not starts:
        return Table("Start times", (), ())
    columns = [(0, DEFAULT), *((start, variant) for start, variant in sorted(starts.items()) if start)]
    rows = []
    for algorithm in ALGORITHMS:
        cells = [shown(summary.statistic("p_se", algorithm, 1, variant, start), "", ".1f") for start, variant in columns]
        if any(cell != "–" for cell in cells[1:]):
            rows.append((algorithm_name(algorithm), *cells))
    head = ("algorithm", *(f"start {start}" for start, _ in columns))
    return Table("P_SE on Data 1 by start time [%]", head, tuple(rows), "Start 0 is that of the main set.")


# Markdown


def record_content(summary: Summary, parameters: Mapping[str, object], command: str) -> dict[str, Any]:
    """What the JSON file holds."""
    about = {"study": "aar", "command": command, "parameters": parameter_texts(parameters)}
    return about | {"claims": listed_claims(claims(summary))} | to_json(summary)


def markdown(content: Mapping[str, Any]) -> str:
    """The page of a record's content."""
    summary = from_json(content)
    judged = claims(summary)
    parts = [
        "# Aerial refuelling: a study after Wu and others (2022)\n",
        "What the publication on two-stage adaptive GNSS/INS relative navigation for aerial refuelling reports, and what "
        "`relnav study aar`, built after it, finds. Numbers are means over the seeds with 95 % bootstrap intervals; "
        "differences are paired. SKF and AKF are the standard and the adaptive main filter.\n",
        f"Made by\n\n```\n{content['command']}\n```\n",
        _runs(summary),
        f"Claims of the publication: {count_verdicts(judged, False)}. Further checks: {count_verdicts(judged, True)}.\n",
        *_readings_markdown(summary),
        "## Claims\n",
        markdown_table(verdict_table([c for c in judged if not c.is_check], "publication")),
        "## Further checks\n",
        markdown_table(verdict_table([c for c in judged if c.is_check], "")),
    ]
    parameters = parameter_table(content["parameters"])
    listed = [*tables(summary), *_curves(summary), *([parameters] if parameters.rows else [])]
    return "\n".join([*parts, *map(markdown_section, listed)])


def _readings_markdown(summary: Summary) -> list[str]:
    advantages = robust_advantages(summary)
    listed = "".join(f"- {sentence}\n" for sentence in advantages)
    found = [f"{ROBUST_LEAD}\n", listed] if advantages else []
    return [*found, markdown_section(readings(summary))]


def _runs(summary: Summary) -> str:
    rows = []
    for variant in dict.fromkeys(row.cell.variant for row in summary.rows):
        mine = [row for row in summary.rows if row.cell.variant == variant]
        data = ", ".join(str(d) for d in sorted({row.cell.data for row in mine}))
        starts = ", ".join(str(s) for s in sorted({row.cell.start for row in mine}))
        n = sorted({len(row.seeds) for row in mine})
        seeds = str(n[0]) if len(n) == 1 else f"{n[0]} to {n[-1]}"
        rows.append((variant, VARIANTS.get(variant, ""), data, starts, seeds))
    if summary.curves:
        rows.append((SWEEP, VARIANTS[SWEEP], "1", "0", str(max(curve.n for curve in summary.curves))))
    return markdown_table(Table("", ("variant", "what", "Data", "start", "seeds"), tuple(rows), n_text=4))


def _curves(summary: Summary) -> list[Table]:
    titles = {
        "adop_code": ("ADOP against the code σ [cycles]", ".3g"),
        "adop_ins": ("ADOP against the σ of the INS position [cycles]", ".3g"),
        "success_ins": ("P_corr against the σ of the INS position [%]", ".1f"),
        "success_bias": ("P_corr against a bias of the INS position [%]", ".1f"),
    }
    found = []
    for curve in summary.curves:
        if curve.name not in titles:
            continue
        title, form = titles[curve.name]
        rows = tuple((plain(x), *(plain(row[j], form) for row in curve.mean)) for j, x in enumerate(curve.x))
        found.append(Table(title, (curve.x_title, *curve.labels), rows))
    return found


# files


def write_record(summary: Summary, folder: Path, parameters: Mapping[str, object], command: str) -> list[Path]:
    """Write the JSON file and the Markdown page of the study. Raises InputError naming what cannot be written."""
    content = record_content(summary, parameters, command)
    return [write_text(folder / JSON_NAME, json_text(content)), write_text(folder / PAGE_NAME, markdown(content))]


def write_table(summary: Summary, folder: Path, stem: str = "results") -> list[Path]:
    """Write every statistic as one long table, CSV and Parquet: a row for each cell and metric."""
    names = ("variant", "data", "start", "algorithm", "metric", "unit", "mean", "lower", "upper", "smallest", "largest", "seeds")
    columns = zip(*_long_rows(summary), strict=True) if summary.rows else [()] * len(names)
    table = pa.table(dict(zip(names, (list(column) for column in columns), strict=True)))
    written = []
    writers: tuple[tuple[str, Callable[[pa.Table, Path], None]], ...] = (("csv", write_csv), ("parquet", write_parquet))
    for kind, write in writers:
        written.append(folder / f"{stem}.{kind}")
        write(table, written[-1])
    return written


def _long_rows(summary: Summary) -> Iterator[tuple[object, ...]]:
    for row in summary.rows:
        cell = row.cell
        for name, s in row.statistics.items():
            yield cell.variant, cell.data, cell.start, cell.algorithm, name, metric_of(name).unit, *s.numbers, s.n
