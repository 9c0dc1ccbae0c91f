"""Times of least squares along time: `python -m tests.benchmarks.bench_least_squares [stages]`.

Two vehicles of 15 states each per stage (1200 stages unless told otherwise), some 30 ambiguities alive, 30 rows and two interval
factors of 15 rows per stage: Layout, factorisation, step and covariances, beside SuperLU on the same normal equations in its own
and in our order, and GTSAM's elimination along time, all in the same run. Rows are given, whitened.
Then integers of random problems by bonmin beside the search of `ambiguity`.
Processor time, best of several runs, since others may use the machine.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TypeVar

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ambiguity import integer_least_squares
from factorgraph.least_squares.fronts import FactorBlock, Factorised, Layout, Part, Scalars, Variables
from factorgraph.least_squares.integers import nearest_integers
from factorgraph.types import Array

T = TypeVar("T")
DIM, VEHICLES, ROWS, LIFE, ALIVE = 15, 2, 30, 300, 30


def problem(stages: int, seed: int = 1) -> tuple[Variables, list[FactorBlock], list[Part]]:
    """Random rows of the structure above; ambiguities begin and end one after the other."""
    rng = np.random.default_rng(seed)
    states = np.arange(stages * VEHICLES).reshape(stages, VEHICLES)
    begin = np.linspace(1 - LIFE, stages - 1, ALIVE * (stages + LIFE) // LIFE).astype(int)
    arcs = states.size + np.arange(len(begin))
    seen = [arcs[(begin <= k) & (k < begin + LIFE)] for k in range(stages)]
    first_key = np.concatenate([[0], np.cumsum([len(each) for each in seen])])
    scalars = Scalars(np.concatenate(seen), first_key, ROWS * first_key)
    blocks = [FactorBlock((DIM,) * VEHICLES, states, ROWS * np.arange(stages + 1), scalars)]
    for v in range(VEHICLES):
        blocks.append(FactorBlock((DIM, DIM), np.column_stack([states[:-1, v], states[1:, v]]), DIM * np.arange(stages)))
    blocks.append(FactorBlock((1,), arcs[:, None], np.arange(len(arcs) + 1)))
    parts = []
    for block in blocks:
        n = int(block.start[-1])
        dense = rng.standard_normal(int(block.scalars.first[-1]) if block.scalars else 0)
        parts.append(Part(rng.standard_normal(n), rng.standard_normal((n, sum(block.widths))), dense))
    last = np.concatenate([np.repeat(np.arange(stages), VEHICLES), np.full(len(arcs), -1)])
    variables = Variables(np.arange(len(last)), np.where(np.arange(len(last)) < states.size, DIM, 1), last)
    return variables, blocks, parts


def factors(blocks: list[FactorBlock], parts: list[Part]) -> list[tuple[list[int], list[Array], Array]]:
    """Keys, Jacobians and residuals of every factor."""
    result = []
    for block, part in zip(blocks, parts, strict=True):
        edges = np.cumsum(block.widths)[:-1]
        for f in range(len(block.start) - 1):
            rows = slice(int(block.start[f]), int(block.start[f + 1]))
            keys, J = [int(k) for k in block.keys[f]], np.split(part.Jw[rows], edges, axis=1)
            if (s := block.scalars) is not None:
                piece = part.dense[s.first[f] : s.first[f + 1]].reshape(-1, rows.stop - rows.start)
                keys, J = keys + s.keys[s.first_key[f] : s.first_key[f + 1]].tolist(), [*J, *(c[:, None] for c in piece)]
            result.append((keys, J, part.e[rows]))
    return result


def linearised(every: list[tuple[list[int], list[Array], Array]], layout: Layout) -> gtsam.GaussianFactorGraph:
    """The factors for GTSAM; those with many variables can be made from Python only by linearising."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, d in zip(layout.key, layout.dim, strict=True):
        values.insert(int(k), np.zeros(d))
    for keys, J, e in every:

        def error(_f: gtsam.CustomFactor, _v: gtsam.Values, H: list[Array] | None, J: list[Array] = J, e: Array = e) -> Array:
            if H is not None:
                for slot, block in enumerate(J):
                    H[slot] = block
            return e

        factors.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(e)), keys, error))
    return factors.linearize(values)


def _best(what: str, work: Callable[[], T], reference_s: float | None = None, runs: int = 5) -> tuple[float, T]:
    times = []
    for _ in range(runs):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    ratio = f"   {min(times) / reference_s:6.1f} x factorise + step" if reference_s is not None else ""
    print(f"{what:60s} {1e3 * min(times):8.1f} ms{ratio}", flush=True)
    return min(times), result


