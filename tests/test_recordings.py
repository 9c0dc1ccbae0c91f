"""What the toolkit reaches on real recordings; every figure is in docs/recordings.md.

Recordings that come with no package are looked for where `tests.helpers.shared_data` says; tests without them skip.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from factorgraph.geodesy import LocalFrame
from factorgraph.interpolation import interpolate
from factorgraph.measurements import PositionStream
from factorgraph.problem import Link, NavigationProblem, Settings, Vehicle
from factorgraph.registry import solve
from factorgraph.solution import Fix, PairSolution, Solution, Status, VehicleSolution
from factorgraph.types import Array, BoolArray
from scenarios import methods
from scenarios.flights import load
from scenarios.flights.rtklib_pos import read_pos
from tests.helpers import shared_data, wheel_file

STATIC, KINEMATIC = "cssrlib_static_2021_078", "cssrlib_kin_2021_265"
MILUV = "miluv_cirObstacles_3_random_0"
STATIC_BASE = np.array([-3959400.631, 3385704.533, 3667523.111])
STATIC_ROVER = np.array([-3962108.673, 3381309.574, 3668678.638])
KINEMATIC_BASE = np.array([-3959400.6443, 3385704.4948, 3667523.1275])
WHEEL_FILES = {
    "cssrlib-static": ("cssrlib", "data/SEPT078M1.21O"),
    "kitti": ("gtsam", "Data/KittiGps_converted.txt"),
    "plaza1": ("gtsam", "Data/Plaza1_.mat"),
    "plaza2": ("gtsam", "Data/Plaza2_.mat"),
}


@cache
def problem_of(name: str) -> NavigationProblem:
    """A flight of the catalogue; skips the test where its files are not."""
    if name in WHEEL_FILES:
        wheel_file(*WHEEL_FILES[name])
        return load(name).problem
    folder = MILUV if name.startswith("miluv") else name.removesuffix("_moving_base")
    return load(name, shared_data(folder).parent).problem


@cache
def solved(name: str) -> Solution:
    return solve(problem_of(name))


def rms(x: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))


def rmse(error: Array) -> float:
    """Root mean square of the lengths of error (n, k)."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def baseline_n(solution: Solution) -> Array:
    return solution.vehicle("rover").r_n - solution.vehicle("base").r_n


def assert_clean(solution: Solution) -> None:
    assert solution.diagnostics.status is Status.CONVERGED and not solution.diagnostics.warnings


def assert_integers_fit(solution: Solution, settings: Settings) -> None:
    """No wrong integer is kept: phase residuals of every epoch and every fixed arc stay below the release threshold."""
    table, arcs = solution.residuals, solution.ambiguities
    mine = np.flatnonzero(table.kind_index == table.kind.index("phase"))
    t_s, u = table.t_s[mine], (table.residual / table.sigma)[mine]
    _, epoch = np.unique(np.round(t_s, 2), return_inverse=True)
    per_epoch = np.sqrt(np.bincount(epoch, u**2) / np.bincount(epoch))
    assert per_epoch.max() < settings.ambiguity.release_sigma
    name = np.array(
        [f"{table.source[s]} {table.label[k]}" for s, k in zip(table.source_index[mine], table.label_index[mine], strict=True)]
    )
    for i in np.flatnonzero(np.isin(arcs.state, ["fixed", "datum"])):
        inside = (t_s >= arcs.t_start_s[i] - 0.01) & (t_s <= arcs.t_end_s[i] + 0.01)
        own = u[inside & (name == f"{arcs.link[i]} {arcs.signal[i]} {arcs.satellite[i]}")]
        assert len(own) and np.sqrt(np.mean(own**2)) < settings.ambiguity.release_sigma


# -- two static receivers, documented coordinates ----------------------------------------------------


