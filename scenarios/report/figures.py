"""Figures for papers: PNG files drawn by matplotlib. Each function takes data and Axes and returns the Axes."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import norm

from factorgraph.attitude import euler_from_matrix, matrix_from_quat
from factorgraph.consistency import standard_deviations
from factorgraph.solution import ATT, Fix, PairSolution, ResidualTable, Solution, VehicleSolution
from factorgraph.types import Array
from scenarios.metrics import ErrorSeries, cdf, euler_sigma, pair_name, solution_errors
from scenarios.report.chart import ENU, FIX_COLOURS, FIX_NAMES, TIME_TITLE
from scenarios.report.series import ALERT_COLOUR, AXIS_COLOURS, BAND_SIGMAS, CYCLE, TRUTH_COLOUR, normalised

DPI = 160
WIDTH_IN = 7.0
ROW_IN = 1.7


def write_figures(solution: Solution, folder: Path) -> list[Path]:
    """Write the figures the solution has data for as PNG files; the folder is made. Returns their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for pair in solution.pairs:
        if len(pair.t_s):
            written += _pair_figures(pair, folder)
    for vehicle in solution.vehicles:
        if not vehicle.is_fixed and np.isfinite(vehicle.q_nb).all(axis=1).any():
            written.append(_stacked(folder / f"attitude-{_slug(vehicle.name)}.png", vehicle.name, _attitude_rows(vehicle)))
    for series in solution_errors(solution):
        name = f"error-{_slug(series.quantity)}-{_slug(series.subject)}.png"
        title = f"{series.subject}: {series.quantity} error"
        written.append(_stacked(folder / name, title, _error_rows(series)))
        written.append(_single(folder / f"cdf-{name.removeprefix('error-')}", partial(error_cdf, series)))
    if len(solution.residuals.t_s):
        written.append(_single(folder / "residuals.png", lambda ax: residual_histogram(solution.residuals, ax)))
    return written


def with_band(t_s: Array, y: Array, sigma: Array, label: str, colour: str, ax: Axes, truth: Array | None = None) -> Axes:
    """A curve (n,) with ±3σ and, where known, truth (n,); `label` is quantity and unit."""
    reach = BAND_SIGMAS * sigma
    ax.fill_between(t_s, y - reach, y + reach, color=colour, alpha=0.22, linewidth=0, label="±3σ")
    ax.plot(t_s, y, color=colour, linewidth=1.0, marker="." if len(t_s) == 1 else "", label="estimate")
    if truth is not None:
        ax.plot(t_s, truth, color=TRUTH_COLOUR, linewidth=1.0, linestyle="--", label="truth")
    ax.set_ylabel(label)
    return ax


def plan(pair: PairSolution, ax: Axes) -> Axes:
    """Rover in the reference's east-north, coloured by fix status, same scale on both axes."""
    ax.plot(pair.baseline_enu[:, 0], pair.baseline_enu[:, 1], color=TRUTH_COLOUR, linewidth=0.8)
    for status in Fix:
        mine = pair.baseline_enu[pair.fix == status.value]
        if len(mine):
            ax.plot(mine[:, 0], mine[:, 1], ".", color=FIX_COLOURS[status], markersize=3, label=FIX_NAMES[status])
    ax.plot(0.0, 0.0, "+", color=ALERT_COLOUR, markersize=10, label="reference")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("east [m]")
    ax.set_ylabel("north [m]")
    ax.set_title(pair_name(pair))
    ax.legend()
    return ax


def errors(series: ErrorSeries, axis: int, ax: Axes) -> Axes:
    """One component of an error with ±3σ around zero."""
    scale, unit = series.display
    reach = BAND_SIGMAS * scale * series.sigma[:, axis]
    ax.fill_between(series.t_s, -reach, reach, color=TRUTH_COLOUR, alpha=0.22, linewidth=0, label="±3σ")
    ax.plot(series.t_s, scale * series.error[:, axis], color=AXIS_COLOURS[axis], linewidth=0.9, label="error")
    ax.set_ylabel(f"{series.axes[axis]} [{unit}]")
    return ax


