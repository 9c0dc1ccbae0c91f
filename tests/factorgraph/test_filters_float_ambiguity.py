"""Float ambiguities: against batch least squares, through satellites that come, go and slip, with faults, statistically.

Integer search itself is checked against brute force in tests/ambiguity.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph.filters import float_ambiguity as fa
from factorgraph.filters import kalman
from factorgraph.filters.float_ambiguity import FloatFilter, FloatSettings, FloatSolution, InsBaseline, Scheme, single_epoch
from factorgraph.models import double_differences as dd
from factorgraph.models.double_differences import PairEpochs
from factorgraph.types import Array, IntArray
from tests.factorgraph.relative import LAM, SD_CYCLES, pair
from tests.helpers import assert_consistent

HERE = np.zeros(3)
TOLD = FloatSettings(code_m=0.13, phase_m=0.003, accel_walk=0.05, ambiguity_walk=0.0)
B0, V0 = np.array([40.0, -70.0, -10.0]), np.array([1.0, 2.0, -0.5])


def flight(K: int) -> tuple[Array, Array]:
    """Baseline and velocity (K, 3) of a steady approach."""
    return B0 + V0 * np.arange(K)[:, None], np.tile(V0, (K, 1))


def ins_of(b: Array, sigma: float = 0.3, rng: np.random.Generator | None = None) -> list[InsBaseline]:
    noise = np.zeros_like(b) if rng is None else sigma * rng.normal(size=b.shape)
    return [InsBaseline(x, sigma**2 * np.eye(3)) for x in b + noise]


def run(
    data: PairEpochs, scheme: Scheme = Scheme.EKF, told: FloatSettings = TOLD, ins: list[InsBaseline] | None = None
) -> list[FloatSolution | None]:
    estimator = FloatFilter(scheme, told)
    return [estimator.step(data, k, HERE, None if ins is None else ins[k]) for k in range(data.n_epochs)]


def solved(solutions: list[FloatSolution | None]) -> list[FloatSolution]:
    assert all(s is not None for s in solutions)
    return [s for s in solutions if s is not None]


def integers(s: FloatSolution, cycles: Array = SD_CYCLES) -> Array:
    return dd.difference(np.asarray(cycles, float), s.order)


# one epoch


def test_single_epoch_is_weighted_least_squares_of_everything() -> None:
    """Spec aar_two_stage.md, section 2.5: unknowns b and N at once, H = [G 0; G lam I], W = inv(R)."""
    rng = np.random.default_rng(1)
    data = pair(B0[None], settings=TOLD, rng=rng)
    s = single_epoch(data, 0, HERE, TOLD, B0 + 5.0)
    assert s is not None
    m = len(s.a_cyc)
    rho, _, G = dd.predict(
        data.sat_reference[0], data.sat_rover[0], data.vel_rover[0], data.vel_rover[0], s.order, HERE, HERE, s.b_n, HERE
    )  # fmt: skip
    H = np.block([[G, np.zeros((m, m))], [G, LAM * np.eye(m)]])
    R = np.zeros((2 * m, 2 * m))
    R[:m, :m] = dd.covariance(TOLD.code_m**2 * data.variance_scale[0], s.order)
    R[m:, m:] = dd.covariance(TOLD.phase_m**2 * data.variance_scale[0], s.order)
    Q = np.linalg.inv(H.T @ np.linalg.solve(R, H))
    y = np.concatenate([dd.difference(data.code_m[0], s.order), dd.difference(data.phase_m[0], s.order)])
    residual = y - np.concatenate([rho, rho + LAM * s.a_cyc])
    np.testing.assert_allclose(Q @ H.T @ np.linalg.solve(R, residual), 0.0, atol=1e-6)  # nothing to improve
    np.testing.assert_allclose(s.Q_b, Q[:3, :3], rtol=1e-6)
    np.testing.assert_allclose(s.Q_a, Q[3:, 3:], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(s.Q_ba, Q[:3, 3:], rtol=1e-6, atol=1e-9)


def test_errorless_epochs_are_exact() -> None:
    b, v = flight(5)
    data = pair(b, v)
    for k in range(5):
        s = single_epoch(data, k, HERE, TOLD, np.zeros(3))
        assert s is not None
        np.testing.assert_allclose(s.b_n, b[k], atol=1e-6)
        np.testing.assert_allclose(s.a_cyc, integers(s), atol=1e-5)
    for scheme, ins in ((Scheme.EKF, None), (Scheme.IEKF, ins_of(b))):
        last = solved(run(data, scheme, ins=ins))[-1]
        np.testing.assert_allclose(last.b_n, b[-1], atol=1e-3)
        np.testing.assert_allclose(last.a_cyc, integers(last), atol=0.02)


def test_three_satellites_are_too_few_four_are_enough() -> None:
    for n, known in ((3, False), (4, True)):
        data = pair(B0[None], n_sat=n)
        assert (single_epoch(data, 0, HERE, TOLD, B0) is not None) is known
        assert (FloatFilter(Scheme.EKF, TOLD).step(data, 0, HERE) is not None) is known


def test_wrong_uses_are_refused() -> None:
    with pytest.raises(ValueError, match="single_epoch"):
        FloatFilter(Scheme.WLS, TOLD)
    for scheme in (Scheme.IEKF, Scheme.IBRKF, Scheme.IBRCAF):
        with pytest.raises(ValueError, match="needs the baseline of the INS"):
            FloatFilter(scheme, TOLD).step(pair(B0[None]), 0, HERE)


# updates


@given(st.integers(0, 2**32 - 1), st.integers(3, 10), st.booleans())
@settings(deadline=None, max_examples=40)
def test_two_blocks_are_the_batch_update(seed: int, m: int, aided: bool) -> None:
    """Spec aar_two_stage.md, check 5: code and INS first, phase after, to 1e-9 of all at once."""
    rng = np.random.default_rng(seed)
    n = fa.N0 + m
    A = rng.normal(size=(n, 2 * n))
    s = np.repeat([2.0, 1.0, 0.5, 10.0], [3, 3, 3, m])
    P, x = A @ A.T / (2 * n) * np.outer(s, s), rng.normal(size=n)
    G, order = rng.normal(size=(m, 3)), np.arange(m + 1)
    R_code, R_phase = (dd.covariance(sigma**2 * rng.uniform(2, 6, m + 1), order) for sigma in (0.2, 0.05))
    ins = InsBaseline(rng.normal(size=3), np.diag(rng.uniform(0.01, 1.0, 3)))
    nu_code, nu_phase = rng.normal(size=m), rng.normal(size=m)
    nu_ins = ins.b_n - x[:3] if aided else None
    found, P_found = fa._two_blocks(x, P, G, LAM, nu_code, nu_phase, R_code, R_phase, ins if aided else None)
    zeros, eye = np.zeros((m, m)), np.eye(3)
    H = np.block([[G, np.zeros((m, 6)), zeros], [eye, np.zeros((3, 6 + m))], [G, np.zeros((m, 6)), LAM * np.eye(m)]])
    R = np.zeros((2 * m + 3, 2 * m + 3))
    R[:m, :m], R[m : m + 3, m : m + 3], R[m + 3 :, m + 3 :] = R_code, ins.R, R_phase
    nu = np.concatenate([nu_code, np.zeros(3) if nu_ins is None else nu_ins, nu_phase])
    rows = np.ones(len(nu), bool) if aided else np.r_[np.ones(m, bool), np.zeros(3, bool), np.ones(m, bool)]
    dx, P_batch, _ = kalman.update(P, nu[rows], H[rows], R[np.ix_(rows, rows)])
    np.testing.assert_allclose((found - x) / s, dx / s, atol=1e-9 * (1 + np.abs(dx / s).max()))
    np.testing.assert_allclose(P_found / np.outer(s, s), P_batch / np.outer(s, s), atol=1e-9)


def test_steps_are_those_of_a_plain_filter() -> None:
    """Six epochs against a filter written in matrices: time update, linearisation at the INS, batch update."""
    told = replace(TOLD, accel_walk=0.7, ambiguity_walk=0.3)
    rng = np.random.default_rng(3)
    b, v = flight(6)
    data, ins = pair(b, v, settings=told, rng=rng), ins_of(b, 0.5, rng)
    m = 6
    F = np.eye(9 + m)
    F[:3, 3:6] = F[3:6, 6:9] = np.eye(3)
    F[:3, 6:9] = 0.5 * np.eye(3)
    Q = np.diag(np.r_[np.zeros(6), np.full(3, 0.7**2), np.full(m, 0.3**2)])
    order = data.order(0)
    x = np.concatenate([ins[0].b_n, np.zeros(6), dd.difference((data.phase_m - data.code_m)[0], order) / LAM])
    P = np.diag(np.r_[fa.START_SIGMA, np.full(m, fa.NEW_CYC)] ** 2)
    for k, s in enumerate(solved(run(data, Scheme.IEKF, told, ins))):
        if k:
            x, P = F @ x, F @ P @ F.T + Q
        rho, _, G = dd.predict(
            data.sat_reference[k], data.sat_rover[k], data.vel_rover[k], data.vel_rover[k], order, HERE, HERE, ins[k].b_n, HERE
        )  # fmt: skip
        H = np.zeros((2 * m + 3, 9 + m))
        H[:m, :3] = H[m : 2 * m, :3] = G
        H[m : 2 * m, 9:], H[2 * m :, :3] = LAM * np.eye(m), np.eye(3)
        R = np.zeros((2 * m + 3, 2 * m + 3))
        R[:m, :m] = dd.covariance(told.code_m**2 * data.variance_scale[k], order)
        R[m : 2 * m, m : 2 * m] = dd.covariance(told.phase_m**2 * data.variance_scale[k], order)
        R[2 * m :, 2 * m :] = ins[k].R
        linear = rho - G @ ins[k].b_n
        z = np.concatenate([
            dd.difference(data.code_m[k], order) - linear, dd.difference(data.phase_m[k], order) - linear, ins[k].b_n,
        ])  # fmt: skip
        dx, P, _ = kalman.update(P, z - H @ x, H, R)
        x = x + dx
        np.testing.assert_allclose(s.b_n, x[:3], atol=1e-7)
        np.testing.assert_allclose(s.a_cyc, x[9:], atol=1e-6)
        np.testing.assert_allclose(s.Q_a, P[9:, 9:], rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(s.Q_ba, P[:3, 9:], rtol=1e-5, atol=1e-9)
        assert s.weights.min() == 1 and s.factors == (1.0, 1.0)


# satellites that come, go and slip


def against(old: IntArray, new: IntArray) -> Array:
    """T (m, m) with N_new = T N_old for the same satellites in another order, by way of single differences."""
    n = len(old)
    embedded = np.eye(n)[:, old[1:]]  # N of the old pivot is zero
    return np.asarray((np.eye(n)[new[1:]] - np.eye(n)[new[0]]) @ embedded)


def turned(data: PairEpochs, pivots: list[int]) -> PairEpochs:
    """The same data with another highest satellite at every epoch, and the same noise model."""
    elevation = np.where(np.arange(len(data.satellites)) == np.array(pivots)[:, None], 1.5, data.elevation_rad)
    return replace(data, elevation_rad=elevation)


@pytest.mark.parametrize("scheme", [Scheme.EKF, Scheme.IEKF])
def test_any_pivot_gives_the_same_baseline(scheme: Scheme) -> None:
    """A filter through changes of the pivot against one that keeps it.

    Without a random walk of the ambiguities: that of differences depends on the pivot.
    """
    b, v = flight(30)
    rng = np.random.default_rng(5)
    data, ins = pair(b, v, settings=TOLD, rng=rng), ins_of(b, 0.5, rng)
    kept = solved(run(data, scheme, ins=ins))
    pivots = [0] * 5 + [3] * 5 + [6, 2, 6, 2, 6] + [0] * 10 + [1] * 5
    changed = solved(run(turned(data, pivots), scheme, ins=ins))
    for k, (s, reference) in enumerate(zip(changed, kept, strict=True)):
        assert s.order[0] == pivots[k]
        np.testing.assert_allclose(s.b_n, reference.b_n, atol=1e-6)
        np.testing.assert_allclose(s.Q_b, reference.Q_b, rtol=1e-5, atol=1e-10)
        T = against(reference.order, s.order)
        np.testing.assert_allclose(s.a_cyc, T @ reference.a_cyc, atol=2e-5)
        np.testing.assert_allclose(s.Q_a, T @ reference.Q_a @ T.T, rtol=1e-4, atol=1e-9)


def precise(s: FloatSolution) -> Array:
    """Standard deviation of every satellite's ambiguity against the pivot, by satellite; NaN where there is none."""
    out = np.full(7, np.nan)
    out[s.order[1:]] = np.sqrt(np.diag(s.Q_a))
    return out


