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
from factorgraph.filters.sequential import StageRows
from factorgraph.problem import NavigationProblem
from factorgraph.solution import Solution
from factorgraph.types import Array
from scenarios import corrected, methods
from scenarios.cli import main
from scenarios.simulate import load_scenario, simulate
from scenarios.studies import replace_duration
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


# -- by name ------------------------------------------------------------------------------------------


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
