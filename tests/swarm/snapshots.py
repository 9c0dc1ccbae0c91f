"""Updates of a relative filter as the paper's sensors make them, drawn from their own prior and noise."""

from __future__ import annotations

import numpy as np

from swarm.snapshot import Snapshot
from swarm.types import Array

N, M, RANGE, SEEN = 12, 21, 20, np.arange(6)
VEL, POS = slice(0, 3), slice(3, 6)
CODE_M, RATE_MPS, ABS_M, ABS_MPS, RANGE_M = 3.0, 0.03, 1.0, 0.05, 0.15
PRIOR = np.r_[0.1, -0.2, 0.05, -80.0, 30.0, -10.0, np.zeros(6)]
AZIMUTH, ELEVATION = np.deg2rad([0, 50, 95, 140, 190, 230, 280, 330]), np.deg2rad([80, 30, 45, 20, 60, 35, 25, 50])


def rows() -> tuple[Array, Array]:
    """H (21, 12) with the range's row at the prior, and R: double differences share their reference's noise."""
    up = np.column_stack([np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)])
    dd = -(up[1:] - up[0])
    H, R = np.zeros((M, N)), np.zeros((M, M))
    H[:7, POS], H[7:14, VEL], H[7:14, POS] = dd, dd, 1e-4 * dd[::-1]
    H[14:17, POS], H[17:20, VEL], H[RANGE, POS] = np.eye(3), np.eye(3), PRIOR[POS] / np.linalg.norm(PRIOR[POS])
    shared = 2.0 * (np.eye(7) + np.ones((7, 7)))
    R[:7, :7], R[7:14, 7:14] = CODE_M**2 * shared, RATE_MPS**2 * shared
    R[14:17, 14:17], R[17:20, 17:20], R[RANGE, RANGE] = ABS_M**2 * np.eye(3), ABS_MPS**2 * np.eye(3), RANGE_M**2
    return H, R


def prior_covariance(rng: np.random.Generator) -> Array:
    """P (12, 12), all states correlated."""
    G, sigma = rng.normal(size=(N, N)), np.repeat([0.02, 0.5, 0.05, 0.05], 3)
    return np.asarray(sigma[:, None] * (G @ G.T / N + 0.3 * np.eye(N)) * sigma)


def drawn(seed: int, *, linear: bool = False, bias: Array | None = None) -> tuple[Snapshot, Array]:
    """An extended Kalman filter's update and the truth (12,); the range is a row of H where `linear`; bias (21,) of z."""
    rng = np.random.default_rng(seed)
    H, R = rows()
    P = prior_covariance(rng)
    truth = PRIOR + np.linalg.cholesky(P) @ rng.normal(size=N)
    z = H @ truth + np.linalg.cholesky(R) @ rng.normal(size=M)
    if not linear:
        z[RANGE] += np.linalg.norm(truth[POS]) - H[RANGE] @ truth
    if bias is not None:
        z = z + bias
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    left = np.eye(N) - K @ H
    x, P_post = PRIOR + K @ (z - H @ PRIOR), left @ P @ left.T + K @ R @ K.T
    if linear:
        return Snapshot(PRIOR, P, x, P_post, z, R, H), truth
    D = np.zeros((1, 3, N))
    D[0, :, POS] = np.eye(3)
    return Snapshot(PRIOR, P, x, P_post, z, R, H, np.array([RANGE]), D, np.zeros((1, 3)), np.ones(1)), truth
