"""What the commands do, after parsing: load, call, write, tell.

Results go to stdout, progress and remarks to stderr. Writers put every file in place when it is complete, so an
interrupt or a full disk leaves what was finished before. Heavy rooms are imported where they are used.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from factorgraph.errors import InputError
from factorgraph.measurements import ReadReport
from factorgraph.problem import NavigationProblem, Settings
from factorgraph.solution import Solution, Status
from scenarios import guard
from scenarios import methods as estimators
from scenarios.cli import check_writable, describe_os_error
from scenarios.overrides import override

SOLUTION = "solution"  # folder in the results
PIPE_WIDTH = 100  # columns of a table that is not read on a terminal


class Outputs:
    """A folder of results and what was finished in it."""

    def __init__(self, folder: Path, unfinished: str = "nothing is written yet") -> None:
        self.folder = folder
        self.finished: list[Path] = []
        self._unfinished = unfinished

    def write(self, name: str, writer: Callable[[Path], object]) -> None:
        """Let `writer` write a file or folder that it puts in place by itself."""
        writer(self.folder / name)
        self.finished.append(self.folder / name)

    @property
    def state(self) -> str:
        """What an early end leaves behind."""
        return f"results so far are in {self.folder}" if self.finished else self._unfinished


class Stages:
    """Progress: a bar on stderr when that is a terminal, and a note of each stage to the guard."""

    def __init__(self, trace: guard.Trace | None = None) -> None:
        self._trace = trace
        self._noted = ""
        self._console = Console(stderr=True)
        columns = (SpinnerColumn(), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
        self._bar = Progress(*columns, console=self._console, transient=True, disable=not self._console.is_terminal)
        self._task = self._bar.add_task("", total=None)

    def __enter__(self) -> Stages:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, stage: str, fraction: float | None = None) -> None:
        """Show a stage ("name" or "name: detail") and the fraction done in [0, 1]; None where it is not known."""
        name = stage.partition(":")[0]
        if self._trace is not None and name != self._noted:
            self._trace.stage(name)
            self._noted = name
        if fraction is None:
            self._bar.update(self._task, description=stage, total=None)
        else:
            self._bar.update(self._task, description=stage, total=1.0, completed=fraction)

    @property
    def is_shown(self) -> bool:
        """Whether there is a terminal to show progress on."""
        return self._console.is_terminal

    def say(self, text: str) -> None:
        """A remark on stderr."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def early_end(outputs: Outputs) -> Iterator[None]:
    """Adds to an interrupt or a file system error what is left behind."""
    try:
        yield
    except KeyboardInterrupt:
        raise guard.Stopped(guard.INTERRUPTED, f"stopped; {outputs.state}") from None
    except OSError as error:
        raise guard.Stopped(guard.FAILED, f"error: {describe_os_error(error)}; {outputs.state}") from error
    except InputError as error:
        if not outputs.finished:
            raise
        raise guard.Stopped(guard.FAILED, f"error: {error}; {outputs.state}") from error


def smooth(args: argparse.Namespace) -> int:
    """Estimate a flight and write solution, trajectories, summary and report."""
    outputs = Outputs(args.out)
    check_replaceable(args.out / SOLUTION)
    _check_figures(args)
    with early_end(outputs), Stages(args.trace) as stages:
        problem, solution = _estimate(args, stages)
        _write_results(problem, solution, outputs, stages, args)
    _print_summary(solution)
    return _outcome(solution, outputs, stages)


def check_replaceable(folder: Path) -> None:
    """Saving a solution replaces its folder: raises InputError where that holds something else."""
    from scenarios.solutions import TEXT

    if folder.exists() and not (folder / TEXT).exists():
        raise InputError(f"{folder} is there and not a solution that may be replaced; choose another --out")


def _check_figures(args: argparse.Namespace) -> None:
    if args.figures and find_spec("matplotlib") is None:
        raise InputError("--figures needs matplotlib, which is not installed; try: pip install matplotlib")


