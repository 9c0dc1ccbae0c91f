"""Time of integer least squares and partial fixing per call, beside RTKLIB on the same draws.

    python -m tests.benchmarks.bench_ambiguity [draws]

Ours is timed through the public function, checks included. RTKLIB is timed twice: its C routine alone on filled arrays,
and with the arrays filled from numpy and read back. Medians over the draws; ratios above 1 mean ours is faster.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np

from ambiguity import fix, integer_least_squares
from tests.ambiguity.models import Rtklib, double_difference_covariance, draw_float

CASES: tuple[tuple[str, tuple[int, ...], int, float, float, int, float], ...] = (
    # name, satellites per system, frequencies, phase and code sigma [m], epochs, target [us]
    ("n=6  single frequency, 10 mm, 10 epochs", (7,), 1, 0.010, 0.3, 10, np.nan),
    ("n=8  dual, 3 mm", (5,), 2, 0.003, 0.3, 1, 40.0),
    ("n=12 dual, 3 mm", (7,), 2, 0.003, 0.3, 1, 60.0),
    ("n=20 dual, 3 mm", (6, 6), 2, 0.003, 0.3, 1, 250.0),
    ("n=40 dual, 10 mm", (8, 8, 7), 2, 0.010, 0.3, 1, 450.0),
    ("n=40 dual, 10 mm, code 1.5 m", (8, 8, 7), 2, 0.010, 1.5, 1, np.nan),
    ("n=60 triple, 10 mm", (8, 8, 7), 3, 0.010, 0.3, 1, np.nan),
)


def microseconds(call: Callable[[], object], repeats: int = 5) -> float:
    """Shortest of a few calls: what the work costs when nothing else runs."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return best * 1e6


def run(name: str, model: tuple[tuple[int, ...], int, float, float, int], target_us: float, n_draws: int) -> str:
    rng = np.random.default_rng(2024)
    ours, partial, core, whole, nodes, gave_up = [], [], [], [], [], 0
    for _ in range(n_draws):
        Q = double_difference_covariance(rng, *model)
        a, _ = draw_float(rng, Q)
        rtklib = Rtklib(len(Q))
        nodes.append(integer_least_squares(a, Q).nodes)
        ours.append(microseconds(lambda a=a, Q=Q: integer_least_squares(a, Q)))  # type: ignore[misc]
        partial.append(microseconds(lambda a=a, Q=Q: fix(a, Q)))  # type: ignore[misc]
        if rtklib(a, Q) is None:
            gave_up += 1
            continue
        core.append(microseconds(rtklib.core))
        whole.append(microseconds(lambda a=a, Q=Q, rtklib=rtklib: rtklib(a, Q)))  # type: ignore[misc]
    us = statistics.median(ours)
    c, w = (statistics.median(t) if t else np.nan for t in (core, whole))
    verdict = "" if np.isnan(target_us) else f"target {target_us:.0f} {'met' if us <= target_us else 'MISSED'}"
    return (
        f"{name:41s} {us:8.1f} {statistics.median(partial):8.1f} {statistics.median(nodes):8.0f} {c:8.1f} {w:8.1f} "
        f"{c / us:6.2f} {w / us:6.1f} {gave_up:4d}/{n_draws}  {verdict}"
    )


def main(n_draws: int) -> None:
    print(f"{'us per call, median':41s}     ours      fix    nodes   C core  C+numpy  ratio  ratio  gave up")
    for name, *model, target_us in CASES:
        print(run(name, tuple(model), target_us, n_draws))  # type: ignore[arg-type]


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