def static_error_enu(solution: Solution) -> Array:
    """Baseline error (n, 3)."""
    error = baseline_n(solution) @ solution.frame.C_en - (STATIC_ROVER - STATIC_BASE)
    return np.asarray(error @ LocalFrame.at_ecef(STATIC_ROVER).C_en.T)


@pytest.mark.parametrize("name", [STATIC, f"{STATIC}_moving_base", "cssrlib-static"])
def test_static_pair_meets_its_coordinates(name: str) -> None:
    """Base known, and both ends free to move."""
    solution = solved(name)
    assert_clean(solution)
    (pair,) = solution.pairs
    assert len(pair.fix) == 60 and np.all(pair.fix == Fix.FIXED.value)
    error = static_error_enu(solution)
    assert np.abs(error.mean(axis=0)).max() < 5e-3
    assert rms(error).max() <= 5e-3
    assert_integers_fit(solution, problem_of(name).settings)


def test_static_moving_base_is_where_code_says() -> None:
    """A free base is a few metres off, within its claimed uncertainty: differences do not pull it away."""
    problem = problem_of("cssrlib-static")
    base, rover = (problem.vehicle(name) for name in ("base", "rover"))
    solution = solve(replace(problem, vehicles=(replace(base, fixed_n=None), rover)))
    assert np.all(solution.pairs[0].fix == Fix.FIXED.value)
    assert_position_is_honest(solution.vehicle("base"), np.array(base.fixed_n), 3.0)


def assert_position_is_honest(vehicle: VehicleSolution, r_true_n: Array, limit_m: float) -> None:
    error = vehicle.r_n - r_true_n
    sigma = np.sqrt(np.diagonal(vehicle.P[:, :3, :3], axis1=1, axis2=2))
    assert rmse(error) < limit_m and np.all(np.abs(error) < 3 * sigma)


# -- a moving receiver, no IMU -----------------------------------------------------------------------


@cache
def kinematic(kind: str) -> Solution:
    """The recording as "fixed" or "moving" base, "swapped" roles of either, and with all frequencies."""
    problem = problem_of(f"{KINEMATIC}_moving_base" if "moving" in kind else KINEMATIC)
    if "swapped" in kind:
        problem = replace(problem, links=tuple(Link(link.rover, link.reference) for link in problem.links))
    if "all" in kind:
        problem = replace(problem, settings=replace(problem.settings, systems="GEJ", bands="125678"))
    return solve(problem)


@cache
def rtklib() -> tuple[Array, Array, BoolArray]:
    """Seconds since t0 (n,), ECEF positions (n, 3) and which are fixed, of RTKLIB's kinematic processing."""
    pos = read_pos(shared_data("reference/cssrlib_kin_rtklib_inst.pos"))
    r = pos.ecef()
    assert r is not None
    t0 = problem_of(KINEMATIC).t0
    return pos.times.since(t0), r, pos.quality == 1


def against_rtklib(solution: Solution) -> Array:
    """East-north-up differences (n, 3) of the rover at epochs that both fixed, the base at its known place."""
    t_s, r_ecef, fixed = rtklib()
    vehicle, pair = solution.vehicle("rover"), solution.pairs[0]
    at = np.clip(np.searchsorted(vehicle.t_s, t_s - 0.02), 0, len(vehicle.t_s) - 1)
    assert np.abs(vehicle.t_s[at] - t_s).max() < 0.02
    both = fixed & (pair.fix[at] == Fix.FIXED.value)
    rover = KINEMATIC_BASE + baseline_n(solution) @ solution.frame.C_en
    return np.asarray((rover[at] - r_ecef)[both] @ LocalFrame.at_ecef(KINEMATIC_BASE).C_en.T)


