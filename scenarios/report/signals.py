"""Charts of the satellite signals: fix status, ratio test, number of satellites, sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorgraph.models.outliers import GROSS, WORDS
from factorgraph.solution import Fix, PairSolution, ResidualTable
from factorgraph.types import Array
from scenarios.metrics import pair_name
from scenarios.report.chart import (
    FIX_COLOURS,
    FIX_NAMES,
    Chart,
    Panel,
    log_axis,
    time_chart,
)
from scenarios.report.quality import CLASS_COLOURS
from scenarios.report.series import (
    ALERT_COLOUR,
    AXIS_COLOURS,
    CYCLE,
    TRUTH_COLOUR,
    Trace,
    legend_once,
    line,
    numbers,
    plot_text,
    sample,
    seconds,
    stretches,
    thin,
    thin_note,
)

SYSTEM_NAMES = {"G": "GPS", "R": "GLONASS", "E": "Galileo", "C": "BeiDou", "J": "QZSS", "I": "NavIC", "S": "SBAS"}
SYSTEM_COLOURS = dict(zip(SYSTEM_NAMES, CYCLE, strict=False))
FIX_AXIS = {"range": [0, 1], "fixedrange": True, "showticklabels": False, "showgrid": False, "zeroline": False}
SKY_ROWS = 60_000  # residuals the paths are taken from
SKY_POINTS = 60  # a satellite
SKY_MARKS = 400  # a class of outliers


def fixing(pair: PairSolution, threshold: float | None, limit: int) -> Chart:
    """Fix status and ratio test over time."""
    panels = [Panel("", _fix_bars(pair, limit), FIX_AXIS, 0.3)]
    if np.isfinite(pair.ratio).any():
        rows = thin(limit, pair.ratio)
        style = {"color": AXIS_COLOURS[0], "width": 1.2}
        curve = line(pair.t_s[rows], pair.ratio[rows], stretches(pair.t_s)[rows], name="ratio", line=style)
        traces = [curve | {"hovertemplate": "%{y:.2f}"}]
        if threshold is not None:
            level = line(pair.t_s[[0, -1]], np.full(2, threshold), np.zeros(2, np.int64), name="threshold", mode="lines")
            traces.append(level | {"line": {"color": ALERT_COLOUR, "width": 1.2, "dash": "dot"}, "hoverinfo": "skip"})
        panels.append(Panel("ratio", traces, log_axis(np.append(pair.ratio, threshold or np.nan))))
    return time_chart(plot_text(pair_name(pair)), panels, thin_note(len(pair.t_s), limit))


def _fix_bars(pair: PairSolution, limit: int) -> list[Trace]:
    """One bar for each unbroken run of a status."""
    rows = thin(limit, pair.fix.astype(float))
    t_s, fix, stretch = pair.t_s[rows], pair.fix[rows], stretches(pair.t_s)[rows]
    first = np.flatnonzero(np.concatenate([[True], (np.diff(fix) != 0) | (np.diff(stretch) != 0)]))
    step = float(np.median(np.diff(pair.t_s))) if len(pair.t_s) > 1 else 1.0
    end = np.append(t_s[1:], t_s[-1] + step)
    last = np.append(first[1:], len(t_s)) - 1
    end = np.where(np.append(np.diff(stretch), 0) != 0, t_s + step, end)
    bars = []
    for status in Fix:
        mine = fix[first] == status.value
        start, stop = t_s[first[mine]], end[last[mine]]
        if len(start):
            bars.append(
                {
                    "type": "bar",
                    "name": FIX_NAMES[status],
                    "x": seconds(start),
                    "width": seconds(stop - start),
                    "offset": 0,
                    "y": [1] * len(start),
                    "marker": {"color": FIX_COLOURS[status], "line": {"width": 0}},
                    "hoverinfo": "name",
                }
            )
    return bars


def satellite_count(pair: PairSolution, limit: int) -> Chart:
    n_sat = pair.n_sat.astype(float)
    rows = thin(limit, n_sat)
    style = {"color": AXIS_COLOURS[0], "width": 1.4, "shape": "hv"}
    curve = line(pair.t_s[rows], n_sat[rows], stretches(pair.t_s)[rows], name="satellites", line=style)
    axis = {"rangemode": "tozero", "tickformat": "d"}
    panel = Panel("satellites used", [curve | {"hovertemplate": "%{y}"}], axis)
    chart = time_chart(f"{plot_text(pair_name(pair))}: in the differences", [panel], thin_note(len(pair.t_s), limit))
    return replace(chart, height_px=460, wide=False)


def skyplot(table: ResidualTable) -> Chart | None:
    """Azimuth and elevation of the satellites in the residuals; None without any."""
    rows = np.flatnonzero(np.isfinite(table.azimuth_rad) & np.isfinite(table.elevation_rad))
    if not len(rows):
        return None
    rows = sample(SKY_ROWS, rows)
    rows = rows[np.lexsort((table.t_s[rows], table.label_index[rows]))]
    tracks = []
    for mine in np.split(rows, np.flatnonzero(np.diff(table.label_index[rows])) + 1):
        path = mine[np.linspace(0, len(mine) - 1, min(SKY_POINTS, len(mine))).astype(np.int64)]
        name = table.label[table.label_index[mine[0]]]
        tracks.append((name, np.rad2deg(table.azimuth_rad[path]), np.rad2deg(table.elevation_rad[path])))
    chart = sky_chart("Sky", tracks)
    marks = _sky_marks(table)
    return replace(chart, data=legend_once([*chart.data, *marks])) if marks else chart


def _sky_marks(table: ResidualTable) -> list[Trace]:
    """Where outliers were that last: reflections and suspected slips."""
    marks: list[Trace] = []
    for i, words in WORDS.items():
        rows = sample(SKY_MARKS, np.flatnonzero((table.outlier_class == i) & np.isfinite(table.azimuth_rad)))
        if i == GROSS or not len(rows):
            continue
        marks.append(
            {
                "type": "scatterpolar",
                "mode": "markers",
                "name": words,
                "legendgroup": words,
                "theta": numbers(np.rad2deg(table.azimuth_rad[rows]), 5),
                "r": numbers(np.rad2deg(table.elevation_rad[rows]), 5),
                "marker": {"color": CLASS_COLOURS[i], "size": 6, "symbol": "x", "opacity": 0.7},
                "text": [plot_text(table.label[k]) for k in table.label_index[rows]],
                "hovertemplate": f"%{{text}}: {words}<br>azimuth %{{theta:.1f}}°, elevation %{{r:.1f}}°<extra></extra>",
            }
        )
    return marks


def sky_chart(title: str, tracks: Sequence[tuple[str, Array, Array]], note: str = "") -> Chart:
    """Paths in the sky: satellite, azimuth (n,) and elevation (n,) in degrees; the last point carries the name."""
    polar = {
        "domain": {"y": [0, 0.94]},  # leaves room between the mark of north and the legend
        "radialaxis": {"range": [90, 0], "tickvals": [0, 30, 60], "angle": 90, "tickangle": 90, "ticksuffix": "°"},
        "angularaxis": {
            "direction": "clockwise",
            "rotation": 90,
            "tickvals": list(range(0, 360, 45)),
            "ticktext": ["N", "NE", "E", "SE", "S", "SW", "W", "NW"],
        },
    }
    data = [_sky_path(plot_text(name), azimuth_deg, elevation_deg) for name, azimuth_deg, elevation_deg in tracks]
    return Chart(title, legend_once(data), {"polar": polar, "hovermode": "closest"}, 460, note, wide=False)


def _sky_path(satellite: str, azimuth_deg: Array, elevation_deg: Array) -> Trace:
    colour = SYSTEM_COLOURS.get(satellite[:1], TRUTH_COLOUR)
    system = SYSTEM_NAMES.get(satellite[:1], "other")
    return {
        "type": "scatterpolar",
        "mode": "lines+markers+text",
        "name": system,
        "legendgroup": system,
        "theta": numbers(azimuth_deg, 5),
        "r": numbers(elevation_deg, 5),
        "line": {"color": colour, "width": 2},
        "marker": {"color": colour, "size": [0] * (len(azimuth_deg) - 1) + [9]},
        "text": [""] * (len(azimuth_deg) - 1) + [satellite],
        "textposition": "top center",
        "textfont": {"size": 11},
        "hovertemplate": f"{satellite}<br>azimuth %{{theta:.1f}}°, elevation %{{r:.1f}}°<extra></extra>",
    }
