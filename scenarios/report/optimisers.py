"""The page of the comparison of optimisers: verdicts, ranks with critical differences, success, convergence, tables.

Methods keep their colour on the whole page and are shown and hidden together (`comparison.js`); the band of one of them is
drawn, from the lower to the upper quartile over the seeds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph.types import Array
from scenarios.metrics_ranks import Ranking, cliques
from scenarios.report.chart import Chart, log_axis
from scenarios.report.frame import Card, Page, Section, write_page
from scenarios.report.series import CYCLE, TRUTH_COLOUR, Trace, band, line, numbers, plot_text
from scenarios.report.tables import document_table, table, text
from scenarios.studies.document import Table
from scenarios.studies.optimisers import KINDS, grid
from scenarios.studies.optimisers_record import (
    HOW,
    contrast_table,
    error_table,
    parameters,
    rank_table,
    sentences,
    solved_table,
    speed_table,
    success_table,
    time_table,
    verdict_table,
)
from scenarios.studies.optimisers_summary import SUBJECT, Problem, Summary
from scenarios.studies.verdicts import seed_count

EVALS_TITLE = "evaluations"
HALF_PX = 330
HIDDEN_AXIS = {"visible": False, "fixedrange": True}


def write_study(summary: Summary, path: Path, command: str = "relnav study optimisers") -> Path:
    """Write the page of the study as one self-contained HTML file. Returns the path."""
    return write_page(study_page(summary, command), path)


def study_page(summary: Summary, command: str) -> Page:
    """What the page says."""
    few = not summary.can_be_significant
    reason = f"{summary.n_seeds} seeds are too few for any verdict to be significant."
    return Page(
        title="Optimisers compared – relnav study",
        heading="Optimisers compared",
        sections=[
            _verdict_section(summary),
            _rank_section(summary),
            _success_section(summary),
            *(_convergence_section(summary, kind) for kind in ("unimodal", "multimodal")),
            _origin_section(summary),
            *(_convergence_section(summary, kind) for kind in ("normalised", "whitened", "raw")),
            _table_section(summary),
        ],
        cards=_cards(summary),
        badge=seed_count(summary.n_seeds),
        badge_is_good=not few,
        lines=(text(HOW), f"Made by <code>{text(command)}</code>"),
        reasons=[reason] if few else [],
        controls=_controls(summary.methods),
        script="comparison.js",
    )


def _cards(summary: Summary) -> list[Card]:
    """The best mean rank of every kind."""
    cards = []
    for kind, found in summary.rankings.items():
        best = int(np.argmin(found.mean_ranks))
        alike = next((group for group in cliques(found) if group[0] == best), [best])[1:]
        detail = f"mean rank {found.mean_ranks[best]:.2f}"
        detail += f"; not told apart from {', '.join(summary.methods[i] for i in alike)}" if alike else "; before all others"
        cards.append(Card(KINDS[kind].title, summary.methods[best], detail))
    return cards


def _controls(methods: Sequence[str]) -> str:
    """Buttons that show and hide methods, and the choice of the one with a band."""
    first = _banded(methods)
    buttons = "".join(
        f'<button type="button" data-method="{text(m)}" aria-pressed="true"><i style="background:{colour}"></i>{text(m)}</button>'
        for m, colour in _colours(methods).items()
    )
    options = "".join(f'<option value="{text(m)}"{" selected" if m == first else ""}>{text(m)}</option>' for m in methods)
    return f'<div class="methods">{buttons}<label>quartiles of <select autocomplete="off">{options}</select></label></div>'


def _colours(methods: Sequence[str]) -> dict[str, str]:
    return {m: CYCLE[i % len(CYCLE)] for i, m in enumerate(methods)}


def _banded(methods: Sequence[str]) -> str:
    return SUBJECT if SUBJECT in methods else methods[0]


# sections


def _titled(found: Table) -> str:
    return f"<h3>{text(found.title)}</h3>{document_table(found)}" if found.rows else ""


def _verdict_section(summary: Summary) -> Section:
    found = verdict_table(summary)
    html = ""
    if found.rows:
        listed = "".join(f"<li>{text(sentence)}</li>" for sentence in sentences(summary))
        html = f"<ul>{listed}</ul>{document_table(found)}{_titled(speed_table(summary))}"
    return Section("verdicts", found.title, "Verdicts", html=html, absent=f"{SUBJECT} was not run beside another method.")


def _rank_section(summary: Summary) -> Section:
    charts = [rank_chart(KINDS[kind].title, found, summary.methods) for kind, found in summary.rankings.items()]
    html = document_table(rank_table(summary)) if charts else ""
    lead = "Methods joined by a bar cannot be told apart; the ruler is the critical difference. The best stands on the left."
    return Section("ranks", "Mean ranks", "Ranks", charts, html, "There is nothing to rank with a single method.", lead)


def _success_section(summary: Summary) -> Section:
    charts = [_success_chart(summary, kind) for kind in summary.kinds]
    lead = "Share of runs that are solved after so many evaluations."
    return Section("success", "Success", "Success", charts, document_table(success_table(summary)), lead=lead)


def _convergence_section(summary: Summary, kind: str) -> Section:
    about = KINDS[kind]
    charts = [_convergence_chart(p) for p in summary.of(kind)]
    lead = f"{about.about[0].upper()}{about.about[1:]}. Medians over the seeds, and the quartiles of one method."
    title = f"Convergence: {about.title}"
    return Section(kind, title, about.title.capitalize(), charts, absent="These problems were not run.", lead=lead, open_charts=6)


def _origin_section(summary: Summary) -> Section:
    at_origin, moved = ({p.name: p for p in summary.of(kind)} for kind in ("origin", "moved"))
    charts = [_contrast_chart(at_origin[name], moved[name]) for name in at_origin if name in moved]
    lead = (
        "Full: the optimum lies at the origin of the coordinates. Dashed: function and box moved away together, so that nothing "
        "but the coordinates' origin has changed."
    )
    html = document_table(contrast_table(summary)) if summary.contrasts else ""
    return Section("origin", "Does the place of the origin matter?", "Origin", charts, html, "Not run.", lead, open_charts=6)


def _table_section(summary: Summary) -> Section:
    found = [*(f(summary, kind) for kind in summary.kinds for f in (error_table, solved_table)), time_table(summary)]
    about = table(("parameter", "value"), list(parameters(summary).items()), 2)
    return Section("tables", "Tables", "Tables", html="".join(map(_titled, found)) + f"<h3>Parameters</h3>{about}")


# charts


def _curves_layout(x: Array, values: Array, y_title: str) -> dict[str, Any]:
    return {
        "hovermode": "x unified",
        "xaxis": {"title": {"text": EVALS_TITLE}, "hoverformat": ",d"} | log_axis(x),
        "yaxis": {"title": {"text": y_title}, "exponentformat": "power"} | log_axis(values),
    }


def _curve(method: str, x: Array, y: Array, colour: str, dash: str = "solid") -> Trace:
    style = {"color": colour, "width": 1.6, "dash": dash}
    curve = line(x, y, np.zeros(len(x), np.int64), name=plot_text(method), mode="lines", line=style)
    return curve | {"meta": {"method": method}, "legendgroup": method, "hovertemplate": "%{y:.2~e}"}


def _convergence_chart(problem: Problem) -> Chart:
    """Median error of every method against evaluations, and the quartiles of one."""
    x = grid(problem.max_evals)
    lower, median, upper = problem.curves
    bands, curves = [], []
    for i, (method, colour) in enumerate(_colours(problem.methods).items()):
        area = band(x, lower[i], upper[i], np.zeros(len(x), np.int64), colour, name=f"quartiles of {plot_text(method)}")
        if area is not None:
            shown = {"meta": {"method": method, "band": True}, "visible": method == _banded(problem.methods)}
            bands.append(area | shown | {"showlegend": False})
        curves.append(_curve(method, x, median[i], colour))
    layout = _curves_layout(x, problem.curves, "error")
    return Chart(plot_text(problem.name), [*bands, *curves], layout, HALF_PX, wide=False)


def _contrast_chart(first: Problem, second: Problem) -> Chart:
    """Median error of every method on a problem put in two ways."""
    x = grid(first.max_evals)
    data = []
    for i, (method, colour) in enumerate(_colours(first.methods).items()):
        data.append(_curve(method, x, first.curves[1, i], colour))
        data.append(_curve(method, x, second.curves[1, i], colour, "dash") | {"showlegend": False})
    layout = _curves_layout(x, np.stack([first.curves[1], second.curves[1]]), "median error") | {"hovermode": "closest"}
    return Chart(plot_text(first.name), data, layout, HALF_PX, wide=False)


def _success_chart(summary: Summary, kind: str) -> Chart:
    """Share of solved runs over all problems of a kind against evaluations."""
    x = grid(summary.max_evals)
    data = []
    for i, (method, colour) in enumerate(_colours(summary.methods).items()):
        hit = np.concatenate([p.hit[i] for p in summary.of(kind)])
        share = 100 * np.mean(hit[:, None] <= x, axis=0)
        data.append(_curve(method, x, share, colour) | {"hovertemplate": "%{y:.0f} %"})
    layout = _curves_layout(x, x, "solved [%]")
    layout["yaxis"] = {"title": {"text": "solved [%]"}, "range": [-3, 103]}
    return Chart(f"{KINDS[kind].title}, error below {summary.of(kind)[0].solved:g}", data, layout, HALF_PX, wide=False)


def rank_chart(title: str, found: Ranking, methods: Sequence[str]) -> Chart:
    """Mean ranks on a line, groups that cannot be told apart joined by bars, and the critical difference as a ruler.

    Source: Demšar (2006), sec. 3.2.4, for the drawing.
    """
    k, groups = len(methods), cliques(found)
    floor = -0.5 * (len(groups) + 1)  # below the bars
    colours: Mapping[str, str] = _colours(methods)
    data = [
        _rule(np.array([1.0, k]), 0.0),
        _scale(k),
        _rule(np.array([1.0, 1.0 + found.critical_difference]), 1.9, "critical difference"),
    ]
    for j, group in enumerate(groups):
        ends = found.mean_ranks[[group[0], group[-1]]] + np.array([-0.04, 0.04])
        data.append(_rule(ends, -0.5 * (j + 1)) | {"line": {"color": TRUTH_COLOUR, "width": 5}})
    order = np.argsort(found.mean_ranks, kind="stable")
    n_left = (k + 1) // 2
    for place, i in enumerate(order):
        left = place < n_left
        depth = floor - 0.8 * ((place if left else k - 1 - place) + 0.5)
        rank, edge = float(found.mean_ranks[i]), 0.8 if left else k + 0.2
        words = f"{plot_text(methods[i])} {rank:.2f}"
        data.append({
            "type": "scatter", "mode": "lines+text", "hoverinfo": "skip", "showlegend": False,
            "x": numbers(np.array([rank, rank, edge])), "y": numbers(np.array([0.0, depth, depth])),
            "text": ["", "", words], "textposition": f"middle {'left' if left else 'right'}",
            "line": {"color": colours[methods[i]], "width": 1.6},
        })  # fmt: skip
    lowest = floor - 0.8 * (n_left + 0.2)
    layout = {
        "hovermode": False,
        "dragmode": False,
        "xaxis": HIDDEN_AXIS | {"range": [-0.5 * k, 1 + 1.5 * k]},
        "yaxis": HIDDEN_AXIS | {"range": [lowest, 3.0]},
    }
    return Chart(title, data, layout, 60 + round(26 * (3.0 - lowest)), f"{found.n_blocks} problems ranked.", wide=False)


def _rule(x: Array, y: float, words: str = "") -> Trace:
    """A horizontal line with words above its middle."""
    middle = float(np.mean(x))
    return {
        "type": "scatter",
        "mode": "lines+text",
        "x": numbers(np.array([x[0], middle, x[1]])),
        "y": [y, y, y],
        "text": ["", words, ""],
        "textposition": "top center",
        "line": {"color": TRUTH_COLOUR, "width": 1.4},
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _scale(k: int) -> Trace:
    """The numbers of the ranks."""
    marker = {"symbol": "line-ns-open", "size": 8, "color": TRUTH_COLOUR}
    places = {"x": list(range(1, k + 1)), "y": [0] * k, "text": [str(i) for i in range(1, k + 1)], "textposition": "top center"}
    return {"type": "scatter", "mode": "markers+text", "marker": marker, "hoverinfo": "skip", "showlegend": False} | places
