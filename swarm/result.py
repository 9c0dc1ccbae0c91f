"""What every minimiser of this room returns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from swarm.types import Array


class SwarmStatus(Enum):
    """Why the search stopped."""

    TARGET = "target cost reached"
    CONVERGED = "the population has contracted"
    BUDGET = "evaluations used up"
    NO_FINITE_COST = "no finite cost was met"


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """The best point met and how it was found."""

    x: Array  # (n,)
    cost: float  # infinite where no finite cost was met
    n_evals: int  # points evaluated
    n_invalid: int  # of them without a finite cost
    history: Array  # (iterations + 1,) best cost after each population
    status: SwarmStatus
