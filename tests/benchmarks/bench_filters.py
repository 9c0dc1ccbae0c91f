"""Times of the recursive filters: `OPENBLAS_NUM_THREADS=1 python -m tests.benchmarks.bench_filters`.

First one filter step (time update, then a Joseph update) of an inertial filter, beside the same formulas in plain NumPy and
beside FilterPy's ExtendedKalmanFilter, all on the same inputs and compared digit by digit. FilterPy is no requirement of
relnav: without it (`pip install filterpy`) its column says so. Then the kernels around a step, and the two-stage filter on
the simulated refuelling flight (1200 s, IMU 200 Hz and GNSS 1 Hz on both vehicles), algorithm by
algorithm, with what many seeds of all data sets would take. The simulation is not counted.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from factorgraph.filters import kalman, two_stage
from factorgraph.filters.discretise import discretise
from factorgraph.filters.inertial import INERTIAL, Navigator, fill_inertial
from factorgraph.filters.tightly_coupled import TightTrack
from factorgraph.filters.two_stage import Shared
from factorgraph.models.strapdown import propagate
from factorgraph.types import Array
from scenarios.published import aar
from scenarios.published.aar import TANKER, UAV, AarData, AarFlight
from scenarios.studies import aar as study

try:
    from filterpy.kalman import ExtendedKalmanFilter  # type: ignore[import-untyped]
except ImportError:
    ExtendedKalmanFilter = None

T = TypeVar("T")
STEP_RATIO, RUN_S = 5.0, 1.5  # targets
SEEDS, DATA_SETS = 50, 4


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a filter with n error states, zero after feedback, and m measurements z (m,)."""

    P: Array
    Phi: Array
    Q: Array
    z: Array
    H: Array
    R: Array


def dynamics() -> tuple[Array, Array]:
    """F (18, 18) of the inertial errors in a manoeuvre and their noise densities (18, 18)."""
    F, w_ie, up = np.zeros((INERTIAL.size, INERTIAL.size)), np.array([0.0, 6.2e-5, 3.8e-5]), np.array([0.0, 0.0, 1.0])
    fill_inertial(F, np.eye(3), np.array([0.3, 1.0, 9.8]), w_ie, np.zeros(3), up, 1.5e-6, 1500.0, 4000.0)
    return F, np.diag(np.repeat([0.0, 1e-6, 1e-11, 0.0, 1e-17, 1e-9], 3))


