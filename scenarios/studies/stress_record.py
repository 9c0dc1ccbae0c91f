"""The stress study on paper: a table, the claims it is to bear, JSON and a page."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph.consistency import Interval, band, mean_interval, paired_bootstrap, wilson
from factorgraph.types import Array
from scenarios.report.frame import Card, Page, Section, write_page
from scenarios.report.tables import paragraph, table
from scenarios.studies.document import write_text
from scenarios.studies.stress import CASES, FRACTIONS, parameters
from scenarios.studies.study import Job, Outcome, Results

HEAD = (
    *("case", "seeds", "RMSE as it should be [mm]", "RMSE with the fault [mm]", "ratio", "fixed [%]", "wrong [%]"),
    *("mean NEES of 3", "epochs in the 95 % band", "what was found"),
)


@dataclass(frozen=True, slots=True)
class CaseSummary:
    """One case over all seeds."""

    name: str
    seeds: int
    clean_mm: Interval
    faulty_mm: Interval
    ratio: Interval  # of the root mean squares over seeds, faulty to clean, paired
    fixed: Interval  # mean over seeds
    wrong: float
    nees: float
    in_band: int  # of FRACTIONS, across seeds
    found: str


def summarise(results: Results[Job]) -> list[CaseSummary]:
    """What every case came to."""
    out = []
    for name in CASES:
        trials = [dict(arrays) for job, arrays in results.items() if job.parameters["case"] == name]
        if trials:
            out.append(_summary(name, trials))
    return out


def _column(trials: list[dict[str, Any]], name: str) -> Array:
    return np.array([t[name] for t in trials], float)


def _ratio(a: Array, b: Array) -> Array:
    """Root mean square of b to that of a over the last axis."""
    return np.asarray(np.sqrt(np.mean(b**2, axis=-1) / np.mean(a**2, axis=-1)))


def _summary(name: str, trials: list[dict[str, Any]]) -> CaseSummary:
    clean, faulty = _column(trials, "clean/rmse_m"), _column(trials, "faulty/rmse_m")
    n = len(trials)
    total = _column(trials, "faulty/nees").sum(axis=0)
    lower, upper = band(np.full(len(FRACTIONS), 3.0 * n))
    ratio = paired_bootstrap(clean, faulty, np.random.default_rng(0), _ratio) if n > 1 else mean_interval(faulty / clean)
    return CaseSummary(
        name,
        n,
        mean_interval(1e3 * clean),
        mean_interval(1e3 * faulty),
        ratio,
        mean_interval(_column(trials, "faulty/fixed")),
        float(_column(trials, "faulty/wrong").mean()),
        float(total.mean() / n),
        int(np.sum((total >= lower) & (total <= upper))),
        _found(trials),
    )


def _share(trials: list[dict[str, Any]], part: str, whole: str) -> str:
    share = wilson(int(_column(trials, part).sum()), int(_column(trials, whole).sum()))
    return f"{100 * share.value:.2f} % ({100 * share.lower:.2f} to {100 * share.upper:.2f})"


def _found(trials: list[dict[str, Any]]) -> str:
    """What the case's own measures say, in words."""
    parts = []
    if "outliers" in trials[0]:
        parts.append(f"outliers found {_share(trials, 'outliers_found', 'outliers')}")
        parts.append(f"good codes refused {_share(trials, 'good_refused', 'good')}")
    if "parameter_error" in trials[0]:
        error, sigmas = _column(trials, "parameter_error"), _column(trials, "parameter_sigmas")
        parts.append(f"largest error {error.max():.2g}, rms {np.sqrt(np.mean(error**2)):.2g}")
        parts.append(f"{int(np.sum(sigmas <= 3))} of {len(sigmas)} within 3 σ")
    for key, words in (("slips", "slips left inside kept arcs"), ("starts", "starts that end elsewhere")):
        if key in trials[0]:
            parts.append(f"{words}: {int(_column(trials, key + '_missed').sum())} of {int(_column(trials, key).sum())}")
    return "; ".join(parts)


def _interval(x: Interval, scale: float = 1.0, digits: int = 1) -> str:
    return f"{scale * x.value:.{digits}f} ({scale * x.lower:.{digits}f} to {scale * x.upper:.{digits}f})"


def rows(summaries: list[CaseSummary]) -> list[list[str]]:
    """The table, one row per case."""
    return [
        [
            *(s.name, str(s.seeds), _interval(s.clean_mm), _interval(s.faulty_mm), _interval(s.ratio, 1.0, 3)),
            *(_interval(s.fixed, 100.0), f"{100 * s.wrong:.2f}", f"{s.nees:.2f}", f"{s.in_band} of {len(FRACTIONS)}", s.found),
        ]
        for s in summaries
    ]


def markdown(summaries: list[CaseSummary], command: str) -> str:
    """The record as a page of the documentation."""
    lines = ["# Stress of the factor graph", "", f"`{command}`. Mean over seeds with 95 % intervals; the ratio is of root mean"]
    lines += ["squares over all seeds, both flights of a seed drawn alike.", "", "| " + " | ".join(HEAD) + " |"]
    lines += ["|" + "---|" * len(HEAD)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(summaries)]
    lines += ["", "Cases:", ""]
    lines += [f"- {name}: {what}" for name, what in parameters().items()]
    return "\n".join(lines) + "\n"


def write(results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
    """Summary as JSON, Markdown and page in `folder`."""
    summaries = summarise(results)
    command = f"relnav study stress{' --quick' if options.quick else ''}"
    tree = {"command": command, "cases": {s.name: _plain(s) for s in summaries}, "parameters": dict(parameters())}
    write_text(folder / "stress.json", json.dumps(tree, indent=1) + "\n")
    write_text(folder / "stress.md", markdown(summaries, command))
    write_page(_page(summaries, command), folder / "report.html")
    said = [", ".join(filter(None, [f"{s.name}: RMSE ratio {_interval(s.ratio, 1.0, 3)}", s.found])) for s in summaries]
    return Outcome((*said, f"written: stress.json, stress.md, report.html in {folder}"))


def _plain(s: CaseSummary) -> Mapping[str, object]:
    def number(x: float) -> float | None:
        return round(float(x), 6) if np.isfinite(x) else None

    def interval(x: Interval) -> list[float | None]:
        return [number(x.value), number(x.lower), number(x.upper)]

    return {
        "seeds": s.seeds,
        "clean_mm": interval(s.clean_mm),
        "faulty_mm": interval(s.faulty_mm),
        "ratio": interval(s.ratio),
        "fixed": interval(s.fixed),
        "wrong": number(s.wrong),
        "nees": number(s.nees),
        "in_band": s.in_band,
        "found": s.found,
    }


def _page(summaries: list[CaseSummary], command: str) -> Page:
    cards = [
        Card(s.name, f"× {s.ratio.value:.3f}", f"{s.faulty_mm.value:.1f} mm, fixed {100 * s.fixed.value:.1f} %")
        for s in summaries
    ]
    lead = paragraph("Error with the fault to the error without it, the same draws in both.")
    cases = table(("case", "what"), [list(item) for item in parameters().items()], 2)
    sections = [
        Section("cases", "Cases", "Cases", html=lead + table(HEAD, rows(summaries), 1)),
        Section("what", "What they are", "What", html=cases),
    ]
    return Page("relnav study stress", "Stress of the factor graph", sections, cards, lines=(command,))
