"""Charts of where the vehicles were: tracks, baseline, relative velocity, attitude, biases, each with ±3σ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from factorgraph.attitude import euler_from_matrix, matrix_from_quat
from factorgraph.consistency import standard_deviations
from factorgraph.solution import ATT, BA, BG, POS, Fix, PairSolution, VehicleSolution
from factorgraph.types import Array, BoolArray
from scenarios.metrics import euler_sigma, pair_name
from scenarios.report.chart import (
    CLOUD_LIMIT,
    ENU,
    FIX_COLOURS,
    FIX_NAMES,
    Chart,
    Panel,
    log_axis,
    plane_chart,
    time_chart,
)
from scenarios.report.series import (
    ALERT_COLOUR,
    AXIS_COLOURS,
    CYCLE,
    TRUTH_COLOUR,
    Trace,
    line,
    numbers,
    plot_text,
    seconds,
    stretches,
    thin,
    thin_note,
    truth_line,
    with_band,
)


def relative_track(pair: PairSolution, limit: int) -> list[Chart]:
    """Plan and side view of the rover in the reference's east-north-up."""
    east, north, up = pair.baseline_enu.T
    distance, note = np.hypot(east, north), thin_note(len(pair.t_s), limit)
    truth = None if pair.truth_enu is None else pair.truth_enu.T
    plan = track(pair.t_s, east, north, limit) + _by_fix(pair, east, north, limit)
    side = track(pair.t_s, distance, up, limit) + _by_fix(pair, distance, up, limit)
    if truth is not None:
        plan.insert(1, track(pair.t_s, truth[0], truth[1], limit, "truth", TRUTH_COLOUR, dash="dash")[0])
        side.insert(1, track(pair.t_s, np.hypot(truth[0], truth[1]), truth[2], limit, "truth", TRUTH_COLOUR, dash="dash")[0])
    origin = points("reference", np.zeros(1), np.zeros(1), {"color": ALERT_COLOUR, "size": 11, "symbol": "cross"})
    charts = [
        plane_chart(f"{plot_text(pair_name(pair))}: plan", [*plan, origin], "east [m]", "north [m]", note),
        plane_chart(f"{plot_text(pair_name(pair))}: side", side, "horizontal distance [m]", "up [m]", note),
    ]
    # heights are small beside distances: their own scale shows them
    del charts[1].layout["yaxis"]["scaleanchor"], charts[1].layout["yaxis"]["scaleratio"]
    return charts


def vehicle_map(vehicles: Sequence[VehicleSolution], limit: int) -> list[Chart]:
    """East-north of every vehicle in the flight's local frame, and their heights over time."""
    plan: list[Trace] = []
    heights: list[Trace] = []
    for i, vehicle in enumerate(vehicles):
        colour, name = CYCLE[i % len(CYCLE)], plot_text(vehicle.name)
        east, north, up = vehicle.r_n.T
        if vehicle.is_fixed:
            marker = {"color": colour, "size": 12, "symbol": "triangle-up"}
            plan.append(points(f"{name} (base)", east[:1], north[:1], marker))
            continue
        plan += track(vehicle.t_s, east, north, limit, name, colour)
        plan.append(points("start", east[:1], north[:1], {"color": colour, "size": 9, "symbol": "circle-open"}))
        heights += with_band(name, "m", vehicle.t_s, up, standard_deviations(vehicle.P[:, POS, POS])[:, 2], colour, limit)
        if vehicle.truth is not None:
            r_true = vehicle.truth.r_n.T
            plan += track(vehicle.truth.t_s, r_true[0], r_true[1], limit, "truth", TRUTH_COLOUR, dash="dash")
            heights.append(truth_line(vehicle.truth.t_s, r_true[2], "m", limit))
    note = thin_note(max((len(v.t_s) for v in vehicles), default=0), limit)
    charts = [plane_chart("All vehicles in the local frame", plan, "east [m]", "north [m]", note)]
    if heights:
        chart = time_chart("Height above the origin of the local frame", [Panel("up [m]", heights)], note)
        charts.append(replace(chart, height_px=460, wide=False))
    return charts


def track(
    t_s: Array, x: Array, y: Array, limit: int, name: str = "track", colour: str = TRUTH_COLOUR, dash: str = "solid"
) -> list[Trace]:
    """A path in a plane (n,), broken at gaps in time; thinned."""
    rows = thin(limit, x, y)
    breaks = np.flatnonzero(np.diff(stretches(t_s)[rows])) + 1
    style = {"color": colour, "width": 1.4, "dash": dash}
    mode = "lines" if len(rows) > 1 else "markers"
    xs, ys = (numbers(np.insert(v[rows], breaks, np.nan)) for v in (x, y))
    hover = f"{name}<br>%{{x:.3f}} m, %{{y:.3f}} m<extra></extra>"
    return [{"type": "scatter", "mode": mode, "name": name, "x": xs, "y": ys, "line": style, "hovertemplate": hover}]


def points(name: str, x: Array, y: Array, marker: dict[str, Any]) -> Trace:
    """Single points in a plane."""
    hover = "%{x:.3f} m, %{y:.3f} m"
    return {"type": "scatter", "mode": "markers", "name": name, "x": numbers(x), "y": numbers(y), "marker": marker} | {
        "hovertemplate": hover + "<extra>%{fullData.name}</extra>"
    }


