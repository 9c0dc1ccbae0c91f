"""How good a solution is: errors against truth, their statistics, consistency, and the summary rows.

Errors are estimate - truth; the attitude error phi obeys C_est = (I - [phi x]) C_true (`factorgraph.solution`).
The mathematics of consistency is in `factorgraph.consistency`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from factorgraph.attitude import log_so3, matrix_from_quat
from factorgraph.consistency import Consistency, judge, nees, standard_deviations
from factorgraph.measurements import Truth
from factorgraph.models.outliers import class_counts
from factorgraph.solution import ATT, POS, VEL, Fix, PairSolution, Solution, VehicleSolution
from factorgraph.types import Array, BoolArray, IntArray

MAX_GAP_STEPS = 2.5  # truth inside a longer gap of the solution, in median steps, is not compared


@dataclass(frozen=True)  # no slots: the cached statistic needs a place
class ErrorSeries:
    """Errors of one three-component quantity with the covariance the estimator claims."""

    subject: str  # vehicle, or pair by `pair_name`
    quantity: str  # "baseline", "relative velocity"; "position", "velocity", "attitude"
    unit: str  # "m", "m/s" or "rad"
    axes: tuple[str, str, str]
    t_s: Array  # (n,)
    error: Array  # (n, 3) NaN where truth or estimate is unknown
    P: Array  # (n, 3, 3) NaN where not estimated

    @property
    def sigma(self) -> Array:
        """Claimed standard deviations (n, 3)."""
        return standard_deviations(self.P)

    @cached_property
    def nees(self) -> Consistency:
        """Normalised estimation error squared per epoch with its two-sided 95 % band."""
        value = nees(self.error, self.P)
        return judge(self.t_s, value, np.full(len(value), float(self.error.shape[1])))

    @property
    def display(self) -> tuple[float, str]:
        """Factor and unit for people: degrees for radians."""
        return (float(np.rad2deg(1.0)), "°") if self.unit == "rad" else (1.0, self.unit)


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of finite magnitudes; NaN where there are none."""

    n: int
    rmse: float
    median: float
    p68: float
    p95: float
    maximum: float


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """One line of the summary; a value that is not known is NaN."""

    subject: str
    quantity: str
    value: float
    unit: str

    @property
    def text(self) -> str:
        """The value with its unit, four significant digits, or a dash."""
        if not np.isfinite(self.value):
            return "–"
        if self.unit == "":
            return f"{self.value:,.0f}"
        if self.unit == "%":
            return f"{self.value:.1f} %"
        return f"{self.value:.4g} {self.unit}"


def pair_name(pair: PairSolution) -> str:
    """How a pair is called in tables and plots."""
    return f"{pair.reference} → {pair.rover}"


def pair_errors(pair: PairSolution) -> list[ErrorSeries]:
    """Baseline and, where true velocities are known, relative velocity errors of a pair; empty without truth."""
    subject, axes = pair_name(pair), ("east", "north", "up")
    found = []
    if pair.truth_enu is not None:
        error = pair.baseline_enu - pair.truth_enu
        found.append(ErrorSeries(subject, "baseline", "m", axes, pair.t_s, error, pair.P[:, :3, :3]))
    if pair.truth_velocity_enu is not None:
        error = pair.velocity_enu - pair.truth_velocity_enu
        found.append(ErrorSeries(subject, "relative velocity", "m/s", axes, pair.t_s, error, pair.P[:, 3:, 3:]))
    return [series for series in found if np.isfinite(series.error).all(axis=1).any()]


