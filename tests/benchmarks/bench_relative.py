"""Times of the relative filter: `OPENBLAS_NUM_THREADS=1 python -m tests.benchmarks.bench_relative`.

First every configuration on the 600 s flight of two UAVs with IMUs and attitudes at 100 Hz, one process: preparing the vehicles
(own filters), the measurements, the filter itself. Then formations of up to ten UAVs with ranges between all pairs or in a ring:
time against number, and the error of all pairs. The simulation is not counted.
"""

from __future__ import annotations

import time
from itertools import combinations
from typing import Literal

import numpy as np

from factorgraph.filters.relative.filtering import RelativeTrack
from factorgraph.filters.relative.flight import Configuration, Formation, prepare, truth_of
from factorgraph.filters.relative.own import own_motions
from factorgraph.models.receivers import receivers
from scenarios.published import ahrs_tdo

RUN_S = 4.0  # target for 600 s at 100 Hz
SETTLED_S = 60.0
CONFIGURATIONS = {
    "attitude-referenced": Configuration(),
    "without absolute differences": Configuration(kinds=("code", "doppler", "range")),
    "constant velocity": Configuration(motion="velocity", walk=0.5),
    "constant acceleration": Configuration(motion="acceleration", walk=0.3),
    "strong tracking": Configuration(strong_tracking=True),
}


def prepared(n: int, ranges: Literal["all", "ring"], seed: int = 1) -> tuple[Formation, float, float]:
    """A flight of n vehicles; CPU seconds for the vehicles and for the measurements."""
    problem = ahrs_tdo.simulate_flight(seed, n=n, ranges=ranges).problem
    start = time.process_time()
    rx = receivers(problem)
    motions = own_motions(problem, rx)
    middle = time.process_time()
    return prepare(problem, motions, rx), middle - start, time.process_time() - middle


def timed(formation: Formation, configuration: Configuration) -> tuple[RelativeTrack, float]:
    """A run and its CPU seconds."""
    start = time.process_time()
    track = formation.run(configuration)
    return track, time.process_time() - start


def pair_errors(formation: Formation, track: RelativeTrack) -> list[float]:
    """RMS of the position error of every pair [m], once the filter has settled."""
    out = []
    for a, b in combinations(range(len(formation.names)), 2):
        true = truth_of(formation, formation.names[a], formation.names[b])
        assert true is not None
        e = (track.pair(a, b)[0] - true[0])[formation.t_s >= SETTLED_S]
        out.append(float(np.sqrt(np.nanmean(np.sum(e**2, axis=1)))))
    return out


def main() -> None:
    formation, _, _ = prepared(2, "all")
    for configuration in CONFIGURATIONS.values():
        formation.run(configuration)  # compiles
    formation, vehicles_s, measurements_s = prepared(2, "all")
    print(f"two UAVs, 600 s, 100 Hz: vehicles {vehicles_s:.2f} s, measurements and increments {measurements_s:.2f} s CPU")
    for name, configuration in CONFIGURATIONS.items():
        spent = min(timed(formation, configuration)[1] for _ in range(3))
        total = vehicles_s + measurements_s + spent
        print(f"  {name:32s} filter {spent:5.2f} s, everything {total:5.2f} s of {RUN_S:g} s")
    print(f"{'formations':12s} {'vehicles':>9s} {'prepare s':>10s} {'filter s':>9s} {'RMS of all pairs m':>20s}")
    for ranges in ("all", "ring"):
        for n in (2, 4, 6, 8, 10):
            formation, vehicles_s, measurements_s = prepared(n, ranges)
            track, spent = timed(formation, CONFIGURATIONS["without absolute differences"])
            error = float(np.mean(pair_errors(formation, track)))
            print(f"{ranges:12s} {n:9d} {vehicles_s + measurements_s:10.2f} {spent:9.2f} {error:20.3f}")


if __name__ == "__main__":
    main()
