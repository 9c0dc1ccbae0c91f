"""Corrections from outside in any recursive filter: what is handed out and taken back, and methods by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.filters import methods as filters
from factorgraph.filters.correctors import Case, Corrector, Iterated, Searched
from factorgraph.filters.recursive import Recursive
from factorgraph.filters.relative.filtering import Options, Update, run
from factorgraph.filters.relative.motion import Smooth
from factorgraph.filters.relative.rows import Distances, RangeRow, Rows, Source, stacked
from factorgraph.filters.sequential import StageRows
from factorgraph.problem import NavigationProblem
from factorgraph.solution import Solution
from factorgraph.types import Array
from scenarios import corrected, methods
from scenarios.cli import main
from scenarios.simulate import load_scenario, simulate
from scenarios.studies import replace_duration
from swarm.corrector import Corrector as SwarmCorrector
from swarm.judgement import Rule
from tests.factorgraph.test_filters_recursive import quiet


@cache
def problem() -> NavigationProblem:
    return simulate(replace_duration(load_scenario("two-uav"), 12.0), 1).problem


@cache
def plain(name: str) -> Solution:
    return filters.create(name, integers=False).solve(problem(), quiet)


def with_correction(name: str, search: str, rule: Rule) -> tuple[Solution, corrected.Correction]:
    """A filter's solution with a correction, and that."""
    method = filters.FILTERS[name]
    correction = corrected.Correction(search, replace(corrected.SETTINGS, rule=rule))
    own = replace(method, corrector=lambda: Searched(method.corrector(), correction))
    return Recursive(name, "", own, integers=False).solve(problem(), quiet), correction


def apart(a: Solution, b: Solution) -> float:
    """Largest difference of positions in b's standard deviations."""
    pairs = zip(a.vehicles, b.vehicles, strict=True)
    return max(float(np.abs((x.r_n - y.r_n) / np.sqrt(np.einsum("kii->ki", y.P))[:, :3]).max()) for x, y in pairs)


@pytest.mark.parametrize("name", ["eskf", "srckf"])
def test_a_rule_that_never_triggers_leaves_the_plain_filter(name: str) -> None:
    found, correction = with_correction(name, "gauss-newton", Rule("never"))
    assert correction.triggered == 0
    for x, y in zip(found.vehicles, plain(name).vehicles, strict=True):
        np.testing.assert_array_equal(x.r_n, y.r_n)
        np.testing.assert_array_equal(x.P, y.P)


@pytest.mark.parametrize("name", ["eskf", "srckf"])
def test_of_linear_rows_gauss_newton_returns_to_the_posterior(name: str) -> None:
    found, correction = with_correction(name, "gauss-newton", Rule("always"))
    assert correction.triggered == len(plain(name).vehicles[0].t_s)
    assert apart(found, plain(name)) < 1e-4
    for x, y in zip(found.vehicles, plain(name).vehicles, strict=True):
        np.testing.assert_allclose(np.einsum("kii->ki", x.P), np.einsum("kii->ki", y.P), rtol=1e-5)


def test_a_search_comes_close_to_the_posterior() -> None:
    found, correction = with_correction("eskf", "tdo", Rule(quantile=0.5))
    assert 1 < correction.triggered < 12
    assert 0 < apart(found, plain("eskf")) < 1e-3


# -- what is handed over ------------------------------------------------------------------------------


def rows_of(H: Array, e: Array) -> StageRows:
    m = len(e)
    judged = np.arange(m) != 0
    return StageRows(e, H, np.ones(m), np.zeros(m, np.int64), judged, 0.5, [])


def drawn() -> tuple[Array, Array, Array, Array]:
    """P (4, 4) and a root, e (6,) and H (6, 4)."""
    rng = np.random.default_rng(0)
    L = np.tril(rng.normal(size=(4, 4))) + 2 * np.eye(4)
    return L @ L.T, L, rng.normal(size=6), rng.normal(size=(6, 4))


