"""Runs a study: finds what is left to do, has an engine do it, stores every result, lets the study finish.

What is done stays done: a run that was stopped goes on where it was, also with more trials than before.
"""

from __future__ import annotations

import argparse
import pickle
import re
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from factorgraph.errors import InputError
from scenarios.studies import store
from scenarios.studies.engines import Done, Engine, Task
from scenarios.studies.store import State, Store
from scenarios.studies.study import Job, Outcome, Results, Study

KEY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+=-]{0,99}")
UNNOTED = ("name", "out", "workers", "engine")


@dataclass(frozen=True, slots=True)
class Failure:
    """A job that failed, why, and the file that tells all."""

    key: str
    why: str
    path: Path


@dataclass(frozen=True, slots=True)
class Tally:
    """How far a run is."""

    total: int
    kept: int = 0  # results of earlier runs that are used
    outdated: int = 0  # files of other parameters or another version, done again
    damaged: int = 0  # files that do not check, done again
    done: int = 0  # by this run
    failed: tuple[Failure, ...] = ()
    elapsed_s: float = 0.0

    @property
    def stored(self) -> int:
        """Results that are there."""
        return self.kept + self.done

    @property
    def fraction(self) -> float:
        return (self.stored + len(self.failed)) / self.total

    @property
    def text(self) -> str:
        """Numbers, rate and time left."""
        parts = [f"{self.stored} of {self.total}"]
        if self.failed:
            parts.append(f"{len(self.failed)} failed")
        tried = self.done + len(self.failed)
        left = self.total - self.stored - len(self.failed)
        if tried and self.elapsed_s > 0:
            rate = tried / self.elapsed_s
            parts.append(f"{rate:.1f}/s" if rate >= 1 else f"{60 * rate:.1f}/min")
            if left:
                parts.append(f"{_duration(left / rate)} left")
        return ", ".join(parts)


Progress = Callable[[Tally], None]


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def run(
    study: Study, options: argparse.Namespace, folder: Path, engine: Engine, progress: Progress | None = None
) -> tuple[Tally, Outcome]:
    """Do the jobs that `folder` does not hold yet, then let the study finish. `progress` hears of every change.

    Raises InputError for wrong options, a folder in use or of another study, a failed write, or when every job failed;
    what is stored stays.
    """
    jobs = study.jobs(options)
    _check(study, jobs)
    own = {name: value for name, value in vars(options).items() if name not in UNNOTED}
    kept = Store(folder)
    with kept.claimed(study.name, {"options": own, "jobs": len(jobs)}):
        tally = _do(study, jobs, kept, engine, progress or (lambda tally: None))
        files = {job: kept.path(job.key) for job in jobs if job.key not in {f.key for f in tally.failed}}
        if not files:
            raise InputError(f"every trial failed, the first with {tally.failed[0].why}; see {tally.failed[0].path}")
        return tally, study.finish(Results(files), folder, options)


def _check(study: Study, jobs: Sequence[Job]) -> None:
    """Raises InputError for keys that cannot name files."""
    if not jobs:
        raise InputError(f"nothing to do: these options leave no trial of the study {study.name}")
    seen: set[str] = set()
    for job in jobs:
        if not KEY.fullmatch(job.key):
            raise InputError(f"study {study.name}: a trial cannot be filed as {job.key!r}; use letters, digits and . _ + - =")
        if job.key.lower() in seen:  # some file systems do not tell case
            raise InputError(f"study {study.name}: two trials are named {job.key}")
        seen.add(job.key.lower())


def _do(study: Study, jobs: Sequence[Job], kept: Store, engine: Engine, progress: Progress) -> Tally:
    headers = {job: store.header(study.name, job.parameters) for job in jobs}
    states = {job: kept.state(job.key, told["digest"]) for job, told in headers.items()}
    count = list(states.values()).count
    tally = Tally(len(jobs), kept=count(State.DONE), outdated=count(State.OUTDATED), damaged=count(State.DAMAGED))
    progress(tally)
    tasks: list[Task] = [
        (job, pickle.dumps(partial(work, study, job, headers[job]))) for job, state in states.items() if state is not State.DONE
    ]
    start = time.monotonic()
    with closing(engine(tasks)) as replies:
        for job, reply in replies:
            if isinstance(reply, Done):
                kept.put(job.key, reply.packed)
                tally = replace(tally, done=tally.done + 1)
            else:
                kept.put_failure(job.key, reply.details)
                tally = replace(tally, failed=(*tally.failed, Failure(job.key, reply.why, kept.failure(job.key))))
            tally = replace(tally, elapsed_s=time.monotonic() - start)
            progress(tally)
    return tally


def work(study: Study, job: Job, told: Mapping[str, Any]) -> bytes:
    """A job's packed result; its header tells the time it took as well."""
    start = time.perf_counter()
    arrays = study.run(job)
    return store.pack(arrays, {**told, "runtime_s": round(time.perf_counter() - start, 3)})
