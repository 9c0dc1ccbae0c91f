"""The study `ahrs-tdo`: what it says of made-up numbers, its jobs, and its command on a short flight."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorgraph import registry
from factorgraph.problem import NavigationProblem
from factorgraph.solution import Solution
from factorgraph.types import Array
from scenarios import cli
from scenarios.published import ahrs_tdo as scene
from scenarios.published import ahrs_tdo_filters
from scenarios.published.ahrs_tdo_filters import CA_CV, EVALUATIONS, FILTERS
from scenarios.simulate.scenario import load_scenario
from scenarios.simulate.trajectory import Manoeuvres, Segment
from scenarios.studies import ahrs_tdo
from scenarios.studies.ahrs_tdo import BOUND, GRID, OTHERS, RULES, SEARCHES, TUNING
from scenarios.studies.ahrs_tdo_claims import AIM, PAPER_POSITION, PAPER_VELOCITY, claims
from scenarios.studies.ahrs_tdo_record import markdown, tables
from scenarios.studies.ahrs_tdo_summary import (
    BOUND_SET,
    OBJECTIVES,
    PLAIN,
    PUBLISHED,
    SETTLED_S,
    Search,
    Summary,
    manoeuvring,
    measure,
    pairs,
    summarise,
)
from scenarios.studies.study import Job
from scenarios.studies.verdicts import Claim, Verdict

T = np.arange(601.0)
SEEDS = (1, 2, 3, 4, 5, 6)
LASTS = 24.0  # s, of flights that are simulated


def flown(name: str, position: Array, velocity: Array, seed: int) -> dict[str, Any]:
    """A trial whose errors have the wanted RMSE per axis, from a covariance that says so."""
    rng = np.random.default_rng(seed)
    unit = rng.standard_normal((len(T), 6))
    counted = unit[T >= SETTLED_S]
    unit /= np.sqrt(np.mean(counted**2, axis=0))
    sigma = np.concatenate([position, velocity])
    return {
        f"{name}/position_error_m": unit[:, :3] * position,
        f"{name}/velocity_error_mps": unit[:, 3:] * velocity,
        f"{name}/sigma": np.tile(sigma, (len(T), 1)),
        f"{name}/nees": np.sum(unit**2, axis=1),
        f"{name}/nis": rng.chisquare(21, len(T)),
        f"{name}/n_rows": np.full(len(T), 21),
        f"{name}/triggered": (np.arange(len(T)) % 5 == 0) & (name in FILTERS and FILTERS[name].correction is not None),
        f"{name}/runtime_s": np.array(0.5),
    }


def results(spread: float, **wanted: tuple[Array, Array]) -> dict[Job, Mapping[str, Any]]:
    """Jobs of all SEEDS with the wanted RMSE, which vary by `spread` from seed to seed, alike for all filters."""
    found: dict[Job, Mapping[str, Any]] = {}
    for i, seed in enumerate(SEEDS):
        factor = 1.0 + spread * (i - 0.5 * (len(SEEDS) - 1))
        arrays: dict[str, Any] = {"t_s": T}
        for j, (name, (r, v)) in enumerate(wanted.items()):
            arrays |= flown(name.replace("_", "-"), factor * r, factor * v, 100 * j + seed)
        found[Job(f"published-{seed:04d}", {"part": "published", "seed": seed})] = arrays
    return found


def published_world() -> dict[Job, Mapping[str, Any]]:
    """What the publication says, with the velocity of AHRS between the others."""
    velocity = {name: np.array(PAPER_VELOCITY[name]) for name in (PUBLISHED, CA_CV)}
    velocity[PLAIN] = 0.5 * (velocity[PUBLISHED] + velocity[CA_CV])
    wanted = {name.replace("-", "_"): (np.array(PAPER_POSITION[name]), velocity[name]) for name in PAPER_POSITION}
    return results(0.02, **wanted)


def judged(found: Mapping[Job, Mapping[str, Any]]) -> tuple[Summary, dict[str, Claim]]:
    summary = summarise(found)  # type: ignore[arg-type]  # a mapping like Results
    return summary, {c.id: c for c in claims(summary)}


def test_a_world_like_the_published_one_reproduces_its_claims() -> None:
    summary, said = judged(published_world())
    stated = [c for c in said.values() if not c.is_check and c.verdict is not Verdict.NOT_TESTED]
    assert len(stated) == 15 + 4 + 2 + 3 + 9
    assert {c.id: c.word for c in stated if c.verdict is not Verdict.REPRODUCED} == {}
    assert "12.5 %" in said[f"gain-r-x-{CA_CV}"].ours and "3.56" in said["ratio-v-x"].ours
    assert all(said[f"search-{m}"].verdict is Verdict.NOT_TESTED for m in ("pso", "ga"))
    assert said["nees-ahrs"].verdict is Verdict.REPRODUCED
    assert said["worse-ahrs-tdo-o1"].verdict is Verdict.NOT_REPRODUCED  # it is better
    assert "not consistent" not in said["best-position"].evidence
    best = summary.best
    assert best is not None and best.name == PUBLISHED
    assert said["aim-r-x"].verdict is Verdict.NOT_REPRODUCED and "0.279" in said["aim-r-x"].ours


def test_a_correction_that_harms_is_said_to() -> None:
    good, bad = np.full(3, 0.3), np.full(3, 0.45)
    slow = np.full(3, 0.02)
    summary, said = judged(results(0.05, **{"ca": (good, slow), "ahrs": (good, slow), "ahrs_tdo_o1": (bad, 1.2 * slow)}))
    for id in ("best-position", "best-velocity", "steady-position", f"gain-r-z-{PLAIN}"):
        assert said[id].verdict is Verdict.NOT_REPRODUCED
    assert said["worse-ahrs-tdo-o1"].verdict is Verdict.REPRODUCED
    assert said["windows-ahrs-tdo-o1"].verdict is Verdict.NOT_REPRODUCED
    assert "50.0 %" in said["best-position"].ours
    d = summary.compare("r_3d", PLAIN, PUBLISHED)
    assert d is not None and (d.better, d.worse) == (0, 6) and d.percent.value == pytest.approx(50.0)
    assert summary.cdf_distance("position_m", PLAIN, PUBLISHED) > 0.2 > summary.cdf_distance("position_m", PLAIN, CA_CV)


def test_numbers_of_a_trial() -> None:
    r, v = np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.02, 0.03])
    arrays = {"t_s": T, **flown("ahrs-tdo-o1", r, v, 3)}
    found = measure(arrays, "ahrs-tdo-o1").values
    assert [found[f"r_{a}"] for a in "xyz"] == pytest.approx(r) and [found[f"v_{a}"] for a in "xyz"] == pytest.approx(v)
    assert found["r_3d"] == pytest.approx(np.linalg.norm(r)) and found["triggered"] == pytest.approx(20.0, abs=0.2)
    assert found["nis"] == pytest.approx(1.0, abs=0.05) and found["nees"] == pytest.approx(6.0)
    shifted = dict(arrays) | {"ahrs-tdo-o1/position_error_m": arrays["ahrs-tdo-o1/position_error_m"] + [5.0, 0.0, 0.0]}
    moved = measure(shifted, "ahrs-tdo-o1").values
    assert moved["r_std_x"] == pytest.approx(found["r_std_x"]) and moved["r_x"] > 4.9  # the mean is no spread
    pushed = dict(arrays) | {"ahrs-tdo-o1/position_error_m": np.where(manoeuvring(T)[:, None], np.full(3, 2.0), 0.1)}
    inside = measure(pushed, "ahrs-tdo-o1").values
    assert inside["r_manoeuvre"] == pytest.approx(2 * np.sqrt(3)) and inside["r_quiet"] == pytest.approx(0.1 * np.sqrt(3))
    assert manoeuvring(np.array([249.9, 250.0, 260.0, 260.1])).tolist() == [False, True, True, False]
    short = {name: x[:31] if np.ndim(x) else x for name, x in arrays.items()}  # ends before what is left out does
    assert np.isnan(measure(short, "ahrs-tdo-o1").values["r_manoeuvre"]) and measure(short, "ahrs-tdo-o1").values["r_3d"] > 0


def test_optimistic_filters_are_marked() -> None:
    found = results(0.0, ahrs=(np.ones(3), np.ones(3)))
    for arrays in found.values():
        arrays["ahrs/nees"][:] *= 4.0
    found |= {Job("x", {"part": "published", "seed": 1}): {"t_s": T, **flown(PUBLISHED, np.ones(3), np.ones(3), 9)}}
    next(reversed(found.values()))[f"{PUBLISHED}/nees"][:] *= 0.1
    summary, said = judged(found)
    assert "not consistent" in said["best-position"].evidence
    assert not summary.rows["ahrs"].is_consistent and said["nees-ahrs"].verdict is Verdict.NOT_REPRODUCED
    assert any("‡" in row[0] for table in tables(summary) for row in table.rows)


def bounded(graph: float, spread: float = 0.01, least: float = 0.2) -> dict[Job, Mapping[str, Any]]:
    """The graph at so many times the bound, and a filter with attitude systems below the bound."""
    sigma = np.repeat([least, 0.1 * least], 3)
    found = results(spread, graph=(graph * sigma[:3], graph * sigma[3:]), ahrs=(0.5 * sigma[:3], 0.5 * sigma[3:]))
    return found | {Job("bound", {"part": BOUND}): {"t_s": T, "sigma": np.tile(sigma, (len(T), 1))}}


@pytest.mark.parametrize(
    ("graph", "spread", "verdict"),
    [
        (1.05, 0.01, Verdict.REPRODUCED),
        (1.05, 0.1, Verdict.PARTLY),  # the mean is near enough, its interval is not
        (1.15, 0.01, Verdict.NOT_REPRODUCED),
    ],
)
def test_the_best_of_the_sensors_of_the_bound_is_held_against_it(graph: float, spread: float, verdict: Verdict) -> None:
    summary, said = judged(bounded(graph, spread))
    assert summary.best is not None and summary.best.name == PLAIN and set(BOUND_SET) == {"graph", "moving-horizon", "eskf"}
    for id in ("bound-r", "bound-v"):
        assert said[id].verdict is verdict and said[id].ours.startswith("factor graph, whole flight: X 1.")
        assert "IMU, code, Doppler and ranges, without attitude systems" in said[id].text
    ratios = summary.over_bound("graph")
    squares = [s.value**2 for s in ratios if s is not None]
    assert squares == pytest.approx([graph**2 * np.mean((1 + spread * (np.arange(6) - 2.5)) ** 2)] * 6)  # not the mean of roots
    without, said = judged(results(0.01, graph=(np.ones(3), np.ones(3))))
    assert without.over_bound("graph") == [] and said["bound-r"].verdict is Verdict.NOT_TESTED


def test_an_aim_below_the_bound_is_said_to_be_out_of_reach() -> None:
    _, said = judged(bounded(1.05))
    assert "cannot be reached" in said["aim-r-x"].evidence and "0.2 m, 1.44 times the aim" in said["aim-r-x"].evidence
    assert 0.2 / (AIM * PAPER_POSITION[PUBLISHED][0]) == pytest.approx(1.44, abs=0.005)
    _, said = judged(bounded(1.05, least=0.01))
    assert "It can be reached" in said["aim-r-x"].evidence and said["aim-r-x"].verdict is Verdict.REPRODUCED


def test_flights_of_different_length_are_not_compared() -> None:
    def part_of(name: str, end: int) -> dict[Job, Mapping[str, Any]]:
        return {
            Job(job.key.replace("published", name), job.parameters): {
                key: np.asarray(x)[:end] if np.ndim(x) else x for key, x in arrays.items() if key.startswith((f"{name}/", "t_s"))
            }
            for job, arrays in bounded(1.05).items()
            if job.parameters["part"] == "published"
        }

    short = part_of(PLAIN, 21)
    summary, said = judged(short | part_of("graph", len(T)))
    assert summary.cut_short == [PLAIN] and summary.best is not None and summary.best.name == "graph"
    assert said["aim-r-x"].evidence.endswith("Until 600 s of the flight. Left out, since they saw less of it: AHRS.")
    assert "Until 20 s of the flight: AHRS." in markdown(summary, list(said.values()), "relnav")
    summary, said = judged(short)
    assert summary.best is not None and summary.best.name == PLAIN
    assert said["aim-r-x"].evidence.endswith("Until 20 s of the flight.")
    _, said = judged(part_of(PLAIN, len(T)))
    assert "Until" not in said["aim-r-x"].evidence


def searched(tdo: float, pso: float) -> Search:
    rng = np.random.default_rng(0)
    excess = {m: x * rng.uniform(0.8, 1.2, (20, 4)) for m, x in (("tdo", tdo), ("pso", pso))}
    return Search("O2", excess, {m: np.tile(x[..., None], len(GRID)) for m, x in excess.items()}, dict.fromkeys(excess, 36_000.0))


@pytest.mark.parametrize(
    ("tdo", "pso", "verdict"),
    [
        (1e-5, 1e-4, Verdict.REPRODUCED),
        (1e-4, 1e-5, Verdict.NOT_REPRODUCED),
        (1e-9, 1e-7, Verdict.NOT_REPRODUCED),  # too near to the minimum to matter
    ],
)
def test_searches_are_judged_by_a_paired_test(tdo: float, pso: float, verdict: Verdict) -> None:
    said = {c.id: c for c in claims(Summary({}, {"O2": searched(tdo, pso)}))}
    assert said["search-pso"].verdict is verdict and said["search-ga"].verdict is Verdict.NOT_TESTED
    assert said["minimum-O2"].verdict is Verdict.REPRODUCED and said["minimum-O1"].verdict is Verdict.NOT_TESTED


def test_sidelines_are_summarised() -> None:
    at = np.array(ahrs_tdo.WALKED)
    found: dict[Job, Mapping[str, Any]] = {
        Job("bound", {"part": BOUND}): {"t_s": T, "sigma": np.tile(np.arange(1.0, 7.0), (len(T), 1))},
        Job("rules-0001", {"part": RULES, "seed": 1}): {"nis/none": np.array([0.01, 0.02])},
        Job("rules-0002", {"part": RULES, "seed": 2}): {"nis/none": np.array([0.01, 0.01])},
        Job("walks-1001", {"part": TUNING, "seed": 1001}): {
            "walk": at, **{f"{n}/{what}": 1 + (at - 0.5) ** 2 for n in ("cv", "ca") for what in ("position_m", "velocity_mps")},
        },
    }  # fmt: skip
    summary, said = judged(found)
    assert summary.bound is not None and summary.bound.tolist() == pytest.approx([1, 2, 3, 4, 5, 6])
    assert summary.rules["nis"]["none"].value == pytest.approx(1.25) and said["rate-nis"].verdict is Verdict.REPRODUCED
    assert summary.walks["ca"].best == 0.5 and said["level-r"].verdict is Verdict.NOT_TESTED
    assert "| CA | 0.5 |" in markdown(summary, list(said.values()), "relnav")


def test_filters_are_named_and_compared() -> None:
    one = FILTERS[PUBLISHED].correction
    assert one is not None and (one.settings.rule.form, one.settings.objective, one.settings.covariance) == (
        "literal",
        "O1",
        "kept",
    )
    assert all(first in FILTERS and second in FILTERS for first, second in pairs()) and len(set(pairs())) == len(list(pairs()))
    assert not set(FILTERS) & set(OTHERS)
    assert set(ahrs_tdo_filters.WALKS.values()) <= set(ahrs_tdo.WALKED)  # what is used is in the tuning table
    assert ahrs_tdo_filters.told(FILTERS["ahrs"]) != ahrs_tdo_filters.told(FILTERS["no-abs"])


# jobs and command


def options(**changes: Any) -> argparse.Namespace:
    usual = {"trials": None, "seed": 1, "quick": False, "configurations": None, "seconds": 600.0}
    return argparse.Namespace(**(usual | changes))


def test_jobs() -> None:
    every = ahrs_tdo.STUDY.jobs(options())
    keys = [job.key for job in every]
    assert len(set(keys)) == len(keys) and {"published-0020", "graph-0020", "searches-0001", "rules-0001", "bound"} <= set(keys)
    assert {name for job in every for name in job.parameters.get("filters", ())} == set(FILTERS)
    assert {job.parameters["part"] for job in every} >= {*OTHERS, SEARCHES, RULES, TUNING, BOUND, "outliers"}
    for job in every:
        json.dumps(dict(job.parameters))
    quick = ahrs_tdo.STUDY.jobs(options(quick=True))
    assert len(quick) < 12 and all(job.parameters.get("seed", 1) in (1, 2) for job in quick)
    some = ahrs_tdo.STUDY.jobs(options(trials=1, configurations=["no-abs", "ahrs"]))
    assert [job.parameters["filters"] for job in some] == [["ahrs", "no-abs"]] and some[0].key not in keys


def test_the_other_estimators_turn_to_earth_fixed_axes() -> None:
    found = ahrs_tdo.errors(np.ones((2, 3)), np.zeros((2, 3)), np.tile(np.diag([4.0] * 6), (2, 1, 1)))
    assert found["nees"].tolist() == pytest.approx([0.75, 0.75])
    problem = ahrs_tdo.raw(1)
    assert not any(v.attitudes for v in problem.vehicles)
    C = ahrs_tdo._to_ecef(problem, np.array([0.0]))[0]
    leader = problem.vehicle("leader").truth
    assert leader is not None
    up = problem.frame.to_ecef(leader.r_n[:1])[0]
    assert C @ [0.0, 0.0, 1.0] @ up / np.linalg.norm(up) == pytest.approx(1.0, abs=1e-4)
    assert C @ [1.0, 0.0, 0.0] @ [0.0, 0.0, 1.0] == pytest.approx(0.0, abs=1e-12)  # east has no component along the axis


@pytest.fixture
def turning(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The published pair for LASTS seconds of turns, which show the attitudes."""
    base = load_scenario(scene.NAME)
    leader, follower = base.vehicle
    assert isinstance(leader.trajectory, Manoeuvres)
    turns = (Segment(duration_s=2.0), Segment(duration_s=10.0, turn_dps=9.0), Segment(duration_s=LASTS, turn_dps=-9.0))
    leader = leader.model_copy(update={"trajectory": leader.trajectory.model_copy(update={"segments": turns})})
    info = base.scenario.model_copy(update={"duration_s": LASTS})
    short = base.model_copy(update={"vehicle": (leader, follower), "scenario": info})
    monkeypatch.setattr(scene, "load_scenario", lambda name: short)
    for name, value in (("SEARCHED_S", (10.0, 15.0)), ("JUDGED_S", (10.0, 12.0, 15.0)), ("WALKED", (0.02, 0.2, 5.0))):
        monkeypatch.setattr(ahrs_tdo, name, value)
    monkeypatch.setattr(ahrs_tdo_filters, "RULE_TRIALS", 1000)
    kept = (scene._exact, ahrs_tdo.prepared)
    for known in kept:
        known.cache_clear()
    yield
    for known in kept:
        known.cache_clear()


