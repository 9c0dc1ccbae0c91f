"""What the atmosphere does beyond the models of estimators: the same for every receiver, different for every satellite.

Ionosphere: vertical delays at L1 on a thin shell at 350 km, a gradient and travelling waves as medium-scale disturbances are
(wavelengths of 100 to 400 km, 100 to 200 m/s), seen where the ray pierces the shell and slanted by 1 / cos of its zenith angle
there. Wet troposphere: zenith delays that drift with the wind (structures of 15 to 80 km, 10 m/s), fall off with 2 km of height
and are mapped by Niell's function.

Source: Hernandez-Pajares, Juan and Sanz (2006), Medium-scale traveling ionospheric disturbances affecting GPS measurements;
Niell (1996).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.models.atmosphere import niell_wet
from factorgraph.types import Array

EARTH_M = 6_371_000.0
SHELL_M = 350_000.0
SCALE_HEIGHT_M = 2000.0
N_WAVES = 32
DISTURBANCES = ((1e5, 4e5), (100.0, 200.0))  # wavelengths [m], speeds [m/s]
WEATHER = ((1.5e4, 8e4), (10.0, 10.0))


@dataclass(frozen=True, slots=True)
class Waves:
    """A random field of unit variance in the plane and time: plane waves that travel."""

    k: Array  # (w, 2) wave vectors [rad/m]
    rate: Array  # (w,) [rad/s]
    phase: Array  # (w,)

    @classmethod
    def drawn(
        cls, rng: np.random.Generator, lengths_m: tuple[float, float], speeds: tuple[float, float], together: bool
    ) -> Waves:
        """Wavelengths evenly in their logarithm; `together`: all drift with one wind instead of along their own direction."""
        k = 2 * np.pi / np.exp(rng.uniform(np.log(lengths_m[0]), np.log(lengths_m[1]), N_WAVES))
        course, speed = rng.uniform(0, 2 * np.pi, N_WAVES), rng.uniform(*speeds, N_WAVES)
        phase = rng.uniform(0, 2 * np.pi, N_WAVES)
        towards = np.column_stack([np.cos(course), np.sin(course)])
        wind = rng.uniform(0, 2 * np.pi)
        along = towards @ [np.cos(wind), np.sin(wind)] if together else 1.0
        return cls(k[:, None] * towards, k * speed * along, phase)

    def at(self, x_m: Array, t_s: Array) -> Array:
        """Values (n,) at points (n, 2) and times (n,)."""
        out = np.zeros(len(x_m))
        for k, rate, phase in zip(self.k, self.rate, self.phase, strict=True):
            out += np.cos(x_m @ k - rate * t_s + phase)
        return np.asarray(out * np.sqrt(2 / len(self.phase)))


@dataclass(frozen=True, slots=True)
class Rays:
    """Where and how signals arrive, (n,) each."""

    t_s: Array
    lat_rad: Array
    lon_rad: Array
    h_m: Array
    az_rad: Array
    el_rad: Array


def _plane(lat_rad: Array, lon_rad: Array, origin: tuple[float, float]) -> Array:
    """East and north (n, 2) of points about an origin, metres along the Earth's surface."""
    lat0, lon0 = origin
    east = np.mod(lon_rad - lon0 + np.pi, 2 * np.pi) - np.pi
    return EARTH_M * np.column_stack([np.cos(lat0) * east, lat_rad - lat0])


def pierced(rays: Rays) -> tuple[Array, Array, Array]:
    """Latitude and longitude (n,) where rays pierce the shell, and 1 / cos of the zenith angle there."""
    sin_z = EARTH_M / (EARTH_M + SHELL_M) * np.cos(rays.el_rad)
    psi = np.pi / 2 - rays.el_rad - np.arcsin(sin_z)
    lat = np.arcsin(np.sin(rays.lat_rad) * np.cos(psi) + np.cos(rays.lat_rad) * np.sin(psi) * np.cos(rays.az_rad))
    lon = rays.lon_rad + np.arcsin(np.sin(psi) * np.sin(rays.az_rad) / np.cos(lat))
    return lat, lon, 1 / np.sqrt(1 - sin_z**2)


def ionosphere_m(rays: Rays, waves_m: float, gradient_ppm: float, rng: np.random.Generator, origin: tuple[float, float]) -> Array:
    """Slant delay (n,) at L1: waves of a standard deviation and a gradient of a size, in a random direction."""
    waves = Waves.drawn(rng, *DISTURBANCES, together=False)
    course = rng.uniform(0, 2 * np.pi)
    lat, lon, slant = pierced(rays)
    x = _plane(lat, lon, origin)
    gradient = 1e-6 * gradient_ppm * (x @ [np.sin(course), np.cos(course)])
    return np.asarray(slant * (gradient + waves_m * waves.at(x, rays.t_s)))


def wet_m(rays: Rays, sigma_m: float, rng: np.random.Generator, origin: tuple[float, float]) -> Array:
    """Slant wet delay (n,) over the model's, of a standard deviation of the zenith at sea level."""
    weather = Waves.drawn(rng, *WEATHER, together=True)
    zenith = sigma_m * np.exp(-rays.h_m / SCALE_HEIGHT_M) * weather.at(_plane(rays.lat_rad, rays.lon_rad, origin), rays.t_s)
    up = rays.el_rad > 0
    mapping = niell_wet(rays.lat_rad, np.where(up, rays.el_rad, np.pi / 2))
    return np.asarray(np.where(up, zenith * mapping, 0.0))
