"""Joint covariances from an eliminated graph without inverting everything.

Conditionals R x_F + S x_S = d of the Bayes net give, in reverse order of elimination,

    Sigma_FS = -R^-1 S Sigma_SS,    Sigma_FF = R^-1 R^-T - Sigma_FS (R^-1 S)^T,

where Sigma_SS consists of blocks that are known already, since the separators of a conditional form a clique.
Conditionals that share their separator are treated as one: split into single variables (a velocity given two
positions, say) the gains R^-1 S exceed one and rounding errors grow along a chain; joined they are smoother gains.

The covariance of a few variables anywhere in the net needs no more than the conditionals on their paths to its end: with
R^T Y = E, E the unit columns of the variables, it is Y^T Y.

Source: Takahashi et al. (1973); Kaess and Dellaert (2009), Covariance recovery from a square root information matrix.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numba import njit

from factorgraph.types import Array


@njit(cache=True)
def _fetch(va, vb, dim, node_of, row_of, var_first, var, size, out, out_first, target, i, j):  # type: ignore[no-untyped-def]
    """Copy Sigma of variables va, vb into target[i:, j:]; va's node is processed, or vb's holds the transposed block."""
    first, second, swap = va, vb, False
    if node_of[va] < node_of[vb]:  # nodes are numbered in processing order: the later one holds the block
        first, second, swap = vb, va, True
    n = node_of[first]
    width = (out_first[n + 1] - out_first[n]) // size[n]
    block = out[out_first[n] : out_first[n + 1]].reshape(size[n], width)
    col = 0
    found = False
    for k in range(var_first[n], var_first[n + 1]):
        if var[k] == second:
            found = True
            break
        col += dim[var[k]]
    if not found:
        return  # no common clique: the target keeps what it has
    r0, df, ds = row_of[first], dim[first], dim[second]
    for a in range(df):
        for b in range(ds):
            if swap:
                target[i + b, j + a] = block[r0 + a, col + b]
            else:
                target[i + a, j + b] = block[r0 + a, col + b]


@njit(cache=True)
def _selected_inverse(dim, node_of, row_of, var_first, var, size, out, out_first):  # type: ignore[no-untyped-def]
    """Put [Sigma_FF Sigma_FS] of every node in the place of its [R S]."""
    for n in range(len(size)):
        d = size[n]
        total = (out_first[n + 1] - out_first[n]) // d
        w = total - d
        block = out[out_first[n] : out_first[n + 1]].reshape(d, total)
        Ri = np.linalg.inv(np.ascontiguousarray(block[:, :d]))
        result = np.zeros((d, total))
        result[:, :d] = Ri @ Ri.T
        if w > 0:
            first = var_first[n]
            skipped = 0
            while skipped < d:
                skipped += dim[var[first]]
                first += 1
            SS = np.zeros((w, w))
            i = 0
            for p in range(first, var_first[n + 1]):
                j = 0
                for q in range(first, var_first[n + 1]):
                    if q >= p:
                        _fetch(var[p], var[q], dim, node_of, row_of, var_first, var, size, out, out_first, SS, i, j)
                    j += dim[var[q]]
                i += dim[var[p]]
            for a in range(w):
                for b in range(a):
                    SS[a, b] = SS[b, a]
            G = Ri @ np.ascontiguousarray(block[:, d:])
            FS = -G @ SS
            result[:, d:] = FS
            FF = result[:, :d] - FS @ G.T
            result[:, :d] = 0.5 * (FF + FF.T)
        out[out_first[n] : out_first[n + 1]] = result.ravel()


@njit(cache=True)
def _joints(groups, dim, node_of, row_of, var_first, var, size, out, out_first, target):  # type: ignore[no-untyped-def]
    for g in range(len(groups)):
        i = 0
        for p in range(groups.shape[1]):
            j = 0
            for q in range(groups.shape[1]):
                if q >= p:
                    _fetch(
                        groups[g, p], groups[g, q], dim, node_of, row_of, var_first, var, size, out, out_first, target[g], i, j
                    )
                j += dim[groups[g, q]]
            i += dim[groups[g, p]]
        for a in range(i):
            for b in range(a):
                target[g, a, b] = target[g, b, a]


@njit(cache=True)
def _path_covariance(dim, at, unit, parent_first, parent, block_first, blocks):  # type: ignore[no-untyped-def]
    """Y^T Y for R^T Y = E: variables of dimension dim[i] at rows at[i], E rows unit[i]; blocks hold [R S] of each."""
    m = unit.shape[1]
    pending = unit.copy()
    P = np.zeros((m, m))
    for i in range(len(dim)):
        d = dim[i]
        block = blocks[block_first[i] : block_first[i + 1]].reshape(d, -1)
        y = np.linalg.solve(np.ascontiguousarray(block[:, :d].T), pending[at[i] : at[i] + d])
        P += y.T @ y
        col = d
        for k in range(parent_first[i], parent_first[i + 1]):
            p = parent[k]
            pending[at[p] : at[p] + dim[p]] -= np.ascontiguousarray(block[:, col : col + dim[p]].T) @ y
            col += dim[p]
    return P


def covariance_of(net: gtsam.GaussianBayesNet, keys: Sequence[int]) -> Array:
    """Joint covariance (d, d) of any variables of a net, in the order of `keys`.

    Costs a path to the end of the net for each, so it is meant for few of them or a net whose paths are short.
    """
    wanted = set(keys)
    index: dict[int, int] = {}
    dims: list[int] = []
    parents: list[list[int]] = []
    blocks: list[Array] = []
    for i in range(net.size()):
        conditional = net.at(i)
        own, *others = (int(k) for k in conditional.keys())
        if own in wanted:
            index[own] = len(dims)
            wanted.update(others)
            dims.append(conditional.R().shape[0])
            parents.append(others)
            blocks.append(np.hstack([conditional.R(), conditional.S()]).ravel())
    dim = np.array(dims, np.int64)
    at = np.concatenate([[0], np.cumsum(dim)]).astype(np.int64)
    columns = np.concatenate([np.arange(at[index[k]], at[index[k] + 1]) for k in keys])
    unit = np.zeros((at[-1], len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    lengths = [len(p) for p in parents]
    return np.asarray(
        _path_covariance(
            dim,
            at,
            unit,
            np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            np.array([index[k] for others in parents for k in others], np.int64),
            np.concatenate([[0], np.cumsum([b.size for b in blocks])]).astype(np.int64),
            np.concatenate(blocks),
        )
    )


class JointCovariance:
    """Covariance blocks of variables that share a factor (or fill-in) in the eliminated graph."""

    def __init__(self, net: gtsam.GaussianBayesNet) -> None:
        n = net.size()
        keys = [net.at(i).keys() for i in range(n)]
        self.index = {k[0]: i for i, k in enumerate(keys)}
        self.dim = np.array([net.at(i).R().shape[0] for i in range(n)], np.int64)
        parents = [sorted(self.index[k] for k in ks[1:]) for ks in keys]
        # node of a variable: that of its first parent when both share the remaining separator
        leader = np.arange(n)
        for i in range(n - 1, -1, -1):
            if parents[i] and len(parents[i]) == len(parents[parents[i][0]]) + 1:
                leader[i] = leader[parents[i][0]]
        members: dict[int, list[int]] = {}
        for i in range(n):
            members.setdefault(int(leader[i]), []).append(i)
        order = sorted(members, reverse=True)
        self.node_of, self.row_of = np.zeros(n, np.int64), np.zeros(n, np.int64)
        columns = [[*members[lead], *parents[lead]] for lead in order]
        self.size = np.array([self.dim[members[lead]].sum() for lead in order], np.int64)
        self.var = np.array([v for each in columns for v in each], np.int64)
        self.var_first = np.concatenate([[0], np.cumsum([len(each) for each in columns])]).astype(np.int64)
        widths = np.array([self.dim[each].sum() for each in columns], np.int64)
        self.out_first = np.concatenate([[0], np.cumsum(self.size * widths)]).astype(np.int64)
        self.out = np.zeros(self.out_first[-1])
        for node, lead in enumerate(order):
            block = self.out[self.out_first[node] : self.out_first[node + 1]].reshape(-1, widths[node])
            edges = np.cumsum([0, *self.dim[columns[node]]]).tolist()
            at = dict(zip(columns[node], edges, strict=False))
            for v in members[lead]:
                self.node_of[v], self.row_of[v] = node, at[v]
                conditional = net.at(v)
                rows = slice(at[v], at[v] + int(self.dim[v]))
                block[rows, rows] = conditional.R()
                S, col = conditional.S(), 0
                for k in keys[v][1:]:
                    p = self.index[k]
                    width = int(self.dim[p])
                    block[rows, at[p] : at[p] + width] = S[:, col : col + width]
                    col += width
        _selected_inverse(self.dim, self.node_of, self.row_of, self.var_first, self.var, self.size, self.out, self.out_first)

    def block(self, a: int, b: int) -> Array:
        """Covariance of keys a and b (d_a, d_b); NaN where the graph does not join them in one clique."""
        da = int(self.dim[self.index[a]])
        return self.joint([a, b])[:da, da:] if a != b else self.joint([a])

    def joint(self, keys: Sequence[int]) -> Array:
        """Joint covariance of several keys in the given order; pairs that share no clique are NaN."""
        return np.asarray(self.joints([keys])[0])

    def joints(self, groups: Sequence[Sequence[int]]) -> Array:
        """Joint covariances (g, d, d) of groups of keys whose dimensions agree from group to group."""
        at = np.array([[self.index[k] for k in keys] for keys in groups], np.int64)
        d = int(self.dim[at[0]].sum())
        target = np.full((len(at), d, d), np.nan)
        _joints(at, self.dim, self.node_of, self.row_of, self.var_first, self.var, self.size, self.out, self.out_first, target)
        return target
