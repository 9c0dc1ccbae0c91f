"""Cycle slips: found, sized and repaired from how phases change against a predicted trajectory.

Single differences rover - reference of phase less their prediction, y = z - h(x), change between two epochs by

    dy_i = g_i . d + c + lambda_i b_i + noise,    g_i = d h_i / d r

with d the error of the predicted displacement, c the change of the difference of the two receiver clocks, common to all
constellations and carriers, and b_i the slip in cycles. Each epoch's d and c are fitted to the phases that agree; d has a
prior whose width is the robust spread of d itself over the flight, millimetres where an IMU predicts. Phases that disagree
by more than noise allows have slipped, one by one (detection, identification, adaptation); what the rest predict gives b_i
and its standard deviation, also over gaps, where the fits in between add up, and at the ends of arcs that other detectors
set. A slip is repaired where rounding to half cycles succeeds with the probability asked for and gives whole cycles, or
half ones where the receiver had announced them; every other slip ends the arc: phases that step by some half a cycle
unannounced may have lost half a cycle or have been disturbed.

Source: Teunissen (1990), Quality control in integrated navigation systems (DIA); Teunissen (1998) for the success rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.special import ndtr

from factorgraph.models.differencing import CommonGroups
from factorgraph.types import Array, BoolArray, IntArray

DETECT_SIGMA = 5.0
STANDS_OUT_SIGMA = 8.0  # a slip this large is detected with a probability of 0.999
DETECT_CYC = 0.35  # what is no slip of half a cycle is left to robust weights
AGREE_SIGMA = 3.0  # of an estimated slip against the half cycle it is taken for
PRIOR_MPS = 1.0  # displacement per second a start trajectory may be wrong by
PRIOR_FLOOR_M = 0.005
PRIOR_KNEE = 5.0  # standard deviations of it from which on a prediction gives way to phases that refuse it
PRIOR_SPREADS = 3.0  # robust spreads of the fitted displacements that the prior allows
CLOCK_M = 1e3  # prior of the clock, the median of its epoch taken out: only keeps an epoch without phases solvable
MIN_AGREEING = 4  # phases
ROUNDS = 12


@dataclass(frozen=True, slots=True)
class Phases:
    """Phase residuals of a link in order of time."""

    epoch: IntArray  # (n,) consecutive numbers of the epochs
    t_s: Array  # (n,)
    series: IntArray  # (n,) satellite and signal
    arc: IntArray  # (n,)
    residual_m: Array  # (n,) measured - predicted, ambiguity not taken off, slips that are repaired are
    jump_cyc: Array  # (n,) those slips so far within the row's arc
    gradient: Array  # (n, 3) of the prediction by the rover's position
    sigma_m: Array  # (n,)
    wavelength_m: Array  # (n,)
    half: BoolArray  # (n,) flagged as ambiguous by half a cycle


@dataclass(frozen=True, slots=True)
class Steps:
    """Between every two neighbouring phases of a series: what changed beyond prediction."""

    before: IntArray  # (b,) rows
    after: IntArray
    cut: BoolArray  # (b,) the arcs differed already
    slipped: BoolArray  # (b,) the change is no noise
    cycles: Array  # (b,) estimated slip, NaN where nothing predicts it
    sigma_cyc: Array  # (b,)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Displacement and clock of every epoch against the one before."""

    x: Array  # (g, 4)
    Q: Array  # (g, 4, 4)
    keep: BoolArray  # (n,) rows that agree
    residual: Array  # (n,)
    variance: Array  # (n,) of the residuals


