"""Reading one hour of 1 Hz RINEX 3: this reader against cssrlib's, CPU seconds in one run.

    OPENBLAS_NUM_THREADS=1 python -m tests.benchmarks.bench_rinex [--runs 3]

The file is made in a temporary folder: the six minutes of a recording (RELNAV_DATA) repeated ten times with running time
tags, or, where it is absent, an hour written from the built-in constellation. Ours is timed to the finished GnssStream
with satellite states; cssrlib's to decoded observations without them, of the signals it can hold (equally many per system).
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from factorgraph import geodesy
from factorgraph.geodesy import C_MPS
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import GnssStream
from scenarios.flights.navigation import builtin_constellation, read_navigation
from scenarios.flights.rinex import gnss_stream, read_observations
from scenarios.flights.rinex_writer import write_navigation, write_observations
from scenarios.flights.signals import wavelength_m
from tests.helpers import ROOT

RECORDING = "cssrlib_kin_2021_265"
SIGNALS = ("E1C", "E5Q", "E7Q", "E8Q", "G1C", "G1W", "G2W", "G2L", "G5Q", "J1C", "J2L", "J5Q")


def repeated_recording(folder: Path, out: Path, times: int) -> None:
    """The recording `times` over, time tags running on."""
    lines = (folder / "SEPT265G.21O").read_text().splitlines()
    body = next(i for i, line in enumerate(lines) if "END OF HEADER" in line) + 1
    with out.open("w") as f:
        f.write("\n".join(lines[:body]) + "\n")
        for k in range(times):
            for line in lines[body:]:
                if line[0] == ">":
                    moved = datetime.strptime(line[2:21], "%Y %m %d %H %M %S") + timedelta(seconds=360 * k)
                    line = f"> {moved:%Y %m %d %H %M %S}{line[21:]}"
                f.write(line + "\n")


def simulated_hour(out: Path, nav: Path) -> None:
    """An hour at 1 Hz of the satellites in view of one place, four observations of every signal."""
    t0 = GpsTime(2380, 345_600.0)
    navigation = builtin_constellation().shifted_to(t0, 3600.0)
    names = tuple(s for s in navigation.satellites if s[0] in "GEJ")
    place = geodesy.ecef_from_geodetic(np.deg2rad(35.3), np.deg2rad(139.5), 60.0)
    epoch, sat = (v.ravel() for v in np.meshgrid(np.arange(3600), np.arange(len(names)), indexing="ij"))
    states, travel = navigation.states_seen_from(names, sat, t0, epoch.astype(float), np.broadcast_to(place, (epoch.size, 3)))
    up = geodesy.C_en(np.deg2rad(35.3), np.deg2rad(139.5))[2]
    seen = np.flatnonzero((states.pos_ecef - place) @ up / (travel * C_MPS) > np.sin(np.deg2rad(5.0)))
    system = np.array([s[0] for s in SIGNALS])
    row, signal = np.nonzero(np.array([s[0] for s in names])[sat[seen]][:, None] == system)
    at = seen[row]
    wave = np.array([wavelength_m(s) for s in SIGNALS])[signal]
    code = travel[at] * C_MPS - states.clock_m[at]
    n = np.full(at.size, 1000.0)
    stream = GnssStream(
        np.arange(3600.0), epoch[at], sat[at], signal, names, SIGNALS, wave, code, code / wave, n, n * 0.045, 0 * epoch[at],
        states.pos_ecef[at], states.vel_ecef[at], states.clock_m[at], states.clock_mps[at], place,
    )  # fmt: skip
    write_observations(out, stream, t0)
    write_navigation(nav, navigation)


def ours(obs: Path, nav: Path) -> tuple[int, int]:
    raw = read_observations(obs)
    stream, _ = gnss_stream(raw, read_navigation([nav]), raw.t0)
    return len(stream.t_s), stream.n_rows


def cssrlib(obs: Path, types: list[str], n_epochs: int) -> tuple[int, int]:
    from cssrlib.gnss import rSigRnx
    from cssrlib.rinex import rnxdec

    decoder = rnxdec()
    decoder.setSignals([rSigRnx(t) for t in types])
    decoder.decode_obsh(str(obs))
    satellites = sum(len(decoder.decode_obs().sat) for _ in range(n_epochs))
    decoder.fobs.close()
    return n_epochs, satellites


def cssrlib_types(signals: tuple[str, ...]) -> list[str]:
    """Code, phase and strength of as many signals as every system has: the decoder wants equal numbers."""
    by_system = {system: [s for s in signals if s[0] == system] for system in {s[0] for s in signals}}
    n = min(len(names) for names in by_system.values())
    return [s[0] + kind + s[1:] for names in by_system.values() for s in names[:n] for kind in "CLS"]


def cpu_seconds(work: Callable[[], tuple[int, int]], runs: int) -> tuple[float, tuple[int, int]]:
    spent, result = [], (0, 0)
    for _ in range(runs):
        start = time.process_time()
        result = work()
        spent.append(time.process_time() - start)
    return statistics.median(spent), result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=3)
    runs = parser.parse_args().runs
    data = Path(os.environ.get("RELNAV_DATA", ROOT.parent / "shared" / "data")) / RECORDING
    with tempfile.TemporaryDirectory() as folder:
        obs, nav = Path(folder) / "hour.rnx", Path(folder) / "nav.rnx"
        if data.exists():
            repeated_recording(data, obs, 10)
            nav = data / "SEPT2650.21P"
        else:
            simulated_hour(obs, nav)
        body = obs.read_bytes().partition(b"END OF HEADER")[2].splitlines()[1:]
        records = sum(not line.startswith(b">") for line in body)
        print(f"{obs.stat().st_size / 1e6:.1f} MB, {records} satellite rows ({'recording' if data.exists() else 'simulated'})")
        start = time.process_time()
        ours(obs, nav)
        print(f"relnav, first use in this process  {time.process_time() - start:6.2f} s")
        mine, (epochs, rows) = cpu_seconds(lambda: ours(obs, nav), runs)
        print(f"relnav, GnssStream with states     {mine:6.2f} s   {epochs} epochs, {rows} rows")
        if find_spec("cssrlib") is None or find_spec("bitstruct") is None:
            print("cssrlib (with bitstruct) is not installed: no comparison")
            return
        types = cssrlib_types(read_observations(obs).signals)
        theirs, (epochs, satellites) = cpu_seconds(lambda: cssrlib(obs, types, epochs), runs)
        print(f"cssrlib, observations only         {theirs:6.2f} s   {epochs} epochs, {satellites} satellite rows")
        print(f"ratio                              {theirs / mine:6.1f}")


if __name__ == "__main__":
    main()
