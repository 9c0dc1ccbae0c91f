"""The study of the optimisers: its problems, its bookkeeping on made-up runs, and a small run through the command line."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest

from factorgraph.errors import InputError
from factorgraph.types import Array
from scenarios import cli
from scenarios.metrics_ranks import ranking
from scenarios.report.optimisers import rank_chart
from scenarios.studies import catalogue, store
from scenarios.studies.optimisers import KINDS, PARTS, SEARCHES, available, grid, on_grid, tasks, trial
from scenarios.studies.optimisers_record import command_line, tables, write
from scenarios.studies.optimisers_summary import summarise
from scenarios.studies.study import Job, Results
from swarm.functions import FUNCTIONS
from tests.scenarios.pages import charts_of

METHODS = ("tdo", "ga", "pso")
MAX_EVALS = 300
N_SEEDS = 12


def options(**changes: object) -> argparse.Namespace:
    usual = {"methods": list(available()), "parts": list(PARTS), "functions": None, "dimensions": None}
    return argparse.Namespace(**(usual | {"evals": None, "trials": None, "quick": True, "seed": 1} | changes))


# problems


@pytest.mark.parametrize(
    ("part", "name", "n"), [("functions", "rastrigin", 6), ("origin", "levy", 6), *(("navigation", *s) for s in SEARCHES.items())]
)
def test_problems_are_the_same_for_a_seed_and_others_for_another(part: str, name: str, n: int) -> None:
    u = np.random.default_rng(0).random((20, n))

    def values(seed: int) -> dict[str, Array]:
        return {k: t.cost(t.bounds[:, 0] + u * np.ptp(t.bounds, axis=1)) for k, t in tasks(part, name, n, seed)}

    one, again, other = values(1), values(1), values(2)
    assert set(one) <= set(KINDS) and all(KINDS[kind].part == part for kind in one)
    for kind in one:
        np.testing.assert_array_equal(one[kind], again[kind])
        assert part == "origin" or not np.allclose(one[kind], other[kind])
    if part != "functions":  # the same problem put in two ways
        first, second = (one[kind] for kind in (("origin", "moved") if part == "origin" else ("normalised", "raw")))
        assert first == pytest.approx(second, rel=1e-6)


@pytest.mark.parametrize("name", SEARCHES)
def test_gauss_newton_is_where_nothing_in_the_box_is_lower(name: str) -> None:
    rng = np.random.default_rng(3)
    for _, task in (found for seed in (1, 2) for found in tasks("navigation", name, SEARCHES[name], seed)):
        assert len(task.bounds) == SEARCHES[name]
        low, high = task.bounds.T
        points = rng.uniform(low, high, (3000, len(low)))
        error = (task.cost(points) - task.offset) / task.scale
        assert task.scale > 0 and error.min() > -task.even


def test_snapshots_are_what_the_filter_believes() -> None:
    from scenarios.studies import optimisers_snapshots as snapshots

    for draw in (snapshots.pair, snapshots.formation):
        nis, z_post = [], []
        for seed in range(150):
            s = draw(np.random.default_rng(seed))
            keep = np.delete(np.arange(s.m), s.norm_rows)  # a range is off
            e = s.innovation[keep]
            nis.append(e @ np.linalg.solve(s.S[np.ix_(keep, keep)], e) / len(keep))
            z_post.append(np.linalg.eigvalsh(s.P_prior - s.P_post).min() / np.trace(s.P_prior))
        assert np.mean(nis) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (150 * len(keep))))
        assert min(z_post) > -1e-9 and len(s.seen) in SEARCHES.values()


# runs


def test_histories_are_read_as_steps() -> None:
    evals, errors = np.array([30.0, 60.0, 90.0]), np.array([3.0, 2.0, 1.0])
    assert on_grid(evals, errors, np.array([10.0, 30.0, 59.0, 60.0, 89.0, 500.0])).tolist() == [3, 3, 3, 2, 2, 1]
    assert grid(24_000)[[0, -1]].tolist() == [30, 24_000] and np.all(np.diff(grid(24_000)) > 0)


def test_a_trial_keeps_to_its_budget_and_reports_its_error() -> None:
    found = trial("functions", "sphere", 6, 1, list(available()), 1500)
    (name,) = {key.rpartition("/")[0] for key in found}
    error, evals, history = (found[f"{name}/{key}"] for key in ("error", "evals", "history"))
    assert len(error) == len(available()) and np.all(evals <= 1500) and np.all(error >= 0)
    assert np.all(np.diff(history, axis=1) <= 0) and history[:, -1] == pytest.approx(error)
    assert np.all(error < 0.3 * history[:, 0]) and np.median(error) < 1e-2 * np.median(history[:, 0])


# the summary of made-up runs


def made_up(folder: Path, factors: dict[str, float], n_seeds: int = N_SEEDS, parts: tuple[str, ...] = PARTS) -> Results[Job]:
    """Errors a method's factor times noise, balanced over the seeds between tdo and pso; tdo is better at the origin."""
    rng, files = np.random.default_rng(0), {}
    for kind, about in KINDS.items():
        for problem in (f"{kind} one", f"{kind} two") if about.part in parts else ():
            for seed in range(n_seeds):
                side = {"tdo": 0.0, "pso": (-1) ** seed * (0.3 + 0.01 * seed)}
                noise = np.array([side.get(m, 0.3 * rng.normal()) for m in factors])
                error = np.array(list(factors.values())) * np.exp(noise)
                if kind == "origin":
                    error[list(factors).index("tdo")] = 1e-12
                history = error[:, None] * np.geomspace(100, 1, len(grid(MAX_EVALS)))
                arrays = {"error": error, "evals": np.full(len(error), 300.0), "hit": np.where(error < 1e-3, 100.0, np.nan)}
                arrays |= {"runtime_s": np.full(len(error), 3e-3), "history": history, "levels": np.array([1e-3, 1e-8])}
                parameters = {"methods": list(factors), "max_evals": MAX_EVALS, "seed": seed, "part": about.part}
                job = Job(f"{kind}-{problem[-3:]}-{seed}", parameters)
                files[job] = folder / f"{job.key}.npz"
                packed = {f"{kind}/{problem}/{key}": x for key, x in arrays.items()}
                files[job].write_bytes(store.pack(packed, store.header("optimisers", parameters)))
    return Results(files)


