"""Joint covariances from the eliminated graph against the dense inverse of the same information."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.linalg import solveh_banded

from factorgraph.assembly.variables import key
from factorgraph.graphs.covariance import JointCovariance, covariance_of
from factorgraph.graphs.engine import eliminate
from factorgraph.types import Array


def linear(keys: list[int], blocks: list[Array]) -> gtsam.CustomFactor:
    """A factor of any number of variables with constant Jacobians, sum of blocks times variables = 0."""

    def error(_factor: gtsam.CustomFactor, _values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        if jacobians is not None:
            for slot, block in enumerate(blocks):
                jacobians[slot] = block
        return np.zeros(len(blocks[0]))

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(blocks[0])), keys, error)


def linearized(factors: gtsam.NonlinearFactorGraph, dims: dict[int, int]) -> gtsam.GaussianFactorGraph:
    values = gtsam.Values()
    for k, d in dims.items():
        values.insert(k, np.zeros(d))
    return factors.linearize(values)


class Information:
    """A linear Gaussian graph and its dense normal matrix, filled side by side."""

    def __init__(self, dims: dict[int, int]) -> None:
        self.dims, self.at = dims, {}
        n = 0
        for k, d in dims.items():
            self.at[k] = slice(n, n + d)
            n += d
        self.N = np.zeros((n, n))
        self.factors = gtsam.NonlinearFactorGraph()

    def add(self, keys: list[int], blocks: list[Array]) -> None:
        self.factors.add(linear(keys, blocks))
        J = np.zeros((len(blocks[0]), len(self.N)))
        for k, block in zip(keys, blocks, strict=True):
            J[:, self.at[k]] += block
        self.N += J.T @ J

    def inverse(self, keys: list[int]) -> Array:
        pick = np.concatenate([np.arange(len(self.N))[self.at[k]] for k in keys])
        return np.asarray(np.linalg.inv(self.N)[np.ix_(pick, pick)])

    def eliminated(self, last: list[int]) -> gtsam.GaussianBayesNet:
        graph = linearized(self.factors, self.dims)
        ordering = (
            gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, last)
            if last
            else gtsam.Ordering.ColamdGaussianFactorGraph(graph)
        )
        net = eliminate(graph, ordering)
        assert net is not None
        return net


def random_chain(seed: int, K: int = 12, vehicles: int = 2, n_globals: int = 3) -> tuple[Information, list[int]]:
    """Vehicles with states of several variables, in chains, tied to each other here and there and to global scalars."""
    rng = np.random.default_rng(seed)
    letters = {0: (("x", 6), ("v", 3), ("b", 6)), 1: (("p", 3), ("v", 3))}
    states = {(i, k): [(key(c, i, k), d) for c, d in letters[i % 2]] for i in range(vehicles) for k in range(K)}
    scalars = [int(gtsam.symbol("a", j)) for j in range(n_globals)]
    info = Information({k: d for state in states.values() for k, d in state} | dict.fromkeys(scalars, 1))

    def tie(variables: list[tuple[int, int]], rows: int) -> None:
        info.add([k for k, _ in variables], [rng.normal(size=(rows, d)) for _, d in variables])

    for i in range(vehicles):
        tie(states[i, 0], 18)
        for k in range(K - 1):
            tie(states[i, k] + states[i, k + 1], 16)
    for k in range(K):
        both = states[0, k][:2] + states[vehicles - 1, k][:2]
        if rng.random() < 0.7:
            seen = rng.permutation(scalars)[: rng.integers(0, n_globals + 1)].tolist()
            tie(both + [(int(s), 1) for s in seen], 7)
    for s in scalars:
        tie([(s, 1)], 1)
    return info, scalars


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("globals_last", [True, False])
def test_blocks_of_the_dense_inverse(seed: int, globals_last: bool) -> None:
    """Every state's own joint covariance, and pairs across vehicles wherever the graph joins them."""
    info, scalars = random_chain(seed)
    cov = JointCovariance(info.eliminated(scalars if globals_last else []))
    known = 0
    for k in range(12):
        for own in ([key("x", 0, k), key("v", 0, k), key("b", 0, k)], [key("p", 1, k), key("v", 1, k)]):
            expected = info.inverse(own)
            P = cov.joint(own)
            np.testing.assert_allclose(P, expected, atol=1e-9 * np.abs(expected).max())
            np.testing.assert_array_equal(P, P.T)
        cross = [key("x", 0, k), key("p", 1, k)]
        block = cov.block(*cross)
        assert block.shape == (6, 3)
        if np.all(np.isfinite(block)):
            known += 1
            np.testing.assert_allclose(block, info.inverse(cross)[:6, 6:], atol=1e-9)
            np.testing.assert_array_equal(block, cov.block(*cross[::-1]).T)
        else:
            assert np.all(np.isnan(block))
    assert known >= 3  # where a factor ties them


def test_order_of_the_keys_is_the_callers() -> None:
    info, scalars = random_chain(1)
    cov = JointCovariance(info.eliminated(scalars))
    keys = [key("v", 1, 4), key("p", 1, 4)]
    np.testing.assert_allclose(cov.joint(keys), info.inverse(keys), atol=1e-9)
    np.testing.assert_allclose(cov.joint([keys[1]]), info.inverse([keys[1]]), atol=1e-9)


def test_groups_at_once_are_those_one_by_one() -> None:
    info, scalars = random_chain(2)
    cov = JointCovariance(info.eliminated(scalars))
    groups = [[key("x", 0, k), key("b", 0, k)] for k in range(12)]
    many = cov.joints(groups)
    assert many.shape == (12, 12, 12)
    for P, keys in zip(many, groups, strict=True):
        np.testing.assert_array_equal(P, cov.joint(keys))


