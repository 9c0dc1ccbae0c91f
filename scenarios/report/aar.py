"""The page of the refuelling study: tables beside the publication's, its claims, and a counterpart of figures 3 to 24.

The study is one after the publication (Wu and others 2022): what is read or done otherwise has a section of its own.
Timelines show one seed, the first; everything else is of all seeds. What a run of part of the study lacks is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph.types import Array, BoolArray
from scenarios.published.aar import DATA_SETS
from scenarios.report.chart import ENU, Chart, Panel, log_axis, plane_chart, shaded, time_chart
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
    seconds,
    translucent,
)
from scenarios.report.signals import SKY_POINTS, sky_chart
from scenarios.report.tables import document_table, folded, paragraph, table, text
from scenarios.report.verdicts import DIGITS, bars, claim_sections, prose, published, verdict_cards
from scenarios.studies.aar_claims import (
    MIN_SEEDS,
    PAPER_ALGORITHMS,
    PAPER_RATIO,
    PAPER_RMS,
    claims,
    robust_advantages,
)
from scenarios.studies.aar_record import (
    ROBUST_LEAD,
    detail_tables,
    graph_note,
    overview_tables,
    readings,
)
from scenarios.studies.aar_summary import (
    DEFAULT,
    FILTERS,
    GRAPH,
    RATIO_CAP,
    RATIO_THRESHOLD,
    SCHEMES,
    Curve,
    JobKey,
    Summary,
    algorithm_name,
    algorithms,
    windows,
)
from scenarios.studies.statistics import NAN, Statistic
from scenarios.studies.verdicts import Claim, plain, seed_count

Results = Mapping[JobKey, Mapping[str, Array]]

COLOURS = dict(zip((*SCHEMES, "g"), (CYCLE[5], CYCLE[4], CYCLE[2], CYCLE[0], CYCLE[3], CYCLE[6]), strict=True))
RATIO_FIGURES = {1: 5, 2: 9, 3: 10, 4: 11}
BASELINE_FIGURES = {1: 13, 2: 16, 3: 19, 4: 22}
SMALLEST_M, SMALLEST_MPS = 1e-3, 1e-4  # where logarithmic axes of errors begin
UNKNOWN = Statistic(NAN, NAN, NAN, NAN, NAN, 0)
FAULT_TEXTS = {
    1: "Original data.",
    2: "Code errors of 5, 10, 20 and 40 m in four windows.",
    3: "Velocity faults of 5 m/s in the predicted state in two windows.",
    4: "Code errors of 20 m and velocity faults of 5 m/s together in two windows.",
}


def write_study(
    summary: Summary,
    results: Results,
    path: Path,
    parameters: Mapping[str, object] | None = None,
    command: str = "relnav study aar",
) -> Path:
    """Write the page of the study; of `results` only the first seed of each data set is loaded. Returns the path."""
    return write_page(study_page(summary, results, parameters or {}, command), path)


def study_page(summary: Summary, results: Results, parameters: Mapping[str, object], command: str) -> Page:
    """What the page says."""
    judged = claims(summary)
    n_seeds = min((len(summary.seeds(row.cell.data)) for row in summary.rows if row.cell.variant == DEFAULT), default=0)
    data_sections: list[Section] = []
    scenario = Section("scenario", "Trajectories and satellites", "Scenario", absent="Data 1 to 4 were not run.")
    for data in DATA_SETS:
        key = min((k for k in results if (k.variant, k.data, k.start) == (DEFAULT, data, 0)), default=None)
        if key is None:
            data_sections.append(Section(f"data-{data}", f"Data {data}", f"Data {data}", absent=f"Data {data} was not run."))
            continue
        arrays = results[key]  # one trial at a time
        data_sections.append(_data_section(summary, arrays, key))
        if not scenario.charts:
            scenario = _scenario_section(arrays, key)
    few = 0 < n_seeds < MIN_SEEDS
    return Page(
        title="Aerial refuelling – study after Wu and others (2022)",
        heading="Aerial refuelling: a study after Wu and others (2022)",
        sections=[
            *_overview(summary),
            _readings_section(summary),
            *_claim_sections(judged),
            scenario,
            *data_sections,
            _sweep_section(summary),
            _table_section(summary, parameters),
        ],
        cards=_cards(summary, judged),
        badge=seed_count(n_seeds),
        badge_is_good=not few and n_seeds > 0,
        lines=(
            "Two-stage adaptive relative navigation: the numbers of the publication beside those found here; means over the "
            "seeds with 95 % intervals. SKF and AKF are the standard and the adaptive main filter.",
            f"Made by <code>{text(command)}</code>",
        ),
        reasons=[f"Success rates want at least {MIN_SEEDS} seeds; intervals of this run are wide."] if few else [],
    )


# overview


def _cards(summary: Summary, judged: Sequence[Claim]) -> list[Card]:
    cards = verdict_cards(judged)
    for digit, data in (("3", 2), ("4", 2), ("5", 4)):
        found = {name: summary.statistic("p_se", digit + main, data) for main, name in FILTERS.items()}
        if any(found.values()):
            rms = " | ".join(shown_cm(summary.statistic("baseline_rms_fixed", digit + main, data)) for main in FILTERS)
            value = " | ".join("–" if s is None else plain(s.value, ".1f") for s in found.values())
            detail = f"with {' | '.join(found)}; fixed RMS {rms}"
            cards.append(Card(f"P_SE [%], {SCHEMES[digit]} on Data {data}", value, detail))
    graph = summary.statistic("p_se", GRAPH, 4)
    if graph is not None:
        rms = shown_cm(summary.statistic("baseline_rms_fixed", GRAPH, 4))
        detail = f"fixed RMS {rms}; has the code errors alone and is told the simulated noise"
        cards.append(Card("P_SE [%], factor graph on Data 4", plain(graph.value, ".1f"), detail))
    return cards


def shown_cm(found: Statistic | None) -> str:
    """A length in centimetres."""
    return "–" if found is None else f"{plain(100 * found.value)} cm"


def _overview(summary: Summary) -> list[Section]:
    html = "".join(f"<h3>{text(t.title)}</h3>{document_table(t)}" for t in overview_tables(summary))
    advantages = robust_advantages(summary)
    if advantages:
        listed = "".join(f"<li>{text(sentence)}</li>" for sentence in advantages)
        html = f"<h3>What the robust schemes bring</h3>{paragraph(ROBUST_LEAD)}<ul>{listed}</ul>{html}"
    absent = "No data set was run."
    return [Section("overview", "Success rates and ratios", "Overview", _ratio_means(summary), html, absent)]


def _readings_section(summary: Summary) -> Section:
    found = readings(summary)
    lead = "The publication leaves much open, and some of it cannot be met as printed. What is read or done otherwise:"
    return Section("readings", found.title, "Readings", html=prose(found.head, found.rows) + paragraph(found.note), lead=lead)


def _ratio_means(summary: Summary) -> list[Chart]:
    """Figure 12."""
    groups = [(data, digit) for data in DATA_SETS for digit in SCHEMES if _either(summary, digit, data)]
    if not groups:
        return []
    x = [[f"Data {data}" for data, _ in groups], [SCHEMES[digit] for _, digit in groups]]
    traces = []
    for main, name in FILTERS.items():
        found = [summary.statistic("ratio_mean", digit + main, data) for data, digit in groups]
        colours = [COLOURS[digit] if main == "b" else translucent(COLOURS[digit], 0.45) for _, digit in groups]
        traces.append(bars(x, [s or UNKNOWN for s in found], colours, name))
    paper = np.array([PAPER_RATIO[digit].get(data, np.nan) for data, digit in groups])
    traces.append(published(x, numbers(paper)))
    layout = {
        "xaxis": {"type": "multicategory"},
        "yaxis": {"title": {"text": "mean ratio"}, "rangemode": "tozero"},
        "barmode": "group",
        "hovermode": "closest",
    }
    title = "Figure 12 of the paper: ratio means of the schemes (Data 1 to 4)"
    note = f"Pale: with the SKF, full: with the AKF. Ratios beyond {RATIO_CAP:.0f} count as {RATIO_CAP:.0f}."
    return [Chart(title, legend_once(traces), layout, 400, note)]


def _either(summary: Summary, digit: str, data: int) -> bool:
    return any(summary.statistic("ratio_mean", digit + main, data) for main in FILTERS)


def _claim_sections(judged: Sequence[Claim]) -> list[Section]:
    lead = (
        "A published number counts as reproduced where it lies within the span of the seeds or near their mean, a comparison "
        "where the 95 % interval of the paired difference lies on the right side of zero. The publication speaks of schemes: "
        "they are judged beside the SKF and beside the AKF, and what holds with one of them alone counts as partly."
    )
    return claim_sections(judged, lead)


# the scenario


def _scenario_section(arrays: Mapping[str, Array], key: JobKey) -> Section:
    t_s = np.asarray(arrays["t_s"], float)
    charts: list[Chart] = []
    missing = []
    if "truth_tanker_n" in arrays and "truth_uav_n" in arrays:
        charts += _trajectories(t_s, np.asarray(arrays["truth_tanker_n"], float), np.asarray(arrays["truth_uav_n"], float))
    else:
        missing.append("Figure 3 of the paper: the trial holds no true positions.")
    if "azimuth_deg" in arrays and "elevation_deg" in arrays:
        charts.append(_sky(arrays))
    else:
        missing.append("Figure 4 of the paper: the trial holds no satellite directions.")
    charts += _counts(t_s, arrays)
    html = "".join(paragraph(reason) for reason in missing)
    return Section(
        "scenario", "Trajectories and satellites", "Scenario", charts, html, lead=f"Seed {key.seed} of Data {key.data}."
    )


def _trajectories(t_s: Array, tanker: Array, uav: Array) -> list[Chart]:
    """Figure 3: plan of both vehicles, plan relative to the tanker, heights."""
    names = (("tanker", tanker, CYCLE[1]), ("UAV", uav, CYCLE[0]))
    plan = [trace for name, r, colour in names for trace in _path(name, r[:, 0] / 1e3, r[:, 1] / 1e3, t_s, colour)]
    relative = uav - tanker
    near = _path("UAV", relative[:, 0], relative[:, 1], t_s, CYCLE[0])
    near.append(_dot("tanker", np.zeros(1), np.zeros(1), CYCLE[1]))
    caption = "Figure 3 of the paper: trajectories of tanker and UAV"
    plan_chart = plane_chart(f"{caption}, plan", plan, "east [km]", "north [km]", "Open circles: start.")
    del plan_chart.layout["yaxis"]["scaleanchor"], plan_chart.layout["yaxis"]["scaleratio"]  # 120 km north, 5 km east
    heights = [_curve(name, t_s, r[:, 2], colour, "m") for name, r, colour in names]
    up = time_chart(f"{caption}, height in the local frame", [Panel("up [m]", heights)])
    return [
        plan_chart,
        plane_chart("UAV relative to the tanker, plan", near, "east [m]", "north [m]"),
        replace(up, note="The local frame is a plane: over 120 km the Earth falls away from it."),
    ]


def _path(name: str, x: Array, y: Array, t_s: Array, colour: str) -> list[Trace]:
    hover = f"{name} at %{{customdata}} s<br>%{{x:.4~f}}, %{{y:.4~f}}<extra></extra>"
    path: Trace = {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": numbers(x, 6),
        "y": numbers(y, 6),
        "customdata": seconds(t_s),
    }
    return [
        path | {"line": {"color": colour, "width": 1.8}, "hovertemplate": hover},
        _dot("start", x[:1], y[:1], colour, "circle-open"),
    ]


def _dot(name: str, x: Array, y: Array, colour: str, symbol: str = "cross") -> Trace:
    marker = {"color": colour, "size": 9, "symbol": symbol}
    shown_in_legend = name != "start"
    return {"type": "scatter", "mode": "markers", "name": name, "x": numbers(x, 6), "y": numbers(y, 6), "marker": marker} | {
        "hoverinfo": "name",
        "showlegend": shown_in_legend,
    }


def _sky(arrays: Mapping[str, Array]) -> Chart:
    azimuth, elevation = (np.asarray(arrays[f"{name}_deg"], float) for name in ("azimuth", "elevation"))
    known = np.isfinite(azimuth) & np.isfinite(elevation)
    names = [str(s) for s in arrays["satellites"]] if "satellites" in arrays else [f"{j + 1}" for j in range(azimuth.shape[1])]
    tracks = []
    for j in np.flatnonzero(known.any(axis=0)):
        rows = np.flatnonzero(known[:, j])
        rows = rows[np.linspace(0, len(rows) - 1, min(SKY_POINTS, len(rows))).astype(np.int64)]
        tracks.append((names[j], azimuth[rows, j], elevation[rows, j]))
    return sky_chart("Figure 4 of the paper: skyplot of the visible satellites", tracks)


def _counts(t_s: Array, arrays: Mapping[str, Array]) -> list[Chart]:
    found = []
    if "n_sat" in arrays:
        curve = _curve("satellites", t_s, np.asarray(arrays["n_sat"], float), CYCLE[0], "")
        found.append(Panel("satellites", [curve], {"rangemode": "tozero", "tickformat": "d"}))
    if "baseline_m" in arrays:
        baseline = np.asarray(arrays["baseline_m"], float)
        found.append(Panel("baseline [m]", [_curve("true baseline", t_s, baseline, CYCLE[2], "m")], log_axis(baseline)))
    if not found:
        return []
    return [replace(time_chart("Satellites in use and length of the baseline", found), height_px=460, wide=False)]


# one data set


def _data_section(summary: Summary, arrays: Mapping[str, Array], key: JobKey) -> Section:
    data = key.data
    t_s = np.asarray(arrays["t_s"], float)
    faulted = np.asarray(arrays["faulted"], bool) if "faulted" in arrays else np.zeros(len(t_s), bool)
    here = algorithms(arrays)
    drawn = [a for a in (*PAPER_ALGORITHMS[data], GRAPH) if a in here]
    charts: list[Chart | str] = [_ratio_timeline(arrays, t_s, faulted, data)]
    if data == 1:
        charts.append(_adop_timeline(arrays, t_s))
    number = BASELINE_FIGURES[data]
    charts += [
        _error_timeline(
            arrays, t_s, faulted, drawn, f"Figure {number} of the paper: baseline errors (Data {data})", "baseline_error_m"
        ),
        _error_timeline(
            arrays, t_s, faulted, drawn, f"Figure {number + 1} of the paper: velocity errors (Data {data})", "velocity_error_mps"
        ),
        *_rms_bars(summary, data, number + 2),
    ]
    missing = [chart for chart in charts if isinstance(chart, str)]
    absent_algorithms = [a for a in PAPER_ALGORITHMS[data] if a not in here]
    if absent_algorithms:
        missing.append(f"Not run on Data {data}: {', '.join(algorithm_name(a) for a in absent_algorithms)}.")
    drawn_how = f"Timelines show seed {key.seed}, the ratio's threshold is {RATIO_THRESHOLD:g}"
    drawn_how += "; fault windows are shaded." if faulted.any() else "."
    if GRAPH in here:
        missing.append(graph_note(summary, data))
    html = "".join(paragraph(reason) for reason in missing)
    return Section(
        f"data-{data}",
        f"Data {data}",
        f"Data {data}",
        [c for c in charts if isinstance(c, Chart)],
        html,
        lead=f"{FAULT_TEXTS[data]} {drawn_how}",
    )


def _curve(name: str, t_s: Array, y: Array, colour: str, unit: str, **style: Any) -> Trace:
    trace = line(t_s, y, np.zeros(len(t_s), np.int64), name=name, line={"color": colour, "width": 1.0} | style)
    return trace | {"y": numbers(y, DIGITS), "hovertemplate": f"%{{y:.3~g}} {unit}".rstrip()}


def _shaded(chart: Chart, t_s: Array, faulted: BoolArray) -> Chart:
    """The chart with the fault windows marked over all panels."""
    return shaded(chart, ((float(t_s[w][0]) - 0.5, float(t_s[w][-1]) + 0.5) for w in windows(faulted)))


def _ratio_timeline(arrays: Mapping[str, Array], t_s: Array, faulted: BoolArray, data: int) -> Chart | str:
    caption = f"Figure {RATIO_FIGURES[data]} of the paper: ratio values (Data {data})"
    found = {a: np.minimum(ratio, RATIO_CAP) for a, ratio in _known(arrays, "ratio", data).items()}
    if not found:
        return f"{caption}: no ratio was stored."
    axis = log_axis(np.concatenate([*found.values(), [RATIO_THRESHOLD]]))
    panels = []
    for digit in dict.fromkeys(a[0] for a in found):
        level = line(t_s[[0, -1]], np.full(2, RATIO_THRESHOLD), np.zeros(2, np.int64), name="threshold", mode="lines")
        level |= {"line": {"color": ALERT_COLOUR, "width": 1.2, "dash": "dot"}, "hoverinfo": "skip"}
        curves = [_curve(algorithm_name(a), t_s, ratio, _colour(a), "") for a, ratio in found.items() if a[0] == digit]
        panels.append(Panel(SCHEMES[digit], [*curves, level], axis, 0.75))
    return _shaded(time_chart(caption, panels, "Grey: with the SKF, behind the curve with the AKF."), t_s, faulted)


def _known(arrays: Mapping[str, Array], name: str, data: int) -> dict[str, Array]:
    """What the algorithms that the publication draws have of a quantity, unless all of it is unknown."""
    found = {a: np.asarray(arrays[f"{a}/{name}"], float) for a in PAPER_ALGORITHMS[data] if f"{a}/{name}" in arrays}
    return {a: values for a, values in found.items() if np.isfinite(values).any()}


def _adop_timeline(arrays: Mapping[str, Array], t_s: Array) -> Chart | str:
    caption = "Figure 6 of the paper: ADOP values (Data 1)"
    found = _known(arrays, "adop_cyc", 1)
    if not found:
        return f"{caption}: no ADOP was stored."
    dashes = {"a": "dot", "b": "solid"}
    curves = [_curve(algorithm_name(a), t_s, adop, COLOURS[a[0]], "cycles", dash=dashes[a[1]]) for a, adop in found.items()]
    axis = _roomy(np.concatenate(list(found.values())))
    return time_chart(caption, [Panel("ADOP [cycles]", curves, axis, 1.5)], "Dotted: with the SKF.")


def _roomy(values: Array) -> dict[str, Any]:
    """A logarithmic axis that reaches beyond the values, so that it has a mark even where they are all alike."""
    return log_axis(np.append(values, [0.6 * np.nanmin(values), 1.4 * np.nanmax(values)]))


def _error_timeline(
    arrays: Mapping[str, Array], t_s: Array, faulted: BoolArray, drawn: Sequence[str], caption: str, name: str
) -> Chart | str:
    """Norms of the error, a panel for each scheme, then the components of the publication's best algorithm and the graph."""
    unit, smallest = ("m", SMALLEST_M) if name.endswith("_m") else ("m/s", SMALLEST_MPS)
    found = {a: np.asarray(arrays[f"{a}/{name}"], float) for a in drawn if f"{a}/{name}" in arrays}
    found = {a: error for a, error in found.items() if np.isfinite(error).any()}
    if not found:
        return f"{caption}: no errors were stored."
    norms = {a: np.linalg.norm(error, axis=1) for a, error in found.items()}
    axis = log_axis(np.maximum(np.concatenate(list(norms.values())), smallest))
    panels = []
    for digit in dict.fromkeys(a[0] for a in found):
        mine = [a for a in found if a[0] == digit]
        curves = [_curve(algorithm_name(a), t_s, norms[a], _colour(a), unit) for a in mine]
        panels.append(Panel(f"{SCHEMES.get(digit, 'graph')} [{unit}]", curves, axis, 0.75))
    best = [*[a for a in found if a.endswith("b")][-1:], *[a for a in found if a == GRAPH]]
    for i, component in enumerate(ENU if best else ()):
        curves = [_curve(algorithm_name(a), t_s, found[a][:, i], _colour(a), unit) for a in best]
        panels.append(Panel(f"{component} [{unit}]", curves, {}, 0.75))
    note = "Norms on a logarithmic scale."
    if best:
        note += f" The last three panels are the components of {' and '.join(algorithm_name(a) for a in best)}."
    return _shaded(time_chart(caption, panels, note), t_s, faulted)


