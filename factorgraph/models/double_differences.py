"""Double differences of two receivers against a pivot satellite, epoch by epoch, for recursive filters.

With e the line of sight from the midpoint of both antennas, i a satellite, j the pivot (highest elevation):

    DD P         =  DD rho          + noise
    DD Phi       =  DD rho + lam N  + noise           DD rho  = (rho_b^i - rho_a^i) - (rho_b^j - rho_a^j)
    -lam DD D    =  DD drho/dt      + noise           d DD rho / d baseline = -(e^i - e^j)

a is the reference, b the rover. Ranges are not linearised; the midpoint makes the linear form good to 2e-5 m at 5.7 km,
where the rover's own line of sight is off by 0.6 m.

    R_DD = 2 D diag(sigma_i^2) D',  D = [-1 | I]: two receivers of equal noise

Source: spec common.md, section 5; spec aar_two_stage.md, section 2.1, errata E2 and E4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from factorgraph.errors import InputError
from factorgraph.models.arcs import find_arcs
from factorgraph.models.gnss import PairedRows, elevation_scale, pair_rows
from factorgraph.models.receivers import Receiver
from factorgraph.problem import Settings
from factorgraph.types import Array, BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class PairEpochs:
    """Single differences rover - reference of one signal, epochs by satellites, NaN where not shared; vectors in n."""

    t_reference_s: Array  # (K,) true times of reception
    t_rover_s: Array  # (K,)
    satellites: tuple[str, ...]
    wavelength_m: float
    sat_reference: Array  # (K, S, 3) as received there
    sat_rover: Array  # (K, S, 3)
    vel_reference: Array
    vel_rover: Array
    code_m: Array  # (K, S)
    phase_m: Array
    rate_mps: Array
    elevation_rad: Array  # (K, S)
    variance_scale: Array  # (K, S) 1 + 1 / sin^2 of the elevation: variance of an observation over sigma0^2
    arc: IntArray  # (K, S) changes where the integer may have, -1 without phase
    usable: BoolArray  # (K, S) code, phase and rate are there

    @property
    def n_epochs(self) -> int:
        return len(self.t_rover_s)

    def order(self, k: int, avoid: IntArray | None = None) -> IntArray:
        """Satellites of epoch k (m + 1,), the pivot first: the highest one, if possible none of `avoid`."""
        seen = np.flatnonzero(self.usable[k])
        if not len(seen):
            return seen
        good = seen if avoid is None or not len(avoid) else np.setdiff1d(seen, avoid)
        pool = good if len(good) else seen
        pivot = pool[np.argmax(self.elevation_rad[k, pool])]
        return np.concatenate([[pivot], seen[seen != pivot]])


def pair_epochs(reference: Receiver, rover: Receiver, settings: Settings, needs_phase: bool = True) -> PairEpochs:
    """Shared observations of two receivers; without `needs_phase`, code and rate make a satellite usable.

    Raises InputError where nothing is shared, or several signals are.
    """
    a, b = reference.antenna.stream, rover.antenna.stream
    pairs = pair_rows(a, b, reference.usable, rover.usable, settings.bands)
    names = f"{reference.vehicle.name}-{rover.vehicle.name}"
    if not len(pairs.a):
        raise InputError(f"link {names}: nothing is observed by both; check times, satellites and elevation masks")
    if len(pairs.group_names) > 1:
        signals = ", ".join(pairs.group_names)
        raise InputError(f"link {names}: this filter takes one signal, both share {signals}; choose with systems and bands")
    lam = b.wavelength_m[pairs.b]
    if np.ptp(lam) > 1e-9:
        raise InputError(f"link {names}: this filter takes satellites of one carrier, not GLONASS; choose with systems")
    return _tabled(reference, rover, pairs, settings, needs_phase)


def _tabled(reference: Receiver, rover: Receiver, pairs: PairedRows, settings: Settings, needs_phase: bool) -> PairEpochs:
    a, b = reference.antenna.stream, rover.antenna.stream
    ra, rb = pairs.a, pairs.b
    pa, pb = reference.differenced, rover.differenced
    epochs, k = np.unique(pairs.epoch, return_inverse=True)
    seen, s = np.unique(b.sat[rb], return_inverse=True)
    finite = np.isfinite(a.phase_cyc[ra]) & np.isfinite(b.phase_cyc[rb])
    arcs = find_arcs(a, b, pairs, finite, settings.ambiguity)

    def table(values: Array) -> Array:
        out = np.full((len(epochs), len(seen), *values.shape[1:]), np.nan)
        out[k, s] = values
        return out

    arc = np.full((len(epochs), len(seen)), -1, np.int64)
    arc[k, s] = arcs.of_row
    code, phase, rate = (table(getattr(pb, name)[rb] - getattr(pa, name)[ra]) for name in ("code_m", "phase_m", "rate_mps"))
    elevation = table(pb.elevation_rad[rb])
    first = np.searchsorted(k, np.arange(len(epochs)))
    vel_a, vel_b = table(pa.sat_vel_n[ra]), table(pb.sat_vel_n[rb])
    usable = np.isfinite(code) & np.isfinite(rate) & np.isfinite(vel_a).all(axis=2) & np.isfinite(vel_b).all(axis=2)
    if needs_phase:
        usable &= np.isfinite(phase) & (arc >= 0)
    return PairEpochs(
        t_reference_s=pa.t_s[ra[first]],
        t_rover_s=pb.t_s[rb[first]],
        satellites=tuple(b.satellites[i] for i in seen),
        wavelength_m=float(b.wavelength_m[rb[0]]),
        sat_reference=table(pa.sat_n[ra]),
        sat_rover=table(pb.sat_n[rb]),
        vel_reference=vel_a,
        vel_rover=vel_b,
        code_m=code,
        phase_m=phase,
        rate_mps=rate,
        elevation_rad=elevation,
        variance_scale=2.0 * elevation_scale(elevation) ** 2,
        arc=arc,
        usable=usable,
    )


@njit(cache=True)
def _unit(s: Array, r: Array, e: Array) -> float:
    x, y, z = s[0] - r[0], s[1] - r[1], s[2] - r[2]
    rho = np.sqrt(x * x + y * y + z * z)
    e[0], e[1], e[2] = x / rho, y / rho, z / rho
    return float(rho)


@njit(cache=True)
def difference(values: Array, order: IntArray) -> Array:
    """Satellite minus pivot (m,) of values (S,) with order (m + 1,), the pivot first."""
    out = np.empty(len(order) - 1)
    for i in range(len(out)):
        out[i] = values[order[i + 1]] - values[order[0]]
    return out


@njit(cache=True)
def predict(
    sat_a: Array, sat_b: Array, vel_a: Array, vel_b: Array, order: IntArray, r_a: Array, v_a: Array, r_b: Array, v_b: Array
) -> tuple[Array, Array, Array]:
    """DD range (m,), DD range rate (m,) and the baseline's geometry rows -(e^i - e^j) (m, 3), e from the midpoint."""
    m = len(order) - 1
    rho, rate, G = np.empty(m), np.empty(m), np.empty((m, 3))
    e, e_mid, pivot = np.empty(3), np.empty(3), np.empty(3)
    middle, sat = 0.5 * (r_a + r_b), np.empty(3)
    rho_j, rate_j = 0.0, 0.0
    for i in range(m + 1):
        s = order[i]
        sd = _unit(sat_b[s], r_b, e)
        sd_rate = e[0] * (vel_b[s, 0] - v_b[0]) + e[1] * (vel_b[s, 1] - v_b[1]) + e[2] * (vel_b[s, 2] - v_b[2])
        sd -= _unit(sat_a[s], r_a, e)
        sd_rate -= e[0] * (vel_a[s, 0] - v_a[0]) + e[1] * (vel_a[s, 1] - v_a[1]) + e[2] * (vel_a[s, 2] - v_a[2])
        for c in range(3):
            sat[c] = 0.5 * (sat_a[s, c] + sat_b[s, c])
        _unit(sat, middle, e_mid)
        if i == 0:
            rho_j, rate_j = sd, sd_rate
            pivot[:] = e_mid
        else:
            rho[i - 1], rate[i - 1] = sd - rho_j, sd_rate - rate_j
            for c in range(3):
                G[i - 1, c] = pivot[c] - e_mid[c]
    return rho, rate, G


@njit(cache=True)
def covariance(variance: Array, order: IntArray) -> Array:
    """R_DD (m, m) of undifferenced variances (S,), the same at both receivers."""
    m = len(order) - 1
    R = np.full((m, m), 2.0 * variance[order[0]])
    for i in range(m):
        R[i, i] += 2.0 * variance[order[i + 1]]
    return R


@njit(cache=True)
def baseline_from_phase(
    range_m: Array, R: Array, sat_a: Array, sat_b: Array, order: IntArray, r_a: Array, b_start: Array
) -> tuple[Array, Array]:
    """Least-squares baseline (3,) and covariance (3, 3) from DD ranges (m,), for instance phases less their ambiguities.

    Three Gauss-Newton steps: midpoint geometry leaves 1e-4 of the error after each.
    """
    b = b_start.copy()
    N = np.zeros((3, 3))
    still = np.zeros(3)
    none = np.zeros_like(sat_a)
    W = np.linalg.inv(R)
    for _ in range(3):
        rho, _rate, G = predict(sat_a, sat_b, none, none, order, r_a, still, r_a + b, still)
        GW = G.T @ W
        N[:, :] = np.linalg.inv(GW @ G)
        b = b + N @ (GW @ (range_m - rho))
    return b, N
