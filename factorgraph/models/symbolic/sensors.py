"""Sensors that see the vehicle's velocity or attitude: fixes' velocities, odometers, attitude systems, magnetometers, cameras.

With C_bs = Exp(m) the sensor's rotation against the body and x_s = C_bs^T C_nb^T x_n:

    velocity of a fix  z = v_a                          odometer       z = (1 + s) C_bs^T C_nb^T v_a
    attitude           0 = Log(C_ns (C_nb C_bs)^T)      heading        z = atan2(f_E, f_N),  f = C_nb C_bs e_y
    magnetometer       z = C_bs^T C_nb^T m_n + b        camera, radar  azimuth, elevation, range of C_bs^T C_nb^T (r_target - r_a)

Outputs e = predicted - measured, of an attitude -Log(...). Of the mounting m the axes that are estimated have columns.
Source: Groves (2013), ch. 6 and 16.
"""

from __future__ import annotations

import casadi as ca

from factorgraph.models.symbolic.point import EndShape, end_of
from factorgraph.models.symbolic.ranging import LEAST_M, length
from factorgraph.models.symbolic.rotations import Turn, log_so3, wrapped
from factorgraph.models.symbolic.symbols import Symbols, matrix

Axes = tuple[tuple[int, ...], ...]  # which axes of the mounting each of its parameters holds


def mounting_of(s: Symbols, axes: Axes) -> Turn:
    """C_bs. Inputs and columns: mounting0, mounting1, ... one per parameter; none where the mounting is not estimated."""
    if not axes:
        return Turn()
    m = ca.SX.zeros(3)
    for i, of in enumerate(axes):
        m[list(of)] = s.variable(f"mounting{i}", len(of))
    return Turn.by(m)


def fix_velocity(s: Symbols, a: EndShape) -> dict[str, ca.SX]:
    """Velocity (3,) in n of end a [m/s]. Input beside the end: z (3,)."""
    return {"e": end_of(s, "a", a).v_n - s.vector("z", 3)}


def odometer(s: Symbols, a: EndShape, has_scale: bool, axes: Axes) -> dict[str, ca.SX]:
    """Velocity (3,) of end a along the sensor's axes [m/s]. Inputs beside the end: z (3,), scale (1,), mounting."""
    end = end_of(s, "a", a)
    scale = s.variable("scale") if has_scale else 0
    v_s = mounting_of(s, axes).back(end.C_nb.back(end.v_n))
    return {"e": (1 + scale) * v_s - s.vector("z", 3)}


def attitude(s: Symbols, a: EndShape, axes: Axes) -> dict[str, ca.SX]:
    """Rotation error (3,) about east, north, up [rad]. Inputs beside the end: C_ns (9,) measured, row by row, mounting."""
    C_nb = end_of(s, "a", a).C_nb
    C = (C_nb * mounting_of(s, axes)).whole()
    return {"e": -log_so3(matrix(s.vector("z", 9), 3, 3) @ C.T)}


def heading(s: Symbols, a: EndShape, axes: Axes) -> dict[str, ca.SX]:
    """Heading (1,) of the sensor's forward axis [rad]. Inputs beside the end: z (1,), mounting."""
    C_nb = end_of(s, "a", a).C_nb
    f = C_nb.apply(mounting_of(s, axes).apply(ca.SX([0, 1, 0])))
    return {"e": -wrapped(s.scalar("z") - ca.atan2(f[0], f[1]))}


def magnetometer(s: Symbols, a: EndShape, has_bias: bool, axes: Axes) -> dict[str, ca.SX]:
    """Magnetic field (3,) along the sensor's axes. Inputs beside the end: z (3,), field (3,) in n, bias (3,), mounting."""
    m_b = end_of(s, "a", a).C_nb.back(s.vector("field", 3))
    bias = s.variable("bias", 3) if has_bias else 0
    return {"e": mounting_of(s, axes).back(m_b) + bias - s.vector("z", 3)}


def vision(s: Symbols, a: EndShape, b: EndShape | None, axes: Axes) -> dict[str, ca.SX]:
    """Azimuth, elevation [rad] and range [m] (3,) of end b, or of a landmark, from end a.

    Inputs beside the ends: z (3,), landmark (3,), mounting.
    """
    observer = end_of(s, "a", a)
    target_n = s.vector("landmark", 3) if b is None else end_of(s, "b", b).r_n
    z = s.vector("z", 3)
    d = mounting_of(s, axes).back(observer.C_nb.back(target_n - observer.r_n))
    angles = ca.vertcat(ca.atan2(d[0], d[1]), ca.atan2(d[2], length(d[:2], LEAST_M)))
    return {"e": ca.vertcat(-wrapped(z[:2] - angles), length(d) - z[2])}