def _by_fix(pair: PairSolution, x: Array, y: Array, limit: int) -> list[Trace]:
    rows = thin(min(limit, CLOUD_LIMIT), x, y)
    found = []
    for status in Fix:
        mine = rows[pair.fix[rows] == status.value]
        if len(mine):
            trace = points(FIX_NAMES[status], x[mine], y[mine], {"color": FIX_COLOURS[status], "size": 5})
            trace["customdata"] = seconds(pair.t_s[mine])
            trace["hovertemplate"] = "%{x:.3f} m, %{y:.3f} m at %{customdata:.2f} s<extra>%{fullData.name}</extra>"
            found.append(trace)
    return found


def baseline(pair: PairSolution, limit: int) -> Chart:
    """East, north, up with ±3σ and truth, and 3σ itself."""
    panels = _enu_panels(pair.t_s, pair.baseline_enu, pair.P[:, :3, :3], pair.truth_enu, "m", limit)
    sigma = standard_deviations(pair.P[:, :3, :3])
    if np.isfinite(sigma).any():
        curves = []
        for axis, colour, column in zip(ENU, AXIS_COLOURS, 3 * sigma.T, strict=True):
            rows = thin(limit, column)
            style = {"color": colour, "width": 1.2}
            curve = line(pair.t_s[rows], column[rows], stretches(pair.t_s)[rows], name=axis, line=style)
            curves.append(curve | {"hovertemplate": "%{y:.2~g} m"})
        panels.append(Panel("3σ [m]", curves, log_axis(3 * sigma)))
    return time_chart(plot_text(pair_name(pair)), panels, thin_note(len(pair.t_s), limit))


def relative_velocity(pair: PairSolution, limit: int) -> Chart:
    panels = _enu_panels(pair.t_s, pair.velocity_enu, pair.P[:, 3:, 3:], pair.truth_velocity_enu, "m/s", limit)
    return time_chart(plot_text(pair_name(pair)), panels, thin_note(len(pair.t_s), limit))


def attitude(vehicle: VehicleSolution, limit: int) -> Chart:
    """Pitch, roll and heading in degrees with ±3σ and truth."""
    angles = _euler_deg(vehicle.q_nb)
    sigma = np.rad2deg(euler_sigma(vehicle.q_nb, vehicle.P[:, ATT, ATT]))
    truth = vehicle.truth if vehicle.truth is not None and vehicle.truth.q_nb is not None else None
    panels = []
    for i, name in enumerate(("pitch", "roll", "heading")):
        y, jump = angles[:, i], _wraps(angles[:, i])
        traces = with_band(name, "°", vehicle.t_s, y, sigma[:, i], AXIS_COLOURS[i], limit, jump)
        if truth is not None and truth.q_nb is not None:
            y_true = _euler_deg(truth.q_nb)[:, i]
            traces.append(truth_line(truth.t_s, y_true, "°", limit, _wraps(y_true)))
        panels.append(Panel(f"{name} [°]", traces))
    return time_chart(plot_text(vehicle.name), panels, thin_note(len(vehicle.t_s), limit))


def biases(vehicle: VehicleSolution, limit: int) -> list[Chart]:
    """Gyroscope and accelerometer biases with ±3σ, body axes right, front, up."""
    sets = (
        ("gyroscope", "°/s", np.rad2deg(vehicle.bias_gyro), np.rad2deg(1.0), BG),
        ("accelerometer", "m/s²", vehicle.bias_accel, 1.0, BA),
    )
    charts = []
    for sensor, unit, values, scale, block in sets:
        sigma = scale * standard_deviations(vehicle.P[:, block, block])
        panels = [
            Panel(f"{axis} [{unit}]", with_band(axis, unit, vehicle.t_s, values[:, i], sigma[:, i], AXIS_COLOURS[i], limit))
            for i, axis in enumerate(("right", "front", "up"))
        ]
        title = f"{plot_text(vehicle.name)}: {sensor}"
        chart = time_chart(title, panels, thin_note(len(vehicle.t_s), limit))
        charts.append(replace(chart, wide=False))
    return charts


def _enu_panels(t_s: Array, y: Array, P: Array, truth: Array | None, unit: str, limit: int) -> list[Panel]:
    sigma = standard_deviations(P)
    panels = []
    for i, axis in enumerate(ENU):
        traces = with_band(axis, unit, t_s, y[:, i], sigma[:, i], AXIS_COLOURS[i], limit)
        if truth is not None and np.isfinite(truth[:, i]).any():
            traces.append(truth_line(t_s, truth[:, i], unit, limit))
        panels.append(Panel(f"{axis} [{unit}]", traces))
    return panels


def _euler_deg(q_nb: Array) -> Array:
    pitch, roll, heading = euler_from_matrix(matrix_from_quat(q_nb))
    angles: Array = np.rad2deg(np.column_stack([pitch, roll, np.mod(heading, 2 * np.pi)]))
    return angles


def _wraps(angle_deg: Array) -> BoolArray:
    wrapped: BoolArray = np.abs(np.diff(angle_deg, prepend=angle_deg[:1])) > 180
    return wrapped
