"""Constants that the flight estimates beside its states: biases, scales, lever arms, mountings, time offsets.

A parameter is one variable with a Gaussian prior, eliminated after all states. Its key's letter says its
dimension: `c` 1, `l` 3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.keys import symbol
from factorgraph.types import Array

LETTERS = {1: "c", 3: "l"}


@dataclass(slots=True, eq=False)
class Parameter:
    """One constant and its prior."""

    key: int
    name: str  # "follower/gnss lever arm"
    components: tuple[str, ...]  # "x", "y", "z"; ("",) of a scalar
    unit: str
    prior: Array  # (d,) mean
    sigma: Array  # (d,) of the prior
    value: Array  # (d,) current estimate


@dataclass(slots=True)
class Parameters:
    """The parameters of a graph, one per name."""

    of_name: dict[str, Parameter] = field(default_factory=dict)

    def add(self, name: str, components: tuple[str, ...], unit: str, prior: Array, sigma: Array) -> Parameter:
        """The parameter of that name; made where there is none yet. prior, sigma (d,), d 1 or 3."""
        if name not in self.of_name:
            prior, sigma = np.atleast_1d(np.asarray(prior, float)), np.atleast_1d(np.asarray(sigma, float))
            key = symbol(LETTERS[len(prior)], len(self.of_name))
            self.of_name[name] = Parameter(key, name, components, unit, prior, sigma, prior.copy())
        return self.of_name[name]

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.of_name.values())

    def scalar(self, name: str, unit: str, sigma: float, prior: float = 0.0) -> Parameter | None:
        """A scalar parameter, None where `sigma` is 0."""
        return self.add(name, ("",), unit, np.array([prior]), np.array([sigma])) if sigma > 0 else None

    def vector(self, name: str, unit: str, sigma: float) -> Parameter | None:
        """Three components x, y, z with zero mean, None where `sigma` is 0."""
        return self.add(name, ("x", "y", "z"), unit, np.zeros(3), np.full(3, sigma)) if sigma > 0 else None

    def offsets_s(self) -> Array:
        """Current time offsets (m,)."""
        return np.array([p.value[0] for p in self.of_name.values() if p.unit == "s"])
