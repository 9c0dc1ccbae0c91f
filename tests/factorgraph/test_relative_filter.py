"""The relative filter's parts: motion against exact trajectories, rows against differences, frames, consistency.

Numbers in names of tests are acceptance checks of spec ahrs_tdo.md, section 6.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from factorgraph.attitude import skew
from factorgraph.consistency import nees
from factorgraph.errors import InputError
from factorgraph.filters.relative import filtering, motion, rows
from factorgraph.filters.relative.motion import AccelModel, AttitudeReferenced, Mover, Smooth, error, position, tilt, velocity
from factorgraph.geodesy import LocalFrame
from factorgraph.types import Array
from scenarios.simulate import load_scenario
from scenarios.simulate.flight import Exact, exact
from tests.helpers import numerical_jacobian

MODEL = AccelModel(5e-4, 0.01, 3600.0, (2e-3, 2e-3, 5e-3), 5.0)
UAVS = ("leader", "follower")


@pytest.fixture(scope="module")
def flown() -> tuple[Exact, LocalFrame]:
    scenario = load_scenario("two-uav")
    info = scenario.scenario.model_copy(update={"duration_s": 60.0})
    scenario = scenario.model_copy(update={"scenario": info})
    return exact(scenario, 1), info.origin.frame


def movers(flown: tuple[Exact, LocalFrame], end_s: float = 40.0) -> list[Mover]:
    known, frame = flown
    out = []
    for name in UAVS:
        imu = known.imu[name]
        rows_used = imu.t_s <= end_s
        t, f = imu.t_s[rows_used], imu.f_b[rows_used]
        edges = np.concatenate([[t[0] - (t[1] - t[0])], t])
        C = np.einsum("ij,kjl->kil", frame.C_en.T, known.trajectories[name].at(0.5 * (edges[1:] + edges[:-1])).C_nb)
        out.append(Mover(name, edges, np.einsum("kij,kj->ki", C, f), C, MODEL, frame.C_en))
    return out


def relative_truth(flown: tuple[Exact, LocalFrame], t_s: Array) -> tuple[Array, Array, Array]:
    """Reference position, relative velocity and position (k, 3), ECEF."""
    known, frame = flown
    a, b = (known.trajectories[name].at(t_s) for name in UAVS)
    return frame.to_ecef(a.r_n), frame.rotate_to_ecef(b.v_n - a.v_n), frame.rotate_to_ecef(b.r_n - a.r_n)


def test_check_1_noise_free_dead_reckoning_closes(flown: tuple[Exact, LocalFrame]) -> None:
    t = np.arange(5.0, 35.5, 1.0)
    place, v, r = relative_truth(flown, t)
    moving = AttitudeReferenced(movers(flown), t, place)
    for start in (0, 10, 20):
        x = np.zeros(moving.size)
        x[velocity(0)], x[position(0)] = v[start], r[start]
        for k in range(start + 1, start + 11):
            x = moving.predict(k, x)[0]
        assert np.linalg.norm(x[velocity(0)] - v[start + 10]) < 1e-3
        assert np.linalg.norm(x[position(0)] - r[start + 10]) < 5e-3


def test_without_coriolis_and_gravity_difference_dead_reckoning_does_not_close(flown: tuple[Exact, LocalFrame]) -> None:
    t = np.arange(5.0, 35.5, 1.0)
    _, v, _ = relative_truth(flown, t)
    a, b = (motion.integrate(mover, t) for mover in movers(flown))
    off = v[0] + np.sum(b.dv - a.dv, axis=0) - v[-1]  # erratum E6: both are left out in print
    assert np.linalg.norm(off) > 2e-3


@pytest.mark.parametrize("coloured", [False, True])
def test_check_1_transition_is_the_derivative(flown: tuple[Exact, LocalFrame], coloured: bool) -> None:
    t = np.arange(5.0, 8.5, 0.5)
    place, v, r = relative_truth(flown, t)
    moving = AttitudeReferenced(movers(flown), t, place, coloured)
    x = np.concatenate([v[2], r[2], 0.01 * np.arange(12.0 if coloured else 6.0)])
    J = numerical_jacobian(lambda d: moving.predict(3, x + d)[0], len(x), 1.0)
    np.testing.assert_allclose(moving.predict(3, x)[1], J, atol=1e-6)


def test_coloured_attitude_errors_push_as_wrong_attitudes_do(flown: tuple[Exact, LocalFrame]) -> None:
    t = np.arange(5.0, 7.5, 1.0)
    place, v, r = relative_truth(flown, t)
    leader, follower = movers(flown)
    psi = np.array([1e-3, -2e-3, 5e-4])  # of the truth against what is told
    told = replace(follower, f_e=follower.f_e - np.cross(psi, follower.f_e), model=replace(MODEL, attitude_s=1e9))
    moving = AttitudeReferenced([leader, told], t, place, coloured=True)
    x = np.zeros(moving.size)
    x[velocity(0)], x[position(0)], x[tilt(1, 1)] = v[0], r[0], psi
    for k in (1, 2):
        x = moving.predict(k, x)[0]
    assert np.linalg.norm(x[velocity(0)] - v[2]) < 1e-3
    x[velocity(0)] -= v[2]
    assert np.linalg.norm(moving.predict(1, np.concatenate([v[0], r[0], np.zeros(12)]))[0][velocity(0)] - v[1]) > 5e-3


def test_check_2_identity_in_the_position_block_as_printed_runs_away() -> None:
    F = np.zeros((6, 6))
    F[3:, :3] = np.eye(3)
    printed = np.zeros((6, 6))
    printed[3:, 3:] = np.eye(3)  # erratum E2
    x = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert np.linalg.norm(expm(5.0 * F) @ x) == pytest.approx(1.0)
    assert np.linalg.norm(expm(5.0 * printed) @ x) > 0.999 * np.exp(5.0)


def test_check_3_attitude_noise_moves_velocity_and_not_position(flown: tuple[Exact, LocalFrame]) -> None:
    leader, follower = movers(flown)
    silent = replace(MODEL, white_mps2_rthz=0.0, markov_mps2=0.0)
    dt = float(follower.edges[2] - follower.edges[1])
    t = follower.edges[100:102]
    moving = AttitudeReferenced(
        [replace(leader, model=motion.PERFECT), replace(follower, model=silent)], t, np.zeros((2, 3)) + 6.4e6
    )
    Q = moving.predict(1, np.zeros(12))[2]
    f = follower.f_e[100]
    S = follower.C_en.T @ np.diag(2 * silent.attitude_s * np.square(silent.attitude_rad)) @ follower.C_en
    np.testing.assert_allclose(Q[:3, :3], dt * skew(f) @ S @ skew(f).T, rtol=1e-9, atol=1e-18)
    assert np.trace(Q[3:6, 3:6]) < dt**2 * np.trace(Q[:3, :3])
    assert not np.any(Q[6:, :])
    coloured = AttitudeReferenced(moving.movers, t, np.zeros((2, 3)) + 6.4e6, coloured=True)
    assert not np.any(coloured.predict(1, np.zeros(18))[2][:12, :12])  # then the error is a state and not noise


def test_signs_of_the_accelerometer_errors(flown: tuple[Exact, LocalFrame]) -> None:
    t = np.array([10.0, 11.0])
    moving = AttitudeReferenced(movers(flown), t, np.zeros((2, 3)) + 6.4e6)
    x = np.zeros(12)
    Phi = moving.predict(1, x)[1]
    C_l, C_f = (m.C_eb[np.searchsorted(m.edges, 10.5)] for m in moving.movers)
    np.testing.assert_allclose(Phi[velocity(0), error(1, 0)], -C_l, atol=0.05)
    np.testing.assert_allclose(Phi[velocity(0), error(1, 1)], C_f, atol=0.05)


def test_noise_of_an_interval_is_that_of_its_parts(flown: tuple[Exact, LocalFrame]) -> None:
    both = movers(flown)
    place = np.zeros((3, 3)) + 6.4e6
    whole = AttitudeReferenced(both, np.array([10.0, 12.0]), place)
    halves = AttitudeReferenced(both, np.array([10.0, 11.0, 12.0]), place)
    x = np.ones(12)
    _, Phi, Q = whole.predict(1, x)
    (_, A, QA), (_, B, QB) = halves.predict(1, x), halves.predict(2, x)
    np.testing.assert_allclose(B @ A, Phi, atol=3e-4)  # Coriolis acceleration of what df brings is left out
    np.testing.assert_allclose(B @ QA @ B.T + QB, Q, rtol=1e-3, atol=1e-9)


def test_followers_share_the_noise_of_the_reference(flown: tuple[Exact, LocalFrame]) -> None:
    leader, follower = movers(flown)
    t = np.array([10.0, 11.0])
    place = np.zeros((2, 3)) + 6.4e6
    three = AttitudeReferenced([leader, follower, follower], t, place)
    Q = three.predict(1, np.zeros(three.size))[2]
    alone = motion.integrate(leader, t).Q[0]
    np.testing.assert_allclose(Q[:6, 6:12], alone[:6, :6])
    assert np.linalg.eigvalsh(Q).min() > -1e-12


def distances_and_places(rng: np.random.Generator, R: Array, n: int, walk: Array) -> list[filtering.Source]:
    """Absolute differences and a range in axes turned by R, of the relative path `walk` (K, 6), velocity first."""
    K = len(walk)
    noise = rng.normal(size=(K, 6))
    P = np.tile(np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01]), (2, K, 1, 1))
    r_e, v_e = np.zeros((2, K, 3)), np.zeros((2, K, 3))
    r_e[1] = (walk[:, 3:] + np.sqrt(2) * noise[:, :3]) @ R.T
    v_e[1] = (walk[:, :3] + 0.1 * np.sqrt(2) * noise[:, 3:]) @ R.T
    turned = np.kron(np.eye(2), R)
    P = turned @ P @ turned.T
    measured = np.linalg.norm(walk[:, 3:], axis=1) + 0.1 * rng.normal(size=K)
    by_epoch = {k: [rows.RangeRow(0, 1, np.zeros(3), float(measured[k]), 0.1, "a-b")] for k in range(K)}
    return [rows.AbsoluteDifferences(r_e, v_e, P, ("a", "b"), n, factor=1.0), rows.Distances(by_epoch, n)]


def walk_of(rng: np.random.Generator, t: Array, size: float) -> Array:
    """A relative path (K, 6) whose velocity walks, velocity first."""
    dt = t[1] - t[0]
    L = np.linalg.cholesky(size**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    steps = rng.normal(size=(len(t), 3, 2)) @ L.T
    out = np.zeros((len(t), 6))
    out[0] = [1.0, 0.5, -0.3, 30.0, 80.0, -10.0]
    for k in range(1, len(t)):
        out[k, :3] = out[k - 1, :3] + steps[k, :, 1]
        out[k, 3:] = out[k - 1, 3:] + dt * out[k - 1, :3] + steps[k, :, 0]
    return out


@pytest.mark.parametrize("kind", ["velocity", "acceleration"])
def test_check_14_turned_axes_change_nothing(kind: str) -> None:
    t = np.arange(0.0, 30.0)
    R = Rotation.random(random_state=5).as_matrix()
    walk = walk_of(np.random.default_rng(1), t, 0.3)
    found = []
    for turn in (np.eye(3), R):
        moving = Smooth(kind, 1, t, 0.3)  # type: ignore[arg-type]
        sources = distances_and_places(np.random.default_rng(2), turn, moving.size, walk)
        start = np.kron(np.eye(2), turn) @ (walk[0] + 0.5)
        track = filtering.run(moving, sources, t, (start, 4.0 * np.eye(6)))
        r, v, P = track.pair(0, 1)
        found.append((r @ turn, v @ turn, np.trace(P[:, :3, :3], axis1=1, axis2=2)))
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


def test_errors_are_as_large_as_told() -> None:
    t = np.arange(0.0, 20.0)
    values = []
    for seed in range(60):
        rng = np.random.default_rng([7, seed])
        walk = walk_of(rng, t, 0.3)
        moving = Smooth("velocity", 1, t, 0.3)
        sources = distances_and_places(rng, np.eye(3), moving.size, walk)
        start = walk[0] + rng.normal(size=6)
        track = filtering.run(moving, sources, t, (start, np.eye(6)))
        r, v, P = track.pair(0, 1)
        e = np.hstack([r[-1] - walk[-1, 3:], v[-1] - walk[-1, :3]])
        values.append(nees(e[None], P[-1:])[0])
    assert 6.0 - 3 * np.sqrt(12 / 60) < np.mean(values) < 6.0 + 3 * np.sqrt(12 / 60)


def test_rows_of_distances_are_the_derivative() -> None:
    source = rows.Distances({0: [rows.RangeRow(1, 2, np.array([0.1, -0.2, 0.3]), 40.0, 0.1, "b-c")]}, 15, scale=1.001)
    x = np.random.default_rng(3).normal(0.0, 20.0, 15)
    found = source.rows(0, x)
    assert found is not None
    nu, H = found.linearised(x)
    J = numerical_jacobian(lambda d: found.z - found.linearised(x + d)[0], 15, 1e-3)
    np.testing.assert_allclose(H, J, atol=1e-7)
    way = x[position(1)] - x[position(0)] + [0.1, -0.2, 0.3]
    assert nu[0] == pytest.approx(40.0 - 1.001 * np.linalg.norm(way))
    assert source.rows(1, x) is None


def test_a_distance_of_zero_says_nothing() -> None:
    source = rows.Distances({0: [rows.RangeRow(0, 1, np.zeros(3), 1.0, 0.1, "a-b")]}, 6)
    found = source.rows(0, np.zeros(6))
    assert found is not None
    nu, H = found.linearised(np.zeros(6))
    assert np.all(np.isfinite(nu)) and not np.any(H)


def test_stacked_rows_keep_order_and_names() -> None:
    a = rows.Rows(np.array([1.0, 2.0]), np.eye(2, 6), np.eye(2), np.array([rows.CODE, rows.DOPPLER]), ("b G02-G01", "b G02-G01"))
    b = rows.Distances({0: [rows.RangeRow(0, 1, np.zeros(3), 3.0, 0.5, "a-b")]}, 6).rows(0, np.ones(6))
    assert b is not None
    both = rows.stacked([a, b])
    assert [rows.KINDS[k] for k in both.kind] == ["code", "doppler", "range"]
    assert both.labels == ("b G02-G01", "b G02-G01", "a-b")
    assert both.z.tolist() == [1.0, 2.0, 3.0] and both.norm_rows.tolist() == [2] and both.R[2, 2] == 0.25


def test_an_epoch_without_rows_only_predicts() -> None:
    t = np.arange(0.0, 3.0)
    moving = Smooth("velocity", 1, t, 0.3)
    track = filtering.run(moving, [rows.Distances({}, 6)], t, (np.array([1.0, 0, 0, 0, 0, 0]), np.eye(6)))
    np.testing.assert_allclose(track.x[2, 3:6], [2.0, 0.0, 0.0])
    assert np.all(np.isnan(track.nis)) and not np.any(track.n_rows)


def test_samples_that_do_not_cover_the_epochs_are_told(flown: tuple[Exact, LocalFrame]) -> None:
    with pytest.raises(InputError, match=r"vehicle leader: its IMU and attitudes cover .* the epochs 0\.000 to 99\.000"):
        AttitudeReferenced(movers(flown), np.array([0.0, 99.0]), np.zeros((2, 3)))


def test_every_time_belongs_to_one_epoch() -> None:
    times = np.array([0.0, 1.0, 1.0011, 2.0, 2.0021, 2.0041, 3.0])
    epochs = rows.epochs_of(times[::-1])
    assert epochs.tolist() == [0.0, 1.0, 2.0, 2.0021, 3.0]
    assert rows.epoch_of(times, epochs).tolist() == [0, 1, 1, 2, 3, 3, 4]
    assert rows.epoch_of(np.array([-0.1, 0.5, 9.0]), epochs).tolist() == [-1, -1, -1]
    assert rows.measured_at(np.array([1.0011, 2.0021]), epochs).tolist() == [-1, 0, -1, 1, -1]
    assert rows.measured_at(np.zeros(0), epochs).tolist() == [-1] * 5
