"""Filters that are compared on the flight of `ahrs_tdo`: those of the publication, its controls, and one change at a time.

A filter is a relative filter (`flight.Configuration`) with or without a correction of its updates (`swarm.corrector`), on a
scene. The correction nearest to the publication is "ahrs-tdo-o1": the literal rule, the sum of weighted sizes searched by TDO,
velocity and position decided, the filter's covariance kept. Constant velocity and acceleration were tuned on the first half of
the flight with seeds TUNING_SEEDS (`relnav study ahrs-tdo` repeats it) and are kept; the better of them stands for CA/CV.

Scenes: as published; accelerometers a hundred times better; one range in OUTLIER_EVERY longer by OUTLIER_M, of which no filter
is told; every vehicle's own attitude filter on IMU and magnetometer in place of an attitude system of given errors; the vehicles'
own filters with code alone and their accelerometer errors taken off, as printed.

Source: Lu et al. (2024); spec ahrs_tdo.md, sections 2.5, 2.6 and 2.8.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from factorgraph.filters.relative.filtering import Correct, Update
from factorgraph.filters.relative.flight import Configuration, Formation, prepare
from factorgraph.filters.relative.method import HONEST
from factorgraph.filters.relative.own import OwnSettings, own_motions
from factorgraph.filters.relative.rows import KINDS, RANGE
from factorgraph.models.receivers import receivers
from factorgraph.problem import NavigationProblem
from factorgraph.types import Array
from scenarios.corrected import RelativeCorrection, relative_snapshot
from scenarios.published import ahrs_tdo
from scenarios.simulate.streams import Streams
from swarm import gauss_newton
from swarm.corrector import GAUSS_NEWTON, Corrector, CorrectorSettings, Optimiser, posed
from swarm.judgement import Rule, trigger_rates
from swarm.objective import Which
from swarm.result import SwarmResult
from swarm.snapshot import Snapshot

Scene = Literal["published", "0.1mg", "outliers", "own-attitude", "own-code", "own-code-0.1mg"]
TUNING_SEEDS = (1001, 1002, 1003, 1004, 1005)
WALKS = {"velocity": 0.2, "acceleration": 0.1}  # m/s per sqrt(s), m/s^2 per sqrt(s); see above
CA_CV = "ca"  # the better of both
EVALUATIONS, MEMBERS = 36_000, 30  # of a correction: those of TDO with 800 iterations
OUTLIER_M, OUTLIER_EVERY = 3.0, 20
RULE_TRIALS = 5000
UWB_M, JUMP_MPS, PUSH_MPS2 = 3.0, 1.0, 2.0  # mismatches that rules are asked to see
TUNED: dict[str, object] = {
    "walk of CV [m/s per sqrt(s)]": WALKS["velocity"],
    "walk of CA [m/s^2 per sqrt(s)]": WALKS["acceleration"],
    "CA/CV": CA_CV,
    "evaluations of a correction": EVALUATIONS,
    "members of a population": MEMBERS,
    "range outliers [m]": OUTLIER_M,
}


@dataclass(frozen=True, slots=True)
class Correction:
    """What judges an update, and what replaces it."""

    settings: CorrectorSettings
    method: str = "tdo"


@dataclass(frozen=True, slots=True)
class Filter:
    """One of the filters that are compared."""

    title: str
    configuration: Configuration = field(default_factory=Configuration)
    correction: Correction | None = None
    scene: Scene = "published"


def _correction(which: Which, method: str = "tdo", **settings: object) -> Correction:
    """Of the literal rule and the filter's covariance, changed by `settings`."""
    plain = CorrectorSettings(rule=Rule("literal"), objective=which, covariance="kept")
    return Correction(replace(plain, **settings), method)  # type: ignore[arg-type]  # each of its own type


def _without(*kinds: str) -> Configuration:
    return Configuration(kinds=tuple(kind for kind in KINDS if kind not in kinds))