def vehicle_errors(vehicle: VehicleSolution) -> list[ErrorSeries]:
    """Position, velocity and attitude errors of a vehicle, at the times of whichever is sparser, its states or its truth.

    The denser of the two is interpolated: position by cubic Hermite interpolation with its velocity (linearly where
    there is none), velocity linearly, attitude along the shortest rotation, covariances linearly. What lies outside the
    other or inside a gap of it is left out. Empty without truth, for base stations, and with fewer than two epochs.
    """
    truth = vehicle.truth
    if truth is None or vehicle.is_fixed or len(vehicle.t_s) < 2:
        return []
    if len(truth.t_s) > 2 and np.median(np.diff(truth.t_s)) < np.median(np.diff(vehicle.t_s)):
        truth = _thinned(truth, vehicle.t_s)
    usable = covered(vehicle.t_s, truth.t_s)
    if not usable.any():
        return []
    t_s, enu = truth.t_s[usable], ("east", "north", "up")
    index, fraction = _bracket(vehicle.t_s, t_s)
    smooth = np.isfinite(vehicle.r_n).all() and np.isfinite(vehicle.v_n).all()
    r_n = CubicHermiteSpline(vehicle.t_s, vehicle.r_n, vehicle.v_n)(t_s) if smooth else _lerp(vehicle.r_n, index, fraction)

    def covariance(block: slice) -> Array:
        return _lerp(vehicle.P[:, block, block], index, fraction)

    found = [ErrorSeries(vehicle.name, "position", "m", enu, t_s, r_n - truth.r_n[usable], covariance(POS))]
    if truth.v_n is not None:
        error = _lerp(vehicle.v_n, index, fraction) - truth.v_n[usable]
        found.append(ErrorSeries(vehicle.name, "velocity", "m/s", enu, t_s, error, covariance(VEL)))
    if truth.q_nb is not None:
        error = _attitude_error(vehicle, truth, usable)
        found.append(ErrorSeries(vehicle.name, "attitude", "rad", enu, t_s, error, covariance(ATT)))
    return [series for series in found if np.isfinite(series.error).all(axis=1).any()]


def statistics(error: Array) -> Statistics:
    """Statistics of error magnitudes: |e| of (n,), Euclidean norm of (n, k); rows that are not finite are left out."""
    e = np.asarray(error, float)
    size = np.abs(e) if e.ndim == 1 else np.linalg.norm(e, axis=1)
    size = size[np.isfinite(size)]
    if not size.size:
        return Statistics(0, *(float("nan"),) * 5)
    median, p68, p95 = (float(v) for v in np.percentile(size, (50, 68, 95)))
    return Statistics(len(size), float(np.sqrt(np.mean(size**2))), median, p68, p95, float(size.max()))


def cdf(error: Array) -> tuple[Array, Array]:
    """Sorted magnitudes and the share of rows not above each, both (m,); |e| of (n,), norm of (n, k)."""
    e = np.asarray(error, float)
    size = np.abs(e) if e.ndim == 1 else np.linalg.norm(e, axis=1)
    size = np.sort(size[np.isfinite(size)])
    return size, np.arange(1, len(size) + 1) / max(len(size), 1)


def fix_percentage(fix: IntArray, status: Fix) -> float:
    """Percentage of epochs (n,) with an ambiguity status, NaN without epochs."""
    return 100.0 * float(np.mean(fix == status.value)) if len(fix) else float("nan")


def euler_sigma(q_nb: Array, P_att: Array) -> Array:
    """Standard deviations (n, 3) of pitch, roll, heading [rad] of attitude errors phi with covariance (n, 3, 3) in n.

    Small changes of the Euler angles turn the body by d_pitch r + d_roll f - d_heading u in n, where r is right and
    level, f the nose and u up. With h the nose's horizontal direction the inverse is d_pitch = r'w, d_roll = h'w / cos
    pitch, d_heading = tan(pitch) h'w - u'w. NaN within 0.1 degree of a vertical nose.
    """
    C = matrix_from_quat(q_nb)
    cos_pitch = np.hypot(C[:, 0, 1], C[:, 1, 1])
    usable = np.isfinite(P_att).all(axis=(1, 2)) & (cos_pitch > np.sin(np.deg2rad(0.1)))
    nose, cos_pitch = C[usable, :, 1], cos_pitch[usable]
    east, north = nose[:, 0] / cos_pitch, nose[:, 1] / cos_pitch
    J = np.zeros((len(nose), 3, 3))
    J[:, 0, 0], J[:, 0, 1] = north, -east
    J[:, 1, 0], J[:, 1, 1] = east / cos_pitch, north / cos_pitch
    J[:, 2, :2], J[:, 2, 2] = nose[:, 2:] * J[:, 1, :2], -1.0
    sigma = np.full((len(C), 3), np.nan)
    sigma[usable] = np.sqrt(np.maximum(np.sum((J @ P_att[usable]) * J, axis=2), 0.0))
    return sigma


