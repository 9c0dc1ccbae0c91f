"""Order of elimination: along time, so that cost and memory grow with the length of the flight and not faster.

States go in the order of their times, every scalar that lives for a while (an ambiguity, a node of an ionosphere) right after the
last state it was observed from, constants of the whole flight at the end. A conditional then has no more parents than the next
states, the scalars alive and the constants: a minimum-degree ordering with all ambiguities last carries those that ended long ago
along, up to its largest separators.

Of many vehicles not all are tied to all others at every time, and minimum degree finds less fill (a third of the time with ten);
along time every state of one is joined with every state of the others.

With many ambiguities their joint covariance is wanted for fixing, which takes a path through the net from the elimination of each
to its end. Along time these paths are as long as the flight; by nested dissection (the states in the middle of an interval are
eliminated after both halves) they have the length of its logarithm, for twice the fill.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph.types import Array, IntArray

SLACK_S = 5e-3  # observations this long before a state belong to it


@dataclass(frozen=True, slots=True)
class Lives:
    """Scalar variables and the states (first, last) they were observed from; a key may have several entries."""

    key: IntArray  # (n,)
    first: IntArray
    last: IntArray

    @classmethod
    def between(cls, key: IntArray, t_s: Array, grid_s: Array) -> Lives:
        """From observations (n,) of keys at times t_s."""
        k = np.clip(np.searchsorted(grid_s, t_s + SLACK_S, side="right") - 1, 0, max(len(grid_s) - 1, 0))
        return cls(key, k, k)

    @classmethod
    def joined(cls, parts: Sequence[Lives]) -> Lives:
        """One entry per key, over all parts."""
        none = np.zeros(0, np.int64)
        key, first, last = (np.concatenate([none, *(getattr(p, name) for p in parts)]) for name in ("key", "first", "last"))
        every, index = np.unique(key, return_inverse=True)
        begin, end = np.full(len(every), np.iinfo(np.int64).max), np.full(len(every), -1)
        np.minimum.at(begin, index, first)
        np.maximum.at(end, index, last)
        return cls(every, begin, end)


def nested_ranks(n: int) -> IntArray:
    """Rank (n,) of times 0 to n - 1 by nested dissection: the middle of every interval after all others in it."""
    ranks = np.empty(n, np.int64)
    pending, rank = [(0, n)], n
    while pending:
        a, b = pending.pop()
        if a < b:
            rank -= 1
            middle = (a + b) // 2
            ranks[middle] = rank
            pending += [(a, middle), (middle + 1, b)]
    return ranks


def elimination_order(
    states: Sequence[Iterable[tuple[int, ...]]], lives: Lives, constants: Sequence[int], present: Iterable[int], nested: bool
) -> gtsam.Ordering:
    """Order for the keys `present` in a graph.

    states: per vehicle the keys of each of its states, by time; lives: one entry per key. Within a time the keys that come last
    in a state (biases) go first. What is neither a state nor has a life goes before the constants.
    """
    place: dict[int, tuple[int, int, int]] = {}
    n = 0
    for v, of_vehicle in enumerate(states):
        for k, keys in enumerate(of_vehicle):
            n = max(n, k + 1)
            for i, key in enumerate(keys):
                place[key] = (k, -i, v)
    ranks = nested_ranks(n) if nested else np.arange(n)
    if nested:
        place = {key: (int(ranks[k]), i, v) for key, (k, i, v) in place.items()}
    for key, first, last in zip(lives.key.tolist(), lives.first.tolist(), lives.last.tolist(), strict=True):
        place[key] = (int(ranks[first : last + 1].max()), 1, 0)
    place |= {key: (n + 1, 0, i) for i, key in enumerate(constants)}
    order: list[int] = sorted(present, key=lambda key: place.get(key, (n, 0, 0)))
    return gtsam.Ordering(order)
