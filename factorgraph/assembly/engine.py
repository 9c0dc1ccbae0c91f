"""What solves the linear systems of an assembled problem: the seam between the rows and the ways of solving.

An engine evaluates blocks and eliminates the variables of the linear least-squares problem

    sum over factors |e + J d|^2,   with lam |d|^2 where it is damped

that their whitened rows make. The outer loop, robust weights and integers are the same for all engines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from factorgraph.types import Array, IntArray

if TYPE_CHECKING:
    from factorgraph.assembly.blocks import Block
    from factorgraph.assembly.optimizer import Graph


class Covariances(Protocol):
    """Covariances of variables that are close to each other in the eliminated problem."""

    def joints(self, groups: Sequence[Sequence[int]]) -> Array:
        """Joint covariances (g, d, d) of groups of keys whose dimensions agree; NaN of pairs that are not at hand."""

    def joint(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of several keys."""


class Step(Protocol):
    """A move of all variables."""

    def step(self, keys: Sequence[int] | IntArray) -> Array:
        """Components (n, d) of variables of one dimension."""


class Eliminated(Step, Protocol):
    """A linear problem after elimination; its step leads to the minimum."""

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of any few variables."""

    def covariances(self) -> Covariances:
        """Those of all neighbouring variables."""


class Linear(Protocol):
    """A linearised problem."""

    def eliminate(self, lam: float) -> Eliminated | None:
        """Eliminate all variables, damped by lam; None where the problem is singular."""


class Engine(Protocol):
    """One way of solving."""

    packages: tuple[str, ...]  # whose versions a solution names

    def predict(self, block: Block) -> None:
        """Set the block's y and J at the current variables."""

    def linearise(self, graph: Graph, joints: bool) -> Linear:
        """The problem at the current variables; with `joints`, what covariances of pairs need is kept together."""

    def remarks(self, graph: Graph) -> list[str]:
        """What the engine can say of an elimination that failed."""
