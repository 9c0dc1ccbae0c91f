"""Times of one filter step beside others': `OPENBLAS_NUM_THREADS=1 python -m tests.benchmarks.bench_filter_steps`.

17 states (position, velocity, clock and drift, nine of first-order Gauss-Markov processes) and 14 ranges of 2.2e7 m with the
receiver's clock: one prediction and one update of the extended, unscented and cubature filters, by covariance and by root,
in the same process and with the same prior, measurements and sigma points as FilterPy's and Stone Soup's. Ranges to all
sigma points are one compiled call here; the others call a compiled function once per point (FilterPy) or for all points
(Stone Soup). Neither is a requirement of relnav (`pip install filterpy stonesoup`); without them their columns say so.

FilterPy's cubature filter is left out: it forms E[xx'] - mm', which raw ranges make indefinite. Stone Soup's
differs from ours and from its own unscented filter by standard deviations with such ranges.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from factorgraph.filters import kalman, updates
from factorgraph.filters.sigma_points import Rule, cubature, root, unscented
from factorgraph.types import Array
from tests.benchmarks.bench_filters import difference, in_turn

N, M, RANGE_M = 17, 14, 2.2e7
ALPHA, BETA, KAPPA = 0.5, 2.0, 0.0
EKF_GOAL, POINTS_GOAL = 5.0, 15.0  # times FilterPy's EKF and UKF
Result = tuple[Array, Array]


@dataclass(frozen=True, slots=True)
class Case:
    """State, its covariance, motion, satellites and measured ranges."""

    x: Array
    P: Array
    F: Array
    Q: Array
    sats: Array
    z: Array
    sigma: float = 1.0


def case() -> Case:
    rng = np.random.default_rng(7)
    F = np.diag(np.r_[np.ones(8), np.full(9, np.exp(-1 / 300))])
    F[:3, 3:6], F[6, 7] = np.eye(3), 1.0
    F[3:6, 8:11] = 0.5 * np.eye(3)
    u = rng.normal(size=(M, 3))
    sats = RANGE_M * u / np.linalg.norm(u, axis=1)[:, None]
    x = np.r_[rng.normal(0.0, 1e3, 3), rng.normal(0.0, 50.0, 3), 1e4, 30.0, np.zeros(9)]
    sigma = np.r_[np.full(3, 20.0), np.full(3, 2.0), 30.0, 1.0, np.full(9, 0.1)]
    moved = F @ x + 0.3 * sigma * rng.normal(size=N)
    z = np.linalg.norm(sats - moved[:3], axis=1) + moved[6] + rng.normal(size=M)
    return Case(x, np.diag(sigma**2), F, np.diag((0.01 * sigma) ** 2), sats, z)


@njit(cache=True)
def ranges(X: Array, sats: Array) -> Array:
    """Ranges plus clock (s, m) of states X (s, n)."""
    out = np.empty((len(X), len(sats)))
    for i in range(len(X)):
        for j in range(len(sats)):
            d0, d1, d2 = sats[j, 0] - X[i, 0], sats[j, 1] - X[i, 1], sats[j, 2] - X[i, 2]
            out[i, j] = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2) + X[i, 6]
    return out


@njit(cache=True)
def residuals(x: Array, D: Array, sats: Array, z: Array, sigma: float) -> Array:
    """Whitened residuals (s, m) at deviations D (s, n) from x."""
    return (z - ranges(x + D, sats)) / sigma


@njit(cache=True)
def rows(x: Array, sats: Array, z: Array, sigma: float) -> tuple[Array, Array]:
    """Whitened rows at x (n,): measured less predicted (m,) and derivatives (m, n)."""
    e, H = np.empty(len(sats)), np.zeros((len(sats), len(x)))
    for j in range(len(sats)):
        d0, d1, d2 = x[0] - sats[j, 0], x[1] - sats[j, 1], x[2] - sats[j, 2]
        rho = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        e[j] = (z[j] - rho - x[6]) / sigma
        H[j, 0], H[j, 1], H[j, 2], H[j, 6] = d0 / rho / sigma, d1 / rho / sigma, d2 / rho / sigma, 1.0 / sigma
    return e, H


def ekf(c: Case) -> Result:
    x = c.F @ c.x
    dx, P, _ = kalman.update_white(kalman.predict(c.P, c.F, c.Q), *rows(x, c.sats, c.z, c.sigma))
    return x + dx, P


def by_points(c: Case, rule: Rule) -> Result:
    mean, P, _ = updates.predict(c.P, lambda D: (c.x + D) @ c.F.T, c.Q, rule)
    u = updates.sigma_point(P, lambda D: residuals(mean, D, c.sats, c.z, c.sigma), rule)
    return mean + u.dx, u.P


def by_roots(c: Case, L: Array, root_Q: Array, rule: Rule) -> Result:
    mean, prior, _ = updates.predict_root(L, lambda D: (c.x + D) @ c.F.T, root_Q, rule)
    u = updates.square_root(prior, lambda D: residuals(mean, D, c.sats, c.z, c.sigma), rule)
    return mean + u.dx, u.P


def with_filterpy(c: Case) -> dict[str, Callable[[], Result]]:
    """FilterPy's EKF and UKF; nothing where it is not installed."""
    if importlib.util.find_spec("filterpy") is None:
        return {}
    from filterpy.kalman import (  # type: ignore[import-untyped]
        ExtendedKalmanFilter,
        MerweScaledSigmaPoints,
        UnscentedKalmanFilter,
    )

    def h(x: Array) -> Array:
        z: Array = ranges(x[None], c.sats)[0]
        return z

    extended = ExtendedKalmanFilter(N, M)
    points = MerweScaledSigmaPoints(N, ALPHA, BETA, KAPPA)
    unscented_ = UnscentedKalmanFilter(N, M, 1.0, h, lambda x, dt: c.F @ x, points)
    extended.F, extended.Q, extended.R = c.F, c.Q, c.sigma**2 * np.eye(M)
    unscented_.Q, unscented_.R = c.Q, c.sigma**2 * np.eye(M)

    def run_ekf() -> Result:
        extended.x, extended.P = c.x, c.P
        extended.predict()
        extended.update(c.z, lambda x: rows(x, c.sats, c.z, 1.0)[1], h)
        return extended.x, extended.P

    def run_ukf() -> Result:
        unscented_.x, unscented_.P = c.x, c.P
        unscented_.predict()
        unscented_.update(c.z)
        return unscented_.x, unscented_.P

    return {"EKF": run_ekf, "UKF": run_ukf}


