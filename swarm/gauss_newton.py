"""Bounded Gauss-Newton of an `Objective`: what a swarm has to be compared with.

Squares: steps p = -lstsq(J, r) over the coordinates that no wall holds, cut to the box and halved while the cost does not fall.
A wall holds a coordinate on it whose descent leads out. Sizes: the same for sum sqrt(r^2 + epsilon^2), whose majorising
squares have weights 1 / sqrt(r^2 + epsilon^2), for smaller and smaller epsilon: reweighted least squares.

Source: Bertsekas (1982) for the projected step; Huber (1981), sec. 7.8, for reweighting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarm.objective import Objective
from swarm.result import SwarmResult, SwarmStatus
from swarm.types import Array

STEPS, HALVINGS = 60, 30  # of one epsilon, of one step
TOLERANCE = 1e-12  # of a step in parts of the box, and of the cost that it takes away
EPSILONS = 10.0 ** -np.arange(0.0, 9.5, 0.5)  # in mean sizes of the rows at the start
SETTLED = 1e-7  # part of the cost that a step at one epsilon has to take away


def minimize(cost: Objective, bounds: Array, start: Array) -> SwarmResult:
    """Local minimum in the box bounds (p, 2) from a point start (p,) in it; rows evaluated count as points."""
    first = float(cost(start[None])[0])
    trace = _Trace(start.copy(), first, [first], [1.0])
    for epsilon in EPSILONS * first / len(cost.c) if cost.absolute else (0.0,):
        converged = _descend(cost, bounds, float(epsilon), trace)
    status = SwarmStatus.CONVERGED if converged else SwarmStatus.BUDGET
    history = np.minimum.accumulate(trace.history)
    return SwarmResult(trace.best, trace.least, trace.n_evals, 0, history, status, np.array(trace.history_evals))


@dataclass(slots=True)
class _Trace:
    """The best point so far, and the cost after every step."""

    best: Array
    least: float
    history: list[float]
    history_evals: list[float]
    n_evals: int = 1

    def step(self, y: Array, value: float) -> None:
        self.history.append(value)
        self.history_evals.append(float(self.n_evals))
        if value < self.least:
            self.best, self.least = y, value


def _descend(cost: Objective, bounds: Array, epsilon: float, trace: _Trace) -> bool:
    """Go from the best point to the minimum of the smoothed cost; whether it was reached."""
    y = trace.best
    r = cost.rows(y[None])[0]
    value = _merit(r, epsilon)
    for _ in range(STEPS):
        w = 1 / np.sqrt(r * r + epsilon**2) ** 0.5 if epsilon else np.ones(len(r))
        J = cost.jacobian(y)
        gradient = J.T @ (w * w * r)
        free = ~(((y <= bounds[:, 0]) & (gradient > 0)) | ((y >= bounds[:, 1]) & (gradient < 0)))
        p = np.zeros(len(y))
        p[free] = -np.linalg.lstsq(w[:, None] * J[:, free], w * r, rcond=None)[0]
        before, share = value, 1.0
        for _ in range(HALVINGS):
            there = np.clip(y + share * p, bounds[:, 0], bounds[:, 1])
            r_there = cost.rows(there[None])[0]
            trace.n_evals += 1
            if (value := _merit(r_there, epsilon)) < before:
                break
            share *= 0.5
        else:
            return True
        moved = np.abs(there - y) / (bounds[:, 1] - bounds[:, 0])
        y, r = there, r_there
        trace.step(y, float(np.abs(r).sum() if cost.absolute else r @ r))
        enough = SETTLED if epsilon else TOLERANCE
        if before - value <= enough * before or moved.max() <= TOLERANCE:
            return True
    return False


def _merit(r: Array, epsilon: float) -> float:
    return float(np.sqrt(r * r + epsilon**2).sum() if epsilon else r @ r)
