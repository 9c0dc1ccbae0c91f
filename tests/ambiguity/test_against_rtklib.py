"""The same two candidates and norms as RTKLIB's C routine, wherever it answers."""

from __future__ import annotations

import numpy as np
import pytest

from ambiguity import integer_least_squares
from ambiguity.types import Array
from tests.ambiguity.models import MODELS, Rtklib, double_difference_covariance, draw_float, mixed_covariance, random_covariance

N_BATCHES, PER_BATCH = 8, 90  # three kinds of models in each batch


def geometry(rng: np.random.Generator) -> Array:
    """Any number of systems, satellites and frequencies with 2 to 60 ambiguities, from very strong to weak."""
    while True:
        n_freq = int(rng.integers(1, 4))
        n_sats = tuple(int(n) for n in rng.integers(3, 12, rng.integers(1, 4)))
        if 5 <= sum(n_sats) and n_freq * (sum(n_sats) - len(n_sats)) <= 60:
            break
    phase_m, code_m = rng.choice([0.002, 0.003, 0.005, 0.010]), rng.choice([0.2, 0.3, 0.6, 1.5])
    return double_difference_covariance(rng, n_sats, n_freq, phase_m, code_m, int(rng.choice([1, 5, 30])), bool(rng.integers(2)))


def axes(rng: np.random.Generator) -> Array:
    return random_covariance(rng, int(rng.integers(2, 25)), float(rng.uniform(0.0, 2.0)))


def mixed(rng: np.random.Generator) -> Array:
    return mixed_covariance(rng, int(rng.integers(2, 61)))


def compare(rtklib: dict[int, Rtklib], rng: np.random.Generator, Q: Array) -> bool:
    """Whether RTKLIB answered; where it did, its candidates and norms are ours."""
    a, _ = draw_float(rng, Q)
    ours = integer_least_squares(a, Q)
    assert ours.proven
    theirs = rtklib.setdefault(len(a), Rtklib(len(a)))(a, Q)
    if theirs is None:
        return False
    np.testing.assert_array_equal(ours.candidates, theirs[0])
    np.testing.assert_allclose(ours.norms, theirs[1], rtol=1e-9)
    return True


@pytest.mark.parametrize("batch", range(N_BATCHES))
def test_random_and_real_geometry(batch: int) -> None:
    """Over all batches 2160 models of 2 to 60 ambiguities; it answers nearly all."""
    rng = np.random.default_rng([7, batch])
    rtklib: dict[int, Rtklib] = {}
    answered = [compare(rtklib, rng, kind(rng)) for _ in range(PER_BATCH) for kind in (geometry, axes, mixed)]
    assert sum(answered) >= 0.93 * len(answered)
    assert min(rtklib) <= 4 and max(rtklib) >= 55


@pytest.mark.parametrize("name", MODELS)
def test_models_of_the_benchmark(name: str) -> None:
    rng = np.random.default_rng(len(name))
    rtklib: dict[int, Rtklib] = {}
    assert sum(compare(rtklib, rng, double_difference_covariance(rng, *MODELS[name])) for _ in range(25)) >= 10


@pytest.mark.parametrize("n_sats", [(21,), (11, 11), (8, 8, 7)])
def test_strong_models_of_40_ambiguities_are_beyond_its_limit(n_sats: tuple[int, ...]) -> None:
    """3 mm phase of one precision: its search stops after 10,000 loops although a fix is certain; ours goes on."""
    rng = np.random.default_rng(40)
    rtklib: dict[int, Rtklib] = {}
    answered = 0
    for _ in range(10):
        answered += compare(rtklib, rng, double_difference_covariance(rng, n_sats, 2, 0.003, 0.6, weighted=False))
    assert answered <= 3
