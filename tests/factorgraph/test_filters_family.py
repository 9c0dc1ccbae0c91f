"""The family of measurement updates, adaptations and the smoother, against closed forms and each other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.filters import adaptive, kalman, smoother, updates
from factorgraph.filters.sigma_points import Rule, cubature, downdate, lower, root, spread, through, unscented
from factorgraph.types import Array
from tests.factorgraph.test_filters_kalman import spd

RULES = {
    "cubature": cubature,
    "unscented": unscented,
    "narrow": partial(unscented, alpha=1e-2),
    "negative centre": partial(unscented, beta=0.0, kappa=-1.0),
    "wide": partial(unscented, alpha=1.5, beta=2.0),
}
every_rule = pytest.mark.parametrize("rule_of", RULES.values(), ids=RULES.keys())
RANGE_M = 2.2e7


def linear_case(seed: int, n: int = 6, m: int = 9) -> tuple[Array, Array, Array]:
    """P, e, H of whitened rows, the last of which says nothing."""
    rng = np.random.default_rng(seed)
    e, H = rng.normal(size=m), rng.normal(size=(m, n))
    e[-1], H[-1] = 0.0, 0.0
    return spd(rng, n), e, H


def of_linear(e: Array, H: Array) -> tuple[Callable[[Array], tuple[Array, Array]], Callable[[Array], Array]]:
    """The same rows as a linearisation and as residuals of many points."""
    return lambda d: (e - H @ d, H), lambda D: e - D @ H.T


def unbounded(t: Array) -> Array:
    return np.ones_like(t)


# -- linear and Gaussian: one filter ---------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@every_rule
def test_all_updates_are_kalmans_where_rows_are_linear(seed: int, rule_of: Callable[[int], Rule]) -> None:
    P, e, H = linear_case(seed)
    linearise, residuals = of_linear(e, H)
    rule = rule_of(len(P))
    dx, posterior, nis = kalman.update(P, e, H, np.eye(len(e)))
    white = kalman.whiten(*updates.statistical(root(P), residuals, rule))
    found = {
        "linear": updates.linear(P, e, H),
        "iterated": updates.iterated(P, linearise),
        "sigma point": updates.sigma_point(P, residuals, rule),
        "square root": updates.square_root(root(P), residuals, rule),
        "huber": updates.regression(P, e, H, unbounded),
        "huber, sigma point": updates.regression(P, *white, unbounded),
        "robust": updates.robust_fading(P, 0.1 * e, H, unbounded),
    }
    s = np.sqrt(np.diag(P))
    for name, u in found.items():
        share = 0.1 if name == "robust" else 1.0
        np.testing.assert_allclose(u.dx / s, share * dx / s, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(u.P / np.outer(s, s), posterior / np.outer(s, s), atol=1e-10, err_msg=name)
        assert u.nis == pytest.approx(share**2 * nis, rel=1e-9), name
    assert found["iterated"].steps <= 2


@every_rule
def test_time_update_is_kalmans_where_motion_is_linear(rule_of: Callable[[int], Rule]) -> None:
    rng = np.random.default_rng(5)
    P, Q, F = spd(rng, 5), spd(rng, 4), rng.normal(size=(4, 5))
    for mean, covariance, cross in (
        updates.predict(P, lambda D: 7.0 + D @ F.T, Q, rule_of(5)),
        updates.predict_root(root(P), lambda D: 7.0 + D @ F.T, root(Q), rule_of(5)),
    ):
        full = covariance if covariance[0, 1] != 0 else covariance @ covariance.T
        np.testing.assert_allclose(mean, 7.0, rtol=1e-12)
        np.testing.assert_allclose(full, F @ P @ F.T + Q, atol=1e-10 * np.abs(full).max())
        np.testing.assert_allclose(cross, P @ F.T, atol=1e-10 * np.abs(cross).max())


def test_rows_that_say_nothing_change_nothing() -> None:
    """As many rows, fewer directions: rows with and without a common clock taken out by a projection."""
    P, e, H = linear_case(1, m=8)
    n = len(e)
    one = np.ones((n, 1)) / np.sqrt(n)
    e, H = e - one[:, 0] * (one.T @ e), H - one @ (one.T @ H)
    basis = np.linalg.svd(np.eye(n) - one @ one.T)[0][:, : n - 1]
    for function in (
        updates.linear,
        lambda P, e, H: updates.sigma_point(P, of_linear(e, H)[1], cubature(len(P))),
        lambda P, e, H: updates.square_root(root(P), of_linear(e, H)[1], unscented(len(P))),
        lambda P, e, H: updates.iterated(P, of_linear(e, H)[0]),
    ):
        whole, fewer = function(P, e, H), function(P, basis.T @ e, basis.T @ H)
        np.testing.assert_allclose(whole.dx, fewer.dx, atol=1e-10)
        np.testing.assert_allclose(whole.P, fewer.P, atol=1e-10)
        assert whole.nis == pytest.approx(fewer.nis)


# -- moments ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha, kappa", [(1.0, 0.0), (0.1, 0.0), (0.5, 2.0), (1e-3, 0.0)])
def test_unscented_points_know_the_moments_of_a_square(alpha: float, kappa: float) -> None:
    """x' x of x ~ N(0, P): mean tr P; one variable's variance 2 P^2, which beta = 2 meets."""
    rng = np.random.default_rng(1)
    P = spd(rng, 4)
    s = through(lambda D: np.sum(D**2, axis=1, keepdims=True), root(P), unscented(4, alpha, 2.0, kappa))
    assert s.mean[0] == pytest.approx(np.trace(P), rel=1e-8)
    one = through(lambda D: 3.0 + D**2, np.array([[0.7]]), unscented(1, alpha, 2.0, 0.0))
    assert one.mean[0] == pytest.approx(3.49, rel=1e-8)
    if alpha < 0.2:  # the fourth moment as alpha goes to zero
        assert one.covariance[0, 0] == pytest.approx(2 * 0.7**4, rel=0.02)


def test_the_weights_are_the_textbooks() -> None:
    """Sum of weighted squares about the mean with the centre's own weights, erratum E1 of the printed sign."""
    n, alpha, beta, kappa = 3, 0.9, 1.4, 0.5
    rng = np.random.default_rng(3)
    L = root(spd(rng, n))
    lam = alpha**2 * (n + kappa) - n
    wm = np.r_[lam / (n + lam), np.full(2 * n, 0.5 / (n + lam))]
    wc = wm + np.r_[1 - alpha**2 + beta, np.zeros(2 * n)]
    rule = unscented(n, alpha, beta, kappa)
    D = spread(L, rule.gamma)
    Y = np.column_stack([np.sin(D[:, 0]) + D[:, 1] ** 2, np.exp(0.3 * D[:, 2]) * D[:, 0]])
    mean = wm @ Y
    s = through(lambda _: Y, L, rule)
    np.testing.assert_allclose(s.mean, mean, atol=1e-13)
    np.testing.assert_allclose(s.covariance, (wc[:, None] * (Y - mean)).T @ (Y - mean), atol=1e-13)
    np.testing.assert_allclose(L @ s.G.T, (wm[:, None] * D).T @ (Y - mean), atol=1e-13)
    with pytest.raises(InputError, match="kappa"):
        unscented(3, kappa=-3.0)


