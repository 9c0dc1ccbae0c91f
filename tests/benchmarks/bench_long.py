"""Long flights and many vehicles: `python -m tests.benchmarks.bench_long [seconds]`.

Two UAVs (IMU 200 Hz each, 15 satellites 1 Hz, UWB 10 Hz) for 20 min and for 3 h, unless told another length, solved with robust
weights, integers and every covariance: time and memory over the data may be as long as the flight is, no longer. Then ten UAVs
with the relative solutions of all 45 pairs. Every run has a process of its own, so that peaks of memory are its own.
"""

from __future__ import annotations

import ctypes
import gc
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from factorgraph import registry
from scenarios.simulate import load_scenario, simulate
from scenarios.studies import replace_duration

SHORT_S, LONG_S, GROUP_S = 1200.0, 10_800.0, 300.0
PAGE_MB = resource.getpagesize() / 2**20


def _resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * PAGE_MB


def _give_back() -> None:
    """Hand freed memory back to the system, where the C library can: else the solution would use it unseen."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _run(scenario: str, seconds: float) -> dict[str, float]:
    """Solve one flight in this process."""
    registry.solve(simulate(replace_duration(load_scenario(scenario), 20.0), 1).problem)  # compiled kernels
    flight = simulate(replace_duration(load_scenario(scenario), seconds), 1)
    problem = flight.problem
    del flight
    gc.collect()
    _give_back()
    before = _resident_mb()
    wall, cpu = time.perf_counter(), time.process_time()
    solution = registry.solve(problem)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    errors = [p.baseline_enu - p.truth_enu for p in solution.pairs if p.truth_enu is not None]
    return {
        "wall_s": wall,
        "cpu_s": cpu,
        "data_mb": before,
        "over_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before,
        "pairs": len(solution.pairs),
        "rms_mm": 1e3 * float(np.sqrt(np.mean(np.sum(np.square(np.concatenate(errors)), axis=1)))),
        "degraded": float(solution.is_degraded),
    }


def _measured(scenario: str, seconds: float) -> dict[str, float]:
    command = [sys.executable, "-m", "tests.benchmarks.bench_long", "--run", scenario, str(seconds)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found: dict[str, float] = json.loads(out.splitlines()[-1])
    print(
        f"{scenario:9s} {seconds:7.0f} s: {found['wall_s']:7.1f} s wall {found['cpu_s']:7.1f} s CPU, "
        f"{found['over_mb']:6.0f} MB over {found['data_mb']:.0f} MB of data and programs; "
        f"{found['pairs']:.0f} pairs, rms {found['rms_mm']:.1f} mm{', DEGRADED' if found['degraded'] else ''}",
        flush=True,
    )
    return found


def main() -> None:
    """Print the figures."""
    if sys.argv[1:2] == ["--run"]:
        print(json.dumps(_run(sys.argv[2], float(sys.argv[3]))))
        return
    long_s = float(sys.argv[1]) if len(sys.argv) > 1 else LONG_S
    short, long = _measured("two-uav", SHORT_S), _measured("two-uav", long_s)
    limit = long_s / SHORT_S
    for what, key in (("wall time", "wall_s"), ("CPU time", "cpu_s"), ("memory over the data", "over_mb")):
        ratio = long[key] / short[key]
        print(f"ratio of {what:21s} {ratio:5.1f}   target {limit:g}: {'met' if ratio <= limit else 'MISSED'}")
    group = _measured("ten-uavs", GROUP_S)
    alone = short["cpu_s"] * GROUP_S / SHORT_S / 2
    print(f"per vehicle {group['cpu_s'] / 10:.1f} s CPU and {group['over_mb'] / 10:.0f} MB; of two {alone:.1f} s")


if __name__ == "__main__":
    main()
