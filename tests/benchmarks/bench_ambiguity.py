"""Time of integer least squares and partial fixing per call, beside RTKLIB on the same draws.

    python -m tests.benchmarks.bench_ambiguity [draws]

Ours is timed through the public function, checks included. RTKLIB is timed twice: its C routine alone on filled arrays,
and with the arrays filled from numpy and read back. Medians over the draws, ratios over those RTKLIB answered: above 1 ours is
faster. After the single calls: many small problems in one call, simulated rates and thresholds.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from ambiguity import fix, integer_least_squares
from ambiguity.batch import integer_least_squares_batch
from ambiguity.simulation import simulate
from ambiguity.types import Array
from ambiguity.validation import ffrt_threshold
from tests.ambiguity.models import Rtklib, double_difference_covariance, draw_float, with_success_rate

Model = Callable[[np.random.Generator], Array]


def model(n_sats: tuple[int, ...], n_freq: int, phase_m: float, code_m: float, n_epochs: int = 1, weighted: bool = True) -> Model:
    return lambda rng: double_difference_covariance(rng, n_sats, n_freq, phase_m, code_m, n_epochs, weighted)


CASES: tuple[tuple[str, Model, float], ...] = (
    # frequencies, phase and code sigma [m], epochs; target [us]
    ("n=6  single frequency, 10 mm, 10 epochs", model((7,), 1, 0.010, 0.3, 10), np.nan),
    ("n=8  dual, 3 mm", model((5,), 2, 0.003, 0.3), 40.0),
    ("n=12 dual, 3 mm", model((7,), 2, 0.003, 0.3), 60.0),
    ("n=20 dual, 3 mm", model((6, 6), 2, 0.003, 0.3), 250.0),
    ("n=40 dual, 10 mm", model((8, 8, 7), 2, 0.010, 0.3), 450.0),
    ("n=40 dual, 3 mm, one precision, code 0.6 m", model((8, 8, 7), 2, 0.003, 0.6, weighted=False), np.nan),
    ("n=40 dual, 10 mm, code 1.5 m", model((8, 8, 7), 2, 0.010, 1.5), 50_000.0),
    ("n=40 dual, 10 mm, one precision, code 1.5 m", model((8, 8, 7), 2, 0.010, 1.5, weighted=False), 50_000.0),
    ("n=60 triple, 10 mm", model((8, 8, 7), 3, 0.010, 0.3), np.nan),
)


def microseconds(call: Callable[[], object], repeats: int = 5) -> float:
    """Shortest of a few calls: what the work costs when nothing else runs."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return best * 1e6


def single_calls(name: str, draw: Model, target_us: float, n_draws: int) -> str:
    rng = np.random.default_rng(2024)
    ours, partly, nodes, core, whole, ratio, ratio_whole, gave_up = [], [], [], [], [], [], [], 0
    for _ in range(n_draws):
        Q = draw(rng)
        a, _ = draw_float(rng, Q)
        rtklib = Rtklib(len(Q))
        nodes.append(integer_least_squares(a, Q).nodes)
        ours.append(microseconds(partial(integer_least_squares, a, Q)))
        partly.append(microseconds(partial(fix, a, Q)))
        if rtklib(a, Q) is None:
            gave_up += 1
            continue
        core.append(microseconds(rtklib.core))
        whole.append(microseconds(partial(rtklib, a, Q)))
        ratio.append(core[-1] / ours[-1])
        ratio_whole.append(whole[-1] / ours[-1])
    us = statistics.median(ours)
    c, w, faster, faster_whole = (statistics.median(t) if t else np.nan for t in (core, whole, ratio, ratio_whole))
    verdict = "" if np.isnan(target_us) else f"target {target_us:.0f} {'met' if us <= target_us else 'MISSED'}"
    return (
        f"{name:44s} {us:8.1f} {statistics.median(partly):8.1f} {statistics.median(nodes):8.0f} {c:8.1f} {w:8.1f} "
        f"{faster:6.2f} {faster_whole:6.1f} {gave_up:4d}/{n_draws}  {verdict}"
    )


def batched(n_problems: int = 1000) -> None:
    """Problems of 12 ambiguities in one call, each with its own covariance and all with the same."""
    rng = np.random.default_rng(2024)
    draw = model((7,), 2, 0.003, 0.3)
    Q = np.stack([draw(rng) for _ in range(n_problems)])
    a = np.stack([draw_float(rng, q)[0] for q in Q])
    same = np.stack([draw_float(rng, Q[0])[0] for _ in range(n_problems)])
    print(f"\nn=12 dual, 3 mm: us per problem, {n_problems} problems in one call")
    for name, floats, covariance in (("each its own covariance", a, Q), ("one covariance", same, Q[0])):
        singles = Q if covariance.ndim == 3 else [covariance] * n_problems
        result = integer_least_squares_batch(floats, covariance)
        one_by_one = [integer_least_squares(x, q).norms for x, q in zip(floats, singles, strict=True)]
        np.testing.assert_allclose(result.norms, one_by_one, rtol=1e-6)
        filled = [Rtklib(12) for _ in range(n_problems)]
        for rtklib, x, q in zip(filled, floats, singles, strict=True):
            rtklib.fill(x, q)
        ours, core = np.inf, np.inf
        for _ in range(10):  # in turn, so that both see the same machine
            ours = min(ours, microseconds(partial(integer_least_squares_batch, floats, covariance), 2) / n_problems)
            core = min(core, microseconds(lambda filled=filled: [rtklib.core() for rtklib in filled], 2) / n_problems)  # type: ignore[misc]
        print(f"{name:44s} {ours:8.1f}   RTKLIB core {core:6.1f}   ratio {core / ours:.2f}")


def simulations(n_samples: int = 20_000) -> None:
    """Sampling, and the threshold of a failure rate, at a success rate of 95 %."""
    print(f"\nms per call, {n_samples} samples, success rate 95 %")
    rng = np.random.default_rng(2024)
    for name, n_sats in (("n=8", (5,)), ("n=12", (7,)), ("n=20", (6, 6)), ("n=40", (8, 8, 7))):
        Q = with_success_rate(double_difference_covariance(rng, n_sats, 2, 0.003, 0.3), 0.95)
        simulate(Q, 1, 1)
        counted, threshold = (
            microseconds(partial(f, *options), 2) / 1e3
            for f, options in ((simulate, (Q, n_samples, 1)), (ffrt_threshold, (Q, 0.001, n_samples, 1)))
        )
        print(f"{name:44s} simulate {counted:8.0f}   ffrt_threshold {threshold:8.0f}")


def main(n_draws: int) -> None:
    print(f"{'us per call, median':44s}     ours      fix    nodes   C core  C+numpy  ratio  ratio  gave up")
    for name, draw, target_us in CASES:
        print(single_calls(name, draw, target_us, n_draws))
    batched()
    simulations()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
