"""Broadcast orbits and clocks: Kepler elements (GPS, Galileo, BeiDou, QZSS) and GLONASS state vectors.

Rows keep the numbers of a RINEX 3 record in file order, so writing them back loses nothing. Columns of `KeplerSet.data`:

     0 f0     1 f1     2 f2      3 iode     4 Crs   5 dn        6 M0      7 Cuc    8 e      9 Cus   10 sqrt A
    11 toe   12 Cic   13 Omega0 14 Cis     15 i0   16 Crc      17 omega  18 Omega' 19 i'
    20 codes 21 week  22 -      23 accuracy 24 health  25 TGD | BGD E5a/E1 | TGD1   26 IODC | BGD E5b/E1 | TGD2   27-30 -

and of `GlonassSet.data`, kilometres: 0 -tau  1 gamma  2 frame time; 3 7 11 position; 4 8 12 velocity; 5 9 13 luni-solar
acceleration; 6 health; 10 channel; 14 age; 16 tau(L2) - tau(L1).

A satellite's clock offset is f0 + f1 dt + f2 dt^2 plus the relativistic -2 sqrt(mu A) e sin E / c^2.
Velocities are derivatives in the rotating frame.

Source: IS-GPS-200, 20.3.3.4; Galileo OS SIS ICD, 5.1; BDS-SIS-ICD-2.1, 5.2.4 (geostationary: turned by -5 deg);
GLONASS ICD 5.1, A.3.1.2 (Runge-Kutta, steps of 60 s).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.geodesy import C_MPS, MU_M3S2, OMEGA_E_RPS
from factorgraph.types import Array, BoolArray, IntArray

N_KEPLER, N_GLONASS = 31, 19
F0, F1, F2, CRS, DN, M0, CUC, ECC, CUS, SQRT_A = 0, 1, 2, 4, 5, 6, 7, 8, 9, 10
TOE, CIC, OMEGA0, CIS, I0, CRC, OMEGA, OMEGA_DOT, I_DOT = 11, 12, 13, 14, 15, 16, 17, 18, 19
CODES, WEEK, HEALTH, DELAY_1, DELAY_2 = 20, 21, 24, 25, 26
G_F0, G_F1, G_HEALTH, G_CHANNEL, G_DTAU = 0, 1, 6, 10, 16
G_POS, G_VEL, G_ACC = [3, 7, 11], [4, 8, 12], [5, 9, 13]

MU_GPS = 3.9860050e14  # GPS and QZSS; Galileo and BeiDou use the WGS-84 value
OMEGA_BDS = 7.2921150e-5
GEO_TILT_RAD = np.deg2rad(-5.0)
MU_GLO, J2_GLO, RE_GLO_M, OMEGA_GLO = 3.9860044e14, 1.0826257e-3, 6_378_136.0, 7.292115e-5
GLONASS_STEP_S = 60.0
NEWTON_STEPS = 7  # from E = M: exact to rounding for e < 0.3

# Seconds from toe within which a broadcast orbit is used.
MAX_AGE_S = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 21_600.0, "R": 1800.0}


@dataclass(frozen=True, slots=True)
class KeplerSet:
    """Kepler records, sorted by satellite and toe; times are seconds from the owner's reference instant."""

    satellites: tuple[str, ...]
    toc_s: Array  # (n,)
    toe_s: Array  # (n,)
    data: Array  # (n, 31)


@dataclass(frozen=True, slots=True)
class GlonassSet:
    """GLONASS records, sorted by satellite and reference time."""

    satellites: tuple[str, ...]
    toe_s: Array  # (n,)
    data: Array  # (n, 19)


@dataclass(frozen=True, slots=True)
class OrbitClock:
    """Position (n, 3), velocity (n, 3), clock offset (n,) in seconds and its rate (n,)."""

    pos: Array
    vel: Array
    clock_s: Array
    rate: Array


def is_geostationary(satellite: str) -> bool:
    """BeiDou satellites whose broadcast orbit is in the tilted frame."""
    return satellite[0] == "C" and (int(satellite[1:]) <= 5 or int(satellite[1:]) >= 59)