def part(name: str) -> dict[str, Array]:
    found = ahrs_tdo.STUDY.run(Job(name, {"part": name, "seed": 1, "seconds": 16.0}))
    return {key: np.asarray(x) for key, x in found.items()}


def test_searches_of_recorded_updates(turning: None) -> None:
    found = part(SEARCHES)
    names = [f"{which}/{m}" for which in OBJECTIVES for m in ahrs_tdo.SEARCH_METHODS]
    assert set(found) == {f"{name}/{what}" for name in names for what in ("excess", "evals", "history")}
    for name in names:
        excess, evals, history = (found[f"{name}/{what}"] for what in ("excess", "evals", "history"))
        assert excess.shape == evals.shape == (2,) and history.shape == (2, len(GRID))
        assert np.all(excess > -1e-3) and np.all(excess < 0.05), name
        assert np.all((evals > 0) & (evals <= EVALUATIONS))  # some methods end where nothing changes any more
        assert np.all(np.diff(history, axis=1) <= 0) and np.all(history[:, 0] > excess)
        np.testing.assert_allclose(history[:, -1], excess)


def test_rules_at_recorded_updates(turning: None) -> None:
    found = part(RULES)
    assert len(found) == 4 * 4 and all(x.shape == (3,) and np.all((x >= 0) & (x <= 1)) for x in found.values())
    rules = {name.partition("/")[0] for name in found}
    assert rules == {"literal", "literal, residual", "normalised", "nis"}
    assert all(np.mean(found[f"{rule}/none"]) < np.mean(found[f"{rule}/UWB 3 m"]) for rule in rules)


