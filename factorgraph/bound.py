"""The posterior Cramer-Rao bound of a problem: the covariance at the truth.

For a Gaussian problem the information of the measurements and priors, linearised at the true trajectory, bounds the
covariance of any estimator. With `integers_known` the ambiguities are constants, which is the bound of a correctly fixed
solution. Of an estimator that sees no future only the last state is bounded this way: a filter or a window may lie far above it
anywhere else, and that is no fault of theirs. Source: Van Trees and Bell (2007), sec. 1.3; Tichavsky et al. (1998).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.assembly import phases
from factorgraph.assembly.build import build
from factorgraph.assembly.pairs import pair_covariance, pair_ends
from factorgraph.assembly.result import state_covariances
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.grid import common_grid
from factorgraph.least_squares.engine import StageEngine
from factorgraph.models.receivers import receivers
from factorgraph.problem import NavigationProblem
from factorgraph.sampling import interpolate
from factorgraph.types import Array


@dataclass(frozen=True, slots=True)
class Bound:
    """Smallest covariances that an unbiased estimator of the whole flight can have."""

    t_s: Array  # (K,) state times
    pairs: dict[tuple[str, str], Array]  # (K, 6, 6) relative position and velocity, east-north-up at the reference
    vehicles: dict[str, Array]  # (K, 15, 15) of moving vehicles, in the order of `solution.VehicleSolution.P`


def posterior_bound(problem: NavigationProblem, integers_known: bool = True) -> Bound:
    """Bound of every moving vehicle and of every wanted pair at the state times.

    Raises InputError where the truth (position, velocity, attitude) of a moving vehicle is missing or the problem is singular.
    """
    grid = common_grid(problem)
    vehicles = [VehicleVariables(i, v, grid, problem.frame) for i, v in enumerate(problem.bodies)]
    for v in vehicles:
        if v.mode == "fixed":
            continue
        truth = v.vehicle.truth
        if truth is None or truth.v_n is None or (v.mode == "imu" and truth.q_nb is None):
            raise InputError(f"the bound needs the true position, velocity and attitude of {v.name}")
        v.r, v.v = interpolate(grid, truth.t_s, truth.r_n), interpolate(grid, truth.t_s, truth.v_n)
        if truth.q_nb is not None:
            after = np.clip(np.searchsorted(truth.t_s, grid), 1, max(len(truth.t_s) - 1, 1))
            near = np.where(
                grid - truth.t_s[after - 1] < truth.t_s[np.minimum(after, len(truth.t_s) - 1)] - grid, after - 1, after
            )
            v.R = matrix_from_quat(truth.q_nb[np.minimum(near, len(truth.t_s) - 1)])
    built = build(problem, vehicles, receivers(problem), use_phase=True, engine=StageEngine())
    for data in built.links:
        phases.prepare(data, problem.settings.ambiguity)
        if integers_known:
            data.block.amb_key[:] = 0
            data.block.renew()
    built.graph.assemble()
    built.graph.predict()
    eliminated = built.graph.eliminate(joints=True)
    if eliminated is None:
        raise InputError(f"the problem is singular at the truth: {'; '.join(built.graph.engine.remarks(built.graph))}")
    cov = eliminated.covariances()
    return Bound(
        grid,
        {(p.reference, p.rover): pair_covariance(problem, pair_ends(problem, vehicles, p), cov) for p in problem.wanted_pairs},
        {v.name: state_covariances(v, cov) for v in vehicles if v.mode != "fixed"},
    )
