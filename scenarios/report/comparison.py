"""The page of a comparison: one table, then tracks, errors, consistency and cost of every method in its own colour.

Every trace of a method says so in `meta`; `comparison.js` shows and hides methods in all plots at once by it, and draws the
±3σ band of one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph.types import Array
from scenarios.comparison import (
    METHOD_METRICS,
    PLACES,
    SUBJECT_METRICS,
    Comparison,
    Metric,
    Subject,
    best_of,
    figure,
)
from scenarios.metrics import ErrorSeries, pair_name
from scenarios.report import quality
from scenarios.report.chart import Chart, Panel, log_axis, plane_chart, time_chart
from scenarios.report.frame import Card, Page, Section, write_page
from scenarios.report.series import (
    BAND_SIGMAS,
    CYCLE,
    TRUTH_COLOUR,
    Trace,
    band,
    line,
    numbers,
    plot_text,
    stretches,
    thin,
    thin_note,
)
from scenarios.report.tables import paragraph, table, text
from scenarios.report.trajectory import points, track

POINT_BUDGET = 16_000  # rows drawn in all curves of one kind of plot; methods and subjects share it
POINT_LIMIT, MIN_POINTS = 1500, 200  # rows drawn a curve
DASHES = ("solid", "dash", "dot", "dashdot")  # methods beyond the colours
SPREAD = 8.0  # errors of the worst method are shown up to so many times those of the best
LOG_RATIO = 30.0  # bars that differ by more are drawn on a logarithmic axis
ERROR, DIFFERENCE = "error", "difference"
OUT_OF_RANGE = "Some curves leave the vertical range; a double click shows all."


def write_comparison(found: Comparison, path: Path) -> Path:
    """Write the page of a comparison as one self-contained HTML file; folders are made. Returns the path."""
    return write_page(comparison_page(found), path)


def comparison_page(found: Comparison) -> Page:
    """What the page says."""
    degraded = [method for method, solution in found.solutions.items() if solution.is_degraded]
    reasons = [f"{o.method} failed: {o.reason}" for o in found.failed]
    reasons += [f"{method}: {why}" for method in degraded for why in _whys(found, method)]
    return Page(
        title=f"{found.name} – methods compared",
        heading=found.name,
        sections=_sections(found),
        cards=_cards(found),
        badge="degraded" if reasons else "done",
        badge_is_good=not reasons,
        lines=(f"Methods compared: <b>{text(', '.join(found.solutions))}</b>",),
        reasons=reasons,
        maker=_maker(found),
        controls=_controls(found),
        script="comparison.js",
    )


def _whys(found: Comparison, method: str) -> Iterable[str]:
    diagnostics = found.solutions[method].diagnostics
    return diagnostics.warnings or (f"{diagnostics.status.value} after {diagnostics.n_iterations} iterations",)


def _maker(found: Comparison) -> str:
    version = next((s.versions["relnav"] for s in found.solutions.values() if "relnav" in s.versions), "")
    return f"relnav {version}".strip()


def _sections(found: Comparison) -> list[Section]:
    true = [subject for subject in found.subjects if subject.has_truth]
    paint = Paint(found)
    several = len(found.solutions) > 1
    spread = [_cdf(subject, paint) for subject in true if any(subject.errors.values())]
    if len(spread) % 2:
        spread[-1] = replace(spread[-1], wide=True)
    first = next(iter(found.solutions))
    return [
        Section("summary", "Summary", "Summary", html=_table(found) + _notes(found)),
        Section("tracks", "Tracks", "Tracks", _tracks(found, paint), absent="There are no tracks."),
        Section(
            "errors",
            "Error against truth",
            "Errors",
            _time_charts(true, lambda s: s.errors, ERROR, paint, found),
            absent="No truth is known for this flight.",
            lead="Estimate minus truth at the same epochs; the band is ±3σ of the method chosen above.",
        ),
        Section(
            "distribution",
            "Distribution of the errors",
            "Distribution",
            spread,
            lead="Share of epochs with an error below each size.",
        ),
        Section("consistency", "Consistency", "Consistency", _consistency(true, paint, found)),
        Section(
            "differences",
            f"Differences to {first}",
            "Differences",
            _time_charts(found.subjects, lambda s: s.differences, DIFFERENCE, paint, found) if several else [],
            absent="There is nothing to compare with a single method.",
            lead="Of every method to the first one, at the same epochs.",
            open_charts=4,
        ),
        Section("cost", "Computing time and memory", "Cost", _bars(found, paint), lead=_cost_lead(found)),
        Section("failed", "Methods that failed", "Failed", html=_failures(found)),
    ]


# table, cards, controls


def _table(found: Comparison) -> str:
    methods = list(found.solutions)
    head = "<th></th>" + "".join(f'<th class="num">{text(m)}</th>' for m in methods)
    rows = []
    for subject in found.subjects:
        against = "errors against truth" if subject.has_truth else f"differences to {subject.against}"
        rows.append(_group(subject.name, f"{against}, {subject.n_epochs:,} epochs", len(methods)))
        rows += [_row(m, {k: v[m.key] for k, v in subject.values.items()}, methods) for m in SUBJECT_METRICS]
    rows.append(_group("Solving", "", len(methods)))
    status = "".join(f'<td class="num">{text(s.diagnostics.status.value)}</td>' for s in found.solutions.values())
    rows.append(f"<tr><td>status</td>{status}</tr>")
    rows += [_row(m, {k: v[m.key] for k, v in found.values.items()}, methods) for m in METHOD_METRICS]
    body = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return f'<div class="table full" tabindex="0">{body}</div>'


def _group(name: str, about: str, n_methods: int) -> str:
    return f'<tr class="group"><td colspan="{n_methods + 1}">{text(name)} <small>{text(about)}</small></td></tr>'


def _row(metric: Metric, values: dict[str, float], methods: Sequence[str]) -> str:
    """A row of the table; nothing where no method knows the value."""
    if not any(np.isfinite(v) for v in values.values()):
        return ""
    best = best_of(metric, values)
    label = f"{metric.label} [{metric.unit}]" if metric.unit else metric.label
    cells = "".join(
        f'<td class="num{" best" if m in best else ""}">{figure(metric, values.get(m, float("nan")))}</td>' for m in methods
    )
    return f"<tr><td>{text(label)}</td>{cells}</tr>"


def _notes(found: Comparison) -> str:
    said = ["Every figure is of the same epochs for all methods; the best of a row is marked."]
    if any(np.isfinite(s.bound_rmse_m) for s in found.subjects):
        said.append("Bound: posterior Cramér-Rao bound of the baseline with known integers.")
    return paragraph(" ".join(said))


def _cards(found: Comparison) -> list[Card]:
    cards = []
    for subject in found.subjects[:1]:
        values = {m: v["rmse_m"] for m, v in subject.values.items() if np.isfinite(v["rmse_m"])}
        if subject.has_truth and values:
            best = min(values, key=lambda m: values[m])
            cards.append(Card("Smallest 3D RMSE", f"{figure(SUBJECT_METRICS[4], values[best])} m", f"{best}, {subject.name}"))
    for name, key, unit in (("Shortest wall time", "wall_s", "s"), ("Least memory", "peak_mb", "MB")):
        values = {m: v[key] for m, v in found.values.items() if np.isfinite(v[key])}
        if values:
            best = min(values, key=lambda m: values[m])
            cards.append(Card(name, f"{values[best]:.3g} {unit}", best))
    n = max((s.n_epochs for s in found.subjects), default=0)
    return [*cards, Card("Epochs compared", f"{n:,}", "at most, of a pair or vehicle")]


def _controls(found: Comparison) -> str:
    """Buttons that show and hide methods, and the choice of the one with a band."""
    paint = Paint(found)
    buttons = "".join(
        f'<button type="button" data-method="{text(m)}" aria-pressed="true">'
        f'<i style="background:{paint.colour(m)}"></i>{text(m)}</button>'
        for m in found.solutions
    )
    options = "".join(f'<option value="{text(m)}">{text(m)}</option>' for m in found.solutions)
    return f'<div class="methods">{buttons}<label>±3σ of <select autocomplete="off">{options}</select></label></div>'


def _failures(found: Comparison) -> str:
    return table(("method", "reason"), [(o.method, o.reason) for o in found.failed], 2) if found.failed else ""


# plots


class Paint:
    """A colour and a dash for each method, the same in all plots."""

    def __init__(self, found: Comparison) -> None:
        self._methods = list(found.solutions)

    def colour(self, method: str) -> str:
        return CYCLE[self._methods.index(method) % len(CYCLE)]

    def dash(self, method: str) -> str:
        return DASHES[self._methods.index(method) // len(CYCLE) % len(DASHES)]

    def is_first(self, method: str) -> bool:
        """Whether it is the one whose band is shown at first."""
        return method == self._methods[0]

    def owned(self, method: str, trace: Trace) -> Trace:
        """A trace that is shown and hidden with its method."""
        return trace | {"meta": {"method": method}, "legendgroup": method}


def _limit(n_curves: int) -> int:
    return max(MIN_POINTS, min(POINT_LIMIT, POINT_BUDGET // max(n_curves, 1)))


def _tracks(found: Comparison, paint: Paint) -> list[Chart]:
    """Plan view of all vehicles, and of every rover relative to its reference."""
    limit = _limit(2 * len(found.solutions))
    plan: list[Trace] = []
    named: set[str] = set()
    truths: dict[str, Trace] = {}
    for method, solution in found.solutions.items():
        for vehicle in (v for v in solution.vehicles if len(v.t_s)):
            east, north, _ = vehicle.r_n.T
            if vehicle.name not in named:
                named.add(vehicle.name)
                plan.append(_label(vehicle.name, east[:1], north[:1]))
            if not vehicle.is_fixed:
                plan += _owned_track(method, vehicle.t_s, east, north, limit, paint)
            if vehicle.truth is not None and not vehicle.is_fixed and vehicle.name not in truths:
                r_true = vehicle.truth.r_n.T
                truths[vehicle.name] = track(vehicle.truth.t_s, r_true[0], r_true[1], limit, "truth", TRUTH_COLOUR, "dash")[0]
    chart = plane_chart("All vehicles in the local frame", [*truths.values(), *plan], *ENU_TITLES)
    charts = [replace(chart, height_px=520)] if plan else []
    for key in dict.fromkeys((p.reference, p.rover) for s in found.solutions.values() for p in s.pairs):
        charts += _relative_track(key, found, paint, limit)
    if len(charts) % 2:
        charts[0] = replace(charts[0], wide=True)
    return charts


ENU_TITLES = ("east [m]", "north [m]")


def _relative_track(key: tuple[str, str], found: Comparison, paint: Paint, limit: int) -> list[Chart]:
    data: list[Trace] = []
    truth: list[Trace] = []
    name = ""
    for method, solution in found.solutions.items():
        for pair in (p for p in solution.pairs if (p.reference, p.rover) == key and len(p.t_s)):
            name = pair_name(pair)
            data += _owned_track(method, pair.t_s, pair.baseline_enu[:, 0], pair.baseline_enu[:, 1], limit, paint)
            if pair.truth_enu is not None and not truth:
                truth = track(pair.t_s, pair.truth_enu[:, 0], pair.truth_enu[:, 1], limit, "truth", TRUTH_COLOUR, "dash")
    chart = plane_chart(f"{plot_text(name)}: relative, plan", [*truth, *data], *ENU_TITLES)
    return [replace(chart, height_px=520)] if data else []


def _owned_track(method: str, t_s: Array, x: Array, y: Array, limit: int, paint: Paint) -> list[Trace]:
    drawn = track(t_s, x, y, limit, plot_text(method), paint.colour(method), paint.dash(method))
    return [paint.owned(method, trace) for trace in drawn]


def _label(name: str, x: Array, y: Array) -> Trace:
    marker = {"color": TRUTH_COLOUR, "size": 9, "symbol": "circle-open"}
    words = {"mode": "markers+text", "text": [plot_text(name)], "textposition": "top center", "showlegend": False}
    return points(plot_text(name), x, y, marker) | words


def _time_charts(
    subjects: Sequence[Subject],
    series_of: Callable[[Subject], dict[str, tuple[ErrorSeries, ...]]],
    what: str,
    paint: Paint,
    found: Comparison,
) -> list[Chart]:
    """A chart of each quantity of each subject, all methods in it."""
    limit = _limit(3 * len(found.solutions))
    charts = []
    for subject in subjects:
        by_quantity: dict[str, dict[str, ErrorSeries]] = {}
        for method, found_series in series_of(subject).items():
            for series in found_series:
                by_quantity.setdefault(series.quantity, {})[method] = series
        charts += [_components(group, what, paint, limit) for group in by_quantity.values()]
    return charts


def _components(group: dict[str, ErrorSeries], what: str, paint: Paint, limit: int) -> Chart:
    """East, north, up of one quantity over time."""
    any_series = next(iter(group.values()))
    scale, unit = any_series.display
    known = {m: np.isfinite(s.error).all(axis=1) for m, s in group.items()}
    top = _reach([scale * s.error[known[m]] for m, s in group.items()]) if what == ERROR else None
    axis_range: dict[str, Any] = {"exponentformat": "power"} | ({} if top is None else {"range": [-top, top]})
    panels = []
    for i, axis in enumerate(any_series.axes):
        traces: list[Trace] = []
        for method, series in group.items():
            rows = known[method]
            error, sigma = scale * series.error[rows, i], scale * series.sigma[rows, i]
            sigma = sigma if what == ERROR else np.full_like(sigma, np.nan)  # it would hide how small differences are
            traces += _curve(method, series.t_s[rows], error, sigma, unit, paint, limit)
        panels.append(Panel(f"{axis} [{unit}]", traces, axis_range))
    note = " ".join(filter(None, ["" if top is None else OUT_OF_RANGE, thin_note(max(k.sum() for k in known.values()), limit)]))
    return time_chart(f"{plot_text(any_series.subject)}: {any_series.quantity} {what}", panels, note)


def _reach(errors: Sequence[Array]) -> float | None:
    """Half the vertical range that shows the better methods well; None where all fits into it anyhow."""
    sizes = [np.max(np.abs(e), axis=1) for e in errors if len(e)]
    usual = sorted(float(np.percentile(s, 95)) for s in sizes)
    if not usual or not usual[-1] > 0:
        return None
    shown = 1.6 * min(usual[-1], SPREAD * next(u for u in usual if u > 0))
    return shown if max(float(s.max()) for s in sizes) > 2 * shown else None


def _curve(method: str, t_s: Array, y: Array, sigma: Array, unit: str, paint: Paint, limit: int) -> list[Trace]:
    rows, stretch = thin(limit, y), stretches(t_s)
    reach = BAND_SIGMAS * sigma[rows]
    colour = paint.colour(method)
    area = band(t_s[rows], -reach, reach, stretch[rows], colour, name=f"±3σ of {plot_text(method)}", showlegend=False)
    style = {"color": colour, "width": 1.3, "dash": paint.dash(method)}
    curve = paint.owned(method, line(t_s[rows], y[rows], stretch[rows], name=plot_text(method), line=style))
    curve["hovertemplate"] = f"%{{y:.4~f}} {unit}"
    if area is None:
        return [curve]
    return [area | {"meta": {"method": method, "band": True}, "visible": paint.is_first(method)}, curve]


def _cdf(subject: Subject, paint: Paint) -> Chart:
    """Distribution of the baseline or position error."""
    drawn = {m: replace(e, subject=m) for m, found in subject.errors.items() for e in found if e.quantity in PLACES}
    quantity = next(iter(drawn.values())).quantity
    chart = quality.error_cdf(f"3D {quantity}", list(drawn.values()))
    data = []
    for method, curve in zip(drawn, chart.data, strict=True):
        style = curve["line"] | {"color": paint.colour(method), "dash": paint.dash(method)}
        data.append(paint.owned(method, curve | {"line": style}))
    return replace(chart, title=f"{plot_text(subject.name)}: {quantity} error", data=data)


def _consistency(subjects: Sequence[Subject], paint: Paint, found: Comparison) -> list[Chart]:
    """NEES over time of every subject, then the NIS of every method relative to its degrees of freedom."""
    limit = _limit(len(found.solutions))
    charts = []
    for subject in subjects:
        drawn = {m: e for m, es in subject.errors.items() for e in es if e.quantity in PLACES}
        drawn = {m: e for m, e in drawn.items() if np.isfinite(e.nees.value).any()}
        traces: list[Trace] = []
        for method, series in drawn.items():
            test = series.nees
            rows = np.isfinite(test.value)
            area, *curves = quality.chi_square_traces(
                test.t_s[rows], test.value[rows], test.lower[rows], test.upper[rows], plot_text(method), limit
            )
            if not curves:
                area, curves = {}, [area]
            if area and not traces:
                traces.append(area)
            style = {"color": paint.colour(method), "width": 1.1, "dash": paint.dash(method)}
            traces.append(paint.owned(method, curves[0] | {"line": style}))
        if traces:
            values = np.concatenate([e.nees.value for e in drawn.values()])
            title = f"{plot_text(subject.name)}: NEES, 3 degrees of freedom"
            charts.append(time_chart(title, [Panel("NEES", traces, log_axis(values), 1.4)]))
    return charts


def _bars(found: Comparison, paint: Paint) -> list[Chart]:
    timed = [m for m in found.solutions if np.isfinite(found.values[m]["wall_s"])]
    sets = (
        ("Computing time", "s", {"wall": "wall_s", "CPU": "cpu_s"}),
        ("Peak memory over the flight's data", "MB", {"memory": "peak_mb"}),
    )
    charts = []
    for title, unit, keys in sets:
        data = []
        for method in timed:
            y = np.array([found.values[method][key] for key in keys.values()])
            bar: Trace = {
                "type": "bar",
                "name": plot_text(method),
                "x": list(keys),
                "y": numbers(y, 4),
                "marker": {"color": paint.colour(method)},
            }
            bar |= {"text": [f"{v:.3g}" for v in y], "textposition": "outside", "cliponaxis": False}
            bar["hovertemplate"] = f"%{{y:.3~g}} {unit}"
            data.append(paint.owned(method, bar))
        if data:
            charts.append(Chart(title, data, _bar_layout(data, unit), 340, wide=False))
    return charts


def _bar_layout(data: Sequence[Trace], unit: str) -> dict[str, Any]:
    values = np.array([v for bar in data for v in bar["y"] if v is not None])
    used = values[values > 0]
    spread = len(used) > 0 and used.max() > LOG_RATIO * used.min()
    axis = log_axis(values) if spread else {"rangemode": "tozero"}
    return {
        "barmode": "group",
        "hovermode": "closest",
        "xaxis": {"title": {"text": ""}},
        "yaxis": {"title": {"text": unit}} | axis,
    }


def _cost_lead(found: Comparison) -> str:
    runs = {o.cost.n_runs for o in found.outcomes if o.cost is not None}
    times = "of one run" if runs == {1} else f"medians of {min(runs)} runs or more" if runs else ""
    return f"Solving alone, each method in a process of its own; times are {times}. A first run may compile code." if runs else ""
