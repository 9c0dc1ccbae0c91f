"""WGS-84 Earth: positions, local frames, rotation and gravity (spec common.md, section 1).

`n` is the local tangent frame east-north-up, fixed to the Earth at a stated origin. All functions
accept a single point (3,) or many (n, 3). Angles in radians, lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.types import Array

A_M = 6_378_137.0
F = 1 / 298.257223563
E2 = F * (2 - F)
OMEGA_E_RPS = 7.2921151467e-5
MU_M3S2 = 3.986004418e14
C_MPS = 299_792_458.0
J2 = 1.0826298213e-3  # from WGS-84 C20


def ecef_from_geodetic(lat_rad: Array | float, lon_rad: Array | float, h_m: Array | float) -> Array:
    """ECEF position (..., 3) of geodetic latitude, longitude and ellipsoidal height."""
    lat, lon, h = np.broadcast_arrays(*(np.asarray(v, float) for v in (lat_rad, lon_rad, h_m)))
    N = A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    xy = (N + h) * np.cos(lat)
    return np.stack([xy * np.cos(lon), xy * np.sin(lon), (N * (1 - E2) + h) * np.sin(lat)], axis=-1)


def geodetic_from_ecef(r_ecef: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude, height of (..., 3); Bowring's start and fixed-point refinement (< 1e-9 m near the Earth)."""
    r = np.asarray(r_ecef, float)
    x, y, z = r[..., 0], r[..., 1], r[..., 2]
    p = np.hypot(x, y)
    b = A_M * (1 - F)
    theta = np.arctan2(z * A_M, p * b)
    lat = np.arctan2(z + E2 / (1 - E2) * b * np.sin(theta) ** 3, p - E2 * A_M * np.cos(theta) ** 3)
    for _ in range(3):
        N = A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + E2 * N * np.sin(lat), p)
    N = A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    # along the normal: well conditioned at the poles and at the equator
    h = p * np.cos(lat) + z * np.sin(lat) - A_M**2 / N
    return lat, np.arctan2(y, x), h


def C_en(lat_rad: Array | float, lon_rad: Array | float) -> Array:
    """Rotation (..., 3, 3) from ECEF to ENU: v_n = C_en @ v_ecef (rows east, north, up)."""
    lat, lon = np.broadcast_arrays(np.asarray(lat_rad, float), np.asarray(lon_rad, float))
    sL, cL, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(sL)
    rows = [np.stack(row, axis=-1) for row in ((-sl, cl, zero), (-sL * cl, -sL * sl, cL), (cL * cl, cL * sl, sL))]
    return np.stack(rows, axis=-2)


def gravitation_ecef(r_ecef: Array) -> Array:
    """Attraction of the Earth with J2 (..., 3), ECEF [m/s^2]; the centrifugal acceleration is not in it."""
    r = np.asarray(r_ecef, float)
    r2 = np.sum(r * r, axis=-1, keepdims=True)
    s2 = r[..., 2:3] ** 2 / r2
    k = 1.5 * J2 * A_M**2 / r2
    scale = np.concatenate([1 + k * (1 - 5 * s2), 1 + k * (1 - 5 * s2), 1 + k * (3 - 5 * s2)], axis=-1)
    return np.asarray(-MU_M3S2 / r2**1.5 * r * scale)


def centrifugal_ecef(r_ecef: Array) -> Array:
    """Centrifugal acceleration (..., 3) of a point turning with the Earth, ECEF [m/s^2]."""
    r = np.asarray(r_ecef, float)
    return np.asarray(OMEGA_E_RPS**2 * r * np.array([1.0, 1.0, 0.0]))


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """The tangent frame `n` (ENU) at a geodetic origin."""

    lat_rad: float
    lon_rad: float
    h_m: float

    @classmethod
    def at_ecef(cls, r_ecef: Array) -> LocalFrame:
        return cls(*(float(v) for v in geodetic_from_ecef(r_ecef)))

    @property
    def origin_ecef(self) -> Array:
        return ecef_from_geodetic(self.lat_rad, self.lon_rad, self.h_m)

    @property
    def C_en(self) -> Array:
        return C_en(self.lat_rad, self.lon_rad)

    @property
    def w_ie_n(self) -> Array:
        """Earth rate in n, rad/s."""
        return OMEGA_E_RPS * np.array([0.0, np.cos(self.lat_rad), np.sin(self.lat_rad)])

    def from_ecef(self, r_ecef: Array) -> Array:
        """Positions (..., 3) ECEF to n."""
        return (np.asarray(r_ecef, float) - self.origin_ecef) @ self.C_en.T

    def to_ecef(self, r_n: Array) -> Array:
        """Positions (..., 3) n to ECEF."""
        return self.origin_ecef + np.asarray(r_n, float) @ self.C_en

    def rotate_from_ecef(self, v_ecef: Array) -> Array:
        return np.asarray(v_ecef, float) @ self.C_en.T

    def rotate_to_ecef(self, v_n: Array) -> Array:
        return np.asarray(v_n, float) @ self.C_en

    def C_to_enu(self, r_n: Array) -> Array:
        """Rotations (..., 3, 3) from n to east-north-up at positions (..., 3) in n."""
        lat, lon, _ = geodetic_from_ecef(self.to_ecef(r_n))
        return C_en(lat, lon) @ self.C_en.T

    def gravitation(self, r_n: Array) -> Array:
        """Attraction (..., 3) at positions in n, resolved in n [m/s^2]."""
        return self.rotate_from_ecef(gravitation_ecef(self.to_ecef(r_n)))

    def gravity(self, r_n: Array) -> Array:
        """Attraction plus centrifugal acceleration (..., 3) at positions in n, resolved in n [m/s^2]."""
        r = self.to_ecef(r_n)
        return self.rotate_from_ecef(gravitation_ecef(r) + centrifugal_ecef(r))
