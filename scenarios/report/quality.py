"""Charts of how far to believe a solution: residuals, consistency, cost, errors against truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from factorgraph.consistency import judge
from factorgraph.models.outliers import GROSS, MULTIPATH, NLOS, SLIP, WORDS
from factorgraph.solution import Diagnostics, ResidualTable
from factorgraph.types import Array, IntArray
from scenarios.metrics import ErrorSeries, cdf
from scenarios.report.chart import (
    CLOUD_LIMIT,
    UNITS,
    Chart,
    Panel,
    log_axis,
    time_chart,
)
from scenarios.report.series import (
    ALERT_COLOUR,
    AXIS_COLOURS,
    CYCLE,
    TRUTH_COLOUR,
    Trace,
    band,
    line,
    normalised,
    numbers,
    plot_text,
    sample,
    seconds,
    stretches,
    thin,
    thin_note,
)

TIMELINE_LABELS = 48
CLASS_COLOURS = {GROSS: TRUTH_COLOUR, MULTIPATH: CYCLE[4], NLOS: ALERT_COLOUR, SLIP: CYCLE[3]}


def residuals(table: ResidualTable, outlier_sigma: float | None, limit: int) -> list[Chart]:
    """A chart for each kind: in units above, divided by the assumed sigma below."""
    scaled = normalised(table)
    charts = []
    for k, kind in enumerate(table.kind):
        rows = np.flatnonzero((table.kind_index == k) & np.isfinite(table.residual))
        if not len(rows):
            continue
        flagged = table.outlier[rows]
        # the largest first: they are what the chart is looked at for
        strange = rows[flagged][np.argsort(-np.abs(scaled[rows[flagged]]), kind="stable")][:limit]
        good = sample(CLOUD_LIMIT, rows[~flagged])
        unit = UNITS.get(kind, "SI")
        panels = [
            Panel(f"residual [{unit}]", _cloud(table.t_s, table.residual, table, good, strange, unit)),
            Panel(
                "residual / σ",
                [*_sigma_levels(table.t_s[rows], outlier_sigma), *_cloud(table.t_s, scaled, table, good, strange, "σ")],
            ),
        ]
        title = f"{plot_text(kind)}: {len(rows):,} residuals, {int(flagged.sum()):,} outliers"
        note = _drawn_note(len(good), int(np.sum(~flagged)), len(strange), int(flagged.sum()))
        chart = time_chart(title, panels, note)
        chart.layout.update({"hovermode": "closest"})
        del chart.layout["hoversubplots"]
        charts.append(chart)
    return charts


def _drawn_note(good: int, all_good: int, strange: int, all_strange: int) -> str:
    parts = [f"{good:,} of {all_good:,} residuals in use, chosen at random"] if good < all_good else []
    parts += [f"the largest {strange:,} of {all_strange:,} outliers"] if strange < all_strange else []
    return f"Drawn: {', '.join(parts)}." if parts else ""


def outlier_timeline(table: ResidualTable, limit: int) -> Chart | None:
    """When which satellite, radio or axis had outliers, by what they look like; None without any.

    The labels with most outliers are drawn, at most TIMELINE_LABELS.
    """
    flagged = np.flatnonzero(table.outlier_class > 0)
    if not len(flagged):
        return None
    count = np.bincount(table.label_index[flagged], minlength=len(table.label))
    drawn = np.argsort(-count, kind="stable")[: min(TIMELINE_LABELS, int(np.sum(count > 0)))]
    names = [plot_text(table.label[i]) for i in sorted(drawn.tolist(), key=lambda i: table.label[i])]
    rows = flagged[np.isin(table.label_index[flagged], drawn)]
    data: list[Trace] = []
    shown = 0
    for i, words in WORDS.items():
        mine = rows[table.outlier_class[rows] == i]
        if len(mine):
            kept = sample(limit, mine)
            shown += len(kept)
            marker = {"color": CLASS_COLOURS[i], "size": 7, "symbol": "line-ns-open" if i == GROSS else "square", "opacity": 0.8}
            kinds = [f"{plot_text(table.kind[table.kind_index[k]])} {table.residual[k]:+.3g}" for k in kept]
            cloud: Trace = {"type": "scatter", "mode": "markers", "name": words, "marker": marker, "text": kinds}
            cloud |= {"x": seconds(table.t_s[kept]), "y": [plot_text(table.label[k]) for k in table.label_index[kept]]}
            data.append(cloud | {"hovertemplate": f"%{{y}} %{{text}} at %{{x:.2f}} s<extra>{words}</extra>"})
    axis = {"type": "category", "categoryorder": "array", "categoryarray": names[::-1], "dtick": 1}
    parts = [f"{shown:,} of {len(rows):,} outliers"] if shown < len(rows) else []
    more = int(np.sum(count > 0)) - len(names)
    parts += [f"the {len(names)} labels with most outliers; {more} more have some"] if more else []
    note = f"Drawn: {', '.join(parts)}." if parts else ""
    chart = time_chart("Outliers by satellite, radio or axis", [Panel("", data, axis, max(1.0, len(names) / 8))], note)
    chart.layout.update({"hovermode": "closest"})
    del chart.layout["hoversubplots"]
    return chart


def histogram(table: ResidualTable) -> Chart | None:
    """Normalised residuals of each kind against the standard normal density; None without residuals."""
    scaled, edges = normalised(table), np.linspace(-6, 6, 61)
    x = (edges[:-1] + edges[1:]) / 2
    data: list[Trace] = []
    for k, kind in enumerate(table.kind):
        mine = scaled[table.kind_index == k]
        mine = mine[np.isfinite(mine)]
        if len(mine):
            # beyond ±6 counts into the last bins
            density = np.histogram(np.clip(mine, -6, 6), edges)[0] / len(mine) / (edges[1] - edges[0])
            style = {"color": CYCLE[k % len(CYCLE)], "width": 1.6, "shape": "hvh"}
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": plot_text(kind),
                    "x": numbers(x),
                    "y": numbers(density, 4),
                    "line": style,
                }
            )
    if not data:
        return None
    grid = np.linspace(-6, 6, 121)
    style = {"color": TRUTH_COLOUR, "width": 2, "dash": "dash"}
    data.append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": "N(0, 1)",
            "x": numbers(grid),
            "y": numbers(norm.pdf(grid), 4),
            "line": style,
        }
    )
    layout = {
        "hovermode": "x",
        "xaxis": {"title": {"text": "residual / σ"}},
        "yaxis": {"title": {"text": "density"}, "rangemode": "tozero"},
    }
    return Chart("Distribution against N(0, 1)", data, layout, 380, "The end bins hold everything beyond ±6.")


def nis(diagnostics: Diagnostics, limit: int) -> Chart | None:
    """Normalised innovation squared per epoch with its 95 % band; None without any."""
    if not np.isfinite(diagnostics.nis).any():
        return None
    test = judge(diagnostics.nis_t_s, diagnostics.nis, diagnostics.nis_dof)
    note = f"{100 * test.share_inside:.1f} % of epochs lie inside the 95 % band. {thin_note(len(test.t_s), limit)}".strip()
    panel = Panel(
        "squared residuals",
        chi_square_traces(test.t_s, test.value, test.lower, test.upper, "NIS", limit),
        _maybe_log(test.value),
    )
    return time_chart("Sum of squared normalised residuals per epoch", [panel], note)


def cost(diagnostics: Diagnostics) -> Chart | None:
    """Cost after each iteration; None without any."""
    y = diagnostics.cost[np.isfinite(diagnostics.cost)]
    if len(y) < 2:
        return None
    style = {"color": AXIS_COLOURS[0], "width": 1.6}
    data = [
        {
            "type": "scatter",
            "mode": "lines+markers",
            "x": list(range(len(y))),
            "y": numbers(y),
            "line": style,
            "showlegend": False,
        }
    ]
    axis = log_axis(y) if (y > 0).all() else {}
    layout = {"xaxis": {"title": {"text": "iteration"}, "tickformat": "d"}, "yaxis": {"title": {"text": "cost"}} | axis}
    return Chart("Cost of the optimisation", data, layout, 300)


def _cloud(t_s: Array, y: Array, table: ResidualTable, good: IntArray, strange: IntArray, unit: str) -> list[Trace]:
    clouds = []
    for name, rows, colour, size in (("kept", good, AXIS_COLOURS[0], 3), ("outlier", strange, ALERT_COLOUR, 6)):
        if len(rows):
            labels = [plot_text(table.label[i]) for i in table.label_index[rows]]
            marker = {"color": colour, "size": size, "opacity": 0.75}
            cloud: Trace = {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "legendgroup": name,
                "text": labels,
                "marker": marker,
            }
            cloud |= {"x": seconds(t_s[rows]), "y": numbers(y[rows], 5)}
            clouds.append(cloud | {"hovertemplate": f"%{{text}}<br>%{{y:.4~f}} {unit} at %{{x:.2f}} s<extra>{name}</extra>"})
    return clouds


def _sigma_levels(t_s: Array, outlier_sigma: float | None) -> list[Trace]:
    ends = np.array([np.min(t_s), np.max(t_s)])
    level = outlier_sigma if outlier_sigma is not None else 3.0
    x = np.array([ends[0], ends[1], np.nan, ends[0], ends[1]])
    style = {"color": TRUTH_COLOUR, "width": 1.2, "dash": "dot"}
    levels: Trace = {"type": "scatter", "mode": "lines", "name": f"±{level:g}σ", "line": style, "hoverinfo": "skip"}
    return [levels | {"x": seconds(x), "y": numbers(np.array([level, level, np.nan, -level, -level]))}]


def chi_square_traces(t_s: Array, value: Array, lower: Array, upper: Array, name: str, limit: int) -> list[Trace]:
    rows, stretch = thin(limit, value), stretches(t_s)
    area = band(
        t_s[rows],
        lower[rows],
        upper[rows],
        stretch[rows],
        AXIS_COLOURS[2],
        name="95 % band",
        legendgroup="95 % band",
        legendrank=1300,
    )
    style = {"color": AXIS_COLOURS[0], "width": 1.1}
    curve = line(t_s[rows], value[rows], stretch[rows], name=name, line=style) | {"hovertemplate": "%{y:.3~g}"}
    return [curve] if area is None else [area, curve]


def _maybe_log(value: Array) -> dict[str, Any]:
    finite = value[np.isfinite(value) & (value > 0)]
    spread = len(finite) > 0 and finite.max() > 20 * np.median(finite)
    return log_axis(value) if spread else {"rangemode": "tozero"}


def errors(series: ErrorSeries, limit: int) -> Chart:
    """Error of each component with ±3σ around zero, and the NEES with its 95 % band."""
    scale, unit = series.display
    known = np.isfinite(series.error).all(axis=1)
    t_s, error, sigma = series.t_s[known], scale * series.error[known], scale * series.sigma[known]
    top = _robust_reach(error, 3 * sigma)
    axis_range = {} if top is None else {"range": [-top, top]}
    panels = [
        Panel(f"{axis} [{unit}]", _error_traces(t_s, error[:, i], sigma[:, i], axis, unit, AXIS_COLOURS[i], limit), axis_range)
        for i, axis in enumerate(series.axes)
    ]
    test, notes = series.nees, [thin_note(len(t_s), limit)]
    if top is not None:
        notes.insert(0, "A few epochs lie far outside the vertical range; a double click shows them.")
    if np.isfinite(test.value).any():
        traces = chi_square_traces(t_s, test.value[known], test.lower[known], test.upper[known], "NEES", limit)
        panels.append(Panel("NEES", traces, log_axis(test.value)))
        notes.insert(0, f"NEES inside its 95 % band at {100 * test.share_inside:.1f} % of epochs.")
    return time_chart(f"{plot_text(series.subject)}: {series.quantity} error", panels, " ".join(filter(None, notes)))


def _robust_reach(error: Array, reach: Array) -> float | None:
    """Half the vertical range that shows nine epochs of ten well, when the largest would hide them; else None."""
    largest = np.max(np.abs(error), axis=1)
    band = np.max(np.where(np.isfinite(reach), reach, 0.0), axis=1)
    usual = max(float(np.percentile(v, 90)) for v in (largest, band))
    return 1.4 * usual if 0 < 5 * usual < max(largest.max(), band.max()) else None


def _error_traces(t_s: Array, error: Array, sigma: Array, name: str, unit: str, colour: str, limit: int) -> list[Trace]:
    rows, stretch = thin(limit, error, sigma), stretches(t_s)
    reach = 3 * sigma[rows]
    area = band(t_s[rows], -reach, reach, stretch[rows], TRUTH_COLOUR, name="±3σ", legendgroup="band", legendrank=1200)
    curve = line(t_s[rows], error[rows], stretch[rows], name=name, line={"color": colour, "width": 1.3})
    curve["hovertemplate"] = f"%{{y:.4~f}} {unit}"
    return [curve] if area is None else [area, curve]


def error_cdf(quantity: str, found: Sequence[ErrorSeries]) -> Chart:
    """Share of epochs with an error below each size, all subjects: the norm, and for positions horizontal and up."""
    scale, unit = found[0].display
    parts = (
        {"3D": slice(0, 3), "horizontal": slice(0, 2), "up": slice(2, 3)}
        if quantity in ("baseline", "position")
        else {"3D": slice(0, 3)}
    )
    data, drawn = [], np.zeros(0)
    for i, series in enumerate(found):
        for j, (part, columns) in enumerate(parts.items()):
            size, share = cdf(scale * series.error[:, columns])
            # the smallest errors say little and would stretch the axis
            size, share = size[share > 0.01], share[share > 0.01]
            drawn = np.concatenate([drawn, size])
            rows = np.unique(np.linspace(0, len(size) - 1, min(len(size), 400)).astype(np.int64))
            name = f"{plot_text(series.subject)} {part}" if len(parts) > 1 else plot_text(series.subject)
            style = {"color": CYCLE[(i if len(found) > 1 else j) % len(CYCLE)], "width": 1.8}
            style["dash"] = ("solid", "dash", "dot")[j] if len(found) > 1 else "solid"
            hover = f"%{{y:.1f}} % below %{{x:.4~g}} {unit}"
            curve: Trace = {"type": "scatter", "mode": "lines", "name": name, "line": style, "hovertemplate": hover}
            data.append(curve | {"x": numbers(size[rows], 4), "y": numbers(100 * share[rows], 4)})
    layout = {
        "hovermode": "closest",
        "xaxis": {"title": {"text": f"{quantity} error [{unit}]"}} | log_axis(drawn),
        "yaxis": {"title": {"text": "epochs below [%]"}, "range": [-3, 103]},
    }
    return Chart(f"Distribution of the {quantity} error", data, layout, 380, wide=False)
