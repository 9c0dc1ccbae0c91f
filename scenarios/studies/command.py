"""`relnav study`: lists the studies or runs one, and shows how far it is."""

from __future__ import annotations

import argparse

from scenarios import guard
from scenarios.cli import OUT_ROOT, check_writable
from scenarios.commands import Outputs, Stages, early_end, print_catalogue
from scenarios.studies import catalogue, engines, runner
from scenarios.studies.runner import Tally
from scenarios.studies.store import TRIALS
from scenarios.studies.study import Outcome


def study(args: argparse.Namespace) -> int:
    """Run a study, or list the studies."""
    if args.name is None:
        print_catalogue("study", ((info.name, info.summary, info.path) for info in catalogue.studies().values()))
        return guard.DONE
    chosen = catalogue.create(args.name)
    engine = engines.choose(args.engine, args.workers)
    outputs = _Outputs(args.out if args.out is not None else OUT_ROOT / f"study-{args.name}")
    check_writable(outputs.folder)
    with guard.one_interrupt(), early_end(outputs), Stages() as stages:
        stages("reading what is there")
        tally, outcome = runner.run(chosen, args, outputs.folder, engine, _Shown(outputs, stages))
    return _told(tally, outcome, stages)


def _told(tally: Tally, outcome: Outcome, stages: Stages) -> int:
    """Say what came out and whether it can be trusted; the exit code."""
    for line in outcome.lines:
        print(line)
    for warning in outcome.warnings:
        stages.say(f"relnav: degraded: {warning}")
    if tally.failed:
        stages.say(f"relnav: degraded: {len(tally.failed)} of {tally.total} trials failed; see {tally.failed[0].path.parent}")
    return guard.DEGRADED if outcome.warnings or tally.failed else guard.DONE


class _Outputs(Outputs):
    """A folder of trials: an early end costs those that were under way."""

    tally: Tally | None = None

    @property
    def state(self) -> str:
        if self.tally is None or not self.finished:
            return "no trial is finished yet"
        return f"{self.tally.stored} of {self.tally.total} trials are kept in {self.folder}; the same command goes on from there"


class _Shown:
    """Progress of trials: a bar on a terminal, elsewhere a line whenever another tenth is done."""

    def __init__(self, outputs: _Outputs, stages: Stages) -> None:
        self._outputs = outputs
        self._stages = stages
        self._tenths = 0
        self._n_failed = 0

    def __call__(self, tally: Tally) -> None:
        """Hear of a change."""
        if self._outputs.tally is None:
            self._begin(tally)
        self._outputs.tally = tally
        self._outputs.finished = [self._outputs.folder / TRIALS] if tally.stored else []
        for failure in tally.failed[self._n_failed :]:
            self._stages.say(f"relnav: trial {failure.key} failed: {failure.why}; see {failure.path}")
        self._n_failed = len(tally.failed)
        self._stages(f"trials: {tally.text}", tally.fraction)
        tenths = int(10 * tally.fraction)
        if tenths > self._tenths and not self._stages.is_shown:
            self._stages.say(f"trials: {tally.text}")
        self._tenths = tenths
        if tally.fraction == 1.0:
            self._stages("writing the results")

    def _begin(self, tally: Tally) -> None:
        self._tenths = int(10 * tally.fraction)
        for number, what in (
            (tally.kept, "are kept from an earlier run"),
            (tally.outdated, "are of another version or other parameters and done again"),
            (tally.damaged, "are damaged and done again"),
        ):
            if number:
                self._stages.say(f"relnav: {number} of {tally.total} trials {what}")
