"""The page of the study `ahrs-tdo`: verdicts, errors beside the publication's, a counterpart of figures 5 and 7 to 16, tables.

Timelines show one seed, the first; everything else is of all seeds.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from factorgraph.consistency import average_nees
from scenarios.metrics import cdf
from scenarios.published.ahrs_tdo import MANOEUVRES
from scenarios.published.ahrs_tdo_filters import CA_CV
from scenarios.report.chart import Chart, Panel, log_axis, shaded, time_chart
from scenarios.report.frame import Card, Page, Section, write_page
from scenarios.report.series import (
    ALERT_COLOUR,
    CYCLE,
    TRUTH_COLOUR,
    Trace,
    band,
    legend_once,
    line,
    numbers,
    thin,
)
from scenarios.report.tables import document_table, text
from scenarios.report.verdicts import bars, claim_sections, prose, published, verdict_cards
from scenarios.studies.ahrs_tdo import GRID, OTHERS, parameters
from scenarios.studies.ahrs_tdo_claims import METHODS, PAPER_POSITION, PAPER_VELOCITY
from scenarios.studies.ahrs_tdo_record import HOW, readings_table, tables
from scenarios.studies.ahrs_tdo_summary import AXES, PLAIN, PUBLISHED, RECOVERED_S, Row, Search, Summary, estimators, title_of
from scenarios.studies.document import parameter_table, parameter_texts
from scenarios.studies.statistics import NEES_PROB
from scenarios.studies.study import Arrays, Job, Results
from scenarios.studies.verdicts import Claim, plain, seed_count

MAIN = (CA_CV, PLAIN, PUBLISHED)
COMPARED = (PUBLISHED, CA_CV, PLAIN, "graph", "eskf", "moving-horizon", "ahrs-tdo-o2", "ahrs-nis-o3", "no-abs")
COLOURS = dict(zip(COMPARED, (*CYCLE, TRUTH_COLOUR), strict=True))
METHOD_COLOURS = {"tdo": CYCLE[0], "pso": CYCLE[1], "ga": CYCLE[2]}
FEW_SEEDS = 10
CDF_POINTS = 300
LABEL_WIDTH = 14
CURVE_POINTS = 1200
LOWEST_EXCESS = 1e-12  # where the axis of the searches begins
Quantity = tuple[str, str, str, str]  # letter of the metrics, unit, name of the norms, word
POSITION: Quantity = ("r", "m", "position_m", "position")
VELOCITY: Quantity = ("v", "m/s", "velocity_mps", "velocity")


def write_study(summary: Summary, judged: Sequence[Claim], results: Results[Job], path: Path, command: str) -> Path:
    """Write the page of the study; of `results` only the first seed is loaded. Returns the path."""
    return write_page(study_page(summary, judged, first_seed(results), command), path)


def first_seed(results: Results[Job]) -> dict[str, Arrays]:
    """Arrays of the first seed by estimator."""
    flown = [
        job for job in results if "seed" in job.parameters and (job.parameters["part"] in OTHERS or "filters" in job.parameters)
    ]
    first = min((job.parameters["seed"] for job in flown), default=None)
    found: dict[str, Arrays] = {}
    for job in flown:
        if job.parameters["seed"] == first:
            arrays = results[job]
            found |= dict.fromkeys(estimators(arrays), arrays)
    return found


def study_page(summary: Summary, judged: Sequence[Claim], first: Mapping[str, Arrays], command: str) -> Page:
    """What the page says."""
    few = summary.n_seeds < FEW_SEEDS
    return Page(
        title="Attitude systems, UWB and TDO – study after Lu and others (2024)",
        heading="Attitude systems, UWB and TDO: a study after Lu and others (2024)",
        sections=[
            _error_section(summary, POSITION, PAPER_POSITION, 3, 7, 8),
            _error_section(summary, VELOCITY, PAPER_VELOCITY, 4, 12, 13),
            *_claim_sections(judged),
            _readings_section(),
            _timeline_section(first, POSITION, 9),
            _timeline_section(first, VELOCITY, 14),
            _search_section(summary),
            _window_section(summary),
            _consistency_section(summary),
            _table_section(summary),
        ],
        cards=_cards(summary, judged),
        badge=seed_count(summary.n_seeds),
        badge_is_good=not few,
        lines=(text(HOW), f"Made by <code>{text(command)}</code>"),
        reasons=[f"{summary.n_seeds} seeds are few: intervals of this run are wide."] if few else [],
    )


def _shown(summary: Summary, names: Sequence[str]) -> list[Row]:
    return [summary.rows[name] for name in names if name in summary.rows]


# overview


def _cards(summary: Summary, judged: Sequence[Claim]) -> list[Card]:
    cards = verdict_cards(judged)
    for other in (PLAIN, CA_CV):
        found = [summary.compare(metric, other, PUBLISHED) for metric in ("r_3d", "v_3d")]
        if all(d is not None for d in found):
            value = " | ".join(f"{plain(d.percent.value, '+.1f')} %" for d in found if d is not None)
            cards.append(Card(f"AHRS+TDO less {METHODS[other]}", value, "RMSE of position | velocity"))
    best = summary.best
    if best is not None:
        rmse = [best.of(metric) for metric in ("r_3d", "v_3d")]
        value = " | ".join(plain(s.value) for s in rmse if s is not None)
        mark = "consistent" if best.is_consistent else "covariance not consistent"
        cards.append(Card(f"Best: {title_of(best.name)}", value, f"RMSE, m | m/s; {mark}"))
    return cards


def _claim_sections(judged: Sequence[Claim]) -> list[Section]:
    lead = (
        "A published number counts as reproduced where it lies within the span of the seeds or near their mean, a comparison "
        "where the 95 % interval of the paired difference lies on the right side of zero."
    )
    return claim_sections(judged, lead)


def _readings_section() -> Section:
    found = readings_table()
    return Section("readings", found.title, "Readings", html=prose(found.head, found.rows))


# errors


def _error_section(
    summary: Summary, quantity: Quantity, paper: Mapping[str, Sequence[float]], table_of: int, cdf_of: int, std_of: int
) -> Section:
    letter, _, _, word = quantity
    rows = _shown(summary, COMPARED)
    title = f"{word.capitalize()} errors"
    if not rows:
        return Section(word, title, word.capitalize(), absent="No estimator was run on the flight as published.")
    charts = [
        _rmse_chart(rows, quantity, paper, f"Table {table_of} of the paper: {word} RMSE per axis"),
        _cdf_chart(rows, quantity, f"Figure {cdf_of} of the paper: distribution of the {word} error"),
        _std_chart(rows, quantity, f"Figure {std_of} of the paper: standard deviation of the {word} error per axis"),
    ]
    found = tables(summary)[0 if letter == "r" else 1]
    return Section(word, title, word.capitalize(), charts, document_table(found))


def _rmse_chart(rows: Sequence[Row], quantity: Quantity, paper: Mapping[str, Sequence[float]], title: str) -> Chart:
    letter, unit, _, word = quantity
    return _axis_bars(rows, letter, unit, f"{word} RMSE [{unit}]", title, paper)


def _std_chart(rows: Sequence[Row], quantity: Quantity, title: str) -> Chart:
    letter, unit, _, word = quantity
    return _axis_bars(rows, f"{letter}_std", unit, f"std of the {word} error [{unit}]", title, {})


def _axis_bars(
    rows: Sequence[Row], metric: str, unit: str, y_title: str, title: str, paper: Mapping[str, Sequence[float]]
) -> Chart:
    """Bars of every axis, a group for each estimator."""
    titles = [_label(row) for row in rows]
    traces: list[Trace] = []
    for i, axis in enumerate(AXES):
        found = [(name, s) for name, row in zip(titles, rows, strict=True) if (s := row.of(f"{metric}_{axis}")) is not None]
        traces.append(bars([name for name, _ in found], [s for _, s in found], CYCLE[i], axis.upper()) | {"offsetgroup": axis})
    for i, axis in enumerate(AXES):
        known = [(name, paper[row.name][i]) for name, row in zip(titles, rows, strict=True) if row.name in paper]
        if known:
            mark = published([name for name, _ in known], [value for _, value in known])
            traces.append(
                mark | {"offsetgroup": axis, "hovertemplate": f"published, {axis.upper()}: %{{y}} {unit}<extra></extra>"}
            )
    layout = {
        "barmode": "group",
        "scattermode": "group",
        "hovermode": "closest",
        "xaxis": {"type": "category"},
        "yaxis": {"title": {"text": y_title}, "rangemode": "tozero"},
    }
    return Chart(title, legend_once(traces), layout, 400)


def _label(row: Row) -> str:
    """An estimator below a group of bars, in short lines."""
    return "<br>".join(textwrap.wrap(title_of(row.name), LABEL_WIDTH))


def _cdf_chart(rows: Sequence[Row], quantity: Quantity, title: str) -> Chart:
    _, unit, norms, word = quantity
    traces, ends = [], []
    for row in rows:
        size, share = cdf(getattr(row.norms, norms))
        if not len(size):
            continue
        at = np.unique(np.linspace(0, len(size) - 1, CDF_POINTS).round().astype(int))
        ends += [size[len(size) // 100], size[-1]]
        width = 2.4 if row.name in MAIN else 1.4
        curve = line(size[at], 100 * share[at], np.zeros(len(at), np.int64), name=title_of(row.name), mode="lines")
        traces.append(
            curve
            | {"x": numbers(size[at], 4), "line": {"color": COLOURS[row.name], "width": width}, "hovertemplate": "%{y:.1f} %"}
        )
    layout = {
        "hovermode": "closest",
        "xaxis": {"title": {"text": f"|{word} error| [{unit}]"}} | log_axis(np.array(ends)),
        "yaxis": {"title": {"text": "epochs below [%]"}, "range": [0, 101]},
    }
    return Chart(title, legend_once(traces), layout, 400, "All seeds and epochs together.")


def _timeline_section(first: Mapping[str, Arrays], quantity: Quantity, figure: int) -> Section:
    _, unit, _, word = quantity
    names = [name for name in (*MAIN, "graph") if name in first]
    if not names:
        return Section(f"time-{word}", "", "", absent="")
    what = "position_error_m" if word == "position" else "velocity_error_mps"
    charts = []
    for i, axis in enumerate(AXES):
        traces: list[Trace] = []
        for name in names:
            arrays = first[name]
            t_s, y = np.asarray(arrays["t_s"], float), np.asarray(arrays[f"{name}/{what}"], float)[:, i]
            at = thin(CURVE_POINTS, y)
            curve = line(t_s[at], y[at], np.zeros(len(at), np.int64), name=title_of(name))
            traces.append(curve | {"line": {"color": COLOURS[name], "width": 1.4}, "hovertemplate": f"%{{y:.4~f}} {unit}"})
        traces += _sigma(first, i + 3 * (word == "velocity"))
        charts.append(
            shaded(
                time_chart(
                    f"Figure {figure + i} of the paper: {word} error {axis.upper()}", [Panel(f"{axis.upper()} [{unit}]", traces)]
                ),
                MANOEUVRES,
            )
        )
    lead = f"The first seed. Shaded: ±3σ of {title_of(PLAIN)}; bars: the follower is pushed aside."
    return Section(f"time-{word}", f"{word.capitalize()} errors over time", f"{word.capitalize()} over time", charts, lead=lead)


def _sigma(first: Mapping[str, Arrays], column: int) -> list[Trace]:
    """Three standard deviations of the plain filter."""
    if PLAIN not in first:
        return []
    t_s, sigma = np.asarray(first[PLAIN]["t_s"], float), 3 * np.asarray(first[PLAIN][f"{PLAIN}/sigma"], float)[:, column]
    at = thin(CURVE_POINTS, sigma)
    area = band(t_s[at], -sigma[at], sigma[at], np.zeros(len(at), np.int64), COLOURS[PLAIN], name="±3σ")
    return [] if area is None else [area]


# searches


def _search_section(summary: Summary) -> Section:
    charts = [_search_chart(search) for search in summary.searches.values()]
    lead = (
        "Figure 5 of the paper: objectives of recorded updates against evaluations, relative to the minimum that Gauss-Newton "
        "finds. Medians over updates and seeds, shaded the quartiles of TDO."
    )
    found = next((t for t in tables(summary) if t.title.startswith("Searches")), None)
    html = document_table(found) if found else ""
    return Section("searches", "Searches", "Searches", charts, html, "Searches were not run.", lead)


def _search_chart(search: Search) -> Chart:
    traces: list[Trace] = []
    low, high = LOWEST_EXCESS, LOWEST_EXCESS
    flat = np.zeros(len(GRID), np.int64)
    for method, history in search.history.items():
        curves = np.quantile(np.maximum(history.reshape(-1, history.shape[-1]), LOWEST_EXCESS), (0.25, 0.5, 0.75), axis=0)
        high = max(high, float(curves.max()))
        if method == "tdo":
            area = band(GRID, curves[0], curves[2], flat, METHOD_COLOURS[method], name="quartiles of TDO")
            traces += [area] if area is not None else []
        style = {"color": METHOD_COLOURS[method], "width": 1.8}
        traces.append(line(GRID, curves[1], flat, name=method.upper(), mode="lines", line=style) | {"hovertemplate": "%{y:.2~e}"})
    layout = {
        "hovermode": "x unified",
        "xaxis": {"title": {"text": "evaluations"}, "hoverformat": ",d"} | log_axis(GRID),
        "yaxis": {"title": {"text": "J / J(Gauss-Newton) − 1"}, "exponentformat": "power"} | log_axis(np.array([low, high])),
    }
    return Chart(f"Objective {search.objective}", legend_once(traces), layout, 380, wide=False)


# manoeuvres, consistency, tables


def _window_section(summary: Summary) -> Section:
    rows = [row for row in _shown(summary, COMPARED) if row.of("r_manoeuvre") is not None]
    charts = []
    for letter, unit, _, word in (POSITION, VELOCITY) if rows else ():
        traces = []
        for part, name, colour in (("manoeuvre", "at manoeuvres", ALERT_COLOUR), ("quiet", "elsewhere", TRUTH_COLOUR)):
            found = [(row, s) for row in rows if (s := row.of(f"{letter}_{part}")) is not None]
            traces.append(bars([_label(row) for row, _ in found], [s for _, s in found], colour, name))
        layout = {
            "barmode": "group",
            "hovermode": "closest",
            "xaxis": {"type": "category"},
            "yaxis": {"title": {"text": f"{word} RMSE [{unit}]"}, "rangemode": "tozero"},
        }
        charts.append(Chart(f"{word.capitalize()} at manoeuvres and elsewhere", legend_once(traces), layout, 360))
    lead = f"Manoeuvres: from the start of a push to {RECOVERED_S:g} s after its end."
    return Section("windows", "Manoeuvres", "Manoeuvres", charts, absent="The flight was too short for manoeuvres.", lead=lead)


def _consistency_section(summary: Summary) -> Section:
    rows = _shown(summary, COMPARED)
    if not rows:
        return Section("consistency", "Consistency", "Consistency", absent="No estimator was run on the flight as published.")
    traces: list[Trace] = []
    values = []
    for row in rows:
        found = average_nees(row.t_s, row.nees, 6, NEES_PROB)
        at = thin(CURVE_POINTS, found.value)
        values.append(found.value)
        curve = line(row.t_s[at], found.value[at], np.zeros(len(at), np.int64), name=title_of(row.name), mode="lines")
        traces.append(curve | {"line": {"color": COLOURS[row.name], "width": 1.3}, "hovertemplate": "%{y:.3~g}"})
    limits = average_nees(rows[0].t_s, rows[0].nees, 6, NEES_PROB)
    for edge in (limits.lower, limits.upper):
        style = {"color": TRUTH_COLOUR, "width": 1.2, "dash": "dash"}
        traces.append(line(rows[0].t_s, edge, np.zeros(len(edge), np.int64), name="99 % band", mode="lines", line=style))
    panel = Panel("mean NEES", traces, log_axis(np.concatenate(values)), 1.6)
    chart = shaded(time_chart("Mean NEES over the seeds of relative position and velocity", [panel]), MANOEUVRES)
    found_table = next(t for t in tables(summary) if t.title == "Consistency")
    return Section("consistency", "Consistency", "Consistency", [chart], document_table(found_table))


def _table_section(summary: Summary) -> Section:
    found = (*tables(summary), parameter_table(parameter_texts(parameters())))
    html = "".join(f"<h3>{text(t.title)}</h3>{document_table(t)}" for t in found)
    return Section("tables", "Tables", "Tables", html=html)
