"""Adaptive correction of a filter's update: where a rule does not believe it, a search decides the state anew.

A rule of `judgement` accepts the posterior or asks for a correction; then an objective of `objective` is minimised within a box
about the posterior, by any method of `swarm.minimize` or, as a control, by bounded Gauss-Newton; and the state is replaced.

Covariance after a correction, of the error x - truth:

    kept     P_post, as published: right for O3, whose minimum the posterior is, and too small for O1 and O2, which use no prior
    joseph   that of the corrected state: with its gain K, x = x_prior + K (z - h(x_prior)), (I - K H) P_prior (I - K H)' + K R K'
    scaled   joseph, times max(1, e' inv(R) e / dof) at the solution, O3 at the solution / m: for rows noisier than R says

K follows from the objective's normal equations in the free coordinates y of x = x_post + T y, those that no wall holds:

    K = K_u + T inv(T' N T) T' (H' W (I - H K_u) - V K_u),   N = H' W H + V,   K_u = P_prior H' inv(S)

    O2: W = inv(R), V = 0;   O3: W = inv(R), V = inv(P_prior);   O1: W = diag(w_j), V = 0

so that states that were kept, and coordinates on a wall, have the filter's own gain, and the covariances between them and those
that were decided anew come out as well. O1 is least where sum a_j H_j' sign(r_j) = 0, r the residuals. In its place is

    sign(r_j) = sqrt(2/pi) r_j / s_j + n_j,   cov n = (2/pi) (arcsin rho - rho),   s_j^2 = var r_j,   rho the correlations of r,

as for a normal r: w_j = a_j sqrt(2/pi) / s_j, and T inv(T' N T) T' H' (a_i cov(n)_ij a_j) H T inv(T' N T) T' is added. Both
follow from cov r and cov r from both, which is iterated from r = v: precise rows find residuals far below their noise and weigh
more than their a_j says. A coordinate on a wall was moved there from the filter's state: the square of its move is added.

None of these knows that the update was selected by a rule. Updates that fit badly by chance alone have larger errors.

Source: spec ahrs_tdo.md 2.5 to 2.7, errata E21, E24, E25; Bussgang (1952) for the slope of a sign, its use here is ours;
Birge (1932) for scaled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Literal, get_args

import numpy as np

from swarm import gauss_newton, methods
from swarm.judgement import Rule, judge, literal_weights
from swarm.objective import Objective, Space, Which, objective, space
from swarm.result import SwarmResult
from swarm.snapshot import IntArray, Snapshot
from swarm.types import Array

GAUSS_NEWTON = "gauss-newton"
Decided = Literal["seen", "all"] | tuple[int, ...]
Others = Literal["kept", "follow", "auto"]
Coordinates = Literal["normalised", "whitened", "raw"]
Covariance = Literal["kept", "joseph", "scaled"]
Search = Callable[[Objective, Space, np.random.Generator], SwarmResult]
AT_WALL = 1e-9  # of the box
SIGN_STEPS, LEAST_RESIDUAL = 30, 1e-3  # of the linearised signs; standard deviations of rows


class Outcome(Enum):
    """What became of an update."""

    ACCEPTED = "posterior accepted"
    CORRECTED = "state replaced"
    UNDETERMINED = "the rows do not determine the decided states; posterior kept"


@dataclass(frozen=True, slots=True)
class CorrectorSettings:
    """When and how to correct.

    decided: states that are searched, "seen" those that rows depend on. others: states that are not searched stay ("kept") or
    follow as their conditional mean; "auto" lets them follow in O3 and stay in O1 and O2, which know no prior.
    """

    rule: Rule = field(default_factory=Rule)
    objective: Which = "O3"
    decided: Decided = "seen"
    others: Others = "auto"
    coordinates: Coordinates = "normalised"
    box_sigmas: float = 3.0
    covariance: Covariance = "joseph"

    def __post_init__(self) -> None:
        for name, choices in (
            ("objective", get_args(Which)),
            ("others", get_args(Others)),
            ("coordinates", get_args(Coordinates)),
            ("covariance", get_args(Covariance)),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)}")
        if isinstance(self.decided, str) and self.decided not in ("seen", "all"):
            raise ValueError(f"decided must be seen, all or numbers of states, got {self.decided}")
        if not (np.isfinite(self.box_sigmas) and self.box_sigmas > 0):
            raise ValueError(f"box_sigmas must be positive, got {self.box_sigmas}")

    @property
    def follow(self) -> bool:
        """Whether states that are not searched follow."""
        return self.objective == "O3" if self.others == "auto" else self.others == "follow"


@dataclass(frozen=True, slots=True)
class Corrected:
    """State and covariance to go on with, and how they came about."""

    x: Array  # (n,)
    P: Array  # (n, n)
    triggered: bool
    statistic: float
    threshold: float
    outcome: Outcome
    result: SwarmResult | None = None  # of the search, where there was one


@dataclass(frozen=True, slots=True)
class Optimiser:
    """A search by name: of `swarm.METHODS`, or gauss-newton. Raises ValueError for an unknown one.

    The default budget is that of the published optimiser with 30 members and 800 iterations. from_posterior: one member starts
    there, so that the search ends no higher.
    """

    method: str = "tdo"
    max_evals: int = 36_000
    n_members: int = 30
    from_posterior: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)  # of the method

    def __post_init__(self) -> None:
        if self.method != GAUSS_NEWTON and self.method not in methods.METHODS:
            raise ValueError(f"method must be one of {', '.join((*methods.METHODS, GAUSS_NEWTON))}, got {self.method}")

    def __call__(self, cost: Objective, within: Space, rng: np.random.Generator) -> SwarmResult:
        """Minimise an objective."""
        if self.method == GAUSS_NEWTON:
            return gauss_newton.minimize(cost, within.bounds, within.start)
        return methods.minimize(
            self.method,
            cost.compiled(),
            within.bounds,
            rng=rng,
            max_evals=self.max_evals,
            n_members=self.n_members,
            x0=within.start if self.from_posterior else None,
            **self.options,
        )


class Corrector:
    """Judge and correct updates one by one; keeps nothing between them.

    optimiser: a name of `Optimiser`, one with its budget, or any callable of the objective, its space and a generator.
    """

    def __init__(self, settings: CorrectorSettings | None = None, optimiser: str | Search = "tdo") -> None:
        self.settings = settings or CorrectorSettings()
        self.search: Search = Optimiser(optimiser) if isinstance(optimiser, str) else optimiser

    def __call__(self, snapshot: Snapshot, rng: np.random.Generator) -> Corrected:
        """The update as it is, or corrected.

        Raises ValueError where a decided state is none of the snapshot's or has no variance, LinAlgError where a covariance is
        not positive definite.
        """
        verdict = judge(self.settings.rule, snapshot)
        accepted = Corrected(
            snapshot.x_post, snapshot.P_post, verdict.triggered, verdict.statistic, verdict.threshold, Outcome.ACCEPTED
        )
        if not verdict.triggered:
            return accepted
        within, cost = posed(self.settings, snapshot)
        if not _determined(cost, within):
            return replace(accepted, outcome=Outcome.UNDETERMINED)
        result = self.search(cost, within, rng)
        x = within.state(result.x)
        P = covariance(self.settings, snapshot, within, result.x)
        return replace(accepted, x=x, P=P, outcome=Outcome.CORRECTED, result=result)


def posed(settings: CorrectorSettings, snapshot: Snapshot) -> tuple[Space, Objective]:
    """The search of a snapshot: its coordinates and its objective."""
    decided, kind = _decided(settings.decided, snapshot), settings.coordinates
    within = space(snapshot, decided, settings.box_sigmas, kind == "raw", settings.follow, kind == "whitened")
    return within, objective(settings.objective, snapshot, within)


def covariance(settings: CorrectorSettings, snapshot: Snapshot, within: Space, y: Array) -> Array:
    """Covariance (n, n) after a correction that ended at y (p,), as the settings want it."""
    if settings.covariance == "kept":
        return snapshot.P_post
    x, margin = within.state(y), AT_WALL * (within.bounds[:, 1] - within.bounds[:, 0])
    free = (y > within.bounds[:, 0] + margin) & (y < within.bounds[:, 1] - margin)
    moved = within.T[:, ~free] @ (y - within.start)[~free]
    P = _joseph(settings.objective, snapshot, snapshot.jacobian(x), within.T[:, free]) + np.outer(moved, moved)
    if settings.covariance == "joseph":
        return P
    e = snapshot.z - snapshot.h(x[None])[0]
    chi_square, dof = float(e @ np.linalg.solve(snapshot.R, e)), float(snapshot.m if snapshot.dof is None else snapshot.dof)
    if settings.objective == "O3":
        dx = x - snapshot.x_prior
        chi_square += float(dx @ np.linalg.solve(snapshot.P_prior, dx))
    else:
        dof -= np.count_nonzero(free)
    return P * max(1.0, chi_square / dof) if dof > 0 else P


def _joseph(which: Which, snapshot: Snapshot, H: Array, T: Array) -> Array:
    """Covariance of the minimiser with rows H (m, n) in free coordinates T (n, f)."""
    R, P, eye = snapshot.R, snapshot.P_prior, np.eye(snapshot.m)
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    W, of_signs = _signs(H @ T, R) if which == "O1" else (np.linalg.inv(R), None)
    N_T, from_rows = H.T @ W @ (H @ T), H.T @ W
    right = from_rows @ (eye - H @ K)
    if which == "O3":
        N_T = N_T + np.linalg.solve(P, T)
        right -= np.linalg.solve(P, K)
    K = K + T @ np.linalg.solve(T.T @ N_T, T.T @ right)
    left = np.eye(snapshot.n) - K @ H
    out = left @ P @ left.T + K @ R @ K.T
    if of_signs is not None:
        out += T @ of_signs @ T.T
    return np.asarray(0.5 * (out + out.T))


def _signs(A: Array, R: Array) -> tuple[Array, Array]:
    """W (m, m) of O1 for rows A (m, f) of the free coordinates, and what signs add to the coordinates' covariance (f, f)."""
    sigma = np.sqrt(np.diag(R))
    a, eye, linear = literal_weights(sigma), np.eye(len(R)), np.sqrt(2 / np.pi)
    s, rho = sigma, R / np.outer(sigma, sigma)
    for _ in range(SIGN_STEPS):
        w = a * linear / s
        M = np.linalg.inv(A.T @ (w[:, None] * A))
        noise = linear**2 * np.outer(a, a) * (np.arcsin(np.clip(rho, -1.0, 1.0)) - rho)
        added = M @ A.T @ noise @ A @ M
        left = eye - A @ M @ (A.T * w)
        V = left @ R @ left.T + A @ added @ A.T
        size = np.sqrt(np.maximum(np.diag(V), (LEAST_RESIDUAL * sigma) ** 2))
        rho = V / np.outer(size, size)
        s = np.sqrt(s * size)
    return np.diag(w), added


def _determined(cost: Objective, within: Space) -> bool:
    """Whether the rows leave no direction of the coordinates open."""
    J = cost.jacobian(within.start) * (within.bounds[:, 1] - within.bounds[:, 0])
    return bool(np.linalg.matrix_rank(J) == J.shape[1])


def _decided(decided: Decided, snapshot: Snapshot) -> IntArray:
    if isinstance(decided, str):
        return snapshot.seen if decided == "seen" else np.arange(snapshot.n)
    chosen = np.unique(np.array(decided, np.intp))
    if not (len(chosen) and chosen[0] >= 0 and chosen[-1] < snapshot.n):
        raise ValueError(f"decided must name states below {snapshot.n}, got {decided}")
    return chosen
