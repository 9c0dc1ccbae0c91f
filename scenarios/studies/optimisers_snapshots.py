"""Measurement updates of relative navigation drawn at random, for searches to be compared on.

    pair        two vehicles, states [v r df_l df_f] (12): 7 double-differenced codes and 7 range rates, differences of absolute
                position and velocity (6), one range; 21 rows, which see v and r
    formation   positions of four followers against their leader (12): 20 double-differenced codes, all 10 ranges; 30 rows

Noise is that of Lu et al. (2024): 3 m and 0.03 m/s undifferenced, ranges 0.15 m. Where a search is asked for, a measurement does
not fit: one range is FAULT_M off. Lines of sight are random above MASK_RAD, their turning is left out of the rates; axes are
east, north, up. Priors are correlated at random.

Source: spec ahrs_tdo.md, sections 2.4 and 3.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag

from factorgraph.filters import kalman
from factorgraph.types import Array
from swarm.snapshot import Snapshot

CODE_M, RATE_MPS, RANGE_M = 3.0, 0.03, 0.15
OWN_M, OWN_MPS, OWN_FACTOR = 1.5, 0.05, 4.0  # of each vehicle's own filter; the factor is on their covariance
FAULT_M = 3.0
MASK_RAD = np.deg2rad(15.0)
PAIR_SIGMAS = np.repeat([0.03, 0.5, 0.098, 0.098], 3)  # m/s, m, m/s^2 of the prior
FORMATION_SIGMA_M = 0.7
PAIR_R_M = np.array([30.0, -80.0, -10.0])
SPREAD_M = np.array([150.0, 150.0, 20.0])  # of a formation, to either side


def pair(rng: np.random.Generator) -> Snapshot:
    """A pair's update."""
    G = _double_differences(8, rng)
    R_dd = _dd_covariance(7)
    zero = np.zeros((7, 3))
    H = np.zeros((21, 12))
    H[:14, :6] = np.block([[zero, G], [G, zero]])
    H[14:17, 3:6] = H[17:20, :3] = np.eye(3)
    own = 2.0 * OWN_FACTOR * np.repeat([OWN_M**2, OWN_MPS**2], 3)
    R = block_diag(CODE_M**2 * R_dd, RATE_MPS**2 * R_dd, np.diag(own), np.diag([RANGE_M**2]))
    D = np.zeros((1, 3, 12))
    D[0, :, 3:6] = np.eye(3)
    x = np.concatenate([rng.normal(0.0, 1.0, 3), PAIR_R_M * rng.uniform(0.5, 1.5, 3), np.zeros(6)])
    return _snapshot(x, PAIR_SIGMAS, H, R, D, rng)


def formation(rng: np.random.Generator) -> Snapshot:
    """A formation's update."""
    G = _double_differences(6, rng)
    links = list(combinations(range(5), 2))  # vehicle 0 leads
    H, D = np.zeros((30, 12)), np.zeros((10, 3, 12))
    for i in range(4):
        H[5 * i : 5 * i + 5, 3 * i : 3 * i + 3] = G
    for row, link in enumerate(links):
        for vehicle, sign in zip(link, (-1.0, 1.0), strict=True):
            if vehicle:
                D[row, :, 3 * vehicle - 3 : 3 * vehicle] = sign * np.eye(3)
    # half the variance of a difference is the leader's, the same for all followers
    shared = 0.5 * CODE_M**2 * np.kron(np.eye(4) + np.ones((4, 4)), _dd_covariance(5))
    x = (SPREAD_M * rng.uniform(-1.0, 1.0, (4, 3))).ravel()
    R = block_diag(shared, RANGE_M**2 * np.eye(10))
    return _snapshot(x, np.full(12, FORMATION_SIGMA_M), H, R, D, rng)


DRAWS: dict[str, Callable[[np.random.Generator], Snapshot]] = {"pair": pair, "formation": formation}


def _double_differences(n: int, rng: np.random.Generator) -> Array:
    """-(e_s - e_1) (n - 1, 3) of n random lines of sight, the highest as pivot."""
    el, az = rng.uniform(MASK_RAD, 0.5 * np.pi, n), rng.uniform(0.0, 2 * np.pi, n)
    e = np.column_stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])
    e = e[np.argsort(-el)]
    return np.asarray(e[0] - e[1:])


def _dd_covariance(m: int) -> Array:
    """Of m double differences to one pivot, for receivers of unit variance."""
    return np.asarray(2.0 * (np.eye(m) + np.ones((m, m))))


def _snapshot(x_true: Array, sigma: Array, H: Array, R: Array, D: Array, rng: np.random.Generator) -> Snapshot:
    """Measurements of a true state, a prior, and the extended Kalman update; the last rows are the distances |D x|."""
    n, m, q = len(x_true), len(R), len(D)
    W = rng.normal(size=(n, 3 * n))
    W /= np.linalg.norm(W, axis=1, keepdims=True)
    P = np.outer(sigma, sigma) * (W @ W.T)
    x = x_true + sigma * (W @ rng.normal(size=3 * n))
    rows = np.arange(m - q, m)
    way = D @ x
    H = H.copy()
    H[rows] = np.einsum("qa,qan->qn", way / np.linalg.norm(way, axis=1, keepdims=True), D)
    z = H @ x_true + np.linalg.cholesky(R) @ rng.normal(size=m)
    z[rows] += np.linalg.norm(D @ x_true, axis=1) - H[rows] @ x_true
    z[rng.choice(rows)] += FAULT_M * rng.choice([-1.0, 1.0])
    nu = z - H @ x
    nu[rows] = z[rows] - np.linalg.norm(way, axis=1)
    dx, P_post, _ = kalman.update_sequential(P, nu, H, R)
    return Snapshot(x, P, x + dx, P_post, z, R, H, rows, D, np.zeros((q, 3)), np.ones(q))