def inertial_step(n: int, m: int) -> Step:
    """One second of inertial errors, observed by differenced code and Doppler; states beyond n are left out."""
    rng = np.random.default_rng(2024)
    Phi, Q = discretise(*dynamics(), 1.0)
    sigma = np.repeat([2.0, 0.1, 1e-3, 5e-6, 5e-8, 3e-3], 3)
    H = np.zeros((m, INERTIAL.size))
    H[: m // 2, :3], H[m // 2 :, 3:6] = rng.normal(0.0, 1.0, (m // 2, 3)), rng.normal(0.0, 1.0, (m - m // 2, 3))
    R = np.zeros((m, m))
    for rows, s in ((slice(0, m // 2), 0.2), (slice(m // 2, m), 0.01)):
        R[rows, rows] = s**2 * (np.eye(len(range(*rows.indices(m)))) + 1.0)
    z = rng.normal(0.0, 1.0, m) * np.sqrt(np.diag(R))
    first = slice(0, n)
    square = np.ix_(range(n), range(n))
    return Step(np.diag(sigma**2)[square], Phi[square], Q[square], z, np.ascontiguousarray(H[:, first]), R)


def ours(s: Step) -> tuple[Array, Array]:
    """Correction (n,) and covariance (n, n) after the step."""
    dx, P, _, _ = kalman.step(s.P, s.Phi, s.Q, s.z, s.H, s.R)
    return dx, P


def in_numpy(s: Step) -> tuple[Array, Array]:
    """The same in matrix form, as one would write it down."""
    P = s.Phi @ s.P @ s.Phi.T + s.Q
    PH = P @ s.H.T
    K = PH @ np.linalg.inv(s.H @ PH + s.R)
    A = np.eye(len(P)) - K @ s.H
    return K @ s.z, A @ P @ A.T + K @ s.R @ K.T


def with_filterpy(s: Step) -> Callable[[Step], tuple[Array, Array]]:
    """A step of a filter that is there already, as it is in a loop."""
    zero = np.zeros(len(s.P))
    ekf = ExtendedKalmanFilter(len(s.P), len(s.z))
    ekf.F, ekf.Q, ekf.R = s.Phi, s.Q, s.R

    def step(s: Step) -> tuple[Array, Array]:
        ekf.x, ekf.P = zero, s.P
        ekf.predict()
        ekf.update(s.z, lambda _: s.H, lambda x: s.H @ x)
        return ekf.x, ekf.P

    return step


def difference(a: tuple[Array, Array], b: tuple[Array, Array]) -> float:
    """Largest difference of two results in standard deviations, and of covariances in correlations."""
    s = np.sqrt(np.diag(a[1]))
    return float(max(np.abs((a[0] - b[0]) / s).max(), np.abs((a[1] - b[1]) / np.outer(s, s)).max()))


def in_turn(calls: dict[str, Callable[[], object]], rounds: int = 400, each: int = 5) -> dict[str, float]:
    """Median time of a call in us; taken in turn, so that all see the same machine."""
    spent: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            began = time.perf_counter()
            for _ in range(each):
                call()
            spent[name].append((time.perf_counter() - began) / each * 1e6)
    return {name: statistics.median(values[rounds // 10 :]) for name, values in spent.items()}


def steps() -> None:
    print("one step, predict and Joseph update, median us      ours    NumPy  FilterPy   ratio  difference")
    for n, m in ((18, 14), (17, 14), (18, 27)):
        s = inertial_step(n, m)
        ways: dict[str, Callable[[Step], tuple[Array, Array]]] = {"ours": ours, "NumPy": in_numpy}
        if ExtendedKalmanFilter is not None:
            ways["FilterPy"] = with_filterpy(s)
        apart = max(difference(ours(s), way(s)) for way in ways.values())
        us = in_turn({name: partial(way, s) for name, way in ways.items()})
        line = f"{n} states, {m} measurements{'':26s} {us['ours']:8.1f} {us['NumPy']:8.1f}"
        if "FilterPy" in us:
            ratio = us["FilterPy"] / us["ours"]
            line += (
                f"{us['FilterPy']:10.1f} {ratio:7.1f}  {apart:.1e}   target {STEP_RATIO:g} times: {_verdict(ratio >= STEP_RATIO)}"
            )
        else:
            line += f"  not installed  {apart:.1e}"
        print(line)


def kernels(flight: AarFlight) -> None:
    """What surrounds the step: the noise of an interval, and inertial navigation."""
    s = inertial_step(18, 14)
    F, q = dynamics()
    frame, imu, start = flight.problem.frame, flight.problem.vehicle(UAV).imu, flight.start[UAV]
    assert imu is not None
    nav = Navigator(imu, frame, start, aar.imu_model(), float(imu.t_s[0]))
    samples = slice(0, min(2000, len(imu.t_s)))

    def one_second() -> None:
        nav.t_s = float(imu.t_s[0])
        nav.advance(nav.t_s + 1.0)

    us = in_turn(
        {
            "discretise, 18 states, 1 s": lambda: discretise(F, q, 1.0),
            "predict, 18 states": lambda: kalman.predict(s.P, s.Phi, s.Q),
            "sequential update, 14 rows": lambda: kalman.update_sequential(s.P, s.z, s.H, s.R),
            "batch update, 14 rows": lambda: kalman.update(s.P, s.z, s.H, s.R),
            "navigator, 1 s of 200 Hz": one_second,
            "strapdown, 10 s of 200 Hz": lambda: propagate(
                frame, imu.t_s[samples], imu.f_b[samples], imu.w_b[samples], start.r_n, start.v_n, start.C_nb
            ),
        },
        rounds=200,
    )
    print("\nmedian us per call")
    for name, value in us.items():
        note = {"navigator, 1 s of 200 Hz": 200, "strapdown, 10 s of 200 Hz": samples.stop}.get(name)
        print(f"{name:40s} {value:8.1f}{f'   {1e3 * value / note:.0f} ns per sample' if note else ''}")


def cpu(work: Callable[[], T], repeats: int = 3) -> tuple[float, T]:
    """Shortest CPU time of a few runs [s] and the result."""
    best, result = np.inf, None
    for _ in range(repeats):
        began = time.process_time()
        result = work()
        best = min(best, time.process_time() - began)
    assert result is not None
    return best, result


def _share(flight: AarFlight, case: AarData, tanker: TightTrack | None = None) -> Shared:
    return two_stage.share(case.problem, flight.start, dict.fromkeys((TANKER, UAV), aar.imu_model()), tanker)


def algorithms(flight: AarFlight) -> None:
    """One run of every algorithm from the measurements to the baseline, and its parts."""
    case = aar.data_set(flight, 4)
    for algorithm in ("1b", "2b", "5b"):  # compiles
        two_stage.run(_share(flight, case), study.SCHEMES[algorithm[0]], study.settings("dd", algorithm), n_epochs=5)
    whole, shared = cpu(partial(_share, flight, case))
    again, _ = cpu(partial(_share, flight, case, shared.reference))
    print(f"\n{shared.data.n_epochs} epochs, CPU s of one thread: shared {again:.2f}, tanker's filter {whole - again:.2f}")
    print("algorithm   subfilter alone      run   with shared and tanker")
    total = 0.0
    for algorithm in study.FILTERS:
        scheme, settings = study.SCHEMES[algorithm[0]], study.settings("dd", algorithm)
        if scheme in study.UNAIDED:
            alone, floats = cpu(partial(two_stage.float_solutions, shared, scheme, settings.floats))
        else:
            alone, floats = 0.0, None
        main, _ = cpu(partial(two_stage.run, shared, scheme, settings, None, floats))
        spent = whole + alone + main
        total += main + (alone if algorithm.endswith("a") else 0.0)  # the subfilter of a and b is the same
        print(
            f"{algorithm} {scheme.value:8s} {f'{alone:15.2f}' if alone else ' ' * 15} {main:8.2f} {spent:12.2f}"
            f"   target {RUN_S:g} s: {_verdict(spent <= RUN_S)}"
        )
    hours = SEEDS * (whole - again + DATA_SETS * (again + total)) / 3600
    print(
        f"{SEEDS} seeds, {DATA_SETS} data sets, {len(study.FILTERS)} algorithms: {hours:.2f} CPU h of one thread, not simulated"
    )


def _verdict(good: bool) -> str:
    return "met" if good else "MISSED"


def main() -> None:
    """Print the figures."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        print("OPENBLAS_NUM_THREADS is not 1: matrices of this size are then slower and times scatter")
    steps()
    flight = aar.simulate_flight(1)
    kernels(flight)
    algorithms(flight)


if __name__ == "__main__":
    main()
