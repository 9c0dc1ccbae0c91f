"""The demonstration: recordings that come with installed packages and one simulated flight, smoothed and reported.

Every flight runs in its own watched process: one that fails does not hide the others.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from scenarios import guard
from scenarios.cli import check_writable
from scenarios.commands import stdout_console

RECORDINGS = {
    "cssrlib-static": "two GNSS receivers 5 km apart, carrier phase",
    "kitti": "car with IMU and position fixes",
    "plaza1": "robot with radio ranges to four beacons",
}
SCENARIO, SCENARIO_TEXT = "two-uav", "two UAVs, simulated: IMU, moving-base carrier phase, UWB"
COLUMNS = {  # heading -> quantities of the summary, the first that is there
    "fixed": ("integers fixed",),
    "σ, median": ("baseline σ, median", "position σ, median"),
    "error RMS": ("baseline error RMS", "position error RMS"),
}
RESULTS = {guard.DONE: "done", guard.DEGRADED: "degraded", guard.INTERRUPTED: "stopped"}


@dataclass(frozen=True, slots=True)
class Run:
    """How one flight of the demonstration went."""

    name: str
    text: str
    code: int
    folder: Path
    seconds: float


def demo(args: argparse.Namespace) -> int:
    """Smooth every flight, print one table; 1 when one of them failed or is degraded, 130 when stopped."""
    check_writable(args.out)
    console = Console(stderr=True)
    runs: list[Run] = []
    flight = args.out / f"{SCENARIO}-flight"
    steps = [(name, text, name) for name, text in RECORDINGS.items()] + [(SCENARIO, SCENARIO_TEXT, str(flight))]
    for i, (name, text, source) in enumerate(steps, start=1):
        console.print(f"[{i}/{len(steps)}] {name}: {text}", markup=False, highlight=False)
        runs.append(_run(name, text, source, args.out / name, flight))
        if runs[-1].code == guard.INTERRUPTED:
            break
    _print_table(runs)
    codes = [run.code for run in runs]
    if guard.INTERRUPTED in codes:
        return guard.INTERRUPTED
    return guard.DEGRADED if any(codes) else guard.DONE


def _run(name: str, text: str, source: str, folder: Path, flight: Path) -> Run:
    start = time.perf_counter()
    code = guard.run(["simulate", SCENARIO, str(flight)], flight, quiet=True) if name == SCENARIO else guard.DONE
    if code == guard.DONE:
        code = guard.run(["smooth", source, "--out", str(folder)], folder, quiet=True)
    return Run(name, text, code, folder, time.perf_counter() - start)


def _print_table(runs: list[Run]) -> None:
    table = Table(title="relnav demo", title_justify="left", header_style="bold")
    table.add_column("flight", no_wrap=True)
    table.add_column("result")
    table.add_column("of", no_wrap=True)
    for column in COLUMNS:
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("time", justify="right", no_wrap=True)
    for run in runs:
        subjects = _subjects(run) or {"": {}}
        for i, (subject, values) in enumerate(subjects.items()):
            cells = [next((values[q] for q in quantities if q in values), "–") for quantities in COLUMNS.values()]
            ends = (run.name, RESULTS.get(run.code, "failed"), f"{run.seconds:.1f} s") if i == 0 else ("", "", "")
            table.add_row(*ends[:2], subject, *cells, ends[2])
        table.add_section()
    stdout_console().print(table)
    for run in runs:
        if (run.folder / "report.html").exists() and run.code in (guard.DONE, guard.DEGRADED):
            print(run.folder / "report.html")


def _subjects(run: Run) -> dict[str, dict[str, str]]:
    """Pair or vehicle -> quantity -> text, of the summary that a finished run wrote."""
    if run.code not in (guard.DONE, guard.DEGRADED):
        return {}
    found: dict[str, dict[str, str]] = {}
    for row in json.loads((run.folder / "summary.json").read_text(encoding="utf-8"))["rows"]:
        found.setdefault(row["subject"], {})[row["quantity"]] = row["text"]
    shown = {quantity for quantities in COLUMNS.values() for quantity in quantities}
    return {subject: values for subject, values in found.items() if shown & values.keys()}