def healthy_kepler(satellites: tuple[str, ...], data: Array) -> BoolArray:
    """Health word zero; the QZSS bit of L1C/B (bit 0) is not L1's."""
    mask = np.array([0xFE if s[0] == "J" else -1 for s in satellites], np.int64)
    return np.asarray((np.nan_to_num(data[:, HEALTH], nan=1.0).astype(np.int64) & mask) == 0)


def kepler_clock_s(p: Array, since_toc_s: Array) -> Array:
    """Polynomial clock offset (n,) without relativity of messages p (31, n)."""
    return np.asarray(p[F0] + since_toc_s * (p[F1] + since_toc_s * p[F2]))


def kepler_states(p: Array, system: Array, geo: BoolArray, since_toe_s: Array, since_toc_s: Array) -> OrbitClock:
    """Orbit and clock with relativity of messages p (31, n); system (n,) holds RINEX letters."""
    mu = np.where((system == "G") | (system == "J"), MU_GPS, MU_M3S2)
    w_e = np.where(system == "C", OMEGA_BDS, OMEGA_E_RPS)
    tk, e = since_toe_s, p[ECC]
    A = p[SQRT_A] ** 2
    n = np.sqrt(mu / A**3) + p[DN]
    M = p[M0] + n * tk
    E = M.copy()
    for _ in range(NEWTON_STEPS):
        E -= (E - e * np.sin(E) - M) / (1 - e * np.cos(E))
    sin_E, cos_E = np.sin(E), np.cos(E)
    E_dot = n / (1 - e * cos_E)
    root = np.sqrt(1 - e**2)
    phi = np.arctan2(root * sin_E, cos_E - e) + p[OMEGA]
    phi_dot = root * E_dot / (1 - e * cos_E)

    s2, c2 = np.sin(2 * phi), np.cos(2 * phi)
    u = phi + p[CUS] * s2 + p[CUC] * c2
    r = A * (1 - e * cos_E) + p[CRS] * s2 + p[CRC] * c2
    i = p[I0] + p[I_DOT] * tk + p[CIS] * s2 + p[CIC] * c2
    u_dot = phi_dot * (1 + 2 * (p[CUS] * c2 - p[CUC] * s2))
    r_dot = A * e * sin_E * E_dot + 2 * phi_dot * (p[CRS] * c2 - p[CRC] * s2)
    i_dot = p[I_DOT] + 2 * phi_dot * (p[CIS] * c2 - p[CIC] * s2)

    x, y = r * np.cos(u), r * np.sin(u)
    x_dot, y_dot = r_dot * np.cos(u) - y * u_dot, r_dot * np.sin(u) + x * u_dot
    node_dot = p[OMEGA_DOT] - np.where(geo, 0.0, w_e)
    node = p[OMEGA0] + node_dot * tk - w_e * p[TOE]
    sin_o, cos_o, sin_i, cos_i = np.sin(node), np.cos(node), np.sin(i), np.cos(i)
    pos = np.stack([x * cos_o - y * cos_i * sin_o, x * sin_o + y * cos_i * cos_o, y * sin_i])
    across = y_dot * cos_i - y * sin_i * i_dot
    vel = np.stack(
        [
            x_dot * cos_o - across * sin_o - pos[1] * node_dot,
            x_dot * sin_o + across * cos_o + pos[0] * node_dot,
            y_dot * sin_i + y * cos_i * i_dot,
        ]
    )
    if geo.any():
        pos[:, geo], vel[:, geo] = _from_tilted(pos[:, geo], vel[:, geo], w_e[geo], tk[geo])
    relativity = -2 * np.sqrt(mu) * p[SQRT_A] * e / C_MPS**2
    clock = kepler_clock_s(p, since_toc_s) + relativity * sin_E
    rate = p[F1] + 2 * p[F2] * since_toc_s + relativity * cos_E * E_dot
    return OrbitClock(pos.T, vel.T, clock, rate)


