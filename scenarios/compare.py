"""`relnav compare`: every method in a watched process of its own, then one table and one page of what they found.

A method's folder holds its `solution/`, `summary.json` and `run.json` with what it cost; that one is written last and
removed first, so where it is, the method is finished. It names the fingerprint of the problem that was solved: results of
another flight or other settings are not taken for finished. A method that fails leaves `failure.txt` instead.

Times are those of solving alone, in a process that has read the flight; memory is the largest resident size while solving
over that after reading (Linux: VmHWM, reset before; elsewhere ru_maxrss, which a greedy reader may hide in).
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from factorgraph.errors import InputError
from factorgraph.problem import NavigationProblem
from factorgraph.solution import Status
from scenarios import guard, solutions
from scenarios import methods as estimators
from scenarios.cli import check_writable
from scenarios.commands import (
    SOLUTION,
    Outputs,
    Stages,
    check_replaceable,
    early_end,
    read_problem,
    solve,
    stdout_console,
    summary,
)
from scenarios.comparison import (
    METHOD_METRICS,
    SUBJECT_METRICS,
    Bound,
    Comparison,
    Cost,
    Metric,
    Outcome,
    best_of,
    compared,
    figure,
)
from scenarios.studies.store import relnav_version
from scenarios.writers import file_name

RUN, FAILURE = "run.json", "failure.txt"  # in a method's folder
BOUND, BOUND_FOLDER = "@bound", ".bound"  # the part that is no method
LABEL_WIDTH = 36  # of the first column on a terminal, with its margins and rules


@dataclass(frozen=True, slots=True)
class Part:
    """What a child process does."""

    method: str  # or BOUND
    folder: Path


def compare(args: argparse.Namespace) -> int:
    """Run the methods that are not finished yet, then write and print what all of them found."""
    methods = chosen(args.methods)
    parts = [Part(method, args.out / file_name(method)) for method in methods]
    check_writable(args.out)
    for part in parts:
        check_replaceable(part.folder / SOLUTION)
    outputs = Outputs(args.out)
    with early_end(outputs), Stages() as stages:
        problem, doubts = read_problem(args, stages)
        print_of = fingerprint(problem)
        outcomes = []
        for i, part in enumerate(parts, 1):
            try:
                outcomes.append(_outcome(part, args, print_of, stages, f"[{i}/{len(parts)}] {part.method}"))
            except KeyboardInterrupt:
                kept = f"{len(outputs.finished)} of {len(parts)} methods are finished in {args.out}"
                raise guard.Stopped(guard.INTERRUPTED, f"stopped; {kept}; the same command goes on") from None
            if outcomes[-1].solution is not None:
                outputs.finished.append(part.folder)
        if not outputs.finished:
            raise InputError(f"no method finished: {'; '.join(f'{o.method}: {o.reason}' for o in outcomes)}")
        bound = _bound(problem, args, print_of, stages)
        stages("comparing")
        found = compared(outcomes, problem, bound)
        _write(found, outputs, stages)
    _print(found)
    return _tell(found, doubts, outputs, stages)


def chosen(text: str) -> list[str]:
    """Methods by name. Raises InputError where there is none, or one that is unknown or named twice."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError("say which methods to compare, as --methods graph,…; relnav methods lists them")
    for name in names:
        estimators.METHODS.named(name)
        if names.count(name) > 1:
            raise InputError(f"--methods names {name} twice; once is enough")
    return names


def fingerprint(problem: NavigationProblem) -> str:
    """Digest of everything in a problem, the same for the same flight and settings in every process."""
    digest = hashlib.sha256()
    for piece in _pieces(problem):
        digest.update(piece)
    return digest.hexdigest()


def _pieces(value: Any) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif dataclasses.is_dataclass(value):
        yield type(value).__name__.encode()
        for field in dataclasses.fields(value):
            yield from _pieces(getattr(value, field.name))
    elif isinstance(value, dict):
        yield from _pieces([item for pair in value.items() for item in pair])
    elif isinstance(value, list | tuple):
        yield f"{len(value)}:".encode()
        for item in value:
            yield from _pieces(item)
    else:
        yield repr(value).encode()


# the parent's side