def solution_errors(solution: Solution) -> list[ErrorSeries]:
    """Every error against truth: of the pairs, then of the vehicles."""
    found = [series for pair in solution.pairs for series in pair_errors(pair)]
    return found + [series for vehicle in solution.vehicles for series in vehicle_errors(vehicle)]


def summary_rows(solution: Solution, errors: Sequence[ErrorSeries] | None = None) -> list[SummaryRow]:
    """The summary of a solution, the same for the report and the terminal: pairs, vehicles, then the whole.

    Errors and sigmas are norms of the three components, bands hold 95 %. `errors` are those of `solution_errors`
    where they are at hand already.
    """
    found = solution_errors(solution) if errors is None else errors
    rows = [row for pair in solution.pairs for row in _pair_rows(pair, found)]
    rows += [row for vehicle in solution.vehicles if not vehicle.is_fixed for row in _vehicle_rows(vehicle, found)]
    return rows + _whole_rows(solution)


def _pair_rows(pair: PairSolution, errors: Sequence[ErrorSeries]) -> list[SummaryRow]:
    subject = pair_name(pair)
    sigma = standard_deviations(pair.P)
    rows = [SummaryRow(subject, "epochs", len(pair.t_s), "")]
    if np.any(pair.fix != Fix.NONE.value):
        rows.append(SummaryRow(subject, "integers fixed", fix_percentage(pair.fix, Fix.FIXED), "%"))
        rows.append(SummaryRow(subject, "partly fixed", fix_percentage(pair.fix, Fix.PARTIAL), "%"))
    rows.append(SummaryRow(subject, "baseline σ, median", statistics(sigma[:, :3]).median, "m"))
    rows.append(SummaryRow(subject, "velocity σ, median", statistics(sigma[:, 3:]).median, "m/s"))
    mine = [series for series in errors if series.subject == subject]
    fixed = pair.fix == Fix.FIXED.value
    for series in mine:
        if series.quantity == "baseline" and fixed.any():
            rows.append(SummaryRow(subject, "fixed baseline error RMS", statistics(series.error[fixed]).rmse, "m"))
    return rows + [row for series in mine for row in _error_rows(series)]


def _vehicle_rows(vehicle: VehicleSolution, errors: Sequence[ErrorSeries]) -> list[SummaryRow]:
    sigma = standard_deviations(vehicle.P[:, POS, POS])
    rows = [
        SummaryRow(vehicle.name, "epochs", len(vehicle.t_s), ""),
        SummaryRow(vehicle.name, "position σ, median", statistics(sigma).median, "m"),
    ]
    if np.isfinite(vehicle.q_nb).any():
        heading = euler_sigma(vehicle.q_nb, vehicle.P[:, ATT, ATT])[:, 2]
        rows.append(SummaryRow(vehicle.name, "heading σ, median", float(np.rad2deg(statistics(heading).median)), "°"))
    return rows + [row for series in errors if series.subject == vehicle.name for row in _error_rows(series)]


def _error_rows(series: ErrorSeries) -> list[SummaryRow]:
    scale, unit = series.display
    stats = statistics(series.error)
    return [
        SummaryRow(series.subject, f"{series.quantity} error RMS", stats.rmse * scale, unit),
        SummaryRow(series.subject, f"{series.quantity} error 95 %", stats.p95 * scale, unit),
        SummaryRow(series.subject, f"{series.quantity} NEES in band", 100.0 * series.nees.share_inside, "%"),
    ]


def _whole_rows(solution: Solution) -> list[SummaryRow]:
    table, diagnostics = solution.residuals, solution.diagnostics
    rows = [SummaryRow("solution", "residuals", len(table.t_s), "")]
    if len(table.t_s):
        rows.append(SummaryRow("solution", "outliers", int(np.sum(table.outlier)), ""))
        rows.append(SummaryRow("solution", "outliers, share", 100.0 * float(np.mean(table.outlier)), "%"))
        rows += [SummaryRow("solution", f"outliers, {words}", n, "") for words, n in class_counts(table).items()]
    if len(diagnostics.nis):
        inside = judge(diagnostics.nis_t_s, diagnostics.nis, diagnostics.nis_dof).share_inside
        rows.append(SummaryRow("solution", "NIS in band", 100.0 * inside, "%"))
    rows.append(SummaryRow("solution", "iterations", diagnostics.n_iterations, ""))
    rows.append(SummaryRow("solution", "runtime", total_runtime_s(diagnostics.runtime_s), "s"))
    return rows


