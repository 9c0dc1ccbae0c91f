"""What a solution says of its input: stretches without IMU samples, vehicles whose place on Earth nothing tells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph.assembly.engine import Covariances
from factorgraph.assembly.parameters import Parameter
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.problem import NavigationProblem
from factorgraph.solution import VehicleSolution
from factorgraph.types import Array

DEGRADING_GAP_S = 1.0
LISTED_GAPS = 5
TOLD = 0.5  # posterior to prior standard deviation above which the data hardly tell a direction
NAMED_SHARE = 0.3  # of a direction, for a component to be named
VAGUE_HEADING_RAD = np.deg2rad(10.0)


def gap_remarks(problem: NavigationProblem, vehicles: list[VehicleVariables]) -> tuple[list[str], list[str]]:
    """Notes on the IMU gaps of each vehicle, and warnings of those longer than DEGRADING_GAP_S."""
    notes, warnings = [], []
    for v in vehicles:
        gaps = v.gaps_s[(v.gaps_s[:, 1] > v.t_s[0]) & (v.gaps_s[:, 0] < v.t_s[-1])]
        long = gaps[:, 1] - gaps[:, 0] > DEGRADING_GAP_S
        lost = _not_carried(problem, v)
        if np.any(~long):
            notes.append(f"{v.name}: no IMU samples {_listed(gaps[~long])}; motion in between follows from the other sensors")
        if np.any(long):
            warnings.append(f"{v.name}: no IMU samples {_listed(gaps[long])}; attitude and motion in between are poorly known")
        if lost:
            notes.append(f"{v.name}: {lost} measurements without IMU samples since the last state are left out")
    return notes, warnings


def _listed(gaps: Array) -> str:
    shown = ", ".join(f"from {a:.2f} to {b:.2f} s" for a, b in gaps[:LISTED_GAPS].tolist())
    more = len(gaps) - LISTED_GAPS
    return shown if more <= 0 else f"{shown} and {more} times more ({np.diff(gaps[LISTED_GAPS:]).sum():.1f} s)"


def _not_carried(problem: NavigationProblem, v: VehicleVariables) -> int:
    own = v.vehicle
    times = [*(h.t_s for h in own.heights), *own.motion_times]
    times += [s.t_s for s in problem.visions if v.name in (s.observer.vehicle, s.target.vehicle)]
    for model in problem.ranges:
        mine = np.array([tag.vehicle == v.name for tag in model.stream.tags])
        times.append(model.stream.t_s[mine[model.stream.tag_a] | mine[model.stream.tag_b]])
    t = np.concatenate([np.zeros(0), *times])
    t = t[(t >= v.t_s[0]) & (t <= v.t_s[-1])]
    return int(np.sum(~v.is_carried(t)))


def unplaced_notes(problem: NavigationProblem) -> list[str]:
    """A note for every group of vehicles, tied by links and ranges, none of which has an absolute position."""
    group = {v.name: v.name for v in problem.vehicles}
    placed = {v.name for v in problem.vehicles if v.is_fixed or v.positions or (v.gnss and problem.settings.use_absolute)}
    ties = [(link.reference, link.rover) for link in problem.links]
    ties += [(v.carrier, v.name) for v in problem.vehicles if v.carrier is not None]
    for model in problem.ranges:
        tags = model.stream.tags
        for i, j in np.unique(np.column_stack([model.stream.tag_a, model.stream.tag_b]), axis=0).tolist():
            ends = [name for name in (tags[i].vehicle, tags[j].vehicle) if name is not None]
            if len(ends) == 2:
                ties.append((ends[0], ends[1]))
            else:
                placed.update(ends)
    for a, b in ties:
        group = {name: group[a] if of == group[b] else of for name, of in group.items()}
    notes = []
    for first in dict.fromkeys(group.values()):
        members = [name for name, of in group.items() if of == first]
        if not placed & set(members):
            notes.append(f"{', '.join(members)}: no absolute position is measured; only what is relative can be trusted")
    return notes


def untold_notes(parameters: Sequence[Parameter], cov: Covariances | None) -> list[str]:
    """A note for every direction among the estimated constants that the data do not fix.

    Directions are eigenvectors of the joint posterior covariance over the priors' standard deviations: several constants may
    each look unknown while only their sum is (an axle's misalignment and a heading, say).
    """
    if cov is None or not parameters:
        return []
    sigma = np.concatenate([p.sigma for p in parameters])
    names = [f"{p.name} {c}".strip() for p in parameters for c in p.components]
    P = cov.joint([p.key for p in parameters])
    P = np.where(np.isfinite(P), P, 0.0)  # constants that share no clique are as good as uncorrelated
    values, vectors = np.linalg.eigh(P / np.outer(sigma, sigma))
    notes = []
    for value, v in zip(values, vectors.T, strict=True):
        if value > TOLD**2:
            v = v * np.sign(v[np.argmax(np.abs(v))])
            parts = [f"{x:+.2f} {name}" for x, name in zip(v.tolist(), names, strict=True) if abs(x) > NAMED_SHARE]
            text = parts[0][6:] if len(parts) == 1 else " ".join(parts)
            notes.append(f"the data hardly tell {text}: {np.sqrt(value):.0%} of the prior's uncertainty is left")
    return notes


def heading_notes(vehicles: Sequence[VehicleSolution]) -> list[str]:
    """A note on every vehicle whose heading stays vague throughout."""
    notes = []
    for v in vehicles:
        sigma = np.sqrt(v.P[:, 8, 8])
        if np.any(np.isfinite(sigma)) and np.nanmin(sigma) > VAGUE_HEADING_RAD:
            best = np.rad2deg(np.nanmin(sigma))
            notes.append(f"{v.name}: heading never known better than {best:.0f}°; motion, a second antenna or a hint tell it")
    return notes
