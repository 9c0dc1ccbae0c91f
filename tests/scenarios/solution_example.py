"""A made-up but plausible solution: two vehicles, one pair, truth, ambiguities, residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from factorgraph.attitude import exp_so3, matrix_from_euler, quat_from_matrix
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import Truth
from factorgraph.solution import (
    ATT,
    BA,
    BG,
    POS,
    VEL,
    AmbiguityTable,
    Diagnostics,
    Fix,
    PairSolution,
    ParameterEstimate,
    ResidualTable,
    Solution,
    Status,
    VehicleSolution,
)
from factorgraph.types import Array, IntArray

SATELLITES = ("G05", "G12", "G15", "G24", "G25", "G29", "E03", "E08", "E13", "E15", "E26", "C21", "C34")
SIGMA = {"code": 0.3, "phase": 0.004, "doppler": 0.05, "range": 0.1, "height": 0.5}
VEHICLE_SIGMA = ((POS, 0.6), (VEL, 0.02), (ATT, 2e-3), (BG, 2e-4), (BA, 8e-3))


def example_solution(n: int = 600, rate_hz: float = 1.0, seed: int = 7, with_truth: bool = True) -> Solution:
    """Leader on a racetrack, rover weaving behind it; errors are correlated in time and obey the covariances."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(n) / rate_hz
    leader = _vehicle("leader", t_s, _racetrack(t_s), rng, with_truth)
    relative = np.column_stack([-35 + 12 * np.sin(t_s / 31), -60 + 20 * np.cos(t_s / 47), 8 + 4 * np.sin(t_s / 23)])
    rover = _vehicle("rover", t_s, _racetrack(t_s) + relative, rng, with_truth)
    return Solution(
        name="racetrack with two vehicles",
        method="graph",
        t0=GpsTime(2314, 216_000.0),
        frame=LocalFrame(np.deg2rad(47.07), np.deg2rad(15.44), 410.0),
        vehicles=(leader, rover),
        pairs=(_pair(t_s, relative, rng, with_truth),),
        ambiguities=_ambiguities(t_s, rng),
        residuals=_residuals(t_s, rng),
        diagnostics=_diagnostics(t_s, rng),
        configuration={"method": "graph", "settings": {"systems": "GEC", "ambiguity": {"ratio_threshold": 3.0}}},
        versions={"relnav": "0.1.0", "gtsam": "4.3.0", "numpy": np.__version__},
    )


def with_base(solution: Solution) -> Solution:
    """The same with the leader turned into a base station: no attitude, no biases, nothing estimated."""
    leader = solution.vehicles[0]
    nan = np.full_like(leader.r_n, np.nan)
    base = replace(
        leader,
        name="base",
        r_n=np.zeros_like(leader.r_n),
        v_n=np.zeros_like(leader.v_n),
        q_nb=np.full_like(leader.q_nb, np.nan),
        bias_gyro=nan,
        bias_accel=nan,
        P=np.full_like(leader.P, np.nan),
        truth=None,
        is_fixed=True,
    )
    pair = replace(solution.pairs[0], reference="base")
    return replace(solution, vehicles=(base, *solution.vehicles[1:]), pairs=(pair,))


def coloured_noise(rng: np.random.Generator, sigma: Array, correlation: float = 0.95) -> Array:
    """Stationary first-order noise (n, k) with standard deviations sigma (n, k)."""
    white = rng.standard_normal(sigma.shape)
    white[1:] *= np.sqrt(1 - correlation**2)
    unit: Array = lfilter([1.0], [1.0, -correlation], white, axis=0)
    return sigma * unit


def _racetrack(t_s: Array) -> Array:
    return np.column_stack([400 * np.sin(t_s / 48), 250 * np.sin(t_s / 24 + 0.4), 60 + 25 * np.sin(t_s / 80)])


def _gradient(r: Array, t_s: Array) -> Array:
    return np.gradient(r, t_s, axis=0) if len(t_s) > 1 else np.zeros_like(r)


def _vehicle(name: str, t_s: Array, r_true: Array, rng: np.random.Generator, with_truth: bool) -> VehicleSolution:
    n = len(t_s)
    v_true = _gradient(r_true, t_s)
    heading = np.arctan2(v_true[:, 0], v_true[:, 1])
    C_true = matrix_from_euler(0.03 * np.sin(t_s / 7), 0.2 * np.sin(t_s / 24), heading)
    P = np.zeros((n, 15, 15))
    settle = 1 + 3 * np.exp(-t_s / 40)
    for block, sigma_0 in VEHICLE_SIGMA:
        P[:, block, block] = np.eye(3) * (sigma_0 * settle[:, None, None]) ** 2
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    error = coloured_noise(rng, sigma)
    truth = Truth(t_s, r_true, v_true, quat_from_matrix(C_true)) if with_truth else None
    return VehicleSolution(
        name=name,
        t_s=t_s,
        r_n=r_true + error[:, POS],
        v_n=v_true + error[:, VEL],
        q_nb=quat_from_matrix(exp_so3(-error[:, ATT]) @ C_true),
        bias_gyro=np.array([2e-3, -1e-3, 5e-4]) + error[:, BG],
        bias_accel=np.array([0.05, -0.08, 0.02]) + error[:, BA],
        P=P,
        truth=truth,
    )


def _fix_timeline(t_s: Array) -> IntArray:
    fix = np.full(len(t_s), Fix.FIXED.value, np.int64)
    share = np.arange(len(t_s)) / max(len(t_s), 1)
    fix[share < 0.04] = Fix.FLOAT.value
    fix[(share > 0.52) & (share < 0.56)] = Fix.PARTIAL.value
    fix[(share > 0.80) & (share < 0.81)] = Fix.NONE.value
    return fix


