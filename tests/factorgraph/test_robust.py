"""Robust kernels: weights belong to costs, and both to their definitions."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from factorgraph.models.robust import cost, weight
from factorgraph.problem import Kernel, Robust

KERNELS = [k for k in get_args(Kernel)]
T = np.concatenate([-np.geomspace(50, 1e-3, 60), np.geomspace(1e-3, 50, 60)])


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("width", [0.7, 1.345, 4.0])
def test_weight_is_the_slope_of_the_cost_over_t(kernel: Kernel, width: float) -> None:
    robust = Robust(kernel, width)
    t = T[np.abs(np.abs(T) - width) > 1e-3]  # the second derivative may jump there
    h = 1e-5 * np.maximum(np.abs(t), 0.01)
    slope = (cost(robust, t + h) - cost(robust, t - h)) / (2 * h)
    np.testing.assert_allclose(weight(robust, t), slope / t, rtol=2e-5, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
def test_small_residuals_are_least_squares(kernel: Kernel) -> None:
    robust = Robust(kernel, 2.0)
    t = np.array([-1e-4, 0.0, 1e-4])
    np.testing.assert_allclose(weight(robust, t), 1.0, atol=1e-7)
    np.testing.assert_allclose(cost(robust, t), 0.5 * t**2, rtol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_even_bounded_and_never_rising(kernel: Kernel) -> None:
    robust = Robust(kernel, 2.0)
    t = np.linspace(0, 100, 5001)
    w, rho = weight(robust, t), cost(robust, t)
    np.testing.assert_array_equal(w, weight(robust, -t))
    np.testing.assert_array_equal(rho, cost(robust, -t))
    assert np.all((w >= 0) & (w <= 1)) and np.all(np.diff(w) <= 0)
    assert np.all(np.diff(rho) >= 0) and np.all(np.abs(np.diff(rho)) < 3)  # no jump of the cost


@pytest.mark.parametrize(
    ("kernel", "w", "rho"),
    [
        ("huber", 0.5, 2 * 4 - 2),
        ("cauchy", 0.2, 2 * np.log(5)),
        ("geman-mcclure", 0.04, 8 / 5),
        ("tukey", 0.0, 4 / 6),
        ("none", 1.0, 8.0),
    ],
)
def test_values_at_twice_the_width(kernel: Kernel, w: float, rho: float) -> None:
    """By hand from the definitions with c = 2, t = 4."""
    t = np.array([4.0])
    np.testing.assert_allclose(weight(Robust(kernel, 2.0), t), w, atol=1e-15)
    np.testing.assert_allclose(cost(Robust(kernel, 2.0), t), rho, atol=1e-14)


def test_no_kernel_is_least_squares() -> None:
    np.testing.assert_array_equal(weight(None, T), 1.0)
    np.testing.assert_array_equal(cost(None, T), 0.5 * T**2)


@pytest.mark.parametrize("kernel", ["cauchy", "geman-mcclure", "tukey"])
def test_redescending_kernels_forget_gross_errors(kernel: Kernel) -> None:
    """Their influence t w(t) falls towards zero; huber's does not."""
    t = np.array([10.0, 1000.0])
    influence = t * weight(Robust(kernel, 2.0), t)
    assert influence[1] <= influence[0] / 5
    huber = t * weight(Robust("huber", 2.0), t)
    np.testing.assert_allclose(huber, 2.0)
