"""Methods side by side: the same epochs, the figures, what a failure or an interrupt leaves, the page."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from contextlib import redirect_stderr
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest

from factorgraph.problem import Link, NavigationProblem, Settings, Vehicle
from factorgraph.solution import PairSolution, Solution
from scenarios import cli, comparison, guard, solutions
from scenarios.compare import fingerprint
from scenarios.comparison import METHOD_METRICS, SUBJECT_METRICS, Cost, Metric, Outcome, best_of, compared, figure
from scenarios.report.comparison import write_comparison
from tests.helpers import ROOT, install_entry_points, interruptible
from tests.scenarios.pages import assert_quiet_and_drawn, charts_of, open_page
from tests.scenarios.plugin_methods import worse
from tests.scenarios.solution_example import example_solution

PLUGINS = ("Example", "Worse", "Refusing", "Slow", "Crashing", "Buggy")
WALKERS = """
[scenario]
name = "walkers"
duration_s = 8.0
origin = { lat_deg = 45.0, lon_deg = 10.0 }

[[vehicle]]
name = "one"
trajectory = { kind = "waypoints", points = [{ t_s = 0.0, r_n = [0, 0, 0] }, { t_s = 8.0, r_n = [8, 0, 0] }] }
positions = [{ rate_hz = 2.0 }]

[[vehicle]]
name = "two"
trajectory = { kind = "waypoints", points = [{ t_s = 0.0, r_n = [0, 9, 0] }, { t_s = 8.0, r_n = [8, 5, 0] }] }
positions = [{ rate_hz = 2.0 }]
"""


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_entry_points(tmp_path, monkeypatch, "relnav.methods", "tests.scenarios.plugin_methods", PLUGINS)


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Parts run in this process; the methods that were run, in order."""
    run: list[str] = []

    def watch(argv: list[str], out: Path, on_stage: object, stdout: object, stderr: IO[bytes]) -> tuple[int, str]:
        run.append(argv[argv.index("--methods") + 1])
        with redirect_stderr(io.StringIO()) as printed:
            try:
                code = cli.main([*argv, guard.TRACE_OPTION, "unused"])
            except ZeroDivisionError:
                traceback.print_exc()
                code = guard.BUG
        stderr.write(printed.getvalue().encode())
        return code, ""

    monkeypatch.setattr(guard, "Trace", lambda path: None)
    monkeypatch.setattr(guard, "watch", watch)
    return run


def problem_of(solution: Solution) -> NavigationProblem:
    """A problem with the solution's frame and vehicles, without measurements."""
    vehicles = tuple(Vehicle(v.name) for v in solution.vehicles)
    return NavigationProblem(solution.name, solution.t0, solution.frame, vehicles)


def outcomes_of(**found: Solution) -> list[Outcome]:
    return [Outcome(name, solution, Cost(1.0 + i, 2.0, 3.0)) for i, (name, solution) in enumerate(found.items())]


def compare(**found: Solution) -> comparison.Comparison:
    return compared(outcomes_of(**found), problem_of(next(iter(found.values()))))


# figures