def _estimate(args: argparse.Namespace, stages: Stages) -> tuple[NavigationProblem, Solution]:
    stages("loading the engine")
    estimators.create(args.method)  # what is wrong here is told before the files are read
    problem, doubts = read_problem(args, stages)
    stages("solving")
    return problem, solve(problem, doubts, args.method, stages)


def read_problem(args: argparse.Namespace, stages: Stages) -> tuple[NavigationProblem, tuple[str, ...]]:
    """The flight with its settings changed as asked, and what is doubtful in it."""
    override(Settings(), args.set)
    stages("reading the flight")
    from scenarios.flights import load

    flight = load(args.flight, args.data)
    for report in flight.reports:
        _tell_dropped(report, stages)
    problem = dataclasses.replace(flight.problem, settings=override(flight.problem.settings, args.set))
    return problem, tuple(str(finding) for finding in flight.examined.findings)


def solve(problem: NavigationProblem, doubts: tuple[str, ...], method: str, stages: Stages) -> Solution:
    """The solution of a method, with what is doubtful in its input among the warnings."""
    try:
        solution = estimators.solve(problem, method, stages)
    except InputError as error:
        raise InputError(f"{error}; doubtful in the flight: {doubts[0]}" if doubts else str(error)) from error
    return _with_doubts(solution, doubts)


def _with_doubts(solution: Solution, doubts: tuple[str, ...]) -> Solution:
    """The solution with what is doubtful in its input among the warnings."""
    told = dataclasses.replace(solution.diagnostics, warnings=(*doubts, *solution.diagnostics.warnings))
    return dataclasses.replace(solution, diagnostics=told) if doubts else solution


def _tell_dropped(report: ReadReport, stages: Stages) -> None:
    reasons = ", ".join(f"{n} {reason}" for reason, n in report.dropped.items() if n)
    if reasons:
        stages.say(f"{report.source}: {report.n_rows} rows used, dropped {reasons}")
    for note in report.notes:
        stages.say(f"{report.source}: {note}")


def _write_results(
    problem: NavigationProblem, solution: Solution, outputs: Outputs, stages: Stages, args: argparse.Namespace
) -> None:
    from factorgraph.interpolation import resample
    from scenarios import solutions, writers

    stages("writing the results")
    text = json.dumps(summary(solution), indent=1, ensure_ascii=False) + "\n"
    outputs.write(SOLUTION, lambda path: solutions.save(solution, path))
    exported = solution if args.rate is None else resample(solution, problem, args.rate)
    outputs.write("export", lambda path: writers.write_all(exported, path))
    outputs.write("summary.json", lambda path: solutions.replace_with(path, lambda part: part.write_text(text, encoding="utf-8")))
    if not args.no_report:
        stages("writing the report")
        _write_report(solution, outputs)
    if args.figures:
        stages("drawing the figures")
        _write_figures(solution, outputs)


def _write_report(solution: Solution, outputs: Outputs) -> None:
    from scenarios.report.page import write_report
    from scenarios.solutions import replace_with

    outputs.write("report.html", lambda path: replace_with(path, lambda part: write_report(solution, part)))


def _write_figures(solution: Solution, outputs: Outputs) -> None:
    from scenarios.report.figures import write_figures

    outputs.write("figures", lambda path: write_figures(solution, path))


def summary(solution: Solution) -> dict[str, object]:
    """The summary as plain JSON types; numbers that are not known are null."""
    from scenarios.metrics import summary_rows

    rows = [
        {**dataclasses.asdict(r), "value": r.value if math.isfinite(r.value) else None, "text": r.text}
        for r in summary_rows(solution)
    ]
    diagnostics = solution.diagnostics
    return {
        "name": solution.name,
        "method": solution.method,
        "status": diagnostics.status.value,
        "degraded": solution.is_degraded,
        "warnings": list(diagnostics.warnings),
        "rows": rows,
    }


