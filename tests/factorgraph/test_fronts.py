"""Least squares along time against dense solutions of the same rows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.least_squares.fronts import (
    SMALLEST_PIVOT,
    FactorBlock,
    Factorised,
    Layout,
    Marginal,
    Part,
    Scalars,
    Undetermined,
    Variables,
)
from factorgraph.types import Array


@dataclass
class Chain:
    """States of several vehicles at every stage, ambiguities that live for a while, and constants to the end.

    Keys: 10 k + vehicle, 100_000 + ambiguity, 900_000 + constant. Ambiguities come first in the list, so that neither the order
    of keys nor that of the list is the one of elimination.
    """

    stages: int = 12
    vehicles: int = 2
    dim: int = 4
    life: int = 5
    ambiguities: int = 9
    seed: int = 1
    state_prior: float = 0.0
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        begin = np.linspace(1 - self.life, self.stages - 1, self.ambiguities).astype(int)
        self.seen = [100_000 + np.flatnonzero((begin <= k) & (k < begin + self.life)) for k in range(self.stages)]
        arcs = np.unique(np.concatenate(self.seen))
        states = 10 * np.arange(self.stages)[:, None] + np.arange(self.vehicles)
        self.states = states
        self.variables = Variables(
            np.concatenate([arcs, states.ravel(), [900_000, 900_001]]),
            np.concatenate([np.ones(len(arcs), int), np.full(states.size, self.dim), [2, 1]]),
            np.concatenate([np.full(len(arcs), -1), np.repeat(np.arange(self.stages), self.vehicles), [self.stages - 1, -1]]),
        )
        self.blocks: list[FactorBlock] = []
        self.parts: list[Part] = []
        self._phases()
        for v in range(self.vehicles):
            self.add(
                (self.dim, self.dim, 2),
                np.column_stack([states[1:, v], states[:-1, v], np.full(self.stages - 1, 900_000)]),
                self.dim,
            )
        if self.vehicles > 1:
            self.add(
                (self.dim, 1, self.dim), np.column_stack([states[::3, 1], np.full(len(states[::3]), 900_001), states[::3, 0]]), 1
            )
        self.add((1,), arcs[:, None], 1, 0.1)
        self.add((2,), np.array([[900_000]]), 2)
        self.add((1,), np.array([[900_001]]), 1)
        if self.state_prior:
            self.add((self.dim,), states.reshape(-1, 1), self.dim, self.state_prior)

    def add(self, widths: tuple[int, ...], keys: np.ndarray, rows: int, scale: float = 1.0) -> None:
        start = rows * np.arange(len(keys) + 1)
        self.blocks.append(FactorBlock(widths, keys, start))
        n = int(start[-1])
        J = scale * self.rng.standard_normal((n, sum(widths)))
        if scale != 1.0:
            J = scale * np.tile(np.eye(rows), (len(keys), 1))
        self.parts.append(Part(self.rng.standard_normal(n), J))

    def _phases(self) -> None:
        """Rows over the first two vehicles' states and the ambiguities seen: as many factors' rows as those see, plus one."""
        used = min(self.vehicles, 2)
        counts = np.array([len(a) for a in self.seen])
        start = np.concatenate([[0], np.cumsum(counts + 3)])
        first_key = np.concatenate([[0], np.cumsum(counts)])
        first = np.concatenate([[0], np.cumsum(counts * (counts + 3))])
        widths = (self.dim,) * used
        shuffled = np.concatenate([self.rng.permutation(a) for a in self.seen])
        self.blocks.append(FactorBlock(widths, self.states[:, :used], start, Scalars(shuffled, first_key, first)))
        n = int(start[-1])
        e, J = self.rng.standard_normal(n), self.rng.standard_normal((n, sum(widths)))
        self.parts.append(Part(e, J, self.rng.standard_normal(int(first[-1]))))

    def dense(self) -> tuple[Array, Array]:
        """J (m, N) and e (m,) of all rows, columns in the order of the variables."""
        offset = np.concatenate([[0], np.cumsum(self.variables.dim)])
        at = {int(k): slice(offset[i], offset[i + 1]) for i, k in enumerate(self.variables.key)}
        J, e = [], []
        for block, part in zip(self.blocks, self.parts, strict=True):
            edges = np.concatenate([[0], np.cumsum(block.widths)])
            for f in range(len(block.start) - 1):
                i, j = block.start[f], block.start[f + 1]
                rows = np.zeros((j - i, offset[-1]))
                for slot, k in enumerate(block.keys[f]):
                    rows[:, at[int(k)]] = part.Jw[i:j, edges[slot] : edges[slot + 1]]
                if block.scalars is not None:
                    s = block.scalars
                    piece = part.dense[s.first[f] : s.first[f + 1]].reshape(-1, j - i).T
                    for c, k in enumerate(s.keys[s.first_key[f] : s.first_key[f + 1]]):
                        rows[:, at[int(k)]] = piece[:, c : c + 1]
                J.append(rows)
                e.append(part.e[i:j])
        return np.concatenate(J), np.concatenate(e)

    def columns(self, keys: list[int]) -> np.ndarray:
        layout = self.layout
        return np.concatenate([np.arange(layout.offset[i], layout.offset[i + 1]) for i in layout.index(keys)])

    @property
    def layout(self) -> Layout:
        return Layout(self.variables, self.blocks)

    def factorised(self, damping: float | Array = 0.0) -> Factorised:
        factor = self.layout.factorise(self.parts, damping)
        assert isinstance(factor, Factorised)
        return factor


CHAINS = [
    Chain(),
    Chain(stages=1, vehicles=1, ambiguities=3),
    Chain(stages=30, vehicles=5, dim=6, life=25, ambiguities=14, seed=2, state_prior=0.5),
    Chain(stages=60, vehicles=1, dim=15, life=40, ambiguities=30, seed=3, state_prior=0.5),
]


@pytest.mark.parametrize("chain", CHAINS)
def test_step_is_the_least_squares_solution(chain: Chain) -> None:
    J, e = chain.dense()
    expected = np.linalg.lstsq(J, -e, rcond=None)[0]
    factor = chain.factorised()
    np.testing.assert_allclose(factor.step(), expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    assert factor.log_det() == pytest.approx(np.linalg.slogdet(J.T @ J)[1], rel=1e-11)
    assert factor.decrease() == pytest.approx(e @ e - np.sum((J @ expected + e) ** 2), rel=1e-10)
    assert 0 < factor.weakest_pivot < 1


@pytest.mark.parametrize("damping", [0.3, "each"])
def test_damping(damping: float | str) -> None:
    chain = CHAINS[0]
    J, e = chain.dense()
    D = np.linspace(0, 5, J.shape[1]) if damping == "each" else np.full(J.shape[1], damping)
    factor = chain.factorised(D if damping == "each" else float(damping))
    expected = np.linalg.solve(J.T @ J + np.diag(D), -J.T @ e)
    np.testing.assert_allclose(factor.step(), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert factor.decrease() == pytest.approx(-e @ J @ expected, rel=1e-10)


@pytest.mark.parametrize("chain", CHAINS)
def test_covariances_are_those_of_the_dense_inverse(chain: Chain) -> None:
    J, _ = chain.dense()
    P = np.linalg.inv(J.T @ J)
    factor = chain.factorised()
    far = [int(chain.states[-1, 0]), 900_001, int(chain.states[0, -1]), *(int(k) for k in chain.seen[0][:2]), 900_000]
    at = chain.columns(far)
    np.testing.assert_allclose(factor.covariance(far), P[np.ix_(at, at)], rtol=0, atol=1e-9 * np.abs(P[at, at]).max())
    selected = factor.selected()
    for k in range(chain.stages):
        near = [900_000, *chain.states[k].tolist(), *chain.seen[k].tolist(), *chain.states[min(k + 1, chain.stages - 1)].tolist()]
        near = list(dict.fromkeys(near))
        at = chain.columns(near)
        np.testing.assert_allclose(selected.joint(near), P[np.ix_(at, at)], rtol=0, atol=1e-9 * np.abs(P[at, at]).max())


def test_groups_and_pairs_that_share_no_front() -> None:
    chain = CHAINS[0]
    J, _ = chain.dense()
    P = np.linalg.inv(J.T @ J)
    selected = chain.factorised().selected()
    groups = np.column_stack([chain.states[:, 1], chain.states[:, 0]])
    joints = selected.joints(groups)
    for group, joint in zip(groups.tolist(), joints, strict=True):
        at = chain.columns(group)
        np.testing.assert_allclose(joint, P[np.ix_(at, at)], atol=1e-10)
    apart = selected.joint([int(chain.states[0, 0]), int(chain.states[5, 0])])
    assert np.all(np.isnan(apart[:4, 4:])) and np.all(np.isnan(apart[4:, :4]))
    assert np.all(np.isfinite(apart[:4, :4])) and np.all(np.isfinite(apart[4:, 4:]))
    with pytest.raises(InputError, match="agree in their variables' dimensions"):
        selected.joints([[0, 1], [0, 900_001]])


def test_marginal_stands_for_everything_before() -> None:
    """The window from a stage on, with the marginal's rows in the place of all earlier factors, has the same solution."""
    chain = Chain(stages=10, seed=4)
    stage = 6
    marginal = chain.layout.marginal(chain.parts, stage)
    assert isinstance(marginal, Marginal)
    J, e = chain.dense()
    layout = chain.layout
    last = np.repeat(layout.last, layout.dim)
    front = np.array([last[row != 0].min() for row in J])
    before, past = J[front < stage], last < stage
    gone = before[:, past]
    Q, _ = np.linalg.qr(gone)
    at = chain.columns(marginal.keys.tolist())
    left, e_left = before[:, at] - Q @ (Q.T @ before[:, at]), e[front < stage] - Q @ (Q.T @ e[front < stage])
    np.testing.assert_allclose(marginal.information, left.T @ left, atol=1e-11)
    np.testing.assert_allclose(marginal.vector, left.T @ e_left, atol=1e-11)
    e_rows, rows = marginal.rows()
    np.testing.assert_allclose(rows.T @ rows, marginal.information, atol=1e-11)
    np.testing.assert_allclose(rows.T @ e_rows, marginal.vector, atol=1e-11)
    window = np.vstack([np.zeros((len(rows), J.shape[1])), J[front >= stage]])
    window[: len(rows), at] = rows
    expected = np.linalg.lstsq(window[:, ~past], -np.concatenate([e_rows, e[front >= stage]]), rcond=None)[0]
    np.testing.assert_allclose(chain.factorised().step()[~past], expected, atol=1e-10)
    with pytest.raises(InputError, match=r"stage must lie in \[1, 9\], got 10"):
        layout.marginal(chain.parts, 10)