SCALE = 1.0 + ahrs_tdo.ASSUMED.crystal
CA = Configuration("acceleration", WALKS["acceleration"])
NIS_O3 = _correction("O3", rule=Rule("nis"))
FILTERS = {
    "cv": Filter("CV: constant velocity", Configuration("velocity", WALKS["velocity"])),
    "ca": Filter("CA: constant acceleration", CA),
    "ahrs": Filter("AHRS"),
    "ahrs-tdo-o1": Filter("AHRS+TDO, O1", correction=_correction("O1")),
    "ahrs-tdo-o2": Filter("AHRS+TDO, O2", correction=_correction("O2")),
    "ahrs-tdo-o3": Filter("AHRS+TDO, O3", correction=_correction("O3")),
    "ahrs-nis-o3": Filter("AHRS, NIS rule, TDO, O3", correction=NIS_O3),
    "ahrs-pso": Filter("AHRS+PSO, O2", correction=_correction("O2", "pso")),
    "ahrs-ga": Filter("AHRS+GA, O2", correction=_correction("O2", "ga")),
    "ahrs-gauss-newton": Filter("AHRS+Gauss-Newton, O2", correction=_correction("O2", GAUSS_NEWTON)),
    "ahrs-stf": Filter("AHRS, strong tracking", Configuration(strong_tracking=True)),
    "o1-joseph": Filter("AHRS+TDO, O1, joseph", correction=_correction("O1", covariance="joseph")),
    "o2-joseph": Filter("AHRS+TDO, O2, joseph", correction=_correction("O2", covariance="joseph")),
    "o1-residual": Filter("AHRS+TDO, O1, rule of the residual", correction=_correction("O1", rule=Rule("literal", "residual"))),
    "o1-raw": Filter("AHRS+TDO, O1, raw coordinates", correction=_correction("O1", coordinates="raw")),
    "no-abs": Filter("AHRS without absolute differences", _without("position", "velocity")),
    "abs-1": Filter("AHRS, absolute differences as independent", Configuration(absolute_factor=1.0)),
    "no-uwb": Filter("AHRS without UWB", _without("range")),
    "scale-known": Filter("AHRS, UWB scale known", Configuration(range_scale=SCALE)),
    "no-abs-scale-known": Filter(
        "AHRS without absolute differences, UWB scale known", replace(_without("position", "velocity"), range_scale=SCALE)
    ),
    "coloured": Filter("AHRS, attitude errors as states", Configuration(coloured=True)),
    "all-told": Filter(
        "AHRS, attitude errors as states, UWB scale known, without absolute differences",
        replace(_without("position", "velocity"), range_scale=SCALE, coloured=True),
    ),
    "relative": Filter("relative, as `relnav smooth --method relative`: as before, UWB scale estimated", HONEST),
    "no-abs-tdo-o1": Filter("AHRS+TDO, O1, without absolute differences", _without("position", "velocity"), _correction("O1")),
    "no-doppler": Filter("AHRS without Doppler", _without("doppler")),
    "ca-0.1mg": Filter("0.1 mg: CA", CA, scene="0.1mg"),
    "ahrs-0.1mg": Filter("0.1 mg: AHRS", scene="0.1mg"),
    "ahrs-tdo-o1-0.1mg": Filter("0.1 mg: AHRS+TDO, O1", correction=_correction("O1"), scene="0.1mg"),
    "ahrs-outliers": Filter("outliers: AHRS", scene="outliers"),
    "ahrs-tdo-o1-outliers": Filter("outliers: AHRS+TDO, O1", correction=_correction("O1"), scene="outliers"),
    "ahrs-nis-o3-outliers": Filter("outliers: AHRS, NIS rule, TDO, O3", correction=NIS_O3, scene="outliers"),
    "ahrs-own-attitude": Filter("own attitude filters: AHRS", scene="own-attitude"),
    "ahrs-tdo-o1-own-attitude": Filter("own attitude filters: AHRS+TDO, O1", correction=_correction("O1"), scene="own-attitude"),
    "ca-own-code": Filter("own filters of code: CA", CA, scene="own-code"),
    "ahrs-own-code": Filter("own filters of code: AHRS", scene="own-code"),
    "ahrs-tdo-o1-own-code": Filter("own filters of code: AHRS+TDO, O1", correction=_correction("O1"), scene="own-code"),
    "ca-own-code-0.1mg": Filter("own filters of code, 0.1 mg: CA", CA, scene="own-code-0.1mg"),
    "ahrs-own-code-0.1mg": Filter("own filters of code, 0.1 mg: AHRS", scene="own-code-0.1mg"),
    "ahrs-tdo-o1-own-code-0.1mg": Filter(
        "own filters of code, 0.1 mg: AHRS+TDO, O1", correction=_correction("O1"), scene="own-code-0.1mg"
    ),
}


