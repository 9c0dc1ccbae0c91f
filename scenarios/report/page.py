"""The report: one HTML page that holds everything it needs, text, tables, data and plotly.js.

Layout of the page: headline, key figures, a navigation that stays in view, sections. plotly.js and the charts lie
in the page as gzip in base64, which makes it three times smaller and keeps data apart from markup; `page.js`
unpacks them with the browser's own DecompressionStream (Chromium 80, Firefox 113, Safari 16.4). A content
security policy forbids every connection.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from plotly.offline import get_plotlyjs, get_plotlyjs_version

from factorgraph.consistency import judge, standard_deviations
from factorgraph.solution import Fix, Solution, Status
from factorgraph.types import Array
from scenarios.metrics import (
    ErrorSeries,
    fix_percentage,
    pair_name,
    solution_errors,
    statistics,
    total_runtime_s,
)
from scenarios.report import quality, signals, tables, trajectory
from scenarios.report.chart import Chart
from scenarios.report.tables import folded, number, paragraph, text

POINT_LIMIT = 2000  # rows drawn a curve
POINT_BUDGET = 12_000  # rows drawn in all curves of one section; many pairs share it
MIN_POINTS = 300
OPEN_CHARTS = 8  # charts of a section drawn at once; the rest opens on demand

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


@dataclass(frozen=True, slots=True)
class Section:
    """One part of the page. Without charts and HTML it says in one line why."""

    key: str
    title: str
    short: str  # in the navigation
    charts: Sequence[Chart] = ()
    html: str = ""
    absent: str = ""
    lead: str = ""


def write_report(solution: Solution, path: Path) -> Path:
    """Write the report of a solution as one self-contained HTML page; folders are made. Returns the path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render(solution), encoding="utf-8")
    return path


def render(solution: Solution) -> str:
    """The page as text."""
    errors = solution_errors(solution)
    parts = [section for section in sections(solution, errors) if section.charts or section.html or section.absent]
    drawn = [chart for section in parts for chart in section.charts]
    payload = json.dumps([_as_json(chart) for chart in drawn], separators=(",", ":"), allow_nan=False)
    body, first = [], 0
    for section in parts:
        body.append(_section_html(section, first))
        first += len(section.charts)
    links = "".join(f'<a href="#{section.key}">{text(section.short)}</a>' for section in parts)
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">',
            f"<title>{text(solution.name)} – relative navigation report</title>",
            f"<style>\n{_asset('page.css')}</style>\n</head>\n<body>",
            _headline(solution, errors),
            f'<nav aria-label="Sections"><div>{links}</div></nav>',
            f"<main>{''.join(body)}</main>",
            _footer(solution),
            '<noscript><p class="note">The plots of this page need JavaScript.</p></noscript>',
            f'<script type="text/plain" id="packed-plotly">{_packed_plotly()}</script>',
            f'<script type="text/plain" id="packed-charts">{_pack(payload)}</script>',
            f"<script>\n{_asset('page.js')}</script>\n</body>\n</html>\n",
        ]
    )


def sections(solution: Solution, errors: Sequence[ErrorSeries]) -> list[Section]:
    """All sections in reading order, those without data included."""
    limit = _limit(max(len(solution.pairs), len(solution.vehicles)))
    return [
        Section("summary", "Summary", "Summary", html=_messages(solution) + tables.summary(solution, errors)),
        *_track_sections(solution, limit),
        *_pair_sections(solution, limit),
        *_vehicle_sections(solution, limit),
        *_fix_sections(solution, limit),
        *_residual_sections(solution, limit),
        _error_section(errors, _limit(len(errors))),
        *_table_sections(solution),
    ]