def find_steps(p: Phases) -> Steps:
    """Slips between neighbouring phases of each series, by what the other phases of the epoch say."""
    before, after = _neighbours(p)
    cut = p.arc[before] != p.arc[after]
    n_epochs = int(p.epoch.max()) + 1 if len(p.epoch) else 0
    direct = np.flatnonzero(p.epoch[after] - p.epoch[before] == 1)
    direct = direct[np.argsort(p.epoch[after[direct]], kind="stable")]
    dy = p.residual_m[after] - p.residual_m[before]
    sigma = np.hypot(p.sigma_m[after], p.sigma_m[before])
    design = np.column_stack([p.gradient[after], np.ones(len(after))])
    lam = p.wavelength_m[after]
    slipped = np.zeros(len(after), bool)
    x, Q = np.full((n_epochs, 4), np.nan), np.full((n_epochs, 4, 4), np.nan)
    scale = 1.0
    if len(direct):
        epoch = p.epoch[after[direct]]
        groups = CommonGroups.from_labels(epoch)
        dt = (p.t_s[after] - p.t_s[before])[direct[groups.start]]
        base = groups.median(dy[direct], ~cut[direct])
        fit, scale = _adapted(
            design[direct], dy[direct] - base[groups.of_row], sigma[direct], lam[direct], ~cut[direct], groups, dt
        )
        agreeing = groups.sum(fit.keep.astype(float))
        refused = ~fit.keep & ~cut[direct]
        suspect = _suspects(design[direct], scale * sigma[direct], lam[direct], fit, refused, groups)
        # where most phases disagree, none is to be trusted
        doubtful = agreeing <= groups.sum(refused.astype(float))
        slipped[direct] = refused | suspect | (~cut[direct] & doubtful[groups.of_row])
        good = (agreeing >= MIN_AGREEING) & ~doubtful & (groups.sum(suspect.astype(float)) == 0)
        ids = epoch[groups.start][good]
        x[ids], Q[ids] = fit.x[good] + np.outer(base[good], [0, 0, 0, 1]), fit.Q[good]
    change, variance = _predicted(design, x, Q, p.epoch[before], p.epoch[after])
    cycles = (dy - change) / lam
    sigma_cyc = np.sqrt((scale * sigma) ** 2 + variance) / lam
    return Steps(before, after, cut, slipped, cycles, sigma_cyc)


def _neighbours(p: Phases) -> tuple[IntArray, IntArray]:
    order = np.lexsort((p.epoch, p.series))
    same = p.series[order[1:]] == p.series[order[:-1]]
    return order[:-1][same], order[1:][same]


def _adapted(a: Array, y: Array, sigma: Array, lam: Array, use: BoolArray, groups: CommonGroups, dt: Array) -> tuple[_Fit, float]:
    """The fit with the flight's own spread of displacements and noise, and the factor on the noise."""
    fit = _fit(a, y, sigma, lam, use, groups, np.repeat(PRIOR_MPS * dt[:, None], 3, axis=1))
    enough = groups.sum(fit.keep.astype(float)) >= MIN_AGREEING
    if enough.sum() < 10:
        return fit, 1.0
    spread = 1.4826 * np.median(np.abs(fit.x[enough, :3]) / dt[enough, None], axis=0)
    prior = np.maximum(PRIOR_SPREADS * spread * dt[:, None], PRIOR_FLOOR_M)
    t = fit.residual[fit.keep] / np.sqrt(fit.variance[fit.keep])
    scale = max(1.4826 * float(np.median(np.abs(t))), 0.5)
    return _fit(a, y, scale * sigma, lam, use, groups, prior), scale


def _fit(a: Array, y: Array, sigma: Array, lam: Array, use: BoolArray, groups: CommonGroups, prior: Array) -> _Fit:
    """Every epoch's displacement and clock from the rows that agree with each other.

    Least absolute deviations tell which do to begin with; then the worst row of an epoch is taken out and rows that agree
    after all are put back, until nothing changes.
    """
    precision = np.zeros((len(prior), 4))
    precision[:, :3], precision[:, 3] = 1 / prior**2, 1 / CLOCK_M**2
    x = np.zeros((len(prior), 4))
    r = y.copy()
    for _ in range(10):
        w = use / sigma**2 * np.minimum(1.0, 1.5 * sigma / np.maximum(np.abs(r), 1e-9))
        soft = np.minimum(1.0, PRIOR_KNEE / np.maximum(np.abs(x) * np.sqrt(precision), 1e-9))
        x, _ = _solve(a, y, w, groups, precision * soft)
        r = _left(a, y, x, groups.of_row)
    var = sigma**2
    keep = use & ~_disagrees(r, r, var, lam)
    Q = np.zeros((len(prior), 4, 4))
    for _ in range(ROUNDS):
        soft = np.minimum(1.0, PRIOR_KNEE / np.maximum(np.abs(x) * np.sqrt(precision), 1e-9))
        x, Q = _solve(a, y, keep / sigma**2, groups, precision * soft)
        r = _left(a, y, x, groups.of_row)
        spread = _spread(a, Q, groups.of_row)
        var = np.maximum(sigma**2 + np.where(keep, -spread, spread), 1e-3 * sigma**2)
        # a slip shows in the residual of a row in use only as far as the others control it
        bad = _disagrees(r, np.where(keep, r * sigma**2 / var, r), var, lam)
        worst = _worst(np.where(keep & bad, np.abs(r) / np.sqrt(var), 0.0), groups)
        back = use & ~keep & ~bad
        if not np.any(worst | back):
            break
        keep = (keep & ~worst) | back
    return _Fit(x, Q, keep & ~bad, r, var)


