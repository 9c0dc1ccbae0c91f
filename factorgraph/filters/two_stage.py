"""Two-stage relative navigation of a rover against a moving reference: integers first, then tightly coupled inertial.

    rover's IMU -> strapdown -> predicted baseline -> subfilter: float ambiguities, integers (`float_ambiguity`)
                       ^                                 |
                       +---- 18-state main filter <- DD code, phase less its ambiguities, Doppler

The reference sends its observations and the position and velocity of its own filter (`tightly_coupled`); what the two
have in common, the reference's own error, drops out of differences.

    z = [DD P; DD Phi - lam N; -lam DD D] - predicted,   H = -A_a on dr (P, Phi) and on dv (D)       (delta = estimate - truth)

The main filter is a standard one (SKF) or an adaptive one (AKF), whose predicted covariance is divided by
alpha = min(1, k0 / statistic of the innovation). While ambiguities are float, their phases are left out ("omitted"), enter
with the ambiguities' covariance ("inflated") or as if these were known ("known"). An aided subfilter has used the predicted
baseline, so the last two count it twice: the filter then confirms its own error. The final baseline is the least-squares
one from the phases less the integers where those passed the ratio test, and the subfilter's own else.

Source: spec aar_two_stage.md (Wu et al. 2022), sections 1, 2.2 and 2.6, errata E3, E4, E7 and E8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numba import njit

import ambiguity
from factorgraph.attitude import skew
from factorgraph.errors import InputError, positive
from factorgraph.filters import adaptive, kalman, tightly_coupled
from factorgraph.filters.adaptive import Statistic
from factorgraph.filters.float_ambiguity import (
    FloatFilter,
    FloatSettings,
    FloatSolution,
    InsBaseline,
    Scheme,
    single_epoch,
)
from factorgraph.filters.inertial import ATT, INERTIAL, NAVIGATION, POS, SENSORS, VEL, ImuModel, InertialStart, Navigator
from factorgraph.filters.tightly_coupled import TightSettings, TightTrack
from factorgraph.models import double_differences as dd
from factorgraph.models.double_differences import PairEpochs, pair_epochs
from factorgraph.models.receivers import receivers
from factorgraph.models.robust import bifactor
from factorgraph.problem import NavigationProblem
from factorgraph.types import Array, BoolArray, IntArray

MOVING = slice(POS.start, VEL.stop)
_SIZE, _R, _V, _A = INERTIAL.size, POS.start, VEL.start, ATT.start  # for kernels


@dataclass(frozen=True, slots=True)
class TwoStageSettings:
    """Everything that is tuned. Source: spec aar_two_stage.md, sections 2 and 3."""

    floats: FloatSettings
    doppler_mps: float
    ratio_threshold: float = 3.0
    is_adaptive: bool = True  # AKF, else SKF
    k0: float = 1.5
    statistic: Statistic = "literal"
    float_phase: Literal["inflated", "known", "omitted"] = "omitted"
    robust_main: bool = True  # codes have the weights of the subfilter (1 unless its scheme is robust) here, too
    reference_jumps: bool = False  # count the corrections of the reference's filter as noise of the relative state

    def __post_init__(self) -> None:
        positive(self, "doppler_mps", "k0")
        if not self.ratio_threshold >= 1:
            raise InputError(f"TwoStageSettings.ratio_threshold must be at least 1, got {self.ratio_threshold}")


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A fault of the predicted velocity, to study what it does: added to the subfilter's or the navigator's."""

    velocity_mps: Array  # (K, 3)
    target: Literal["subfilter", "ins"] = "subfilter"

    def of(self, target: str, k: int) -> Array | None:
        """What is added to the velocity of a target (3,) at epoch k."""
        return self.velocity_mps[k] if target == self.target else None


@dataclass(frozen=True, slots=True)
class Shared:
    """What all algorithms have in common: differences, the reference's own solution, the rover's IMU and start."""

    problem: NavigationProblem
    data: PairEpochs
    reference: TightTrack  # at the epochs of `data`
    lever_rover: Array  # (3,)
    rover: str
    start: InertialStart
    model: ImuModel


@dataclass(frozen=True, slots=True)
class Resolved:
    """Integers of one epoch and what speaks for them."""

    order: IntArray  # (m + 1,) satellites, the pivot first
    integers: IntArray  # (m,) nearest
    ratio: float
    adop_cyc: float
    success_rate: float  # bootstrapped
    proven: bool


