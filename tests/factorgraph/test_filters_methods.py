"""Recursive methods beside the error-state filter: clouds of sigma points, charts of the error, weights, integers, divergence."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.assembly.build import Built
from factorgraph.assembly.flight import WholeFlight
from factorgraph.attitude import exp_so3, log_so3, skew
from factorgraph.filters import methods
from factorgraph.filters.charts import BODY, EULER, INVARIANT, Chart, by_angles
from factorgraph.filters.clouds import Cloud
from factorgraph.filters.recursive import Run, run
from factorgraph.filters.sequential import Stages
from factorgraph.filters.sigma_points import cubature, unscented
from factorgraph.filters.weighing import Whitening, weigh
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.models.imu_interval import States
from factorgraph.registry import RECURSIVE, create
from factorgraph.solution import Fix, Solution, Status
from factorgraph.types import Array
from tests.factorgraph.test_batch_simulation import PAIR, WITH_BASE, flight_of, pair_flight
from tests.factorgraph.test_filters_recursive import in_sigmas, quiet


@cache
def solved(name: str, integers: bool = False) -> Solution:
    return methods.create(name, integers).solve(pair_flight(1.0, 3)[0].problem, quiet)


def built_flight(text: str, imu: str | None = None) -> Built:
    """A flight's blocks at start values, anew."""
    problem = (flight_of(text, 1.0, 4) if imu is None else flight_of(text, 1.0, 4, imu)).problem
    built, _, _ = WholeFlight("", GtsamEngine).started(problem, quiet)
    built.graph.assemble()
    return built


def test_methods_have_names() -> None:
    assert set(methods.FILTERS) == set(RECURSIVE)
    for name in RECURSIVE:
        assert create(name).summary and "smoothed" in create(f"{name}-rts").summary
    with pytest.raises(AttributeError, match="no attribute"):
        methods.__getattr__("nothing-rts")


@pytest.mark.parametrize("name", ["inekf", "ckf", "srckf"])
def test_filters_end_where_the_vehicles_are(name: str) -> None:
    found = solved(name)
    assert found.diagnostics.status is Status.CONVERGED
    assert np.all(in_sigmas(found) < 4.0)
    d = found.diagnostics
    assert 0.8 < d.nis[10:].sum() / d.nis_dof[10:].sum() < 1.3


def test_roots_give_what_covariances_give() -> None:
    once, again = solved("ckf"), solved("srckf")
    for name in "ab":
        x, y = once.vehicle(name), again.vehicle(name)
        sigma = np.sqrt(np.einsum("kii->ki", x.P))
        assert np.all(np.abs(x.r_n - y.r_n) < 1e-3 * sigma[:, :3])
        np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", y.P)), sigma, rtol=1e-3)


# -- clouds -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("text, imu", [(PAIR, None), (WITH_BASE, "")])
def test_small_clouds_see_what_jacobians_see(text: str, imu: str | None) -> None:
    stages = Stages(built_flight(text, imu).graph)
    for v in stages.vehicles:
        v.r, v.v, v.R, v.bias = v.r.copy(), v.v.copy(), v.R.copy(), v.bias.copy()
    n, k = stages.n_states, 12
    L = 1e-4 * np.eye(n)
    for rule in (unscented, cubature):
        cloud = Cloud(stages, rule)
        stages.carry(k, k + 2)
        F, Q = (x[0, :n, :n] for x in stages.transitions(k, k + 2))
        seen, noise = cloud.transition(k, L)
        np.testing.assert_allclose(seen.slope, F, atol=1e-5 * np.abs(F).max())
        np.testing.assert_allclose(noise @ noise.T, Q, rtol=1e-6, atol=1e-12 * np.abs(Q).max())
        rows, bend = cloud.rows(k, L)
        plain = next(stages.rows(k, k + 1))
        np.testing.assert_allclose(rows.e, plain.e, atol=1e-4)
        # Jacobians leave out what a gyroscope's bias does to the velocity of a lever arm
        seen_by = [c for c in range(rows.H.shape[1]) if c >= n or c % 15 < 12 or imu == ""]
        np.testing.assert_allclose(rows.H[:, seen_by], plain.H[:, seen_by], atol=1e-4 * np.abs(plain.H).max())
        assert np.abs(bend).max() < 2e-3