def keeper(cases: list[Case], answer: tuple[Array, Array] | None) -> Callable[[Case], tuple[Array, Array] | None]:
    def correct(case: Case) -> tuple[Array, Array] | None:
        cases.append(case)
        return answer

    return correct


def test_update_and_answer_are_handed_over() -> None:
    P, L, e, H = drawn()
    rows, cases = rows_of(H, e), list[Case]()
    answer = (np.arange(4.0), np.diag([1.0, 4.0, 9.0, 16.0]))
    u = Corrector().update(P, e, rows, None)
    found = Searched(Corrector(), keeper(cases, answer)).update(P, e, rows, None)
    assert found.dx is answer[0] and found.P is answer[1] and found.nis == u.nis
    case = cases[0]
    np.testing.assert_array_equal(case.x_post, u.dx)
    np.testing.assert_array_equal(case.P_post, u.P)
    assert case.P_prior is P and case.e is e and case.H is H and case.dof == 4.5
    rooted = Searched(Corrector(), keeper(cases, answer)).rooted(L, e, rows, np.zeros((6, 1)))
    assert rooted.L is not None
    np.testing.assert_allclose(rooted.L, np.diag([1.0, 2.0, 3.0, 4.0]))
    np.testing.assert_allclose(cases[1].H, H)
    none = Searched(Corrector(), keeper(cases, None))
    np.testing.assert_array_equal(none.update(P, e, rows, None).dx, u.dx)
    assert none.rooted(L, e, rows, np.zeros((6, 1))).L is not None


def test_rows_of_an_iterated_update_are_those_where_it_ends() -> None:
    P, _, e, H = drawn()
    P = 0.01 * P

    def bent(x: Array) -> tuple[Array, Array]:
        return e - H @ x - 0.1 * np.sin(x[0]), H + 0.1 * np.outer(np.ones(6), np.cos(x[0]) * np.eye(4)[0])

    cases: list[Case] = []
    u = Searched(Iterated(), keeper(cases, None)).update(P, e, rows_of(H, e), bent)
    case = cases[0]
    least = np.linalg.solve(case.H.T @ case.H + np.linalg.inv(P), case.H.T @ case.e)
    np.testing.assert_allclose(u.dx, least, atol=1e-4 * np.sqrt(np.diag(P)).min())


def test_what_is_not_sound_is_not_searched() -> None:
    P, _, e, H = drawn()
    judged = np.ones(6, np.bool_)
    correct = corrected.Correction("gauss-newton")
    huge = Case(P, np.zeros(4), P, 100 * e, H, judged, 6.0)
    assert correct(huge) is not None
    assert correct(replace(huge, P_prior=np.diag([1.0, 1.0, 1.0, 0.0]))) is None
    assert correct(replace(huge, judged=~judged, dof=0.0)) is None
    assert correct.triggered == 2


# -- the relative filter ------------------------------------------------------------------------------

ALWAYS = replace(corrected.SETTINGS, rule=Rule("always"))


def ranged(*, bias: int, scale: int, far_m: float) -> list[Source]:
    """One range to a follower, 3 m longer than it is thought to be."""
    row = RangeRow(0, 1, np.array([0.0, 0.6, 0.8]), 0.0, 0.1, "a-b", scale=scale, bias=bias)
    row = replace(row, range_m=3.0 + float(np.linalg.norm(row.arm_e + [far_m, 0.0, 0.0])))
    return [Distances({0: [row]}, 6 + max(bias, scale) + 1, first_constant=6)]