@dataclass(frozen=True, slots=True)
class TwoStageRun:
    """What one algorithm made of a flight; baselines are rover - reference in n, NaN where there is none."""

    t_s: Array  # (K,)
    baseline_n: Array  # (K, 3) between the antennas, from phases
    baseline_P: Array  # (K, 3, 3)
    velocity_n: Array  # (K, 3) of the rover's filter minus the reference's
    main_baseline_n: Array  # (K, 3) of the body origins, the rover's filter minus the reference's
    main_P: Array  # (K, 9, 9) position, velocity, attitude of the rover
    C_nb: Array  # (K, 3, 3)
    fixed: BoolArray  # (K,) the ratio test passed
    ratio: Array
    adop_cyc: Array
    success_rate: Array
    ins_sigma_m: Array  # (K,) of the predicted baseline
    alpha: Array  # (K,)
    nis: Array  # (K,) divided by its degrees of freedom
    resolved: list[Resolved | None] = field(default_factory=list)
    floats: list[FloatSolution | None] = field(default_factory=list)


def share(
    problem: NavigationProblem,
    start: dict[str, InertialStart],
    models: dict[str, ImuModel],
    reference: TightTrack | None = None,
    tight: TightSettings | None = None,
) -> Shared:
    """Prepare a problem with one link between two vehicles that carry an IMU.

    start, models: by vehicle name. reference: the reference's solution where another data set has it already. Raises
    InputError for any other problem and for what the receivers lack.
    """
    if len(problem.links) != 1:
        raise InputError(f"{problem.name}: the two-stage filter needs exactly one link, there are {len(problem.links)}")
    link = problem.links[0]
    for name in (link.reference, link.rover):
        if problem.vehicle(name).imu is None:
            raise InputError(f"vehicle {name}: the two-stage filter needs an IMU on both vehicles")
        if name not in start or name not in models:
            raise InputError(f"vehicle {name}: the two-stage filter needs its start and its IMU's error model")
    rx = receivers(problem)
    ref, rov = rx[link.reference], rx[link.rover]
    data = pair_epochs(ref, rov, problem.settings)
    if reference is None:
        reference = tightly_coupled.run(ref, problem.frame, start[link.reference], models[link.reference], tight)
    rows = np.clip(np.searchsorted(reference.t_s, data.t_reference_s - 1e-6), 0, len(reference.t_s) - 1)
    if np.any(np.abs(reference.t_s[rows] - data.t_reference_s) > 1e-6):
        raise InputError(f"vehicle {link.reference}: its solution does not cover the epochs it shares with {link.rover}")
    at = TightTrack(*(np.asarray(getattr(reference, name))[rows] for name in TightTrack.__slots__))
    return Shared(problem, data, at, np.asarray(rov.antenna.lever_b, float), link.rover, start[link.rover], models[link.rover])


def resolve(solution: FloatSolution) -> Resolved:
    """The nearest integers of a float solution, their ratio, ADOP and bootstrapped success rate."""
    ils = ambiguity.integer_least_squares(solution.a_cyc, solution.Q_a, 2)
    ratio = ambiguity.ratio_test(ils.norms, 1.0).ratio
    rate = ambiguity.success_rate(solution.Q_a)
    return Resolved(solution.order, ils.candidates[0], ratio, ambiguity.adop(solution.Q_a), rate, ils.proven)


def float_solutions(
    shared: Shared,
    scheme: Scheme,
    settings: FloatSettings,
    disturbance: Disturbance | None = None,
    ins: Sequence[InsBaseline] | None = None,
    n_epochs: int | None = None,
) -> tuple[list[FloatSolution | None], list[Resolved | None]]:
    """The subfilter alone, over all epochs or the first `n_epochs`.

    WLS and EKF are the same for every main filter. Aided schemes need the INS baselines of all epochs, for instance
    imposed ones.
    """
    if scheme.has_ins and ins is None:
        raise ValueError(f"{scheme.value} depends on the main filter: give it INS baselines")
    data, out = shared.data, []
    subfilter = None if scheme is Scheme.WLS else FloatFilter(scheme, settings)
    b = np.zeros(3)
    for k in range(n_epochs or data.n_epochs):
        r_a = shared.reference.antenna_n[k]
        if subfilter is None:
            solution = single_epoch(data, k, r_a, settings, b)
        else:
            fault = None if disturbance is None else disturbance.of("subfilter", k)
            solution = subfilter.step(data, k, r_a, None if ins is None else ins[k], fault)
        b = b if solution is None else solution.b_n
        out.append(solution)
    return out, [None if s is None else resolve(s) for s in out]


