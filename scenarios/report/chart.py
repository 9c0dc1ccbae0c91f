"""What a chart of the report is: plotly data and layout, stacked panels over time, planes, logarithmic axes.

Colours of text, grid and ground are left to the page, which follows the reader's light or dark preference.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from factorgraph.solution import Fix
from factorgraph.types import Array
from scenarios.report.series import ALERT_COLOUR, Trace, legend_once, translucent

ENU = ("east", "north", "up")
TIME_TITLE = "time since t0 [s]"
FIX_NAMES = {Fix.NONE: "no phase", Fix.FLOAT: "float", Fix.PARTIAL: "partly fixed", Fix.FIXED: "fixed"}
FIX_COLOURS = {Fix.NONE: "#8b93a0", Fix.FLOAT: "#dd7d35", Fix.PARTIAL: "#c9a227", Fix.FIXED: "#2f9e79"}
UNITS = {"code": "m", "phase": "m", "doppler": "m/s", "range": "m", "position": "m", "height": "m"}  # of residuals
CLOUD_LIMIT = 1200  # points of a cloud; each is an element of the page


@dataclass(frozen=True, slots=True)
class Chart:
    """One figure of the page."""

    title: str
    data: list[Trace]
    layout: dict[str, Any]
    height_px: int
    note: str = ""
    wide: bool = True  # takes the whole width of the page, else half of it
    is_time: bool = False  # abscissa is time: zooms together with the others


@dataclass(frozen=True, slots=True)
class Panel:
    """One row of a chart over time."""

    title: str  # quantity and unit
    traces: Sequence[Trace]
    axis: dict[str, Any] = field(default_factory=dict)
    share: float = 1.0  # height, relative to the other rows


def time_chart(title: str, panels: Sequence[Panel], note: str = "") -> Chart:
    """Panels under each other on one time axis."""
    gap = min(0.05, 0.2 / len(panels)) if len(panels) > 1 else 0.0
    room = (1 - gap * (len(panels) - 1)) / sum(panel.share for panel in panels)
    layout: dict[str, Any] = {"hovermode": "x unified", "hoversubplots": "axis"}
    data, top = [], 1.0
    for i, panel in enumerate(panels, 1):
        key = "" if i == 1 else str(i)
        bottom = top - room * panel.share
        layout[f"yaxis{key}"] = {"title": {"text": panel.title}, "domain": [max(bottom, 0.0), top], "nticks": 6} | panel.axis
        data += [trace | {"xaxis": "x", "yaxis": f"y{key}"} for trace in panel.traces]
        top = bottom - gap
    layout["xaxis"] = {"title": {"text": TIME_TITLE}, "anchor": f"y{key}", "hoverformat": ".2f"}
    times = [t_s for trace in data for t_s in trace["x"] if t_s is not None]
    if times and max(times) > min(times):
        layout["xaxis"]["range"] = [min(times), max(times)]
    height_px = 95 + round(150 * sum(panel.share for panel in panels)) + (50 if len(panels) == 1 else 0)
    return Chart(title, legend_once(data), layout, height_px, note, is_time=True)


def shaded(chart: Chart, spans: Iterable[tuple[float, float]]) -> Chart:
    """The chart with spans of time marked over all panels."""
    shapes = [
        {
            "type": "rect", "xref": "x", "yref": "paper", "x0": start, "x1": end, "y0": 0, "y1": 1,
            "fillcolor": translucent(ALERT_COLOUR, 0.16), "line": {"width": 0}, "layer": "below",
        }
        for start, end in spans
    ]  # fmt: skip
    return replace(chart, layout=chart.layout | {"shapes": shapes}) if shapes else chart


def log_axis(values: Array) -> dict[str, Any]:
    """A logarithmic axis over the positive ones of some values, marked at 1, 2, 5 or at powers of ten alone."""
    usable = values[np.isfinite(values) & (values > 0)]
    if not usable.size:
        return {"type": "log"}
    low, high = np.log10(usable.min()), np.log10(usable.max())
    pad = 0.05 * max(high - low, 0.3)
    decades = np.arange(np.floor(low - pad), np.ceil(high + pad) + 1)
    every = max(1, int(np.ceil(len(decades) / 6)))
    marks = [(m, int(d)) for d in decades[::every] for m in ((1, 2, 5) if high - low < 1.6 else (1,))]
    ticks = {"tickvals": [float(f"{m}e{d}") for m, d in marks], "ticktext": [_power_text(m, d) for m, d in marks]}
    return {"type": "log", "range": [float(low - pad), float(high + pad)]} | ticks


def _power_text(factor: int, power: int) -> str:
    if -4 < power < 4:
        return f"{factor * 10.0**power:g}"
    return f"10<sup>{power}</sup>" if factor == 1 else f"{factor}·10<sup>{power}</sup>"


def plane_chart(title: str, data: Sequence[Trace], x_title: str, y_title: str, note: str = "") -> Chart:
    """A chart of two lengths on the same scale."""
    layout = {
        "hovermode": "closest",
        "xaxis": {"title": {"text": x_title}},
        "yaxis": {"title": {"text": y_title}, "scaleanchor": "x", "scaleratio": 1},
    }
    return Chart(title, legend_once(data), layout, 460, note, wide=False)
