"""Gauss-Newton and Levenberg-Marquardt over an assembled problem.

An engine linearises and eliminates; the loop, the robust weights, the damping and the convergence test are here. One
iteration: evaluate blocks, reweight, linearise, eliminate, step; a step that raises the robust cost is undone and the damping
raised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.blocks import KINDS, Block, GnssBlock
from factorgraph.assembly.engine import Eliminated, Engine, Step
from factorgraph.assembly.nodes import Nodes
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.variables import Trajectory, VehicleVariables
from factorgraph.models.robust import Loss, mixture
from factorgraph.problem import Robust
from factorgraph.solution import Status
from factorgraph.types import Array

LAMBDA_START, LAMBDA_MAX = 1e-4, 1e8


@dataclass(slots=True)
class Result:
    """How an optimisation ended; eliminated is the last linearisation, one small step before the end."""

    status: Status
    costs: list[float]
    eliminated: Eliminated | None = None


@dataclass(frozen=True, slots=True)
class Values:
    """Values of all variables."""

    trajectories: list[Trajectory]
    ambiguities: list[Array]
    parameters: list[Array]
    nodes: list[Array]


@dataclass(slots=True)
class Graph:
    """The variables of a problem and the blocks that tie them to each other and to measurements."""

    vehicles: list[VehicleVariables]
    engine: Engine
    blocks: list[Block] = field(default_factory=list)
    gnss: list[GnssBlock] = field(default_factory=list)
    parameters: Parameters = field(default_factory=Parameters)
    joints: list[Block] = field(default_factory=list)  # only for covariances: variables whose joint one is wanted
    ambiguities: set[int] = field(default_factory=set)  # keys in use

    @property
    def nodes(self) -> list[Nodes]:
        return [nodes for block in self.blocks for nodes in block.nodes]

    def assemble(self) -> None:
        """See which ambiguities are variables; call again after some were fixed or released."""
        free = {int(k) for gnss in self.gnss for k in gnss.amb_key}
        self.ambiguities = free & {int(k) for gnss in self.gnss for k in gnss.scalars().keys}

    def preintegrate(self) -> None:
        """Have IMUs integrated at the current biases, time offsets and scale factors from now on."""
        for v in self.vehicles:
            v.apply_imu_calibration()
            v.preintegrated_bias = v.bias.copy()
        for block in self.blocks:
            block.refresh()

    def predict(self) -> None:
        """Evaluate every block."""
        for block in self.blocks:
            self.engine.predict(block)

    def values(self) -> Values:
        """The current values; arrays are replaced and not written to when variables move."""
        return Values(
            [v.trajectory for v in self.vehicles],
            [gnss.amb_value for gnss in self.gnss],
            [parameter.value for parameter in self.parameters],
            [nodes.value for nodes in self.nodes],
        )

    def take(self, values: Values) -> None:
        """Make values current and evaluate every block there."""
        for v, trajectory in zip(self.vehicles, values.trajectories, strict=True):
            v.trajectory = trajectory
        for gnss, of_arcs in zip(self.gnss, values.ambiguities, strict=True):
            gnss.amb_value = of_arcs
        for parameter, value in zip(self.parameters, values.parameters, strict=True):
            parameter.value = value
        for nodes, of_nodes in zip(self.nodes, values.nodes, strict=True):
            nodes.value = of_nodes
        self.predict()

    def move(self, eliminated: Step) -> None:
        """Move all variables by a step, such as that of a linear solution, and evaluate every block there."""
        for v in self.vehicles:
            v.retract(eliminated.step)
        for gnss in self.gnss:
            free = np.array([int(k) in self.ambiguities for k in gnss.amb_key], bool)
            gnss.amb_value = gnss.amb_value.copy()
            if np.any(free):
                gnss.amb_value[free] += eliminated.step(gnss.amb_key[free].tolist())[:, 0]
        for parameter in self.parameters:
            parameter.value = parameter.value + eliminated.step([parameter.key])[0]
        for nodes in self.nodes:
            nodes.value = nodes.value + eliminated.step(nodes.key.tolist())[:, 0]
        self.predict()

    def cost(self, losses: Mapping[str, Loss]) -> float:
        return sum(b.cost(losses) for b in self.blocks)

    def name_of(self, key: int) -> str:
        """What a variable is, in words."""
        for v in self.vehicles:
            for k in range(len(v.t_s)):
                if key in v.keys(k):
                    words = ("attitude or position", "velocity", "IMU bias") if v.mode == "imu" else ("position", "velocity")
                    return f"the {words[v.keys(k).index(key)]} of {v.name} at {v.t_s[k]:.2f} s"
        for parameter in self.parameters:
            if parameter.key == key:
                return parameter.name
        for gnss in self.gnss:
            for arc in np.flatnonzero(gnss.amb_key == key):
                row = int(np.flatnonzero(gnss.arc == arc)[0])
                return f"the ambiguity of {gnss.rows.label[gnss.rows.label_index[row]]} in {gnss.rows.source}"
        return "a delay that changes slowly"

    def worst_row(self) -> str | None:
        """The measurement that is furthest from the current variables, in words."""
        worst: tuple[float, str] | None = None
        for b in self.blocks:
            t = np.where(b.active & (b.rows.kind >= 0), np.abs(b.normalised()), -1.0)
            i = int(np.argmax(t)) if b.n else 0
            if b.n and t[i] > (worst[0] if worst else 0.0):
                kind, label = KINDS[b.rows.kind[i]], b.rows.label[b.rows.label_index[i]]
                worst = float(t[i]), f"{kind} {label} of {b.rows.source} at {b.rows.t_s[i]:.2f} s is off by {t[i]:.3g} sigma"
        return worst[1] if worst else None

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

    def eliminate(self, joints: bool = False) -> Eliminated | None:
        """The problem at the current values, eliminated; with `joints` for covariances of pairs. None where singular."""
        for block in self.blocks:
            block.whiten()
        return self.engine.linearise(self, joints).eliminate(0.0)


def optimise(
    graph: Graph, robust: Mapping[str, Loss], max_iterations: int, tolerance: float, progress: Callable[[int, float], None]
) -> Result:
    """Minimise the robust cost from the current values; the result's elimination is the last linearisation's.

    Converged when the cost falls by less than `tolerance` of itself plus one. The steps are Gauss-Newton
    while the cost falls; otherwise Levenberg-Marquardt with damping relative to unit information. A problem that only damping
    makes solvable ends as singular, with nothing eliminated.
    """
    graph.predict()
    losses = graph.reweight(robust, afresh=True)
    cost = graph.cost(losses)
    costs = [cost]
    lam = 0.0
    eliminated: Eliminated | None = None
    singular = False
    for iteration in range(max_iterations):
        losses = graph.reweight(robust)
        weighed = graph.cost(losses)  # clocks move with the weights, and losses that tune themselves change
        eliminated = None  # the old elimination and the new system need not be in memory together
        for block in graph.blocks:
            block.whiten()
        linear = graph.engine.linearise(graph, joints=False)
        before = graph.values()
        while True:
            eliminated = linear.eliminate(lam)
            if lam == 0:
                singular = eliminated is None
            if eliminated is not None:
                graph.move(eliminated)
                new = graph.cost(losses)
                # linearisation errs, so near the optimum the cost may rise by next to nothing
                if np.isfinite(new) and new <= weighed + tolerance * (weighed + 1):
                    break
                graph.take(before)
            lam = LAMBDA_START if lam == 0 else lam * 10
            if lam > LAMBDA_MAX:
                status = Status.SINGULAR if eliminated is None else Status.STALLED
                return Result(status, costs, None if singular else linear.eliminate(0.0))
        lam = 0.0 if lam <= LAMBDA_START else lam / 10
        # losses that reject outright may take turns between rows: then an iteration gets no further although its step does
        decrease, cost = min(weighed - new, abs(cost - new)), new
        costs.append(cost)
        progress(iteration + 1, cost)
        if lam == 0.0 and decrease < tolerance * (cost + 1):
            return Result(Status.SINGULAR, costs) if singular else Result(Status.CONVERGED, costs, eliminated)
    return Result(Status.MAX_ITERATIONS, costs, eliminated)