def _outcome(part: Part, args: argparse.Namespace, print_of: str, stages: Stages, title: str) -> Outcome:
    """A method's result: that of an earlier run where it fits, else of a process of its own."""
    if not args.force:
        kept = _finished(part, print_of, args.repeat)
        if kept is not None:
            stages.say(f"{title}: finished before, {_seconds(kept.cost)}")
            return kept
    (part.folder / RUN).unlink(missing_ok=True)
    if args.warm:
        with tempfile.TemporaryDirectory(prefix="relnav-") as folder:
            code, _ = _watched(Part(part.method, Path(folder)), args, 1, stages, f"{title}, warming up")
        if code == guard.INTERRUPTED:
            raise KeyboardInterrupt
    code, reason = _watched(part, args, args.repeat, stages, title)
    if code == guard.INTERRUPTED:
        raise KeyboardInterrupt
    if code != guard.DONE:
        stages.say(f"{title}: failed: {reason}")
        return Outcome(part.method, reason=reason)
    done = _finished(part, print_of, args.repeat)
    if done is None:
        raise InputError(f"{args.flight} or {part.folder} changed while {part.method} was running; run the command again")
    stages.say(f"{title}: {done.solution.diagnostics.status.value if done.solution else ''}, {_seconds(done.cost)}")
    return done


def _seconds(cost: Cost | None) -> str:
    return f"{cost.wall_s:.3g} s" if cost is not None else ""


def _finished(part: Part, print_of: str, n_runs: int) -> Outcome | None:
    """The stored result of a method, where it is of this problem and version and was timed as often as asked."""
    told = _told(part.folder / RUN)
    if told.get("fingerprint") != print_of or told.get("relnav") != relnav_version() or told.get("n_runs", 0) < n_runs:
        return None
    cost = Cost(told["wall_s"], told["cpu_s"], told["peak_mb"], told["n_runs"])
    try:
        return Outcome(part.method, solutions.load(part.folder / SOLUTION), cost)
    except InputError:  # absent or damaged: run again
        return None


def _told(path: Path) -> dict[str, Any]:
    """A JSON object from a file; empty where it is absent or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _watched(part: Part, args: argparse.Namespace, repeat: int, stages: Stages, title: str) -> tuple[int, str]:
    """Run a part in a child; its exit code, and one line why it failed. What it prints is kept where it fails."""
    argv = ["compare", str(args.flight), "--methods", part.method, "--out", str(part.folder), "--repeat", str(repeat)]
    argv += [word for text in args.set for word in ("--set", text)]
    argv += ["--data", str(args.data)] if args.data is not None else []
    stages(title)
    with tempfile.TemporaryFile() as errors:
        code, message = guard.watch(argv, part.folder, lambda stage: stages(f"{title}: {stage}"), subprocess.DEVNULL, errors)
        errors.seek(0)
        printed = errors.read().decode(errors="replace")
    if code in (guard.DONE, guard.INTERRUPTED):
        (part.folder / FAILURE).unlink(missing_ok=True)
        return code, ""
    told = printed + (f"relnav: {message}\n" if message else "")
    solutions.replace_with(part.folder / FAILURE, lambda path: path.write_text(told, encoding="utf-8"))
    return code, _reason(told)


def _reason(printed: str) -> str:
    """The line of what a child printed that says why it failed."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    for line in reversed(lines):
        if line.startswith("relnav: error: "):
            return line.removeprefix("relnav: error: ")
    # an error in relnav or the method itself: a traceback, whose last line is followed by ours
    told = [line for line in lines if not line.startswith("relnav: ")]
    return told[-1] if told else "it ended without saying why"


def _bound(problem: NavigationProblem, args: argparse.Namespace, print_of: str, stages: Stages) -> Bound | None:
    """The posterior bound of the pairs, where the truth is known well enough; None otherwise."""
    moving = [v for v in problem.bodies if not v.is_fixed]
    truths = [v.truth for v in moving]
    if not problem.wanted_pairs or any(t is None or t.v_n is None for t in truths):
        return None
    if any(v.imu is not None and (v.truth is None or v.truth.q_nb is None) for v in moving):
        return None
    part = Part(BOUND, args.out / BOUND_FOLDER)
    told, file = _told(part.folder / RUN), part.folder / "bound.npz"
    if (told.get("fingerprint"), told.get("relnav")) != (print_of, relnav_version()) or not file.exists() or args.force:
        (part.folder / RUN).unlink(missing_ok=True)
        code, reason = _watched(part, args, 1, stages, "bound")
        if code == guard.INTERRUPTED:
            raise KeyboardInterrupt
        if code != guard.DONE:
            stages.say(f"bound: not known: {reason}")
            return None
    with np.load(file, allow_pickle=False) as arrays:
        pairs = {(p.reference, p.rover): arrays[f"P{i}"] for i, p in enumerate(problem.wanted_pairs)}
        return arrays["t_s"], pairs


