"""Ranges between points, positions and heights of points.

    range       z = (1 + s) |a - b| + b_r       s: scale, b_r: bias, where they are estimated
    position    z = a
    height      z = a_U + b_h,                  b_h constant or (1 - f) b_j + f b_{j+1} between the nodes of a walk

Outputs e = predicted - measured.
"""

from __future__ import annotations

import casadi as ca

from factorgraph.models.symbolic.point import EndShape, end_of
from factorgraph.models.symbolic.symbols import Symbols

LEAST_M = 1e-6  # ranges are kept off zero, where their direction is undefined


def length(d: ca.SX, least: float = LEAST_M) -> ca.SX:
    """Norm of a vector, not below `least`."""
    return ca.sqrt(ca.fmax(ca.dot(d, d), least**2))


def point_range(s: Symbols, a: EndShape, b: EndShape | None, has_bias: bool, has_scale: bool) -> dict[str, ca.SX]:
    """Range [m] between ends a and b, or a and an anchor. Inputs beside the ends: z (1,), anchor (3,), bias, scale (1,)."""
    near = end_of(s, "a", a).r_n
    far = s.vector("anchor", 3) if b is None else end_of(s, "b", b).r_n
    bias = s.variable("bias") if has_bias else 0
    scale = s.variable("scale") if has_scale else 0
    return {"e": (1 + scale) * length(near - far) + bias - s.scalar("z")}


def position(s: Symbols, a: EndShape) -> dict[str, ca.SX]:
    """Position (3,) of end a [m]. Input beside the end: z (3,)."""
    return {"e": end_of(s, "a", a).r_n - s.vector("z", 3)}


def height(s: Symbols, a: EndShape, has_bias: bool) -> dict[str, ca.SX]:
    """Up coordinate of end a [m]. Inputs beside the end: z, bias (1,)."""
    up = end_of(s, "a", a).r_n[2]
    return {"e": up + (s.variable("bias") if has_bias else 0) - s.scalar("z")}


def barometer(s: Symbols, a: EndShape) -> dict[str, ca.SX]:
    """Up coordinate of end a [m] with a bias between nodes. Inputs beside the end: before, after, late (share of after), z."""
    up = end_of(s, "a", a).r_n[2]
    before, after = s.variable("before"), s.variable("after")
    late = s.scalar("late")
    return {"e": up + (1 - late) * before + late * after - s.scalar("z")}
