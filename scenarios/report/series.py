"""Long series made small: thinning that keeps extremes, line breaks at gaps, short JSON numbers, ±3σ bands.

A trace is a plain dictionary in plotly's schema (https://plotly.com/javascript/reference/).
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from factorgraph.solution import ResidualTable
from factorgraph.types import Array, BoolArray, IntArray

Trace = dict[str, Any]

GAP_STEPS = 5.0  # a line breaks where time jumps by more than this many median steps
BAND_SIGMAS = 3.0
FEW_POINTS = 60  # up to here a line also shows its points

AXIS_COLOURS = ("#3f83d1", "#dd7d35", "#2f9e79")  # east, north, up; legible on light and on dark ground
TRUTH_COLOUR = "#8b93a0"
ALERT_COLOUR = "#d8434f"
CYCLE = (*AXIS_COLOURS, "#9a6bd0", "#c9a227", "#3aa6b9", "#d0608f", "#7f8c4d")


def plot_text(text: str) -> str:
    """Text from input for use in a plot, where plotly would read markup."""
    return html.escape(text, quote=False)


def translucent(colour: str, alpha: float) -> str:
    """A "#rrggbb" colour with an opacity."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha})"


def numbers(values: Array | IntArray, digits: int = 7) -> list[float | None]:
    """Plain numbers rounded to significant digits; what is not finite becomes None (null)."""
    a = np.asarray(values, float)
    finite = np.isfinite(a)
    size = np.abs(np.where(finite & (a != 0), a, 1.0))
    decade = 10.0 ** (digits - 1 - np.floor(np.log10(np.maximum(size, 1e-30))))
    rounded = np.where(finite, np.round(np.where(finite, a, 0.0) * decade) / decade, np.nan)
    if finite.all():
        return list(rounded.tolist())
    return [value if good else None for value, good in zip(rounded.tolist(), finite.tolist(), strict=True)]


def seconds(t_s: Array) -> list[float | None]:
    """Times as plain numbers, to the millisecond."""
    return numbers(np.round(t_s, 3), 12)


def thin(limit: int, *columns: Array) -> IntArray:
    """Rows to draw, at most about `limit`: first, last, and the extremes of every column (n,) in equal groups of rows."""
    n = len(columns[0])
    if n <= limit:
        return np.arange(n)
    size = -(-n * 2 * len(columns) // limit)
    groups = -(-n // size)
    start = np.arange(groups) * size
    keep = [np.array([0, n - 1])]
    for column in columns:
        padded = np.full(groups * size, np.nan)
        padded[:n] = column
        table, hollow = padded.reshape(groups, size), np.isnan(padded.reshape(groups, size))
        keep.append(start + np.argmin(np.where(hollow, np.inf, table), axis=1))
        keep.append(start + np.argmax(np.where(hollow, -np.inf, table), axis=1))
    return np.unique(np.concatenate(keep))


def sample(limit: int, rows: IntArray) -> IntArray:
    """At most `limit` of the rows, drawn evenly at random: a regular stride would meet the order of the satellites."""
    if len(rows) <= limit:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, limit, replace=False))


def thin_note(n: int, limit: int, what: str = "epochs") -> str:
    """What to tell the reader when a series of n rows is thinned."""
    return f"Drawn with at most {limit:,} of {n:,} {what} a curve; extremes are kept." if n > limit else ""


def stretches(t_s: Array, jump: BoolArray | None = None) -> IntArray:
    """Number (n,) of the unbroken stretch each row belongs to; rows where `jump` is true start a new one."""
    if len(t_s) < 2:
        return np.zeros(len(t_s), np.int64)
    step = np.diff(t_s)
    broken = step > GAP_STEPS * np.median(step)
    if jump is not None:
        broken = broken | jump[1:]
    return np.concatenate([[0], np.cumsum(broken)])


def line(t_s: Array, y: Array, stretch: IntArray, **options: Any) -> Trace:
    """A curve that breaks between stretches."""
    at = np.flatnonzero(np.diff(stretch)) + 1
    few = len(t_s) <= FEW_POINTS
    trace: Trace = {"type": "scatter", "mode": "lines+markers" if few else "lines"}
    if few:
        trace["marker"] = {"size": 5}
    return trace | {"x": seconds(np.insert(t_s, at, np.nan)), "y": numbers(np.insert(y, at, np.nan))} | options


def band(t_s: Array, lower: Array, upper: Array, stretch: IntArray, colour: str, **options: Any) -> Trace | None:
    """The area between two curves, one polygon a stretch; None when nothing of it is known."""
    known = np.isfinite(lower) & np.isfinite(upper)
    if np.count_nonzero(known) < 2:
        return None
    t_s, lower, upper = t_s[known], lower[known], upper[known]
    # a stretch also ends where the band is unknown
    part = np.cumsum(np.diff(stretch, prepend=stretch[0]) != 0)[known] * len(known) + np.cumsum(~known)[known]
    pieces = np.split(np.arange(len(part)), np.flatnonzero(np.diff(part)) + 1)
    x = [v for p in pieces for v in (t_s[p], t_s[p][::-1], t_s[p][:1], [np.nan])]
    y = [v for p in pieces for v in (upper[p], lower[p][::-1], upper[p][:1], [np.nan])]
    area: Trace = {"type": "scatter", "mode": "lines", "fill": "toself", "hoverinfo": "skip", "line": {"width": 0}}
    area |= {"fillcolor": translucent(colour, 0.22), "x": seconds(np.concatenate(x)), "y": numbers(np.concatenate(y))}
    return area | options


def with_band(
    name: str, unit: str, t_s: Array, y: Array, sigma: Array, colour: str, limit: int, jump: BoolArray | None = None
) -> list[Trace]:
    """A curve (n,) with its ±3σ band where sigma (n,) is known."""
    rows, stretch = thin(limit, y, sigma), stretches(t_s, jump)
    reach = BAND_SIGMAS * sigma[rows]
    area = band(
        t_s[rows], y[rows] - reach, y[rows] + reach, stretch[rows], colour, legendgroup="band", name="±3σ", legendrank=1200
    )
    curve = line(t_s[rows], y[rows], stretch[rows], name=name, line={"color": colour, "width": 1.4})
    curve["hovertemplate"] = f"%{{y:.4~f}} {unit}"
    if len(rows) == 1 and np.isfinite(reach[0]):
        curve["error_y"] = {"type": "data", "array": numbers(reach), "color": colour}
    return [curve] if area is None else [area, curve]


def truth_line(t_s: Array, y: Array, unit: str, limit: int, jump: BoolArray | None = None) -> Trace:
    """The true curve, dashed."""
    rows = thin(limit, y)
    style = {"color": TRUTH_COLOUR, "width": 1.4, "dash": "dash"}
    return line(t_s[rows], y[rows], stretches(t_s, jump)[rows], name="truth", line=style) | {
        "legendgroup": "truth",
        "legendrank": 1100,
        "hovertemplate": f"%{{y:.4~f}} {unit}",
    }


def legend_once(traces: Sequence[Trace]) -> list[Trace]:
    """The traces with one legend entry for each name."""
    seen: set[str] = set()
    listed = []
    for trace in traces:
        name = str(trace.get("name", ""))
        listed.append(trace | {"showlegend": bool(name) and name not in seen and trace.get("showlegend", True)})
        seen.add(name)
    return listed


def normalised(table: ResidualTable) -> Array:
    """Residuals divided by their assumed standard deviations (n,), NaN where those are not positive."""
    usable = table.sigma > 0
    return np.where(usable, table.residual / np.where(usable, table.sigma, 1.0), np.nan)