def _colour(algorithm: str) -> str:
    """Of a scheme; grey with the standard filter, whose curve lies behind the adaptive one's."""
    return TRUTH_COLOUR if algorithm.endswith("a") else COLOURS[algorithm[0]]


def _rms_bars(summary: Summary, data: int, figure: int) -> list[Chart | str]:
    rows = [row for a in (*PAPER_ALGORITHMS[data], GRAPH) if (row := summary.row(a, data)) is not None]
    charts: list[Chart | str] = []
    for metric, what, unit, index in (("baseline_rms", "baseline", "m", 0), ("velocity_rms", "velocity", "m/s", 1)):
        caption = f"Figure {figure} of the paper: RMS errors of the {what} (Data {data})"
        mine = [row for row in rows if metric in row.statistics]
        if not mine:
            charts.append(f"{caption}: no errors were stored.")
            continue
        names = [algorithm_name(row.cell.algorithm) for row in mine]
        values = [row.statistics[metric] for row in mine]
        traces = [bars(names, values, [_colour(row.cell.algorithm) for row in mine], "here")]
        paper = {algorithm_name(a): bounds[index] for (a, d), bounds in PAPER_RMS.items() if d == data}
        marked = {name: value for name, value in paper.items() if name in names}
        if marked:
            traces.append(published(list(marked), list(marked.values())))
        heights = np.array([v for s in values for v in (s.value, s.lower, s.upper)] + list(marked.values()))
        axis = {"title": {"text": f"RMS [{unit}]"}} | _roomy(heights)
        layout = {"xaxis": {"type": "category", "tickangle": -45}, "yaxis": axis, "hovermode": "closest"}
        note = f"All seeds, all epochs; logarithmic scale. {graph_note(summary, data)}".rstrip()
        charts.append(Chart(caption, legend_once(traces), layout, 420, note, wide=False))
    return charts


