"""Attitude: Hamilton quaternions scalar first, Euler angles, small-angle errors (spec common.md, section 2).

`C_nb` maps body (right, front, up) to navigation (east, north, up). Euler angles are pitch (nose up),
roll (right wing down) and heading (clockwise from north). Functions are vectorised over leading axes.
"""

from __future__ import annotations

import numpy as np

from factorgraph.types import Array

# Same matrix both ways: ENU <-> NED and RFU <-> FRD.
ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def skew(v: Array) -> Array:
    """[v x] (..., 3, 3) of (..., 3)."""
    v = np.asarray(v, float)
    S = np.zeros((*v.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    S[..., 1, 0], S[..., 2, 0], S[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return S


def _angles(phi: Array, series_below: float) -> tuple[Array, Array, Array, Array]:
    """Of rotation vectors: angle squared, angle with 1 in place of small ones, which are small (..., 1, 1), [phi x]."""
    phi = np.asarray(phi, float)
    a2 = np.sum(phi * phi, axis=-1)[..., None, None]
    a = np.sqrt(a2)
    small = a < series_below
    return a2, np.where(small, 1.0, a), small, skew(phi)


def exp_so3(phi: Array) -> Array:
    """Rotation matrix (..., 3, 3) of a rotation vector (..., 3)."""
    a2, a, small, S = _angles(phi, 1e-4)
    s = np.where(small, 1 - a2 / 6, np.sin(a) / a)
    c = np.where(small, 0.5 - a2 / 24, (1 - np.cos(a)) / a**2)
    return np.asarray(np.eye(3) + s * S + c * (S @ S))


def right_jacobian(phi: Array) -> Array:
    """Jr (..., 3, 3) of rotation vectors (..., 3): Exp(phi + d) = Exp(phi) Exp(Jr d) to first order."""
    a2, a, small, S = _angles(phi, 1e-4)
    b = np.where(small, 0.5 - a2 / 24, (1 - np.cos(a)) / a**2)
    c = np.where(small, 1 / 6 - a2 / 120, (a - np.sin(a)) / a**3)
    return np.asarray(np.eye(3) - b * S + c * (S @ S))


def right_jacobian_inverse(phi: Array) -> Array:
    """Inverse of `right_jacobian` (..., 3, 3), for rotation vectors up to pi: Log(Exp(phi) Exp(d)) = phi + Jr^-1 d."""
    a2, a, small, S = _angles(phi, 1e-3)
    c = np.where(small, 1 / 12 + a2 / 720, 1 / a**2 - 0.5 / (a * np.tan(a / 2)))
    return np.asarray(np.eye(3) + 0.5 * S + c * (S @ S))


def wrapped(angle_rad: Array | float) -> Array:
    """Angles in [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi)


def log_so3(C: Array) -> Array:
    """Rotation vector (..., 3), norm in [0, pi], of rotation matrices (..., 3, 3)."""
    q = quat_from_matrix(C)
    v = q[..., 1:]
    n = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(n, q[..., :1])
    return np.where(n < 1e-12, 2 * v, angle / np.where(n < 1e-12, 1.0, n) * v)


def matrix_from_quat(q: Array) -> Array:
    """Rotation matrix (..., 3, 3) of unit quaternions (..., 4), scalar first."""
    q = np.asarray(q, float)
    w, v = q[..., 0, None, None], q[..., 1:]
    S = skew(v)
    return np.asarray(np.eye(3) + 2 * w * S + 2 * (S @ S))


def quat_from_matrix(C: Array) -> Array:
    """Unit quaternion (..., 4), scalar first and non-negative, of rotation matrices (..., 3, 3)."""
    C = np.asarray(C, float)
    tr = np.trace(C, axis1=-2, axis2=-1)
    d = np.diagonal(C, axis1=-2, axis2=-1)
    # Shepperd: four candidates, keep the one with the largest pivot
    sq = np.concatenate([(1 + tr)[..., None], 1 + 2 * d - tr[..., None]], axis=-1)
    k = np.argmax(sq, axis=-1)
    cand = np.empty((*k.shape, 4, 4))
    wx, wy, wz = (C[..., i, j] - C[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    xy, xz, yz = (C[..., i, j] + C[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    for row, values in enumerate(
        ((sq[..., 0], wx, wy, wz), (wx, sq[..., 1], xy, xz), (wy, xy, sq[..., 2], yz), (wz, xz, yz, sq[..., 3]))
    ):
        cand[..., row, :] = np.stack(values, axis=-1)
    q = np.take_along_axis(cand, k[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def matrix_from_euler(pitch_rad: Array | float, roll_rad: Array | float, heading_rad: Array | float) -> Array:
    """C_nb (..., 3, 3) from pitch, roll and heading."""
    th, ga, ps = np.broadcast_arrays(*(np.asarray(v, float) for v in (pitch_rad, roll_rad, heading_rad)))
    st, ct, sg, cg, sp, cp = np.sin(th), np.cos(th), np.sin(ga), np.cos(ga), np.sin(ps), np.cos(ps)
    rows = (
        (cg * cp + sg * sp * st, sp * ct, sg * cp - cg * sp * st),
        (-cg * sp + sg * cp * st, cp * ct, -sg * sp - cg * cp * st),
        (-sg * ct, st, cg * ct),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def euler_from_matrix(C_nb: Array) -> tuple[Array, Array, Array]:
    """Pitch, roll, heading of C_nb (..., 3, 3); heading in (-pi, pi]."""
    C = np.asarray(C_nb, float)
    pitch = np.arcsin(np.clip(C[..., 2, 1], -1.0, 1.0))
    return pitch, np.arctan2(-C[..., 2, 0], C[..., 2, 2]), np.arctan2(C[..., 0, 1], C[..., 1, 1])