FACTORS = {"tdo": 1e-2, "ga": 1e-4, "pso": 1e-2}


def test_the_summary_says_what_the_runs_say(tmp_path: Path) -> None:
    summary = summarise(made_up(tmp_path, FACTORS))
    assert summary.kinds == list(KINDS) and summary.n_seeds == N_SEEDS and summary.can_be_significant
    words = {(v.kind, v.second): v.word for v in summary.verdicts}
    assert words["multimodal", "ga"] == "no, worse" and words["multimodal", "pso"] == "not significant"
    assert words["origin", "pso"] == "yes" and words["moved", "ga"] == "no, worse"
    against_ga = next(v for v in summary.verdicts if (v.kind, v.second) == ("raw", "ga"))
    assert 10.0**-against_ga.test.median_difference == pytest.approx(100, rel=0.3)
    assert (against_ga.n_better, against_ga.n_worse, against_ga.n_problems) == (0, 2, 2)
    found = {(c.first, c.method): c.word for c in summary.contrasts}
    assert found["origin", "tdo"] == "better: optimum at the origin" and found["origin", "ga"] == "no difference"
    assert summary.success("unimodal", "ga").value == 1.0 and summary.success("unimodal", "tdo").value == 0.0
    problem = summary.of("unimodal")[0]
    assert problem.expected_evals("ga") == 100 and problem.expected_evals("tdo") == np.inf
    assert summary.rankings["unimodal"].n_blocks == 2 and summary.rankings["raw"].n_blocks == 2 * N_SEEDS
    assert np.argmin(summary.rankings["raw"].mean_ranks) == 1
    assert summary.microseconds("raw", "pso") == pytest.approx(10.0)


