"""Tiny flights on disk for tests: a resting IMU and fixes, written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgraph.types import Array

FLIGHT = """
[flight]
origin = { lat_deg = 47.0, lon_deg = 15.4, h_m = 400.0 }

[[vehicle]]
name = "uav"

[vehicle.imu]
file = "imu.csv"
time = "t"
accel = ["ax", "ay", "az"]
gyro = ["wx", "wy", "wz"]

[[vehicle.positions]]
file = "fixes.csv"
time = "t"
position = ["e", "n", "u"]
sigma_m = [0.1, 0.1, 0.2]
"""


def write_csv(path: Path, header: str, rows: Array) -> None:
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=header, comments="")


def resting_imu(n: int = 200, rate_hz: float = 10.0) -> Array:
    """Rows t, f (right, front, up), w of an IMU at rest."""
    rng = np.random.default_rng(5)
    rows = np.zeros((n, 7))
    rows[:, 0] = np.arange(n) / rate_hz
    rows[:, 1:4] = [0.02, -0.03, 9.81]
    rows[:, 1:] += rng.normal(0.0, 0.01, (n, 6))
    return rows


def write_flight(folder: Path, text: str = FLIGHT, imu: Array | None = None) -> Path:
    """A flight folder with a resting IMU and ten fixes along (0, 1, 2) … (9, 1, 2)."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.toml").write_text(text)
    write_csv(folder / "imu.csv", "t,ax,ay,az,wx,wy,wz", resting_imu() if imu is None else imu)
    fixes = np.column_stack([np.arange(10) * 1.0, np.arange(10.0), np.ones(10), np.full(10, 2.0)])
    write_csv(folder / "fixes.csv", "t,e,n,u", fixes)
    return folder