def told(one: Filter) -> str:
    """All settings of a filter in words."""
    return repr(one)


def problem(scene: Scene, seed: int) -> NavigationProblem:
    """The flight of a scene."""
    accel: ahrs_tdo.Accel = "0.1mg" if scene.endswith("0.1mg") else "0.01g"
    flight = ahrs_tdo.simulate_flight(seed, accel, magnetometers=scene == "own-attitude").problem
    if scene == "own-attitude":
        return replace(flight, vehicles=tuple(replace(v, attitudes=()) for v in flight.vehicles))
    if scene != "outliers":
        return flight
    rng = Streams(seed)("range outliers")
    ranges = []
    for model in flight.ranges:
        hit = rng.random(len(model.stream.range_m)) < 1.0 / OUTLIER_EVERY
        ranges.append(replace(model, stream=replace(model.stream, range_m=model.stream.range_m + OUTLIER_M * hit)))
    return replace(flight, ranges=tuple(ranges))


def formation(scene: Scene, seed: int) -> Formation:
    """The flight of a scene with what each vehicle tells of itself, ready for relative filters."""
    flight = problem(scene, seed)
    rx = receivers(flight)
    settings = OwnSettings(use_doppler=False, calibrate=True) if scene.startswith("own-code") else OwnSettings()
    return prepare(flight, own_motions(flight, rx, settings), rx)


def corrector(one: Filter, rng: np.random.Generator) -> Correct | None:
    """The correction of a filter's updates, all draws from one generator; None without one."""
    if one.correction is None:
        return None
    return RelativeCorrection(Corrector(one.correction.settings, Optimiser(one.correction.method, EVALUATIONS, MEMBERS)), rng)


def searched(
    snapshot: Snapshot, settings: CorrectorSettings, methods: Sequence[str], seed: int, evaluations: int = EVALUATIONS
) -> tuple[float, dict[str, SwarmResult]]:
    """Gauss-Newton's minimum of an objective, and what every method makes of it."""
    within, cost = posed(settings, snapshot)
    runs = {
        m: Optimiser(m, evaluations, MEMBERS)(cost, within, np.random.default_rng([seed, zlib.crc32(m.encode())]))
        for m in methods
    }
    return gauss_newton.minimize(cost, within.bounds, within.start).cost, runs


def rates(update: Update, rng: np.random.Generator) -> Mapping[str, Mapping[str, float]]:
    """How often each rule triggers at an update, without and with what it should see (spec ahrs_tdo.md, check 8)."""
    u = relative_snapshot(update)
    kind = update.rows.kind
    zero, uwb = np.zeros(u.m), np.where(kind == RANGE, UWB_M, 0.0)
    jump, push = np.zeros(u.n), np.zeros(u.n)  # of the state against the prediction
    jump[0] = JUMP_MPS
    push[0], push[3] = PUSH_MPS2, 0.5 * PUSH_MPS2  # for a second
    mismatches: dict[str, Array] = {
        "none": zero,
        f"UWB {UWB_M:g} m": uwb,
        f"velocity {JUMP_MPS:g} m/s": u.H @ jump,
        f"acceleration {PUSH_MPS2:g} m/s² for 1 s": u.H @ push,
    }
    asked = {
        "literal": Rule("literal"),
        "literal, residual": Rule("literal", "residual"),
        "normalised": Rule("normalised"),
        "nis": Rule("nis"),
    }
    return trigger_rates(asked, mismatches, u.H, u.P_prior, u.R, rng, RULE_TRIALS)