def test_satellites_set_and_rise_without_loss() -> None:
    """The pivot sets, others too, and come back: integers stay right, and only what is new is uncertain."""
    b, v = flight(60)
    seen = np.ones((60, 7), bool)
    seen[20:40, 0] = False  # the pivot
    seen[30:45, 3] = False
    data = pair(b, v, settings=TOLD, rng=np.random.default_rng(6), seen=seen)
    found = solved(run(data))
    for k, s in enumerate(found[15:], 15):
        assert sorted(s.order) == np.flatnonzero(seen[k]).tolist()
        assert np.all(np.abs(s.a_cyc - integers(s)) < 5 * np.sqrt(np.diag(s.Q_a)))
    assert found[20].order[0] == 4 and found[40].order[0] == 4 and found[41].order[0] == 0
    before, after = precise(found[19]), precise(found[20])
    assert np.nanmax(after) < 1.5 * np.nanmax(before)  # the pivot has gone, what was learned has not
    back = precise(found[40])
    assert np.nanmax(np.delete(back, [0, 3])) < 1.1 * np.nanmax(after)


def test_a_high_satellite_that_rises_is_not_the_pivot_at_once() -> None:
    """As the pivot it would reset every ambiguity: nothing is known against it yet."""
    b, v = flight(40)
    seen = np.ones((40, 7), bool)
    seen[:30, 0] = False
    found = solved(run(pair(b, v, settings=TOLD, rng=np.random.default_rng(7), seen=seen)))
    assert [found[k].order[0] for k in (29, 30, 31)] == [4, 4, 0]
    before, after = precise(found[29]), precise(found[30])
    assert np.nanmax(after[1:]) < 1.1 * np.nanmax(before[1:])
    assert np.sqrt(np.trace(found[31].Q_b)) < 1.1 * np.sqrt(np.trace(found[29].Q_b))


