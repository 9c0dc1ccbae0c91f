"""Receivers ready for differencing: single-point solutions and corrected rows of every vehicle with GNSS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgraph.errors import InputError
from factorgraph.models.clock_jumps import NO_JUMPS, ClockJumps, clock_jumps, with_phases_following
from factorgraph.models.gnss import Prepared, SinglePoint, elevation_scale, prepare, single_point, system_of, without_ionosphere
from factorgraph.problem import Antenna, NavigationProblem, Vec3, Vehicle
from factorgraph.sampling import interpolate
from factorgraph.types import Array, BoolArray, IntArray

Quantity = Literal["code_m", "phase_m", "doppler_mps"]  # of GnssNoise


@dataclass(slots=True)
class Receiver:
    """A vehicle's receiver with its single-point solution and corrected rows."""

    vehicle: Vehicle
    point: SinglePoint
    clock_s: Array  # (m,) interpolated over epochs without a solution
    prepared: Prepared
    differenced: Prepared  # the same as the receiver's links difference them
    usable: BoolArray  # (n,) rows above the mask, strong enough, with a satellite state
    jumps: ClockJumps = NO_JUMPS

    @property
    def antenna(self) -> Antenna:
        assert self.vehicle.gnss is not None
        return self.vehicle.gnss

    @property
    def lever_b(self) -> Vec3:
        """Lever arm from the vehicle's own point; a base station's point is its antenna."""
        return (0.0, 0.0, 0.0) if self.vehicle.is_fixed else self.antenna.lever_b


def receivers(problem: NavigationProblem) -> dict[str, Receiver]:
    """Single-point solutions and corrected rows of every vehicle with GNSS.

    Raises InputError when a receiver never has enough satellites with ephemerides.
    """
    out = {}
    settings = problem.settings
    for v in problem.vehicles:
        if v.gnss is None:
            continue
        stream, lags = with_phases_following(v.gnss.stream)
        v = replace(v, gnss=replace(v.gnss, stream=stream)) if np.any(lags) else v
        if not np.any(np.isfinite(stream.sat_pos_ecef)):
            raise InputError(
                f"vehicle {v.name}: no satellite has an ephemeris; check that the navigation file covers the flight's time"
            )
        klobuchar = stream.klobuchar if settings.ionosphere_model != "none" else None
        assert v.gnss is not None
        point = single_point(stream, v.gnss.noise, settings.systems, klobuchar, problem.t0.sow)
        good = np.isfinite(point.clock_s)
        if not np.any(good):
            most = int(point.n_sat.max()) if len(point.n_sat) else 0
            raise InputError(
                f"vehicle {v.name}: no epoch has enough satellites for a position (at most {most} with code and ephemeris; "
                f"4 are needed, one more for each further constellation); check systems, elevation mask and navigation file"
            )
        clock = np.interp(stream.t_s, stream.t_s[good], point.clock_s[good])
        if v.fixed_n is not None:
            r_n = np.tile(np.asarray(v.fixed_n, float), (len(stream.t_s), 1))
        else:
            r_n = interpolate(stream.t_s, stream.t_s, problem.frame.from_ecef(point.r_ecef))
        out[v.name] = replace(corrected(problem, v, point, clock, r_n), jumps=clock_jumps(stream.t_s, point.clock_s, lags))
    return out


def corrected(problem: NavigationProblem, vehicle: Vehicle, point: SinglePoint, clock_s: Array, r_n: Array) -> Receiver:
    """A receiver's rows corrected at antenna positions r_n (m, 3)."""
    assert vehicle.gnss is not None
    stream, noise, settings = vehicle.gnss.stream, vehicle.gnss.noise, problem.settings
    klobuchar = stream.klobuchar if settings.ionosphere_model != "none" else None
    day = problem.t0.day_of_year if settings.troposphere_mapping == "niell" else None
    prepared = prepare(stream, problem.frame, r_n, clock_s, klobuchar, problem.t0.sow, day)
    usable = (
        np.isin(system_of(stream), list(settings.systems))
        & (prepared.elevation_rad >= noise.elevation_mask_rad)
        & ~(stream.cn0_dbhz < noise.min_cn0_dbhz)
        & np.all(np.isfinite(prepared.sat_n), axis=1)
        & np.isfinite(stream.sat_clock_m)
    )
    differenced = prepared if settings.ionosphere_model == "broadcast" else without_ionosphere(prepared)
    return Receiver(vehicle, point, clock_s, prepared, differenced, usable)


def difference_sigma(quantity: Quantity, ref: Receiver, rov: Receiver, ra: IntArray, rb: IntArray) -> Array:
    """Standard deviation (n,) of rover minus reference, for rows of the two."""
    a, b = ref.antenna.noise, rov.antenna.noise
    scale_a = elevation_scale(ref.prepared.elevation_rad[ra], a.elevation)
    scale_b = elevation_scale(rov.prepared.elevation_rad[rb], b.elevation)
    return np.asarray(np.hypot(getattr(a, quantity) * scale_a, getattr(b, quantity) * scale_b))
