"""Swarm optimisers on a snapshot of a relative filter: `OPENBLAS_NUM_THREADS=1 python -m tests.benchmarks.bench_swarm [seeds]`.

12 states (position, velocity, six errors of force), ten ranges |r - anchor| with sigma 0.15 m and twenty linear rows; weighted
least squares, searched in deviations of +-3 sigma from a filter's estimate. Population 30, 800 iterations: 24,000
evaluations, 36,000 for the Tasmanian devils. Times are the processor's, the shortest of a few runs after compilation, with a
NumPy cost of all members at once and with a compiled one; targets are 0.25 s and 0.05 s for TDO and PSO. J/J* is that of all
seeds at equal evaluations, J* from SciPy's least squares.

In the same process mealpy's TDO and pyswarms' PSO, with the same cost. Neither is a requirement of relnav
(`pip install pyswarms pandas; pip install --no-deps mealpy opfunu`: mealpy asks for an older NumPy than it needs); without them
their lines say so.
"""

from __future__ import annotations

import importlib.util
import logging
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit
from scipy.optimize import least_squares

import swarm
from swarm.types import Array

N, RANGES, LINEAR, N_MEMBERS, N_ITER = 12, 10, 20, 30, 800
EVALS = 24_000
NUMPY_S, COMPILED_S, QUALITY = 0.25, 0.05, 1e-3
TIMED = ("tdo", "pso")
HEAD = RANGES * (3 + 1) + LINEAR * (N + 1)


@dataclass(frozen=True, slots=True)
class Problem:
    """Rows whitened: r = z / sigma - |D y + d| / sigma and r = c - A y, for deviations y in standard deviations."""

    sigma: Array  # (12,) of the estimate
    arm: Array  # (10, 3) from anchors to the estimate [m]
    range_m: Array  # (10,)
    A: Array  # (20, 12)
    c: Array  # (20,)
    bounds: Array  # (12, 2)
    range_sigma_m: float = 0.15

    def rows(self, Y: Array) -> Array:
        """Residuals (k, 30) of points (k, 12)."""
        arm = self.arm + (Y[:, :3] * self.sigma[:3])[:, None, :]
        distance = np.sqrt(np.einsum("kqi,kqi->kq", arm, arm))
        return np.hstack([(self.range_m - distance) / self.range_sigma_m, self.c - Y @ self.A.T])

    def __call__(self, Y: Array) -> Array:
        r = self.rows(Y)
        return np.asarray(np.einsum("kr,kr->k", r, r))

    def compiled(self) -> swarm.CompiledCost:
        head = [self.sigma[:3] / self.range_sigma_m, self.arm.ravel() / self.range_sigma_m, self.range_m / self.range_sigma_m]
        return swarm.CompiledCost(compiled_cost, np.concatenate([*head, self.A.ravel(), self.c]))

    def best(self) -> float:
        """J* within the box."""
        found = least_squares(
            lambda y: self.rows(y[None])[0], np.zeros(N), bounds=self.bounds.T, xtol=1e-12, ftol=1e-12, gtol=1e-12
        )
        return float(2 * found.cost)


@njit("float64(float64[::1], float64[::1])", cache=True, error_model="numpy", fastmath=True)
def compiled_cost(y: Array, data: Array) -> float:
    """The same cost of one point (12,)."""
    at_range = 3 + 3 * RANGES
    at_rows = at_range + RANGES
    at_c = at_rows + LINEAR * N
    e0, e1, e2 = y[0] * data[0], y[1] * data[1], y[2] * data[2]
    J = 0.0
    for q in range(RANGES):
        d0, d1, d2 = data[3 + 3 * q] + e0, data[4 + 3 * q] + e1, data[5 + 3 * q] + e2
        r = data[at_range + q] - np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        J += r * r
    for m in range(LINEAR):
        r = data[at_c + m]
        for j in range(N):
            r -= data[at_rows + m * N + j] * y[j]
        J += r * r
    return J


def problem(seed: int) -> Problem:
    """A snapshot: a true deviation drawn from the estimate's standard deviations, rows measured with noise."""
    rng = np.random.default_rng(seed)
    sigma = np.r_[np.full(3, 0.5), np.full(3, 0.1), np.full(6, 0.02)]
    arm = 100.0 * rng.standard_normal((RANGES, 3))
    y_true = np.clip(rng.standard_normal(N), -2.5, 2.5)
    A = rng.standard_normal((LINEAR, N))
    c = A @ y_true + rng.standard_normal(LINEAR)
    range_m = np.linalg.norm(arm + sigma[:3] * y_true[:3], axis=1) + 0.15 * rng.standard_normal(RANGES)
    return Problem(sigma, arm, range_m, A, c, np.tile([-3.0, 3.0], (N, 1)))


