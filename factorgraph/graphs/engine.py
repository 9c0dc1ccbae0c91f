"""GTSAM linearises and eliminates: one custom factor per factor of a block, which hands out what the block computed.

A factor holds the arrays that its block fills and not the block, which may come to hold it: a circle of Python and C++ would
never be freed. Values stay empty, as no factor looks at them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph.assembly.blocks import Block, GnssBlock
from factorgraph.assembly.keys import dimension
from factorgraph.assembly.optimizer import Graph
from factorgraph.graphs.covariance import JointCovariance, covariance_of
from factorgraph.graphs.ordering import Lives, elimination_order
from factorgraph.types import Array, IntArray

PIVOT_MIN = 1e-13  # relative to its row
WIDE = 60  # columns of all states of one time, above which a minimum-degree ordering finds less fill than time does
MANY_AMBIGUITIES = 40  # from here on the paths to their joint covariance are to be short


@dataclass(slots=True)
class Net:
    """A linear problem eliminated to a Bayes net."""

    net: gtsam.GaussianBayesNet
    solution: gtsam.VectorValues | None = None

    def step(self, keys: Sequence[int] | IntArray) -> Array:
        """The minimiser's components (n, d)."""
        if self.solution is None:
            self.solution = self.net.optimize()
        return np.array([self.solution.at(int(key)) for key in keys])

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of a few variables."""
        return covariance_of(self.net, keys)

    def covariances(self) -> JointCovariance:
        """Those of all variables that share a clique."""
        return JointCovariance(self.net)


@dataclass(slots=True)
class LinearGraph:
    """A linearised problem with its order of elimination."""

    linear: gtsam.GaussianFactorGraph
    order: gtsam.Ordering

    def eliminate(self, lam: float) -> Net | None:
        """Eliminate all variables, damped by lam; None where the problem is singular."""
        net = eliminate(self.linear if lam == 0 else _damped(self.linear, lam), self.order)
        return None if net is None else Net(net)


class GtsamEngine:
    """Blocks evaluated as they are, eliminated by GTSAM."""

    packages: tuple[str, ...] = ("gtsam",)

    def __init__(self) -> None:
        self._factors: dict[int, tuple[Block, tuple[int, ...], gtsam.NonlinearFactorGraph]] = {}
        self._order: tuple[object, gtsam.Ordering] | None = None

    def predict(self, block: Block) -> None:
        """Set the block's y and J at the current variables."""
        block.predict()

    def linearise(self, graph: Graph, joints: bool) -> LinearGraph:
        """The blocks' whitened rows as a linear graph; with `joints` the states of pairs share a clique."""
        extra = graph.joints if joints else []
        for block in extra:
            block.predict()
            block.whiten()
        factors = gtsam.NonlinearFactorGraph()
        structure: list[object] = []
        for block in (*graph.blocks, *extra):
            factors.push_back(self._of(block))
            structure.append((id(block), block.version))
        linear = factors.linearize(gtsam.Values())
        if self._order is None or self._order[0] != structure:
            self._order = structure, ordering(graph, linear)
        return LinearGraph(linear, self._order[1])

    def remarks(self, graph: Graph) -> list[str]:
        """GTSAM names no variable."""
        return []

    def _of(self, block: Block) -> gtsam.NonlinearFactorGraph:
        """The block's factors, made once as long as its structure stays."""
        known = self._factors.get(id(block))
        if known is None or known[0] is not block or known[1] != block.version:
            known = self._factors[id(block)] = block, block.version, factors_of(block)
        return known[2]


def factors_of(block: Block) -> gtsam.NonlinearFactorGraph:
    """A factor for each of a block that has variables."""
    made = gtsam.NonlinearFactorGraph()
    edges, scalars = block.edges(), block.scalars()
    for f in range(len(block.rows.factor.start)):
        keys = block.keys(f)
        used = [edge for edge, key in zip(edges, keys, strict=True) if key]
        keys = [key for key in keys if key]
        matrix = None
        if scalars is not None and scalars.first_key[f + 1] > scalars.first_key[f]:
            matrix = scalars.matrix(f)
            keys += scalars.of(f)
        if keys:
            made.add(_carrier(block, block.slices(f), keys, used, matrix))
    return made


def _carrier(
    block: Block, rows: tuple[int, int], keys: list[int], edges: list[tuple[int, int]], matrix: Array | None
) -> gtsam.CustomFactor:
    """A factor that hands out rows of what `whiten` computed, and the columns of its scalar variables."""
    (i, j), white, own = rows, block.white, len(edges)
    width = 0 if matrix is None else matrix.shape[1]

    def error(_factor: gtsam.CustomFactor, _values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        if jacobians is not None:
            Jw = white.Jw[i:j]
            for slot, (a, b) in enumerate(edges):
                jacobians[slot] = Jw[:, a:b]
            for k in range(width):
                jacobians[own + k] = matrix[:, k : k + 1]  # type: ignore[index]
        return white.e[i:j]

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(j - i), keys, error)


def ordering(graph: Graph, linear: gtsam.GaussianFactorGraph) -> gtsam.Ordering:
    """Along time, parameters last; by nested dissection where there are many ambiguities; see `graphs.ordering`."""
    constants = [parameter.key for parameter in graph.parameters]
    if sum(sum(v.dims) for v in graph.vehicles) > WIDE:
        last = [*sorted(graph.ambiguities), *constants]
        by_degree = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph
        return by_degree(linear, last) if last else gtsam.Ordering.ColamdGaussianFactorGraph(linear)
    states = [[v.keys(k) for k in range(len(v.t_s))] for v in graph.vehicles]
    grid = graph.vehicles[0].t_s
    lives = [Lives.between(*gnss.sightings(), grid) for gnss in graph.gnss]
    for block in graph.blocks:
        if not isinstance(block, GnssBlock):
            lives += [Lives.between(nodes.key[nodes.node], block.rows.t_s[nodes.row], grid) for nodes in block.nodes]
    nested = len(graph.ambiguities) > MANY_AMBIGUITIES
    return elimination_order(states, Lives.joined(lives), constants, [int(k) for k in linear.keyVector()], nested)


def eliminate(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.GaussianBayesNet | None:
    """Cholesky, QR where Cholesky calls the system indeterminate, None where it is singular."""
    try:
        return linear.eliminateSequential(ordering)
    except RuntimeError:
        try:
            net = linear.eliminateSequential(ordering, gtsam.EliminateQR)
        except RuntimeError:
            return None
        return net if _has_full_rank(net) else None


def _has_full_rank(net: gtsam.GaussianBayesNet) -> bool:
    """Whether every pivot stands out from the rounding of its row; QR itself never complains."""
    for i in range(net.size()):
        c = net.at(i)
        R = c.R()
        if np.any(np.abs(np.diag(R)) <= PIVOT_MIN * np.abs(np.hstack([R, c.S()])).max(axis=1)):
            return False
    return True


def _damped(linear: gtsam.GaussianFactorGraph, lam: float) -> gtsam.GaussianFactorGraph:
    damped = linear.clone()
    for k in linear.keyVector():
        n = dimension(k)
        damped.add(gtsam.JacobianFactor(k, np.eye(n) * np.sqrt(lam), np.zeros(n), gtsam.noiseModel.Unit.Create(n)))
    return damped
