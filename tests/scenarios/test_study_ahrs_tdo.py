"""The study `ahrs-tdo`: what it says of made-up numbers, its jobs, and its command on a short flight."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorgraph.types import Array
from scenarios import cli
from scenarios.published import ahrs_tdo_filters
from scenarios.published.ahrs_tdo_filters import CA_CV, FILTERS
from scenarios.studies import ahrs_tdo
from scenarios.studies.ahrs_tdo import BOUND, GRID, OTHERS, RULES, SEARCHES, TUNING
from scenarios.studies.ahrs_tdo_claims import PAPER_POSITION, PAPER_VELOCITY, claims
from scenarios.studies.ahrs_tdo_record import markdown, tables
from scenarios.studies.ahrs_tdo_summary import (
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
        f"{name}/triggered": (np.arange(len(T)) % 5 == 0) & (FILTERS[name].correction is not None),
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
    # the same objective has one minimum: what finds it hardly matters
    assert rows["ahrs-tdo-o2"]["r_3d"][0] == pytest.approx(rows["ahrs-gauss-newton"]["r_3d"][0], rel=0.02)
    assert "| CA: constant acceleration" in (tmp_path / "ahrs-tdo.md").read_text()
    assert (tmp_path / "report.html").stat().st_size > 1e6


def test_the_command_refuses_unknown_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["study", "ahrs-tdo", "--configurations", "ahrs-tdo-o4", "--out", str(tmp_path / "out")]) == 2
    assert "did you mean ahrs-tdo-o" in capsys.readouterr().err