def _from_tilted(pos: Array, vel: Array, w_e: Array, tk: Array) -> tuple[Array, Array]:
    """BeiDou geostationary: R_z(w_e tk) R_x(-5 deg), (3, n) each."""
    s5, c5 = np.sin(GEO_TILT_RAD), np.cos(GEO_TILT_RAD)
    s, c = np.sin(w_e * tk), np.cos(w_e * tk)

    def turned(v: Array) -> Array:
        y, z = v[1] * c5 + v[2] * s5, v[2] * c5 - v[1] * s5
        return np.stack([v[0] * c + y * s, y * c - v[0] * s, z])

    r, v = turned(pos), turned(vel)
    return r, v + w_e * np.stack([r[1], -r[0], np.zeros_like(tk)])


def glonass_clock_s(p: Array, since_toe_s: Array) -> Array:
    """Clock offset (n,) of messages p (19, n)."""
    return np.asarray(p[G_F0] + p[G_F1] * since_toe_s)


def glonass_states(p: Array, since_toe_s: Array) -> OrbitClock:
    """Orbit and clock of messages p (19, n) by Runge-Kutta steps from the record's state."""
    state = np.concatenate([p[G_POS], p[G_VEL]]) * 1e3
    acc = p[G_ACC] * 1e3
    left = since_toe_s.copy()
    while np.any(np.abs(left) > 1e-9):
        h = np.clip(left, -GLONASS_STEP_S, GLONASS_STEP_S)
        k1 = _glonass_rates(state, acc)
        k2 = _glonass_rates(state + h / 2 * k1, acc)
        k3 = _glonass_rates(state + h / 2 * k2, acc)
        k4 = _glonass_rates(state + h * k3, acc)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        left -= h
    return OrbitClock(state[:3].T, state[3:].T, glonass_clock_s(p, since_toe_s), p[G_F1].copy())


def _glonass_rates(state: Array, acc: Array) -> Array:
    x, y, z, vx, vy, vz = state
    r2 = x * x + y * y + z * z
    r3 = r2 * np.sqrt(r2)
    a = 1.5 * J2_GLO * MU_GLO * RE_GLO_M**2 / r2 / r3
    c = -MU_GLO / r3 - a * (1 - 5 * z * z / r2)
    w2 = OMEGA_GLO**2
    return np.stack(
        [
            vx,
            vy,
            vz,
            (c + w2) * x + 2 * OMEGA_GLO * vy + acc[0],
            (c + w2) * y - 2 * OMEGA_GLO * vx + acc[1],
            (c - 2 * a) * z + acc[2],
        ]
    )


def nearest_records(
    record_of: dict[str, tuple[int, int]], toe_s: Array, names: tuple[str, ...], sat: IntArray, t_s: Array
) -> IntArray:
    """Record (n,) used by satellite sat (n,) of `names` at t_s; -1 where none is within its age limit.

    `record_of` gives each satellite's first and one-past-last record, sorted by toe. Galileo takes the latest record
    not after t (its orbits predict forward), the others the nearest.
    """
    out = np.full(len(sat), -1, np.int64)
    if not toe_s.size or not len(sat):
        return out
    first, end = np.array([record_of.get(name, (0, 0)) for name in names], np.int64).T
    age_s = np.array([MAX_AGE_S.get(name[:1], 0.0) for name in names])
    forward = np.array([name[:1] == "E" for name in names])
    # one sorted axis for all satellites: their records lie side by side, a gap apart
    base, gap = toe_s.min() - 1e5, np.ptp(toe_s) + 4e5
    axis = toe_s - base
    for place, (begin, stop) in enumerate(record_of.values()):
        axis[begin:stop] += place * gap
    place_of = {name: place for place, name in enumerate(record_of)}
    place_row = np.array([place_of.get(name, -1) for name in names], float)[sat]
    left = np.searchsorted(axis, np.clip(t_s - base, 0.0, gap - 2e5) + place_row * gap, side="right") - 1
    lo = first[sat]
    hi = np.maximum(end[sat] - 1, lo)
    before, after = np.clip(left, lo, hi), np.clip(left + 1, lo, hi)
    take_after = (np.abs(toe_s[after] - t_s) < np.abs(toe_s[before] - t_s)) & ~forward[sat]
    chosen = np.where(take_after, after, before)
    usable = (end[sat] > lo) & (np.abs(toe_s[chosen] - t_s) <= age_s[sat] + 1.0)
    out[usable] = chosen[usable]
    return out