@pytest.mark.parametrize("slipped", [[0], [5], [0, 2, 5], list(range(7))])
def test_flagged_slips_start_anew(slipped: list[int]) -> None:
    """Also of the pivot, also of all at once: the baseline does not notice, the new integers are found."""
    K, at = 60, 30
    b, v = flight(K)
    cycles, arc = np.tile(SD_CYCLES[:7], (K, 1)), np.tile(np.arange(7), (K, 1))
    cycles[at:, slipped] += np.arange(1, len(slipped) + 1) * 7.0
    arc[at:, slipped] += 100
    data = pair(b, v, settings=TOLD, rng=np.random.default_rng(8), cycles=cycles, arc=arc)
    found = solved(run(data))
    for k in range(10, K):
        s = found[k]
        assert np.all(np.abs(s.b_n - b[k]) < 5 * np.sqrt(np.diag(s.Q_b)))
        assert np.all(np.abs(s.a_cyc - integers(s, cycles[k])) < 5 * np.sqrt(np.diag(s.Q_a)))
    before, after = precise(found[at - 1]), precise(found[at])
    kept = [i for i in range(7) if i not in slipped]
    if kept:
        assert found[at].order[0] in kept
        assert np.nanmax(after[kept]) < 1.5 * np.nanmax(before)  # what the others know stays
    unflagged = solved(run(replace(data, arc=np.tile(np.arange(7), (K, 1)))))
    wrong = max(np.abs(s.b_n - b[k]).max() for k, s in enumerate(unflagged[at:], at))
    right = max(np.abs(s.b_n - b[k]).max() for k, s in enumerate(found[at:], at))
    assert wrong > 3 * right