def test_wide_clouds_see_the_bend_of_ranges() -> None:
    """Mean and spread of rows with attitudes known to a sixth of a radian, against many samples."""
    stages = Stages(built_flight(PAIR).graph)
    n, k = stages.n_states, 12
    sigma = np.tile(np.repeat([0.15, 0.5, 0.1, 1e-3, 1e-3], 3), 2)
    rows, bend = Cloud(stages, unscented).rows(k, np.diag(sigma))
    covariance = rows.H[:, :n] @ np.diag(sigma**2) @ rows.H[:, :n].T + bend @ bend.T
    rng, images = np.random.default_rng(0), []
    before = [(v, v.R[k].copy(), v.r[k].copy(), v.v[k].copy(), v.bias[k].copy()) for v in stages.vehicles]
    for x in sigma * rng.standard_normal((200, n)):
        stages.move(k, x[None])
        images.append(next(stages.rows(k, k + 1)).e)
        for v, *values in before:
            v.R[k], v.r[k], v.v[k], v.bias[k] = values
    std = np.std(images, axis=0)
    moved = std > 1e-6
    assert np.all(np.abs(np.mean(images, axis=0) - rows.e)[moved] < 0.2 * std[moved])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[moved], std[moved], rtol=0.15)


# -- charts -----------------------------------------------------------------------------------------


def states(n: int) -> States:
    rng = np.random.default_rng(n)
    return States(exp_so3(rng.normal(0, 0.8, (n, 3))), rng.normal(0, 300.0, (n, 3)), rng.normal(0, 20.0, (n, 3)))


def local(a: States, b: States) -> Array:
    """Error columns (n, 9) that lead from a to b."""
    back = np.swapaxes(a.R, 1, 2)
    return np.hstack([log_so3(back @ b.R), np.einsum("nij,nj->ni", back, b.r_n - a.r_n), b.v_n - a.v_n])


def invariant_map(R: Array, r: Array, v: Array) -> Array:
    """A (9, 9): columns theta, rho, nu from phi, xi_v, xi_r."""
    A = np.zeros((9, 9))
    A[:3, :3] = R.T
    A[3:6, :3], A[3:6, 6:] = -R.T @ skew(r), R.T
    A[6:, :3], A[6:, 3:6] = -skew(v), np.eye(3)
    return A


@pytest.mark.parametrize("chart", [BODY, EULER, INVARIANT])
def test_charts_agree_on_small_errors(chart: Chart) -> None:
    at = states(5)
    x = 1e-5 * np.random.default_rng(0).standard_normal((5, 9))
    moved, T = chart.move(at, x)
    np.testing.assert_allclose(local(at, moved), x, atol=1e-8)
    np.testing.assert_allclose(T, np.tile(np.eye(9), (5, 1, 1)), atol=2e-4)


def test_covariances_stay_with_what_the_charts_say() -> None:
    """Body: the derivative of the composition. Euler: the angles' covariance; invariant: that of the group's error."""
    at = states(4)
    x = np.random.default_rng(1).normal(0, 0.3, (4, 9))
    moved, T = BODY.move(at, x)
    for i in range(9):
        step = np.zeros(9)
        step[i] = 1e-6
        np.testing.assert_allclose(local(moved, BODY.move(at, x + step)[0]) / 1e-6, T[:, :, i], atol=1e-4)
    moved, T = EULER.move(at, x)
    np.testing.assert_allclose(T[:, :3, :3] @ by_angles(at.R), by_angles(moved.R), atol=1e-12)
    moved, T = INVARIANT.move(at, x)
    for i in range(4):
        A, after = (invariant_map(s.R[i], s.r_n[i], s.v_n[i]) for s in (at, moved))
        np.testing.assert_allclose(T[i] @ A, after, atol=1e-9)


def test_invariant_error_moves_the_same_wherever_the_estimate_is() -> None:
    """Transitions of attitude, position and velocity errors at two headings and velocities; what is left is the Earth's turn."""
    stages = Stages(built_flight(WITH_BASE).graph)
    v, k = stages.vehicles[0], 20
    for own in ("r", "v", "R", "bias"):
        setattr(v, own, getattr(v, own).copy())
    found: dict[str, list[Array]] = {"body": [], "invariant": []}
    for turn in (0.0, 1.0):
        v.R[k] = exp_so3(np.array([[0.0, 0.0, turn]]))[0] @ v.R[k]
        v.v[k] += 30.0 * turn
        stages.carry(k, k + 2)
        F = stages.transitions(k, k + 2)[0][0][:9, :9]
        A, after = (invariant_map(v.R[i], v.r[i], v.v[i]) for i in (k, k + 1))
        found["body"].append(F)
        found["invariant"].append(np.linalg.solve(after, F @ A))
    off = {name: float(np.abs(b - a).max()) for name, (a, b) in found.items()}
    assert off["body"] > 1.0
    assert off["invariant"] < 5e-3


