"""The study of the optimisers on paper: verdicts, ranks, spreads, success, as Markdown, JSON and a page."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph.consistency import Interval
from scenarios.metrics_ranks import LEVEL
from scenarios.studies.document import Table, markdown_section, write_text
from scenarios.studies.optimisers import KINDS, N_MEMBERS, PARTS, available
from scenarios.studies.optimisers_summary import SUBJECT, Problem, Summary, Verdict, summarise
from scenarios.studies.study import Job, Outcome, Results

JSON_NAME, PAGE_NAME, REPORT_NAME = "optimisers.json", "optimisers.md", "report.html"
RIVALS = ("ga", "pso")
OPEN = "problems better / worse / open"
HOW = (
    "Every method has the same problems, the same numbers of evaluations and, seed by seed, the same places of the optima. "
    "The error is the cost above the optimum, in navigation J/J* - 1 with J* of Gauss-Newton. A run that gets below 1e-8, in "
    "navigation 1e-6, is stopped, and such errors count as even."
)


def tables(summary: Summary) -> list[Table]:
    """All tables that have rows, in reading order."""
    found = [
        verdict_table(summary),
        speed_table(summary),
        rank_table(summary),
        success_table(summary),
        contrast_table(summary),
        *(error_table(summary, kind) for kind in summary.kinds),
        *(solved_table(summary, kind) for kind in summary.kinds),
        time_table(summary),
    ]
    return [table for table in found if table.rows]


def verdict_table(summary: Summary) -> Table:
    """Whether the subject is better than the others, per kind."""
    head = ("problems", "against", f"{SUBJECT} better?", f"error of {SUBJECT} / of the other", "p", OPEN)
    note = (
        f"Wilcoxon's signed-rank test over {summary.n_seeds} seeds of the mean decimal logarithm of the error over the problems; "
        f"p after Holm for the whole table, level {LEVEL:g}. The ratio is 10 to the median of the differences. The last column "
        "tests every problem by itself, after Holm within its kind."
    )
    return Table(f"Is {SUBJECT} better?", head, tuple(map(_verdict_row, summary.verdicts)), note, 3)


def speed_table(summary: Summary) -> Table:
    """Whether the subject needs fewer evaluations, where nearly all runs succeed."""
    head = ("problems", "against", f"{SUBJECT} sooner?", f"evaluations of {SUBJECT} / of the other", "p", OPEN)
    note = (
        "Problems that nearly all runs solve: what is left to compare are the evaluations until they are solved, the "
        "budget where they are not, tested as the errors are."
    )
    return Table(f"Is {SUBJECT} sooner?", head, tuple(map(_verdict_row, summary.speeds)), note, 3)


def _verdict_row(v: Verdict) -> tuple[str, ...]:
    counts = f"{v.n_better} / {v.n_worse} / {v.n_problems - v.n_better - v.n_worse}"
    return KINDS[v.kind].title, v.second, v.word, number(10.0**-v.test.median_difference), probability(v.p), counts


def sentences(summary: Summary) -> list[str]:
    """The verdicts on the published claim, that the subject is better than GA and PSO, in words."""
    said = []
    asked = (
        ("smaller error than {}?", summary.verdicts),
        ("solved sooner than by {}, where nearly all runs succeed?", summary.speeds),
    )
    for question, verdicts in asked:
        for rival in RIVALS:
            titles: dict[str, list[str]] = {}
            for v in verdicts:
                if v.second == rival:
                    titles.setdefault(v.word, []).append(KINDS[v.kind].title)
            listed = "; ".join(f"{word}: {' | '.join(found)}" for word, found in titles.items())
            said += [f"{SUBJECT}, {question.format(rival)} {listed}."] if titles else []
    return said


def rank_table(summary: Summary) -> Table:
    """Mean ranks with critical differences."""
    rows = []
    for kind, r in summary.rankings.items():
        ranks = tuple(f"{rank:.2f}" for rank in r.mean_ranks)
        rows.append((KINDS[kind].title, *ranks, f"{r.critical_difference:.2f}", str(r.n_blocks), probability(r.p)))
    note = (
        "1 is best. Two methods differ where their mean ranks do by more than the critical difference (Nemenyi, level "
        f"{LEVEL:g}); p is Friedman's test that all are alike. Ranked is the median over the seeds of every problem, in "
        "navigation every snapshot."
    )
    return Table("Mean ranks", ("problems", *summary.methods, "critical difference", "ranked", "p"), tuple(rows), note)


def success_table(summary: Summary) -> Table:
    """Solved runs per kind."""
    rows = tuple(
        (KINDS[kind].title, f"{summary.of(kind)[0].solved:g}", *(share(summary.success(kind, m)) for m in summary.methods))
        for kind in summary.kinds
    )
    note = (
        f"Runs that came below the error in the second column within {summary.max_evals:,} evaluations, with Wilson's intervals."
    )
    return Table("Success [%]", ("problems", "error", *summary.methods), rows, note)


def contrast_table(summary: Summary) -> Table:
    """The same problems put in two ways, per method."""
    rows = tuple(
        (
            *(f"{KINDS[c.first].title} / {KINDS[c.second].title}", c.method, c.word),
            *(number(10.0**-c.test.median_difference), probability(c.p)),
        )
        for c in summary.contrasts
    )
    note = (
        "Tested as above, after Holm for this table. A ratio below 1: the error is smaller in the first way. Every box of "
        "navigation has its middle at the posterior, normalised and whitened ones their origin as well. The minimum of O3 lies "
        "near it, in the formation all but on it: there a search that is drawn to the origin, or starts in the middle as cma-es "
        "does, has an advantage that is not its own."
    )
    return Table("Does the place of the origin matter?", ("ways", "method", "finding", "ratio of the errors", "p"), rows, note, 3)


def error_table(summary: Summary, kind: str) -> Table:
    """Median and quartiles of the error, problem by problem."""
    rows = []
    for p in summary.of(kind):
        rows.append((p.name, *(_error(p, m) for m in p.methods)))
    note = f"Median and quartiles over the seeds after {summary.max_evals:,} evaluations."
    errors = np.concatenate([p.error.ravel() for p in summary.of(kind)])
    below = errors < -summary.of(kind)[0].even
    if below.any():
        note += (
            f" {below.sum()} of {len(errors):,} runs went below Gauss-Newton's J*, by {number(-errors.min(), 2)} of it at most."
        )
    return Table(f"Error: {KINDS[kind].title}", ("problem", *summary.methods), tuple(rows), note)


def _error(problem: Problem, method: str) -> str:
    s, even = problem.spread(method), problem.even
    if s.upper < even:
        return f"< {even:g}"
    median, lower, upper = (number(max(x, 0.0), 2) if x >= even else f"< {even:g}" for x in (s.median, s.lower, s.upper))
    return f"{median} ({lower} to {upper})"


def solved_table(summary: Summary, kind: str) -> Table:
    """Success and evaluations for it, problem by problem."""
    rows = tuple((p.name, *(_solved(p, m) for m in p.methods)) for p in summary.of(kind))
    note = "Share of solved runs in percent, and the evaluations of all runs for each solved one."
    return Table(f"Solved: {KINDS[kind].title}", ("problem", *summary.methods), rows, note)


def _solved(problem: Problem, method: str) -> str:
    expected = problem.expected_evals(method)
    share_of = f"{100 * problem.success(method).value:.0f}"
    return f"{share_of} ({expected:,.0f})" if np.isfinite(expected) else share_of


def time_table(summary: Summary) -> Table:
    """What an evaluation costs."""
    rows = tuple(
        (KINDS[kind].title, *(f"{summary.microseconds(kind, m):.2f}" for m in summary.methods)) for kind in summary.kinds
    )
    note = "Median, one thread, compiled costs."
    return Table("Time of an evaluation, the method's own work included [µs]", ("problems", *summary.methods), rows, note)


def number(x: float, digits: int = 3) -> str:
    """To significant digits, with a power of ten only where it is shorter."""
    shown = f"{x:.{digits}g}"
    return f"{float(shown):.0f}" if "e+0" in shown and abs(x) < 1e5 else shown


def probability(p: float) -> str:
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def share(x: Interval) -> str:
    return f"{100 * x.value:.0f} ({100 * x.lower:.0f} to {100 * x.upper:.0f})"


# files


def write(results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
    """The record as JSON and Markdown and the page, in `folder`."""
    from scenarios.report.optimisers import write_study

    summary = summarise(results)
    command = command_line(options)
    content = json.dumps(record(summary, command), separators=(",", ":"), allow_nan=False).replace(',{"', ',\n{"')
    write_text(folder / JSON_NAME, content + "\n")
    write_text(folder / PAGE_NAME, markdown(summary, command))
    write_study(summary, folder / REPORT_NAME, command)
    return Outcome((*sentences(summary), f"written: {JSON_NAME}, {PAGE_NAME}, {REPORT_NAME} in {folder}"))


def command_line(options: argparse.Namespace) -> str:
    """The command that makes the same again."""
    told = ["--quick"] if options.quick else []
    told += [f"--{name} {value}" for name in ("trials", "evals") if (value := getattr(options, name)) is not None]
    told += [f"--seed {options.seed}"] if options.seed != 1 else []
    usual = {"methods": available(), "parts": PARTS, "functions": None, "dimensions": None}
    for name, known in usual.items():
        given = getattr(options, name)
        if given is not None and tuple(given) != known:
            told.append(f"--{name} {' '.join(map(str, given))}")
    return " ".join(["relnav study optimisers", *told])


def parameters(summary: Summary) -> Mapping[str, str]:
    """What the study is made of."""
    return {
        "methods": ", ".join(summary.methods),
        "seeds": str(summary.n_seeds),
        "evaluations of a run": f"{summary.max_evals:,}",
        "members of a population": f"{N_MEMBERS}",
    } | {KINDS[kind].title: KINDS[kind].about for kind in summary.kinds}


def markdown(summary: Summary, command: str) -> str:
    """The record as a page of the documentation."""
    listed = "".join(f"- {name}: {value}\n" for name, value in parameters(summary).items())
    found = "".join(f"- {sentence}\n" for sentence in sentences(summary))
    parts = [f"# Optimisers compared\n\n`{command}`. {HOW}\n\n{listed}" + (f"\nFound:\n\n{found}" if found else "")]
    return "\n".join(parts + [markdown_section(table) for table in tables(summary)])


def record(summary: Summary, command: str) -> dict[str, Any]:
    """What the JSON file holds."""
    return {
        "study": "optimisers",
        "command": command,
        "parameters": dict(parameters(summary)),
        "verdicts": [_plain_verdict(v) for v in summary.verdicts],
        "speeds": [_plain_verdict(v) for v in summary.speeds],
        "contrasts": [
            {"first": c.first, "second": c.second, "method": c.method, "finding": c.word, "p": c.p, "test": asdict(c.test)}
            for c in summary.contrasts
        ],
        "rankings": {
            kind: {"mean_ranks": dict(zip(summary.methods, r.mean_ranks.tolist(), strict=True)), "n": r.n_blocks, "p": r.p}
            | {"critical_difference": r.critical_difference}
            for kind, r in summary.rankings.items()
        },
        "problems": [
            {"kind": p.kind, "name": p.name, "solved": p.solved, "even": p.even, "seeds": len(p.seeds)}
            | {"methods": {m: _plain(p, m) for m in p.methods}}
            for p in summary.problems
        ],
    }


def _plain_verdict(v: Verdict) -> dict[str, object]:
    about = {"kind": v.kind, "first": v.first, "second": v.second, "verdict": v.word, "p": v.p, "test": asdict(v.test)}
    return about | {"problems": [v.n_better, v.n_worse, v.n_problems]}


def _plain(problem: Problem, method: str) -> dict[str, object]:
    """Quartiles of the error, success with its interval, expected evaluations (null: never solved)."""
    s, success, expected = problem.spread(method), problem.success(method), problem.expected_evals(method)
    return {
        "error": [float(f"{x:.4g}") for x in (s.lower, s.median, s.upper)],
        "success": [round(x, 4) for x in (success.value, success.lower, success.upper)],
        "evals": round(expected) if np.isfinite(expected) else None,
    }
