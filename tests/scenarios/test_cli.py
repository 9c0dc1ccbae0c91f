"""The command line: results, exit codes, one clear line for every wrong input, interrupts, full disks, crashes."""

from __future__ import annotations

import argparse
import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factorgraph.errors import InputError
from factorgraph.problem import Settings
from factorgraph.solution import Solution
from scenarios import cli, demo, guard, solutions
from scenarios.metrics import summary_rows
from scenarios.overrides import override
from tests.helpers import ROOT, install_entry_points, interruptible
from tests.scenarios.solution_example import example_solution

SCENARIO = """
[scenario]
name = "line"
duration_s = 6.0
origin = { lat_deg = 45.0, lon_deg = 10.0 }

[[vehicle]]
name = "walker"
trajectory = { kind = "waypoints", points = [{ t_s = 0.0, r_n = [0, 0, 0] }, { t_s = 6.0, r_n = [6, 0, 0] }] }
positions = [{ rate_hz = 2.0 }]
"""
METHODS = ("Example", "Degraded", "Slow", "Crashing", "Buggy")
posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Installs the estimators of `plugin_methods` under their names in lower case, for child processes too."""
    install_entry_points(tmp_path, monkeypatch, "relnav.methods", "tests.scenarios.plugin_methods", METHODS)


@pytest.fixture
def unguarded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Guarded commands run in this process, without handlers of signals: quick, and modules can be patched."""
    monkeypatch.setattr(guard, "Trace", lambda path: None)
    monkeypatch.setattr(guard, "run", lambda argv, out, quiet=False: cli.main([*argv, guard.TRACE_OPTION, "unused"]))


def relnav(*argv: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    return subprocess.run(_command(argv), capture_output=True, text=True, cwd=cwd, env=_env(), timeout=120, check=False)


def _command(argv: tuple[object, ...]) -> list[str]:
    return [sys.executable, "-m", "scenarios", *map(str, argv)]


def _env() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.environ.get("PYTHONPATH", str(ROOT)), "PYTHONUTF8": "1"}


def one_error_line(err: str) -> str:
    """The only line of `err`, which must be relnav's error line."""
    (line,) = err.splitlines()
    assert line.startswith("relnav: error: ")
    return line


def test_help_names_every_command_and_every_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == guard.DONE
    out = capsys.readouterr().out
    assert all(f"\n  {name}" in out for name in cli.COMMANDS)
    assert all(f"\n  {code} " in out for code in (guard.DONE, guard.DEGRADED, guard.FAILED, guard.BUG, guard.INTERRUPTED))


def test_examples_of_the_help_are_valid_command_lines() -> None:
    lines = [line.split("  ")[1].split() for line in cli.EXAMPLES.splitlines()[1:]]
    for name, command, *argv in lines:
        assert name == "relnav"
        assert cli._parse(cli.COMMANDS[command], argv) is not None


def test_every_command_and_option_is_documented() -> None:
    page = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    for command in cli.COMMANDS.values():
        assert f"## relnav {command.name}" in page
        parser = argparse.ArgumentParser()
        if command.add_options is not None:
            command.add_options(parser)
        options = {o for action in parser._actions for o in action.option_strings if o.startswith("--")} - {"--help"}
        assert not {o for o in options if f"`{o}" not in page}