def with_stonesoup(c: Case) -> dict[str, Callable[[], Result]]:
    """Stone Soup's EKF, UKF and CKF; nothing where it is not installed."""
    if importlib.util.find_spec("stonesoup") is None:
        return {}
    from datetime import datetime, timedelta

    from stonesoup.base import Property  # type: ignore[import-untyped]
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement  # type: ignore[import-untyped]
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel  # type: ignore[import-untyped]
    from stonesoup.predictor import kalman as predictors  # type: ignore[import-untyped]
    from stonesoup.types.detection import Detection  # type: ignore[import-untyped]
    from stonesoup.types.hypothesis import SingleHypothesis  # type: ignore[import-untyped]
    from stonesoup.types.state import GaussianState, StateVector, StateVectors  # type: ignore[import-untyped]
    from stonesoup.updater import kalman as updaters  # type: ignore[import-untyped]

    class Ranges(NonLinearGaussianMeasurement):  # type: ignore[misc]
        sats: Any = Property()

        @property
        def ndim_meas(self) -> int:
            return M

        def function(self, state: Any, noise: bool = False, **_: Any) -> Any:
            X = np.asarray(state.state_vector, float)
            Y = ranges(np.ascontiguousarray(X.reshape(N, -1).T), self.sats).T
            return StateVector(Y) if X.shape[1] == 1 else StateVectors(Y)

        def jacobian(self, state: Any, **_: Any) -> Array:
            H: Array = rows(np.asarray(state.state_vector, float).ravel(), self.sats, c.z, 1.0)[1]
            return H

    model = Ranges(ndim_state=N, mapping=list(range(N)), noise_covar=c.sigma**2 * np.eye(M), sats=c.sats)
    motion = LinearGaussianTimeInvariantTransitionModel(transition_matrix=c.F, covariance_matrix=c.Q)
    began = datetime(2026, 1, 1)
    later = began + timedelta(seconds=1)
    scaled = {"alpha": ALPHA, "beta": BETA, "kappa": KAPPA}

    def runner(predictor: Any, updater: Any) -> Callable[[], Result]:
        def run() -> Result:
            # new objects each time: predictions from the same are not computed again
            prior, seen = GaussianState(c.x[:, None], c.P, began), Detection(c.z[:, None], timestamp=later)
            post = updater.update(SingleHypothesis(predictor.predict(prior, timestamp=later), seen))
            return np.asarray(post.state_vector, float).ravel(), np.asarray(post.covar, float)

        return run

    return {
        "EKF": runner(predictors.ExtendedKalmanPredictor(motion), updaters.ExtendedKalmanUpdater(model)),
        "UKF": runner(predictors.UnscentedKalmanPredictor(motion, **scaled), updaters.UnscentedKalmanUpdater(model, **scaled)),
        "CKF": runner(predictors.CubatureKalmanPredictor(motion), updaters.CubatureKalmanUpdater(model)),
    }


def main() -> None:
    """Print the figures."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        print("OPENBLAS_NUM_THREADS is not 1: matrices of this size are then slower and times scatter")
    c = case()
    L, root_Q = root(c.P), root(c.Q)
    u, k = unscented(N, ALPHA, BETA, KAPPA), cubature(N)
    ours: dict[str, Callable[[], Result]] = {
        "EKF": lambda: ekf(c),
        "UKF": lambda: by_points(c, u),
        "CKF": lambda: by_points(c, k),
        "SR-UKF": lambda: by_roots(c, L, root_Q, u),
        "SR-CKF": lambda: by_roots(c, L, root_Q, k),
    }
    others = {"FilterPy": with_filterpy(c), "Stone Soup": with_stonesoup(c)}
    calls = {f"ours {name}": call for name, call in ours.items()}
    calls |= {f"{package} {name}": call for package, ways in others.items() for name, call in ways.items()}
    us = in_turn(dict(calls), rounds=40, each=100)  # steps follow each other as they do in a run
    print(f"one step, {N} states, {M} ranges of {RANGE_M:.1e} m, median us (difference from ours in standard deviations)")
    print(f"{'':8s}{'ours':>8s}" + "".join(f"{package:>24s}" for package in others))
    for name, call in ours.items():
        line = f"{name:8s}{us[f'ours {name}']:8.1f}"
        for package, ways in others.items():
            if name in ways:
                line += f"{us[f'{package} {name}']:14.1f} ({difference(call(), ways[name]()):.1e})"
            else:
                line += f"{'-' if ways else 'not installed':>24s}"
        print(line)
    for name, of, goal in (("EKF", "EKF", EKF_GOAL), ("UKF", "UKF", POINTS_GOAL), ("CKF", "UKF", POINTS_GOAL)):
        if f"FilterPy {of}" in us:
            ratio = us[f"FilterPy {of}"] / us[f"ours {name}"]
            print(f"{name}: {ratio:.1f} times FilterPy's {of}, goal {goal:g}: {'met' if ratio >= goal else 'MISSED'}")


if __name__ == "__main__":
    main()