def _write(found: Comparison, outputs: Outputs, stages: Stages) -> None:
    stages("writing the comparison")
    text = json.dumps(as_json(found), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    outputs.write("comparison.json", lambda path: solutions.replace_with(path, lambda p: p.write_text(text, encoding="utf-8")))
    outputs.write("comparison.csv", lambda path: solutions.replace_with(path, lambda part: write_csv(found, part)))
    stages("writing the page")
    from scenarios.report.comparison import write_comparison

    outputs.write("comparison.html", lambda path: solutions.replace_with(path, lambda part: write_comparison(found, part)))


def as_json(found: Comparison) -> dict[str, object]:
    """The comparison as plain JSON types; numbers that are not known are null."""
    methods = []
    for o in found.outcomes:
        diagnostics = None if o.solution is None else o.solution.diagnostics
        methods.append(
            {
                "method": o.method,
                "status": "failed" if diagnostics is None else diagnostics.status.value,
                "degraded": None if o.solution is None else o.solution.is_degraded,
                "reason": o.reason,
                "warnings": [] if diagnostics is None else list(diagnostics.warnings),
                "n_runs": None if o.cost is None else o.cost.n_runs,
                **_plain(found.values[o.method]),
            }
        )
    subjects = [
        {
            "subject": s.name,
            "against": s.against,
            "epochs": s.n_epochs,
            **_plain({"bound_rmse_m": s.bound_rmse_m}),
            "methods": {method: _plain(values) for method, values in s.values.items()},
        }
        for s in found.subjects
    ]
    return {"name": found.name, "methods": methods, "subjects": subjects}


def _plain(values: dict[str, float]) -> dict[str, float | None]:
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


def write_csv(found: Comparison, path: Path) -> None:
    """A row per subject and method, and one per method that failed; what is not known is empty."""
    keys = [metric.key for metric in (*SUBJECT_METRICS, *METHOD_METRICS)]
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["subject", "against", "epochs", "method", "status", "reason", "bound_rmse_m", *keys])
        for subject in found.subjects:
            for method, values in subject.values.items():
                status = found.solutions[method].diagnostics.status.value
                told = values | found.values[method]
                head = [subject.name, subject.against, subject.n_epochs, method, status, "", _cell(subject.bound_rmse_m)]
                rows.writerow([*head, *(_cell(told[key]) for key in keys)])
        for o in found.failed:
            rows.writerow(["", "", "", o.method, "failed", o.reason, "", *([""] * len(keys))])


def _cell(value: float) -> str:
    return repr(value) if math.isfinite(value) else ""


# the table


def _print(found: Comparison) -> None:
    """The table, in as many pieces as the width asks for."""
    console = stdout_console()
    pieces: list[list[str]] = [[]]
    for method in found.solutions:
        if pieces[-1] and LABEL_WIDTH + sum(map(_column_width, [*pieces[-1], method])) > console.width:
            pieces.append([])
        pieces[-1].append(method)
    for methods in pieces:
        console.print(_table(found, methods))


def _column_width(method: str) -> int:
    return max(len(method), len(Status.CONVERGED.value)) + 3  # with its margins and rule


def _table(found: Comparison, methods: Sequence[str]) -> Table:
    table = Table(title=f"{found.name}, {len(found.solutions)} methods", title_justify="left", header_style="bold")
    table.add_column("")
    for method in methods:
        table.add_column(method, justify="right", overflow="fold")
    for subject in found.subjects:
        against = "errors against truth" if subject.has_truth else f"differences to {subject.against}"
        table.add_section()
        table.add_row(f"[bold]{escape(subject.name)}[/bold]\n{escape(against)}, {subject.n_epochs:,} epochs")
        for metric in SUBJECT_METRICS:
            _add_row(table, metric, {m: v[metric.key] for m, v in subject.values.items()}, methods)
    table.add_section()
    table.add_row("[bold]solving[/bold]")
    table.add_row("status", *(found.solutions[m].diagnostics.status.value for m in methods))
    for metric in METHOD_METRICS:
        _add_row(table, metric, {m: found.values[m][metric.key] for m in found.solutions}, methods)
    return table


def _add_row(table: Table, metric: Metric, values: dict[str, float], methods: Sequence[str]) -> None:
    if not any(math.isfinite(v) for v in values.values()):
        return
    best = best_of(metric, values)
    texts = [figure(metric, values.get(m, float("nan"))) for m in methods]
    marked = [f"[bold green]{t}[/bold green]" if m in best else t for m, t in zip(methods, texts, strict=True)]
    table.add_row(f"{metric.label} \\[{metric.unit}]" if metric.unit else metric.label, *marked)


