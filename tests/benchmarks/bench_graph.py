"""Times of the factor graph and of least squares: `python -m tests.benchmarks.bench_graph [seconds]`.

A simulated two-UAV flight (IMU 200 Hz each, 15 satellites 1 Hz, UWB 10 Hz, 1200 s unless told otherwise) solved with
float ambiguities, then with robust weights, integers and every pair covariance; the smoothing of a 10 min flight from
files to the report; and, where recording and program are here, the recorded rover against RTKLIB's rnx2rtkp. The same flight by
least squares (set FACTORGRAPH_CODEGEN=1 for compiled models), with what start values, assembly and solution take of it, and the
steps of the moving horizon over its first minutes.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from factorgraph import registry
from factorgraph.assembly.flight import WholeFlight
from factorgraph.least_squares.engine import StageEngine
from factorgraph.least_squares.horizon import HorizonSettings, MovingHorizon
from factorgraph.problem import AmbiguitySettings, NavigationProblem
from factorgraph.solution import Solution
from scenarios.flights import load
from scenarios.report.page import write_report
from scenarios.simulate import load_scenario, simulate
from scenarios.simulate.write import write_flight
from scenarios.studies import replace_duration


def _timed(what: str, work: Callable[[], object], target_s: float | None = None) -> tuple[float, object]:
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    note = f"   target {target_s:g} s: {'met' if wall <= target_s else 'MISSED'}" if target_s is not None else ""
    print(f"{what:58s} {wall:7.2f} s wall {cpu:7.2f} s CPU{note}", flush=True)
    return wall, result


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _float_only(problem: NavigationProblem) -> NavigationProblem:
    return replace(problem, settings=replace(problem.settings, ambiguity=AmbiguitySettings(fix=False), robust={}))


def main() -> None:
    """Print the figures."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 1200.0
    print(f"two UAVs, {seconds:g} s, one thread; compiled kernels warmed up on 30 s first")
    registry.solve(simulate(replace_duration(load_scenario("two-uav"), 30.0), 1).problem)
    flight = simulate(replace_duration(load_scenario("two-uav"), seconds), 1)
    before = _peak_mb()
    scale = seconds / 1200.0
    _timed("graph, robust, integers fixed, every pair covariance", lambda: registry.solve(flight.problem), 12.0 * scale)
    print(f"peak memory over the data: {_peak_mb() - before:.0f} MB (target 200)")
    _, solution = _timed("graph, float ambiguities, with covariances", lambda: registry.solve(_float_only(flight.problem)))
    assert isinstance(solution, Solution)
    solved = sum(s for stage, s in solution.diagnostics.runtime_s.items() if stage != "covariances")
    print(f"  of it until solved {solved:.2f} s   target {6.0 * scale:g} s: {'met' if solved <= 6.0 * scale else 'MISSED'}")
    _least_squares(flight.problem, scale)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_flight(simulate(load_scenario("two-uav"), 1), folder / "flight")

        def smooth() -> None:
            solution = registry.solve(load(folder / "flight").problem)
            write_report(solution, folder / "report.html")

        _timed("smooth a 10 min flight, files to report", smooth, 15.0)
    _against_rtklib()


def _least_squares(problem: NavigationProblem, scale: float) -> None:
    """The whole flight and the moving horizon with CasADi."""
    warm = simulate(replace_duration(load_scenario("two-uav"), 30.0), 1).problem
    registry.solve(warm, "least-squares")
    for what, of in (("robust, integers fixed", problem), ("float ambiguities", _float_only(problem))):
        _, solution = _timed(f"least squares, {what}, with covariances", partial(registry.solve, of, "least-squares"))
        assert isinstance(solution, Solution)
        spent = solution.diagnostics.runtime_s
        print("  of it " + ", ".join(f"{stage} {s:.2f} s" for stage, s in spent.items()))
    iterating, target = spent["float solution"], 2 * scale
    verdict = "met" if iterating <= target else "MISSED"
    print(f"  float solution from its start values {iterating:.2f} s   target {target:g} s: {verdict}")
    built, _, _ = WholeFlight("moving-horizon", StageEngine).started(problem, lambda stage, fraction: None)
    window = MovingHorizon(built.graph, HorizonSettings(), problem.settings.robust, problem.settings.ambiguity)
    steps_ms = 1e3 * np.array([window.step().spent_s for _ in range(min(200, len(window.t_s)))])[30:]
    median = float(np.median(steps_ms))
    most = float(np.quantile(steps_ms, 0.99))
    print(
        f"moving horizon, 20 s: median {median:.1f} ms, p99 {most:.1f} ms   target 10 ms: {'met' if median <= 10 else 'MISSED'}"
    )


def _against_rtklib() -> None:
    data = Path(os.environ.get("RELNAV_DATA", "../shared/data"))
    program = shutil.which("rnx2rtkp")
    if program is None or not (data / "cssrlib_kin_2021_265").exists():
        print("recorded rover against rnx2rtkp: skipped, recording or program missing")
        return
    name = "cssrlib_kin_2021_265"
    ours, _ = _timed("recorded rover, 360 epochs, read and solved", lambda: registry.solve(load(name, data).problem))
    kin = data / "cssrlib_kin_2021_265"
    files = [kin / "SEPT265G.21O", kin / "3034265G.21O", kin / "SEPT2650.21P"]
    command = [program, "-k", str(data / "reference/cssrlib_kin_kinematic_instantaneous.conf"), *map(str, files)]
    theirs, _ = _timed("rnx2rtkp, epoch by epoch", lambda: subprocess.run(command, check=True, capture_output=True))
    print(f"ratio relnav / rnx2rtkp {ours / theirs:.1f} (a smoother over all epochs against an epoch-wise filter)")


if __name__ == "__main__":
    main()