def test_walks_are_tried_on_both_smooth_motions(turning: None) -> None:
    found = part(TUNING)
    assert set(found) == {"walk", *(f"{n}/{what}" for n in ("cv", "ca") for what in ("position_m", "velocity_mps"))}
    assert all(x.shape == (3,) and np.all(x > 0) for x in found.values())
    stiff, _, loose = found["cv/velocity_mps"]
    assert stiff > 1.5 * loose  # in turns constant velocity is wrong


def test_other_estimators_and_the_bound(turning: None) -> None:
    bound = part(BOUND)
    k = len(bound["t_s"])
    assert set(bound) == {"t_s", "sigma"} and bound["sigma"].shape == (k, 6) and k == LASTS + 1
    for name in OTHERS:
        found = part(name)
        shapes = {"position_error_m": (k, 3), "velocity_error_mps": (k, 3), "sigma": (k, 6), "nees": (k,), "runtime_s": ()}
        assert {key: x.shape for key, x in found.items()} == {"t_s": (k,), **{f"{name}/{w}": s for w, s in shapes.items()}}
        assert np.all(found[f"{name}/nees"] >= 0) and found[f"{name}/runtime_s"] > 0
        ratio = found[f"{name}/sigma"] / bound["sigma"]
        if name in BOUND_SET:
            assert np.all(ratio[-1] > 0.97), name  # linearised where it was estimated
            size = np.linalg.norm(found[f"{name}/position_error_m"][-1])
            assert size < 4 * np.linalg.norm(found[f"{name}/sigma"][-1, :3])
        else:
            assert np.all(ratio[:, :3] < 0.1)  # what phases add