def _limit(n_subjects: int) -> int:
    return max(MIN_POINTS, min(POINT_LIMIT, POINT_BUDGET // max(n_subjects, 1)))


def _track_sections(solution: Solution, limit: int) -> list[Section]:
    tracks = [chart for pair in solution.pairs if len(pair.t_s) for chart in trajectory.relative_track(pair, limit)]
    seen = [vehicle for vehicle in solution.vehicles if len(vehicle.t_s)]
    maps = trajectory.vehicle_map(seen, limit) if seen else []
    lead = "Rover relative to the reference, resolved east-north-up at the reference."
    return [
        Section("track", "Relative track", "Track", tracks, absent=_no_pairs(solution), lead=lead),
        Section("map", "Map of all vehicles", "Map", maps, absent="There are no vehicles."),
    ]


def _pair_sections(solution: Solution, limit: int) -> list[Section]:
    pairs = [pair for pair in solution.pairs if len(pair.t_s)]
    absent = _no_pairs(solution)
    return [
        Section("baseline", "Baseline with ±3σ", "Baseline", [trajectory.baseline(p, limit) for p in pairs], absent=absent),
        Section(
            "velocity",
            "Relative velocity with ±3σ",
            "Velocity",
            [trajectory.relative_velocity(p, limit) for p in pairs],
            absent=absent,
        ),
    ]


def _vehicle_sections(solution: Solution, limit: int) -> list[Section]:
    moving = [vehicle for vehicle in solution.vehicles if not vehicle.is_fixed]
    turned = [vehicle for vehicle in moving if np.isfinite(vehicle.q_nb).all(axis=1).any()]
    sensed = [vehicle for vehicle in moving if np.isfinite(vehicle.bias_gyro).any() or np.isfinite(vehicle.bias_accel).any()]
    biases = [chart for vehicle in sensed for chart in trajectory.biases(vehicle, limit)]
    no_imu = "No vehicle carries an inertial sensor."
    return [
        Section("attitude", "Attitude with ±3σ", "Attitude", [trajectory.attitude(v, limit) for v in turned], absent=no_imu),
        Section("biases", "Inertial sensor biases with ±3σ", "Biases", biases, absent=no_imu, lead="Body axes right, front, up."),
    ]


def _fix_sections(solution: Solution, limit: int) -> list[Section]:
    pairs = [pair for pair in solution.pairs if len(pair.t_s)]
    phased = [pair for pair in pairs if np.any(pair.fix != Fix.NONE.value)]
    threshold = _setting(solution, "ambiguity", "ratio_threshold")
    sky = signals.skyplot(solution.residuals)
    counts = [signals.satellite_count(pair, limit) for pair in pairs if np.any(pair.n_sat > 0)]
    return [
        Section(
            "fix",
            "Fix status and ratio test",
            "Fix",
            [signals.fixing(pair, threshold, limit) for pair in phased],
            absent="No pair uses carrier phase.",
        ),
        Section("sky", "Satellites", "Satellites", [*counts, *([sky] if sky else [])], absent="No satellites were used."),
    ]


def _residual_sections(solution: Solution, limit: int) -> list[Section]:
    table, diagnostics = solution.residuals, solution.diagnostics
    drawn = [quality.histogram(table), *quality.residuals(table, _setting(solution, "outlier_sigma"), min(limit, 500))]
    judged = [quality.nis(diagnostics, limit), quality.cost(diagnostics)]
    return [
        Section(
            "residuals",
            "Residuals",
            "Residuals",
            [chart for chart in drawn if chart],
            absent="The solution holds no residuals.",
            lead="Measured minus predicted, after the solution.",
        ),
        Section(
            "nis", "Consistency", "NIS", [chart for chart in judged if chart], absent="The method gives no consistency statistic."
        ),
    ]


def _setting(solution: Solution, *path: str) -> float | None:
    """A number in the stored settings, if it is there."""
    value: object = solution.configuration.get("settings")
    for key in path:
        value = value.get(key) if isinstance(value, dict) else None
    return float(value) if isinstance(value, int | float) else None


def _error_section(found: Sequence[ErrorSeries], limit: int) -> Section:
    quantities: dict[str, list[ErrorSeries]] = {}
    for series in found:
        quantities.setdefault(series.quantity, []).append(series)
    distributions = [quality.error_cdf(quantity, group) for quantity, group in quantities.items()]
    if len(distributions) % 2:
        distributions[-1] = replace(distributions[-1], wide=True)
    drawn = [*distributions, *(quality.errors(series, limit) for series in found)]
    html = tables.error_statistics(found) if found else ""
    return Section("truth", "Error against truth", "Truth", drawn, html, "No truth is known for this flight.")


def _table_sections(solution: Solution) -> list[Section]:
    diagnostics, table = solution.diagnostics, solution.residuals
    arcs = tables.ambiguities(solution.ambiguities) if solution.ambiguities.link else ""
    constants = tables.parameters(diagnostics.parameters) if diagnostics.parameters else ""
    about = f'<div class="pair">{tables.timings(diagnostics.runtime_s)}{tables.versions(solution.versions)}</div>'
    return [
        Section("ambiguities", "Ambiguities", "Ambiguities", html=arcs, absent="No ambiguities were estimated."),
        Section("outliers", "Outliers", "Outliers", html=tables.outliers(table) if len(table.t_s) else ""),
        Section("parameters", "Estimated parameters", "Parameters", html=constants),
        Section(
            "configuration",
            "Configuration",
            "Configuration",
            html=tables.configuration(solution) if solution.configuration else "",
        ),
        Section("about", "Runtime and versions", "About", html=about),
    ]


def _no_pairs(solution: Solution) -> str:
    return "The pairs have no epochs." if solution.pairs else "The solution holds no pairs."


def _messages(solution: Solution) -> str:
    notes = "".join(f"<li>{text(note)}</li>" for note in solution.diagnostics.notes)
    return f'<ul class="notes">{notes}</ul>' if notes else ""


def _headline(solution: Solution, errors: Sequence[ErrorSeries]) -> str:
    reasons = list(solution.diagnostics.warnings)
    if solution.diagnostics.status is not Status.CONVERGED:
        reasons.insert(0, f"The optimisation stopped early: {solution.diagnostics.status.value}.")
    badge = '<span class="badge bad">degraded</span>' if solution.is_degraded else '<span class="badge good">done</span>'
    listed = "".join(f"<li>{text(reason)}</li>" for reason in reasons)
    warning = f'<ul class="reasons" aria-label="Warnings">{listed}</ul>' if reasons else ""
    cards = "".join(
        f'<div class="card"><span>{text(name)}</span><b>{text(value)}</b><small>{text(detail)}</small></div>'
        for name, value, detail in _cards(solution, errors)
    )
    return (
        f"<header><div><h1>{text(solution.name)}</h1>{badge}</div>"
        f'<p class="when">{text(_span(solution))}</p><p class="when">Method <b>{text(solution.method)}</b>, '
        f"{_count(len(solution.vehicles), 'vehicle')}, {_count(len(solution.pairs), 'pair')}</p>{warning}"
        f'<div class="cards">{cards}</div></header>'
    )


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _span(solution: Solution) -> str:
    times = [t_s for t_s in _times(solution) if len(t_s)]
    if not times:
        return f"t0 {solution.t0.calendar():%Y-%m-%d %H:%M:%S} GPST"
    start, end = (solution.t0 + float(v) for v in (min(t[0] for t in times), max(t[-1] for t in times)))
    length = timedelta(seconds=round(end - start))
    last = end.calendar()
    form = "%H:%M:%S" if last.date() == start.calendar().date() else "%Y-%m-%d %H:%M:%S"
    return f"{start.calendar():%Y-%m-%d %H:%M:%S} to {last:{form}} GPST ({length})"


def _times(solution: Solution) -> list[Array]:
    return [pair.t_s for pair in solution.pairs] + [vehicle.t_s for vehicle in solution.vehicles]


def _cards(solution: Solution, errors: Sequence[ErrorSeries]) -> list[tuple[str, str, str]]:
    """Key figures: name, value, detail."""
    table, diagnostics = solution.residuals, solution.diagnostics
    runtime_s = total_runtime_s(diagnostics.runtime_s)
    epochs = max((len(t_s) for t_s in _times(solution)), default=0)
    cards = [*_pair_cards(solution, errors), ("Epochs", f"{epochs:,}", _rate(solution))]
    if len(table.t_s):
        share = f"{100 * np.mean(table.outlier):.2f} % of {len(table.t_s):,} residuals"
        cards.append(("Outliers", f"{int(np.sum(table.outlier)):,}", share))
    if np.isfinite(diagnostics.nis).any():
        inside = judge(diagnostics.nis_t_s, diagnostics.nis, diagnostics.nis_dof).share_inside
        cards.append(("NIS in 95 % band", f"{100 * inside:.1f} %", "of epochs"))
    detail = f"{diagnostics.n_iterations} iterations, {diagnostics.status.value}"
    return [*cards, ("Runtime", f"{runtime_s:.1f} s" if np.isfinite(runtime_s) else "–", detail)]


def _pair_cards(solution: Solution, errors: Sequence[ErrorSeries]) -> list[tuple[str, str, str]]:
    pairs = [pair for pair in solution.pairs if len(pair.t_s)]
    if not pairs:
        return []
    cards = []
    fix = np.concatenate([pair.fix for pair in pairs])
    if np.any(fix != Fix.NONE.value):
        partial = f"and {fix_percentage(fix, Fix.PARTIAL):.1f} % partly"
        cards.append(("Integers fixed", f"{fix_percentage(fix, Fix.FIXED):.1f} %", partial))
    sigma = np.concatenate([standard_deviations(pair.P[:, :3, :3]) for pair in pairs])
    cards.append(("Baseline σ", _metres(statistics(sigma).median), "median, 3D"))
    by_name = {pair_name(pair): pair for pair in pairs}
    known = [(series, by_name[series.subject]) for series in errors if series.quantity == "baseline"]
    if known:
        error = np.concatenate([series.error for series, _ in known])
        fixed = np.concatenate([series.error[pair.fix == Fix.FIXED.value] for series, pair in known])
        detail = f"{_metres(statistics(fixed).rmse)} where fixed" if len(fixed) else "against truth, 3D"
        cards.append(("Baseline RMS error", _metres(statistics(error).rmse), detail))
    return cards


def _rate(solution: Solution) -> str:
    """The epoch interval of the longest series, in words."""
    t_s = max(_times(solution), key=len, default=np.zeros(0))
    return f"every {float(np.median(np.diff(t_s))):.3g} s" if len(t_s) > 1 else ""


def _metres(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    if value < 0.01:
        return f"{number(value * 1e3, 3)} mm"
    return f"{number(value * 1e2, 3)} cm" if value < 1 else f"{number(value, 3)} m"


def _footer(solution: Solution) -> str:
    maker = " ".join(["relnav", solution.versions.get("relnav", "")]).strip()
    plots = f"Plots by plotly.js {get_plotlyjs_version()} (MIT licence), inside this page."
    return f"<footer><p>{text(maker)}. {text(plots)}</p></footer>"


def _section_html(section: Section, first: int) -> str:
    if not section.charts and not section.html:
        inner = paragraph(section.absent)
    else:
        places = [_place(chart, first + i) for i, chart in enumerate(section.charts)]
        inner = f'<p class="note">{text(section.lead)}</p>' if section.lead else ""
        inner += section.html
        inner += f'<div class="charts">{"".join(places[:OPEN_CHARTS])}</div>' if places else ""
        if places[OPEN_CHARTS:]:
            rest = f'<div class="charts">{"".join(places[OPEN_CHARTS:])}</div>'
            inner += folded(f"Show {len(places) - OPEN_CHARTS} more plots", rest)
    return f'<section id="{section.key}"><h2>{text(section.title)}</h2>{inner}</section>'


def _place(chart: Chart, index: int) -> str:
    size = "wide" if chart.wide else "half"
    note = paragraph(chart.note) if chart.note else ""
    # titles are escaped for plotly and HTML alike where they are made
    return (
        f'<figure class="{size}"><figcaption>{chart.title}</figcaption>'
        f'<div class="plot" data-chart="{index}" style="height:{chart.height_px}px"></div>{note}</figure>'
    )


def _as_json(chart: Chart) -> dict[str, object]:
    return {"data": chart.data, "layout": chart.layout, "height": chart.height_px, "time": chart.is_time}


def _pack(content: str) -> str:
    return base64.b64encode(gzip.compress(content.encode(), 6, mtime=0)).decode()


@lru_cache(maxsize=1)
def _packed_plotly() -> str:
    return _pack(get_plotlyjs())


@lru_cache
def _asset(name: str) -> str:
    return files("scenarios.report").joinpath(name).read_text(encoding="utf-8")