def _pair(t_s: Array, relative: Array, rng: np.random.Generator, with_truth: bool) -> PairSolution:
    fix = _fix_timeline(t_s)
    sigma_m = np.array([0.6, 0.25, 0.03, 0.008])[fix][:, None] * [1.0, 1.0, 2.0]
    sigma = np.hstack([sigma_m, np.full_like(sigma_m, 0.01)])
    error = coloured_noise(rng, sigma, 0.8)
    velocity = _gradient(relative, t_s)
    held = fix >= Fix.PARTIAL.value
    return PairSolution(
        reference="leader",
        rover="rover",
        t_s=t_s,
        baseline_enu=relative + error[:, :3],
        velocity_enu=velocity + error[:, 3:],
        P=sigma[:, :, None] ** 2 * np.eye(6),
        fix=fix,
        ratio=np.where(held, 3 + rng.gamma(2.0, 6.0, len(t_s)), np.nan),
        n_sat=np.where(fix == Fix.NONE.value, 3, 8 + np.round(2 * np.sin(t_s / 90)).astype(np.int64)),
        truth_enu=relative if with_truth else None,
        truth_velocity_enu=velocity if with_truth else None,
    )


def _ambiguities(t_s: Array, rng: np.random.Generator) -> AmbiguityTable:
    rows = [(satellite, satellite[0] + signal) for satellite in SATELLITES for signal in ("1C", "2W")]
    state = ["datum", "datum", *("released" if i == 5 else "float" if i % 9 == 4 else "fixed" for i in range(len(rows) - 2))]
    integer = np.where(np.isin(state, ("fixed", "datum")), rng.integers(-40, 40, len(rows)), np.nan)
    centre = np.where(np.isnan(integer), rng.uniform(-40, 40, len(rows)), integer)
    return AmbiguityTable(
        link=("leader-rover",) * len(rows),
        satellite=tuple(row[0] for row in rows),
        signal=tuple(row[1] for row in rows),
        t_start_s=np.full(len(rows), t_s[0]),
        t_end_s=np.full(len(rows), t_s[-1]),
        float_cyc=centre + 0.05 * rng.standard_normal(len(rows)),
        sigma_cyc=rng.uniform(0.02, 0.08, len(rows)),
        integer=integer,
        state=tuple(state),
    )


def _residuals(t_s: Array, rng: np.random.Generator) -> ResidualTable:
    """Code, phase and Doppler of every satellite at every epoch, ranges and heights at every epoch, 1 % outliers."""
    n_sat, n = len(SATELLITES), len(t_s)
    gnss = [np.repeat(np.arange(3), n * n_sat), np.tile(np.repeat(np.arange(n), n_sat), 3), np.tile(np.arange(n_sat), 3 * n)]
    other = [np.repeat([3, 4], n), np.tile(np.arange(n), 2), np.repeat([n_sat, n_sat + 1], n)]
    kind_index, epoch, label_index = (np.concatenate(columns) for columns in zip(gnss, other, strict=True))
    azimuth, elevation = _sky(t_s)
    is_gnss, satellite = label_index < n_sat, np.minimum(label_index, n_sat - 1)
    kinds = tuple(SIGMA)
    sigma = np.array(list(SIGMA.values()))[kind_index]
    outlier = rng.random(len(epoch)) < 0.01
    scaled = rng.standard_normal(len(epoch)) * np.where(outlier, 3.0, 0.9) + np.where(outlier, 6.0, 0.0)
    return ResidualTable(
        kind=kinds,
        source=("leader-rover G1C", "leader-rover", "rover"),
        label=(*SATELLITES, "A1-B1", "up"),
        kind_index=kind_index,
        source_index=np.maximum(kind_index - 2, 0),
        label_index=label_index,
        t_s=t_s[epoch],
        residual=scaled * sigma,
        sigma=sigma,
        weight=np.minimum(1.0, 2.0 / np.maximum(np.abs(scaled), 1e-9)),
        outlier=outlier,
        azimuth_rad=np.where(is_gnss, azimuth[epoch, satellite], np.nan),
        elevation_rad=np.where(is_gnss, elevation[epoch, satellite], np.nan),
    )


def _sky(t_s: Array) -> tuple[Array, Array]:
    start = np.linspace(0, 2 * np.pi, len(SATELLITES), endpoint=False)
    height = np.deg2rad(20 + 50 * np.modf(np.arange(len(SATELLITES)) * 0.618)[0])
    azimuth = np.mod(start + 1e-4 * np.outer(t_s, np.where(np.arange(len(SATELLITES)) % 2, 1, -1)), 2 * np.pi)
    return azimuth, np.clip(height + 1.2e-4 * t_s[:, None] * np.cos(start), 0.1, 1.5)


def _diagnostics(t_s: Array, rng: np.random.Generator) -> Diagnostics:
    dof = np.full(len(t_s), 24.5)
    return Diagnostics(
        status=Status.CONVERGED,
        n_iterations=6,
        cost=np.array([9.1e6, 4.2e4, 2.1e4, 1.94e4, 1.93e4, 1.93e4, 1.93e4]),
        runtime_s={"read": 0.41, "build": 1.32, "optimise": 2.75, "integers": 0.12, "covariance": 0.94},
        nis_t_s=t_s,
        nis=rng.chisquare(dof),
        nis_dof=dof,
        notes=("3 arcs shorter than 5 epochs were left out",),
        parameters=(
            ParameterEstimate("uwb A1-B1 bias", "m", 0.123, 0.008, 0.0, 0.3),
            ParameterEstimate("uwb A1-B1 scale", "1", 4e-4, 2e-4, 0.0, 3e-4),
        ),
    )