def test_errors_of_other_estimators_are_estimates_less_truth(turning: None, monkeypatch: pytest.MonkeyPatch) -> None:
    solution, up_m = registry.solve(ahrs_tdo.raw(1), "eskf"), 10.0

    def shifted_up(by: float) -> Array:
        pair = replace(solution.pairs[0], baseline_enu=solution.pairs[0].baseline_enu + [0.0, 0.0, by])

        def solved(problem: NavigationProblem, method: str) -> Solution:
            return replace(solution, pairs=(pair,))

        monkeypatch.setattr(registry, "solve", solved)
        return np.asarray(ahrs_tdo.solve("eskf", 1)["eskf/position_error_m"])

    moved = shifted_up(up_m) - shifted_up(0.0)
    problem = ahrs_tdo.raw(1)
    leader = problem.vehicle(scene.LEADER).truth
    assert leader is not None
    up = problem.frame.to_ecef(leader.r_n[0])
    np.testing.assert_allclose(moved @ (up / np.linalg.norm(up)), up_m, rtol=1e-3)


def test_a_short_flight_from_jobs_to_page(tmp_path: Path) -> None:
    asked = options(trials=1, seconds=20.0, configurations=["ca", "ahrs", "ahrs-tdo-o2", "ahrs-gauss-newton"])
    found = {job: ahrs_tdo.STUDY.run(job) for job in ahrs_tdo.STUDY.jobs(asked)}
    outcome = ahrs_tdo.STUDY.finish(found, tmp_path, asked)  # type: ignore[arg-type]  # a mapping like Results
    assert outcome.lines[0].startswith("claims of the publication") and "report.html" in outcome.lines[-1]
    content = json.loads((tmp_path / "ahrs-tdo.json").read_text())
    assert content["command"] == (
        "relnav study ahrs-tdo --trials 1 --configurations ca ahrs ahrs-tdo-o2 ahrs-gauss-newton --seconds 20"
    )
    rows = {row["name"]: row["statistics"] for row in content["rows"]}
    assert set(rows) == {"ca", "ahrs", "ahrs-tdo-o2", "ahrs-gauss-newton"}
    assert 0 < rows["ahrs-tdo-o2"]["triggered"][0] < 60
    # the same objective has one minimum: what finds it hardly matters, where the prior is wide a little
    assert rows["ahrs-tdo-o2"]["r_3d"][0] == pytest.approx(rows["ahrs-gauss-newton"]["r_3d"][0], rel=0.1)
    assert rows["ahrs"]["r_3d"][0] < 0.75 * rows["ahrs-gauss-newton"]["r_3d"][0]
    assert "| CA: constant acceleration" in (tmp_path / "ahrs-tdo.md").read_text()
    assert (tmp_path / "report.html").stat().st_size > 1e6


def test_the_command_refuses_unknown_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["study", "ahrs-tdo", "--configurations", "ahrs-tdo-o4", "--out", str(tmp_path / "out")]) == 2
    assert "did you mean ahrs-tdo-o" in capsys.readouterr().err
