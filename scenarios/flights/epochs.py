"""Some epochs of a receiver, and what they alone tell: position, velocity, and whether the time tags fit the orbits.

Time tags that are wrong by dt put every satellite range-rate * dt out of place, differently for each: code residuals reach
kilometres. Satellites carried along their orbits by the right correction fit again:

    r(t + dt) = r + v dt + a dt^2 / 2,   a = -mu r / |r|^3 - 2 w x v - w x (w x r)   (ECEF; below 2 m for 30 s)
"""

from __future__ import annotations

import dataclasses

import numpy as np

from factorgraph.geodesy import MU_M3S2, OMEGA_E_RPS
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import GnssStream
from factorgraph.models.gnss import SinglePoint, single_point
from factorgraph.problem import GnssNoise
from factorgraph.types import Array, BoolArray

EPOCHS_LOOKED_AT = 20  # for a position
SYSTEMS = "GREJC"
PER_ROW = ("sat", "signal", "wavelength_m", "code_m", "phase_cyc", "doppler_hz", "cn0_dbhz", "lli")
STATES = ("sat_pos_ecef", "sat_vel_ecef", "sat_clock_m", "sat_clock_mps")
FITS_M = 100.0  # residuals of code stay below, even in streets
MAX_TAG_ERROR_S = 30


def epochs_of(stream: GnssStream, keep: BoolArray) -> GnssStream:
    """The stream with some of its epochs."""
    rows = keep[stream.epoch]
    index = np.cumsum(keep) - 1
    changes = {name: getattr(stream, name)[rows] for name in (*PER_ROW, *STATES)}
    return dataclasses.replace(stream, t_s=stream.t_s[keep], epoch=index[stream.epoch[rows]], **changes)


def every(stream: GnssStream, interval_s: float, n_most: int) -> GnssStream:
    """The stream thinned to about an interval, and evenly to so many epochs at most."""
    n = len(stream.t_s)
    usual = float(np.median(np.diff(stream.t_s))) if n > 1 else interval_s
    step = max(1, round(interval_s / usual), -(-n // n_most))
    return stream if step == 1 else epochs_of(stream, np.arange(n) % step == 0)


def points(stream: GnssStream, t0: GpsTime, noise: GnssNoise | None = None) -> SinglePoint:
    """Single-point solutions from code and Doppler, without the receiver's own idea of its position."""
    free = dataclasses.replace(stream, approx_ecef=None)
    return single_point(free, noise or GnssNoise(), SYSTEMS, free.klobuchar, t0.sow)


def approximate_position(stream: GnssStream, t0: GpsTime) -> Array | None:
    """Median single-point position (3,) ECEF of the first epochs, from the code alone; None where it fails."""
    point = points(epochs_of(stream, np.arange(len(stream.t_s)) < EPOCHS_LOOKED_AT), t0)
    good = np.isfinite(point.r_ecef).all(axis=1) & (point.rms_m < FITS_M)
    return np.median(point.r_ecef[good], axis=0) if good.any() else None


def code_misfit_m(stream: GnssStream, t0: GpsTime) -> float:
    """Median rms of the residuals of single-point solutions over the flight; NaN without a redundant one."""
    n = len(stream.t_s)
    chosen = np.unique(np.linspace(0, n - 1, min(n, EPOCHS_LOOKED_AT)).astype(np.int64))
    rms = points(epochs_of(stream, np.isin(np.arange(n), chosen)), t0).rms_m
    rms = rms[np.isfinite(rms) & (rms > 0)]
    return float(np.median(rms)) if rms.size else float("nan")


def tag_error_s(stream: GnssStream, t0: GpsTime) -> int | None:
    """Whole seconds by which the time tags are late, as the orbits tell; None where no such error explains the code."""
    errors = [dt for dt in range(-MAX_TAG_ERROR_S, MAX_TAG_ERROR_S + 1) if dt]
    few = epochs_of(stream, np.arange(len(stream.t_s)) < 3)
    misfit = [code_misfit_m(_carried(few, -dt), t0) for dt in errors]
    best = int(np.nanargmin(misfit)) if np.isfinite(misfit).any() else 0
    return errors[best] if misfit[best] < FITS_M else None


def _carried(stream: GnssStream, dt_s: float) -> GnssStream:
    """The stream with the satellites where they are some time later."""
    r, v = stream.sat_pos_ecef, stream.sat_vel_ecef
    w = np.array([0.0, 0.0, OMEGA_E_RPS])
    a = -MU_M3S2 * r / np.linalg.norm(r, axis=1, keepdims=True) ** 3 - 2 * np.cross(w, v) - np.cross(w, np.cross(w, r))
    clock = stream.sat_clock_m + dt_s * np.nan_to_num(stream.sat_clock_mps)
    return dataclasses.replace(stream, sat_pos_ecef=r + v * dt_s + 0.5 * a * dt_s**2, sat_clock_m=clock)
