"""Delays of the neutral atmosphere and of the ionosphere for single-frequency users.

Troposphere: Saastamoinen's zenith delays in the standard atmosphere, mapped by 1 / sin(el):

    T = [0.0022768 p / (1 - 0.00266 cos 2L - 0.00028 h/km) + 0.002277 (1255 / T_K + 0.05) e] / sin(el)

Ionosphere: the Klobuchar cosine of local time at the ionospheric pierce point; the delay of another frequency is the
L1 delay times (f_L1 / f)^2. Both keep the constants of the sources, so that they agree with RTKLIB's `tropmodel` and
`ionmodel` to rounding.

Source: Saastamoinen (1972); IS-GPS-200, 20.3.3.5.2.5.
"""

from __future__ import annotations

import numpy as np

from factorgraph.geodesy import C_MPS
from factorgraph.types import Array

HUMIDITY = 0.7  # relative, standard atmosphere
TOP_M = 10_000.0  # the standard atmosphere's formulas end here
NIGHT_S = 5e-9  # Klobuchar's constant part
PEAK_S = 50_400.0  # 14 h local time
SEMICIRCLE_S = 43_200.0  # seconds of local time per semicircle of longitude


def troposphere_m(lat_rad: Array | float, h_m: Array | float, el_rad: Array | float, humidity: float = HUMIDITY) -> Array:
    """Slant delay of the neutral atmosphere in metres; arguments broadcast.

    Heights are held within 0 to 10 km; zero at and below the horizon.
    """
    h = np.clip(h_m, 0.0, TOP_M)
    pressure_hpa = 1013.25 * (1 - 2.2557e-5 * h) ** 5.2568
    kelvin = 15.0 - 6.5e-3 * h + 273.16
    vapour_hpa = 6.108 * humidity * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    dry = 0.0022768 * pressure_hpa / (1 - 0.00266 * np.cos(2 * np.asarray(lat_rad)) - 0.00028 * h / 1e3)
    wet = 0.002277 * (1255.0 / kelvin + 0.05) * vapour_hpa
    sin_el = np.sin(np.asarray(el_rad, float))
    up = sin_el > 0
    return np.asarray(np.where(up | np.isnan(sin_el), (dry + wet) / np.where(up, sin_el, np.nan), 0.0))


def klobuchar_m(
    coefficients: Array, tow_s: Array, lat_rad: Array | float, lon_rad: Array | float, az_rad: Array, el_rad: Array
) -> Array:
    """Slant ionospheric delay at L1 in metres; arguments broadcast.

    coefficients (8,): broadcast alpha 0-3 then beta 0-3; tow_s: GPS seconds, any multiple of days may be missing.
    Zero below the horizon.
    """
    alpha, beta = np.asarray(coefficients, float).reshape(2, 4)
    el = np.asarray(el_rad, float) / np.pi  # semicircles from here on
    psi = 0.0137 / (np.maximum(el, 0.0) + 0.11) - 0.022
    phi = np.clip(np.asarray(lat_rad) / np.pi + psi * np.cos(az_rad), -0.416, 0.416)
    lam = np.asarray(lon_rad) / np.pi + psi * np.sin(az_rad) / np.cos(phi * np.pi)
    phi_m = phi + 0.064 * np.cos((lam - 1.617) * np.pi)
    local_s = np.mod(SEMICIRCLE_S * lam + tow_s, 86_400.0)
    amplitude = np.maximum(np.polyval(alpha[::-1], phi_m), 0.0)
    period = np.maximum(np.polyval(beta[::-1], phi_m), 72_000.0)
    x = 2 * np.pi * (local_s - PEAK_S) / period
    day = np.where(np.abs(x) < 1.57, amplitude * (1 - x**2 / 2 + x**4 / 24), 0.0)
    slant = 1 + 16 * (0.53 - el) ** 3
    return np.asarray(np.where(el < 0, 0.0, C_MPS * slant * (NIGHT_S + day)))