def test_too_few_satellites_are_bridged_by_prediction() -> None:
    """No solution for five epochs of three satellites; afterwards the motion and the unbroken ambiguities go on."""
    b, v = flight(50)
    seen = np.ones((50, 7), bool)
    seen[30:35, 3:] = False
    estimator = FloatFilter(Scheme.EKF, TOLD)
    data = pair(b, v, settings=TOLD, rng=np.random.default_rng(9), seen=seen)
    found = [estimator.step(data, k, HERE) for k in range(35)]
    assert [s is None for s in found] == [not 0 <= k < 30 for k in range(35)]
    np.testing.assert_allclose(estimator._x[:3], b[34], atol=1.0)  # predicted all the way, not left behind: 11 m
    s = estimator.step(data, 35, HERE)
    before = found[29]
    assert s is not None and before is not None
    assert np.all(np.abs(s.b_n - b[35]) < 5 * np.sqrt(np.diag(s.Q_b)))
    assert np.nanmax(precise(s)) < 1.2 * np.nanmax(precise(before))
    none = FloatFilter(Scheme.EKF, TOLD)
    late = pair(b[30:], v[30:], settings=TOLD, rng=np.random.default_rng(9), seen=seen[30:])
    assert [none.step(late, k, HERE) is None for k in range(6)] == [True] * 5 + [False]  # nor does it start with three


