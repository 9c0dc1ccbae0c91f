"""Metaheuristic minimisers of a plain callable: bounded, counted, vectorised.

`minimize("tdo", cost, bounds, rng=rng)` takes a cost of many points at once, or a `CompiledCost`, and returns a `SwarmResult`;
`METHODS` names them all, and `tdo`, `pso`, `ga` and `references` hold them with their own options.
"""

from swarm.compiled import CompiledCost
from swarm.methods import METHODS, Optimiser, minimize
from swarm.result import SwarmResult, SwarmStatus
from swarm.types import Progress

__all__ = ["METHODS", "CompiledCost", "Optimiser", "Progress", "SwarmResult", "SwarmStatus", "minimize"]
