"""Studies: what is done stays done, a trial that fails stops no other, interrupts, locks, wrong input, engines."""

from __future__ import annotations

import argparse
import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.named import Named
from scenarios import cli, guard
from scenarios.studies import catalogue, engines, store
from scenarios.studies.engines import Done, Failed, Replies, Task, execute
from scenarios.studies.runner import Tally, run
from scenarios.studies.store import State, Store
from scenarios.studies.study import Job, Outcome, Results, seeds
from tests.helpers import install_entry_points, interruptible
from tests.scenarios import plugin_studies
from tests.scenarios.plugin_studies import Hopeless, Misnamed, Stumbling, Sums, Twins

STUDIES = ("Sums", "Stumbling", "Hopeless", "Sleeping", "INSTANCE")
posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


def inline(tasks: Sequence[Task]) -> Replies:
    """An engine without processes."""
    for job, packed in tasks:
        yield job, execute(packed)


def options(**changes: object) -> argparse.Namespace:
    return argparse.Namespace(**{"trials": None, "seed": 1, "quick": False, "numbers": 3, **changes})


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file in which every run of a trial leaves its key."""
    path = tmp_path / "runs"
    path.touch()
    monkeypatch.setenv("RUNS", str(path))
    return path


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Installs the studies of `plugin_studies` under their names in lower case, for child processes too."""
    install_entry_points(tmp_path, monkeypatch, catalogue.STUDIES.group, "tests.scenarios.plugin_studies", STUDIES)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def unspawned(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line without worker processes."""
    monkeypatch.setattr(engines, "choose", lambda text, workers: inline)


def relnav(*argv: object) -> int:
    return cli.main(["study", *map(str, argv)])


def done_now(runs: Path) -> list[str]:
    """The trials that were run since the last question."""
    keys = runs.read_text(encoding="utf-8").split()
    runs.write_text("", encoding="utf-8")
    return keys


# what is done stays done


def test_results_are_stored_and_handed_over(tmp_path: Path) -> None:
    seen: list[Tally] = []
    tally, outcome = run(Sums(), options(numbers=5), tmp_path, inline, seen.append)
    assert (tally.total, tally.done, tally.kept, tally.failed) == (6, 6, 0, ())
    assert outcome == Outcome(("6 sums",))
    assert [t.done for t in seen] == [0, 1, 2, 3, 4, 5, 6] and seen[-1].fraction == 1.0
    arrays = store.read(tmp_path / "trials" / "s004.npz")
    assert set(arrays) == {"all/numbers", "sum", "threads"}
    expected = np.random.default_rng(4).normal(size=5)
    np.testing.assert_array_equal(arrays["all/numbers"], expected.astype(np.float32))
    assert arrays["all/numbers"].dtype == np.float32
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert list(summary) == [str(seed) for seed in range(1, 7)] and summary["4"] == expected.sum()


def test_a_second_run_does_only_what_is_new(tmp_path: Path, runs: Path) -> None:
    run(Sums(), options(trials=2), tmp_path, inline)
    assert done_now(runs) == ["s001", "s002"]
    tally, outcome = run(Sums(), options(trials=4), tmp_path, inline)
    assert done_now(runs) == ["s003", "s004"]
    assert (tally.kept, tally.done) == (2, 2) and outcome.lines == ("4 sums",)
    tally, outcome = run(Sums(), options(trials=3), tmp_path, inline)  # what was not asked for is not shown
    assert done_now(runs) == [] and outcome.lines == ("3 sums",)


@pytest.mark.parametrize("what", ["parameters", "version"])
def test_results_of_other_parameters_or_another_version_are_done_again(
    what: str, tmp_path: Path, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(Sums(), options(trials=2), tmp_path, inline)
    done_now(runs)
    if what == "version":
        monkeypatch.setattr(store, "relnav_version", lambda: "0.0.0")
    tally, _ = run(Sums(), options(trials=2, numbers=4 if what == "parameters" else 3), tmp_path, inline)
    assert done_now(runs) == ["s001", "s002"] and (tally.outdated, tally.kept) == (2, 0)


def test_damaged_files_are_counted_and_done_again(tmp_path: Path, runs: Path) -> None:
    run(Sums(), options(), tmp_path, inline)
    done_now(runs)
    trials = tmp_path / "trials"
    whole = (trials / "s001.npz").read_bytes()
    (trials / "s001.npz").write_bytes(whole[: len(whole) // 2])
    (trials / "s002.npz").write_bytes(b"")
    (trials / "s003.npz").write_bytes(bytes(200))
    (trials / "s004.npz").unlink()
    (trials / ".s005.npz.part-1").write_bytes(b"of a run that was killed")
    tally, _ = run(Sums(), options(), tmp_path, inline)
    assert done_now(runs) == ["s001", "s002", "s003", "s004"]
    assert (tally.damaged, tally.kept, tally.done) == (3, 2, 4)
    assert sorted(path.name for path in trials.iterdir()) == [f"s00{i}.npz" for i in range(1, 7)]


def test_no_damage_goes_unnoticed(tmp_path: Path) -> None:
    """Whatever bytes change, a file is refused, or what it holds is what was stored."""
    told = store.header("sums", {"seed": 1})
    arrays = {"a/x": np.arange(40.0), "names": np.array(["G01", "G02"])}
    kept, packed, rng = Store(tmp_path), store.pack(arrays, told), np.random.default_rng(1)
    kept.put("job", packed)
    assert kept.state("job", told["digest"]) is State.DONE
    refused = 0
    for _ in range(300):
        bad = bytearray(packed)
        bad[rng.integers(len(bad))] ^= 1 << int(rng.integers(8))
        kept.path("job").write_bytes(bad)
        if kept.state("job", told["digest"]) is State.DONE:
            for name, array in store.read(kept.path("job")).items():
                np.testing.assert_array_equal(array, arrays[name])
        else:
            refused += 1
    assert refused > 200


def test_a_file_damaged_meanwhile_is_named(tmp_path: Path) -> None:
    run(Sums(), options(trials=1), tmp_path, inline)
    path = tmp_path / "trials" / "s001.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"s001\.npz: the results are damaged .* run the study again"):
        Results({"one": path})["one"]


@pytest.mark.usefixtures("plugins", "unspawned")
def test_a_full_disk_is_one_line_and_loses_nothing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    write, left = Path.write_bytes, [1, 1]

    def limited(path: Path, data: bytes) -> int:
        if not left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        left.pop()
        return write(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", limited)
        assert relnav("sums", "--out", "out") == guard.FAILED
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("relnav: error: cannot write") and os.strerror(errno.ENOSPC) in error
    assert "2 of 6 trials are kept in out; the same command goes on from there" in error
    assert relnav("sums", "--out", "out") == guard.DONE
    assert "relnav: 2 of 6 trials are kept from an earlier run" in capsys.readouterr().err


# trials that fail


@pytest.mark.usefixtures("plugins")
def test_a_trial_that_fails_or_crashes_stops_no_other(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert relnav("stumbling", "--workers", 2) == guard.DEGRADED
    out, err = capfd.readouterr()
    assert out.splitlines() == ["3 sums"]
    folder = Path("relnav-out", "study-stumbling")
    lines = err.splitlines()
    assert f"relnav: trial s002 failed: ZeroDivisionError: two is too much; see {folder / 'failed' / 's002.txt'}" in lines
    assert any(line.startswith("relnav: trial s003 failed: its process ended (") for line in lines)
    assert any(line.startswith("relnav: trial s004 failed: ValueError: Object arrays") for line in lines)
    assert lines[-1] == f"relnav: degraded: 3 of 6 trials failed; see {folder / 'failed'}"
    assert sum(line.startswith("trials: ") for line in lines) == 6
    assert "Traceback" not in err and "Fatal" not in err
    assert "plugin_studies.py" in (folder / "failed" / "s003.txt").read_text(encoding="utf-8")  # where it crashed
    for key in ("s001", "s005", "s006"):  # the same numbers as without processes, from one thread
        arrays = store.read(folder / "trials" / f"{key}.npz")
        assert list(arrays["threads"]) == ["1", "1"]
        here = Sums().run(Job(key, {"seed": int(key[1:]), "n": 3}))
        np.testing.assert_array_equal(arrays["all/numbers"], here["all/numbers"])


def test_a_failure_is_forgotten_when_the_trial_succeeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: Path) -> None:
    study = Stumbling()
    tally, _ = run(study, options(trials=2), tmp_path, inline)
    (failure,) = tally.failed
    assert "for me" in failure.path.read_text(encoding="utf-8")
    done_now(runs)
    monkeypatch.setattr(Stumbling, "run", Sums.run)
    tally, _ = run(study, options(trials=2), tmp_path, inline)
    assert done_now(runs) == ["s002"] and tally.failed == () and not failure.path.exists()


def test_when_every_trial_fails_there_is_nothing_to_finish(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"every trial failed, the first with ZeroDivisionError; see .*s001\.txt"):
        run(Hopeless(), options(), tmp_path, inline)
    assert not (tmp_path / "summary.json").exists()


def test_a_task_that_cannot_be_unpacked_is_a_failure() -> None:
    reply = execute(pickle.dumps(np.array)[:-3])
    assert isinstance(reply, Failed) and "Traceback" in reply.details


# interrupts and locks


@posix
@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(("send", "name"), [("killpg", "SIGINT"), ("kill", "SIGTERM")])
def test_an_interrupt_keeps_what_is_done(
    send: str, name: str, tmp_path: Path, runs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ready = tmp_path / "ready"
    argv = ["sleeping", "--trials", "4", "--workers", "1", "--out", "out"]
    code = interruptible([sys.executable, "-m", "scenarios", "study", *argv])
    env = {**os.environ, "SLOW_READY": str(ready)}
    with subprocess.Popen(code, stderr=subprocess.PIPE, text=True, env=env, start_new_session=True) as process:
        worker = _read_when_there(ready)
        started = time.monotonic()
        getattr(os, send)(process.pid, getattr(signal, name))
        _, err = process.communicate(timeout=60)
    assert process.returncode == guard.INTERRUPTED
    lines = [line for line in err.splitlines() if not line.startswith("trials: ")]
    assert lines == ["relnav: stopped; 2 of 4 trials are kept in out; the same command goes on from there"]
    assert time.monotonic() - started < 10
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)
    done_now(runs)
    assert relnav(*argv) == guard.DONE
    assert done_now(runs) == ["s003", "s004"] and "2 of 4 trials are kept" in capfd.readouterr().err


def _read_when_there(path: Path) -> int:
    deadline = time.monotonic() + 60
    while not path.exists() or not path.read_text(encoding="utf-8"):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return int(path.read_text(encoding="utf-8"))


@pytest.mark.usefixtures("plugins", "unspawned")
def test_an_interrupt_before_the_first_result_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(study: Sums, job: Job) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Sums, "run", interrupted)
    before = signal.getsignal(signal.SIGTERM)
    assert relnav("sums") == guard.INTERRUPTED
    assert capsys.readouterr().err == "relnav: stopped; no trial is finished yet\n"
    assert signal.getsignal(signal.SIGTERM) is before


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with Store(tmp_path).claimed("sums", {}):
        with pytest.raises(InputError, match=f"is in use by process {os.getpid()} on .*; wait, or choose another --out"):
            run(Sums(), options(), tmp_path, inline)
    assert (tmp_path / store.LOCK).exists()  # as after a run that was killed: the file alone keeps nobody out
    run(Sums(), options(), tmp_path, inline)


def test_a_folder_belongs_to_one_study(tmp_path: Path, runs: Path) -> None:
    run(Sums(), options(), tmp_path, inline)
    with pytest.raises(InputError, match="holds the study sums; choose another --out"):
        run(Stumbling(), options(), tmp_path, inline)
    (tmp_path / store.ASKED).write_text("{", encoding="utf-8")
    done_now(runs)
    run(Sums(), options(), tmp_path, inline)
    asked = json.loads((tmp_path / store.ASKED).read_text(encoding="utf-8"))
    assert asked["study"] == "sums" and asked["options"]["numbers"] == 3 and asked["jobs"] == 6
    assert done_now(runs) == []


# the command line


@pytest.mark.usefixtures("plugins")
def test_without_a_name_all_studies_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert relnav() == guard.DONE
    out = capsys.readouterr().out
    assert all(name in out for name in ("sums", "stumbling", "from plugins"))
    assert all(info.name in out for info in catalogue.STUDIES.built_in)


@pytest.mark.parametrize("info", catalogue.STUDIES.built_in, ids=lambda info: info.name)
def test_our_studies_are_as_listed(info: Named) -> None:
    study = catalogue.create(info.name)
    assert (study.name, study.summary) == (info.name, info.summary)
    study.add_options(argparse.ArgumentParser())


@pytest.mark.usefixtures("plugins")
def test_help_of_a_study_tells_its_own_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        relnav("sums", "--help")
    out = capsys.readouterr().out
    assert "--numbers" in out and "--trials" in out and "Sums of random numbers" in out
    with pytest.raises(SystemExit):
        relnav("--help")
    assert "--numbers" not in capsys.readouterr().out


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(
    ("argv", "part"),
    [
        (["sms"], "no study named sms; did you mean sums?"),
        (["sums", "--trials", "0"], "--trials: give a whole number from 1 on, not 0"),
        (["sums", "--trials", "1.5"], "not 1.5"),
        (["sums", "--workers", "0"], "--workers: give a whole number from 1 on"),
        (["sums", "--seed=-1"], "--seed: give a whole number from 0 on"),
        (["sums", "--engine", "spark"], "give local or dask://HOST:PORT, not spark"),
        (["sums", "--engine", "dask://here"], "give local or dask://HOST:PORT"),
        (["sums", "--engine", "dask://here:1", "--workers", "3"], "--workers belongs to the engine local"),
        (["sums", "--number", "3"], "unknown argument --number, did you mean --numbers?"),
        (["--numbers", "3"], "no study named 3"),
        (["sums", "--numbers", "-2"], "--numbers: -2 is negative"),
        (["sums", "--numbers", "0"], "these options leave no trial of the study sums"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_2(argv: list[str], part: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert relnav(*argv) == guard.FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("relnav: error: ") and part in line
    assert not Path("relnav-out").exists()


@pytest.mark.usefixtures("plugins", "unspawned")
def test_warnings_of_a_study_make_it_degraded(capsys: pytest.CaptureFixture[str]) -> None:
    assert relnav("instance", "--quick", "--numbers", 13) == guard.DEGRADED
    out, err = capsys.readouterr()
    assert out == "2 sums\n" and err.splitlines()[-1] == "relnav: degraded: the sums mean nothing"


@pytest.mark.usefixtures("plugins", "unspawned")
def test_progress_is_one_line_for_every_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    assert relnav("sums", "--trials", 50, "--seed", 7) == guard.DONE
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [f"trials: {n} of 50" for n in range(5, 51, 5)]
    assert all(" left" in line for line in lines[:-1]) and " left" not in lines[-1]
    assert sorted(path.name for path in Path("relnav-out", "study-sums", "trials").iterdir())[0] == "s007.npz"


def test_rate_and_time_left() -> None:
    tally = Tally(total=100, kept=20, done=30, elapsed_s=600.0)
    assert tally.text == "50 of 100, 3.0/min, 17 min left" and tally.fraction == 0.5
    assert Tally(10, done=10, elapsed_s=2.0).text == "10 of 10, 5.0/s"
    assert Tally(1000, done=1, elapsed_s=60.0).text == "1 of 1000, 1.0/min, 16.6 h left"
    assert Tally(10).text == "0 of 10"


def test_keys_must_name_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a trial cannot be filed as 'a/b'"):
        run(Misnamed(), options(), tmp_path, inline)
    with pytest.raises(InputError, match="two trials are named A"):
        run(Twins(), options(), tmp_path, inline)


def test_seeds_follow_the_options() -> None:
    assert seeds(options(), usual=5, quick=2) == range(1, 6)
    assert seeds(options(quick=True, seed=4), usual=5, quick=2) == range(4, 6)
    assert seeds(options(quick=True, trials=3), usual=5, quick=2) == range(1, 4)


# engines


@contextmanager
def _dask() -> Iterator[str]:
    """A cluster of one worker in this process: its HOST:PORT."""
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp", host="127.0.0.1"
    ) as cluster:
        yield cluster.scheduler_address.removeprefix("tcp://")


def test_a_cluster_gives_the_same_results_and_failures(tmp_path: Path) -> None:
    with _dask() as address:
        engine = engines.choose(f"{engines.DASK}{address}", None)
        tally, _ = run(plugin_studies.INSTANCE, options(trials=3), tmp_path / "cluster", engine)
        replies = dict(engine([(Job("bad"), b"no pickle"), (Job("good"), pickle.dumps(plugin_studies.nothing))]))
    assert tally.done == 3
    run(plugin_studies.INSTANCE, options(trials=3), tmp_path / "here", inline)
    for path in (tmp_path / "here" / "trials").iterdir():
        here, there = store.read(path), store.read(tmp_path / "cluster" / "trials" / path.name)
        assert set(here) == set(there)
        np.testing.assert_array_equal(here["all/numbers"], there["all/numbers"])
    assert isinstance(replies[Job("bad")], Failed) and replies[Job("good")] == Done(b"")


def test_a_cluster_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    monkeypatch.setattr(engines, "CONNECT_S", 1)
    with pytest.raises(InputError, match="no dask scheduler answers there"):
        next(engines.choose("dask://127.0.0.1:9", None)([(Job("one"), b"")]))


def test_workers_by_default_are_the_processors() -> None:
    assert 1 <= engines.choose("local", None).keywords["workers"] <= (os.cpu_count() or 1)  # type: ignore[attr-defined]
    assert engines.choose("local", 7).keywords["workers"] == 7  # type: ignore[attr-defined]
