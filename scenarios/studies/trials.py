"""Studies over many seeds: how an estimator's errors compare with its own covariance and with the bound.

A trial is one simulated flight, solved and compared with its truth; trials run in worker processes and give the same
numbers on any worker. Consistency is judged across trials at one epoch, since epochs of one run are correlated.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from factorgraph import registry
from factorgraph.consistency import nees
from factorgraph.solution import Fix, Solution
from factorgraph.types import Array, IntArray
from scenarios.simulate import Scenario, SimulatedFlight, load_scenario, simulate


@dataclass(frozen=True, slots=True)
class Trial:
    """One seed of a two-vehicle flight, on the grid of its solution."""

    seed: int
    t_s: Array  # (K,)
    error_enu: Array  # (K, 3) baseline, estimate minus truth
    nees: Array  # (K,) of the baseline
    bound_m2: Array  # (K,) trace of the posterior Cramer-Rao bound of the baseline, integers known
    fix: IntArray  # (K,) values of Fix
    wrong_epochs: int  # epochs whose integers in use contain a wrong one
    status: str
    runtime_s: float


@dataclass(frozen=True, slots=True)
class Trials:
    """Trials of one scenario and method."""

    scenario: str
    method: str
    trials: tuple[Trial, ...]

    @property
    def rmse_over_bound(self) -> float:
        """Root mean square baseline error over the root mean bound, all fixed epochs of all trials."""
        error = sum(float(np.sum(t.error_enu[t.fix == Fix.FIXED.value] ** 2)) for t in self.trials)
        bound = sum(float(np.sum(t.bound_m2[t.fix == Fix.FIXED.value])) for t in self.trials)
        return float(np.sqrt(error / bound))

    @property
    def fixed_share(self) -> float:
        return float(np.mean([np.mean(t.fix == Fix.FIXED.value) for t in self.trials]))

    @property
    def wrong_share(self) -> float:
        """Epochs with a wrong integer among fixed epochs."""
        fixed = sum(int(np.sum(t.fix == Fix.FIXED.value)) for t in self.trials)
        return sum(t.wrong_epochs for t in self.trials) / max(fixed, 1)

    def nees_at(self, fractions: Sequence[float]) -> Array:
        """Sum over trials of the baseline's NEES at epochs given as fractions of the flight; 3 degrees of freedom a trial."""
        k = [int(f * (len(self.trials[0].t_s) - 1)) for f in fractions]
        return np.asarray(np.sum([t.nees[k] for t in self.trials], axis=0))


def run(
    scenario: str,
    seeds: Sequence[int],
    method: str = "graph",
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
    duration_s: float | None = None,
) -> Trials:
    """Simulate and solve one flight per seed. `duration_s` shortens the scenario; `progress` hears of finished trials."""
    one = partial(trial, scenario, method, duration_s)
    done: list[Trial] = []
    if workers == 1:
        for seed in seeds:
            done.append(one(seed))
            if progress is not None:
                progress(len(done))
        return Trials(scenario, method, tuple(done))
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for result in pool.map(one, seeds):
            done.append(result)
            if progress is not None:
                progress(len(done))
    return Trials(scenario, method, tuple(done))


def trial(scenario: str, method: str, duration_s: float | None, seed: int) -> Trial:
    """One seed: simulate, solve, compare with the truth and the bound."""
    from factorgraph.bound import posterior_bound  # brings in CasADi, which a light import must not

    description = load_scenario(scenario)
    if duration_s is not None:
        description = replace_duration(description, duration_s)
    flight = simulate(description, seed)
    solution = registry.solve(flight.problem, method)
    pair = solution.pairs[0]
    assert pair.truth_enu is not None
    error = pair.baseline_enu - pair.truth_enu
    bounds = posterior_bound(flight.problem).pairs
    bound = bounds[(pair.reference, pair.rover)]
    return Trial(
        seed=seed,
        t_s=pair.t_s,
        error_enu=error,
        nees=nees(error, pair.P[:, :3, :3]),
        bound_m2=np.trace(bound[:, :3, :3], axis1=1, axis2=2),
        fix=pair.fix,
        wrong_epochs=len(wrong_times(flight, solution)),
        status=solution.diagnostics.status.value,
        runtime_s=sum(solution.diagnostics.runtime_s.values()),
    )


def replace_duration(description: Scenario, duration_s: float) -> Scenario:
    """The same scenario, shorter or longer."""
    return description.model_copy(update={"scenario": description.scenario.model_copy(update={"duration_s": duration_s})})


def wrong_times(flight: SimulatedFlight, solution: Solution) -> set[int]:
    """Times [s] of the first pair's epochs at which some integer in use differs from the simulated one.

    Integers are determined up to one common shift per signal, so each epoch's deviations of a signal must all be equal.
    """
    pair = solution.pairs[0]
    table = solution.ambiguities
    number = {}
    for name in (pair.reference, pair.rover):
        antenna = flight.problem.vehicle(name).gnss
        assert antenna is not None
        s = antenna.stream
        integer = flight.record.gnss[name].integer
        number[name] = {
            (s.satellites[a], s.signals[g], round(float(s.t_s[e]))): int(n)
            for a, g, e, n in zip(s.sat, s.signal, s.epoch, integer, strict=True)
        }
    wrong = set()
    epochs = np.round(pair.t_s).astype(int)
    for signal in set(table.signal):
        mine = [i for i, s in enumerate(table.signal) if s == signal and table.state[i] in ("fixed", "datum")]
        ref_signal, rover_signal = signal.split("/")
        for t in epochs:
            deviations = set()
            for i in mine:
                key_a, key_b = (table.satellite[i], ref_signal, int(t)), (table.satellite[i], rover_signal, int(t))
                inside = table.t_start_s[i] - 0.5 <= t <= table.t_end_s[i] + 0.5
                if inside and key_a in number[pair.reference] and key_b in number[pair.rover]:
                    true = number[pair.rover][key_b] - number[pair.reference][key_a]
                    deviations.add(int(table.integer[i]) + _taken_off(solution, i, t) - true)
            if len(deviations) > 1:
                wrong.add(int(t))
    return wrong


def _taken_off(solution: Solution, arc: int, t_s: float) -> int:
    """Cycles of the slips repaired in an arc up to a time."""
    table, slips = solution.ambiguities, solution.slips
    where = (table.link[arc], table.satellite[arc], table.signal[arc])
    mine = [slip == where for slip in zip(slips.link, slips.satellite, slips.signal, strict=True)]
    before = slips.repaired & (slips.t_s > table.t_start_s[arc]) & (slips.t_s < t_s + 0.5)
    return round(float(np.sum(slips.cycles[before & np.array(mine, bool)])))