@pytest.mark.parametrize("kind", ["fixed", "moving", "moving swapped"])
def test_moving_receiver_agrees_with_rtklib(kind: str) -> None:
    solution = kinematic(kind)
    assert_clean(solution)
    (pair,) = solution.pairs
    assert len(pair.fix) == 360 and np.mean(pair.fix == Fix.FIXED.value) >= 0.97
    difference = np.linalg.norm(against_rtklib(solution), axis=1)
    assert len(difference) >= 0.97 * 327
    assert np.median(difference) <= 0.01
    assert difference.max() < 0.05
    assert_integers_fit(solution, problem_of(KINEMATIC).settings)
    nis = solution.diagnostics.nis.sum() / solution.diagnostics.nis_dof.sum()
    assert 0.6 < nis < 1.1


@pytest.mark.parametrize("kind", ["fixed swapped", "moving", "moving swapped"])
def test_roles_and_base_do_not_change_the_baseline(kind: str) -> None:
    one, other = kinematic("fixed"), kinematic(kind)
    fixed = (one.pairs[0].fix == Fix.FIXED.value) & (other.pairs[0].fix == Fix.FIXED.value)
    assert fixed.mean() >= 0.97
    assert np.linalg.norm(baseline_n(one) - baseline_n(other), axis=1)[fixed].max() < 5e-3


def test_kinematic_moving_base_is_where_code_says() -> None:
    truth = problem_of(f"{KINEMATIC}_moving_base").vehicle("base").truth
    assert truth is not None
    assert_position_is_honest(kinematic("moving").vehicle("base"), truth.r_n[0], 3.0)


def test_all_frequencies_agree_but_for_antennas() -> None:
    """More signals fix as well; phase centres that differ by frequency show as a height of a centimetre or two."""
    solution = kinematic("all")
    assert np.mean(solution.pairs[0].fix == Fix.FIXED.value) >= 0.97
    difference = against_rtklib(solution)
    assert np.median(np.linalg.norm(difference, axis=1)) < 0.025
    assert np.abs(np.median(difference[:, :2], axis=0)).max() < 0.01
    assert np.linalg.norm(difference, axis=1).max() < 0.05


# -- a car with an IMU and position fixes ------------------------------------------------------------


def test_imu_bridges_withheld_fixes() -> None:
    """Every second fix is withheld and predicted; 2 s between the others."""
    problem = problem_of("kitti")
    (car,) = problem.vehicles
    fixes = car.positions[0]
    used, withheld = np.arange(0, len(fixes.t_s), 2), np.arange(1, len(fixes.t_s), 2)
    car = replace(car, positions=(PositionStream(fixes.t_s[used], fixes.r_n[used], fixes.sigma_m[used], fixes.lever_b),))
    solution = solve(replace(problem, vehicles=(car,)))
    assert_clean(solution)
    (path,) = solution.vehicles
    withheld = withheld[(fixes.t_s[withheld] >= path.t_s[0]) & (fixes.t_s[withheld] <= path.t_s[-1])]
    assert len(withheld) >= 230
    predicted = interpolate(path, car.imu, problem.frame, fixes.t_s[withheld])
    assert rmse(predicted.r_n - fixes.r_n[withheld]) <= 0.2
    # the declared noise fits: 8.4 with the densities of the recording's metadata
    assert 0.8 < solution.diagnostics.nis.sum() / solution.diagnostics.nis_dof.sum() < 1.5


# -- radio ranges only -------------------------------------------------------------------------------

SILENCE_S = 5.0