# -- weights, integers, divergence -------------------------------------------------------------------


def with_jump(noise_of: str, size_m: float, every: int) -> Run:
    """A flight run with every so-many-th code of its link off by some metres, with the problem's losses or without."""
    built = built_flight(WITH_BASE)
    block = next(b for b in built.graph.gnss if b.reference is not None)
    code = np.flatnonzero(block.rows.kind == 0)[20::every]
    block.z[code] += size_m
    problem = flight_of(WITH_BASE, 1.0, 4).problem
    return run(built.graph, methods.FILTERS["eskf"], problem.settings.robust if noise_of == "losses" else {})


def test_losses_of_the_problem_act() -> None:
    truth = flight_of(WITH_BASE, 1.0, 4).record.trajectories["a"]
    off = {}
    for with_losses in ("losses", "none"):
        found = with_jump(with_losses, 60.0, 6)
        v = found.s.vehicles[0]
        off[with_losses] = float(np.linalg.norm(v.r[-1] - truth.at(v.t_s[-1:]).r_n[0]))
    assert off["losses"] < 0.1
    assert off["none"] > 10 * off["losses"]


def test_weighed_rows_are_those_of_the_block() -> None:
    """Weights on whitened rows, and on rows that are whitened with them."""
    graph = built_flight(PAIR).graph
    stages, k = Stages(graph), 10
    plain = next(stages.rows(k, k + 1))
    rng = np.random.default_rng(0)
    w = rng.uniform(0.1, 1.0, len(plain.e))
    done = 0
    for number, i, j in plain.at:
        graph.blocks[number].predict()
        graph.blocks[number].w[i:j] = w[done : done + j - i]
        graph.blocks[number].whiten()
        done += j - i
    direct = np.concatenate([-graph.blocks[number].e[i:j] for number, i, j in plain.at])
    again = Whitening.of(graph, plain).again(plain.e, w)
    np.testing.assert_allclose(again[:done], direct, atol=1e-6)


def test_what_fits_keeps_its_weight() -> None:
    stages = Stages(built_flight(PAIR).graph)
    rows = next(stages.rows(10, 11))
    losses = pair_flight(1.0, 3)[0].problem.settings.robust
    nothing = np.zeros(len(rows.e))
    assert weigh(stages.graph, rows, nothing, np.eye(rows.H.shape[1]), nothing, losses) is None


def test_state_put_out_is_conditioned_on_integers() -> None:
    fixed, floats = solved("eskf", True), solved("eskf")
    pair, other = fixed.pair("a", "b"), floats.pair("a", "b")
    assert np.mean(pair.fix == Fix.FIXED.value) > 0.9 and np.all(other.fix <= Fix.FLOAT.value)
    assert pair.truth_enu is not None
    off, of_floats = (np.linalg.norm(p.baseline_enu - pair.truth_enu, axis=1)[5:] for p in (pair, other))
    assert np.median(off) < 0.02 < np.median(of_floats)
    assert np.all(np.linalg.eigvalsh(pair.P) > 0)


def test_filter_that_diverges_says_so() -> None:
    """An accelerometer that is noise from 5 s on, and is believed."""
    flight = flight_of(WITH_BASE, 1.0, 4)
    a = flight.problem.vehicle("a")
    assert a.imu is not None
    late = (a.imu.t_s > a.imu.t_s[0] + 5)[:, None]
    noise = np.random.default_rng(0).normal(0, 100.0, a.imu.f_b.shape)
    broken = replace(a, imu=replace(a.imu, f_b=a.imu.f_b + late * noise))
    vehicles = tuple(broken if v.name == "a" else v for v in flight.problem.vehicles)
    found = methods.create("eskf", False).solve(replace(flight.problem, vehicles=vehicles), quiet)
    assert found.diagnostics.status is Status.DIVERGED
    assert any("diverged" in text and "sigma" in text for text in found.diagnostics.warnings)