@pytest.mark.parametrize(("bias", "scale"), [(-1, -1), (0, -1), (-1, 0), (1, 0)])
def test_gauss_newton_returns_to_the_posterior_with_constants_of_ranges(bias: int, scale: int) -> None:
    """From far away distances are straight; a range that is too long is shared out between place, bias and scale."""
    far_m = 1e5
    sigma = {bias: 1.0, scale: 1.0 / far_m}
    options = Options(constants=tuple(sigma[i] for i in range(max(bias, scale) + 1)))
    sources, start = ranged(bias=bias, scale=scale, far_m=far_m), (np.array([0.0, 0, 0, far_m, 0, 0]), np.eye(6))
    t_s = np.zeros(1)
    correction = corrected.RelativeCorrection(SwarmCorrector(ALWAYS, "gauss-newton"), np.random.default_rng(0))
    own, found = (
        run(Smooth("velocity", 1, t_s, 0.3), sources, t_s, start, replace(options, correct=correct))
        for correct in (None, correction)
    )
    assert found.triggered.all()
    shares = 1 + (bias >= 0) + (scale >= 0)
    assert own.x[0, 3] - far_m == pytest.approx(3.0 / (shares + 0.1**2))
    s = np.sqrt(np.diag(own.P[0]))
    np.testing.assert_allclose(found.x[0] / s, own.x[0] / s, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.P[0] / np.outer(s, s), own.P[0] / np.outer(s, s), atol=1e-3)


def test_snapshots_of_relative_updates_are_their_rows() -> None:
    """Innovations and rows are the filter's own, also where states that are not zero have no variance."""
    rng = np.random.default_rng(5)
    arms = rng.normal(size=(2, 3))
    told = [RangeRow(0, 1, arms[0], 40.0, 0.1, "a-b", 0, 1), RangeRow(1, 2, arms[1], 70.0, 0.1, "b-c", bias=2)]
    x, d = np.r_[rng.normal(0.0, 30.0, 12), 1e-3, 0.4, -0.7], 1e-3 * rng.normal(size=15)
    linear = Rows(np.ones(4), rng.normal(size=(4, 15)), np.eye(4), np.zeros(4, np.int64), ("row",) * 4)
    distances = Distances({0: told}, 15, scale=1.01, first_constant=12).rows(0, x)
    assert distances is not None
    rows = stacked([linear, distances])
    e, H = rows.linearised(x)
    P = np.eye(15)
    update = Update(x, P, x, P, rows, H)
    for fixed in ([], [0, 4, 13], [3, 12, 14]):
        free = np.setdiff1d(np.arange(15), fixed)
        s = corrected.relative_snapshot(update, free)
        np.testing.assert_allclose(s.innovation, e, atol=1e-9)
        np.testing.assert_allclose(s.jacobian(x[free]), H[:, free], atol=1e-12)
        there = x.copy()
        there[free] += d[free]
        np.testing.assert_allclose(s.z - s.h(there[free][None])[0], rows.linearised(there)[0], atol=1e-5)


# -- by name ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["relative-cma-es", "eskf-cma-es", "eskf-cma-es-rts"])
def test_a_search_without_its_package_is_told_first(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    assert corrected.create(name).name == name
    monkeypatch.setattr(corrected, "find_spec", lambda package: None)
    with pytest.raises(InputError, match=r'the search cma-es needs cmaes, .* pip install "relnav\[optimisers\]"'):
        methods.create(name)
    other = name.replace("cma-es", "de")
    assert corrected.create(other).name == other


def test_filters_and_searches_make_names(capsys: pytest.CaptureFixture[str]) -> None:
    method = methods.create("strong-tracking-cma-es-rts")
    assert method.summary == "error-state filter with a fading factor, corrected by cma-es, smoothed"
    for name in ("eskf-tdo", "srukf-gauss-newton"):
        assert isinstance(methods.create(name), Recursive)
    with pytest.raises(InputError, match=r"named eskf-tdoo; did you mean eskf-tdo\? There are: graph, .*FILTER-SEARCH$"):
        methods.create("eskf-tdoo")
    with pytest.raises(AttributeError, match="no attribute"):
        corrected.__getattr__("eskf-nothing")
    assert main(["methods"]) == 0
    shown = capsys.readouterr().out
    assert "FILTER-SEARCH" in shown and "eskf-pso" not in shown