# sweeps


def _sweep_section(summary: Summary) -> Section:
    wanted = (
        ("adop_code", "Figure 7 of the paper: ADOP against the code σ (300 s, Data 1)", "ADOP [cycles]", True),
        ("adop_ins", "Figure 8 of the paper: ADOP against the σ of the INS position (300 s, Data 1)", "ADOP [cycles]", True),
        ("success_ins", "Success against the σ of the INS position", "P_corr [%]", False),
        ("success_bias", "Success against a bias of the INS position, its σ as claimed", "P_corr [%]", False),
    )
    charts, missing = [], []
    for name, caption, title, is_log in wanted:
        curve = summary.curve(name)
        if curve is None:
            missing.append(f"{caption}: not run.")
        else:
            charts.append(_sweep_chart(curve, caption, title, is_log))
    html = "".join(paragraph(reason) for reason in missing)
    return Section("sweep", "Code and INS precision", "Precision", charts, html)


def _sweep_chart(curve: Curve, caption: str, title: str, is_log: bool) -> Chart:
    x, data = np.array(curve.x), []
    stretch = np.zeros(len(x), np.int64)
    digits = {scheme: digit for digit, scheme in SCHEMES.items()}
    for label in curve.labels:
        mean, lower, upper = curve.of(label)
        colour = COLOURS[digits[label]]
        area = band(x, lower, upper, stretch, colour, name="95 %", legendgroup="95 %")
        trace = line(x, mean, stretch, name=label, line={"color": colour, "width": 1.8})
        data += [*([area] if area else []), trace | {"hovertemplate": f"{label} %{{y:.3~g}} at %{{x}}<extra></extra>"}]
    is_wide_range = x.min() > 0 and x.max() > 20 * x.min()
    x_axis = {"title": {"text": curve.x_title}} | (log_axis(x) if is_wide_range else {})
    y_axis = {"title": {"text": title}} | (_roomy(np.array(curve.mean)) if is_log else {})
    return Chart(caption, legend_once(data), {"xaxis": x_axis, "yaxis": y_axis, "hovermode": "closest"}, 380, wide=False)


# the rest


def _table_section(summary: Summary, parameters: Mapping[str, object]) -> Section:
    parts = [folded(t.title, document_table(t)) for t in detail_tables(summary)]
    if parameters:
        rows = [(name, str(value)) for name, value in parameters.items()]
        parts.append(folded("Parameters", table(("parameter", "value"), rows, 2)))
    return Section("tables", "Tables", "Tables", html="".join(parts), absent="Nothing was run.")
