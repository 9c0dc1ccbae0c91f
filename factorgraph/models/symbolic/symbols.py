"""Inputs of a symbolic model and the local columns by which it is differentiated.

A model is a function model(s, *options) that asks `s` for its inputs, perturbs its variables by local columns d that are zero
where it is linearised, and returns named outputs:

    y = f(x [+] d, constants),   J = dy/dd at d = 0

where [+] is R Exp(dtheta) for attitudes, r + R drho for positions of a body, addition for everything else. Value and Jacobian
follow from the same expression; nothing is differentiated by hand.

Matrices come in row by row, so that a C-contiguous array (n, rows * columns) is CasADi's own layout of n samples.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import casadi as ca

Model = Callable[..., dict[str, ca.SX]]


class Symbols:
    """Named inputs and local columns of one model, in the order in which it asks for them."""

    def __init__(self) -> None:
        self.inputs: dict[str, ca.SX] = {}
        self.columns: dict[str, ca.SX] = {}
        self.stages: list[tuple[ca.SX, ca.SX]] = []

    def vector(self, name: str, size: int) -> ca.SX:
        """A new input (size,)."""
        self.inputs[name] = ca.SX.sym(name, size)
        return self.inputs[name]

    def scalar(self, name: str) -> ca.SX:
        """A new scalar input."""
        return self.vector(name, 1)

    def local(self, name: str, size: int) -> ca.SX:
        """A new group of local columns (size,)."""
        self.columns[name] = ca.SX.sym(f"d_{name}", size)
        return self.columns[name]

    def variable(self, name: str, size: int = 1) -> ca.SX:
        """A new input (size,) that is itself a variable: perturbed by addition, its columns have its name."""
        return self.vector(name, size) + self.local(name, size)

    def stage(self, x: ca.SX) -> ca.SX:
        """A symbol in the place of x, which is differentiated by it and by the columns one after the other.

        For what is few numbers of many columns and enters costly expressions: the chain rule then passes through those once
        for each number instead of once for each column.
        """
        self.stages.append((ca.SX.sym(f"stage{len(self.stages)}", x.sparsity()), x))
        return self.stages[-1][0]


def derivatives(s: Symbols, outputs: list[ca.SX]) -> tuple[list[ca.SX], list[ca.SX]]:
    """Outputs (m,) and their Jacobians (m, columns) to all columns of a model, at zero columns."""
    d = ca.vertcat(*s.columns.values())
    by_columns: list[ca.SX] = []

    def total(y: ca.SX) -> ca.SX:
        J = ca.jacobian(y, d)
        for (t, _), by in zip(s.stages, by_columns, strict=False):
            J += ca.jacobian(y, t) @ by
        return J

    for _, x in s.stages:
        by_columns.append(total(ca.vec(x)))
    found = [*outputs, *(total(y) for y in outputs)]
    for t, x in reversed(s.stages):
        found = ca.substitute(found, [t], [x])
    found = ca.substitute(found, [d], [ca.SX.zeros(d.numel())])
    return found[: len(outputs)], found[len(outputs) :]


def matrix(entries: ca.SX, rows: int, columns: int) -> ca.SX:
    """The (rows, columns) matrix of `entries` (rows * columns,) row by row."""
    return ca.reshape(entries, columns, rows).T


def flat(M: ca.SX) -> ca.SX:
    """Entries of a matrix row by row."""
    return ca.vec(ca.densify(M).T)


def split(x: ca.SX, *sizes: int) -> list[ca.SX]:
    """Consecutive pieces of a vector (sum of sizes,)."""
    edges = [0]
    for size in sizes:
        edges.append(edges[-1] + size)
    return [x[a:b] for a, b in itertools.pairwise(edges)]