def _disagrees(r: Array, slip_m: Array, variance: Array, lam: Array) -> BoolArray:
    return np.asarray((np.abs(r) > DETECT_SIGMA * np.sqrt(variance)) & (np.abs(slip_m) > DETECT_CYC * lam))


def _suspects(a: Array, sigma: Array, lam: Array, fit: _Fit, refused: BoolArray, groups: CommonGroups) -> BoolArray:
    """Rows that agree (n,), but might have slipped instead of a refused one without it being seen.

    A slip of row j, of a cycle or of what makes row i stand off as far as it does, moves row i by its share h_ij in the fit;
    j is suspect where that slip would not stand out against noise by itself.
    """
    size = np.diff(np.append(groups.start, len(a)))
    rows = np.flatnonzero(refused)
    g = groups.of_row[rows]
    i = np.repeat(rows, size[g])
    j = np.repeat(groups.start[g], size[g]) + np.arange(len(i)) - np.repeat(np.cumsum(size[g]) - size[g], size[g])
    i, j = i[fit.keep[j]], j[fit.keep[j]]
    share = np.abs(np.einsum("ni,nij,nj->n", a[i], fit.Q[groups.of_row[i]], a[j])) / sigma[j] ** 2
    slip_m = np.maximum(lam[j], np.abs(fit.residual[i]) / np.maximum(share, 1e-9))
    hidden = slip_m * np.sqrt(fit.variance[j]) / sigma[j] ** 2 < STANDS_OUT_SIGMA
    out = np.zeros(len(a), bool)
    out[j[hidden]] = True
    return out


def _worst(size: Array, groups: CommonGroups) -> BoolArray:
    """The row of the largest positive size of each group."""
    largest = np.maximum.reduceat(size, groups.start)
    return np.asarray((size > 0) & (size == largest[groups.of_row]))


def _solve(a: Array, y: Array, w: Array, groups: CommonGroups, precision: Array) -> tuple[Array, Array]:
    """Weighted least squares of each group's four unknowns with a diagonal prior, and their covariances."""
    N, b = _normals(a, y, w, groups.of_row, len(groups.start))
    N[:, np.arange(4), np.arange(4)] += precision
    Q = np.asarray(np.linalg.inv(N), np.float64)
    return np.einsum("gij,gj->gi", Q, b), Q


@njit(cache=True)
def _normals(a, y, w, of_row, n_groups):  # type: ignore[no-untyped-def]
    """Sums of w a a^T (g, 4, 4) and w y a (g, 4)."""
    N, b = np.zeros((n_groups, 4, 4)), np.zeros((n_groups, 4))
    for i in range(len(y)):
        g = of_row[i]
        for p in range(4):
            wa = w[i] * a[i, p]
            b[g, p] += wa * y[i]
            for q in range(4):
                N[g, p, q] += wa * a[i, q]
    return N, b


@njit(cache=True)
def _left(a, y, x, of_row):  # type: ignore[no-untyped-def]
    """y - a x (n,) with each row's own group's x (g, 4)."""
    r = np.empty(len(y))
    for i in range(len(y)):
        g = of_row[i]
        r[i] = y[i] - (a[i, 0] * x[g, 0] + a[i, 1] * x[g, 1] + a[i, 2] * x[g, 2] + a[i, 3] * x[g, 3])
    return r


@njit(cache=True)
def _spread(a, Q, of_row):  # type: ignore[no-untyped-def]
    """a Q a^T (n,) with each row's own group's Q (g, 4, 4)."""
    out = np.zeros(len(a))
    for i in range(len(a)):
        g = of_row[i]
        for p in range(4):
            for q in range(4):
                out[i] += a[i, p] * Q[g, p, q] * a[i, q]
    return out


