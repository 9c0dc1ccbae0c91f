"""Corrections of updates: objectives against their formulas, searches against Gauss-Newton, covariances against the truth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.stats import chi2

from swarm import gauss_newton
from swarm.corrector import Corrected, Corrector, CorrectorSettings, Covariance, Optimiser, Outcome, posed
from swarm.judgement import Rule, literal_weights
from swarm.objective import Which
from swarm.snapshot import Snapshot
from swarm.types import Array
from tests.swarm.snapshots import POS, RANGE, SEEN, M, N, drawn

ALWAYS = CorrectorSettings(rule=Rule("always"))
OBJECTIVES: tuple[Which, ...] = ("O1", "O2", "O3")


def formula(which: Which, s: Snapshot, X: Array) -> Array:
    e, dx = s.z - s.h(X), X - s.x_prior
    if which == "O1":
        return np.asarray(np.abs(e) @ literal_weights(np.sqrt(np.diag(s.R))))
    fit = np.einsum("km,mj,kj->k", e, np.linalg.inv(s.R), e)
    return np.asarray(fit + np.einsum("ki,ij,kj->k", dx, np.linalg.inv(s.P_prior), dx) if which == "O3" else fit)


def corrected(settings: CorrectorSettings, s: Snapshot, method: str = "gauss-newton") -> Corrected:
    return Corrector(settings, method)(s, np.random.default_rng(0))


# -- objectives --------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", OBJECTIVES)
@pytest.mark.parametrize("coordinates", ["normalised", "whitened", "raw"])
@pytest.mark.parametrize("decided", ["seen", "all", (3, 4, 5)])
def test_objectives_are_their_formulas(which: Which, coordinates: str, decided: object) -> None:
    s, _ = drawn(1)
    G = np.eye(1, N, 9) + 0.5 * np.eye(1, N, 3)
    s = replace(s, norm_d=np.array([[1.0, 2.0, -3.0]]), norm_scale=np.array([1.01]), norm_G=G)
    settings = CorrectorSettings(objective=which, coordinates=coordinates, decided=decided)  # type: ignore[arg-type]
    within, cost = posed(settings, s)
    Y = np.random.default_rng(2).uniform(within.bounds[:, 0], within.bounds[:, 1], (7, len(within.bounds)))
    expected = formula(which, s, np.array([within.state(y) for y in Y]))
    np.testing.assert_allclose(cost(Y), expected, rtol=1e-10)
    np.testing.assert_allclose(cost.compiled()(Y), cost(Y), rtol=1e-12)
    np.testing.assert_allclose(within.state(within.start), s.x_post, rtol=1e-12)
    step = 1e-6 * (within.bounds[0, 1] - within.bounds[0, 0])
    numeric = (cost.rows(Y[:1] + step * np.eye(Y.shape[1])) - cost.rows(Y[:1] - step * np.eye(Y.shape[1]))).T / (2 * step)
    np.testing.assert_allclose(cost.jacobian(Y[0]), numeric, atol=1e-6 * np.abs(numeric).max())


def test_box_is_three_standard_deviations_about_the_posterior() -> None:
    s, _ = drawn(1)
    half = 3 * np.sqrt(np.diag(s.P_post))[SEEN]
    for coordinates in ("normalised", "raw"):
        within, _ = posed(CorrectorSettings(coordinates=coordinates), s)
        corners = [within.state(within.bounds[:, i])[SEEN] - s.x_post[SEEN] for i in (0, 1)]
        np.testing.assert_allclose(corners, [-half, half], rtol=1e-9)


def test_states_that_follow_lose_nothing() -> None:
    """The minimum of O3 over all states is that over the seen ones, the others following; also from a bent range."""
    s, _ = drawn(7, bias=20.0 * np.eye(M)[RANGE])
    over_all, over_seen = (corrected(replace(ALWAYS, decided=d), s) for d in ("all", "seen"))
    np.testing.assert_allclose(over_seen.x, over_all.x, atol=1e-6)
    np.testing.assert_allclose(over_seen.P, over_all.P, atol=1e-9)
    kept = corrected(replace(ALWAYS, others="kept"), s)
    np.testing.assert_array_equal(kept.x[6:], s.x_post[6:])
    assert np.abs(over_seen.x[6:] - s.x_post[6:]).max() > 1e-4


def test_of_linear_rows_the_posterior_is_the_least_of_o3() -> None:
    s, _ = drawn(3, linear=True)
    found = corrected(ALWAYS, s)
    np.testing.assert_allclose(found.x, s.x_post, atol=1e-9)
    np.testing.assert_allclose(found.P, s.P_post, atol=1e-12)


def test_of_a_biased_distance_the_posterior_is_the_least_of_o3() -> None:
    """From 100 km away a distance is straight; its bias is a state that only it sees."""
    s, _ = drawn(3)
    G, far = 3.0 * np.eye(1, N, 9), 1e5 * np.array([[0.6, 0.0, 0.8]])
    H, e = s.H.copy(), s.innovation
    H[RANGE] = G
    H[RANGE, POS] += (s.x_prior[POS] + far[0]) / np.linalg.norm(s.x_prior[POS] + far[0])
    e[RANGE] = 4.0
    K = np.linalg.solve(H @ s.P_prior @ H.T + s.R, H @ s.P_prior).T
    s = replace(s, H=H, norm_d=far, norm_G=G, x_post=s.x_prior + K @ e, P_post=s.P_prior - K @ H @ s.P_prior)
    s = replace(s, z=s.h(s.x_prior[None])[0] + e)
    np.testing.assert_allclose(s.jacobian(s.x_prior), H, atol=1e-12)
    found = corrected(ALWAYS, s)
    np.testing.assert_allclose(found.x, s.x_post, atol=1e-4)
    np.testing.assert_allclose(found.P, s.P_post, atol=2e-6)


def test_o2_is_weighted_least_squares() -> None:
    s, _ = drawn(3, linear=True)
    found = corrected(replace(ALWAYS, objective="O2", box_sigmas=100.0), s)
    W, H = np.linalg.inv(s.R), s.H[:, :6]
    np.testing.assert_allclose(found.x[:6], np.linalg.solve(H.T @ W @ H, H.T @ W @ s.z), atol=1e-8)
    np.testing.assert_allclose(found.P[:6, :6], np.linalg.inv(H.T @ W @ H), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found.P[6:, 6:], s.P_post[6:, 6:], atol=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_gauss_newton_finds_the_least_sum_of_sizes(seed: int) -> None:
    """Against a linear programme."""
    s, _ = drawn(seed, linear=True)
    within, cost = posed(CorrectorSettings(objective="O1"), s)
    p, eye = len(within.bounds), np.eye(M)
    rows = np.block([[-cost.A, -eye], [cost.A, -eye]])
    bounds = [*map(tuple, within.bounds), *[(0, None)] * M]
    best = linprog(np.r_[np.zeros(p), np.ones(M)], rows, np.r_[-cost.c, cost.c], bounds=bounds)
    found = gauss_newton.minimize(cost, within.bounds, within.start)
    assert best.fun * (1 - 1e-9) <= found.cost <= best.fun * (1 + 5e-5)


@pytest.mark.parametrize("which", OBJECTIVES)
def test_searches_come_close_to_gauss_newton(which: Which) -> None:
    snapshots = [drawn(seed, bias=2.0 * np.eye(M)[RANGE])[0] for seed in range(2)]
    for name in ("tdo", "pso", "ga"):
        excess = []
        for i, s in enumerate(snapshots):
            within, cost = posed(replace(ALWAYS, objective=which), s)
            least = gauss_newton.minimize(cost, within.bounds, within.start).cost
            runs = [Optimiser(name)(cost, within, np.random.default_rng([seed, i])) for seed in range(2)]
            excess += [run.cost / least - 1.0 for run in runs]
        assert min(excess) > -5e-5, name
        assert np.median(excess) < 1e-3, name


def test_a_correction_is_fast() -> None:
    s, _ = drawn(2)
    correct = Corrector(ALWAYS, "tdo")
    correct(s, np.random.default_rng(0))
    spent = []
    for _ in range(3):
        began = time.perf_counter()
        correct(s, np.random.default_rng(0))
        spent.append(time.perf_counter() - began)
    assert min(spent) < 0.2  # a quarter of it on an idle machine


# -- covariances -------------------------------------------------------------------------------------


def nees(settings: CorrectorSettings, seeds: Sequence[int]) -> tuple[float, float, float]:
    """Sums over seeds of squared errors in units of their covariance: of all states, of those that rows see, of the others."""
    total = np.zeros(3)
    for seed in seeds:
        s, truth = drawn(seed, linear=True)
        found = corrected(settings, s)
        for i, part in enumerate((slice(0, N), slice(0, 6), slice(6, N))):
            e = (found.x - truth)[part]
            total[i] += e @ np.linalg.solve(found.P[part, part], e)
    return float(total[0]), float(total[1]), float(total[2])


def within_band(total: float, dof: int) -> bool:
    low, high = chi2.interval(0.998, dof)
    return bool(low < total < high)


@pytest.mark.parametrize(("which", "others"), [("O3", "follow"), ("O3", "kept"), ("O2", "kept"), ("O2", "follow")])
def test_joseph_is_as_large_as_the_errors(which: Which, others: str) -> None:
    settings = replace(ALWAYS, objective=which, others=others, box_sigmas=100.0)  # type: ignore[arg-type]
    assert within_band(nees(settings, range(150))[0], 150 * N)


def test_joseph_of_sizes_is_nearly_as_large_as_the_errors() -> None:
    settings = replace(ALWAYS, objective="O1", box_sigmas=100.0)
    found, of_seen, of_others = nees(settings, range(30))
    assert 0.75 < found / (30 * N) < 1.3
    assert 0.65 < of_seen / (30 * 6) < 1.5
    assert within_band(of_others, 30 * 6)


def test_kept_is_too_small_without_the_prior() -> None:
    """Of O3 it is right; O1 and O2 forget the prior that it is made of."""
    kept: Covariance = "kept"
    assert within_band(nees(replace(ALWAYS, covariance=kept), range(150))[0], 150 * N)
    for which, n in (("O2", 100), ("O1", 10)):
        _, of_seen, of_others = nees(replace(ALWAYS, objective=which, covariance=kept, box_sigmas=100.0), range(n))  # type: ignore[arg-type]
        assert of_seen / (6 * n) > 2.5
        assert within_band(of_others, 6 * n)


def test_walls_are_counted_as_errors() -> None:
    settings = replace(ALWAYS, objective="O2", box_sigmas=1.0)
    assert 0.5 < nees(settings, range(60))[1] / (60 * 6) < 1.2


def test_scaled_grows_with_rows_that_do_not_fit() -> None:
    s, _ = drawn(5, linear=True, bias=np.r_[np.zeros(14), 10.0, np.zeros(6)])
    plain, scaled = (corrected(replace(ALWAYS, objective="O2", box_sigmas=100.0, covariance=c), s) for c in ("joseph", "scaled"))
    e = s.z - s.H @ plain.x
    np.testing.assert_allclose(scaled.P, plain.P * (e @ np.linalg.solve(s.R, e)) / (M - 6), rtol=1e-9)
    good, _ = drawn(2, linear=True)
    assert corrected(replace(ALWAYS, covariance="scaled"), good).P[3, 3] >= corrected(ALWAYS, good).P[3, 3]


# -- what becomes of an update -----------------------------------------------------------------------


def test_sound_updates_are_accepted_and_wrong_ones_corrected() -> None:
    settings = CorrectorSettings(objective="O1")
    sound, _ = drawn(4)
    accepted = corrected(settings, sound)
    assert accepted.outcome is Outcome.ACCEPTED and not accepted.triggered and accepted.result is None
    assert accepted.x is sound.x_post and accepted.P is sound.P_post
    wrong, truth = drawn(4, bias=8.0 * np.eye(M)[RANGE])
    found = corrected(settings, wrong)
    assert found.outcome is Outcome.CORRECTED and found.triggered and found.statistic > found.threshold
    assert found.result is not None and np.linalg.norm((found.x - truth)[POS]) < np.linalg.norm((wrong.x_post - truth)[POS]) + 3


def test_what_rows_do_not_determine_stays() -> None:
    s, _ = drawn(4)
    only = slice(14, 17)  # positions
    few = Snapshot(s.x_prior, s.P_prior, s.x_post, s.P_post, s.z[only], s.R[only, only], s.H[only])
    for decided, outcome in (("seen", Outcome.CORRECTED), ("all", Outcome.UNDETERMINED), ((0, 3), Outcome.UNDETERMINED)):
        found = corrected(replace(ALWAYS, objective="O2", decided=decided), few)  # type: ignore[arg-type]
        assert found.outcome is outcome and found.triggered
    assert corrected(replace(ALWAYS, decided="all"), few).outcome is Outcome.CORRECTED  # the prior determines them


def test_any_callable_searches() -> None:
    s, _ = drawn(4)
    found = Corrector(ALWAYS, lambda cost, within, rng: gauss_newton.minimize(cost, within.bounds, within.start))
    np.testing.assert_array_equal(found(s, np.random.default_rng(0)).x, corrected(ALWAYS, s).x)
    np.testing.assert_array_equal(corrected(ALWAYS, s, "pso").x, corrected(ALWAYS, s, "pso").x)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"objective": "O4"}, "objective must be one of O1, O2, O3, got O4"),
        ({"others": "gone"}, "others must be one of kept, follow, auto, got gone"),
        ({"coordinates": "polar"}, "coordinates must be one of normalised, whitened, raw, got polar"),
        ({"covariance": "large"}, "covariance must be one of kept, joseph, scaled, got large"),
        ({"decided": "some"}, "decided must be seen, all or numbers of states, got some"),
        ({"box_sigmas": 0.0}, "box_sigmas must be positive, got 0.0"),
    ],
)
def test_wrong_settings_are_named(options: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        CorrectorSettings(**options)  # type: ignore[arg-type]


def test_wrong_states_and_methods_are_named() -> None:
    s, _ = drawn(1)
    with pytest.raises(ValueError, match=r"decided must name states below 12, got \(3, 12\)"):
        corrected(replace(ALWAYS, decided=(3, 12)), s)
    P = s.P_post.copy()
    P[4, 4] = 0.0
    with pytest.raises(ValueError, match="needs a positive variance in P_post, got 0 of state 4"):
        corrected(ALWAYS, replace(s, P_post=P))
    with pytest.raises(ValueError, match=r"method must be one of .*gauss-newton, got annealing"):
        Optimiser("annealing")
