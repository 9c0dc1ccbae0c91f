"""Our own Gauss-Newton / Levenberg-Marquardt loop over a GTSAM graph.

GTSAM linearises and eliminates; the loop, the robust weights, the damping and the convergence test are here, because a
C++ optimizer copies all values into every Python factor call. One iteration: evaluate blocks, reweight, linearise,
eliminate in COLAMD order with ambiguities and parameters last, step; a step that raises the robust cost is undone
and the damping raised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factorgraph.graphs.blocks import Block, GnssBlock
from factorgraph.graphs.parameters import Parameters
from factorgraph.graphs.variables import ValueTable, VehicleVariables
from factorgraph.problem import Robust
from factorgraph.solution import Status
from factorgraph.types import Array, IntArray

LAMBDA_START, LAMBDA_MAX = 1e-4, 1e8
PIVOT_MIN = 1e-13  # relative to its row
DIMENSION = {"x": 6, "b": 6, "p": 3, "v": 3, "a": 1, "i": 1, "c": 1, "s": 2, "l": 3}  # of a variable, by the letter of its key


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
    last: list[int] = field(default_factory=list)  # keys that are eliminated last
    ambiguities: set[int] = field(default_factory=set)  # keys among the values

    def assemble(self) -> None:
        """Collect factors and values; call again after ambiguities were fixed or released or native factors renewed."""
        self.graph = gtsam.NonlinearFactorGraph()
        self.graph.push_back(self.native)
        for block in self.blocks:
            self.graph.push_back(block.factors())
        if self.values.size() == 0:
            for vehicle in self.vehicles:
                vehicle.insert(self.values)
            for gnss in self.gnss:
                _put(self.values, gnss.iono_key, gnss.iono_value)
        used = {int(k) for gnss in self.gnss for k in gnss.amb_key}
        used &= set(self.graph.keyVector())
        for k in self.ambiguities - used:
            self.values.erase(k)
        self.ambiguities = used
        for gnss in self.gnss:
            mine = np.array([int(k) in used for k in gnss.amb_key], bool)
            _put(self.values, gnss.amb_key[mine], gnss.amb_value[mine])
        self.last = sorted(used)
        for parameter in self.parameters:
            if not self.values.exists(parameter.key):
                self.values.insert(parameter.key, parameter.value.copy())
            self.last.append(parameter.key)

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
            for i, k in enumerate(gnss.iono_key):
                gnss.iono_value[i] = values.atVector(int(k))[0]
        for parameter in self.parameters:
            parameter.value = values.atVector(parameter.key)
        for block in self.blocks:
            block.predict()

    def cost(self, robust: dict[str, Robust]) -> float:
        return self.native.error(self.values) + sum(b.cost(robust) for b in self.blocks)

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
        """COLAMD with ambiguities and parameters last."""
        if self.last:
            return gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, self.last)
        return gtsam.Ordering.ColamdGaussianFactorGraph(linear)


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
    graph: Graph, robust: dict[str, Robust], max_iterations: int, tolerance: float, progress: Callable[[int, float], None]
) -> Result:
    """Minimise the robust cost from the current values; the result's Bayes net belongs to the last linearisation.

    Converged when the cost falls by less than `tolerance` of itself plus one. The steps are Gauss-Newton
    while the cost falls; otherwise Levenberg-Marquardt with damping relative to unit information. A problem that only damping
    makes solvable ends as singular, without a Bayes net.
    """
    graph.take(graph.values)
    for block in graph.blocks:
        block.reweight(robust)
    cost = graph.cost(robust)
    costs = [cost]
    lam = 0.0
    net, order = None, None
    singular = False
    for iteration in range(max_iterations):
        for block in graph.blocks:
            block.reweight(robust)
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
                new = graph.cost(robust)
                # robust weights lag one iteration, so near the optimum the cost may rise by next to nothing
                if np.isfinite(new) and new <= cost + tolerance * (cost + 1):
                    break
                graph.take(before)
            lam = LAMBDA_START if lam == 0 else lam * 10
            if lam > LAMBDA_MAX:
                status = Status.SINGULAR if net is None else Status.STALLED
                return Result(status, costs, None if singular else eliminate(linear, order))
        lam = 0.0 if lam <= LAMBDA_START else lam / 10
        decrease, cost = cost - new, new
        costs.append(cost)
        progress(iteration + 1, cost)
        if lam == 0.0 and decrease < tolerance * (cost + 1):
            return Result(Status.SINGULAR, costs) if singular else Result(Status.CONVERGED, costs, net)
    return Result(Status.MAX_ITERATIONS, costs, net)