def test_marginal_without_information_about_some() -> None:
    """A random walk whose start is unknown: what came before says nothing about a level, something about the difference."""
    variables = Variables(np.array([1, 2, 3]), np.array([1, 1, 1]), np.array([0, 1, 1]))
    block = FactorBlock((1, 1), np.array([[1, 2], [1, 3]]), np.array([0, 1, 2]))
    marginal = Layout(variables, [block]).marginal([Part(np.array([1.0, 3.0]), np.array([[1.0, -1.0], [1.0, -1.0]]))], 1)
    assert isinstance(marginal, Marginal)
    e, J = marginal.rows()
    assert J.shape == (1, 2)
    assert J[0, 0] == pytest.approx(-J[0, 1])
    np.testing.assert_allclose(np.linalg.lstsq(J, -e, rcond=None)[0] @ [1, -1], -2.0)


def levelled(stages: int, phase: float = 1.0) -> tuple[Chain, Array]:
    """A chain without priors on states and ambiguities, and the direction that changes no row.

    It moves the second component of all states up and all ambiguities down.
    """
    chain = Chain(stages=stages, vehicles=2, dim=3, life=30, ambiguities=2 + stages // 5, seed=5)
    moved = np.where(chain.variables.key >= 900_000, 0.0, np.where(chain.variables.dim == 1, -1.0, 0.0))
    level = np.repeat(moved, chain.variables.dim)
    level[chain.columns(chain.states.ravel().tolist())[1::3]] = 1.0
    chain.blocks, chain.parts = chain.blocks[:3], chain.parts[:3]
    phases, *moves = chain.parts
    block = chain.blocks[0]
    assert block.scalars is not None
    for f in range(stages):
        i, j = block.start[f], block.start[f + 1]
        piece = phases.dense[block.scalars.first[f] : block.scalars.first[f + 1]].reshape(-1, j - i)
        phases.Jw[i:j, 1] = piece.sum(axis=0) - phases.Jw[i:j, 4]
    phases.Jw[:] *= phase
    phases.dense[:] *= phase
    for part in moves:
        part.Jw[:, 4] = -part.Jw[:, 1]
    chain.add((2,), np.array([[900_000]]), 2)
    chain.add((1,), np.array([[900_001]]), 1)
    return chain, level


@pytest.mark.parametrize("stages", [3, 300])
def test_undetermined_direction_is_told(stages: int) -> None:
    chain, level = levelled(stages)
    J, _ = chain.dense()
    assert np.abs(J @ level).max() < 1e-12
    found = chain.layout.factorise(chain.parts)
    assert isinstance(found, Undetermined)
    assert abs(found.pivot) < SMALLEST_PIVOT
    scaled = found.direction / level[chain.columns([found.key])[found.component]]
    np.testing.assert_allclose(scaled, level, atol=1e-6)
    assert isinstance(chain.layout.factorise(chain.parts, damping=1e-3), Factorised)


def test_variable_without_rows_and_rows_that_are_not_finite() -> None:
    variables = Variables(np.array([7, 8]), np.array([2, 3]), np.array([0, -1]))
    layout = Layout(variables, [FactorBlock((2,), np.array([[7]]), np.array([0, 2]))])
    found = layout.factorise([Part(np.zeros(2), np.eye(2))])
    assert isinstance(found, Undetermined)
    assert (found.key, found.component, found.stage, found.pivot) == (8, 0, 0, 0.0)
    np.testing.assert_array_equal(found.direction, [0, 0, 1, 0, 0])
    found = layout.factorise([Part(np.zeros(2), np.full((2, 2), np.nan))], damping=1.0)
    assert isinstance(found, Undetermined)
    assert found.key == 7 and np.isnan(found.pivot)


def refined(J: Array, e: Array) -> Array:
    """Least squares by QR with residuals in extended precision until nothing changes: right to the last digits."""
    norm = np.linalg.norm(J, axis=0)
    Q, R = np.linalg.qr(J / norm)
    x = np.zeros(J.shape[1], np.longdouble)
    r = -e.astype(np.longdouble)
    JL = J.astype(np.longdouble)
    for _ in range(6):
        x = x + np.linalg.solve(R, Q.T @ r.astype(float)) / norm
        r = -e - JL @ x
    return np.asarray(x, float)


def test_millimetres_beside_kilometres() -> None:
    """What all states and ambiguities share is known to 1 km, phases to 3 mm: 1e11 between the squared weights.

    With columns of unit length J has the condition 4e6, so that the normal equations may lose 3e-3 in relative terms; of the
    step, in standard deviations, 6e-5 is seen. Once more with the residuals that are left, as the next iteration would do it,
    leaves that much of it again.
    """
    chain, _ = levelled(60, phase=300.0)
    chain.add((3,), chain.states.reshape(-1, 1), 3, 1e-3)
    J, e = chain.dense()
    expected = refined(J, e)
    norm = np.linalg.norm(J, axis=0)
    root = np.linalg.inv(np.linalg.qr(J / norm, mode="r")) / norm[:, None]
    sigma = np.linalg.norm(root, axis=1)
    factor = chain.factorised()
    step = factor.step()
    assert np.abs((step - expected) / sigma).max() < 1e-3
    keys = chain.states[0].tolist()
    for P in (factor.covariance(keys), factor.selected().joint(keys)):
        np.testing.assert_allclose(np.sqrt(np.diag(P)), sigma[chain.columns(keys)], rtol=1e-3)
    starts = np.cumsum([0, *(len(part.e) for part in chain.parts)])
    left = e + J @ step
    chain.parts = [Part(left[i : i + len(p.e)], p.Jw, p.dense) for i, p in zip(starts, chain.parts, strict=False)]
    assert np.abs((step + chain.factorised().step() - expected) / sigma).max() < 1e-6


def test_what_does_not_fit() -> None:
    variables = Variables(np.array([1, 2]), np.array([1, 2]), np.array([0, 1]))
    one = np.array([0, 1])
    cases = [
        ([FactorBlock((1, 2), np.array([[1, 3]]), one)], "no variable 3"),
        ([FactorBlock((1, 1), np.array([[1, 2]]), one)], "variable 2 does not have the width"),
        ([FactorBlock((2, 2), np.array([[2, 2]]), one)], "factor 0 of block 0 has a variable twice"),
        (
            [FactorBlock((), np.zeros((1, 0), int), one, Scalars(np.array([2]), one, one))],
            "variable 2 of block 0 is not a scalar",
        ),
    ]
    for blocks, message in cases:
        with pytest.raises(InputError, match=message):
            Layout(variables, blocks)
    with pytest.raises(InputError, match="variable 1 is given twice"):
        Layout(Variables(np.array([1, 1]), np.array([1, 2]), np.array([0, 1])), [])
    layout = Layout(variables, [FactorBlock((1, 2), np.array([[1, 2]]), one)])
    with pytest.raises(InputError, match="1 blocks need as many parts, got 0"):
        layout.factorise([])
    with pytest.raises(InputError, match="part 0 must have e, Jw and dense of shapes"):
        layout.factorise([Part(np.zeros(1), np.zeros((1, 2)))])
    with pytest.raises(InputError, match="no variable 5"):
        layout.index([1, 5])
