"""What every minimiser of this room returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from swarm.types import Array


class SwarmStatus(Enum):
    """Why the search stopped."""

    TARGET = "target cost reached"
    CONVERGED = "the population has contracted"
    BUDGET = "evaluations used up"
    ITERATIONS = "iterations used up"
    STOPPED = "stopped by the callback"
    NO_FINITE_COST = "no finite cost was met"


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """The best point met and how it was found."""

    x: Array  # (n,)
    cost: float  # infinite where no finite cost was met
    n_evals: int  # points evaluated
    n_invalid: int  # of them without a finite cost
    history: Array  # (populations,) best cost after each population
    status: SwarmStatus
    history_evals: Array = field(default_factory=lambda: np.empty(0))  # (populations,) points evaluated by then, where kept
