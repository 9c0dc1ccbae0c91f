"""The report of a solution: what its page says, section by section. `frame` turns it into HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np

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
from scenarios.report.frame import Card, Page, Section, render_page, write_page
from scenarios.report.tables import number, text

POINT_LIMIT = 2000  # rows drawn a curve
POINT_BUDGET = 12_000  # rows drawn in all curves of one section; many pairs share it
MIN_POINTS = 300


def write_report(solution: Solution, path: Path) -> Path:
    """Write the report of a solution as one self-contained HTML page; folders are made. Returns the path."""
    return write_page(solution_page(solution), path)


def render(solution: Solution) -> str:
    """The page as text."""
    return render_page(solution_page(solution))


def solution_page(solution: Solution) -> Page:
    """What the report says of a solution."""
    errors = solution_errors(solution)
    about = f"{_count(len(solution.vehicles), 'vehicle')}, {_count(len(solution.pairs), 'pair')}"
    return Page(
        title=f"{solution.name} – relative navigation report",
        heading=solution.name,
        sections=sections(solution, errors),
        cards=_cards(solution, errors),
        badge="degraded" if solution.is_degraded else "done",
        badge_is_good=not solution.is_degraded,
        lines=(text(_span(solution)), f"Method <b>{text(solution.method)}</b>, {about}"),
        reasons=_reasons(solution),
        maker=" ".join(["relnav", solution.versions.get("relnav", "")]).strip(),
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
    timeline = quality.outlier_timeline(table, POINT_LIMIT // 2)
    arcs = tables.ambiguities(solution.ambiguities) if solution.ambiguities.link else ""
    constants = tables.parameters(diagnostics.parameters) if diagnostics.parameters else ""
    about = f'<div class="pair">{tables.timings(diagnostics.runtime_s)}{tables.versions(solution.versions)}</div>'
    return [
        Section("ambiguities", "Ambiguities", "Ambiguities", html=arcs, absent="No ambiguities were estimated."),
        Section(
            "outliers",
            "Outliers",
            "Outliers",
            [timeline] if timeline else [],
            tables.outliers(table) if len(table.t_s) else "",
        ),
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


def _reasons(solution: Solution) -> list[str]:
    reasons = list(solution.diagnostics.warnings)
    if solution.diagnostics.status is not Status.CONVERGED:
        reasons.insert(0, f"The optimisation stopped early: {solution.diagnostics.status.value}.")
    return reasons


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


def _cards(solution: Solution, errors: Sequence[ErrorSeries]) -> list[Card]:
    """Key figures."""
    table, diagnostics = solution.residuals, solution.diagnostics
    runtime_s = total_runtime_s(diagnostics.runtime_s)
    epochs = max((len(t_s) for t_s in _times(solution)), default=0)
    cards = [*_pair_cards(solution, errors), Card("Epochs", f"{epochs:,}", _rate(solution))]
    if len(table.t_s):
        share = f"{100 * np.mean(table.outlier):.2f} % of {len(table.t_s):,} residuals"
        cards.append(Card("Outliers", f"{int(np.sum(table.outlier)):,}", share))
    if np.isfinite(diagnostics.nis).any():
        inside = judge(diagnostics.nis_t_s, diagnostics.nis, diagnostics.nis_dof).share_inside
        cards.append(Card("NIS in 95 % band", f"{100 * inside:.1f} %", "of epochs"))
    detail = f"{diagnostics.n_iterations} iterations, {diagnostics.status.value}"
    return [*cards, Card("Runtime", f"{runtime_s:.1f} s" if np.isfinite(runtime_s) else "–", detail)]


def _pair_cards(solution: Solution, errors: Sequence[ErrorSeries]) -> list[Card]:
    pairs = [pair for pair in solution.pairs if len(pair.t_s)]
    if not pairs:
        return []
    cards = []
    fix = np.concatenate([pair.fix for pair in pairs])
    if np.any(fix != Fix.NONE.value):
        partial = f"and {fix_percentage(fix, Fix.PARTIAL):.1f} % partly"
        cards.append(Card("Integers fixed", f"{fix_percentage(fix, Fix.FIXED):.1f} %", partial))
    sigma = np.concatenate([standard_deviations(pair.P[:, :3, :3]) for pair in pairs])
    cards.append(Card("Baseline σ", _metres(statistics(sigma).median), "median, 3D"))
    by_name = {pair_name(pair): pair for pair in pairs}
    known = [(series, by_name[series.subject]) for series in errors if series.quantity == "baseline"]
    if known:
        error = np.concatenate([series.error for series, _ in known])
        fixed = np.concatenate([series.error[pair.fix == Fix.FIXED.value] for series, pair in known])
        detail = f"{_metres(statistics(fixed).rmse)} where fixed" if len(fixed) else "against truth, 3D"
        cards.append(Card("Baseline RMS error", _metres(statistics(error).rmse), detail))
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