@pytest.mark.parametrize(("name", "n_silent"), [("plaza1", 3), ("plaza2", 0)])
def test_ranges_alone_give_the_path(name: str, n_silent: int) -> None:
    """Where radios are silent for long, nothing tells where the vehicle is, and the solution says so."""
    problem, solution = problem_of(name), solved(name)
    assert_clean(solution)
    (path,), (mower,) = solution.vehicles, problem.vehicles
    truth, ranges = mower.truth, problem.ranges[0].stream
    assert truth is not None
    inside = (truth.t_s >= path.t_s[0]) & (truth.t_s <= path.t_s[-1])
    t_s, r_true = truth.t_s[inside], truth.r_n[inside, :2]
    error = CubicHermiteSpline(path.t_s, path.r_n[:, :2], path.v_n[:, :2])(t_s) - r_true
    silent = np.diff(ranges.t_s) > SILENCE_S
    assert int(np.sum(silent & (np.diff(ranges.t_s) > 10))) == n_silent
    after = np.clip(np.searchsorted(ranges.t_s, t_s), 1, len(ranges.t_s) - 1)
    is_silent = silent[after - 1]
    assert rmse(error[~is_silent]) <= 0.6
    assert np.mean(is_silent) < 0.1
    near = np.clip(np.searchsorted(path.t_s, t_s), 0, len(path.t_s) - 1)
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(path.P[near, :2, :2], error[..., None])[..., 0]) / 2
    assert nees[~is_silent].mean() < 2
    assert not n_silent or nees[is_silent].mean() < 2


# -- three quadcopters, IMU, height and UWB ----------------------------------------------------------


@cache
def without_anchors() -> Solution:
    """Fixes with a standard deviation of 30 m give start values and next to no information: see docs/recordings.md."""
    problem = problem_of("miluv-no-anchors")
    return solve(replace(problem, vehicles=tuple(_started(v) for v in problem.vehicles)))


def _started(vehicle: Vehicle) -> Vehicle:
    truth = vehicle.truth
    assert truth is not None
    rows = np.arange(50, len(truth.t_s) - 50, 100)
    hint = PositionStream(truth.t_s[rows], truth.r_n[rows], np.full((len(rows), 3), 30.0), name="start")
    return replace(vehicle, positions=(hint,))


def pair_error(pair: PairSolution) -> Array:
    """Baseline errors (n, 3) where motion capture knows both ends."""
    assert pair.truth_enu is not None
    error = pair.baseline_enu - pair.truth_enu
    return np.asarray(error[np.isfinite(error[:, 0])])


def test_quadcopters_relative_to_each_other_with_anchors() -> None:
    solution = solved("miluv")
    assert_clean(solution)
    assert len(solution.pairs) == 3
    for pair in solution.pairs:
        assert rmse(pair_error(pair)) <= 0.30, f"{pair.reference}-{pair.rover}"
    for path in solution.vehicles:
        assert path.truth is not None
        nearest = np.searchsorted(path.truth.t_s, path.t_s).clip(0, len(path.truth.t_s) - 1)
        assert rmse(path.r_n - path.truth.r_n[nearest]) <= 0.30
    nis = solution.diagnostics.nis.sum() / solution.diagnostics.nis_dof.sum()
    assert 0.5 < nis < 1.2


def test_quadcopters_by_the_relative_filter_with_and_without_a_corrector() -> None:
    plain, corrected = (methods.solve(problem_of("miluv"), name) for name in ("relative", "relative-tdo"))
    for a, b in zip(plain.pairs, corrected.pairs, strict=True):
        assert rmse(pair_error(a)) <= 1.2, f"{a.reference}-{a.rover}"
        np.testing.assert_allclose(b.baseline_enu, a.baseline_enu, atol=0.1)  # O3's least is the filter's own posterior
    assert "replaced by the corrector" in corrected.diagnostics.notes[-1]
    assert plain.diagnostics.nis.sum() / plain.diagnostics.nis_dof.sum() < 2.0


def test_quadcopters_relative_to_each_other_without_anchors() -> None:
    """Ranges among the three, IMUs and heights keep the relative positions; absolute ones are unknown and said to be."""
    solution = without_anchors()
    assert_clean(solution)
    for pair in solution.pairs:
        assert rmse(pair_error(pair)) <= 0.60, f"{pair.reference}-{pair.rover}"
        assert np.sqrt(np.median(pair.P[:, 0, 0] + pair.P[:, 1, 1])) < 1.0
    for path in solution.vehicles:
        assert np.sqrt(path.P[:, 0, 0].min()) > 1.5