def _print_summary(solution: Solution) -> None:
    from scenarios.metrics import summary_rows

    table = Table(title=f"{solution.name}, method {solution.method}", title_justify="left", header_style="bold")
    table.add_column("of")
    table.add_column("what")
    table.add_column("value", justify="right")
    rows = summary_rows(solution)
    for i, row in enumerate(rows):
        first = i == 0 or rows[i - 1].subject != row.subject
        if first and i:
            table.add_section()
        table.add_row(row.subject if first else "", row.quantity, row.text)
    stdout_console().print(table)


def stdout_console() -> Console:
    """A console for results: as wide as the terminal, or PIPE_WIDTH."""
    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH)


def _outcome(solution: Solution, outputs: Outputs, stages: Stages) -> int:
    """Say what was written and whether it can be trusted; the exit code."""
    for path in outputs.finished:
        print(f"{path.name:<14} {path}")
    for warning in solution.diagnostics.warnings:
        stages.say(f"relnav: degraded: {warning}")
    status = solution.diagnostics.status
    if status is Status.INTERRUPTED:
        stages.say(f"relnav: stopped; {outputs.state}")
        return guard.INTERRUPTED
    if status is not Status.CONVERGED:
        stages.say(f"relnav: degraded: {status.value} after {solution.diagnostics.n_iterations} iterations")
    return guard.DEGRADED if solution.is_degraded else guard.DONE


def simulate(args: argparse.Namespace) -> int:
    """Write a simulated flight folder."""
    from scenarios.simulate import load_scenario
    from scenarios.simulate import simulate as run
    from scenarios.simulate.write import write_flight

    outputs = Outputs(args.out, unfinished=f"no complete flight is in {args.out}")
    with early_end(outputs), Stages(args.trace) as stages:
        stages("simulating")
        flight = run(load_scenario(args.scenario), args.seed)
        stages("writing the flight")
        write_flight(flight, args.out)
    print(f"{args.out / 'flight.toml'}; next: relnav smooth {args.out}")
    return guard.DONE


def check(args: argparse.Namespace) -> int:
    """Tell what a flight holds, and what in it is doubtful (DEGRADED) or cannot be right (InputError, after the tables)."""
    from scenarios.flights import load
    from scenarios.flights.check import as_json, render
    from scenarios.flights.check import check as inspect

    with Stages() as stages:
        stages("reading the flight")
        flight = load(args.flight, args.data, strict=False)
        tables = inspect(flight)
    if args.json:
        print(json.dumps(as_json(tables), indent=1, ensure_ascii=False))
    else:
        stdout_console().print(render(tables))
    findings = flight.examined.findings
    if findings and findings[0].is_wrong:
        raise InputError(str(findings[0]))
    return guard.DEGRADED if findings else guard.DONE


def report(args: argparse.Namespace) -> int:
    """Write the reports of saved solutions again."""
    from scenarios import solutions

    code = guard.DONE
    _check_figures(args)
    for folder in args.solutions:
        outputs = Outputs(folder.parent if folder.name == SOLUTION else folder)
        check_writable(outputs.folder)
        with early_end(outputs), Stages() as stages:
            stages(f"reading {folder}")
            solution = solutions.load(outputs.folder / SOLUTION)
            stages("writing the report")
            _write_report(solution, outputs)
            if args.figures:
                stages("drawing the figures")
                _write_figures(solution, outputs)
        code = max(code, _outcome(solution, outputs, stages))
    return code


def methods(args: argparse.Namespace) -> int:
    """List the estimators."""
    print_catalogue("method", ((info.name, info.summary, info.path) for info in estimators.methods()))
    return guard.DONE


def print_catalogue(kind: str, rows: Iterable[tuple[str, str, str]]) -> None:
    """A table of what can be chosen by name: name, summary and "module:object" of each."""
    table = Table(box=None, header_style="bold")
    for column in (kind, "what it is", "where"):
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*row)
    stdout_console().print(table)
