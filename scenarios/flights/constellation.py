"""The nominal constellations the simulator flies under, as broadcast messages.

    GPS      24 slots of the SPS Performance Standard (2001, table A-2-1), epoch 1993-07-01 00:00, 26,559.7 km, 55 deg
    Galileo  Walker 24/3/1, 29,599.8 km, 56 deg, first slot at RAAN 317.632 deg, argument of latitude 225.153 deg
    BeiDou   Walker 24/3/1, 27,906.1 km, 55 deg; geostationary at 58.75, 80, 110.5, 140, 160 deg E; three inclined
             geosynchronous ones crossing the equator at 118 deg E (spec common.md, M6)
    QZSS     three inclined geosynchronous (e 0.075, 41 deg, centred on 135 deg E) and one geostationary at 127 deg E

All share one Greenwich angle, that of the GPS table's epoch, so the sky is a possible one though not that of any day.
Clock offsets, group delays and the small eccentricities of the others are spread by the golden section, within the sizes
real messages have, so that nothing in a simulation is zero by accident.

`write_constellation(CONSTELLATION)` makes the file that `builtin_constellation` reads.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgraph.geodesy import MU_M3S2, OMEGA_E_RPS
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array
from scenarios.flights import _orbits as o
from scenarios.flights.navigation import BDT_WEEK, INAV, Navigation
from scenarios.flights.rinex_writer import write_navigation

TOE = GpsTime.from_calendar(2026, 1, 7, 12)  # reading of each system's own clock
GREENWICH_DEG = 279.06  # 18 h 36 min 14.4 s
KLOBUCHAR = np.array([1.1176e-8, 7.4506e-9, -5.9605e-8, -5.9605e-8, 9.0112e4, 1.6384e4, -1.9661e5, -6.5536e4])
GPS_NODES_DEG = (272.847, 332.847, 32.847, 92.847, 152.847, 212.847)
GPS_LATITUDES_DEG = (
    (268.126, 161.786, 11.676, 41.806),
    (80.956, 173.336, 309.976, 204.376),
    (111.876, 11.796, 339.666, 241.556),
    (135.226, 265.446, 35.156, 167.356),
    (197.046, 302.596, 66.066, 333.686),
    (238.886, 345.226, 105.206, 135.346),
)
BDS_GEO_DEG = (140.0, 80.0, 110.5, 160.0, 58.75)  # C01 to C05
BDS_IGSO_DEG, QZS_IGSO_DEG, QZS_GEO_DEG = 118.0, 135.0, 127.0
GOLDEN = (np.sqrt(5.0) - 1) / 2
COMMENTS = (
    "Nominal constellations for simulation, not a recording.",
    "GPS: SPS Performance Standard 2001, table A-2-1.",
    "Galileo: Walker 24/3/1.",
    "BeiDou: Walker 24/3/1, 5 geostationary, 3 inclined.",
    "QZSS: 3 inclined at 135 deg E, 1 GEO at 127 deg E.",
    "Clocks, group delays, small eccentricities: golden-section",
    "spread of the usual size. Klobuchar: likewise.",
)


def write_constellation(path: Path) -> None:
    """Write the nominal constellations as a RINEX 3.04 navigation file."""
    write_navigation(path, nominal_constellation(), COMMENTS)


def nominal_constellation() -> Navigation:
    """One message per satellite, all with the same reference time (of their own system)."""
    rows: dict[str, Array] = {}
    slots = [(node, u) for node, plane in zip(GPS_NODES_DEG, GPS_LATITUDES_DEG, strict=True) for u in plane]
    for k, (node, u) in enumerate(slots):
        rows[f"G{k + 1:02d}"] = _message("G", k, 26_559.7e3, _spread(k, 1, 1e-3, 1.2e-2), 55.0, node - GREENWICH_DEG, u, -8.0e-9)
    for k, (node, u) in enumerate(_walker(317.632, 225.153)):
        rows[f"E{k + 1:02d}"] = _message("E", k, 29_599.8e3, _spread(k, 1, 5e-5, 5e-4), 56.0, node - GREENWICH_DEG, u, -5.6e-9)
    for k, longitude in enumerate(BDS_GEO_DEG):
        rows[f"C{k + 1:02d}"] = _bds_geostationary(k, longitude)
    for k in range(3):
        rows[f"C{k + 6:02d}"] = _geosynchronous("C", k + 5, BDS_IGSO_DEG, 120.0 * k, 3e-3, 55.0, 190.0)
        rows[f"J{k + 1:02d}"] = _geosynchronous("J", k, QZS_IGSO_DEG, 120.0 * k, 7.5e-2, 41.0, 270.0)
    for k, (node, u) in enumerate(_walker(0.0, 0.0)):
        e = _spread(k, 1, 1e-4, 1e-3)
        rows[f"C{k + 11:02d}"] = _message("C", k + 8, 27_906.1e3, e, 55.0, node - GREENWICH_DEG, u, -7.0e-9)
    rows["J04"] = _geosynchronous("J", 3, QZS_GEO_DEG, 0.0, 1e-4, 0.05, 0.0)
    names = tuple(sorted(rows))
    toe_s = np.array([14.0 if name[0] == "C" else 0.0 for name in names])
    kepler = o.KeplerSet(names, toe_s, toe_s, np.array([rows[name] for name in names]))
    return Navigation(TOE, kepler, o.GlonassSet((), np.zeros(0), np.zeros((0, o.N_GLONASS))), KLOBUCHAR)


def _walker(node_deg: float, latitude_deg: float) -> list[tuple[float, float]]:
    """Node and argument of latitude of Walker 24/3/1, degrees."""
    return [(node_deg + 120.0 * p, latitude_deg + 45.0 * s + 15.0 * p) for p in range(3) for s in range(8)]


def _spread(k: int, stream: int, low: float, high: float) -> float:
    """The k-th of evenly scattered values between low and high."""
    return low + (high - low) * float(np.mod((k + 1) * GOLDEN + 0.37 * stream, 1.0))


def _message(
    system: str, k: int, a_m: float, e: float, i_deg: float, node_deg: float, latitude_deg: float, node_rate: float,
    perigee_deg: float | None = None,
) -> Array:  # fmt: skip
    """A broadcast message; node_deg is the node's longitude at toe, latitude_deg the mean argument of latitude."""
    w_e = o.OMEGA_BDS if system == "C" else OMEGA_E_RPS
    perigee = _spread(k, 2, 0.0, 360.0) if perigee_deg is None else perigee_deg
    row = np.zeros(o.N_KEPLER)
    row[o.F0], row[o.F1] = _spread(k, 3, -5e-4, 5e-4), _spread(k, 4, -8e-12, 8e-12)
    row[o.SQRT_A], row[o.ECC], row[o.I0] = np.sqrt(a_m), e, np.deg2rad(i_deg)
    row[o.OMEGA] = _angle(np.deg2rad(perigee))
    row[o.M0] = _angle(np.deg2rad(latitude_deg - perigee))
    row[o.OMEGA0] = _angle(np.deg2rad(node_deg) + w_e * TOE.sow)
    row[o.OMEGA_DOT], row[o.TOE] = node_rate, TOE.sow
    row[o.DELAY_1] = _spread(k, 5, -1.2e-8, 1.2e-8)
    row[23], row[27] = 2.0, TOE.sow  # accuracy, time of transmission
    row[o.WEEK] = TOE.week - (BDT_WEEK if system == "C" else 0)
    row[3] = 1.0 + k % 4
    if system in "GJ":
        row[o.CODES], row[o.DELAY_2], row[28] = 1.0, row[3], 4.0 if system == "G" else 0.0
    else:  # the second group delay nearly repeats the first, as measured ones do
        row[o.DELAY_2] = 0.9 * row[o.DELAY_1] + _spread(k, 6, -1e-9, 1e-9)
    if system == "E":
        row[o.CODES], row[23] = float(INAV + 4 + 1), 3.12  # from E1-B and E5b-I, clock of that pair
    return row


def _geosynchronous(
    system: str, k: int, longitude_deg: float, phase_deg: float, e: float, i_deg: float, perigee_deg: float
) -> Array:
    """An orbit of one sidereal day whose ground track crosses the equator northward at longitude_deg, any phase."""
    mu, w_e = (o.MU_GPS, OMEGA_E_RPS) if system == "J" else (MU_M3S2, o.OMEGA_BDS)
    a_m = float(np.cbrt(mu / w_e**2))
    return _message(system, k, a_m, e, i_deg, longitude_deg - phase_deg, phase_deg, 0.0, perigee_deg)


def _bds_geostationary(k: int, longitude_deg: float) -> Array:
    """At rest over the equator: in the frame tilted by -5 deg the orbit has 5 deg inclination and its node at 180 deg."""
    return _message("C", k, float(np.cbrt(MU_M3S2 / o.OMEGA_BDS**2)), 0.0, 5.0, 180.0, longitude_deg - 180.0, 0.0, 0.0)


def _angle(radians: float) -> float:
    return float(np.mod(radians + np.pi, 2 * np.pi) - np.pi)