def main() -> None:
    """Print the figures."""
    stages = int(sys.argv[1]) if len(sys.argv) > 1 else 1200
    warm = problem(20)
    factor = Layout(*warm[:2]).factorise(warm[2])
    assert isinstance(factor, Factorised)
    factor.step()
    factor.selected()
    factor.covariance([0])
    variables, blocks, parts = problem(stages)
    _, layout = _best("layout, once per structure", lambda: Layout(variables, blocks))
    print(f"{stages} stages, {layout.size} unknowns, fronts of {layout.front_sizes.mean():.0f} columns")
    t_factor, factor = _best("assembly and factorisation", lambda: layout.factorise(parts))
    assert isinstance(factor, Factorised)
    ours = factor
    t_step, step = _best("step", ours.step)
    ref = t_factor + t_step
    verdict = f"target {stages / 24:.0f} ms: {'met' if ref <= stages / 24e3 else 'MISSED'}"
    print(f"{'factorise + step':60s} {1e3 * ref:8.1f} ms   {verdict}")
    _best("covariances of all that share a front", ours.selected, ref)
    _best("joint covariance of one state of each end of the flight", lambda: ours.covariance([0, 2 * stages - 1]), ref)

    every = factors(blocks, parts)
    m = np.cumsum([0, *(len(e) for _, _, e in every)])
    entries = []
    for at, (keys, J, _) in zip(m, every, strict=False):
        columns = np.concatenate([np.arange(layout.offset[k], layout.offset[k + 1]) for k in keys])
        entries.append(
            (np.repeat(np.arange(at, at + len(J[0])), len(columns)), np.tile(columns, len(J[0])), np.hstack(J).ravel())
        )
    row, column, value = (np.concatenate(each) for each in zip(*entries, strict=True))
    A = sparse.csc_matrix((value, (row, column)), shape=(m[-1], layout.size))
    e = np.concatenate([each for _, _, each in every])
    along = np.argsort(np.repeat(layout.last, layout.dim), kind="stable")

    def superlu(order: str) -> Array:
        N, g = (A.T @ A).tocsc(), -(A.T @ e)
        if order == "NATURAL":
            N, g = N[along][:, along], g[along]
        x = splu(N, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve(g)
        if order == "NATURAL":
            x[along] = x.copy()
        return np.asarray(x)

    for order, name in (("MMD_AT_PLUS_A", "minimum degree"), ("NATURAL", "along time")):
        _, x = _best(f"SuperLU, {name}, product J^T J included", lambda order=order: superlu(order), ref, 2)
        print(f"{'':60s} largest difference {np.abs(x - step).max():.1e}")

    graph = linearised(every, layout)
    ordering = gtsam.Ordering()
    for i in np.argsort(layout.last, kind="stable"):
        ordering.push_back(int(layout.key[i]))
    _, net = _best("GTSAM, eliminateSequential along time", lambda: graph.eliminateSequential(ordering), ref, 2)
    solution = net.optimize()
    x = np.concatenate([np.asarray(solution.at(int(k))) for k in layout.key])
    print(f"{'':60s} largest difference {np.abs(x - step).max():.1e}")
    integers()


def integers(problems: int = 10) -> None:
    """Median times of both ways to the nearest integers, and how often they agree."""
    rng = np.random.default_rng(2)
    for n in (2, 4, 6, 8, 10):
        times, agree = np.zeros((2, problems)), 0
        for k in range(problems):
            axes = np.linalg.qr(rng.standard_normal((n, n)))[0]
            Q = axes @ np.diag(10 ** rng.uniform(-2.5, 1.0, n)) @ axes.T
            Q = (Q + Q.T) / 2
            a = rng.multivariate_normal(np.zeros(n), Q)
            start = time.process_time()
            found = nearest_integers(a, Q)
            middle = time.process_time()
            expected = integer_least_squares(a, Q)
            times[:, k] = middle - start, time.process_time() - middle
            agree += np.array_equal(found.integers, expected.candidates[0])
        bonmin, search = 1e3 * np.median(times, axis=1)
        print(f"{n:2d} ambiguities: bonmin {bonmin:8.2f} ms, search {search:6.3f} ms, {agree} of {problems} agree", flush=True)


if __name__ == "__main__":
    main()
