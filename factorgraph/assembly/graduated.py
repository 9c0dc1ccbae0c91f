"""Graduated non-convexity: losses with local minima approached from convex ones, so that bad starts converge.

After least squares, each loss is replaced by a relaxed one that is convex over the residuals there are, and tightened step by
step, a few Gauss-Newton iterations each. With R the relaxation, from R_0 down by a constant factor,

    truncated least squares        mu = 1 / R          R_0 = 2 r_max^2 / c^2 - 1, until 1 / mu is TLS_END
    other losses with local minima c -> c sqrt(R)      R_0 = 2 r_max^2 / c^2, until 1

where r_max is the largest normalised residual of least squares. Huber's loss is convex and stays, and a self-tuned one starts
wide by itself.

Source: Yang, Antonante, Tzoumas and Carlone (2020), Graduated non-convexity for robust spatial perception, for Geman-McClure
and truncated least squares; the others by the same scaling of the width.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from factorgraph.assembly.blocks import KINDS
from factorgraph.assembly.optimizer import Graph, optimise
from factorgraph.models.robust import Loss, RelaxedTls
from factorgraph.problem import Robust
from factorgraph.types import Array

GRADUATED = ("cauchy", "geman-mcclure", "tukey", "dcs", "tls")
TLS_END = 0.02  # of 1 / mu: weights between 0 and 1 are then within 1 % of the width
START_ITERATIONS = 30
ITERATIONS = 2  # per step
TOLERANCE = 1e-3


def relaxed(loss: Robust, relaxation: float) -> Loss:
    """A loss relaxed by a factor of at least its smallest."""
    if loss.kernel == "tls":
        return RelaxedTls(loss.width, 1 / max(relaxation, TLS_END))
    return replace(loss, width=loss.width * float(np.sqrt(max(relaxation, 1.0))))


def relaxations(largest: Mapping[str, float], robust: Mapping[str, Robust], step: float) -> list[dict[str, Loss]]:
    """Losses from convex to their own, all kinds together; `largest`: normalised residual of each kind that occurs."""
    start = {}
    for kind, r_max in largest.items():
        loss = robust.get(kind)
        if loss is not None and loss.kernel in GRADUATED:
            ratio = 2 * (r_max / loss.width) ** 2
            start[kind] = (ratio - 1, TLS_END) if loss.kernel == "tls" else (ratio, 1.0)
    count = max((int(np.ceil(np.log(max(first / end, 1.0)) / np.log(step))) for first, end in start.values()), default=0)
    return [
        {**robust, **{kind: relaxed(robust[kind], first / step**k) for kind, (first, _) in start.items()}} for k in range(count)
    ]


def approach(graph: Graph, robust: Mapping[str, Robust], step: float, progress: Callable[[int, float], None]) -> None:
    """Take the graph's variables to where the relaxed losses lead; the losses themselves are the caller's to minimise."""
    graph.assemble()
    convex = {kind: loss for kind, loss in robust.items() if loss.kernel not in GRADUATED}
    optimise(graph, convex, START_ITERATIONS, TOLERANCE, progress)
    for losses in relaxations(_largest(graph), robust, step):
        optimise(graph, losses, ITERATIONS, TOLERANCE, progress)


def _largest(graph: Graph) -> dict[str, float]:
    """Largest normalised residual of each kind, all rows weighing alike."""
    found: dict[str, float] = {}
    for block in graph.blocks:
        block.reweight({})
        t: Array = np.abs(block.normalised())
        for index in np.unique(block.rows.kind[block.active & (block.rows.kind >= 0)]).tolist():
            kind = KINDS[index]
            found[kind] = max(found.get(kind, 0.0), float(t[block.active & (block.rows.kind == index)].max()))
    return found