def test_pairs_without_a_common_clique_are_not_known() -> None:
    """The ends of a chain share nothing: NaN off the diagonal, the exact blocks on it."""
    info, _ = random_chain(3, n_globals=0)
    cov = JointCovariance(info.eliminated([]))
    keys = [key("p", 1, 0), key("p", 1, 11)]
    P, expected = cov.joint(keys), info.inverse(keys)
    assert np.all(np.isnan(P[:3, 3:])) and np.all(np.isnan(P[3:, :3]))
    np.testing.assert_allclose(P[:3, :3], expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(P[3:, 3:], expected[3:, 3:], atol=1e-9)


def test_one_variable_alone() -> None:
    info = Information({key("p", 0, 0): 3})
    info.add([key("p", 0, 0)], [np.diag([1.0, 2.0, 4.0])])
    cov = JointCovariance(info.eliminated([]))
    np.testing.assert_allclose(cov.joint([key("p", 0, 0)]), np.diag([1.0, 0.25, 0.0625]), atol=1e-15)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("globals_last", [True, False])
def test_a_few_variables_have_their_own_short_way(seed: int, globals_last: bool) -> None:
    """Whatever the elimination, in any order of the keys, with or without a clique of their own."""
    info, scalars = random_chain(seed, n_globals=5)
    net = info.eliminated(scalars if globals_last else [])
    rng = np.random.default_rng(seed)
    keys = [*rng.permutation(scalars)[:4].tolist(), key("x", 0, 3), key("p", 1, 11)]
    np.testing.assert_allclose(covariance_of(net, keys), info.inverse(keys), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(covariance_of(net, keys[:1]), info.inverse(keys[:1]), rtol=1e-8)


# -- long chains -----------------------------------------------------------------------------------

STATES = 2000
DT_S, Q = 1.0, 0.5**2


def constant_velocity(every_nth: int) -> gtsam.GaussianFactorGraph:
    """White-noise acceleration in three axes, positions with 1 m at every n-th state, a weak prior."""
    graph = gtsam.NonlinearFactorGraph()
    whiten: Array = np.linalg.inv(np.linalg.cholesky(Q * np.array([[DT_S**3 / 3, DT_S**2 / 2], [DT_S**2 / 2, DT_S]])))
    eye: Array = np.eye(3)
    p0, v0 = (np.kron(whiten @ np.array(column), eye).astype(float) for column in ([[-1.0], [0.0]], [[-DT_S], [-1.0]]))
    p1, v1 = (np.kron(whiten @ np.array(column), eye).astype(float) for column in ([[1.0], [0.0]], [[0.0], [1.0]]))
    for k in range(STATES - 1):
        keys = [key("p", 0, k), key("v", 0, k), key("p", 0, k + 1), key("v", 0, k + 1)]
        graph.add(linear(keys, [p0, v0, p1, v1]))
    for k in range(0, STATES, every_nth):
        graph.add(linear([key("p", 0, k)], [eye]))
    graph.add(linear([key("v", 0, 0)], [0.01 * eye]))
    return linearized(graph, {key(letter, 0, k): 3 for letter in "pv" for k in range(STATES)})


def one_axis(every_nth: int, states: list[int]) -> Array:
    """Covariances (len(states), 2, 2) of position and velocity by a banded solver."""
    whiten = np.linalg.inv(np.linalg.cholesky(Q * np.array([[DT_S**3 / 3, DT_S**2 / 2], [DT_S**2 / 2, DT_S]])))
    J = whiten @ np.array([[-1.0, -DT_S, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0]])
    step = J.T @ J
    bands = np.zeros((4, 2 * STATES))  # lower: bands[i - j, j]
    for k in range(STATES - 1):
        for j in range(4):
            bands[: 4 - j, 2 * k + j] += step[j:, j]
    bands[0, 0 : 2 * STATES : 2 * every_nth] += 1.0
    bands[0, 1] += 0.01**2
    unit = np.zeros((2 * STATES, 2 * len(states)))
    for i, k in enumerate(states):
        unit[2 * k, 2 * i] = unit[2 * k + 1, 2 * i + 1] = 1.0
    columns = solveh_banded(bands, unit, lower=True)
    return np.array([columns[2 * k : 2 * k + 2, 2 * i : 2 * i + 2] for i, k in enumerate(states)])


@pytest.mark.parametrize("every_nth", [1, 10, 400])
def test_a_chain_of_two_thousand_states(every_nth: int) -> None:
    """Stays finite, symmetric and positive, and right: errors of the recursion must not grow along the chain."""
    graph = constant_velocity(every_nth)
    net = eliminate(graph, gtsam.Ordering.ColamdGaussianFactorGraph(graph))
    assert net is not None
    cov = JointCovariance(net)
    P = cov.joints([[key("p", 0, k), key("v", 0, k)] for k in range(STATES)])
    assert np.all(np.isfinite(P))
    scale = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert np.all(np.linalg.eigvalsh(P / scale[:, :, None] / scale[:, None, :]) > 0)
    states = [0, 1, 7, 333, 1000, 1994, STATES - 1]
    expected = one_axis(every_nth, states)
    for k, E in zip(states, expected, strict=True):
        sigma = np.sqrt(np.diag(E))
        unit = E / np.outer(sigma, sigma)
        np.testing.assert_allclose(P[k] / np.outer(np.repeat(sigma, 3), np.repeat(sigma, 3)), np.kron(unit, np.eye(3)), atol=1e-5)
