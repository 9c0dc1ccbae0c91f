"""Ranges and range rates from satellites to antennas, and their differences between two receivers.

    rho = |s - a|,   rho' = e . (s' - a'),   e = (s - a) / rho
    single        rho(a)
    difference    rho(a_rover) - rho(a_reference)
    placed        rho(p + a_rover - a_reference) - rho(p),     p: where a moving reference is taken to be

Satellites are where they were at transmission, in the axes of n at reception: the Earth's turn meanwhile is in s.
Clocks, ambiguities and what changes slowly are linear and join outside.

These are models of rows: variables are the points themselves, whose own Jacobians (`point`) come once per epoch.
Source: Groves (2013), sec. 8.5 and 9.4.
"""

from __future__ import annotations

from typing import Literal

import casadi as ca

from factorgraph.models.symbolic.symbols import Symbols

Differencing = Literal["single", "difference", "placed"]


def satellite_range(sat_n: ca.SX, r_n: ca.SX) -> ca.SX:
    """Range [m] from a point (3,) to a satellite (3,)."""
    return ca.norm_2(sat_n - r_n)


def satellite_rate(sat_n: ca.SX, vel_n: ca.SX, r_n: ca.SX, v_n: ca.SX) -> ca.SX:
    """Range rate [m/s] of a point (3,) at velocity (3,) to a satellite (3,) at velocity (3,)."""
    return ca.dot(sat_n - r_n, vel_n - v_n) / ca.norm_2(sat_n - r_n)


def code_or_phase(s: Symbols, differencing: Differencing) -> dict[str, ca.SX]:
    """Predicted range or difference [m]. Inputs: rover, reference (3,), sat_rover, sat_reference (3,), place (3,)."""
    rover, sat = s.variable("rover", 3), s.vector("sat_rover", 3)
    if differencing == "single":
        return {"h": satellite_range(sat, rover)}
    reference, sat_reference = s.variable("reference", 3), s.vector("sat_reference", 3)
    if differencing == "difference":
        return {"h": satellite_range(sat, rover) - satellite_range(sat_reference, reference)}
    place = s.vector("place", 3)
    return {"h": satellite_range(sat, place + rover - reference) - satellite_range(sat_reference, place)}


def doppler(s: Symbols, differencing: Differencing) -> dict[str, ca.SX]:
    """Predicted range rate or difference [m/s]. Inputs as of `code_or_phase`, but positions and velocities (6,) of all."""
    r, v = _halves(s.variable("rover", 6))
    sat, vel = _halves(s.vector("sat_rover", 6))
    if differencing == "single":
        return {"h": satellite_rate(sat, vel, r, v)}
    r_ref, v_ref = _halves(s.variable("reference", 6))
    sat_ref, vel_ref = _halves(s.vector("sat_reference", 6))
    if differencing == "difference":
        return {"h": satellite_rate(sat, vel, r, v) - satellite_rate(sat_ref, vel_ref, r_ref, v_ref)}
    place = s.vector("place", 3)
    moved = satellite_rate(sat, vel, place + r - r_ref, v)
    return {"h": moved - satellite_rate(sat_ref, vel_ref, place, v_ref)}


def _halves(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    return x[:3], x[3:]