def test_cubature_is_exact_to_the_third_degree() -> None:
    L = root(np.array([[2.0, 0.5], [0.5, 1.0]]))

    def monomials(D: Array) -> Array:
        x, y = D.T
        return np.column_stack([x, x * y, x**2, x**3, x**2 * y, x * y**2, y**3])

    s = through(monomials, L, cubature(2))
    np.testing.assert_allclose(s.mean, [0, 0.5, 2.0, 0, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose((L @ s.G.T)[:, 0], [2.0, 0.5], atol=1e-12)


def test_roots_and_what_is_taken_off_them() -> None:
    rng = np.random.default_rng(4)
    A, x = rng.normal(size=(5, 9)), rng.normal(size=5)
    L = lower(A)
    np.testing.assert_allclose(L @ L.T, A @ A.T, atol=1e-12)
    assert np.all(np.diag(L) > 0) and np.all(np.triu(L, 1) == 0)
    more = lower(np.column_stack([A, x]))
    np.testing.assert_allclose(downdate(more, x), L, atol=1e-10)
    with pytest.raises(np.linalg.LinAlgError):
        downdate(L, 100 * x)


# -- ranges of satellites ---------------------------------------------------------------------------


def sky(rng: np.random.Generator, m: int) -> Array:
    """Satellites (m, 3) above the horizon."""
    u = rng.normal(size=(m, 3))
    u[:, 2] = np.abs(u[:, 2]) + 0.2
    return np.asarray(RANGE_M * u / np.linalg.norm(u, axis=1)[:, None])


@pytest.mark.parametrize("by_root", [False, True])
@every_rule
def test_long_runs_with_raw_ranges_stay_positive_definite(rule_of: Callable[[int], Rule], by_root: bool) -> None:
    """Position, velocity, clock and drift, code of 1 m, phase of 3 mm, for 400 epochs: and the errors are as large as said."""
    rng = np.random.default_rng(11)
    n, sigma = 8, np.r_[np.full(7, 1.0), np.full(7, 0.003)]
    sats = np.tile(sky(rng, 7), (2, 1))
    F = np.eye(n)
    F[:3, 3:6], F[6, 7] = np.eye(3), 1.0
    Q = np.diag(np.r_[np.full(3, 1e-6), np.full(3, 1e-4), 1e-4, 1e-4])
    x, truth, P, rule = np.zeros(n), np.r_[30.0, -20, 10, 1, 2, 0.1, 50, 0.3], np.diag(np.full(n, 1e4)), rule_of(n)
    L, nees = root(P), []
    for _ in range(400):
        truth, x = F @ truth + rng.normal(size=n) * np.sqrt(np.diag(Q)), F @ x
        z = np.linalg.norm(sats - truth[:3], axis=1) + truth[6] + sigma * rng.normal(size=14)

        def residuals(D: Array, x: Array = x, z: Array = z) -> Array:
            X = x + D
            return np.asarray((z - np.linalg.norm(sats - X[:, None, :3], axis=2) - X[:, 6:7]) / sigma)

        if by_root:
            L = updates.predict_root(L, lambda D: D @ F.T, np.diag(np.sqrt(np.diag(Q))), rule)[1]
            u = updates.square_root(L, residuals, rule)
            assert u.L is not None
            L = u.L
        else:
            u = updates.sigma_point(updates.predict(P, lambda D: D @ F.T, Q, rule)[1], residuals, rule)
            P = u.P
        x = x + u.dx
        assert np.all(np.linalg.eigvalsh(u.P) > 0)
        nees.append((x - truth) @ np.linalg.solve(u.P, x - truth))
    assert 5.0 < np.mean(nees[50:]) < 12.0


# -- nonlinear ---------------------------------------------------------------------------------------


def bent(seed: int) -> tuple[Array, Callable[[Array], tuple[Array, Array]], Callable[[Array], Array]]:
    """Ranges to near anchors from a prior that is metres off."""
    rng = np.random.default_rng(seed)
    anchors, truth, sigma = rng.uniform(-8, 8, (6, 2)), np.array([2.0, -1.5]), 0.05
    z = np.linalg.norm(anchors - truth, axis=1) + sigma * rng.normal(size=6)

    def linearise(d: Array) -> tuple[Array, Array]:
        rho = np.linalg.norm(anchors - d, axis=1)
        return (z - rho) / sigma, (d - anchors) / rho[:, None] / sigma

    return np.diag([4.0, 4.0]), linearise, lambda D: np.array([linearise(d)[0] for d in D])


@pytest.mark.parametrize("seed", range(3))
def test_iteration_ends_where_gauss_newton_does(seed: int) -> None:
    P, linearise, _ = bent(seed)
    u = updates.iterated(P, linearise, steps=30)
    d = np.zeros(2)
    for _ in range(50):
        e, H = linearise(d)
        information = np.linalg.inv(P) + H.T @ H
        d = d + np.linalg.solve(information, H.T @ e - np.linalg.solve(P, d))
    np.testing.assert_allclose(u.dx, d, atol=1e-7)
    np.testing.assert_allclose(u.P, np.linalg.inv(information), rtol=1e-6)
    e, H = linearise(d)
    assert u.nis == pytest.approx(e @ e + d @ np.linalg.solve(P, d), rel=1e-6)
    once = updates.linear(P, *linearise(np.zeros(2)))
    assert np.linalg.norm(u.dx - d) < 1e-3 * np.linalg.norm(once.dx - d)


@every_rule
def test_roots_and_covariances_agree_where_rows_bend(rule_of: Callable[[int], Rule]) -> None:
    P, _, residuals = bent(0)
    P = 0.01 * P
    full, rooted = (
        updates.sigma_point(P, residuals, rule_of(2)),
        updates.square_root(root(P), residuals, rule_of(2)),
    )
    np.testing.assert_allclose(rooted.dx, full.dx, rtol=1e-9)
    np.testing.assert_allclose(rooted.P, full.P, atol=1e-10 * np.abs(full.P).max())
    assert rooted.nis == pytest.approx(full.nis)


def test_sigma_points_know_that_far_ranges_bend() -> None:
    """Range to an anchor from a wide prior across the line of sight: sqrt(9 + y^2), biased by y^2 / 6 to second order."""
    s = through(lambda D: np.sqrt((3 + D[:, :1]) ** 2 + D[:, 1:] ** 2), np.diag([0.01, 0.5]), unscented(2))
    draws = np.random.default_rng(0).normal(size=(200_000, 2)) * [0.01, 0.5]
    rho = np.sqrt((3 + draws[:, 0]) ** 2 + draws[:, 1] ** 2)
    assert s.mean[0] == pytest.approx(rho.mean(), abs=1e-3)
    assert s.mean[0] - 3 > 0.03
    assert rho.var() > 30 * 0.01**2  # what a linearisation says
    assert 0.5 * rho.var() < s.covariance[0, 0] < 2 * rho.var()


# -- robust -------------------------------------------------------------------------------------------


def test_huber_stands_an_outlier_and_costs_little_without() -> None:
    rng = np.random.default_rng(8)
    n, m, trials = 2, 12, 1500
    P = np.diag([100.0, 100.0])
    errors: dict[str, list[Array]] = {"plain": [], "huber": [], "plain, outlier": [], "huber, outlier": []}
    for _ in range(trials):
        H, x = rng.normal(size=(m, n)), rng.normal(size=n)
        e = H @ x + rng.normal(size=m)
        bad = e.copy()
        bad[0] += 20.0
        for name, rows in (("", e), (", outlier", bad)):
            errors["plain" + name].append(updates.linear(P, rows, H).dx - x)
            errors["huber" + name].append(updates.regression(P, rows, H).dx - x)
    size = {name: np.mean(np.square(found)) for name, found in errors.items()}
    assert size["huber"] < 1.07 * size["plain"]  # 5 % and what 1500 draws scatter
    assert size["huber, outlier"] < 2.5 * size["plain"] < 0.1 * size["plain, outlier"]


def test_huber_weighs_a_prior_that_is_wrong() -> None:
    """Six rows of a quarter of a unit each pull more than the prior's bounded influence."""
    H = np.vstack([4 * np.eye(2)] * 6)
    u = updates.regression(0.01 * np.eye(2), H @ np.array([5.0, 0.0]), H)
    plain = updates.linear(0.01 * np.eye(2), H @ np.array([5.0, 0.0]), H)
    assert u.dx[0] > 4.7 > 1.5 * plain.dx[0] and abs(u.dx[1]) < 1e-9
    assert u.P[0, 0] > 1.5 * u.P[1, 1]


def test_robust_fading_tells_a_bad_row_from_a_bad_prior() -> None:
    rng = np.random.default_rng(2)
    H = rng.normal(size=(12, 3))
    P = 0.01 * np.eye(3)
    weigh = partial(np.vectorize(lambda t: 1.0 if abs(t) <= 1.5 else 1.5 / abs(t), otypes=[float]))
    e = 0.3 * rng.normal(size=12)
    e[4] = 30.0
    one = updates.robust_fading(P, e, H, weigh)
    assert one.weights is not None and one.weights[4] < 0.1 and np.all(np.delete(one.weights, 4) == 1.0)
    moved = updates.robust_fading(P, H @ np.array([4.0, -3.0, 2.0]), H, unbounded)
    assert moved.theta < 0.05
    np.testing.assert_allclose(moved.dx, [4.0, -3.0, 2.0], atol=0.5)
    approximate = updates.robust_fading(P, H @ np.array([4.0, -3.0, 2.0]), H, unbounded, "approximate")
    assert moved.theta < approximate.theta < 1.0


@pytest.mark.parametrize("form", ["exact", "approximate"])
def test_trace_ratio_is_a_share(form: str) -> None:
    rng = np.random.default_rng(6)
    for _ in range(2000):
        R = rng.uniform(0.1, 50)
        S = R + rng.uniform(0, 50)
        theta = adaptive.trace_ratio(rng.uniform(0, 300), S, R, form)  # type: ignore[arg-type]
        assert 0 < theta <= 1


# -- adaptation ---------------------------------------------------------------------------------------


def noisy_filter(level: adaptive.Level | None, residual: bool, rng: np.random.Generator) -> tuple[Array, Array]:
    """A random walk seen by two classes of rows, the second of which is three times noisier from epoch 300 on: its factors."""
    levels = adaptive.NoiseLevels(level, 2) if level is not None else None
    P, x, truth, classes = np.eye(2), np.zeros(2), np.zeros(2), np.repeat([0, 1], 6)
    factors, errors = [], []
    for k in range(600):
        truth = truth + 0.3 * rng.normal(size=2)
        P = P + 0.09 * np.eye(2)
        H = rng.normal(size=(12, 2))
        z = H @ truth + rng.normal(size=12) * np.where(classes == 1, 3.0 if k >= 300 else 1.0, 1.0)
        scale = np.ones(12) if levels is None else np.sqrt(levels.factors[classes])
        e, prior = z - H @ x, P
        u = updates.linear(P, e / scale, H / scale[:, None])
        x, P = x + u.dx, u.P
        if levels is not None:
            sample = adaptive.residual_samples(e - H @ u.dx, H, P) if residual else adaptive.innovation_samples(e, H, prior)
            levels.add(sample, classes)
            factors.append(levels.factors)
        errors.append(x - truth)
    return np.array(factors), np.array(errors)


@pytest.mark.parametrize("memory", ["window", "forgetting", "fading"])
@pytest.mark.parametrize("residual", [False, True])
def test_a_noise_level_that_changes_is_found(memory: adaptive.Memory, residual: bool) -> None:
    """Windows of innovations (IAE) and residuals (RAE), forgetting weights, Sage and Husa's recursion."""
    level = adaptive.Level(memory, forget=0.95)
    factors, errors = noisy_filter(level, residual, np.random.default_rng(21))
    _, plain = noisy_filter(None, residual, np.random.default_rng(21))
    assert factors[60:300].mean(axis=0) == pytest.approx([1.0, 1.0], abs=0.15)
    assert factors[360:].mean(axis=0) == pytest.approx([1.0, 9.0], rel=0.15)
    assert np.mean(errors[360:] ** 2) < 0.9 * np.mean(plain[360:] ** 2)


def test_memories_weigh_as_they_say() -> None:
    np.testing.assert_allclose(adaptive.Level("window").weights(3), 1.0)
    np.testing.assert_allclose(adaptive.Level("forgetting").weights(20)[::-1][[0, -1]], [0.513, 0.076], atol=5e-4)
    b, s = 0.9, 0.0
    levels = adaptive.NoiseLevels(adaptive.Level("fading", forget=b, bounds=(1e-9, 1e9)), 1)
    for k, x in enumerate([4.0, 2.0, 9.0, 1.0]):
        d = (1 - b) / (1 - b ** (k + 1))
        s = (1 - d) * s + d * x
        levels.add(np.array([x]), np.zeros(1, int))
        assert levels.factors[0] == pytest.approx(s)
    with pytest.raises(InputError, match="forget"):
        adaptive.Level(forget=1.0)
    with pytest.raises(InputError, match="bounds"):
        adaptive.Level(bounds=(2.0, 3.0))


def test_rows_of_a_clock_count_less() -> None:
    """Projected rows have smaller residuals by their share in the clock: the level is the noise's all the same."""
    rng = np.random.default_rng(3)
    levels = adaptive.NoiseLevels(adaptive.Level(epochs=500), 1)
    for _ in range(500):
        e = 2.0 * rng.normal(size=5)
        levels.add((e - e.mean()) ** 2, np.zeros(5, int), np.full(5, 0.8))
    assert levels.factors[0] == pytest.approx(4.0, rel=0.1)


def test_strong_tracking_follows_a_manoeuvre() -> None:
    """Constant velocity, its noise taken for far too small: after a turn the filter is back in a few epochs."""
    F, Q, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.diag([1e-6, 1e-6]), np.array([[1.0, 0.0], [1.0, 0.0]]) / 0.1

    def late(adaptation: bool) -> tuple[float, float]:
        rng = np.random.default_rng(4)
        x, P, truth, state = np.zeros(2), np.eye(2), np.zeros(2), adaptive.Fading()
        before: list[float] = []
        after: list[float] = []
        for k in range(200):
            truth = F @ truth + [0, 3.0 if k == 150 else 0.0]
            e = H @ (truth - F @ x) + rng.normal(size=2)
            moved, lam = kalman.predict(P, F, np.zeros((2, 2))), 1.0
            if adaptation:
                lam, state = state.step(e, float(np.trace(H @ Q @ H.T)), float(np.trace(H @ moved @ H.T)), 2.0)
            u = updates.linear(lam * moved + Q, e, H)
            x, P = F @ x + u.dx, u.P
            (before if k < 150 else after).append(abs(x[0] - truth[0]))
        return float(np.mean(before[50:])), float(np.mean(after[5:]))

    calm, turned = late(True)
    calm_plain, turned_plain = late(False)
    assert turned < 0.2 * turned_plain and turned < 0.15
    assert calm < 4 * calm_plain


def test_process_noise_from_corrections() -> None:
    """A random walk whose steps the filter does not know: corrections say how large they are."""
    rng = np.random.default_rng(9)
    q, truth, x, P, C = 4.0, 0.0, 0.0, 1.0, []
    Q = 0.01
    for _ in range(2000):
        truth += np.sqrt(q) * rng.normal()
        P += Q
        nu = truth - x + 0.5 * rng.normal()
        K = P / (P + 0.25)
        x, P = x + K * nu, (1 - K) * P
        C.append(nu**2)
        Q = adaptive.process_noise(np.array([[K]]), np.array([[np.mean(C[-50:])]]), np.array([[0.01]]))[0, 0]
    assert Q == pytest.approx(q, rel=0.5)


# -- smoother -----------------------------------------------------------------------------------------


def test_smoother_is_the_batch_solution() -> None:
    """A linear chain whose states come and go, once by all rows at a time: means and covariances to 1e-10."""
    rng = np.random.default_rng(12)
    sizes = [3, 3, 4, 2, 3]
    F = [rng.normal(size=(b, a)) for a, b in pairwise(sizes)]
    Q = [spd(rng, b) for b in sizes[1:]]
    H = [rng.normal(size=(4, n)) for n in sizes]
    z = [rng.normal(size=4) for _ in sizes]
    P0 = spd(rng, sizes[0])
    first = np.concatenate([[0], np.cumsum(sizes)])
    A, b = np.zeros((first[-1], first[-1])), np.zeros(first[-1])
    part = [slice(first[k], first[k + 1]) for k in range(len(sizes))]
    A[part[0], part[0]] += np.linalg.inv(P0)
    x, P, x_prior, P_prior = [np.zeros(sizes[0])], [P0], [], []
    for k in range(len(sizes)):
        if k:
            J = np.hstack([-F[k - 1], np.eye(sizes[k])])
            both = slice(part[k - 1].start, part[k].stop)
            A[both, both] += J.T @ np.linalg.solve(Q[k - 1], J)
            x_prior.append(F[k - 1] @ x[-1])
            P_prior.append(F[k - 1] @ P[-1] @ F[k - 1].T + Q[k - 1])
            x.append(x_prior[-1])
            P.append(P_prior[-1])
        A[part[k], part[k]] += H[k].T @ H[k]
        b[part[k]] += H[k].T @ z[k]
        u = updates.linear(P[k], z[k] - H[k] @ x[k], H[k])
        x[k], P[k] = x[k] + u.dx, u.P
    xs, Ps = smoother.chain(x, P, x_prior, P_prior, F, Q)
    joint = np.linalg.inv(A)
    for k, rows in enumerate(part):
        np.testing.assert_allclose(xs[k], (joint @ b)[rows], atol=1e-10)
        np.testing.assert_allclose(Ps[k], joint[rows, rows], atol=1e-10)
    d, P_s = smoother.crossed(P[-2], P[-2] @ F[-1].T, P_prior[-1], xs[-1] - x_prior[-1], Ps[-1])
    np.testing.assert_allclose(x[-2] + d, xs[-2], atol=1e-10)
    np.testing.assert_allclose(P_s, Ps[-2], atol=1e-10)
