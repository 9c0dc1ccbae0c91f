"""Times of the filter over whole flights: `OPENBLAS_NUM_THREADS=1 python -m tests.benchmarks.bench_filter_runs [--quick]`.

Two UAVs (states and GNSS 1 Hz, IMUs 200 Hz, ranges 10 Hz) for 1200 s: one run of the filter in passes (`filters.passes`, all
that it does between the assembled problem and the track) and of the smoother, after compilation, beside the filter stage by
stage; then a Monte Carlo with full feedback in two processes, 100 seeds or, with `--quick`, 10 of them and what 100 would take.

Seeds share trajectory, start values and the noise-free simulation; each draws noise of GNSS, ranges and IMUs and preintegrates
anew. That is its preparation; simulation and start values are not counted. Errors at the end over their standard deviations
say that the runs are filters of their data. Times are the processor's, since others may use the machine.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from factorgraph.assembly.blocks import GnssBlock, RangeBlock
from factorgraph.assembly.flight import WholeFlight
from factorgraph.assembly.optimizer import Graph, Values
from factorgraph.filters import passes, recursive
from factorgraph.filters.course import ChainEngine, smooth_values
from factorgraph.types import Array
from scenarios.simulate import SimulatedFlight, load_scenario, simulate
from scenarios.studies import replace_duration

RUN_S, MONTE_CARLO_S, SEEDS = 1.0, 60.0, 100  # targets
PROCESSES = 2


@dataclass(frozen=True, slots=True)
class Prepared:
    """A flight without noise at its start values."""

    flight: SimulatedFlight
    graph: Graph
    values: Values
    z: dict[int, Array]
    imu: list[tuple[Array, Array]]  # angular rate and force of vehicles


def prepare(duration_s: float) -> Prepared:
    scenario = replace_duration(load_scenario("two-uav"), duration_s)
    flight = simulate(scenario.model_copy(update={"scenario": scenario.scenario.model_copy(update={"noise_scale": 0.0})}), 1)
    graph = WholeFlight("", ChainEngine).started(flight.problem, lambda stage, fraction: None)[0].graph
    graph.assemble()
    z = {}
    for i, block in enumerate(graph.blocks):
        if isinstance(block, GnssBlock):
            z[i] = block.z.copy()
        elif isinstance(block, RangeBlock):
            z[i] = block.z_m.copy()
    return Prepared(flight, graph, graph.values(), z, [(v.imu.w_b, v.imu.f_b) for v in graph.vehicles])


def draw(p: Prepared, seed: int) -> None:
    """Start values again, with new noise on all measurements."""
    rng, graph = np.random.default_rng(seed), p.graph
    for v, trajectory, (w, f) in zip(graph.vehicles, p.values.trajectories, p.imu, strict=True):
        v.trajectory = trajectory
        noise, root = v.vehicle.imu_noise, np.sqrt(1 / np.median(np.diff(v.imu.t_s)))
        w = w + root * noise.gyro_rps_rthz * rng.standard_normal(w.shape)
        v._imu = replace(v.imu, w_b=w, f_b=f + root * noise.accel_mps2_rthz * rng.standard_normal(f.shape))
    for gnss, value in zip(graph.gnss, p.values.ambiguities, strict=True):
        gnss.amb_value = value.copy()
    for i, z in p.z.items():
        block = graph.blocks[i]
        noisy = z + block.rows.single_sigma * rng.standard_normal(len(z))
        if isinstance(block, GnssBlock):
            block.z = noisy
        elif isinstance(block, RangeBlock):
            block.z_m = noisy
    graph.preintegrate()


def _seed(seed: int) -> tuple[float, float, Array]:
    """Seconds of preparation and filter, and the last positions' errors between the vehicles in standard deviations."""
    began = time.process_time()
    draw(PREPARED[0], seed)
    ready = time.process_time()
    track = passes.filtered(PREPARED[0].graph)
    done = time.process_time()
    s, truth = track.stages, PREPARED[0].flight.record.trajectories
    a, b = s.vehicles
    apart = [truth[v.name].at(v.t_s[-1:]).r_n[0] - v.r[-1] for v in (a, b)]
    P = track.course[-1].P[: s.n_states, : s.n_states]
    T = np.zeros((3, s.n_states))
    T[:, s.offset[a.index] + 3 : s.offset[a.index] + 6] = -a.R[-1]
    T[:, s.offset[b.index] + 3 : s.offset[b.index] + 6] = b.R[-1]
    return ready - began, done - ready, (apart[1] - apart[0]) / np.sqrt(np.diag(T @ P @ T.T))


PREPARED: list[Prepared] = []  # inherited by forked processes


def _verdict(what: str, seconds: float, target: float) -> None:
    print(f"{what:60s} {seconds:8.2f} s   target {target:.0f} s: {'met' if seconds <= target else 'MISSED'}", flush=True)


def main() -> None:
    """Print the figures."""
    quick = "--quick" in sys.argv[1:]
    PREPARED.append(prepare(1200.0))
    graph, took, behind = PREPARED[0].graph, [], []
    for seed in range(4):
        draw(PREPARED[0], seed)
        began = time.process_time()
        track = passes.filtered(graph)
        took.append(time.process_time() - began)
        began = time.process_time()
        smooth_values(track)
        behind.append(time.process_time() - began)
    s = track.stages
    print(f"{s.K} stages, {s.n_fixed} states and up to {max(map(len, s.live))} ambiguities; first run {took[0]:.1f} s")
    _verdict("filter, best of three", min(took[1:]), RUN_S)
    print(f"{'smoother, best of three':60s} {min(behind[1:]):8.2f} s")
    draw(PREPARED[0], 0)
    began = time.process_time()
    recursive.run(graph, recursive.Filter(), {})
    print(f"{'filter stage by stage':60s} {time.process_time() - began:8.2f} s")

    n = 10 if quick else SEEDS
    began = time.perf_counter()
    with multiprocessing.get_context("fork").Pool(PROCESSES) as pool:
        found = pool.map(_seed, range(n), chunksize=1)
    whole = (time.perf_counter() - began) * SEEDS / n
    preparation, filters = (sum(part) * SEEDS / n / PROCESSES for part in list(zip(*found, strict=True))[:2])
    _verdict(f"{SEEDS} seeds in {PROCESSES} processes, from {n}", preparation + filters, MONTE_CARLO_S)
    print(f"    preparation {preparation:.1f} s, filters {filters:.1f} s; {whole:.1f} s by the clock")
    errors = np.array([each[2] for each in found])
    print(f"    baseline's errors at the end in standard deviations, rms {np.sqrt(np.mean(errors**2)):.2f}")


if __name__ == "__main__":
    main()
