"""Our own Gauss-Newton / Levenberg-Marquardt loop over a GTSAM graph.

GTSAM linearises and eliminates; the loop, the robust weights, the damping and the convergence test are here, because a
C++ optimizer copies all values into every Python factor call. One iteration: evaluate blocks, reweight, linearise,
eliminate along time (`ordering`), step; a step that raises the robust cost is undone and the damping raised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factorgraph.graphs.blocks import KINDS, Block, GnssBlock
from factorgraph.graphs.nodes import Nodes, take_nodes
from factorgraph.graphs.ordering import Lives, elimination_order
from factorgraph.graphs.parameters import Parameters
from factorgraph.graphs.variables import ValueTable, VehicleVariables
from factorgraph.models.robust import Loss, mixture
from factorgraph.problem import Robust
from factorgraph.solution import Status
from factorgraph.types import Array, IntArray

LAMBDA_START, LAMBDA_MAX = 1e-4, 1e8
PIVOT_MIN = 1e-13  # relative to its row
WIDE = 60  # columns of all states of one time, above which a minimum-degree ordering finds less fill than time does
MANY_AMBIGUITIES = 40  # from here on the paths to their joint covariance are to be short
DIMENSION = {"x": 6, "b": 6, "p": 3, "v": 3, "a": 1, "i": 1, "c": 1, "l": 3}  # of a variable, by the letter of its key


@dataclass(slots=True)
class Result:
    """How an optimisation ended; the Bayes net is that of the last linearisation, one small step before the end."""

    status: Status
    costs: list[float]
    bayes_net: gtsam.GaussianBayesNet | None = None


@dataclass(slots=True)
class Graph:
    """Native factors that stay, blocks that are evaluated anew, and the variables of both."""

    vehicles: list[VehicleVariables]
    blocks: list[Block]
    native: gtsam.NonlinearFactorGraph
    gnss: list[GnssBlock] = field(default_factory=list)
    parameters: Parameters = field(default_factory=Parameters)
    joints: list[Block] = field(default_factory=list)  # only for covariances: what is to share a clique
    values: gtsam.Values = field(default_factory=gtsam.Values)
    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    ambiguities: set[int] = field(default_factory=set)  # keys among the values

    @property
    def nodes(self) -> list[Nodes]:
        return [nodes for block in self.blocks for nodes in block.nodes]

    def assemble(self) -> None:
        """Collect factors and values; call again after ambiguities were fixed or released or native factors renewed."""
        self.graph = gtsam.NonlinearFactorGraph()
        self.graph.push_back(self.native)
        for block in self.blocks:
            self.graph.push_back(block.factors())
        if self.values.size() == 0:
            for vehicle in self.vehicles:
                vehicle.insert(self.values)
            for nodes in self.nodes:
                _put(self.values, nodes.key, nodes.value)
        used = {int(k) for gnss in self.gnss for k in gnss.amb_key}
        used &= set(self.graph.keyVector())
        for k in self.ambiguities - used:
            self.values.erase(k)
        self.ambiguities = used
        for gnss in self.gnss:
            mine = np.array([int(k) in used for k in gnss.amb_key], bool)
            _put(self.values, gnss.amb_key[mine], gnss.amb_value[mine])
        for parameter in self.parameters:
            if self.values.exists(parameter.key):
                self.values.update(parameter.key, parameter.value.copy())  # biases start anew with their ambiguities
            else:
                self.values.insert(parameter.key, parameter.value.copy())

    def take(self, values: gtsam.Values) -> None:
        """Make `values` current and evaluate every block there."""
        self.values = values
        table = ValueTable.of(values, self.vehicles)
        for vehicle in self.vehicles:
            vehicle.extract(values, table)
        for gnss in self.gnss:
            for i, k in enumerate(gnss.amb_key):
                if k and values.exists(int(k)):
                    gnss.amb_value[i] = values.atVector(int(k))[0]
        for parameter in self.parameters:
            parameter.value = values.atVector(parameter.key)
        take_nodes(values, self.nodes)
        for block in self.blocks:
            block.predict()

    def cost(self, losses: Mapping[str, Loss]) -> float:
        return self.native.error(self.values) + self.block_cost(losses)

    def block_cost(self, losses: Mapping[str, Loss]) -> float:
        return sum(b.cost(losses) for b in self.blocks)

    def reweight(self, robust: Mapping[str, Loss], afresh: bool = False) -> dict[str, Loss]:
        """Robust weights of all rows at the current residuals; returns the losses, those that tune themselves as tuned."""
        losses = {kind: self._tuned(kind, loss) for kind, loss in robust.items()}
        for block in self.blocks:
            block.reweight(losses, afresh)
        return losses

    def _tuned(self, kind: str, loss: Loss) -> Loss:
        if not (isinstance(loss, Robust) and loss.kernel == "self-tuned"):
            return loss
        index = KINDS.index(kind)
        parts = [b.normalised()[b.active & (b.rows.kind == index)] for b in self.blocks if np.any(b.rows.kind == index)]
        return mixture(np.concatenate([np.zeros(0), *parts]), loss.width)

    def linearize(self) -> gtsam.GaussianFactorGraph:
        for block in self.blocks:
            block.whiten()
        return self.graph.linearize(self.values)

    def covariance_net(self) -> gtsam.GaussianBayesNet | None:
        """The elimination at the current values, with the variables of `joints` kept together."""
        linear = self.linearize()
        extra = gtsam.NonlinearFactorGraph()
        for block in self.joints:
            block.predict()
            block.whiten()
            extra.push_back(block.factors())
        linear.push_back(extra.linearize(self.values))
        return eliminate(linear, self.ordering(linear))

    def ordering(self, linear: gtsam.GaussianFactorGraph) -> gtsam.Ordering:
        """Along time, parameters last; by nested dissection where there are many ambiguities; see `graphs.ordering`."""
        constants = [parameter.key for parameter in self.parameters]
        if sum(sum(v.dims) for v in self.vehicles) > WIDE:
            last = [*sorted(self.ambiguities), *constants]
            by_degree = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph
            return by_degree(linear, last) if last else gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        states = [[v.keys(k) for k in range(len(v.t_s))] for v in self.vehicles]
        grid = self.vehicles[0].t_s
        lives = [Lives.between(*gnss.sightings(), grid) for gnss in self.gnss]
        for block in self.blocks:
            if not isinstance(block, GnssBlock):
                lives += [Lives.between(nodes.key[nodes.node], block.rows.t_s[nodes.row], grid) for nodes in block.nodes]
        nested = len(self.ambiguities) > MANY_AMBIGUITIES
        return elimination_order(states, Lives.joined(lives), constants, [int(k) for k in linear.keyVector()], nested)


def _put(values: gtsam.Values, keys: IntArray, scalars: Array) -> None:
    for k, value in zip(keys, scalars, strict=True):
        if values.exists(int(k)):
            values.update(int(k), np.array([value]))
        else:
            values.insert(int(k), np.array([value]))


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
        n = DIMENSION[chr(gtsam.symbolChr(k))]
        damped.add(gtsam.JacobianFactor(k, np.eye(n) * np.sqrt(lam), np.zeros(n), gtsam.noiseModel.Unit.Create(n)))
    return damped


def optimise(
    graph: Graph, robust: Mapping[str, Loss], max_iterations: int, tolerance: float, progress: Callable[[int, float], None]
) -> Result:
    """Minimise the robust cost from the current values; the result's Bayes net belongs to the last linearisation.

    Converged when the cost falls by less than `tolerance` of itself plus one. The steps are Gauss-Newton
    while the cost falls; otherwise Levenberg-Marquardt with damping relative to unit information. A problem that only damping
    makes solvable ends as singular, without a Bayes net.
    """
    graph.take(graph.values)
    losses = graph.reweight(robust, afresh=True)
    native = graph.native.error(graph.values)
    cost = native + graph.block_cost(losses)
    costs = [cost]
    lam = 0.0
    net, order = None, None
    singular = False
    for iteration in range(max_iterations):
        losses = graph.reweight(robust)
        weighed = native + graph.block_cost(losses)  # clocks move with the weights, and losses that tune themselves change
        net = None  # the old elimination and the new system need not be in memory together
        linear = graph.linearize()
        if order is None:
            order = graph.ordering(linear)
        before = graph.values
        while True:
            net = eliminate(linear if lam == 0 else _damped(linear, lam), order)
            if lam == 0:
                singular = net is None
            if net is not None:
                graph.take(before.retract(net.optimize()))
                native = graph.native.error(graph.values)
                new = native + graph.block_cost(losses)
                # linearisation errs, so near the optimum the cost may rise by next to nothing
                if np.isfinite(new) and new <= weighed + tolerance * (weighed + 1):
                    break
                graph.take(before)
            lam = LAMBDA_START if lam == 0 else lam * 10
            if lam > LAMBDA_MAX:
                status = Status.SINGULAR if net is None else Status.STALLED
                return Result(status, costs, None if singular else eliminate(linear, order))
        lam = 0.0 if lam <= LAMBDA_START else lam / 10
        # losses that reject outright may take turns between rows: then an iteration gets no further although its step does
        decrease, cost = min(weighed - new, abs(cost - new)), new
        costs.append(cost)
        progress(iteration + 1, cost)
        if lam == 0.0 and decrease < tolerance * (cost + 1):
            return Result(Status.SINGULAR, costs) if singular else Result(Status.CONVERGED, costs, net)
    return Result(Status.MAX_ITERATIONS, costs, net)