def test_three_seeds_claim_nothing(tmp_path: Path) -> None:
    summary = summarise(made_up(tmp_path, FACTORS, 3))
    assert not summary.can_be_significant and {v.word for v in summary.verdicts} == {"not significant"}


def test_parts_of_the_study_can_be_missing(tmp_path: Path) -> None:
    results = made_up(tmp_path, {"ga": 1.0, "pso": 2.0}, 3, ("functions",))
    summary = summarise(results)
    assert not summary.verdicts and not summary.contrasts
    assert [t.title for t in tables(summary)][:2] == ["Mean ranks", "Success [%]"]
    write(results, tmp_path, options(methods=["ga", "pso"], parts=["functions"]))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "tdo was not run beside another method." in page and "These problems were not run." in page


def test_the_record_is_written_thrice(tmp_path: Path) -> None:
    outcome = write(made_up(tmp_path, FACTORS), tmp_path, options(methods=list(METHODS), trials=N_SEEDS))
    assert "tdo, smaller error than ga? no, worse: one minimum | many minima | the same moved away" in outcome.lines[0]
    assert "solved sooner" not in " ".join(outcome.lines)
    tree = json.loads((tmp_path / "optimisers.json").read_text(encoding="utf-8"))
    assert len(tree["problems"]) == 2 * len(KINDS) and set(tree["rankings"]) == set(KINDS)
    assert tree["command"] == "relnav study optimisers --quick --trials 12 --methods tdo ga pso"
    page = (tmp_path / "optimisers.md").read_text(encoding="utf-8")
    assert "| many minima | ga | no, worse |" in page and "| unimodal one |" in page
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Is tdo better?" in report and "12 seeds" in report
    charts = charts_of(report)
    assert len(charts) == 2 * len(KINDS) + 2 * (len(KINDS) - 2)  # ranks and success; convergence but of `origin`
    for chart in charts:
        go.Figure({"data": chart["data"], "layout": chart["layout"]})  # raises on anything unknown
    bands = [t for c in charts for t in c["data"] if t.get("meta", {}).get("band")]
    assert bands and {t["meta"]["method"] for t in bands if t["visible"]} == {"tdo"}


def test_rank_diagram_joins_what_cannot_be_told_apart() -> None:
    rng = np.random.default_rng(1)
    costs = np.array([1.0, 1.1, 5.0]) + 0.5 * rng.random((20, 3))
    chart = rank_chart("ranks", ranking(costs), METHODS)
    joins = [t for t in chart.data if t.get("line", {}).get("width") == 5]
    words = [w for t in chart.data for w in t.get("text", []) if w]
    assert len(joins) == 1 and max(joins[0]["x"]) < 2.5
    assert any(w.startswith("pso 3.00") for w in words) and "critical difference" in words


# jobs


def test_every_problem_has_jobs_and_unknown_names_are_named() -> None:
    study = catalogue.create("optimisers")
    jobs = study.jobs(options())
    assert len(jobs) == 3 * (2 * 3 + len(SEARCHES)) == len({job.key for job in jobs})
    full = study.jobs(options(quick=False))
    assert len(full) == 25 * (3 * len(FUNCTIONS) + len(SEARCHES)) and full[0].parameters["max_evals"] == 24_000
    for change, words in (
        ({"methods": ["tod"]}, "no method tod; did you mean tdo"),
        ({"functions": ["spere"]}, "no function spere; did you mean sphere"),
        ({"dimensions": [1]}, "--dimensions must be at least 2, got 1"),
        ({"evals": 3}, "--evals must be at least 30, got 3"),
    ):
        with pytest.raises(InputError, match=words):
            study.jobs(options(**change))
    assert command_line(options(dimensions=[2, 3])) == "relnav study optimisers --quick --dimensions 2 3"


def test_the_command_runs_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["--methods", *METHODS, "--functions", "sphere", "--evals", "300", "--trials", "2", "--quick"]
    code = cli.main(["study", "optimisers", *asked, "--workers", "1", "--out", str(tmp_path / "out")])
    assert code == 0 and "tdo, smaller error than ga?" in capsys.readouterr().out
    assert (tmp_path / "out" / "report.html").stat().st_size > 1e5
