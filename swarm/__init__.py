"""Metaheuristic minimisers of a plain callable: bounded, counted, vectorised.

`pso.minimize(cost, bounds, rng=rng)` takes a cost of many points at once and returns a `SwarmResult`.
"""

from swarm.result import SwarmResult, SwarmStatus

__all__ = ["SwarmResult", "SwarmStatus"]