# faults


def spoilt(data: PairEpochs, k: int, s: int, error_m: float) -> PairEpochs:
    code = data.code_m.copy()
    code[k, s] += error_m
    return replace(data, code_m=code)


def test_robust_weights_reject_a_code_error() -> None:
    b, v = flight(40)
    rng = np.random.default_rng(10)
    data, ins = spoilt(pair(b, v, settings=TOLD, rng=rng), 30, 5, 20.0), ins_of(b, 0.3, rng)
    told = replace(TOLD, accel_walk=1.0, ambiguity_walk=1.0)  # a filter that believes codes
    off = {}
    for scheme in (Scheme.IEKF, Scheme.IBRKF, Scheme.IBRCAF):
        s = solved(run(data, scheme, told, ins))[30]
        off[scheme] = np.linalg.norm(s.b_n - b[30])
        weight = dict(zip(s.order[1:].tolist(), s.weights, strict=True))
        assert weight[5] == (1.0 if scheme is Scheme.IEKF else 1e-12)
    assert off[Scheme.IBRKF] < 0.3 * off[Scheme.IEKF] and off[Scheme.IBRCAF] < 0.3 * off[Scheme.IEKF]


def test_classified_factors_answer_a_wrong_prediction() -> None:
    """5 m/s on the velocity: when the position that follows from it is wrong, the adaptive scheme gives its prediction up."""
    b, v = flight(40)
    rng = np.random.default_rng(11)
    data, ins = pair(b, v, settings=TOLD, rng=rng), ins_of(b, 0.1, rng)
    told = replace(TOLD, c0=1e9, c1=2e9)  # codes are all kept: factors alone
    off = {}
    for scheme in (Scheme.IEKF, Scheme.IBRKF, Scheme.IBRCAF):
        estimator, factors = FloatFilter(scheme, told), []
        for k in range(34):
            s = estimator.step(data, k, HERE, ins[k], 5.0 / np.sqrt(3) * np.ones(3) if k == 30 else None)
            assert s is not None
            factors.append(min(s.factors))
        off[scheme] = np.linalg.norm(estimator._x[3:6] - v[33])
        assert (factors[31] < 0.1) == (scheme is Scheme.IBRCAF) and min(factors[5:31]) == 1
    assert off[Scheme.IBRCAF] < 0.2 * off[Scheme.IEKF] and off[Scheme.IBRKF] == off[Scheme.IEKF]


def test_thresholds_out_of_reach_leave_the_plain_filter() -> None:
    """Spec aar_two_stage.md, check 7: bit for bit."""
    b, v = flight(30)
    rng = np.random.default_rng(12)
    data, ins = pair(b, v, settings=TOLD, rng=rng), ins_of(b, 0.3, rng)
    plain = solved(run(data, Scheme.IEKF, ins=ins))
    for scheme in (Scheme.IBRKF, Scheme.IBRCAF):
        for passes in (1, 3):
            told = replace(TOLD, c0=1e6, c1=2e6, c2=1e6, passes=passes)
            for s, reference in zip(solved(run(data, scheme, told, ins)), plain, strict=True):
                np.testing.assert_array_equal(s.a_cyc, reference.a_cyc)
                np.testing.assert_array_equal(s.Q_a, reference.Q_a)
                np.testing.assert_array_equal(s.b_n, reference.b_n)


