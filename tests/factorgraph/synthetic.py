"""Hand-made receivers over a simple sky, for tests that need full control over every row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph.geodesy import C_MPS, LocalFrame
from factorgraph.measurements import GnssStream
from factorgraph.models.gnss import turned_satellites
from factorgraph.types import Array

FRAME = LocalFrame(np.deg2rad(48.0), np.deg2rad(11.0), 500.0)
FREQUENCY_HZ = {"1": 1575.42e6, "2": 1227.60e6, "5": 1176.45e6}
ORBIT_M = 2.2e7  # range of every satellite at the origin and t = 0


def wavelength(signal: str) -> float:
    return C_MPS / FREQUENCY_HZ[signal[1]]


def satellites_at(names: Sequence[str], t_s: Array) -> tuple[Array, Array]:
    """ECEF positions and velocities (n, 3): spread over the sky by number, moving straight at up to 3 km/s."""
    number = np.array([int(name[1:]) for name in names], float)
    azimuth, elevation = 2.4 * number, np.deg2rad(25.0 + (37.0 * number) % 60.0)
    up = np.column_stack([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])
    v_n = 2500.0 * np.column_stack([np.cos(number), np.sin(number), 0.3 * np.cos(3 * number)])
    return FRAME.to_ecef(ORBIT_M * up + v_n * np.asarray(t_s, float)[:, None]), FRAME.rotate_to_ecef(v_n)


def receiver(
    t_s: Array,
    rows: Sequence[tuple[int, str, str]],
    *,
    r_n: Array | None = None,
    v_n: Array | None = None,
    clock_m: float = 0.0,
    cycles: dict[tuple[str, str], float] | None = None,
) -> GnssStream:
    """Exact vacuum observations of rows (epoch, satellite, signal); r_n, v_n (m, 3) of the antenna; `cycles` adds integers.

    Satellites stand where they are at the time tag (no light travel): what matters to the tests is that streams of two
    receivers agree with the model.
    """
    rows = sorted(rows)
    epoch = np.array([e for e, _, _ in rows], np.int64)
    satellites = tuple(sorted({s for _, s, _ in rows}))
    signals = tuple(sorted({k for _, _, k in rows}))
    sat = np.array([satellites.index(s) for _, s, _ in rows], np.int64)
    signal = np.array([signals.index(k) for _, _, k in rows], np.int64)
    t_s = np.asarray(t_s, float)
    r = FRAME.to_ecef(np.zeros((len(t_s), 3)) if r_n is None else r_n)[epoch]
    v = FRAME.rotate_to_ecef(np.zeros((len(t_s), 3)) if v_n is None else v_n)[epoch]
    pos, vel = satellites_at([s for _, s, _ in rows], t_s[epoch])
    turned, turned_vel = turned_satellites(pos, vel, r)
    d = turned - r
    rho = np.linalg.norm(d, axis=1)
    rate = np.einsum("ni,ni->n", d / rho[:, None], turned_vel - v)
    lam = np.array([wavelength(k) for _, _, k in rows])
    integers = np.array([(cycles or {}).get((s, k), 0.0) for _, s, k in rows])
    n = len(rows)
    return GnssStream(
        t_s=t_s,
        epoch=epoch,
        sat=sat,
        signal=signal,
        satellites=satellites,
        signals=signals,
        wavelength_m=lam,
        code_m=rho + clock_m,
        phase_cyc=(rho + clock_m) / lam + integers,
        doppler_hz=-rate / lam,
        cn0_dbhz=np.full(n, 45.0),
        lli=np.zeros(n, np.int64),
        sat_pos_ecef=pos,
        sat_vel_ecef=vel,
        sat_clock_m=np.zeros(n),
        sat_clock_mps=np.zeros(n),
    )


def every(epochs: int, satellites: Sequence[str], signals: Sequence[str]) -> list[tuple[int, str, str]]:
    """Rows of every epoch, satellite and signal."""
    return [(e, s, k) for e in range(epochs) for s in satellites for k in signals]
