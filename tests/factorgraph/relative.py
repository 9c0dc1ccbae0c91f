"""Two receivers under a simple sky as the recursive filters see them, with every number under control."""

from __future__ import annotations

import numpy as np

from factorgraph.filters.float_ambiguity import FloatSettings
from factorgraph.models.double_differences import PairEpochs
from factorgraph.types import Array, BoolArray, IntArray

ORBIT_M, LAM = 2.2e7, 0.192
AZIMUTH = np.deg2rad([10.0, 75.0, 130.0, 200.0, 250.0, 320.0, 40.0, 170.0, 290.0])
ELEVATION = np.deg2rad([70.0, 35.0, 52.0, 28.0, 61.0, 44.0, 40.0, 30.0, 33.0])
UP = np.column_stack([np.sin(AZIMUTH) * np.cos(ELEVATION), np.cos(AZIMUTH) * np.cos(ELEVATION), np.sin(ELEVATION)])
SPEED = 2500.0 * np.column_stack([np.cos(AZIMUTH + 1), np.sin(AZIMUTH + 1), 0.3 * np.cos(3 * AZIMUTH)])
SD_CYCLES = np.array([12.0, -7.0, 33.0, 4.0, -21.0, 8.0, -3.0, 16.0, 0.0])


def pair(
    baseline: Array,
    velocity: Array | None = None,
    *,
    settings: FloatSettings | None = None,
    rng: np.random.Generator | None = None,
    n_sat: int = 7,
    seen: BoolArray | None = None,
    arc: IntArray | None = None,
    cycles: Array | None = None,
    elevation: Array | None = None,
    doppler_mps: float = 0.0,
) -> PairEpochs:
    """Single differences of baselines (K, 3) at 1 Hz, the reference at the origin; noise of `settings` where there is rng.

    seen, arc, elevation (K, S); cycles (K, S) or (S,) single-difference ambiguities.
    """
    K, S = len(baseline), n_sat
    t = np.arange(float(K))
    sat = ORBIT_M * UP[:S] + SPEED[:S] * t[:, None, None]
    vel = np.broadcast_to(SPEED[:S], sat.shape).copy()
    v = np.zeros((K, 3)) if velocity is None else velocity
    d = sat - baseline[:, None]
    rho_b, rho_a = np.linalg.norm(d, axis=2), np.linalg.norm(sat, axis=2)
    rate = np.einsum("ksi,ksi->ks", d / rho_b[..., None], vel - v[:, None]) - np.einsum(
        "ksi,ksi->ks", sat / rho_a[..., None], vel
    )
    clock = 30.0 + 0.5 * t[:, None]
    el = np.broadcast_to(ELEVATION[:S], (K, S)) if elevation is None else elevation
    scale = 1 + 1 / np.sin(el) ** 2
    noise = np.zeros((3, K, S))
    if rng is not None and settings is not None:
        sigma = np.array([settings.code_m, settings.phase_m, doppler_mps])
        noise = sigma[:, None, None] * np.sqrt(2 * scale) * rng.normal(size=(3, K, S))
    N = np.broadcast_to(SD_CYCLES[:S] if cycles is None else cycles, (K, S))
    usable = np.ones((K, S), bool) if seen is None else seen

    def shown(x: Array) -> Array:
        return np.where(usable, x, np.nan)

    return PairEpochs(
        t_reference_s=t,
        t_rover_s=t,
        satellites=tuple(f"C{i + 1:02d}" for i in range(S)),
        wavelength_m=LAM,
        sat_reference=sat,
        sat_rover=sat.copy(),
        vel_reference=vel,
        vel_rover=vel.copy(),
        code_m=shown(rho_b - rho_a + clock + noise[0]),
        phase_m=shown(rho_b - rho_a + clock + LAM * N + noise[1]),
        rate_mps=shown(rate + 0.5 + noise[2]),
        elevation_rad=shown(el),
        variance_scale=shown(scale),
        arc=np.where(usable, np.arange(S) if arc is None else arc, -1),
        usable=usable,
    )
