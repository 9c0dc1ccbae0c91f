"""Studies by name: ours are listed here; an installed package adds its own through the entry-point group `relnav.studies`."""

from __future__ import annotations

import argparse

from factorgraph.named import Named, Names
from scenarios.studies.study import Study

STUDIES = Names(
    "study",
    "relnav.studies",
    (
        Named(
            "aar",
            "scenarios.studies.aar:STUDY",
            "two-stage relative navigation for aerial refuelling, after Wu and others (2022)",
        ),
        Named(
            "ahrs-tdo",
            "scenarios.studies.ahrs_tdo:STUDY",
            "relative navigation with attitude systems, UWB and Tasmanian devil optimisation, after Lu and others (2024)",
        ),
        Named(
            "optimisers",
            "scenarios.studies.optimisers:STUDY",
            "swarm optimisers on test functions and on navigation, at equal evaluations",
        ),
        Named(
            "stress",
            "scenarios.studies.stress:STUDY",
            "the factor graph under outliers, slips, wrong installations, unknown headings and long baselines",
        ),
    ),
)


def studies() -> dict[str, Named]:
    """All studies, ours first; none is imported."""
    return STUDIES.all()


def create(name: str) -> Study:
    """A study by name. Raises InputError with the nearest name for an unknown one."""
    study: Study = STUDIES.create(name)
    return study


def add_options(parser: argparse.ArgumentParser, known: argparse.Namespace) -> None:
    """Add to the options of `relnav study` those of the study that the command line names."""
    if known.name is not None:
        study = create(known.name)
        parser.description = f"{study.summary[0].upper()}{study.summary[1:]}."
        study.add_options(parser.add_argument_group(f"options of {known.name}"))  # type: ignore[arg-type]  # same methods