def error_cdf(series: ErrorSeries, ax: Axes) -> Axes:
    """Share of epochs with an error norm below each size."""
    scale, unit = series.display
    size, share = cdf(scale * series.error)
    ax.step(size, 100 * share, where="post", color=AXIS_COLOURS[0])
    if len(size) and size[-1] > 0:
        ax.set_xscale("log")
    ax.set_xlabel(f"{series.quantity} error, 3D [{unit}]")
    ax.set_ylabel("epochs below [%]")
    ax.set_title(series.subject)
    return ax


def residual_histogram(table: ResidualTable, ax: Axes) -> Axes:
    """Normalised residuals of each kind against the standard normal density; the end bins hold the rest."""
    scaled, edges = normalised(table), np.linspace(-6, 6, 61)
    for k, kind in enumerate(table.kind):
        mine = scaled[(table.kind_index == k) & np.isfinite(scaled)]
        if len(mine):
            ax.hist(np.clip(mine, -6, 6), edges.tolist(), density=True, histtype="step", color=CYCLE[k % len(CYCLE)], label=kind)
    ax.plot(edges, norm.pdf(edges), "--", color=TRUTH_COLOUR, label="N(0, 1)")
    ax.set_xlabel("residual / σ")
    ax.set_ylabel("density")
    ax.legend()
    return ax


def _pair_figures(pair: PairSolution, folder: Path) -> list[Path]:
    slug, title = _slug(pair_name(pair)), pair_name(pair)
    position, velocity = pair.P[:, :3, :3], pair.P[:, 3:, 3:]
    baseline = _enu_rows(pair.t_s, pair.baseline_enu, position, "m", pair.truth_enu)
    speed = _enu_rows(pair.t_s, pair.velocity_enu, velocity, "m/s", pair.truth_velocity_enu)
    return [
        _single(folder / f"track-{slug}.png", lambda ax: plan(pair, ax)),
        _stacked(folder / f"baseline-{slug}.png", f"{title}: baseline", baseline),
        _stacked(folder / f"velocity-{slug}.png", f"{title}: relative velocity", speed),
    ]


Row = Callable[[Axes], Axes]


def _enu_rows(t_s: Array, y: Array, P: Array, unit: str, truth: Array | None) -> list[Row]:
    sigma = standard_deviations(P)

    def row(i: int) -> Row:
        true = None if truth is None else truth[:, i]
        return lambda ax: with_band(t_s, y[:, i], sigma[:, i], f"{ENU[i]} [{unit}]", AXIS_COLOURS[i], ax, true)

    return [row(i) for i in range(3)]


def _attitude_rows(vehicle: VehicleSolution) -> list[Row]:
    pitch, roll, heading = euler_from_matrix(matrix_from_quat(vehicle.q_nb))
    known = np.isfinite(heading)
    heading[known] = np.unwrap(heading[known])
    angles = np.rad2deg(np.column_stack([pitch, roll, heading]))
    sigma = np.rad2deg(euler_sigma(vehicle.q_nb, vehicle.P[:, ATT, ATT]))

    def row(i: int, name: str) -> Row:
        return lambda ax: with_band(vehicle.t_s, angles[:, i], sigma[:, i], f"{name} [°]", AXIS_COLOURS[i], ax)

    return [row(i, name) for i, name in enumerate(("pitch", "roll", "heading"))]


def _error_rows(series: ErrorSeries) -> list[Row]:
    return [partial(errors, series, i) for i in range(3)]


def _stacked(path: Path, title: str, rows: Sequence[Row]) -> Path:
    figure = Figure(figsize=(WIDTH_IN, ROW_IN * len(rows) + 0.8), layout="constrained")
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    for draw, ax in zip(rows, axes, strict=True):
        draw(ax).grid(alpha=0.3)
    axes[0].set_title(title, loc="left", fontsize="medium")
    # above the curves, beside the title
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, fontsize="small", frameon=False)
    axes[-1].set_xlabel(TIME_TITLE)
    return _save(figure, path)


def _single(path: Path, draw: Row) -> Path:
    figure = Figure(figsize=(WIDTH_IN, 4.6), layout="constrained")
    draw(figure.subplots()).grid(alpha=0.3)
    return _save(figure, path)


def _save(figure: Figure, path: Path) -> Path:
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=DPI)
    return path


def _slug(name: str) -> str:
    """A name as part of a file name."""
    return re.sub(r"[^\w.]+", "-", name).strip("-.") or "unnamed"
