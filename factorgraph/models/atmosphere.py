"""Delays of the neutral atmosphere and of the ionosphere for single-frequency users.

Troposphere: Saastamoinen's zenith delays in the standard atmosphere, mapped by 1 / sin(el):

    T = [0.0022768 p / (1 - 0.00266 cos 2L - 0.00028 h/km) + 0.002277 (1255 / T_K + 0.05) e] / sin(el)

or, with Niell's functions of latitude, height and day of the year, m_h(el) and m_w(el) in place of 1 / sin(el) for the dry
and the wet part; m is the continued fraction 1 / (sin + a / (sin + b / (sin + c))) normed to 1 in the zenith.

Ionosphere: the Klobuchar cosine of local time at the ionospheric pierce point; the delay of another frequency is the
L1 delay times (f_L1 / f)^2. Both keep the constants of the sources, so that they agree with RTKLIB's `tropmodel` and
`ionmodel` to rounding.

Source: Saastamoinen (1972); Niell (1996), tables 3 and 4; IS-GPS-200, 20.3.3.5.2.5.
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


# Niell: latitudes [deg] and, per row, a b c of the mean, their yearly amplitudes, and a b c of the wet part
NIELL_DEG = np.array([15.0, 30.0, 45.0, 60.0, 75.0])
NIELL_MEAN = np.array(
    [
        [1.2769934e-3, 1.2683230e-3, 1.2465397e-3, 1.2196049e-3, 1.2045996e-3],
        [2.9153695e-3, 2.9152299e-3, 2.9288445e-3, 2.9022565e-3, 2.9024912e-3],
        [62.610505e-3, 62.837393e-3, 63.721774e-3, 63.824265e-3, 64.258455e-3],
    ]
)
NIELL_YEARLY = np.array(
    [
        [0.0, 1.2709626e-5, 2.6523662e-5, 3.4000452e-5, 4.1202191e-5],
        [0.0, 2.1414979e-5, 3.0160779e-5, 7.2562722e-5, 11.723375e-5],
        [0.0, 9.0128400e-5, 4.3497037e-5, 84.795348e-5, 170.37206e-5],
    ]
)
NIELL_WET = np.array(
    [
        [5.8021897e-4, 5.6794847e-4, 5.8118019e-4, 5.9727542e-4, 6.1641693e-4],
        [1.4275268e-3, 1.5138625e-3, 1.4572752e-3, 1.5007428e-3, 1.7599082e-3],
        [4.3472961e-2, 4.6729510e-2, 4.3908931e-2, 4.4626982e-2, 5.4736038e-2],
    ]
)
NIELL_HEIGHT = np.array([2.53e-5, 5.49e-3, 1.14e-3])
NIELL_DAY = 28.0  # of the year: northern midwinter


def zenith_delays_m(lat_rad: Array | float, h_m: Array | float, humidity: float = HUMIDITY) -> tuple[Array, Array]:
    """Dry and wet delay of the zenith in the standard atmosphere; heights are held within 0 to 10 km."""
    h = np.clip(h_m, 0.0, TOP_M)
    pressure_hpa = 1013.25 * (1 - 2.2557e-5 * h) ** 5.2568
    kelvin = 15.0 - 6.5e-3 * h + 273.16
    vapour_hpa = 6.108 * humidity * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    dry = 0.0022768 * pressure_hpa / (1 - 0.00266 * np.cos(2 * np.asarray(lat_rad)) - 0.00028 * h / 1e3)
    wet = 0.002277 * (1255.0 / kelvin + 0.05) * vapour_hpa
    return np.asarray(dry), np.asarray(wet)


def troposphere_m(
    lat_rad: Array | float,
    h_m: Array | float,
    el_rad: Array | float,
    humidity: float = HUMIDITY,
    day_of_year: float | None = None,
) -> Array:
    """Slant delay of the neutral atmosphere in metres; arguments broadcast.

    Mapped by 1 / sin(el), or by Niell's functions where the day of the year is given. Zero at and below the horizon.
    """
    dry, wet = zenith_delays_m(lat_rad, h_m, humidity)
    sin_el = np.sin(np.asarray(el_rad, float))
    up = sin_el > 0
    if day_of_year is None:
        slant = (dry + wet) / np.where(up, sin_el, np.nan)
    else:
        safe = np.where(up, el_rad, np.nan)
        slant = dry * niell_dry(lat_rad, h_m, safe, day_of_year) + wet * niell_wet(lat_rad, safe)
    return np.asarray(np.where(up | np.isnan(sin_el), slant, 0.0))


def niell_dry(lat_rad: Array | float, h_m: Array | float, el_rad: Array | float, day_of_year: float) -> Array:
    """Niell's mapping of the dry zenith delay; arguments broadcast."""
    lat = np.rad2deg(np.asarray(lat_rad, float))
    season = np.cos(2 * np.pi * ((day_of_year - NIELL_DAY) / 365.25 + np.where(lat < 0, 0.5, 0.0)))
    tables = zip(NIELL_MEAN, NIELL_YEARLY, strict=True)
    a, b, c = (_of_latitude(mean, lat) - _of_latitude(yearly, lat) * season for mean, yearly in tables)
    sin_el = np.sin(np.asarray(el_rad, float))
    above = 1 / sin_el - _continued(sin_el, *NIELL_HEIGHT)
    return np.asarray(_continued(sin_el, a, b, c) + above * np.clip(h_m, 0.0, TOP_M) / 1e3)


def niell_wet(lat_rad: Array | float, el_rad: Array | float) -> Array:
    """Niell's mapping of the wet zenith delay; arguments broadcast."""
    lat = np.rad2deg(np.asarray(lat_rad, float))
    return _continued(np.sin(np.asarray(el_rad, float)), *(_of_latitude(row, lat) for row in NIELL_WET))


def _of_latitude(row: Array, lat_deg: Array) -> Array:
    return np.asarray(np.interp(np.abs(lat_deg), NIELL_DEG, row))


def _continued(sin_el: Array, a: Array, b: Array, c: Array) -> Array:
    top = 1 + a / (1 + b / (1 + c))
    return np.asarray(top / (sin_el + a / (sin_el + b / (sin_el + c))))


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
