"""The test functions: known values, optima that are where they are said to be, also when shifted, turned and moved."""

from __future__ import annotations

import numpy as np
import pytest

from swarm.functions import FUNCTIONS, instance, random_offset, random_place, random_rotation

NAMES = tuple(FUNCTIONS)

KNOWN = [  # name, point, value worked out by hand
    ("sphere", [3.0, -4.0], 25.0),
    ("ellipsoid", [1.0, 2.0, 3.0], 1.0 + 4.0e3 + 9.0e6),
    ("rosenbrock", [-1.0, 2.0, 3.0], (100.0 * 1 + 4.0) + (100.0 * 1 + 1.0)),
    ("rastrigin", [0.5, 1.0], 0.25 + 20.0 + 1.0),
    ("ackley", [1.0, 1.0], 20.0 - 20.0 * np.exp(-0.2)),
    ("griewank", [np.pi, 0.0], np.pi**2 / 4000 + 2.0),
    ("schwefel", [0.0, 0.0, 0.0], 3 * 418.9828872724338),
    ("schwefel", [503.0, 0.0], 2 * 418.9828872724338 - 500 * np.sin(np.sqrt(500)) + 9.0),
    ("levy", [-3.0, 5.0], 1.0 * (1 + 10 * np.sin(1.0) ** 2) + 1.0),
]


@pytest.mark.parametrize(("name", "z", "value"), KNOWN)
def test_values_worked_out_by_hand(name: str, z: list[float], value: float) -> None:
    assert FUNCTIONS[name].value(np.array(z)) == pytest.approx(value, rel=1e-12)
    at = FUNCTIONS[name].z_best
    placed = instance(name, len(z), x_best=np.full(len(z), at), C=np.eye(len(z)))
    assert placed.cost(np.array([z]))[0] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n", [2, 6, 12])
def test_optimum_is_zero_and_nothing_in_the_box_is_lower(name: str, n: int) -> None:
    rng = np.random.default_rng(n)
    x_best = random_place(name, n, rng)
    placed = instance(name, n, x_best=x_best, C=random_rotation(n, rng), offset=random_offset(name, n, rng))
    low, high = placed.bounds.T
    assert np.all(placed.x_best > low) and np.all(placed.x_best < high)
    assert placed.cost(placed.x_best[None])[0] == pytest.approx(0.0, abs=1e-9)
    points = rng.uniform(low, high, (2000, n))
    near = placed.x_best + (high - low) * rng.normal(size=(2000, n)) * 10.0 ** rng.uniform(-4, -1, (2000, 1))
    found = placed.cost(np.concatenate([points, near]))
    assert found.shape == (4000,) and found.min() > 0.0


@pytest.mark.parametrize("name", NAMES)
def test_moving_function_and_box_changes_nothing_but_the_place(name: str) -> None:
    rng = np.random.default_rng(2)
    offset, u = random_offset(name, 5, rng), rng.random((50, 5))
    here, there = instance(name, 5), instance(name, 5, offset=offset)
    x, moved = (c.bounds[:, 0] + u * np.ptp(c.bounds, axis=1) for c in (here, there))
    assert moved - x == pytest.approx(np.tile(offset, (50, 1)))
    assert there.cost(moved) == pytest.approx(here.cost(x), rel=1e-9, abs=1e-9)
    assert np.all(np.abs(offset) >= 0.5 * np.ptp(here.bounds, axis=1))


@pytest.mark.parametrize("name", NAMES)
def test_only_the_sphere_looks_the_same_when_turned(name: str) -> None:
    rng = np.random.default_rng(3)
    C = random_rotation(4, rng)
    points = rng.uniform(FUNCTIONS[name].low, FUNCTIONS[name].high, (20, 4))
    plain, turned = instance(name, 4).cost(points), instance(name, 4, C=C).cost(points)
    assert np.allclose(plain, turned) != FUNCTIONS[name].turns


def test_turning_is_about_the_optimum() -> None:
    C, x_best = random_rotation(3, np.random.default_rng(1)), np.array([1.0, -2.0, 0.5])
    cost = instance("ellipsoid", 3, x_best=x_best, C=C).cost
    for i, weight in enumerate((1.0, 1e3, 1e6)):
        assert cost((x_best + 0.1 * C[i])[None])[0] == pytest.approx(0.01 * weight)


def test_random_rotations_are_orthogonal_and_have_no_preferred_direction() -> None:
    found = np.array([random_rotation(3, np.random.default_rng(seed)) for seed in range(400)])
    assert found @ found.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (400, 1, 1)), abs=1e-12)
    assert np.abs(found.mean(axis=0)).max() < 0.15  # standard deviation 1/sqrt(1200) = 0.03


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"name": "spere"}, "name must be one of sphere, .*, got spere"),
        ({"n": 1}, "n must be at least 2, got 1"),
        ({"x_best": np.zeros(3)}, r"x_best must be finite with shape \(2,\)"),
        ({"x_best": np.array([0.0, 101.0])}, r"x_best must lie inside \[-100, 100\], got \[0.0, 101.0\]"),
        ({"offset": np.array([0.0, np.nan])}, "offset must be finite"),
        ({"C": np.array([[1.0, 0.0], [0.1, 1.0]])}, "C must be an orthogonal matrix"),
    ],
)
def test_wrong_input_is_named(change: dict[str, object], text: str) -> None:
    arguments: dict[str, object] = {"name": "sphere", "n": 2} | change
    with pytest.raises(ValueError, match=text):
        instance(**arguments)  # type: ignore[arg-type]
