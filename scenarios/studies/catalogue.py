"""Studies by name: ours are listed here; an installed package adds its own through the entry-point group `relnav.studies`."""

from __future__ import annotations

import argparse
import difflib
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points

from factorgraph.errors import InputError
from scenarios.studies.study import Study

GROUP = "relnav.studies"


@dataclass(frozen=True, slots=True)
class StudyInfo:
    name: str
    path: str  # "package.module:CLASS_OR_INSTANCE"
    summary: str


BUILT_IN = (StudyInfo("aar", "scenarios.studies.aar:STUDY", "two-stage relative navigation for aerial refuelling, as published"),)


def studies() -> dict[str, StudyInfo]:
    """All studies, ours first; none is imported."""
    found = {s.name: s for s in BUILT_IN}
    for entry in entry_points(group=GROUP):
        found.setdefault(entry.name, StudyInfo(entry.name, entry.value, f"from {entry.dist.name if entry.dist else '?'}"))
    return found


def create(name: str) -> Study:
    """A study by name. Raises InputError with the nearest name for an unknown one."""
    known = studies()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]}?" if near else "."
        raise InputError(f"no study named {name}{hint} There are: {', '.join(known)}")
    module, _, attribute = known[name].path.partition(":")
    found = getattr(import_module(module), attribute)
    study: Study = found() if isinstance(found, type) else found
    return study


def add_options(parser: argparse.ArgumentParser, known: argparse.Namespace) -> None:
    """Add to the options of `relnav study` those of the study that the command line names."""
    if known.name is not None:
        study = create(known.name)
        parser.description = f"{study.summary[0].upper()}{study.summary[1:]}."
        study.add_options(parser.add_argument_group(f"options of {known.name}"))  # type: ignore[arg-type]  # same methods