def run(
    shared: Shared,
    scheme: Scheme,
    settings: TwoStageSettings,
    disturbance: Disturbance | None = None,
    floats: tuple[list[FloatSolution | None], list[Resolved | None]] | None = None,
    n_epochs: int | None = None,
) -> TwoStageRun:
    """One algorithm over the flight, or its first epochs. floats: what `float_solutions` gave, for schemes without INS."""
    data = shared.data
    imu = shared.problem.vehicle(shared.rover).imu
    assert imu is not None
    if floats is None and not scheme.has_ins:
        floats = float_solutions(shared, scheme, settings.floats, disturbance, n_epochs=n_epochs)
    subfilter = FloatFilter(scheme, settings.floats) if floats is None else None
    nav = Navigator(imu, shared.problem.frame, shared.start, shared.model, float(data.t_rover_s[0]))
    P = np.zeros((INERTIAL.size, INERTIAL.size))
    P[NAVIGATION, NAVIGATION], P[SENSORS, SENSORS] = shared.start.P, shared.model.P
    q = shared.model.density
    out = _empty_run(data)
    for k in range(n_epochs or data.n_epochs):
        t = float(data.t_rover_s[k])
        if t > nav.t_s:
            dt = t - nav.t_s
            f_n, middle = nav.advance(t)
            P = kalman.predict(P, *nav.transition(f_n, middle, q, dt))
            if settings.reference_jumps:
                P[MOVING, MOVING] += shared.reference.jump[k]
        fault, push = (None, None) if disturbance is None else (disturbance.of("subfilter", k), disturbance.of("ins", k))
        if push is not None:
            nav.v = nav.v + push
        r_a = shared.reference.antenna_n[k]
        place, _ = nav.point(shared.lever_rover)
        R_ins = _antenna_covariance(P, place - nav.r)
        out.ins_sigma_m[k] = np.sqrt(np.trace(R_ins))
        if floats is not None:
            solution, found = floats[0][k], floats[1][k]
        else:
            assert subfilter is not None
            solution = subfilter.step(data, k, r_a, InsBaseline(place - r_a, R_ins), fault)
            found = None if solution is None else resolve(solution)
        if solution is not None and found is not None:
            fixed = found.ratio >= settings.ratio_threshold and found.proven
            P = _main_update(shared, k, solution, found, fixed, nav, P, r_a, settings, out)
            _final_baseline(shared, k, solution, found, fixed, r_a, settings, out)
            out.fixed[k], out.ratio[k] = fixed, found.ratio
            out.adop_cyc[k], out.success_rate[k] = found.adop_cyc, found.success_rate
        moved = shared.reference.v_n[k] * (t - data.t_reference_s[k])  # the receivers' clocks are not one
        out.baseline_n[k] -= moved
        out.velocity_n[k] = nav.v - shared.reference.v_n[k]
        out.main_baseline_n[k] = nav.r - shared.reference.r_n[k] - moved
        out.main_P[k], out.C_nb[k] = P[NAVIGATION, NAVIGATION], nav.C
        out.resolved.append(found)
        out.floats.append(solution)
    return out


def _antenna_covariance(P: Array, arm: Array) -> Array:
    """Covariance (3, 3) of the antenna's position, from that of position and attitude; arm (3,) in n."""
    J = np.hstack([np.eye(3), skew(arm)])
    states = np.r_[POS, ATT]
    return np.asarray(J @ P[np.ix_(states, states)] @ J.T)