def _predicted(design: Array, x: Array, Q: Array, before: IntArray, after: IntArray) -> tuple[Array, Array]:
    """Change and its variance (b,) between epochs, the fits in between added up; NaN where one of them is missing."""
    total = np.vstack([np.zeros((1, 4)), np.cumsum(np.nan_to_num(x), axis=0)])
    summed = np.concatenate([np.zeros((1, 4, 4)), np.cumsum(np.nan_to_num(Q), axis=0)])
    missing = np.concatenate([[0], np.cumsum(np.isnan(x[:, 0]))])
    dx, dQ = total[after + 1] - total[before + 1], summed[after + 1] - summed[before + 1]
    known = missing[after + 1] == missing[before + 1]
    change = np.where(known, np.einsum("ni,ni->n", design, dx), np.nan)
    return change, _spread(design, dQ, np.arange(len(design)))


@dataclass(frozen=True, slots=True)
class Repaired:
    """Arcs after slips ended or continued them."""

    arc: IntArray  # (n,)
    jump_cyc: Array  # (n,) slips so far within the row's arc, relative to the arc's ambiguity
    joined: IntArray  # rows at which an arc goes on over a slip or an end
    cycles: Array  # (joined,) the slips there
    sigma_cyc: Array  # (joined,)


def repair(p: Phases, steps: Steps, min_success: float, max_gap_s: float) -> Repaired:
    """Arcs from their neighbours' steps: continued where a slip is known for certain, ended where it is not.

    min_success: probability that rounding a slip to half cycles is right; 1 repairs nothing.
    """
    halves = np.rint(2 * np.nan_to_num(steps.cycles))
    with np.errstate(invalid="ignore"):
        success = 2 * ndtr(0.25 / steps.sigma_cyc) - 1
        off = np.abs(steps.cycles - 0.5 * halves)
        sure = (success >= min_success) & (off <= AGREE_SIGMA * steps.sigma_cyc) & (min_success < 1)
        sure &= (halves % 2 == 0) | p.half[steps.before] | p.half[steps.after]
        sure &= p.t_s[steps.after] - p.t_s[steps.before] <= max_gap_s
    open_ = steps.cut | steps.slipped
    joins = open_ & sure
    ends = open_ & ~sure
    order = np.lexsort((p.epoch, p.series))
    step_of = np.full(len(p.epoch), -1)
    step_of[steps.after] = np.arange(len(steps.after))
    step = step_of[order]
    begins = (step < 0) | (ends[step] & (step >= 0))
    arc = np.empty(len(order), np.int64)
    arc[order] = np.cumsum(begins) - 1
    jump = np.zeros(len(order))
    running = np.cumsum(np.where((step >= 0) & joins[step], halves[step], 0.0))
    first = np.flatnonzero(begins)
    jump[order] = running - running[first][arc[order]]
    return Repaired(
        arc=arc,
        jump_cyc=p.jump_cyc + 0.5 * jump,
        joined=steps.after[joins],
        cycles=0.5 * halves[joins],
        sigma_cyc=steps.sigma_cyc[joins],
    )


def whole_cycles(arc: IntArray, jump_cyc: Array, flagged: BoolArray, odd: BoolArray) -> tuple[Array, BoolArray]:
    """Jumps (n,) counted from an arc's first unflagged phase, and arcs (arcs,) whose ambiguity may be a multiple of half a cycle.

    These are arcs without an unflagged phase, with unflagged phases half a cycle apart, and those known to be so (`odd`).
    """
    n = int(arc.max()) + 1 if len(arc) else 0
    _, first = np.unique(2 * arc + flagged, return_index=True)
    base = np.zeros(n)
    base[arc[first[::-1]]] = jump_cyc[first[::-1]]  # of an arc with both kinds, the unflagged one is written last
    jump_cyc = jump_cyc - base[arc]
    unflagged = np.bincount(arc, ~flagged, minlength=n)
    apart = np.bincount(arc, ~flagged & (np.rint(2 * jump_cyc) % 2 == 1), minlength=n)
    return jump_cyc, (unflagged == 0) | (apart > 0) | (np.bincount(arc, odd, minlength=n) > 0)
