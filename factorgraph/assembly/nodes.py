"""Quantities that change slowly along the flight: scalar variables at nodes in time, linear between them.

A series (the ionosphere of one satellite, a wet delay, a sensor's bias) has nodes at whole multiples of a step; an
observation at time t between nodes j and j + 1 sees (1 - f) x_j + f x_{j+1}. From node to node the series is either a
Gauss-Markov process of standard deviation s and correlation time tau or, with an infinite one, a random walk of density q:

    x_{j+1} = a x_j + w,   a = exp(-dt / tau), var w = s^2 (1 - a^2);   or   a = 1, var w = q^2 dt

All have zero mean; the first node of a series has standard deviation s.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.keys import symbol
from factorgraph.types import Array, IntArray

LETTER = "i"  # of the nodes' keys
LEAST = 1e-9  # share of a node below which an observation does not see it


@dataclass(frozen=True, slots=True)
class Process:
    """How a series changes: `sigma` of a single value, correlation time [s]; a random walk where that is infinite."""

    sigma: float
    correlation_s: float = np.inf
    walk: float = 0.0  # density of the random walk, per sqrt(s)

    def step(self, dt_s: Array) -> tuple[Array, Array]:
        """Decay a and standard deviation of w (n,) over steps dt_s (n,)."""
        if np.isinf(self.correlation_s):
            return np.ones_like(dt_s), self.walk * np.sqrt(dt_s)
        a = np.exp(-dt_s / self.correlation_s)
        return a, self.sigma * np.sqrt(1 - a**2)


@dataclass(slots=True, eq=False)
class Nodes:
    """Nodes of one or several series and how the rows of one block see them; entries without order."""

    name: str
    key: IntArray  # (k,) by series, then time
    t_s: Array  # (k,)
    series: IntArray  # (k,)
    row: IntArray  # (e,)
    node: IntArray  # (e,)
    scale: Array  # (e,) of this row per unit of that node
    value: Array = field(init=False)  # (k,)

    def __post_init__(self) -> None:
        self.value = np.zeros(len(self.key))

    @classmethod
    def of(cls, name: str, first_key: int, rows: IntArray, series: IntArray, t_s: Array, scale: Array, step_s: float) -> Nodes:
        """Nodes for `rows` (n,) of a block, with the series, time and factor (n,) of each. Keys count up from `first_key`."""
        place = (t_s - t_s.min()) / step_s
        before = np.floor(place).astype(np.int64)
        late = place - before
        width = int(before.max()) + 2
        row = np.concatenate([rows, rows])
        label = np.concatenate([series * width + before, series * width + before + 1])
        share = np.concatenate([scale * (1 - late), scale * late])
        seen = np.concatenate([1 - late, late]) > LEAST
        used, node = np.unique(label[seen], return_inverse=True)
        keys = np.array([symbol(LETTER, first_key + i) for i in range(len(used))], np.int64)
        return cls(name, keys, t_s.min() + used % width * step_s, used // width, row[seen], node, share[seen])

    @property
    def previous(self) -> IntArray:
        """(k,) node before each in its series, -1 for the first."""
        same = np.concatenate([[False], self.series[1:] == self.series[:-1]])
        return np.where(same, np.arange(len(same)) - 1, -1)

    def seen(self, n: int) -> Array:
        """What each of the block's n rows sees of the nodes at their values."""
        return np.asarray(np.bincount(self.row, self.scale * self.value[self.node], minlength=n), float)