@pytest.mark.parametrize("statistic", ["literal", "normalised"])
@pytest.mark.parametrize("code_statistic", ["predicted", "postfit"])
def test_variants_of_the_statistics_reject_gross_errors(statistic: Any, code_statistic: Any) -> None:
    b, v = flight(40)
    rng = np.random.default_rng(13)
    data, ins = spoilt(pair(b, v, settings=TOLD, rng=rng), 30, 4, 40.0), ins_of(b, 0.1, rng)
    told = replace(TOLD, accel_walk=1.0, ambiguity_walk=1.0, statistic=statistic, code_statistic=code_statistic, passes=3)
    robust, plain = (solved(run(data, scheme, told, ins))[30] for scheme in (Scheme.IBRCAF, Scheme.IEKF))
    assert np.linalg.norm(robust.b_n - b[30]) < 0.5 * np.linalg.norm(plain.b_n - b[30])


# statistics


@pytest.mark.parametrize("scheme", [Scheme.WLS, Scheme.EKF, Scheme.IEKF])
def test_errors_and_covariances_agree(scheme: Scheme) -> None:
    """Motion and noise drawn from the filter's own model, 60 flights of 25 epochs: NEES of b, of N and of both, two-sided."""
    told = FloatSettings(code_m=0.185, phase_m=0.005, accel_walk=0.5, ambiguity_walk=0.05)
    rng = np.random.default_rng(14)
    K, m = 25, 6
    errors, covariances = [], []
    for _ in range(60):
        x = np.concatenate([B0, V0, rng.normal(0, 0.5, 3)])
        b, walk = np.empty((K, 3)), np.zeros((K, m))
        for k in range(K):
            if k:
                x[:3] += x[3:6] + 0.5 * x[6:]
                x[3:6] += x[6:]
                x[6:] += told.accel_walk * rng.normal(size=3)
                walk[k] = walk[k - 1] + told.ambiguity_walk * rng.normal(size=m)
            b[k] = x[:3]
        N = SD_CYCLES[:7] + np.column_stack([np.zeros(K), walk])  # differences against satellite 0, the pivot, walk
        data = pair(b, settings=told, rng=rng, cycles=N)
        if scheme is Scheme.WLS:
            s = single_epoch(data, K - 1, HERE, told, np.zeros(3))
        else:
            ins = ins_of(b, 0.2, rng) if scheme is Scheme.IEKF else None
            s = run(data, scheme, told, ins)[-1]
        assert s is not None and s.order[0] == 0
        errors.append(np.concatenate([s.b_n - b[-1], s.a_cyc - integers(s, N[-1])]))
        covariances.append(np.block([[s.Q_b, s.Q_ba], [s.Q_ba.T, s.Q_a]]))
    error, cov = np.array(errors), np.array(covariances)
    assert_consistent(error, cov)
    assert_consistent(error[:, :3], cov[:, :3, :3])
    assert_consistent(error[:, 3:], cov[:, 3:, 3:])


def test_more_information_never_harms_the_ambiguities() -> None:
    """Erratum E20: det Q_a falls from one epoch alone to the filter to the aided filter, for any INS precision."""
    b, v = flight(20)
    data = pair(b, v)
    alone = single_epoch(data, 19, HERE, TOLD, B0)
    filtered = run(data)[-1]
    assert alone is not None and filtered is not None
    det = [np.linalg.slogdet(s.Q_a)[1] for s in (alone, filtered)]
    for sigma in (30.0, 3.0, 0.3, 0.03):
        aided = run(data, Scheme.IEKF, ins=ins_of(b, sigma))[-1]
        assert aided is not None
        det.append(np.linalg.slogdet(aided.Q_a)[1])
    assert np.all(np.diff(det) <= 1e-6)