def _tell(found: Comparison, doubts: Sequence[str], outputs: Outputs, stages: Stages) -> int:
    """Say what was written and what cannot be trusted; the exit code."""
    for path in outputs.finished:
        print(f"{path.name:<16} {path}")
    for doubt in doubts:
        stages.say(f"relnav: degraded: {doubt}")
    for o in found.failed:
        stages.say(f"relnav: degraded: {o.method} failed: {o.reason}")
    for method, solution in found.solutions.items():
        for warning in (w for w in solution.diagnostics.warnings if w not in doubts):
            stages.say(f"relnav: degraded: {method}: {warning}")
        if solution.diagnostics.status is not Status.CONVERGED:
            n = solution.diagnostics.n_iterations
            stages.say(f"relnav: degraded: {method}: {solution.diagnostics.status.value} after {n} iterations")
    degraded = bool(found.failed) or any(s.is_degraded for s in found.solutions.values())
    return guard.DEGRADED if degraded else guard.DONE


# the child's side


def run_part(args: argparse.Namespace) -> int:
    """In a process of its own: solve the flight with one method, or find its bound, and store that."""
    outputs = Outputs(args.out)
    with early_end(outputs), Stages(args.trace) as stages:
        if args.methods == BOUND:
            problem, _ = read_problem(args, stages)
            stages("finding the bound")
            _store_bound(problem, args.out)
            told: dict[str, object] = {}
        else:
            stages("loading the engine")
            estimators.create(args.methods)
            problem, doubts = read_problem(args, stages)
            told = _measured(problem, doubts, args, outputs, stages)
        told = {"fingerprint": fingerprint(problem), "relnav": relnav_version(), **told}
        text = json.dumps(told, indent=1) + "\n"
        outputs.write(RUN, lambda path: solutions.replace_with(path, lambda part: part.write_text(text, encoding="utf-8")))
    return guard.DONE


def _measured(
    problem: NavigationProblem, doubts: tuple[str, ...], args: argparse.Namespace, outputs: Outputs, stages: Stages
) -> dict[str, object]:
    """Solve as often as asked and store the solution; what it cost."""
    wall_s, cpu_s = [], []
    before_mb = _memory_mb("VmRSS")
    _forget_peak()
    for _ in range(args.repeat):
        stages("solving")
        start = time.perf_counter(), _cpu_s()
        solution = solve(problem, doubts, args.methods, stages)
        wall_s.append(time.perf_counter() - start[0])
        cpu_s.append(_cpu_s() - start[1])
        if solution.diagnostics.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
    peak_mb = max(_memory_mb("VmHWM") - before_mb, 0.0)
    stages("writing the results")
    outputs.write(SOLUTION, lambda path: solutions.save(solution, path))
    text = json.dumps(summary(solution), indent=1, ensure_ascii=False) + "\n"
    outputs.write("summary.json", lambda path: solutions.replace_with(path, lambda part: part.write_text(text, encoding="utf-8")))
    costs = {"wall_s": float(np.median(wall_s)), "cpu_s": float(np.median(cpu_s)), "peak_mb": peak_mb}
    return {**costs, "n_runs": args.repeat, "all_wall_s": wall_s, "all_cpu_s": cpu_s}


def _store_bound(problem: NavigationProblem, folder: Path) -> None:
    from factorgraph.bound import posterior_bound  # brings in CasADi, which a light import must not

    bound = posterior_bound(problem)
    arrays = {f"P{i}": bound.pairs[(p.reference, p.rover)] for i, p in enumerate(problem.wanted_pairs)}

    def write(part: Path) -> None:
        with part.open("wb") as file:
            np.savez(file, allow_pickle=False, t_s=bound.t_s, **arrays)

    solutions.replace_with(folder / "bound.npz", write)


def _cpu_s() -> float:
    """Processor time of all threads of this process and of its finished children."""
    return sum(os.times()[:4])


def _forget_peak() -> None:
    """Let VmHWM begin anew, where the system can."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def _memory_mb(field: str) -> float:
    """Resident memory now (VmRSS) or at most (VmHWM); where there is no /proc, the most so far, NaN without `resource`."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith(f"{field}:")) / 1024
    except OSError:
        pass
    try:
        import resource
    except ModuleNotFoundError:
        return float("nan")
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