def total_runtime_s(runtime_s: dict[str, float]) -> float:
    """The stage named "total", else the sum of all stages; NaN without stages."""
    if not runtime_s:
        return float("nan")
    return runtime_s.get("total", sum(runtime_s.values()))


def covered(t_s: Array, at_s: Array) -> BoolArray:
    """Which of the times at_s (m,) lie on epochs t_s (n,), n > 1, or between two of them that are not a gap apart."""
    step = np.diff(t_s)
    inside = (at_s >= t_s[0]) & (at_s <= t_s[-1])
    index, fraction = _bracket(t_s, at_s)
    on_epoch = (fraction <= 0) | (fraction >= 1)
    short = step[index] <= MAX_GAP_STEPS * float(np.median(step))
    usable: BoolArray = inside & (on_epoch | short)
    return usable


def _bracket(t_s: Array, at_s: Array) -> tuple[IntArray, Array]:
    index = np.clip(np.searchsorted(t_s, at_s, side="right") - 1, 0, len(t_s) - 2)
    return index, (at_s - t_s[index]) / (t_s[index + 1] - t_s[index])


def _lerp(values: Array, index: IntArray, fraction: Array) -> Array:
    result: Array = values[index]
    rows = np.flatnonzero(fraction)  # none where truth and estimate share their epochs
    f = fraction[rows].reshape(-1, *(1,) * (values.ndim - 1))
    result[rows] = (1 - f) * result[rows] + f * values[index[rows] + 1]
    return result


def _slerp(q: Array, index: IntArray, fraction: Array) -> Array:
    """Unit quaternions (m, 4) on the shortest way from row index to the next."""
    start, end = q[index], q[index + 1]
    cosine = np.sum(start * end, axis=1)
    end = np.where(cosine[:, None] < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    # sin(f angle) / sin(angle) by sinc, which stands angle = 0
    whole = np.sinc(angle / np.pi)
    weights = [f * np.sinc(f * angle / np.pi) / whole for f in (1 - fraction, fraction)]
    turned: Array = weights[0][:, None] * start + weights[1][:, None] * end
    return turned


def _thinned(truth: Truth, t_s: Array) -> Truth:
    """Truth at those of the times t_s that it covers."""
    t = t_s[covered(truth.t_s, t_s)]
    index, fraction = _bracket(truth.t_s, t)
    if truth.v_n is not None and np.isfinite(truth.v_n).all() and np.isfinite(truth.r_n).all():
        r_n = CubicHermiteSpline(truth.t_s, truth.r_n, truth.v_n)(t)
    else:
        r_n = _lerp(truth.r_n, index, fraction)
    v_n = None if truth.v_n is None else _lerp(truth.v_n, index, fraction)
    return Truth(t, r_n, v_n, None if truth.q_nb is None else _slerp(truth.q_nb, index, fraction))


def _attitude_error(vehicle: VehicleSolution, truth: Truth, usable: BoolArray) -> Array:
    """phi (m, 3) of the usable truth rows, NaN where either attitude is unknown."""
    assert truth.q_nb is not None
    t_s, q_true = truth.t_s[usable], truth.q_nb[usable]
    phi = np.full((len(t_s), 3), np.nan)
    known = np.isfinite(vehicle.q_nb).all(axis=1)
    if known.sum() < 2:
        return phi
    t_known = vehicle.t_s[known]
    rows = np.isfinite(q_true).all(axis=1) & covered(t_known, t_s)
    if rows.any():
        C_est = matrix_from_quat(_slerp(vehicle.q_nb[known], *_bracket(t_known, t_s[rows])))
        phi[rows] = -log_so3(C_est @ np.swapaxes(matrix_from_quat(q_true[rows]), 1, 2))
    return phi