def test_figures_are_those_of_the_epochs_all_methods_have() -> None:
    good = example_solution(n=60)
    found = compare(good=good, bad=worse(good))
    assert [s.name for s in found.subjects] == ["leader → rover", "leader", "rover"]
    for subject in found.subjects:
        assert subject.has_truth and subject.n_epochs == 30
        a, b = (subject.values[m] for m in ("good", "bad"))
        for part in ("horizontal_rmse_m", "horizontal_p95_m", "vertical_rmse_m", "vertical_p95_m", "rmse_m", "p95_m"):
            assert b[part] == pytest.approx(5 * a[part], rel=1e-6)
        assert b["nees_per_dof"] == pytest.approx(25 * a["nees_per_dof"], rel=1e-5)
        assert b["velocity_rmse_mps"] == a["velocity_rmse_mps"]
    pair = good.pairs[0]
    assert pair.truth_enu is not None
    error = (pair.baseline_enu - pair.truth_enu)[::2]
    values = found.subjects[0].values["good"]
    assert values["rmse_m"] == pytest.approx(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    assert values["vertical_p95_m"] == pytest.approx(np.percentile(np.abs(error[:, 2]), 95))
    assert values["nees_per_dof"] == pytest.approx(np.mean(np.sum(error**2 / np.diagonal(pair.P, 0, 1, 2)[::2, :3], axis=1)) / 3)
    assert values["fixed_percent"] == pytest.approx(100 * np.mean(pair.fix[::2] == 3))


def test_epochs_that_one_method_does_not_know_count_for_none() -> None:
    good = example_solution(n=40)
    pair = good.pairs[0]
    hollow = pair.baseline_enu.copy()
    hollow[10:15] = np.nan
    found = compare(good=good, hollow=replace(good, pairs=(replace(pair, baseline_enu=hollow),)))
    subject = found.subjects[0]
    assert subject.n_epochs == 35
    np.testing.assert_equal(subject.values["good"], subject.values["hollow"])


def test_methods_with_other_epochs_are_carried_to_the_common_ones() -> None:
    # uniform motion: between states the solution is known exactly
    t_s = np.arange(41) / 4.0
    dense = _moving_straight(t_s)
    sparse = _moving_straight(t_s[2:-4:4] + 0.1)
    found = compare(dense=dense, sparse=sparse)
    subject = found.subjects[0]
    assert subject.name == "leader → rover" and subject.n_epochs == len(sparse.pairs[0].t_s)
    assert subject.against == "dense"
    assert subject.values["sparse"]["rmse_m"] < 1e-9
    vehicle = next(s for s in found.subjects if s.name == "rover")
    assert vehicle.values["sparse"]["rmse_m"] < 1e-9 and vehicle.n_epochs == subject.n_epochs


def _moving_straight(t_s: np.ndarray[Any, np.dtype[np.float64]]) -> Solution:
    """Two vehicles in uniform motion, without truth, attitude and IMU."""
    solution = example_solution(n=len(t_s), with_truth=False)
    nan = np.full((len(t_s), 3), np.nan)
    vehicles = []
    for i, v in enumerate(solution.vehicles):
        velocity = np.array([2.0, -1.0 + i, 0.5])
        r_n = t_s[:, None] * velocity + [0.0, 5.0 * i, 0.0]
        told = {"r_n": r_n, "v_n": np.tile(velocity, (len(t_s), 1)), "q_nb": np.full((len(t_s), 4), np.nan)}
        vehicles.append(replace(v, t_s=t_s, bias_gyro=nan, bias_accel=nan, **told))
    leader, rover = vehicles
    C = solution.frame.C_to_enu(leader.r_n)
    relative = {"baseline_enu": rover.r_n - leader.r_n, "velocity_enu": rover.v_n - leader.v_n}
    resolved = {name: (C @ values[:, :, None])[:, :, 0] for name, values in relative.items()}
    return replace(solution, vehicles=(leader, rover), pairs=(replace(solution.pairs[0], t_s=t_s, **resolved),))


def test_without_truth_the_first_method_is_what_others_differ_from() -> None:
    good = example_solution(n=40)
    bad = worse(good, every=1)
    blind = [
        replace(s, vehicles=tuple(replace(v, truth=None) for v in s.vehicles), pairs=tuple(_blind(p) for p in s.pairs))
        for s in (good, bad)
    ]
    found = compare(good=blind[0], bad=blind[1])
    true = compare(good=good)
    for subject, known in zip(found.subjects, true.subjects, strict=True):
        assert subject.against == "good" and not subject.has_truth
        assert np.isnan(subject.values["good"]["rmse_m"])
        assert subject.values["bad"]["rmse_m"] == pytest.approx(4 * known.values["good"]["rmse_m"], rel=1e-6)
        assert np.isnan(subject.values["bad"]["nees_per_dof"])


def _blind(pair: PairSolution) -> PairSolution:
    return replace(pair, truth_enu=None, truth_velocity_enu=None)


def test_the_bound_is_of_the_same_epochs() -> None:
    good = example_solution(n=60)
    grid_s = np.arange(0.0, 60.0)
    P = np.tile(np.eye(6) * 0.01, (60, 1, 1))
    P[1::2] *= 1e6  # epochs that the other method does not have
    bound = (grid_s, {("leader", "rover"): P})
    subject = compared(outcomes_of(good=good, bad=worse(good)), problem_of(good), bound).subjects[0]
    assert subject.bound_rmse_m == pytest.approx(np.sqrt(0.03))
    assert subject.values["bad"]["rmse_over_bound"] == pytest.approx(subject.values["bad"]["rmse_m"] / np.sqrt(0.03))


def test_the_best_of_a_row() -> None:
    small, ratio, none = Metric("a", "a", "m"), Metric("b", "b", "", 1.0), Metric("c", "c", "", float("nan"))
    assert best_of(small, {"x": 2.0, "y": 1.0, "z": 1.001, "w": float("nan")}) == {"y", "z"}
    assert best_of(ratio, {"x": 0.5, "y": 1.9}) == {"y"}
    assert best_of(none, {"x": 1.0, "y": 2.0}) == set()
    assert best_of(small, {"x": 1.0}) == best_of(small, {"x": 1.0, "y": 1.0}) == set()
    assert [figure(small, v) for v in (0.0123456, 12345.6, float("nan"))] == ["0.0123", "12,346", "–"]


def test_a_fingerprint_tells_data_and_settings_apart() -> None:
    problem = problem_of(example_solution(n=5))
    link = Link("leader", "rover")
    assert fingerprint(problem) == fingerprint(problem_of(example_solution(n=5)))
    changed = [
        replace(problem, links=(link,)),
        replace(problem, pairs=(link,)),
        replace(problem, settings=Settings(max_iterations=7)),
    ]
    assert len({fingerprint(p) for p in (problem, *changed)}) == 4


# the command


@pytest.mark.usefixtures("plugins", "parts")
def test_one_table_and_files_and_a_failure_is_a_row(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = flight / "out"
    argv = ["compare", str(flight), "--methods", "example, worse,refusing,buggy", "--out", str(out)]
    assert cli.main(argv) == guard.DEGRADED
    printed, err = capsys.readouterr()
    row = next(line for line in printed.splitlines() if "3D RMSE [m]" in line)
    assert "example" in printed and len(row.split("│")) == 5
    assert "degraded: refusing failed: no vehicle has an odometer; add one" in err
    assert "degraded: buggy failed: ZeroDivisionError: an error of the estimator itself" in err
    assert "Traceback" not in err and "Traceback" in (out / "buggy" / "failure.txt").read_text("utf-8")

    told = json.loads((out / "comparison.json").read_text(encoding="utf-8"))
    assert [m["status"] for m in told["methods"]] == ["converged", "converged", "failed", "failed"]
    assert told["methods"][0]["wall_s"] >= 0 and told["methods"][0]["peak_mb"] >= 0
    assert told["methods"][2]["reason"] == "no vehicle has an odometer; add one" and told["methods"][2]["wall_s"] is None
    pair = told["subjects"][0]
    assert pair["against"] == "truth" and pair["epochs"] == 30
    assert pair["methods"]["worse"]["rmse_m"] == pytest.approx(5 * pair["methods"]["example"]["rmse_m"], rel=1e-6)

    rows = list(csv.DictReader((out / "comparison.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 3 * 2 + 2
    assert float(rows[1]["rmse_m"]) == pair["methods"]["worse"]["rmse_m"]
    assert {m.key for m in (*SUBJECT_METRICS, *METHOD_METRICS)} < rows[0].keys()
    assert (rows[-1]["method"], rows[-2]["status"]) == ("buggy", "failed")
    assert "refusing failed" in (out / "comparison.html").read_text(encoding="utf-8")

    assert cli.main(["report", str(out / "worse")]) == guard.DONE
    assert (out / "worse" / "report.html").exists()


@pytest.mark.usefixtures("plugins")
def test_finished_methods_are_not_run_again_unless_something_changed(flight: Path, parts: list[str]) -> None:
    argv = ["compare", str(flight), "--out", str(flight / "out"), "--methods"]
    for more, run in (
        (["example,refusing"], ["example", "refusing"]),
        (["example,worse"], ["worse"]),
        (["example", "--repeat", "2"], ["example"]),
        (["example"], []),
        (["example", "--force"], ["example"]),
        (["example", "--set", "max_iterations=9"], ["example"]),
        (["worse", "--set", "max_iterations=9", "--warm"], ["worse", "worse"]),
    ):
        parts.clear()
        assert cli.main([*argv, *more]) in (guard.DONE, guard.DEGRADED)
        assert parts == run, more
    (flight / "fixes.csv").write_text("t,x,y,z\n0,0,0,0\n1,1,0,0\n2,2,0,0\n", encoding="utf-8")
    parts.clear()
    assert cli.main([*argv, "worse", "--set", "max_iterations=9"]) == guard.DONE
    assert parts == ["worse"]


@pytest.mark.usefixtures("plugins")
def test_repeated_runs_are_timed_and_their_median_told(flight: Path, parts: list[str]) -> None:
    assert cli.main(["compare", str(flight), "--methods", "example", "--repeat", "3", "--out", str(flight / "out")]) == guard.DONE
    assert parts == ["example"]
    told = json.loads((flight / "out" / "example" / "run.json").read_text(encoding="utf-8"))
    assert told["n_runs"] == 3 == len(told["all_wall_s"])
    assert told["wall_s"] == sorted(told["all_wall_s"])[1]


@pytest.mark.usefixtures("plugins", "parts")
@pytest.mark.parametrize(
    ("methods", "part"),
    [
        ("exampel", "did you mean example?"),
        ("example,worse,example", "--methods names example twice"),
        ("", "say which methods to compare"),
        (" , ", "say which methods to compare"),
        (None, "say which methods to compare"),
        ("refusing", "no method finished: refusing: no vehicle has an odometer; add one"),
    ],
)
def test_wrong_methods_are_one_error_line_and_2(
    methods: str | None, part: str, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = [] if methods is None else ["--methods", methods]
    assert cli.main(["compare", str(flight), "--out", str(flight / "out"), *more]) == guard.FAILED
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("relnav: error: ") and part in line
    assert not list(flight.glob("out/comparison.*"))


def test_a_missing_flight_or_a_folder_in_the_way_is_one_line_and_2(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocked = flight / "out" / "graph" / "solution"
    blocked.mkdir(parents=True)
    for argv, part in (
        (["no-such-flight", "--out", str(flight / "new")], "no-such-flight"),
        ([str(flight), "--out", str(flight / "fixes.csv")], "is a file"),
        ([str(flight), "--out", str(flight / "out")], "choose another --out"),
    ):
        assert cli.main(["compare", *argv, "--methods", "graph"]) == guard.FAILED
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("relnav: error: ") and part in line
    assert not (flight / "new").exists()


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.usefixtures("plugins")
def test_a_crash_costs_its_method_only_and_an_interrupt_keeps_finished_ones(flight: Path, tmp_path: Path) -> None:
    ready, out = tmp_path / "ready", flight / "out"
    env = {**os.environ, "PYTHONPATH": os.environ.get("PYTHONPATH", str(ROOT)), "SLOW_READY": str(ready)}
    argv = [sys.executable, "-m", "scenarios", "compare", str(flight), "--methods", "crashing,example,slow", "--out", str(out)]
    with subprocess.Popen(interruptible(argv), stderr=subprocess.PIPE, text=True, cwd=flight, env=env) as process:
        deadline = time.monotonic() + 60
        while not ready.exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == guard.INTERRUPTED
    told = err.splitlines()
    assert "[1/3] crashing: failed: a native library crashed" in told[0] and "SIGSEGV" in told[0]
    assert (out / "crashing" / guard.CRASH_FILE).exists()
    last = f"relnav: stopped; 1 of 3 methods are finished in {out}; the same command goes on"
    assert told[-1] == last
    assert solutions.load(out / "example" / "solution").name == "walk"
    assert (out / "example" / "run.json").exists() and not (out / "slow").exists()


@pytest.mark.usefixtures("parts")
def test_a_simulated_flight_has_errors_and_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "run", lambda argv, out, quiet=False: cli.main([*argv, guard.TRACE_OPTION, "unused"]))
    (tmp_path / "walkers.toml").write_text(WALKERS, encoding="utf-8")
    assert cli.main(["simulate", str(tmp_path / "walkers.toml"), str(tmp_path / "sim")]) == guard.DONE
    assert cli.main(["compare", str(tmp_path / "sim"), "--methods", "graph", "--out", str(tmp_path / "out")]) == guard.DONE
    told = json.loads((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))
    assert [s["subject"] for s in told["subjects"]] == ["one → two", "one", "two"]
    values = told["subjects"][0]["methods"]["graph"]
    assert 0.2 < values["rmse_over_bound"] < 5
    assert values["rmse_over_bound"] == pytest.approx(values["rmse_m"] / told["subjects"][0]["bound_rmse_m"])


# the page


def page_of(good: Solution, folder: Path) -> Path:
    found = outcomes_of(graph=good, **{"a<b>": worse(good, 2.0, 1)})
    failed = Outcome("gone", reason="<script>alert(1)</script>")
    return write_comparison(compared([*found, failed], problem_of(good)), folder / "comparison.html")


def test_the_page_draws_every_method_and_quotes_what_it_is_given(tmp_path: Path) -> None:
    text = page_of(example_solution(n=80), tmp_path).read_text(encoding="utf-8")
    assert "<script>alert" not in text and "a<b>" not in text and "a&lt;b&gt;" in text
    charts = charts_of(text)
    for chart in charts:
        owners = {trace["meta"]["method"] for trace in chart["data"] if "meta" in trace}
        assert owners == {"graph", "a<b>"}
    bands = [t for c in charts for t in c["data"] if t.get("meta", {}).get("band")]
    assert {t["meta"]["method"] for t in bands if t["visible"]} == {"graph"}
    assert {t["meta"]["method"] for t in bands} == {"graph", "a<b>"}


def test_a_button_hides_a_method_in_all_plots_and_the_band_can_be_chosen(tmp_path: Path, browser: Any) -> None:
    solution = example_solution(n=80)
    page = page_of(replace(solution, vehicles=solution.vehicles[:1], pairs=()), tmp_path)
    open_page(browser, page, 1280)
    assert_quiet_and_drawn_or_folded(browser, page)
    shown = (
        "return [...document.querySelectorAll('.plot[data-drawn]')].flatMap(d => d.data)"
        ".filter(t => t.meta && !!t.meta.band === arguments[0] && (t.visible ?? true) === true).map(t => t.meta.method)"
    )
    assert set(browser.execute_script(shown, False)) == {"graph", "a<b>"}
    assert set(browser.execute_script(shown, True)) == {"graph"}
    browser.execute_script(
        "const s = document.querySelector('.methods select'); s.value = 'a<b>'; s.dispatchEvent(new Event('change'))"
    )
    assert set(browser.execute_script(shown, True)) == {"a<b>"}
    browser.execute_script("document.querySelector('.methods button').click()")
    assert set(browser.execute_script(shown, False)) == {"a<b>"}
    pressed = "return document.querySelector('.methods button').getAttribute('aria-pressed')"
    assert browser.execute_script(pressed) == "false"
    # a legend shows it again, everywhere
    browser.execute_script(
        "const d = document.querySelector('#errors .plot');"
        "d.emit('plotly_legendclick', { curveNumber: d.data.findIndex(t => t.meta.method === 'graph') })"
    )
    assert set(browser.execute_script(shown, False)) == {"graph", "a<b>"}
    assert browser.execute_script(pressed) == "true"


def assert_quiet_and_drawn_or_folded(browser: Any, page: Path) -> None:
    """Opens what is folded, then everything must be drawn."""
    browser.execute_script("document.querySelectorAll('details').forEach(d => d.open = true)")
    deadline = time.monotonic() + 60
    while browser.execute_script("return document.querySelectorAll('.plot:not(.js-plotly-plot)').length"):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert_quiet_and_drawn(browser, len(charts_of(page.read_text(encoding="utf-8"))))
