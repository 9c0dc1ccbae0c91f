"""Studies that only tests use, installed through the entry-point group as a user's own would be."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph.errors import InputError
from scenarios.studies.study import Job, Outcome, Results, seeds


class Sums:
    """Sums random numbers; a file RUNS (environment) counts what is run."""

    name = "sums"
    summary = "sums of random numbers"

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--numbers", type=int, default=3)

    def jobs(self, options: argparse.Namespace) -> list[Job]:
        if options.numbers < 0:
            raise InputError(f"--numbers: {options.numbers} is negative")
        every = seeds(options, usual=6, quick=2)
        return [Job(f"s{seed:03d}", {"seed": seed, "n": options.numbers}) for seed in every if options.numbers]

    def run(self, job: Job) -> Mapping[str, NDArray[Any]]:
        if "RUNS" in os.environ:
            with open(os.environ["RUNS"], "a", encoding="utf-8") as file:
                file.write(f"{job.key}\n")
        numbers = np.random.default_rng(job.parameters["seed"]).normal(size=job.parameters["n"])
        threads = np.array([os.environ.get(name, "") for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")])
        return {"all/numbers": numbers.astype(np.float32), "sum": np.array(numbers.sum()), "threads": threads}

    def finish(self, results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
        by_seed = results.keyed(lambda job: int(job.parameters["seed"]))
        total = {seed: float(arrays["sum"]) for seed, arrays in by_seed.items()}
        (folder / "summary.json").write_text(json.dumps(total), encoding="utf-8")
        return Outcome((f"{len(total)} sums",), ("the sums mean nothing",) if options.numbers == 13 else ())


class Stumbling(Sums):
    """Seed 2 raises; seed 3 reads address zero; seed 4 returns what cannot be stored."""

    name = "stumbling"

    def run(self, job: Job) -> Mapping[str, NDArray[Any]]:
        seed = job.parameters["seed"]
        if seed == 2:
            raise ZeroDivisionError("two is too much\nfor me")
        if seed == 3:
            ctypes.string_at(0)
        return {"objects": np.array([None])} if seed == 4 else super().run(job)


class Hopeless(Sums):
    """Every trial raises."""

    name = "hopeless"

    def run(self, job: Job) -> Mapping[str, NDArray[Any]]:
        raise ZeroDivisionError


class Sleeping(Sums):
    """From seed 3 on, waits for Ctrl-C after it has said so in the file that SLOW_READY names."""

    name = "sleeping"

    def run(self, job: Job) -> Mapping[str, NDArray[Any]]:
        if job.parameters["seed"] >= 3 and "SLOW_READY" in os.environ:
            Path(os.environ["SLOW_READY"]).write_text(str(os.getpid()), encoding="utf-8")
            time.sleep(60)
        return super().run(job)


class Misnamed(Sums):
    """Keys that no file can have."""

    name = "misnamed"

    def jobs(self, options: argparse.Namespace) -> list[Job]:
        return [Job("a/b"), Job("../c")]


class Twins(Sums):
    """Two trials of one name."""

    name = "twins"

    def jobs(self, options: argparse.Namespace) -> list[Job]:
        return [Job("a"), Job("A")]


INSTANCE = Sums()
INSTANCE.name = "instance"


def nothing() -> bytes:
    """A task."""
    return b""
