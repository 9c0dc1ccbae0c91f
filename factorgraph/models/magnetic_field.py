"""The Earth's magnetic field from the world magnetic model, in n.

The model is a spherical harmonic series to degree 12 with its change in time, valid for five years from its epoch; good to
0.1 to 0.2 microtesla where no iron is near. Declination is the angle from north to the field, clockwise.

Source: Chulliat et al. (2025), the US/UK World Magnetic Model for 2025-2030 (coefficients and series from `pygeomag`).
"""

from __future__ import annotations

import calendar

import numpy as np

from factorgraph import geodesy
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array

NANOTESLA = 1e-3  # microtesla


def field_n(frame: LocalFrame, t: GpsTime, r_n: Array | None = None) -> Array:
    """The field (3,) [microtesla] in n at a place r_n (3,), the origin when not given.

    Raises InputError for dates that no model covers.
    """
    from pygeomag import GeoMag

    place = np.zeros(3) if r_n is None else r_n
    lat, lon, h = (float(x) for x in geodesy.geodetic_from_ecef(frame.to_ecef(place)))
    year = decimal_year(t)
    try:
        model = GeoMag(base_year=int(year)).calculate(np.rad2deg(lat), np.rad2deg(lon), 1e-3 * h, year)
    except ValueError as error:
        raise InputError(f"no magnetic model for the year {year:.1f}: give the field itself") from error
    return np.asarray(NANOTESLA * np.array([model.y, model.x, -model.z]) @ frame.C_to_enu(place))


def declination_rad(field: Array) -> float:
    """Angle of a field (3,) in n, clockwise from north."""
    return float(np.arctan2(field[0], field[1]))


def decimal_year(t: GpsTime) -> float:
    """The date as a year and its fraction."""
    year = t.calendar().year
    return float(year + (t.day_of_year - 1) / (366 if calendar.isleap(year) else 365))