def cpu_s(call: Callable[[], object], repeats: int = 5) -> float:
    """Shortest processor time of a few calls."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def timed(p: Problem) -> dict[str, float]:
    """Seconds of every method with a NumPy cost; prints both."""
    compiled, found = p.compiled(), {}
    print(f"{'':14s}{'NumPy cost':>12s}{'compiled':>12s}{'evaluations':>13s}")
    for name, method in swarm.METHODS.items():
        if name == "cma-es" and importlib.util.find_spec("cmaes") is None:
            print(f"{name:14s} (cmaes is not installed)")
            continue
        evals = 100_000 if name.startswith("tdo") else EVALS

        def run(cost: Problem | swarm.CompiledCost, name: str = name, evals: int = evals) -> swarm.SwarmResult:
            rng = np.random.default_rng(1)
            return swarm.minimize(name, cost, p.bounds, rng=rng, max_evals=evals, n_members=N_MEMBERS, n_iter=N_ITER)

        n_evals = run(p).n_evals
        slow, fast = cpu_s(partial(run, p), 3), cpu_s(partial(run, compiled), 5)
        found[name] = slow
        goal = f"  targets {NUMPY_S} and {COMPILED_S} s " + ("met" if slow <= NUMPY_S and fast <= COMPILED_S else "MISSED")
        note = "" if method.is_compiled_capable else "  (loop in Python either way)"
        print(f"{name:14s}{slow:10.4f} s{fast:10.4f} s{n_evals:13,d}{goal if name in TIMED else note}")
    return found


def quality(seeds: int) -> None:
    """J/J* of all methods over seeds, every seed another problem."""
    problems = [problem(seed) for seed in range(seeds)]
    best = np.array([p.best() for p in problems])
    print(f"\nJ/J* - 1 at {EVALS:,d} evaluations, {seeds} problems{'median':>16s}{'worst':>10s}")
    for name in swarm.METHODS:
        if name == "cma-es" and importlib.util.find_spec("cmaes") is None:
            continue
        runs = [
            swarm.minimize(name, p.compiled(), p.bounds, rng=np.random.default_rng(i), max_evals=EVALS, n_members=N_MEMBERS).cost
            for i, p in enumerate(problems)
        ]
        excess = np.array(runs) / best - 1
        verdict = (
            f"  target {QUALITY:g} {'met' if np.median(excess) <= QUALITY else 'MISSED'}" if name in ("tdo", "pso", "ga") else ""
        )
        print(f"{name:46s}{np.median(excess):16.2e}{excess.max():10.1e}{verdict}")


def mealpy_tdo(p: Problem) -> float | None:
    """Seconds of mealpy's TDO."""
    if any(importlib.util.find_spec(name) is None for name in ("mealpy", "pandas")):
        return None
    from mealpy import TDO, FloatVar  # type: ignore[import-not-found,import-untyped,unused-ignore]

    given = {
        "obj_func": lambda y: float(p(y[None])[0]),
        "bounds": FloatVar(lb=p.bounds[:, 0].tolist(), ub=p.bounds[:, 1].tolist()),
        "minmax": "min",
        "log_to": None,
    }
    return cpu_s(lambda: TDO.OriginalTDO(epoch=N_ITER, pop_size=N_MEMBERS).solve(given, seed=1), 1)


def pyswarms_pso(p: Problem) -> float | None:
    """Seconds of pyswarms' PSO."""
    if importlib.util.find_spec("pyswarms") is None:
        return None
    from pyswarms.single import GlobalBestPSO  # type: ignore[import-not-found,import-untyped,unused-ignore]

    logging.disable(logging.CRITICAL)
    options = {"c1": 1.49618, "c2": 1.49618, "w": 0.7298}

    def run() -> None:
        walls = (p.bounds[:, 0], p.bounds[:, 1])
        GlobalBestPSO(n_particles=N_MEMBERS, dimensions=N, options=options, bounds=walls).optimize(p, iters=N_ITER, verbose=False)

    return cpu_s(run, 3)


def main() -> None:
    p = problem(0)
    ours = timed(p)
    for name, peer, theirs in (("mealpy's TDO", mealpy_tdo(p), "tdo"), ("pyswarms' PSO", pyswarms_pso(p), "pso")):
        if peer is None:
            print(f"{name:14s} (not installed)")
        else:
            print(f"{name:14s}{peer:10.4f} s, {peer / ours[theirs]:.1f} times ours with the same NumPy cost")
    quality(int(sys.argv[1]) if len(sys.argv) > 1 else 20)


if __name__ == "__main__":
    main()