def _main_update(
    shared: Shared,
    k: int,
    solution: FloatSolution,
    found: Resolved,
    fixed: bool,
    nav: Navigator,
    P: Array,
    r_a: Array,
    settings: TwoStageSettings,
    out: TwoStageRun,
) -> Array:
    """Correct the navigator with code, phase and Doppler of an epoch; returns the covariance (18, 18)."""
    data, order, lam = shared.data, solution.order, shared.data.wavelength_m
    place, speed = nav.point(shared.lever_rover)
    predicted = dd.predict(
        data.sat_reference[k], data.sat_rover[k], data.vel_reference[k], data.vel_rover[k], order,
        r_a, shared.reference.antenna_v_n[k], place, speed,
    )  # fmt: skip
    N = found.integers.astype(float) if fixed else solution.a_cyc
    observed = (data.code_m[k], data.phase_m[k], data.rate_mps[k])
    sigmas = (settings.floats.code_m, settings.floats.phase_m, settings.doppler_mps)
    nu, H, R = _main_rows(order, observed, data.variance_scale[k], sigmas, predicted, lam * N, place - nav.r)
    m = len(N)
    if settings.robust_main and solution.weights.min() < 1.0:
        R[:m, :m] = bifactor(R[:m, :m], solution.weights)
    if not fixed and settings.float_phase == "inflated":
        R[m : 2 * m, m : 2 * m] += lam**2 * solution.Q_a
    if not fixed and settings.float_phase == "omitted":
        used = np.r_[:m, 2 * m : 3 * m]
        nu, H, R = nu[used], H[used], R[np.ix_(used, used)]
    alpha = 1.0
    if settings.is_adaptive:
        S = kalman.innovation_covariance(P, H, R)
        alpha = adaptive.factor(adaptive.innovation_statistic(nu, S, settings.statistic), settings.k0)
    dx, P, nis = kalman.update_sequential(P / alpha, nu, H, R)
    nav.correct(dx)
    out.alpha[k], out.nis[k] = alpha, nis / len(nu)
    return P


@njit(cache=True)
def _main_rows(
    order: IntArray,
    observed: tuple[Array, Array, Array],
    scale: Array,
    sigmas: tuple[float, float, float],
    predicted: tuple[Array, Array, Array],
    ambiguity_m: Array,
    arm: Array,
) -> tuple[Array, Array, Array]:
    """Innovations (3m,), their geometry (3m, 18) and covariance (3m, 3m): code, phase, Doppler. Source: erratum E3."""
    rho, rate, G = predicted
    m = len(rho)
    nu, H, R = np.empty(3 * m), np.zeros((3 * m, _SIZE)), np.zeros((3 * m, 3 * m))
    nu[:m] = dd.difference(observed[0], order) - rho
    nu[m : 2 * m] = dd.difference(observed[1], order) - ambiguity_m - rho
    nu[2 * m :] = dd.difference(observed[2], order) - rate
    H[:m, _R : _R + 3] = H[m : 2 * m, _R : _R + 3] = H[2 * m :, _V : _V + 3] = -G
    for i in range(m):
        turned = -np.cross(G[i], arm)
        H[i, _A : _A + 3] = turned
        H[m + i, _A : _A + 3] = turned
    for j in range(3):
        R[j * m : (j + 1) * m, j * m : (j + 1) * m] = dd.covariance(sigmas[j] ** 2 * scale, order)
    return nu, H, R


def _final_baseline(
    shared: Shared,
    k: int,
    solution: FloatSolution,
    found: Resolved,
    fixed: bool,
    r_a: Array,
    settings: TwoStageSettings,
    out: TwoStageRun,
) -> None:
    if not fixed:
        out.baseline_n[k], out.baseline_P[k] = solution.b_n, solution.Q_b
        return
    data, order, lam = shared.data, solution.order, shared.data.wavelength_m
    phase = dd.difference(data.phase_m[k], order)
    R = dd.covariance(settings.floats.phase_m**2 * data.variance_scale[k], order)
    out.baseline_n[k], out.baseline_P[k] = dd.baseline_from_phase(
        phase - lam * found.integers, R, data.sat_reference[k], data.sat_rover[k], order, r_a, solution.b_n
    )


def _empty_run(data: PairEpochs) -> TwoStageRun:
    K = data.n_epochs

    def nan(*shape: int) -> Array:
        return np.full((K, *shape), np.nan)

    return TwoStageRun(
        data.t_rover_s, nan(3), nan(3, 3), nan(3), nan(3), nan(9, 9), nan(3, 3), np.zeros(K, bool),
        nan(), nan(), nan(), nan(), nan(), nan(),
    )  # fmt: skip
