"""Graduated losses: convex at first, themselves at the end, and right from starts where redescending losses alone fail."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.assembly.graduated import TLS_END, approach, relaxations, relaxed
from factorgraph.assembly.optimizer import Graph
from factorgraph.models.robust import RelaxedTls, weight
from factorgraph.problem import Kernel, Robust
from tests.factorgraph.test_optimizer import measured, ranging, rms, run

REDESCENDING: tuple[Kernel, ...] = ("cauchy", "geman-mcclure", "tukey", "dcs", "tls")
STEP = 1.4


@pytest.mark.parametrize("kernel", REDESCENDING)
def test_steps_lead_from_convex_to_the_loss_itself(kernel: Kernel) -> None:
    loss = Robust(kernel, 2.5)
    steps = relaxations({"range": 80.0, "code": 5.0}, {"range": loss, "code": Robust("huber", 2.0)}, STEP)
    assert all(losses["code"] == Robust("huber", 2.0) for losses in steps)
    t = np.linspace(0.0, 80.0, 4001)
    w = weight(steps[0]["range"], t)
    if kernel == "tls":
        assert np.all(w[:-1] > 0)  # the largest residual is where weights end
    else:
        assert np.all(np.diff((t * w)[t < 40.0]) > 0)  # influence grows with the residual: convex there
        assert w[t == 20.0] > 0.6  # what will be rejected takes part
    last = steps[-1]["range"]
    if isinstance(last, RelaxedTls):
        assert TLS_END <= 1 / last.control < TLS_END * STEP * 1.001
    else:
        assert 1.0 <= last.width / 2.5 <= np.sqrt(STEP) * 1.001
    assert relaxed(loss, 1e-9) == (RelaxedTls(2.5, 1 / TLS_END) if kernel == "tls" else loss)


def test_nothing_to_graduate() -> None:
    assert relaxations({"range": 80.0}, {"range": Robust("huber", 2.0)}, STEP) == []
    assert relaxations({"range": 80.0}, {}, STEP) == []
    assert relaxations({"range": 0.1}, {"range": Robust("tls", 2.0)}, STEP) == []


@pytest.mark.parametrize("kernel", REDESCENDING)
def test_bad_starts_with_gross_errors_converge(kernel: Kernel) -> None:
    """One range of seven is metres too long, and the start hundreds of metres off: by themselves all of them stay astray."""
    robust = {"range": Robust(kernel, 3.0)}
    reached = {True: 0, False: 0}
    for seed in range(20, 26):
        for graduated in reached:
            graph, v = ranging(measured(seed, gross=0.15), np.array([400.0, -250.0, 120.0]))
            if graduated:
                approach(graph, robust, STEP, lambda i, c: None)
            run(graph, robust)
            reached[graduated] += rms(v) < 0.35
    assert reached[False] <= 1 and reached[True] >= 4


def test_a_self_tuned_loss_learns_how_many_ranges_are_bad() -> None:
    graph, v = ranging(measured(30, gross=0.2), np.array([30.0, 20.0, 4.0]))
    run(graph, {"range": Robust("self-tuned", 3.0)})
    assert rms(v) < 0.25
    found = _mixture_of(graph)
    stream = measured(30).stream
    share = np.mean(np.abs(measured(30, gross=0.2).stream.range_m - stream.range_m) > 1.0)
    assert abs(found.share - share) < 0.05 and found.inner < 1.3 and found.outer > 50


def _mixture_of(graph: Graph):  # type: ignore[no-untyped-def]
    return graph.reweight({"range": Robust("self-tuned", 3.0)})["range"]
