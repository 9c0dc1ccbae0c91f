"""Order of elimination: along time, scalars after they end, and nested dissection with its short paths."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factorgraph.assembly.variables import key
from factorgraph.graphs.engine import eliminate
from factorgraph.graphs.ordering import Lives, elimination_order, nested_ranks
from tests.factorgraph.test_covariance import linear, linearized


@pytest.mark.parametrize("n", [1, 2, 7, 64, 1000])
def test_nested_ranks_are_an_order(n: int) -> None:
    ranks = nested_ranks(n)
    assert sorted(ranks.tolist()) == list(range(n))
    assert ranks[n // 2] == n - 1  # the middle goes last


def test_no_entry_of_a_life_is_lost() -> None:
    grid = np.arange(10.0)
    a = Lives.between(np.array([7, 7, 9]), np.array([2.0, 6.0, 0.999]), grid)
    b = Lives.between(np.array([9, 7]), np.array([8.4, 1.0]), grid)
    both = Lives.joined([a, b])
    assert both.key.tolist() == [7, 9] and both.first.tolist() == [1, 1] and both.last.tolist() == [6, 8]


def flight(K: int, arc_states: int) -> tuple[gtsam.GaussianFactorGraph, Lives, list[int], list[tuple[int, ...]]]:
    """A chain of states that see one arc after the other, two at a time, and a constant."""
    rng = np.random.default_rng(0)
    factors = gtsam.NonlinearFactorGraph()
    dims: dict[int, int] = {}
    constant = int(gtsam.symbol("c", 0))
    seen, when = [], []
    for k in range(K):
        dims |= {key("p", 0, k): 3, key("v", 0, k): 3}
        numbers = 2 * (k // arc_states), 2 * ((k + arc_states // 2) // arc_states) + 1
        arcs = [int(gtsam.symbol("a", i)) for i in numbers]
        dims |= dict.fromkeys([*arcs, constant], 1)
        seen += arcs
        when += [float(k)] * 2
        variables = [key("p", 0, k), *arcs, constant]
        factors.add(linear(variables, [rng.normal(size=(9, dims[v])) for v in variables]))
        if k:
            chain = [key(letter, 0, i) for i in (k - 1, k) for letter in "pv"]
            factors.add(linear(chain, [rng.normal(size=(6, 3)) for _ in chain]))
    for scalar in {*seen, constant}:
        factors.add(linear([scalar], [np.eye(1)]))
    lives = Lives.joined([Lives.between(np.array(seen), np.array(when), np.arange(float(K)))])
    states = [(key("p", 0, k), key("v", 0, k)) for k in range(K)]
    return linearized(factors, dims), lives, [constant], states


@pytest.mark.parametrize("nested", [False, True])
def test_conditionals_stay_small_and_nothing_is_forgotten(nested: bool) -> None:
    """A hundred arcs: parents are the next state or the neighbours, the arcs alive and the constant, not all arcs seen so far."""
    linear_graph, lives, constants, states = flight(500, 10)
    order = elimination_order([states], lives, constants, linear_graph.keyVector(), nested)
    assert order.size() == 2 * 500 + len(lives.key) + 1
    net = eliminate(linear_graph, order)
    assert net is not None
    parents = [net.at(i).S().shape[1] for i in range(net.size())]
    assert max(parents) <= (30 if nested else 3 + 6 + 3 + 1)
    assert net.at(net.size() - 1).keys()[0] == constants[0]


def test_nested_paths_are_short() -> None:
    """From an arc to the end of the net: along time half the flight, nested a few levels."""

    def path(nested: bool) -> int:
        linear_graph, lives, constants, states = flight(500, 10)
        net = eliminate(linear_graph, elimination_order([states], lives, constants, linear_graph.keyVector(), nested))
        assert net is not None
        wanted, n = {int(gtsam.symbol("a", 40))}, 0
        for i in range(net.size()):
            own, *others = net.at(i).keys()
            if own in wanted:
                n += 1
                wanted.update(others)
        return n

    assert path(False) > 500 and path(True) < 60


def test_keys_of_unknown_kind_go_before_the_constants() -> None:
    none = Lives.joined([])
    other, constant, state = int(gtsam.symbol("q", 1)), int(gtsam.symbol("c", 0)), key("p", 0, 0)
    order = elimination_order([[(state,)]], none, [constant], [constant, other, state], nested=False)
    assert [order.at(i) for i in range(3)] == [state, other, constant]
