"""What a study is. One is written as a class, in relnav or in a package of one's own:

    class Lengths:
        name = "lengths"
        summary = "how the baseline error grows with length"

        def add_options(self, parser):                  # options of its own; --trials, --seed, --quick … are there
            parser.add_argument("--lengths", type=float, nargs="+", default=[10.0, 100.0])

        def jobs(self, options):                        # every job is one file: the unit of resuming and of failing
            return [Job(f"{length:g}m-{seed:04d}", {"length_m": length, "seed": seed})
                    for length in options.lengths for seed in seeds(options, usual=100, quick=5)]

        def run(self, job):                             # in a worker process: only job.parameters, no global state
            return {"error_m": error_of(**job.parameters)}

        def finish(self, results, folder, options):     # once, here: summary, tables, report
            rms = {job.key: float(np.sqrt(np.mean(arrays["error_m"] ** 2))) for job, arrays in results.items()}
            (folder / "summary.json").write_text(json.dumps(rms))
            return Outcome(lines=(f"{len(rms)} trials",))

It is found by name through the entry-point group `relnav.studies` ("my_package.lengths:Lengths", a class without
parameters or an instance), and then run by `relnav study lengths`. Its class must be importable and its instances small:
they travel to the workers with every job. A job is known by the study's name and its parameters: results of an earlier
run with the same ones are used again, so what changes results (a revision of the model, say) belongs in the parameters.
"""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from factorgraph.errors import InputError
from scenarios.studies import store

Arrays = Mapping[str, NDArray[Any]]  # name -> array of any type but object
K = TypeVar("K")
L = TypeVar("L")


@dataclass(frozen=True, slots=True)
class Job:
    """One piece of a study. Jobs with the same key are equal."""

    key: str  # unique in the study; letters, digits and . _ + - =: it names the file
    parameters: Mapping[str, Any] = field(default_factory=dict, compare=False)  # plain JSON types


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a finished study prints; a warning makes its result degraded."""

    lines: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


class Results(Mapping[K, Arrays]):
    """Stored arrays of the jobs that are done; those of a job are read when asked for, and not kept.

    Raises InputError naming a file that was damaged in the meantime.
    """

    def __init__(self, files: Mapping[K, Path]) -> None:
        self._files = dict(files)

    def __getitem__(self, key: K) -> Arrays:
        return store.read(self._files[key])

    def __iter__(self) -> Iterator[K]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)

    def keyed(self, name: Callable[[K], L]) -> Results[L]:
        """The same results under other keys, for instance of `job.parameters`."""
        return Results({name(key): path for key, path in self._files.items()})


class Study(Protocol):
    """A question, cut into jobs that do not depend on each other."""

    name: str
    summary: str

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add the study's own options to the common ones: trials (None: the usual number), seed (the first), quick."""

    def jobs(self, options: argparse.Namespace) -> Sequence[Job]:
        """What is to be done. Raises InputError for options that do not fit."""

    def run(self, job: Job) -> Arrays:
        """The result of a job, in a worker process with one thread; what it raises is noted as that job's failure."""

    def finish(self, results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
        """Write what the results say to `folder`. Jobs that failed are absent; there is at least one result."""


def seeds(options: argparse.Namespace, usual: int, quick: int) -> range:
    """The seeds asked for: --trials of them, or `usual` or, with --quick, `quick`, from --seed on."""
    number = options.trials if options.trials is not None else quick if options.quick else usual
    return range(options.seed, options.seed + number)


def chosen(what: str, given: Sequence[K], known: Sequence[K]) -> list[K]:
    """What is asked for, once each and in our order. Raises InputError with the nearest name for what there is not."""
    for value in given:
        if value not in known:
            near = difflib.get_close_matches(str(value), [str(k) for k in known], n=1)
            hint = f"; did you mean {near[0]}?" if near else ";"
            raise InputError(f"no {what} {value}{hint} there are {', '.join(map(str, known))}")
    return [value for value in known if value in given]
