"""The posterior Cramer-Rao bound of a problem: the covariance at the truth.

For a Gaussian problem the information of the measurements and priors, linearised at the true trajectory, bounds the
covariance of any estimator. With `integers_known` the ambiguities are constants, which is the bound of a correctly fixed
solution. Source: Van Trees and Bell (2007), sec. 1.3; Tichavsky et al. (1998).
"""

from __future__ import annotations

import numpy as np

from factorgraph.assembly import phases
from factorgraph.assembly.build import build
from factorgraph.assembly.pairs import pair_covariance, pair_ends
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import matrix_from_quat
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.grid import common_grid
from factorgraph.models.receivers import receivers
from factorgraph.problem import NavigationProblem
from factorgraph.sampling import interpolate
from factorgraph.types import Array


def posterior_bound(problem: NavigationProblem, integers_known: bool = True) -> tuple[Array, dict[tuple[str, str], Array]]:
    """Bound of every wanted pair's relative position and velocity at the state times.

    Needs the truth (position, velocity, attitude) of every moving vehicle, else ValueError. Returns the times (K,) and, per
    pair (reference, rover), the bound (K, 6, 6) resolved east-north-up at the reference.
    """
    grid = common_grid(problem)
    vehicles = [VehicleVariables(i, v, grid, problem.frame) for i, v in enumerate(problem.bodies)]
    for v in vehicles:
        if v.mode == "fixed":
            continue
        truth = v.vehicle.truth
        if truth is None or truth.v_n is None or (v.mode == "imu" and truth.q_nb is None):
            raise ValueError(f"the bound needs the true position, velocity and attitude of {v.name}")
        v.r, v.v = interpolate(grid, truth.t_s, truth.r_n), interpolate(grid, truth.t_s, truth.v_n)
        if truth.q_nb is not None:
            near = np.clip(np.searchsorted(truth.t_s, grid - 1e-6), 0, len(truth.t_s) - 1)
            v.R = matrix_from_quat(truth.q_nb[near])
    built = build(problem, vehicles, receivers(problem), use_phase=True, engine=GtsamEngine())
    for data in built.links:
        phases.prepare(data, problem.settings.ambiguity)
        if integers_known:
            data.block.amb_key[:] = 0
            data.block.renew()
    built.graph.assemble()
    built.graph.predict()
    eliminated = built.graph.eliminate(joints=True)
    if eliminated is None:
        raise ValueError("the problem is singular at the truth")
    cov = eliminated.covariances()
    return grid, {
        (p.reference, p.rover): pair_covariance(problem, pair_ends(problem, vehicles, p), cov) for p in problem.wanted_pairs
    }
