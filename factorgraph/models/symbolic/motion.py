"""What is known of a vehicle's motion without measuring it.

    non-holonomic    0 = C_bc^T C_nb^T v_a,  C_bc = Exp(m): of its three rows those across the direction of travel count
    still            0 = v_a
    zero rotation    0 = Log(C_nb(t_0)^T C_nb(t_1)) / (t_1 - t_0)
    start            C_0 = C_nb, r_0 = r, v_0 = v, 0 = b, of a first state

Outputs e = predicted - known. Source: Groves (2013), sec. 15.3 and 15.4.
"""

from __future__ import annotations

import casadi as ca

from factorgraph.models.symbolic.point import EndShape, end_of
from factorgraph.models.symbolic.rotations import exp_small, log_so3
from factorgraph.models.symbolic.sensors import Axes, mounting_of
from factorgraph.models.symbolic.symbols import Symbols, matrix, split


def travel(s: Symbols, a: EndShape, axes: Axes) -> dict[str, ca.SX]:
    """Velocity (3,) of end a right, forward and up of the direction of travel [m/s]. Inputs: the end's, mounting."""
    end = end_of(s, "a", a)
    return {"e": mounting_of(s, axes).back(end.C_nb.back(end.v_n))}


def still(s: Symbols, a: EndShape) -> dict[str, ca.SX]:
    """Velocity (3,) in n of end a [m/s]. Inputs: the end's."""
    return {"e": end_of(s, "a", a).v_n}


def zero_rotation(s: Symbols) -> dict[str, ca.SX]:
    """Mean rate (3,) between two states [rad/s]. Inputs: before, after (9,) attitudes row by row, dt (1,).

    Columns `poses` (12,): rotation and position of the one before, then of the one after.
    """
    before, after = matrix(s.vector("before", 9), 3, 3), matrix(s.vector("after", 9), 3, 3)
    d = s.local("poses", 12)
    turn = exp_small(d[:3]).T @ before.T @ after @ exp_small(d[6:9])
    return {"e": log_so3(turn) / s.scalar("dt")}


def start(s: Symbols) -> dict[str, ca.SX]:
    """A first state against what is known of it (15,): attitude about the axes of n, position, velocity, biases.

    Inputs: state (21,) R row by row, r, v, bias, gyroscope first; C_0 (9,) row by row; r_0, v_0 (3,). Columns `state` (15,).
    """
    R, r, v, b = split(s.vector("state", 21), 9, 3, 3, 6)
    d = s.local("state", 15)
    R, C_0 = matrix(R, 3, 3), matrix(s.vector("C_0", 9), 3, 3)
    turn = C_0 @ log_so3(C_0.T @ R @ exp_small(d[:3]))
    bias = ca.vertcat(b[3:], b[:3]) + d[9:]
    return {"e": ca.vertcat(turn, r + R @ d[3:6] - s.vector("r_0", 3), v + d[6:9] - s.vector("v_0", 3), bias)}
