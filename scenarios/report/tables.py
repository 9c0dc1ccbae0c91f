"""Tables and texts of the report as HTML; everything that comes from input is escaped here."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Sequence

import numpy as np

from factorgraph.models.outliers import GROSS, class_counts
from factorgraph.models.outliers import outlier_runs as runs_of
from factorgraph.solution import AmbiguityTable, ParameterEstimate, ResidualTable, Solution
from scenarios.metrics import ErrorSeries, SummaryRow, statistics, summary_rows
from scenarios.report.chart import UNITS
from scenarios.report.series import normalised
from scenarios.studies.document import Table

ROW_LIMIT = 400
OUTLIER_LIMIT = 200
RUN_LIMIT = 100


def text(value: object) -> str:
    """Any value as escaped HTML text."""
    return html.escape(str(value))


def number(value: float, digits: int = 4) -> str:
    """A number to significant digits, or a dash where it is unknown."""
    return f"{value:.{digits}g}" if np.isfinite(value) else "–"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], n_text: int = 1) -> str:
    """A scrollable table of plain texts; columns after the first `n_text` are aligned right."""
    header = "".join(f"<th{_align(i, n_text)}>{text(name)}</th>" for i, name in enumerate(head))
    body = "".join(
        "<tr>" + "".join(f"<td{_align(i, n_text)}>{text(c)}</td>" for i, c in enumerate(row)) + "</tr>" for row in rows
    )
    return f'<div class="table" tabindex="0"><table><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table></div>'


def document_table(found: Table) -> str:
    """A table of a study with its note."""
    return table(found.head, found.rows, found.n_text) + (paragraph(found.note) if found.note else "")


def paragraph(words: str) -> str:
    return f'<p class="note">{text(words)}</p>'


def folded(title: str, inner: str) -> str:
    """A part that opens on demand; `inner` is HTML already."""
    return f"<details><summary>{text(title)}</summary>{inner}</details>"


def summary(solution: Solution, errors: Sequence[ErrorSeries]) -> str:
    """The summary rows, one block for each subject."""
    blocks: dict[str, list[SummaryRow]] = {}
    for row in summary_rows(solution, errors):
        blocks.setdefault(row.subject, []).append(row)
    parts = []
    for subject, rows in blocks.items():
        lines = "".join(f"<dt>{text(row.quantity)}</dt><dd>{text(row.text)}</dd>" for row in rows)
        parts.append(f'<div class="block"><h3>{text(subject)}</h3><dl>{lines}</dl></div>')
    note = paragraph("Errors and σ are norms of the three components; bands hold 95 %.")
    return f'<div class="blocks">{"".join(parts)}</div>{note}'


def error_statistics(found: Sequence[ErrorSeries]) -> str:
    """Norms of the errors against truth."""
    rows = []
    for series in found:
        scale, unit = series.display
        stats = statistics(scale * series.error)
        values = [number(v, 3) for v in (stats.rmse, stats.median, stats.p68, stats.p95, stats.maximum)]
        inside = number(100 * series.nees.share_inside, 3)
        rows.append([series.subject, f"{series.quantity} [{unit}]", f"{stats.n:,}", *values, inside])
    head = ("subject", "error, 3D norm", "epochs", "RMS", "median", "68 %", "95 %", "largest", "NEES in band [%]")
    return table(head, rows, 2)


def ambiguities(found: AmbiguityTable) -> str:
    """Arcs with their float and integer values."""
    n = len(found.link)
    head = ("link", "satellite", "signal", "state", "from [s]", "to [s]", "float [cyc]", "σ [cyc]", "integer")
    rows = (
        [
            found.link[i],
            found.satellite[i],
            found.signal[i],
            found.state[i],
            f"{found.t_start_s[i]:.1f}",
            f"{found.t_end_s[i]:.1f}",
            f"{found.float_cyc[i]:.3f}" if np.isfinite(found.float_cyc[i]) else "–",
            number(found.sigma_cyc[i], 2),
            f"{found.integer[i]:.0f}" if np.isfinite(found.integer[i]) else "–",
        ]
        for i in range(min(n, ROW_LIMIT))
    )
    counts = ", ".join(f"{found.state.count(state):,} {state}" for state in dict.fromkeys(found.state))
    note = f"{n:,} arcs: {counts}." + (f" The first {ROW_LIMIT} are listed." if n > ROW_LIMIT else "")
    return paragraph(note) + table(head, rows, 4)


def outliers(found: ResidualTable) -> str:
    """The largest outliers by |residual / sigma|, or a line that says there are none."""
    flagged = np.flatnonzero(found.outlier)
    if not len(flagged):
        return paragraph(f"None of {len(found.t_s):,} residuals is marked as an outlier.")
    scaled = normalised(found)
    order = flagged[np.argsort(-np.nan_to_num(np.abs(scaled[flagged])), kind="stable")][:OUTLIER_LIMIT]
    head = ("kind", "source", "label", "t [s]", "residual", "unit", "σ", "residual / σ", "weight")
    rows = []
    for i in order:
        kind = found.kind[found.kind_index[i]]
        names = [kind, found.source[found.source_index[i]], found.label[found.label_index[i]]]
        values = [f"{found.t_s[i]:.2f}", number(found.residual[i]), UNITS.get(kind, "SI"), number(found.sigma[i], 3)]
        rows.append([*names, *values, number(scaled[i], 3), number(found.weight[i], 2)])
    shown = f"The largest {OUTLIER_LIMIT} of {len(flagged):,}" if len(flagged) > OUTLIER_LIMIT else f"All {len(flagged):,}"
    singles = paragraph(f"{shown} outliers among {len(found.t_s):,} residuals.") + table(head, rows, 3)
    return outlier_runs(found) + folded("Show the outliers one by one", singles)


def outlier_runs(found: ResidualTable) -> str:
    """Outliers that belong together, the largest effects first."""
    runs = runs_of(found)
    rows = []
    for run in runs[:RUN_LIMIT]:
        unit = UNITS.get(run.kind, "SI")
        sign = "" if run.outlier_class == GROSS else "+"
        span = [f"{run.start_s:.1f}", f"{run.end_s:.1f}", f"{run.n:,}"]
        rows.append([run.kind, run.source, run.label, run.words, *span, f"{run.mean:{sign}.3g}", number(run.largest, 3), unit])
    head = ("kind", "source", "label", "looks like", "from [s]", "to [s]", "rows", "mean", "largest", "unit")
    counts = ", ".join(f"{n:,} {words}" for words, n in class_counts(found).items())
    more = f" The {RUN_LIMIT} with the largest effect of {len(runs):,} runs." if len(runs) > RUN_LIMIT else ""
    note = "Gross errors are single rows; of them the mean size. In differences a negative sign means the reference's."
    return paragraph(f"By what they look like: {counts}.{more} {note}") + table(head, rows, 4)


def parameters(found: Sequence[ParameterEstimate]) -> str:
    """Estimated constants with their standard deviations beside their priors."""
    rows = [
        [p.name, number(p.value, 6), number(p.sigma, 3), number(p.prior, 6), number(p.prior_sigma, 3), p.unit, _told(p)]
        for p in found
    ]
    return table(("parameter", "estimate", "σ", "prior", "prior σ", "unit", "observed"), rows)


def _told(p: ParameterEstimate) -> str:
    return "yes" if p.is_told else "no: the data hardly tell it"


def configuration(solution: Solution) -> str:
    """The configuration as collapsible JSON."""
    body = json.dumps(solution.configuration, indent=2, ensure_ascii=False, default=str)
    return folded("Show the configuration", f'<pre tabindex="0">{text(body)}</pre>')


def timings(runtime_s: dict[str, float]) -> str:
    return table(("stage", "runtime [s]"), [[name, f"{value:.3f}"] for name, value in runtime_s.items()])


def versions(found: dict[str, str]) -> str:
    return table(("software", "version"), list(found.items()), 2)


def _align(column: int, n_text: int) -> str:
    return "" if column < n_text else ' class="num"'
