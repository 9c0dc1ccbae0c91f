"""RTKLIB solution files (`.pos`): latitude/longitude/height, ECEF or east-north-up baselines.

Header lines begin with "%"; the last of them names the time system (GPST or UTC) and the columns. Times are calendar
dates or week and seconds. A standard deviation of two axes is sign(cov) sqrt(|cov|). Baselines count from the
reference position of the header ("% ref pos"). Velocities and their standard deviations may follow the ratio
(out-outvel), in the axes of the positions.

Source: RTKLIB 2.4.3 manual, appendix B.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from factorgraph.errors import InputError
from factorgraph.geodesy import C_en, ecef_from_geodetic, geodetic_from_ecef
from factorgraph.gpstime import GpsTime, leap_seconds
from factorgraph.types import Array, IntArray
from scenarios.flights.tables import Times, read_bytes

Kind = Literal["llh", "ecef", "enu"]
MARKS: tuple[tuple[str, Kind], ...] = (("latitude", "llh"), ("x-ecef", "ecef"), ("e-baseline", "enu"))
N_VALUES = 22  # position 3, Q, ns, standard deviations 6, age, ratio; velocity 3 and standard deviations 6 where asked for


@dataclass(frozen=True, slots=True)
class PosFile:
    """A solution file as it stands."""

    times: Times
    kind: Kind
    position: Array  # (n, 3) degrees, degrees, metres; or metres
    cov: Array  # (n, 3, 3) east-north-up, ECEF for kind "ecef" [m^2]; NaN where absent
    quality: IntArray  # (n,) 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP
    n_sat: IntArray  # (n,)
    ratio: Array  # (n,)
    velocity: Array  # (n, 3) east-north-up, ECEF for kind "ecef" [m/s]; NaN where absent
    velocity_cov: Array  # (n, 3, 3) in the same axes [m^2/s^2]
    reference_ecef: Array | None  # (3,) of the header
    n_rows: int
    dropped: dict[str, int]

    def ecef(self) -> Array | None:
        """Positions (n, 3) ECEF; None for baselines without a reference position."""
        if self.kind == "ecef":
            return self.position
        if self.kind == "llh":
            return ecef_from_geodetic(np.radians(self.position[:, 0]), np.radians(self.position[:, 1]), self.position[:, 2])
        if self.reference_ecef is None:
            return None
        return self.reference_ecef + self.position @ _C_en(self.reference_ecef)

    def cov_enu(self, C_en_: Array) -> Array:
        """Covariances (n, 3, 3) east-north-up, with the rotation (3, 3) for those in ECEF."""
        return np.asarray(C_en_ @ self.cov @ C_en_.T) if self.kind == "ecef" else self.cov

    def velocity_enu(self, C_en_: Array) -> tuple[Array, Array]:
        """Velocities (n, 3) and their covariances (n, 3, 3) east-north-up, with the rotation for those in ECEF."""
        if self.kind != "ecef":
            return self.velocity, self.velocity_cov
        return self.velocity @ C_en_.T, np.asarray(C_en_ @ self.velocity_cov @ C_en_.T)


def _C_en(r_ecef: Array) -> Array:
    lat, lon, _ = geodetic_from_ecef(r_ecef)
    return C_en(lat, lon)


def read_pos(path: Path) -> PosFile:
    """Read a solution file. Raises InputError when it is none, or no row can be read; broken rows are counted."""
    lines = read_bytes(path).decode("latin-1").splitlines()
    header = [line for line in lines if line.startswith("%")]
    titles = next((line for line in reversed(header) if any(mark in line for mark, _ in MARKS)), None)
    if titles is None:
        raise InputError(f"{path}: not an RTKLIB solution file (no % line with latitude, x-ecef or e-baseline)")
    if "(d'" in titles:
        raise InputError(f"{path}: positions in degrees, minutes, seconds are not read; write them with out-degform=deg")
    kind = next(kind for mark, kind in MARKS if mark in titles)
    body = [line for line in lines if line.strip() and not line.startswith("%")]
    rows = [row for line in body if (row := _row(line)) is not None]
    if not rows:
        raise InputError(f"{path}: no solution row could be read (of {len(body)})")
    start = GpsTime(rows[0][0].week, float(np.floor(rows[0][0].sow)))
    values = np.array([row[1] for row in rows])
    leap = leap_seconds(start.calendar()) if "UTC" in titles.split()[1] else 0
    dropped = {"unreadable": len(body) - len(rows)} if len(body) > len(rows) else {}
    return PosFile(
        Times(np.array([row[0] - start for row in rows]), start + leap),
        kind,
        values[:, :3],
        _covariances(values[:, 5:11], kind),
        values[:, 3].astype(np.int64),
        values[:, 4].astype(np.int64),
        values[:, 12],
        values[:, [14, 13, 15]] if kind == "llh" else values[:, 13:16],
        _covariances(values[:, 16:22], kind),
        _reference(header),
        len(body),
        dropped,
    )


def _row(line: str) -> tuple[GpsTime, list[float]] | None:
    cells = line.replace(",", " ").split()
    try:
        values = [float(cell) for cell in cells[2 : 2 + N_VALUES]]
        if len(values) < 5 or not np.all(np.abs(values[:5]) < 1e9):  # NaN included
            return None
        return _instant(cells[0], cells[1]), values + [np.nan] * (N_VALUES - len(values))
    except (ValueError, IndexError):
        return None


def _instant(day: str, clock: str) -> GpsTime:
    if "/" not in day:
        return GpsTime(int(day), float(clock))
    year, month, date = (int(v) for v in day.split("/"))
    hour, minute, second = clock.split(":")
    return GpsTime.from_calendar(year, month, date, int(hour), int(minute), float(second))


def _covariances(sd: Array, kind: Kind) -> Array:
    """(n, 3, 3) from the columns sd_a, sd_b, sd_c, sd_ab, sd_bc, sd_ca; llh files have them in the order n, e, u."""
    var = np.sign(sd) * sd**2
    a, b, c, ab, bc, ca = (var[:, i] for i in range(6))
    P = np.stack([np.stack(row, axis=-1) for row in ((a, ab, ca), (ab, b, bc), (ca, bc, c))], axis=-2)
    return P[:, [[1], [0], [2]], [1, 0, 2]] if kind == "llh" else P


def _reference(header: list[str]) -> Array | None:
    """Reference position ECEF (3,) of "% ref pos   : ...", three metres or latitude, longitude and height."""
    line = next((line for line in header if line.startswith("% ref pos")), None)
    try:
        values = np.array([float(v) for v in line.split(":", 1)[1].split()[:3]]) if line else np.zeros(0)
    except ValueError:
        return None
    if values.shape != (3,):
        return None
    if np.linalg.norm(values) > 1e6:
        return values
    return ecef_from_geodetic(np.radians(values[0]), np.radians(values[1]), values[2])