@pytest.mark.parametrize(
    ("argv", "part"),
    [
        (["smoth"], "no command smoth, did you mean smooth?"),
        (["smooth"], "FLIGHT"),
        (["smooth", "a", "--metod=graph"], "unknown argument --metod=graph, did you mean --method?"),
        (["smooth", "a", "b"], "unknown argument b"),
        (["smooth", "a", "--rate", "fast"], "--rate: give imu or a rate in Hz, not fast"),
        (["smooth", "a", "--rate=-5"], "--rate: give imu or a rate in Hz, not -5"),
        (["simulate", "two-uav"], "OUT"),
        (["simulate", "two-uav", "out", "--seed", "x"], "--seed"),
        (["report"], "SOLUTION"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_2(argv: list[str], part: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(argv) == guard.FAILED
    assert part in one_error_line(capsys.readouterr().err)


@pytest.mark.parametrize("command", ["smooth", "check"])
def test_a_missing_flight_is_one_line_and_2(command: str, tmp_path: Path) -> None:
    done = relnav(command, "no-such-flight", cwd=tmp_path)
    assert done.returncode == guard.FAILED
    assert "no-such-flight" in one_error_line(done.stderr)
    assert not list(tmp_path.iterdir())  # and no empty folder of results


@pytest.mark.usefixtures("unguarded")
def test_an_unknown_key_names_file_key_and_the_nearest(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = flight / "flight.toml"
    file.write_text(file.read_text(encoding="utf-8").replace("[[vehicle.positions]]", "[[vehicle.position]]"), encoding="utf-8")
    assert cli.main(["smooth", str(flight), "--out", str(flight / "out")]) == guard.FAILED
    line = one_error_line(capsys.readouterr().err)
    assert "flight.toml" in line and "unknown key position" in line and "did you mean positions" in line


@pytest.mark.usefixtures("unguarded")
def test_an_unknown_method_is_told_with_the_known_ones(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["smooth", str(flight), "--method", "grap", "--out", str(flight / "out")]) == guard.FAILED
    assert "did you mean graph?" in one_error_line(capsys.readouterr().err)


def test_a_file_in_the_way_of_the_results_is_told_before_any_work(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    in_the_way = flight / "fixes.csv"
    assert cli.main(["smooth", str(flight), "--out", str(in_the_way / "out")]) == guard.FAILED
    assert f"{in_the_way} is a file" in one_error_line(capsys.readouterr().err)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="a folder nobody may write in is needed, such as /proc")
def test_a_folder_that_refuses_files_is_told_before_any_work(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["smooth", str(flight), "--out", "/proc/self/out"]) == guard.FAILED
    assert "/proc/self/out" in one_error_line(capsys.readouterr().err)


@pytest.mark.usefixtures("plugins")
def test_smooth_writes_results_prints_a_summary_and_their_place(flight: Path) -> None:
    done = relnav("smooth", flight, "--method", "example", cwd=flight)
    assert (done.returncode, done.stderr) == (guard.DONE, "")
    out = flight / "relnav-out" / "walk"
    assert {path.name for path in out.iterdir()} == {"export", "report.html", "solution", "summary.json"}
    assert str(Path("relnav-out", "walk", "report.html")) in done.stdout
    assert "baseline" in done.stdout
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["name"] == "walk" and summary["degraded"] is False and len(summary["rows"]) > 5


@pytest.mark.usefixtures("plugins", "unguarded")
def test_a_saved_solution_gives_its_report_again(flight: Path) -> None:
    out = flight / "one"
    assert cli.main(["smooth", str(flight), "--method", "example", "--no-report", "--out", str(out)]) == guard.DONE
    assert not (out / "report.html").exists()
    for folder in (out, out / "solution"):
        assert cli.main(["report", str(folder)]) == guard.DONE
        (out / "report.html").unlink()


@pytest.mark.usefixtures("plugins", "unguarded")
def test_a_rate_changes_the_export_and_not_the_solution(flight: Path) -> None:
    out = flight / "out"
    argv = ["smooth", str(flight), "--method", "example", "--no-report", "--out", str(out)]
    rows = {}
    for rate in ([], ["--rate", "4"], ["--rate", "imu"]):
        assert cli.main([*argv, *rate]) == guard.DONE
        lines = [len(path.read_text("utf-8").splitlines()) for path in (out / "export").glob("[vp]*-*.csv")]
        rows[" ".join(rate)] = lines
        assert len(solutions.load(out / "solution").vehicles[0].t_s) == 60
    assert set(rows[""]) == {61}
    assert set(rows["--rate 4"]) == {1 + 59 * 4 + 1}
    assert rows["--rate imu"] == rows[""]  # no vehicle of this flight has one


@pytest.mark.usefixtures("unguarded")
def test_figures_without_matplotlib_are_refused_before_any_work(
    flight: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("scenarios.commands.find_spec", lambda name: None)
    assert cli.main(["smooth", str(flight), "--figures", "--out", str(flight / "out")]) == guard.FAILED
    assert "pip install matplotlib" in one_error_line(capsys.readouterr().err)


@pytest.mark.usefixtures("unguarded")
def test_a_folder_that_is_not_a_solution_is_not_replaced(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (flight / "solution").mkdir()
    assert cli.main(["smooth", str(flight), "--out", str(flight)]) == guard.FAILED
    assert "choose another --out" in one_error_line(capsys.readouterr().err)


@pytest.mark.usefixtures("plugins", "unguarded")
def test_a_degraded_result_is_written_told_and_1(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = flight / "out"
    assert cli.main(["smooth", str(flight), "--method", "degraded", "--out", str(out)]) == guard.DEGRADED
    err = capsys.readouterr().err
    assert "no position from 3 s to 9 s" in err and "iteration limit" in err
    assert (out / "report.html").exists()


@pytest.mark.usefixtures("plugins", "unguarded")
def test_dropped_rows_are_told(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (flight / "fixes.csv").open("a", encoding="utf-8") as file:
        file.write("20,abc,1,2\n")
    argv = ["smooth", str(flight), "--method", "example", "--no-report", "--out", str(flight / "out")]
    assert cli.main(argv) == guard.DONE
    err = capsys.readouterr().err
    assert "fixes.csv" in err and "dropped 1" in err


@pytest.mark.usefixtures("plugins", "unguarded")
@pytest.mark.parametrize(("failing", "left"), [("writers.write_all", ["solution"]), ("solutions.save", [])])
def test_a_full_disk_is_one_line_and_what_was_finished_survives(
    failing: str, left: list[str], flight: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(solution: Solution, path: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(f"scenarios.{failing}", full)
    out = flight / "out"
    assert cli.main(["smooth", str(flight), "--method", "example", "--out", str(out)]) == guard.FAILED
    line = one_error_line(capsys.readouterr().err)
    assert os.strerror(errno.ENOSPC) in line
    assert (f"results so far are in {out}" if left else "nothing is written yet") in line
    assert sorted(path.name for path in out.glob("*")) == left


@posix
@pytest.mark.usefixtures("plugins")
def test_a_report_that_cannot_be_written_leaves_the_solution(flight: Path) -> None:
    command = ["sh", "-c", 'ulimit -f 1000; exec "$@"', "sh", *_command(("smooth", flight, "--method", "example"))]
    done = subprocess.run(command, capture_output=True, text=True, cwd=flight, env=_env(), check=False)
    assert done.returncode == guard.FAILED
    line = one_error_line(done.stderr)
    assert os.strerror(errno.EFBIG) in line and "results so far are in" in line
    assert sorted(path.name for path in (flight / "relnav-out" / "walk").iterdir()) == ["export", "solution", "summary.json"]


@posix
@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(("send", "name"), [("kill", "SIGINT"), ("killpg", "SIGINT"), ("kill", "SIGTERM")])
def test_an_interrupt_stops_with_130_and_says_what_is_left(send: str, name: str, flight: Path, tmp_path: Path) -> None:
    ready = tmp_path / "ready"
    env = {**_env(), "SLOW_READY": str(ready)}
    command = interruptible(_command(("smooth", flight, "--method", "slow")))
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=flight, env=env, start_new_session=True) as process:
        _wait_for(ready)
        started = time.monotonic()
        getattr(os, send)(process.pid, getattr(signal, name))
        _, err = process.communicate(timeout=60)
    assert process.returncode == guard.INTERRUPTED
    assert err == "relnav: stopped; nothing is written yet\n"
    assert time.monotonic() - started < 20
    assert not (flight / "relnav-out").exists()


def _wait_for(path: Path) -> None:
    deadline = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@posix
@pytest.mark.usefixtures("plugins")
def test_a_crash_of_native_code_is_one_line_and_keeps_its_trace(flight: Path) -> None:
    done = relnav("smooth", flight, "--method", "crashing", cwd=flight)
    assert done.returncode == guard.FAILED
    line = one_error_line(done.stderr)
    assert "SIGSEGV" in line and "'reading address zero'" in line
    trace = flight / "relnav-out" / "walk" / guard.CRASH_FILE
    assert str(trace.relative_to(flight)) in line
    assert "plugin_methods.py" in trace.read_text(encoding="utf-8")


@pytest.mark.usefixtures("plugins")
def test_an_error_in_a_method_is_a_traceback_and_3(flight: Path) -> None:
    done = relnav("smooth", flight, "--method", "buggy", cwd=flight)
    assert done.returncode == guard.BUG
    assert "ZeroDivisionError" in done.stderr and "please report" in done.stderr


def test_check_tells_what_a_flight_holds(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(flight)]) == guard.DONE
    assert "walker" in capsys.readouterr().out
    assert cli.main(["check", str(flight), "--json"]) == guard.DONE
    (sensor,) = json.loads(capsys.readouterr().out)["sensors"]
    assert sensor["samples"] == 20 and sensor["from s"] == 0.0 and sensor["to s"] == 19.0


@pytest.mark.usefixtures("unguarded")
def test_a_simulated_flight_is_one_that_check_reads(tmp_path: Path) -> None:
    scenario, flight = tmp_path / "one.toml", tmp_path / "sim"
    scenario.write_text(SCENARIO, encoding="utf-8")
    assert cli.main(["simulate", str(scenario), str(flight), "--seed", "3"]) == guard.DONE
    assert cli.main(["check", str(flight)]) == guard.DONE


def test_a_demo_shows_every_flight_and_a_failure_hides_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = {"subject": "a → b", "quantity": "baseline σ, median", "value": 0.0123, "unit": "m", "text": "0.0123 m"}

    def run(argv: list[str], out: Path, quiet: bool = False) -> int:
        if argv[:2] == ["smooth", "kitti"]:
            return guard.FAILED
        out.mkdir(parents=True, exist_ok=True)
        (out / "summary.json").write_text(json.dumps({"rows": [row]}), encoding="utf-8")
        (out / "report.html").touch()
        return guard.DONE

    monkeypatch.setattr(guard, "run", run)
    assert cli.main(["demo", "--out", str(tmp_path)]) == guard.DEGRADED
    out = capsys.readouterr().out
    assert out.count("0.0123 m") == 3 and out.count("report.html") == 3
    assert next(line for line in out.splitlines() if "kitti" in line).split("│")[2].strip() == "failed"


def test_quantities_the_demo_shows_are_in_the_summary() -> None:
    quantities = {row.quantity for row in summary_rows(example_solution(n=60))}
    assert {quantity for shown in demo.COLUMNS.values() for quantity in shown} <= quantities


@pytest.mark.usefixtures("plugins")
def test_methods_lists_installed_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["methods"]) == guard.DONE
    out = capsys.readouterr().out
    assert "graph" in out and "from plugins" in out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full stands for a full disk")
def test_results_that_cannot_be_printed_are_one_line_and_2(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            _command(("methods",)), stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=_env(), check=False
        )
    assert done.returncode == guard.FAILED
    one_error_line(done.stderr)


def test_settings_change_by_dotted_keys() -> None:
    settings = override(
        Settings(), ["ambiguity.fix=false", "robust.code.width=3", "max_iterations=7", "robust.range.kernel=huber"]
    )
    assert settings.ambiguity.fix is False
    assert settings.robust["code"].width == 3.0
    assert settings.max_iterations == 7
    assert settings.robust["range"].kernel == "huber"
    assert settings.robust["phase"] == Settings().robust["phase"]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("fix", "KEY=VALUE"),
        ("ambigity.fix=false", "did you mean ambiguity?"),
        ("ambiguity=1", "ambiguity is a table of fix"),
        ("max_iterations=seven", "integer"),
        ("robust.code.kernel=hubr", "'huber'"),
        ("robust.code.width=-1", "positive"),
        ("tolerance=nan", "finite"),
    ],
)
def test_a_wrong_setting_names_itself_and_what_would_help(text: str, part: str) -> None:
    with pytest.raises(InputError) as caught:
        override(Settings(), [text])
    assert text in str(caught.value) and part in str(caught.value)
