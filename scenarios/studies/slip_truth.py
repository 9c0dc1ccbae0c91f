"""What became of simulated slips, from the record of the simulation."""

from __future__ import annotations

from collections import Counter

import numpy as np

from factorgraph.solution import Solution
from factorgraph.types import Array
from scenarios.simulate import SimulatedFlight

NEAR_S = 0.02  # epochs of both receivers


def true_cycles(flight: SimulatedFlight, link: str, satellite: str, signal: str) -> tuple[Array, Array]:
    """Times and single-difference ambiguity, rover - reference [cyc], of all epochs that both observe."""
    both = []
    for name, own in zip(link.split("-"), signal.split("/"), strict=True):
        antenna = flight.problem.vehicle(name).gnss
        assert antenna is not None
        s, record = antenna.stream, flight.record.gnss[name]
        mine = np.flatnonzero((s.sat == s.satellites.index(satellite)) & (s.signal == s.signals.index(own)))
        both.append(dict(zip(np.round(s.t_s[s.epoch[mine]], 3).tolist(), record.cycles[mine].tolist(), strict=True)))
    t = sorted(both[0].keys() & both[1].keys())
    return np.array(t), np.array([both[1][x] - both[0][x] for x in t])


def used_times(solution: Solution, link: str, satellite: str, signal: str) -> set[float]:
    """Times of the phases in use, rounded to 0.1 s: those of short arcs are not."""
    r = solution.residuals
    source = f"{link} {signal}"
    if source not in r.source or satellite not in r.label:
        return set()
    mine = (r.kind_index == r.kind.index("phase")) & (r.source_index == r.source.index(source))
    return set(np.round(r.t_s[mine & (r.label_index == r.label.index(satellite))], 1).tolist())


def judge(flight: SimulatedFlight, solution: Solution) -> Counter[str]:
    """Slips between phases of one arc: "repaired", "wrongly repaired", "missed"; otherwise "ended", "unused"; "invented"."""
    arcs, slips = solution.ambiguities, solution.slips
    count: Counter[str] = Counter()
    names = list(zip(arcs.link, arcs.satellite, arcs.signal, strict=True))
    for link, satellite, signal in sorted(set(names)):
        t, cycles = true_cycles(flight, link, satellite, signal)
        own = [i for i, name in enumerate(names) if name == (link, satellite, signal)]
        arc = np.full(len(t), -1)
        for i in own:
            arc[(t > arcs.t_start_s[i] - NEAR_S) & (t < arcs.t_end_s[i] + NEAR_S)] = i
        used = used_times(solution, link, satellite, signal)
        arc[[round(x, 1) not in used for x in t.tolist()]] = -1
        taken = {
            round(slips.t_s[i], 1): float(slips.cycles[i])
            for i in range(len(slips.t_s))
            if (slips.link[i], slips.satellite[i], slips.signal[i]) == (link, satellite, signal) and slips.repaired[i]
        }
        before = -1  # last epoch of an arc
        for k in range(len(t)):
            slipped = k > 0 and cycles[k] != cycles[k - 1]
            if arc[k] < 0:
                count["unused"] += slipped
                continue
            if before >= 0 and arc[before] == arc[k]:
                jump, taken_off = cycles[k] - cycles[before], taken.pop(round(t[k], 1), 0.0)
                if jump or taken_off:
                    what = "repaired" if jump == taken_off else "missed" if not taken_off else "wrongly repaired"
                    count[what if jump else "invented"] += 1
            elif slipped:
                count["ended"] += 1
            before = k
    return count
